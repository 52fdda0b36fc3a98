"""Excitation: smooth torques and motions made of a few harmonics, the control that follows a motion, and the robots that do so.

The amplitudes are leaves, so one compiled program runs a whole batch of excitations. All joints of a tree are driven; of a
mechanism the motors, whose loops give the others.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.assembly import assemble
from jaxdyn.constraints.selection import degrees_of_freedom, independent_rows
from jaxdyn.dynamics.quantities import bias_force, inverse_dynamics
from jaxdyn.identify.chart import check_bodies
from jaxdyn.identify.mechanisms import check_motors, follow_motors, motor_basis
from jaxdyn.identify.result import inverse_torque
from jaxdyn.model.arguments import as_array
from jaxdyn.model.configuration import neutral
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene


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


# Samples on the way from the start of a mechanism to the first sample of a motion.
_APPROACH = 20


class DrivenRobot(eqx.Module):
    """Robot whose motors follow a motion: all joints of a tree, or `motors`, indices in v, of a mechanism with loops.

    `start` (nq,): a closed configuration of a mechanism.
    """

    scene: Scene
    start: Float[Array, " nq"]
    motors: tuple[int, ...] | None = eqx.field(static=True)

    @property
    def model(self) -> Model:
        return self.scene.system

    @property
    def joints(self) -> np.ndarray:
        """Indices in v of the joints that follow the motion."""
        return np.arange(self.model.nv) if self.motors is None else np.array(self.motors)

    def states(self, motion: FourierMotion, times):
        """q, v, a (n, nv) of all joints, tangent bases N (n, nv, m), and the gaps of the loops (n,)."""
        q, v, a = jax.vmap(motion)(times)
        if self.motors is None:
            N = jnp.broadcast_to(jnp.eye(q.shape[1], dtype=q.dtype), (*q.shape, q.shape[1]))
            return q, v, a, N, jnp.zeros(len(q), q.dtype)
        # From the start to the first sample, so that the loops stay on their branch.
        shares = jnp.arange(_APPROACH, dtype=q.dtype)[:, None] / _APPROACH
        begin = self.start[self.joints][None]
        approach = begin + shares * (q[:1] - begin)
        whole, gaps = follow_motors(self.scene, self.motors, self.start, jnp.concatenate([approach, q]))
        basis = partial(motor_basis, self.scene, columns=self.motors)
        q, gap = whole[_APPROACH:], jnp.maximum(gaps[_APPROACH:], jnp.max(gaps[:_APPROACH]))
        N, _ = jax.vmap(lambda q, v: basis(q, v, 0.0))(q, jnp.zeros_like(q))
        v = jnp.einsum("nij,nj->ni", N, v)
        drift = jax.vmap(lambda q, v: basis(q, v, 0.0)[1])(q, v)
        return q, v, jnp.einsum("nij,nj->ni", N, a) + drift, N, gap


@eqx.filter_jit
def joint_signals(motion: FourierMotion, robot: DrivenRobot, times):
    """q, v, a (n, nv) of all joints, torques (n, m) of the driven ones, tangent bases (n, nv, m), and the loops' gaps (n,)."""
    q, v, a, N, gap = robot.states(motion, times)
    tau = jax.vmap(partial(inverse_torque, robot.scene))(q, v, a, times)
    return q, v, a, jnp.einsum("nij,ni->nj", N, tau), N, gap


def make_robot(scene: Scene, motors: Sequence[str] | None, guess) -> DrivenRobot:
    """The robot that a motion drives: the tree, or the mechanism by its motors. Checks the names and the numbers of both."""
    model: Any = scene.system
    check_bodies(model)
    if model.nq != model.nv:
        raise ValueError(
            f"model has nq={model.nq}, nv={model.nv}; exciting motions are for joints with one coordinate each"
        )
    if not scene.constraints:
        if motors is not None:
            raise ValueError(f"motors is {list(motors)}; a robot without loops moves all joints, so omit it")
        return DrivenRobot(scene, neutral(model), None)
    start = neutral(model) if guess is None else jnp.asarray(as_array(guess, "guess"), model.home.dtype)
    if start.shape != (model.nq,):
        raise ValueError(f"guess has shape {start.shape}, expected ({model.nq},)")
    start = assemble(scene, start).q
    if motors is None:
        count = degrees_of_freedom(scene, start)
        raise ValueError(
            f"{model.name!r} has loops and {count} degrees of freedom; name as many of its joints in motors "
            f"({', '.join(model.joint_names)})"
        )
    columns = check_motors(scene, start, motors)
    # Loops of a rounded file close but for redundant rows, which stay open by its rounding.
    return DrivenRobot(independent_rows(scene, start, 0.0), start, columns)
