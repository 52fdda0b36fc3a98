"""What a mode becomes at an event: first velocities, by an impact, then forces.

Both are problems of complementarity: what is closed must push, what is open must not be pressed in, what sticks must stay in its
cone, what slides must not turn round. A contact that sticks and would pull slides first: then it may well push. They are solved
by changing the first element that disagrees, one at a time, which ends for problems of one solution (Murty's rule); where it does
not end, no mode was found.

The impact is that of least change in the metric of M over the bodies that are kept apart, or rebound by Newton's
hypothesis. An impulse that leaves the cone slides, against the direction of the impulse that would have held it: exact in a
plane, an approximation of the sliding direction in space.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxdyn.compile.batch import any_sample
from jaxdyn.simulation.hybrid.modes import Elements, Mode


class Judged(NamedTuple):
    """A state in a mode: `conditions` (n, CHANNELS) and their rounding `levels`; forces of each element and the cone at rest;
    velocities and accelerations of slipping (n, 2) and of the gap (n,), with their sizes (n,) or ()."""

    conditions: Array
    levels: Array
    normal: Array
    holding: Array
    cone: Array
    slip: Array
    slip_rate: Array
    slip_size: Array
    rate_size: Array
    gap: Array
    gap_velocity: Array
    gap_rate: Array
    gap_size: Array


class Jumped(NamedTuple):
    """Velocity (nv,) after an impact; impulses of each element; velocities of slipping (n, 2) after it, and of the gap (n,)
    above the `rebound` (n,) that restitution asks for."""

    v: Array
    normal: Array
    holding: Array
    slip: Array
    gap_velocity: Array
    rebound: Array
    size: Array


class Change(NamedTuple):
    """A transition: the mode and directions (n, 2) of the impact, those that follow, and the velocity (nv,). Whether it was
    found, and whether friction leaves no forces."""

    impact: Mode
    impact_slip: Array
    mode: Mode
    slip: Array
    v: Array
    settled: Array
    paradox: Array


def _loose(dtype) -> float:
    """Below which velocities and gaps count as zero, in SI units and of what cancels in them."""
    return float(jnp.finfo(dtype).eps) ** 0.6


def length(x):
    """|x| of rows (n, 2), and unit vectors, e_x where x is zero."""
    square = jnp.sum(x * x, 1)
    some = square > 0
    size = jnp.sqrt(jnp.where(some, square, jnp.ones_like(square)))
    unit = jnp.where(some[:, None], x / size[:, None], _first(x))
    return jnp.where(some, size, jnp.zeros_like(size)), unit


def _first(x):
    return jnp.broadcast_to(jnp.asarray([1.0, 0.0], x.dtype), x.shape)


def aligned(slip, reference):
    """Directions of slipping (n, 2) of what moves, on the side of the old ones; the old ones of what does not."""
    size, unit = length(lax.stop_gradient(slip))
    is_sliding = size > 100 * float(jnp.finfo(slip.dtype).eps)
    forward = jnp.where(jnp.sum(unit * reference, 1) < 0, -1.0, 1.0).astype(slip.dtype)
    return lax.stop_gradient(jnp.where(is_sliding[:, None], forward[:, None] * unit, reference))


def at_once(elements: Elements, mode: Mode, slip, judged: Judged, hit) -> tuple[Mode, Array, Array]:
    """The mode and directions with what the conditions `hit` (n, CHANNELS) ask for, before velocities and forces are looked at;
    which elements begin to slide."""
    opens = jnp.asarray(elements.opening)
    first, second = hit[:, 0], hit[:, 1]
    closes, releases = opens & first & ~mode.closed, opens & first & mode.closed
    begins, ends = second & mode.stick & mode.closed, second & ~mode.stick & mode.closed
    _, against = length(-judged.holding)
    slip = jnp.where(begins[:, None], against, slip)
    changed = mode._replace(
        closed=(mode.closed | closes) & ~releases,
        stick=((mode.stick | closes | ends) & ~begins) & ~releases,
        negative=mode.negative ^ (first & ~opens),
    )
    return changed, slip, begins


def changed_mode(elements: Elements, cones, mode: Mode, slip, begins, v, jump: Callable, judge: Callable) -> Change:
    """The mode that follows, from a first guess at the velocity v (nv,).

    `begins` (n,): which elements slide from rest, because they could not be held.
    `jump(mode, slip)` and `judge(mode, slip, v)` give `Jumped` and `Judged`; `cones` (n,), coefficients at rest.
    """
    n = len(elements.each)
    most = 4 * n + 8
    opens = jnp.asarray(elements.opening)
    rough = jnp.asarray(np.array([bool(one.tangent) and not one.smooth for one in elements.each]))
    mode = mode._replace(stick=mode.stick & rough)

    def flip(state, wrong, stick_when_closing, against):
        """Change the first element of those that disagree: (pulls, pressed in, leaves its cone, turns round, sign)."""
        mode, slip = state
        first = jnp.argmax(wrong.reshape(-1))
        one = jnp.zeros(wrong.size, bool).at[first].set(True).reshape(wrong.shape) & wrong
        pulls, pressed, leaves, turns, reverses = (one[:, k] for k in range(5))
        slip = jnp.where(leaves[:, None], against, slip)
        changed = mode._replace(
            closed=(mode.closed | pressed) & ~pulls,
            stick=(mode.stick | (pressed & stick_when_closing) | turns) & ~pulls & ~leaves & rough,
            negative=mode.negative ^ reverses,
        )
        return changed, slip

    def solve(wrong_of, mode, slip):
        def unfinished(carry):
            return any_sample(carry[3] & (carry[2] < most))

        def body(carry):
            mode, slip, count, busy, _ = carry
            wrong, stick, against, values = wrong_of(mode, slip)
            busy = busy & wrong.any() & (count < most)
            after = flip((mode, slip), wrong, stick, against)
            mode, slip = jax.tree.map(lambda a, b: jnp.where(busy, a, b), after, (mode, slip))
            return mode, slip, count + busy.astype(jnp.int32), busy, values

        start = jax.eval_shape(wrong_of, mode, slip)[3]
        blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), start)
        first = mode, slip, jnp.zeros((), jnp.int32), jnp.ones((), bool), blank
        mode, slip, count, _, values = lax.while_loop(unfinished, body, first)
        return mode, slip, count < most, values

    def by_velocity(mode, slip):
        after: Jumped = jump(mode, slip)
        small = _loose(after.v.dtype)
        hold, against = length(-after.holding)
        cone = cones * jnp.where(opens, jnp.maximum(after.normal, 0.0), jnp.abs(after.normal))
        tiny = small * after.size
        touching = opens & (judged.gap <= small * judged.gap_size)
        moving = jnp.sum(slip * after.slip, 1)
        wrong = jnp.stack(
            [
                opens & mode.closed & ~mode.stick & (after.normal < -tiny),
                touching & ~mode.closed & (after.gap_velocity < -small * judged.slip_size),
                mode.closed & mode.stick & ((hold > cone + tiny) | (opens & (after.normal < -tiny))),
                mode.closed & ~mode.stick & rough & (moving < -small * judged.slip_size),
                jnp.zeros((n,), bool),
            ],
            1,
        )
        return wrong, jnp.ones((n,), bool), against, after

    def by_force(mode, slip):
        now: Judged = judge(mode, slip, v)
        small = _loose(v.dtype)
        scale = small * (jnp.sum(jnp.abs(now.normal)) + jnp.sum(jnp.abs(now.holding)))
        hold, against = length(-now.holding)
        speed, _ = length(now.slip)
        at_rest = speed <= small * now.slip_size
        resting = opens & (now.gap <= small * now.gap_size) & (jnp.abs(now.gap_velocity) <= small * now.slip_size)
        wrong = jnp.stack(
            [
                opens & mode.closed & ~mode.stick & (now.normal < -scale),
                resting & ~mode.closed & (now.gap_rate < -small * now.rate_size),
                mode.closed & mode.stick & ((hold > now.cone + scale) | (opens & (now.normal < -scale))),
                mode.closed
                & ~mode.stick
                & rough
                & at_rest
                & (jnp.sum(slip * now.slip_rate, 1) < -small * now.rate_size),
                ~opens & (now.normal < -scale) & coupled,
            ],
            1,
        )
        return wrong, at_rest, against, now

    coupled = jnp.asarray(np.array([one.normal >= 0 for one in elements.each]))
    judged: Judged = judge(mode, slip, v)
    impact, impact_slip, hit, after = solve(by_velocity, mode, slip)
    v = after.v
    speed, unit = length(after.slip)
    is_sliding = speed > _loose(v.dtype) * judged.slip_size
    slip = impact_slip = lax.stop_gradient(jnp.where(is_sliding[:, None], unit, impact_slip))
    # Elements that rebound open; those that came to rest together stick if their cones allow it.
    closed = impact.closed & ~(opens & (after.rebound > 0))
    resting = impact._replace(closed=closed, stick=(impact.stick | (rough & ~is_sliding & ~begins)) & closed)
    final, slip, settled, now = solve(by_force, resting, slip)
    final = final._replace(stick=final.stick & final.closed)
    # Where sliding has no forces, no mode is found; where it has two, one is.
    tried = judge(resting, impact_slip, v)
    paradox = _left_alone(final, now) | (_left_alone(resting, tried) & ~settled)
    return Change(impact, impact_slip, final, slip, v, hit & settled, paradox)


def _left_alone(mode: Mode, judged: Judged):
    """Whether the equations for forces of what slides have lost a positive pivot."""
    return ((mode.closed & ~mode.stick)[:, None] & (judged.conditions[:, 2:] <= 0)).any()
