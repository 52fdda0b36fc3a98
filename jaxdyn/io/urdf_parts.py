"""Links and joints of a URDF file as data, with the format's defaults, and checks that name each fault's line."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.io.loaded import NotTaken
from jaxdyn.io.unread import URDF_GAZEBO, URDF_JOINT, URDF_LINK, URDF_ROBOT, unread_parts
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import host_math

JOINTS = {"floating": "free", **{kind: kind for kind in ("revolute", "continuous", "prismatic", "planar", "fixed")}}
# Number of finite values of each attribute used by the model.
NUMBERS = {
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "mass": {"value": 1},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 1),
    "limit": dict.fromkeys(("lower", "upper", "velocity", "effort"), 1),
    "dynamics": dict.fromkeys(("damping", "friction", "armature"), 1),
    "mimic": {"multiplier": 1, "offset": 1},
}
REQUIRED = {"mass": ("value",), "inertia": tuple(NUMBERS["inertia"]), "parent": ("link",), "child": ("link",)}
REQUIRED["mimic"] = ("joint",)
_READ = {*NUMBERS, *REQUIRED, "inertial"}
_PARENTS = ("link", "joint", "inertial")  # elements that contain each of the parts above at most once


def check_elements(file: XmlFile) -> tuple[list, dict[str, str]]:
    """Check names, references and numbers; return the link and joint elements, and file:line of each."""
    root: Any = file.root
    fault = file.fault
    if root.tag != "robot":
        raise fault(root, f"the root element is <{root.tag}>, expected <robot>; this is not a URDF file")
    elements = [element for element in root if element.tag in ("link", "joint")]
    # A xacro file that was not expanded may have neither, hence the hint.
    if not elements or not root.get("name"):
        missing = "name" if elements else "<link>"
        is_xacro = "xmlns:xacro" in root.attrib and file.source.suffix.lower() != ".xacro"
        hint = "; this is xacro: expand it (xacro IN > OUT), or rename it to end in .xacro" if is_xacro else ""
        raise fault(root, f"the robot has no {missing}{hint}")
    places: dict[str, str] = {}
    for element in elements:
        tag, name = element.tag, element.get("name")
        if not name:
            raise fault(element, f"a <{tag}> has no name")
        if f"{tag} {name}" in places:
            raise fault(element, f"the {tag} name {name!r} is taken at {places[f'{tag} {name}']}; rename one")
        places[f"{tag} {name}"] = f"{file.path}:{element.line}"
        for parent, part in _parts(element):
            # `find` takes the first, and would ignore the second silently.
            if parent.tag in _PARENTS and (first := parent.find(part.tag)) is not part:
                text = f"a second <{part.tag}> of {tag} {name!r}, the first is on line {first.line}; keep one"
                raise fault(part, text)
            for key in REQUIRED.get(part.tag, ()):
                if part.get(key) is None:
                    raise fault(part, f"<{part.tag}> of {tag} {name!r} has no {key}")
            # Ignoring this attribute would give the part a wrong rotation.
            if part.get("quat_xyzw") is not None:
                raise fault(
                    part, f"<{part.tag}> of {tag} {name!r} has quat_xyzw, which is not supported; write it as rpy"
                )
            for key, count in NUMBERS.get(part.tag, {}).items():
                if part.get(key) is not None:
                    file.numbers(part, count, f"{tag} {name!r}", key)
            for key in ("velocity", "effort") if part.tag == "limit" else ():
                # Clipping to -limit .. limit would have an empty range.
                if float(part.get(key, 0)) < 0:
                    raise fault(part, f"{key} of <limit> of {tag} {name!r} is {part.get(key)}; give its magnitude")
    for element in elements:
        if element.tag == "link":
            continue
        name = element.get("name")
        if element.get("type") not in JOINTS:
            kinds = ", ".join(JOINTS)
            raise fault(
                element, f"joint {name!r} has type {element.get('type')!r}, which is unknown; types are {kinds}"
            )
        for end in ("parent", "child"):
            if (part := element.find(end)) is None:
                raise fault(element, f"joint {name!r} has no <{end}>")
            if f"link {part.get('link')}" not in places:
                raise fault(part, f"joint {name!r}: the {end} link {part.get('link')!r} is not in the file")
    return elements, places


def _parts(element) -> Iterator[tuple]:
    """Yield the used elements below an element with their parents, in the file's order, without visual ones."""
    for part in element:
        # Their <origin> is another one than the link's or the joint's.
        if element.tag not in ("visual", "collision") and part.tag in _READ:
            yield element, part
        yield from _parts(part)


# Attributes of <inertia>, in the order of the entries of the matrix.
_INERTIA_ATTRIBUTES = np.array([["ixx", "ixy", "ixz"], ["ixy", "iyy", "iyz"], ["ixz", "iyz", "izz"]])


class Inertial(NamedTuple):
    """Inertial data of a link; None where the file has no such element.

    `mass` in kg; `inertia` (3, 3) in kg m^2, about the centre of mass, in the axes of `origin`; `origin` (4, 4): pose of a frame
    at the centre of mass, in the link's frame.
    """

    mass: float | None
    inertia: np.ndarray | None
    origin: np.ndarray | None


class Mimic(NamedTuple):
    """Coupling of a joint's position q to that of another one: q = multiplier q[joint] + offset (rad or m)."""

    joint: str
    multiplier: float
    offset: float


class Joint(NamedTuple):
    """Joint as the file describes it.

    `origin` (4, 4): pose of the joint's frame, which is the child's at q = 0, in the parent's frame. `axis` (3,): in the joint's
    frame, not normalised. `limit` and `dynamics`: the numeric attributes that the file has, in its units; `limit` is None
    without the element.
    """

    name: str
    type: str
    parent: str
    child: str
    origin: np.ndarray
    axis: np.ndarray
    limit: dict[str, float] | None
    dynamics: dict[str, float]
    mimic: Mimic | None


class Parts(NamedTuple):
    """Contents of a file: the robot's name, its links and joints by name in the order of the file, and the line of each.

    A link without inertial data is None. `children`: names of the joints that a link carries; `root`: the link that none moves.
    """

    name: str
    links: dict[str, Inertial | None]
    joints: dict[str, Joint]
    places: dict[str, str]  # "joint NAME" and "link NAME" -> file:line
    children: dict[str, list[str]]
    root: str


def read_parts(file: XmlFile) -> Parts:
    """Read the links and joints of a file.

    **Raises:** ValueError with file and line, for everything that `check_elements` refuses, and unless the links form one tree.
    """
    elements, places = check_elements(file)
    links: dict[str, Inertial | None] = {}
    for link in (part for part in elements if part.tag == "link"):
        inertial = links[link.get("name")] = link.find("inertial")
        if inertial is not None:
            mass, inertia = inertial.find("mass"), inertial.find("inertia")
            rows = [] if inertia is None else [[float(inertia.get(key)) for key in row] for row in _INERTIA_ATTRIBUTES]
            links[link.get("name")] = Inertial(
                None if mass is None else float(mass.get("value")), np.array(rows) if rows else None, _origin(inertial)
            )
    joints = {part.get("name"): _joint(part) for part in elements if part.tag == "joint"}
    children: dict[str, list[str]] = {name: [] for name in links}
    for joint in joints.values():
        children[joint.parent].append(joint.name)
    root = _root(joints, links, places, file.path)
    return Parts(file.root.get("name") or "", links, joints, places, children, root)


def _root(joints: dict[str, Any], links: dict[str, Any], places: dict[str, str], path) -> str:
    """Root link, the only one that no joint moves. **Raises:** ValueError unless the links form one tree."""
    moved_by: dict[str, str] = {}
    for joint in joints.values():
        if joint.child in moved_by:
            where, other = places[f"joint {joint.name}"], moved_by[joint.child]
            fault = f"link {joint.child!r} is the child of joints {other!r} and {joint.name!r}"
            raise ValueError(f"{where}: {fault}; a URDF is a tree, close loops with a constraint")
        moved_by[joint.child] = joint.name
    roots = [name for name in links if name not in moved_by]
    if len(roots) > 1:
        raise ValueError(f"{path}: there are {len(roots)} root links: {', '.join(roots)}; join them by a joint")
    # The chain of parents of every link ends at the root, unless it is a cycle.
    sound = set(roots)
    for start in links:
        visited, link = [], start
        while link not in sound:
            if link in visited:
                circle = visited[visited.index(link) :]
                where = places[f"joint {moved_by[link]}"]
                raise ValueError(
                    f"{where}: the links {', '.join(circle)} form a cycle; a URDF is a tree, remove a joint"
                )
            visited.append(link)
            link = joints[moved_by[link]].parent
        sound.update(visited)
    return roots[0]


def add_elements_without_effect(file: XmlFile, left: NotTaken) -> None:
    """Add the elements and attributes of a file that a model does not represent."""
    robot = file.root.get("name") or "robot"
    elements: list = [(file.root, robot, URDF_ROBOT)]
    tables = {"link": URDF_LINK, "joint": URDF_JOINT, "gazebo": URDF_GAZEBO}
    for element in file.root:
        if element.tag in tables:
            elements.append((element, element.get("name") or element.get("reference") or robot, tables[element.tag]))
    for what, names in unread_parts(file, elements).items():
        left.add(what, names)


def _joint(element) -> Joint:
    axis, limit, mimic = (element.find(tag) for tag in ("axis", "limit", "mimic"))
    origin, coupling = _origin(element), None
    if mimic is not None:
        coupling = Mimic(mimic.get("joint"), float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0")))
    return Joint(
        element.get("name"),
        element.get("type"),
        element.find("parent").get("link"),
        element.find("child").get("link"),
        np.eye(4) if origin is None else origin,
        # The format's default axis is x; SDF's is z.
        _vector(axis, "xyz", "1 0 0"),
        None if limit is None else _numbers(limit),
        _numbers(element.find("dynamics")),
        coupling,
    )


def _origin(element) -> np.ndarray | None:
    origin = element.find("origin")
    if origin is None:
        return None
    pose = np.eye(4)
    pose[:3, :3] = host_math.rotation_from_rpy(_vector(origin, "rpy", "0 0 0"))
    pose[:3, 3] = _vector(origin, "xyz", "0 0 0")
    return pose


def _vector(element, key: str, default: str) -> np.ndarray:
    text = default if element is None else element.get(key, default)
    return np.array([float(part) for part in text.split()])


def _numbers(element) -> dict[str, float]:
    """Numeric attributes of an element, of those that the format defines (`NUMBERS`)."""
    if element is None:
        return {}
    return {key: float(element.get(key)) for key in NUMBERS[element.tag] if element.get(key) is not None}
