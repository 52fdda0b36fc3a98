"""Options of `fit_parameters`: what to minimise, by which method, and where and how long to compute.

An objective is the error between a scene and a log: of torques, momentum, energy, or simulated motion, open-loop or under the
logged controller. The errors of one segment of a log form an array, in units of `scale`. Momentum and energy are balances over a
segment,

    M v |_0^T     = integral of C^T v - g + f + tau           (nv,),   as dM/dt = C + C^T,
    T + V |_0^T   = integral of v . (f + tau)                 (),

with f the scene's forces, by the trapezoidal rule over the samples. Balances need velocities and no accelerations, and M v
and T depend on the velocities at the ends alone. Sample at ten times the bandwidth of the motion, or more.

Source: Gautier & Khalil (1988), energy; Slotine & Li (1987), filtered dynamics; Bock (1983), multiple shooting.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.dynamics import quantities as dynamics
from jaxdyn.dynamics.centroidal import kinetic_energy, potential_energy
from jaxdyn.identify.mechanisms import Measured
from jaxdyn.identify.methods import METHODS, SOLVERS, Optimizer
from jaxdyn.identify.result import (
    HOLDS,
    INITIAL,
    SampledTorque,
    Segments,
    check_replay,
    inverse_torque,
    motion_errors,
    motion_scale,
    moving_scale,
    project_to_motors,
    simulate_segment,
    simulation_options,
)
from jaxdyn.identify.torque_terms import friction_of
from jaxdyn.model.arguments import (
    Checked,
    FilePath,
    SystemLike,
    as_static,
    check_count,
    check_mapping,
    check_seed,
    warn,
)
from jaxdyn.simulation.controls import Control
from jaxdyn.systems.system import displace
from jaxdyn.tasks import DaskClient

SIMULATED = ("trajectory", "closed-loop")
BALANCES = ("momentum", "energy")
ERRORS = ("trajectory", "torque", "momentum", "energy", "closed-loop")


_SIMULATE = ("solver", "stepsize", "substeps", "rtol", "atol", "adjoint", "max_steps", "method")


def _as_tuple(names):
    if names is not None and not isinstance(names, (tuple, list)):
        raise ValueError(
            f"observed is {names!r}; give the names (or indices) of the measured coordinates, or None for all"
        )
    return None if names is None else tuple(names)


class Objective(eqx.Module):
    r"""Objective of `fit_parameters`.

    The mean, over samples and coordinates, of the squared errors in units of their root mean square over the logs, plus
    $\mathrm{noise}^2/N$ times the squares of the priors' residuals, N the number of errors.

    **Arguments:**

    - `error`: the quantity to compare.
      "torque": M a + h less the scene's forces. Needs accelerations, and no simulation. Of a mechanism with constraints the
      torques of its motors are compared, `observed`, as many as it has degrees of freedom.
      "momentum", "energy": balances over segments of `horizon` steps (20 by default), which need no accelerations.
      "trajectory": motions of segments of `horizon` steps, simulated with the measured torques (multiple shooting).
      "closed-loop": the same under the logged controller; its torques are compared too. Unlike this, open-loop replay of a
      geared arm is ill-conditioned.
    - `horizon`: steps of a log in a segment. Simulations of whole logs, None, need logs of equal length. Chaos amplifies errors
      along long segments; short ones see no small errors that add up.
    - `initial`: "measured" states start the segments; "free" ones are fitted too, for noisy measurements.
    - `hold`: torques between samples, "linear" or "previous" (a controller that holds its output).
    - `substeps`: fixed steps between two samples (Tsit5 unless `simulation` has a solver); None: adaptive steps. Fixed
      steps end on every sample, where the torques have their kinks, and cost the same in every segment.
    - `control`: the logged controller of "closed-loop", `control(q, v, t)` or a `jd.Controller`, with references in the log's
      time.
    - `observed`: names (of a system without bodies, indices) of the measured coordinates, if not all were; only these are
      compared. Fill the log with `jd.identify.complete_log`.
    - `noise`: the expected final error as a share of the root mean square; it weights data against priors.
    - `simulation`: options of `jd.simulate` by name: solver, stepsize, rtol, atol, adjoint, max_steps.

    **Raises:** ValueError for arguments that are unknown, out of range, or of no effect with this error.

    Source: output error and equation error methods, Ljung (1999), section 7; Bock (1983), multiple shooting.

    ```python
    objective = jd.identify.Objective("trajectory", horizon=20, substeps=2)
    ```
    """

    error: Checked[str] = eqx.field(static=True, default="trajectory")
    horizon: Checked[int | None] = eqx.field(static=True, default=None)
    initial: Checked[str] = eqx.field(static=True, default=INITIAL[0])
    hold: Checked[str] = eqx.field(static=True, default=HOLDS[0])
    substeps: Checked[int | None] = eqx.field(static=True, default=None)
    control: Control = None
    observed: Any = eqx.field(static=True, default=None, converter=_as_tuple)
    noise: Checked[float] = eqx.field(static=True, default=0.01)
    simulation: dict[str, Any] = eqx.field(default_factory=dict)

    def __check_init__(self):
        check_replay(self.initial, self.hold)
        if self.error not in ERRORS:
            raise ValueError(f"error is {self.error!r}; give one of {ERRORS}")
        as_static(self.noise, "noise", np.finfo(float).tiny, np.inf, "a positive share, such as 0.01")
        unknown = set(check_mapping(self.simulation, "simulation", '{"rtol": 1e-6}')) - set(_SIMULATE)
        if unknown or self.simulation is None:
            raise ValueError(
                f"simulation is {self.simulation!r}; give options by name, of {', '.join(_SIMULATE)}, or none: {{}}"
            )
        if self.horizon is not None:
            check_count(self.horizon, "horizon")
        if (self.control is None) == (self.error == "closed-loop"):
            raise ValueError(
                f"control is {self.control!r} with error={self.error!r}; error='closed-loop' takes the logged controller, "
                "others none"
            )
        if self.error in SIMULATED:
            simulation_options(self.substeps, self.simulation)
            return
        given = {
            "horizon": self.horizon if self.error == "torque" else None,
            "substeps": self.substeps,
            **self.simulation,
        }
        given |= {
            name: x
            for name, x, usual in (("initial", self.initial, INITIAL), ("hold", self.hold, HOLDS))
            if x != usual[0]
        }
        names = [name for name, value in given.items() if value is not None]
        if names:
            raise ValueError(f"{', '.join(names)} with error='{self.error}', which simulates nothing; omit it")

    @property
    def needs(self) -> tuple[str, ...]:
        """Signals that a log must have in addition to q and tau."""
        return ("v", "a") if self.error == "torque" else ("v",)

    def scale(self, system: SystemLike, segments: Segments) -> Array:
        """Units of the errors."""
        torque = moving_scale(jnp.sqrt(jnp.mean(segments.tau**2, axis=(0, 1))))
        # Impulse and work of a segment grow with its duration, so that the units of the balances do too.
        span = jnp.mean(segments.t[:, -1] - segments.t[:, 0])
        if self.error == "torque":
            return torque
        if self.error == "momentum":
            return torque * span
        if self.error == "energy":
            power = jnp.sqrt(jnp.mean(jnp.sum(segments.tau * segments.v, axis=-1) ** 2))
            return jnp.where(power > 0, power, jnp.ones_like(power)) * span
        motion = motion_scale(system, segments)
        return motion if self.error == "trajectory" else jnp.concatenate([motion, torque[None]])

    def errors(
        self,
        measured: Measured,
        segment: Segments,
        change: Float[Array, "2 nv"] | None,
        scale: Array,
        torque: Callable = inverse_torque,
    ) -> Float[Array, "n k"]:
        """Errors of one segment, a row for each sample (one row for a balance); `change` (2, nv): of its initial state.

        `torque(scene, q, v, a, t)`: `inverse_torque`, or an equal function.
        """
        scene, system = measured.scene, measured.scene.system
        segment = correct_sensors(measured, segment, None if self.error in SIMULATED else self.hold)
        if self.error == "torque":
            errors = jax.vmap(partial(torque, scene))(segment.q, segment.v, segment.a, segment.t) - segment.tau
            if segment.smoothing is not None:
                errors = errors + friction_of(scene).coulomb[None] * segment.smoothing
            if scene.constraints:
                errors = jax.vmap(partial(project_to_motors, scene, self.observed))(
                    segment.q, segment.v, segment.t, errors
                )
            return self._select_columns(errors / scale[None])
        if self.error == "momentum":
            return self._select_columns((momentum_balance(scene, segment) / scale)[None])
        if self.error == "energy":
            return (energy_balance(scene, segment) / scale)[None, None]
        start = None if change is None else change * scale[:2]
        simulated = partial(simulate_segment, scene, segment, start, self.hold, self.simulation, observed=self.observed)
        if self.error == "trajectory":
            t, tau = jnp.asarray(segment.t), jnp.asarray(segment.tau)
            law = SampledTorque(t + measured.delay, tau, self.hold)
            q, v = simulated(control=law)
            return jnp.concatenate(
                [self._select_columns(e) for e in motion_errors(system, segment, q, v, scale)], axis=1
            )
        q, v, tau = simulated(control=self.control, outputs=("torque",))
        errors = [*motion_errors(system, segment, q, v, scale[:2]), (tau - segment.tau) / scale[2][None]]
        return jnp.concatenate([self._select_columns(error) for error in errors], axis=1)

    def _select_columns(self, errors):
        return errors if self.observed is None else errors[:, jnp.asarray(self.observed)]


def correct_sensors(measured: Measured, segment: Segments, hold: str | None) -> Segments:
    """Correct a log segment for its sensors; with `hold` the torques are the delayed ones at its samples."""
    system = measured.scene.system
    q = jax.vmap(lambda q: displace(system, q, -measured.position_bias))(segment.q)
    tau = measured.torque_gain[None] * segment.tau + measured.torque_bias[None]
    if hold is not None and segment.tau.shape[0] > 1:
        law = SampledTorque(jnp.asarray(segment.t), tau, hold)
        # Interpolated torques have kinks at the samples; the derivative there is that of the next interval.
        tau = jax.vmap(lambda t: law.at(t - measured.delay))(segment.t)
    return eqx.tree_at(lambda p: (p.q, p.tau), segment, (q, tau))


def momentum_balance(scene, segment: Segments) -> Float[Array, " nv"]:
    """Change of the momentum M v over a segment less the impulse (nv,): zero for a motion of the scene."""
    system = scene.system

    def force(t, q, v, tau):
        C, g = dynamics.coriolis_matrix(system, q, v, t), dynamics.gravity_force(system, q, t)
        applied = scene.applied_force(q, v, t)
        # d(M v)/dt = (C + C^T) v + M a = C^T v - g + f + tau, since M a = f + tau - C v - g; v @ C is C^T v.
        return v @ C - g + tau + (0.0 if applied is None else applied)

    rate = jax.vmap(force)(segment.t, segment.q, segment.v, segment.tau)
    t: Any = segment.t
    momentum = [dynamics.mass_matrix(system, segment.q[i], t[i]) @ segment.v[i] for i in (0, -1)]
    return momentum[1] - momentum[0] - _integral(rate, segment.t)


def energy_balance(scene, segment: Segments) -> Float[Array, ""]:
    """Change of the energy over a segment less the work (J): zero for a motion of the scene.

    Constraints that do not move with time do no work, so it holds for mechanisms too.
    """
    system = scene.system

    def power(t, q, v, tau):
        force = scene.applied_force(q, v, t)
        return jnp.sum(v * (tau if force is None else tau + force))

    work = _integral(jax.vmap(power)(segment.t, segment.q, segment.v, segment.tau), segment.t)
    t: Any = segment.t
    energy = [
        kinetic_energy(system, segment.q[i], segment.v[i], t[i]) + potential_energy(system, segment.q[i], t[i])
        for i in (0, -1)
    ]
    return energy[1] - energy[0] - work


def _integral(rate, t):
    """Trapezoidal rule along the first axis."""
    steps = (t[1:] - t[:-1]).reshape(-1, *[1] * (rate.ndim - 1))
    return jnp.sum(steps * (rate[1:] + rate[:-1]) / 2, axis=0)


GAUSS_NEWTON = "gauss-newton"


class Solver(eqx.Module):
    """Method of minimisation of `fit_parameters`.

    **Arguments:**

    - `method`: "gauss-newton" for up to some hundred numbers: damped Gauss-Newton steps with exact Jacobians by forward mode,
      which eliminate free initial states segment by segment, until the next one predicts a decrease of the loss by less than
      `tolerance` of it. Torques that are linear in feasible inertias and other numbers take the interior-point steps of
      `fit_torques` first. "levenberg-marquardt" and "dogleg" are those of optimistix, with the same Jacobians. For more numbers,
      as of a network, "lbfgs", "adam" or an optax.GradientTransformation, by reverse mode.
    - `steps`: the most steps. `learning_rate`: of adam, a share of each number (of one where it starts at zero), decaying to zero
      along a cosine. `tolerance`: "lbfgs" ends where ten steps have lowered the loss by less than this share of it.
    - `starts`: number of starting points around the given one. All are improved in one `jax.vmap`, and the best is fitted to the
      end. `spread`: standard deviation of the coordinates of the points, of positive numbers as a share. `seed`: of the points.

    **Raises:** ValueError for an unknown method, and numbers out of range.

    Source: Marquardt (1963), damping.

    ```python
    solver = jd.identify.Solver("lbfgs", steps=500)
    ```
    """

    method: Checked[str | Optimizer] = GAUSS_NEWTON
    steps: int = 200
    learning_rate: float = 0.1
    tolerance: float = 1e-9
    starts: Checked[int] = 1
    spread: float = 0.3
    seed: int = 0

    def __check_init__(self):
        methods = (GAUSS_NEWTON, *SOLVERS, *METHODS)
        is_optax = hasattr(self.method, "init") and hasattr(self.method, "update")
        if not (self.method in methods if isinstance(self.method, str) else is_optax):
            raise ValueError(f"method is {self.method!r}; give one of {methods} or an optax.GradientTransformation")
        check_count(self.steps, "steps")
        check_count(self.starts, "starts")
        check_seed(self.seed)
        positive = np.finfo(float).tiny
        as_static(self.learning_rate, "learning_rate", positive, np.inf, "a positive number")
        as_static(self.tolerance, "tolerance", 0, np.inf, "zero or a positive number")
        as_static(
            self.spread, "spread", positive, np.inf, "a positive number, the deviation of the starts' coordinates"
        )

    @property
    def name(self) -> str:
        """Name of the method."""
        return self.method if isinstance(self.method, str) else type(self.method).__name__


class Execution(eqx.Module):
    """Devices, duration, reports and checkpoints of `fit_parameters`.

    **Arguments:**

    - `devices`: some of `jax.devices()`, over which the segments are sharded (samples where error="torque", whole logs of a
      `Measured` scene), as many as divide their number; an iteration exchanges one all-reduce. None: one device.
    - `client`: a `dask.distributed.Client`, whose workers share the starts.
    - `callback(step, loss, system)` is called at every point with the system there; True stops the fit. `progress`: print step,
      loss and time left on standard error. `seconds`: limit of the fit's duration.
    - `checkpoint`: a file with the fit's state. A fit of the same problem resumes from it, even after kill -9, and ends in the
      same numbers, bit for bit on one machine. `every`: steps (an integer) or seconds (a float) between two writes.
      `resume`: False starts again.

    ```python
    execution = jd.identify.Execution(progress=True, checkpoint="fit.ckpt", every=10)
    ```
    """

    devices: Sequence[Any] | None = None
    client: DaskClient | None = None
    callback: Callable[[int, float, Any], Any] | None = None
    progress: bool = False
    seconds: float | None = None
    checkpoint: FilePath | None = None
    every: int | float = 30.0
    resume: bool = True


def merge_options(old: dict[str, Any], objective: Objective, *groups: Any) -> list[Any]:
    """The groups of options with those that were given by their own names, which is deprecated.

    Names of no group are options of the simulation.
    """
    every = (objective, *groups)
    if not old:
        return list(every)
    places = {field.name: k for k, group in enumerate(every) for field in dataclasses.fields(group)}
    changes: list[dict[str, Any]] = [{} for _ in every]
    for name, value in old.items():
        if name in places:
            changes[places[name]][name] = value
        else:
            changes[0]["simulation"] = changes[0].get("simulation", dict(objective.simulation)) | {name: value}
    for group, change in zip(every, changes, strict=True):
        if change:
            kind = type(group).__name__
            warn(
                f"{', '.join(change)}: pass jd.identify.{kind}({', '.join(change)}), a group of options",
                DeprecationWarning,
            )
    # Together: some options are allowed with each other only.
    return [dataclasses.replace(group, **change) for group, change in zip(every, changes, strict=True)]
