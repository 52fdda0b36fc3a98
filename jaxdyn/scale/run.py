"""`jd.scale.run` and `jd.scale.evaluate`: many rollouts of one-sample functions, into a store that can be gone on with."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PyTree

from jaxdyn.model.arguments import Checked, FilePath, Numbers, as_array
from jaxdyn.model.description import scene_lines
from jaxdyn.scale.batch import Cost, Options, Run, whole
from jaxdyn.scale.described import described_function, described_motion
from jaxdyn.scale.driver import STEPS
from jaxdyn.scale.members import digest, members
from jaxdyn.scale.reductions import Reduction
from jaxdyn.simulation.controls import Control
from jaxdyn.simulation.run import simulate
from jaxdyn.simulation.solvers.inputs import check_times
from jaxdyn.systems.scene import as_scene
from jaxdyn.systems.system import SceneLike

SHARE = 0.05  # of the times that are simulated to measure what a rollout costs


def run(
    scene: Checked[SceneLike | Callable[[Any], Any]],
    states: Checked[tuple[Numbers, Numbers] | Callable[[Any], tuple[Array, Array]]],
    parameters: PyTree,
    ts: Numbers,
    *,
    out: FilePath,
    samples: int | None = None,
    seed: int = 0,
    control: Control = None,
    reductions: Checked[Mapping[str, Reduction] | None] = None,
    rows: bool | Sequence[str] = True,
    cost: Cost = None,
    units: Mapping[str, str] | None = None,
    process: tuple[int, int] | None = None,
    devices: Sequence[Any] | None = None,
    lanes: int | None = None,
    chunk: int | None = None,
    memory: int | None = None,
    compress: bool = False,
    verify: bool = True,
    progress: bool = True,
    **options: Any,
) -> Run:
    """Simulate a batch of any size, block by block, into a Zarr store; started again, it goes on where it stopped.

    **Arguments:**

    - `scene`: a `Scene` or `Model` for all rollouts, or a function that builds that of one, `scene(parameters)`; it may return
      a pair (scene, control). The function is traced: parameters go into leaves (`model.replace`, arguments of a
      scene that become leaves).
    - `states`: a pair (q0, v0) of arrays, (nq,) and (nv,) for all rollouts or (samples, nq) and (samples, nv), or a function
      of one rollout, `states(parameters) -> (q0, v0)`.
    - `parameters`: None; a pytree of arrays (samples, ...), one row a rollout; or a function `draw(key)` that draws those of one
      rollout, traced: then `samples` says how many there are, and nothing is held in memory. Rollout i has the key
      `jax.random.fold_in(jax.random.key(seed), i)`, whatever blocks, devices and processes there are; `jd.scale.member` gives
      its parameters again.
    - `ts` (nt,): save points (s), `control` and further options: as in `jd.simulate`.
    - `out`: directory of the store. Its variables are those of `Solution.to_xarray` over "rollout" and t, with names and units;
      `parameter_NAME`; `result`, a code whose names are its attribute flag_meanings; `num_steps` and `time_reached` (s).
      With `cost` the coordinate `rollout` has the numbers.
    - `reductions`: a dictionary of `jd.scale.Mean`, `Histogram`, `Quantiles`, `Worst` or your own `Reduction`. Those that failed
      are left out of them. They are variables NAME_PART of the store.
    - `rows`: True to store all arrays, False for none (codes and reductions alone), or the names of those to store.
    - `cost`: a function `cost(parameters)` or an array (samples,): about how long a rollout takes, in any unit. Rollouts are
      computed and stored in the order of falling cost, so that those of one batch take about equally many steps. Or "measured",
      where nobody knows, for adaptive steps: the first twentieth of the times is simulated first, and the rollouts of a chunk
      are computed by falling steps of that; they are stored in the order of their numbers.
    - `units`: of parameters, by name.
    - `process`: (index, count) of this process among those that write to the store; by default as `jax.distributed` or the
      environment (Slurm, Open MPI, an indexed job of Kubernetes with JAXDYN_PROCESSES) says. They exchange nothing: each
      claims chunks by files beside the store, and those left by one that dies are computed by the others.
    - `devices`: of this process, all by default. `lanes`: rollouts computed at once, by default 2048 for each device of a CPU
      and fewer where there are few rollouts, or where the compiled program with its results, by XLA's account of it, does not
      fit into `memory` (bytes; by default half of what is free, shared among the processes). `chunk`: rollouts stored at
      once, and lost at most when killed; by default some two seconds' work.
    - `compress`: store arrays compressed (Zstandard); smaller, and slower.
    - `verify`: at the end look through the chunks that an earlier call has stored, and compute again what is not whole.
    - `progress`: show rate and time left on standard error.

    **Returns:** a `Run`. A rollout that fails is a row with its code and does not raise.

    Results are the same, bit for bit, whether a run was interrupted or not, and for any number of processes, devices, lanes
    and chunks on CPUs of one kind; other kinds, and GPUs, round differently in the last bit.

    **Raises:** ValueError for arguments that do not fit; for a store of another scene, version, seed, ..., with both values; for
    one that another living process writes to, with its owner; what `simulate` raises when it is traced. ImportError without
    zarr and xarray. MemoryError where not even one rollout fits. OSError where `out` cannot be written, or its disk is full: what
    was finished is kept.

    ```python
    def draw(key):
        mass, radius = jax.random.uniform(key, (2,), minval=0.3, maxval=0.7)
        return {"mass": mass, "radius": radius}


    def start(p):
        return jnp.zeros(4), jnp.stack([2.0 * p["radius"], 0.0, 1.0, 2.0])


    disks = jd.scale.run(
        lambda p: jd.scenes.rolling_disk(**p), start, draw, ts, samples=100_000, out="disks.zarr", outputs=("energy",)
    )
    ```
    """
    ts = np.asarray(as_array(ts, "ts"))
    check_times(ts)
    for name in ("throw", "progress"):
        options.pop(name, None)
    model: Any = scene
    builds = callable(scene) and jax.tree_util.all_leaves([scene])
    draw = parameters if callable(parameters) else None
    named: dict[str, Any] = {} if draw is not None or parameters is None else {"parameters": parameters}
    fixed = {}
    if not callable(states):
        if not isinstance(states, (tuple, list)) or len(states) != 2:
            raise ValueError(f"states is {states!r}; give a pair (q0, v0), or a function of the parameters")
        for name, value in zip(("q0", "v0"), states, strict=True):
            value = np.asarray(as_array(value, name))
            (named if value.ndim > 1 else fixed)[name] = value
    batch = members(named, draw, samples, seed)

    def begun(drawn: Any, row: Any) -> tuple[Any, Any, Any, Any]:
        own = drawn if draw is not None else row.get("parameters")
        built = model(own) if builds else model
        law = control
        if isinstance(built, tuple):
            built, law = built
        start: Any = states(own) if callable(states) else [(row | fixed)[name] for name in ("q0", "v0")]
        return built, law, *start

    def one(drawn: Any, row: Any) -> tuple[Any, Any, Any]:
        built, law, q0, v0 = begun(drawn, row)
        own = drawn if draw is not None else row.get("parameters")
        return simulate(built, q0, v0, ts, control=law, throw=False, **options), built, own

    def pilot(drawn: Any, row: Any) -> dict[str, Any]:
        built, law, q0, v0 = begun(drawn, row)
        early = np.array([ts[0], ts[0] + SHARE * (ts[-1] - ts[0])])
        solution = simulate(built, q0, v0, early, control=law, throw=False, **{**options, "outputs": ()})
        return {STEPS: solution.stats[STEPS]}

    if not builds:
        model = as_scene(model)
    given = {
        "ts": f"{ts[0]:g} to {ts[-1]:g} s, {len(ts)} points, {digest(ts)}",
        "scene": "built by a function" if builds else scene_lines(model),
        "outputs": list(options.get("outputs", ())),
    }
    shared = Options(
        out, reductions, rows, cost, process, devices, lanes, chunk, memory, compress, verify, progress, units or {}
    )
    adaptive = pilot if options.get("stepsize") is None else None
    return whole(
        lambda reducing: described_motion(one, batch, reducing, shared.units, ts), given, batch, shared, adaptive
    )


def evaluate(
    function: Callable[[Any], Mapping[str, Any]],
    parameters: PyTree,
    *,
    out: FilePath,
    samples: int | None = None,
    seed: int = 0,
    reductions: Checked[Mapping[str, Reduction] | None] = None,
    rows: bool | Sequence[str] = True,
    cost: Cost = None,
    units: Mapping[str, str] | None = None,
    process: tuple[int, int] | None = None,
    devices: Sequence[Any] | None = None,
    lanes: int | None = None,
    chunk: int | None = None,
    memory: int | None = None,
    compress: bool = False,
    verify: bool = True,
    progress: bool = True,
) -> Run:
    """A function of one sample for a batch of any size, as `run` does it for motions: fits from many starts, rewards, designs.

    **Arguments:** `function(parameters)`, traced, returns a dictionary of arrays, the variables of the store; one named "success"
    says whether the sample succeeded, and without it those fail that are not finite. `parameters` and all others: as in
    `run`; `units` are of parameters and of variables.

    **Returns:** a `Run`.

    **Raises:** ValueError for a function that returns no dictionary of arrays, and as `run` does.
    """
    draw = parameters if callable(parameters) else None
    batch = members({} if draw is not None else {"parameters": parameters}, draw, samples, seed)

    def one(drawn: Any, row: Any) -> tuple[Any, Any]:
        own = drawn if draw is not None else row["parameters"]
        return function(own), own

    shared = Options(
        out, reductions, rows, cost, process, devices, lanes, chunk, memory, compress, verify, progress, units or {}
    )
    return whole(lambda reducing: described_function(one, batch, reducing, shared.units), {}, batch, shared)
