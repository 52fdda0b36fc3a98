"""Errors between a scene and a log: of torques, momentum, energy, or simulated motion, open-loop or under the logged controller.

The errors of one segment of a log form an array, in units of `scale`. Momentum and energy are balances over a segment,

    M v |_0^T     = integral of C^T v - g + f + tau           (nv,),   as dM/dt = C + C^T,
    T + V |_0^T   = integral of v . (f + tau)                 (),

with f the scene's forces, by the trapezoidal rule over the samples. Balances need velocities and no accelerations, and M v
and T depend on the velocities at the ends alone. Sample at ten times the bandwidth of the motion, or more.

Source: Gautier & Khalil (1988), energy; Slotine & Li (1987), filtered dynamics; Bock (1983), multiple shooting.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.dynamics import quantities as dynamics
from jaxdyn.identify.replay import SampledTorque, Segments, motion_errors, motion_scale, moving_scale, simulate_segment
from jaxdyn.identify.result import inverse_torque
from jaxdyn.identify.sensors import Measured
from jaxdyn.systems.system import displace

SIMULATED = ("trajectory", "closed-loop")
BALANCES = ("momentum", "energy")
ERRORS = ("trajectory", "torque", "momentum", "energy", "closed-loop")


class Objective(eqx.Module):
    """Objective of a fit.

    The kind of `error`, the interpolation of torques, options of `simulate`, the logged controller, and the indices of the
    coordinates that were measured (None: all).
    """

    error: str = eqx.field(static=True)
    hold: str = eqx.field(static=True)
    options: Any
    control: Any = None
    observed: tuple[int, ...] | None = eqx.field(static=True, default=None)

    def scale(self, system, segments: Segments) -> Array:
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

    def errors(self, measured: Measured, segment: Segments, change, scale) -> Float[Array, "n k"]:
        """Errors of one segment, a row for each sample (one row for a balance); `change` (2, nv): of its initial state."""
        scene, system = measured.scene, measured.scene.system
        segment = correct_sensors(measured, segment, None if self.error in SIMULATED else self.hold)
        if self.error == "torque":
            tau = jax.vmap(lambda t, q, v, a: inverse_torque(scene, q, v, a, t))(
                segment.t, segment.q, segment.v, segment.a
            )
            return self._select_columns((tau - segment.tau) / scale[None])
        if self.error == "momentum":
            return self._select_columns((momentum_balance(scene, segment) / scale)[None])
        if self.error == "energy":
            return (energy_balance(scene, segment) / scale)[None, None]
        start = None if change is None else change * scale[:2]
        options: dict[str, Any] = dict(self.options)
        simulated = partial(simulate_segment, scene, segment, start, self.hold, options, observed=self.observed)
        if self.error == "trajectory":
            law = SampledTorque(segment.t + measured.delay, segment.tau, self.hold)
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
        law = SampledTorque(segment.t, tau, hold)
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
        dynamics.kinetic_energy(system, segment.q[i], segment.v[i], t[i])
        + dynamics.potential_energy(system, segment.q[i], t[i])
        for i in (0, -1)
    ]
    return energy[1] - energy[0] - work


def _integral(rate, t):
    """Trapezoidal rule along the first axis."""
    steps = (t[1:] - t[:-1]).reshape(-1, *[1] * (rate.ndim - 1))
    return jnp.sum(steps * (rate[1:] + rate[:-1]) / 2, axis=0)
