"""Quality of steps through contacts beside other engines: penetration, creep, friction, and energy, at one step length.

    python -m benchmarks.contact_quality [--dt 0.002]

A box on its four lower corners: it rests on a slope below the friction angle for ten seconds, slides down one above it, where the
acceleration is known, and tumbles in flight for half a second. C MuJoCo has elliptic cones and its defaults. The others run
where they are installed: MJX, with the same model, in float64; Drake, with point contacts of small spheres at the corners, its
discrete solver and its defaults; Newton, with its solver Kamino and its defaults, in float32, the only precision that it has.
"""

import argparse
import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import timing

G, MU, SIZE = 9.81, 0.5, np.array([0.2, 0.15, 0.1])
SPIN = np.array([0.3, 0.1, 2.0, 4.0, 7.0, -3.0])  # of the flight


def gravity(slope: float) -> np.ndarray:
    """Gravity in axes of a slope that falls along x."""
    return G * np.array([np.sin(slope), 0.0, -np.cos(slope)])


def ours(slope: float, height: float, v, dt: float, count: int):
    """Heights of the lowest corner, positions, energies, and forces (count, 4, 3) of each corner: friction, normal."""
    builder = jd.ModelBuilder("box", gravity=tuple(gravity(slope)))
    builder.add_body("box", None, "free", (1.0, (0, 0, 0), (np.sum(SIZE**2) - SIZE**2) / 12))
    corners = [SIZE / 2 * (x, y, -1) for x in (-1, 1) for y in (-1, 1)]
    feet = [jd.contact.ground_contact("box", at, MU, name=str(i)) for i, at in enumerate(corners)]
    scene = jd.Scene(builder.build(), forces=feet)
    step = jd.stepper(scene, dt, report=True)

    def advance(state, _):
        state, report = step(state, jnp.zeros(6))
        turn = jd.so3.quat_to_matrix(state[0][3:])
        low = jnp.min(state[0][2] + jnp.asarray(corners) @ turn[2])
        energy = jd.kinetic_energy(scene.system, *state) - jnp.asarray(gravity(slope)) @ state[0][:3]
        return state, (low, state[0], energy, jnp.stack([report.forces[str(i)] for i in range(4)]))

    start = jnp.asarray([0, 0, height, 1, 0, 0, 0.0]), jnp.asarray(v, float)
    return map(np.asarray, jax.jit(lambda s: jax.lax.scan(advance, s, None, length=count)[1])(start))


def box_of_mujoco(slope: float, dt: float):
    """The box and its ground as a model of MuJoCo."""
    import mujoco

    x, y, z = SIZE / 2
    gx, gy, gz = gravity(slope)
    return mujoco.MjModel.from_xml_string(  # pyright: ignore[reportAttributeAccessIssue]
        f"""<mujoco><option gravity="{gx} {gy} {gz}" timestep="{dt}" cone="elliptic"><flag energy="enable"/></option>
        <default><geom friction="{MU} 0.005 0.0001"/></default><worldbody><geom type="plane" size="99 99 1"/>
        <body><freejoint/><geom type="box" size="{x} {y} {z}" mass="1"/></body></worldbody></mujoco>"""
    )


def with_mujoco(slope: float, height: float, v, dt: float, count: int):
    """The same by MuJoCo."""
    import mujoco as _mujoco

    mujoco: Any = _mujoco  # without types
    model = box_of_mujoco(slope, dt)
    data = mujoco.MjData(model)
    data.qpos[:3], data.qvel[:] = (0, 0, height), v
    rows = []
    for _ in range(count):
        mujoco.mj_step(model, data)
        forces, low = np.zeros((4, 3)), np.inf
        for i in range(min(4, data.ncon)):
            wrench = np.zeros(6)
            mujoco.mj_contactForce(model, data, i, wrench)
            forces[i], low = wrench[[1, 2, 0]], min(low, data.contact[i].dist)
        mujoco.mj_forward(model, data)  # the energy is that of the start of a step
        rows.append((low, data.qpos.copy(), data.energy.sum(), forces))
    return map(np.array, zip(*rows, strict=True))


def with_mjx(slope: float, height: float, v, dt: float, count: int):
    """The same by MJX; the corners that touch are those of negative distance."""
    from mujoco import mjx as _mjx  # pyright: ignore[reportAttributeAccessIssue]

    mjx: Any = _mjx  # without types
    whole = box_of_mujoco(slope, dt)
    whole.opt.enableflags = 0  # MJX refuses the flag of the energy
    model = mjx.put_model(whole)
    turn_of = jd.so3.quat_to_matrix

    def advance(data, _):
        new = mjx.step(model, data)
        contact, rows = new._impl.contact, new._impl.efc_force
        forces = jnp.stack([rows[jnp.asarray(at) + jnp.asarray([1, 2, 0])] for at in contact.efc_address[:4]])
        rotation, speed = turn_of(new.qpos[3:]), new.qvel
        kinetic = 0.5 * speed[:3] @ speed[:3] + 0.5 * jnp.asarray(np.sum(SIZE**2) - SIZE**2) / 12 @ speed[3:] ** 2
        corners = jnp.asarray([SIZE / 2 * (x, y, -1) for x in (-1, 1) for y in (-1, 1)])
        low = jnp.min(new.qpos[2] + corners @ rotation[2])
        return new, (low, new.qpos, kinetic - jnp.asarray(gravity(slope)) @ new.qpos[:3], forces)

    start = mjx.make_data(model)
    start = start.replace(qpos=jnp.asarray([0, 0, height, 1, 0, 0, 0.0]), qvel=jnp.asarray(v, float))
    return map(np.asarray, jax.jit(lambda s: jax.lax.scan(advance, s, None, length=count)[1])(start))


def with_newton(slope: float, height: float, v, dt: float, count: int):
    """The same by Newton's solver Kamino."""
    import newton as _newton  # pyright: ignore[reportMissingImports]
    import warp as _warp  # pyright: ignore[reportMissingImports]

    newton: Any = _newton  # without types
    warp: Any = _warp
    warp.config.quiet = True
    builder = newton.ModelBuilder(gravity=tuple(gravity(slope).tolist()))
    inertia = np.diag((np.sum(SIZE**2) - SIZE**2) / 12)
    place = warp.transform((0, 0, height), warp.quat_identity())
    body = builder.add_body(xform=place, mass=1.0, inertia=warp.mat33(*inertia.ravel().tolist()), lock_inertia=True)
    material = newton.ModelBuilder.ShapeConfig(density=0.0, mu=MU)
    x, y, z = SIZE / 2
    builder.add_shape_box(body, hx=x, hy=y, hz=z, cfg=material)
    builder.add_ground_plane(cfg=material)
    model = builder.finalize(device="cpu")
    solver, control, pipeline = newton.solvers.SolverKamino(model), model.control(), newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    observed = solver.observables(["contact_f"], contacts=contacts)
    state, following = model.state(), model.state()
    state.joint_qd.assign(np.asarray(v, np.float32))
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    rows = []
    corners = np.array([SIZE / 2 * (x, y, -1) for x in (-1, 1) for y in (-1, 1)])
    for _ in range(count):
        state.clear_forces()
        pipeline.collide(state, contacts)
        solver.step(state, following, control, contacts, dt, observables=observed)
        state, following = following, state
        (place,), (speed,) = state.body_q.numpy().astype(float), state.body_qd.numpy().astype(float)
        rotation = np.asarray(jd.so3.quat_to_matrix(np.roll(place[3:], 1)))
        found = observed.contact_f.numpy()[: min(4, contacts.rigid_contact_count.numpy()[0]), :3]
        forces = np.zeros((4, 3))
        forces[: len(found)] = found * np.sign(found[:, 2:])
        # The angular velocity is in axes of the world.
        kinetic = 0.5 * speed[:3] @ speed[:3] + 0.5 * np.diag(inertia) @ (rotation.T @ speed[3:]) ** 2
        rows.append((np.min(place[2] + corners @ rotation[2]), place, kinetic - gravity(slope) @ place[:3], forces))
    return map(np.array, zip(*rows, strict=True))


def with_drake(slope: float, height: float, v, dt: float, count: int):
    """The same by Drake."""
    import pydrake.all as _drake  # pyright: ignore[reportMissingImports]

    drake: Any = _drake  # without types
    builder, radius = drake.DiagramBuilder(), 1e-3
    plant, _ = drake.AddMultibodyPlantSceneGraph(builder, dt)
    plant.set_contact_model(drake.ContactModel.kPoint)
    plant.mutable_gravity_field().set_gravity_vector(gravity(slope))
    plant.AddRigidBody("box", drake.SpatialInertia(1.0, np.zeros(3), drake.UnitInertia.SolidBox(*SIZE)))
    shapes = [(plant.world_body(), np.zeros(3), drake.HalfSpace())]
    corners = [SIZE / 2 * (x, y, -1) + (0, 0, radius) for x in (-1, 1) for y in (-1, 1)]
    shapes += [(plant.GetBodyByName("box"), at, drake.Sphere(radius)) for at in corners]
    for i, (body, at, shape) in enumerate(shapes):
        friction = drake.CoulombFriction(MU, MU)
        plant.RegisterCollisionGeometry(body, drake.RigidTransform(at), shape, f"shape {i}", friction)
    plant.Finalize()
    simulator = drake.Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetPositions(context, [1, 0, 0, 0, 0, 0, height])
    plant.SetVelocities(context, np.roll(v, 3))  # angular first
    rows = []
    for k in range(count):
        simulator.AdvanceTo(dt * (k + 1))
        results, forces, low = plant.get_contact_results_output_port().Eval(context), np.zeros((4, 3)), np.inf
        for i in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(i)
            force, low = contact.contact_force(), min(low, -contact.point_pair().depth)
            forces[i] = force * np.sign(force[2])
        energy = plant.CalcKineticEnergy(context) + plant.CalcPotentialEnergy(context)
        q = plant.GetPositions(context)
        rows.append((low, np.roll(q, 3), energy, forces))
    return map(np.array, zip(*rows, strict=True))


def quality(run, dt: float) -> dict[str, float]:
    """Measures of one program."""
    count = round(1 / dt)
    low, q, _, _ = run(0.4, SIZE[2] / 2, np.zeros(6), dt, 11 * count)
    measures = {
        "penetration at rest, m": max(0.0, -low[-1]),
        "creep in ten seconds, m": np.linalg.norm(q[-1, :3] - q[count, :3]),
    }
    low, q, _, forces = run(0.6, SIZE[2] / 2, np.zeros(6), dt, count)
    # From the second half on, where a soft contact has settled: positions of a constant acceleration.
    times = dt * np.arange(1, count + 1)
    found = 2 * np.polyfit(times[count // 2 :], q[count // 2 :, 0], 2)[0]
    normal = forces[count // 2 :, :, 2]
    excess = np.linalg.norm(forces[count // 2 :, :, :2], axis=2) - MU * normal
    measures["error of the acceleration of sliding"] = abs(found / (G * (np.sin(0.6) - MU * np.cos(0.6))) - 1)
    measures["friction beyond or below mu N while sliding, of N"] = np.abs(excess).max() / normal.sum(1).max()
    _, _, energy, _ = run(0.0, 1.0, SPIN, dt, count // 2)
    measures["change of energy in flight"] = np.ptp(energy) / energy[0]
    return measures


def main():
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dt", type=float, default=0.002)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(timing.machine())
    programs = {"jaxdyn": ours, "MuJoCo": with_mujoco}
    others = {"MJX": ("mujoco.mjx", with_mjx), "Drake": ("pydrake", with_drake), "Newton": ("newton", with_newton)}
    programs |= {name: run for name, (module, run) in others.items() if importlib.util.find_spec(module)}
    found = {name: quality(run, given.dt) for name, run in programs.items()}
    for measure in found["jaxdyn"]:
        print(f"{measure}:", ", ".join(f"{name} {measures[measure]:.1e}" for name, measures in found.items()))


if __name__ == "__main__":
    main()
