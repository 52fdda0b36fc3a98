"""The program of a batch: a function of one member, mapped over lanes and shared among the devices of this process.

Members do not know of each other, so a program has no communication at all: `jax.shard_map` gives each device its lanes, and a
device whose lanes are done waits for nobody until the batch is read. Processes share a store and no program.
"""

import hashlib
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyn.compile import compilation
from jaxdyn.compile.calls import function_of, glue_options
from jaxdyn.scale.members import Members

logger = logging.getLogger("jaxdyn")
LANES = {"cpu": 2048}  # lanes of a device in one program: more do not run faster there
LANES_ELSEWHERE = 16384
IN_FLIGHT = 3  # batches whose results are in memory at once: computed, copied, waiting to be
SHARE = 0.5  # of the memory that is free, for programs and results


class Program:
    """A function of one member, compiled for `lanes` members at a time on these devices.

    `lanes` may be lowered where a program of so many does not fit into `memory` (bytes). `is_glue`: what is computed are motions,
    whose numbers kernels compute, so that XLA need not work hard at what stands between them.

    **Raises:** MemoryError with the figures where not even one lane for each device fits.
    """

    def __init__(
        self,
        one: "Traced",
        members: Members,
        devices: Sequence[Any],
        lanes: int,
        memory: int | None,
        is_glue: bool = False,
    ):
        self.members, self.devices = members, list(devices)
        self._options = glue_options(self.devices[0].platform) if is_glue else None
        mesh = jax.make_mesh(
            (len(self.devices),), ("rollouts",), devices=self.devices, axis_types=(jax.sharding.AxisType.Auto,)
        )
        # Whether a value is the same on all devices is not looked at: nothing is.
        self._batch = jax.jit(
            jax.shard_map(
                jax.vmap(one),
                mesh=mesh,
                in_specs=jax.P("rollouts"),
                out_specs=jax.P("rollouts"),
                check_vma=False,
            )
        )
        least = len(self.devices)
        self.lanes = max(least, -(-lanes // least) * least)
        budget = available_memory(self.devices) * SHARE if memory is None else memory
        while True:
            lowered = self._batch.lower(self._inputs_of(self.lanes))
            self.lowered = hashlib.sha256(lowered.as_text().encode()).hexdigest()[:16]
            self.compiled = lowered.compile(compiler_options=self._options)
            self.bytes = self._memory_needed()
            if self.bytes <= budget:
                break
            if self.lanes == least:
                raise MemoryError(
                    f"a program of {least} rollouts needs {self.bytes / 2**20:.3g} MiB, and {budget / 2**20:.3g} MiB are allowed "
                    "(memory=, or half of what is free); save fewer points or outputs, or take fewer devices"
                )
            fitting = int(0.9 * self.lanes * budget / self.bytes)
            self.lanes = max(least, min(fitting, self.lanes // 2) // least * least)
        self._first: tuple[np.ndarray, Any] | None = None

    def start(self, numbers: np.ndarray) -> Any:
        """Begin to compute these members, at most `lanes`; `result` waits for it."""
        if self._first is not None and np.array_equal(self._first[0], numbers):
            return self._first[1]
        filled = np.concatenate([numbers, np.repeat(numbers[-1:], self.lanes - len(numbers))])
        return self.compiled(self.members.inputs(filled))

    def time(self, numbers: np.ndarray, clock: Callable[[], float]) -> float:
        """Seconds of a batch; what it computes is kept for when these members are asked for again."""
        before = clock()
        self._first = numbers, jax.block_until_ready(self.start(numbers))
        return clock() - before

    def _inputs_of(self, lanes: int) -> Any:
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct((lanes, *x.shape), x.dtype), member_shapes(self.members))

    def _memory_needed(self) -> int:
        """Bytes of the program and of the results that are in memory at once, on all devices, by XLA's own account."""
        analysis = self.compiled.memory_analysis()
        if analysis is None:
            return 0
        own = analysis.temp_size_in_bytes + analysis.argument_size_in_bytes
        return len(self.devices) * (own + IN_FLIGHT * analysis.output_size_in_bytes)


class Traced:
    """`one(drawn, row) -> dict of arrays`, traced once: its operations are mapped over lanes without running its Python again.

    `shapes`: shapes and dtypes of what one member gives, by name.
    """

    def __init__(self, one: Callable, members: Members):
        self._origin = one, members
        trace = jax.make_jaxpr(lambda given: one(*members.one(given)), return_shape=True)
        operations, self.shapes = trace(member_shapes(members))
        self._call = function_of(operations)
        self._structure = jax.tree.structure(self.shapes)

    def __reduce__(self) -> tuple[Any, ...]:
        return Traced, self._origin  # what is traced cannot be sent, so that a worker traces it again

    def __call__(self, given: Any) -> dict[str, Any]:
        return jax.tree.unflatten(self._structure, self._call(*jax.tree.leaves(given)))


def member_shapes(members: Members) -> Any:
    """Shapes and dtypes of what the function of one member takes."""
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape[1:], jax.dtypes.canonicalize_dtype(x.dtype)),
        members.inputs(np.zeros(1, np.int64)),
    )


def fingerprint(one: Callable, members: Members) -> str:
    """A hash of what is computed for one member, by operations of JAX alone: the same on every machine with these versions."""
    with compilation("plain"):
        text = jax.jit(lambda given: one(*members.one(given))).lower(member_shapes(members)).as_text()
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def default_lanes(devices: Sequence[Any]) -> int:
    """Lanes of all devices together."""
    return sum(LANES.get(device.platform, LANES_ELSEWHERE) for device in devices)


def available_memory(devices: Sequence[Any]) -> int:
    """Bytes that are free: of the devices where they say, else of the host and of the cgroup that this process is in."""
    told = [device.memory_stats() for device in devices]
    if all(x and "bytes_limit" in x for x in told):
        return sum(x["bytes_limit"] - x.get("bytes_in_use", 0) for x in told)
    free = [_meminfo(), _of_group()]
    return min((x for x in free if x is not None), default=2**31)


def _meminfo() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    available = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    return int(available[0]) * 1024 if available else None


def _of_group() -> int | None:
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii").strip()
        used = Path("/sys/fs/cgroup/memory.current").read_text(encoding="ascii")
    except OSError:
        return None
    return None if limit == "max" else int(limit) - int(used)
