"""PTX, NVIDIA's portable assembly, from the text of a kernel: by LLVM, without a toolkit. The driver makes machine code of it."""

import copy
import functools
import re
from collections.abc import Sequence

import llvmlite.binding as llvm

from jaxdyn.compile.body import symbol_of
from jaxdyn.compile.careful import Careful
from jaxdyn.compile.code import kernel_ir, subprogram_ir, varying_first
from jaxdyn.compile.gpu.functions import library_text
from jaxdyn.compile.jax_adapter import Unsupported
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import Array, Constant, Program, kind_of

# Architectures that LLVM writes for; the driver takes PTX of an older one for a newer one. ISA 8.0 came with CUDA 12.0.
ARCHITECTURES = (70, 75, 80, 86, 89, 90)
MIN_DRIVER = 12000
_TRIPLE, _ISA = "nvptx64-nvidia-cuda", "+ptx80"

_SAMPLE = """define internal i64 @sample() alwaysinline {
  %thread = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()
  %block = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
  %threads = call i32 @llvm.nvvm.read.ptx.sreg.ntid.x()
  %wide.thread = zext i32 %thread to i64
  %wide.block = zext i32 %block to i64
  %wide.threads = zext i32 %threads to i64
  %before = mul i64 %wide.block, %wide.threads
  %sample = add i64 %before, %wide.thread
  ret i64 %sample
}
declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ntid.x()"""


def architecture_for(capability: int) -> int | None:
    """The newest architecture for a device of this compute capability, as 90 for 9.0; None where the device is too old."""
    return max((x for x in ARCHITECTURES if x <= capability), default=None)


@functools.cache
def _target():
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    try:
        return llvm.Target.from_triple(_TRIPLE)
    except RuntimeError as error:  # a build of llvmlite on an LLVM of somebody else
        raise Unsupported(f"LLVM has no target for NVIDIA's GPUs ({error})") from None


def ptx_of(module: str, architecture: int) -> str:
    """The PTX of a module's text (see `text.module_ir`). **Raises:** `Unsupported`."""
    machine = _target().create_target_machine(cpu=f"sm_{architecture}", features=_ISA, opt=1)
    parsed = llvm.parse_assembly(f"{module}\n{_SAMPLE}")
    parsed.triple, parsed.data_layout = _TRIPLE, str(machine.target_data)
    passes = llvm.create_new_module_pass_manager()
    passes.add_always_inliner_pass()
    for _ in range(2):  # first the pointers to a thread's arrays, then the arrays
        passes.add_sroa_pass()
        passes.add_instruction_combine_pass()
        passes.add_simplify_cfg_pass()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(parsed, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=1)))
    text = machine.emit_assembly(parsed)
    # How many threads a block has decides how many registers each may take, and that one block is enough lets it take them: by
    # itself the assembler prefers more blocks, and spills. LLVM's own notes of it depend on its version.
    head = re.compile(rf"(\.entry {KERNEL}\([^)]*\)\s*)(?:\.\w+ [^\n]*\n)*\{{")
    return head.sub(rf"\1.maxntid {MAX_THREADS}, 1, 1\n.minnctapersm 1\n{{", text, count=1)


# --- the text of a kernel for a GPU: that of the CPU for one sample, within a function that a thread runs for its sample ---


KERNEL = "jaxdyn_thread"  # the function of a thread
# A thread copies arrays of at most so many entries to registers, or to its local memory.
MAX_INTERLEAVED_ENTRIES = 128
MAX_THREADS = 128  # in a block: each of them may take as many registers as there are
# Memory of a thread for its arrays. A GPU reserves it for all threads that it can run at a time: 18 GB of an H100's 80.
MAX_BYTES = 1 << 16


class TooLarge(Exception):
    """A program that cannot be a kernel for a GPU, with the reason."""


def is_interleaved(array: Array, uniform: bool) -> bool:
    """Decide whether an array is stored with the entries of neighbouring samples side by side."""
    return not uniform and array.size <= MAX_INTERLEAVED_ENTRIES


def module_ir(program, uniform: Sequence[bool]) -> str:
    """The module of a program's kernel, but for `sample`, which gives the number of a thread. **Raises:** `TooLarge`.

    The kernel is `void jaxdyn_thread(ptr ..., i64 n)` with the arguments in the order of `varying_first`, then the results.
    """
    program = with_careful_programs(program)
    if not isinstance(program, Program) and not hasattr(program, "turn"):
        program = as_call(program)
    text = kernel_ir(program, 1, uniform) if isinstance(program, Program) else program.ir(1, uniform)
    parts = _parts(text.replace("define void @kernel(", "define internal void @kernel(").replace("#0 {", "#2 {", 1))
    _define(parts, program.subprograms)
    thread = _thread_ir(program, uniform)
    _add(parts, thread)
    parts["attributes #2"] = 'attributes #2 = { alwaysinline nounwind "no-builtins" }'
    # LLVM writes functions out that are called once: what is passed stays in registers.
    text = "\n".join(parts.values())
    for symbol in (symbol_of(x, 1) for x in program.subprograms):
        if symbol in parts and text.count(f"call void @{symbol}(") == 1:
            parts[symbol] = parts[symbol].replace(" #0 {", " #2 {", 1)
    text = "\n".join(parts.values())
    # LLVM has no such fence for GPUs, where nothing compares stores.
    text = text.replace('  fence syncscope("singlethread") release\n', "")
    taken = sum(int(size) for size in re.findall(r"= alloca \[(\d+) x i8\]", text))
    unknown = [name for name, part in parts.items() if part.startswith("declare ") and not name.startswith("llvm.")]
    if set(unknown) - {"malloc", "free"}:
        raise TooLarge(f"it calls {', '.join(unknown)}")
    if taken > MAX_BYTES or unknown:
        raise TooLarge(f"it needs {taken} bytes of memory for each sample, and a GPU's threads have {MAX_BYTES}")
    return text


# --- programs without parts that are made later ---


def with_careful_programs(program):
    """The program with its careful programs made; one of a matrix as a call of it."""
    if isinstance(program, Careful):
        return with_careful_programs(program.program())
    if isinstance(program, Program):
        inner = [with_careful_programs(x) for x in program.subprograms]
        if inner == list(program.subprograms) and program.careful is None:
            return program
        return Program(program.inputs, program.outputs, program.operations, program.results, inner, name=program.name)
    if hasattr(program, "turn"):
        loop = copy.copy(program)
        loop.turn = with_careful_programs(program.turn)
        loop.subprograms, loop.derived = loop.turn.subprograms, {}
        return loop
    if hasattr(program, "body"):
        scan = copy.copy(program)
        scan.body, scan.derived = with_careful_programs(program.body), {}
        vars(scan).pop("digest", None)
        return scan
    return program


def as_call(called) -> Program:
    """A program that only calls a subprogram, such as one of a matrix."""
    operations, entries = [], []
    for place, array in enumerate(called.inputs):
        entries += range(len(operations), len(operations) + array.size)
        operations += [("input", kind_of(array.dtype), (place, k)) for k in range(array.size)]
    call = len(operations)
    operations.append(("call", "call", (Constant(0), *entries)))
    results, first = [], 0
    for array in called.outputs:
        kind, at = kind_of(array.dtype), len(operations)
        operations += [("part", kind, (call, Constant(first + k))) for k in range(array.size)]
        results.append(tuple(range(at, at + array.size)))
        first += array.size
    return Program(called.inputs, called.outputs, operations, results, [called], name=called.name)


# --- the parts of a module ---

_PART = re.compile(r"^define [\s\S]*?^\}$|^\S[^\n]*", re.MULTILINE)
_NAME = re.compile(r"""^(?:define|declare)[^@]*@("?[\w.]+"?)\(|^@("?[\w.]+"?)|^(attributes #\d+|!\d+)""")


def _parts(text: str) -> dict[str, str]:
    """Functions, declarations, data and attributes of a module's text, by their names."""
    parts = {}
    for match in _PART.finditer(text):
        name = _NAME.match(match[0])
        if name is not None:  # else a comment, or the target of LLVM's own printer
            parts[next(x for x in name.groups() if x).strip('"')] = match[0]
    return parts


def _add(parts: dict[str, str], text: str) -> None:
    """Add the parts of a text; what is defined stays so."""
    for name, part in _parts(text).items():
        if not parts.get(name, "").startswith("define"):
            parts[name] = part


def _define(parts: dict[str, str], called: Sequence) -> None:
    """Define the subprograms and the functions of the C library that the parts call, and those that these call."""
    for x in called:
        symbol = symbol_of(x, 1)
        # A call is written as one of what an address in memory points to, which here is always the same.
        if parts.pop(f"{symbol}_at", None) is None:
            continue
        del parts[symbol]
        if isinstance(x, Program):
            text = subprogram_ir(x, 1).replace("define void @called(", f"define internal void @{symbol}(")
        else:
            text = "\n".join(x.definition(symbol).values())
        _add(parts, text)
        _define(parts, x.subprograms)
    for name, part in list(parts.items()):
        text = library_text(name) if part.startswith("declare ") else None
        if text is not None:
            _add(parts, text)


# --- the function of a thread ---


def _thread_ir(program, uniform: Sequence[bool]) -> str:
    arrays = [*program.inputs, *program.outputs]
    same = [*uniform, *[False] * len(program.outputs)]
    order = [*varying_first(uniform), *range(len(uniform), len(arrays))]
    e, after, allocations = _ThreadEmitter(), [], [f"  %data = alloca [{len(arrays)} x ptr]"]
    for at, i in enumerate(order):
        array, pointer = arrays[i], f"%g{i}"
        if is_interleaved(array, same[i]):
            pointer = f"%local{i}"
            allocations.append(f"  {pointer} = alloca [{max(8, array.size * array.dtype.itemsize)} x i8], align 8")
            if i < len(uniform):
                e.copy(pointer, f"%g{i}", array, is_back=False)
            else:
                after.append((pointer, f"%g{i}", array))
        elif not same[i]:
            offset = e.emit(f"mul i64 %s, {array.size * array.dtype.itemsize}")
            pointer = e.emit(f"getelementptr i8, ptr %g{i}, i64 {offset}")
        slot = e.emit(f"getelementptr ptr, ptr %data, i64 {at}")
        e.lines.append(f"  store ptr {pointer}, ptr {slot}")
    e.lines.append("  call void @kernel(ptr %data, i64 1, i64 0, i64 1)")
    for pointer, far, array in after:
        e.copy(pointer, far, array, is_back=True)
    given = ", ".join(f"ptr noalias %g{i}" for i in order)
    return "\n".join(
        [
            f"define ptx_kernel void @{KERNEL}({given}, i64 %n) #0 {{",
            "entry:",
            *allocations,
            "  %s = call i64 @sample()",
            "  %is.sample = icmp ult i64 %s, %n",
            "  br i1 %is.sample, label %go, label %out",
            "go:",
            *e.lines,
            "  br label %out",
            "out:",
            "  ret void",
            "}",
        ]
    )


class _ThreadEmitter(Emitter):
    def __init__(self):
        super().__init__(1)

    def copy(self, own: str, far: str, array: Array, is_back: bool) -> None:
        """Copy the entries of sample %s to memory of its own, or back."""
        of, size = {1: "i8", 4: "i32", 8: "i64"}[array.dtype.itemsize], array.dtype.itemsize
        at = self.emit(f"getelementptr {of}, ptr {far}, i64 %s")
        for k in range(array.size):
            here = self.emit(f"getelementptr i8, ptr {own}, i64 {k * size}")
            source, target = (here, at) if is_back else (at, here)
            value = self.emit(f"load {of}, ptr {source}, align {size}")
            self.lines.append(f"  store {of} {value}, ptr {target}, align {size}")
            at = self.emit(f"getelementptr {of}, ptr {at}, i64 %n")
