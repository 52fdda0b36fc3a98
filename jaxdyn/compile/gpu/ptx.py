"""PTX, NVIDIA's portable assembly, from the text of a kernel: by LLVM, without a toolkit. The driver makes machine code of it."""

import functools
import re

import llvmlite.binding as llvm

from jaxdyn.compile.gpu.text import KERNEL, MAX_THREADS
from jaxdyn.compile.jax_adapter import Unsupported

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
