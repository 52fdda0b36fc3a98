"""Scenes along logs: segments, their simulation under the logged torques, torques that a scene needs, and results of fits."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.codes import Outcome, name_of
from jaxdyn.constraints.redundancy import add_constraints
from jaxdyn.dynamics import quantities as dynamics
from jaxdyn.forces.elements import as_leaf
from jaxdyn.identify.logs import Log, as_logs, check_log
from jaxdyn.identify.mechanisms import FitSystem, Measured, build_scene, motor_basis, on_constraints
from jaxdyn.identify.regression import torque_error
from jaxdyn.identify.torque_terms import ExtraTorque, Friction, friction_of, smoothing_by_filter
from jaxdyn.model.arguments import Checked, Number, state_dtype
from jaxdyn.model.description import short, table
from jaxdyn.model.tree import Model
from jaxdyn.simulation.options import pack_steps
from jaxdyn.simulation.run import simulate
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import displace, displacement

HOLDS = ("linear", "previous")
INITIAL = ("measured", "free")


class SampledTorque(eqx.Module):
    """Control that replays torques: linear between the samples, or held from each sample to the next ("previous").

    Fixed steps, a whole number of which fills the time between two samples, integrate held torques exactly: these are constant
    within a step.

    `t` (n,) s; `tau` (n, nv) N m.
    """

    t: Float[Array, " n"] = eqx.field(converter=as_leaf("SampledTorque: t"))
    tau: Float[Array, "n nv"] = eqx.field(converter=as_leaf("SampledTorque: tau"))
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
    return _replay(system, log, friction, horizon, hold, simulation_options(substeps, simulation))[2:]


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
    scene, data, q, v = _replay(system, log, friction, horizon, hold, simulation_options(substeps, simulation))
    errors = _segment_errors(scene.system, data, q, v, motion_scale(scene.system, data))
    of_q, of_v = (100 * float(jnp.sqrt(jnp.mean(error**2))) for error in errors)
    return of_q, of_v


def _replay(system: Any, log: Log, friction, horizon: int | None, hold: str, options: dict):
    """Scene of a system, with one more force, the segments of a log for it, and their simulated q and v."""
    check_replay(INITIAL[0], hold)
    scene = as_scene(system)
    logs = as_logs(log, scene.system, needs=("v",))
    if friction is not None:
        scene = add_constraints(scene, (), (*scene.forces, friction))
    data = segments(logs, horizon, state_dtype(scene.system), restart=isinstance(system, Model))
    return scene, data, *_rollout(scene, data, hold, with_even_steps(options, data))


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
    return {"max_steps": count + 1} | options | {"stepsize": float(np.ptp(t[0])) / count}


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


class Fit(Outcome):
    """Result of a fit: of a robot by its torques (`fit_torques`, `fit_robot`), or of any numbers (`fit_parameters`).

    - `system`: the system or the scene with the fitted numbers, of a robot by its torques the scene of `model` and `friction`;
      `nominal`: as given, where the fit started. `scene`: of the system, with its forces.
    - `names` (p,): of the fitted numbers, of a robot as of `parameter_names`, else their paths within the system, as in
      "parameters['mass']". `values`, `nominal_values` (p,).
    - `deviation` (p,): standard deviation of each, infinite for numbers that the log does not determine, None where the method
      computes none (`RobotFit.intervals` has those of a robot): the larger of that for independent errors of one size, and of a
      delete-a-group jackknife, whose groups are consecutive samples twice as long as the autocorrelation time, or whole logs
      where there are twenty or more. `factor`: a 95 % interval is plus and minus this many of them (Student's t).
    - `history` (steps,): loss before each step and at the end. `result`: one of `RESULTS`, `successful` where it has
      converged, else `max_steps_reached`, `stopped`, `no_descent` where no step lowers the loss at a point that is no minimum, or
      `nonfinite`; `cause` then names the log, the sample and the parameters.
    - `motors`: indices in v of the observed coordinates, where the fit named them; `torques` of a mechanism are theirs.
    - `terms`: names of the fitted torque terms. `sigma`: torque noise (N m) that weighed the data against the prior, or None.
    - `extra`: fitted torque terms beyond `friction`, or None. They belong to logs, and are no force of the scene.
    - `as_measured`: whether friction was fitted, and is predicted, as the low-pass of a log leaves it (`from_raw`).
    """

    system: Any
    nominal: Any
    names: tuple[str, ...] = eqx.field(static=True)
    values: np.ndarray
    nominal_values: np.ndarray
    history: np.ndarray
    result: Any
    method: str = eqx.field(static=True)
    deviation: np.ndarray | None = None
    factor: float = np.nan
    cause: str | None = eqx.field(static=True, default=None)
    motors: tuple[int, ...] | None = eqx.field(static=True, default=None)
    terms: tuple[str, ...] = eqx.field(static=True, default=())
    sigma: float | None = None
    extra: ExtraTorque | None = None
    as_measured: bool = eqx.field(static=True, default=False)

    def __str__(self) -> str:
        half = np.full(len(self.names), np.nan) if self.deviation is None else self.factor * self.deviation
        columns = zip(self.names, self.nominal_values, self.values, half, strict=True)
        rows = [[name, *(short(float(x)) for x in numbers)] for name, *numbers in columns]
        losses = [short(float(loss)) for loss in (self.history[0], self.history[-1])]
        head = f"Fit: {self.method}, {self.result.message}, loss {' to '.join(losses)} in {len(self.history) - 1} steps"
        return f"{head}\n{table(['number', 'nominal', 'fitted', '+- 95 %'], rows)}"

    @property
    def scene(self) -> Scene:
        """Fitted scene; of a system, its scene without constraints and forces."""
        return build_scene(self.system)

    @property
    def model(self) -> Model:
        """Fitted model, with its inertias, armature, damping and friction."""
        return self.scene.system

    @property
    def friction(self) -> Friction:
        """Fitted friction law, with its offset: a force for `Scene(fit.model, forces=[fit.friction])`."""
        return friction_of(self.scene)

    def torques(self, log: Log) -> np.ndarray:
        """Torques (n, nv) that the fitted system needs along a log, in the log's units: as its sensors would measure them.

        With its friction and all extra terms (N m, N), over and above the other forces of the scene.
        """
        torque = torques_along(self.scene, log, self.motors)
        if self.as_measured:
            torque = torque + np.asarray(self.friction.coulomb) * smoothing_by_filter(self.scene, log)
        if isinstance(self.system, Measured):
            bias, gain = (np.asarray(x, np.float64) for x in (self.system.torque_bias, self.system.torque_gain))
            torque = (torque - bias) / gain
        if self.extra is None:
            return torque
        # Without friction: the load of the gears is the torque of bodies and rotors, as in the fit.
        load = torques_along(Scene(self.model), log) if self.extra.needs_load else np.zeros_like(torque)
        return torque + self.extra.torque(log, load)

    def error(self, log: Log) -> float:
        """Torque error along a log in per cent, 100 |tau_fit - tau| / |tau| over all samples and joints."""
        return torque_error(self.torques(log), log.tau)

    def rms(self, log: Log) -> np.ndarray:
        """Root mean square of the torque error of each coordinate (nv,)."""
        return np.sqrt(np.mean((self.torques(log) - np.asarray(log.tau)) ** 2, axis=0))

    @property
    def vector(self) -> np.ndarray:
        """All parameters x (10 nb + 4 nv,) of a robot in the order of `jd.identify.parameter_names(model)`."""
        model, friction = self.model, self.friction
        rotors = np.zeros(model.nv) if model.armature is None else model.armature
        parts = (model.inertias, friction.viscous, friction.coulomb, friction.offset, rotors)
        return np.concatenate([np.asarray(part, np.float64).reshape(-1) for part in parts])

    @property
    def parameters(self) -> list[tuple[str, float, float, float]]:
        """Rows (name, nominal, fitted, standard deviation), the last NaN where the method computes none.

        Of single inertial numbers only combinations are identifiable (`base_parameters`); the prior determines the rest.
        """
        deviation = np.full_like(self.values, np.nan) if self.deviation is None else self.deviation
        columns = (self.nominal_values, self.values, deviation)
        return list(zip(self.names, *(column.tolist() for column in columns), strict=True))

    def summary(self, *logs: Log) -> str:
        """Summary of the fit: how it ended, the error on each log given, and the parameters."""
        system = self.scene.system
        lines = [
            f"{self.method}, {system.name if isinstance(system, Model) else type(system).__name__}: {name_of(self.result)} after "
            f"{len(self.history) - 1} steps, loss {self.history[0]:.6g} -> {self.history[-1]:.6g}"
        ]
        for i, log in enumerate(logs):
            per_joint = ", ".join(f"{x:.3g}" for x in self.rms(log))
            lines.append(
                f"log {i + 1}: {len(log)} samples, torque error {self.error(log):.3f} %, rms per joint {per_joint}"
            )
        columns = ("nominal", "fitted") if self.deviation is None else ("nominal", "fitted", "std")
        width = max(map(len, self.names), default=0)
        lines.append(f"{'parameter':{width}}" + "".join(f"  {column:>12}" for column in columns))
        for name, *numbers in self.parameters:
            lines.append(f"{name:{width}}" + "".join(f"  {x:12.5g}" for x in numbers[: len(columns)]))
        return "\n".join(lines)


def residuals(fit: Any, logs: Sequence[Log]) -> list[np.ndarray]:
    """Errors (n, nv) of the torques of a fit along each of some logs."""
    return [fit.torques(log) - np.asarray(log.tau, np.float64) for log in logs]


def torques_along(scene: Scene, log: Log, motors: tuple[int, ...] | None = None) -> np.ndarray:
    """Torques (n, nv) that a scene needs along a log; of a mechanism those of its `motors`, zero elsewhere.

    **Raises:** ValueError for a log that does not fit, and for a mechanism without `motors`.
    """
    check_log(log, scene.system)
    if scene.constraints and motors is None:
        raise ValueError("the torques of a mechanism are those of its motors; name them as observed= in the fit")
    dtype = state_dtype(scene.system)
    signals = (jnp.asarray(x, dtype) for x in (log.t, log.q, log.v, log.a))
    return np.asarray(_torques(scene, motors if scene.constraints else None, *signals), np.float64)


def inverse_torque(scene: Scene, q, v, a, t):
    """Torque tau (nv,) of a motion of a scene without constraints: inverse dynamics less the scene's forces."""
    tau = dynamics.inverse_dynamics(scene.system, q, v, a, t)
    force = scene.applied_force(q, v, t)
    return tau if force is None else tau - force


def project_to_motors(scene: Scene, columns, q, v, t, tau):
    """Torques (nv,) of the motors that have the power of torques (nv,) at all joints of a mechanism; zero elsewhere."""
    N, _ = motor_basis(scene, q, v, t, columns)
    return jnp.zeros_like(tau).at[np.array(columns)].set(N.T @ tau)


def regressor_torque(scene: Scene, q, v, a, t):
    """`inverse_torque` of a model by its regressor, whose derivative by the inertias is the regressor itself."""
    model: Any = scene.system
    tau = dynamics.torque_regressor(model, q, v, a) @ model.inertias.reshape(-1)
    tau = tau if model.armature is None else tau + model.armature * a
    force = scene.applied_force(q, v, t)
    return tau if force is None else tau - force


@eqx.filter_jit
def _torques(scene: Scene, motors, t, q, v, a):
    def one(t, q, v, a):
        tau = inverse_torque(scene, q, v, a, t)
        return tau if motors is None else project_to_motors(scene, motors, q, v, t, tau)

    return jax.vmap(one)(t, q, v, a)
