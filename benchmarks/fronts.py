"""Fronts of work-precision plots compared: cost at equal error, and runs of peers below our front."""

import math
from collections.abc import Iterable

from jaxdyn.reports import Record, pareto_front

TARGETS = (1e-3, 1e-5, 1e-7, 1e-9)


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
