"""Terminal events of a run: contacts that leave their cones, joints that pass their limits, controls that become singular.

The rows of a contact are two-sided; whether its cone admits the multipliers is tested during the motion. Each of these conditions
has an allowance, which is negative where it is violated. The run ends at the first zero of the least allowance that a step shows
at its end or within. The library's own loops locate it by shorter steps (`solvers/guards.py`); diffrax's by bisection of the
step's dense output. Where a save point alone shows a violation, its time is that of the save point.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxdyn.contact.forces import contact_forces, contacts_with_cones
from jaxdyn.model.arguments import Number
from jaxdyn.model.tree import Model
from jaxdyn.simulation.options import is_backsolve
from jaxdyn.simulation.solution import RESULTS, Solution, joint_of
from jaxdyn.simulation.solvers.base import Flag, StepOutput, Wrapped
from jaxdyn.systems.scene import Scene


class JointLimitWarning(UserWarning):
    """A motion has passed a position limit of the model, and continues."""


class Conditions(NamedTuple):
    """Conditions that can end a run: its contacts, its joint limits, its control, and the number of terminal events."""

    contacts: bool
    limits: bool
    control: bool
    terminals: int

    def counts(self, scene: Scene) -> tuple[int, int, int, int]:
        """Numbers of allowances of contacts, limits, the control and terminal events, in this order among all."""
        contacts = len(contacts_with_cones(scene)) if self.contacts else 0
        return contacts, 2 * scene.nq if self.limits else 0, int(self.control), self.terminals


def check_conditions(conditions: Conditions, adjoint) -> None:
    """Refuse an adjoint that does not go back through the event that may end a run."""
    if any(conditions) and is_backsolve(adjoint):
        raise ValueError(
            "adjoint is 'backsolve', which does not go back through events, and contacts, limits, a terminal event or the "
            "control may end the run; take 'reverse', or jd.events.ContactLost(stop=False), no other events and a control "
            "without `allowance`"
        )


def contact_allowances(scene: Scene, multipliers: Float[Array, " nc"]) -> Float[Array, " k"]:
    """Margin of each contact with a cone, plus the rounding of its force, eps^(1/2) |f|; N. Negative where it is lost."""
    contacts = contact_forces(scene, multipliers)
    # A contact that is held exactly on its cone is not lost by rounding.
    slack = jnp.finfo(multipliers.dtype).eps ** 0.5
    return jnp.stack(
        [contacts.margins[name] + slack * jnp.sum(jnp.abs(contacts.forces[name])) for name in contacts.margins]
    )


def limit_allowances(model: Model, q: Float[Array, " nq"]) -> Float[Array, " n"]:
    """Distances of q above the lower limits, then below the upper ones, plus rounding, eps^(1/2) of the limit's size.

    Negative where a limit is passed, rad or m; a large number where there is none.
    """
    # A finite number for "no limit": bisection and products of infinity would give NaN.
    none = jnp.full_like(q, float(jnp.finfo(q.dtype).max) ** 0.5)

    def allowance(limit, room):
        slack = jnp.finfo(q.dtype).eps ** 0.5 * jnp.maximum(jnp.abs(limit), jnp.ones_like(limit))
        return jnp.where(jnp.isfinite(limit), room + slack, none)

    lower, upper = model.lower.astype(q.dtype), model.upper.astype(q.dtype)
    return jnp.concatenate([allowance(lower, q - lower), allowance(upper, upper - q)])


class Violation(NamedTuple):
    """The first violation: whether and when there was one, and the entry of the allowances, -1 for none."""

    happened: Bool[Array, ""]
    time: Float[Array, ""]
    entry: Int[Array, ""]

    def codes(self, counts: tuple[int, int, int, int]) -> list[tuple[Any, Any]]:
        """Cases of the result, for `first_of`; `counts` as of `Conditions`."""
        codes: Any = RESULTS
        names = codes.contact_lost, codes.joint_limit_passed, codes.control_singular, codes.event_occurred
        return [(self._within(counts, i), code) for i, code in enumerate(names)]

    def _within(self, counts, kind: int) -> Bool[Array, ""]:
        first = sum(counts[:kind])
        return self.happened & (self.entry >= first) & (self.entry < first + counts[kind])

    def stats(self, conditions: Conditions, counts: tuple[int, int, int, int]) -> dict[str, Array]:
        """Index of the contact that was lost, entry of q whose limit was passed, terminal event, each -1 for none."""
        # The lower limits of all entries come before the upper ones: both belong to the entry modulo their number.
        names = {"lost_contact": (0, counts[0]), "passed_limit": (1, counts[1] // 2), "terminal_event": (3, counts[3])}
        return {
            name: jnp.where(self._within(counts, kind), (self.entry - sum(counts[:kind])) % size, -1).astype(jnp.int32)
            for name, (kind, size) in names.items()
            if conditions[kind]
        }


def first_violation(rows: Float[Array, "nt k"], reached, ts, within) -> Violation:
    """First negative allowance, from those at the save points and at the event that ended a step.

    `within` is None, or whether there was such an event, its time and the allowances (k,) there.
    """
    below = reached & (rows < 0).any(1)
    # The first true flag; zero without any, where `happened` is false.
    first = jnp.argmax(below)
    violation = Violation(below.any(), ts[first], jnp.argmin(rows[first]).astype(jnp.int32))
    if within is not None:
        happened, time, margins = within
        # A singular basis may have ended the step too: then no margin is near zero.
        happened = happened & (jnp.min(margins) <= jnp.finfo(rows.dtype).eps ** 0.25 * (1 + jnp.max(jnp.abs(margins))))
        located = Violation(happened, time, jnp.argmin(margins).astype(jnp.int32))
        earlier = happened & ~(violation.happened & (violation.time <= time))
        violation = jax.tree.map(lambda a, b: jnp.where(earlier, a, b), located, violation)
    return violation._replace(entry=jnp.where(violation.happened, violation.entry, -1))


# Entry of the state in diffrax's loop: -1 where an allowance has been negative within the last step, else 1.
WITHIN = "within_step"
# Fractions of a step at which diffrax's loop evaluates the allowances.
_FRACTIONS = tuple(i / 8 for i in range(1, 8))


class GuardedSolver(Wrapped):
    """A method whose steps mark in the state if an allowance has been negative within them.

    The condition of an event of diffrax knows the state at the end of a step alone.
    """

    guards: Callable

    @property
    def term_compatible_contr_kwargs(self) -> PyTree:
        """Arguments of the terms of the wrapped method."""
        return self.solver.term_compatible_contr_kwargs

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        """Dense output of the wrapped method."""
        return self.solver.interpolation_cls

    def step(
        self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree, solver_state: PyTree, made_jump: Flag
    ) -> StepOutput:
        """Make one step of the wrapped method and look within it."""
        y1, error, dense_info, state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        # The mark has no derivative, and neither have the guards that make it.
        arrays, rest_of_args = eqx.partition(args, eqx.is_array)
        start, end, info, arrays = jax.lax.stop_gradient((t0, t1, dense_info, arrays))
        dense, args = self.interpolation_cls(t0=start, t1=end, **info), eqx.combine(arrays, rest_of_args)

        def least(fraction):
            t = start + fraction * (end - start)
            return jnp.min(self.guards(t, dense.evaluate(t), args)[0])

        passed = (jax.vmap(least)(jnp.asarray(_FRACTIONS, jnp.result_type(t0))) < 0).any()
        mark = jnp.where(passed, -1.0, 1.0).astype(y1[WITHIN].dtype)
        return y1 | {WITHIN: mark}, error, dense_info, state, result


def event(quality, guards, t0, y0, args) -> diffrax.Event | None:
    """Event of a run in diffrax's loop, from the quality (t, y, args) of a basis and the guards, each a function or None."""
    if guards is None:
        return None if quality is None else diffrax.Event(quality)
    start = None if quality is None else jax.lax.stop_gradient(quality(t0, y0, args))

    def condition(start, t, y, args, **_):
        # One event for all conditions: the first one that is violated ends the run.
        least = jnp.minimum(jnp.min(guards(t, y, args)[0]), y[WITHIN])
        if quality is not None:
            # A run has one event: a basis that has become singular counts as a violation, whatever the allowances.
            least = jnp.where(quality(t, y, args) * start > 0, least, -jnp.ones_like(least))
        return least.astype(float)  # the dtype of diffrax's own branches

    eps = float(jnp.finfo(t0.dtype).eps)
    # A traced value must be a leaf of the event: reverse mode refuses one that a function captures.
    return diffrax.Event(
        jax.tree_util.Partial(condition, start), Bisection(rtol=8 * eps, atol=8 * eps, flip=True), direction=False
    )


class Bisection(optimistix.Bisection):
    """Bisection of a function that falls through zero, until the interval is at rounding, however steep the function is."""

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Begin with the interval up to the first point at which the function is negative."""
        lower, upper = options["lower"], options["upper"]
        # The function may be positive again at the end. From the last point to the first, so that the first one stays.
        points = [lower + fraction * (upper - lower) for fraction in _FRACTIONS]
        values = jax.vmap(lambda t: fn(t, args)[0])(jnp.stack(points))
        for point, value in zip(reversed(points), reversed(list(values)), strict=True):
            upper = jnp.where(value < 0, point, upper)
        return super().init(fn, y, args, options | {"upper": upper}, f_struct, aux_struct, tags)

    def step(self, fn, y, args, options, state, tags):
        """Halve the interval; the first point, the end of the step, may be behind it."""
        return super().step(fn, jnp.minimum(y, state.upper), args, options, state, tags)

    # optimistix also asks for a small value of the function, which a steep one does not reach.
    def terminate(self, fn, y, args, options, state, tags):
        """Stop when the interval is small."""
        width = jnp.abs(state.upper - state.lower)
        return width <= self.atol + self.rtol * jnp.abs(y), optimistix.RESULTS.successful


def report_limits(scene: Scene, solution: Solution, is_concrete: bool) -> Solution:
    """Add `stats["passed_limit"]` to a solution; a concrete one that passes a limit warns, a traced one does not."""
    model: Any = scene.system
    margins = jax.vmap(limit_allowances, (None, 0))(model, solution.q)
    # Rows that the run did not reach are NaN.
    below = jnp.isfinite(solution.q).all(1) & (margins < 0).any(1)
    entry = jnp.argmin(margins[jnp.argmax(below)]) % (margins.shape[1] // 2)
    entry = jnp.where(below.any(), entry, -1).astype(jnp.int32)
    if is_concrete and int(entry) >= 0:
        first, joint = int(np.argmax(np.asarray(margins < 0).any(1))), joint_of(model, int(entry))
        lower, upper, q = (float(np.asarray(x)[int(entry)]) for x in (model.lower, model.upper, solution.q[first]))
        side, limit = ("lower", lower) if q - lower < upper - q else ("upper", upper)
        words = (
            f"joint {joint!r} is at {q:.6g}, its {side} limit is {limit:.6g}, at t = {float(solution.ts[first]):.6g} s"
        )
        warnings.warn(
            f"{words}; the motion continues (jd.events.JointLimit() ends it there)", JointLimitWarning, stacklevel=3
        )
    return eqx.tree_at(lambda s: s.stats, solution, solution.stats | {"passed_limit": entry})
