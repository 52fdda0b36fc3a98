"""Extreme constraints: singular positions, nearly dependent rows, bases and grasps that degenerate, open starts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks.extremes import FIXED, Outcome, as_dtype, case, outcome, study, table
from jaxdyn.constraints.codes import code_of
from jaxdyn.reports import references

LOOSE = {"float64": 1e-6, "float32": 2e-3}
# Windows, method, fixed step and tolerance.
FALLS = (
    *((1, method, None, 1e-8) for method in ("projected", "multipliers", "baumgarte", "reduced")),
    *((1, method, 0.005, 1e-8) for method in ("projected", "reduced")),
    (2, "projected", None, 1e-8),
    (2, "projected", 0.005, 1e-8),
    *((2, method, None, tight) for method in ("projected", "multipliers") for tight in (1e-11, 1e-12)),
)


@case
def flat(dtypes, gradient, runs=FALLS):
    """Loops through a singular position: one and two parallelogram windows that fall through the horizontal, by each method"""
    rows, ts = [], np.array([0.0, 0.5, 1.0])
    for count, method, stepsize, tolerance in runs:
        base = jd.scenes.windows(count=count)
        q0, v0 = jd.scenes.windows.start(count=count)
        reference = references.windows(ts, count)
        # The uprights are horizontal after a quarter of a turn, which they have passed after 1 s.
        assert np.abs(reference.q[1:]).max() > np.pi / 2
        exact = np.concatenate([reference.q[-1], reference.v[-1]])[None]

        def run(point, x, base=base, q0=q0, v0=v0, method=method, stepsize=stepsize, tolerance=tolerance):
            dtype = point.dtype
            v = v0.astype(dtype) * (point + x)
            at = jnp.asarray(ts, dtype)
            bound = tolerance if stepsize is None else None
            steps = jd.Steps(stepsize, rtol=bound, atol=bound, max_steps=4096)
            options = {"method": method, "stepsize": steps}
            solution = jd.simulate(
                as_dtype(base, dtype), q0.astype(dtype), v, at, outputs=("constraint_residual",), **options
            )
            return outcome(solution, residual=jnp.max(solution.constraint_residual[:, 0]))

        # Gradients of one window by the default method tell enough, and compile for minutes.
        # Tolerances that float32 does not know are raised there.
        chosen = dtypes if tolerance == 1e-8 else [d for d in dtypes if d == "float64"]
        studied = study(run, jnp.ones(1), chosen, gradient and count == 1 and method == "projected")
        label = f"{count} window{'s' * (count > 1)}, {method}, {'adaptive' if stepsize is None else 'fixed'}"
        label += f", {tolerance:.0e}" if tolerance != 1e-8 else ""
        close = {"excused": 0.0 if stepsize is None else FIXED, "advice": FLAT}
        rows += table("flat", [label], studied, exact, LOOSE, "Jacobi's functions", **close)
    return rows


ANGLES = 10.0 ** -np.array([2, 3, 4, 5, 6, 8, 10, 12])


def _lines(p, q, t):
    return jnp.stack([q[2], jnp.cos(p) * q[2] + jnp.sin(p) * q[1]])


def _mass(q, t, mass):
    return mass * jnp.eye(3, dtype=q.dtype)


def _no_force(q, v, t, mass):
    return jnp.zeros_like(v)


@case
def planes(dtypes, gradient):
    """Rows at an angle of 1e-2 to 1e-12: a particle held on the line in which two planes meet, pushed along and across, 1 s"""
    across = np.repeat([0.0, 1.0], len(ANGLES))
    points = jnp.asarray(np.tile(ANGLES, 2)), jnp.asarray(across)
    rows = []
    for rank_tol in (None, 1e-14):
        run = lambda point, x, tol=rank_tol: _held_by_planes(point, x, tol)  # noqa: E731
        chosen = dtypes if rank_tol is None else [d for d in dtypes if d == "float64"]
        for dtype in chosen:
            # Rows at a smaller angle than this count as one, and do not hold across; the angle in Y is half of it at most.
            least = float(np.finfo(dtype).eps) ** (4 / 7) if rank_tol is None else rank_tol
            free = across * (np.tile(ANGLES, 2) < least)
            exact = np.stack([np.full(len(across), 0.5), 0.5 * free, np.zeros(len(across))], 1)
            labels = [
                f"{a:.0e} rad, {'across' if side else 'along'}{', counted as one' if one else ''}"
                for a, side, one in zip(np.tile(ANGLES, 2), across, free, strict=True)
            ]
            if rank_tol is not None:
                labels = [f"{label}, rank_tol {rank_tol:.0e}" for label in labels]
            studied = study(run, points, (dtype,), gradient)
            slope = np.full(len(across), 1.5)  # of q + v after 1 s, for the push along
            rows += table("planes", labels, studied, exact, LOOSE, "closed form", advice=PLANES, wanted=slope)
    return rows


def _held_by_planes(point, x, rank_tol):
    angle, across = point
    dtype = angle.dtype
    held = jd.Holonomic(jax.tree_util.Partial(_lines, angle), name="planes")
    scene = jd.Scene(jd.ExplicitSystem(_mass, _no_force, 3, parameters=jnp.ones((), dtype)), (held,))
    push = _Push(jnp.stack([1.0 + x, across, jnp.ones((), dtype)]))
    zero, ts, method = jnp.zeros(3, dtype), jnp.asarray([0.0, 1.0], dtype), jd.Projected(rank_tol=rank_tol)
    options = {
        "control": push,
        "method": method,
        "stepsize": jd.Steps(max_steps=256),
        "outputs": ("constraint_residual",),
    }
    solution = jd.simulate(scene, zero, zero, ts, **options)
    return outcome(solution, end=solution.q[-1], value=jnp.sum(solution.q[-1] + solution.v[-1]))


class _Push(eqx.Module):
    force: jax.Array

    def __call__(self, q, v, t):
        return self.force


@case
def bases(dtypes, gradient):
    """Minimal velocities that stop to determine the others: a four-bar linkage by one joint's rate, a turn of the crank"""
    rows, base = [], jd.scenes.four_bar(gravity=None)
    q0, v0 = jd.scenes.four_bar.start(rate=3.0)
    ts = np.array([0.0, 1.0, 2.5])
    tight = jd.simulate(base, q0, v0, ts, stepsize=jd.Steps(rtol=1e-12, atol=1e-12))
    exact = np.concatenate([tight.q[-1], tight.v[-1]])[None]
    choices = {"rocker": jd.Reduced((2,)), "continued": jd.Reduced(dof=1)}
    for name, method in choices.items():
        for stepsize in (None, 0.01):

            def run(point, x, method=method, stepsize=stepsize):
                dtype = point.dtype
                solution = jd.simulate(
                    as_dtype(base, dtype),
                    q0.astype(dtype),
                    v0.astype(dtype) * (point + x),
                    jnp.asarray(ts, dtype),
                    method=method,
                    stepsize=jd.Steps(stepsize, max_steps=2048),
                    outputs=("constraint_residual",),
                    throw=False,
                )
                return outcome(solution)

            studied = study(run, jnp.ones(1), dtypes, gradient)
            label = f"{name}, {'adaptive' if stepsize is None else 'fixed'}"
            rows += table("bases", [label], studied, exact, LOOSE, "projected, tolerance 1e-12", advice=BASES)
    return rows


@case
def grasps(dtypes, gradient):
    """A ball held at three points that approach a line, and fingers that approach their full reach: `object_dynamics`"""
    rows, nearness = [], 10.0 ** -np.array([1, 2, 4, 6, 8, 10, 12])
    held, exact = _held_ball(), np.stack([_ball_acceleration(d) for d in nearness])

    def hold(near, x):
        dtype = near.dtype
        directions = jnp.stack([jnp.zeros_like(near), np.pi - near, np.pi + near])
        points = 0.1 * jnp.stack([jnp.cos(directions), jnp.sin(directions), 0 * directions], 1)
        grasp = as_dtype(held, dtype)
        poses = [jnp.eye(4, dtype=dtype).at[:3, 3].set(point) for point in points]
        grasp = eqx.tree_at(lambda g: [c.pose for c in g.constraints], grasp, poses)
        q = jnp.concatenate([points.reshape(-1), jnp.asarray([0, 0, 0, 1, 0, 0, 0], dtype)])
        tau = jnp.asarray(_PUSH, dtype)
        dynamics = jd.grasp.object_dynamics(grasp, q, jnp.zeros(6, dtype), tau + x)
        inside = jd.grasp.internal_forces(grasp, q, dynamics.contact_forces)
        moved = jnp.max(jnp.abs(jd.grasp.grasp_map(grasp, q) @ inside))
        return Outcome(dynamics.rate, moved, code_of(dynamics.result), jnp.sum(dynamics.rate) + jnp.sum(inside))

    def reach(near, x):
        dtype = near.dtype
        hand = as_dtype(jd.scenes.hand_with_bar(), dtype)
        q, _ = jd.scenes.hand_with_bar.start()
        q = q.astype(dtype).at[1].set(near)
        V = jnp.asarray([0.1, 0.2, -0.1], dtype) * near
        tau = 0.1 * jnp.cos(jnp.arange(hand.nv, dtype=dtype)) + x
        dynamics = jd.grasp.object_dynamics(hand, q, V, tau)
        other = jd.constrained_dynamics(hand, q, dynamics.velocity, tau)
        return Outcome(dynamics.acceleration - other.acceleration, x, code_of(dynamics.result), jnp.sum(dynamics.rate))

    studied = study(hold, jnp.asarray(nearness), dtypes, gradient)
    labels = [f"three points {n:.0e} rad from a line" for n in nearness]
    rows += table("grasps", labels, studied, exact, LOOSE, "Newton and Euler", advice=GRASPS)
    studied = study(reach, jnp.asarray(nearness), dtypes, gradient, step=1e-2)
    labels = [f"knee {n:.0e} rad from straight" for n in nearness]
    # The joints' accelerations grow with 1/knee, and so does what rounding leaves of their difference.
    allowed = {d: np.clip(1e4 * np.finfo(d).eps / nearness**2, LOOSE[d], 1e-2) for d in dtypes}
    against = "constrained_dynamics"
    rows += table(
        "grasps",
        labels,
        studied,
        np.zeros((len(labels), 1)),
        allowed,
        against,
        size=1.0,
        residual=False,
        advice=GRASPS,
    )
    return rows


_PUSH = 0.3 * np.cos(np.arange(15.0))


def _held_ball():
    """A ball of 0.4 kg held at three points by fingers of 0.1 kg that slide along x, y and z; no gravity."""
    builder = jd.ModelBuilder("hand", gravity=None)
    point = (0.1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    for i in range(3):
        for name, parent, axis, inertia in (
            ("x", None, (1, 0, 0), None),
            ("y", "x", (0, 1, 0), None),
            ("z", "y", (0, 0, 1), point),
        ):
            builder.add_body(f"{i}{name}", None if parent is None else f"{i}{parent}", "prismatic", inertia, axis=axis)
    builder.add_body("ball", None, "free", jd.inertia.sphere(0.4, 0.1), joint_name="object")
    return jd.grasp.Grasp(builder.build(), "ball", [jd.grasp.contact("hard-finger", f"{i}z", None) for i in range(3)])


def _ball_acceleration(near):
    """Rate of the ball's twist by Newton's and Euler's laws of ball and fingers as one body."""
    directions = np.array([0.0, np.pi - near, np.pi + near])
    points = 0.1 * np.stack([np.cos(directions), np.sin(directions), 0 * directions], 1)
    mass = np.diag([0.4] * 3 + [0.4 * 0.4 * 0.01] * 3)
    wrench = _PUSH[9:].copy()
    for point, force in zip(points, _PUSH[:9].reshape(3, 3), strict=True):
        x, y, z = point
        carried = np.concatenate([np.eye(3), np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])])
        mass += 0.1 * carried @ carried.T
        wrench += carried @ force
    return np.linalg.solve(mass, wrench)


OFF = 10.0 ** -np.array([12, 9, 6, 4, 3, 2, 1])


@case
def starts(dtypes, gradient):
    """A start that violates the constraints by 1e-12 to 1e-1: through `assemble`, and without it"""
    base = jd.scenes.four_bar()
    q0, v0 = jd.scenes.four_bar.start()
    rows, ts = [], np.array([0.0, 0.5])

    def run(off, x, assembled):
        dtype = off.dtype
        scene = as_dtype(base, dtype)
        side = jnp.asarray([0.0, 1.0, 1.0], dtype)
        q, v = q0.astype(dtype) + off * side, v0.astype(dtype) * (1 + x) + off * side
        code = None
        if assembled:
            state = jd.assemble(scene, q, v)
            q, v, code = state.q, state.v, state.result
        solution = jd.simulate(
            scene,
            q,
            v,
            jnp.asarray(ts, dtype),
            outputs=("constraint_residual", "energy"),
            stepsize=jd.Steps(max_steps=512),
        )
        result = outcome(solution, end=(solution.energy[1:] - solution.energy[0]) / 50.0)
        if code is None:
            return result
        good = code == jd.RESULTS.successful
        bad = code_of(jd.RESULTS.inconsistent_start)
        return result._replace(code=jnp.where(good, result.code, bad))

    for assembled in (True, False):
        studied = study(lambda p, x, a=assembled: run(p, x, a), jnp.asarray(OFF), dtypes, gradient)
        labels = [f"{o:.0e}, {'assembled' if assembled else 'as it is'}" for o in OFF]
        exact = np.zeros((len(OFF), 1))
        rows += table("starts", labels, studied, exact, LOOSE, "energy", size=1.0, advice=STARTS)
    return rows


FLAT = (
    "Adaptive steps in float64 pass the position where the rows lose rank, with every method. Exactly there, rounding"
    " decides on which of two branches the mechanism leaves. A run whose steps end there, which is likely in float32,"
    " ends with `dt_min_reached` or `max_steps_reached`: use float64, or fixed steps. In float32 fixed steps are off "
    "by up to 1e-2 without a code: check outputs=('energy', 'work'). Gradients through the position are those of the "
    "steps taken."
)
PLANES = (
    "Rows at an angle below `rank_tol` (1e-9 in float64, 1e-4 in float32) count as one row, because dependent rows "
    "differ by as much when a loop is open by rounding. The other direction is then free, with a residual of the "
    "angle times the distance moved. `constrained_dynamics(...).rank` is the number of rows counted. If two rows are "
    "meant, write the two directions as separate rows, or use jd.Projected(rank_tol=1e-14). Accelerations are then "
    "off by eps over the angle, so that below 1e-10 rad adaptive steps become short, up to `max_steps_reached`."
)
BASES = "Use jd.Reduced() without indices, which continues its basis smoothly, or method='projected'."
GRASPS = (
    "Accelerations and contact forces stay correct when the points approach a line. What is lost is control about the"
    " line, which the least singular value of `grasp_map` shows. A finger close to its reach ends with "
    "`singular_basis`; `constrained_dynamics` continues."
)
STARTS = (
    "Start from jd.assemble(scene, q, v). A start that is open by more than rounding (5e-7 in float64, 2e-3 in "
    "float32) is refused: a ValueError on concrete numbers, the code `inconsistent_start` on traced ones."
)
