"""URDF loader.

Files are checked strictly: XML, structure, references and numbers, each fault with its line (`urdf_check`); `urdf_parts`
converts them. Meshes and other visual elements are not read.
"""

import os
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from jaxdyn.io.loaded import warn_of_units
from jaxdyn.io.urdf_parts import JOINTS, Joint, Mimic, Parts, read_parts
from jaxdyn.io.xml_lines import XmlFile, rounding_of_digits
from jaxdyn.model import host_math
from jaxdyn.model.arguments import DType, Numbers
from jaxdyn.model.builder import ModelBuilder, unknown
from jaxdyn.model.topology import KINDS, SCREW_KINDS, joint_neutral
from jaxdyn.model.tree import Model, inertia_problems

# URDF has no number for "no limit", and other readers refuse "inf"; `save_urdf` writes the largest double.
NO_LIMIT = float(np.finfo(np.float64).max)
ROOT_JOINT = "root_joint"
_Z = np.array([0.0, 0.0, 1.0])


def urdf_model(
    file: XmlFile,
    *,
    floating_base: bool | None,
    lock: Iterable[str] | Mapping[str, Any],
    mimic: str,
    gravity: Numbers | None,
    missing_inertia: Numbers | None,
    dtype: DType | None,
    balls: Iterable[str] = (),
    followers: Mapping[str, tuple[Mimic, str]] | None = None,
) -> Model:
    """Build the model of a URDF file, with options as of `jd.load_model`.

    `balls` names spherical joints, a kind that URDF lacks; `followers` are joints that follow others without `<mimic>`, each
    with file:line.

    **Raises:** as `jd.load_model`; ValueError for balls that are no movable joints of the file.
    """
    if mimic not in ("ignore", "couple", "error"):
        raise ValueError(f"mimic is {mimic!r}; give 'ignore', 'couple' or 'error'")
    urdf, path = read_parts(file), file.path
    root_joint = ROOT_JOINT
    # The root's joint is ours; a joint of the file keeps its name.
    while root_joint in urdf.joints:
        root_joint = f"_{root_joint}"
    kinds = {name: JOINTS[joint.type] for name, joint in urdf.joints.items()}
    for name in balls:
        if kinds.get(name, "fixed") == "fixed":
            raise ValueError(f"{path}: {unknown('joint', name, kinds)}; a ball takes the place of a joint that moves")
        kinds[name] = "spherical"
    # A floating base can be locked at a pose as any joint.
    locked = _lock_values({root_joint: "free", **kinds} if floating_base else kinds, lock, path)
    couplings = {name: joint.mimic for name, joint in urdf.joints.items() if joint.mimic}
    places = {name: urdf.places[f"joint {name}"] for name in couplings}
    for name, (coupling, where) in (followers or {}).items():
        # A file may state a coupling as <mimic> and as a plugin; equal ones count once.
        if couplings.setdefault(name, coupling) != coupling:
            raise ValueError(f"{where}: joint {name!r} follows {couplings[name].joint!r} already; keep one of them")
        places.setdefault(name, where)
    # A fixed joint has no coordinate that could follow another one.
    couplings = {name: coupling for name, coupling in couplings.items() if kinds.get(name) != "fixed"}
    if mimic == "error" and couplings:
        listed = ", ".join(f"{name} (follows {coupling.joint})" for name, coupling in couplings.items())
        raise ValueError(f"{path}: joints that follow others: {listed}; pass mimic='couple' or mimic='ignore'")
    if mimic == "couple":
        couplings = _resolve_couplings(couplings, kinds, locked, places)

    builder = ModelBuilder(urdf.name, gravity=gravity, dtype=dtype, rounding=rounding_of_digits(file.root))
    # Warnings of the builder can then name lines of the file.
    builder.places = {name: urdf.places[f"link {name}"] for name in urdf.links}
    free = floating_base and root_joint not in locked
    # A locked base is a fixed body at the pose of the given coordinates.
    base = host_math.joint_pose("free", np.zeros(6), locked[root_joint]) if root_joint in locked else None
    missing = None if missing_inertia is None else host_math.inertia_numbers(missing_inertia, "missing_inertia")
    inertia = _inertia(urdf, urdf.root, missing if free else None)
    builder.add_body(urdf.root, None, "free" if free else "fixed", inertia, joint_name=root_joint, pose=base)
    # A stack in reverse gives depth-first order with siblings in the file's order; the builder sorts them by name.
    stack = list(reversed(urdf.children[urdf.root]))
    while stack:
        joint = urdf.joints[stack.pop()]
        stack.extend(reversed(urdf.children[joint.child]))
        moves = kinds[joint.name] != "fixed" and joint.name not in locked
        inertia = _inertia(urdf, joint.child, missing if moves else None)
        try:
            _add_joint(builder, joint, kinds[joint.name], inertia, urdf, locked)
        except ValueError as error:
            raise ValueError(f"{urdf.places[f'joint {joint.name}']}: {error}") from error
    if mimic == "couple":
        for name, coupling in couplings.items():
            try:
                builder.add_coupling(name, coupling.joint, coupling.multiplier, coupling.offset)
            except ValueError as error:
                raise ValueError(f"{places[name]}: {error}") from error
    try:
        model = builder.build()
    except ValueError as error:
        # The builder names the joint that moves no inertia; its line is looked up here.
        named = re.match(r"joint '(.*?)' \(body", str(error))
        where = urdf.places.get(f"joint {named[1]}", path) if named else path
        kinematic = "; or give missing_inertia=jd.inertia.sphere(1.0, 0.1) to load it for kinematics" if named else ""
        raise ValueError(f"{where}: {error}{kinematic}") from error
    warn_of_units(path, model)
    return model


def urdf_inertia_report(
    path: str | os.PathLike,
    *,
    arguments: Mapping[str, Any] | None = None,
    packages: Mapping[str, str | os.PathLike] | None = None,
) -> list[tuple[str, str]]:
    """Unphysical inertias stated in a URDF file, as (link, problem), before links are merged.

    Links without `<inertial>` are listed only where a joint moves them: a fixed one is only a frame. `arguments` and
    `packages` are as for `jd.load_model`.

    **Raises:** ValueError as `jd.load_model` does for a file that cannot be read.
    """
    urdf = read_parts(XmlFile(path, "URDF", arguments, packages))
    # A massless link on a fixed joint is a frame, as of a tool or a sensor.
    moved = {joint.child for joint in urdf.joints.values() if joint.type != "fixed"}
    report = []
    for name, link in urdf.links.items():
        if link is None:
            report += [(name, "massless: no <inertial>")] if name in moved else []
            continue
        report += [(name, problem) for problem in inertia_problems(_inertia(urdf, name))]
    return report


def _add_joint(
    builder: ModelBuilder, joint: Joint, kind: str, inertia, urdf: Parts, locked: dict[str, np.ndarray]
) -> None:
    name = joint.child
    pose, parent, axis, turn = joint.origin, joint.parent, _Z, np.eye(4)
    if kind in SCREW_KINDS or kind == "planar":
        axis = np.asarray(host_math.unit(joint.axis, f"joint {joint.name!r}: axis"))
    # A planar joint moves in the x-y plane of its body; another normal needs an intermediate body.
    if kind == "planar":
        turn, axis = host_math.rotation_from_z(axis), _Z
    if joint.name in locked:
        screw = np.concatenate([axis, np.zeros(3)] if kind == "prismatic" else [np.zeros(3), axis])
        # The same rotation before and after: the link stays in the axes of the file.
        pose = pose @ turn @ host_math.joint_pose(kind, screw, locked[joint.name]) @ host_math.inverse(turn)
        kind, axis, turn = "fixed", _Z, np.eye(4)
    leaves = {} if kind == "fixed" else _leaves(joint, kind)
    if not np.array_equal(turn, np.eye(4)):
        carrier = f"{name}_plane"
        # The intermediate body is massless and carries the link, whose frame keeps the file's axes.
        builder.add_body(carrier, parent, kind, joint_name=joint.name, pose=pose @ turn, **leaves)
        builder.add_body(
            name, carrier, "fixed", inertia, joint_name=f"{joint.name}_plane", pose=host_math.inverse(turn)
        )
        return
    builder.add_body(name, parent, kind, inertia, joint_name=joint.name, pose=pose, axis=axis, **leaves)


def _leaves(joint: Joint, kind: str) -> dict[str, Any]:
    leaves: dict[str, Any] = {key: joint.dynamics.get(key) for key in ("armature", "damping", "friction")}
    if joint.limit is not None:
        # <limit> of a continuous joint has these two alone.
        leaves |= {"velocity_limit": joint.limit.get("velocity"), "effort_limit": joint.limit.get("effort")}
        if kind in ("revolute", "prismatic"):
            # The format's default for a missing bound is zero.
            leaves |= {key: joint.limit.get(key, 0.0) for key in ("lower", "upper")}
        for key in ("velocity_limit", "effort_limit", "lower", "upper"):
            if leaves.get(key) is not None and abs(leaves[key]) >= NO_LIMIT:
                # The largest double means "no limit" in files of `save_urdf`.
                leaves[key] = np.copysign(np.inf, leaves[key])
    return leaves


def _inertia(urdf: Parts, link: str, missing: host_math.Values | None = None) -> host_math.Values:
    """Ten inertial parameters of a link; `missing` of one that has no mass and no inertia."""
    inertial = urdf.links[link]
    none = np.zeros(10) if missing is None else missing
    if inertial is None:
        return none
    if not inertial.mass and (inertial.inertia is None or not inertial.inertia.any()):
        return none
    # A missing <mass> or <inertia> inside <inertial> means zero.
    parts = (inertial.mass or 0.0, np.zeros(3), np.zeros((3, 3)) if inertial.inertia is None else inertial.inertia)
    try:
        parameters = np.asarray(host_math.inertia_numbers(parts, f"link {link!r}"))
    except ValueError as error:
        raise ValueError(f"{urdf.places[f'link {link}']}: {error}") from error
    return parameters if inertial.origin is None else np.asarray(host_math.move_inertia(inertial.origin, parameters))


def _lock_values(kinds: dict[str, str], lock, path) -> dict[str, np.ndarray]:
    """Coordinates of each locked joint, from the option `lock`."""
    if isinstance(lock, str):
        raise ValueError(f"lock is {lock!r}; give a list of joint names or a mapping of name to value")
    values = dict(lock) if isinstance(lock, Mapping) else dict.fromkeys(lock)
    locked = {}
    for name, value in values.items():
        if name not in kinds or kinds[name] == "fixed":
            fault = f"joint {name!r} is fixed already" if name in kinds else unknown("joint", name, kinds)
            raise ValueError(f"lock: {fault} in {path}; leave it out")
        nq = KINDS[kinds[name]].nq
        if value is None:
            locked[name] = joint_neutral(kinds[name])
            continue
        shapes = {(nq,): f"({nq},)"} | ({(): "a number"} if nq == 1 else {})
        locked[name] = host_math.numbers(value, shapes, f"lock: value of joint {name!r}").reshape(nq)
        if kinds[name] == "free" and not locked[name][3:].any():
            raise ValueError(f"lock: value of joint {name!r} is {value!r}; its quaternion (qw, qx, qy, qz) is zero")
    return locked


def _resolve_couplings(
    couplings: dict, kinds: dict[str, str], locked: dict[str, np.ndarray], places: dict[str, str]
) -> dict:
    """Lock joints coupled to locked or fixed ones (added to `locked`); return the remaining couplings."""
    left = dict(couplings)
    for name, coupling in couplings.items():
        where, leader = places[name], coupling.joint
        if leader not in kinds and name in locked:
            del left[name]  # the caller gives its coordinate
            continue
        for joint in (name, leader):
            if joint not in kinds:
                fault = f"joint {name!r} follows {leader!r}; {unknown('joint', joint, kinds)}"
                hold = f", hold it by lock={{{name!r}: 0.0}}" if name in kinds else ""
                raise ValueError(f"{where}: {fault}; correct the name{hold}, or pass mimic='ignore'")
            if kinds[joint] not in (*SCREW_KINDS, "fixed"):
                fault = f"joint {name!r} follows {leader!r}, but {joint!r} is {kinds[joint]}"
                raise ValueError(f"{where}: {fault}; couple joints of one degree of freedom, or pass mimic='ignore'")
    # A fixed joint is at zero, so its followers are at their offset.
    held = {name: np.zeros(1) for name, kind in kinds.items() if kind == "fixed"}
    settled = False
    # Chains of couplings: each pass may lock leaders of others, until none changes.
    while not settled:
        settled = True
        for name, coupling in list(left.items()):
            if coupling.joint not in locked and coupling.joint not in held:
                continue
            value = coupling.multiplier * (locked | held)[coupling.joint] + coupling.offset
            # A follower that the caller locks as well is accepted where both values agree.
            if not np.allclose(locked.setdefault(name, value), value, rtol=1e-9, atol=1e-9):
                raise ValueError(
                    f"lock: joint {name!r} is held at {locked[name]}, but follows {coupling.joint!r} to {value}"
                )
            del left[name]
            settled = False
    for name, coupling in left.items():
        if name in locked:
            raise ValueError(f"lock: joint {name!r} follows {coupling.joint!r}; lock that one instead")
    return left
