"""Functions as self-contained machine code, with their Jacobians: `export` makes them, `Exported` calls and saves them."""

import ctypes
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import PyTree

from jaxdyn.compile import standalone
from jaxdyn.compile.objects import Code
from jaxdyn.compile.program import Program
from jaxdyn.compile.standalone import HOST as HOST
from jaxdyn.compile.standalone import TARGETS as TARGETS
from jaxdyn.export.arguments import (
    Argument,
    arguments_of,
    check_identifier,
    comment_on,
    fields_of,
    system_of,
)
from jaxdyn.export.casadi import casadi_ir
from jaxdyn.export.files import write_files
from jaxdyn.export.lanes import batch_ir
from jaxdyn.model.tree import Model

DERIVATIVES = ("jacobian",)
ABIS = ("c", "casadi")


def export(
    function: Callable,
    *examples: PyTree,
    name: str,
    derivatives: Sequence[str] = (),
    batch: bool = False,
) -> "Exported":
    """Compile a function of one sample to self-contained machine code for C, CasADi and NumPy.

    **Arguments:**

    - `function(*arrays)` -> array or tuple of arrays: any function of one sample that is a program of single numbers, such as
      dynamics, kinematics, constrained dynamics, a projection, a step of an integrator or a control law. A model that it closes
      over is compiled in; a model that is an argument becomes a structure of arrays with named fields.
    - `examples`: arrays, or pytrees of arrays, that give shapes and dtypes (float64 or float32). The test program that `save`
      writes uses their values as inputs.
    - `name`: of the C function.
    - `derivatives`: ("jacobian",) adds `name_jacobian`, the derivatives of each result by each argument.
    - `batch`: whether to add `name_batch`, which takes many samples and computes several at once in vector registers.

    **Returns:** `Exported`. Called with numpy arrays it returns numpy arrays, without JAX.

    **Raises:** ValueError for a function that is no such program (callbacks, loops or branches that depend on data), for integers
    and complex numbers, and for a name that is no identifier of C.

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
    derivatives = (derivatives,) if isinstance(derivatives, str) else tuple(derivatives)
    for each in derivatives:
        if each not in DERIVATIVES:
            raise ValueError(
                f"derivatives has {each!r}; choose from {', '.join(map(repr, DERIVATIVES))}, or leave it empty"
            )
    examples = jax.tree.map(np.asarray, examples)
    arguments = arguments_of(function, examples)
    program, structure = standalone.scalar_program(function, examples, name)
    if program.outputs and any(x.dtype.name not in ("float64", "float32") for x in program.outputs[:-1]):
        kinds = ", ".join(str(x.dtype) for x in program.outputs[:-1])
        raise ValueError(
            f"function returns arrays of {kinds}; exported functions return float64 and float32, so convert with astype"
        )
    jacobian = standalone.jacobian_program(program, f"{name}_jacobian") if "jacobian" in derivatives else None
    system = system_of(function, examples)
    return Exported(name, arguments, program, structure, jacobian, batch, examples, system)


class Exported:
    """A function as machine code; see `export`."""

    def __init__(
        self,
        name: str,
        arguments: tuple[Argument, ...],
        program: Program,
        structure: PyTree,
        jacobian: Program | None,
        batch: bool,
        examples: PyTree,
        system: Model | None,
    ):
        self.name = name
        self.arguments = arguments
        self.program = program
        self.jacobian_program = jacobian
        self.batch = batch
        self.examples = examples
        self._structure = structure
        self._system = system
        self._is_one_array = jax.tree_util.treedef_is_leaf(structure)
        self._code: Code | None = None
        self._local = threading.local()

    def __repr__(self):
        extra = f", jacobian with {self.jacobian_program.cost}" if self.jacobian_program else ""
        return f"Exported({self.name}, {self.program.cost} operations{extra})"

    @property
    def has_structures(self) -> bool:
        """Whether an argument is a pytree of arrays."""
        return any(x.is_structure for x in self.arguments)

    def results(self) -> list[tuple[str, tuple[int, ...], np.dtype]]:
        """Names, shapes and dtypes of the results."""
        outputs = self.program.outputs[:-1]
        names = ["out"] if len(outputs) == 1 else [f"out{i}" for i in range(len(outputs))]
        return [(name, x.shape, x.dtype) for name, x in zip(names, outputs, strict=True)]

    def jacobian_results(self) -> list[tuple[str, tuple[int, ...], np.dtype]]:
        """The same of the Jacobian: `result_by_argument` (size of the result, size of the argument)."""
        assert self.jacobian_program is not None
        leaves = [
            leaf if not x.is_structure else leaf._replace(name=f"{x.name}_{leaf.name}")
            for x in self.arguments
            for leaf in x.leaves
        ]
        names = [f"{result}_by_{leaf.name}" for result, _, _ in self.results() for leaf in leaves]
        return [(name, x.shape, x.dtype) for name, x in zip(names, self.jacobian_program.outputs[:-1], strict=True)]

    def comment_on(self, name: str, size: int) -> str:
        """Order and units of the entries of an argument."""
        return comment_on(name, size, self._system)

    # --- calls from Python ---

    def __call__(self, *args: PyTree) -> PyTree:
        """The function's results as numpy arrays, computed without JAX.

        **Raises:** ValueError for arguments of other shapes; FloatingPointError where the sample needs a decision about rank.
        """
        try:
            call = self._local.function
        except AttributeError:
            call = self._caller("function")
        outputs = call(args)
        return outputs[0] if self._is_one_array else jax.tree.unflatten(self._structure, outputs)

    def jacobian(self, *args: PyTree) -> tuple:
        """Derivatives (size of the result, size of the argument) of each result by each argument.

        **Returns:** of one result a tuple with one array for each array among the arguments; of several results a tuple of such.

        **Raises:** ValueError where the function was exported without derivatives; as `__call__`.
        """
        if self.jacobian_program is None:
            raise ValueError(
                f"{self.name} was exported without its Jacobian; pass derivatives=('jacobian',) to jd.export"
            )
        flat = self._caller("jacobian")(args)
        count = len(flat) // max(1, len(self.results()))
        rows = [tuple(flat[i : i + count]) for i in range(0, len(flat), count)]
        return rows[0] if len(rows) == 1 else tuple(rows)

    def _caller(self, which: str) -> Callable[[tuple], list[np.ndarray]]:
        """A function from arguments to results, with buffers of this thread, so that calls of several threads do not meet."""
        caller = getattr(self._local, which, None)
        if caller is None:
            if self._code is None:
                self._code = Code(self.module("packed"))
            program = self.program if which == "function" else self.jacobian_program
            symbol = self.name if which == "function" else f"{self.name}_jacobian"
            assert program is not None
            caller = _make_caller(self._code.address(f"{symbol}_packed"), self, program)
            setattr(self._local, which, caller)
        return caller

    def evaluate(self, which: str = "function") -> list[np.ndarray]:
        """Results, or their derivatives ("jacobian"), at the examples; NaN where the sample is degenerate."""
        try:
            return self._caller(which)(self.examples)
        except FloatingPointError:
            program = self.program if which == "function" else self.jacobian_program
            assert program is not None
            return [np.full(x.shape, np.nan, x.dtype) for x in program.outputs[:-1]]

    # --- code and files ---

    def module(self, abi: str = "c", lanes: int = 1) -> str:
        """The text of all functions, in LLVM's intermediate representation; "packed" is what calls from Python take."""
        if abi == "casadi":
            return casadi_ir(self)
        fields = fields_of(self.arguments)
        functions = [standalone.function_ir(self.name, self.program, fields)]
        if self.jacobian_program is not None:
            functions.append(standalone.function_ir(f"{self.name}_jacobian", self.jacobian_program, fields))
        if abi == "packed":
            functions += [standalone.array_call_ir(self.name, len(self.arguments), self.program)]
            if self.jacobian_program is not None:
                functions += [
                    standalone.array_call_ir(f"{self.name}_jacobian", len(self.arguments), self.jacobian_program)
                ]
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

        - `target`: "host", a short name ("x86_64", "x86_64-v3", "x86_64-v4", "aarch64", "cortex-m7", "riscv64", "wasm32"), or a
          triple of LLVM; `cpu` and `features` as LLVM writes them.
        - `abi`: "c", or "casadi" for `casadi.external(name, "./name.so")`, with exact first derivatives where the function was
          exported with its Jacobian.

        **Returns:** the folder. Either all files are written or none.

        **Raises:** ValueError for an unknown target or interface, and for a folder that cannot be written.
        """
        if abi not in ABIS:
            raise ValueError(f"abi is {abi!r}; choose from {', '.join(map(repr, ABIS))}")
        if abi == "casadi" and (self.has_structures or any(x.dtype != np.float64 for x in self.program.inputs)):
            raise ValueError(
                "abi is 'casadi', whose functions take arrays of float64: export a function of such arrays alone"
            )
        resolved = standalone.resolve_target(target, cpu, features)
        made = standalone.object_file(self.module(abi, resolved.lanes), resolved)
        return write_files(self, Path(folder), made, resolved, abi)


def _make_caller(address: int, exported: Exported, program: Program) -> Callable[[tuple], list[np.ndarray]]:
    """Buffers, and a function that copies arguments into them, calls the code at the address, and copies results out.

    To find the addresses of numpy arrays for every call would take longer than the call.
    """
    structure, name = jax.tree.structure(exported.examples), exported.name
    takes_arrays = not exported.has_structures
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
    function = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(address)
    pointer = ctypes.c_void_p(ctypes.addressof(block))
    pairs = [(leaf, leaf.shape) for leaf in leaves]

    def call(args):
        if not takes_arrays:
            args, given = jax.tree.flatten(args)
            if given != structure:
                raise ValueError(f"{name}: the arguments have the structure {given}, the examples had {structure}")
        elif len(args) != len(pairs):
            raise ValueError(f"{name} takes {len(pairs)} arguments, and was given {len(args)}")
        for (buffer, shape), x in zip(pairs, args, strict=True):
            # An assignment alone would spread a single number over the whole array.
            if (x.shape if type(x) is np.ndarray else np.shape(x)) != shape:
                raise ValueError(f"{name}: an argument has shape {np.shape(x)}, the example had {shape}")
            buffer[...] = x
        if function(pointer):
            raise FloatingPointError(
                f"{name}: the constraints lose rank at this sample, which straight-line code cannot handle; take "
                "jd.constrained_dynamics in Python there"
            )
        return [x.copy() for x in results]

    call.memory = (memory, block)  # pyright: ignore[reportFunctionMemberAccess]  # addresses alone do not keep it alive
    return call
