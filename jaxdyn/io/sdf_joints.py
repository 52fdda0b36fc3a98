"""Joints of an SDF file as data in world axes, and the choice of the spanning tree."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.io.loaded import UNLIMITED
from jaxdyn.io.sdf_frames import SdfFile
from jaxdyn.model import host_math
from jaxdyn.model.builder import unknown

# Axes of each kind. A gearbox is a coupling of two other joints, not a joint.
AXES = dict(revolute=1, continuous=1, prismatic=1, screw=1, revolute2=2, universal=2, ball=0, fixed=0, gearbox=2)
# Kind of `jd.loop` for each kind of joint; screws and gearboxes cannot close loops.
LOOPS = dict(revolute="revolute", continuous="revolute", prismatic="prismatic", universal="universal")
LOOPS |= dict(revolute2="universal", ball="spherical", fixed="weld")


class Axis(NamedTuple):
    """Joint axis: direction (3,) in world axes, spring, and arguments of `ModelBuilder.add_body`."""

    direction: np.ndarray
    stiffness: float
    rest: float
    leaves: dict[str, Any]
    limited: bool
    mimic: Any


class Joint(NamedTuple):
    """Joint between two links (None: the world), with its pose in the world, its axes and its pitch (m/rad)."""

    name: str
    kind: str
    parent: str | None
    child: str | None
    pose: np.ndarray
    axes: tuple[Axis, ...]
    pitch: float
    cut: bool  # the file asks for a loop to be cut here
    element: Any


class Edge(NamedTuple):
    """Edge of the tree: `body` is attached to `carrier` by `joint`, backwards where `body` is the joint's parent in the file."""

    joint: Joint | None  # None: the body is a root without a joint in the file
    carrier: str | None
    body: str
    backwards: bool


def read_joints(file: SdfFile) -> list[Joint]:
    """Read all joints of a file, in its order.

    **Raises:** ValueError with file and line for an unknown kind, a bad axis, a screw without a pitch, a joint that
    joins a link to itself.
    """
    joints = []
    for name, (element, scope) in file.joints.items():
        kind = element.get("type") or ""
        if kind not in AXES:
            raise file.fault(element, f"joint {name!r}: {unknown('type', kind, AXES)}; types are {', '.join(AXES)}")
        pose = file.joint_pose(name)
        parent, child = (file.link_of(file.end(name, which)) for which in ("parent", "child"))
        # Both ends may be None: static models are parts of the world, and joining them has no effect.
        if parent == child and parent is not None:
            raise file.fault(element, f"joint {name!r} joins {parent!r} to itself; name two links")
        tags = ("axis", "axis2")[: AXES[kind]]
        axes = tuple(_axis(file, name, element, scope, tag, kind, pose) for tag in tags)
        cut = file.flag(element, "physics/simbody/must_be_loop_joint", f"joint {name!r}")
        pitch = _pitch(file, name, element) if kind == "screw" else 0.0
        joints.append(Joint(name, kind, parent, child, pose, axes, pitch, cut, element))
    return joints


def _axis(file: SdfFile, name: str, joint, scope, tag: str, kind: str, pose: np.ndarray) -> Axis:
    what = f"joint {name!r}"
    element = joint.find(tag)
    xyz = None if element is None else element.find("xyz")
    # A missing axis is z from version 1.7 on; earlier files have to state it.
    if xyz is None and (tag == "axis2" or file.minor < 7):
        raise file.fault(joint if element is None else element, f"{what} is {kind} and has no <{tag}> with <xyz>")
    values = np.array([0.0, 0.0, 1.0]) if xyz is None else file.numbers(xyz, 3, f"<{tag}> of {what}")
    if not values.any():
        raise file.fault(xyz, f"<xyz> of <{tag}> of {what} is zero; give a direction")
    # From 1.5 on, axes are in the joint's own frame by default.
    turn = pose[:3, :3]
    inside = (xyz.get("expressed_in") or "").strip() if xyz is not None else ""
    if file.minor >= 7 and file.flag(element, "use_parent_model_frame", what):
        raise file.fault(
            element,
            f"<use_parent_model_frame> of {what} is of versions 1.5 and 1.6; write expressed_in='__model__' in its <xyz>",
        )
    # Up to 1.4 axes are in the model's frame; in 1.5 and 1.6 where the file says so.
    if file.minor < 7 and (file.minor == 4 or file.flag(element, "use_parent_model_frame", what)):
        turn = file.pose(scope.frame)[:3, :3]
    elif inside:
        turn = file.pose(file.find(inside, scope, xyz))[:3, :3]
    get = lambda tag, default, **how: file.number(element, tag, default, what, **how)  # noqa: E731
    lower, upper = get("limit/lower", -np.inf, finite=False), get("limit/upper", np.inf, finite=False)
    limited = kind != "continuous" and (lower > -UNLIMITED or upper < UNLIMITED)
    leaves: dict[str, Any] = {}
    # Files write huge finite numbers for no limit; only finite limits become leaves.
    if limited:
        leaves = {"lower": lower if lower > -UNLIMITED else -np.inf, "upper": upper if upper < UNLIMITED else np.inf}
    for key, path in (("effort_limit", "limit/effort"), ("velocity_limit", "limit/velocity")):
        value = get(path, -1.0, finite=False)  # negative: no limit
        if 0 <= value < UNLIMITED:
            leaves[key] = value
    for key in ("damping", "friction"):
        # Zero is the format's default; a leaf of zeros would be a force that does nothing.
        if value := get(f"dynamics/{key}", 0.0):
            leaves[key] = value
    stiffness, rest = get("dynamics/spring_stiffness", 0.0), get("dynamics/spring_reference", 0.0)
    mimic = None if element is None else element.find("mimic")
    return Axis(turn @ host_math.unit(values, what), stiffness, rest, leaves, limited, mimic)


def _pitch(file: SdfFile, name: str, joint) -> float:
    """Metres per radian, positive for a right-handed thread."""
    what = f"joint {name!r}"
    if joint.find("screw_thread_pitch") is not None:
        return file.number(joint, "screw_thread_pitch", 1.0, what) / (2 * math.pi)
    if joint.find("thread_pitch") is None:
        raise file.fault(joint, f"{what} is a screw without a pitch; give <screw_thread_pitch> (m per turn)")
    turns = file.number(joint, "thread_pitch", 1.0, what)  # radians per metre, positive for a left-handed thread
    if turns == 0:
        raise file.fault(joint, f"{what}: <thread_pitch> is 0 rad/m; use a fixed joint, or <screw_thread_pitch>")
    return -1.0 / turns


def spanning_tree(
    links: Iterable[str], fixed: Iterable[str], joints: list[Joint], first: Iterable[str]
) -> tuple[list[Edge], list[Joint]]:
    """Choose the joints of the tree, parents before children; the remaining joints close loops.

    A joint that closes a loop has no coordinate, so its spring, damping and limits are lost. The tree prefers
    joints with a spring, then with damping or friction, then with limits; ball joints, and joints marked
    to be cut, come last; ties are broken by depth from the root in breadth-first order, then by the file's order.

    **Arguments:** `links`; `fixed`, links that do not move; `joints` without gearboxes; `first`, links preferred as
    roots of parts without a joint to the world, in order of preference.
    """
    # The arguments are read several times and may be iterators.
    links, fixed, first = list(links), set(fixed), list(first)
    # The world is a node, so that all joints to it are edges like others.
    nodes: list[str | None] = [None, *links]
    near: dict[str | None, list[str | None]] = {node: [] for node in nodes}
    for joint in joints:
        near[joint.parent].append(joint.child)
        near[joint.child].append(joint.parent)
    # Links of static models are at depth 1 although no joint holds them.
    for link in fixed:
        near[None].append(link)
    depth: dict[str | None, int] = {}
    roots: list[str | None] = []
    # Breadth first from the world, then from each preferred root of a part not reached yet.
    for start in (None, *first, *links):
        if start in depth:
            continue
        roots.append(start)
        depth[start], queue = 0, [start]
        for node in queue:
            for other in near[node]:
                if other not in depth:
                    depth[other] = depth[node] + 1
                    queue.append(other)

    def cost(joint: Joint):
        leaves = [axis.leaves for axis in joint.axes]
        moving = any("damping" in leaf or "friction" in leaf for leaf in leaves)
        springs, limits = any(axis.stiffness for axis in joint.axes), any(axis.limited for axis in joint.axes)
        # Of equal joints the one nearer to the root stays, which gives short branches.
        deep = min(depth[joint.parent], depth[joint.child])
        return joint.cut, joint.kind == "ball", not springs, not moving, not limits, deep

    # Kruskal's algorithm: adding the cheapest joint between two parts gives the tree of least total cost.
    part: dict[str | None, str | None] = {node: node for node in nodes} | dict.fromkeys(fixed, None)

    def group(node: str | None) -> str | None:
        while part[node] != node:
            node = part[node]
        return node

    chosen: list[Joint] = []
    left: set[str] = set()
    for joint in sorted(joints, key=cost):
        a, b = group(joint.parent), group(joint.child)
        if a == b:
            left.add(joint.name)
            continue
        chosen.append(joint)
        # The world represents its own group, since it can never be merged into another.
        part[b if a is None else a] = a if a is None else b
    # Directions follow from the roots outwards, whatever parent and child are in the file.
    edges: list[Edge] = [Edge(None, None, link, False) for link in links if link in fixed]
    edges += [Edge(None, None, root, False) for root in roots if root is not None]
    seen: set[str | None] = {None, *(edge.body for edge in edges)}
    queue = [None, *(edge.body for edge in edges)]
    for node in queue:
        for joint in chosen:
            for here, there, backwards in ((joint.parent, joint.child, False), (joint.child, joint.parent, True)):
                if here == node and there is not None and there not in seen:
                    seen.add(there)
                    queue.append(there)
                    edges.append(Edge(joint, node, there, backwards))
    return edges, [joint for joint in joints if joint.name in left]
