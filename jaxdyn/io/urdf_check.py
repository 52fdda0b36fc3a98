"""Checks of URDF files: names, references and numbers, each fault with its line."""

from collections.abc import Iterator
from typing import Any

from jaxdyn.io.xml_lines import XmlFile

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
            _check_once(parent, part, f"{tag} {name!r}", fault)
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


def _check_once(parent, part, what: str, fault) -> None:
    first = parent.find(part.tag)
    # `find` takes the first, and would ignore the second silently.
    if parent.tag in _PARENTS and first is not part:
        raise fault(part, f"a second <{part.tag}> of {what}, the first is on line {first.line}; keep one")
