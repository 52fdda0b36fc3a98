"""Interfaces of an exported function: its arguments in C, with names and places in memory; batches of samples; CasADi's.

CasADi stores matrices by columns, and of sparse ones only the entries of a pattern. The pattern of a Jacobian leaves out
structural zeros: entries that are zero for every input. A null pointer stands for an argument that is zero, or for a result that
CasADi does not need. With these functions `casadi.external` has exact first derivatives.

Source: CasADi's user guide, "Using the generated code", and the signatures that its code generator writes.
"""

import inspect
import keyword
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxdyn.compile import standalone
from jaxdyn.compile.body import Body
from jaxdyn.compile.directions import Directions
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import Array, Constant, kind_of
from jaxdyn.compile.standalone import DEGENERATE, NOT_FINITE, Field, Routine, Text, all_finite
from jaxdyn.model.tree import Model

C_TYPES = {"float64": "double", "float32": "float"}
# Of C11 and C++20 together: the header is read by both.
C_KEYWORDS = frozenset(
    "alignas alignof and asm auto bool break case catch char class const constexpr continue decltype default delete do double "
    "else enum explicit export extern false float for friend goto if inline int long mutable namespace new not nullptr operator "
    "or private protected public register restrict return short signed sizeof static struct switch template this throw true try "
    "typedef typeid typename union unsigned using virtual void volatile wchar_t while xor".split()
)


class Leaf(NamedTuple):
    """An array of an argument: its name, its shape and dtype, and its offset in bytes within a structure."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    offset: int


class Argument(NamedTuple):
    """An argument of the C function: an array, or a structure of arrays."""

    name: str
    leaves: tuple[Leaf, ...]
    is_structure: bool
    bytes: int


def check_identifier(name: str, what: str) -> str:
    """Return the name. **Raises:** ValueError unless it is an identifier of C and C++ and no keyword of theirs."""
    # Only ASCII: compilers accept other letters, linkers of microcontrollers often do not.
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) or name in C_KEYWORDS:
        raise ValueError(
            f"{what} is {name!r}, which is no identifier of C and C++; use letters, digits and underscores, and no keyword, "
            "as in 'arm_fd'"
        )
    return name


def _identifier(text: str) -> str:
    # Paths of pytrees are "['gain'][0]" or ".inertias": what separates their parts becomes underscores.
    name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_") or "value"
    # A field of a tuple is "[0]", and no identifier begins with a digit.
    name = f"x{name}" if name[0].isdigit() else name
    return f"{name}_" if name in C_KEYWORDS or keyword.iskeyword(name) else name


def arguments_of(function: Callable, examples: Sequence[Any]) -> tuple[Argument, ...]:
    """Arguments of the C function, named as those of the Python function.

    **Raises:** ValueError for examples that are no arrays of float64 or float32.
    """
    count = len(examples)
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # functions of other languages have no signature
        parameters = []
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    names = [_identifier(x.name) for x in parameters if x.kind in kinds][:count]
    names += [f"x{i}" for i in range(len(names), count)]
    # Macros of sizes are upper case, so names may not differ by case alone.
    names = names if len({x.upper() for x in names}) == count else [f"x{i}" for i in range(count)]
    return tuple(_argument(name, example) for name, example in zip(names, examples, strict=True))


def _argument(name: str, example: Any) -> Argument:
    paths = jax.tree_util.tree_flatten_with_path(example)[0]
    # An array is a pytree whose only leaf has an empty path. A list of one array is a structure with one field.
    is_structure = not (len(paths) == 1 and not paths[0][0])
    leaves, used, offset, widest = [], set(), 0, 1
    for path, value in paths:
        dtype = np.dtype(getattr(value, "dtype", type(value)))
        if dtype.name not in C_TYPES:
            raise ValueError(
                f"examples: {name}{jax.tree_util.keystr(path)} has dtype {dtype}; exported functions take float64 and float32, "
                "so close over integers, or make them floats"
            )
        shape = np.shape(value)
        field = _identifier(jax.tree_util.keystr(path)) if is_structure else name
        while field in used:  # a["b"] and a.b may become the same identifier
            field += "_"
        used.add(field)
        size = dtype.itemsize
        # The rules by which C compilers place members: each at a multiple of its size, the whole a multiple of the widest one.
        offset, widest = -(-offset // size) * size, max(widest, size)
        leaves.append(Leaf(field, shape, dtype, offset))
        offset += size * int(np.prod(shape, dtype=int))
    return Argument(name, tuple(leaves), is_structure, -(-offset // widest) * widest)


def fields_of(arguments: Sequence[Argument]) -> list[Field]:
    """Argument and offset of each array, in the order of the program's inputs."""
    return [Field(i, leaf.offset) for i, argument in enumerate(arguments) for leaf in argument.leaves]


def system_of(function: Callable, examples: Sequence[Any]) -> Model | None:
    """A model that the function is given or closes over, for the names of joints in comments."""
    candidates = list(examples)
    # The names of joints are nowhere in the program, only in the model; a function that hides its model gets no comments.
    try:
        closure = inspect.getclosurevars(inspect.unwrap(getattr(function, "func", function)))
        candidates += [*closure.nonlocals.values(), *closure.globals.values()]
    except TypeError:  # a callable object
        pass
    candidates += list(getattr(function, "args", ()))  # of functools.partial
    for value in candidates:
        system = getattr(value, "system", value)
        if isinstance(system, Model):
            return system
    return None


def batch_ir(exported: Any, width: int) -> Text:
    """Text of `i32 name_batch(i64 n, ptr a0, ..., ptr r0, ...)` over the samples 0 .. n - 1.

    Arrays have one row for each sample; a structure is the same for all. The status has the bits of all samples. Results of
    samples without a regular solution are NaN.
    """
    program = exported.value.program
    # Pseudo-inverses take another number of sweeps for each sample, so these are computed one at a time.
    e = Emitter(1 if program.subprograms else width)
    arguments, outputs = exported.arguments, program.outputs[:-1]
    # Results follow the arguments in the numbering of pointers.
    sizes = {i: x.bytes for i, x in enumerate(arguments) if not x.is_structure}
    sizes |= {len(arguments) + i: x.size * x.dtype.itemsize for i, x in enumerate(outputs)}
    # Where fewer samples remain than lanes, the others repeat the last sample: no code for a remainder, and no reading
    # beyond the arrays. It is computed several times and stored as often.
    rows = e.rows(list(sizes), list(sizes.values()))
    if program.subprograms:
        status = _single_calls(e, exported, rows)
        e.lines += ["  br label %following"]
        incoming = [(status, "%block")]
    else:
        incoming = _vector_block(e, exported, rows)
    pointers = [f"ptr %a{i}" for i in range(len(arguments) + len(outputs))]
    text = "\n".join(
        [
            f"define i32 @{exported.name}_batch(i64 %n, {', '.join(pointers)}) #0 {{",
            "entry:",
            "  %last = sub i64 %n, 1",
            "  %some = icmp sgt i64 %n, 0",
            "  br i1 %some, label %block, label %none",
            "block:",
            "  %base = phi i64 [ 0, %entry ], [ %next, %following ]",
            "  %worst = phi i32 [ 0, %entry ], [ %after, %following ]",
            *e.lines,
            "following:",
            f"  %status = phi i32 {', '.join(f'[ {value}, {label} ]' for value, label in incoming)}",
            "  %after = or i32 %worst, %status",
            f"  %next = add i64 %base, {e.width}",
            "  %more = icmp slt i64 %next, %n",
            "  br i1 %more, label %block, label %done",
            "none:",
            "  ret i32 0",
            "done:",
            "  ret i32 %after",
            "}",
        ]
    )
    return Text(text, e.declared)


def _vector_block(e: Emitter, exported: Any, rows: dict[int, list[str]]) -> list[tuple[str, str]]:
    """Compute W samples at once, and again one at a time where the program flags one; returns statuses and their blocks."""
    routine, fields, width = exported.value, fields_of(exported.arguments), e.width

    def load(place, entry, kind):
        field = fields[place]
        if not exported.arguments[field.argument].is_structure:
            return e.load(rows[field.argument], entry, kind)
        # One load and a copy to all lanes.
        value = Emitter(1)
        # Registers have numbers: each emitter counts on from the other, or a name would be defined twice.
        value.count = e.count
        at = value.emit(f"getelementptr i8, ptr %a{field.argument}, i64 {field.offset}")
        name = value.load_one(at, entry, kind)
        e.lines += value.lines
        e.count = value.count
        return name if width == 1 else e.splat(name, kind)

    *results, (flag,) = Body(e, routine.program, load, lambda place: None).results()
    regular = _all_lanes(e, flag)
    incoming = []
    if routine.careful is not None:
        e.lines += [f"  br i1 {regular}, label %regular, label %careful", "careful:"]
        # Rare, so that the other samples of the block are simply computed again.
        incoming.append((_single_calls(e, exported, rows), "%careful"))
        e.lines += ["  br label %following", "regular:"]
    for i, (row, array) in enumerate(zip(results, routine.program.outputs, strict=False)):
        e.store_array(rows[len(exported.arguments) + i], kind_of(array.dtype), row)
    finite = _all_lanes(e, all_finite(e, results, routine.program.outputs))
    code = e.emit(f"select i1 {finite}, i32 0, i32 {NOT_FINITE}")
    code = e.emit(f"select i1 {regular}, i32 {code}, i32 {DEGENERATE}")
    # A label of its own: sines of large angles have branches, so that these lines may not be in %block any more.
    e.lines += ["  br label %stored", "stored:", "  br label %following"]
    return [*incoming, (code, "%stored")]


def _all_lanes(e: Emitter, flag: str) -> str:
    """Flag that is set where that of every sample is."""
    if e.width == 1:
        return flag
    name = f"llvm.vector.reduce.and.v{e.width}i1"
    e.declared[name] = f"declare i1 @{name}({e.type('b1')})"
    return e.emit(f"call i1 @{name}({e.type('b1')} {flag})")


def _single_calls(e: Emitter, exported: Any, rows: dict[int, list[str]]) -> str:
    """Call the function of one sample for each of the W samples; returns the bits of all statuses."""
    count = len(exported.arguments) + len(exported.value.program.outputs) - 1
    total = "0"
    for k in range(e.width):
        pointers = [f"ptr {rows[i][k]}" if i in rows else f"ptr %a{i}" for i in range(count)]
        status = e.emit(f"call i32 @{exported.name}({', '.join(pointers)})")
        # Bits are collected, so that one status reports every kind of failure among the samples.
        total = e.emit(f"or i32 {total}, {status}")
    return total


# --- CasADi's interface for external functions ---


class Pattern(NamedTuple):
    """Sparsity pattern of a matrix of CasADi, and the place of each entry of the program's array in it."""

    stored: np.ndarray  # (rows, columns) of bools
    places: np.ndarray  # for each entry, by rows, its place among the stored ones by columns; -1 where it is not stored

    @property
    def count(self) -> int:
        """Number of stored entries."""
        return int(self.stored.sum())

    def description(self) -> list[int]:
        """Rows, columns, the start of each column, and the rows of the stored entries: CasADi's compressed columns."""
        starts = np.concatenate([[0], np.cumsum(self.stored.sum(axis=0))])
        return [*self.stored.shape, *starts.tolist(), *np.nonzero(self.stored.T)[1].tolist()]


def _by_columns(stored: np.ndarray) -> np.ndarray:
    """Number of stored entries before each entry of a matrix, by columns; -1 for entries that are not stored."""
    places = np.full(stored.T.shape, -1)
    places[stored.T] = np.arange(stored.sum())
    return places.T


def _dense(array: Array) -> Pattern:
    """Pattern of an array: a vector is a column, and leading axes of more than two become rows."""
    columns = array.shape[-1] if len(array.shape) > 1 else 1
    # An axis may have length zero; `max` avoids a division by it.
    stored = np.ones((array.size // max(columns, 1), columns), bool)
    return Pattern(stored, _by_columns(stored).ravel())


def _block(is_stored: np.ndarray, result: Pattern, argument: Pattern) -> Pattern:
    """Pattern of a Jacobian: rows and columns are the entries of a result and of an argument, each by columns as in CasADi."""
    where = np.ix_(result.places, argument.places)
    stored = np.zeros(is_stored.shape, bool)
    stored[where] = is_stored
    return Pattern(stored, _by_columns(stored)[where].ravel())


def casadi_ir(exported: Any, lanes: int) -> str:
    """Text of `name`, and of `jac_name` where the Jacobian was exported, with the functions that describe them to CasADi."""
    # CasADi finds the Jacobian of `name` by the name of its function, `jac_name`, and asks it for all blocks at once.
    program, jacobian = exported.value.program, exported.derivative
    inputs, outputs = list(map(_dense, program.inputs)), list(map(_dense, program.outputs[:-1]))
    functions = _functions(exported.name, exported.value, exported, inputs, outputs, [], lanes)
    if jacobian is not None:
        patterns, count = [], len(inputs)
        for i, array in enumerate(jacobian.program.outputs[:-1]):
            rows = [x.results[i] for x in jacobian.programs]
            # An entry is left out where it is zero for regular and for singular samples.
            is_stored = [
                any(type(x) is not Constant or x.value != 0 for x in entries) for entries in zip(*rows, strict=True)
            ]
            patterns.append(_block(np.reshape(is_stored, array.shape), outputs[i // count], inputs[i % count]))
        functions += _functions(f"jac_{exported.name}", jacobian, exported, inputs, patterns, outputs, lanes)
    return standalone.module_ir(*functions)


def _functions(
    name: str,
    routine: Routine,
    exported: Any,
    inputs: Sequence[Pattern],
    outputs: Sequence[Pattern],
    nominal: Sequence[Pattern],
    lanes: int,
) -> list[Text]:
    """One function of CasADi's interface; `nominal` are the results, which CasADi passes to a Jacobian after the arguments."""
    core = f"{name}_core"
    places = {i: pattern.places for i, pattern in enumerate(inputs)}
    # A Jacobian by columns stores whole rows of vector registers, so it is stored dense in the work vector and copied from there.
    is_dense = any(isinstance(x, Directions) for x in routine.programs)
    results = None if is_dense else [pattern.places for pattern in outputs]
    fields, routine = fields_of(exported.arguments), routine._replace(symbol=core)
    texts = standalone.routine_ir(routine, fields, lanes=lanes, places=places, results=results, internal=True)
    sizes = [x.stored.size for x in outputs]
    # Results whose pointer is null are written to the work vector.
    work = sum(sizes) if is_dense else max([0, *(x.count for x in outputs)])
    # The results at the point are arguments of a Jacobian, which does not read them.
    lines = _descriptions(name, [*inputs, *nominal], outputs, work)
    lines.append(f"define i32 @{name}(ptr %args, ptr %results, ptr %iw, ptr %w, i32 %mem) #0 {{")
    lines += _pointers("a", "%args", len(inputs), f"@{name}_zero") + _pointers("r", "%results", len(outputs), "%w")
    passed, declared = [f"ptr %a{i}" for i in range(len(inputs))], {}
    for i in range(len(outputs)):
        lines.append(f"  %d{i} = getelementptr double, ptr %w, i64 {sum(sizes[:i])}")
        passed.append(f"ptr %d{i}" if is_dense else f"ptr %r{i}")
    lines.append(f"  %status = call i32 @{core}({', '.join(passed)})")
    if is_dense:
        declared["copy_entries"] = _COPY_ENTRIES
        for i, pattern in enumerate(outputs):
            table = f"@{name}_entries{i}"
            # Entries that are not stored have the place -1 and come first: they are cut off.
            order = np.argsort(pattern.places, kind="stable")[pattern.places.size - pattern.count :]
            entries = ", ".join(f"i64 {x}" for x in order)
            declared[table] = f"{table} = internal constant [{pattern.count} x i64] [{entries}]"
            lines.append(f"  %n{i} = select i1 %is_null_r{i}, i64 0, i64 {pattern.count}")
            lines.append(f"  call void @copy_entries(i64 %n{i}, ptr {table}, ptr %d{i}, ptr %r{i})")
    lines += ["  ret i32 %status", "}"]
    return [*texts, Text("\n".join(lines), declared)]


def _descriptions(name: str, inputs: Sequence[Pattern], outputs: Sequence[Pattern], work: int) -> list[str]:
    """Lines of the functions by which CasADi asks for numbers of arguments, patterns and sizes of the work vectors."""
    # One array of zeros stands for every argument that is null: it is as long as the longest, and never empty.
    lines = [f"@{name}_zero = internal constant [{max([1, *(x.count for x in inputs)])} x double] zeroinitializer"]
    for kind, patterns in (("in", inputs), ("out", outputs)):
        for i, pattern in enumerate(patterns):
            numbers = pattern.description()
            entries = ", ".join(f"i64 {x}" for x in numbers)
            lines.append(f"@{name}_{kind}{i} = internal constant [{len(numbers)} x i64] [{entries}]")
        lines += [f"define i64 @{name}_n_{kind}() #0 {{", f"  ret i64 {len(patterns)}", "}"]
        cases = " ".join(f"i64 {i}, label %case{i}" for i in range(len(patterns)))
        lines += [f"define ptr @{name}_sparsity_{kind}(i64 %i) #0 {{", f"  switch i64 %i, label %other [ {cases} ]"]
        for i in range(len(patterns)):
            lines += [f"case{i}:", f"  ret ptr @{name}_{kind}{i}"]
        lines += ["other:", "  ret ptr null", "}"]
    lines.append(f"define i32 @{name}_work(ptr %args, ptr %results, ptr %iw, ptr %w) #0 {{")
    for pointer, size in (("%args", len(inputs)), ("%results", len(outputs)), ("%iw", 0), ("%w", work)):
        lines.append(f"  store i64 {size}, ptr {pointer}")
    return [*lines, "  ret i32 0", "}"]


def _pointers(letter: str, array: str, count: int, default: str) -> list[str]:
    """Lines that load the pointers %a0, %a1, ... of an array, with a default for null pointers."""
    lines = []
    for i in (f"{letter}{k}" for k in range(count)):
        lines += [
            f"  %at_{i} = getelementptr ptr, ptr {array}, i64 {i[1:]}",
            f"  %given_{i} = load ptr, ptr %at_{i}",
            f"  %is_null_{i} = icmp eq ptr %given_{i}, null",
            f"  %{i} = select i1 %is_null_{i}, ptr {default}, ptr %given_{i}",
        ]
    return lines


# Copies dense[entries[k]] to stored[k] for k = 0 .. n - 1.
_COPY_ENTRIES = """define internal void @copy_entries(i64 %n, ptr %entries, ptr %dense, ptr %stored) #0 {
entry:
  %some = icmp sgt i64 %n, 0
  br i1 %some, label %one, label %done
one:
  %k = phi i64 [ 0, %entry ], [ %next, %one ]
  %at = getelementptr i64, ptr %entries, i64 %k
  %place = load i64, ptr %at
  %from = getelementptr double, ptr %dense, i64 %place
  %x = load double, ptr %from
  %to = getelementptr double, ptr %stored, i64 %k
  store double %x, ptr %to
  %next = add i64 %k, 1
  %more = icmp slt i64 %next, %n
  br i1 %more, label %one, label %done
done:
  ret void
}"""
