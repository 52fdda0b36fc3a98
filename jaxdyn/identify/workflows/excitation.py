"""Excitation: smooth torques and motions made of a few harmonics, and the control that follows a motion.

The amplitudes are leaves, so one compiled program runs a whole batch of excitations.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.dynamics.quantities import bias_force, inverse_dynamics
from jaxdyn.model.tree import Model


class FourierTorque(eqx.Module):
    """Control tau(t) = sum over k of cosine_k cos(k w t) + sine_k sin(k w t), w = 2 pi / period, plus gravity compensation.

    - `cosine`, `sine` (harmonics, nv): amplitudes, N m or N. `period`: s.
    - `carry`: a model whose weight the control also supports, tau = ... + N(q), or None.
    """

    cosine: Float[Array, "harmonics nv"]
    sine: Float[Array, "harmonics nv"]
    period: Float[Array, ""]
    carry: Model | None = None

    def __call__(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t) -> Float[Array, " nv"]:
        c, s, _ = _harmonics(self.cosine.shape[0], self.period, t)
        tau = c @ self.cosine + s @ self.sine
        # At rest the bias force is the gravity force.
        return tau if self.carry is None else tau + bias_force(self.carry, q, jnp.zeros_like(v))


def random_torque(key: Array, size, *, period=2.0, harmonics: int = 3, carry: Model | None = None) -> FourierTorque:
    """A `FourierTorque` with normally distributed amplitudes: `size` (nv,) is the standard deviation of each joint's torque.

    **Arguments:** `key`, of jax.random; `size` (nv,), N m or N; `period` (s) of the slowest of the `harmonics`.

    **Raises:** ValueError for a size that is no vector, or no harmonics.
    """
    size = jnp.asarray(size)
    if size.ndim != 1 or harmonics < 1:
        raise ValueError(f"size has shape {size.shape}, harmonics is {harmonics}; give size (nv,) and harmonics >= 1")
    cosine, sine = _amplitudes(key, size, harmonics)
    return FourierTorque(cosine, sine, jnp.asarray(period, size.dtype), carry)


@eqx.filter_jit
def _amplitudes(key, size, harmonics: int):
    amplitudes = jax.random.normal(key, (2, harmonics, size.shape[0]), size.dtype) * size[None, None]
    # Variances of harmonics add up: with this factor the sum has the deviation `size`.
    return tuple(amplitudes / np.sqrt(harmonics).astype(size.dtype))


class FourierMotion(eqx.Module):
    """Motion q(t) = center + sum over k of cosine_k cos(k w t) + sine_k sin(k w t), w = 2 pi / period, for nq = nv.

    Harmonics keep an identification experiment periodic and within a known band.

    - `center` (nq,), `cosine`, `sine` (harmonics, nq): rad or m. `period`: s.

    Source: Swevers, Ganseman, Tukel, De Schutter & Van Brussel (1997), "Optimal robot excitation and identification".
    """

    center: Float[Array, " nq"]
    cosine: Float[Array, "harmonics nq"]
    sine: Float[Array, "harmonics nq"]
    period: Float[Array, ""]

    def __call__(self, t) -> tuple[Float[Array, " nq"], Float[Array, " nq"], Float[Array, " nq"]]:
        """Position, velocity and acceleration at time t."""
        c, s, w = _harmonics(self.cosine.shape[0], self.period, t)
        q = self.center + c @ self.cosine + s @ self.sine
        v = (w * c) @ self.sine - (w * s) @ self.cosine
        return q, v, -((w * w * c) @ self.cosine + (w * w * s) @ self.sine)


def random_motion(key: Array, center, size, *, period=10.0, harmonics: int = 5) -> FourierMotion:
    """A `FourierMotion` with random amplitudes that fall with the harmonic and that starts at rest at its center.

    **Arguments:** `key`, of jax.random; `center` (nq,), rad or m; `size` (nq,), about the standard deviation of the motion
    around it; `period`, s; `harmonics`, at least 2.

    **Raises:** ValueError when the shapes differ or there are fewer than two harmonics.
    """
    center = jnp.asarray(center)
    size = jnp.asarray(size, center.dtype)
    if center.ndim != 1 or size.shape != center.shape or harmonics < 2:
        raise ValueError(
            f"center has shape {center.shape}, size {size.shape}, harmonics is {harmonics}; give (nq,), (nq,) and >= 2"
        )
    return _random_motion(key, center, size, jnp.asarray(period, center.dtype), harmonics)


@eqx.filter_jit
def _random_motion(key, center, size, period, harmonics: int):
    # As 1 / k all harmonics have the same share of the velocity.
    weight = size[None] / jnp.arange(1, harmonics + 1, dtype=size.dtype)[:, None]
    cosine, sine = jax.random.normal(key, (2, harmonics, size.shape[0]), size.dtype) * weight[None]
    return motion_from_rest(center, cosine, sine, period)


def motion_from_rest(center, cosine, sine, period) -> FourierMotion:
    """Motion at rest at its center at t = 0: what the amplitudes lack for it is distributed over all harmonics."""
    k = jnp.arange(1, cosine.shape[0] + 1, dtype=cosine.dtype)[:, None]
    cosine = cosine - jnp.mean(cosine, axis=0, keepdims=True)
    return FourierMotion(center, cosine, sine - jnp.mean(k * sine, axis=0, keepdims=True) / k, period)


class Tracking(eqx.Module):
    """Control that makes a model follow a motion: tau = ID(q, v, a_d + stiffness (q_d - q) + damping (v_d - v)).

    - `model`: that of the controller, which need not be the truth. `motion(t) -> (q, v, a)`.
    - `stiffness` (1/s^2), `damping` (1/s) of the error.
    """

    model: Model
    motion: FourierMotion
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]

    def __call__(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t) -> Float[Array, " nv"]:
        wanted, rate, acceleration = self.motion(t)
        command = acceleration + self.stiffness * (wanted - q) + self.damping * (rate - v)
        return inverse_dynamics(self.model, q, v, command)


def _harmonics(count: int, period, t):
    w = 2 * np.pi / period * jnp.arange(1, count + 1, dtype=jnp.result_type(period))
    angle = w * jnp.asarray(t, w.dtype)
    return jnp.cos(angle), jnp.sin(angle), w
