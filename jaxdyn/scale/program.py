"""Program of a batch: a function of one member, mapped over a batch that is shared among the devices of this process.

Members are independent, so that a program has no communication: `jax.shard_map` gives each device its part of the batch, and a
device that is done waits for the others only when the results are read. Processes share a store and no program.
"""

import contextlib
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyn.compile import compilation
from jaxdyn.compile.calls import function_of, glue_options
from jaxdyn.scale.members import Members

BATCH = {"cpu": 2048}  # members of a device in one program: more do not run faster there
BATCH_ELSEWHERE = 16384
IN_FLIGHT = 3  # batches whose results are in memory at once: computed, copied, waiting to be
SHARE = 0.5  # of the free memory, for programs and results


class Program:
    """A function of one member, compiled for `size` members at a time on these devices.

    `size` is lowered where such a program does not fit into `memory` (bytes). `is_glue`: the members are motions, which kernels
    compute, so that XLA may spend less effort on the operations between them.

    **Raises:** MemoryError with the figures where not even one member for each device fits.
    """

    def __init__(
        self,
        one: "Traced",
        members: Members,
        devices: Sequence[Any],
        size: int,
        memory: int | None,
        is_glue: bool = False,
    ):
        self.members, self.devices = members, list(devices)
        options = glue_options(self.devices[0].platform) if is_glue else None
        kinds = (jax.sharding.AxisType.Auto,)
        mesh = jax.make_mesh((len(self.devices),), ("rollouts",), devices=self.devices, axis_types=kinds)
        # No value is the same on all devices: the check for such values would find nothing.
        shares: Any = {"mesh": mesh, "in_specs": jax.P("rollouts"), "out_specs": jax.P("rollouts"), "check_vma": False}
        batch = jax.jit(jax.shard_map(jax.vmap(one), **shares))
        least = len(self.devices)
        self.size = max(least, -(-size // least) * least)
        budget = available_memory(self.devices) * SHARE if memory is None else memory
        while True:
            lowered = batch.lower(jax.tree.map(self._batch_shape, member_shapes(members)))
            self.lowered = hashlib.sha256(lowered.as_text().encode()).hexdigest()[:16]
            self.compiled = lowered.compile(compiler_options=options)
            self.bytes = self._program_bytes()
            if self.bytes <= budget:
                break
            if self.size == least:
                raise MemoryError(
                    f"a program of {least} rollouts needs {self.bytes / 2**20:.3g} MiB, and {budget / 2**20:.3g} MiB are allowed "
                    "(memory=, or half of what is free); save fewer points or outputs, or take fewer devices"
                )
            # Memory is about proportional to the size; a tenth less, so that the next program fits most often.
            fitting = int(0.9 * self.size * budget / self.bytes)
            self.size = max(least, min(fitting, self.size // 2) // least * least)
        self._first: tuple[np.ndarray, Any] | None = None

    def start(self, numbers: np.ndarray) -> Any:
        """Begin to compute these members, at most `size`; reading the result waits for it."""
        if self._first is not None and np.array_equal(self._first[0], numbers):
            return self._first[1]
        # A last batch is filled up by repeating a member: a program of another size would be another compilation.
        return self.compiled(
            self.members.inputs(np.concatenate([numbers, np.repeat(numbers[-1:], self.size - len(numbers))]))
        )

    def time(self, numbers: np.ndarray, clock: Callable[[], float]) -> float:
        """Seconds of a batch; its result is kept for the next call with these members."""
        before = clock()
        self._first = numbers, jax.block_until_ready(self.start(numbers))
        return clock() - before

    def _batch_shape(self, one: Any) -> Any:
        return jax.ShapeDtypeStruct((self.size, *one.shape), one.dtype)

    def _program_bytes(self) -> int:
        """Bytes of the program and of the results that are in memory at once, on all devices, by XLA's own account."""
        analysis = self.compiled.memory_analysis()
        if analysis is None:
            return 0
        # XLA's figures are those of one device.
        own = analysis.temp_size_in_bytes + analysis.argument_size_in_bytes
        return len(self.devices) * (own + IN_FLIGHT * analysis.output_size_in_bytes)


class Traced:
    """`one(drawn, row) -> dict of arrays`, traced once: programs of several sizes do not run its Python again.

    `shapes`: shapes and dtypes of the arrays of one member, by name.
    """

    def __init__(self, one: Callable, members: Members):
        self._origin = one, members
        # Tracing a scene and its integrator takes seconds, and is the largest part of the start.
        trace = jax.make_jaxpr(lambda given: one(*members.one(given)), return_shape=True)
        operations, self.shapes = trace(member_shapes(members))
        self._call = function_of(operations)
        self._structure = jax.tree.structure(self.shapes)

    def __reduce__(self) -> tuple[Any, ...]:
        return Traced, self._origin  # a jaxpr cannot be pickled; a worker traces again

    def __call__(self, given: Any) -> dict[str, Any]:
        return jax.tree.unflatten(self._structure, self._call(*jax.tree.leaves(given)))


def member_shapes(members: Members) -> Any:
    """Shapes and dtypes of the inputs of one member."""
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape[1:], jax.dtypes.canonicalize_dtype(x.dtype)),
        members.inputs(np.zeros(1, np.int64)),
    )


def fingerprint(one: Callable, members: Members) -> str:
    """Hash of the computation for one member, by operations of JAX alone: equal on every machine with these versions."""
    # Kernels contain machine code, whose bytes depend on the processor.
    with compilation("plain"):
        text = jax.jit(lambda given: one(*members.one(given))).lower(member_shapes(members)).as_text()
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def default_size(devices: Sequence[Any]) -> int:
    """Members of a batch on all devices together."""
    return sum(BATCH.get(device.platform, BATCH_ELSEWHERE) for device in devices)


def available_memory(devices: Sequence[Any]) -> int:
    """Free memory, bytes: of the devices where they report it, else of the host and of the cgroup of this process."""
    reports = [device.memory_stats() for device in devices]
    if all(one and "bytes_limit" in one for one in reports):
        return sum(one["bytes_limit"] - one.get("bytes_in_use", 0) for one in reports)
    free = []
    with contextlib.suppress(OSError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    with contextlib.suppress(OSError, ValueError):  # no cgroup, or one whose limit is "max"
        limit, used = (
            int(Path(f"/sys/fs/cgroup/memory.{name}").read_text(encoding="ascii")) for name in ("max", "current")
        )
        free.append(limit - used)
    return min(free, default=2**31)
