"""Loops of URDF files, in the two places where users write them.

1. A YAML file with the URDF's name, as in collections of parallel robots:

       closed_loop: [[frame_a, frame_b], ...]   links (or joints) whose frames coincide
       type: [3d, 6d, ...]                      their origins only, or their axes too; one word for all
       name_mot: [joint, ...]                   joints with a motor
       joint_name: [joint, ...]                 joints of kinds that URDF lacks,
       joint_type: [SPHERICAL, FIXED, ...]      a ball joint at the joint's frame, or locked at zero

2. `<gazebo>` elements with an SDF `<joint>` in them, which Gazebo adds to the tree (poses in the child's frame, axes in
   the joint's, closed where all coordinates are zero), or with a mimic plugin (`<joint>`, `<mimicJoint>`,
   `<multiplier>`, `<offset>`).
"""

import pathlib
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.base import Constraint
from jaxdyn.constraints.loops import loop
from jaxdyn.io.loaded import Actuators, NotTaken
from jaxdyn.io.sdf_file import LOOPS
from jaxdyn.io.urdf_parts import Mimic
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import host_math
from jaxdyn.model.arguments import as_path
from jaxdyn.model.topology import KINDS, frame_index, joint_index
from jaxdyn.model.tree import Model

_SUFFIXES = (".yaml", ".yml")
_KEYS = ("closed_loop", "name_mot", "joint_name")
_TYPES = {"3d": "spherical", "6d": "weld"}


class Closures(NamedTuple):
    """Contents of the YAML file: pairs of frames with the joint that closes each, spherical joints, locked joints, motors.

    `others` are joints of other kinds, which stay as in the URDF.
    """

    path: str
    pairs: tuple[tuple[str, str, str], ...] = ()
    balls: tuple[str, ...] = ()
    locked: tuple[str, ...] = ()
    motors: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


def read_closures(urdf: pathlib.Path, loops) -> Closures:
    """Read the loops of a URDF file from its YAML file.

    **Arguments:** `loops`: a YAML file; None: the one with the URDF's name in its folder, if it names loops or
    motors; False: none.

    **Raises:** ValueError with the file for malformed YAML, invalid pairs, unknown types, lists of
    different lengths.
    """
    if loops is False:
        return Closures("")
    if loops is not None:
        return _read(as_path(loops, "loops"), wanted=True)
    # robot.urdf.xacro belongs to robot.yaml.
    name = urdf.with_suffix("") if urdf.suffix == ".xacro" and len(urdf.suffixes) > 1 else urdf
    beside = [path for suffix in _SUFFIXES if (path := name.with_suffix(suffix)).is_file()]
    return _read(beside[0], wanted=False) if beside else Closures("")


def _read(path: pathlib.Path, wanted: bool) -> Closures:
    # Imported here, since few files have loops.
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
        if not wanted and not any(key in text for key in _KEYS):
            return Closures("")  # an unrelated file with this name
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, Loader=yaml.SafeLoader)):
            # A few nested aliases expand to gigabytes, and no list of loops needs them.
            raise ValueError(
                f"{path}: aliases (*name) are refused, as they can expand without bound; write the text out"
            )
        content = yaml.safe_load(text)
    except OSError as error:
        raise ValueError(f"loops: {path} cannot be read ({error.strerror}); check the path") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        if not wanted:
            return Closures("")
        raise ValueError(f"{path}: malformed YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict) or not set(_KEYS) & content.keys():
        if not wanted:
            return Closures("")
        raise ValueError(f"{path}: names no loops; give closed_loop: [[FRAME, FRAME], ...] and type: [3d, 6d, ...]")
    pairs = content.get("closed_loop") or []
    if not isinstance(pairs, list) or not all(
        isinstance(pair, list) and len(pair) == 2 and all(isinstance(name, str) for name in pair) for pair in pairs
    ):
        raise ValueError(f"{path}: closed_loop is {pairs!r}; give pairs of frames, [[FRAME, FRAME], ...]")
    types = content.get("type", "6d")
    types = [types] * len(pairs) if isinstance(types, str) else types or []
    if len(types) != len(pairs):
        raise ValueError(f"{path}: type has {len(types)} entries, closed_loop {len(pairs)}; give one for each pair")
    kinds = []
    for pair, word in zip(pairs, types, strict=True):
        if str(word).lower() not in _TYPES:
            raise ValueError(f"{path}: the type of the loop {pair[0]}, {pair[1]} is {word!r}; give 3d or 6d")
        kinds.append(_TYPES[str(word).lower()])
    names, words, motors = (_names(content, key, path) for key in ("joint_name", "joint_type", "name_mot"))
    if len(names) != len(words):
        raise ValueError(
            f"{path}: joint_name has {len(names)} entries, joint_type {len(words)}; give one for each joint"
        )
    chosen = list(zip(names, (word.upper() for word in words), strict=True))
    return Closures(
        str(path),
        tuple((a, b, kind) for (a, b), kind in zip(pairs, kinds, strict=True)),
        tuple(name for name, word in chosen if word == "SPHERICAL"),
        tuple(name for name, word in chosen if word == "FIXED"),
        tuple(motors),
        tuple(f"{name} ({word})" for name, word in chosen if word not in ("SPHERICAL", "FIXED")),
    )


def _names(content: dict, key: str, path) -> list[str]:
    value = content.get(key) or []
    value = [value] if isinstance(value, str) else value
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise ValueError(f"{path}: {key} is {value!r}; give a list of names")
    return value


def loop_constraints(closures: Closures, urdf: XmlFile, model: Model, left: NotTaken) -> list[Constraint]:
    """Loop constraints of both conventions, without mimic plugins.

    **Raises:** ValueError with the file for frames and joints that the model does not have, and for bad numbers.
    """
    taken: list[Constraint] = []
    for a, b, kind in closures.pairs:
        ends = [
            model.frame_names[_look_up(frame_index, model, name, f"{closures.path}: closed_loop")] for name in (a, b)
        ]
        taken.append(loop(ends[0], np.eye(4), ends[1], np.eye(4), kind, name=f"{a}-{b}"))
    left.add(f"kinds of joints in {pathlib.Path(closures.path).name}, which stay as in the URDF", closures.others)
    return [*taken, *_gazebo(urdf, model, left)]


def motors_of(closures: Closures, model: Model) -> Actuators | None:
    """Motors with unit gain on the joints in `name_mot`: controls are generalised forces (N m or N)."""
    if not closures.motors:
        return None
    columns = []
    for name in closures.motors:
        joint = _look_up(joint_index, model, name, f"{closures.path}: name_mot")
        # A motor has one control, and so one coordinate.
        if KINDS[kind := model.topology.kinds[joint]].nv != 1:
            raise ValueError(
                f"{closures.path}: name_mot: joint {name!r} is {kind}; motors drive joints with one degree of freedom"
            )
        columns.append(model.topology.v_slices[joint].start)
    n, dtype = len(columns), model.home.dtype
    # The effort limits of the file stay leaves of the model and do not clip here.
    free = np.tile([-np.inf, np.inf], (n, 1))
    moment = np.zeros((n, model.nv))
    moment[np.arange(n), columns] = 1.0
    places = np.full(model.nv, -1)
    for in_q, in_v in zip(model.topology.q_slices, model.topology.v_slices, strict=True):
        if in_q.stop - in_q.start == 1:
            places[in_v.start] = in_q.start
    gain = np.tile([1.0, 0.0, 0.0], (n, 1))
    numbers = (moment, np.zeros((n, 6)), gain, 0 * gain, free, free, np.tile([-np.inf, np.inf], (model.nv, 1)))
    leaves = (jnp.asarray(x, dtype) for x in numbers)
    return Actuators(closures.motors, (None,) * n, tuple(int(x) for x in places), *leaves)


def _look_up(index, model: Model, name: str, where: str) -> int:
    try:
        return index(model, name)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _gazebo(file: XmlFile, model: Model, left: NotTaken) -> list[Constraint]:
    """Loop constraints of joints in `<gazebo>` elements."""
    taken: list[Constraint] = []
    for element in file.root.iter("gazebo"):
        for tag in ("plugin", "sensor"):
            for part in element.findall(tag):
                if part.find("mimicJoint") is None:
                    left.add(f"<{tag}> in <gazebo>", [part.get("name") or element.get("reference") or tag])
        for joint in element.findall("joint"):
            name = file.name(joint, "<gazebo>")
            kind = joint.get("type") or ""
            # A prismatic joint without an axis has no direction in which it is free.
            if kind not in LOOPS or (kind == "prismatic" and joint.find("axis") is None):
                left.add("<gazebo> joints of kinds that cannot close a loop", [f"{name} ({kind})"])
                continue
            taken.append(_gazebo_loop(file, joint, name, LOOPS[kind], model))
            if any(joint.find(f"axis/{tag}") is not None for tag in ("dynamics", "limit")):
                left.add("limits and damping of <gazebo> joints", [name])
    return taken


def _gazebo_loop(file: XmlFile, joint, name: str, kind: str, model: Model) -> Constraint:
    what = f"joint {name!r}"
    ends: list[str | None] = []
    for tag in ("parent", "child"):
        link = file.word(joint, tag)
        if not link:
            raise file.fault(joint, f"{what} in <gazebo> has no <{tag}>")
        try:
            ends.append(None if link == "world" else model.frame_names[frame_index(model, link)])
        except ValueError as error:
            raise file.fault(joint, f"{what} in <gazebo>: {error}") from error
    pose = joint.find("pose")
    here = np.eye(4) if pose is None or not (pose.text or "").strip() else file.pose_numbers(pose, what)
    if pose is not None and (pose.get("relative_to") or ends[1]) != ends[1]:
        raise file.fault(
            pose, f"<pose> of {what} is relative to {pose.get('relative_to')!r}; write it in its child's frame"
        )
    places = [np.eye(4) if end is None else _zero_pose(model, end) for end in ends]
    # All coordinates zero is the configuration at which the format closes the loop.
    world = places[1] @ here
    turns = [_axis_rotation(file, joint, tag, world, what) for tag in ("axis", "axis2")]
    # Only a universal joint has a second axis; others use one for both ends.
    turns = turns if kind == "universal" else turns[:1] * 2
    poses = []
    for place, turn in zip(places, turns, strict=True):
        frame = world.copy()
        frame[:3, :3] = turn if kind in ("revolute", "prismatic", "universal") else world[:3, :3]
        poses.append(host_math.inverse(place) @ frame)
    return loop(ends[0], poses[0], ends[1], poses[1], kind, name=name)


def _axis_rotation(file: XmlFile, joint, tag: str, world: np.ndarray, what: str) -> np.ndarray:
    """Rotation (3, 3) of a frame in the world with z along a joint axis that is given in the joint's frame."""
    xyz: Any = joint.find(f"{tag}/xyz")
    if xyz is not None and (xyz.get("expressed_in") or "").strip():
        raise file.fault(
            xyz, f"<xyz> of {what} is expressed in {xyz.get('expressed_in')!r}; write it in the joint's frame"
        )
    # The format's default axis is z; x for the second keeps the two at right angles.
    default = [0.0, 0.0, 1.0] if tag == "axis" else [1.0, 0.0, 0.0]
    axis = np.array(default) if xyz is None else file.numbers(xyz, 3, f"<{tag}> of {what}")
    if not axis.any():
        raise file.fault(xyz, f"<xyz> of <{tag}> of {what} is zero; give a direction")
    return host_math.rotation_from_z(world[:3, :3] @ host_math.unit(axis, what))[:3, :3]


def plugin_followers(file: XmlFile) -> dict[str, tuple[Mimic, str]]:
    """Joints that follow others by a `<gazebo>` plugin, mimicJoint = multiplier joint + offset, with file:line of each.

    **Raises:** ValueError with file and line for a plugin without the joints' names, bad numbers, a joint that follows twice.
    """
    followers: dict[str, tuple[Mimic, str]] = {}
    for plugin in file.root.iterfind(".//gazebo/plugin"):
        # Plugins of other kinds (controllers, sensors) have no such element.
        if plugin.find("mimicJoint") is None:
            continue
        leader, follower = file.word(plugin, "joint"), file.word(plugin, "mimicJoint")
        if not leader or not follower:
            raise file.fault(plugin, "a mimicking plugin has no <joint> or no name in <mimicJoint>; give both")
        ratio = file.number(plugin, "multiplier", 1.0, "a mimicking plugin")
        coupling = Mimic(leader, ratio, file.number(plugin, "offset", 0.0, "a mimicking plugin"))
        if followers.setdefault(follower, (coupling, f"{file.path}:{plugin.line}"))[0] != coupling:  # pyright: ignore[reportAttributeAccessIssue]
            raise file.fault(plugin, f"joint {follower!r} follows {followers[follower][0].joint!r} already; keep one")
    return followers


def _zero_pose(model: Model, frame: str) -> np.ndarray:
    """World pose (4, 4) of a frame at zero coordinates, in float64."""
    k = model.frame_names.index(frame)
    pose, body = np.asarray(model.frame_poses, np.float64)[k], model.topology.frame_bodies[k]
    # At neutral coordinates every joint transform is the identity, so home poses alone make the chain.
    while body >= 0:
        pose, body = np.asarray(model.home, np.float64)[body] @ pose, model.topology.parents[body]
    return pose
