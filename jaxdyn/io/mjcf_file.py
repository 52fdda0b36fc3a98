"""MJCF files compiled by the mujoco package, with unique names of all elements."""

import re
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.io.chains import Names
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import host_math

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
            f"the root element is <{file.root.tag}>, expected <mujoco>; load_urdf and load_sdf read those formats",
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
