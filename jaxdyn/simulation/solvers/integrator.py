"""Derivatives of an integration by its own steps, whatever made them."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


class Integrator(eqx.Module):
    """Integrator whose derivatives are those of its own steps: call(y0, args, ts) -> results, rows of the state at ts[1:] first.

    To derivatives the ends of steps are constants, except that they follow the start and the end of the run. A loop in native
    code has values and no derivatives: reverse mode is `pull`, along the history of the run; forward mode and derivatives of
    `pull` are those of `replay`.
    """

    room: int = eqx.field(static=True, kw_only=True)  # steps that a history holds

    def __call__(self, y0, args, ts):
        return _integrate((y0, args, ts), jax.lax.stop_gradient(self))

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
