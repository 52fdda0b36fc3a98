"""Stiff scenes, each with a reference: what every solver makes of them, and what to do.

Run as `python -m benchmarks.stiff [CASE ...]`. For every case, solver and stiffness: steps and the error of the positions against
the reference, or the code with which the run ended; and the largest error of the derivative by the logarithm of the
stiffness. Errors are relative to the size of the motion. Tolerances are 1e-8, and 10 rounding errors in float32.
"""

import functools
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np

import jaxdyn as jd
from benchmarks.extremes import name_of
from benchmarks.report_cases import test_set
from benchmarks.report_cases.references import car_axis
from benchmarks.timing import chosen_names
from jaxdyn.constraints.codes import code_of

SOLVERS: dict[str, Any] = {
    "Dopri8": diffrax.Dopri8(),
    "Kvaerno3": diffrax.Kvaerno3(),
    "Kvaerno5": diffrax.Kvaerno5(),
    "KenCarp4": diffrax.KenCarp4(),
    "Rodas5P": jd.solvers.Rodas5P(),
    "RK4, 1 ms": jd.solvers.RK4(),
}
FIXED_STEP = 1e-3
MAX_STEPS = 20_000


class Case(NamedTuple):
    """A scene of any stiffness.

    `build(stiffness)` -> (scene, control, q0, v0); `ts`; `values`, the stiffnesses of the table; `exact(stiffness)` -> q (nt,
    nq) in closed form or published, None where a converged solution serves; `size`, m or rad, of the motion; `without`,
    solvers left out.
    """

    name: str
    text: str
    unit: str
    build: Callable[[Any], tuple]
    ts: np.ndarray
    values: np.ndarray
    exact: Callable[[float], np.ndarray] | None
    size: float
    without: tuple[str, ...] = ()


class Push(eqx.Module):
    """A force that swings: tau = amplitude sin(3 t) on the first coordinate."""

    amplitude: jax.Array

    def __call__(self, q, v, t):
        return jnp.zeros_like(v).at[0].set((self.amplitude * jnp.sin(3 * t)).astype(v.dtype))


class Between(eqx.Module):
    """Spring and damper between the first two coordinates."""

    stiffness: jax.Array
    damping: jax.Array

    def __call__(self, system, q, v, t):
        pull = self.stiffness * (q[1] - q[0]) + self.damping * (v[1] - v[0])
        return jnp.stack([pull, -pull])


class Ground(eqx.Module):
    """One-sided spring and damper under a body that moves along z: depth of a smoothed step of width `eps`."""

    stiffness: jax.Array
    damping: jax.Array
    eps: jax.Array

    def __call__(self, system, q, v, t):
        root = jnp.sqrt(q * q + self.eps**2)
        depth, touching = 0.5 * (root - q), 0.5 * (1 - q / root)
        return self.stiffness * depth - self.damping * touching * v


@functools.cache
def _sliders(masses: tuple, gravity: bool) -> jd.Model:
    builder = jd.ModelBuilder("sliders", **({} if gravity else {"gravity": None}))
    for i, mass in enumerate(masses):
        builder.add_body(f"body{i}", joint="prismatic", axis=(0, 0, 1), inertia=(mass, (0, 0, 0), (0, 0, 0)))
    with jax.ensure_compile_time_eval():
        return builder.build()


@functools.cache
def _light_arm() -> jd.Model:
    builder = jd.ModelBuilder("arm")
    rod = (1.0, (0.25, 0, 0), (0.001, 0.02, 0.02))
    builder.add_body("link", joint="revolute", axis=(0, 1, 0), inertia=rod)
    tip = (1e-3, (0.05, 0, 0), (1e-7, 1e-6, 1e-6))
    builder.add_body("tip", "link", "revolute", axis=(0, 1, 0), inertia=tip, pose=(0.5, 0, 0))
    with jax.ensure_compile_time_eval():
        return builder.build()


def _spring(k):
    forces = (jd.forces.JointSpring(k), jd.forces.JointDamping(4 * jnp.sqrt(k)))
    return jd.Scene(_sliders((1.0,), False), forces=forces), Push(0.01 * k), np.array([0.01]), np.zeros(1)


def _spring_exact(k, ts):
    rate = np.sqrt(k) * (-2 + np.sqrt(3) * np.array([1, -1]))
    response = 0.01 * k / (k - 9 + 12j * np.sqrt(k))
    start = np.array([0.01 - response.imag, -(3 * response).real])
    weights = np.linalg.solve(np.array([np.ones(2), rate]), start)
    return (np.exp(np.outer(ts, rate)) @ weights + (response * np.exp(3j * ts)).imag)[:, None]


def _flexible(k):
    damping = 0.1 * jnp.sqrt(k * 0.1 / 1.1)  # a twentieth of critical
    scene = jd.Scene(
        _sliders((0.1, 1.0), False), forces=(Between(k, damping), jd.forces.JointDamping(jnp.asarray([0.5, 0.0])))
    )
    return scene, Push(jnp.asarray(1.0)), np.zeros(2), np.zeros(2)


def _flexible_exact(k, ts):
    # In 40 digits: those of float64 are lost in the exponential of a matrix of norm 1e10.
    with mpmath.workdps(40):
        k = mpmath.mpf(float(k))
        d = mpmath.sqrt(k * mpmath.mpf("0.1") / mpmath.mpf("1.1")) / 10
        rows = mpmath.zeros(6)  # (q, v) and (sin 3t, cos 3t)
        rows[0, 2] = rows[1, 3] = 1
        for i, m in ((2, mpmath.mpf("0.1")), (3, mpmath.mpf(1))):
            sign = 1 if i == 2 else -1
            rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3] = (sign * x / m for x in (-k, k, -d, d))
        rows[2, 2] -= 5
        rows[2, 4], rows[4, 5], rows[5, 4] = 10, 3, -3
        ends = [mpmath.expm(rows * mpmath.mpf(float(t)))[:2, 5] for t in ts]
        return np.array([[float(x) for x in end] for end in ends])


def _drive(kd):
    drive = jd.forces.Drive(100 * kd, kd, jnp.asarray(0.5), joints=("tip_joint",))
    return jd.Scene(_light_arm(), forces=(drive,)), None, np.array([0.3, 0.0]), np.zeros(2)


def _press(k):
    ground = Ground(k, 2 * jnp.sqrt(k), 1 / k)  # smoothed over a tenth of the depth at rest
    return jd.Scene(_sliders((1.0,), True), forces=(ground,)), None, np.array([0.05]), np.zeros(1)


def _car(scale):
    with jax.ensure_compile_time_eval():
        scene, start = test_set.car_axis(), [np.asarray(x) for x in test_set.car_axis.start()]
    mass = scene.system.parameters["k"] * scale
    return eqx.tree_at(lambda s: s.system.parameters["k"], scene, mass), None, *start


def cases() -> dict[str, Case]:
    """Every stiff scene by its name."""
    one, two = np.array([0.0, 0.5, 1.0]), np.array([0.0, 1.0, 2.0])
    all_of = (
        Case(
            "spring",
            "Body on a joint spring with a damper of twice the critical one, pushed at 3 rad/s",
            "N/m",
            _spring,
            two,
            10.0 ** np.array([2, 4, 6, 7, 9]),
            lambda k: _spring_exact(k, two),
            0.01,
        ),
        Case(
            "flexible_joint",
            "Motor of 0.1 kg on a spring, damped by a twentieth of the critical damping, to a body of 1 kg, pushed at 3 rad/s",
            "N/m",
            _flexible,
            two,
            10.0 ** np.array([2, 4, 6, 7, 9]),
            lambda k: _flexible_exact(k, two),
            0.3,
        ),
        Case(
            "drive",
            "Drive that holds a link of 1 g on a swinging arm of 1 kg",
            "N m s/rad",
            _drive,
            one,
            10.0 ** np.arange(-5, 2, 2),
            None,
            1.0,
        ),
        Case(
            "press",
            "Body that falls 5 cm onto a one-sided spring and damper, and comes to rest on it",
            "N/m",
            _press,
            one,
            10.0 ** np.arange(2, 9, 2),
            None,
            0.05,
        ),
        Case(
            "car_axis",
            "Car axis on a bumpy road: springs of rate 1/eps, no dampers, constraints that move",
            "times its mass",
            _car,
            np.array([0.0, 3.0]),
            np.ones(1),
            lambda scale: car_axis(test_set.car_axis.start()).q,
            1.0,
            # 15 000 steps; and nothing in Scene.forces that could be split off.
            ("Kvaerno3", "KenCarp4"),
        ),
    )
    return {case.name: case for case in all_of}


def program(case: Case, solver, dtype=float, size=None, max_steps=None) -> Callable:
    """A function (stiffness, tolerance) -> (q (nt, nq), dq/d log(stiffness), steps, result), to be batched and compiled."""

    def run(log, tolerance):
        scene, control, q0, v0 = case.build(jnp.exp(log))
        if dtype is not float:
            scene, control = jax.tree.map(lambda x: x.astype(dtype), (scene, control))
        # Explicit steps of a given length have no use for a tolerance.
        bound = None if isinstance(solver, jd.solvers.RK4) else tolerance
        steps = jd.simulation.Steps(size, rtol=bound, atol=bound, max_steps=max_steps)
        options = {"control": control, "solver": solver, "stepsize": steps, "adjoint": "forward", "throw": False}
        solution = jd.simulate(scene, q0, v0, case.ts, **options)
        return solution.q, (solution.stats["num_steps"], solution.success, code_of(solution.result))

    def both(stiffness, tolerance):
        log = jnp.log(stiffness.astype(dtype))
        q, slope, rest = jax.jvp(lambda x: run(x, tolerance), (log,), (jnp.ones_like(log),), has_aux=True)
        return q, slope, *rest

    return both


def runner(case: Case, solver, dtype=float) -> Callable:
    """A function (tolerance) -> positions, derivatives, steps, success and code at all stiffnesses of a case, in numpy."""
    options = {"size": FIXED_STEP} if isinstance(solver, jd.solvers.RK4) else {"max_steps": MAX_STEPS}
    run = jax.jit(jax.vmap(program(case, solver, dtype, **options), (0, None)))
    return lambda tolerance: tuple(
        np.asarray(x) for x in run(jnp.asarray(case.values, dtype), jnp.asarray(tolerance, dtype))
    )


def reference(case: Case, one: Callable, other: Callable):
    """Positions at all stiffnesses, closed form where there is one, derivatives, and how far two methods differ there."""
    one, other = one(1e-10), other(1e-10)
    if not one[3].all():
        raise RuntimeError(f"{case.name}: the reference needs more than {MAX_STEPS} steps at {case.values[~one[3]]}")
    both = one[3] & other[3]
    differ = [np.abs(a - b)[both].max() / case.size for a, b in zip(one[:2], other[:2], strict=True)]
    q = one[0] if case.exact is None else np.stack([case.exact(k) for k in case.values])
    return q, one[1], differ


def table(case: Case) -> str:
    """The table of a case, in markdown."""
    chosen = {name: (solver, float) for name, solver in SOLVERS.items() if name not in case.without}
    chosen |= {f"{name}, float32": (SOLVERS[name], jnp.float32) for name in ("Dopri8", "Rodas5P")}
    runs = {name: runner(case, *how) for name, how in chosen.items()}
    q, slope, differ = reference(case, runs["Rodas5P"], runs["Kvaerno5"])
    kind = "converged solution" if case.exact is None else "closed form" if case.values.size > 1 else "published"
    lines = [
        f"**{case.name}.** {case.text} (over {case.ts[-1]:g} s). Reference: {kind}; two methods at 1e-10 differ by "
    ]
    lines[0] += f"{differ[0]:.0e}, in the derivative by {differ[1]:.0e}."
    lines += [
        "",
        f"| {case.name.replace('_', ' ')}, {case.unit} | "
        + " | ".join(f"{k:.0e}" for k in case.values)
        + " | derivative |",
    ]
    lines += ["|---" * (case.values.size + 2) + "|"]
    rates = [jd.stiffness(scene, q0, v0, 0.0, control) for scene, control, q0, v0 in map(case.build, case.values)]
    for name in ("decay", "frequency"):
        lines += [f"| {name} at the start | " + " | ".join(f"{float(getattr(r, name)):.0e}" for r in rates) + " | |"]
    for name, run in runs.items():
        computed = run(1e-8)
        error, off = (np.abs(a - b).max((1, 2)) / case.size for a, b in zip(computed[:2], (q, slope), strict=True))
        steps, success, codes = computed[2:]
        cells = [
            f"{n}, {e:.0e}" if ok else f"`{name_of(code)}` ({n})"
            for n, e, ok, code in zip(steps, error, success, codes, strict=True)
        ]
        worst = f"{off[success].max():.0e}" if success.any() else ""
        lines += [f"| {name} | " + " | ".join(cells) + f" | {worst} |"]
        print(lines[-1], file=sys.stderr, flush=True)
    return "\n".join(lines)


def main() -> None:
    """Print the tables of the cases named, or of all."""
    jax.config.update("jax_enable_x64", True)
    chosen = cases()
    for name in chosen_names(sys.argv[1:], chosen):
        print(table(chosen[name]), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
