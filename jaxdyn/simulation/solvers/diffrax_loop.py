"""Runs in diffrax's loop, whose reverse mode takes the steps of the forward run, and their events.

diffrax recomputes steps from checkpoints. Their lengths follow from error estimates, whose last digits depend on the program,
and the program is another one there: one may refuse a step that the other keeps, and the parts that are put together belong to
two different runs. Here the forward run records the ends of its steps, so that nothing is left to decide on the way back.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from jaxdyn.compile import forward_only, reverse_only
from jaxdyn.model.arguments import Number
from jaxdyn.simulation.equations import WITHIN
from jaxdyn.simulation.solvers.base import Flag, StepOutput, Wrapped
from jaxdyn.simulation.solvers.choice import innermost
from jaxdyn.simulation.solvers.driver import COUNTS, FORWARD, ROOM
from jaxdyn.simulation.solvers.guards import delay

_FIRST_ORDER = (
    'this method has first derivatives in reverse mode alone; forward mode (jax.jvp, jax.jacfwd) needs adjoint="forward" of '
    'jd.simulate, Hessians need adjoint="direct", or adjoint="forward" and jax.jacfwd twice'
)
_FORWARD_ONLY = (
    'adjoint="forward" of this method has derivatives in forward mode alone (jax.jvp, jax.jacfwd); reverse mode (jax.grad, '
    'jax.jacrev) needs adjoint="reverse", the default of jd.simulate, and Hessians adjoint="direct" or jax.jacfwd twice'
)


class DiffraxRun(NamedTuple):
    """Arguments of a run in diffrax's loop, as of `diffrax.diffeqsolve`.

    `record`: True to save the times at which steps ended too; `end`, (), s: a time whose state is returned as that of the event.
    """

    term: Any
    solver: Any
    controller: Any
    event: diffrax.Event | None
    adjoint: diffrax.AbstractAdjoint
    max_steps: int
    progress: diffrax.AbstractProgressMeter
    dt0: Any
    record: bool = False
    end: Any = None


def run(inputs, given: DiffraxRun):
    """diffrax's solution from one end of the save points to the other.

    **Arguments:** `inputs`, what may be differentiated: the initial state, `args`, and the save points (nt,) with the start in
    front.

    **Returns:** rows of the state at ts[1:]; the result, the counts, the time reached and, if the time of an event is located,
    the state there; all that diffrax returned.
    """
    if isinstance(given.adjoint, diffrax.RecursiveCheckpointAdjoint):
        inputs = reverse_only(inputs, _FIRST_ORDER, first_order=True)
    y0, args, ts = inputs
    located, end = _is_located(given.event), given.end
    saves = diffrax.SubSaveAt(ts=ts[1:])
    last = diffrax.SubSaveAt(t1=True, fn=_state if located else _nothing)
    last = last if end is None else diffrax.SubSaveAt(ts=end[None])
    ends = (diffrax.SubSaveAt(steps=True, fn=_nothing),) if given.record else ()
    saveat = diffrax.SaveAt(subs=(saves, last, *ends), controller_state=True)
    continuous = isinstance(given.adjoint, diffrax.BacksolveAdjoint)  # supports save points and nothing else
    solved: Any = diffrax.diffeqsolve(
        given.term,
        _with_scan(given.solver, given.adjoint),
        t0=ts[0],
        t1=ts[-1],
        dt0=given.dt0,
        y0=y0,
        args=args,
        saveat=diffrax.SaveAt(subs=saves) if continuous else saveat,
        stepsize_controller=given.controller,
        adjoint=given.adjoint,
        event=given.event,
        max_steps=given.max_steps,
        throw=False,
        progress_meter=given.progress,
    )
    if isinstance(given.adjoint, diffrax.ForwardMode):
        solved = eqx.tree_at(
            lambda solved: (solved.ys, solved.ts), solved, forward_only((solved.ys, solved.ts), _FORWARD_ONLY)
        )
    counts = {name: solved.stats[name] for name in COUNTS}
    if continuous:
        reached = jnp.max(jnp.where(jnp.isfinite(solved.ts), solved.ts, ts[0]))
        return solved.ys, (solved.result, counts, reached), solved
    end = (jax.tree.map(lambda rows: rows[0], solved.ys[1]),) if located or end is not None else ()
    return solved.ys[0], (solved.result, counts, solved.ts[1][0], *end), solved


def _with_scan(solver, adjoint):
    """The method with loops over its stages that forward mode can differentiate, where an adjoint needs these.

    diffrax sets them on a method, or on one in a wrapper; in two wrappers it does not see the method.
    """
    kind = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}.get(type(adjoint))
    inner = innermost(solver)
    if kind is None or not isinstance(inner, diffrax.AbstractRungeKutta) or inner.scan_kind is not None:
        return solver
    return eqx.tree_at(lambda solver: innermost(solver).scan_kind, solver, kind, is_leaf=lambda x: x is None)


def run_adaptively(inputs, given: DiffraxRun, limit_is_given: bool) -> tuple[Any, tuple]:
    """Rows and facts of `run` with adaptive steps whose ends are constants to reverse mode.

    The time of an event then follows from the state at its end.
    """
    if not isinstance(given.controller, diffrax.AbstractAdaptiveStepSizeController):
        return run(inputs, given)[:2]  # with steps that are given, as those of `diffrax.StepTo`
    numbers, rest = eqx.partition(given, eqx.is_array)
    # Tolerances and limits decide which steps are made, and the steps are constants here.
    given = eqx.combine(jax.lax.stop_gradient(numbers), rest)
    room = given.max_steps if limit_is_given else min(given.max_steps, ROOM)
    if isinstance(given.adjoint, diffrax.RecursiveCheckpointAdjoint):
        return _with_end(_run(reverse_only(inputs, FORWARD), given, room), inputs[1], given)
    if isinstance(given.adjoint, diffrax.DirectAdjoint):
        numbers, rest = eqx.partition(inputs, eqx.is_array)
        facts, steps = _record(eqx.combine(jax.lax.stop_gradient(numbers), rest), given, given.max_steps)[1:]
        rows, repeated, _ = run(inputs, _repeat(given, steps, facts[2]))
        return _with_end((rows, (*facts[:3], *repeated[3:])), inputs[1], given)
    return run(inputs, given)[:2]


@eqx.filter_custom_vjp
def _run(inputs, given, room):
    return run(inputs, given)[:2]


@_run.def_fwd
def _(perturbed, inputs, given, room):
    rows, facts, steps = _record(inputs, given, room)
    return (rows, facts), (steps, facts[2])


@_run.def_bwd
def _(residuals, gradients, perturbed, inputs, given, room):
    free, fixed = eqx.partition(inputs, perturbed)
    given = _repeat(given, *residuals)

    def states(free):
        rows, facts, _ = run(eqx.combine(free, fixed), given)
        return rows, facts[3:]

    values, pull = eqx.filter_vjp(states, free)
    of_states = gradients[0], gradients[1][3:]
    return pull(jax.tree.map(lambda y, g: jnp.zeros_like(y) if g is None else g, values, of_states))[0]


def _is_located(event) -> bool:
    """True for an event whose time within a step is found."""
    return event is not None and event.root_finder is not None


def _with_end(solved, args, given: DiffraxRun):
    """Rows and facts, whose time of an event has its derivative."""
    rows, (result, counts, reached, *last) = solved
    if not last:
        return solved
    codes: Any = diffrax.RESULTS
    event: Any = given.event
    term, (end,) = given.term, last
    y, unravel = ravel_pytree(end)

    def guard(known, t, y):
        args, condition = known
        return condition(t, unravel(y), args)

    def field(known, t, y):
        return ravel_pytree(term.vf_prod(t, unravel(y), known[0], term.contr(t, t + 1)))[0]

    late = delay(guard, field, (args, event.cond_fn), reached, y)
    return rows, (result, counts, reached + jnp.where(result == codes.event_occurred, late, 0.0), end)


def _record(inputs, given: DiffraxRun, room):
    """Rows and facts of `run`, and the controller that repeats its steps."""
    recorded = given._replace(adjoint=diffrax.ForwardMode(), max_steps=room, record=True)
    rows, facts, solution = run(inputs, recorded)
    starts, jumps = solution.ts[2], _jumps(given.controller)
    ends = starts
    if jumps is not None:
        # A step ends at the number before a jump, and the next one starts at the second one after it.
        before, after = _beside(jumps, -1), _beside(_beside(jumps, 1), 1)
        is_jump = (starts[:, None] > before[None]) & (starts[:, None] <= after[None])
        ends = jnp.where(is_jump.any(1), before[is_jump.argmax(1)], starts)
    controller = _GivenSteps(ends, None if jumps is None else starts, solution.stats["num_accepted_steps"])
    return rows, facts, jax.lax.stop_gradient(controller)


def _repeat(given: DiffraxRun, controller, end):
    """Options of a run that repeats steps, with the state at the time `end` if that is the time of an event."""
    end = jax.lax.stop_gradient(end) if _is_located(given.event) else None
    meter, maximum = diffrax.NoProgressMeter(), controller.ends.shape[0]
    return given._replace(controller=controller, max_steps=maximum, progress=meter, event=None, end=end)


class _GivenSteps(diffrax.AbstractStepSizeController):
    """Step-size control by steps that were recorded."""

    ends: jax.Array
    starts: jax.Array | None
    count: jax.Array

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        # Where no step was kept, one of no length.
        return jnp.where(self.count > 0, _along(self.ends[0], t0), t0), jnp.asarray(1)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        # Behind the last record the index is held within the array: the code reports that steps are missing.
        row = jnp.minimum(controller_state, self.ends.shape[0] - 1)
        over = controller_state >= self.count
        start = t1 if self.starts is None else jnp.where(over, t1, _along(self.starts[controller_state - 1], t1))
        end = jnp.where(over, t1, _along(self.ends[row], t1))
        codes: Any = diffrax.RESULTS
        result = codes.where(over, codes.max_steps_reached, codes.successful)
        # With jumps the state of the previous step is not valid any more.
        return True, start, end, self.starts is not None, controller_state + 1, result


def _jumps(controller):
    """Times of jumps at which a step-size control ends and begins a step, if any."""
    if isinstance(controller, diffrax.ClipStepSizeController):
        return _jumps(controller.controller) if controller.jump_ts is None else controller.jump_ts
    return None


def _beside(t, side: int):
    """Next floating-point number on a side, as diffrax computes it: none is denormal."""
    tiny = jnp.full_like(t, side * jnp.finfo(t.dtype).tiny)
    return jnp.where(t == 0, tiny, jnp.nextafter(t, jnp.full_like(t, side * jnp.inf)))


def _along(t, base):
    """Time `t`, with the derivatives of `base`."""
    return t + (base - jax.lax.stop_gradient(base))


def _nothing(t, y, args):
    return None


def _state(t, y, args):
    return y


# --- events of a run in diffrax's loop ---


# Fractions of a step at which diffrax's loop evaluates the allowances.
_FRACTIONS = (0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875)


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

        def minimum(fraction):
            t = start + fraction * (end - start)
            return jnp.min(self.guards(t, dense.evaluate(t), args)[0])

        passed = (jax.vmap(minimum)(jnp.asarray(_FRACTIONS, jnp.result_type(t0))) < 0).any()
        mark = jnp.where(passed, -1.0, 1.0).astype(y1[WITHIN].dtype)
        return y1 | {WITHIN: mark}, error, dense_info, state, result


def event_of(quality, guards, t0, y0, args) -> diffrax.Event | None:
    """Event of a run in diffrax's loop, from the quality (t, y, args) of a basis and the guards, each a function or None."""
    if guards is None:
        return None if quality is None else diffrax.Event(quality)
    start = None if quality is None else jax.lax.stop_gradient(quality(t0, y0, args))

    def condition(known, t, y, args, **_):
        start, sizes = known
        # One event for all conditions: the first one that is violated ends the run.
        minimum = jnp.minimum(jnp.min(guards(t, y, args)[0] / sizes), y[WITHIN])
        if quality is not None:
            # A run has one event: a basis that has become singular counts as a violation, whatever the allowances.
            minimum = jnp.where(quality(t, y, args) * start > 0, minimum, -jnp.ones_like(minimum))
        return minimum.astype(float)  # the dtype of diffrax's own branches

    eps = float(jnp.finfo(t0.dtype).eps)
    # A traced value must be a leaf of the event: reverse mode refuses one that a function captures.
    known = start, sizes_of(guards, t0, y0, args)
    return diffrax.Event(
        jax.tree_util.Partial(condition, known), Bisection(rtol=8 * eps, atol=8 * eps, flip=True), direction=False
    )


def sizes_of(guards, t0, y0, args):
    """Sizes (k,) of guards, each in its own units, from the start of a run."""
    sizes = jnp.abs(jax.lax.stop_gradient(guards(t0, y0, args)[0]))
    return jnp.where(sizes > 0, sizes, jnp.ones_like(sizes))


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
