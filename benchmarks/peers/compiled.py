"""CasADi and C: equations by hand, differentiated by CasADi, and integrated in compiled code from start to end.

SUNDIALS' CVODES runs within CasADi, for one trajectory. `runge_kutta.c` runs diffrax's own tableau of Dopri8, and RK4, on the
C code that CasADi writes of the equations; the C compiler of the machine makes both into one library, and OpenMP shares a
batch among the cores. That is the fastest way to run these methods that we know of, and no user of a library of multibody
dynamics gets it without writing equations. Constrained equations are solved with their multipliers, unprojected, by sparse QR
where they are many.
"""

import atexit
import contextlib
import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import casadi
import diffrax
import numpy as np

from benchmarks.peers.equations import EQUATIONS, Equations
from benchmarks.peers.steps import CORES, TOLERANCES, steps_between
from jaxdyn.reports.run import Contestant, Motion

COMPILER = shutil.which(os.environ.get("CC", "cc"))
MAX_STEPS = 2**14
# Larger systems are solved by sparse QR with numbers; expanded into single operations, it loses digits of Andrews' mechanism.
LARGEST = 8


def _matrix(rows) -> casadi.SX:
    """A sparse matrix; entries that are 0.0 are structural zeros."""
    computed = casadi.SX(len(rows), len(rows[0]))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            if not isinstance(entry, float) or entry != 0.0:
                computed[i, j] = entry
    return computed


@functools.cache
def slope(name: str) -> casadi.Function:
    """`slope(t, y)` -> dy/dt."""
    equations = EQUATIONS[name]()
    t, q, v = casadi.SX.sym("t"), casadi.SX.sym("q", equations.nq), casadi.SX.sym("v", equations.nv)
    qs, vs = casadi.vertsplit(q), casadi.vertsplit(v)
    rates = casadi.vertcat(*equations.rates(casadi, qs, vs)) if equations.rates else v
    K = _matrix(equations.mass(casadi, qs))
    r = casadi.vertcat(*equations.force(casadi, t, qs, vs))
    moving = None
    if equations.rows:
        rows = casadi.vertcat(*equations.rows(casadi, t, qs))
        moving = casadi.jtimes(rows, q, rates) + casadi.jacobian(rows, t)
    elif equations.velocity_rows:
        moving = casadi.vertcat(*equations.velocity_rows(casadi, t, qs, vs))
    if moving is not None:
        J = casadi.jacobian(moving, v)
        drift = casadi.jtimes(moving, q, rates) + casadi.jacobian(moving, t)
        K = casadi.blockcat([[K, J.T], [J, casadi.SX(J.shape[0], J.shape[0])]])
        r = casadi.vertcat(r, -drift)
    y = casadi.vertcat(q, v)
    if K.shape[0] <= LARGEST:
        full = casadi.solve(K, r)[: equations.nv]
        return casadi.Function("slope", [t, y], [casadi.densify(casadi.vertcat(rates, full))])
    parts = casadi.Function("parts", [t, y], [casadi.densify(rates), K, casadi.densify(r)])
    t, y = casadi.MX.sym("t"), casadi.MX.sym("y", equations.nq + equations.nv)
    rates, K, r = parts(t, y)
    return casadi.Function("slope", [t, y], [casadi.vertcat(rates, casadi.solve(K, r, "qr")[: equations.nv])])


@functools.cache
def library(name: str) -> ctypes.CDLL:
    """The integrators compiled together with a scene's equations."""
    with tempfile.TemporaryDirectory() as folder:
        generated = casadi.CodeGenerator("slope.c")
        generated.add(slope(name))
        generated.generate(folder + os.sep)
        source = Path(folder) / "all.c"
        source.write_text('#include "slope.c"\n' + Path(__file__).with_name("runge_kutta.c").read_text())
        built = Path(folder) / "all.so"
        flags = ["-O3", "-march=native", "-fopenmp", "-shared", "-fPIC"]
        subprocess.run([str(COMPILER), *flags, str(source), "-o", str(built), "-lm"], check=True)
        return ctypes.CDLL(str(built))


def _tableau(solver: str):
    """Stages, order of the estimate, and a, b, e, c as arrays."""
    if solver == "RK4":
        a = np.diag([0.5, 0.5, 1.0], -1)
        return 4, 4.0, a, np.array([1, 2, 2, 1]) / 6, np.zeros(4), np.array([0, 0.5, 0.5, 1.0])
    known = diffrax.Dopri8.tableau
    size = len(known.b_sol)
    a = np.zeros((size, size))
    for i, row in enumerate(known.a_lower):
        a[i + 1, : i + 1] = row
    return size, 8.0, a, np.asarray(known.b_sol), np.asarray(known.b_error), np.concatenate([[0.0], known.c])


def integrate(name: str, solver: str, times, states, *, steps: int = 0, tolerance: float = 1.0):
    """All of `states` (batch, n) over `times` (batch, nt): rows (batch, nt, n), failures, counts (batch, 3).

    `steps` > 0: so many equal ones between save points; else adaptive ones, rtol = atol = `tolerance`.
    """
    size, order, *arrays = _tableau(solver)
    times, states, *arrays = (np.ascontiguousarray(x, float) for x in (times, states, *arrays))
    batch, n = states.shape
    rows, counts = np.empty((batch, times.shape[1], n)), np.empty((batch, 3), np.dtype(ctypes.c_long))
    at = lambda x: ctypes.c_void_p(x.ctypes.data)  # noqa: E731
    fails = library(name).run(
        size, ctypes.c_double(order), *map(at, arrays), batch, n, times.shape[1], at(times), at(states), at(rows), steps,
        ctypes.c_double(tolerance), ctypes.c_long(MAX_STEPS), at(counts),
    )  # fmt: skip
    return rows, fails, counts


def contestants(prepared, starts) -> list[Contestant]:
    """Rungs of CVODES for one trajectory, of Dopri8 and RK4 in C for any number."""
    name = prepared.case.name
    if name not in EQUATIONS:
        return []
    equations = EQUATIONS[name]()
    q, v = equations.there(*starts[:2])
    states = np.concatenate([q, v], 1)
    # Derivatives of large systems through their sparse solution take CasADi minutes to build.
    computed = _cvodes(prepared, equations, states[0]) if len(states) == 1 and equations.nv <= 2 * LARGEST else []
    if COMPILER is None:
        return computed
    for solver, settings in (("Dopri8", TOLERANCES), ("RK4", steps_between(prepared, 3))):
        computed += [_in_c(prepared, equations, solver, setting, starts[2], states) for setting in settings]
    return computed


def _in_c(prepared, equations: Equations, solver: str, setting, times, states) -> Contestant:
    name, ts, fixed = prepared.case.name, prepared.reference.ts, solver == "RK4"
    options = {"steps": setting} if fixed else {"tolerance": setting}
    library(name)

    def motion(computed) -> Motion:
        rows, fails, counts = computed
        y = rows[0]
        good = fails == 0 and np.isfinite(rows).all()
        q, v = equations.back(y[:, : equations.nq], y[:, equations.nq :])
        return Motion(q, v, "successful" if good else "stopped", *(int(x) for x in counts[0]))

    def call():
        return integrate(name, solver, times, states, **options)

    source = "C" if len(states) == 1 else f"C, {CORES} threads"
    setting = float(ts[1] - ts[0]) / setting if fixed else setting
    return Contestant(f"{source}, CasADi {casadi.__version__}", "by hand", solver, setting, fixed, call, motion)


@functools.cache
def _folder() -> str:
    """Where CasADi's compiler leaves its files, until the interpreter ends."""
    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _cvodes(prepared, equations: Equations, state) -> list[Contestant]:
    """CVODES: Adams' methods, or BDF for a stiff scene."""
    name, ts = prepared.case.name, prepared.reference.ts
    t, y = casadi.MX.sym("t"), casadi.MX.sym("y", len(state))
    problem = {"x": y, "t": t, "ode": slope(name)(t, y)}
    options = {"linear_multistep_method": "bdf" if prepared.case.stiff else "adams", "max_num_steps": MAX_STEPS}
    if COMPILER is not None:
        options |= {"jit": True, "compiler": "shell", "jit_options": {"compiler": COMPILER, "flags": ["-O3"]}}

    def contestant(tolerance) -> Contestant:
        accuracy = {"reltol": tolerance, "abstol": tolerance}
        with contextlib.chdir(_folder()):
            solver = casadi.integrator("solver", "cvodes", problem, ts[0], list(ts[1:]), options | accuracy)

        def call():
            try:
                return np.asarray(solver(x0=state)["xf"]).T
            except RuntimeError:
                return None

        def motion(rows) -> Motion:
            if rows is None:
                return Motion(*(np.full_like(x, np.nan) for x in prepared.reference[1:3]), "stopped")
            rows = np.concatenate([state[None], rows])
            stats = solver.stats()
            back: Callable = equations.back
            return Motion(*back(rows[:, : equations.nq], rows[:, equations.nq :]), "successful", stats.get("nsteps"))

        return Contestant(f"CasADi {casadi.__version__}", "by hand", "CVODES", tolerance, False, call, motion)

    return [contestant(tolerance) for tolerance in TOLERANCES]
