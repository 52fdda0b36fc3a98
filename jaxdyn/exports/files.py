"""The files that `Exported.save` writes: object file, header, test program and build file."""

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyn.compile.standalone import DEGENERATE, NOT_FINITE, LinkableFile, Triple
from jaxdyn.exports.interfaces import C_TYPES, Argument

TOLERANCE = 1e-12  # of the test program, relative: other processors round fused operations otherwise
_TOLERANCE_SINGLE = 1e-4  # a thousand roundings of float32, which accelerations of long chains lose


def write_files(exported: Any, folder: Path, made: LinkableFile, target: Triple, abi: str) -> Path:
    """Write all files; none where one cannot be written. **Raises:** ValueError where the folder cannot be written."""
    name = exported.name
    contents: dict[str, bytes] = {f"{name}.o": made.binary}
    if abi == "casadi":
        contents["CMakeLists.txt"] = _casadi_build(name, made).encode()
        contents[f"{name}_test.py"] = _casadi_test(exported).encode()
    else:
        contents[f"{name}.h"] = header(exported, made, target).encode()
        contents[f"{name}_test.c"] = test_program(exported).encode()
        contents["CMakeLists.txt"] = _build(name, made).encode()
    # Written beside their final names and moved at the end: a full disk leaves no half of a header behind.
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as place:
            for file, content in contents.items():
                (Path(place) / file).write_bytes(content)
            for file in contents:
                shutil.move(Path(place) / file, folder / file)
    except OSError as error:
        raise ValueError(f"folder is {str(folder)!r}, which cannot be written ({error}); name another folder") from None
    return folder


# --- the header ---


def header(exported: Any, made: LinkableFile, target: Triple) -> str:
    """C header: sizes, structures, and one prototype for each function."""
    name, upper = exported.name, exported.name.upper()
    lines = [
        f"/* {name}: made by jaxdyn for {target.triple}, {target.cpu or 'generic'}.",
        " *",
        " * Functions allocate nothing, have no state and may be called from several threads at once. They return 0, or",
        f" * {DEGENERATE} where the sample has no regular solution: constraint rows contradict each other, the mass matrix is",
        " * singular, or a step cannot be completed; the results are then not defined;",
        f" * {NOT_FINITE} where a result is infinite or not a number.",
        f" * Functions of the C library that they call: {', '.join(made.library) or 'none'}.",
        " */",
        f"#ifndef {upper}_H",
        f"#define {upper}_H",
        "",
        "#include <stdint.h>",
        "",
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        "",
        *_definitions(exported, made),
        *_prototypes(exported),
        "",
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "",
        "#endif",
        "",
    ]
    return "\n".join(lines)


def _definitions(exported: Any, made: LinkableFile) -> list[str]:
    """Lines with the sizes of arrays, the bytes of stack, and the structures."""
    name, upper = exported.name, exported.name.upper()
    lines = []
    for argument in exported.arguments:
        for leaf in argument.leaves:
            label = f"{argument.name}_{leaf.name}" if argument.is_structure else leaf.name
            lines.append(f"#define {upper}_SIZE_{label.upper()} {_size(leaf.shape)}")
    lines += [f"#define {upper}_SIZE_{result.upper()} {_size(shape)}" for result, shape, _ in exported.results()]
    lines += ["", "/* Bytes of stack that each function takes at most, with those that it calls. */"]
    lines += [f"#define {symbol.upper()}_STACK_BYTES {made.stack[symbol]}" for symbol in exported.symbols()]
    for argument in exported.arguments:
        if argument.is_structure:
            lines += ["", f"/* The arrays of the argument {argument.name}, each by rows. */", "typedef struct {"]
            # C has no arrays without entries, so an empty one has a place that nothing reads.
            lines += [
                f"  {C_TYPES[leaf.dtype.name]} {leaf.name}[{max(1, _size(leaf.shape))}]; /* shape {leaf.shape} */"
                for leaf in argument.leaves
            ]
            lines += [f"}} {_type_of(name, argument)};"]
    return lines


def _prototypes(exported: Any) -> list[str]:
    """Lines with the prototypes, and the order and units of the entries of each argument."""
    name = exported.name
    lines = ["", "/*", f" * {name}: arrays are stored by rows. Results may overwrite arguments."]
    for argument in exported.arguments:
        if not argument.is_structure:
            (leaf,) = argument.leaves
            comment = exported.comment_on(argument.name, _size(leaf.shape))
            lines.append(f" * {argument.name} {leaf.shape}" + (f": {comment}" if comment else ""))
    lines += [f" * {result} {shape}" for result, shape, _ in exported.results()]
    lines += [" */", f"int {name}({_parameters(exported, exported.results())});"]
    if exported.derivative is not None:
        lines += [
            "",
            "/* Derivatives: one row for each entry of the result, one column for each entry of the argument. */",
            f"int {name}_jacobian({_parameters(exported, exported.jacobian_results())});",
        ]
    if exported.batch:
        results = [(result, (), dtype) for result, _, dtype in exported.results()]
        lines += [
            "",
            "/* n samples, one row of each array for each; structures are shared. The status has the bits of all samples, and",
            " * the results of samples without a regular solution are NaN. Results may not overlap arguments. */",
            f"int {name}_batch(int64_t n, {_parameters(exported, results, is_batch=True)});",
        ]
    return lines


def _size(shape: Sequence[int]) -> int:
    return int(np.prod(shape, dtype=int))


def _type_of(name: str, argument: Argument) -> str:
    return f"{name}_{argument.name}_t"


def _parameters(exported: Any, results: list, is_batch: bool = False) -> str:
    # Sizes in brackets mean nothing to the compiler of the callee; gcc and clang warn callers of arrays that are too short.
    parameters = []
    for argument in exported.arguments:
        if argument.is_structure:
            parameters.append(f"const {_type_of(exported.name, argument)} *{argument.name}")
            continue
        (leaf,) = argument.leaves
        kind = C_TYPES[leaf.dtype.name]
        parameters.append(
            f"const {kind} *{leaf.name}" if is_batch else f"const {kind} {leaf.name}[{max(1, _size(leaf.shape))}]"
        )
    for result, shape, dtype in results:
        kind = C_TYPES[np.dtype(dtype).name]
        parameters.append(f"{kind} *{result}" if is_batch else f"{kind} {result}[{max(1, _size(shape))}]")
    return ", ".join(parameters)


# --- the test program ---


def _numbers(values: np.ndarray) -> str:
    # Hexadecimal: every bit of a reference result reaches the C compiler.
    return (
        ", ".join(
            float(x).hex() if np.isfinite(x) else ("NAN" if np.isnan(x) else "INFINITY" if x > 0 else "-INFINITY")
            for x in values.ravel()
        )
        or "0"
    )


def test_program(exported: Any) -> str:
    """C program that compares the functions with reference results, and returns non-zero where they differ."""
    name = exported.name
    data, checks = _references(exported)
    is_single = any(dtype == np.float32 for _, _, dtype in exported.results())
    kind = "float" if is_single else "double"
    lines = [
        f"/* Compares {name} with reference results of jaxdyn: prints the largest difference, returns 1 above the tolerance. */",
        "#include <math.h>",
        "#include <stdio.h>",
        "",
        f'#include "{name}.h"',
        "",
        *data,
        "",
        "/* The largest difference, relative to the largest expected number. */",
        f"static double difference(const char *name, const {kind} *got, const double *expected, int size) {{",
        "  double scale = 1e-300, worst = 0;",
        "  for (int i = 0; i < size; i++) scale = isfinite(expected[i]) ? fmax(scale, fabs(expected[i])) : scale;",
        "  for (int i = 0; i < size; i++) {",
        "    int is_same = got[i] == expected[i] || (isnan(got[i]) && isnan(expected[i]));",
        "    double apart = is_same ? 0 : fabs(got[i] - expected[i]) / scale;",
        "    if (!(apart <= worst)) worst = apart;",
        "  }",
        '  printf("%s: largest relative difference %.3g\\n", name, worst);',
        "  return isnan(worst) ? INFINITY : worst;",
        "}",
        "",
        "int main(void) {",
        "  double worst = 0;",
        *checks,
        '  printf("largest relative difference %.3g\\n", worst);',
        f"  return worst > {_TOLERANCE_SINGLE if is_single else TOLERANCE:g};",
        "}",
        "",
    ]
    return "\n".join(lines)


def _references(exported: Any) -> tuple[list[str], list[str]]:
    """Lines with the arguments and the expected results, and lines that call the functions and compare."""
    # The prefixes keep names apart from those of the C library: y0 is a Bessel function of <math.h>.
    name, data, checks = exported.name, [], []
    for argument, example in zip(exported.arguments, exported.examples, strict=True):
        values = jax.tree.leaves(example)
        if argument.is_structure:
            inner = ",\n  ".join(f"{{{_numbers(np.asarray(x))}}}" for x in values)
            data.append(f"static const {_type_of(name, argument)} given_{argument.name} = {{\n  {inner}\n}};")
        else:
            kind = C_TYPES[argument.leaves[0].dtype.name]
            data.append(f"static const {kind} given_{argument.name}[] = {{{_numbers(np.asarray(values[0]))}}};")
    calls = [(name, exported.results(), exported.evaluate())]
    if exported.derivative is not None:
        calls.append((f"{name}_jacobian", exported.jacobian_results(), exported.evaluate("jacobian")))
    given = ", ".join(f"{'&' if x.is_structure else ''}given_{x.name}" for x in exported.arguments)
    for function, results, references in calls:
        for (result, shape, dtype), reference in zip(results, references, strict=True):
            data.append(f"static const double expected_{result}[] = {{{_numbers(reference)}}};")
            data.append(f"static {C_TYPES[np.dtype(dtype).name]} got_{result}[{max(1, _size(shape))}];")
        passed = [given, *("got_" + x for x, _, _ in results)]
        # A value that is not finite has a status; a Jacobian has one where the sample has no regular solution.
        is_failed = function == name and not all(np.isfinite(x).all() for x in references)
        checks.append(f"  if (({function}({', '.join(filter(None, passed))}) != 0) != {int(is_failed)}) {{")
        checks += [f'    printf("{function}: unexpected status\\n");', "    return 1;", "  }"]
        for result, shape, _ in results:
            compared = f'difference("{result}", got_{result}, expected_{result}, {_size(shape)})'
            checks.append(f"  worst = fmax(worst, {compared});")
    return data, checks


def _build(name: str, made: LinkableFile) -> str:
    # An interface library: the object file is all there is to it, and it goes into the program that links it.
    link = f"\ntarget_link_libraries({name} INTERFACE m)" if made.library else ""
    return f"""# target_link_libraries(your_program {name}) links the functions of {name}.h.
cmake_minimum_required(VERSION 3.16)
project({name} C)

add_library({name} INTERFACE)
target_include_directories({name} INTERFACE ${{CMAKE_CURRENT_SOURCE_DIR}})
target_sources({name} INTERFACE ${{CMAKE_CURRENT_SOURCE_DIR}}/{name}.o){link}

add_executable({name}_test {name}_test.c)
target_link_libraries({name}_test {name} m)
enable_testing()
add_test({name}_test {name}_test)
"""


# --- CasADi ---


def _casadi_build(name: str, made: LinkableFile) -> str:
    return f"""# Makes {name}.so for casadi.external("{name}", "./{name}.so"); or: cc -shared -o {name}.so {name}.o -lm
cmake_minimum_required(VERSION 3.16)
project({name} C)

file(WRITE ${{CMAKE_CURRENT_BINARY_DIR}}/empty.c "")
add_library({name} SHARED ${{CMAKE_CURRENT_BINARY_DIR}}/empty.c {name}.o)
set_target_properties({name} PROPERTIES PREFIX "" SUFFIX ".so")
target_link_libraries({name} m)
"""


def _casadi_test(exported: Any) -> str:
    arguments = ", ".join(np.asarray(x).tolist().__repr__() for x in exported.examples)
    expected = ", ".join(x.tolist().__repr__() for x in exported.evaluate())
    return f'''"""Compares {exported.name}.so with reference results of jaxdyn; needs casadi and numpy."""

import casadi
import numpy as np

f = casadi.external("{exported.name}", "./{exported.name}.so")
results = f(*map(casadi.DM, [{arguments}]))
results = results if isinstance(results, (tuple, list)) else [results]
worst = 0.0
for got, expected in zip(results, [{expected}], strict=True):
    expected = np.asarray(expected)
    got = got.full().reshape(expected.shape)
    worst = max(worst, abs(got - expected).max() / max(abs(expected).max(), 1e-300))
print(f"largest relative difference {{worst:.3g}}")
raise SystemExit(worst > {TOLERANCE:g})
'''
