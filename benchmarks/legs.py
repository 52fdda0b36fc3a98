"""Robots with legs against Pinocchio: a quadruped held on four feet, and the quadratic program of its whole body.

    python -m benchmarks.legs [--batch 1024] [--rounds 20]

Solo12 of example-robot-data, crouched, 18 velocities, 12 rows. Accelerations of `jd.constrained_dynamics` and of Pinocchio's
`constraintDynamics` (three-dimensional contacts, called from Python once a sample on one core) are compared before they are
timed, interleaved in one run. jaxdyn uses all cores: its time is multiplied by their number for the ratio per core. The
program is `jd.control.underactuated_inverse_dynamics`: 12 forces in four cones, batched.
"""

import argparse
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin

import jaxdyn as jd
from benchmarks import timing

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")


def solo():
    """Our model, Pinocchio's, and a crouched configuration: positions and unit quaternion (w first here, last there), joints."""
    folder = Path(pin.__file__).parents[4] / "share" / "example-robot-data" / "robots"
    path = next(folder.rglob("solo12.urdf"))
    model = jd.load_model(str(path), floating_base=True)
    source = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
    q = np.array(jd.neutral(model))
    for name, part in zip(model.joint_names, model.topology.q_slices, strict=True):
        if "HFE" in name or "KFE" in name:
            q[part] = 0.8 if "HFE" in name else -1.6
    return model, source, q


def states(model, q, batch):
    """Configurations near q, at rest, with torques of the motors."""
    rng = np.random.default_rng(0)
    qs = np.tile(q, (batch, 1))
    qs[:, 7:] += 0.05 * rng.normal(size=(batch, q.size - 7))
    tau = rng.normal(size=(batch, model.nv))
    tau[:, :6] = 0.0
    return qs, np.zeros((batch, model.nv)), tau


def to_pinocchio(model, source, qs, tau):
    """Orders of joints and of the quaternion there."""
    there, pushed = np.tile(pin.neutral(source), (len(qs), 1)), np.zeros_like(tau)
    there[:, :3], there[:, 3:6], there[:, 6] = qs[:, :3], qs[:, 4:7], qs[:, 3]
    for name, at, rate in zip(model.joint_names, model.topology.q_slices, model.topology.v_slices, strict=True):
        if at.stop - at.start == 1:
            joint = source.joints[source.getJointId(name)]
            there[:, joint.idx_q] = qs[:, at.start]
            pushed[:, joint.idx_v] = tau[:, rate.start]
    return there, pushed


def peer(source, qs, tau):
    """A call of Pinocchio for the whole batch."""
    contacts = pin.StdVec_RigidConstraintModel()
    for foot in FEET:
        frame = source.frames[source.getFrameId(foot, pin.FrameType.BODY)]
        contacts.append(
            pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, source, frame.parentJoint, frame.placement)
        )
    data, held = source.createData(), pin.StdVec_RigidConstraintData()
    held.extend([one.createData() for one in contacts])
    pin.initConstraintDynamics(source, data, contacts, held)
    settings, at_rest = pin.ProximalSettings(1e-12, 0.0, 1), np.zeros(source.nv)

    def call():
        return [
            pin.constraintDynamics(source, data, q, at_rest, pushed, contacts, held, settings).copy()
            for q, pushed in zip(qs, tau, strict=True)
        ]

    return call


def main(argv=None) -> None:
    """Measure, print, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    model, source, q = solo()
    cone = jd.contact.friction_cone("hard-finger", mu=0.6)
    feet = [jd.control.foot(name, cone) for name in FEET]
    scene = jd.Scene(model, [one.hold(model, jnp.asarray(q)) for one in feet])
    qs, vs, tau = states(model, q, options.batch)
    inputs = [jnp.asarray(x) for x in (qs, vs, tau)]
    at_rest = jnp.zeros(model.nv)

    def accelerations(q, v, tau):
        return jd.constrained_dynamics(scene, q, v, tau).acceleration

    def program(q, v, tau):
        computed = jd.control.underactuated_inverse_dynamics(model, q, v, at_rest, feet)
        return computed.tau, computed.forces, computed.success

    ours = jax.jit(jax.vmap(accelerations))
    there = peer(source, *to_pinocchio(model, source, qs, tau))
    # Orders of joints differ; the base's first six velocities do not.
    want, got = np.array(there())[:, :6], np.asarray(ours(*inputs))[:, :6]
    print(f"accelerations of the base differ by {np.abs(got - want).max() / np.abs(want).max():.1e} of the largest")
    whole = jax.jit(jax.vmap(program))
    solved = whole(*inputs)[2]
    print(f"{int(solved.sum())} of {options.batch} programs solved")
    calls = {
        "constrained_dynamics": lambda: jax.block_until_ready(ours(*inputs)),
        "constraintDynamics": there,
        "underactuated_inverse_dynamics": lambda: jax.block_until_ready(whole(*inputs)),
    }
    times = timing.time_alternately(calls, options.rounds)
    cores, rows = len(os.sched_getaffinity(0)), {}
    for name, computed in times.items():
        rows[name] = [computed[key] / options.batch * 1e6 for key in ("best", "median")]
        print(f"{name:32s} {rows[name][0]:8.2f} us a sample, best ({rows[name][1]:.2f} median)")
    ours_us, there_us = rows["constrained_dynamics"], rows["constraintDynamics"]
    print(
        f"ratio per core: {cores * ours_us[0] / there_us[0]:.2f} ({cores * ours_us[1] / there_us[1]:.2f}), {cores} cores"
    )
    print(
        "written to", timing.write("benchmark_legs", {"machine": timing.machine(), "batch": options.batch, "us": rows})
    )


if __name__ == "__main__":
    main()
