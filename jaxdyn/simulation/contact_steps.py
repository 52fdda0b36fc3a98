r"""Steps of fixed length through contacts: time stepping, in which impacts and forces are impulses of a step.

A step of length h from (q, v) has the velocity v_f = v + h a(q + h v/2, v + h a/2) without contact forces, by the midpoint rule,
with the multipliers of the scene's constraints in a, and the scene's forces at v where a contact closes. At the end q' = q + h v,
with the rows A of the constraints and J of the contacts there and M at the midpoint, the velocity v' satisfies

    M (v' - v_f) = A^T lam + J^T p,   A v' = b,   Coulomb's law between p and J v' (`jaxdyn.contact.coulomb`),

where the normal velocity counts from a bound n . v' >= c:

    c = -gap / h             the contact closes in the next step at the earliest,
    c = min(-gap / h, -u)    for a gap below zero; u = n . v_f: no more velocity comes out than has come in,
    c = e |u|                for an impact: the contact closes in the next step, with restitution e.

If no contact closes, q' is that of the midpoint rule, q + h v/2 + h v'/2, and the step is of order two. A contact at rest has
v = 0, and so q' = q to rounding: nothing creeps. q' is projected onto the holonomic constraints before the solve.

Sources: Moreau, Unilateral contact and dry friction in finite freedom dynamics (1988); Stewart & Trinkle (1996); Acary &
Brogliato, Numerical methods for nonsmooth dynamical systems (2008), chapters 10 and 13.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import implicit, invalidate_derivatives, kernel, value_and_jvp
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import constraint_jacobian, position_residual, velocity_residual
from jaxdyn.constraints.codes import RESULTS, Outcome, Result
from jaxdyn.constraints.dynamics import constrained_dynamics
from jaxdyn.constraints.projection import project_state
from jaxdyn.constraints.rank import regular_gram
from jaxdyn.contact import coulomb
from jaxdyn.contact.unilateral import UnilateralContact, WithModes
from jaxdyn.dynamics.quantities import bias_force, mass_matrix
from jaxdyn.forces.piecewise import Pieces
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.joints import KINDS
from jaxdyn.model.tree import Model
from jaxdyn.simulation.hybrid.modes import elements_of, extend, force_at
from jaxdyn.systems.mass_factor import MassFactor, cholesky, mass_factor, solve_cholesky
from jaxdyn.systems.scene import Scene, has_drives
from jaxdyn.systems.system import displace

# An approach counts as an impact, with restitution, above this many times what forces change in a step: a rebound from a slower
# one would end within a few steps.
_IMPACT = 2.0


class ContactStep(Outcome):
    """Contact forces of a step.

    - `forces`: by the contact's name, (n,), N: the normal force, and the friction along the rows of slip; means over the step, so
      that those of an impact are its impulse over the step's length.
    - `limit_forces` (nv,): of joint limits, N or N m.
    - `result`: one of `jd.RESULTS`. Where it is not `successful` the state is NaN, with derivatives of NaN.
    - `residual` (): of Coulomb's law, in numbers scaled to one.
    """

    forces: dict[str, Float[Array, "..."]]
    limit_forces: Float[Array, " nv"]
    result: Any
    residual: Float[Array, ""]


class Contacts(NamedTuple):
    """Contacts of a scene in the order of the cones: those with two directions of slip, with one, and without; joint limits.

    - `elements`: of `simulation.hybrid.modes`; `order`: their indices in the order of the cones.
    - `limited`: indices in q and v of the joints whose limits hold. `own`: number of rows of the scene's constraints.
    """

    elements: tuple
    order: tuple[int, ...]
    limited: tuple[tuple[int, int], ...]
    own: int

    @property
    def groups(self) -> coulomb.Groups:
        """Numbers and dimensions of the cones."""
        sizes = [1 + len(self.elements[i].tangent) for i in self.order]
        groups = [(sizes.count(size), size) for size in (3, 2)]
        return tuple(x for x in (*groups, (sizes.count(1) + len(self.limited), 1)) if x[0])

    @property
    def rows(self) -> np.ndarray:
        """Rows of the contacts among those of the extended scene, in the order of the cones."""
        chosen = [k for i in self.order for k in (self.elements[i].normal, *self.elements[i].tangent)]
        return np.array(chosen, int)

    @property
    def normals(self) -> np.ndarray:
        """Entries of the normals in the order of the cones."""
        sizes = [1 + len(self.elements[i].tangent) for i in self.order] + [1] * len(self.limited)
        return np.cumsum([0, *sizes])[:-1]


def contacts_of(scene: Scene, limits: str | None) -> Contacts:
    """Contacts of a scene. **Raises:** ValueError for other forces with modes, and drives with states."""
    for force in scene.forces:
        if isinstance(force, WithModes) and not isinstance(force, UnilateralContact):
            raise ValueError(
                f"stepper: {type(force).__name__} {force.name!r} sticks and slips by events, which steps of one length do not "
                "have; take jd.simulate, or jd.forces.CoulombFriction in its place"
            )
        if isinstance(force, UnilateralContact):
            _check_static(force)
    if has_drives(scene):
        raise ValueError(
            "stepper: drives with states (jd.forces.DriveDynamics) have no steps with contacts or limits='hold'"
        )
    elements = elements_of(scene, Pieces((), ())) if any(isinstance(f, WithModes) for f in scene.forces) else None
    each = () if elements is None else elements.each
    order = sorted(range(len(each)), key=lambda i: -len(each[i].tangent))
    return Contacts(each, tuple(order), _joints_with_limits(scene, limits), 0 if elements is None else elements.own)


def _check_static(force: UnilateralContact) -> None:
    pair = (force.coefficient, force.static)
    if is_concrete(pair) and (np.asarray(pair[0]) != np.asarray(pair[1])).any():
        raise ValueError(
            f"stepper: contact {force.name!r} has friction {pair[0]} and static {pair[1]}; time stepping has one coefficient: "
            "leave static out, or take jd.simulate"
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


class _Step(NamedTuple):
    q: Array
    v: Array
    impulses: Array  # (m,), N s
    x: Array  # of `coulomb.solve`
    residual: Array
    solved: Array
    steps: Array
    regular: Array  # whether the mass matrix is positive definite


class _Terms(NamedTuple):
    """Contacts at a configuration: gaps (k,), rows J (m, nv), and velocities J v - b at a velocity."""

    gap: Array
    J: Array
    velocity: Any
    side: Array  # of joint limits: 1 where the lower one is nearer, else -1


def contact_step(contacts: Contacts, scene: Scene, q, v, tau, t, h, smoothing) -> tuple[Array, Array, ContactStep]:
    """State after a step of length h (), and its contact forces; `smoothing` () in J."""
    found = _advance(contacts, scene, q, v, tau, t, h, smoothing)
    fine = found.solved & found.regular & jnp.isfinite(found.q).all() & jnp.isfinite(found.v).all()
    result = RESULTS.where(found.solved, RESULTS.successful, RESULTS.no_contact_impulses)  # pyright: ignore[reportArgumentType]
    result = RESULTS.where(fine | ~found.solved, result, RESULTS.nonfinite)  # pyright: ignore[reportArgumentType]
    result = RESULTS.where(found.regular, result, RESULTS.singular_mass_matrix)  # pyright: ignore[reportArgumentType]
    q1, v1, forces = (jnp.where(fine, x, jnp.nan) for x in (found.q, found.v, found.impulses / h))
    q1, v1, forces = invalidate_derivatives((q1, v1, forces), ~fine, (scene, q, v, tau, t, h))
    by_name, start = {}, 0
    for i in contacts.order:
        size = 1 + len(contacts.elements[i].tangent)
        by_name[contacts.elements[i].name] = forces[start : start + size]
        start += size
    limit_forces = jnp.zeros_like(v)
    if contacts.limited:
        limit_forces = limit_forces.at[np.array([k for _, k in contacts.limited])].add(forces[start:])
    by_name = {one.name: by_name[one.name] for one in contacts.elements}
    return q1, v1, ContactStep(by_name, limit_forces, result, found.residual)


def mean_of_steps(steps: ContactStep) -> ContactStep:
    """Mean forces of several steps, the first code that is not `successful`, and the largest residual."""
    forces, limit_forces = jax.tree.map(lambda x: jnp.mean(x, 0), (steps.forces, steps.limit_forces))
    codes = steps.result.index
    first = codes[jnp.argmax(codes != RESULTS.successful.index)]
    return ContactStep(forces, limit_forces, Result(first), jnp.max(steps.residual))


def _advance(contacts: Contacts, scene: Scene, *state) -> _Step:
    def solve(scene, *state):
        return kernel(_step, static=1, derivative=False)(contacts, scene, *state)

    def tangent(scene, *rest):
        *state, steps = rest
        found = _advance(contacts, scene, *state)
        x = jax.lax.stop_gradient(found.x)

        def again(scene, *args):
            return kernel(_step, static=1)(contacts, scene, *args)

        _, change = value_and_jvp(again, (scene, *state, x), [*steps, None])
        return found, jax.tree.map(jnp.zeros_like, found) if change is None else _change_without_flags(found, change)

    return implicit(scene, state, solve, tangent)


def _change_without_flags(found: _Step, change: _Step) -> _Step:
    """The change with no derivative of flags and of the residual."""
    float0 = lambda x: np.zeros(jnp.shape(x), jax.dtypes.float0)  # noqa: E731
    return change._replace(
        residual=jnp.zeros_like(found.residual),
        steps=jnp.zeros_like(found.steps),
        solved=float0(found.solved),
        regular=float0(found.regular),
    )


def _terms(contacts: Contacts, scene: Scene, q, v, t) -> _Terms:
    """Contacts and joint limits at q; `scene` is the extended one."""
    parts_gap, parts_J, parts_velocity, side = [], [], [], jnp.zeros((0,), q.dtype)
    if contacts.elements:
        # The rows of the contacts alone, which come behind those of the scene's constraints.
        own = Scene(scene.system, scene.constraints[len(scene.constraints) - len(contacts.elements) :])
        rows = contacts.rows - contacts.own
        gaps = position_residual(own, q, t)
        parts_gap.append(gaps[np.array(contacts.order, int)])
        parts_J.append(constraint_jacobian(own, q, t)[rows])
        parts_velocity.append(velocity_residual(own, q, v, t)[rows])
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


class _Flow(NamedTuple):
    """Motion without contacts at the middle of a step: `place`, the factor of M, and accelerations.

    `acceleration(v, w)`: at the velocity v, with forces of the scene at the velocity w.
    """

    place: Array
    metric: MassFactor
    acceleration: Callable


def _flow(scene: Scene, q, v, tau, t, h) -> _Flow:
    """Motion of a scene without contacts."""
    system, middle, unforced = scene.system, t + 0.5 * h, Scene(scene.system, scene.constraints)
    place = displace(system, q, 0.5 * h * v)
    metric = mass_factor(mass_matrix(system, place, middle))

    def acceleration(v, v_of_forces):
        force = scene.drive_torque(place, v_of_forces, middle, tau)[0]
        applied = scene.applied_force(place, v_of_forces, middle)
        force = force if applied is None else force + applied
        if scene.constraints:
            return constrained_dynamics(unforced, place, v, force, middle).acceleration
        return metric.solve(force - bias_force(system, place, v, middle))

    return _Flow(place, metric, acceleration)


def _bounds(contacts: Contacts, scene: Scene, terms: _Terms, v, free, h):
    """Bounds (k,) of the normal velocities; v (nv,) is the velocity at the start, `free` that without contact forces."""
    at = contacts.normals
    change, free = matmul(terms.J[at], free - v), terms.velocity[at]
    now = free - change
    restitution = [force_at(scene, contacts.elements[i]).restitution for i in contacts.order]
    e = jnp.stack([*restitution, *[jnp.zeros(())] * len(contacts.limited)]).astype(free.dtype)
    reach = -terms.gap / h
    bound = jnp.where(terms.gap < 0, jnp.minimum(reach, -free), reach)
    # Closing in the next step, and faster than forces close it.
    is_impact = (free < bound) & (-now > _IMPACT * jnp.abs(change)) & (e > 0)
    # Under a constant force, which changes the velocity by d in the step, the velocity u after the way h u is the root of
    # (u + d)^2 - d^2: so restitution of one keeps the energy.
    speed = jnp.sqrt(jnp.where(is_impact, free * free - change * change, jnp.ones_like(free)))
    return jnp.where(is_impact, jnp.maximum(bound, e * speed), bound)


class _Problem(NamedTuple):
    """Complementarity problem of a step in scaled numbers, and what its solution x changes: velocity + push x.

    `W` (m, m), `q` (m,) and `scale` (m,) as of `coulomb.solve`; impulses are `scale` x `size`.
    """

    place: Array
    velocity: Array
    metric: MassFactor
    Y: Array
    W: Array
    q: Array
    scale: Array
    size: Array
    side: Array


def _step(contacts: Contacts, scene: Scene, q, v, tau, t, h, smoothing, x=None) -> _Step:
    """A step; with `x`, the solution of its contacts, an equation for its derivatives."""
    # One subprogram, in which the zeros of the rows are known, as far as they are.
    problem = jax.jit(partial(_problem, contacts, scene))(q, v, tau, t, h)
    scaled, width = problem.Y * problem.scale[None], jnp.sqrt(smoothing) / problem.size
    if x is None:
        is_redundant = len(problem.q) + contacts.own > scene.nv
        solution = coulomb.solve(contacts.groups, is_redundant, problem.W, problem.q, problem.scale, width)
        x, residual, solved, steps = solution
    else:
        y = matmul(scaled.T, matmul(scaled, x)) + problem.q
        # The residual is no more than a reader of all arguments: programs leave out those that no value depends on.
        residual = coulomb.residual_at(contacts.groups, x, y, width)
        solved, steps = residual >= 0, residual
        x = coulomb.attach_derivative(contacts.groups, problem.W, y, problem.scale, jax.lax.stop_gradient(width), x)
    velocity = problem.velocity + problem.metric.unwhiten(matmul(scaled, x) * problem.size)
    signs = jnp.concatenate([jnp.ones((len(x) - len(contacts.limited),), q.dtype), problem.side])
    impulses = problem.scale * x * problem.size * signs
    return _Step(problem.place, velocity, impulses, x, residual, solved, steps, problem.metric.is_definite())


def _problem(contacts: Contacts, scene: Scene, q, v, tau, t, h) -> _Problem:
    whole = extend(scene)
    bare = Scene(scene.system, scene.constraints, whole.forces)
    flow, end = _flow(bare, q, v, tau, t, h), t + h
    place, metric, start = displace(scene.system, flow.place, 0.5 * h * v), flow.metric, flow.acceleration(v, v)
    free = v + h * start
    terms = _terms(contacts, whole, place, free, end)
    closes = jnp.any(terms.velocity[contacts.normals] < _bounds(contacts, scene, terms, v, free, h))
    # Halfway to a velocity without contact forces, damping would be that of a motion that contacts prevent.
    half = v + 0.5 * h * start
    change = h * (flow.acceleration(half, jnp.where(closes, v, half)) - start)
    free, terms = free + change, terms._replace(velocity=terms.velocity + matmul(terms.J, change))
    bound = _bounds(contacts, scene, terms, v, free, h)
    place = jnp.where(closes, place, displace(scene.system, flow.place, 0.5 * h * free))
    if not scene.constraints:
        return _scale_problem(
            contacts, scene, metric, metric.whiten(terms.J.T), place, free, terms, terms.velocity, bound
        )
    place = project_state(bare, place, free, end)[0]
    terms = _terms(contacts, whole, place, free, end)
    bound = _bounds(contacts, scene, terms, v, free, h)
    # The rows of the scene's constraints are eliminated: what is left of Y is orthogonal to them.
    of_loops, Y = metric.whiten(constraint_jacobian(bare, place, end).T), metric.whiten(terms.J.T)
    factor = cholesky(regular_gram(of_loops))
    closed = -matmul(of_loops, solve_cholesky(factor, velocity_residual(bare, place, free, end)))
    rest = Y - matmul(of_loops, solve_cholesky(factor, matmul(of_loops.T, Y)))
    velocities = terms.velocity + matmul(Y.T, closed)
    return _scale_problem(
        contacts, scene, metric, rest, place, free + metric.unwhiten(closed), terms, velocities, bound
    )


def _scale_problem(
    contacts: Contacts, scene: Scene, metric: MassFactor, Y, place, velocity, terms: _Terms, velocities, bound
) -> _Problem:
    """Coordinates in which the friction coefficient is one, and the mean inertia of a contact."""
    one, zero, gram = jnp.ones((), Y.dtype), jnp.zeros((), Y.dtype), matmul(Y.T, Y)
    squares = jax.lax.stop_gradient(jnp.diagonal(gram))
    relative, scales, parts, sizes, start = velocities.at[contacts.normals].add(-bound), [], [], [], 0
    units = []
    for size, _ in _sizes(contacts, scene):
        mean = jnp.mean(squares[start : start + size])
        units += [jnp.where(mean > 0, 1 / jnp.sqrt(jnp.where(mean > 0, mean, one)), one)] * size
        start += size
    if _may_contradict(contacts, scene):
        relative = _make_consistent(contacts, gram, jnp.stack(units), relative)
    start = 0
    for size, mu in _sizes(contacts, scene):
        unit = units[start]
        scales.append(jnp.stack([unit, *[unit * mu.astype(Y.dtype)] * (size - 1)]))
        parts.append(scales[-1] * relative[start : start + size])
        # Contacts that are far away do not count: their large bounds would hide the velocities of the others.
        largest = jnp.max(jnp.abs(jax.lax.stop_gradient(parts[-1])))
        sizes.append(jnp.where(parts[-1][0] < 0, largest, zero))
        start += size
    scale, q, size = jnp.concatenate(scales), jnp.concatenate(parts), jnp.max(jnp.stack(sizes))
    size = jnp.where(size > 0, size, one)
    W = gram * scale[:, None] * scale[None]
    return _Problem(place, velocity, metric, Y, W, q / size, scale, size, terms.side)


def _may_contradict(contacts: Contacts, scene: Scene) -> bool:
    """Decide whether rows may depend on each other: by their number, or because contacts share a body."""
    bodies = [getattr(force_at(scene, one).contact, "body", None) for one in contacts.elements]
    rows = sum(size for size, _ in _sizes(contacts, scene))
    return rows + contacts.own > scene.nv or len(set(bodies)) < len(bodies)


def _make_consistent(contacts: Contacts, gram, unit, relative):
    """Velocities (m,) of the contacts that close, projected on those that impulses can stop; `unit` (m,) scales the rows.

    Where an edge falls on its two ends, these close their gaps with different velocities, and cannot both stick: their distance
    is constant, and the edge is oblique. The slip of the second order that is left would have all of their friction.
    """
    mask, start = [], 0
    for size in [1 + len(contacts.elements[i].tangent) for i in contacts.order] + [1] * len(contacts.limited):
        mask += [relative[start] < 0] * size
        start += size
    closes = jnp.stack(mask)
    scale = unit * closes.astype(gram.dtype)
    gram, wanted = gram * scale[:, None] * scale[None], relative * scale
    # Between the squares of independent rows and rounding. The second step leaves a share of its square.
    shift = float(jnp.finfo(gram.dtype).eps) ** 0.55
    factor = cholesky(gram + shift * jnp.eye(len(unit), dtype=gram.dtype))
    x = solve_cholesky(factor, wanted)
    x = x + solve_cholesky(factor, wanted - matmul(gram, x))
    return jnp.where(closes, matmul(gram, x) / unit, relative)


def _sizes(contacts: Contacts, scene: Scene):
    """Dimension and friction coefficient of each cone."""
    for i in contacts.order:
        one = contacts.elements[i]
        yield 1 + len(one.tangent), force_at(scene, one).coefficient
    for _ in contacts.limited:
        yield 1, jnp.ones(())
