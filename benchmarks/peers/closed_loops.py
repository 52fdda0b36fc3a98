"""By how much other libraries open a closed loop: a four-bar linkage that falls for a second, at steps of 10 ms and 1 ms.

    python -m venv peer; peer/bin/pip install drake exudyn mujoco newton
    peer/bin/python benchmarks/peers/closed_loops.py [LIBRARY ...]

It needs NumPy and the libraries to be measured; those that are missing are left out. Crank and coupler are a chain from the
origin, the rocker turns about (1, 0), and the loop joins (0.9, 0) of the coupler to (0.7, 0) of the rocker. The gap is that of
the two points in the plane at the end, in m.
"""

import importlib.util
import math
import sys

import numpy as np

LENGTHS = 0.3, 0.9, 0.7  # m: of the crank, and to the points that meet on coupler and rocker
CENTRE, MOMENTS = (
    np.array([0.2, 0.0, 0.0]),
    np.diag([0.05, 0.06, 0.06]),
)  # of each body of 1 kg, about its centre of mass
GRAVITY = np.array([0.0, -9.81, 0.0])


def start() -> tuple[list[float], list[np.ndarray]]:
    """Angles of the bodies in the plane, with the crank at 1 rad, and the places of their joints."""
    crank, coupler, rocker = LENGTHS
    knee = crank * np.array([math.cos(1.0), math.sin(1.0), 0.0])
    pin = np.array([1.0, 0.0, 0.0])
    apart = pin - knee
    distance = np.linalg.norm(apart)
    # The triangle of knee, pin and the point that coupler and rocker share, above the line between the first two.
    turn = math.acos((coupler**2 + distance**2 - rocker**2) / (2 * coupler * distance))
    angle = math.atan2(apart[1], apart[0]) + turn
    tip = knee + coupler * np.array([math.cos(angle), math.sin(angle), 0.0]) - pin
    return [1.0, angle, math.atan2(tip[1], tip[0])], [np.zeros(3), knee, pin]


def rotation(angle: float) -> np.ndarray:
    """Rotation about z."""
    return np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])


def with_drake(dt: float) -> float:
    """Ball constraint of a discrete plant, solved by SAP; continuous plants accept none."""
    import pydrake.all as drake  # pyright: ignore[reportMissingImports]

    builder = drake.DiagramBuilder()
    plant = builder.AddSystem(drake.MultibodyPlant(dt))
    plant.mutable_gravity_field().set_gravity_vector(GRAVITY)
    inertia = drake.SpatialInertia.MakeFromCentralInertia(1.0, CENTRE, drake.RotationalInertia(*np.diag(MOMENTS)))
    bodies = [plant.AddRigidBody(name, inertia) for name in ("crank", "coupler", "rocker")]
    world, angles = plant.world_frame(), start()[0]
    for i, (frame, x) in enumerate(((world, 0.0), (bodies[0].body_frame(), LENGTHS[0]), (world, 1.0))):
        base = plant.AddFrame(drake.FixedOffsetFrame(f"f{i}", frame, drake.RigidTransform([x, 0, 0])))
        plant.AddJoint(drake.RevoluteJoint(f"j{i}", base, bodies[i].body_frame(), [0, 0, 1]))
    points = [np.array([LENGTHS[1], 0, 0]), np.array([LENGTHS[2], 0, 0])]
    plant.AddBallConstraint(bodies[1], points[0], bodies[2], points[1])
    plant.Finalize()
    simulator = drake.Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetPositions(context, [angles[0], angles[1] - angles[0], angles[2]])
    simulator.AdvanceTo(1.0)
    ends = [plant.EvalBodyPoseInWorld(context, body) @ p for body, p in zip(bodies[1:], points, strict=True)]
    return float(np.abs(ends[0] - ends[1]).max())


def with_exudyn(dt: float) -> float:
    """Joints as constraints of redundant coordinates; the implicit trapezoidal rule."""
    import exudyn as exu  # pyright: ignore[reportMissingImports]
    import exudyn.utilities  # pyright: ignore[reportMissingImports]

    container = exu.SystemContainer()
    system = container.AddSystem()
    ground, bodies = system.CreateGround(), []
    angles, places = start()
    inertia = exu.utilities.RigidBodyInertia(1.0, MOMENTS, inertiaTensorAtCOM=True).Translated(CENTRE)
    for angle, place in zip(angles, places, strict=True):
        matrix = rotation(angle)
        bodies.append(
            system.CreateRigidBody(
                inertia=inertia, referencePosition=place, referenceRotationMatrix=matrix, gravity=GRAVITY
            )
        )
    tip = places[1] + rotation(angles[1]) @ [LENGTHS[1], 0, 0]
    hinge, pin = [1, 1, 1, 1, 1, 0], [1, 1, 0, 0, 0, 0]
    for ends, place, axes in (
        ([bodies[0], ground], places[0], hinge),
        ([bodies[1], bodies[0]], places[1], hinge),
        ([bodies[2], ground], places[2], hinge),
        ([bodies[1], bodies[2]], tip, pin),
    ):
        system.CreateGenericJoint(
            itemNumbers=ends, position=place, constrainedAxes=axes, useGlobalFrame=True, show=False
        )
    system.Assemble()
    settings = exu.SimulationSettings()
    settings.timeIntegration.numberOfSteps, settings.timeIntegration.endTime = round(1 / dt), 1.0
    settings.timeIntegration.verboseMode = 0
    settings.solutionSettings.writeSolutionToFile = False
    system.SolveDynamic(settings)
    ends = [
        system.GetObjectOutputBody(bodies[i], exu.OutputVariableType.Position, localPosition=[LENGTHS[i], 0, 0])
        for i in (1, 2)
    ]
    return float(np.abs(ends[0] - ends[1]).max())


def with_mujoco(dt: float) -> float:
    """A soft equality constraint."""
    import mujoco  # pyright: ignore[reportMissingImports]

    angles, _ = start()
    inertial = f'<inertial pos="0.2 0 0" mass="1" diaginertia="{" ".join(map(str, np.diag(MOMENTS)))}"/>'
    joint = '<joint axis="0 0 1"/>' + inertial
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{dt}" gravity="0 -9.81 0"/><worldbody><body>{joint}'
        f'<body pos="{LENGTHS[0]} 0 0">{joint}<site name="a" pos="{LENGTHS[1]} 0 0"/></body></body>'
        f'<body pos="1 0 0">{joint}<site name="b" pos="{LENGTHS[2]} 0 0"/></body></worldbody>'
        '<equality><connect site1="a" site2="b"/></equality></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qpos[:] = angles[0], angles[1] - angles[0], angles[2]
    mujoco.mj_step(model, data, round(1 / dt))
    mujoco.mj_forward(model, data)
    return float(np.abs(data.site_xpos[0] - data.site_xpos[1]).max())


def with_newton(dt: float) -> float:
    """Kamino: all joints are constraints of maximal coordinates, in float32."""
    import newton  # pyright: ignore[reportMissingImports]
    import warp as wp  # pyright: ignore[reportMissingImports]

    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=tuple(GRAVITY))
    angles, places = start()
    inertia = wp.mat33(*MOMENTS.ravel())
    bodies = []
    for angle, place in zip(angles, places, strict=True):
        pose = wp.transform(wp.vec3(*place), wp.quat_from_axis_angle(wp.vec3(0, 0, 1), float(angle)))
        bodies.append(builder.add_link(xform=pose, mass=1.0, com=wp.vec3(*CENTRE), inertia=inertia, lock_inertia=True))

    def hinge(parent, child, at, on=0.0):
        poses = [wp.transform(wp.vec3(x, 0, 0), wp.quat_identity()) for x in (at, on)]
        return builder.add_joint_revolute(parent, child, parent_xform=poses[0], child_xform=poses[1], axis=(0, 0, 1))

    tree = [hinge(-1, bodies[0], 0.0), hinge(bodies[0], bodies[1], LENGTHS[0]), hinge(-1, bodies[2], 1.0)]
    hinge(bodies[1], bodies[2], LENGTHS[1], LENGTHS[2])
    builder.add_articulation(tree)
    model = builder.finalize(device="cpu", skip_validation_joints=True)
    solver, control = newton.solvers.SolverKamino(model), model.control()
    state, after = model.state(), model.state()
    for _ in range(round(1 / dt)):
        solver.step(state, after, control, None, dt)
        state, after = after, state
    ends = []
    for i in (1, 2):
        pose = state.body_q.numpy()[bodies[i]].astype(float)
        vector, scalar, point = pose[3:6], pose[6], np.array([LENGTHS[i], 0, 0])
        ends.append(pose[:3] + point + 2 * np.cross(vector, np.cross(vector, point) + scalar * point))
    return float(np.abs(ends[0] - ends[1]).max())


LIBRARIES = {"drake": with_drake, "exudyn": with_exudyn, "mujoco": with_mujoco, "newton": with_newton}
MODULES = {"drake": "pydrake"}


def main(names) -> None:
    """Print a row for each library that is installed."""
    print("| library | steps of 10 ms, m | 1 ms, m |\n|---|---|---|")
    for name in names or LIBRARIES:
        if importlib.util.find_spec(MODULES.get(name, name)) is None:
            print(f"{name} is not installed", file=sys.stderr)
            continue
        print(f"| {name} | {' | '.join(f'{LIBRARIES[name](dt):.1e}' for dt in (0.01, 0.001))} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
