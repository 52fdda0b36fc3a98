"""Derivatives of an integration by its own steps, whatever made them: runs by explicit steps (`driver`), and in diffrax's loop.

diffrax recomputes steps from checkpoints. Their lengths follow from error estimates, whose last digits depend on the program,
and the program is another one there: one may refuse a step that the other keeps, and the parts that are put together belong to
two different runs. Here the forward run records the ends of its steps, so that nothing is left to decide on the way back, which
has no error estimates and no refused steps either.
"""

from abc import abstractmethod
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn.compile import reverse_only
from jaxdyn.compile.loops import Given
from jaxdyn.constraints.codes import RESULTS, first_of
from jaxdyn.simulation.solvers import driver, reverse
from jaxdyn.simulation.solvers.choice import innermost
from jaxdyn.simulation.solvers.driver import AdaptiveSteps, FixedSteps
from jaxdyn.simulation.solvers.guards import delay
from jaxdyn.simulation.solvers.steps import Plan

FORWARD = (
    'forward mode (jax.jvp, jax.jacfwd) through a run or a step needs adjoint="forward", of jd.simulate or jd.stepper'
)


class Integrator(eqx.Module):
    """Integrator whose derivatives are those of its own steps: call(y0, args, ts) -> results, rows of the state at ts[1:] first.

    To derivatives the ends of steps are constants, except that they follow the start and the end of the run. A loop in native
    code has values and no derivatives: reverse mode is `pull`, along the history of the run; forward mode and derivatives of
    `pull` are those of `replay`.
    """

    room: int = eqx.field(static=True, kw_only=True)  # steps that a history holds

    def __call__(self, y0, args, ts):
        return _integrate(reverse_only((y0, args, ts), FORWARD), jax.lax.stop_gradient(self))

    def direct(self, y0, args, ts):
        """Integrate with derivatives of any order in both modes."""
        return _with_history((y0, args, ts), jax.lax.stop_gradient(self), self.room)[0]

    @abstractmethod
    def values(self, inputs, room: int | None) -> tuple[tuple, Any]:
        """Results without derivatives, and a history of at most `room` steps (None: without one)."""

    @abstractmethod
    def replay(self, history, inputs, direct: bool) -> tuple:
        """The first results, by the steps of a history; differentiable, and if `direct` to any order in both modes."""

    @abstractmethod
    def weights(self, inputs, gradients, history) -> tuple:
        """Cotangents of the results of `replay`, from those of all results, which may be None."""

    def pull(self, inputs, weights, history, perturbed):
        """Cotangents of the inputs from those of the results of `replay`."""
        return self.pull_replay(inputs, weights, history, perturbed, direct=False)

    def pull_replay(self, inputs, weights, history, perturbed, direct: bool):
        """Cotangents of the inputs through `replay`."""
        free, fixed = eqx.partition(inputs, perturbed)
        _, pull = jax.vjp(lambda free: self.replay(history, eqx.combine(free, fixed), direct), free)
        return pull(weights)[0]


def zeros_or(gradients, like, count: int):
    """Cotangents of rows (count, ...) of states `like`, with zeros for those that are None."""
    return jax.tree.map(lambda y, g: jnp.zeros((count, *y.shape), y.dtype) if g is None else g, like, gradients)


@eqx.filter_custom_vjp
def _integrate(inputs, run: Integrator):
    return _with_history(inputs, run, None)[0]


@_integrate.def_fwd
def _(perturbed, inputs, run: Integrator):
    return _with_history(inputs, run, run.room)


@_integrate.def_bwd
def _(history, gradients, perturbed, inputs, run: Integrator):
    history = jax.lax.stop_gradient(history)
    return _pull((inputs, run.weights(inputs, gradients, history)), history, run, perturbed)


@eqx.filter_custom_jvp
def _with_history(inputs, run: Integrator, room: int | None):
    return run.values(inputs, room)


@_with_history.def_jvp
def _(primals, tangents):
    inputs, run, room = primals
    results, history = _with_history(inputs, run, run.room if room is None else room)
    known = jax.lax.stop_gradient(history)
    _, changes = eqx.filter_jvp(lambda inputs: run.replay(known, inputs, True), (inputs,), (tangents[0],))
    values = results, None if room is None else history
    still = jax.tree.map(lambda _: None, values)
    return values, ((*changes, *still[0][len(changes) :]), still[1])


@eqx.filter_custom_jvp
def _pull(given, history, run: Integrator, perturbed):
    inputs, weights = given
    return run.pull(inputs, weights, history, perturbed)


@_pull.def_jvp
def _(primals, tangents):
    given, history, run, perturbed = primals

    def pull(given):
        inputs, weights = given
        return run.pull_replay(inputs, weights, history, perturbed, True)

    _, change = eqx.filter_jvp(pull, (given,), (tangents[0],))
    return _pull(*primals), change


class LibraryRun(Integrator):
    """Integrator by explicit steps: call(y0, args, ts) -> rows of the state at ts[1:]; result, counts, and the time reached.

    A plan with guards has a further row, that of the state at the time reached.

    - `plan`, `control`: the steps and their control.
    - `rtol`, `atol`, for adaptive steps; `stepsize` (s), for fixed ones.
    - `max_steps`; `room`, the most where reverse mode is asked for.
    """

    plan: Plan = eqx.field(static=True)
    control: AdaptiveSteps | FixedSteps = eqx.field(static=True)
    rtol: Any
    atol: Any
    stepsize: Any
    max_steps: int = eqx.field(static=True)

    def values(self, inputs, room):
        y0, args, ts = inputs
        plan, control, start = self.plan, self.control, ravel_pytree(y0)[0]
        most = self.max_steps if room is None else room
        # The history of one step that is kept in any case follows from the inputs: where reverse mode computes a run again for
        # its history alone, this one is left out.
        is_one_step = room == 1 and plan.quality is plan.guards is None and isinstance(control, FixedSteps)
        history = None if room is None or is_one_step else reverse.blank(start, ts[0], most)
        records, strides = ((), ()) if history is None else (history.rows, history.strides)
        limits, carry = driver.begin(plan, control, args, ts, start, self.rtol, self.atol, self.stepsize, records)
        state, _, rows, records = driver.run_to_event(plan, control, most, strides, args, limits, Given(ts), carry)
        if history is not None:
            states, times, kept = records
            history = reverse.History(states, times, kept, state.tried)
        elif is_one_step:
            history = reverse.of_one_step(start, ts[0], jnp.minimum(ts[0] + self.stepsize, ts[-1]))
        stopped = state.stopped if state.search is None else state.stopped | state.search.hit.any()
        cases = [(stopped, RESULTS.event_occurred), *driver.cases_of(limits, control, state)]
        rows = rows if plan.guards is None else jnp.concatenate([rows, state.y[None]])
        facts = first_of(cases, RESULTS.successful), state.counts, state.t
        return (jax.vmap(plan.structure)(rows), facts), history

    def number_of_steps(self, ts):
        """Number of fixed steps, None where their ends do not follow the end of the run."""
        is_free = isinstance(self.control, AdaptiveSteps) or self.plan.guards is not None
        return None if is_free else driver.number_of_steps(ts[0], ts[-1], self.stepsize)

    def replay(self, history, inputs, direct):
        y0, args, ts = inputs
        ts, places = self._in_order(history, ts)
        rows = reverse.replay_rows(self.plan, history, ravel_pytree(y0)[0], args, ts, self.number_of_steps(ts))
        return (jax.vmap(self.plan.structure)(rows[places]),)

    def _in_order(self, history, ts):
        """Save points, the time reached among them if there are guards, and the places of the rows, of which its is the last."""
        if self.plan.guards is None:
            return ts, slice(None)
        last = jnp.maximum(history.count - 1, 0)
        times = jnp.append(ts[1:], jnp.where(history.count > 0, history.times[last, 1], ts[0]))
        order = jnp.argsort(lax.stop_gradient(times), stable=True)
        return jnp.concatenate([ts[:1], times[order]]), jnp.argsort(order)

    def weights(self, inputs, gradients, history):
        y0, _, ts = inputs
        return (zeros_or(gradients[0], y0, ts.shape[0] - (self.plan.guards is None)),)

    def pull(self, inputs, weights, history, perturbed):
        """Cotangents of the inputs by kernels."""
        y0, args, ts = inputs
        ts, places = self._in_order(history, ts)
        flat = jax.vmap(lambda y: ravel_pytree(y)[0])(weights[0])
        flat = flat.at[places].set(flat)
        start, structure = ravel_pytree(y0)
        of_y, of_args, of_ts = reverse.pull(
            self.plan, history, start, args, ts, self.number_of_steps(ts), flat, perturbed[1:]
        )
        # The end of a run that has guards is a constant time.
        of_ts = jnp.concatenate([of_ts[:1], of_ts[1:][places][: inputs[2].shape[0] - 1]])

        def or_none(x, varies):
            return x if varies else None

        return jax.tree.map(or_none, structure(of_y), perturbed[0]), of_args, or_none(of_ts, perturbed[2])


# --- runs in diffrax's loop, whose reverse mode takes the steps of the forward run ---


COUNTS = ("num_steps", "num_accepted_steps", "num_rejected_steps")
ROOM = 4096  # steps that are recorded where the user gives no limit: 32 kB a trajectory


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
    meter, most = diffrax.NoProgressMeter(), controller.ends.shape[0]
    return given._replace(controller=controller, max_steps=most, progress=meter, event=None, end=end)


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
