"""Time of accelerations under loops against Pinocchio's constraintDynamics.

    python -m benchmarks.constraints ["hand with a ball"] [--batch 1024] [--rounds 20]

Scenes: the redundant planar parallel manipulator (three 2R legs that carry one point), the A02 windows, N = 40, and the
three-finger hand with a ball (nine rows of three point contacts). Per method
microseconds per evaluation, best and median of the rounds, interleaved with Pinocchio in the same loop. Pinocchio is called from
Python once per sample on one core; jaxdyn uses all cores, so its time is multiplied by their number for the ratio per core.
Pinocchio closes the loops by three-dimensional point contacts, its smallest joint that fits, and solves the then dependent
rows by its proximal method (mu = 1e-10); its accelerations are compared with ours before anything is timed.
"""

import argparse
import os
import time

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin

import jaxdyn as jd
from benchmarks import timing


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


def measure(name, scene, start, batch, rounds):
    """One row per method."""
    rng = np.random.default_rng(0)
    q, v = (np.tile(np.asarray(x), (batch, 1)) for x in start)
    v = v * rng.uniform(0.5, 2.0, (batch, 1))
    tau = rng.normal(size=v.shape)
    source, contacts = to_pinocchio(scene)
    theirs = ordered(scene.system, q)
    data, held = source.createData(), pin.StdVec_RigidConstraintData()
    held.extend(contact.createData() for contact in contacts)
    pin.initConstraintDynamics(source, data, contacts, held)
    settings = pin.ProximalSettings(1e-12, 1e-10, 20)

    def peer():
        return [
            pin.constraintDynamics(source, data, a, b, c, contacts, held, settings).copy()
            for a, b, c in zip(theirs, v, tau, strict=True)
        ]

    want, inputs, calls, built = np.array(peer()), [jnp.asarray(x) for x in (q, v, tau)], {"pinocchio": peer}, {}
    for method in ("rank_aware", "schur"):
        function = jax.jit(
            jax.vmap(lambda q, v, tau, m=method: jd.constrained_dynamics(scene, q, v, tau, method=m).acceleration)
        )
        began = time.perf_counter()
        program = function.lower(*inputs).compile()
        built[method] = time.perf_counter() - began
        error = float(np.abs(np.asarray(program(*inputs)) - want).max() / np.abs(want).max())
        print(f"{name}, {method}: accelerations differ from Pinocchio's by {error:.1e} of the largest", flush=True)
        calls[method] = lambda program=program: jax.block_until_ready(program(*inputs))
    times = timing.time_interleaved(calls, rounds)
    cores = len(os.sched_getaffinity(0))
    rows = []
    for method in built:
        best, median = (times[method][key] / batch * 1e6 for key in ("best", "median"))
        peer_best, peer_median = (times["pinocchio"][key] / batch * 1e6 for key in ("best", "median"))
        rows.append(
            {
                "scene": name, "method": method, "us": [best, median], "pinocchio us": [peer_best, peer_median],
                "ratio": [best / peer_best, median / peer_median], "ratio per core": best * cores / peer_best,
                "compile s": built[method],
            }
        )  # fmt: skip
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
    manipulator = jd.scenes.parallel_manipulator(gravity=(0.0, -9.81, 0.0))
    count = options.windows
    scenes = {
        "parallel manipulator": (manipulator, jd.scenes.parallel_manipulator.start()),
        f"windows, N = {count}": (jd.scenes.windows(count=count), jd.scenes.windows.start(count=count)),
        "hand with a ball": (jd.scenes.hand_with_ball(), jd.scenes.hand_with_ball.start()),
    }
    chosen = timing.chosen_names(options.scenes, scenes)
    rows = [
        row
        for name, (scene, start) in ((name, scenes[name]) for name in chosen)
        for row in measure(name, scene, start, options.batch, options.rounds)
    ]
    print("| scene | method | jaxdyn us | Pinocchio us, one core | ratio | ratio per core | compile s |")
    print("|---|---|---|---|---|---|---|")
    for row in rows:
        ours, peer = ("{:.3g} ({:.3g})".format(*row[key]) for key in ("us", "pinocchio us"))
        print(
            f"| {row['scene']} | {row['method']} | {ours} | {peer} | {row['ratio'][0]:.2f} ({row['ratio'][1]:.2f}) | "
            f"{row['ratio per core']:.2f} | {row['compile s']:.1f} |"
        )
    print(
        "written to",
        timing.write("benchmark_constraints", {"machine": timing.machine(), "batch": options.batch, "rows": rows}),
    )


if __name__ == "__main__":
    main()
