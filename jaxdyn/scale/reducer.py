"""The reductions of a run as arrays of its store: partial results of chunks, and what they are merged to."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxdyn.scale.reductions import Arrays, Reduction
from jaxdyn.scale.store import Variable

QUANTITY = "quantity of "  # in front of a reduction's name: the array of a rollout that it takes


class Reducer:
    """All reductions of a run.

    **Arguments:** `reductions` by name; `shapes`, of the arrays of one rollout, those of the quantities among them; `variables`,
    those of them that have named axes, which a result of the same trailing shape takes over.

    **Raises:** ValueError for a reduction whose results lack some of its `parts`, and what the reductions raise.
    """

    def __init__(
        self,
        reductions: Mapping[str, Reduction],
        shapes: Mapping[str, jax.ShapeDtypeStruct],
        variables: Mapping[str, Variable],
    ):
        self._reductions = dict(reductions)
        self._partials: dict[str, list[str]] = {}
        self.variables: list[Variable] = []
        for name, reduction in reductions.items():
            like = shapes[QUANTITY + name]
            # Chunks without rollouts have the shapes of all others.
            none = reduction.partial(np.zeros((0, *like.shape), like.dtype), np.zeros(0, np.int64))
            self._partials[name] = list(none)
            for part, value in none.items():
                key, array = _partial(name, part), np.asarray(value)
                self.variables.append(Variable(key, array.shape, array.dtype, _axes(key, array.ndim), "chunk"))
            merged = reduction.merge({part: np.stack([value, value]) for part, value in none.items()})
            if missing := set(reduction.parts) - merged.keys():
                raise ValueError(f"reductions[{name!r}].merge does not return {sorted(missing)}, which its parts name")
            of = variables.get(reduction.quantity) if isinstance(reduction.quantity, str) else None
            for part in reduction.parts:
                key, array = f"{name}_{part}", np.asarray(merged[part])
                axes = _axes(key, array.ndim)
                if of is not None and of.dims and array.shape[-len(of.dims) :] == of.shape:
                    axes = axes[: -len(of.dims)] + of.dims
                self.variables.append(Variable(key, array.shape, array.dtype, axes, None))

    def partials(self, rows: Mapping[str, np.ndarray], numbers: np.ndarray) -> Arrays:
        """Partial results of a chunk, by their names in the store, of the rollouts that succeeded."""
        good, sums = rows["result"] == 0, {}
        for name, reduction in self._reductions.items():
            parts = reduction.partial(rows[QUANTITY + name][good], numbers[good])
            sums |= {_partial(name, part): np.asarray(value)[None] for part, value in parts.items()}
        return sums

    def merged(self, partials: Mapping[str, np.ndarray]) -> dict[str, Arrays]:
        """Results of all reductions, of the partial results of all chunks by their names in the store."""
        results = {}
        for name, reduction in self._reductions.items():
            whole = reduction.merge({part: partials[_partial(name, part)] for part in self._partials[name]})
            results[name] = {part: np.asarray(whole[part]) for part in reduction.parts}
        return results


def _partial(name: str, part: str) -> str:
    return f"partial/{name}_{part}"


def _axes(key: str, ndim: int) -> tuple[str, ...]:
    return tuple(f"{key.rpartition('/')[2]}_{k}" for k in range(ndim))


def named(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Results by their names in the store."""
    return {f"{name}_{part}": value for name, parts in results.items() for part, value in parts.items()}
