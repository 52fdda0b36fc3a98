"""Reductions of a run as arrays of its store: partial results of chunks, and their merged results."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxdyn.scale.reductions import Arrays, Reduction
from jaxdyn.scale.store import Variable

COMBINED = 64  # partial results at once
QUANTITY = "quantity of "  # in front of a reduction's name: its array of one rollout


class Reducer:
    """All reductions of a run.

    **Arguments:** `reductions` by name; `shapes`, of the arrays of one rollout, those of the quantities among them; `variables`,
    those of them that have named axes, which a result of the same trailing shape inherits.

    **Raises:** ValueError for a reduction whose results lack some of its `parts`, and errors of the reductions.
    """

    def __init__(
        self,
        reductions: Mapping[str, Reduction],
        shapes: Mapping[str, jax.ShapeDtypeStruct],
        variables: Mapping[str, Variable],
    ):
        self._reductions = dict(reductions)
        self._parts: dict[str, list[str]] = {}
        self.variables: list[Variable] = []
        for name, reduction in reductions.items():
            like = shapes[QUANTITY + name]
            # Shapes of partial results are those of a chunk without rollouts: they may not depend on the count.
            empty = reduction.partial(np.zeros((0, *like.shape), like.dtype), np.zeros(0, np.int64))
            self._parts[name] = list(empty)
            self.variables += [_variable(_key(name, part), value, "chunk") for part, value in empty.items()]
            # Merged once before the run: it shows the shapes of the results, and errors of a user's reduction early.
            merged = reduction.merge({part: np.stack([value, value]) for part, value in empty.items()})
            if missing := set(reduction.parts) - merged.keys():
                raise ValueError(f"reductions[{name!r}].merge does not return {sorted(missing)}, which its parts name")
            of = variables.get(reduction.quantity) if isinstance(reduction.quantity, str) else None
            self.variables += [_variable(f"{name}_{part}", merged[part], None, of) for part in reduction.parts]

    def partials(self, rows: Mapping[str, np.ndarray], numbers: np.ndarray) -> Arrays:
        """Partial results of a chunk, by their names in the store, of the rollouts that succeeded."""
        # Rows of rollouts that failed may hold NaN, which would spread to the results.
        good, results = rows["result"] == 0, {}
        for name, reduction in self._reductions.items():
            parts = reduction.partial(rows[QUANTITY + name][good], numbers[good])
            results |= {_key(name, part): np.asarray(value)[None] for part, value in parts.items()}
        return results

    @property
    def partial_names(self) -> list[str]:
        """Names of the partial results in the store."""
        return [_key(name, part) for name, parts in self._parts.items() for part in parts]

    def combine(self, partials: Arrays) -> Arrays:
        """Fewer partial results with the same merged result, from those of some chunks in order, by their names in the store."""
        combined = {}
        for name, reduction in self._reductions.items():
            parts = reduction.combine(self._of(name, partials))
            combined |= {_key(name, part): np.asarray(value) for part, value in parts.items()}
        return combined

    def merge(self, partials: Arrays) -> dict[str, Arrays]:
        """Results of all reductions, from the partial results of all chunks by their names in the store."""
        results = {}
        for name, reduction in self._reductions.items():
            merged = reduction.merge(self._of(name, partials))
            results[name] = {part: np.asarray(merged[part]) for part in reduction.parts}
        return results

    def _of(self, name: str, partials: Arrays) -> Arrays:
        return {part: partials[_key(name, part)] for part in self._parts[name]}


class Merger:
    """Result codes, failures and reductions of a run, from summaries of chunks that are added in the order of the chunks.

    `codes`: number of rollouts that ended with each code; `failed`: numbers of the first `most` that failed.
    """

    def __init__(self, reducer: Reducer, codes: int, most: int):
        self._reducer, self._most = reducer, most
        self.codes = np.zeros(codes, np.int64)
        self.failed = np.zeros(0, np.int64)
        self.steps = np.zeros(2, np.int64)
        self._size, self._pending = 0, []

    def add(self, summary: Any) -> None:
        """Add the summary of the next chunk."""
        self.codes += summary.codes
        self.steps += summary.steps
        # Summaries come in the order of the chunks, so that these are the first failures for any number of workers.
        self.failed = np.concatenate([self.failed, summary.failed[: self._most - len(self.failed)]])
        if self._reducer.partial_names:
            self._pending.append(summary.partials)
            # After as many chunks as partial results are kept: those of a reduction that does not combine are copied rarely.
            if len(self._pending) > max(COMBINED, self._size):
                self._combine()

    def results(self) -> dict[str, Arrays]:
        """Results of all reductions."""
        return self._reducer.merge(self._combine()) if self._reducer.partial_names else {}

    def _combine(self) -> Arrays:
        together = {name: np.concatenate([one[name] for one in self._pending]) for name in self._pending[0]}
        self._pending = [self._reducer.combine(together)]
        self._size = len(next(iter(self._pending[0].values())))
        return self._pending[0]


def _key(name: str, part: str) -> str:
    return f"partial/{name}_{part}"


def _variable(key: str, value: Any, leading: str | None, of: Variable | None = None) -> Variable:
    array = np.asarray(value)
    axes = tuple(f"{key.rpartition('/')[2]}_{k}" for k in range(array.ndim))
    if of is not None and of.dims and array.shape[-len(of.dims) :] == of.shape:
        # xarray aligns axes by their names: those of the quantity keep theirs.
        axes = axes[: -len(of.dims)] + of.dims
    return Variable(key, array.shape, array.dtype, axes, leading)
