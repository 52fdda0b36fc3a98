"""Pareto front of a work-precision plot, and the best integrator for a class of scenes."""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from jaxdyn.reports.records import Record

TARGETS = (1e-3, 1e-5, 1e-7, 1e-9)


def pareto_front(records: Iterable[Record], *, error: str = "error_path", cost: str = "seconds_best") -> list[Record]:
    """Pareto-optimal records in `error` and `cost`, from cheap to accurate, without failed runs."""
    # After sorting by cost, a record is on the front if its error is below that of all cheaper ones.
    # Failed runs have no error.
    usable = [r for r in records if getattr(r, error) is not None and getattr(r, cost) is not None]
    # At equal cost the more accurate record comes first and hides the other.
    usable.sort(key=lambda r: (getattr(r, cost), getattr(r, error)))
    front: list[Record] = []
    for record in usable:
        # Strictly: of two equally accurate runs only the cheaper one is on the front.
        if not front or getattr(record, error) < getattr(front[-1], error):
            front.append(record)
    return front


def cost_at(
    records: Iterable[Record], target: float, *, error: str = "error_path", cost: str = "seconds_best"
) -> float:
    """Cost at which a ladder of runs reaches an error, interpolated linearly in the log-log plot.

    Infinite where no run reaches it; that of the cheapest run where all are better.
    """
    points = [(getattr(r, error), getattr(r, cost)) for r in pareto_front(records, error=error, cost=cost)]
    for (rough, cheap), (fine, dear) in zip([(math.inf, 0.0), *points], points, strict=False):
        if fine > target:
            continue
        # No line leads from an infinite error or to the error 0 in a logarithmic plot.
        if rough == math.inf or fine == 0.0:
            return dear
        # A straight line in the log-log plot: the logarithm of the cost is linear in that of the error.
        share = math.log(rough / target) / math.log(rough / fine)
        return cheap * (dear / cheap) ** share
    return math.inf


def beaten_by(
    records: Iterable[Record], *, error: str = "error_path", cost: str = "seconds_best"
) -> list[tuple[Record, float]]:
    """Runs of peers below our front, each with the ratio of our cost to its cost at its error, worst first.

    The front is interpolated linearly in the log-log plot. The ratio is infinite where no run of ours
    is as accurate. `records` are of one plot: one scene, dtype and batch.

    **Raises:** ValueError for records of several plots.
    """
    records = list(records)
    plots = {(r.scene, r.dtype, r.batch) for r in records}
    # Times of different plots were not measured interleaved and do not compare.
    if len(plots) > 1:
        raise ValueError(f"records has runs of {len(plots)} plots; give those of one scene, dtype and batch")
    ours = [r for r in records if r.source == "jaxdyn"]
    faster = []
    for r in records:
        if r.source != "jaxdyn" and getattr(r, error) is not None:
            factor = cost_at(ours, getattr(r, error), error=error, cost=cost) / getattr(r, cost)
            if factor > 1:
                faster.append((r, factor))
    return sorted(faster, key=lambda pair: -pair[1])


class Standing(NamedTuple):
    """Ranking entry of an integrator in a class of scenes.

    `ratio`: its cost over that of the best integrator, geometric mean over scenes and target errors that it reaches; `reached`
    of `wanted`: the number of these targets, out of those that some integrator reaches.
    """

    kind: str
    label: str
    ratio: float
    reached: int
    wanted: int


def standings(
    records: Iterable[Record], *, targets: Sequence[float] = TARGETS, cost: str = "seconds_best"
) -> list[Standing]:
    """Ranking of integrators by class of scenes (with dtype and batch): most targets reached first, then the cheapest.

    Only runs of jaxdyn are compared; plots also show peers.
    """
    ladders: dict[tuple, dict[str, list[Record]]] = defaultdict(lambda: defaultdict(list))
    for r in records:
        if r.source == "jaxdyn":
            kind = f"{r.kind}, {r.dtype}, batch {r.batch}"
            # Costs of one dtype and batch compare, so these are part of the class.
            ladders[kind, r.label][r.scene].append(r)
    table = []
    for kind in dict.fromkeys(kind for kind, _ in ladders):
        integrators = {label: scenes for (k, label), scenes in ladders.items() if k == kind}
        # Goals of all integrators together: one that fails a scene reaches fewer of them.
        goals = [(scene, target) for scene in {s for x in integrators.values() for s in x} for target in targets]
        costs = {
            label: [cost_at(scenes.get(scene, ()), target, cost=cost) for scene, target in goals]
            for label, scenes in integrators.items()
        }
        # Goals that nobody reaches are infinite here and count for no one.
        best = [min(column) for column in zip(*costs.values(), strict=True)]
        rows = []
        for label, row in costs.items():
            ratios = [x / b for x, b in zip(row, best, strict=True) if math.isfinite(x)]
            # Geometric mean: ratios of costs have no common unit, and halving must count as much as doubling.
            mean = math.exp(sum(map(math.log, ratios)) / len(ratios)) if ratios else math.inf
            rows.append(Standing(kind, label, mean, len(ratios), sum(map(math.isfinite, best))))
        table += sorted(rows, key=lambda row: (-row.reached, row.ratio))
    return table
