"""MuJoCo in C: its own integrators by `mujoco.rollout`, with all cores for a batch.

Loops are `connect` constraints between two sites. They are soft: the reference acceleration pulls the sites together within
`solref` = two steps, the shortest time that MuJoCo allows, at the largest impedance that it takes, and the solver runs to
its last digits. What this leaves is the floor of its ladders.
"""

from collections.abc import Iterator

import mujoco
import numpy as np
from mujoco import rollout
from scipy.spatial.transform import Rotation

from benchmarks.peers.steps import CORES, steps_between
from benchmarks.peers.twins import TWINS, Twin
from jaxdyn.reports.run import Contestant, Motion

INTEGRATORS = {
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    # Its Euler method is the same, where joints have no damping.
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
STAGES = {"RK4": 4, "implicitfast": 1}


def _row(x) -> str:
    return " ".join(repr(float(y)) for y in x)


def _pose(pose) -> str:
    pose = np.asarray(pose, float)
    return f'pos="{_row(pose[:3, 3])}" quat="{_row(np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1))}"'


def to_mujoco(twin: Twin) -> mujoco.MjModel:
    """Joints, bodies, loops and forces of a twin, without contact."""
    scene, model = twin.scene, twin.scene.system
    topology = model.topology
    homes, numbers, screws = (np.asarray(x, float) for x in (model.home, model.inertias, model.screws))
    sites: dict[int, list[str]] = {i: [] for i in range(-1, model.nb)}
    connects, tendon = [], ""
    for k, loop in enumerate(scene.constraints):
        for side, body, pose in (("a", loop.body_a, loop.pose_a), ("b", loop.body_b, loop.pose_b)):
            sites[model.body_names.index(body)].append(f'<site name="{side}{k}" {_pose(pose)}/>')
        # The time is set with the step, in `_timed`.
        connects.append(f'<connect site1="a{k}" site2="b{k}" solimp="0.9999 0.9999 0.001 0.5 2"/>')
    if twin.spring is not None:
        spring = twin.spring
        sites[-1].append(f'<site name="foot" pos="{_row(spring.foot)}"/>')
        sites[spring.body].append(f'<site name="end" pos="{_row(spring.end)}"/>')
        tendon = (
            f'<tendon><spatial stiffness="{spring.stiffness}" springlength="{spring.rest}"><site site="foot"/>'
            '<site site="end"/></spatial></tendon>'
        )
    motors = "".join(
        f'<general joint="j{i}" gainprm="0" biastype="affine" biasprm="{torque} 0 0"/>'
        for i, torque in enumerate(twin.torques)
        if torque
    )
    bodies: dict[int, str] = {}
    for i in reversed(range(model.nb)):
        m, c = numbers[i][0], numbers[i][1:4] / numbers[i][0]
        xx, xy, yy, xz, yz, zz = numbers[i][4:]
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) - m * (c @ c * np.eye(3) - np.outer(c, c))
        moments, axes = np.linalg.eigh(about)
        axes[:, 0] *= np.linalg.det(axes)
        if topology.kinds[i] == "spherical":
            joint = 'type="ball"'
        else:
            # Turning about z alone: the other moments have no part in it, and a body has to have all three.
            joint = f'type="hinge" axis="{_row(screws[i][3:])}"'
            moments, axes = np.full(3, max(about[2, 2], 1e-13)), np.eye(3)
        inside = "".join(bodies.pop(k) for k in range(model.nb) if topology.parents[k] == i and k in bodies)
        turned = np.roll(Rotation.from_matrix(axes).as_quat(), 1)
        bodies[i] = (
            f'<body {_pose(homes[i])}><joint name="j{i}" {joint}/>'
            f'<inertial mass="{float(m)!r}" pos="{_row(c)}" quat="{_row(turned)}" diaginertia="{_row(moments)}"/>'
            f"{''.join(sites[i])}{inside}</body>"
        )
    gravity = "0 0 0" if model.gravity is None else _row(np.asarray(model.gravity))
    held = "enable" if connects else "disable"
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian" boundinertia="1e-13" boundmass="0"/>'
        f'<option gravity="{gravity}" solver="Newton" iterations="100" tolerance="1e-15" jacobian="auto">'
        f'<flag constraint="{held}" contact="disable"/></option>'
        f"<worldbody>{''.join(sites[-1])}{''.join(bodies[i] for i in sorted(bodies))}</worldbody>{tendon}"
        f"<equality>{''.join(connects)}</equality><actuator>{motors}</actuator></mujoco>"
    )


def _timed(twin: Twin, step: float, integrator) -> mujoco.MjModel:
    model = to_mujoco(twin)
    model.opt.timestep, model.opt.integrator = step, integrator
    model.eq_solref[:] = 2 * step, 1.0
    return model


def contestants(prepared, starts) -> Iterator[Contestant]:
    """Rungs of every integrator."""
    if prepared.case.name not in TWINS:
        return
    twin = TWINS[prepared.case.name]()
    q, v = twin.there(*starts[:2])
    batch, nq, nv = len(q), q.shape[1], v.shape[1]
    span = float(prepared.reference.ts[1] - prepared.reference.ts[0])
    points = len(prepared.reference.ts) - 1
    threads = 0 if batch == 1 else CORES
    for name, kind in INTEGRATORS.items():
        for between in steps_between(prepared, 4 if batch == 1 else 3):
            model = _timed(twin, span / between, kind)
            pool, data = rollout.Rollout(nthread=threads), [mujoco.MjData(model) for _ in range(max(1, threads))]
            state = np.zeros((batch, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
            state[:, 1 : 1 + nq], state[:, 1 + nq : 1 + nq + nv] = q, v

            def call(model=model, pool=pool, data=data, state=state, between=between):
                return pool.rollout(model, data, state, nstep=between * points)[0]

            def motion(computed, name=name, between=between, state=state) -> Motion:
                rows = np.concatenate([state[0][None], computed[0][between - 1 :: between]])
                steps = between * points
                there = twin.back(rows[:, 1 : 1 + nq], rows[:, 1 + nq : 1 + nq + nv])
                # MuJoCo starts anew from its home when a state is not finite; its clock tells.
                whole = abs(rows[-1, 0] - span * points) < span and np.isfinite(rows).all()
                return Motion(*there, "successful" if whole else "stopped", steps, 0, STAGES[name] * steps)

            yield Contestant(f"MuJoCo {mujoco.__version__}", "joint angles", name, span / between, True, call, motion)
