"""Checks of the numbers that are given to `simulate`."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn._tracing import is_concrete
from jaxdyn.model import Model
from jaxdyn.scene import Scene
from jaxdyn.systems import has_quaternions


def as_array(value):
    """Lists and numbers as numpy arrays, which stay known inside a trace; arrays and what holds tracers by jax."""
    if isinstance(value, (np.ndarray, jax.Array)):
        return value
    return np.asarray(value) if is_concrete(value) else jnp.asarray(value)


def check_state(scene: Scene, q0, v0) -> None:
    """Refuse states of a wrong shape, NaN, and quaternions that are far from unit length."""
    for name, value, size, label in (("q0", q0, scene.nq, "(nq,)"), ("v0", v0, scene.nv, "(nv,)")):
        if value.shape != (size,):
            hint = "; simulate takes one sample, use jax.vmap for a batch" if value.ndim == 2 else ""
            raise ValueError(
                f"{name} has shape {value.shape}, expected {(size,)} = {label} of the scene's system{hint}"
            )
        if is_concrete(value):
            _check_finite(name, value)
    if not (has_quaternions(scene.system) and is_concrete(q0)):
        return
    topology = scene.system.topology
    for joint, kind, place in zip(topology.joint_names, topology.kinds, topology.q_slices, strict=True):
        if kind in ("spherical", "free"):
            norm = float(np.linalg.norm(np.asarray(q0, float)[place][-4:]))
            if abs(norm - 1) > 1e-3:
                raise ValueError(
                    f"q0 has a quaternion of length {norm:.6g} at joint {joint!r}, expected 1; "
                    "divide it by its length (order w, x, y, z)"
                )


def most_turned(dtype) -> float:
    """Largest angle (rad) that adaptive steps start from: 150 turns in float32, 3.5e6 in float64.

    Beyond it the angle moves by steps of sqrt(eps)/3 and more. Error estimates of the rates take them for errors of the
    method, and shorter steps make them worse.
    """
    return 1 / (3 * float(jnp.finfo(dtype).eps) ** 0.5)


def turning(system) -> np.ndarray:
    """Indices in q of the angles of a `Model` that come back after a turn."""
    if not isinstance(system, Model):
        return np.zeros(0, int)
    top = system.topology
    places = zip(top.kinds, top.q_slices, strict=True)
    return np.array([at.stop - 1 for kind, at in places if kind in ("revolute", "continuous", "planar")], int)


def check_turns(scene: Scene, q0, dtype) -> None:
    """Refuse angles of so many turns that their dtype holds too little of the rest."""
    angles = turning(scene.system)
    turned = np.abs(np.asarray(q0, float)[angles])
    if turned.size and turned.max() > most_turned(dtype):
        index = int(angles[np.argmax(turned)])
        value, eps = float(q0[index]), float(jnp.finfo(dtype).eps)
        raise ValueError(
            f"q0 is {value:.6g} rad at index {index}, which {jnp.dtype(dtype).name} holds only to {eps * abs(value):.1g} rad; "
            f"subtract the {round(value / (2 * np.pi))} whole turns, use float64, or fixed steps (stepsize=0.01)"
        )


def check_times(ts) -> None:
    """Refuse times that are not at least two, finite and increasing."""
    if ts.ndim != 1 or ts.shape[0] < 2:
        raise ValueError(f"ts has shape {ts.shape}; pass the start and at least one later time, (nt,) with nt >= 2")
    if not is_concrete(ts):
        return
    _check_finite("ts", ts)
    times = np.asarray(ts, float)
    back = np.flatnonzero(np.diff(times) <= 0)
    if back.size:
        i = back[0]
        raise ValueError(
            f"ts does not increase at index {i + 1}: {times[i]} then {times[i + 1]}; sort it, drop doubles"
        )


def _check_finite(name: str, value) -> None:
    bad = np.flatnonzero(~np.isfinite(np.asarray(value, float)))
    if bad.size:
        raise ValueError(f"{name} is {np.asarray(value)[bad[0]]} at index {bad[0]}; give finite numbers")
