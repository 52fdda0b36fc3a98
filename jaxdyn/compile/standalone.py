"""Scalar programs as functions of C's calling convention, without JAX.

A function becomes one or two scalar programs (`make_routine`), its Jacobian others (`jacobian_routine`), and each routine becomes
`i32 name(ptr in0, ..., ptr out0, ...)` (`routine_ir`): it reads each entry where the caller's array holds it, writes each
result, and returns a status. It allocates nothing, calls nothing but functions of the C library, and has no state.
"""

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import llvmlite.binding as llvm
import numpy as np

from jaxdyn.compile import derive
from jaxdyn.compile.body import Body, symbol_of
from jaxdyn.compile.code import ATTRIBUTES
from jaxdyn.compile.derive import inline, replay
from jaxdyn.compile.directions import Directions
from jaxdyn.compile.graph import Graph
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.mode import careful, remedy_of, standalone
from jaxdyn.compile.program import FLOATS, Array, Constant, Program, TooLong, kind_of, objects
from jaxdyn.compile.stored import features as host_features
from jaxdyn.compile.trace import program_of

# Operations of a directional derivative times the number of directions. A Panda's forward dynamics has 63 000: by columns its
# Jacobian takes 1.0 us and half the time to compile, written out 1.6 us. Planar loops have 5 000 and are mostly zeros.
MAX_WRITTEN_OUT = 40_000
MAX_OPERATIONS = 2_000_000  # LLVM takes some 50 microseconds an operation, so this is two minutes
# Bits of a status: a sample without a regular solution, and a result that is infinite or not a number.
DEGENERATE, NOT_FINITE = 1, 2


# --- programs ---


# What JAX raises where Python decides by a number that is not known: `if x > 0`, `x[x > 0]`, `np.sin(x)`.
_DATA_DEPENDENT = (
    jax.errors.ConcretizationTypeError,
    jax.errors.NonConcreteBooleanIndexError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


class Routine(NamedTuple):
    """A function in machine code: its symbol, its program, and the program for samples that the first one flags.

    The first program decides nothing about rank: constraint rows are taken for independent, and its last output says whether
    they are. The second one, None where no sample is ever flagged, calls pseudo-inverses, which are loops.
    """

    symbol: str
    program: Program | Directions
    careful: Program | Directions | None

    @property
    def programs(self) -> tuple[Program | Directions, ...]:
        """One or two programs."""
        return (self.program,) if self.careful is None else (self.program, self.careful)


def make_routine(function: Callable, examples: Sequence[Any], symbol: str) -> tuple[Routine, Any]:
    """Routine of function(*examples), and the structure of its results.

    **Raises:** ValueError where the function is no scalar program.
    """
    with standalone():
        program, structure = _scalar_program(function, examples, symbol)
    # The flag is known where the function decides nothing about rank.
    if type(program.results[-1][0]) is Constant:
        return Routine(symbol, program, None), structure
    try:
        with standalone(), careful():
            again = _scalar_program(function, examples, symbol)[0]
    except ValueError:  # such as a new choice of rows: the status tells of these samples
        again = None
    return Routine(symbol, program, again), structure


def _scalar_program(function: Callable, examples: Sequence[Any], name: str) -> tuple[Program, Any]:
    def call(_, *args):
        return function(*args)

    call.__qualname__ = name
    try:
        # Validity is reported always: the exported function has a status, whether samples can be invalid or not.
        _, made = program_of(call, (), (), tuple(examples), maximum=MAX_OPERATIONS, flags="report_always")
    except _DATA_DEPENDENT as error:
        made = f"shapes, branches or conversions to numpy that depend on data ({str(error).splitlines()[0]})"
    if isinstance(made, str):
        raise ValueError(
            f"function cannot be exported: it has {made}; {remedy_of(made)}. Only functions without callbacks and "
            "data-dependent loops can be exported"
        )
    program, structure = inline(made[0]), made[1]
    # Here the flag is a result like others, which derivatives do not repeat.
    program.reports_validity = False
    return program, structure


def jacobian_routine(routine: Routine, symbol: str) -> Routine:
    """Routine of the derivatives of all float results by all float arguments; see `jacobian_program`.

    **Raises:** ValueError for more operations than the compiler takes.
    """
    try:
        with standalone():
            program = jacobian_program(routine.program, symbol)
        if routine.careful is None:
            return Routine(symbol, program, None)
        with standalone(), careful():
            return Routine(symbol, program, jacobian_program(routine.careful, symbol))
    except TooLong as error:
        count = sum(array.size for array in routine.program.inputs if array.dtype.kind == "f")
        raise ValueError(
            f"derivatives: the Jacobian by all {count} numbers of the arguments has {error}; let the function close over those "
            "that it need not be differentiated by, such as a model"
        ) from None


def jacobian_program(program: Program | Directions, name: str) -> Program | Directions:
    """The derivatives of all float outputs of a program by all float inputs.

    The outputs are an array (size of the output, size of the input) for each float output and each float input, followed by the
    flag of `program`. Entries that no number of the program can make other than zero are constants.
    """
    assert isinstance(program, Program)
    moving = tuple(array.dtype.kind == "f" for array in program.inputs)
    change = inline(derive.tangent(program, moving))
    columns = sum(array.size for array, moves in zip(program.inputs, moving, strict=True) if moves)
    # Of loops each column is a call.
    if change.cost * columns > MAX_WRITTEN_OUT and not change.subprograms:
        return Directions(program, change)
    graph = Graph(MAX_OPERATIONS)
    primal = [graph.inputs(place, array) for place, array in enumerate(program.inputs)]
    varied = [array for array, moves in zip(program.inputs, moving, strict=True) if moves]
    outputs = [array for array in program.outputs if array.dtype.kind == "f"]
    blocks = [[np.empty((y.size, x.size), object) for x in varied] for y in outputs]
    for place, array in enumerate(varied):
        for entry in range(array.size):
            # Steps are known zeros and a one, so that the graph folds what this column does not need and shares all values.
            steps = [objects([0.0] * x.size, x.shape) for x in varied]
            steps[place].reshape(-1)[entry] = 1.0
            columns = replay(graph, change, [*primal, *steps])[1]
            for row, column in zip(blocks, columns, strict=True):
                row[place][:, entry] = column.ravel()
    flag = replay(graph, program, primal)[1][-1]
    arrays = [Array(block.shape, y.dtype) for y, row in zip(outputs, blocks, strict=True) for block in row]
    entries = [block for row in blocks for block in row]
    return graph.finish(program.inputs, [*arrays, program.outputs[-1]], [*entries, flag], name=name)


# --- text ---


class Text(NamedTuple):
    """A function in LLVM's intermediate representation, and what it needs once in a module, by name."""

    function: str
    declared: dict[str, str]


class Field(NamedTuple):
    """Place of an array of a program: the pointer among a function's arguments, and the offset in bytes from it."""

    argument: int
    offset: int


def routine_ir(
    routine: Routine,
    inputs: Sequence[Field],
    *,
    lanes: int = 1,
    places: Mapping[int, np.ndarray] | None = None,
    results: Sequence[np.ndarray] | None = None,
    internal: bool = False,
) -> list[Text]:
    """Text of `i32 symbol(ptr a0, ..., ptr r0, ...)`, which returns 0 or bits of `DEGENERATE` and `NOT_FINITE`.

    **Arguments:** `inputs`: for each input of the program its place in the caller's memory. `places`, `results`: for each entry
    of an input and of an output, by rows, its index in the caller's memory (default: by rows); -1 for a result that is not
    stored; `Directions` store by rows alone. `internal`: whether the function is visible in its module only. `lanes`: float64
    numbers in a vector register.
    """
    layout: dict[str, Any] = {"places": places, "results": results, "lanes": lanes}
    careful = f"{routine.symbol}_careful"
    if routine.careful is None:
        return [_function_ir(routine.symbol, routine.program, inputs, internal, None, **layout)]
    return [
        _function_ir(routine.symbol, routine.program, inputs, internal, careful, **layout),
        _function_ir(careful, routine.careful, inputs, True, None, **layout),
    ]


def _function_ir(
    name: str,
    program: Program | Directions,
    inputs: Sequence[Field],
    internal: bool,
    careful: str | None,
    *,
    lanes: int,
    places: Mapping[int, np.ndarray] | None,
    results: Sequence[np.ndarray] | None,
) -> Text:
    e = Emitter(1)

    def load(place, entry, kind):
        field = inputs[place]
        base = f"%a{field.argument}"
        if field.offset:
            base = e.emit(f"getelementptr i8, ptr {base}, i64 {field.offset}")
        return e.load_one(base, entry if places is None else int(places[place][entry]), kind)

    count = 1 + max((field.argument for field in inputs), default=-1)
    pointers = [f"ptr %a{i}" for i in range(count)] + [f"ptr %r{i}" for i in range(len(program.outputs) - 1)]

    def leave(flag: str) -> list[str]:
        # Before anything is stored: a result may be written over an argument that the careful program still reads.
        if careful is None:
            return []
        return [
            f"  br i1 {flag}, label %regular, label %careful",
            "careful:",
            f"  %repaired = call i32 @{careful}({', '.join(pointers)})",
            "  ret i32 %repaired",
            "regular:",
        ]

    if isinstance(program, Directions):
        assert results is None
        allocated, regular = program.lines(e, name, lanes, load, leave)
        finite = "true"  # the value says so, and tests of all entries would cost as much as some columns
    else:
        body = Body(e, program, load, lambda place: None)
        *values, (regular,) = body.results()
        allocated = body.allocations()
        e.lines += leave(regular)
        finite = all_finite(e, values, program.outputs)
        for i, (row, array) in enumerate(zip(values, program.outputs, strict=False)):
            for k, value in enumerate(row):
                where = k if results is None else int(results[i][k])
                if where >= 0:
                    e.store_one(f"%r{i}", where, kind_of(array.dtype), value)
    e.lines.append(f"  %code = select i1 {finite}, i32 0, i32 {NOT_FINITE}")
    e.lines.append(f"  %status = select i1 {regular}, i32 %code, i32 {DEGENERATE}")
    linkage = "internal " if internal else ""
    head = f"define {linkage}i32 @{name}({', '.join(pointers)}) #0 {{"
    text = "\n".join([head, *allocated, *e.lines, "  ret i32 %status", "}"])
    for called in program.subprograms:
        if (symbol := symbol_of(called, 1)) in e.declared:  # else no result needs it
            e.declared |= called.definition(symbol)  # pyright: ignore[reportAttributeAccessIssue]
    return Text(text, e.declared)


def all_finite(e: Emitter, rows: Sequence[Sequence[str]], arrays: Sequence[Array]) -> str:
    """Name of a flag: whether all float results of a sample are finite."""
    flags = []
    for kind in FLOATS:
        of, zero = e.type(kind), e.constant(0.0, kind)
        names = [x for row, array in zip(rows, arrays, strict=False) if kind_of(array.dtype) == kind for x in row]
        # x 0 is 0, or not a number where x is not finite. A tree of sums: a chain would wait for each sum.
        terms = [e.emit(f"fmul {of} {x}, {zero}") for x in names]
        while len(terms) > 1:
            pairs = [e.emit(f"fadd {of} {a}, {b}") for a, b in zip(terms[::2], terms[1::2], strict=False)]
            terms = [*pairs, *terms[len(terms) - len(terms) % 2 :]]
        flags += [e.emit(f"fcmp ord {of} {x}, {zero}") for x in terms]
    total = e.constant(True, "b1")
    for flag in flags:
        total = e.emit(f"and {e.type('b1')} {total}, {flag}")
    return total


def array_call_ir(name: str, arguments: int, program: Program | Directions) -> Text:
    """The text of `i32 name_packed(ptr block)`, which takes the pointers of `name` from an array (ctypes is slow by argument)."""
    lines, given = [], []
    for i in range(arguments + len(program.outputs) - 1):
        lines += [f"  %at{i} = getelementptr ptr, ptr %block, i64 {i}", f"  %x{i} = load ptr, ptr %at{i}"]
        given.append(f"ptr %x{i}")
    call = f"  %status = call i32 @{name}({', '.join(given)})"
    return Text("\n".join([f"define i32 @{name}_packed(ptr %block) #0 {{", *lines, call, "  ret i32 %status", "}"]), {})


def module_ir(*functions: Text) -> str:
    """A module of functions; what several of them need is declared once."""
    declared = {name: line for text in functions for name, line in text.declared.items()}
    return "\n".join([*(text.function for text in functions), *declared.values(), *ATTRIBUTES])


# --- relocatable object files for any target of LLVM, with what a linker and a stack need to know of them ---


class Triple(NamedTuple):
    """A target of LLVM."""

    triple: str
    cpu: str
    features: str
    lanes: int  # float64 numbers in a vector register, 1 where there is none


HOST = "host"
_X86 = "x86_64-unknown-linux-gnu"
TARGETS = {
    "x86_64": Triple(_X86, "x86-64", "", 2),
    "x86_64-v3": Triple(_X86, "x86-64-v3", "", 4),
    "x86_64-v4": Triple(_X86, "x86-64-v4", "", 8),
    "aarch64": Triple("aarch64-unknown-linux-gnu", "generic", "", 2),
    "cortex-m7": Triple("thumbv7em-none-eabihf", "cortex-m7", "", 1),
    "riscv64": Triple("riscv64-unknown-linux-gnu", "generic-rv64", "+m,+a,+f,+d,+c", 1),
    "wasm32": Triple("wasm32-unknown-unknown", "generic", "", 1),
}


def resolve_target(name: str, cpu: str | None = None, features: str | None = None) -> Triple:
    """The target of a short name of `TARGETS`, of "host", or of an LLVM triple. **Raises:** ValueError for what LLVM lacks."""
    _initialize()
    if name == HOST:
        known = llvm.get_host_cpu_features()
        lanes = 8 if known.get("avx512f") else 4 if known.get("avx") else 2
        target = Triple(llvm.get_process_triple(), llvm.get_host_cpu_name(), host_features(), lanes)
    else:
        target = TARGETS.get(name, Triple(name, "", "", 1))
    target = target._replace(
        cpu=target.cpu if cpu is None else cpu, features=target.features if features is None else features
    )
    try:
        llvm.Target.from_triple(target.triple)
    except RuntimeError as error:
        known_names = ", ".join(map(repr, (HOST, *TARGETS)))
        raise ValueError(
            f"target is {name!r}, which LLVM {'.'.join(map(str, llvm.llvm_version_info))} does not have ({error}); take one of "
            f"{known_names}, or a triple that this LLVM was built with"
        ) from None
    return target


@functools.cache
def _initialize() -> None:
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()


class LinkableFile(NamedTuple):
    """A relocatable object file, the functions of the C library that it calls, and the bytes of stack of each function."""

    binary: bytes
    library: tuple[str, ...]
    stack: dict[str, int]


def object_file(text: str, target: Triple) -> LinkableFile:
    """Compile a module for a target."""
    _initialize()
    machine = llvm.Target.from_triple(target.triple).create_target_machine(
        cpu=target.cpu, features=target.features, opt=2, reloc="pic", codemodel="small"
    )
    if target.triple.startswith(("arm", "thumb")):
        text = _without_maximum(text)
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = target.triple, str(machine.target_data)
    options = llvm.create_pipeline_tuning_options(speed_level=1)
    options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = False
    llvm.create_pass_builder(machine, options).getModulePassManager().run(
        module, llvm.create_pass_builder(machine, options)
    )
    called = sorted({x.name for x in module.functions if x.is_declaration and not x.name.startswith("llvm.")})
    assembly = machine.emit_assembly(module)
    return LinkableFile(machine.emit_object(module), tuple(called), stack_bytes(assembly))


def _without_maximum(text: str) -> str:
    """The module with LLVM's maximum and minimum as comparisons: LLVM 22 aborts where it expands them for 32-bit ARM."""
    for name, word in (("maximum", "ogt"), ("minimum", "olt")):
        for suffix, of in (("f64", "double"), ("f32", "float")):
            intrinsic, own = f"@llvm.{name}.{suffix}(", f"@{name}_{suffix}("
            definition = f"""define internal {of} {own}{of} %a, {of} %b) alwaysinline {{
  %is_first = fcmp {word} {of} %a, %b
  %larger = select i1 %is_first, {of} %a, {of} %b
  %is_number = fcmp ord {of} %a, %b
  %sum = fadd {of} %a, %b
  %result = select i1 %is_number, {of} %larger, {of} %sum
  ret {of} %result
}}"""
            text = text.replace(f"declare {of} {intrinsic}{of}, {of})", definition).replace(intrinsic, own)
    return text


# The instruction by which a function takes its frame, on each family of processors.
_FRAMES = (
    r"subq\s+\$(\d+), %rsp",
    r"sub\w*\s+sp, (?:sp, )?#(\d+)(?:, lsl #(\d+))?",
    r"addi\s+sp, sp, -(\d+)",
    r"i32\.const\s+(\d+)\n\s+i32\.sub\s*\n\s+(?:local\.tee\s+\d+\n\s+)?global\.set\s+__stack_pointer",
)
_CALLS = r"\b(?:callq?|blx?|jmp|b|tail)\s+([A-Za-z_]\w*)"  # calls, and jumps to a function at the end of another one
_SAVED = (
    256  # bytes, more than all registers that a function saves before it takes its frame take on any of the targets
)


def stack_bytes(assembly: str) -> dict[str, int]:
    """Bytes of stack that each function of an assembly takes, with the registers that it saves and the functions it calls."""
    sizes: dict[str, int] = {}
    bodies: dict[str, str] = {}
    parts = re.split(r"^([A-Za-z_]\w*):", assembly, flags=re.MULTILINE)
    for name, body in zip(parts[1::2], parts[2::2], strict=True):
        taken = 0
        for pattern in _FRAMES:
            for match in re.finditer(pattern, body):
                shift = match.group(2) if match.re.groups > 1 else None
                taken += int(match.group(1)) << int(shift or 0)
        sizes[name], bodies[name] = taken + _SAVED, body

    @functools.cache
    def total(name: str) -> int:
        # Nothing here is recursive. A frame ends before a jump to another function, but the sum is an upper bound then too.
        called = set(re.findall(_CALLS, bodies[name])) & (sizes.keys() - {name})
        return sizes[name] + max(map(total, called), default=0)

    return {name: total(name) for name in sizes}
