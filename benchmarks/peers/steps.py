"""Tolerances and steps of the peers' ladders, and integrators for those without one: SciPy's, and RK4 in Python."""

import os
from collections.abc import Callable

import numpy as np
import scipy
from scipy.integrate import ode, odeint

from jaxdyn.reports.run import Contestant, Motion

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


def dop853(prepared, source: str, slope: Callable, start, back: Callable, method: str = "by hand") -> list[Contestant]:
    """SciPy's compiled DOP853 on dy/dt = slope(t, y); `back(y (nt, n))` -> q, v of the scene."""
    ts = prepared.reference.ts

    def contestant(tolerance):
        def call():
            calls = 0

            def counted(t, y):
                nonlocal calls
                calls += 1
                return slope(t, y)

            solver = ode(counted).set_integrator("dop853", rtol=max(tolerance, 3e-14), atol=tolerance, nsteps=10**6)
            solver.set_initial_value(start, ts[0])
            rows = [start, *(solver.integrate(t) for t in ts[1:])]
            return np.stack(rows), solver.successful(), calls

        def motion(computed) -> Motion:
            rows, good, calls = computed
            return Motion(*back(rows), "successful" if good else "stopped", evaluations=calls)

        return Contestant(source, method, f"SciPy {scipy.__version__} dop853", tolerance, False, call, motion)

    return [contestant(tolerance) for tolerance in TOLERANCES]


def lsoda(prepared, source: str, slope: Callable, start, back: Callable) -> list[Contestant]:
    """ODEPACK's LSODA on dy/dt = slope(t, y), by SciPy's `odeint`; `back` as in `dop853`."""
    ts = prepared.reference.ts

    def contestant(tolerance):
        def call():
            options = {"rtol": max(tolerance, 3e-14), "atol": tolerance, "mxstep": 10**6, "full_output": True}
            return odeint(slope, start, ts, tfirst=True, **options)

        def motion(computed) -> Motion:
            rows, info = computed
            result = "successful" if info["message"] == "Integration successful." else "stopped"
            return Motion(*back(rows), result, int(info["nst"][-1]), None, int(info["nfe"][-1]))

        return Contestant(source, "by hand", f"SciPy {scipy.__version__} LSODA", tolerance, False, call, motion)

    return [contestant(tolerance) for tolerance in TOLERANCES]
