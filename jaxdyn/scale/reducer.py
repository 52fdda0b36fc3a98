"""The reductions of a run as arrays of its store: partial results of chunks, and what they are merged to."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxdyn.scale.reductions import Arrays, Reduction
from jaxdyn.scale.store import Variable

COMBINED = 64  # partial results at once
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

    @property
    def partial_names(self) -> list[str]:
        """Names of the partial results in the store."""
        return [_partial(name, part) for name, parts in self._partials.items() for part in parts]

    def combine(self, partials: Arrays) -> Arrays:
        """Fewer partial results that merge to the same, of those of some chunks in their order, by their names in the store."""
        combined = {}
        for name, reduction in self._reductions.items():
            parts = reduction.combine({part: partials[_partial(name, part)] for part in self._partials[name]})
            combined |= {_partial(name, part): np.asarray(value) for part, value in parts.items()}
        return combined

    def merge(self, partials: Arrays) -> dict[str, Arrays]:
        """Results of all reductions, of the partial results of all chunks by their names in the store."""
        results = {}
        for name, reduction in self._reductions.items():
            whole = reduction.merge({part: partials[_partial(name, part)] for part in self._partials[name]})
            results[name] = {part: np.asarray(whole[part]) for part in reduction.parts}
        return results


class Merger:
    """The results of a run, of summaries of chunks that are added in the order of the chunks.

    `codes`: how many rollouts ended with each; `failed`: numbers of the first `most` that did not succeed.
    """

    def __init__(self, reducer: Reducer, codes: int, most: int):
        self._reducer, self._most = reducer, most
        self.codes = np.zeros(codes, np.int64)
        self.failed = np.zeros(0, np.int64)
        self.steps = np.zeros(2, np.int64)
        self._combined, self._pending = 0, []

    def add(self, summary: Any) -> None:
        """The summary of the next chunk."""
        self.codes += summary.codes
        self.steps += summary.steps
        self.failed = np.concatenate([self.failed, summary.failed[: self._most - len(self.failed)]])
        if self._reducer.partial_names:
            self._pending.append(summary.partials)
            # As many as there are already, so that those of reductions that do not combine are copied a few times only.
            if len(self._pending) > max(COMBINED, self._combined):
                self._combine()

    def results(self) -> dict[str, Arrays]:
        """Those of all reductions."""
        return self._reducer.merge(self._combine()) if self._reducer.partial_names else {}

    def _combine(self) -> Arrays:
        together = {name: np.concatenate([one[name] for one in self._pending]) for name in self._pending[0]}
        self._pending = [self._reducer.combine(together)]
        self._combined = len(next(iter(self._pending[0].values())))
        return self._pending[0]


def _partial(name: str, part: str) -> str:
    return f"partial/{name}_{part}"


def _axes(key: str, ndim: int) -> tuple[str, ...]:
    return tuple(f"{key.rpartition('/')[2]}_{k}" for k in range(ndim))
