"""Checks of the numbers that are given to `simulate`."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxdyn.compile.known import is_concrete
from jaxdyn.model.arguments import batch_hint, check_shape
from jaxdyn.model.tree import Model
from jaxdyn.simulation.solvers.choice import is_fixed
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import has_quaternions

# Numbers that a file holds to a few digits are of unit length to this.
_LENGTH_TOLERANCE = 1e-3


def check_start(scene: Scene, q0, v0) -> None:
    """Refuse systems that cannot move, states of a wrong shape, NaN, and quaternions that are far from unit length."""
    if scene.nv == 0:
        raise ValueError("the system has no coordinates (nq = nv = 0), so nothing moves; add a body with a joint")
    for name, value in (("q0", q0), ("v0", v0)):
        check_shape(scene.system, name, value)
        if is_concrete(value):
            _check_finite(name, value)
    if not is_concrete(q0):
        return
    for joint, places in _quaternions(scene.system):
        length = float(np.linalg.norm(np.asarray(q0, float)[places]))
        if abs(length - 1) > _LENGTH_TOLERANCE:
            raise ValueError(
                f"q0 has a quaternion of length {length:.6g} at joint {joint!r}, expected 1; "
                "divide it by its length (order w, x, y, z)"
            )


def has_unit_quaternions(system, q) -> Bool[Array, ""]:
    """Whether every quaternion of q is of unit length, within what numbers in files are rounded to, or zero."""
    squares = [jnp.sum(q[places] ** 2) for _, places in _quaternions(system)]
    if not squares:
        return jnp.asarray(True)
    low, high = (1 - _LENGTH_TOLERANCE) ** 2, (1 + _LENGTH_TOLERANCE) ** 2
    return jnp.stack([(x == 0) | ((x >= low) & (x <= high)) for x in squares]).all()


def _quaternions(system) -> list[tuple[str, slice]]:
    """Joints whose coordinates end with a quaternion, and where it stands in q."""
    if not has_quaternions(system):
        return []
    top = system.topology
    joints = zip(top.joint_names, top.kinds, top.q_slices, strict=True)
    return [(name, slice(at.stop - 4, at.stop)) for name, kind, at in joints if kind in ("spherical", "free")]


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


def check_tolerance(name: str, value) -> None:
    """Refuse tolerances that are no single number, negative, infinite or NaN."""
    if value.shape != ():
        raise ValueError(f"{name} has shape {value.shape}; pass one number{batch_hint(value, ())}")
    if is_concrete(value) and not (np.isfinite(value) and value >= 0):
        raise ValueError(f"{name} is {value}; pass a finite number that is not negative, such as 1e-8")


def usable_steps(steps, ts):
    """(rtol, atol, stepsize or controller) with what cannot be used replaced, so that a bad lane of a batch ends soon.

    **Returns:** the three, whether the step was positive and finite, and whether the tolerances were fine.
    """
    rtol, atol, stepsize = steps
    fine_tolerances = jnp.isfinite(rtol) & (rtol >= 0) & jnp.isfinite(atol) & (atol >= 0)
    rtol, atol = (jnp.where(fine_tolerances, x, jnp.full_like(x, 1e-3)) for x in (rtol, atol))
    if not is_fixed(stepsize):
        return (rtol, atol, stepsize), jnp.asarray(True), fine_tolerances
    fine_steps = jnp.isfinite(stepsize) & (stepsize > 0)
    return (rtol, atol, jnp.where(fine_steps, stepsize, ts[-1] - ts[0])), fine_steps, fine_tolerances


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
