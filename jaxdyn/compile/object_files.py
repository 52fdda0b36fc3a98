"""Relocatable object files for any target of LLVM, with what a linker and a stack need to know of them."""

import functools
import re
from typing import NamedTuple

import llvmlite.binding as llvm

from jaxdyn.compile.objects import features as host_features


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
    return ObjectFile(machine.emit_object(module), tuple(called), stack_bytes(assembly))


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
