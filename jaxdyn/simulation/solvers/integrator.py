"""Derivatives of an integration by its own steps, whatever made them, and the runs by explicit steps (`driver`)."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn.compile import reverse_only
from jaxdyn.compile.loops import Given
from jaxdyn.constraints.codes import RESULTS, first_of
from jaxdyn.simulation.solvers import driver, reverse
from jaxdyn.simulation.solvers.driver import AdaptiveSteps, FixedSteps
from jaxdyn.simulation.solvers.explicit import Plan

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


class ExplicitRun(Integrator):
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
