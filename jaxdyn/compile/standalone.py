"""Programs as functions of C's calling convention, without JAX: their text, and object files for any target of LLVM.

A function becomes a program of single numbers (`scalar_program`), its Jacobian another one (`jacobian_program`), and each
becomes `i32 name(ptr in0, ..., ptr out0, ...)` (`function_ir`): it reads each entry where the caller's array holds it, writes
each result, and returns a status. It allocates nothing, calls nothing but functions of the C library, and has no state.
"""

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np

from jaxdyn.compile import derive
from jaxdyn.compile.code import ATTRIBUTES, Body
from jaxdyn.compile.graph import Graph, inline
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.number import objects
from jaxdyn.compile.objects import features as host_features
from jaxdyn.compile.program import Array, Program, kind_of
from jaxdyn.compile.trace import program_of

MAX_OPERATIONS = 2_000_000  # LLVM takes some 50 microseconds an operation, so this is two minutes
DEGENERATE = 1  # status of a sample that needs a decision about rank, which straight-line code cannot take


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


# --- programs ---


def scalar_program(function: Callable, examples: Sequence[Any], name: str) -> tuple[Program, Any]:
    """The program of function(*examples) and the structure of its results.

    The last output of the program says whether the sample is valid for straight-line code; it is a constant where it always can.

    **Raises:** ValueError where the function is no program of single numbers.
    """

    def call(_, *args):
        return function(*args)

    call.__qualname__ = name
    # Validity is reported always: the exported function has a status, whether samples can be invalid or not.
    _, made = program_of(call, (), (), tuple(examples), most=MAX_OPERATIONS, flags="report_always")
    if isinstance(made, str):
        raise ValueError(
            f"function cannot be exported: it has {made}; only functions without callbacks and data-dependent loops can"
        )
    program, structure = made
    return inline(program), structure


def jacobian_program(program: Program, name: str) -> Program:
    """The derivatives of all float outputs of a program by all float inputs.

    The outputs are an array (size of the output, size of the input) for each float output and each float input, followed by the
    flag of `program`. Entries that no number of the program can make other than zero are constants.
    """
    moving = tuple(array.dtype.kind == "f" for array in program.inputs)
    change = inline(derive.tangent(program, moving))
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
            columns = graph.replay(change, [*primal, *steps])[1]
            for row, column in zip(blocks, columns, strict=True):
                row[place][:, entry] = column.ravel()
    # Replayed into the same graph: values that the derivatives need too are there already.
    flag = graph.replay(program, primal)[1][-1]
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


def function_ir(
    name: str,
    program: Program,
    inputs: Sequence[Field],
    *,
    places: Mapping[int, np.ndarray] | None = None,
    results: Sequence[np.ndarray] | None = None,
    internal: bool = False,
) -> Text:
    """The text of `i32 name(ptr a0, ..., ptr r0, ...)`: status 0, or `DEGENERATE` where the flag of the program is not set.

    **Arguments:** `inputs`: for each input of the program the place where it stands. `places`, `results`: for each entry of an
    input and of an output, by rows, its index in the caller's memory (default: by rows); -1 for a result that is not stored.
    `internal`: whether the function is seen in its module alone.
    """
    e = Emitter(1)

    def load(place, entry, kind):
        field = inputs[place]
        base = f"%a{field.argument}"
        if field.offset:
            base = e.emit(f"getelementptr i8, ptr {base}, i64 {field.offset}")
        return e.load_one(base, entry if places is None else int(places[place][entry]), kind)

    *values, flag = Body(e, program, load, lambda place: None).results()
    for i, (row, array) in enumerate(zip(values, program.outputs, strict=False)):
        for k, value in enumerate(row):
            where = k if results is None else int(results[i][k])
            if where >= 0:
                e.store_one(f"%r{i}", where, kind_of(array.dtype), value)
    e.lines.append(f"  %status = select i1 {flag[0]}, i32 0, i32 {DEGENERATE}")
    count = 1 + max((field.argument for field in inputs), default=-1)
    pointers = [f"ptr %a{i}" for i in range(count)] + [f"ptr %r{i}" for i in range(len(values))]
    linkage = "internal " if internal else ""
    head = f"define {linkage}i32 @{name}({', '.join(pointers)}) #0 {{"
    return Text("\n".join([head, *e.lines, "  ret i32 %status", "}"]), e.declared)


def array_call_ir(name: str, arguments: int, program: Program) -> Text:
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


# --- object files ---


class ObjectFile(NamedTuple):
    """A relocatable object file, the functions of the C library that it calls, and the bytes of stack of each function."""

    binary: bytes
    library: tuple[str, ...]
    stack: dict[str, int]


def object_file(text: str, target: Triple) -> ObjectFile:
    """Compile a module for a target."""
    _initialize()
    machine = llvm.Target.from_triple(target.triple).create_target_machine(
        cpu=target.cpu, features=target.features, opt=2, reloc="pic", codemodel="small"
    )
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = target.triple, str(machine.target_data)
    options = llvm.create_pipeline_tuning_options(speed_level=1)
    options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = False
    llvm.create_pass_builder(machine, options).getModulePassManager().run(
        module, llvm.create_pass_builder(machine, options)
    )
    called = sorted({x.name for x in module.functions if x.is_declaration and not x.name.startswith("llvm.")})
    assembly = machine.emit_assembly(module)
    return ObjectFile(machine.emit_object(module), tuple(called), stack_bytes(assembly))


# The instruction by which a function takes its frame, on each family of processors.
_FRAMES = (
    r"subq\s+\$(\d+), %rsp",
    r"sub\w*\s+sp, (?:sp, )?#(\d+)(?:, lsl #(\d+))?",
    r"addi\s+sp, sp, -(\d+)",
    r"i32\.const\s+(\d+)\n\s+i32\.sub\s*\n\s+(?:local\.tee\s+\d+\n\s+)?global\.set\s+__stack_pointer",
)
_SAVED = (
    256  # bytes, more than all registers that a function saves before it takes its frame take on any of the targets
)


def stack_bytes(assembly: str) -> dict[str, int]:
    """Bytes of stack that each function of an assembly takes, registers that it saves included."""
    sizes: dict[str, int] = {}
    parts = re.split(r"^([A-Za-z_]\w*):", assembly, flags=re.MULTILINE)
    for name, body in zip(parts[1::2], parts[2::2], strict=True):
        taken = 0
        for pattern in _FRAMES:
            for match in re.finditer(pattern, body):
                shift = match.group(2) if match.re.groups > 1 else None
                taken += int(match.group(1)) << int(shift or 0)
        sizes[name] = taken + _SAVED
    return sizes
