"""SymPy and SciPy: equations by hand, differentiated and turned into NumPy code, integrated by SciPy's compiled solvers.

One trajectory runs in SciPy's `ode("dop853")` and in `odeint` (LSODA of ODEPACK), which are compiled and call the NumPy
code from there. A batch runs as arrays in a Runge-Kutta method of order 4. Constrained equations are solved with their
multipliers, unprojected.
"""

import functools
from collections.abc import Callable

import numpy as np
import sympy

from benchmarks.peers.equations import EQUATIONS, Equations
from benchmarks.peers.steps import dop853, lsoda, rk4
from jaxdyn.reports.run import Contestant

# Beyond this many unknowns dense NumPy code, filled entry by entry, is no sensible way to write equations.
LARGEST = 20


def augmented(equations: Equations):
    """Symbols (t, q, v), q' and the matrix [K | r] whose solution begins with v'."""
    t, q, v = sympy.Symbol("t"), sympy.symbols(f"q:{equations.nq}"), sympy.symbols(f"v:{equations.nv}")
    rates = sympy.Matrix(equations.rates(sympy, q, v) if equations.rates else v)
    M = sympy.Matrix(equations.mass(sympy, q))
    f = sympy.Matrix(equations.force(sympy, t, q, v))
    if equations.rows:
        rows = sympy.Matrix(equations.rows(sympy, t, q))
        moving = rows.jacobian(q) * rates + rows.diff(t)
    elif equations.velocity_rows:
        moving = sympy.Matrix(equations.velocity_rows(sympy, t, q, v))
    else:
        return (t, *q, *v), rates, sympy.Matrix.hstack(sympy.eye(equations.nv), M.LUsolve(f))
    J = moving.jacobian(v)
    drift = moving.jacobian(q) * rates + moving.diff(t)
    zero = sympy.zeros(len(moving), len(moving))
    return (t, *q, *v), rates, sympy.Matrix.vstack(sympy.Matrix.hstack(M, J.T, f), sympy.Matrix.hstack(J, zero, -drift))


@functools.cache
def slope(name: str) -> Callable:
    """`slope(t, y)` -> dy/dt for y (n,) or (n, batch), by NumPy."""
    equations = EQUATIONS[name]()
    symbols, rates, matrix = augmented(equations)
    entries = [*matrix]
    varying = [i for i, x in enumerate(entries) if x.free_symbols]
    fixed = np.array([0.0 if x.free_symbols else float(x) for x in entries])
    code = sympy.lambdify(symbols, [*rates, *(entries[i] for i in varying)], "numpy", cse=True)
    nq, nv, height = equations.nq, equations.nv, matrix.rows
    closed = height == nv and not equations.rows and not equations.velocity_rows

    def once(t, y):
        computed = code(t, *y)
        if closed:
            return np.array(computed)
        flat = fixed.copy()
        flat[varying] = computed[nq:]
        full = flat.reshape(height, height + 1)
        return np.concatenate([computed[:nq], np.linalg.solve(full[:, :-1], full[:, -1])[:nv]])

    def many(t, y):
        computed = np.stack(np.broadcast_arrays(*code(t, *y)))
        if closed:
            return computed
        flat = np.tile(fixed, (y.shape[1], 1))
        flat[:, varying] = computed[nq:].T
        full = flat.reshape(-1, height, height + 1)
        return np.concatenate([computed[:nq], np.linalg.solve(full[..., :-1], full[..., -1:])[:, :nv, 0].T])

    if closed and len(varying) < nv:  # accelerations that are constant
        place = [nq + varying.index(i * (nv + 1) + nv) if i * (nv + 1) + nv in varying else None for i in range(nv)]

        def filled(t, y):
            computed = code(t, *y)
            rest = [0 * y[0] + fixed[i * (nv + 1) + nv] if k is None else computed[k] for i, k in enumerate(place)]
            return np.stack([*computed[:nq], *rest])

        return filled
    return lambda t, y: once(t, y) if y.ndim == 1 else many(t, y)


def contestants(prepared, starts) -> list[Contestant]:
    """Rungs of SciPy's solvers for one trajectory, of a vectorized method for several."""
    name = prepared.case.name
    if name not in EQUATIONS:
        return []
    equations = EQUATIONS[name]()
    if equations.nv > LARGEST:
        return []
    q, v = equations.there(*starts[:2])
    states, source = np.concatenate([q, v], 1), f"NumPy {np.__version__}"
    if len(states) > 1:
        return rk4(prepared, source, slope(name), states.T, starts[2], _back(equations))
    return [
        *dop853(prepared, source, slope(name), states[0], _back(equations)),
        *lsoda(prepared, source, slope(name), states[0], _back(equations)),
    ]


def _back(equations: Equations) -> Callable:
    return lambda y: equations.back(y[:, : equations.nq], y[:, equations.nq :])
