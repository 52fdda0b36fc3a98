"""Inertias of an arm fitted by mujoco.sysid: the same numbers, log and squared errors as `benchmarks.identify_peers` gives ours.

Torques are compared by `mj_inverse` at every sample, as its rollouts have no inverse dynamics; motion by its own rollouts in C.
"""

import contextlib
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from mujoco import sysid

from jaxdyn.io import save_urdf


class TimeOut(Exception):
    """A fit ran past its limit."""


def specification(model, step: float) -> mujoco.MjSpec:
    """The arm in MuJoCo, with a motor and sensors for each joint, RK4 steps, no contacts and no limits."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        save_urdf(model, path)
        spec = mujoco.MjSpec.from_file(str(path))
    spec.option.integrator, spec.option.timestep = mujoco.mjtIntegrator.mjINT_RK4, step
    spec.option.gravity = np.asarray(model.gravity)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    for name in model.joint_names:
        spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    kinds = (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL)
    for kind, label in zip(kinds, "qv", strict=True):
        for name in model.joint_names:
            spec.add_sensor(name=f"{label} {name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=name)
    return spec


def parameters(spec: mujoco.MjSpec, bodies: Sequence[str]) -> sysid.ParameterDict:
    """Ten numbers of each body, by its log-Cholesky coordinates, within the bounds of sysid."""
    model, free = spec.compile(), sysid.ParameterDict()
    for body in bodies:

        def change(spec, param, body=body):
            sysid.apply_body_inertia(spec, body, param)
            spec.body(body).iquat[:] = (1.0, 0.0, 0.0, 0.0)  # NaN there, which sysid leaves, is refused by MuJoCo 4.0

        free.add(sysid.body_inertia_param(spec, model, body, sysid.InertiaType.Pseudo, modifier=change))
    return free


def joint_parameters(spec: mujoco.MjSpec, joints: Sequence[str], sizes: np.ndarray) -> list[sysid.Parameter]:
    """Viscous and Coulomb friction and rotor inertia of each joint, and its offset, which `torque_residual` adds.

    `sizes` (2, nv): root mean square of velocities and of torques, by which the bounds are set.
    """
    free = []
    for k, (joint, speed, torque) in enumerate(zip(joints, *sizes, strict=True)):

        def change(spec, param, joint=joint):
            place = spec.joint(joint)
            place.damping[0], place.frictionloss, place.armature = param.value

        most = np.array([torque / speed, torque, torque / speed])
        free.append(sysid.Parameter(f"joint {joint}", 0.05 * most, 1e-6 * most, most, modifier=change))
        free.append(sysid.Parameter(f"offset {k}", 0.0, -torque, torque))
    return free


def torque_residual(spec: mujoco.MjSpec, log, scale: np.ndarray):
    """Errors of the torques along a log, over `scale` (nv,); parameters "offset 0" and so on are added to the torques."""
    model = spec.compile()
    padded = np.concatenate([log.q, log.v], axis=1)
    start = sysid.create_initial_state(model, log.q[0], log.v[0])
    names = [sensor.name for sensor in spec.sensors]
    measured = sysid.TimeSeries.from_names(log.t, padded, model, names)
    sequence = sysid.ModelSequences(
        "arm", spec, "log", start, sysid.TimeSeries.from_control_names(log.t, log.tau, model), measured
    )

    def timed(torques):
        return np.concatenate([np.asarray(log.t)[:, None], torques], axis=1)

    def rollout(models, datas, control_signal, initial_states, param_dicts, **mappings):
        return [
            sysid.SystemTrajectory(
                one, control, measured, initial, sysid.TimeSeries(log.t, timed(inverse(one, datas[0], log)), None)
            )
            for one, control, initial in zip(models, control_signal, initial_states, strict=True)
        ]

    def residual(params, predicted, measured, model, return_pred_all, state, **_):
        offset = np.array(
            [params[f"offset {k}"].value[0] if f"offset {k}" in params else 0.0 for k in range(len(scale))]
        )
        return (state[:, 1:] + offset - log.tau) / scale[None], measured, measured

    return sysid.build_residual_fn(
        models_sequences=[sequence], custom_rollout=rollout, modify_residual=residual, resample_true=False
    )


def inverse(model: mujoco.MjModel, data: mujoco.MjData, log) -> np.ndarray:
    """Torques (n, nv) that the arm needs along a log."""
    torques = np.empty((len(log), model.nv))
    for i, (q, v, a) in enumerate(zip(log.q, log.v, log.a, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(model, data)
        torques[i] = data.qfrc_inverse
    return torques


def predicted(spec: mujoco.MjSpec, free: sysid.ParameterDict, log) -> np.ndarray:
    """Torques (n, nv) along a log with the values of the parameters."""
    model = sysid.apply_param_modifiers(free, spec.copy())
    torques = inverse(model, mujoco.MjData(model), log)
    return torques + np.array([free[f"offset {k}"].value[0] for k in range(model.nv)])


def motion_residual(spec: mujoco.MjSpec, pieces, scale: np.ndarray):
    """Errors of the motion of pieces t (pieces, n), q, v, tau, over `scale` (2, nv); a torque is held for a step."""
    model = spec.compile()
    names = [sensor.name for sensor in spec.sensors]
    parts = [(t - t[0], q, v, tau) for t, q, v, tau in zip(*pieces, strict=True)]
    sequence = sysid.ModelSequences(
        "arm",
        spec,
        [f"piece {i}" for i in range(len(parts))],
        [sysid.create_initial_state(model, q[0], v[0]) for _, q, v, _ in parts],
        [sysid.TimeSeries.from_control_names(t, tau, model) for t, _, _, tau in parts],
        [sysid.TimeSeries.from_names(t, np.concatenate([q, v], axis=1), model, names) for t, q, v, _ in parts],
    )
    unit = scale.reshape(-1)

    def residual(params, predicted, measured, model, return_pred_all, state, **_):
        return (state[:, 1 : 1 + len(unit)] - measured.data[1:]) / unit[None], measured, measured

    # One sequence of pieces of equal length goes to its rollout in C at once.
    one = sysid.ModelSequences("arm", spec, [], [], [], [])
    one.measured_rollout = [sequence.measured_rollout]  # pyright: ignore[reportAttributeAccessIssue]
    return sysid.build_residual_fn(models_sequences=[one], modify_residual=residual, resample_true=False)


def fitted(
    residual, free: sysid.ParameterDict, limit: float, clock=time.perf_counter
) -> tuple[list[tuple[float, float]], str]:
    """(seconds since the start, sum of squares) at every single point tried, and how it ended; `free` gets the best point."""
    begun, path, points = clock(), [], []

    def watched(x, params, **options):
        if clock() - begun > limit:
            raise TimeOut
        result = residual(x, params, **options)
        if np.ndim(x) == 2:
            # Errors of pieces that were rolled out at once come beside each other; the optimiser wants them in one column.
            columns = [part.reshape(len(part), np.shape(x)[1], -1) for part in result[0]]
            result = ([part.transpose(2, 0, 1).reshape(-1, np.shape(x)[1]) for part in columns], *result[1:])
        if np.ndim(x) == 1 or np.shape(x)[1] == 1:
            path.append((clock() - begun, float(sum(np.sum(part**2) for part in result[0]))))
            points.append(np.ravel(x).copy())
        return result

    def end(words: str) -> tuple[list[tuple[float, float]], str]:
        free.update_from_vector(points[int(np.argmin([loss for _, loss in path]))])
        return path, words

    try:
        # Its printed progress would be among the rows of a table.
        with contextlib.redirect_stdout(sys.stderr):
            sysid.optimize(free, watched, optimizer="mujoco", verbose=False, **{"max_iters": 200})
    except TimeOut:
        return end(f"not finished in {limit:.0f} s")
    return end(f"finished after {clock() - begun:.1f} s")
