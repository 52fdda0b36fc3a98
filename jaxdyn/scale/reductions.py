"""Reductions of many rollouts: means, histograms, quantiles, the worst, and those that users write.

A reduction works on the values of one quantity, an array of each rollout. The values of a chunk give a partial result of a fixed
shape, which is stored with the chunk. Partial results are combined in the order of the chunks while chunks are computed. So
memory does not grow with their number, and a run that was interrupted, or computed by several workers, gives the same bits as
one that was not. Failed rollouts are left out.
"""

import abc
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jaxdyn.scale.store import Variable

Arrays = dict[str, Any]  # arrays of NumPy, and its scalars


class Reduction(abc.ABC):
    """A map from the values of a quantity in all rollouts to a few arrays; write a subclass for your own.

    `quantity` is the name of an array of a rollout ("q", "energy", ...), or a function of the dictionary of them, which is
    traced: `lambda row: jnp.max(row["energy"])`. `parts` names the arrays of the result.
    """

    quantity: str | Callable[[Mapping[str, Any]], Any]
    parts: tuple[str, ...]

    @abc.abstractmethod
    def partial(self, values: np.ndarray, numbers: np.ndarray) -> Arrays:
        """Partial result from values (n, ...) and numbers (n,) of the rollouts of a chunk that succeeded; n may be 0.

        Shapes and dtypes of its arrays may depend on the shape and dtype of one value only.
        """

    @abc.abstractmethod
    def combine(self, total: Arrays, partial: Arrays) -> Arrays:
        """Partial result of several chunks from that of all but the last one, and that of the last one."""

    def result(self, total: Arrays) -> Arrays:
        """Result, by `parts`, from the partial result of all rollouts, by default that itself."""
        return total


@dataclass(frozen=True)
class Mean(Reduction):
    """Mean and standard deviation (of the sample, n - 1) of each entry, and the number of rollouts.

    The mean of no rollout is NaN, and so is the deviation of fewer than two. Source: Chan, Golub & LeVeque (1983), partial
    sums of squares.
    """

    quantity: str | Callable
    parts = ("mean", "std", "count")

    def partial(self, values: np.ndarray, numbers: np.ndarray) -> Arrays:
        """Count, mean and sum of squared deviations."""
        # About the chunk's own mean: a difference of the sums of squares and of the mean's square would cancel.
        values = values.astype(np.float64)
        mean = values.mean(0) if len(values) else np.zeros(values.shape[1:])
        squares = ((values - mean) ** 2).sum(0)
        return {"count": np.asarray(len(values)), "mean": np.asarray(mean), "squares": np.asarray(squares)}

    def combine(self, total: Arrays, partial: Arrays) -> Arrays:
        """Sums of both, about their common mean."""
        count = total["count"] + partial["count"]
        # Exact where one of them is empty: 0 leaves the other as it is, and 1 takes this one.
        weight, shift = partial["count"] / max(count, 1), partial["mean"] - total["mean"]
        squares = total["squares"] + partial["squares"] + shift**2 * (total["count"] * weight)
        return {"count": count, "mean": total["mean"] + shift * weight, "squares": squares}

    def result(self, total: Arrays) -> Arrays:
        """Mean and deviation."""
        count, mean = total["count"], total["mean"] if total["count"] else np.full_like(total["mean"], np.nan)
        std = np.sqrt(total["squares"] / (count - 1)) if count > 1 else np.full_like(mean, np.nan)
        return {"mean": mean, "std": std, "count": count}


@dataclass(frozen=True)
class Histogram(Reduction):
    """Counts of each entry of the quantity in `bins` equal bins from `low` to `high`.

    The result has "counts" (bins + 2, ...), whose first row counts values below `low`, and the last one values not below `high`
    and NaN; and "edges" (bins + 1,).
    """

    quantity: str | Callable
    low: float
    high: float
    bins: int = 100
    parts = ("counts", "edges")

    def __post_init__(self):
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high and self.bins >= 1):
            raise ValueError(
                f"low is {self.low}, high {self.high}, bins {self.bins}; give finite low < high and at least one bin"
            )

    @property
    def edges(self) -> np.ndarray:
        """Ends of the bins (bins + 1,)."""
        return np.linspace(self.low, self.high, self.bins + 1)

    def partial(self, values: np.ndarray, numbers: np.ndarray) -> Arrays:
        """Counts of the chunk."""
        flat = values.reshape(len(values), math.prod(values.shape[1:]))
        # One `bincount` over pairs (bin, entry): a loop over entries would cost more than the rollouts.
        places = np.searchsorted(self.edges, flat, side="right")
        size, width = self.bins + 2, flat.shape[1]
        counts = np.bincount((places * width + np.arange(width)).ravel(), minlength=size * width)
        return {"counts": counts.reshape(size, *values.shape[1:])}

    def combine(self, total: Arrays, partial: Arrays) -> Arrays:
        """Their sum."""
        return {"counts": total["counts"] + partial["counts"]}

    def result(self, total: Arrays) -> Arrays:
        """The counts, with the edges of the bins."""
        return total | {"edges": self.edges}


@dataclass(frozen=True)
class Quantiles(Histogram):
    """Quantiles of each entry at the `probabilities`, from a histogram, with an error of at most the width of one bin.

    The result "quantiles" (probabilities, ...) is NaN where a quantile is not between `low` and `high`, and without rollouts.
    """

    probabilities: Sequence[float] = (0.05, 0.5, 0.95)
    bins: int = 1000
    parts = ("quantiles", "probabilities")

    def __post_init__(self):
        super().__post_init__()
        given = np.asarray(self.probabilities, float)
        if given.ndim != 1 or not ((given >= 0) & (given <= 1)).all():
            raise ValueError(f"probabilities is {self.probabilities}; give numbers from 0 to 1")

    def result(self, total: Arrays) -> Arrays:
        """Linear within a bin."""
        counts = total["counts"]
        flat = counts.reshape(len(counts), math.prod(counts.shape[1:]))
        probabilities = np.asarray(self.probabilities, float)
        quantiles = np.empty((len(probabilities), flat.shape[1]))
        for k, column in enumerate(flat.T):
            quantiles[:, k] = self._of_entry(column, probabilities)
        return {
            "quantiles": quantiles.reshape(len(probabilities), *counts.shape[1:]),
            "probabilities": probabilities,
        }

    def _of_entry(self, counts: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
        below, total = np.cumsum(counts), counts.sum()
        if total == 0:
            return np.full(len(probabilities), np.nan)
        wanted = probabilities * total
        # The first bin whose cumulative count reaches the wanted one, and is not zero.
        place = np.searchsorted(below, np.maximum(wanted, 1e-9 * total))
        inside = (place > 0) & (place <= self.bins)
        place = np.clip(place, 1, self.bins)
        share = (wanted - below[place - 1]) / np.maximum(counts[place], 1)
        values = self.edges[place - 1] + share * (self.high - self.low) / self.bins
        return np.where(inside, values, np.nan)


@dataclass(frozen=True)
class Worst(Reduction):
    """The `keep` rollouts with the largest (or smallest) values of a scalar quantity, and these values.

    The result has "value" (keep,), NaN where there are fewer rollouts, and "rollout" (keep,), their numbers, -1 there. Equal
    values are ordered by number.
    """

    quantity: str | Callable
    keep: int = 10
    largest: bool = True
    parts = ("value", "rollout")

    def __post_init__(self):
        if self.keep < 1:
            raise ValueError(f"keep is {self.keep}; give at least 1")

    def partial(self, values: np.ndarray, numbers: np.ndarray) -> Arrays:
        """The worst of the chunk."""
        if values.ndim != 1:
            raise ValueError(
                f"quantity of Worst has shape {values.shape[1:]} for each rollout; give a function that returns one number"
            )
        return self._worst(values.astype(np.float64), numbers)

    def combine(self, total: Arrays, partial: Arrays) -> Arrays:
        """The worst of both."""
        value, rollout = (np.concatenate([total[name], partial[name]]) for name in self.parts)
        return self._worst(value[rollout >= 0], rollout[rollout >= 0])

    def _worst(self, values: np.ndarray, numbers: np.ndarray) -> Arrays:
        order = np.lexsort((numbers, -values if self.largest else values))[: self.keep]
        value, rollout = np.full(self.keep, np.nan), np.full(self.keep, -1, np.int64)
        value[: len(order)], rollout[: len(order)] = values[order], numbers[order]
        return {"value": value, "rollout": rollout}


def check_reductions(reductions: object) -> dict[str, Reduction]:
    """The reductions by name.

    **Raises:** ValueError for anything but a dictionary of reductions, and for names that are no identifiers.
    """
    if reductions is None:
        return {}
    if not isinstance(reductions, Mapping) or not all(isinstance(x, Reduction) for x in reductions.values()):
        raise ValueError(
            f'reductions is {reductions!r}; give a dictionary, such as {{"energy": jd.scale.Mean("energy")}}'
        )
    for name in reductions:
        if not (isinstance(name, str) and name.isidentifier()):
            raise ValueError(f"reductions has the name {name!r}; take letters, digits and _")
    return dict(reductions)


def quantities(reductions: Mapping[str, Reduction], rows: Mapping[str, Any]) -> dict[str, Any]:
    """The quantity of each reduction in one rollout, traced.

    **Raises:** ValueError for a name that no array of a rollout has.
    """
    arrays = {}
    for name, reduction in reductions.items():
        if callable(reduction.quantity):
            arrays[name] = reduction.quantity(rows)
        elif reduction.quantity in rows:
            arrays[name] = rows[reduction.quantity]
        else:
            raise ValueError(
                f"reductions[{name!r}] is of {reduction.quantity!r}, which a rollout does not have; it has {', '.join(rows)}. "
                "Ask for it in outputs, or give a function of them"
            )
    return arrays


def describe_reductions(reductions: Mapping[str, Reduction]) -> list[str]:
    """A text for each reduction, the same in every process: without the addresses of functions."""
    return [f"{name}: {re.sub(r' at 0x[0-9a-f]+', '', repr(one))}" for name, one in reductions.items()]


# --- reductions of a run as arrays of its store: partial results of chunks, and results of all ---


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

    `codes`: number of rollouts that ended with each code; `failed`: numbers of the first `maximum` that failed.
    """

    def __init__(self, reducer: Reducer, codes: int, maximum: int):
        self._reducer, self._maximum = reducer, maximum
        self.codes = np.zeros(codes, np.int64)
        self.failed = np.zeros(0, np.int64)
        self._partials: Results | None = None

    def add(self, summary: Any) -> None:
        """Add the summary of the next chunk."""
        self.codes += summary.codes
        # Summaries come in the order of the chunks, so that these are the first failures for any number of workers.
        self.failed = np.concatenate([self.failed, summary.failed[: self._maximum - len(self.failed)]])
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
