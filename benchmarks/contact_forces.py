"""Time of the contact forces of a quadruped, in batches, against solvers of single programs.

    python -m benchmarks.contact_forces [--batch 1024] [--rounds 20]

Twelve forces of four feet track a wrench of six rows; friction is a pyramid of four faces and the pressing itself (20 rows), or
four round cones. `jd.contact.solve_qp` solves the batch in one call, on all cores; quadprog and daqp (pyramids) and Clarabel
(cones) are called from Python once per sample, on one core. All solve to 1e-9 or tighter; forces are compared before anything is
timed. The gradient is that of a sum of squared forces in all numbers of the problem. A solver that is not installed is left
out, and a line says so.
"""

import argparse
import importlib
import os
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import timing

MU = 0.6
FEET = np.array([[0.2, 0.13, -0.3], [0.2, -0.13, -0.3], [-0.2, 0.13, -0.3], [-0.2, -0.13, -0.3]])
WEIGHT = np.diag([1, 1, 1, 10, 10, 10.0])


def problems(count: int, seed: int = 0):
    """Q (count, 12, 12), q (count, 12); pyramids G (20, 12), cones S (4, 3, 12), the same for all samples."""
    random = np.random.default_rng(seed)
    G, S = np.zeros((20, 12)), np.zeros((4, 3, 12))
    for k in range(4):
        for j, (a, s) in enumerate([(0, 1), (0, -1), (1, 1), (1, -1)]):
            G[5 * k + j, 3 * k + a], G[5 * k + j, 3 * k + 2] = s, -MU
        G[5 * k + 4, 3 * k + 2] = -1
        S[k, 0, 3 * k + 2], S[k, 1, 3 * k], S[k, 2, 3 * k + 1] = -MU, -1, -1
    Q, q = np.zeros((count, 12, 12)), np.zeros((count, 12))
    for i in range(count):
        A = np.zeros((6, 12))
        for k in range(4):
            place = FEET[k] + 0.03 * random.normal(size=3)
            normal = np.array([0, 0, 1]) + 0.2 * random.normal(size=3)
            x = np.cross([0, 1.0, 0], normal)
            x, normal = x / np.linalg.norm(x), normal / np.linalg.norm(normal)
            turn = np.stack([x, np.cross(normal, x), normal], 1)
            A[:3, 3 * k : 3 * k + 3], A[3:, 3 * k : 3 * k + 3] = turn, np.cross(place, turn.T).T
        wrench = [*60 * random.normal(size=2), 120 + 20 * random.normal(), *15 * random.normal(size=3)]
        Q[i], q[i] = A.T @ WEIGHT @ A + 1e-2 * np.eye(12), -A.T @ WEIGHT @ wrench
    return Q, q, G, S


def ours(Q, q, G, S):
    """Compiled calls for the batch, by name, and the seconds that each took to compile."""
    h, c = jnp.zeros(20), jnp.zeros((4, 3))

    def pyramids(Q, q):
        return jd.contact.solve_qp(Q, q, G, h)

    def cones(Q, q):
        return jd.contact.solve_qp(Q, q, cones=[(S, c)])

    def gradient(Q, q):
        return jax.grad(lambda Q, q: jnp.sum(cones(Q, q).x ** 2), argnums=(0, 1))(Q, q)

    inputs, calls, built = (jnp.asarray(Q), jnp.asarray(q)), {}, {}
    for name, function in (
        ("jaxdyn, pyramids", pyramids),
        ("jaxdyn, cones", cones),
        ("jaxdyn, cones, with gradient", gradient),
    ):
        began = time.perf_counter()
        program = jax.jit(jax.vmap(function)).lower(*inputs).compile()
        built[name] = time.perf_counter() - began
        calls[name] = lambda program=program: jax.block_until_ready(program(*inputs))
    return calls, built


def peers(Q, q, G, S):
    """Calls of the installed solvers over all samples, by name."""
    calls = {}

    def installed(name):
        try:
            return importlib.import_module(name)
        except ImportError:
            print(f"{name} is not installed (pip install {name}): left out")

    if quadprog := installed("quadprog"):
        rows = -G.T.copy()
        calls["quadprog, pyramids"] = lambda: [
            quadprog.solve_qp(A, -b, rows, np.zeros(20), 0)[0] for A, b in zip(Q, q, strict=True)
        ]
    if daqp := installed("daqp"):
        low, kind = np.full(20, -1e30), np.zeros(20, np.int32)
        calls["daqp, pyramids"] = lambda: [
            daqp.solve(A, b, G, np.zeros(20), low, kind)[0].copy() for A, b in zip(Q, q, strict=True)
        ]
    if clarabel := installed("clarabel"):
        sparse = importlib.import_module("scipy.sparse")
        settings = clarabel.DefaultSettings()
        settings.verbose, settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas = False, 1e-9, 1e-9, 1e-9
        cone_rows, kinds = sparse.csc_matrix(S.reshape(12, 12)), [clarabel.SecondOrderConeT(3)] * 4
        upper = [sparse.csc_matrix(np.triu(A)) for A in Q]
        calls["Clarabel, cones"] = lambda: [
            np.array(clarabel.DefaultSolver(A, b, cone_rows, np.zeros(12), kinds, settings).solve().x)
            for A, b in zip(upper, q, strict=True)
        ]
    return calls


def main(argv=None):
    """Compare, measure, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    data = problems(options.batch)
    calls, built = ours(*data)
    others = peers(*data)
    for kind in ("pyramids", "cones"):
        computed = calls[f"jaxdyn, {kind}"]()
        solved = int(np.sum(np.asarray(computed.result == jd.RESULTS.successful)))
        print(f"{kind}: {solved} of {options.batch} solved, at most {int(computed.steps.max())} steps")
        for name, call in others.items():
            if name.endswith(kind):
                error = np.abs(np.asarray(computed.x) - np.array(call())).max()
                print(f"{kind}: forces differ from those of {name.split(',')[0]} by at most {error:.1e} N")
    calls |= others
    times = timing.time_alternately(calls, options.rounds)
    cores, rows = len(os.sched_getaffinity(0)), []
    print("| solver | us a sample, best (median) | us a core | compile s |")
    print("|---|---|---|---|")
    for name in calls:
        best, median = (times[name][key] / options.batch * 1e6 for key in ("best", "median"))
        row = {"solver": name, "us": [best, median], "us per core": best * (cores if name in built else 1)}
        rows.append(row | {"compile s": built.get(name)})
        seconds = f"{built[name]:.1f}" if name in built else ""
        print(f"| {name} | {best:.3g} ({median:.3g}) | {row['us per core']:.3g} | {seconds} |")
    report = {"machine": timing.machine(), "batch": options.batch, "rows": rows}
    print("written to", timing.write("benchmark_contact_forces", report))


if __name__ == "__main__":
    main()
