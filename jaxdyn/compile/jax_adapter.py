"""The only module of jaxdyn that depends on the version of JAX: its extension points, jaxprs, XLA's FFI and compiler options.

Names of JAX that are documented little, or that have changed, are used here alone; `tests/package/test_jax_adapter.py`
lists them, with the page that documents each. The versions of `TESTED` are those that the tests run with. On any other
version a trial goes through all rules before the first kernel, and where it fails there are no kernels in this process; a later
error while a function is compiled to a kernel leaves that function to JAX's own operations. One warning names the version and
the reason (`forgive`, `reason_against_kernels`).
"""

import contextlib
import copy
import ctypes
import functools
import logging
import operator
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import lax
from jax.core import ShapedArray as ShapedArray
from jax.core import Tracer as Tracer
from jax.core import eval_jaxpr
from jax.sharding import AxisType, NamedSharding, PartitionSpec

logger = logging.getLogger("jaxdyn")

# --- versions ---

TESTED = ((0, 10), (0, 12))  # the first and the last minor version

_against_kernels: str | None = None  # why there are none in this process
_trial: Callable | None = None
_is_warned = False


def is_version_known() -> bool:
    """Decide whether the tests run with this version of JAX."""
    return TESTED[0] <= tuple(jax.__version_info__[:2]) <= TESTED[1]


def forgive(error: BaseException) -> bool:
    """Decide whether to continue without a kernel after an error: never on a tested version, else after one warning."""
    global _is_warned
    if is_version_known() or not isinstance(error, Exception):
        return False
    if not _is_warned:
        _is_warned = True
        first, last = (".".join(map(str, version)) for version in TESTED)
        reason = f"{type(error).__name__}: {error}".strip()
        warnings.warn(
            f"jaxdyn is tested with jax {first} to {last}, and this is jax {jax.__version__}: functions run on JAX's own "
            f"operations, right but slower, where native kernels fail ({reason}). For kernels, "
            f"pip install 'jax<{TESTED[1][0]}.{TESTED[1][1] + 1}'",
            UserWarning,
            stacklevel=2,
        )
    return True


@contextlib.contextmanager
def _kernels_or_none() -> Iterator[None]:
    """Context in which an error that is forgiven turns kernels off for this process."""
    global _against_kernels
    try:
        yield
    except Exception as error:
        if not forgive(error):
            raise
        _against_kernels = _against_kernels or f"{type(error).__name__}: {error}"


def try_first(trial: Callable) -> None:
    """Call `trial()` before the first kernel, on an unknown version alone: where it raises, there are no kernels.

    Rules of primitives are called by JAX in the midst of its transformations, where nothing can be forgiven any more.
    """
    global _trial
    _trial = trial


def reason_against_kernels() -> str | None:
    """Why no function can be a kernel with this JAX, or None."""
    global _trial
    if _trial is not None and _against_kernels is None and not is_version_known():
        trial, _trial = _trial, None  # the trial calls this function too
        # A trial in the midst of a user's trace would be staged into it; another thread has no trace.
        with _kernels_or_none(), ThreadPoolExecutor(1) as other:
            other.submit(trial).result()
    return _against_kernels


def configuration() -> tuple:
    """JAX's options that are in force in this thread: all of them, as any may change what a trace becomes."""
    return _options()(jax.config)


@functools.cache
def _options() -> Callable:
    return operator.attrgetter(*sorted(name for name in jax.config.values if hasattr(jax.config, name)))


# --- extension points ---

try:
    from jax.extend.core import ClosedJaxpr as ClosedJaxpr  # pyright: ignore[reportPrivateImportUsage]
    from jax.extend.core import Literal as Literal
    from jax.extend.core import Primitive
    from jax.extend.mlir.dialects import sdy
    from jax.interpreters import ad, batching, mlir
except ImportError as _error:
    if not forgive(_error):
        raise
    _against_kernels = f"{type(_error).__name__}: {_error}"
    # Names for annotations and `isinstance`: without kernels no jaxpr is looked at.
    ClosedJaxpr = Literal = object


def define_primitive(
    name: str,
    types: Callable,
    *,
    multiple_results: bool = False,
    implement: Callable | None = None,
    lower: Callable | None = None,
    lower_on_cpu: Callable | None = None,
    lower_on_gpu: Callable | None = None,
    batch: Callable | None = None,
    jvp: Callable | None = None,
    transpose: Callable | None = None,
) -> Any:
    """A primitive of JAX with its rules; None on an unknown JAX whose extension points are others.

    **Arguments:**

    - `types(*types, **params)`: types of the results. `implement(*arrays, **params)`: the call outside of a trace.
    - `lower(*arrays, **params)`: the same by operations of JAX. `lower_on_cpu(context, *operands, **params)`: a rule of its own,
      as `lower_on_gpu`, for those of NVIDIA.
    - `batch(arrays, axes, **params)` -> results and their axes, None for what has no axis; `jvp(primals, tangents, **params)`;
      `transpose(cotangents, *operands, **params)`. Tangents and cotangents may be zero (`is_zero`).
    """
    with _kernels_or_none():
        primitive = Primitive(name)
        primitive.multiple_results = multiple_results
        primitive.def_abstract_eval(types)
        if implement is not None:
            primitive.def_impl(implement)
        if lower is not None:
            mlir.register_lowering(primitive, mlir.lower_fun(lower, multiple_results=multiple_results))
        if lower_on_cpu is not None:
            mlir.register_lowering(primitive, lower_on_cpu, platform="cpu")
        if lower_on_gpu is not None:
            mlir.register_lowering(primitive, lower_on_gpu, platform="cuda")
        if batch is not None:
            batching.primitive_batchers[primitive] = batch
        if jvp is not None:
            ad.primitive_jvps[primitive] = jvp
        if transpose is not None:
            ad.primitive_transposes[primitive] = transpose
        return primitive
    return None


def is_zero(tangent) -> bool:
    """Decide whether a tangent or a cotangent is JAX's symbolic zero, which is no array."""
    return type(tangent) is ad.Zero


def zero_tangent(x) -> Any:
    """The tangent of an array that cannot move, such as one of integers."""
    return ad.Zero(ShapedArray(x.shape, jax.dtypes.float0))


def is_linear(operand) -> bool:
    """Decide whether the result is linear in this operand of a transpose rule."""
    return ad.is_undefined_primal(operand)


def lowering_of(function: Callable) -> Any:
    """Lowering rule of a function of arrays: rule(context, *operands, **params)."""
    return mlir.lower_fun(function, multiple_results=True)


def function_of(closed) -> Callable:
    """The function of a closed jaxpr, from a flat list of arrays to one."""
    return functools.partial(eval_jaxpr, closed.jaxpr, closed.consts)


# --- parameters of primitives in jaxprs ---


def scan_counts(params: dict) -> tuple[int, int]:
    """Number of constants and of carried values among the operands of a `scan`."""
    if "ft_in" in params:  # since 0.11: trees of the constants, the carry and the rows
        constants, carry, _ = params["ft_in"].unpack()
        return len(constants), len(carry)
    return params["num_consts"], params["num_carry"]


def expand_high(params: dict) -> tuple[Callable, Any, bool]:
    """Parts of a primitive that JAX keeps whole (since 0.12).

    Its function, the tree of its arguments, and whether its derivative has a rule of its own.
    """
    primitive = params["_prim"]
    if "compare_all" in getattr(primitive, "valid_methods", ()):  # searchsorted: a count has no bisection
        primitive = copy.copy(primitive)
        primitive.method = "compare_all"
    own = {name for kind in type(primitive).__mro__[:-2] for name in vars(kind)}
    return primitive.expand, primitive.in_tree, bool(own & {"jvp", "lin", "vjp_fwd"})


_NOT_USERS = re.compile(r"site-packages/(jax|jaxlib|equinox|jaxtyping)/|/lib/python3[^/]*/(?!site-packages)|^<")


def place_of(eqn) -> str:
    """The function of the user that an equation comes from, with file and line; "" for those of jaxdyn."""
    traceback = getattr(eqn.source_info, "traceback", None)
    for frame in getattr(traceback, "frames", ()):
        file = frame.file_name.replace("\\", "/")
        if _NOT_USERS.search(file):
            continue
        if file.startswith(_OWN):
            return ""
        return f"{frame.function_name} ({file.rpartition('/')[2]}:{frame.line_num})"
    return ""


_OWN = Path(__file__).parent.parent.as_posix() + "/"

# --- types of arrays on meshes of devices ---


def mesh_of(array_type) -> Any:
    """The mesh in the type of an array; None where the type has none."""
    mesh = array_type.sharding.mesh
    return None if mesh.empty else mesh


def spec_of(array_type) -> tuple:
    """For each axis of an array the axes of the mesh along which its type divides it, or None."""
    return tuple(array_type.sharding.spec)


def type_like(array_type, shape: tuple, dtype, spec: Sequence) -> Any:
    """The type of an array on the same mesh, varying along the same manual axes."""
    sharding = NamedSharding(array_type.sharding.mesh, PartitionSpec(*spec))
    return array_type.update(shape=shape, dtype=dtype, weak_type=False, sharding=sharding)


def is_all_manual(mesh) -> bool:
    """Decide whether all axes of a mesh are manual, so that XLA partitions nothing along them."""
    return bool(mesh.axis_types) and all(kind == AxisType.Manual for kind in mesh.axis_types)


def vary_alike(leaves: list) -> list:
    """The same arrays, each varying along all manual axes of meshes along which one of them does."""
    try:
        types = [getattr(jax.typeof(x), "manual_axis_type", None) for x in leaves]
        axes = frozenset().union(*(x.varying for x in types if x is not None))
        return [
            x if kind is None or axes <= kind.varying else lax.pcast(x, tuple(axes - kind.varying), to="varying")
            for x, kind in zip(leaves, types, strict=True)
        ]
    except Exception as error:
        if not forgive(error):
            raise
        return leaves


def sharding_attributes(batch_dims: int, sizes: Sequence[int], operands: Sequence, results: Sequence) -> dict:
    """Attributes that tell XLA's partitioners along which axes a call can be divided.

    `sizes` are those of the independent axes; `operands` and `results` list for each array which of them its axes are.
    """

    def mapping(axes):
        return sdy.TensorMappingAttr.get(dim_mappings=[sdy.DimMappingAttr.get(factor_indices=[k]) for k in axes])

    rule = sdy.OpShardingRuleAttr.get(
        factor_sizes=list(sizes),
        operand_mappings=[mapping(axes) for axes in operands],
        result_mappings=[mapping(axes) for axes in results],
        is_custom=True,
    )
    return {
        "mhlo.frontend_attributes": mlir.ir_attribute({"num_batch_dims": str(batch_dims)}),
        "sdy.sharding_rule": rule,
    }


# --- XLA's foreign function interface ---

# Offsets of the fields that `handler.ll` reads, in bytes.
_READ = {
    "XLA_FFI_CallFrame": {"extension_start": 8, "api": 16, "ctx": 24, "args": 40, "rets": 80, "attrs": 120},
    "XLA_FFI_Args": {"size": 16, "args": 32},
    "XLA_FFI_Rets": {"size": 16, "rets": 32},
    "XLA_FFI_Attrs": {"attrs": 40},
    "XLA_FFI_Scalar": {"value": 8},
    "XLA_FFI_Buffer": {"data": 24, "rank": 32, "dims": 40},
    "XLA_FFI_Metadata_Extension": {"extension_base": 0, "metadata": 24},
    "XLA_FFI_Metadata": {"api_version": 8, "traits": 32},
    "XLA_FFI_Api_Version": {"major_version": 16, "minor_version": 20},
    "XLA_FFI_Api": {
        "XLA_FFI_Error_Create": 48, "XLA_FFI_Error_Destroy": 64, "XLA_FFI_ThreadPool_Schedule": 136,
        "XLA_FFI_ThreadPool_NumThreads": 144,
    },
}  # fmt: skip
# Those that it fills in, of the size that it says: a field more would not be filled in.
_PASSED = {
    "XLA_FFI_Error_Create_Args": {"message": 16, "errc": 24},
    "XLA_FFI_Error_Destroy_Args": {"error": 16},
    "XLA_FFI_ThreadPool_Schedule_Args": {"ctx": 16, "task": 24, "data": 32},
    "XLA_FFI_ThreadPool_NumThreads_Args": {"ctx": 16, "num_threads": 24},
}
# What the handler for GPUs reads and passes beside these.
_OF_GPUS = {
    "XLA_FFI_Api": {"XLA_FFI_Stream_Get": 80, "XLA_FFI_DeviceOrdinal_Get": 184},
    "XLA_FFI_Stream_Get_Args": {"ctx": 16, "stream": 24},
    "XLA_FFI_DeviceOrdinal_Get_Args": {"ctx": 16, "device_ordinal": 24},
}
_MAJOR = 0


class Unsupported(Exception):
    """Why kernels cannot be called here."""


def ffi_version(header: str | None = None, for_gpus: bool = False) -> tuple[int, int]:
    """Version of the FFI of the jaxlib that is installed, or of that header. **Raises:** `Unsupported`.

    Minor versions add fields at the ends of structures and functions at the end of the table, and may rename. So no version is
    refused for its number, but for another major one and where a field that kernels use is at another place.
    """
    if header is None:
        try:
            header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text()
        except OSError as error:
            raise Unsupported(f"jaxlib comes without the header of XLA's FFI ({error})") from None
    found = [re.search(rf"define XLA_FFI_API_{part} (\d+)", header) for part in ("MAJOR", "MINOR")]
    major, minor = (-1 if x is None else int(x.group(1)) for x in found)
    if major != _MAJOR:
        raise Unsupported(f"jaxlib has version {major}.{minor} of XLA's FFI, and kernels are written for {_MAJOR}.x")
    structures = _structures(header)
    for name, expected in (_OF_GPUS if for_gpus else _READ | _PASSED).items():
        fields = structures.get(name, {})
        have = {field: fields.get(field) for field in expected}
        if have != expected or (
            name.endswith("_Args") and name not in _READ and list(fields)[-1] != list(expected)[-1]
        ):
            raise Unsupported(
                f"version {major}.{minor} of XLA's FFI has another {name}: {fields or 'none'}, and kernels need {expected}"
            )
    return major, minor


def _structures(header: str) -> dict[str, dict[str, int]]:
    """Offsets of the fields of each structure of a C header, as compilers for 64 bits lay them out.

    Fields whose type the header does not define end a structure: what comes after them has no known offset.
    """
    # A parser of the few forms that this header has; a compiler for C is not part of the installation.
    text = re.sub(r"//[^\n]*|/\*.*?\*/", "", header, flags=re.DOTALL)
    text = re.sub(r"_XLA_FFI_API_STRUCT_FIELD\((\w+)\)", r"void* \1", text)
    sizes = {name: (4, 4) for name in re.findall(r"typedef enum[^;{]*\{[^}]*\}\s*(\w+)\s*;", text)}
    sizes |= {f"{sign}int{bits}_t": (bits // 8, bits // 8) for sign in ("", "u") for bits in (8, 16, 32, 64)}
    sizes |= {"size_t": (8, 8), "bool": (1, 1), "double": (8, 8), "float": (4, 4), "int": (4, 4)}
    for name, known in re.findall(r"typedef\s+(?=\w+\s+(\w+)\s*;)(\w+)", text):
        if known in sizes:
            sizes[name] = sizes[known]
    structures = {}
    for name, body in re.findall(r"struct\s+(\w+)\s*\{([^}]*)\}", text):
        fields: dict[str, int] = {}
        at, widest = 0, 1
        for declaration in filter(None, map(str.strip, body.split(";"))):
            field = re.fullmatch(r"(?:const\s+)?(?:struct\s+)?(\w+)(.*?)(\w+)", declaration, re.DOTALL)
            kind = None if field is None else (8, 8) if "*" in declaration else sizes.get(field.group(1))
            if field is None or kind is None:
                break
            size, alignment = kind
            at = -(-at // alignment) * alignment
            fields[field.group(3)], at, widest = at, at + size, max(widest, alignment)
        else:
            sizes[name] = -(-at // widest) * widest, widest
        structures[name] = fields
    return structures


def register_handler(name: str, address: int, platform: str = "cpu") -> None:
    """Tell XLA of a function that serves typed calls of this name on a platform, and that their batches can be divided."""
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(ctypes.c_void_p(address)), platform=platform, api_version=1)
    jax.ffi.register_ffi_target_as_batch_partitionable(name)


_EXPORT_HINT = (
    "machine code of jaxdyn cannot be exported by jax.export: trace the function within jd.compilation('plain'), or write an "
    "object file for C with jd.export"
)


def lower_call(
    name: str,
    context,
    operands: Sequence,
    order: Sequence[int],
    attributes: dict | None,
    layouts: Sequence[tuple[int, ...]] | None = None,
    **static,
) -> Any:
    """Lower a call of a registered function with its operands in that order, within a lowering rule.

    `layouts`: for each operand in its own order and each result the axes from the fastest to the slowest; by rows by default.
    """
    context = context.replace(avals_in=[context.avals_in[i] for i in order])
    if getattr(context.module_context.lowering_parameters, "for_export", False):
        # JAX refuses such calls with an error that shows them: the user reads there what to do.
        attributes = {**(attributes or {}), "jaxdyn": mlir.ir_attribute(_EXPORT_HINT)}
    of_operands = None if layouts is None else [layouts[i] for i in order]
    of_results = None if layouts is None else layouts[len(operands) :]
    lower = jax.ffi.ffi_lowering(
        name, operand_layouts=of_operands, result_layouts=of_results, extra_attributes=attributes
    )
    return lower(context, *(operands[i] for i in order), **{key: np.int64(value) for key, value in static.items()})


# --- executables ---


def dump_executable(compiled: Any) -> Any:
    """A compiled function of flat arrays as data that can be pickled; `load_executable` makes it a function again."""
    from jax.experimental import serialize_executable

    return serialize_executable.serialize(compiled)


def load_executable(data: Any) -> Callable:
    """The function of `dump_executable`, of a process with the same jaxlib and processor."""
    from jax.experimental import serialize_executable

    return serialize_executable.deserialize_and_load(*data, execution_devices=jax.devices()[:1])


# --- compiler options ---


def select_options(options: dict[str, Any]) -> dict[str, Any]:
    """Those of the compiler options that the installed XLA has; each other one is logged at level debug, once."""
    return {name: value for name, value in options.items() if _is_option(name, value)}


@functools.cache
def _is_option(name: str, value) -> bool:
    # XLA has no list of its options: the smallest program is compiled with each.
    try:
        jax.jit(lambda: 0.0, compiler_options={name: value})()
    except jax.errors.JaxRuntimeError:
        logger.debug("jaxdyn: XLA has no compiler option %s, which is left out", name)
        return False
    return True
