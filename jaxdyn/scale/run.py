"""`jd.scale.run` and `jd.scale.evaluate`: resumable batch runs of functions of one sample."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PyTree

from jaxdyn.model.arguments import Checked, FilePath, Numbers, as_array
from jaxdyn.model.description import scene_lines
from jaxdyn.scale.batch import Options, Run, run_batch
from jaxdyn.scale.description import describe, function_values, motion_values
from jaxdyn.scale.members import digest, members
from jaxdyn.scale.reductions import Reduction
from jaxdyn.simulation.checks import check_times
from jaxdyn.simulation.controls import Control
from jaxdyn.simulation.run import simulate
from jaxdyn.systems.scene import as_scene
from jaxdyn.systems.system import SceneLike
from jaxdyn.tasks import DaskClient


@dataclass(frozen=True, eq=False)
class Rollout:
    """A rollout of `run`, as a function of its parameters (or None) and of its row of the arrays."""

    # A class, not a function within `run`: cloudpickle sends it by name, so that workers use the code of their own jaxdyn.
    scene: Any
    builds: bool
    states: Callable | None
    fixed: dict[str, np.ndarray]
    control: Any
    ts: np.ndarray
    options: dict[str, Any]

    def __call__(self, parameters: Any, row: Any) -> tuple[Any, Any]:
        """Solution and scene."""
        scene, control = self.scene(parameters) if self.builds else self.scene, self.control
        # A control with parameters of the rollout has to be built with the scene.
        if isinstance(scene, tuple):
            scene, control = scene
        q0, v0 = self.states(parameters) if self.states else ((row | self.fixed)[name] for name in ("q0", "v0"))
        return simulate(scene, q0, v0, self.ts, control=control, throw=False, **self.options), scene


def run(
    scene: Checked[SceneLike | Callable[[Any], Any]],
    states: Checked[tuple[Numbers, Numbers] | Callable[[Any], tuple[Array, Array]]],
    parameters: PyTree,
    ts: Numbers,
    *,
    out: FilePath,
    samples: int | float | None = None,
    seed: int = 0,
    control: Control = None,
    reductions: Checked[Mapping[str, Reduction] | None] = None,
    rows: bool | Sequence[str] = True,
    units: Mapping[str, str] | None = None,
    client: DaskClient | None = None,
    retries: int = 2,
    devices: Sequence[Any] | None = None,
    batch_size: int | None = None,
    chunk: int | None = None,
    progress: bool = True,
    **options: Any,
) -> Run:
    """Simulate a batch of any size, chunk by chunk, into a Zarr store; the same call resumes an interrupted run.

    **Arguments:**

    - `scene`: a `Scene` or `Model` for all rollouts, or a function that builds that of one, `scene(parameters)`; it may return
      a pair (scene, control). The function is traced: parameters go into leaves (`model.replace`, arguments of a
      scene that become leaves).
    - `states`: a pair (q0, v0) of arrays, (nq,) and (nv,) for all rollouts or (samples, nq) and (samples, nv), or a function
      of one rollout, `states(parameters) -> (q0, v0)`.
    - `parameters`: None; a pytree of arrays (samples, ...), one row per rollout; or a function `draw(key)` that draws those of
      one rollout, traced.
    - `samples`: number of rollouts where parameters are drawn, which then are not held in memory. `seed`: rollout i has the key
      `jax.random.fold_in(jax.random.key(seed), i)`, for any chunks, devices and workers (see `jd.scale.member`).
    - `ts` (nt,): save points (s), `control` and further options: as in `jd.simulate`.
    - `out`: directory of the store. Its variables are those of `Solution.to_xarray` over "rollout" and t, with names and
      units; `parameter_NAME`; `result`, a code whose names are its attribute flag_meanings; `num_steps`; `time_reached` (s).
    - `reductions`: a dictionary of `jd.scale.Mean`, `Histogram`, `Quantiles`, `Worst` or your own `Reduction`, of the rollouts
      that succeeded. They are variables NAME_PART of the store.
    - `rows`: True to store all arrays, False for none (codes and reductions alone), or the names of those to store.
    - `units`: of parameters, by name.
    - `client`: a `dask.distributed.Client`, whose workers compute the chunks; without it this process does, and Dask is not
      imported. `retries`: attempts after the first for a chunk that raises; others are finished before its error is reported.
    - `devices`: of this process, all by default; a worker uses all of its own. `batch_size`: rollouts computed at once, by
      default 2048 for each device of a CPU and fewer where there are few rollouts. It is reduced where the compiled program
      with its results, by XLA's account, exceeds half of the free memory, which the workers of a host share. `chunk`: rollouts
      stored at once, and lost at most when killed; by default two seconds of work.
    - `progress`: show rate and time left on standard error. `options`: further ones of `jd.simulate`.

    **Returns:** a `Run`. A rollout that fails is a row with its code and does not raise.

    Results are the same, bit for bit, whether a run was interrupted or not, and for any number of workers and devices and any
    sizes of batches and chunks on CPUs of one kind; other kinds, and GPUs, round differently in the last bit.

    **Raises:** ValueError for arguments that do not fit; for a store of another scene, version, seed, ..., with both values; for
    one that another process writes to, with its owner; for a cluster with other versions, or whose workers do not see `out`;
    what `simulate` raises when it is traced. ImportError without the extra `scale`. MemoryError where not even one rollout fits.
    What was finished is kept by: OSError where `out` cannot be written, or its disk is full; RuntimeError, with number and
    traceback, for a chunk that fails in every attempt; ConnectionError where the scheduler does not come back.

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
    shared = Options(out, reductions, rows, client, retries, devices, batch_size, chunk, progress)
    ts = np.asarray(as_array(ts, "ts"))
    check_times(ts)
    # `Rollout` passes `throw` itself, which given twice would be a TypeError.
    options.pop("throw", None)
    model: Any = scene
    # A function is a leaf; a scene or a model is a pytree, even if it can be called.
    builds = callable(scene) and jax.tree_util.all_leaves([scene])
    draw = parameters if callable(parameters) else None
    named: dict[str, Any] = {} if draw is not None or parameters is None else {"parameters": parameters}
    fixed = {}
    if not callable(states):
        if not isinstance(states, (tuple, list)) or len(states) != 2:
            raise ValueError(f"states is {states!r}; give a pair (q0, v0), or a function of the parameters")
        for name, value in zip(("q0", "v0"), states, strict=True):
            value = np.asarray(as_array(value, name))
            # A state for all rollouts is a constant of the program, and is not repeated for each of them.
            (named if value.ndim > 1 else fixed)[name] = value
    batch = members(named, draw, samples, seed)

    if not builds:
        model = as_scene(model)
    rollout = Rollout(model, builds, states if callable(states) else None, fixed, control, ts, options)
    given = {
        "ts": f"{ts[0]:g} to {ts[-1]:g} s, {len(ts)} points, {digest(ts)}",
        "scene": "built by a function" if builds else scene_lines(model),
        "outputs": list(options.get("outputs", ())),
    }
    return run_batch(partial(describe, partial(motion_values, rollout), batch, units or {}, ts), given, batch, shared)


def evaluate(
    function: Callable[[Any], Mapping[str, Any]],
    parameters: PyTree,
    *,
    out: FilePath,
    samples: int | float | None = None,
    seed: int = 0,
    reductions: Checked[Mapping[str, Reduction] | None] = None,
    rows: bool | Sequence[str] = True,
    units: Mapping[str, str] | None = None,
    client: DaskClient | None = None,
    retries: int = 2,
    devices: Sequence[Any] | None = None,
    batch_size: int | None = None,
    chunk: int | None = None,
    progress: bool = True,
) -> Run:
    """Evaluate a function of one sample for a batch of any size, as `run` simulates: fits from many starts, rewards, designs.

    **Arguments:** `function(parameters)`, traced, returns a dictionary of arrays, the variables of the store. One named "success"
    is true for a sample that succeeded; without it, samples with values that are not finite fail. All others are
    as in `jd.scale.run`; `units`: of parameters and of variables.

    **Returns:** a `Run`.

    **Raises:** ValueError for a function that returns no dictionary of arrays, and as `run` does.
    """
    shared = Options(out, reductions, rows, client, retries, devices, batch_size, chunk, progress)
    draw = parameters if callable(parameters) else None
    batch = members({} if draw is not None else {"parameters": parameters}, draw, samples, seed)
    return run_batch(partial(describe, partial(function_values, function), batch, units or {}, None), {}, batch, shared)
