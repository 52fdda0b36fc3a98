"""The functions of a motion with modes, of a scene whose unknown numbers are arguments: vector field, projection, conditions and
transitions, on states with the entries q, v and `slip`, the directions (n, 2) in which elements slide.

Directions are constants of a step (`step_constants`), renewed where it ends.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxdyn.compile import kernel
from jaxdyn.constraints.base import holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.forces.piecewise import Pieces, values_and_levels
from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.hybrid.dynamics import (
    StateTerms,
    by_element,
    conditions,
    directions,
    gaps,
    jumped,
    motion_at,
    rebounds,
    solve_rows,
    terms_at,
)
from jaxdyn.simulation.hybrid.machine import Laws
from jaxdyn.simulation.hybrid.modes import Elements, Mode, extended, force_at
from jaxdyn.simulation.hybrid.transitions import Change, Judged, Jumped, aligned, at_once, changed_mode
from jaxdyn.simulation.solvers.explicit import Plan
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, rate_to_velocity, retract, velocity_to_rate

_ROUNDS = 2


def laws_of(given: Callable, elements: Elements, solver: Any, y0) -> Laws:
    """Functions of a motion with modes.

    `given(unknown, positive=None)` -> (scene, generalized_force(q, v, t), switching(q, v, t)), of the numbers that are arguments,
    with forces in the pieces where the switching functions are `positive`; `y0`, a state.
    """

    def at(args, t, y):
        unknown, mode = args
        scene, generalized_force, _ = given(unknown, mode.positive)
        q, v = retract(scene.system, y["q"]), y["v"]
        terms = terms_at(scene, elements, q, v, t)
        return (
            scene,
            mode,
            q,
            v,
            terms,
            motion_at(scene, elements, mode, terms, y["slip"], generalized_force(q, v, t), q, v, t),
        )

    @jax.jit
    def field(t, y, args):
        scene, _, q, v, _, motion = at(args, t, y)
        return {"q": velocity_to_rate(scene.system, q, v), "v": motion.acceleration, "slip": jnp.zeros_like(y["slip"])}

    def project(t, y, error, args):
        unknown, mode = args
        return *put_back(given(unknown)[0], elements, mode, t, y, error), diffrax.RESULTS.successful

    plan = Plan(type(solver), field, project, ("slip",), False, *_shape_of(y0))

    def judge(args, t, y):
        y = plan.structure(y)
        scene, mode, q, v, terms, motion = at(args, t, y)
        judged = _judged(scene, elements, mode, terms, motion, y["slip"], q, v, t)
        values, levels = _switches(given(args[0])[2], mode.positive, q, v, t)
        return tuple(jnp.concatenate([own.reshape(-1), more]) for own, more in
                     ((judged.conditions, values), (judged.levels, levels)))  # fmt: skip

    def judge_all(unknown, mode, slip, t, q, v):
        scene, _, q, v, terms, motion = at((unknown, mode), t, {"q": q, "v": v, "slip": slip})
        return _judged(scene, elements, mode, terms, motion, slip, q, v, t)

    def jump(unknown, mode, slip, t, q, v):
        return _jumped(given(unknown)[0], elements, mode, slip, t, q, v)

    def transit(unknown, t, y, mode, slip, hit):
        y = plan.structure(y)
        q, v = y["q"], y["v"]
        scene, _, switching = given(unknown)
        hit, switched = elements.split(hit)
        mode = mode._replace(positive=mode.positive ^ switched)

        def judge_in(mode, slip, v):
            return kernel(judge_all)(unknown, mode, slip, t, q, v)

        def jump_in(mode, slip):
            return kernel(jump)(unknown, mode, slip, t, q, v)

        mode, slip, begins = at_once(elements, mode, slip, judge_in(mode, slip, v), hit)
        cones = jnp.stack([force_at(scene, one).static.astype(v.dtype) for one in elements.each])
        change = changed_mode(elements, cones, mode, slip, begins, v, jump_in, judge_in)
        # What an impact has carried across its zero.
        values, levels = _switches(switching, change.mode.positive, q, change.v, t)
        crossed = (values < -levels) & ~switched
        return change._replace(mode=change.mode._replace(positive=change.mode.positive ^ crossed))

    def land(unknown, mode, slip, t, y):
        y = plan.structure(y)
        jumped_state = kernel(jump)(unknown, mode, slip, t, y["q"], y["v"])
        return ravel_pytree(y | {"v": jumped_state.v})[0]

    def slip_of(y):
        return plan.structure(y)["slip"]

    def placed(y, v, slip):
        return ravel_pytree(plan.structure(y) | {"v": v, "slip": slip})[0]

    return Laws(plan, elements, judge, transit, land, solver.order(None), solver.error_order(None), slip_of, placed)


def _switches(switching: Callable, positive, q, v, t):
    """Switching functions with signs such that they are positive until one changes its sign, and their rounding levels, (k,)."""
    values, levels = values_and_levels(lambda q, v: switching(q, v, t), q, v)
    return jnp.where(positive, values, -values), levels


def laws_of_pieces(plan: Plan, pieces: Pieces, switching: Callable, order, error_order) -> Laws:
    """Of a motion whose only modes are the pieces of its forces.

    `plan` of steps; switching(t, y, args) -> values and rounding levels (k,). The arguments of both are followed by which of
    these are positive.
    """
    elements = Elements((), 0, 0, pieces)

    def inner(args):
        unknown, mode = args
        return (*unknown, mode.positive)

    def field(t, y, args):
        return plan.field(t, y, inner(args))

    def project(t, y, error, args):
        return plan.project(t, y, error, inner(args))  # pyright: ignore[reportOptionalCall]

    whole = plan._replace(field=field, project=None if plan.project is None else project)

    def judge(args, t, y):
        values, levels = switching(t, whole.structure(y), inner(args))
        return jnp.where(args[1].positive, values, -values), levels

    def transit(unknown, t, y, mode, slip, hit):
        changed = mode._replace(positive=mode.positive ^ hit)
        yes = jnp.ones((), bool)
        return Change(changed, slip, changed, slip, jnp.zeros((0,), y.dtype), yes, ~yes)

    def land(unknown, mode, slip, t, y):
        return y

    def slip_of(y):
        return jnp.zeros((0, 2), y.dtype)

    def placed(y, v, slip):
        return y

    return Laws(whole, elements, judge, transit, land, order, error_order, slip_of, placed)


def _shape_of(y0):
    leaves, tree = jax.tree.flatten(y0)
    return tree, tuple(x.shape for x in leaves)


def put_back(scene: Scene, elements: Elements, mode: Mode, t, y, error):
    """q and v by the least change onto the rows that act, and the error (or None) without its part normal to them."""
    whole, dtype = extended(scene), y["v"].dtype
    q, v = retract(scene.system, y["q"]), y["v"]
    terms = terms_at(scene, elements, q, v, t)
    holonomic = holonomic_rows(layout(whole))
    active = elements.active(mode).astype(dtype)
    holds = jnp.zeros((elements.count,), dtype).at[holonomic].set(1.0) * active

    def change(wanted, which):
        """The least velocities that change the rows by `wanted`."""
        lam = solve_rows(terms.Y * which[None], which, (wanted * which)[:, None])[:, 0]
        return terms.metric.unwhiten(matmul(terms.Y, lam))

    tangent = None
    if error is not None:
        e = rate_to_velocity(scene.system, q, error["q"])
        e = e - change(matmul(terms.row.A, e), holds)
        tangent = error | {
            "q": velocity_to_rate(scene.system, q, e),
            "v": error["v"] - change(matmul(terms.row.A, error["v"]), active),
        }
    blank = jnp.zeros((elements.count,), dtype)
    if holonomic.size:
        for _ in range(_ROUNDS):
            q = displace(scene.system, q, -change(blank.at[holonomic].set(position_residual(whole, q, t)), holds))
    for _ in range(_ROUNDS):
        v = v - change(velocity_residual(whole, q, v, t), active)
    slip = by_element(elements, velocity_residual(whole, q, v, t))
    return y | {"q": q, "v": v, "slip": aligned(slip, y["slip"])}, tangent


def _jumped(scene: Scene, elements: Elements, mode: Mode, slip, t, q, v) -> Jumped:
    terms = terms_at(scene, elements, q, v, t)
    along, rebound = directions(scene, elements, jnp.zeros_like(slip), slip), rebounds(scene, elements, terms)
    after, pushed = jumped(scene, elements, mode, terms, along, v, rebound)
    rates = matmul(terms.row.A, after - v) + terms.row.velocity
    gap = jnp.stack([rates[one.normal] if one.opens else jnp.zeros((), v.dtype) for one in elements.each]) - rebound
    M = mass_matrix(scene.system, q, t)
    size = jnp.max(jnp.abs(matmul(M, v))) + jnp.max(jnp.abs(M)) + jnp.max(jnp.abs(pushed.multipliers))
    return Jumped(after, pushed.normal, pushed.holding, by_element(elements, rates), gap, rebound, size)


def _judged(scene: Scene, elements: Elements, mode: Mode, terms: StateTerms, motion, slip, q, v, t) -> Judged:
    dtype, eps = v.dtype, float(jnp.finfo(v.dtype).eps)
    values = conditions(scene, elements, mode, terms, motion, slip, q, t)
    speeds = jnp.sum(jnp.abs(terms.row.A) * jnp.abs(v)[None], 1)
    zero = jnp.zeros((), dtype)
    reach = 1 + jnp.max(jnp.abs(q))
    force = jnp.sum(jnp.abs(motion.normal)) + jnp.sum(jnp.abs(motion.pushed.holding))
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
    cone = jnp.stack(
        [force_at(scene, one).static.astype(dtype) * motion.normal[i] for i, one in enumerate(elements.each)]
    )
    gap_rates = [(terms.row.velocity[one.normal], motion.rates[one.normal]) if one.opens else (zero, zero)
                 for one in elements.each]  # fmt: skip
    return Judged(
        values,
        jnp.stack(levels),
        motion.normal,
        motion.pushed.holding,
        cone,
        terms.slip,
        by_element(elements, motion.rates),
        jnp.stack(slip_size),
        jnp.stack(rate_size),
        gaps(scene, elements, q, t),
        jnp.stack([a for a, _ in gap_rates]),
        jnp.stack([b for _, b in gap_rates]),
        reach,
    )
