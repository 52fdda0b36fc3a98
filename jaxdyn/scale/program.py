"""Members of a batch, and its compiled program: a function of one member, divided among the devices of this process.

A member is one rollout. Members are independent, so that devices do not communicate: `jax.shard_map` gives each its part of the
batch, and a device that has finished waits for the others only when the results are read. Each process compiles its own program;
processes have only the store in common.
"""

import contextlib
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxdyn.compile import compilation
from jaxdyn.compile.executables import glue_options
from jaxdyn.compile.jax_adapter import function_of
from jaxdyn.model.arguments import as_array, check_count, check_seed

MAX_MEMBERS = 2**32  # `fold_in` takes 32 bits


@dataclass(frozen=True)
class Members:
    """`count` members, each a pytree of its own.

    - `rows`: pytrees of arrays of numpy (count, ...), by argument; held by every process.
    - `draw`: a function from the key of a member to its parameters, or None; nothing is held. The key of member i is
      `jax.random.fold_in(jax.random.key(seed), i)`: a member depends neither on chunks nor on devices nor on processes.
    """

    count: int
    rows: dict[str, Any]
    draw: Callable | None
    seed: int

    def inputs(self, numbers: np.ndarray) -> dict[str, Any]:
        """Inputs of a program for these members, with a leading axis."""
        return {"number": numbers.astype(np.uint32), "rows": jax.tree.map(lambda x: x[numbers], self.rows)}

    def one(self, given: dict[str, Any]) -> tuple[Any, Any]:
        """Parameters (None without any) and row of one member, traced."""
        if self.draw is None:
            return given["rows"].get("parameters"), given["rows"]
        return self.draw(jax.random.fold_in(jax.random.key(self.seed), given["number"])), given["rows"]

    def description(self) -> dict[str, Any]:
        """Identity of these members, by argument."""
        seed = None if self.draw is None else self.seed
        return {"samples": self.count, "seed": seed, "values": digest(self.rows)}


def members(named: dict[str, Any], draw: Callable | None, samples: int | float | None, seed: int) -> Members:
    """Members from pytrees with equal leading axes, by the arguments that hold them, and from draws.

    **Raises:** ValueError for axes that differ, naming two arguments; for a draw without `samples`; for no members.
    """
    sizes, rows = {}, {}
    for argument, tree in named.items():
        paths, structure = jax.tree_util.tree_flatten_with_path(tree)
        leaves = {argument + jax.tree_util.keystr(path): leaf for path, leaf in paths}
        arrays = {name: np.asarray(as_array(leaf, name)) for name, leaf in leaves.items()}
        for name, array in arrays.items():
            if array.ndim == 0:
                raise ValueError(f"{name} is one number; give one for each rollout, or put it into the scene")
            sizes[name] = len(array)
        rows[argument] = jax.tree.unflatten(structure, arrays.values())
    if samples is not None:
        sizes["samples"] = check_count(samples, "samples")
    if draw is not None and samples is None:
        raise ValueError("parameters is a function that draws, and samples is None; say how many rollouts to draw")
    if not sizes:
        raise ValueError("samples is None, and no array has an axis of rollouts; say how many there are")
    (first, size), *others = sizes.items()
    for name, other in others:
        if other != size:
            raise ValueError(f"{first} is of {size} rollouts and {name} of {other}; give as many of each")
    if not 0 < size < MAX_MEMBERS:
        raise ValueError(f"{first} is of {size} rollouts; give from 1 to 2^32 - 1")
    return Members(size, rows, draw, check_seed(seed))


def member(parameters: PyTree, number: int, seed: int = 0) -> PyTree:
    """Parameters of rollout `number` of `jd.scale.run` and `jd.scale.evaluate`, to compute it again.

    **Arguments:** `parameters` and `seed` as they were passed there.

    **Raises:** ValueError for a number of a rollout or a seed that is negative or no integer.
    """
    seed = check_seed(seed)
    # As in `Members.one`, which the program of a batch traces.
    if callable(parameters):
        return parameters(jax.random.fold_in(jax.random.key(seed), jnp.uint32(number)))
    return jax.tree.map(lambda x: jnp.asarray(x)[number], parameters)


def digest(tree: Any) -> str:
    """Hash of the values, shapes and paths of a pytree of arrays."""
    # With dtypes and shapes: equal bytes of other types are other inputs.
    hashed = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        # The hash reads a buffer, which an array with strides does not have in one piece.
        array = np.ascontiguousarray(leaf)
        hashed.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape}".encode())
        hashed.update(array.data)
    # 64 bits tell inputs apart, and are short enough for an error message.
    return hashed.hexdigest()[:16]


# Members per device in one program. On a CPU larger batches do not run faster; other devices need more to be busy.
MEMBERS_PER_DEVICE = {"cpu": 2048}
MEMBERS_PER_ACCELERATOR = 16384
# Batches whose results are in memory at once: one is computed, one copied to the host, one waits to be copied.
IN_FLIGHT = 3
# Fraction of the free memory that programs and results may take.
MEMORY_FRACTION = 0.5


class Program:
    """A function of one member, compiled for `size` members at a time on these devices.

    `size` is reduced where the program does not fit into `memory` (bytes). `is_glue`: the members are motions, which are computed
    by kernels. XLA then compiles only the glue between kernels, with options that make this quick.

    Attributes: `size`, the members of a batch; `bytes`, the memory that it needs; `lowered`, a hash of the lowered program.

    **Raises:** MemoryError with the figures where not even one member for each device fits.
    """

    def __init__(self, one: "Traced", devices: Sequence[Any], size: int, memory: float, is_glue: bool = False):
        self.members, self.devices = one.members, list(devices)
        options = glue_options(self.devices[0].platform) if is_glue else None
        axis_types = (jax.sharding.AxisType.Auto,)
        mesh = jax.make_mesh((len(self.devices),), ("rollouts",), devices=self.devices, axis_types=axis_types)
        axis: Any = jax.P("rollouts")
        # `check_vma` checks values that are equal on all devices. Here every value belongs to one device.
        mapped = jax.shard_map(jax.vmap(one), mesh=mesh, in_specs=axis, out_specs=axis, check_vma=False)
        batch = jax.jit(mapped)
        minimum = len(self.devices)  # one member for each device; sizes are multiples of it
        self.size = max(minimum, -(-size // minimum) * minimum)
        while True:
            shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct((self.size, *x.shape), x.dtype), one.inputs)
            lowered = batch.lower(shapes)
            self.lowered = hashlib.sha256(lowered.as_text().encode()).hexdigest()[:16]
            self.compiled = lowered.compile(compiler_options=options)
            self.bytes = self._program_bytes()
            if self.bytes <= memory:
                break
            if self.size == minimum:
                raise MemoryError(
                    f"a program of {minimum} rollouts needs {self.bytes / 2**20:.3g} MiB, and {memory / 2**20:.3g} MiB are "
                    "allowed (half of what is free); save fewer points or outputs, or take fewer devices"
                )
            # Memory is nearly proportional to the size. A tenth less makes it likely that the next program fits. Sizes are at
            # least halved, which bounds the number of compilations.
            fitting = int(0.9 * self.size * memory / self.bytes)
            self.size = max(minimum, min(fitting, self.size // 2) // minimum * minimum)
        self._first: tuple[np.ndarray, Any] | None = None

    def start(self, numbers: np.ndarray) -> Any:
        """Start to compute the members with these numbers (n,), at most `size` of them.

        JAX returns at once, and reading the result waits for it. Rows beyond n are copies of the last member.
        """
        if self._first is not None and np.array_equal(self._first[0], numbers):
            return self._first[1]
        # An incomplete last batch is filled with copies: a program of another size would have to be compiled.
        return self.compiled(
            self.members.inputs(np.concatenate([numbers, np.repeat(numbers[-1:], self.size - len(numbers))]))
        )

    def time(self, numbers: np.ndarray, clock: Callable[[], float]) -> float:
        """Seconds that a batch takes. `start` returns the kept result when it is called with the same members."""
        before = clock()
        self._first = numbers, jax.block_until_ready(self.start(numbers))
        return clock() - before

    def _program_bytes(self) -> int:
        """Bytes of the program and of the results that are in memory at once, on all devices, as XLA reports them."""
        analysis = self.compiled.memory_analysis()
        if analysis is None:
            return 0
        # XLA reports the figures of one device.
        own = analysis.temp_size_in_bytes + analysis.argument_size_in_bytes
        return len(self.devices) * (own + IN_FLIGHT * analysis.output_size_in_bytes)


class Traced:
    """Function `one(parameters, row) -> dict of arrays`, traced once for programs of all sizes.

    `parameters` of a member are drawn or a part of `row`, its row of the given arrays (`Members`). `inputs`, `shapes`: shapes and
    dtypes of the inputs of one member, and of its arrays by name.
    """

    def __init__(self, one: Callable, members: Members):
        self.one, self.members = one, members
        self.inputs = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape[1:], jax.dtypes.canonicalize_dtype(x.dtype)),
            members.inputs(np.zeros(1, np.int64)),
        )
        # Tracing a scene and its integrator takes seconds, the largest part of the time to the first result.
        operations, self.shapes = jax.make_jaxpr(self._of_inputs, return_shape=True)(self.inputs)
        self._call = function_of(operations)
        self._structure = jax.tree.structure(self.shapes)

    def __reduce__(self) -> tuple[Any, ...]:
        return Traced, (self.one, self.members)  # a jaxpr cannot be pickled; a worker traces again

    def __call__(self, given: Any) -> dict[str, Any]:
        return jax.tree.unflatten(self._structure, self._call(*jax.tree.leaves(given)))

    def fingerprint(self) -> str:
        """Hash of the computation for one member; equal on all machines with the same versions of the packages."""
        # Without kernels: they contain machine code, whose bytes depend on the processor.
        with compilation("plain"):
            text = jax.jit(self._of_inputs).lower(self.inputs).as_text()
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _of_inputs(self, given: Any) -> dict[str, Any]:
        return self.one(*self.members.one(given))


def default_size(devices: Sequence[Any]) -> int:
    """Default number of members in a batch, on all devices together."""
    return sum(MEMBERS_PER_DEVICE.get(device.platform, MEMBERS_PER_ACCELERATOR) for device in devices)


def available_memory(devices: Sequence[Any]) -> int:
    """Free memory in bytes: that of the devices if they report it, else the lesser of the host's and the process's cgroup's."""
    all_stats = [device.memory_stats() for device in devices]
    if all(stats and "bytes_limit" in stats for stats in all_stats):
        return sum(stats["bytes_limit"] - stats.get("bytes_in_use", 0) for stats in all_stats)
    free = []
    with contextlib.suppress(OSError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    with contextlib.suppress(OSError, ValueError):  # no cgroup, or one whose limit is "max"
        limit, used = (
            int(Path(f"/sys/fs/cgroup/memory.{name}").read_text(encoding="ascii")) for name in ("max", "current")
        )
        free.append(limit - used)
    return min(free, default=2**31)  # a cautious 2 GiB on systems with neither file, such as macOS
