"""Links and joints of a URDF file as data, with the format's defaults for missing attributes."""

from typing import NamedTuple

import numpy as np

from jaxdyn.io.loaded import summarize
from jaxdyn.io.unread import URDF_GAZEBO, URDF_JOINT, URDF_LINK, URDF_ROBOT, unread_parts
from jaxdyn.io.urdf_check import NUMBERS, check_elements
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import host_math

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

    A link without inertial data is None.
    """

    name: str
    links: dict[str, Inertial | None]
    joints: dict[str, Joint]
    places: dict[str, str]  # "joint NAME" and "link NAME" -> file:line


def read_parts(file: XmlFile) -> Parts:
    """Read the links and joints of a file.

    **Raises:** ValueError with file and line, for everything that `check_elements` refuses.
    """
    elements, places = check_elements(file)
    links = {part.get("name"): _inertial(part.find("inertial")) for part in elements if part.tag == "link"}
    joints = {part.get("name"): _joint(part) for part in elements if part.tag == "joint"}
    return Parts(file.root.get("name") or "", links, joints, places)


def elements_without_effect(file: XmlFile) -> list[str]:
    """Descriptions of elements and attributes of a file that a model does not represent."""
    robot = file.root.get("name") or "robot"
    elements: list = [(file.root, robot, URDF_ROBOT)]
    tables = {"link": URDF_LINK, "joint": URDF_JOINT, "gazebo": URDF_GAZEBO}
    for element in file.root:
        if element.tag in tables:
            elements.append((element, element.get("name") or element.get("reference") or robot, tables[element.tag]))
    return [line for reason, names in unread_parts(file, elements).items() for line in summarize(reason, names)]


def _inertial(element) -> Inertial | None:
    if element is None:
        return None
    mass, inertia = element.find("mass"), element.find("inertia")
    matrix = (
        None if inertia is None else np.array([[float(inertia.get(key)) for key in row] for row in _INERTIA_ATTRIBUTES])
    )
    return Inertial(None if mass is None else float(mass.get("value")), matrix, _origin(element))


def _joint(element) -> Joint:
    axis, limit, mimic = (element.find(tag) for tag in ("axis", "limit", "mimic"))
    origin = _origin(element)
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
        None if mimic is None else _mimic(mimic),
    )


def _mimic(element) -> Mimic:
    return Mimic(element.get("joint"), float(element.get("multiplier", "1")), float(element.get("offset", "0")))


def _origin(element) -> np.ndarray | None:
    origin = element.find("origin")
    if origin is None:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (
        host_math.rotation_from_rpy(_vector(origin, "rpy", "0 0 0")),
        _vector(origin, "xyz", "0 0 0"),
    )
    return pose


def _vector(element, key: str, default: str) -> np.ndarray:
    text = default if element is None else element.get(key, default)
    return np.array([float(part) for part in text.split()])


def _numbers(element) -> dict[str, float]:
    """Numeric attributes of an element, of those that the format defines (`NUMBERS`)."""
    if element is None:
        return {}
    return {key: float(element.get(key)) for key in NUMBERS[element.tag] if element.get(key) is not None}
