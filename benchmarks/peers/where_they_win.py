"""Measured examples of what other libraries do and jaxdyn does not, one for each library.

    python -m venv peer; peer/bin/pip install drake exudyn mujoco newton pin
    peer/bin/python benchmarks/peers/where_they_win.py [LIBRARY ...]

It needs NumPy and the libraries to be measured; those that are missing are left out. Nothing here is a time, so that figures do
not depend on the machine, but for Pinocchio's first call, which is processor time.
"""

import importlib.util
import sys
import time

import numpy as np


def with_drake() -> str:
    """Patch of contact between a compliant ball and a compliant table, by hydroelastic contact."""
    import pydrake.all as drake  # pyright: ignore[reportMissingImports]

    builder = drake.DiagramBuilder()
    plant, _ = drake.AddMultibodyPlantSceneGraph(builder, 0.0)
    properties = drake.ProximityProperties()
    drake.AddCompliantHydroelasticProperties(0.02, 1e6, properties)
    drake.AddContactMaterial(1.0, None, drake.CoulombFriction(0.5, 0.5), properties)
    ball = plant.AddRigidBody("ball", drake.SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.RegisterCollisionGeometry(ball, drake.RigidTransform(), drake.Sphere(0.1), "ball", properties)
    below = drake.RigidTransform([0, 0, -0.1])
    plant.RegisterCollisionGeometry(plant.world_body(), below, drake.Box(1, 1, 0.2), "table", properties)
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    inner = plant.GetMyMutableContextFromRoot(context)
    plant.SetFreeBodyPose(inner, ball, drake.RigidTransform([0, 0, 0.095]))
    patch = plant.get_contact_results_output_port().Eval(inner).hydroelastic_contact_info(0)
    surface, force = patch.contact_surface(), patch.F_Ac_W().translational()
    return f"ball pressed 5 mm into a table: {surface.num_faces()} faces, {1e4 * surface.total_area():.0f} cm^2, {force[2]:.0f} N"


def with_exudyn() -> str:
    """Large static deflection of a cantilever of 16 cable elements: 0.3017 of its length by elliptic integrals.

    Source: Bisshopp & Drucker (1945), Large deflection of cantilever beams, at F L^2 / (E I) = 1.
    """
    import exudyn as exu  # pyright: ignore[reportMissingImports]
    import exudyn.beams  # pyright: ignore[reportMissingImports]
    import exudyn.utilities as tools  # pyright: ignore[reportMissingImports]

    container = exu.SystemContainer()
    system = container.AddSystem()
    cable = tools.Cable2D(physicsMassPerLength=1.0, physicsBendingStiffness=1.0, physicsAxialStiffness=1e6)
    nodes = exudyn.beams.GenerateStraightLineANCFCable2D(
        system, [0, 0, 0], [1, 0, 0], 16, cable, fixedConstraintsNode0=[1, 1, 0, 1]
    )[0]
    end = system.AddMarker(tools.MarkerNodePosition(nodeNumber=nodes[-1]))
    system.AddLoad(tools.Force(markerNumber=end, loadVector=[0, -1, 0]))
    system.Assemble()
    settings = exu.SimulationSettings()
    settings.staticSolver.numberOfLoadSteps, settings.staticSolver.verboseMode = 5, 0
    settings.solutionSettings.writeSolutionToFile = False
    system.SolveStatic(settings)
    return (
        f"cantilever of length 1: deflection {-system.GetNodeOutput(nodes[-1], exu.OutputVariableType.Position)[1]:.4f}"
    )


def with_mujoco() -> str:
    """Twenty boxes in random attitudes fall into a bin; their contacts are found from the shapes."""
    import mujoco  # pyright: ignore[reportMissingImports]

    rng = np.random.default_rng(0)

    def box(i):
        x, y = rng.uniform(-0.15, 0.15, 2)
        angles = " ".join(map(str, rng.uniform(0, 180, 3)))
        geometry = '<freejoint/><geom type="box" size=".1 .07 .05" mass="1"/>'
        return f'<body pos="{x} {y} {0.3 + 0.2 * i}" euler="{angles}">{geometry}</body>'

    walls = "".join(
        f'<geom type="box" pos="{x} {y} .3" size="{0.02 + abs(y)} {0.02 + abs(x)} .3"/>'
        for x, y in ((0.3, 0), (-0.3, 0), (0, 0.3), (0, -0.3))
    )
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><geom type="plane" size="2 2 .1"/>'
        f"{walls}{''.join(map(box, range(20)))}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 4000)
    contacts = [data.contact[i] for i in range(data.ncon)]
    between = {(c.geom1, c.geom2) for c in contacts if min(c.geom1, c.geom2) > 4}  # not with floor and walls
    deepest = -1e3 * min(contact.dist for contact in contacts)
    return (
        f"20 boxes in a bin after 8 s: {len(contacts)} contacts, {len(between)} pairs of boxes, {deepest:.1f} mm deep"
    )


def with_newton() -> str:
    """A cloth of 17 x 17 particles falls on a ball of 0.3 m and drapes over it."""
    import newton  # pyright: ignore[reportMissingImports]
    import warp as wp  # pyright: ignore[reportMissingImports]

    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    stiffness = {"tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 0.1, "edge_ke": 1e-2, "edge_kd": 1e-3}
    builder.add_cloth_grid(
        pos=wp.vec3(-0.5, -0.5, 0.7),
        rot=wp.quat_identity(),
        vel=wp.vec3(0, 0, 0),
        dim_x=16,
        dim_y=16,
        cell_x=1 / 16,
        cell_y=1 / 16,
        mass=1e-3,
        particle_radius=0.02,
        **stiffness,
    )
    builder.add_shape_sphere(-1, xform=wp.transform(wp.vec3(0, 0, 0.3), wp.quat_identity()), radius=0.3)
    builder.color()
    model = builder.finalize(device="cpu")
    solver, control = newton.solvers.SolverVBD(model, iterations=10), model.control()
    state, after = model.state(), model.state()
    for _ in range(600):
        state.clear_forces()
        solver.step(state, after, control, model.collide(state), 1 / 300)
        state, after = after, state
    places = state.particle_q.numpy().astype(float)
    distance = np.linalg.norm(places - [0, 0, 0.3], axis=1).min()
    return f"cloth on a ball after 2 s: hangs down by {np.ptp(places[:, 2]):.2f} m, {1e3 * (0.32 - distance):.1f} mm deep in it"


def with_pinocchio() -> str:
    """Nothing is compiled when a model is used for the first time."""
    import pinocchio as pin  # pyright: ignore[reportMissingImports]

    model = pin.buildSampleModelManipulator()
    data, q, zero = model.createData(), pin.neutral(model), np.zeros(model.nv)
    began = time.process_time()
    pin.aba(model, data, q, zero, zero)
    return f"first forward dynamics of an arm: {1e3 * (time.process_time() - began):.2f} ms"


LIBRARIES = {
    "drake": with_drake,
    "exudyn": with_exudyn,
    "mujoco": with_mujoco,
    "newton": with_newton,
    "pinocchio": with_pinocchio,
}
MODULES = {"drake": "pydrake"}


def main(names) -> None:
    """Print a row for each library that is installed."""
    print("| library | example |\n|---|---|")
    for name in names or LIBRARIES:
        if importlib.util.find_spec(MODULES.get(name, name)) is None:
            print(f"{name} is not installed", file=sys.stderr)
            continue
        print(f"| {name} | {LIBRARIES[name]()} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
