"""MJCF files compiled by the mujoco package, with unique names of all elements, and their sensors."""

import re
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.dynamics.kinematics import named_frame
from jaxdyn.io.loaded import Names, NotTaken
from jaxdyn.io.xml_lines import XmlFile
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

FREE, BALL, SLIDE, HINGE = range(4)  # mjtJoint
SIZES = ((7, 6), (4, 3), (1, 1), (1, 1))  # sizes of q and v of each


class CompiledFile(NamedTuple):
    """Compiled file with a name for each element, named in the file or not.

    `m` is mujoco's MjModel; `bodies` (None: the world), `joints`, `sites`, `tendons` and `actuators` are named by their
    numbers in it.
    """

    path: str
    mujoco: Any
    m: Any
    bodies: list[str | None]
    joints: list[str]
    sites: list[str]
    tendons: list[str]
    actuators: list[str]

    def off(self, flag: str) -> bool:
        """Decide whether the file's <flag> disables a feature, e.g. "GRAVITY"."""
        return bool(self.m.opt.disableflags & int(getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{flag}")))


def import_mujoco():
    """MuJoCo, or an error that names its extra."""
    try:
        import mujoco
    except ImportError as error:
        raise ImportError("reading MJCF files needs mujoco: pip install jaxdyn[mjcf]") from error
    return mujoco


def compile_file(mujoco, path: str):
    """Compile a file without the assets whose files are missing; return it with a list of these."""
    # Parsed here first: mujoco also accepts URDF and fragments of other files, and its parser gives no line for malformed XML.
    file = XmlFile(path, "MJCF")
    if file.root.tag != "mujoco":
        raise file.fault(
            file.root,
            f"the root element is <{file.root.tag}>, expected <mujoco>; jd.load reads all formats",
        )
    if not file.is_utf8:
        raise ValueError(f"{path}:1: mujoco reads files in UTF-8 alone; save the file as UTF-8")
    try:
        # A spec and not a compiled model: assets of missing files can be deleted from it before compilation.
        spec = mujoco.MjSpec.from_file(path)
    except ValueError as error:
        raise ValueError(_add_location(path, error)) from error
    missing: list[str] = []
    # Each failed compilation names one missing file; the loop ends because every pass removes an asset.
    while True:
        try:
            return spec.compile(), missing
        except ValueError as error:
            # The compiler gives no error code; the file's name is in the text alone.
            name = re.search(r"[Ee]rror opening file '(.*?)'", str(error))
            if name is None or not (gone := _without_file(mujoco, spec, name[1])):
                hint = f" (already left out: {'; '.join(missing)})" if missing else ""
                raise ValueError(_add_location(path, error) + hint) from error
            missing.append(gone)


def _add_location(path: str, error: Exception) -> str:
    # mujoco's messages have several lines.
    text = " ".join(str(error).split())
    lines = re.findall(r"[Ll]ine(?: number=| )(\d+)", text)
    # The last number is that of the innermost element; 0 means an unknown line.
    where = f"{path}:{lines[-1]}" if lines and int(lines[-1]) else path
    return f"{where}: {text}"


def _without_file(mujoco, spec, name: str) -> str:
    """Delete a mesh, height field, skin or texture. Return a description of it, or "" for no such file.

    Geoms that show it become points without mass and keep their names, which sensors and contact pairs may name.
    """

    def is_it(file: str) -> bool:
        # The compiler's message has the path with the asset folder in front.
        return bool(file) and (name == file or name.replace("\\", "/").endswith("/" + file))

    for asset in [*spec.meshes, *spec.hfields]:
        if not is_it(asset.file):
            continue
        heavy = set()
        for geom in spec.geoms:
            if asset.name not in (geom.meshname, geom.hfieldname):
                continue
            # Without an explicit <inertial> the mass of this geom is lost with its shape.
            if geom.mass != 0 and not geom.parent.explicitinertial and geom.parent.name != "world":
                heavy.add(geom.parent.name or "(unnamed)")
            # The geom stays, as deleting it would break references by its name.
            geom.meshname = geom.hfieldname = ""
            geom.type, geom.size, geom.mass = mujoco.mjtGeom.mjGEOM_SPHERE, [1e-3, 0.0, 0.0], 0.0
        spec.delete(asset)
        names = ", ".join(sorted(heavy))
        return f"missing file {name!r}" + (
            f", and with it mass of bodies {names}, which state no inertia" if heavy else ""
        )
    for texture in spec.textures:
        if any(is_it(file) for file in (texture.file, *texture.cubefiles)):
            for material in spec.materials:
                # No material may refer to a texture that is deleted.
                material.textures = ["" if used == texture.name else used for used in material.textures]
            spec.delete(texture)
            return f"missing file {name!r}"
    for skin in spec.skins:
        if is_it(skin.file):
            spec.delete(skin)
            return f"missing file {name!r}"
    return ""


def assign_names(mujoco, m, path: str) -> CompiledFile:
    """Give each body and joint of a compiled file a name: its own, or one made of its kind and number."""

    def all_of(kind: str, count: int) -> list[str]:
        code = getattr(mujoco.mjtObj, f"mjOBJ_{kind}")
        return [mujoco.mj_id2name(m, code, i) or "" for i in range(count)]

    def fill_names(raw: list[str], default, taken: Names) -> list[str]:
        given = [
            taken.new(name) if name else "" for name in raw
        ]  # the file's names first, so that none of them changes
        return [name or taken.new(default(i)) for i, name in enumerate(given)]

    def joint_default(j: int) -> str:
        body = m.jnt_bodyid[j]
        # A number only where it distinguishes joints, so that common models have short names.
        several = m.body_jntnum[body] > 1
        return f"{bodies[body]}_joint{j - m.body_jntadr[body] if several else ''}"

    # Bodies and sites share one namespace, since both become frames of the model.
    frames = Names()
    bodies: list[str | None] = [None, *fill_names(all_of("BODY", m.nbody)[1:], lambda i: f"body{i + 1}", frames)]
    known = set(bodies)
    sites = [f"{site}_site" if site in known else site for site in all_of("SITE", m.nsite)]
    sites = fill_names(sites, lambda i: f"site{i}", frames)
    joints = fill_names(all_of("JOINT", m.njnt), joint_default, Names())
    tendons = fill_names(all_of("TENDON", m.ntendon), lambda i: f"tendon{i}", Names())
    names = fill_names(all_of("ACTUATOR", m.nactuator), lambda i: f"actuator{i}", Names())
    return CompiledFile(path, mujoco, m, bodies, joints, sites, tendons, names)


def pose_of(position, quaternion) -> np.ndarray:
    """Pose (4, 4) from a position and a quaternion (w, x, y, z) of any length."""
    return host_math.joint_pose("free", np.zeros(6), np.concatenate([position, quaternion]))


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


def sensors(file: CompiledFile, model: Model, touching: set[str], left: NotTaken) -> list[Sensor]:
    """The sensors of a file; `touching`: bodies with contacts."""
    m, mujoco, taken = file.m, file.mujoco, []
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
            left.add("volume of touch sensors", [name])
        if sensor is None:
            left.add("sensors", [name])
            continue
        taken.append(sensor)
        # The sensor is taken without its clipping, and a warning says so.
        if m.sensor_cutoff[i] > 0:
            left.add("cutoff of sensors", [name])
        if getattr(m, "sensor_interval", np.zeros((m.nsensor, 1)))[i].any():
            left.add("interval of sensors", [name])
    return taken


def _sensor(file: CompiledFile, model: Model, i: int, kind: str, options: dict) -> Sensor | None:
    m = file.m
    place = int(m.sensor_objid[i])
    if kind in _ON_JOINTS:
        return _ON_JOINTS[kind](file.joints[place], **options)
    on = file.mujoco.mjtObj(int(m.sensor_objtype[i])).name
    # mjOBJ_BODY is the inertial frame, which has no name in the model; XBODY is the body's own.
    frame = {"mjOBJ_SITE": file.sites, "mjOBJ_XBODY": file.bodies}.get(on, {place: None})[place]
    # A reference frame (refid) makes the reading relative, which these sensors do not support.
    if kind in _ON_FRAMES and frame is not None and m.sensor_refid[i] < 0:
        of, more = _ON_FRAMES[kind]
        return of(frame, **more, **options)
    if kind in _WRENCHES and frame is not None:
        mount = _mount(file, model, int(m.site_bodyid[place]))
        return None if mount is None else ForceTorque(frame, part=_WRENCHES[kind], **mount, **options)
    return None


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
