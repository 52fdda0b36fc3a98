r"""Steps of fixed length through contacts: time stepping, in which impacts and forces are impulses of a step.

A step of length h from (q, v) has the velocity v_f = v + h a(q + h v/2, v + h a/2) without contact forces, by the midpoint rule,
with the multipliers of the scene's constraints in a, and the scene's forces at v where a contact closes. At the end q' = q + h v,
with the rows A of the constraints and J of the contacts there and M at the midpoint, the velocity v' satisfies

    M (v' - v_f) = A^T lam + J^T p,   A v' = b,   Coulomb's law between p and J v' (`jaxdyn.contact.coulomb`),

where the normal velocity counts from a bound n . v' >= c:

    c = -gap / h             the contact closes in the next step at the earliest,
    c = min(-gap / h, max(d, w))    for a gap below zero; d = min(-u, |u - n . v|), u = n . v_f: no more velocity comes out
                             than forces have driven in,
    c = e |u|                for an impact: the contact closes in the next step, with restitution e.

The step along v bends, as that of a ball whose velocity turns with it; w is the velocity by which this has closed the gap.

If no contact closes, and no friction has a load, q' is that of the midpoint rule, q + h v/2 + h v'/2, and the step is of order
two. A contact at rest has v = 0, and so q' = q to rounding: nothing creeps. q' is projected onto the holonomic constraints
before the solve.

A friction whose load is the multiplier of a constraint has its impulse over the step, from the same equations, with the sign that
it has in the end.

A contact or friction with a coefficient at rest of its own has that one as long as it slips neither before the step nor after
it. Where contacts that close contradict each other, and no solution is found, their velocities are made consistent
(`contact_problem`). States of drives follow the midpoint rule, with the mean of v and v'.

Sources: Moreau, Unilateral contact and dry friction in finite freedom dynamics (1988); Stewart & Trinkle (1996); Acary &
Brogliato, Numerical methods for nonsmooth dynamical systems (2008), chapters 10 and 13.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import batch, implicit, invalidate_derivatives, kernel, value_and_jvp
from jaxdyn.constraints.codes import RESULTS, Outcome, Result
from jaxdyn.contact import coulomb
from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.contact_problem import (
    Contacts,
    Scaled,
    closing_cones,
    friction_of,
    load_signs,
    make_consistent,
    may_contradict,
    pose,
    rests_at,
    scaled,
    slip_speeds,
    with_signs,
)
from jaxdyn.systems.scene import Scene


class ContactStep(Outcome):
    """Report of a step of `jd.stepper`: its result code, and its contact forces, none in a scene without contacts.

    - `forces`: by the contact's name, (n,), N: the friction along the rows of slip, and the normal force as the last one; means
      over the step, so that those of an impact are its impulse over the step's length.
    - `limit_forces` (nv,): of joint limits, N or N m.
    - `result`: one of `jd.RESULTS`. Unless it is `successful` or `coarse_steps`, the state is NaN, with derivatives of NaN.
    - `residual` (): of Coulomb's law, in numbers scaled to one.
    """

    forces: dict[str, Float[Array, "..."]]
    limit_forces: Float[Array, " nv"]
    result: Any
    residual: Float[Array, ""]


class _Step(NamedTuple):
    q: Array
    v: Array
    z: Array  # states of drives
    impulses: Array  # (m,), N s
    x: Array  # of `coulomb.solve`
    at_rest: Array  # cones (k,) with the coefficient of friction at rest
    relaxed: Array  # cones (k,) whose velocities were made consistent with each other
    residual: Array
    solved: Array
    steps: Array
    regular: Array  # whether the mass matrix is positive definite


def contact_step(contacts: Contacts, scene: Scene, q, v, z, tau, t, h, smoothing) -> tuple[tuple, ContactStep]:
    """State (q, v, z) after a step of length h (), and its contact forces; z: of drives; `smoothing` () in J."""
    found = _advance(contacts, scene, q, v, z, tau, t, h, smoothing)
    fine = (
        found.solved
        & found.regular
        & jnp.isfinite(found.q).all()
        & jnp.isfinite(found.v).all()
        & jnp.isfinite(found.z).all()
    )
    result = RESULTS.where(found.solved, RESULTS.successful, RESULTS.no_contact_impulses)
    result = RESULTS.where(fine | ~found.solved, result, RESULTS.nonfinite)
    result = RESULTS.where(found.regular, result, RESULTS.singular_mass_matrix)
    *state, forces = (jnp.where(fine, x, jnp.nan) for x in (found.q, found.v, found.z, found.impulses / h))
    *state, forces = invalidate_derivatives((*state, forces), ~fine, (scene, q, v, z, tau, t, h))
    by_name, start = {}, 0
    for i in contacts.order:
        size = 1 + len(contacts.elements[i].tangent)
        # The normal is the third axis of a contact's frame, in outputs of `simulate` and of grasps too.
        by_name[contacts.elements[i].name] = jnp.roll(forces[start : start + size], -1)
        start += size
    limit_forces = jnp.zeros_like(v)
    if contacts.limited:
        limit_forces = limit_forces.at[np.array([k for _, k in contacts.limited])].add(forces[start:])
    by_name = {one.name: by_name[one.name] for one in contacts.elements}
    return tuple(state), ContactStep(forces=by_name, limit_forces=limit_forces, result=result, residual=found.residual)


def mean_of_steps(steps: ContactStep) -> ContactStep:
    """Mean forces of several steps, the first code that is not `successful`, and the largest residual."""
    forces, limit_forces = jax.tree.map(lambda x: jnp.mean(x, 0), (steps.forces, steps.limit_forces))
    codes = steps.result.index
    first = codes[jnp.argmax(codes != RESULTS.successful.index)]
    return ContactStep(forces=forces, limit_forces=limit_forces, result=Result(first), residual=jnp.max(steps.residual))


def _advance(contacts: Contacts, scene: Scene, *state) -> _Step:
    def solve(scene, *state):
        return kernel(_step, static=1, derivative=False)(contacts, scene, *state)

    def tangent(scene, *rest):
        *state, steps = rest
        found = _advance(contacts, scene, *state)
        known = jax.lax.stop_gradient((found.x, found.at_rest, found.relaxed))

        def again(scene, *args):
            return kernel(_step, static=1)(contacts, scene, *args)

        _, change = value_and_jvp(again, (scene, *state, *known), [*steps, None, None, None])
        return found, jax.tree.map(jnp.zeros_like, found) if change is None else _change_without_flags(found, change)

    return implicit(scene, state, solve, tangent)


def _change_without_flags(found: _Step, change: _Step) -> _Step:
    """The change with no derivative of flags and of the residual."""
    float0 = lambda x: np.zeros(jnp.shape(x), jax.dtypes.float0)  # noqa: E731
    return change._replace(
        residual=jnp.zeros_like(found.residual),
        steps=jnp.zeros_like(found.steps),
        solved=float0(found.solved),
        at_rest=float0(found.at_rest),
        relaxed=float0(found.relaxed),
        regular=float0(found.regular),
    )


def _step(
    contacts: Contacts,
    scene: Scene,
    q,
    v,
    z,
    tau,
    t,
    h,
    smoothing,
    x: Any = None,
    at_rest: Any = None,
    relaxed: Any = None,
) -> _Step:
    """A step; with `x`, the solution of its contacts, and the cones that are `at_rest` and `relaxed`, for its derivatives."""
    # One subprogram, in which the zeros of the rows are known, as far as they are.
    problem, groups = jax.jit(partial(pose, contacts, scene))(q, v, z, tau, t, h), contacts.groups
    if x is None:
        at_rest = jnp.zeros((len(contacts.sizes),), bool)
        if contacts.has_static:
            at_rest = rests_at(contacts, scene, q, v, t)
        of = scaled(contacts, problem, friction_of(contacts, scene, q.dtype, at_rest))
        solution, relaxed = _solve(contacts, scene, of, jnp.sqrt(smoothing) / of.size)
        if contacts.has_static:
            x = solution.x
            # What slips from rest has the coefficient of sliding.
            slips = at_rest & (slip_speeds(contacts, matmul(of.W, x) + of.q) > coulomb.tolerance(q.dtype) ** 0.5)
            at_rest = at_rest & ~slips
            of = scaled(contacts, problem, friction_of(contacts, scene, q.dtype, at_rest))
            anew = slips.any()
            again = _solve(contacts, scene, of, jnp.sqrt(smoothing) / of.size, anew)
            solution, relaxed = jax.tree.map(lambda a, b: jnp.where(anew, a, b), again, (solution, relaxed))
        x, residual, solved, steps = solution
    else:
        of = scaled(contacts, problem, friction_of(contacts, scene, q.dtype, at_rest))
        of = with_signs(contacts, of, load_signs(contacts, of, x))
        width = jnp.sqrt(smoothing) / of.size
        if may_contradict(contacts, scene):
            of = of._replace(q=jnp.where(relaxed.any(), make_consistent(contacts, of, relaxed).q, of.q))
        y = matmul(of.W, x) + of.q
        # The residual is no more than a reader of all arguments: programs leave out those that no value depends on.
        residual = coulomb.residual_at(groups, x, y, width)
        solved, steps = residual >= 0, residual
        x = coulomb.attach_derivative(groups, of.W, y, of.scale, width, x)
    # Impulses of frictions' loads move nothing: their rows are zero.
    velocity = problem.velocity + problem.metric.unwhiten(matmul(problem.Y * of.scale[None], x) * of.size)
    signs = jnp.concatenate([jnp.ones((len(x) - len(contacts.limited),), q.dtype), problem.side])
    impulses = of.scale * x * of.size * signs
    if z.size:
        rates: Any = scene.drive_torque(problem.middle, (v + velocity) / 2, t + 0.5 * h, tau, problem.drives)[1]
        z = z + h * rates
    return _Step(
        problem.place, velocity, z, impulses, x, at_rest, relaxed, residual, solved, steps, problem.metric.is_definite()
    )


def _solve(contacts: Contacts, scene: Scene, of: Scaled, width, wanted: Any = True):
    """Solution of a step's problem, and the cones (k,) whose velocities were made consistent with each other."""
    signs = load_signs(contacts, of, jnp.zeros_like(of.q))
    found = _solve_relaxed(contacts, scene, with_signs(contacts, of, signs), width, wanted)
    if not contacts.load_rows:
        return found
    # The impulses may turn the sign of a load: then it has the other one, or none.
    turned = load_signs(contacts, of, found[0].x)
    flips = (turned != signs).any() & wanted
    again = _solve_relaxed(contacts, scene, with_signs(contacts, of, turned), width, flips)
    agrees = (load_signs(contacts, of, again[0].x) == turned).all()
    again = again[0]._replace(solved=again[0].solved & agrees), again[1]
    return jax.tree.map(lambda a, b: jnp.where(flips, a, b), again, found)


def _solve_relaxed(contacts: Contacts, scene: Scene, of: Scaled, width, wanted: Any):
    """The solution, or that with consistent velocities where there is none, and the cones (k,) with such velocities."""
    is_redundant = sum(contacts.sizes) + contacts.own > scene.nv
    solution = coulomb.solve(contacts.groups, is_redundant, *of[:3], width, wanted)
    if not may_contradict(contacts, scene):
        return solution, jnp.zeros((len(contacts.sizes),), bool)
    fails = ~solution.solved & wanted

    def relax(state):
        # Contacts that only impulses of others close may contradict them too.
        closes = closing_cones(contacts, of, solution.x) & fails
        q = make_consistent(contacts, of, closes).q
        again = coulomb.solve(contacts.groups, True, of.W, q, of.scale, width, fails)
        # The residual is that of the law itself.
        residual = coulomb.residual_at(contacts.groups, again.x, matmul(of.W, again.x) + of.q, width)
        again = again._replace(residual=residual, steps=solution.steps + again.steps)
        return jax.tree.map(lambda new, old: jnp.where(fails, new, old), (fails, again, closes), state)

    # Few problems need it, and a kernel computes it for no others.
    start = fails, solution, jnp.zeros((len(contacts.sizes),), bool)
    return batch.repeat_while(lambda state: state[0], relax, start, 1)[1:]
