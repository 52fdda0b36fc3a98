"""Guards of the elements: the conditions under which a mode holds."""

import jax.numpy as jnp

from jaxdyn.simulation.hybrid.modes import Elements, Mode
from jaxdyn.simulation.hybrid.reactions import Motion, coefficients
from jaxdyn.simulation.hybrid.rows import StateTerms, force_tolerance, gaps, tolerance
from jaxdyn.systems.scene import Scene

ROUNDING = 1e-4  # share of the levels of guards that is rounding: of gaps 1e-14 of a metre


def guards_and_levels(
    scene: Scene, elements: Elements, mode: Mode, terms: StateTerms, motion: Motion, reference, q, v, t
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
