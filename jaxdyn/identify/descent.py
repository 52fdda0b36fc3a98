"""Protocol of all minimisation methods: `init`, `step`, and the loop that reports, checkpoints and ends a fit."""

import abc
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.identify.checkpoint import Watch


class Iterate(NamedTuple):
    """A point of a minimisation, its loss, and the method's own state there.

    `is_finite`: whether a step can start there; losses and derivatives that are not finite end a fit.
    """

    point: Any
    loss: float
    state: Any = None
    is_finite: bool = True


class Method(abc.ABC):
    """A minimisation method. Its state passes through `init` and `step`, and never through `self`.

    `floor`: a loss that rounding cannot lower, at which a fit has converged.
    """

    floor: float = 0.0

    @abc.abstractmethod
    def init(self, start: Any, kept: dict[str, np.ndarray] | None) -> Iterate:
        """Evaluate the start, or the point of a checkpoint whose `arrays` are `kept`."""

    @abc.abstractmethod
    def step(self, iterate: Iterate, history: list[float], best: Iterate) -> tuple[Iterate, str | None]:
        """Make one step.

        **Returns:** the next iterate and None; or the last one and the result, "converged" or "not_finite", that ends the fit.
        """

    def arrays(self, iterate: Iterate) -> dict[str, Any]:
        """Arrays of the state that a checkpoint needs besides the point."""
        return {}


class Descent(NamedTuple):
    """End of a minimisation: the iterate of lowest loss, the last one, all losses, and how it ended."""

    best: Iterate
    last: Iterate
    history: np.ndarray
    result: str


def descend(method: Method, start: Any, watch: Watch) -> Descent:
    """Minimise by a method from `start`, a pytree of arrays, or from the watch's checkpoint, to the same numbers bit for bit.

    `watch` receives every point, the start included, and holds the largest number of steps.

    **Returns:** `Descent`, whose result is "converged", "max_steps", "stopped", or "not_finite" where the loss or its derivatives
    are not finite; `watch.failed` is then that point.

    **Raises:** ValueError for a number of steps that is not positive.
    """
    if not watch.steps > 0:
        raise ValueError(f"steps is {watch.steps}; give a positive number")
    kept = watch.load()
    # The last loss of a checkpoint is evaluated again, with the same bits, and appended again.
    history: list[float] = [] if kept is None else kept["history"][:-1].tolist()
    iterate = method.init(start if kept is None else _restore(kept, "point", start), kept)
    best = iterate if kept is None else Iterate(_restore(kept, "best", start), float(kept["lowest"]))

    def state() -> dict[str, Any]:
        own = {"history": np.array(history), "lowest": np.float64(best.loss)}
        return own | _leaves("point", iterate.point) | _leaves("best", best.point) | method.arrays(iterate)

    # NaN compares false below: a point that failed never becomes the best one.
    while True:
        history.append(iterate.loss)
        best = iterate if iterate.loss <= best.loss else best
        # Before all tests for the end, so that callback and checkpoint see the last point too.
        continues = watch.continues(len(history) - 1, iterate.loss, iterate.point, state)
        if not iterate.is_finite:
            watch.failed = iterate.point
            return Descent(best, iterate, np.array(history), "not_finite")
        if iterate.loss <= method.floor:
            return Descent(best, iterate, np.array(history), "converged")
        if not continues:
            return Descent(best, iterate, np.array(history), "stopped")
        if len(history) > watch.steps:
            return Descent(best, iterate, np.array(history), "max_steps")
        following, result = method.step(iterate, history, best)
        if result == "not_finite":
            watch.failed = following.point
            return Descent(best, iterate, np.array(history), result)
        if result is not None:
            # A method that ends without a step returns the same iterate, whose loss is in the history already.
            if following is not iterate:
                history.append(following.loss)
                best = following if following.loss <= best.loss else best
            return Descent(best, following, np.array(history), result)
        iterate = following


def _leaves(name: str, tree: Any) -> dict[str, Any]:
    return {f"{name}_{i:03d}": leaf for i, leaf in enumerate(jax.tree.leaves(tree))}


def _restore(kept: dict[str, np.ndarray], name: str, like: Any) -> Any:
    leaves, structure = jax.tree.flatten(like)
    return jax.tree.unflatten(structure, [jnp.asarray(kept[f"{name}_{i:03d}"]) for i in range(len(leaves))])
