"""Mode transitions at an event: first the velocities, by an impact, then the forces.

Both are problems of complementarity: a closed contact must push, an open one must not penetrate, an element that sticks must stay
in its cone, and one that slides must not turn round. A contact that sticks and would pull slides first: then it may well push.
They are solved by changing the first element that disagrees, one at a time, which ends for problems of one solution (Murty's
rule); where it does not end, no mode was found.

The impact is that of least change in the metric of M over the bodies that are kept apart, or rebound by Newton's
hypothesis. An impulse that leaves the cone slides, against the direction of the impulse that would have held it: exact in a
plane, an approximation of the sliding direction in space.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxdyn.compile.batch import any_sample
from jaxdyn.simulation.hybrid.modes import Elements, Mode


class ContactState(NamedTuple):
    """A state in a mode, as its guards and transitions see it; sizes are those of the terms that cancel."""

    guards: Array  # (n, CHANNELS)
    levels: Array  # their rounding (n, CHANNELS)
    normal: Array  # normal forces (n,)
    holding: Array  # friction of elements that stick (n, 2)
    cone: Array  # largest friction at rest (n,)
    slip: Array  # velocities of slipping (n, 2)
    slip_rate: Array  # their rates (n, 2)
    slip_size: Array  # (n,)
    rate_size: Array  # (n,)
    gap: Array  # (n,)
    gap_velocity: Array  # (n,)
    gap_rate: Array  # (n,)
    gap_size: Array  # ()


class Impact(NamedTuple):
    """State after an impact."""

    v: Array  # (nv,)
    normal: Array  # impulses (n,)
    holding: Array  # impulses (n, 2)
    slip: Array  # velocities of slipping (n, 2)
    gap_velocity: Array  # above the rebound (n,)
    rebound: Array  # that restitution asks for (n,)
    size: Array  # of the impulses, ()


class Transition(NamedTuple):
    """A transition: mode and directions (n, 2) of the impact, those that follow, and the velocity (nv,) after it."""

    impact: Mode
    impact_slip: Array
    mode: Mode
    slip: Array
    v: Array
    settled: Array  # true if a mode was found
    paradox: Array  # true where friction leaves no forces


def _tolerance(dtype) -> float:
    """Size below which velocities and gaps count as zero, in SI units and relative to the terms that cancel in them."""
    # 4e-10 in float64: above the rounding of a projected state, far below the changes at an event.
    return float(jnp.finfo(dtype).eps) ** 0.6


def length(x):
    """Lengths |x| of rows (n, 2), and unit vectors, e_x where x is zero."""
    square = jnp.sum(x * x, 1)
    some = square > 0
    size = jnp.sqrt(jnp.where(some, square, jnp.ones_like(square)))
    unit = jnp.where(some[:, None], x / size[:, None], jnp.broadcast_to(jnp.asarray([1.0, 0.0], x.dtype), x.shape))
    return jnp.where(some, size, jnp.zeros_like(size)), unit


def align(slip, reference):
    """Directions of slipping (n, 2) on the side of the old ones; the old ones where nothing slips."""
    size, unit = length(lax.stop_gradient(slip))
    # A velocity of the size of rounding has no direction.
    is_sliding = size > 100 * float(jnp.finfo(slip.dtype).eps)
    forward = jnp.where(jnp.sum(unit * reference, 1) < 0, -1.0, 1.0).astype(slip.dtype)
    # Directions are constants of a step, for derivatives too.
    return lax.stop_gradient(jnp.where(is_sliding[:, None], forward[:, None] * unit, reference))


def first_guess(elements: Elements, mode: Mode, slip, state: ContactState, hit) -> tuple[Mode, Array, Array]:
    """Mode and directions after the guards `hit` (n, CHANNELS), before velocities and forces are checked.

    The third result (n,) marks elements that begin to slide.
    """
    opens = jnp.asarray(elements.opening)
    first, second = hit[:, 0], hit[:, 1]
    closes, releases = opens & first & ~mode.closed, opens & first & mode.closed
    begins, ends = second & mode.stick & mode.closed, second & ~mode.stick & mode.closed
    _, against = length(-state.holding)
    # An element that breaks loose slides against the friction that held it: its velocity is still zero.
    slip = jnp.where(begins[:, None], against, slip)
    changed = mode._replace(
        closed=(mode.closed | closes) & ~releases,
        stick=((mode.stick | closes | ends) & ~begins) & ~releases,
        negative=mode.negative ^ (first & ~opens),
    )
    return changed, slip, begins


def next_mode(elements: Elements, cones, mode: Mode, slip, begins, v, impact_at: Callable, state_at: Callable):
    """Transition from a first guess of the mode at the velocity v (nv,), a `Transition`.

    `begins` (n,) marks elements that slide from rest, because they could not be held.
    `impact_at(mode, slip)` gives an `Impact`, `state_at(mode, slip, v)` a `ContactState`; `cones` (n,), coefficients at rest.
    """
    opens, rough = jnp.asarray(elements.opening), jnp.asarray(elements.rough)
    mode = mode._replace(stick=mode.stick & rough)
    before: ContactState = state_at(mode, slip, v)
    by_velocity = partial(_disagreements_of_velocities, elements, cones, before, impact_at)
    impact, impact_slip, hit, after = _solve(rough, by_velocity, mode, slip)
    v = after.v
    speed, unit = length(after.slip)
    is_sliding = speed > _tolerance(v.dtype) * before.slip_size
    slip = impact_slip = lax.stop_gradient(jnp.where(is_sliding[:, None], unit, impact_slip))
    # Elements that rebound open; those that came to rest together stick if their cones allow it.
    closed = impact.closed & ~(opens & (after.rebound > 0))
    resting = impact._replace(closed=closed, stick=(impact.stick | (rough & ~is_sliding & ~begins)) & closed)
    final, slip, settled, now = _solve(rough, partial(_disagreements_of_forces, elements, v, state_at), resting, slip)
    final = final._replace(stick=final.stick & final.closed)
    # Where sliding has no forces, no mode is found; where it has two, one is.
    paradox = _has_lost_pivot(final, now) | (_has_lost_pivot(resting, state_at(resting, impact_slip, v)) & ~settled)
    return Transition(impact, impact_slip, final, slip, v, hit & settled, paradox)


def _solve(rough, disagreements: Callable, mode: Mode, slip):
    """Change the first element that disagrees until none does: mode, directions, whether that ended, and the values there.

    `disagreements(mode, slip)`: flags (n, 5) of elements that pull, penetrate, leave their cones, turn round, or change the sign
    of their normal force; those that stick when they close (n,); directions against what held (n, 2); and values.
    """
    most = 4 * rough.size + 8  # an element changes a few times at most: more changes are a cycle

    # All samples of a batch iterate until the last one has ended, each masked by its own flag.
    def is_running(carry):
        return any_sample(carry[3] & (carry[2] < most))

    def flip(mode, slip, wrong, sticks, against):
        # The first one alone: Murty's rule changes one at a time, as several changes at once may cycle.
        first = jnp.argmax(wrong.reshape(-1))
        # `argmax` is zero where nothing disagrees, so that the flag is masked by `wrong`.
        one = jnp.zeros(wrong.size, bool).at[first].set(True).reshape(wrong.shape) & wrong
        pulls, penetrates, leaves, turns, reverses = (one[:, k] for k in range(5))
        slip = jnp.where(leaves[:, None], against, slip)
        changed = mode._replace(
            closed=(mode.closed | penetrates) & ~pulls,
            stick=(mode.stick | (penetrates & sticks) | turns) & ~pulls & ~leaves & rough,
            negative=mode.negative ^ reverses,
        )
        return changed, slip

    def body(carry):
        mode, slip, count, busy, _ = carry
        wrong, sticks, against, values = disagreements(mode, slip)
        busy = busy & wrong.any() & (count < most)
        after = flip(mode, slip, wrong, sticks, against)
        mode, slip = jax.tree.map(lambda a, b: jnp.where(busy, a, b), after, (mode, slip))
        return mode, slip, count + busy.astype(jnp.int32), busy, values

    # Values of the last iteration are needed: the carry begins with zeros of their shapes.
    start = jax.eval_shape(disagreements, mode, slip)[3]
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), start)
    first = mode, slip, jnp.zeros((), jnp.int32), jnp.ones((), bool), blank
    mode, slip, count, _, values = lax.while_loop(is_running, body, first)
    return mode, slip, count < most, values


def _disagreements_of_velocities(
    elements: Elements, cones, before: ContactState, impact_at: Callable, mode: Mode, slip
):
    opens, rough = jnp.asarray(elements.opening), jnp.asarray(elements.rough)
    after: Impact = impact_at(mode, slip)
    small = _tolerance(after.v.dtype)
    hold, against = length(-after.holding)
    cone = cones * jnp.where(opens, jnp.maximum(after.normal, 0.0), jnp.abs(after.normal))
    tiny = small * after.size
    touching = opens & (before.gap <= small * before.gap_size)
    forward = jnp.sum(slip * after.slip, 1)
    wrong = [
        opens & mode.closed & ~mode.stick & (after.normal < -tiny),
        touching & ~mode.closed & (after.gap_velocity < -small * before.slip_size),
        mode.closed & mode.stick & ((hold > cone + tiny) | (opens & (after.normal < -tiny))),
        mode.closed & ~mode.stick & rough & (forward < -small * before.slip_size),
        jnp.zeros(opens.shape, bool),
    ]
    return jnp.stack(wrong, 1), jnp.ones(opens.shape, bool), against, after


def _disagreements_of_forces(elements: Elements, v, state_at: Callable, mode: Mode, slip):
    opens, rough = jnp.asarray(elements.opening), jnp.asarray(elements.rough)
    has_multiplier = jnp.asarray(np.array([one.normal >= 0 for one in elements.each]))
    now: ContactState = state_at(mode, slip, v)
    small = _tolerance(v.dtype)
    scale = small * (jnp.sum(jnp.abs(now.normal)) + jnp.sum(jnp.abs(now.holding)))
    hold, against = length(-now.holding)
    speed, _ = length(now.slip)
    at_rest = speed <= small * now.slip_size
    # A contact in flight has no force: it can close only where gap and velocity are both zero.
    resting = opens & (now.gap <= small * now.gap_size) & (jnp.abs(now.gap_velocity) <= small * now.slip_size)
    turns = jnp.sum(slip * now.slip_rate, 1) < -small * now.rate_size
    wrong = [
        opens & mode.closed & ~mode.stick & (now.normal < -scale),
        resting & ~mode.closed & (now.gap_rate < -small * now.rate_size),
        mode.closed & mode.stick & ((hold > now.cone + scale) | (opens & (now.normal < -scale))),
        mode.closed & ~mode.stick & rough & at_rest & turns,
        ~opens & (now.normal < -scale) & has_multiplier,
    ]
    return jnp.stack(wrong, 1), at_rest, against, now


def _has_lost_pivot(mode: Mode, state: ContactState):
    """True if the equations for the forces of elements that slide have lost a positive pivot."""
    return ((mode.closed & ~mode.stick)[:, None] & (state.guards[:, 2:] <= 0)).any()
