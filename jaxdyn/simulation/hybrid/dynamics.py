"""Dynamics within a mode: constraints, closed contacts, friction that sticks, and friction that slides.

With Y = U^-1 A^T, M = U U^T, for the active rows A a = gamma, and sliding friction -Z N whose normal forces N = S lam are
multipliers themselves,

    M a + h = tau + A^T lam - Z N,    (A M^-1 A^T) lam - (A M^-1 Z) S lam = gamma - A M^-1 (tau - h).

The first matrix is symmetric; the second term makes the equations for N lose their positive pivots where friction is strong:
Painleve's paradox, where forces of rigid bodies do not exist or are not unique.

Rows that depend on each other (a box on two corners that stick) have multipliers near those of least norm.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from jaxdyn.constraints.base import Rows, position_residual, rows
from jaxdyn.dynamics.quantities import bias_force, mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.hybrid.modes import Elements, Mode, extend, force_at
from jaxdyn.systems.mass_factor import MassFactor, cholesky, mass_factor, solve_cholesky
from jaxdyn.systems.scene import Scene


class StateTerms(NamedTuple):
    """Terms of a state that do not depend on its mode: rows, mass matrix, and sliding velocities (n, 2)."""

    row: Rows
    metric: MassFactor
    Y: Array
    slip: Array


class Reaction(NamedTuple):
    """Reaction of constraints and friction to a motion, as forces or as impulses."""

    multipliers: Array  # (count,)
    normal: Array  # normal forces (n,)
    holding: Array  # friction of elements that stick (n, 2)
    change: Array  # share in the rate of the velocity (nv,)
    pivots: Array  # of the equations for the normal forces (n,): one without friction


def terms_at(scene: Scene, elements: Elements, q, v, t) -> StateTerms:
    """Terms of a scene with its elements."""
    row = rows(extend(scene), q, v, t)
    metric = mass_factor(mass_matrix(scene.system, q, t))
    # Whitened rows Y give A M^-1 A^T as Y^T Y: symmetric, and positive semidefinite for dependent rows too.
    return StateTerms(row, metric, metric.whiten(row.A.T), by_element(elements, row.velocity))


def by_element(elements: Elements, rowwise) -> Array:
    """Entries of the rows that slip, (n, 2), zero where there are none."""
    # Padded to two directions, so that elements with one row and with two rows share one array.
    zero = jnp.zeros((), rowwise.dtype)
    return jnp.stack(
        [
            jnp.stack([rowwise[one.tangent[k]] if k < len(one.tangent) else zero for k in range(2)])
            for one in elements.each
        ]
    )


def normal_load(scene: Scene, element, q, v, t):
    """Prescribed normal force of a friction, (), zero where it is negative: such friction would drive the motion."""
    normal: Any = force_at(scene, element).normal
    value: Any = normal(scene.system, q, v, t) if callable(normal) else normal
    if jnp.shape(value) != ():
        raise ValueError(f"friction {element.name!r}: normal gives shape {jnp.shape(value)}; expected one number, ()")
    return jnp.maximum(jnp.asarray(value, q.dtype), 0.0)


def directions(scene: Scene, elements: Elements, slip, reference) -> Array:
    """Unit vectors (n, 2) of sliding; shorter ones for friction that is smooth.

    They continue smoothly through w = 0 to w < 0, because the event that ends a mode there is bracketed from both sides: w/|w|
    with the sign of `reference` (n, 2), which for one row is constant.
    """
    unit_vectors = []
    for i, one in enumerate(elements.each):
        w, s = slip[i], reference[i]
        # A velocity below rounding has no direction of its own: the reference is kept.
        least = 100 * float(jnp.finfo(w.dtype).eps)
        square = jnp.sum(w * w)
        is_sliding = square > least**2
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


def slides(elements: Elements, mode: Mode) -> list:
    """Flag () of each element that slides."""
    free = [jnp.ones((), bool) if one.smooth else ~mode.stick[i] for i, one in enumerate(elements.each)]
    return [mode.closed[i] & free[i] for i in range(len(elements.each))]


def react(scene: Scene, elements: Elements, mode: Mode, terms: StateTerms, along, target) -> Reaction:
    """Forces that give the active rows the rates `target` (count,), or impulses that give them these velocities."""
    dtype = target.dtype
    # Rows that do not act are masked and not removed: every mode has the same shapes and the same program.
    active = elements.active(mode).astype(dtype)
    sliding = slides(elements, mode)
    Z = [
        jnp.where(sliding[i], force_at(scene, elements.each[i]).coefficient.astype(dtype), 0.0)
        * matmul(along[i, : len(elements.each[i].tangent)], terms.row.A[jnp.asarray(elements.each[i].tangent)])
        for i in elements.frictional
    ]
    count = len(Z)
    pushes = terms.metric.whiten(jnp.stack(Z).T) if count else jnp.zeros((scene.nv, 0), dtype)
    right = jnp.concatenate([target[:, None], matmul(terms.Y.T, pushes)], 1) * active[:, None]
    # Multipliers without sliding friction, and their change by each normal force of an element that slides.
    lam = solve_rows(terms.Y * active[None], active, right)
    base, by_normal = lam[:, 0], lam[:, 1:]
    sign = mode.signs(dtype)
    at = [elements.each[i].normal for i in elements.frictional]
    normal = jnp.zeros((0,), dtype)
    pivots = [jnp.ones((), dtype)] * len(elements.each)
    if count:
        pick = jnp.stack([sign[i] for i in elements.frictional])
        # Sliding friction changes its own normal forces: N = S (base + by_normal N), S the rows and signs of `pick`.
        K = jnp.eye(count, dtype=dtype) - pick[:, None] * by_normal[jnp.asarray(at)]
        normal, own = _eliminate(K, pick * base[jnp.asarray(at)])
        for i, pivot in zip(elements.frictional, own, strict=True):
            pivots[i] = jnp.where(sliding[i], pivot, jnp.ones_like(pivot))
    lam = (base + matmul(by_normal, normal)) * active
    change = terms.metric.unwhiten(matmul(terms.Y, lam) - matmul(pushes, normal))
    zero = jnp.zeros((), dtype)
    normals = [sign[i] * lam[one.normal] if one.normal >= 0 else zero for i, one in enumerate(elements.each)]
    return Reaction(lam, jnp.stack(normals), by_element(elements, lam), change, jnp.stack(pivots))


def solve_rows(Y, active, right):
    """Solution x of Y^T Y x = right on the active rows, zero elsewhere; near the least norm where rows are dependent.

    Two steps of the proximal method x <- x + (G + eps)^-1 (right - G x), of rows scaled to unit length.
    """
    square, eps = jnp.sum(Y * Y, 0), float(jnp.finfo(Y.dtype).eps)
    # A row of the size of rounding is no row, as that of a direction across the plane of a planar model.
    is_row = square > eps**1.5 * jnp.max(square)
    scale = jnp.where(is_row, 1 / jnp.sqrt(jnp.where(is_row, square, jnp.ones_like(square))), 0.0)
    Y = Y * scale[None]
    # Large enough for Cholesky's factors of dependent rows; each step of the proximal method multiplies the error by about it.
    shift = eps**0.5
    count = Y.shape[1]
    # Rows that do not act have a one on the diagonal, so that the factor exists in every mode.
    factor = cholesky(matmul(Y.T, Y) + jnp.diag(1.0 - active + shift * jnp.ones((count,), Y.dtype)))
    right = right * scale[:, None]
    x = solve_cholesky(factor, right)
    for _ in range(2):
        x = x + solve_cholesky(factor, (right - matmul(Y.T, matmul(Y, x))) * active[:, None])
    return x * (scale * active)[:, None]


def _eliminate(K, right):
    """Solution x of K x = right, and the pivots of the elimination in order.

    Without exchange of rows, because the sign of each pivot tells where friction leaves no forces.
    """
    n, pivots = K.shape[0], []
    matrix = [K[i] for i in range(n)]
    values = [right[i] for i in range(n)]
    for i in range(n):
        pivot = matrix[i][i]
        pivots.append(pivot)
        # The recorded pivot stays zero, which ends the mode; the division needs another number.
        pivot = jnp.where(pivot == 0, jnp.full_like(pivot, float(jnp.finfo(pivot.dtype).eps)), pivot)
        for j in range(i + 1, n):
            share = matrix[j][i] / pivot
            matrix[j] = matrix[j] - share * matrix[i]
            values[j] = values[j] - share * values[i]
    unknowns: list[Any] = [None] * n
    for i in reversed(range(n)):
        rest = values[i]
        for j in range(i + 1, n):
            rest = rest - matrix[i][j] * unknowns[j]
        pivot = matrix[i][i]
        unknowns[i] = rest / jnp.where(pivot == 0, jnp.full_like(pivot, float(jnp.finfo(pivot.dtype).eps)), pivot)
    return jnp.stack(unknowns), pivots


class Motion(NamedTuple):
    """Motion in a mode."""

    acceleration: Array  # (nv,)
    reaction: Reaction
    normal: Array  # normal forces (n,), those that are prescribed included
    rates: Array  # A a - gamma (count,)
    sizes: Array  # sizes of the terms that cancel in these (count,)


def motion_at(
    scene: Scene, elements: Elements, mode: Mode, terms: StateTerms, reference, generalized_force, q, v, t
) -> Motion:
    """Motion in a mode; `generalized_force` (nv,) is tau and the forces without modes, or None."""
    along = directions(scene, elements, terms.slip, reference)
    force = jnp.zeros_like(v) if generalized_force is None else generalized_force
    sliding = slides(elements, mode)
    # A given normal force makes sliding friction a known force: it does not enter the equations of `react`.
    prescribed = {}
    for i, one in enumerate(elements.each):
        if one.normal < 0:
            prescribed[i] = normal_load(scene, one, q, v, t)
            level = jnp.where(sliding[i], force_at(scene, one).coefficient.astype(v.dtype) * prescribed[i], 0.0)
            force = force - level * matmul(along[i, : len(one.tangent)], terms.row.A[jnp.asarray(one.tangent)])
    free = terms.metric.whiten(force - bias_force(scene.system, q, v, t))
    reaction = react(scene, elements, mode, terms, along, terms.row.gamma - matmul(terms.Y.T, free))
    acceleration = terms.metric.unwhiten(free) + reaction.change
    normal = jnp.stack([prescribed.get(i, reaction.normal[i]) for i in range(len(elements.each))])
    parts = terms.row.A * acceleration[None]
    # A rate is zero up to the rounding of its terms, so that comparisons need their size.
    sizes = jnp.sum(jnp.abs(parts), 1) + jnp.abs(terms.row.gamma)
    return Motion(acceleration, reaction, normal, jnp.sum(parts, 1) - terms.row.gamma, sizes)


def gaps(scene: Scene, elements: Elements, q, t) -> Array:
    """Gaps of the elements that open, (n,); zero of others."""
    residuals = position_residual(extend(scene), q, t)
    # Contacts have one row each among the residuals, behind those of the scene's own constraints.
    at, gap_of_each = residuals.shape[0] - sum(one.opens for one in elements.each), []
    for one in elements.each:
        gap_of_each.append(residuals[at] if one.opens else jnp.zeros((), q.dtype))
        at += one.opens
    return jnp.stack(gap_of_each)


def rebounds(scene: Scene, elements: Elements, terms: StateTerms) -> Array:
    """Velocity of each gap (n,) after an impact by Newton's hypothesis: e times that with which it closes.

    Slow ones are zero: the flight after them would be hardly higher than the rounding of the gap.
    """
    zero, rates = jnp.zeros((), terms.row.velocity.dtype), []
    least = float(jnp.finfo(zero.dtype).eps) ** 0.3
    for one in elements.each:
        if one.opens:
            rebound = -force_at(scene, one).restitution.astype(zero.dtype) * terms.row.velocity[one.normal]
            rates.append(jnp.where(rebound > least, rebound, zero))
        else:
            rates.append(zero)
    return jnp.stack(rates)


def impact(
    scene: Scene, elements: Elements, mode: Mode, terms: StateTerms, along, v, rebound
) -> tuple[Array, Reaction]:
    """Velocity after impulses that end the motion of the active rows, or give gaps the velocity `rebound` (n,); and these."""
    # An impact changes no positions: the rows and the mass matrix are those before it.
    target = -terms.row.velocity
    for i, one in enumerate(elements.each):
        if one.opens:
            target = target.at[one.normal].add(rebound[i])
    reaction = react(scene, elements, mode, terms, along, target)
    return v + reaction.change, reaction


def element_guards(
    scene: Scene, elements: Elements, mode: Mode, terms: StateTerms, motion: Motion, reference, q, t
) -> Array:
    """Guards (n, CHANNELS), which are positive while the mode holds: 1 where it has no condition."""
    gap, rows = gaps(scene, elements, q, t), []
    # Every element has all channels: the index of a guard means the same condition in every mode.
    one_ = jnp.ones((), q.dtype)
    for i, one in enumerate(elements.each):
        normal = one_
        if one.opens:
            normal = jnp.where(mode.closed[i], motion.normal[i], gap[i])
        elif one.normal >= 0:
            normal = motion.normal[i]
        friction, pivot = one_, one_
        if one.tangent and not one.smooth:
            hold = motion.reaction.holding[i]
            square = jnp.sum(hold * hold)
            # The length has no derivative at zero, and an element that slides has a holding force of zero.
            size = jnp.sqrt(jnp.where(square > 0, square, one_)) * (square > 0).astype(q.dtype)
            margin = force_at(scene, one).static.astype(q.dtype) * motion.normal[i] - size
            # Sliding is guarded by a signed speed, which crosses zero; the length of the velocity only touches it.
            friction = jnp.where(mode.stick[i], margin, jnp.sum(reference[i] * terms.slip[i]))
            friction = jnp.where(mode.closed[i], friction, one_)
        if one.tangent:
            pivot = motion.reaction.pivots[i]
        rows.append(jnp.stack([normal, friction, pivot]))
    return jnp.stack(rows)
