"""Projection of states on the rows of constraints, closed contacts and friction that sticks."""

import jax.numpy as jnp

from jaxdyn.constraints.base import holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.hybrid.modes import Elements, Mode, extend
from jaxdyn.simulation.hybrid.rows import by_element, by_normal_row, terms_at, tolerance
from jaxdyn.simulation.hybrid.transitions import align
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, rate_to_velocity, retract, velocity_to_rate

# Rounds of a projection at the end of a step, and of one at a save point. All have the factor of the first: each reduces what is
# open in proportion to the first correction, which only coarse tolerances make large.
_ROUNDS, _SAVED_ROUNDS = 2, 6


def project(scene: Scene, elements: Elements, mode: Mode, t, y, error, lifts: bool = False):
    """Project q and v by the least change onto the rows that act, and the error (or None) onto their tangent space.

    The last change of q, from which what is left open follows, counts as an error too: a step that is too long for the projection
    is rejected. `lifts`: whether q is projected onto the gaps of open contacts too that are negative, as closing one may push
    another below zero.
    """
    whole, dtype = extend(scene), y["v"].dtype
    q, v = retract(scene.system, y["q"]), y["v"]
    terms = terms_at(scene, elements, q, v, t)
    holonomic = holonomic_rows(layout(whole))
    # Masks keep the shapes of all modes: rows that do not act are multiplied by zero.
    active = elements.active(mode).astype(dtype)
    holds = jnp.zeros((elements.count,), dtype).at[holonomic].set(1.0) * active

    def change(residual, mask):
        """Least velocity that changes the rows of a mask by `residual`."""
        lam = terms.gram.factor(mask).solve((residual * mask)[:, None])[:, 0]
        return terms.metric.unwhiten(matmul(terms.gram.Y, lam))

    contacts = by_normal_row(elements, jnp.ones((len(elements.each),), dtype))
    # From half of the level of the guard on. Gaps at impacts are far smaller: to close them would shorten each bounce.
    deep = tolerance(dtype) * (1 + jnp.max(jnp.abs(q))) / 2
    start, last, blank = q, jnp.zeros_like(v), jnp.zeros((elements.count,), dtype)
    rounds = _SAVED_ROUNDS if error is None and not lifts else _ROUNDS
    if holonomic.size:
        for _ in range(rounds):
            residual, lifted = blank.at[holonomic].set(position_residual(whole, q, t)), holds
            if lifts:
                lifted = jnp.where(residual < -deep, jnp.maximum(holds, contacts), holds)
            last = change(residual, lifted)
            q = displace(scene.system, q, -last)
    tangent = None
    if error is not None:
        e = rate_to_velocity(scene.system, start, error["q"])
        # Rows on velocities do not confine a displacement: an error of q is projected by rows on positions alone.
        e = e - change(matmul(terms.row.A, e), holds) + last
        tangent = error | {
            "q": velocity_to_rate(scene.system, start, e),
            "v": error["v"] - change(matmul(terms.row.A, error["v"]), active),
        }
    for _ in range(rounds):
        v = v - change(velocity_residual(whole, q, v, t), active)
    slip = by_element(elements, velocity_residual(whole, q, v, t))
    aligned = jnp.where((mode.creep > 0)[:, None], y["slip"], align(slip, y["slip"]))
    return y | {"q": q, "v": v, "slip": aligned}, tangent
