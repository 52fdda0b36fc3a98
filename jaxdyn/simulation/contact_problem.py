"""Complementarity problem of the contacts, frictions and joint limits of a step (`contact_steps`)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdyn.compile import solver_of
from jaxdyn.constraints.base import constraint_jacobian, position_residual, velocity_residual
from jaxdyn.constraints.dynamics import constrained_dynamics
from jaxdyn.constraints.projection import project_state
from jaxdyn.constraints.rank import regular_gram
from jaxdyn.constraints.redundancy import add_constraints
from jaxdyn.contact import coulomb
from jaxdyn.contact.unilateral import DryFriction, WithModes
from jaxdyn.dynamics.quantities import bias_force, mass_matrix
from jaxdyn.forces.piecewise import Pieces
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import warn
from jaxdyn.model.topology import KINDS
from jaxdyn.model.tree import Model
from jaxdyn.simulation.hybrid.modes import elements_of, extend, force_at, normal_load
from jaxdyn.systems.mass_factor import MassFactor, cholesky, mass_factor, solve_cholesky
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace

# An approach counts as an impact, with restitution, above this many times what forces change in a step: a rebound from a slower
# one would end within a few steps.
_IMPACT = 2.0
# Contacts up to which a step takes milliseconds.
_MANY = 16
_OF_SLIP = 0.1  # weight of slips beside gaps, where velocities are made consistent: gaps close


class Contacts(NamedTuple):
    """Contacts and frictions of a scene in the order of the cones: two directions of slip, one, and none; joint limits.

    A friction is a contact whose normal impulse moves nothing, with a bound that makes it the load's. Where the load is the
    multiplier of a constraint, the bound moves with the impulses of the others, on which the multiplier depends.

    - `elements`: of `simulation.hybrid.modes`; `order`: their indices in the order of the cones.
    - `has_static`: whether an element has a coefficient at rest of its own.
    - `limited`: indices in q and v of the joints whose limits hold. `own`: number of rows of the scene's constraints.
    """

    elements: tuple
    order: tuple[int, ...]
    limited: tuple[tuple[int, int], ...]
    own: int
    has_static: bool

    @property
    def sizes(self) -> list[int]:
        """Dimensions of the cones."""
        return [1 + len(self.elements[i].tangent) for i in self.order] + [1] * len(self.limited)

    @property
    def closing(self) -> list[bool]:
        """Flags of the cones with a gap: all but those of frictions."""
        return [self.elements[i].opens for i in self.order] + [True] * len(self.limited)

    @property
    def groups(self) -> coulomb.Groups:
        """Numbers and dimensions of the cones."""
        return tuple(x for x in ((self.sizes.count(size), size) for size in (3, 2, 1)) if x[0])

    @property
    def rows(self) -> np.ndarray:
        """Rows of the elements among those of the extended scene, in the order of the cones; -1 for a friction's normal."""
        each = [self.elements[i] for i in self.order]
        return np.array([k for one in each for k in (one.normal if one.opens else -1, *one.tangent)], int)

    @property
    def load_rows(self) -> list[tuple[int, int]]:
        """Cones whose load is the multiplier of a constraint, and its row among the scene's own."""
        each = [self.elements[i] for i in self.order]
        return [(k, one.normal) for k, one in enumerate(each) if not one.opens and one.normal >= 0]

    @property
    def normals(self) -> np.ndarray:
        """Entries of the normals in the order of the cones."""
        return np.cumsum([0, *self.sizes])[:-1]


def contacts_of(scene: Scene, limits: str | None) -> Contacts:
    """Contacts of a scene. **Raises:** ValueError for frictions that are smoothed."""
    for force in scene.forces:
        if isinstance(force, DryFriction) and force.smoothing is not None:
            raise ValueError(
                f"stepper: DryFriction {force.name!r} has smoothing, and sticks in steps without it; leave it out, or take "
                "jd.forces.CoulombFriction"
            )
    elements = elements_of(scene, Pieces((), ())) if any(isinstance(f, WithModes) for f in scene.forces) else None
    each = () if elements is None else elements.each
    order = sorted(range(len(each)), key=lambda i: -len(each[i].tangent))
    if len(order) > _MANY:
        warn(
            f"stepper: the scene has {len(order)} contacts and frictions, and a step takes time with their cube, seconds or "
            'minutes to compile; list the links that touch, or their lowest corners: contacts={"foot": 1} of a reader, '
            "jd.contact.shape_contacts(..., lowest=1)",
            UserWarning,
        )
    return Contacts(
        each,
        tuple(order),
        _joints_with_limits(scene, limits),
        0 if elements is None else elements.own,
        any(force_at(scene, one).has_static for one in each),
    )


def _joints_with_limits(scene: Scene, limits: str | None) -> tuple[tuple[int, int], ...]:
    """Indices in q and v of the joints of one coordinate that have a limit."""
    if limits is None:
        return ()
    if limits != "hold":
        raise ValueError(f"stepper: limits is {limits!r}; choose 'hold' or None")
    model = scene.system
    if not isinstance(model, Model):
        raise ValueError(
            f"stepper: limits is 'hold', and a {type(model).__name__} has no joint limits; pass limits=None"
        )
    top, places = model.topology, []
    for kind, at_q, at_v in zip(top.kinds, top.q_slices, top.v_slices, strict=True):
        if KINDS[kind].nq == KINDS[kind].nv == 1:
            places.append((at_q.start, at_v.start))
    return tuple(places)


class _Terms(NamedTuple):
    """Contacts at a configuration: gaps (k,), rows J (m, nv), and velocities J v - b at a velocity."""

    gap: Array
    J: Array
    velocity: Any
    side: Array  # of joint limits: 1 where the lower one is nearer, else -1


def contact_terms(contacts: Contacts, scene: Scene, q, v, t) -> _Terms:
    """Contacts and joint limits at q; `scene` is the extended one."""
    parts_gap, parts_J, parts_velocity, side = [], [], [], jnp.zeros((0,), q.dtype)
    if contacts.elements:
        own, far = _own_rows(contacts, scene), jnp.ones((), q.dtype)
        rows = contacts.rows - contacts.own
        parts_gap.append(_gaps(contacts, own, q, t))
        is_row = contacts.rows >= 0
        J, velocity = constraint_jacobian(own, q, t), velocity_residual(own, q, v, t)
        parts_J.append(
            jnp.stack([J[k] if some else jnp.zeros_like(J[0]) for k, some in zip(rows, is_row, strict=True)])
        )
        parts_velocity.append(
            jnp.stack([velocity[k] if some else 0 * far for k, some in zip(rows, is_row, strict=True)])
        )
    if contacts.limited:
        at_q, at_v = (np.array(x, int) for x in zip(*contacts.limited, strict=True))
        lower, upper = (jnp.asarray(x, q.dtype)[at_q] for x in (scene.system.lower, scene.system.upper))
        # A joint has one row: it touches one of its limits at a time.
        side = jnp.where(q[at_q] - lower <= upper - q[at_q], 1.0, -1.0).astype(q.dtype)
        limit = jnp.where(side > 0, lower, upper)
        # A joint without a limit is far from it.
        bounded = jnp.isfinite(limit)
        gap = jnp.where(bounded, side * (q[at_q] - jnp.where(bounded, limit, 0.0)), 1e6)
        J = jnp.zeros((len(at_q), scene.nv), q.dtype).at[np.arange(len(at_q)), at_v].set(side)
        parts_gap.append(gap)
        parts_J.append(J)
        parts_velocity.append(side * v[at_v])
    gap, rows, velocity = map(jnp.concatenate, (parts_gap, parts_J, parts_velocity))
    return _Terms(gap, rows, velocity, side)


def _own_rows(contacts: Contacts, scene: Scene) -> Scene:
    """The rows of the contacts alone, which come behind those of the scene's constraints."""
    return Scene(scene.system, scene.constraints[len(scene.constraints) - len(contacts.elements) :])


def _gaps(contacts: Contacts, own: Scene, q, t) -> Array:
    """Gaps of the contacts in their order; `own` as of `_own_rows`."""
    gaps = position_residual(own, q, t)
    # Frictions have no gap, and are far from closing one.
    opening = np.cumsum([one.opens for one in contacts.elements]) - 1
    far = jnp.ones((), q.dtype)
    return jnp.stack([gaps[int(opening[i])] if contacts.elements[i].opens else far for i in contacts.order])


class _Flow(NamedTuple):
    """Motion without contacts at the middle of a step: `place`, the factor of M, and accelerations.

    `acceleration(v, w)`: at the velocity v, with forces of the scene at the velocity w, and the multipliers (nc,) of the
    constraints. `drives`: their states.
    """

    place: Array
    metric: MassFactor
    acceleration: Callable
    drives: Array


def _flow(scene: Scene, q, v, z, tau, t, h) -> _Flow:
    """Motion of a scene without contacts."""
    system, middle, unforced = scene.system, t + 0.5 * h, scene.without_forces
    place = displace(system, q, 0.5 * h * v)
    metric = mass_factor(mass_matrix(system, place, middle))
    # States of drives in the middle, by their rates at the start.
    drives: Any = z + 0.5 * h * scene.drive_torque(q, v, t, tau, z)[1] if z.size else None

    def acceleration(v, v_of_forces):
        force = scene.drive_torque(place, v_of_forces, middle, tau, drives)[0]
        applied = scene.applied_force(place, v_of_forces, middle)
        force = force if applied is None else force + applied
        if scene.constraints:
            motion = constrained_dynamics(unforced, place, v, force, middle)
            return motion.acceleration, motion.multipliers
        return metric.solve(force - bias_force(system, place, v, middle)), jnp.zeros((0,), v.dtype)

    return _Flow(place, metric, acceleration, z if drives is None else drives)


def _bounds(contacts: Contacts, scene: Scene, terms: _Terms, gaps, v, free, h):
    """Bounds (k,) of the normal velocities; v (nv,) is the velocity at the start, and `gaps` are those of contacts there; `free`
    (nv,) is the velocity without contact forces."""
    at = contacts.normals
    change, free = matmul(terms.J[at], free - v), terms.velocity[at]
    now = free - change
    # Velocities by which curved ways of the step have closed gaps: of a rolling ball, whose velocity turns with the body.
    count = len(contacts.elements)
    bent = jnp.zeros_like(now).at[:count].set((terms.gap[:count] - gaps) / h - now[:count])
    restitution = [
        force_at(scene, contacts.elements[i]).restitution if contacts.elements[i].opens else jnp.zeros(())
        for i in contacts.order
    ]
    e = jnp.stack([*restitution, *[jnp.zeros(())] * len(contacts.limited)]).astype(free.dtype)
    reach = -terms.gap / h
    # The approach of a start that is in contact, which no step before has reduced, comes out by restitution alone.
    driven = jnp.maximum(jnp.minimum(-free, jnp.abs(change)), bent)
    bound = jnp.where(terms.gap < 0, jnp.minimum(reach, driven), reach)
    # Closing in the next step, and faster than forces close it.
    is_impact = (free < bound) & (-now > _IMPACT * jnp.abs(change)) & (e > 0)
    # Under a constant force, which changes the velocity by d in the step, the velocity u after the way h u is the root of
    # (u + d)^2 - d^2: so restitution of one keeps the energy.
    speed = jnp.sqrt(jnp.where(is_impact, free * free - change * change, jnp.ones_like(free)))
    return jnp.where(is_impact, jnp.maximum(bound, e * speed), bound)


class _Problem(NamedTuple):
    """Complementarity problem of a step, and what its impulses change.

    `gram` (m, m) and `relative` (m,) are in units (m,) in which rows have a mean length of one; see `scaled`.
    """

    middle: Array  # configuration and states of drives in the middle of the step
    drives: Array
    place: Array  # at its end, with the velocity without contact forces
    velocity: Array
    metric: MassFactor
    Y: Array
    gram: Array
    relative: Array
    unit: Array
    side: Array


class Scaled(NamedTuple):
    """Problem in coordinates in which friction coefficients are one: W (m, m), q (m,) and `scale` (m,) as of `coulomb.solve`.

    Impulses are `scale` x `size`.
    """

    W: Array
    q: Array
    scale: Array
    size: Array


def scaled(contacts: Contacts, problem: _Problem, friction) -> Scaled:
    """Problem with the coefficients `friction` (k,) of the cones."""
    one, zero, parts, sizes, start = jnp.ones((), problem.unit.dtype), 0.0, [], [], 0
    factor = []
    for size, mu in zip(contacts.sizes, friction, strict=True):
        factor += [one, *[mu] * (size - 1)]
    factor = jnp.stack(factor)
    q = problem.relative * factor
    for size in contacts.sizes:
        parts.append(jax.lax.stop_gradient(q[start : start + size]))
        # Contacts that are far away do not count: their large bounds would hide the velocities of the others.
        sizes.append(jnp.where(parts[-1][0] < 0, jnp.max(jnp.abs(parts[-1])), zero))
        start += size
    size = jnp.max(jnp.stack(sizes))
    size = jnp.where(size > 0, size, one)
    return Scaled(problem.gram * factor[:, None] * factor[None], q / size, problem.unit * factor, size)


def load_signs(contacts: Contacts, problem: Scaled, x) -> Array:
    """Signs (m,) of the loads that are multipliers, for impulses x (m,), at the normals of their frictions; 1 elsewhere."""
    signs = jnp.ones_like(x)
    for k, _ in contacts.load_rows:
        at = int(contacts.normals[k])
        load = x[at] - problem.q[at] - jnp.sum(problem.W[at] * x)
        signs = signs.at[at].set(jnp.where(load < 0, -1.0, 1.0))
    return jax.lax.stop_gradient(signs)


def with_signs(contacts: Contacts, problem: Scaled, signs) -> Scaled:
    """Problem in which loads are their sizes, if they have these signs (m,)."""
    if not contacts.load_rows:
        return problem
    unit = jnp.eye(len(signs), dtype=signs.dtype)
    return problem._replace(W=jnp.where(unit > 0, problem.W, problem.W * signs[:, None]), q=problem.q * signs)


def friction_of(contacts: Contacts, scene: Scene, dtype, at_rest=None) -> list:
    """Coefficients of the cones; of those `at_rest` (k,) that at rest."""
    coefficients = []
    for k, i in enumerate(contacts.order):
        force = force_at(scene, contacts.elements[i])
        mu = force.coefficient.astype(dtype)
        if at_rest is not None and force.has_static:
            mu = jnp.where(at_rest[k], force.static.astype(dtype), mu)
        coefficients.append(mu)
    return coefficients + [jnp.ones((), dtype)] * len(contacts.limited)


def slip_speeds(contacts: Contacts, velocities) -> Array:
    """Lengths (k,) of the velocities of slip of the cones, of those of their rows (m,)."""
    speeds = []
    for at, size in zip(contacts.normals, contacts.sizes, strict=True):
        square = jnp.sum(velocities[at + 1 : at + size] ** 2)
        speeds.append(jnp.sqrt(jax.lax.stop_gradient(square)))
    return jnp.stack(speeds)


def rests_at(contacts: Contacts, scene: Scene, q, v, t) -> Array:
    """Mask (k,) of the cones that do not slip at a state, up to the error of the solution of a step."""
    terms = contact_terms(contacts, extend(scene), q, v, t)
    sizes = slip_speeds(contacts, matmul(jnp.abs(terms.J), jnp.abs(v)))
    return slip_speeds(contacts, terms.velocity) <= float(jnp.finfo(q.dtype).eps) ** (1 / 3) * (1 + sizes)


def pose(contacts: Contacts, scene: Scene, q, v, z, tau, t, h) -> _Problem:
    """Problem of a step from a state."""
    whole = extend(scene)
    bare = add_constraints(scene, (), whole.forces)
    flow, end = _flow(bare, q, v, z, tau, t, h), t + h
    place, metric, start = displace(scene.system, flow.place, 0.5 * h * v), flow.metric, flow.acceleration(v, v)[0]
    free = v + h * start
    terms = contact_terms(contacts, whole, place, free, end)
    gaps = _gaps(contacts, _own_rows(contacts, whole), q, t) if contacts.elements else jnp.zeros((0,), q.dtype)
    middle, none = t + 0.5 * h, jnp.zeros((), q.dtype)
    loads = [normal_load(scene, contacts.elements[i], flow.place, v, middle) for i in contacts.order]
    loads = jnp.stack([*loads, *[none] * len(contacts.limited)])
    closes = jnp.any(terms.velocity[contacts.normals] < _bounds(contacts, scene, terms, gaps, v, free, h))
    closes = closes | jnp.any(loads > 0) | bool(contacts.load_rows)
    # Halfway to a velocity without contact forces, damping would be that of a motion that contacts prevent.
    half = v + 0.5 * h * start
    rate, multipliers = flow.acceleration(half, jnp.where(closes, v, half))
    change = h * (rate - start)
    free, terms = free + change, terms._replace(velocity=terms.velocity + matmul(terms.J, change))
    bound = _bounds(contacts, scene, terms, gaps, v, free, h)
    place = jnp.where(closes, place, displace(scene.system, flow.place, 0.5 * h * free))
    if not scene.constraints:
        Y, reaction = metric.whiten(terms.J.T), _Reaction(h * loads, {})
        return _in_units(contacts, flow, Y, place, free, terms, terms.velocity, bound, reaction)
    place = project_state(bare, place, free, end)[0]
    terms = contact_terms(contacts, whole, place, free, end)
    bound = _bounds(contacts, scene, terms, gaps, v, free, h)
    # The rows of the scene's constraints are eliminated: what is left of Y is orthogonal to them.
    of_loops, Y = metric.whiten(constraint_jacobian(bare, place, end).T), metric.whiten(terms.J.T)
    factor = cholesky(regular_gram(of_loops))
    # Impulses of the constraints: those that close them at the end, and those against the impulses of the contacts.
    closing = -solve_cholesky(factor, velocity_residual(bare, place, free, end))
    against = -solve_cholesky(factor, matmul(of_loops.T, Y))
    closed, rest = matmul(of_loops, closing), Y + matmul(of_loops, against)
    velocities = terms.velocity + matmul(Y.T, closed)
    loads, total = h * loads, h * multipliers + closing
    for k, row in contacts.load_rows:
        loads = loads.at[k].set(total[row])
    reaction = _Reaction(loads, {k: against[row] for k, row in contacts.load_rows})
    return _in_units(contacts, flow, rest, place, free + metric.unwhiten(closed), terms, velocities, bound, reaction)


class _Reaction(NamedTuple):
    """Impulses of loads (k,), N s, of either sign where they are multipliers, and their rates (m,) by those of the cones."""

    loads: Array
    rates: dict[int, Array]


def _in_units(contacts: Contacts, flow: _Flow, Y, place, velocity, terms, velocities, bound, reaction: _Reaction):
    """Problem with rows of a mean length of one."""
    one, gram = jnp.ones((), Y.dtype), matmul(Y.T, Y)
    # Coulomb's law is the same in all units; the width of a smooth one is a speed in these, which change with the place.
    squares = jnp.diagonal(gram)
    units, start = [], 0
    for size in contacts.sizes:
        mean = jnp.mean(squares[start : start + size])
        units += [jnp.where(mean > 0, 1 / jnp.sqrt(jnp.where(mean > 0, mean, one)), one)] * size
        start += size
    unit = jnp.stack(units)
    relative = unit * velocities.at[contacts.normals].add(-bound)
    gram = gram * unit[:, None] * unit[None]
    # The normal impulse of a friction moves nothing but a mass of its own.
    for k, (at, closes) in enumerate(zip(contacts.normals, contacts.closing, strict=True)):
        if not closes:
            if k in reaction.rates:
                gram = gram.at[at].set(-reaction.rates[k] * unit / unit[at])
            gram, relative = gram.at[at, at].set(one), relative.at[at].set(-reaction.loads[k] / unit[at])
    return _Problem(flow.place, flow.drives, place, velocity, flow.metric, Y, gram, relative, unit, terms.side)


def may_contradict(contacts: Contacts, scene: Scene) -> bool:
    """Decide whether rows may depend on each other: by their number, or because contacts share a body."""
    bodies = [getattr(force_at(scene, one).contact, "body", None) for one in contacts.elements if one.opens]
    return sum(contacts.sizes) + contacts.own > scene.nv or len(set(bodies)) < len(bodies)


def closing_cones(contacts: Contacts, problem: Scaled, x) -> Array:
    """Mask (k,) of the contacts that close by their velocities, or in impulses x (m,) that push others onto them."""
    minimum = 1e-6 * jnp.max(jnp.abs(x))
    normals, closing = contacts.normals, np.array(contacts.closing)
    return closing & ((problem.q[normals] < 0) | (x[normals] > minimum))


def make_consistent(contacts: Contacts, problem: Scaled, closes) -> Scaled:
    """Problem with velocities of the contacts that close, (k,), projected on those that impulses can stop.

    Where an edge falls on its two ends, these close their gaps with different velocities, and cannot both stick: their distance
    is constant, and the edge is oblique. A slip of the second order is left, which would have all of their friction: often such
    problems have no solution that Newton's method finds. The slip is taken as a stop.
    """
    act, q, W = [], problem.q, problem.W
    for is_closing, size in zip(closes.astype(q.dtype), contacts.sizes, strict=True):
        act += [is_closing, *[_OF_SLIP * is_closing] * (size - 1)]
    act = jnp.stack(act)
    gram, wanted = W * act[:, None] * act[None], q * act
    # Between the squares of independent rows and rounding. The second step leaves a share of its square.
    shift = float(jnp.finfo(q.dtype).eps) ** 0.55
    shifted = gram + shift * jnp.eye(len(act), dtype=q.dtype)
    solve = solver_of(shifted)
    x = solve(wanted[:, None])[:, 0]
    x = x + solve((wanted - matmul(gram, x))[:, None])[:, 0]
    rest = wanted - matmul(gram, x)
    return problem._replace(q=q - jnp.where(act > 0, rest / jnp.where(act > 0, act, 1), 0))
