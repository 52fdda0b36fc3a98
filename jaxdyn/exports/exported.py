"""Functions as self-contained machine code, with their Jacobians: `export` makes them, `Exported` calls and saves them."""

import ctypes
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from jaxdyn.compile import standalone
from jaxdyn.compile.directions import Directions
from jaxdyn.compile.program import Program
from jaxdyn.compile.standalone import DEGENERATE, Routine
from jaxdyn.compile.standalone import HOST as HOST
from jaxdyn.compile.standalone import TARGETS as TARGETS
from jaxdyn.compile.stored import Code, code_of
from jaxdyn.exports.files import write_files
from jaxdyn.exports.interfaces import (
    Argument,
    arguments_of,
    batch_ir,
    casadi_ir,
    check_identifier,
    fields_of,
    system_of,
)
from jaxdyn.model.configuration import columns_of
from jaxdyn.model.tree import Model

DERIVATIVES = ("jacobian",)
ABIS = ("c", "casadi")
_QUANTITIES = {"q": ("q", "q_units"), "v": ("v", "v_units"), "tau": ("v", "force_units"), "a": ("v", "a_units")}


def export(
    function: Callable,
    *examples: PyTree,
    name: str,
    derivatives: Sequence[str] = (),
    batch: bool = False,
) -> "Exported":
    """Compile a function of one sample to self-contained machine code for C, CasADi and NumPy.

    **Arguments:**

    - `function(*arrays)` -> array or tuple of arrays: any function of one sample that is a scalar program (no callbacks, no
      data-dependent control flow), such as dynamics, kinematics, constrained dynamics, a projection, a step of `jd.stepper` or a
      control law. A model that it closes over is compiled in; a model that is an argument becomes a structure of arrays with
      named fields.
    - `examples`: arrays, or pytrees of arrays, that give shapes and dtypes (float64 or float32). The test program that `save`
      writes takes their values as inputs.
    - `name`: of the C function.
    - `derivatives`: ("jacobian",) adds `name_jacobian`, the derivatives of each result by each argument.
    - `batch`: True adds `name_batch`, which takes many samples and computes several at once in vector registers.

    **Returns:** `Exported`. Called with numpy arrays it returns numpy arrays, without JAX.

    Each function returns a status. Samples where constraint rows lose rank are computed by the pseudo-inverse, within the
    object file; the status is non-zero where that has no regular solution either.

    **Raises:** ValueError for a function that is no such program (callbacks, loops, branches or shapes that depend on data), for
    integers and complex numbers, and for a name that is no identifier of C.

    ```python
    model = jd.robots.iiwa()
    q = np.zeros(7)
    function = lambda q, v, tau: jd.forward_dynamics(model, q, v, tau)
    exported = jd.export(function, q, q, q, name="arm_fd", derivatives=("jacobian",))
    acceleration = exported(q, q, q)
    by_q, by_v, by_tau = exported.jacobian(q, q, q)
    exported.save("arm_fd")  # arm_fd.o, arm_fd.h, arm_fd_test.c, CMakeLists.txt
    ```
    """
    check_identifier(name, "name")
    # A text is a sequence too: "jacobian" would be taken for eight names.
    derivatives = (derivatives,) if isinstance(derivatives, str) else tuple(derivatives)
    for each in derivatives:
        if each not in DERIVATIVES:
            raise ValueError(
                f"derivatives has {each!r}; choose from {', '.join(map(repr, DERIVATIVES))}, or leave it empty"
            )
    # Numbers of Python become float64, and arrays of JAX leave the device: the files hold the examples' values.
    examples = jax.tree.map(np.asarray, examples)
    arguments = arguments_of(function, examples)
    value, structure = standalone.make_routine(function, examples, name)
    program = value.program
    leaves = [(f"{x.name}.{leaf.name}" if x.is_structure else x.name, leaf) for x in arguments for leaf in x.leaves]
    for (label, leaf), array in zip(leaves, program.inputs, strict=True):
        # Without this check the C function would read the doubles of its caller as floats.
        if leaf.dtype != array.dtype:
            raise ValueError(
                f"examples: {label} has dtype {leaf.dtype}, and JAX computes in {array.dtype} here; "
                'jax.config.update("jax_enable_x64", True) before the export, or pass float32'
            )
    if program.outputs and any(x.dtype.name not in ("float64", "float32") for x in program.outputs[:-1]):
        kinds = ", ".join(str(x.dtype) for x in program.outputs[:-1])
        raise ValueError(
            f"function returns arrays of {kinds}; exported functions return float64 and float32, so convert with astype"
        )
    jacobian = standalone.jacobian_routine(value, f"{name}_jacobian") if "jacobian" in derivatives else None
    system = system_of(function, examples)
    return Exported(arguments, value, structure, jacobian, batch, examples, system)


class Exported:
    """A function as machine code; see `export`."""

    def __init__(
        self,
        arguments: tuple[Argument, ...],
        value: Routine,
        structure: PyTree,
        derivative: Routine | None,
        batch: bool,
        examples: PyTree,
        system: Model | None,
    ):
        self.name = value.symbol
        self.arguments = arguments
        self.value = value
        self.derivative = derivative
        self.batch = batch
        self.examples = examples
        self._structure = structure
        self._system = system
        self._is_one_array = jax.tree_util.treedef_is_leaf(structure)
        # Compiled at the first call from Python: who only saves files does not wait for this processor's code.
        self._code: Code | None = None
        self._local = threading.local()

    def __repr__(self):
        extra = f", Jacobian {self.derivative.program.cost}" if self.derivative else ""
        return f"Exported({self.name}, {self.value.program.cost} operations{extra})"

    @property
    def has_structures(self) -> bool:
        """True if an argument is a pytree of arrays."""
        return any(x.is_structure for x in self.arguments)

    def results(self) -> list[tuple[str, tuple[int, ...], np.dtype]]:
        """Names, shapes and dtypes of the results."""
        outputs = self.value.program.outputs[:-1]  # the last one is the flag
        names = ["out"] if len(outputs) == 1 else [f"out{i}" for i in range(len(outputs))]
        # Macros of sizes are upper case, so that names which differ by case alone would collide.
        taken = {x.name.lower() for x in self.arguments}
        names = [f"{x}_" if x in taken else x for x in names]
        return [(name, x.shape, x.dtype) for name, x in zip(names, outputs, strict=True)]

    def jacobian_results(self) -> list[tuple[str, tuple[int, ...], np.dtype]]:
        """Names, shapes and dtypes of the Jacobians: `result_by_argument` (size of the result, size of the argument)."""
        assert self.derivative is not None
        leaves = [
            leaf if not x.is_structure else leaf._replace(name=f"{x.name}_{leaf.name}")
            for x in self.arguments
            for leaf in x.leaves
        ]
        names = [f"{result}_by_{leaf.name}" for result, _, _ in self.results() for leaf in leaves]
        return [(name, x.shape, x.dtype) for name, x in zip(names, self.derivative.program.outputs[:-1], strict=True)]

    def symbols(self) -> list[str]:
        """Names of the C functions."""
        names = [x.symbol for x in (self.value, self.derivative) if x is not None]
        return [*names, f"{self.name}_batch"] if self.batch else names

    def comment_on(self, name: str, size: int) -> str:
        """Order and units of the entries of an argument that is called q, v, a or tau; "" for others."""
        if self._system is None or name not in _QUANTITIES:
            return ""
        columns = columns_of(self._system)
        entries, units = (getattr(columns, key) for key in _QUANTITIES[name])
        if len(entries) != size:  # an argument of that name that is something else
            return ""
        return ", ".join(f"{entry} [{unit}]" for entry, unit in zip(entries, units, strict=True))

    # --- calls from Python ---

    def __call__(self, *args: PyTree) -> PyTree:
        """The function's results as numpy arrays, computed without JAX.

        **Raises:** ValueError for arguments of other shapes; FloatingPointError where the sample has no regular solution.
        """
        # Half a microsecond is all that a call has: the attribute is there but for the first call of a thread.
        try:
            call = self._local.function
        except AttributeError:
            call = self._caller("function")
        result = call(args)
        return result if self._is_one_array else jax.tree.unflatten(self._structure, result)

    def jacobian(self, *args: PyTree) -> tuple:
        """Derivatives (size of the result, size of the argument) of each result by each argument.

        **Returns:** of one result a tuple with one array for each array among the arguments; of several results a tuple of such.

        **Raises:** ValueError where the function was exported without derivatives; as `__call__`.
        """
        if self.derivative is None:
            raise ValueError(
                f"{self.name} was exported without its Jacobian; pass derivatives=('jacobian',) to jd.export"
            )
        flat = self._caller("jacobian")(args)
        # The blocks come by results, then by arguments.
        count = len(flat) // max(1, len(self.results()))
        rows = [tuple(flat[i : i + count]) for i in range(0, len(flat), count)]
        return rows[0] if len(rows) == 1 else tuple(rows)

    def _caller(self, which: str) -> Callable[[tuple], Any]:
        """Function from arguments to results with buffers of its own."""
        # One for each thread: threads that shared buffers would overwrite each other's arguments.
        caller = getattr(self._local, which, None)
        if caller is None:
            if self._code is None:
                self._code = code_of(self.module("packed", standalone.resolve_target(HOST).lanes))
            routine = self._routine(which)
            address = self._code.address(f"{routine.symbol}_packed")
            caller = _make_caller(address, self, routine.program, which == "function" and self._is_one_array)
            setattr(self._local, which, caller)
        return caller

    def evaluate(self, which: str = "function") -> list[np.ndarray]:
        """Results, or their derivatives ("jacobian"), at the examples; NaN where they have no regular solution."""
        try:
            results = self._caller(which)(self.examples)
            return results if isinstance(results, list) else [results]
        except FloatingPointError:
            return [np.full(x.shape, np.nan, x.dtype) for x in self._routine(which).program.outputs[:-1]]

    def _routine(self, which: str) -> Routine:
        routine = self.value if which == "function" else self.derivative
        assert routine is not None
        return routine

    # --- code and files ---

    def module(self, abi: str = "c", lanes: int = 1) -> str:
        """All functions in LLVM's intermediate representation; `abi` is "c", "casadi", or "packed" for calls from Python."""
        if abi == "casadi":
            return casadi_ir(self, lanes)
        routines = [x for x in (self.value, self.derivative) if x is not None]
        fields = fields_of(self.arguments)
        functions = [text for x in routines for text in standalone.routine_ir(x, fields, lanes=lanes)]
        if abi == "packed":
            functions += [standalone.array_call_ir(x.symbol, len(self.arguments), x.program) for x in routines]
        if self.batch and abi == "c":
            functions.append(batch_ir(self, lanes))
        return standalone.module_ir(*functions)

    def save(
        self,
        folder: str | Path,
        target: str = "host",
        abi: str = "c",
        *,
        cpu: str | None = None,
        features: str | None = None,
    ) -> Path:
        """Write `name.o`, `name.h`, `name_test.c` and `CMakeLists.txt` into a folder, which is made where it does not exist.

        **Arguments:**

        - `folder`: where the files are written.
        - `target`: "host", a short name ("x86_64", "x86_64-v3", "x86_64-v4", "aarch64", "cortex-m7", "riscv64", "wasm32"), or a
          triple of LLVM; `cpu` and `features` as LLVM writes them.
        - `abi`: "c", or "casadi" for `casadi.external(name, "./name.so")`, with exact first derivatives where the function was
          exported with its Jacobian.

        **Returns:** the folder. Either all files are written or none.

        **Raises:** ValueError for an unknown target or interface, and for a folder that cannot be written.
        """
        if abi not in ABIS:
            raise ValueError(f"abi is {abi!r}; choose from {', '.join(map(repr, ABIS))}")
        arrays = (*self.value.program.inputs, *self.value.program.outputs[:-1])
        if abi == "casadi" and (self.has_structures or any(x.dtype != np.float64 for x in arrays)):
            raise ValueError(
                "abi is 'casadi', whose functions take and return arrays of float64: export a function of such arrays only"
            )
        # Everything that can fail has been done when the first file is written.
        resolved = standalone.resolve_target(target, cpu, features)
        made = standalone.object_file(self.module(abi, resolved.lanes), resolved)
        return write_files(self, Path(folder), made, resolved, abi)


def _make_caller(
    address: int, exported: Exported, program: Program | Directions, is_single: bool
) -> Callable[[tuple], Any]:
    """Buffers, and a function that copies arguments into them, calls the code at the address, and copies results out.

    It returns the first result where that `is_single`, else a list.
    """
    # To find the addresses of numpy arrays takes longer than forward dynamics of an arm, so arguments are copied to known places.
    structure, name = jax.tree.structure(exported.examples), exported.name
    takes_arrays = not exported.has_structures
    # Arguments are laid out as structures of C, so that pytrees need no other code than arrays.
    leaves, memory, pointers = [], [], []
    for argument in exported.arguments:
        raw = np.zeros(max(argument.bytes, 1), np.uint8)
        memory.append(raw)
        pointers.append(raw.ctypes.data)
        for leaf in argument.leaves:
            size = int(np.prod(leaf.shape, dtype=int)) * leaf.dtype.itemsize
            leaves.append(raw[leaf.offset : leaf.offset + size].view(leaf.dtype).reshape(leaf.shape))
    results = [np.zeros(x.shape, x.dtype) for x in program.outputs[:-1]]
    pointers += [x.ctypes.data for x in results]
    block = (ctypes.c_void_p * len(pointers))(*pointers)
    # One pointer to all pointers, without a declared type of argument: ctypes converts neither then, which halves the call. The
    # lock of the interpreter is kept: to get it back may take longer than the function.
    function = ctypes.PYFUNCTYPE(ctypes.c_int)(address)
    pointer = ctypes.c_void_p(ctypes.addressof(block))
    pairs = [(leaf, leaf.shape) for leaf in leaves]
    is_flat = takes_arrays and all(leaf.ndim == 1 for leaf in leaves)
    views = [memoryview(leaf) for leaf in leaves] if is_flat else []

    copy = results[0].copy if is_single else None

    def convert(args):
        if not takes_arrays:
            args, given = jax.tree.flatten(args)
            if given != structure:
                raise ValueError(
                    f"{name}: the arguments have the structure {given}, the examples had {structure}"
                ) from None
        elif len(args) != len(pairs):
            raise ValueError(f"{name} takes {len(pairs)} arguments, and was given {len(args)}") from None
        for (buffer, shape), x in zip(pairs, args, strict=True):
            # An assignment alone would spread a single number over the whole array.
            if np.shape(x) != shape:
                raise ValueError(f"{name}: an argument has shape {np.shape(x)}, the example had {shape}") from None
            buffer[...] = x

    def fail():
        raise FloatingPointError(
            f"{name}: no regular solution at this sample: constraint rows contradict each other, the mass matrix is "
            "singular, or a step cannot be completed; the result code of the function in Python says which"
        )

    known = {
        "convert": convert,
        "fail": fail,
        "function": function,
        "pointer": pointer,
        "copy": copy,
        "whole": slice(None),
    }
    known |= {f"view{i}": view for i, view in enumerate(views)} | {"results": results}
    exec(_caller_source(len(views), is_single), known)
    call: Any = known["call"]
    call.memory = (memory, block)  # addresses alone do not keep it alive
    return call


def _caller_source(count: int, is_single: bool) -> str:
    """Python text of `call(args)`, with one line for each view: a loop over them takes as long as the copies."""
    unpack = f"{''.join(f'x{i}, ' for i in range(count))}= args" if count else "convert(args)"
    # A view takes arrays of its own size and dtype alone: one operation copies and checks.
    lines = [unpack, *(f"view{i}[whole] = x{i}" for i in range(count))]
    body = "\n        ".join(lines)
    # The next call overwrites the buffers, so results are copied. Those that are not finite are returned, as numpy does.
    result = "copy()" if is_single else "[x.copy() for x in results]"
    return f"""def call(args):
    try:
        {body}
    except (TypeError, ValueError, BufferError):
        convert(args)
    if function(pointer) & {DEGENERATE}:
        fail()
    return {result}
"""
