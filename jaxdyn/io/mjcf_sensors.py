"""Sensors of MJCF files: those on frames and joints, force and torque at a site, and touch."""

from typing import Any

import numpy as np

from jaxdyn.dynamics.kinematics import named_frame
from jaxdyn.io.loaded import summarize
from jaxdyn.io.mjcf_file import CompiledFile, pose_of
from jaxdyn.model import host_math
from jaxdyn.model.tree import Model
from jaxdyn.sensors import (
    Accelerometer,
    Encoder,
    ForceTorque,
    FramePose,
    FrameVelocity,
    Gyroscope,
    Noise,
    Sensor,
    Tachometer,
    Touch,
    Velocimeter,
)

# By the names of mjtSensor, less mjSENS_.
_ON_FRAMES: dict[str, tuple[Any, dict]] = {
    "ACCELEROMETER": (Accelerometer, {}),
    "GYRO": (Gyroscope, {}),
    "VELOCIMETER": (Velocimeter, {}),
    "FRAMEPOS": (FramePose, {"part": "position"}),
    "FRAMEQUAT": (FramePose, {"part": "orientation"}),
    "FRAMELINVEL": (FrameVelocity, {"part": "linear"}),
    "FRAMEANGVEL": (FrameVelocity, {"part": "angular"}),
}
_ON_JOINTS = {"JOINTPOS": Encoder, "BALLQUAT": Encoder, "JOINTVEL": Tachometer, "BALLANGVEL": Tachometer}
_WRENCHES = {"FORCE": "force", "TORQUE": "torque"}


def sensors(file: CompiledFile, model: Model, touching: set[str]) -> tuple[tuple[Sensor, ...], list[str]]:
    """The sensors of a file, and descriptions of those that are not taken; `touching`: bodies with contacts."""
    m, mujoco = file.m, file.mujoco
    taken, left, clipped, sampled, touch = [], [], [], [], []
    for i in range(m.nsensor):
        name = mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_SENSOR, i) or f"sensor{i}"
        kind = mujoco.mjtSensor(int(m.sensor_type[i])).name.removeprefix("mjSENS_")
        # Older releases of mujoco have no delay of sensors.
        late = getattr(m, "sensor_delay", np.zeros(m.nsensor))[i]
        noise = Noise(float(m.sensor_noise[i])) if m.sensor_noise[i] > 0 else None
        options: dict = {"name": name, "noise": noise, "delay": float(max(late, 0.0))}
        sensor = _sensor(file, model, i, kind, options)
        if kind == "TOUCH" and file.bodies[m.site_bodyid[m.sensor_objid[i]]] in touching:
            # All contacts of the body count, wherever they are.
            sensor = Touch(file.sites[m.sensor_objid[i]], **options)
            touch.append(name)
        if sensor is None:
            left.append(name)
            continue
        taken.append(sensor)
        # The sensor is taken without its clipping, and a warning says so.
        if m.sensor_cutoff[i] > 0:
            clipped.append(name)
        if getattr(m, "sensor_interval", np.zeros((m.nsensor, 1)))[i].any():
            sampled.append(name)
    more = [*summarize("cutoff of sensors", clipped), *summarize("interval of sensors", sampled)]
    more += summarize("volume of touch sensors", touch)
    return tuple(taken), [*summarize("sensors", left), *more]


def _sensor(file: CompiledFile, model: Model, i: int, kind: str, options: dict) -> Sensor | None:
    m = file.m
    place = int(m.sensor_objid[i])
    if kind in _ON_JOINTS:
        return _ON_JOINTS[kind](file.joints[place], **options)
    frame = _frame(file, i)
    # A reference frame (refid) makes the reading relative, which these sensors do not support.
    if kind in _ON_FRAMES and frame is not None and m.sensor_refid[i] < 0:
        of, more = _ON_FRAMES[kind]
        return of(frame, **more, **options)
    if kind in _WRENCHES and frame is not None:
        mount = _mount(file, model, int(m.site_bodyid[place]))
        return None if mount is None else ForceTorque(frame, part=_WRENCHES[kind], **mount, **options)
    return None


def _frame(file: CompiledFile, i: int) -> str | None:
    """The frame that a sensor is on: a site, or a body with its own frame."""
    kind, place = file.mujoco.mjtObj(int(file.m.sensor_objtype[i])).name, int(file.m.sensor_objid[i])
    if kind == "mjOBJ_SITE":
        return file.sites[place]
    # mjOBJ_BODY is the inertial frame, which has no name in the model; XBODY is the body's own.
    return file.bodies[place] if kind == "mjOBJ_XBODY" else None


def _mount(file: CompiledFile, model: Model, body: int) -> dict | None:
    """Bodies and joints beyond the weld of a body; empty where the body has a joint, None where it is fixed to the ground."""
    m = file.m
    if m.body_jntnum[body]:
        return {}
    carrier, pose = body, np.eye(4)
    # Bodies without joints are welded, and the model has merged them into the next body that moves.
    while not m.body_jntnum[carrier]:
        if carrier == 0:
            return None
        pose = pose_of(m.body_pos[carrier], m.body_quat[carrier]) @ pose
        carrier = int(m.body_parentid[carrier])
    parameters, joints = np.zeros(10), []
    poses = {body: pose}
    # Parents have smaller numbers, so that one pass visits the subtree from the root outwards.
    for b in range(body, m.nbody):
        if b != body and m.body_parentid[b] not in poses:
            continue
        if b != body and m.body_jntnum[b]:
            # The first joint of a moving body carries all that is beyond it.
            joints.append(file.joints[m.body_jntadr[b]])
            continue
        if b != body:
            poses[b] = poses[int(m.body_parentid[b])] @ pose_of(m.body_pos[b], m.body_quat[b])
        inertial = poses[b] @ pose_of(m.body_ipos[b], m.body_iquat[b])
        turn = inertial[:3, :3]
        moment = turn @ np.diag(m.body_inertia[b]) @ turn.T
        parameters = parameters + host_math.inertia_numbers(
            (m.body_mass[b], inertial[:3, 3], moment), "inertia of a body"
        )
    # A joint beside the body's origin has put the model's body frame there.
    _, offset = named_frame(model, file.bodies[carrier])
    # Forces on bodies before the weld do not load it, although the model has merged them with those beyond.
    frames = [file.bodies[b] for b in poses]
    frames += [site for site, b in zip(file.sites, m.site_bodyid, strict=True) if int(b) in poses]
    return {
        "inertia": host_math.move_inertia(np.asarray(offset, float), parameters),
        "joints": joints,
        "frames": frames,
    }
