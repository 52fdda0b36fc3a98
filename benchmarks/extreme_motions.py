"""Extreme motions: rates, turns, gravity, steps up to instability, chaos, a million steps."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks.extremes import FIXED, Outcome, Row, as_dtype, case, name_of, outcome, quick, study, table
from jaxdyn.constraints.codes import code_of
from jaxdyn.reports import references

LOOSE = {"float64": 1e-6, "float32": 1e-3}


@case
def rates(dtypes, gradient):
    """Angular rates up to 1e4 rad/s: a free body, over 10 rad of rotation"""
    base, (q, start) = jd.scenes.free_body(), jd.scenes.free_body.start()
    factors = np.array([1e-4, 1.0, 1e2, 1e4])
    reference = references.free_top(np.array([0.0, 5.0, 10.0]))
    turned = jnp.asarray(reference.q[-1])

    def run(factor, x):
        dtype = factor.dtype
        ts = jnp.asarray([0.0, 5.0, 10.0], dtype) / factor
        v = start.astype(dtype).at[0].add(x) * factor
        solution = jd.simulate(as_dtype(base, dtype), q.astype(dtype), v, ts)
        quaternion = solution.q[-1] * jnp.sign(jnp.sum(solution.q[-1] * turned.astype(dtype)))
        end = jnp.concatenate([quaternion, solution.v[-1] / factor])
        return outcome(solution, end=end, value=jnp.sum(end))

    studied = study(run, jnp.asarray(factors), dtypes, gradient)
    exact = np.tile(np.concatenate([reference.q[-1], reference.v[-1]]), (len(factors), 1))
    labels = [f"{np.linalg.norm(start) * f:.0e} rad/s" for f in factors]
    return table("rates", labels, studied, exact, LOOSE, "Jacobi's functions", residual=False, advice=RATES)


@case
def turns(dtypes, gradient):
    """Angles of up to 1e6 turns: a double pendulum of rods that starts there, 1 s"""
    count = np.array([0.0, 1.0, 100.0, 1e3, 1e6])

    def run(turned, x):
        dtype = turned.dtype
        model = jd.robots.chain(2, dtype=dtype)
        q = jnp.asarray([0.5, -0.3], dtype) + 2 * jnp.pi * turned
        v = jnp.asarray([0.2, 0.4], dtype).at[0].add(x)
        solution = jd.simulate(model, q, v, jnp.asarray([0.0, 1.0], dtype))
        end = jnp.concatenate([solution.q[-1] - 2 * jnp.pi * turned, solution.v[-1]])
        return outcome(solution, end=end, value=jnp.sum(end))

    studied = study(run, jnp.asarray(count), dtypes, gradient)
    exact = np.tile(np.asarray(studied.outcomes["float64"].end)[0], (len(count), 1))
    # The angle itself is rounded, and in float32 a million turns leave half a radian of it.
    allowed = {d: LOOSE[d] + 20 * np.finfo(d).eps * 2 * np.pi * count for d in dtypes}
    labels = [f"{n:.0e} turns" for n in count]
    return table("turns", labels, studied, exact, allowed, "no turns", residual=False, advice=TURNS)


@case
def gravity(dtypes, gradient):
    """Gravity 0 and up to 1e4 times the Earth's: a pendulum in x and y with one constraint, 2 s of its time"""
    q0, v0 = jd.scenes.pendulum_in_plane.start()
    factors = np.array([0.0, 1e-4, 1.0, 1e4])
    reference = references.plane_pendulum(np.array([0.0, 2.0]))

    def run(factor, x):
        dtype = factor.dtype
        clock = jnp.sqrt(jnp.where(factor == 0, jnp.ones_like(factor), factor))
        scene = as_dtype(jd.scenes.pendulum_in_plane(gravity=9.81 * factor), dtype)
        q, v = q0.astype(dtype), v0.astype(dtype) + clock * x * jnp.asarray([0.0, 1.0], dtype)
        solution = jd.simulate(scene, q, v, jnp.asarray([0.0, 2.0], dtype) / clock, outputs=("constraint_residual",))
        end = jnp.concatenate([solution.q[-1], solution.v[-1] / clock])
        return outcome(solution, end=end, value=jnp.sum(end), residual=jnp.max(solution.constraint_residual[:, 0]))

    studied = study(run, jnp.asarray(factors), dtypes, gradient)
    swung = np.concatenate([reference.q[-1], reference.v[-1]])
    exact = np.stack([np.concatenate([q0, v0])] + [swung] * 3)
    labels = [f"{f:.0e} g" for f in factors]
    return table("gravity", labels, studied, exact, LOOSE, "Jacobi's functions", size=1.0, advice=GRAVITY)


SOLVERS = {"RK4": None, "Dopri5": diffrax.Dopri5(), "Tsit5": diffrax.Tsit5(), "Dopri8": diffrax.Dopri8()}


def stability_limits(solver, growth=1 + 1e-10) -> tuple[float, float]:
    """Largest -z and |i z| with |R| <= `growth` on [0, z], R(z) = 1 + z b (1 - z A)^-1 e from the tableau."""
    if solver is None:
        a, b = np.diag([0.5, 0.5, 1.0], -1), np.array([1, 2, 2, 1]) / 6
    else:
        t = solver.tableau
        s = len(t.b_sol)
        a, b = np.zeros((s, s)), np.asarray(t.b_sol, float)
        for i, row in enumerate(t.a_lower):
            a[i + 1, : len(row)] = row
    powers, k = [1.0], np.ones(len(b))
    for _ in range(len(b)):
        powers.append(float(b @ k))
        k = a @ k
    limits = []
    for direction in (-1.0, 1j):
        y = np.linspace(0, 8, 800001)[1:]
        size = np.abs(np.polyval(powers[::-1], direction * y))
        beyond = np.flatnonzero(size > growth)
        limits.append(float(y[beyond[0] - 1]) if beyond.size and beyond[0] else 0.0)
    return limits[0], limits[1]


def _acceleration(q, v, t, p):
    return p[0] ** 2 * q + p[1] * v


def _unit_mass(q, t, p):
    return jnp.ones((1, 1), q.dtype)


def run_oscillator(rate, damping, solver, count):
    """x'' = -rate^2 x - damping x' over `count` steps of 1 s from x' = 1: sizes of the state half-way and at the end."""
    system = jd.ExplicitSystem(_unit_mass, _acceleration, 1, parameters=(rate, damping))
    ts = jnp.asarray([0.0, count / 2, count], rate.dtype)
    start = jnp.zeros(1, rate.dtype), jnp.ones(1, rate.dtype)
    solution = jd.simulate(system, *start, ts, solver=solver, stepsize=jd.Steps(1.0, max_steps=count + 8))
    return jnp.hypot(rate * solution.q[1:, 0], solution.v[1:, 0]), solution


@case
def steps(dtypes, gradient, solvers=None):
    """Fixed steps up to instability: the largest stable step times the rate of a damper and of an oscillator"""
    count, rows = 400, []
    for name, solver in (solvers or SOLVERS).items():
        # Growth by a factor 1.001 in 200 steps counts as unstable, in theory and as measured.
        theory = stability_limits(solver, 1.001 ** (1 / 200))
        near = np.stack([np.linspace(0.9, 1.1, 401) * limit for limit in theory])

        def run(point, x, solver=solver):
            rate, damping = point
            sizes, computed = run_oscillator(rate, damping, solver, count)
            return Outcome(sizes, x, code_of(computed.result), x)

        points = [np.concatenate([0 * near[0], near[1]]), np.concatenate([near[0], 0 * near[1]])]
        studied = study(run, tuple(jnp.asarray(x) for x in points), dtypes, False)
        for dtype in dtypes:
            sizes = np.asarray(studied.outcomes[dtype].end, float).reshape(2, 401, 2)
            stable = sizes[..., 1] <= 1.001 * sizes[..., 0] + 1e-30
            for i, kind in enumerate(("damper", "oscillator")):
                measured = near[i, np.argmin(stable[i]) - 1]
                at = f"{name}, {kind}: {measured:.3f}"
                error = abs(measured / theory[i] - 1)
                rows.append(
                    Row(
                        "steps",
                        at,
                        dtype,
                        error,
                        {"float64": 1e-3, "float32": 5e-3}[dtype],
                        f"R(z): {theory[i]:.3f}",
                        None,
                        False,
                        "",  # many runs, of which some go beyond the limit
                        None,
                        True,
                        STEPS,
                    )
                )
    return rows


@case
def beyond(dtypes, gradient):
    """Fixed steps of RK4 beyond the limit on an oscillator: the size that should stay 1"""
    factors = np.array([0.05, 0.5, 0.99, 1.01, 1.1, 2.0])
    limit = stability_limits(None)[1]

    def run(rate, x):
        sizes, computed = run_oscillator(rate, 0 * rate, None, 2000)
        return Outcome(jnp.minimum(sizes[1], jnp.full_like(rate, 1e30)), x, code_of(computed.result), x)

    studied = study(run, jnp.asarray(factors * limit), dtypes, False)
    labels = [f"{f} of the limit" for f in factors]
    return table(
        "beyond",
        labels,
        studied,
        np.ones((6, 1)),
        {d: 1e-2 for d in dtypes},
        "1",
        residual=False,
        advice=STEPS,
        excused=FIXED,
    )


@case
def chaos(dtypes, gradient):
    """A chaotic double pendulum, 20 s: growth of errors against the tangent map, and energy"""
    ts = np.linspace(0.0, 20.0, 41)
    q0, side = np.array([2.0, 2.5]), np.array([0.6, 0.8])

    def run(dtype, tol):
        model = jd.robots.chain(2, dtype=dtype)

        def motion(x):
            q = jnp.asarray(q0, dtype) + x * jnp.asarray(side, dtype)
            return jd.simulate(
                model,
                q,
                jnp.zeros(2, dtype),
                jnp.asarray(ts, dtype),
                stepsize=jd.Steps(rtol=tol, atol=tol),
                outputs=("energy",),
                adjoint="forward",
            )

        def state(x):
            computed = motion(x)
            return jnp.concatenate([computed.q, computed.v], 1), computed

        one = jnp.ones((), dtype)
        return lambda x: jax.jvp(state, (x,), (one,), has_aux=True)

    # So far apart that the rounding of the steps, 1e-16 each, stays small against the distance.
    tight = quick(jax.vmap(run("float64", 1e-13)))(jnp.asarray([0.0, 1e-10]))
    states, tangent, _ = (np.asarray(x) if i < 2 else x for i, x in enumerate(tight))
    stretch = np.linalg.norm(tangent[0], axis=1)
    difference = np.linalg.norm(states[1] - states[0], axis=1) / 1e-10
    small = stretch * 1e-10 < 1e-3
    rows = [_grown("two starts 1e-10 apart", "float64", difference, stretch, small, 1.0, 0.1, "successful")]
    loose, _, computed = quick(jax.vmap(run("float64", 1e-8)))(jnp.zeros(1))
    error = np.linalg.norm(np.asarray(loose)[0] - states[0], axis=1)
    rows.append(
        _grown(
            "rtol 1e-8",
            "float64",
            error,
            stretch,
            stretch * 1e-7 < 0.1,
            1e-8,
            100.0,
            name_of(code_of(computed.result)[0]),
        )
    )
    rows.append(_kept("rtol 1e-8", "float64", computed, 1e-6))
    if "float32" in dtypes:
        single, _, computed = quick(jax.vmap(run("float32", 1e-6)))(jnp.zeros(1, jnp.float32))
        error = np.linalg.norm(np.asarray(single, float)[0] - states[0], axis=1)
        rows.append(
            _grown(
                "rtol 1e-6",
                "float32",
                error,
                stretch,
                stretch * 1e-5 < 0.1,
                1e-6,
                100.0,
                name_of(code_of(computed.result)[0]),
            )
        )
        rows.append(_kept("rtol 1e-6", "float32", computed, 1e-3))
    return rows


def _grown(what, dtype, error, stretch, small, unit, allowed, code):
    """The largest error in units of what the tangent map makes of a first one of `unit`, while it is small."""
    ratio = float((error[small][1:] / stretch[small][1:]).max() / unit)
    ratio = abs(ratio - 1) if unit == 1.0 else ratio
    last = np.flatnonzero(small)[-1]
    return Row(
        "chaos",
        f"{what}, to {last / 2:.0f} s",
        dtype,
        ratio,
        allowed,
        "tangent map",
        None,
        False,
        code,
        None,
        True,
        CHAOS,
    )


def _kept(what, dtype, computed, allowed):
    energy, code = np.asarray(computed.energy[0], float), name_of(code_of(computed.result)[0])
    drift = float(np.abs(energy - energy[0]).max() / (2 * 9.81))
    return Row(
        "chaos", f"{what}, 20 s", dtype, drift, allowed, "energy", None, bool(np.isnan(drift)), code, None, True, CHAOS
    )


@case
def million(dtypes, gradient, count=1_000_000):
    """A free body over a million steps of RK4, 0.01 s each: state, energy and the quaternion's length"""
    base, start = jd.scenes.free_body(), jd.scenes.free_body.start()
    ts = 0.01 * count * np.array([0.0, 0.01, 0.1, 1.0])
    reference = references.free_top(ts)
    rows = []
    for dtype in dtypes:
        program = quick(
            lambda q, v, ts: jd.simulate(
                as_dtype(base, q.dtype), q, v, ts, stepsize=jd.Steps(0.01, max_steps=2 * count), outputs=("energy",)
            )
        )
        computed = program(*(jnp.asarray(x, dtype) for x in (*start, ts)))
        code = name_of(code_of(computed.result))
        q, v, energy = (np.asarray(x, float) for x in (computed.q, computed.v, computed.energy))
        signs = np.sign(np.sum(q * reference.q, 1, keepdims=True))
        checks = {
            "state": np.maximum(np.abs(q * signs - reference.q).max(1), np.abs(v - reference.v).max(1)),
            "energy": np.abs(energy / energy[0] - 1),
            "length of the quaternion": np.abs(np.linalg.norm(q, axis=1) - 1),
        }
        allowed = {
            "state": MILLION_STATE[dtype],
            "energy": MILLION_ENERGY[dtype],
            "length of the quaternion": 4 * np.finfo(dtype).eps,
        }
        for what, error in checks.items():
            for i in (1, 2, 3):
                n = f"{ts[i] / 0.01:.0e} steps"
                against = "Jacobi's functions" if what == "state" else "what is conserved"
                bound = allowed[what] * (max(ts[i] / ts[3], 1e-2) if what == "energy" else 1.0)
                rows.append(
                    Row(
                        "million",
                        f"{what}, {n}",
                        dtype,
                        float(error[i]),
                        bound,
                        against,
                        None,
                        bool(np.isnan(error[i])),
                        code,
                        None,
                        True,
                        MILLION,
                        FIXED,
                    )
                )
    return rows


MILLION_STATE = {"float64": 1e-6, "float32": 1e-2}
MILLION_ENERGY = {"float64": 1e-8, "float32": 1e-2}
RATES = "Nothing."
TURNS = (
    "An angle of n turns is rounded to 6 n eps: after 1e6 turns to 1e-9 rad in float64, and to half a radian in "
    "float32. Adaptive steps refuse starts beyond 150 turns in float32 (3.5e6 in float64). Subtract whole turns; only"
    " springs and limits depend on them. A quaternion has no such limit."
)
GRAVITY = "Nothing. Choose `atol` and the span in s by the time scale sqrt(l/g)."
STEPS = (
    "Fixed steps that are too long end with `coarse_steps`, from an estimate that slightly exceeds the error, or with"
    " `nonfinite_state` where the state overflows. Use a shorter step, or adaptive steps, which respect the limit. "
    "The longest step is the limit divided by the fastest rate sqrt(k/m) or c/m of the mechanism."
)
CHAOS = (
    "Errors grow like any difference in a chaotic motion, whatever the method: one digit less of the start or of the "
    "tolerance shortens the time for which the state is known by ln(10)/rate. The energy error stays small. Gradients"
    " grow too: use short time spans."
)
MILLION = (
    "Use adaptive steps or a shorter step where the phase matters: the energy error of RK4 grows in proportion to "
    "time, and the phase error with its square. In float32 the rounding errors of the steps add up: after 1e6 steps "
    "the state is off by a tenth, and the code is `coarse_steps`."
)
