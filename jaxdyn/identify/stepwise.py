"""Least squares by the solvers of optimistix, a step at a time, so that every point can be watched, kept and resumed."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from jaxdyn.identify.progress import Watch

SOLVERS = ("levenberg-marquardt", "dogleg")
_OPTIONS = {"jac": "fwd"}
# Steps without a lower loss after which rounding is all that is left.
_STALE = 10


def solver_of(method: str, tolerance: float) -> optx.AbstractLeastSquaresSolver:
    """The solver of a name; it ends where a step changes unknowns and loss by less than `tolerance` of them."""
    kind = optx.LevenbergMarquardt if method == SOLVERS[0] else optx.Dogleg
    return kind(rtol=max(tolerance, 1e-14), atol=max(tolerance, 1e-14))


def stepwise(
    errors: Callable, start, args, *, method: str, tolerance: float, watch: Watch
) -> tuple[Array, np.ndarray, str]:
    """Minimise the sum of squares of `errors(z, args)` from `start`; Jacobians are exact, by forward mode.

    **Returns:** the best point; the loss at every point; "converged", "max_steps", "stopped" or "not_finite".
    """
    solver = solver_of(method, tolerance)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        state = _init(errors, solver, start, args)
        arrays, rest = eqx.partition(state, eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        y, best, lowest, history, kept = start, start, np.inf, [], watch.load()
        if kept is not None:
            y, best, lowest = jnp.asarray(kept["y"]), jnp.asarray(kept["best"]), float(kept["lowest"])
            history = kept["history"][:-1].tolist()
            leaves = [jnp.asarray(kept[f"solver_{i:03d}"], leaf.dtype) for i, leaf in enumerate(leaves)]
            state = eqx.combine(jax.tree.unflatten(structure, leaves), rest)
        while True:
            loss = float(_loss(errors, y, args))
            history.append(loss)

            def numbers(y=y, state=state, best=best, lowest=lowest):
                own = jax.tree.leaves(eqx.filter(state, eqx.is_array))
                known = {"y": y, "best": best, "lowest": np.float64(lowest), "history": np.array(history)}
                return known | {f"solver_{i:03d}": leaf for i, leaf in enumerate(own)}

            goes_on = watch.goes_on(len(history) - 1, loss, y, numbers)
            if np.isfinite(loss) and loss < lowest:
                best, lowest = y, loss
            if not np.isfinite(loss) and len(history) == 1:
                watch.failed = y
                return y, np.array(history), "not_finite"
            if not goes_on:
                return best, np.array(history), "stopped"
            if len(history) > _STALE and min(history[-_STALE:]) >= min(history[:-_STALE]):
                return best, np.array(history), "converged"
            if len(history) > watch.steps:
                return best, np.array(history), "max_steps"
            y, state, done, failed = _step(errors, solver, y, args, state)
            if bool(failed):
                watch.failed = y
                return best, np.array(history), "not_finite"
            if bool(done):
                loss = float(_loss(errors, y, args))
                history.append(loss)
                best = y if np.isfinite(loss) and loss <= lowest else best
                return best, np.array(history), "converged"


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
