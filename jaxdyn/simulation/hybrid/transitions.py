"""Mode transitions at an event: first the velocities, by an impact, then the forces.

Both are one problem of complementarity of all elements at once: with rates u = G p + u_free of the rows under forces (or
impulses) p, a closed contact pushes, an open one does not penetrate, an element that sticks stays in its cone, and one that
slides does so against its friction, in space too. Which element comes first does not matter for that.

It is solved by changing the first element that disagrees, one at a time, which ends for problems of one solution (Murty's rule).
Each time the forces of all elements are computed from their modes, those of dependent rows by least norm: a contact whose force
of least norm would pull is opened, and rests beside the others without force.

Directions of sliding change with the modes, so that changes may cycle. Then an impact begins from the modes of its impulses by
Newton's method on Coulomb's law (`impulsive_mode`): this cone complementarity problem has a solution for all impacts on the
ground. Forces are searched from all modes of four elements in order (`search_mode`).

The impact is plastic, or has rebounds by Newton's hypothesis (Moreau's law: friction is against the velocity after it). A plastic
impact loses energy, p.u <= 0. With rebounds and friction Newton's law can gain some (Kane 1984): the coefficients of
restitution of all contacts are then halved, until the work p.(u + u_free)/2 of the impulses is not positive.

Where sliding leaves no forces (Painleve's paradox), the impact begins from elements that stick: there is an impulse without
collision that stops them (Genot & Brogliato 1999).

`project` puts states on the rows of constraints, closed contacts and friction that sticks.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import while_loop
from jaxdyn.compile.kernels import Carry, Given, Iteration, Task, run_loop
from jaxdyn.constraints.base import holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.contact import coulomb
from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.hybrid.modes import (
    Elements,
    Gram,
    Mode,
    by_element,
    by_normal_row,
    extend,
    force_tolerance,
    terms_at,
    tolerance,
)
from jaxdyn.simulation.hybrid.reactions import Collision, Reaction, depends_on_others, react
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, rate_to_velocity, retract, velocity_to_rate

STICKS, SLIDES = 41, 81  # guesses in which all elements stick, or slide; the last one
_ANGLE = 1.5e-7  # rad, up to which a direction is known where rounding of redundant forces turns it
_STILL = 1e-4  # rate of slipping, of the terms that cancel in it, of what may stand still
_ROOM = 2e-3  # of the friction of all elements, by which the friction of some that stick may grow beyond the cone
_WEIGHT = 32  # changes of direction for which there is the same room as for one of a mode


class Problem(NamedTuple):
    """Complementarity problem of the elements: rates u = G p + free of the rows by forces p along them."""

    gram: Gram
    free: Array  # (count,), less the rates that the rows which act are given
    sliding: Array  # coefficients of friction (n,)
    static: Array  # at rest
    loads: Array  # normal forces that are given (n,)
    may_close: Array  # contacts (n,) that may close: in flight they have no force
    may_stick: Array  # elements (n,) that may stick: those that slide before and after do not
    held: Array  # contacts (n,) that hold on both sides
    stopped: Array  # elements (n,) that stick whatever their friction
    force: Array  # size of forces (), beside their own,
    rate: Array  # and of rates (n,), that count as zero when they are multiplied by the tolerance


class Choice(NamedTuple):
    """A mode while it is chosen, with directions of sliding (n, 2) and the number of changes.

    `turn`: square (rad^2) of the last change of a direction; `wrong`: whether an element disagreed; `done`: whether the search
    has ended.
    """

    mode: Mode
    slip: Array
    turn: Array
    changes: Array
    wrong: Array
    done: Array


class Transition(NamedTuple):
    """A transition: the impact, the mode and directions (n, 2) that follow, and the velocity (nv,) after it."""

    impact: Collision
    mode: Mode
    slip: Array
    v: Array
    settled: Array  # true if a mode was found
    paradox: Array  # true where friction leaves no forces
    tail: Array  # time (), s, in which flights that are not followed would come to rest


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
    # A velocity that may be the rounding of others has no direction.
    is_sliding = size > tolerance(slip.dtype)
    forward = jnp.where(jnp.sum(unit * reference, 1) < 0, -1.0, 1.0).astype(slip.dtype)
    # Directions are constants of a step, for derivatives too.
    return lax.stop_gradient(jnp.where(is_sliding[:, None], forward[:, None] * unit, reference))


def first_guess(elements: Elements, mode: Mode, slip, holding, speed, hit) -> tuple[Mode, Array, Array]:
    """Mode and directions after the guards `hit` (n, CHANNELS), before velocities and forces are checked.

    `holding` (n, 2): friction of elements that stick; `speed` (n,) of slipping. The third result (n,) marks those that begin to
    slide.
    """
    opens = jnp.asarray(elements.opening)
    first, second = hit[:, 0], hit[:, 1]
    closes, releases = opens & first & ~mode.closed, opens & first & mode.closed
    begins, ends = second & mode.stick & mode.closed, second & ~mode.stick & mode.closed
    # What is slow enough for a fixed direction, or too fast for it, slides on.
    leaves = ends & jnp.where(mode.creep > 0, speed > mode.creep / 2, mode.creep < 0)
    ends = ends & ~leaves
    _, against = length(-holding)
    # An element that breaks loose slides against the friction that held it: its velocity is still zero.
    slip = jnp.where(begins[:, None], against, slip)
    changed = mode._replace(
        closed=(mode.closed | closes) & ~releases,
        stick=((mode.stick | closes | ends) & ~begins) & ~releases,
        negative=mode.negative ^ (first & ~opens),
        creep=jnp.where(leaves, 0.0, mode.creep),
    )
    return changed, slip, begins


def guess_again(elements: Elements, problem: Problem, mode: Mode, guess, released) -> Mode:
    """Mode from which changes begin, where `guess` () others before have led to no mode.

    The first one has all contacts closed that may be. Of redundant contacts several modes agree, with other forces: the choice
    must not depend on the modes before, between which a motion would change without end. Contacts (n,) that the event has
    `released` have no force in either mode, and are open. The others are those of `STICKS` and `SLIDES`, and all modes of four
    elements in order: the ternary digits of their number are 0 for open, 1 for sticking, 2 for sliding. Of more elements those
    four apart begin alike.
    """
    opens, is_first = jnp.asarray(elements.opening), guess == 0
    powers = jnp.asarray(3 ** (np.arange(len(elements.each)) % 4), jnp.int32)
    digit = (guess - 1) // powers % 3
    closed = jnp.where(
        opens,
        jnp.where(is_first, mode.closed | (problem.may_close & ~released), problem.may_close & (digit > 0)),
        mode.closed,
    )
    sticks = closed & problem.may_stick & jnp.asarray(elements.rough)
    stick = jnp.where(is_first, mode.stick | (sticks & ~mode.closed), sticks & (digit == 1))
    return mode._replace(closed=closed, stick=stick)


def search_mode(elements: Elements, problem: Problem, mode: Mode, slip, released, wanted) -> Choice:
    """Mode of the forces if `wanted` (), from one of the modes of `guess_again`: changes may cycle, from others they end."""

    def attempt(carry):
        guess, choice, busy = carry
        begin = guess_again(elements, problem, mode, guess, released)
        found = choose_mode(elements, problem, begin, slip)
        choice = jax.tree.map(lambda a, b: jnp.where(busy, a, b), found, choice)
        return guess + 1, choice, busy & found.wrong & (guess < SLIDES)

    none, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    begin = none, Choice(mode, slip, jnp.zeros((), slip.dtype), none, ~no, no), jnp.asarray(wanted) & ~no
    return while_loop(lambda carry: carry[2], attempt, begin)[1]


def choose_mode(elements: Elements, problem: Problem, mode: Mode, slip) -> Choice:
    """Change the first element that disagrees until none does."""
    begin = Carry(Choice(mode, slip, jnp.zeros((), slip.dtype), jnp.zeros((), jnp.int32), *jnp.zeros((2,), bool)))
    return run_loop(Task(_change_first, (elements,)), None, problem, Given(), begin).state


def _change_first(elements: Elements, _, problem: Problem, choice: Choice, __) -> Iteration:
    """Change the first element that disagrees."""
    mode, slip, changes = choice.mode, choice.slip, choice.changes
    reaction = react(elements, mode, problem.gram, problem.sliding, problem.loads, slip, -problem.free)
    wrong, sticks, turned = _disagreements(elements, problem, mode, slip, reaction)
    flat = wrong.reshape(-1)
    # The first one alone: Murty's rule changes one at a time, as several changes at once may cycle.
    first = (flat & (jnp.cumsum(flat.astype(jnp.int32)) == 1)).reshape(wrong.shape)
    pulls, penetrates, leaves, turns, reverses = (first[:, k] for k in range(5))
    _, against = length(-reaction.holding)
    rough = jnp.asarray(elements.rough)
    changed = mode._replace(
        closed=(mode.closed | penetrates) & ~pulls,
        stick=(mode.stick | (penetrates & sticks) | turns) & ~pulls & ~leaves & rough,
        negative=mode.negative != reverses,
    )
    # Directions follow when the modes agree, to rounding as long as each change of them is smaller than the one before.
    rounding = 4 * float(jnp.finfo(slip.dtype).eps)
    angles = jnp.sum((turned - slip) ** 2, 1)
    turn = jnp.max(angles)
    moves = (angles > jnp.where(turn < choice.turn, rounding, max(_ANGLE, rounding)) ** 2) & ~wrong.any()
    slip = jnp.where(leaves[:, None], against, jnp.where(moves[:, None], turned, slip))
    changes = changes + jnp.where(wrong.any(), _WEIGHT, 1).astype(jnp.int32)
    done = ~(wrong.any() | moves.any()) | (changes >= _WEIGHT * max_changes(elements))
    return Iteration(Choice(changed, slip, turn, changes, wrong.any(), done), ~choice.done, ~done)


def max_changes(elements: Elements) -> int:
    """Number of changes after which no mode was found."""
    # An element changes a few times at most: more changes are a cycle.
    return 8 * len(elements.each) + 16


def _disagreements(elements: Elements, problem: Problem, mode: Mode, slip, reaction: Reaction):
    """Flags (n, 5) of elements that pull, penetrate, leave their cones, turn round, or change the sign of their normal force;
    those that stick when they close (n,); and directions (n, 2) of sliding by what slips."""
    opens, rough = jnp.asarray(elements.opening), jnp.asarray(elements.rough)
    has_multiplier = jnp.asarray(np.array([one.normal >= 0 for one in elements.each]))
    dtype, held = reaction.normal.dtype, problem.held
    rates = problem.gram.times(reaction.along) + problem.free
    normal, slipping = rates_of(elements, rates)
    hold, _ = length(reaction.holding)
    forces = jnp.sum(jnp.abs(reaction.normal)) + jnp.sum(jnp.abs(reaction.holding))
    tiny = force_tolerance(dtype) / 4 * forces + tolerance(dtype) * problem.force
    sizes = problem.gram.sizes(reaction.along) + jnp.abs(problem.free)
    across, beside = rates_of(elements, sizes)
    rise, small = (tolerance(dtype) * (problem.rate + x) for x in (across, jnp.max(beside, 1)))
    # Friction mu N against a slip d is the projection of mu N d + r u, u the rate of slipping, onto its disk, for any r > 0:
    # inside of the disk it sticks, and outside it has the direction of this vector.
    level = jnp.maximum(problem.sliding * reaction.normal, 0.0)
    along_normal, square = rates_of(elements, problem.gram.squares)
    share = jnp.sum(square, 1)
    # Where the tangent rows vanish friction holds nothing, and a moment later what sticks would hold the motion that turns them.
    is_loose = (share <= float(jnp.finfo(dtype).eps) * along_normal) & (length(slipping)[0] > small)
    share = jnp.where(share > 0, 1 / jnp.where(share > 0, share, jnp.ones_like(share)), 0.0)
    trial, turned = length(level[:, None] * slip + share[:, None] * slipping)
    slides = mode.closed & ~mode.stick & rough & problem.may_stick & (level > tiny)
    is_plane = jnp.asarray(np.array([len(one.tangent) == 2 for one in elements.each]))
    turned = jnp.where((slides & is_plane)[:, None], turned, slip)
    backwards = (jnp.sum(slip * slipping, 1) < -small) & (~is_plane | (trial <= level) | (level <= tiny))
    # Without a positive pivot a larger force of a sliding contact opens its gap less: what balances there is unstable, and the
    # contact opens. It closes again where it would penetrate: then no mode is found that begins from it.
    is_lost = ~mode.stick & rough & (reaction.pivots <= 0)
    pulls = opens & mode.closed & ((reaction.normal < -tiny) | is_lost) & ~held
    cone = problem.static * jnp.abs(reaction.normal)
    sticks = mode.stick & rough
    wrong = [
        pulls & ~sticks,
        problem.may_close & ~mode.closed & (normal < -rise),
        # A contact that sticks and would pull slides first: then it may well push.
        mode.closed & sticks & ((hold > cone + tiny) | pulls | is_loose) & ~problem.stopped,
        mode.closed & ~mode.stick & rough & problem.may_stick & backwards,
        ~opens & has_multiplier & (reaction.normal < -tiny),
    ]
    return jnp.stack(wrong, 1), problem.may_stick, turned


def find_jams(elements: Elements, problem: Problem, mode: Mode, along) -> tuple[Array, Reaction, Array]:
    """Elements (n,) that slide, but stand still, since they depend on others that stick; the reaction, and rates (count,).

    Their friction of least norm has left the cone, and another share of it has not.
    """
    reaction = react(elements, mode, problem.gram, problem.sliding, problem.loads, along, -problem.free)
    rates = problem.gram.times(reaction.along) + problem.free
    rests = mode.closed & jnp.asarray(elements.rough) & problem.may_stick
    depends = depends_on_others(elements, problem.gram, mode._replace(stick=mode.stick | rests))
    speed, _ = length(rates_of(elements, rates)[1])
    sizes = problem.gram.sizes(reaction.along) + jnp.abs(problem.free)
    minimum = _STILL * jnp.max(rates_of(elements, sizes)[1], 1) + tolerance(speed.dtype) * problem.rate
    return rests & ~mode.stick & depends & (speed <= minimum), reaction, rates


def with_excess(elements: Elements, problem: Problem, mode: Mode, still) -> Mode:
    """Mode in which elements that stand `still` (n,) stick, with room for their friction beyond the cone."""
    mode = mode._replace(stick=mode.stick | still)
    along = jnp.zeros((*mode.excess.shape, 2), mode.excess.dtype)
    reaction = react(elements, mode, problem.gram, problem.sliding, problem.loads, along, -problem.free)
    hold, _ = length(reaction.holding)
    total = jnp.sum(jnp.abs(reaction.normal))
    beyond = hold - problem.static * jnp.abs(reaction.normal)
    room = jnp.maximum(beyond, 0.0) / jnp.where(total > 0, total, 1.0) + _ROOM * problem.static
    excess = jnp.where(mode.stick & mode.closed & still.any() & (beyond > -_ROOM * problem.static * total), room, 0.0)
    return mode._replace(excess=excess)


def rates_of(elements: Elements, rates) -> tuple[Array, Array]:
    """Rates of the gaps (n,) and of slipping (n, 2), of the rates (count,) of all rows."""
    zero = jnp.zeros((), rates.dtype)
    normal = jnp.stack([rates[one.normal] if one.opens else zero for one in elements.each])
    tangent = [[rates[one.tangent[k]] if k < len(one.tangent) else zero for k in range(2)] for one in elements.each]
    return normal, jnp.stack([jnp.stack(pair) for pair in tangent])


def impulsive_mode(elements: Elements, problem: Problem, wanted, mode: Mode, slip) -> tuple[Mode, Array]:
    """Mode of an impact and directions of sliding (n, 2), if `wanted` (); those of other elements than contacts are kept."""
    if not elements.opening.any():
        return mode, slip
    return kernel(_impulsive_mode, static=1, derivative=False)(elements, problem, wanted, mode, slip)


def _impulsive_mode(elements: Elements, problem: Problem, wanted, mode: Mode, slip):
    contacts = [i for i, one in enumerate(elements.each) if one.opens]
    contacts.sort(key=lambda i: -len(elements.each[i].tangent))
    sizes = [1 + len(elements.each[i].tangent) for i in contacts]
    groups = tuple((sizes.count(size), size) for size in (3, 2, 1) if size in sizes)
    rows = np.array([k for i in contacts for k in (elements.each[i].normal, *elements.each[i].tangent)])
    gram, free, dtype = problem.gram, problem.free, problem.free.dtype
    Y = gram.Y[:, rows]
    W, q = matmul(Y.T, Y), free[rows]
    if len(rows) < elements.count:
        # Other rows that act are eliminated: what is left are the velocities of the contacts when these rows hold.
        others = np.setdiff1d(np.arange(elements.count), rows)
        act = elements.active(mode).astype(dtype) * jnp.zeros((elements.count,), dtype).at[others].set(1.0)
        right = jnp.concatenate([matmul(gram.Y.T, Y), free[:, None]], 1)
        change = matmul(Y.T, matmul(gram.Y, gram.factor(act).solve(right * act[:, None])))
        W, q = W - change[:, :-1], q - change[:, -1]
    # Coordinates in which the friction coefficient is one; contacts that do not touch are far away.
    one, scales, parts, start = jnp.ones((), dtype), [], [], 0
    for i, size in zip(contacts, sizes, strict=True):
        mean = sum(W[k, k] for k in range(start, start + size)) / size
        unit = jnp.where(mean > 0, 1 / jnp.sqrt(jnp.where(mean > 0, mean, one)), one)
        touches = problem.may_close[i]
        scales += [jnp.where(touches, unit, 0.0), *[jnp.where(touches, unit * problem.static[i], 0.0)] * (size - 1)]
        parts += [jnp.where(touches, unit * q[start], one), *[scales[-1] * q[start + k] for k in range(1, size)]]
        start += size
    scale, q = jnp.stack(scales), jnp.stack(parts)
    normals = np.cumsum([0, *sizes])[:-1]
    largest = jnp.max(jnp.where(scale > 0, jnp.abs(q), 0.0))
    largest = jnp.where(largest > 0, largest, one)
    q = jnp.where(scale > 0, q / largest, q)
    W = W * scale[:, None] * scale[None]
    x = coulomb.solve(groups, True, W, q, scale, jnp.zeros((), dtype), wanted).x
    y = matmul(W, x) + q
    tiny = float(jnp.finfo(dtype).eps) ** 0.5
    closed, stick, along = list(mode.closed), list(mode.stick), list(slip)
    for i, k, size in zip(contacts, normals, sizes, strict=True):
        closed[i] = problem.may_close[i] & ((x[k] > tiny) | (y[k] < tiny))
        if size > 1:
            speed, unit = length(jnp.concatenate([y[k + 1 : k + size], jnp.zeros((3 - size,), dtype)])[None])
            stick[i] = closed[i] & (speed[0] <= tiny)
            along[i] = jnp.where(stick[i], slip[i], unit[0])
    found = mode._replace(closed=jnp.stack(closed), stick=jnp.stack(stick)), jnp.stack(along)
    return jax.tree.map(lambda a, b: jnp.where(wanted, a, b), found, (mode, slip))


# --- projection of states on the rows of constraints, closed contacts and friction that sticks ---


# Rounds of a projection at the end of a step, and of one at a save point. All have the factor of the first: each reduces what is
# open in proportion to the first correction, which only coarse tolerances make large.
_ROUNDS, _SAVED_ROUNDS = 2, 6


def project(scene: Scene, elements: Elements, mode: Mode, t, y, error, lifts: bool = False):
    """Project q and v by the least change onto the rows that act, and the error (or None) onto their tangent space.

    The last change of q, from which what is left open follows, counts as an error too: a step that is too long for the projection
    is rejected. `lifts`: whether q is projected onto the gaps of open contacts too that are negative, as closing one may push
    another below zero.
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
        lam = terms.gram.factor(mask).solve((residual * mask)[:, None])[:, 0]
        return terms.metric.unwhiten(matmul(terms.gram.Y, lam))

    contacts = by_normal_row(elements, jnp.ones((len(elements.each),), dtype))
    # From half of the level of the guard on. Gaps at impacts are far smaller: to close them would shorten each bounce.
    deep = tolerance(dtype) * (1 + jnp.max(jnp.abs(q))) / 2
    start, last, blank = q, jnp.zeros_like(v), jnp.zeros((elements.count,), dtype)
    rounds = _SAVED_ROUNDS if error is None and not lifts else _ROUNDS
    if holonomic.size:
        for _ in range(rounds):
            residual, lifted = blank.at[holonomic].set(position_residual(whole, q, t)), holds
            if lifts:
                lifted = jnp.where(residual < -deep, jnp.maximum(holds, contacts), holds)
            last = change(residual, lifted)
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
    aligned = jnp.where((mode.creep > 0)[:, None], y["slip"], align(slip, y["slip"]))
    return y | {"q": q, "v": v, "slip": aligned}, tangent
