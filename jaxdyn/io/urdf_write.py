"""URDF writer, whose files load as the same model, and atomic writes of files."""

import contextlib
import os
import pathlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from jaxdyn.io.loaded import Names
from jaxdyn.io.urdf import NO_LIMIT, ROOT_JOINT
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import host_math
from jaxdyn.model.arguments import as_path, check_known, check_shapes, parse_number
from jaxdyn.model.tree import Model


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[pathlib.Path]:
    """Temporary path with the folder and suffix of `path`; at the end of the block it replaces `path`.

    When the block raises, the temporary file is removed and an existing file stays.
    """
    path = pathlib.Path(path)
    # The process id keeps two processes that write the same file apart.
    # The same folder, since a rename is atomic within one file system only; the same suffix, since writers infer the format.
    part = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield part
        # os.rename fails on Windows where the target exists.
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a UTF-8 text atomically."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


_TYPES = {"free": "floating", **{kind: kind for kind in ("revolute", "continuous", "prismatic", "planar")}}


class _Edge(NamedTuple):
    """Joint to be written: of body `body`, or a fixed one of a frame (None)."""

    joint: str
    parent: str
    child: str
    pose: np.ndarray
    body: int | None


def save_urdf(
    model: Model, path: str | os.PathLike, *, torques: Mapping[str, Mapping[str, float]] | None = None
) -> None:
    """Write a model as a URDF file; `load_model` returns the same model, to rounding.

    Bodies become links, other frames become links on fixed joints; merged links stay merged. A single root body on
    a free joint "root_joint" becomes the root link (load it with `floating_base=True`); otherwise the root is a frame
    that coincides with the world's, or a new link "world". Siblings that are not sorted by joint name
    are attached to frames of their parent, or to added ones "..._carrier". Couplings become `<mimic>` (load with
    `mimic="couple"`), armature an attribute of `<dynamics>`, next to damping and friction, which are written as zero where the
    model has none; gravity is not written. Infinite limits are
    written as the largest double, because other readers refuse "inf".

    `torques`: additional torque parameters by joint name, which URDF lacks, as {"shoulder": {"offset": 0.3}}. They go into
    an element `<jaxdyn>` below `<robot>`, which other readers ignore; `jd.io.read_torque_terms` reads them.

    **Raises:** ValueError naming the joint or body for features that URDF cannot express: helical and spherical joints, screws
    that are not of unit length, limits of planar and free joints, friction or armature that differs between the directions of
    one joint, first moments without mass; for `torques` of joints that the model does not have, or numbers that are not finite.
    OSError when the file cannot be written.
    """
    check_known("save_urdf", model=model)
    check_shapes(model)
    path = as_path(path)
    root, edges = _edges(model)
    inertias = dict(zip(model.body_names, np.asarray(model.inertias, np.float64), strict=True))
    robot = ET.Element("robot", name=model.name)
    for link in (root, *(edge.child for edge in edges)):
        _write_link(robot, link, inertias.get(link))
    for edge in edges:
        _write_joint(robot, model, edge)
    if torques:
        _write_torques(robot, model, torques)
    ET.indent(robot)
    # An interrupted write must not leave half a file in the place of a good one.
    with replacing(path) as part:
        ET.ElementTree(robot).write(part, encoding="utf-8", xml_declaration=True)


def read_torque_terms(path: str | os.PathLike) -> dict[str, dict[str, float]]:
    """Read the additional torque parameters that `save_urdf` wrote; empty where the file has none.

    **Raises:** ValueError with file and line for malformed XML, or an invalid number, with the joint.
    """
    file = XmlFile(path, "URDF")
    result: dict[str, dict[str, float]] = {}
    for joint in file.root.iterfind("jaxdyn/joint"):
        numbers = dict(joint.attrib)
        name = numbers.pop("name", "")
        try:
            result[name] = {key: parse_number(value) for key, value in numbers.items()}
        except ValueError as error:
            raise file.fault(joint, f"<jaxdyn> of joint {name!r}: {error}") from None
    return result


def _write_torques(robot: ET.Element, model: Model, torques: Mapping[str, Mapping[str, float]]) -> None:
    unknown = sorted(set(torques) - set(model.joint_names))
    if unknown:
        raise ValueError(
            f"torques: {', '.join(unknown)} are no joints of {model.name!r}: {', '.join(model.joint_names)}"
        )
    element = ET.SubElement(robot, "jaxdyn")
    for joint, numbers in torques.items():
        values = {name: float(value) for name, value in numbers.items()}
        # `read_torque_terms` would read NaN and infinity back without an error.
        if not np.isfinite(list(values.values())).all():
            raise ValueError(f"torques of joint {joint!r} are {values}; they must be finite")
        ET.SubElement(element, "joint", {"name": joint, **{name: repr(value) for name, value in values.items()}})


def _edges(model: Model) -> tuple[str, list[_Edge]]:
    """Root link, and joints whose depth-first order with siblings sorted by name is the model's order."""
    topology = model.topology
    home, poses = np.asarray(model.home, np.float64), np.asarray(model.frame_poses, np.float64)
    links, joints = Names(topology.frame_names), Names(topology.joint_names)
    children: dict[int, list[int]] = {i: [] for i in range(-1, model.nb)}
    frames: dict[int, list[int]] = {i: [] for i in range(-1, model.nb)}
    for i, parent in enumerate(topology.parents):
        children[parent].append(i)
    for k, body in enumerate(topology.frame_bodies[model.nb :], model.nb):
        frames[body].append(k)
    names = {i: name for i, name in enumerate(topology.body_names)}
    if _has_floating_base(model):
        # The root link is the body itself, and `floating_base=True` adds its joint again.
        children[-1] = []
    else:
        # A frame at the world's origin can be the root link; otherwise one is added.
        at_world = [k for k in frames[-1] if np.array_equal(poses[k], np.eye(4))]
        names[-1] = topology.frame_names[at_world[0]] if at_world else links.new("world")
        frames[-1] = [k for k in frames[-1] if k not in at_world[:1]]

    edges = []
    for carrier, name in sorted(names.items()):
        runs = _split_runs([topology.joint_names[i] for i in children[carrier]])
        last = max((topology.joint_names[i] for i in children[carrier]), default="")
        # Siblings in sorted order stay on the body; each further run needs a holder of its own.
        holders = [(name, np.eye(4))]
        for n in range(max(len(frames[carrier]), len(runs) - 1)):
            k = frames[carrier][n] if n < len(frames[carrier]) else None
            link, pose = (links.new(f"{name}_carrier"), np.eye(4)) if k is None else (topology.frame_names[k], poses[k])
            # Bodies on a holder are visited with the holder's joint, after all joints with smaller names.
            joint = f"{last}~{n:03d}" if n + 1 < len(runs) else f"{link}_fixed"
            edges.append(_Edge(joints.new(joint), name, link, pose, None))
            holders.append((link, pose))
        for (link, pose), run in zip(holders, runs, strict=False):
            for i in (topology.joint_names.index(joint) for joint in run):
                edges.append(
                    _Edge(topology.joint_names[i], link, topology.body_names[i], host_math.inverse(pose) @ home[i], i)
                )
    # The smallest key is -1 for the world, or 0 for the body of a floating base.
    return names[min(names)], edges


def _has_floating_base(model: Model) -> bool:
    topology = model.topology
    return (
        topology.parents.count(-1) == 1
        and topology.kinds[0] == "free"
        and topology.joint_names[0] == ROOT_JOINT
        and -1 not in topology.frame_bodies
        and np.array_equal(np.asarray(model.home)[0], np.eye(4))
    )


def _split_runs(names: list[str]) -> list[list[str]]:
    """Split a list of names into sorted runs."""
    runs: list[list[str]] = []
    for name in names:
        if runs and name > runs[-1][-1]:
            runs[-1].append(name)
        else:
            runs.append([name])
    return runs


def _write_link(robot: ET.Element, name: str, parameters: np.ndarray | None) -> None:
    link = ET.SubElement(robot, "link", name=name)
    # A link without <inertial> is massless, and loads as such.
    if parameters is None or not parameters.any():
        return
    # URDF states inertia about the centre of mass, the model about the frame's origin.
    mass, com, inertia = host_math.about_com(parameters)
    if mass == 0 and parameters[1:4].any():
        raise ValueError(
            f"body {name!r} has first moments {parameters[1:4].tolist()} kg m without mass; URDF cannot express them"
        )
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=_text(com), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=_text([mass]))
    rows = {f"i{a}{b}": _text([inertia[i, j]]) for i, a in enumerate("xyz") for j, b in enumerate("xyz") if i <= j}
    ET.SubElement(inertial, "inertia", rows)


def _write_joint(robot: ET.Element, model: Model, edge: _Edge) -> None:
    kind = "fixed" if edge.body is None else model.topology.kinds[edge.body]
    joint = ET.SubElement(robot, "joint", name=edge.joint, type="floating" if kind == "free" else kind)
    rpy = host_math.rpy_from_rotation(edge.pose[:3, :3])
    ET.SubElement(joint, "origin", xyz=_text(edge.pose[:3, 3]), rpy=_text(rpy))
    ET.SubElement(joint, "parent", link=edge.parent)
    ET.SubElement(joint, "child", link=edge.child)
    if edge.body is None:
        return
    what = f"joint {edge.joint!r}"
    if kind in ("helical", "spherical"):
        raise ValueError(f"{what} is {kind}; URDF has no such joint")
    if kind != "free":
        screw = np.asarray(model.screws, np.float64)[edge.body]
        # A planar joint of a model moves in the x-y plane, and URDF gives the normal.
        axis = {"planar": np.array([0.0, 0.0, 1.0]), "prismatic": screw[:3]}.get(kind, screw[3:])
        # Readers divide axes by their length, which scales the coordinate here.
        length = float(np.linalg.norm(axis))
        if abs(length - 1) > 1e-6:
            raise ValueError(f"{what} has a screw of length {length:.6g}; URDF has unit axes, so scale it to 1")
        ET.SubElement(joint, "axis", xyz=_text(axis))
    _write_limits(joint, model, edge.body, what)
    given = {key: getattr(model, key) for key in ("damping", "friction", "armature")}
    # Readers of URDF refuse <dynamics> without damping and friction.
    dynamics: dict[str, str] = {}
    if any(x is not None for x in given.values()):
        dynamics = {"damping": "0", "friction": "0"}
    for key, values in given.items():
        if values is not None:
            own = np.asarray(values, np.float64)[model.topology.v_slices[edge.body]]
            if np.any(own != own[0]):
                raise ValueError(
                    f"{what}: {key} {own.tolist()} differs between directions; URDF holds one number per joint"
                )
            dynamics[key] = _text(own[:1])
    if dynamics:
        ET.SubElement(joint, "dynamics", dynamics)
    for n, (i, source) in enumerate(model.topology.couplings):
        if i == edge.body and model.coupling_values is not None:
            multiplier, offset = np.asarray(model.coupling_values, np.float64)[n]
            values = {"joint": model.joint_names[source], "multiplier": _text([multiplier]), "offset": _text([offset])}
            ET.SubElement(joint, "mimic", values)


def _write_limits(joint: ET.Element, model: Model, body: int, what: str) -> None:
    kind = model.topology.kinds[body]
    place, rates = model.topology.q_slices[body], model.topology.v_slices[body]
    limits = {
        "lower": np.asarray(model.lower, np.float64)[place],
        "upper": np.asarray(model.upper, np.float64)[place],
        "velocity": np.asarray(model.velocity_limit, np.float64)[rates],
        "effort": np.asarray(model.effort_limit, np.float64)[rates],
    }
    if kind == "continuous":
        # The <limit> of a continuous joint has velocity and effort alone.
        del limits["lower"], limits["upper"]
    finite = [key for key, values in limits.items() if np.isfinite(values).any()]
    if kind in ("planar", "free"):
        if finite:
            raise ValueError(f"{what} is {kind} and has limits ({', '.join(finite)}); URDF cannot express them")
        return
    # <limit> is required for revolute and prismatic joints.
    if finite or kind != "continuous":
        ET.SubElement(
            joint, "limit", {key: _text(np.clip(values, -NO_LIMIT, NO_LIMIT)) for key, values in limits.items()}
        )


def _text(values) -> str:
    # repr is the shortest text that reads back as the same double.
    return " ".join(repr(float(value)) for value in values)
