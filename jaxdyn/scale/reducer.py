"""Reductions of a run as arrays of its store: partial results of chunks, and results of all."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from jaxdyn.scale.reductions import Arrays, Reduction
from jaxdyn.scale.store import Variable

QUANTITY = "quantity of "  # in front of a reduction's name: its array of one rollout
Results = dict[str, Arrays]  # arrays of each reduction, by its name


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
        self.reductions = dict(reductions)
        self.names: dict[str, dict[str, str]] = {}  # of partial results in the store, by reduction and part
        self.variables: list[Variable] = []
        for name, reduction in reductions.items():
            like = shapes[QUANTITY + name]
            # Shapes of partial results are those of a chunk without rollouts: they may not depend on the count.
            empty = reduction.partial(np.zeros((0, *like.shape), like.dtype), np.zeros(0, np.int64))
            self.names[name] = {part: f"partial/{name}_{part}" for part in empty}
            self.variables += [_variable(self.names[name][part], value, "chunk") for part, value in empty.items()]
            # Before the run: it shows the shapes of the results, and errors of a user's reduction early.
            result = reduction.result(reduction.combine(empty, empty))
            if missing := set(reduction.parts) - result.keys():
                raise ValueError(f"reductions[{name!r}].result does not return {sorted(missing)}, which its parts name")
            of = variables.get(reduction.quantity) if isinstance(reduction.quantity, str) else None
            self.variables += [_variable(f"{name}_{part}", result[part], None, of) for part in reduction.parts]

    def partials(self, rows: Mapping[str, np.ndarray], numbers: np.ndarray) -> Results:
        """Partial results of a chunk, of the rollouts that succeeded."""
        # Rows of rollouts that failed may hold NaN, which would spread to the results.
        good = rows["result"] == 0
        return {name: one.partial(rows[QUANTITY + name][good], numbers[good]) for name, one in self.reductions.items()}

    def combine(self, total: Results, partials: Results) -> Results:
        """Partial results of all chunks so far, from those of all but the last one and of the last one."""
        return {name: one.combine(total[name], partials[name]) for name, one in self.reductions.items()}

    def results(self, total: Results) -> Results:
        """Results from the partial results of all chunks."""
        results = {name: (one.parts, one.result(total[name])) for name, one in self.reductions.items()}
        return {name: {part: np.asarray(all_[part]) for part in parts} for name, (parts, all_) in results.items()}

    def to_store(self, partials: Results) -> Arrays:
        """Partial results by their names in the store, with an axis of chunks."""
        return {self.names[k][part]: np.asarray(x)[None] for k, one in partials.items() for part, x in one.items()}

    def from_store(self, read: Callable[[list[str]], Arrays]) -> Results:
        """Partial results of a chunk, whose arrays `read(names)` returns."""
        arrays = read([name for one in self.names.values() for name in one.values()])
        return {k: {part: arrays[name][0] for part, name in one.items()} for k, one in self.names.items()}


class Totals:
    """Result codes, failures and reductions of a run, from summaries of chunks that are added in the order of the chunks.

    `codes`: number of rollouts that ended with each code; `failed`: numbers of the first `most` that failed.
    """

    def __init__(self, reducer: Reducer, codes: int, most: int):
        self._reducer, self._most = reducer, most
        self.codes = np.zeros(codes, np.int64)
        self.failed = np.zeros(0, np.int64)
        self._partials: Results | None = None

    def add(self, summary: Any) -> None:
        """Add the summary of the next chunk."""
        self.codes += summary.codes
        # Summaries come in the order of the chunks, so that these are the first failures for any number of workers.
        self.failed = np.concatenate([self.failed, summary.failed[: self._most - len(self.failed)]])
        before, partials = self._partials, summary.partials
        self._partials = partials if before is None else self._reducer.combine(before, partials)

    def results(self) -> Results:
        """Results of all reductions."""
        return self._reducer.results(self._partials or {})


def _variable(key: str, value: Any, leading: str | None, of: Variable | None = None) -> Variable:
    array = np.asarray(value)
    axes = tuple(f"{key.rpartition('/')[2]}_{k}" for k in range(array.ndim))
    if of is not None and of.dims and array.shape[-len(of.dims) :] == of.shape:
        # xarray aligns axes by their names: those of the quantity keep theirs.
        axes = axes[: -len(of.dims)] + of.dims
    return Variable(key, array.shape, array.dtype, axes, leading)
