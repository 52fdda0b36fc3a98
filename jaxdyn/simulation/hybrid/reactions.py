"""Forces within a mode: constraints, closed contacts, friction that sticks, and friction that slides.

For the active rows A a = gamma, and sliding friction -Z N whose normal forces N = S lam are multipliers themselves,

    M a + h = tau + A^T lam - Z N,    (A M^-1 A^T) lam - (A M^-1 Z) S lam = gamma - A M^-1 (tau - h).

The first matrix is symmetric; the second term makes the equations for N lose their positive pivots where friction is strong:
Painleve's paradox, where forces of rigid bodies do not exist or are not unique.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdyn.compile import eliminate
from jaxdyn.dynamics.quantities import bias_force
from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.hybrid.modes import (
    Elements,
    Gram,
    Mode,
    StateTerms,
    by_element,
    by_normal_row,
    force_at,
    force_tolerance,
    gaps,
    normal_load,
    tolerance,
)
from jaxdyn.systems.scene import Scene


class Coefficients(NamedTuple):
    """Coefficients (n,) of the elements: friction while they slide and at rest, and restitution."""

    sliding: Array
    static: Array
    restitution: Array


class Reaction(NamedTuple):
    """Reaction of constraints and friction to a motion, as forces or as impulses."""

    along: Array  # forces along the rows (count,), sliding friction included
    multipliers: Array  # of the rows that act (count,)
    normal: Array  # normal forces (n,), those that are given included
    holding: Array  # friction of elements that stick (n, 2)
    pivots: Array  # of the equations for the normal forces (n,): one without friction


def coefficients(scene: Scene, elements: Elements, dtype) -> Coefficients:
    """Coefficients of the elements."""
    forces, zero = [force_at(scene, one) for one in elements.each], jnp.zeros((), dtype)
    bounces = [f.restitution if one.opens else zero for f, one in zip(forces, elements.each, strict=True)]
    lists = [f.coefficient for f in forces], [f.static for f in forces], bounces
    return Coefficients(*(jnp.stack([x.astype(dtype) for x in values]) for values in lists))


def normal_loads(scene: Scene, elements: Elements, q, v, t) -> Array:
    """Given normal forces of frictions, (n,), zero of others."""
    return jnp.stack([normal_load(scene, one, q, v, t) for one in elements.each])


def directions(scene: Scene, elements: Elements, mode: Mode, slip, reference) -> Array:
    """Unit vectors (n, 2) of sliding; shorter ones for friction that is smooth.

    They continue smoothly through w = 0 to w < 0, because the event that ends a mode there is bracketed from both sides: w/|w|
    with the sign of `reference` (n, 2), which for one row is constant.
    """
    unit_vectors = []
    for i, one in enumerate(elements.each):
        w, s = slip[i], reference[i]
        # A velocity that may be the rounding of others has no direction of its own: the reference is kept.
        minimum = 0.0 if one.smooth else tolerance(w.dtype)
        square = jnp.sum(w * w)
        is_sliding = (square > minimum**2) & (mode.creep[i] <= 0)
        # The square root has an infinite derivative at zero, which a mask behind it would turn into NaN.
        length = jnp.sqrt(jnp.where(is_sliding, square, jnp.ones_like(square)))
        if one.smooth:
            speed = force_at(scene, one).smoothing.astype(w.dtype)
            # 1/speed is the limit of tanh(|w|/speed)/|w| at rest.
            unit_vectors.append(w * jnp.where(is_sliding, jnp.tanh(length / speed) / length, 1 / speed))
        elif len(one.tangent) < 2:
            unit_vectors.append(s)
        else:
            # Behind w = 0 the direction is reversed: friction stays smooth in the interval that brackets the event.
            forward = jnp.where(jnp.sum(s * w) < 0, -1.0, 1.0).astype(w.dtype)
            unit_vectors.append(jnp.where(is_sliding, forward * w / length, s))
    return jnp.stack(unit_vectors)


def slides(elements: Elements, mode: Mode) -> Array:
    """Mask of the elements that slide, (n,)."""
    return mode.closed & (jnp.asarray(elements.smooth) | ~mode.stick)


# Under `jax.jit` kernels without derivative call it: written out at each place, those of eight contacts are too long.
@partial(jax.jit, static_argnums=0)
def react(elements: Elements, mode: Mode, gram: Gram, friction, loads, along, target) -> Reaction:
    """Forces that change the rates of the active rows by `target` (count,), or impulses that so change their velocities.

    `friction` (n,): coefficients of sliding; `loads` (n,): normal forces that are given.
    """
    dtype = target.dtype
    # Rows that do not act are masked and not removed: every mode has the same shapes and the same program.
    active, zero = elements.active(mode).astype(dtype), jnp.zeros((), dtype)
    level = jnp.where(slides(elements, mode), friction, 0.0)
    # Forces of sliding friction along the rows, for a normal force of one.
    pushes = []
    for i, one in enumerate(elements.each):
        push = [zero] * elements.count
        for k, row in enumerate(one.tangent):
            push[row] = -level[i] * along[i, k]
        pushes.append(jnp.stack(push))
    given = sum((loads[i] * pushes[i] for i, one in enumerate(elements.each) if one.normal < 0), jnp.zeros_like(target))
    Z = jnp.stack([jnp.zeros_like(target), *(pushes[i] for i in elements.frictional)])[1:].T
    right = jnp.concatenate([(target - gram.times(given))[:, None], -gram.times(Z)], 1) * active[:, None]
    # Multipliers without sliding friction, and their change by each normal force of an element that slides.
    lam = gram.factor(active).solve(right)
    base, by_normal = lam[:, 0], lam[:, 1:]
    sign = mode.signs(dtype)
    at = [elements.each[i].normal for i in elements.frictional]
    normal, count = jnp.zeros((0,), dtype), len(at)
    pivots = [jnp.ones((), dtype)] * len(elements.each)
    if count:
        pick = jnp.stack([sign[i] for i in elements.frictional])
        # Sliding friction changes its own normal forces: N = S (base + by_normal N), S the rows and signs of `pick`.
        K = jnp.eye(count, dtype=dtype) - pick[:, None] * by_normal[jnp.asarray(at)]
        # Without exchange of rows, because the sign of each pivot tells where friction leaves no forces.
        solution, own = eliminate(K, (pick * base[jnp.asarray(at)])[:, None], float(jnp.finfo(dtype).eps))
        normal, is_sliding = solution[:, 0], slides(elements, mode)
        for k, i in enumerate(elements.frictional):
            pivots[i] = jnp.where(is_sliding[i], own[k], jnp.ones_like(own[k]))
    lam = (base + matmul(by_normal, normal)) * active
    normals = [sign[i] * lam[one.normal] if one.normal >= 0 else loads[i] for i, one in enumerate(elements.each)]
    return Reaction(
        lam + given + matmul(Z, normal), lam, jnp.stack(normals), by_element(elements, lam), jnp.stack(pivots)
    )


def depends_on_others(elements: Elements, gram: Gram, mode: Mode):
    """Mask of the elements (n,) whose friction depends on that of others: only their sum is determined."""
    free = gram.factor(elements.active(mode).astype(gram.Y.dtype)).nullity() > 1e-3
    return jnp.stack([jnp.stack([free[k] for k in one.tangent] or [free[0] & False]).any() for one in elements.each])


class ModeDynamics(NamedTuple):
    """Acceleration and reaction in a mode."""

    acceleration: Array  # (nv,)
    reaction: Reaction


def free_motion(scene: Scene, terms: StateTerms, generalized_force, q, v, t) -> tuple[Array, Array]:
    """Whitened acceleration without the elements and constraints, (nv,), and A a - gamma of the rows there, (count,).

    `generalized_force` (nv,) is tau and the forces without modes, or None.
    """
    force = jnp.zeros_like(v) if generalized_force is None else generalized_force
    free = terms.metric.whiten(force - bias_force(scene.system, q, v, t))
    return free, matmul(terms.gram.Y.T, free) - terms.row.gamma


def motion_at(
    scene: Scene, elements: Elements, mode: Mode, terms: StateTerms, reference, generalized_force, q, v, t
) -> ModeDynamics:
    """Dynamics in a mode; `generalized_force` as of `free_motion`."""
    along = directions(scene, elements, mode, terms.slip, reference)
    loads, friction = normal_loads(scene, elements, q, v, t), coefficients(scene, elements, v.dtype).sliding
    free, rates = free_motion(scene, terms, generalized_force, q, v, t)
    reaction = react(elements, mode, terms.gram, friction, loads, along, -rates)
    return ModeDynamics(terms.metric.unwhiten(free + matmul(terms.gram.Y, reaction.along)), reaction)


class Collision(NamedTuple):
    """Data of an impact beside the state: a mode, directions of sliding (n, 2), and the fate of each contact.

    `rebound` (n,) multiplies coefficients of restitution. Contacts that are `held` (n,) rest behind the impact whatever the sign
    of their impulse, as their flight would be too short to be seen; elements that are `stopped` (n,) stick behind it.
    """

    mode: Mode
    slip: Array
    rebound: Array
    held: Array
    stopped: Array


def rebounds(elements: Elements, terms: StateTerms, restitution) -> Array:
    """Velocity of each gap (n,) after an impact by Newton's hypothesis: e times that with which it closes."""
    zero = jnp.zeros((), restitution.dtype)
    rates = jnp.stack([-terms.row.velocity[one.normal] if one.opens else zero for one in elements.each])
    # A contact that rests closes with the rounding of its velocity.
    return restitution * jnp.where(rates > 10 * tolerance(zero.dtype), rates, 0.0)


def impact(scene: Scene, elements: Elements, collision: Collision, terms: StateTerms, v) -> tuple[Array, Reaction]:
    """Velocity (nv,) after an impact, and its impulses."""
    # An impact changes no positions: the rows and the mass matrix are those before it.
    of = coefficients(scene, elements, v.dtype)
    rebound = rebounds(elements, terms, of.restitution * collision.rebound)
    friction = jnp.where(collision.held, 0.0, of.sliding)
    # Finite forces have no impulse, nor has the friction under them.
    loads = jnp.zeros_like(rebound)
    along = directions(scene, elements, collision.mode, jnp.zeros_like(collision.slip), collision.slip)
    target = by_normal_row(elements, rebound) - terms.row.velocity
    reaction = react(elements, collision.mode, terms.gram, friction, loads, along, target)
    return v + terms.metric.unwhiten(matmul(terms.gram.Y, reaction.along)), reaction


ROUNDING = 1e-4  # share of the levels of guards that is rounding: of gaps 1e-14 of a metre


def guards_and_levels(
    scene: Scene, elements: Elements, mode: Mode, terms: StateTerms, motion: ModeDynamics, reference, q, v, t
):
    """Guards (n, CHANNELS), which are positive while the mode holds, 1 where it has no condition; and their levels.

    A guard below zero by less than its level does not end a mode. Levels are the tolerances with which modes are chosen, so that
    a mode that was chosen holds: of contacts that depend on others, forces, gaps and velocities are zero up to rounding.
    """
    gap, friction, dtype = gaps(scene, elements, q, t), coefficients(scene, elements, q.dtype), q.dtype
    reaction, small = motion.reaction, tolerance(dtype)
    speeds = jnp.sum(jnp.abs(terms.row.A) * jnp.abs(v)[None], 1)
    total = jnp.sum(jnp.abs(reaction.normal))
    force = force_tolerance(dtype) * (total + jnp.sum(jnp.abs(reaction.holding)))
    reach = small * (1 + jnp.max(jnp.abs(q)))
    # Every element has all channels: the index of a guard means the same condition in every mode.
    one_, guards, levels = jnp.ones((), dtype), [], []
    for i, one in enumerate(elements.each):
        normal = one_
        if one.opens:
            normal = jnp.where(mode.closed[i], reaction.normal[i], gap[i])
        elif one.normal >= 0:
            normal = reaction.normal[i]
        sliding, pivot = one_, one_
        if one.tangent and not one.smooth:
            hold = reaction.holding[i]
            square = jnp.sum(hold * hold)
            # The length has no derivative at zero, and an element that slides has a holding force of zero.
            size = jnp.sqrt(jnp.where(square > 0, square, one_)) * (square > 0).astype(dtype)
            margin = friction.static[i] * reaction.normal[i] + mode.excess[i] * total - size
            # Sliding is guarded by a signed speed, which crosses zero; the length of the velocity only touches it.
            speed = jnp.sum(reference[i] * terms.slip[i])
            # In a fixed direction it slides from rest to the speed of `creep`: one guard for both ends, in units of a speed.
            is_fixed = mode.creep[i] > 0
            square = jnp.sum(terms.slip[i] * terms.slip[i]) / jnp.where(is_fixed, mode.creep[i], one_) ** 2
            share = jnp.where(speed > 0, 1 - square, one_)  # both factors are negative behind a fast reversal
            speed = jnp.where(is_fixed, speed * share, speed + mode.creep[i])
            sliding = jnp.where(mode.stick[i], margin, speed)
            sliding = jnp.where(mode.closed[i], sliding, one_)
        if one.tangent:
            pivot = reaction.pivots[i]
        guards.append(jnp.stack([normal, sliding, pivot]))
        speed = small * (1 + jnp.max(jnp.stack([speeds[k] for k in one.tangent] or [jnp.zeros((), dtype)])))
        # Of a contact that falls the gap is known to rounding; of one that rests beside others it is as zero as its velocity.
        # One that rises leaves a gap below zero by itself: it has that of the projection on others at the event before.
        falls = jnp.zeros((), bool)
        if one.opens:
            falls = terms.row.velocity[one.normal] < -4 * small * (1 + speeds[one.normal])
        # The pivots are of the size of one.
        levels.append(
            jnp.stack(
                [
                    jnp.where(mode.closed[i], force, jnp.where(falls, ROUNDING * reach, reach)),
                    jnp.where(mode.stick[i], force, speed),
                    jnp.full((), float(jnp.finfo(dtype).eps), dtype),
                ]
            )
        )
    return jnp.stack(guards), jnp.stack(levels)
