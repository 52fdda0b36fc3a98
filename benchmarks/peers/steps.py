"""Tolerances and steps of the peers' ladders, and a Runge-Kutta method in Python for those without one."""

import os
from collections.abc import Callable

import numpy as np

from jaxdyn.report.measure import Contestant, Motion

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)


def steps_between(prepared, rungs: int = 4) -> list[int]:
    """Fixed steps from one save point to the next, from coarse to fine."""
    coarse = max(1, round(prepared.case.steps / (len(prepared.reference.ts) - 1)))
    return [coarse * 4**k for k in range(rungs)]


def rk4(
    prepared, source: str, slope: Callable, start, times, back: Callable, rungs: int = 3, method: str = "by hand"
) -> list[Contestant]:
    """Runge-Kutta of order 4 in Python on y (n,) or (n, batch), whose save points are `times` (batch, nt).

    `back(y (nt, n))` -> q, v of the scene.
    """
    many = start.ndim == 2
    ts = times if many else times[0]
    points = prepared.reference.ts

    def contestant(between):
        step = float(points[1] - points[0]) / between

        def call():
            y, rows, t = start, [start], ts[..., 0]
            for k in range(len(points) - 1):
                for i in range(between):
                    t = ts[..., k] + i * step
                    a = slope(t, y)
                    b = slope(t + step / 2, y + step / 2 * a)
                    c = slope(t + step / 2, y + step / 2 * b)
                    y = y + step / 6 * (a + 2 * b + 2 * c + slope(t + step, y + step * c))
                rows.append(y)
            return np.stack(rows)

        def motion(rows) -> Motion:
            steps = between * (len(points) - 1)
            result = "successful" if np.isfinite(rows).all() else "not finite"
            return Motion(*back(rows[..., 0] if many else rows), result, steps, 0, 4 * steps)

        return Contestant(source, method, "RK4", step, True, call, motion)

    return [contestant(between) for between in steps_between(prepared, rungs)]
