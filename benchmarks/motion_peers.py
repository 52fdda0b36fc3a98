"""Motions by MuJoCo, Pinocchio and SciPy of scenes that they can do, as contestants of a report.

MuJoCo integrates with its own methods in C (`mujoco.rollout`, all cores for a batch). Pinocchio gives accelerations: to
SciPy's DOP853 for one trajectory, called from Python, and to a Runge-Kutta method over a whole batch in its threads.
SciPy alone integrates equations of motion written by hand in numpy. Every one runs in joint angles, or a quaternion and
body rates, and its states are put into the coordinates of the scene before they are compared.
"""

import os
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
import pinocchio as pin
from mujoco import rollout
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jaxdyn as jd
from benchmarks.constraints import to_pinocchio
from jaxdyn.report.measure import Contestant, Motion

CORES = len(os.sched_getaffinity(0))
MUJOCO = {
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
}
STAGES = {"RK4": 4, "implicitfast": 1, "Euler": 1}
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)


class Twin(NamedTuple):
    """The same motion for a peer: a tree of joints, the way to its coordinates and back, and accelerations by hand."""

    model: jd.Model
    there: Callable  # (q, v) of the scene, with leading axes -> (q, v) of the tree
    back: Callable
    by_hand: Callable  # (q, v) of the tree -> dq/dt, dv/dt


def _same(q, v):
    return np.asarray(q), np.asarray(v)


def _to_angle(q, v):
    angle = np.arctan2(q[..., 0], -q[..., 1])
    return angle[..., None], (np.cos(angle) * v[..., 0] + np.sin(angle) * v[..., 1])[..., None]


def _from_angle(q, v):
    c, s = np.cos(q[..., 0]), np.sin(q[..., 0])
    return np.stack([s, -c], -1), v * np.stack([c, s], -1)


def _pendulum_by_hand(q, v):
    return v, -9.81 * np.sin(q)


def _double_by_hand(q, v, masses=(1.0, 0.5), length=1.0, reaches=(0.5, 0.35)):
    """Two bars in absolute angles a and b: [[A, B c], [B c, D]] (a'', b'') + B s (b'^2, -a'^2) + (G sin a, H sin b) = 0."""
    (m1, m2), (r1, r2) = masses, reaches
    i1, i2 = (m * (2 * r) ** 2 / 12 for m, r in zip(masses, reaches, strict=True))
    a, b, wa, wb = q[0], q[0] + q[1], v[0], v[0] + v[1]
    A, B, D = i1 + m1 * r1**2 + m2 * length**2, m2 * length * r2, i2 + m2 * r2**2
    c, s = B * np.cos(a - b), B * np.sin(a - b)
    first = -s * wb**2 - 9.81 * (m1 * r1 + m2 * length) * np.sin(a)
    second = s * wa**2 - 9.81 * m2 * r2 * np.sin(b)
    turn = (D * first - c * second) / (A * D - c * c)
    return v, np.array([turn, (A * second - c * first) / (A * D - c * c) - turn])


def _top_by_hand(q, v):
    moments = np.array([1.0, 2.0, 3.0])
    w, x, y, z = q
    a, b, c = v
    rate = np.array([-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a])
    return 0.5 * rate, np.cross(moments * v, v) / moments


def twins() -> dict[str, Twin]:
    """Scenes that all of them can do."""
    builder = jd.ModelBuilder("pendulum", gravity=(0.0, -9.81, 0.0))
    builder.add_body("bob", None, "continuous", (1.0, (0.0, -1.0, 0.0), (0.0, 0.0, 0.0)))
    double = jd.scenes.double_pendulum(formulation="model").system
    return {
        "pendulum_in_plane": Twin(builder.build(), _to_angle, _from_angle, _pendulum_by_hand),
        "double_pendulum": Twin(double, _same, _same, _double_by_hand),
        "free_body": Twin(jd.scenes.free_body().system, _same, _same, _top_by_hand),
    }


def contestants(prepared, dtype: str, starts) -> list[Contestant]:
    """Rungs of all peers for a scene of the report; none where they cannot do it, or in float32."""
    twin = twins().get(prepared.case.name)
    if twin is None or dtype != "float64":
        return []
    found = [*_mujoco(prepared, twin, starts)]
    return found + (_scipy(prepared, twin, starts) if len(starts[0]) == 1 else _batched(prepared, twin, starts))


def to_mujoco(model: jd.Model) -> mujoco.MjModel:
    """Joints and bodies of a model of revolute and ball joints, without contact."""
    topology = model.topology
    homes, numbers, screws = (np.asarray(x, float) for x in (model.home, model.inertias, model.screws))
    bodies = {}
    for i in reversed(range(model.nb)):
        m, c = numbers[i][0], numbers[i][1:4] / numbers[i][0]
        xx, xy, yy, xz, yz, zz = numbers[i][4:]
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) - m * (c @ c * np.eye(3) - np.outer(c, c))
        moments, axes = np.linalg.eigh(about)
        axes[:, 0] *= np.linalg.det(axes)
        turned, home = (np.roll(Rotation.from_matrix(x).as_quat(), 1) for x in (axes, homes[i][:3, :3]))
        row = lambda x: " ".join(repr(float(y)) for y in x)  # noqa: E731
        ball = topology.kinds[i] == "spherical"
        joint = 'type="ball"' if ball else f'type="hinge" axis="{row(screws[i][3:])}"'
        inside = "".join(bodies.pop(k) for k in range(model.nb) if topology.parents[k] == i and k in bodies)
        bodies[i] = (
            f'<body pos="{row(homes[i][:3, 3])}" quat="{row(home)}"><joint {joint}/>'
            f'<inertial mass="{row([m])}" pos="{row(c)}" quat="{row(turned)}" diaginertia="{row(np.maximum(moments, 1e-13))}"/>'
            f"{inside}</body>"
        )
    gravity = "0 0 0" if model.gravity is None else " ".join(repr(float(x)) for x in np.asarray(model.gravity))
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian" boundinertia="1e-13"/><option gravity="{gravity}"><flag constraint="disable" '
        f'contact="disable"/></option><worldbody>{"".join(bodies.values())}</worldbody></mujoco>'
    )


def _steps_between(prepared) -> list[int]:
    """Fixed steps from one save point to the next, from coarse to fine."""
    coarse = max(1, round(prepared.case.steps / (len(prepared.reference.ts) - 1)))
    return [coarse * 4**k for k in range(4)]


def _mujoco(prepared, twin, starts):
    q, v = twin.there(*starts[:2])
    batch, nq, nv = len(q), q.shape[1], v.shape[1]
    span = float(prepared.reference.ts[1] - prepared.reference.ts[0])
    points = len(prepared.reference.ts) - 1
    for name, kind in MUJOCO.items():
        for between in _steps_between(prepared)[: 4 if batch == 1 else 3]:
            model = to_mujoco(twin.model)
            model.opt.timestep, model.opt.integrator = span / between, kind
            threads = 0 if batch == 1 else CORES
            pool, data = rollout.Rollout(nthread=threads), [mujoco.MjData(model) for _ in range(max(1, threads))]
            state = np.zeros((batch, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
            state[:, 1 : 1 + nq], state[:, 1 + nq : 1 + nq + nv] = q, v

            def call(model=model, pool=pool, data=data, state=state, between=between):
                return pool.rollout(model, data, state, nstep=between * points)[0]

            def motion(found, name=name, between=between, state=state) -> Motion:
                rows = np.concatenate([state[0][None], found[0][between - 1 :: between]])
                steps = between * points
                there = twin.back(rows[:, 1 : 1 + nq], rows[:, 1 + nq : 1 + nq + nv])
                return Motion(*there, "successful", steps, 0, STAGES[name] * steps)

            yield Contestant(f"MuJoCo {mujoco.__version__}", "joint angles", name, span / between, True, call, motion)


def _rates_by_pinocchio(twin) -> Callable:
    if twin.model.topology.kinds[0] == "spherical":
        source = pin.Model()
        joint = source.addJoint(0, pin.JointModelSpherical(), pin.SE3.Identity(), "ball")
        xx, xy, yy, xz, yz, zz = np.asarray(twin.model.inertias[0][4:], float)
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        source.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), about), pin.SE3.Identity())
        source.gravity.linear = np.zeros(3)
    else:
        source, _ = to_pinocchio(jd.Scene(twin.model))
    data, zero, quaternion = source.createData(), np.zeros(source.nv), source.nq > source.nv

    def rates(q, v):
        if not quaternion:
            return v, pin.aba(source, data, q, v, zero)
        rate, _ = _top_by_hand(q, v)
        return rate, pin.aba(source, data, np.roll(q / np.sqrt(q @ q), -1), v, zero)

    return rates


def _scipy(prepared, twin, starts) -> list[Contestant]:
    """DOP853 from Python: with Pinocchio's accelerations, and with those by hand."""
    q, v = twin.there(starts[0][0], starts[1][0])
    ts, nq = prepared.reference.ts, len(q)
    found = []
    for source, rates in ((f"Pinocchio {pin.__version__}", _rates_by_pinocchio(twin)), ("NumPy", twin.by_hand)):

        def slope(t, y, rates=rates):
            return np.concatenate(rates(y[:nq], y[nq:]))

        for tolerance in TOLERANCES:

            def call(slope=slope, tolerance=tolerance):
                state = np.concatenate([q, v])
                return solve_ivp(
                    slope, (ts[0], ts[-1]), state, "DOP853", ts, rtol=max(tolerance, 3e-14), atol=tolerance
                )

            def motion(solved) -> Motion:
                place = solved.y[:nq].T
                place = place / np.linalg.norm(place, axis=1, keepdims=True) if nq == 4 else place
                return Motion(*twin.back(place, solved.y[nq:].T), evaluations=int(solved.nfev))

            found.append(Contestant(source, "joint angles", "SciPy DOP853", tolerance, False, call, motion))
    return found


def _batched(prepared, twin, starts) -> list[Contestant]:
    """Runge-Kutta of order 4 over the whole batch: accelerations by Pinocchio's threads, sums by numpy."""
    # With one degree of freedom the rows of one number are taken for vectors there, and the call fails.
    if twin.model.nq != twin.model.nv or twin.model.nv == 1:
        return []
    source, _ = to_pinocchio(jd.Scene(twin.model))
    pool = pin.ModelPool(source, CORES)
    q, v = (np.asfortranarray(x.T) for x in twin.there(*starts[:2]))
    zero, ts = np.zeros_like(v), prepared.reference.ts

    def rates(y):
        a = np.zeros_like(v)
        pin.abaInParallel(CORES, pool, np.asfortranarray(y[0]), np.asfortranarray(y[1]), zero, a)
        return np.stack([y[1], a])

    found = []
    for between in _steps_between(prepared)[:3]:
        step = float(ts[1] - ts[0]) / between

        def call(step=step, between=between):
            y, rows = np.stack([q, v]), [np.stack([q, v])]
            for _ in range(len(ts) - 1):
                for _ in range(between):
                    a = rates(y)
                    b = rates(y + step / 2 * a)
                    c = rates(y + step / 2 * b)
                    y = y + step / 6 * (a + 2 * b + 2 * c + rates(y + step * c))
                rows.append(y)
            return np.stack(rows)

        def motion(rows, between=between) -> Motion:
            steps = between * (len(ts) - 1)
            return Motion(*twin.back(rows[:, 0, :, 0], rows[:, 1, :, 0]), "successful", steps, 0, 4 * steps)

        name = f"Pinocchio {pin.__version__}, {CORES} threads"
        found.append(Contestant(name, "joint angles", "RK4", step, True, call, motion))
    return found
