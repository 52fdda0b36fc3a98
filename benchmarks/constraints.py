"""Cost of constraints: accelerations, projections, gradients and steps of mechanisms with loops, alone and in batches.

    python -m benchmarks.constraints ["four-bar in space"] [--batch 1024] [--rounds 20] [--windows 40]

Microseconds a sample under `jit`, best of the rounds, interleaved with Pinocchio's `constraintDynamics` and `lcaba`, which are
called from Python once per sample on one core; jaxdyn has both cores in a batch. The scene is known to the program, as in a
control loop. Pinocchio closes loops by three-dimensional point contacts, its smallest joint that fits, and solves the then
dependent rows by its proximal method. Its accelerations are compared with ours: "wrong" where they differ by more than 1e-6.
Exudyn, where the Python of EXUDYN_PYTHON (by default this one) can import it, makes 50 implicit steps of mechanisms in a plane.
"held": a scene with its choice of rows (`jd.constraints.choose_rows`); the file of that robot has few digits, so that the rows
are searched in each call without it.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin

import jaxdyn as jd
from benchmarks import timing
from benchmarks.first_calls import robot_file
from benchmarks.overconstrained import tilted_four_bar

CASSIE = "cassie_description/robots/cassie_v2.sdf"


def to_pinocchio(scene):
    """Joints, bodies and point contacts of a scene of revolute and free joints; the orders are the same."""
    model, source = scene.system, pin.Model()
    homes, numbers, screws = (np.asarray(x, float) for x in (model.home, model.inertias, model.screws))
    for i, parent in enumerate(model.topology.parents):
        place = pin.SE3(homes[i][:3, :3], homes[i][:3, 3])
        axis = screws[i][3:]
        kind = pin.JointModelRZ() if axis[2] == 1 else pin.JointModelRevoluteUnaligned(axis)
        if model.topology.kinds[i] == "free":
            kind = pin.JointModelFreeFlyer()
        joint = source.addJoint(parent + 1, kind, place, model.joint_names[i])
        m, first, (xx, xy, yy, xz, yz, zz) = numbers[i][0], numbers[i][1:4], numbers[i][4:]
        c = first / m
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) - m * (c @ c * np.eye(3) - np.outer(c, c))
        source.appendBodyToJoint(joint, pin.Inertia(m, c, about), pin.SE3.Identity())
    source.gravity.linear = np.zeros(3) if model.gravity is None else np.asarray(model.gravity, float)
    contacts = pin.StdVec_RigidConstraintModel()
    for constraint in scene.constraints:
        ends = []
        for name, pose in constraint.ends():
            index = model.frame_names.index(name)
            pose = np.asarray(model.frame_poses[index], float) @ np.asarray(pose, float)
            ends += [model.topology.frame_bodies[index] + 1, pin.SE3(pose[:3, :3], pose[:3, 3])]
        contacts.append(pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, source, *ends, pin.ReferenceFrame.LOCAL))
    return source, contacts


def ordered(model, q):
    """Configurations (n, nq) with the scalar of each quaternion last, as Pinocchio has it."""
    order = []
    for kind, place in zip(model.topology.kinds, model.topology.q_slices, strict=True):
        entries = list(range(place.start, place.stop))
        order += entries[:3] + entries[4:] + entries[3:4] if kind == "free" else entries
    return q[:, order]


def mechanisms(windows: int) -> dict:
    """Functions that give a scene with a state on its constraints."""

    def of(named, **parameters):
        return lambda: (named(**parameters), *named.start(**{k: x for k, x in parameters.items() if k == "count"}))

    def robot(is_held: bool):
        scene = jd.load(robot_file(CASSIE), floating_base=True)
        stands = jd.assemble(scene, scene.starts["reference"].q).q
        return jd.constraints.choose_rows(scene, stands) if is_held else scene, stands, jnp.zeros(scene.nv)

    return {
        "four-bar in the plane": of(jd.scenes.four_bar),
        "four-bar in space": lambda: (tilted_four_bar().scene, *jd.scenes.four_bar.start()),
        "three legs on one point": of(jd.scenes.parallel_manipulator, gravity=(0.0, -9.81, 0.0)),
        "ring of 30 bars": of(jd.scenes.closed_ring, count=30),
        f"{windows} windows": of(jd.scenes.windows, count=windows),
        "hand with a ball": of(jd.scenes.hand_with_ball),
        "robot with four loops": lambda: robot(False),
        "robot with four loops, held": lambda: robot(True),
    }


def torques(scene: jd.Scene) -> np.ndarray:
    """Any torques: without them some of the scenes hardly accelerate."""
    return np.cos(np.arange(scene.nv))


def functions(scene: jd.Scene) -> dict:
    """What is timed, of one sample."""
    times = jnp.asarray([0.0, 0.05])

    def accelerate(q, v):
        return jd.constrained_dynamics(scene, q, v, torques(scene)).acceleration

    return {
        "acceleration": accelerate,
        "projection": lambda q, v: jd.constraints.projections(scene, q).P_T,
        "gradient": jax.grad(lambda q, v: jnp.sum(accelerate(q, v)), 1),
        "50 steps of RK4": lambda q, v: jd.simulate(scene, q, v, times, stepsize=1e-3, throw=False).q[-1],
    }


def peers(scene: jd.Scene, q, v) -> dict:
    """Pinocchio's two functions for one state, called from Python; empty for joints that it has no converter for here."""
    if not set(scene.system.topology.kinds) <= {"revolute", "continuous", "free"}:
        return {}
    source, contacts = to_pinocchio(scene)
    data, other, held = source.createData(), source.createData(), pin.StdVec_RigidConstraintData()
    held.extend(contact.createData() for contact in contacts)
    pin.initConstraintDynamics(source, data, contacts, held)
    pin.computeJointMinimalOrdering(source, other, contacts)
    q, v, tau = ordered(scene.system, np.asarray(q)[None])[0], np.asarray(v), torques(scene)
    settings = pin.ProximalSettings(1e-12, 1e-10, 20)
    # Its most accurate setting here: with a smaller mu it loses digits to rounding.
    other_settings = pin.ProximalSettings(1e-14, 1e-4, 50)
    return {
        "constraintDynamics": lambda: pin.constraintDynamics(source, data, q, v, tau, contacts, held, settings).copy(),
        "lcaba": lambda: pin.lcaba(source, other, q, v, tau, contacts, held, other_settings).copy(),
    }


def exudyn_steps(scene: jd.Scene, q, v, rounds: int) -> tuple[float, float] | None:
    """Seconds of 50 steps of Exudyn, and the distance of its bodies from ours; None where it is missing, or has no converter."""
    model = scene.system
    python = os.environ.get("EXUDYN_PYTHON", sys.executable)
    planar = all(getattr(x, "in_plane", False) and x.joint == "revolute" for x in scene.constraints)
    has_exudyn = subprocess.run([python, "-c", "import exudyn"], capture_output=True).returncode == 0
    if not (planar and has_exudyn and set(model.topology.kinds) <= {"revolute", "continuous"}):
        return None
    names, bodies, joints = model.body_names, [], []
    poses = [np.asarray(jd.frame_pose(model, q, name), float) for name in names]
    for i, (name, pose) in enumerate(zip(names, poses, strict=True)):
        m, first, (xx, xy, yy, xz, yz, zz) = (*np.split(np.asarray(model.inertias[i], float), [1, 4]),)
        c = first / m
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) - m * (c @ c * np.eye(3) - np.outer(c, c))
        twist = np.asarray(jd.frame_velocity(model, q, v, name), float)
        body = {"mass": float(m[0]), "com": c, "inertia": about, "position": pose[:3, 3], "rotation": pose[:3, :3]}
        bodies.append(body | {"velocity": twist[:3], "omega": twist[3:]})
        place = {"position": pose[:3, 3], "rotation": pose[:3, :3], "axes": [1, 1, 1, 1, 1, 0]}
        joints.append({"body": i, "parent": model.topology.parents[i]} | place)
    for loop in scene.constraints:
        (a, _), (b, at) = loop.ends()
        place = poses[names.index(b)] @ np.asarray(at, float)
        joint = {"body": names.index(b), "parent": names.index(a) if a else -1, "axes": [1, 1, 0, 0, 0, 0]}
        joints.append(joint | {"position": place[:3, 3], "rotation": place[:3, :3]})
    gravity = np.zeros(3) if model.gravity is None else np.asarray(model.gravity, float)
    mechanism = {"bodies": bodies, "joints": joints, "gravity": gravity, "steps": 50, "time": 0.05, "rounds": rounds}
    given = json.dumps(mechanism, default=lambda x: x.tolist())
    command = [python, str(Path(__file__).parent / "peers" / "with_exudyn.py")]
    found = json.loads(subprocess.run(command, input=given, stdout=subprocess.PIPE, text=True, check=True).stdout)
    end = jd.simulate(scene, q, v, jnp.asarray([0.0, 0.05]), stepsize=1e-3).q[-1]
    ours = np.array([jd.frame_pose(model, end, name)[:3, 3] for name in names])
    return found["seconds"], float(np.abs(ours - np.array(found["positions"])).max())


def measure(name: str, scene, q, v, batch: int, rounds: int) -> list[dict]:
    """One row for a single call, and one for a batch."""
    rows, theirs = [], {} if "held" in name else peers(scene, q, v)
    want = np.asarray(jd.constrained_dynamics(scene, q, v, torques(scene)).acceleration)
    differences = {peer: float(np.abs(call() - want).max() / np.abs(want).max()) for peer, call in theirs.items()}
    print(f"{name}: differences from Pinocchio's accelerations {differences}", flush=True)
    for count in (1, batch):
        calls: dict = dict(theirs) if count == 1 else {}
        for title, function in functions(scene).items():
            run = jax.jit(function if count == 1 else jax.vmap(function))
            state = (q, v) if count == 1 else (jnp.tile(q, (count, 1)), jnp.tile(v, (count, 1)))
            jax.block_until_ready(run(*state))
            calls[title] = lambda run=run, state=state: jax.block_until_ready(run(*state))
        times = timing.time_alternately(calls, rounds)
        if count == 1 and "held" not in name and (found := exudyn_steps(scene, q, v, rounds)):
            print(f"{name}: positions after 50 steps of Exudyn differ by {found[1]:.1e} m", flush=True)
            calls["Exudyn, 50 steps"], times["Exudyn, 50 steps"] = None, {"best": found[0]}
        rows.append(
            {"differences": differences}
            | {"scene": name, "batch": count}
            | {x: times[x]["best"] / count * 1e6 for x in calls}
        )
    return rows


def main(argv=None):
    """Measure, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="by default all")
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--windows", type=int, default=40)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    scenes, rows = mechanisms(options.windows), []
    for name in timing.chosen_names(options.scenes, scenes):
        batch = min(options.batch, 256) if "robot" in name else options.batch
        rows += measure(name, *scenes[name](), batch, options.rounds)
    columns = [
        "acceleration",
        "constraintDynamics",
        "lcaba",
        "projection",
        "gradient",
        "50 steps of RK4",
        "Exudyn, 50 steps",
    ]
    print(f"| us a sample | batch | {' | '.join(columns)} |\n|---|---|{'---|' * len(columns)}")
    for row in rows:
        cells = (
            "" if column not in row else f"{row[column]:.3g}" if row["differences"].get(column, 0) < 1e-6 else "wrong"
            for column in columns
        )
        print(f"| {row['scene']} | {row['batch']} | {' | '.join(cells)} |")
    print("written to", timing.write("benchmark_constraints", {"machine": timing.machine(), "rows": rows}))


if __name__ == "__main__":
    main()
