"""Hybrid systems: flow between events, guards that end a mode, and reset maps.

States have the entries q, v and `slip`, the directions (n, 2) in which elements slide. Directions are constants of a step
(`step_constants`), renewed where it ends.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxdyn.compile import kernel, solver_of
from jaxdyn.compile.batch import cond, while_loop
from jaxdyn.forces.piecewise import values_and_levels
from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.hybrid.modes import Elements, Mode, StateTerms, by_normal_row, gaps, terms_at, tolerance
from jaxdyn.simulation.hybrid.reactions import (
    ROUNDING,
    Collision,
    coefficients,
    directions,
    free_motion,
    guards_and_levels,
    impact,
    motion_at,
    normal_loads,
    react,
    rebounds,
    slides,
)
from jaxdyn.simulation.hybrid.transitions import (
    SLIDES,
    STICKS,
    Problem,
    Transition,
    choose_mode,
    find_jams,
    first_guess,
    guess_again,
    impulsive_mode,
    length,
    project,
    rates_of,
    search_mode,
    with_excess,
)
from jaxdyn.simulation.solvers.steps import Plan
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import retract, velocity_to_rate

_STOPPED = 30  # tolerances of the velocity below which sliding has ended
_IMPACTS = (
    0,
    0,
    STICKS,
    SLIDES,
)  # guesses of the mode of an impact; the second one is replaced by that of Coulomb's law
_SLOWER = 0.1  # part of the speed up to which sliding begins in a fixed direction, below which it ends in one


class HybridSystem:
    """Functions of a motion with modes, on flat states; those of a run hold no arrays, as they are keys of caches.

    `plan` of its steps, whose arguments are (unknown, mode): the traced leaves, and the mode.
    """

    plan: Plan
    elements: Elements

    @abstractmethod
    def guards(self, t, y, args) -> tuple:
        """Guards and their rounding levels: those of the elements by CHANNELS, then those of the switching functions."""

    @abstractmethod
    def reset(self, unknown, t, y, mode: Mode, slip, hit, happens, atol) -> Transition:
        """Transition after the guards `hit`, of any value unless it `happens` ().

        `atol` (), m: the height of flights that are not followed, None for rounding.
        """

    @abstractmethod
    def impact(self, unknown, collision: Collision, t, y) -> Any:
        """State after an impact."""

    @abstractmethod
    def begin(self, args, t, y) -> Any:
        """State from which the first step in a mode is made, on the rows that act."""

    @abstractmethod
    def slip(self, y) -> Any:
        """Directions of sliding (n, 2) of a state."""

    def slip_behind(self, unknown, mode: Mode, following: Mode, slip, t, y) -> Any:
        """Directions `slip` behind an event between two modes, with derivatives where they stay fixed."""
        return slip

    @abstractmethod
    def with_slip(self, y, v, slip) -> Any:
        """State with this velocity and these directions; v None to keep the velocity."""


class ModalSystem(HybridSystem):
    """System with contacts that open and friction that sticks.

    **Arguments:** `bind(unknown, positive=None)` -> (scene, generalized_force(q, v, t), switching(q, v, t)) for the traced
    leaves, with forces in the pieces where the switching functions are `positive`; `y0`, a state.
    """

    def __init__(self, bind: Callable, elements: Elements, solver: diffrax.AbstractAdaptiveSolver, y0):
        leaves, tree = jax.tree.flatten(y0)
        shapes = tuple(x.shape for x in leaves)
        self._bind, self.elements = bind, elements
        # Under `jax.jit`, each is compiled once and called: a step reads the guards four times, and written out it would have
        # more operations than a kernel holds.
        plan = Plan(type(solver), jax.jit(self._field), jax.jit(self._project), ("slip",), False, tree, shapes)
        self.plan = plan._replace(guards=jax.jit(self.guards), rounding=ROUNDING)

    def _motion(self, args, t, y):
        unknown, mode = args
        scene, generalized_force, _ = self._bind(unknown, mode.positive)
        q, v = retract(scene.system, y["q"]), y["v"]
        terms = terms_at(scene, self.elements, q, v, t)
        force = generalized_force(q, v, t)
        return scene, q, v, terms, motion_at(scene, self.elements, mode, terms, y["slip"], force, q, v, t)

    def _field(self, t, y, args):
        scene, q, v, _, motion = self._motion(args, t, y)
        return {"q": velocity_to_rate(scene.system, q, v), "v": motion.acceleration, "slip": jnp.zeros_like(y["slip"])}

    def _project(self, t, y, error, args):
        unknown, mode = args
        following, tangent = project(self._bind(unknown)[0], self.elements, mode, t, y, error)
        return following | {"slip": y["slip"]}, following, tangent

    def _switches(self, unknown, positive, q, v, t):
        """Switching functions with such signs that they are positive until one changes its sign, and their levels, (k,)."""
        switching = self._bind(unknown)[2]
        values, levels = values_and_levels(lambda q, v: switching(q, v, t), q, v)
        return jnp.where(positive, values, -values), levels

    def begin(self, args, t, y):
        # A gap is closed where it has fallen below zero by its level, which the first step behind would count as its error. To
        # close it may push another contact that opens there as far below zero: its guard would end the mode at once, again
        # without a force, and so on without end.
        scene = self._bind(args[0])[0]
        return ravel_pytree(project(scene, self.elements, args[1], t, self.plan.structure(y), None, True)[0])[0]

    def guards(self, t, y, args):
        mode = args[1]
        scene, q, v, terms, motion = self._motion(args, t, y)
        own = guards_and_levels(scene, self.elements, mode, terms, motion, y["slip"], q, v, t)
        values, levels = self._switches(args[0], mode.positive, q, v, t)
        more = values, levels / ROUNDING
        return tuple(jnp.concatenate([a.reshape(-1), b]) for a, b in zip(own, more, strict=True))

    def reset(self, unknown, t, y, mode, slip, hit, happens, atol):
        y = self.plan.structure(y)
        q, v = y["q"], y["v"]
        hit, switched = self.elements.split(hit)
        mode = mode._replace(positive=mode.positive ^ switched)
        holding, speed, size = kernel(self._friction, derivative=False)(unknown, mode, slip, t, q, v)
        # Sliding that is slower than the error of its velocity has ended: its direction is not known.
        minimum = jnp.asarray(2 * tolerance(q.dtype), q.dtype)
        minimum = minimum if atol is None else jnp.maximum(minimum, _STOPPED * atol)
        is_impact = (jnp.asarray(self.elements.opening) & hit[:, 0] & ~mode.closed).any()
        # In a fixed direction it ends where it turns round, with what is left across.
        slow = minimum * (1 + size)
        ends = (speed <= slow) | (hit[:, 1] & (mode.creep > 0) & (speed < mode.creep / 2))
        stopped = jnp.asarray(self.elements.rough) & mode.closed & ~mode.stick & ends & ~is_impact
        before = mode.closed
        mode, slip, begins = first_guess(self.elements, mode, slip, holding, speed, hit)
        mode = mode._replace(stick=mode.stick | (stopped & mode.closed))
        after = self._pass(
            unknown, mode, slip, begins, stopped & mode.closed, before & ~mode.closed, slow, happens, t, q, v, atol
        )
        # Switching functions that the impact has carried across their zeros.
        values, levels = self._switches(unknown, after.mode.positive, q, after.v, t)
        crossed = (values < -levels) & ~switched
        return after._replace(mode=after.mode._replace(positive=after.mode.positive ^ crossed))

    def _friction(self, unknown, mode, slip, t, q, v):
        """Friction (n, 2) of elements that stick, speeds (n,) of those that slide, and the sizes of their terms."""
        *_, terms, motion = self._motion((unknown, mode), t, {"q": q, "v": v, "slip": slip})
        return motion.reaction.holding, length(terms.slip)[0], self._speeds(terms, v)

    def _pass(self, unknown, mode, slip, begins, stopped, released, slow, happens, t, q, v, atol) -> Transition:
        """Transition from a first guess of the mode; `begins` (n,) marks elements that slide from rest, and speeds up to `slow`
        (n,) count as zero."""
        elements, n = self.elements, len(self.elements.each)
        minimum = tolerance(q.dtype) * (1 + jnp.max(jnp.abs(q)))
        height = 4 * minimum if atol is None else jnp.maximum(4 * minimum, atol)

        def attempt(carry):
            tries, guess, (rebound, held, stopped), last, busy = carry
            problem, along = kernel(self._velocities, derivative=False)(
                unknown, mode, rebound, held, stopped, slip, t, q, v
            )
            # First the impulses of Coulomb's law. They are zero where sliding leaves no forces: an impulse without collision
            # begins from elements that stick.
            by_law = (guess == 1) & busy
            begin = guess_again(elements, problem, mode, jnp.asarray(_IMPACTS, jnp.int32)[guess], released)
            begin, along = cond(
                by_law,
                partial(impulsive_mode, elements, problem, by_law),
                lambda mode, along: (mode, along),
                begin,
                along,
            )
            choice = choose_mode(elements, problem, begin._replace(stick=begin.stick | (stopped & begin.closed)), along)
            collision = Collision(choice.mode, choice.slip, rebound, held, stopped)
            still = kernel(self._find_jams, derivative=False)(problem, choice.mode, choice.slip)
            resting, at, after, gains, speed = kernel(self._after, derivative=False)(
                unknown, collision, begins, t, q, v
            )
            # Sliding slower than what has ended would end at once. The impulse that stops one contact gives such a speed to
            # others, whose stop gives it back: each of them would have an event, and a step behind it.
            slides = resting.closed & ~resting.stick & jnp.asarray(elements.rough)
            still = still | (slides & ~begins & ~stopped & (speed <= slow))
            problem, along = kernel(self._forces, derivative=False)(unknown, resting, at, t, q, after)
            final = search_mode(elements, problem, resting, along, released, busy & ~choice.wrong)
            follows, soft, short, paradox, tail = kernel(self._flights, derivative=False)(
                unknown, collision, problem, final.mode, final.slip, t, q, v, after, (height, fast)
            )
            cornered = kernel(self._paradox, derivative=False)(problem, resting, along)
            # Both choices are valid if no element disagreed in the end.
            settled = ~(choice.wrong | final.wrong)
            ends = settled & ~gains & (soft.any() | short.any())
            tail = jnp.where(ends & (last.tail == 0), tail, last.tail)
            new = Transition(collision, follows, final.slip, after, settled, paradox | (cornered & ~settled), tail)
            fate = (
                jnp.where(gains, jnp.where(rebound > 0.1, rebound / 2, 0.0), jnp.where(soft, 0.0, rebound)),
                held | (short & ~gains & ~still.any()),
                stopped | still,
            )
            fate = jax.tree.map(lambda a, b: jnp.where(settled, a, b), fate, (rebound, held, stopped))
            more = jnp.where(settled, gains | soft.any() | short.any() | still.any(), guess < len(_IMPACTS) - 1)
            guess = jnp.where(settled, 0, guess + 1).astype(jnp.int32)
            after = tries + 1, guess, fate, new, more & (tries < 4 * n + 12)
            return jax.tree.map(lambda a, b: jnp.where(busy, a, b), after, carry)

        none, no, zero = jnp.zeros((n,), bool), jnp.zeros((), bool), jnp.zeros((), jnp.int32)
        mode = mode._replace(excess=jnp.zeros((n,), q.dtype), creep=jnp.zeros((n,), q.dtype))
        # As far as the square of the speed is below the tolerance, the direction of sliding may lag behind.
        fast = jnp.asarray(1e-4, q.dtype) if atol is None else 0.3 * jnp.sqrt(jnp.maximum(atol, minimum))
        start = Collision(mode, slip, jnp.ones((n,), q.dtype), none, stopped)
        blank = Transition(start, mode, slip, v, no, no, jnp.zeros((), q.dtype))
        return while_loop(lambda carry: carry[4], attempt, (zero, zero, start[2:], blank, ~no & happens))[3]

    def _velocities(self, unknown, mode: Mode, rebound, held, stopped, slip, t, q, v):
        """Problem of an impact, and directions of sliding (n, 2)."""
        scene, elements = self._bind(unknown)[0], self.elements
        terms, of = terms_at(scene, elements, q, v, t), coefficients(scene, elements, v.dtype)
        rates = terms.row.velocity
        wanted = by_normal_row(elements, rebounds(elements, terms, of.restitution * rebound))
        each = jnp.ones(rebound.shape, bool)
        size = (1 + jnp.max(jnp.abs(rates))) / jnp.max(terms.gram.squares)
        sliding, static = jnp.where(held, 0.0, of.sliding), jnp.where(held, 0.0, of.static)
        loads, touches, rate = jnp.zeros_like(rebound), self._touches(scene, q, t), 1 + self._speeds(terms, v)
        problem = Problem(
            terms.gram, rates - wanted, sliding, static, loads, touches, each, held, stopped, size, rate
        )  # fmt: skip
        return problem, directions(scene, elements, mode, jnp.zeros_like(slip), slip)

    def _touches(self, scene: Scene, q, t):
        opens, gap = jnp.asarray(self.elements.opening), gaps(scene, self.elements, q, t)
        return opens & (gap <= 2 * tolerance(q.dtype) * (1 + jnp.max(jnp.abs(q))))

    def _speeds(self, terms: StateTerms, v):
        """Sizes (n,) of the terms that cancel in the velocities of each element."""
        across, beside = rates_of(self.elements, jnp.sum(jnp.abs(terms.row.A) * jnp.abs(v)[None], 1))
        return jnp.maximum(across, jnp.max(beside, 1))

    def _after(self, unknown, collision: Collision, begins, t, q, v):
        """Mode and directions behind an impact before forces are known, the velocity (nv,), whether it gains energy, and speeds
        (n,) of sliding."""
        scene, elements = self._bind(unknown)[0], self.elements
        terms, of = terms_at(scene, elements, q, v, t), coefficients(scene, elements, v.dtype)
        after, reaction = impact(scene, elements, collision, terms, v)
        rates = terms.gram.times(reaction.along) + terms.row.velocity
        speed, unit = length(rates_of(elements, rates)[1])
        is_sliding = speed > 2 * tolerance(v.dtype) * (1 + self._speeds(terms, v))
        # Elements that rebound open; those that came to rest together stick if their cones allow it.
        opened = rebounds(elements, terms, of.restitution * collision.rebound) > 0
        closed = collision.mode.closed & ~(jnp.asarray(elements.opening) & opened)
        stick = (collision.mode.stick | (jnp.asarray(elements.rough) & ~is_sliding & ~begins)) & closed
        mode = collision.mode._replace(closed=closed, stick=stick & ~is_sliding)
        work, size = (jnp.sum(a * b) for a, b in (
            (reaction.along, rates + terms.row.velocity), (jnp.abs(reaction.along), jnp.abs(rates) + jnp.abs(terms.row.velocity))
        ))  # fmt: skip
        gains = (work > 1e-6 * size) & (opened & (collision.rebound > 0)).any()
        return mode, jnp.where(is_sliding[:, None], unit, collision.slip), after, gains, speed

    def _forces(self, unknown, mode: Mode, slip, t, q, v):
        """Problem of the forces, and directions of sliding (n, 2)."""
        scene, generalized_force, _ = self._bind(unknown, mode.positive)
        elements, zero = self.elements, jnp.zeros(slip.shape[:1], v.dtype)
        terms, of = terms_at(scene, elements, q, v, t), coefficients(scene, elements, v.dtype)
        free, rates = free_motion(scene, terms, generalized_force(q, v, t), q, v, t)
        # Sizes of the terms that cancel in the rates.
        sizes = self._speeds(terms, terms.metric.unwhiten(free)) + jnp.max(jnp.abs(terms.row.gamma))
        minimum = 2 * tolerance(v.dtype) * (1 + self._speeds(terms, v))
        rests = self._touches(scene, q, t) & (jnp.abs(rates_of(elements, terms.row.velocity)[0]) <= minimum)
        speed, _ = length(terms.slip)
        size = jnp.max(jnp.abs(rates)) / jnp.max(terms.gram.squares)
        loads = normal_loads(scene, elements, q, v, t)
        # A contact in flight has no force, and an element that slides does not stick.
        problem = Problem(
            terms.gram, rates, of.sliding, of.static, loads, rests, speed <= minimum, zero > 0, zero > 0, size, sizes
        )  # fmt: skip
        return problem, directions(scene, elements, mode, terms.slip, slip)

    def _flights(self, unknown, collision: Collision, problem: Problem, mode: Mode, along, t, q, v, after, limits):
        """Mode, contacts (n,) whose rebound is too low to be followed, others whose flight is, whether a pivot is lost, and the
        time in which such flights come to rest."""
        scene, elements = self._bind(unknown)[0], self.elements
        terms, of = terms_at(scene, elements, q, v, t), coefficients(scene, elements, v.dtype)
        height, fast = limits
        still, reaction, rates = find_jams(elements, problem, mode, along)
        rate = rates_of(elements, rates)[0]
        velocity = rates_of(elements, matmul(terms.row.A, after - v) + terms.row.velocity)[0]
        flies = (
            self._touches(scene, q, t)
            & ~mode.closed
            & (velocity > 2 * tolerance(v.dtype) * (1 + self._speeds(terms, v)))
        )
        # It comes back if its gap is accelerated downwards: from the height v^2/2a.
        low = flies & (rate < 0) & (velocity * velocity <= -2 * rate * height)
        bounces = collision.mode.closed & (rebounds(elements, terms, of.restitution * collision.rebound) > 0)
        lost = (mode.closed & ~mode.stick & (reaction.pivots <= 0)).any()
        follows = with_excess(elements, problem, mode, still)
        slides = mode.closed & ~follows.stick & jnp.asarray(elements.planar)
        speed, _ = length(rates_of(elements, matmul(terms.row.A, after - v) + terms.row.velocity)[1])
        # Explicit steps could not follow a direction that turns ever faster as the speed falls to zero.
        begins = problem.may_stick | (speed < 0.9 * fast)
        follows = follows._replace(creep=jnp.where(slides, jnp.where(begins, fast, -_SLOWER * fast), 0.0))
        soft, short = low & bounces, low & ~bounces & ~collision.held
        # Every flight takes 2 v / a, and the next one is shorter by the ratio of this impact's velocities: a geometric series.
        before = jnp.max(jnp.where(self._touches(scene, q, t), -rates_of(elements, terms.row.velocity)[0], 0.0))
        ends, one = soft | short, jnp.ones_like(before)
        ratio = jnp.max(jnp.where(ends, velocity, 0.0)) / jnp.where(before > 0, before, one)
        flight = jnp.max(jnp.where(ends, 2 * velocity / jnp.where(ends, -rate, 1.0), 0.0))
        # Slower ones are rounding of velocities that are zero.
        bounces_on = (ratio > tolerance(v.dtype) ** 0.5) & (ratio < 1)
        tail = jnp.where(bounces_on, flight / jnp.where(bounces_on, 1 - ratio, one), 0.0)
        return follows, soft, short, lost, tail

    def _paradox(self, problem: Problem, mode: Mode, along):
        """True if sliding in a mode has lost a positive pivot of its forces: then they do not exist, or are not unique."""
        reaction = react(self.elements, mode, problem.gram, problem.sliding, problem.loads, along, -problem.free)
        return (mode.closed & ~mode.stick & (reaction.pivots <= 0)).any()

    def _find_jams(self, problem: Problem, mode: Mode, along):
        """Elements (n,) whose slow slip behind an impact is only an error of their directions."""
        still, _, rates = find_jams(self.elements, problem, mode, along)
        return still & (length(rates_of(self.elements, rates)[1])[0] > 2 * tolerance(along.dtype) * problem.rate)

    def impact(self, unknown, collision, t, y):
        y = self.plan.structure(y)
        return ravel_pytree(y | {"v": kernel(self._impact)(unknown, collision, t, y["q"], y["v"])})[0]

    def _impact(self, unknown, collision: Collision, t, q, v):
        scene, elements = self._bind(unknown)[0], self.elements
        terms, slip = terms_at(scene, elements, q, v, t), jax.lax.stop_gradient(collision.slip)

        def velocity(slip):
            return impact(scene, elements, collision._replace(slip=slip), terms, v)[0]

        if not elements.planar.any():
            return velocity(slip)
        turns = jnp.asarray(elements.planar) & slides(elements, collision.mode) & ~collision.held

        def excess(flat):
            """Directions (2 n,) of the velocity behind the impact, against which friction acts, minus those that are assumed."""
            rates = terms.row.velocity + matmul(terms.row.A, velocity(flat.reshape(slip.shape)) - v)
            size, unit = length(rates_of(elements, rates)[1])
            turned = jnp.where((turns & (size > tolerance(v.dtype)))[:, None], unit, jax.lax.stop_gradient(slip))
            return turned.reshape(-1) - flat

        # The directions are known; steps of Newton's method that change no value give them their derivatives, one order each.
        flat = slip.reshape(-1)
        solve = solver_of(jax.lax.stop_gradient(jax.jacfwd(excess)(flat)))
        for _ in range(2):
            missing = excess(flat)
            flat = flat - solve((missing - jax.lax.stop_gradient(missing))[:, None])[:, 0]
        return velocity(flat.reshape(slip.shape))

    def slip(self, y):
        return self.plan.structure(y)["slip"]

    def slip_behind(self, unknown, mode: Mode, following: Mode, slip, t, y):
        if not self.elements.planar.any():
            return slip
        y = self.plan.structure(y)
        holding, *_ = kernel(self._friction)(unknown, mode, y["slip"], t, y["q"], y["v"])
        # From rest an element slides against the friction that held it, and so until it is fast enough to have a direction.
        begins, creeps = (following.creep > 0) & mode.stick, (following.creep > 0) & ~mode.stick
        fixed = jnp.where(begins[:, None], length(-holding)[1], y["slip"])
        known = jax.lax.stop_gradient(fixed)
        is_same = jnp.sum((known - slip) ** 2, 1) < tolerance(slip.dtype)
        return slip + jnp.where(((begins | creeps) & is_same)[:, None], fixed - known, 0.0)

    def with_slip(self, y, v, slip):
        y = self.plan.structure(y)
        return ravel_pytree(y | {"v": y["v"] if v is None else v, "slip": slip})[0]
