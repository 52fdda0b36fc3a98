"""Links, joints and frames of an SDF file and their poses: the pose graph of the format, from version 1.4 on.

Every pose is given in a frame: by default the model's for links, the child link's for joints, that of `attached_to` for
frames; from 1.7 on `relative_to` names another. "::" separates names of nested models. All poses are resolved to poses
in the world, as the file describes the mechanism.

Source: sdformat.org, "Pose frame semantics", and the descriptions of each version of the format.
"""

import dataclasses
import math
import os
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.io.loaded import UNLIMITED
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import host_math
from jaxdyn.model.builder import unknown

WORLD = "world"
_VERSIONS = tuple(f"1.{minor}" for minor in range(4, 13))


@dataclasses.dataclass(frozen=True)
class Scope:
    """Scope of names, a world or a model: names in it start with `prefix`; `frame` names its own frame."""

    element: Any
    prefix: str
    frame: str
    parent: "Scope | None"
    static: bool


class SdfFile(XmlFile):
    """An SDF file with its links, joints and frames by their full names (MODEL::NAME in nested models).

    **Raises:** ValueError with file and line for malformed XML, versions other than 1.4 to 1.12, names that are missing,
    taken or unknown, cyclic poses, and invalid numbers.
    """

    def __init__(self, path: str | os.PathLike):
        super().__init__(path, "SDF")
        root = self.root
        if root.tag != "sdf":
            raise self.fault(root, f"the root element is <{root.tag}>, expected <sdf>; this is not an SDF file")
        # Axes and default frames changed between versions, so an unknown one cannot be read safely.
        version = root.get("version") or ""
        if version not in _VERSIONS:
            raise self.fault(root, f"the version is {version!r}; {_VERSIONS[0]} to {_VERSIONS[-1]} are supported")
        self.minor = int(version.partition(".")[2])
        self.links: dict[str, tuple[Any, Scope]] = {}
        self.joints: dict[str, tuple[Any, Scope]] = {}
        self.frames: dict[str, tuple[Any, Scope]] = {}
        self.models: dict[str, Scope] = {}
        self.includes: list[str] = []
        self.of_world: list[str] = []  # links that stand for the world
        worlds = root.findall("world")
        if len(worlds) > 1:
            raise self.fault(worlds[1], "the file holds several worlds; keep one")
        self.world = worlds[0] if worlds else None
        # Models may be at the top of a file without a world.
        top = Scope(root if self.world is None else self.world, "", WORLD, None, False)
        self._collect(top)
        if not self.links:
            raise self.fault(
                root, "the file holds no <link>; its includes are not read" if self.includes else "no <link>"
            )

    def _collect(self, scope: Scope) -> None:
        for element in scope.element:
            if element.tag == "include":
                self.includes.append(self.word(element, "uri", "(no uri)"))
            if element.tag not in ("link", "joint", "frame", "model"):
                continue
            own = self.name(element, scope.frame)
            if own == WORLD and element.tag == "link":
                # In files made from URDF such a link stands for the world, as joints to it do.
                moved = not np.array_equal(self.raw_pose(element, f"link {WORLD!r}"), np.eye(4))
                if (heavy := element.find("inertial") is not None) or moved:
                    part = "an <inertial>" if heavy else "a <pose>"
                    fault = f"the link {WORLD!r} has {part}, but its name is that of the world, to which joints go"
                    raise self.fault(element, f"{fault}; rename it")
                self.of_world.append(scope.prefix + own)
                continue
            # `find` takes these names for others.
            if own == WORLD or (own.startswith("__") and own.endswith("__")):
                raise self.fault(element, f"the {element.tag} name {own!r} is reserved by the format; rename it")
            name = scope.prefix + own
            known = {"link": self.links, "joint": self.joints, "frame": self.frames, "model": self.models}[element.tag]
            if name in known:
                raise self.fault(element, f"the {element.tag} name {name!r} is taken; rename one")
            if element.tag != "model":
                known[name] = (element, scope)
                continue
            static = scope.static or self.flag(element, "static", f"model {name!r}")
            # A single model gives no prefix to its names; several models do, to keep their names distinct.
            alone = scope.parent is None and len(scope.element.findall("model")) == 1
            # Without a prefix, the model's frame must not take the name of one of its elements.
            frame = "__model__" if alone and any(part.get("name") == name for part in element) else name
            inner = Scope(element, "" if alone else f"{name}::", frame, scope, static)
            self.models[frame] = inner
            self._collect(inner)

    def find(self, name: str, scope: Scope, element) -> str:
        """Resolve a name within a scope to the frame's full name. **Raises:** ValueError for an unknown one."""
        if name == "__model__":
            return scope.frame
        if name in (WORLD, "__root__"):
            return WORLD
        # Links precede joints: up to 1.6 a joint may have the name of a link.
        for known in (self.links, self.frames, self.models, self.joints):
            if scope.prefix + name in known:
                return scope.prefix + name
        known = (k.removeprefix(scope.prefix) for all in (self.links, self.frames, self.joints) for k in all)
        raise self.fault(element, f"{unknown('frame', name, known)}; name a link, joint, frame or model of its scope")

    def raw_pose(self, element, what: str) -> np.ndarray:
        """Matrix (4, 4) of an element's <pose>, the identity where there is none."""
        pose = element.find("pose")
        if pose is None or not (pose.text or "").strip():
            return np.eye(4)
        if (pose.get("frame") or "").strip():
            raise self.fault(
                pose,
                f"<pose> of {what} is in the frame {pose.get('frame')!r}, which has no settled meaning before "
                "version 1.7 and none after; write version 1.7 and relative_to",
            )
        return self.pose_numbers(pose, what)

    def pose(self, name: str, stop: str = WORLD, trail: tuple[str, ...] = ()) -> np.ndarray:
        """Pose (4, 4) of a frame in the world, or in the frame `stop` that it is defined in."""
        if name == stop:
            return np.eye(4)
        # Recursion along relative_to; the trail detects cycles.
        element, scope = self._entry(name)
        if name in trail:
            raise self.fault(
                element, f"the poses of {', '.join(trail[trail.index(name) :])} refer to each other in a cycle"
            )
        if name == WORLD:
            raise self.fault(scope.element, f"the frame {trail[0]!r} is not defined in the model {stop!r}")
        raw = self.raw_pose(element, f"{element.tag} {name!r}")
        tag = element.find("pose")
        base = (tag.get("relative_to") or "").strip() if tag is not None else ""
        if base:
            base = self.find(base, scope, tag)
        elif name in self.joints and name not in self.links:
            base = self.end(name, "child")
        elif name in self.frames and (element.get("attached_to") or "").strip():
            base = self.find(element.get("attached_to").strip(), scope, element)
        else:
            base = scope.frame
        placed = self.pose(base, stop, (*trail, name)) @ raw
        placement = (element.get("placement_frame") or "").strip() if name in self.models else ""
        if placement:
            inner = self.models[name]
            # `placement_frame` (1.8) states where that inner frame is put, and not the model's own.
            placed = placed @ host_math.inverse(self.pose(self.find(placement, inner, element), name))
        return placed

    def _entry(self, name: str) -> tuple[Any, Scope]:
        for known in (self.links, self.frames):
            if name in known:
                return known[name]
        if name in self.models:
            model = self.models[name]
            return model.element, model.parent or model
        if name in self.joints:
            return self.joints[name]
        return self.root, Scope(self.root, "", WORLD, None, False)

    def joint_pose(self, name: str) -> np.ndarray:
        """Pose (4, 4) of a joint's frame in the world; a link may have the same name before version 1.7."""
        if name not in self.links and name not in self.frames and name not in self.models:
            return self.pose(name)
        element, scope = self.joints[name]
        tag = element.find("pose")
        base = (tag.get("relative_to") or "").strip() if tag is not None else ""
        base = self.find(base, scope, tag) if base else self.end(name, "child")
        return self.pose(base) @ self.raw_pose(element, f"joint {name!r}")

    def end(self, joint: str, which: str) -> str:
        """Full name of a joint's "parent" or "child" frame."""
        element, scope = self.joints[joint]
        child = element.find(which)
        if child is None or not (child.text or "").strip():
            raise self.fault(element, f"joint {joint!r} has no <{which}>")
        return self.find(child.text.strip(), scope, child)

    def link_of(self, name: str, trail: tuple[str, ...] = ()) -> str | None:
        """Link that carries a frame; None for the world and static models."""
        if name in trail:
            element, _ = self._entry(name)
            raise self.fault(element, f"the frames {', '.join(trail)} are attached to each other in a cycle")
        if name == WORLD:
            return None
        if name in self.links:
            return name
        trail = (*trail, name)
        if name in self.frames:
            element, scope = self.frames[name]
            base = (element.get("attached_to") or "").strip()
            return self.link_of(self.find(base, scope, element) if base else scope.frame, trail)
        if name in self.joints:
            return self.link_of(self.end(name, "child"), trail)
        return self.canonical_link(self.models[name])

    def canonical_link(self, model: Scope) -> str | None:
        """Link that carries a model's frame, None for the world when the model is static or empty."""
        # A static model does not move whatever its joints are.
        if model.static:
            return None
        if named := (model.element.get("canonical_link") or "").strip():
            return self.find(named, model, model.element)
        # The format's default is the first link, else that of the first nested model.
        for tag in ("link", "model"):
            for element in model.element.findall(tag):
                name = model.prefix + self.name(element, model.frame)
                if tag == "link" and name not in self.links:
                    continue  # it stands for the world
                return name if tag == "link" else self.canonical_link(self.models[name])
        return None


def inertia_of(file: SdfFile, link: str) -> np.ndarray:
    """Ten inertial parameters of a link in its frame."""
    element, what = file.links[link][0], f"link {link!r}"
    inertial = element.find("inertial")
    if inertial is None:
        # The format's default inertial: 1 kg and the unit matrix.
        return np.asarray(host_math.inertia_numbers((1.0, np.zeros(3), np.ones(3)), what))
    # Version 1.11 of the format computes inertias from shapes where this attribute is set.
    if (inertial.get("auto") or "").strip().lower() in ("1", "true"):
        raise file.fault(
            inertial,
            f"the inertia of {what} is to be computed from its shapes, which is not supported; write <mass> "
            "and <inertia> (`gz sdf --inertial-stats FILE` prints them)",
        )
    get = lambda tag, default: file.number(inertial, f"inertia/{tag}", default, what)  # noqa: E731
    # Each missing entry has a default of its own, also in an <inertia> that gives others.
    xx, yy, zz = get("ixx", 1.0), get("iyy", 1.0), get("izz", 1.0)
    xy, xz, yz = get("ixy", 0.0), get("ixz", 0.0), get("iyz", 0.0)
    mass = file.number(inertial, "mass", 1.0, what)
    pose = inertial.find("pose")
    # The format has no frames here; a file that names one means another centre of mass than it says.
    if pose is not None and (named := pose.get("relative_to")):
        raise file.fault(
            pose,
            f"<pose> of <inertial> of {what} is relative to {named!r}; give it in the link's frame, without relative_to",
        )
    try:
        about_com = (mass, np.zeros(3), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        return np.asarray(
            host_math.move_inertia(file.raw_pose(inertial, what), host_math.inertia_numbers(about_com, what))
        )
    except ValueError as error:
        raise error if str(error).startswith(file.path) else file.fault(inertial, str(error)) from error


# --- joints of an SDF file as data in world axes ---


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
