"""Hybrid systems: flow between events, guards that end a mode, and reset maps.

States have the entries q, v and `slip`, the directions (n, 2) in which elements slide. Directions are constants of a step
(`step_constants`), renewed where it ends.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxdyn.compile import kernel
from jaxdyn.constraints.base import holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.forces.piecewise import values_and_levels
from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.hybrid.dynamics import (
    StateTerms,
    by_element,
    directions,
    element_guards,
    gaps,
    impact,
    motion_at,
    rebounds,
    solve_rows,
    terms_at,
)
from jaxdyn.simulation.hybrid.modes import Elements, Mode, extend, force_at
from jaxdyn.simulation.hybrid.transitions import ContactState, Impact, Transition, align, first_guess, next_mode
from jaxdyn.simulation.solvers.explicit import Plan
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, rate_to_velocity, retract, velocity_to_rate

# Rounds of a projection at the end of a step, and of one at a save point. All have the factor of the first: each reduces what is
# open in proportion to the first correction, which only coarse tolerances make large.
_ROUNDS, _SAVED_ROUNDS = 2, 6


class HybridSystem:
    """Functions of a motion with modes, on flat states; those of a run hold no arrays, as they are keys of caches.

    `plan` of its steps, whose arguments are (unknown, mode): the traced leaves, and the mode.
    """

    plan: Plan
    elements: Elements

    @abstractmethod
    def guards(self, t, y, args) -> tuple:
        """Guards and their rounding levels: those of the elements by CHANNELS, then those of the switching functions."""

    @abstractmethod
    def reset(self, unknown, t, y, mode: Mode, slip, hit) -> Transition:
        """Transition after the guards `hit`."""

    @abstractmethod
    def impact(self, unknown, mode: Mode, slip, t, y) -> Any:
        """State after an impact."""

    @abstractmethod
    def slip(self, y) -> Any:
        """Directions of sliding (n, 2) of a state."""

    @abstractmethod
    def with_slip(self, y, v, slip) -> Any:
        """State with this velocity and these directions; v None to keep the velocity."""


class ModalSystem(HybridSystem):
    """System with contacts that open and friction that sticks.

    **Arguments:** `bind(unknown, positive=None)` -> (scene, generalized_force(q, v, t), switching(q, v, t)) for the traced
    leaves, with forces in the pieces where the switching functions are `positive`; `y0`, a state.
    """

    def __init__(self, bind: Callable, elements: Elements, solver: diffrax.AbstractERK, y0):
        leaves, tree = jax.tree.flatten(y0)
        shapes = tuple(x.shape for x in leaves)
        self._bind, self.elements = bind, elements
        plan = Plan(type(solver), jax.jit(self._field), self._project, ("slip",), False, tree, shapes)
        self.plan = plan._replace(guards=self.guards)

    def _motion(self, args, t, y):
        unknown, mode = args
        scene, generalized_force, _ = self._bind(unknown, mode.positive)
        q, v = retract(scene.system, y["q"]), y["v"]
        terms = terms_at(scene, self.elements, q, v, t)
        force = generalized_force(q, v, t)
        return scene, q, v, terms, motion_at(scene, self.elements, mode, terms, y["slip"], force, q, v, t)

    def _field(self, t, y, args):
        scene, q, v, _, motion = self._motion(args, t, y)
        return {"q": velocity_to_rate(scene.system, q, v), "v": motion.acceleration, "slip": jnp.zeros_like(y["slip"])}

    def _project(self, t, y, error, args):
        unknown, mode = args
        following, tangent = project(self._bind(unknown)[0], self.elements, mode, t, y, error)
        return following | {"slip": y["slip"]}, following, tangent

    def _switches(self, unknown, positive, q, v, t):
        """Switching functions with such signs that they are positive until one changes its sign, and their levels, (k,)."""
        switching = self._bind(unknown)[2]
        values, levels = values_and_levels(lambda q, v: switching(q, v, t), q, v)
        return jnp.where(positive, values, -values), levels

    def guards(self, t, y, args):
        mode = args[1]
        scene, q, v, terms, motion = self._motion(args, t, y)
        state = _contact_state(scene, self.elements, mode, terms, motion, y["slip"], q, v, t)
        values, levels = self._switches(args[0], mode.positive, q, v, t)
        return tuple(
            jnp.concatenate([own.reshape(-1), more]) for own, more in ((state.guards, values), (state.levels, levels))
        )

    def _state_at(self, unknown, mode, slip, t, q, v):
        scene, q, v, terms, motion = self._motion((unknown, mode), t, {"q": q, "v": v, "slip": slip})
        return _contact_state(scene, self.elements, mode, terms, motion, slip, q, v, t)

    def _impact_at(self, unknown, mode, slip, t, q, v):
        return _impact(self._bind(unknown)[0], self.elements, mode, slip, t, q, v)

    def reset(self, unknown, t, y, mode, slip, hit):
        y = self.plan.structure(y)
        q, v = y["q"], y["v"]
        hit, switched = self.elements.split(hit)
        mode = mode._replace(positive=mode.positive ^ switched)

        def state_at(mode, slip, v):
            return kernel(self._state_at)(unknown, mode, slip, t, q, v)

        def impact_at(mode, slip):
            return kernel(self._impact_at)(unknown, mode, slip, t, q, v)

        mode, slip, begins = first_guess(self.elements, mode, slip, state_at(mode, slip, v), hit)
        forces = [force_at(self._bind(unknown)[0], one) for one in self.elements.each]
        cones = jnp.stack([force.static.astype(v.dtype) for force in forces])
        after = next_mode(self.elements, cones, mode, slip, begins, v, impact_at, state_at)
        # Switching functions that the impact has carried across their zeros.
        values, levels = self._switches(unknown, after.mode.positive, q, after.v, t)
        crossed = (values < -levels) & ~switched
        return after._replace(mode=after.mode._replace(positive=after.mode.positive ^ crossed))

    def impact(self, unknown, mode, slip, t, y):
        y = self.plan.structure(y)
        after = kernel(self._impact_at)(unknown, mode, slip, t, y["q"], y["v"])
        return ravel_pytree(y | {"v": after.v})[0]

    def slip(self, y):
        return self.plan.structure(y)["slip"]

    def with_slip(self, y, v, slip):
        y = self.plan.structure(y)
        return ravel_pytree(y | {"v": y["v"] if v is None else v, "slip": slip})[0]


def project(scene: Scene, elements: Elements, mode: Mode, t, y, error):
    """Project q and v by the least change onto the rows that act, and the error (or None) onto their tangent space.

    The last change of q, from which what is left open follows, counts as an error too: a step that is too long for the projection
    is rejected.
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
        lam = solve_rows(terms.Y * mask[None], mask, (residual * mask)[:, None])[:, 0]
        return terms.metric.unwhiten(matmul(terms.Y, lam))

    start, last, blank = q, jnp.zeros_like(v), jnp.zeros((elements.count,), dtype)
    rounds = _SAVED_ROUNDS if error is None else _ROUNDS
    if holonomic.size:
        for _ in range(rounds):
            last = change(blank.at[holonomic].set(position_residual(whole, q, t)), holds)
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
    return y | {"q": q, "v": v, "slip": align(slip, y["slip"])}, tangent


def _impact(scene: Scene, elements: Elements, mode: Mode, slip, t, q, v) -> Impact:
    terms = terms_at(scene, elements, q, v, t)
    along, rebound = directions(scene, elements, jnp.zeros_like(slip), slip), rebounds(scene, elements, terms)
    after, reaction = impact(scene, elements, mode, terms, along, v, rebound)
    rates = matmul(terms.row.A, after - v) + terms.row.velocity
    gap = jnp.stack([rates[one.normal] if one.opens else jnp.zeros((), v.dtype) for one in elements.each]) - rebound
    # Impulses are compared with the momentum, and with that of a velocity of one: at rest they are zero up to rounding.
    M = mass_matrix(scene.system, q, t)
    size = jnp.max(jnp.abs(matmul(M, v))) + jnp.max(jnp.abs(M)) + jnp.max(jnp.abs(reaction.multipliers))
    return Impact(after, reaction.normal, reaction.holding, by_element(elements, rates), gap, rebound, size)


def _contact_state(
    scene: Scene, elements: Elements, mode: Mode, terms: StateTerms, motion, slip, q, v, t
) -> ContactState:
    dtype, eps = v.dtype, float(jnp.finfo(v.dtype).eps)
    values = element_guards(scene, elements, mode, terms, motion, slip, q, t)
    speeds = jnp.sum(jnp.abs(terms.row.A) * jnp.abs(v)[None], 1)
    zero = jnp.zeros((), dtype)
    reach = 1 + jnp.max(jnp.abs(q))
    force = jnp.sum(jnp.abs(motion.normal)) + jnp.sum(jnp.abs(motion.reaction.holding))
    # A guard is zero up to 100 roundings of the terms that cancel in it: forces of all contacts, velocities, or places. The
    # pivots are of the size of one.
    levels, slip_size, rate_size = [], [], []
    for i, one in enumerate(elements.each):
        tangent = [speeds[k] for k in one.tangent] or [zero]
        speed = jnp.max(jnp.stack(tangent))
        rates = [motion.sizes[k] for k in (*one.tangent, *((one.normal,) if one.opens else ()))]
        slip_size.append(1 + speed + (speeds[one.normal] if one.opens else zero))
        rate_size.append(jnp.max(jnp.stack(rates or [zero])))
        normal = jnp.where(mode.closed[i], 10 * force, reach)
        friction = jnp.where(mode.stick[i], 10 * force, speed)
        levels.append(jnp.stack([100 * eps * normal, 100 * eps * friction, jnp.full((), eps, dtype)]))
    cones = [force_at(scene, one).static.astype(dtype) * motion.normal[i] for i, one in enumerate(elements.each)]
    gap_rates = [
        (terms.row.velocity[one.normal], motion.rates[one.normal]) if one.opens else (zero, zero)
        for one in elements.each
    ]
    return ContactState(
        guards=values,
        levels=jnp.stack(levels),
        normal=motion.normal,
        holding=motion.reaction.holding,
        cone=jnp.stack(cones),
        slip=terms.slip,
        slip_rate=by_element(elements, motion.rates),
        slip_size=jnp.stack(slip_size),
        rate_size=jnp.stack(rate_size),
        gap=gaps(scene, elements, q, t),
        gap_velocity=jnp.stack([a for a, _ in gap_rates]),
        gap_rate=jnp.stack([b for _, b in gap_rates]),
        gap_size=reach,
    )
