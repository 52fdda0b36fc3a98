"""Runs by explicit steps with derivatives: the loop of `driver`, and reverse and forward mode through its steps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn.compile.loops import Given
from jaxdyn.constraints.codes import RESULTS, first_of
from jaxdyn.simulation.solvers import driver, reverse
from jaxdyn.simulation.solvers.driver import AdaptiveSteps, FixedSteps
from jaxdyn.simulation.solvers.explicit import Plan
from jaxdyn.simulation.solvers.integrator import Integrator, zeros_or


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
