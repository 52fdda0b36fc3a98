"""Replay of logs: simulation of segments under the measured torques, and its error against the measured motion."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.mechanisms import FitSystem, on_constraints
from jaxdyn.identify.torque_terms import Friction
from jaxdyn.model.arguments import Checked, Number, state_dtype
from jaxdyn.model.tree import Model
from jaxdyn.simulation.options import pack_steps
from jaxdyn.simulation.run import simulate
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import displace, displacement

HOLDS = ("linear", "previous")
INITIAL = ("measured", "free")


class SampledTorque(eqx.Module):
    """Control that replays torques: linear between the samples, or held from each sample to the next ("previous").

    Fixed steps that end on the samples integrate held torques exactly, as these are constant within a step.

    `t` (n,) s; `tau` (n, nv) N m.
    """

    t: Float[Array, " n"]
    tau: Float[Array, "n nv"]
    hold: str = eqx.field(static=True, default="linear")

    def __call__(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, " nv"]:
        return self.at(t)

    def at(self, t: Number) -> Float[Array, " nv"]:
        """Torque (nv,) at a time (s); before the first sample and after the last one that of these."""
        last = self.t.shape[0] - 2
        # Clipped to the last interval: otherwise both indices clamp to the last sample at the end, and 0/0 enters the gradient.
        i = jnp.clip(jnp.searchsorted(self.t, t, side="right") - 1, 0, last)
        if self.hold == "previous":
            return self.tau[i]
        share = jnp.clip((t - self.t[i]) / (self.t[i + 1] - self.t[i]), 0, 1)
        return self.tau[i] + share * (self.tau[i + 1] - self.tau[i])


class Segments(eqx.Module):
    """Segments of a log, simulated in one batch; each starts on the last sample of the previous one.

    Under `jax.vmap` it is one segment, without the first axis. `smoothing`: change of the column of Coulomb friction by the
    low-pass of the log, for errors of torques.
    """

    t: Float[Array | np.ndarray, "*segments n"]
    q: Float[Array | np.ndarray, "*segments n nq"]
    v: Float[Array | np.ndarray, "*segments n nv"]
    tau: Float[Array | np.ndarray, "*segments n nv"]
    a: Float[Array | np.ndarray, "*segments n nv"] | None = None
    smoothing: Float[Array | np.ndarray, "*segments n nv"] | None = None


def segments(log: Log | Sequence[Log], horizon: int | None, dtype, *, restart: bool = True) -> Segments:
    """Segments in arrays of JAX; arguments as of `cut_segments`."""
    return jax.tree.map(jnp.asarray, cut_segments(log, horizon, dtype, restart=restart))


def cut_segments(log: Log | Sequence[Log], horizon: int | None, dtype, *, restart: bool = True) -> Segments:
    """Cut a log, or each of several, into segments of `horizon` steps (None: one); remaining samples at an end are not used.

    Time starts at zero in each, or is that of the log (`restart=False`), for systems that depend on it.

    **Raises:** ValueError for a log without velocities, a horizon that does not fit, or none for logs of unequal length.
    """
    logs = as_logs(log)
    lengths = sorted({len(one) for one in logs})
    if horizon is None and len(lengths) > 1:
        raise ValueError(
            f"horizon is None, which uses whole logs, and they have {lengths[0]} to {lengths[-1]} samples; give the steps "
            "of a segment"
        )
    # Segments are concatenated: all of them have accelerations, or none.
    if any(one.a is None for one in logs):
        logs = [dataclasses.replace(one, a=None) for one in logs]
    parts = [_segments(one, horizon, dtype, restart) for one in logs]
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)


def _segments(log: Log, horizon: int | None, dtype, restart: bool) -> Segments:
    if log.v is None:
        raise ValueError(
            "the log has no v; a simulation starts from velocities: measure them or use jd.identify.from_raw"
        )
    if len(log) < 2:
        raise ValueError(
            f"the log has {len(log)} sample; a motion is replayed from one sample to the next, so log two or more"
        )
    horizon = len(log) - 1 if horizon is None else int(horizon)
    if not 1 <= horizon <= len(log) - 1:
        raise ValueError(f"horizon={horizon} steps; a log of {len(log)} samples allows 1 to {len(log) - 1}")
    count = (len(log) - 1) // horizon
    rows = np.arange(count)[:, None] * horizon + np.arange(horizon + 1)
    # The start is subtracted in float64: float32 time stamps of a long log do not resolve a sample.
    t = np.asarray(log.t, np.float64)[rows]
    parts = [t - t[:, :1] if restart else t, *(np.asarray(x)[rows] for x in (log.q, log.v, log.tau))]
    parts += [] if log.a is None else [np.asarray(log.a)[rows]]
    return Segments(*(np.asarray(part, dtype) for part in parts))


def rollout(
    system: FitSystem,
    log: Log,
    friction: Checked[Friction | None] = None,
    *,
    horizon: Checked[int | None] = None,
    hold: Checked[str] = "linear",
    substeps: Checked[int | None] = None,
    **simulation: Any,
) -> tuple[Array, Array]:
    """Simulate a log's segments with its torques from its measured states: q (segments, n, nq) and v (segments, n, nv).

    `system` is a `Model`, another system or a `Scene`; `friction` an additional force. The other arguments are as in `Objective`,
    `simulation` by its options' own names. The time of a `Model` starts at zero in every segment, that of anything else is the
    log's.
    """
    check_replay(INITIAL[0], hold)
    scene, data = scene_and_segments(system, log, horizon, friction)
    return _rollout(scene, data, hold, with_even_steps(simulation_options(substeps, simulation), data))


def trajectory_error(
    system: FitSystem,
    log: Log,
    friction: Checked[Friction | None] = None,
    *,
    horizon: Checked[int | None] = None,
    hold: Checked[str] = "linear",
    substeps: Checked[int | None] = None,
    **simulation: Any,
) -> tuple[float, float]:
    r"""Error of the simulated motion along a log, of positions and of velocities, each in per cent of the motion.

    $$100 \sqrt{\operatorname{mean}((q_\mathrm{sim} - q)^2 / q_\mathrm{rms}^2)}$$

    and the same of v. Arguments as in `rollout`.
    """
    q, v = rollout(system, log, friction, horizon=horizon, hold=hold, substeps=substeps, **simulation)
    scene, data = scene_and_segments(system, log, horizon, friction)
    errors = _segment_errors(scene.system, data, q, v, motion_scale(scene.system, data))
    of_q, of_v = (100 * float(jnp.sqrt(jnp.mean(error**2))) for error in errors)
    return of_q, of_v


def scene_and_segments(
    system: Any, log: Log | Sequence[Log], horizon: int | None, friction: Any = None
) -> tuple[Scene, Segments]:
    """Scene of a system, with one more force, and the segments of a log for it."""
    scene = as_scene(system)
    log = as_logs(log, scene.system, needs=("v",))
    if friction is not None:
        scene = Scene(scene.system, scene.constraints, (*scene.forces, friction))
    return scene, segments(log, horizon, state_dtype(scene.system), restart=isinstance(system, Model))


def check_replay(initial: str, hold: str) -> None:
    """Check the initial states of segments and the interpolation of torques. **Raises:** ValueError for unknown ones."""
    for name, value, allowed in (("initial", initial, INITIAL), ("hold", hold, HOLDS)):
        if value not in allowed:
            raise ValueError(f"{name} is {value!r}; give one of {allowed}")


def simulation_options(substeps: int | None, simulation: dict) -> dict:
    """Options of `simulate_segment`: those of `jd.simulate`, and `substeps` between two samples unless it is None.

    **Raises:** ValueError for substeps that are no positive integer, or a `stepsize` in addition to them.
    """
    if substeps is None:
        return dict(simulation)
    if isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1:
        raise ValueError(f"substeps is {substeps!r}; give a positive integer, or None for adaptive steps")
    if "stepsize" in simulation:
        raise ValueError("substeps and stepsize both say how to step; give one of them")
    return {"solver": diffrax.Tsit5(), "substeps": substeps} | simulation


def check_spacing(options: dict, devices: Any) -> None:
    """Check that `substeps` on several devices have evenly spaced samples.

    **Raises:** ValueError otherwise: diffrax's loops, which make uneven steps, are not differentiable on several devices.
    """
    if devices is not None and "substeps" in options:
        raise ValueError(
            f"substeps is {options['substeps']}, devices are given, and the log's samples are not evenly spaced; take "
            "substeps=None, or interpolate the log to even times"
        )


def with_even_steps(options: dict, data: Segments) -> dict:
    """Options with a constant step size in place of `substeps` where samples are evenly spaced, up to rounding.

    Steps then end on the samples too, and are compiled to native code.
    """
    t = np.asarray(data.t, np.float64)
    # Gaps inherit the rounding of the times themselves, not that of their own size.
    gaps, rounding = np.diff(t, axis=1), 8 * float(jnp.finfo(data.t.dtype).eps) * np.abs(t).max()
    if "substeps" not in options or np.ptp(gaps) > rounding:
        return options
    options = dict(options)
    count = gaps.shape[1] * options.pop("substeps")
    # The number of steps is rounded up, and their length then follows from it.
    return {"max_steps": count + 1} | options | {"stepsize": float(np.ptp(t[0])) / (count - 0.5)}


def simulate_segment(
    scene: Scene,
    one: Segments,
    change: Float[Array, "2 nv"] | None,
    hold: str,
    options: dict,
    *,
    control: Any = None,
    outputs: tuple[str, ...] = (),
    observed: tuple[int, ...] | None = None,
) -> tuple[Any, ...]:
    """Motion (n, nq), (n, nv) of one segment from its initial state, displaced by `change`; NaN from a failure on.

    Under its torques, or under a `control`. `outputs`: of `jd.simulate`, which are appended. With constraints the initial
    state is projected onto them, near the `observed` coordinates (`on_constraints`).
    """
    t: Any = one.t
    given = dict(options)
    substeps = given.pop("substeps", None)
    if substeps is not None:
        shares = jnp.arange(substeps, dtype=t.dtype) / substeps
        steps = t[:-1, None] + (t[1:] - t[:-1])[:, None] * shares[None, :]
        given.setdefault("max_steps", steps.size + 1)
        # The last time is taken from the log: recomputed from steps it could miss the sample by rounding.
        given["stepsize"] = diffrax.StepTo(ts=jnp.append(steps.reshape(-1), t[-1]))
    q0, v0 = one.q[0], one.v[0]
    if change is not None:
        # On the manifold, so that quaternions keep unit length.
        q0, v0 = displace(scene.system, q0, change[0]), v0 + change[1]
    if scene.constraints:
        state = on_constraints(scene, q0, v0, t[0], observed)
        # NaN, and no motion from a state that is not the one asked for.
        q0, v0 = (jnp.where(state.success, x, jnp.nan) for x in (state.q, state.v))
    control = SampledTorque(t, jnp.asarray(one.tau), hold) if control is None else control
    # No exception under jax.vmap: one failed segment must not end the others.
    motion = simulate(scene, q0, v0, t, control=control, outputs=outputs, throw=False, **pack_steps(given))
    return motion.q, motion.v, *(getattr(motion, name) for name in outputs)


def motion_errors(system: Any, one: Segments, q: Float[Array, "n nq"], v: Float[Array, "n nv"], scale):
    """Errors of the positions and of the velocities of one segment, each (n, nv), in units of `scale` (2, nv)."""
    far = jax.vmap(lambda a, b: displacement(system, a, b))(one.q, q)
    return far / scale[0][None], (v - one.v) / scale[1][None]


@eqx.filter_jit
def motion_scale(system: Any, data: Segments) -> Float[Array, "2 nv"]:
    """Root mean squares of each coordinate's displacement from the start and of its velocity; the largest for one at rest."""
    path = jax.vmap(jax.vmap(lambda q: displacement(system, data.q[0, 0], q)))(data.q)
    return jnp.stack([moving_scale(jnp.sqrt(jnp.mean(x**2, axis=(0, 1)))) for x in (path, data.v)])


def moving_scale(scale: Float[Array, " n"]) -> Float[Array, " n"]:
    """Scales safe to divide by: those below a thousandth of the largest are replaced by it, and by one where all are zero."""
    # The noise of a coordinate at rest, in units of itself, would count as much as a motion.
    largest = jnp.max(scale, keepdims=True)
    return jnp.where(scale > 1e-3 * largest, scale, jnp.where(largest > 0, largest, jnp.ones_like(largest)))


@eqx.filter_jit
def _rollout(scene: Scene, data: Segments, hold: str, options: dict):
    return jax.vmap(lambda one: simulate_segment(scene, one, None, hold, options))(data)


@eqx.filter_jit
def _segment_errors(system, data: Segments, q, v, scale):
    return jax.vmap(lambda one, q, v: motion_errors(system, one, q, v, scale))(data, q, v)
