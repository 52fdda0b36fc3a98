"""Least-squares methods of optimistix, one step at a time, so that every point can be reported, kept and resumed."""

import contextlib
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from jaxdyn.identify.descent import Iterate, Method

SOLVERS = ("levenberg-marquardt", "dogleg")
_OPTIONS = {"jac": "fwd"}
# Steps without a lower loss after which only rounding is left to remove.
_STALE = 10


class LeastSquaresSteps(Method):
    """Levenberg-Marquardt or dogleg steps for the sum of squares of `errors(z, args)`; Jacobians by forward mode.

    It ends where a step changes unknowns and loss by less than `tolerance` of them. The state of an iterate is the solver's.
    """

    def __init__(self, errors: Callable, args, name: str, tolerance: float):
        kind = optx.LevenbergMarquardt if name == SOLVERS[0] else optx.Dogleg
        # A tolerance below rounding of float64 may never be met.
        self.solver = kind(rtol=max(tolerance, 1e-14), atol=max(tolerance, 1e-14))
        self.errors, self.args = errors, args

    def init(self, start, kept):
        """Start the solver, or restore its state."""
        with loose_promotion():
            state = _init(self.errors, self.solver, start, self.args)
            if kept is not None:
                arrays, rest = eqx.partition(state, eqx.is_array)
                leaves, structure = jax.tree.flatten(arrays)
                leaves = [jnp.asarray(kept[f"solver_{i:03d}"], leaf.dtype) for i, leaf in enumerate(leaves)]
                state = eqx.combine(jax.tree.unflatten(structure, leaves), rest)
            return self._iterate(start, state)

    def step(self, iterate, history, best):
        """Make one step, which need not be accepted: the point then stays and the solver's state changes."""
        if len(history) > _STALE and min(history[-_STALE:]) >= min(history[:-_STALE]):
            return iterate, "converged"
        with loose_promotion():
            y, state, done, has_failed = _step(self.errors, self.solver, iterate.point, self.args, iterate.state)
            following = self._iterate(y, state)
        if bool(has_failed):
            return following, "not_finite"
        return following, "converged" if bool(done) else None

    def arrays(self, iterate):
        """Array leaves of the solver's state."""
        return {
            f"solver_{i:03d}": leaf for i, leaf in enumerate(jax.tree.leaves(eqx.filter(iterate.state, eqx.is_array)))
        }

    def _iterate(self, y, state) -> Iterate:
        loss = float(_loss(self.errors, y, self.args))
        return Iterate(y, loss, state, bool(np.isfinite(loss)))


@contextlib.contextmanager
def loose_promotion():
    """Context in which dtypes and ranks are promoted, as optimistix and optax expect."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def _with_aux(errors):
    return lambda z, args: (errors(z, args), None)


@eqx.filter_jit
def _loss(errors, y, args):
    return jnp.sum(errors(y, args) ** 2)


@eqx.filter_jit
def _init(errors, solver, y, args):
    fn = _with_aux(errors)
    shape = jax.eval_shape(lambda: errors(y, args))
    return solver.init(fn, y, args, _OPTIONS, shape, None, frozenset())


@eqx.filter_jit
def _step(errors, solver, y, args, state):
    fn = _with_aux(errors)
    y, state, _ = solver.step(fn, y, args, _OPTIONS, state, frozenset())
    done, result = solver.terminate(fn, y, args, _OPTIONS, state, frozenset())
    return y, state, done, result != optx.RESULTS.successful
