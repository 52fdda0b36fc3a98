"""XML as ElementTree elements that know their line, and reads that say where a file is wrong.

Entity declarations are refused: robot files need none, and a few nested ones expand to gigabytes.
"""

import os
from typing import NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from jaxdyn.model import float64 as f64
from jaxdyn.model.arguments import as_path


class Element(ElementTree.Element):
    """An element with the line on which it starts."""

    line: int = 0


class XmlFile:
    """An XML file: its root element, and reads of numbers and words that raise with file and line.

    **Raises:** ValueError with file and line for a file that cannot be read, is malformed or declares entities.
    """

    def __init__(self, path: str | os.PathLike, kind: str):
        self.path = str(as_path(path))
        try:
            with open(self.path, "rb") as file:
                data = file.read()
        except OSError as error:
            raise ValueError(f"{kind} file {self.path!r} cannot be read ({error.strerror}); check the path") from error
        parser = expat.ParserCreate()

        def element(tag, attributes) -> Element:
            made = Element(tag, attributes)
            made.line = parser.CurrentLineNumber
            return made

        def entity(name, *_) -> NoReturn:
            raise ValueError(
                f"{self.path}:{parser.CurrentLineNumber}: the file declares the entity {name!r}, which is refused, as "
                "entities can expand without bound; write its text where it is used"
            )

        builder = ElementTree.TreeBuilder(element)
        parser.buffer_text = True
        parser.StartElementHandler = builder.start
        parser.EndElementHandler = builder.end
        parser.CharacterDataHandler = builder.data
        parser.EntityDeclHandler = entity
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            lines = data.splitlines()
            text = lines[error.lineno - 1].decode(errors="replace").strip() if error.lineno <= len(lines) else ""
            shown = f" at {text[:80]!r}" if text else ""
            reason = f"malformed XML: {expat.ErrorString(error.code)}{shown}"
            raise ValueError(f"{self.path}:{error.lineno}: {reason}") from error
        self.root = builder.close()

    def fault(self, element, text: str) -> ValueError:
        """An error that names the file and the element's line."""
        return ValueError(f"{self.path}:{getattr(element, 'line', '')}: {text}")

    def name(self, element, what: str) -> str:
        """The attribute `name`. **Raises:** ValueError where there is none."""
        if not (name := (element.get("name") or "").strip()):
            raise self.fault(element, f"a <{element.tag}> of {what} has no name")
        return name

    def word(self, element, tag: str, default: str = "") -> str:
        """Text of a child element, or the default where there is none."""
        return (element.findtext(tag) or default).strip()

    def numbers(self, element, count: int | tuple[int, ...], what: str) -> np.ndarray:
        """The finite numbers that an element holds. **Raises:** ValueError for others than `count` of them."""
        counts = (count,) if isinstance(count, int) else count
        text = (element.text or "").strip()
        try:
            values = np.array([float(part) for part in text.split()])
        except ValueError:
            values = np.zeros(0)
        if len(values) not in counts or not np.isfinite(values).all():
            wanted = " or ".join(str(n) for n in counts)
            raise self.fault(element, f"<{element.tag}> of {what} is {text!r}; give {wanted} finite numbers")
        return values

    def pose_numbers(self, pose, what: str) -> np.ndarray:
        """The numbers of an SDF <pose> as (4, 4): x y z and roll pitch yaw, in degrees or as a quaternion where it says so."""
        if pose.get("rotation_format") == "quat_xyzw":
            values = self.numbers(pose, 7, what)
            if not values[3:].any():
                raise self.fault(pose, f"<pose> of {what} has the quaternion zero; give x y z qx qy qz qw")
            return f64.joint_pose("free", np.zeros(6), np.concatenate([values[:3], values[6:], values[3:6]]))
        values = self.numbers(pose, 6, what)
        turn = np.deg2rad(values[3:]) if (pose.get("degrees") or "").lower() in ("1", "true") else values[3:]
        return np.asarray(f64.pose_matrix((values[:3], turn), what))

    def number(self, element, tag: str, default: float, what: str, *, finite: bool = True) -> float:
        """A number in a child element `tag` (a path), or the default where there is none or it is empty."""
        child = None if element is None else element.find(tag)
        if child is None or not (child.text or "").strip():
            return default
        if not finite and (child.text or "").strip().lower() in ("inf", "+inf", "-inf"):
            return float(child.text or "")
        return float(self.numbers(child, 1, what)[0])

    def flag(self, element, tag: str, what: str) -> bool:
        """A truth value in a child element, false where there is none."""
        child = None if element is None else element.find(tag)
        text = "" if child is None else (child.text or "").strip().lower()
        if text not in ("", "0", "1", "true", "false"):
            raise self.fault(child, f"<{tag}> of {what} is {text!r}; give true or false")
        return text in ("1", "true")
