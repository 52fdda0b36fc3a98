"""XML parsing to ElementTree elements with line numbers, and readers whose errors name file and line.

Entity declarations are refused: robot files need none, and a few nested ones expand to gigabytes. A file is decoded here by
Python's codecs, since expat knows only four encodings, none of them the multi-byte ones of East Asia.

Files .xacro are expanded by the package xacro. `$(find NAME)` is the folder of a package. xacro asks the index of an installed
ROS for it. Here the folders that the caller gives come first, then a folder NAME beside the file or above it, as repositories of
robots have them, and ROS only after these.
"""

import codecs
import os
import pathlib
import re
import tempfile
from collections.abc import Iterator, Mapping
from typing import Any, NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from jaxdyn.model import host_math
from jaxdyn.model.arguments import as_path, parse_number

_FIND = re.compile(r"\$\(find\s+([^)\s]+)\s*\)")
_INCLUDE = re.compile(r"""(<xacro:include\s[^>]*?filename\s*=\s*)(["'])(.*?)\2""")


def expand(path: pathlib.Path, arguments: Mapping[str, Any], packages: Mapping[str, str | os.PathLike]) -> str:
    """Expand a xacro file to text, with the line numbers of `xacro FILE`.

    **Arguments:** `arguments` of its `<xacro:arg>`; `packages`: folders by the names of packages.

    **Raises:** ValueError for a folder that does not exist, a package that is not found, and what xacro refuses. ImportError
    without xacro.
    """
    try:
        import xacro
    except ImportError as error:
        raise ImportError(f"{path}: reading xacro files needs the package xacro: pip install jaxdyn[xacro]") from error
    for name, folder in packages.items():
        if not pathlib.Path(folder).is_dir():
            raise ValueError(f"packages[{name!r}] is {str(folder)!r}, which is no folder; give that of the package")
    # xacro reads "true" and "false" in lower case.
    words = {name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in arguments.items()}
    with tempfile.TemporaryDirectory() as place:
        copies = _Copies(pathlib.Path(place), packages)
        try:
            return xacro.process_file(str(copies.copy(path)), mappings=words).toprettyxml(indent="  ")  # pyright: ignore[reportAttributeAccessIssue]
        except Exception as error:  # expressions of a file raise anything
            reason = copies.restore(" ".join(str(error).split()) or type(error).__name__)
            fix = "correct the file, or give its arguments={NAME: VALUE}"
            if copies.missing:
                name = copies.missing[0]
                reason = (
                    f"the folder of package {name!r}, which the file names by $(find {name}), is not known ({reason})"
                )
                fix = f"give packages={{{name!r}: FOLDER}}"
            raise ValueError(f"{path}: xacro: {reason}; {fix}") from error


class _Copies:
    """Copies of xacro files with folders in place of `$(find NAME)`; files without one stay where they are."""

    def __init__(self, place: pathlib.Path, packages: Mapping[str, str | os.PathLike]):
        self.place, self.packages = place, packages
        self.done: dict[pathlib.Path, pathlib.Path] = {}
        self.missing: list[str] = []

    def copy(self, path: pathlib.Path) -> pathlib.Path:
        """Path of a file whose packages are found, and of the files that it includes."""
        path = path.absolute()
        if path in self.done:
            return self.done[path]
        # Files may include each other; the copy's name stands before its text.
        here = self.done[path] = self.place / f"{len(self.done)}_{path.name}"
        try:
            text = path.read_bytes().decode("utf-8")
        except (OSError, UnicodeDecodeError):
            self.done[path] = path
            return path
        found = _FIND.sub(lambda mark: self._folder(mark[1], path) or mark[0], text)
        found = found.replace("$(dirname)", str(path.parent))

        def include(mark: re.Match) -> str:
            name, wanted = mark[3], path.parent / mark[3]
            # A name with an expression is known to xacro alone; it is relative to the file itself.
            if "${" in name or "$(" in name:
                wanted = name if name.startswith(("$", "/")) else wanted
            elif wanted.is_file():
                wanted = self.copy(wanted)
            return f"{mark[1]}{mark[2]}{wanted}{mark[2]}"

        here.write_text(_INCLUDE.sub(include, found), encoding="utf-8")
        return here

    def restore(self, text: str) -> str:
        """A message with the paths of the files in place of those of their copies."""
        for path, copy in self.done.items():
            text = text.replace(str(copy), str(path))
        return text

    def _folder(self, name: str, path: pathlib.Path) -> str | None:
        if name in self.packages:
            return str(pathlib.Path(self.packages[name]).absolute())
        for above in path.parents:
            for folder in (above, above / name):
                if folder.name == name and folder.is_dir():
                    return str(folder)
        self.missing.append(name)
        return None


class Element(ElementTree.Element):
    """Element with the line on which it starts."""

    line: int = 0


# UTF-32 before UTF-16: the mark of UTF-32-LE begins with that of UTF-16-LE.
_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"))
_MARKS += (
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
    (b"<\0", "utf-16-le"),
    (b"\0<", "utf-16-be"),
)
_DECLARED = re.compile(rb"""<\?xml[^>]*?\sencoding\s*=\s*["']([^"'>]+)["']""")


# Attributes and elements of URDF, MJCF and SDF that place links and joints.
_PLACES = {"xyz", "rpy", "pos", "quat", "euler", "axisangle", "xyaxes", "zaxis", "axis", "anchor", "relpose", "pose"}
# Elements whose places do not matter for the closing of loops.
_NO_PLACES = {"inertial", "visual", "collision", "geom", "camera", "light", "asset"}
_NUMBER = re.compile(r"[-+]?(\d*)\.?(\d*)(?:[eE]([-+]?\d+))?$")
# Numbers of one or two digits (1, 0.5, -1.2) are meant as they stand. Coarser rounding than the largest one cannot be
# distinguished from a mechanism that does not close; finer rounding than the least one is lost in that of the computation.
_PLAIN_DIGITS, _MIN_ROUNDING, LARGEST_ROUNDING = 2, 1e-12, 1e-3


def rounding_of_digits(root: ElementTree.Element) -> float:
    """Rounding of the numbers that place links and joints: half a unit of the last digit of the coarsest one, m or rad.

    0 where all numbers are plain ones, or have the digits of float64.
    """
    largest = 0.0
    for word in " ".join(_placing_texts(root)).split():
        match = _NUMBER.match(word)
        if match is None:
            continue
        whole, decimals, exponent = match.groups()
        if decimals and len((whole + decimals.rstrip("0")).lstrip("0")) > _PLAIN_DIGITS:
            largest = max(largest, 0.5 * 10.0 ** (int(exponent or 0) - len(decimals)))
    return min(largest, LARGEST_ROUNDING) if largest > _MIN_ROUNDING else 0.0


def _placing_texts(element: ElementTree.Element) -> Iterator[str]:
    yield from (value for name, value in element.items() if name in _PLACES)
    if element.tag in _PLACES:
        yield element.text or ""
    for child in element:
        if child.tag not in _NO_PLACES:
            yield from _placing_texts(child)


class XmlFile:
    """XML file with its root element, and readers of numbers and words whose errors name file and line.

    The text is decoded by the declared encoding, if Python knows it, else as UTF-8. `is_utf8` is true when the
    bytes are UTF-8. A file whose name ends in .xacro is expanded first, with `arguments` for its `<xacro:arg>` and the folders of
    `packages`; lines are then those of the expanded text.

    **Raises:** ValueError with file and line for a file that cannot be read, decoded or expanded, is malformed or declares
    entities; for `arguments` and `packages` of a file that is no xacro. ImportError for a xacro file without the package xacro.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        kind: str,
        arguments: Mapping[str, Any] | None = None,
        packages: Mapping[str, str | os.PathLike] | None = None,
    ):
        self.source = as_path(path)
        self.path = str(self.source)
        is_xacro = self.source.suffix.lower() == ".xacro"
        for name, given in (("arguments", arguments), ("packages", packages)):
            if given and not is_xacro:
                raise ValueError(f"{name} is {dict(given)}, but {self.path} is no .xacro file; leave it out")
        try:
            with open(self.path, "rb") as file:
                data = file.read()
        except OSError as error:
            raise ValueError(f"{kind} file {self.path!r} cannot be read ({error.strerror}); check the path") from error
        text, encoding = (
            (expand(self.source, arguments or {}, packages or {}), "utf-8") if is_xacro else _decode(self.path, data)
        )
        self.path += " (expanded)" * is_xacro
        self.is_utf8 = data.isascii() or encoding.lower().replace("_", "-") in ("utf-8", "utf8", "utf-8-sig")
        # A text handed to expat is UTF-8, whatever it declares.
        parser = expat.ParserCreate()

        def element(tag, attributes) -> Element:
            made = Element(tag, attributes)
            made.line = parser.CurrentLineNumber
            return made

        def entity(name, *_) -> NoReturn:
            # Refused at the declaration, before anything can expand.
            raise ValueError(
                f"{self.path}:{parser.CurrentLineNumber}: the file declares the entity {name!r}, which is refused, as "
                "entities can expand without bound; write its text where it is used"
            )

        builder = ElementTree.TreeBuilder(element)
        # Without this, expat reports each line of a text separately.
        parser.buffer_text = True
        parser.StartElementHandler = builder.start
        parser.EndElementHandler = builder.end
        parser.CharacterDataHandler = builder.data
        parser.EntityDeclHandler = entity
        try:
            parser.Parse(text, True)
        except expat.ExpatError as error:
            lines = text.split("\n")
            line = lines[error.lineno - 1].strip() if error.lineno <= len(lines) else ""
            shown = f" at {line[:80]!r}" if line else ""
            reason = f"malformed XML: {expat.ErrorString(error.code)}{shown}"
            raise ValueError(f"{self.path}:{error.lineno}: {reason}") from error
        self.root = builder.close()

    def fault(self, element, text: str) -> ValueError:
        """Error that names the file and the element's line."""
        return ValueError(f"{self.path}:{getattr(element, 'line', '')}: {text}")

    def name(self, element, what: str) -> str:
        """Attribute `name`. **Raises:** ValueError where there is none."""
        if not (name := (element.get("name") or "").strip()):
            raise self.fault(element, f"a <{element.tag}> of {what} has no name")
        return name

    def word(self, element, tag: str, default: str = "") -> str:
        """Text of a child element, or the default where there is none."""
        return (element.findtext(tag) or default).strip()

    def numbers(
        self, element, count: int | tuple[int, ...], what: str, key: str | None = None, default: Any = None
    ) -> np.ndarray:
        """Read the finite numbers in an element, or in its attribute `key`, which may be missing where there is a default.

        **Raises:** ValueError for another count than `count`.
        """
        counts = (count,) if isinstance(count, int) else count
        text = ((element.text if key is None else element.get(key)) or "").strip()
        if not text and default is not None:
            return np.asarray(default, float)
        try:
            values = np.array([parse_number(part) for part in text.split()])
        except ValueError:
            values = np.zeros(0)
        if len(values) not in counts or not np.isfinite(values).all():
            wanted = "a finite number" if counts == (1,) else f"{' or '.join(map(str, counts))} finite numbers"
            name = f"<{element.tag}>" if key is None else f"{key} of <{element.tag}>"
            raise self.fault(element, f"{name} of {what} is {text!r}; give {wanted}")
        return values

    def pose_numbers(self, pose, what: str) -> np.ndarray:
        """Matrix (4, 4) of an SDF <pose>: x y z and roll pitch yaw, in degrees or as a quaternion where stated."""
        kind, degrees = pose.get("rotation_format") or "euler_rpy", (pose.get("degrees") or "").lower() in ("1", "true")
        if kind not in ("euler_rpy", "quat_xyzw") or (degrees and kind == "quat_xyzw"):
            fault = f"rotation_format {kind!r}" + " in degrees" * degrees
            raise self.fault(pose, f"<pose> of {what} has the {fault}; give euler_rpy, or quat_xyzw without degrees")
        if kind == "quat_xyzw":
            values = self.numbers(pose, 7, what)
            if not values[3:].any():
                raise self.fault(pose, f"<pose> of {what} has the quaternion zero; give x y z qx qy qz qw")
            # The format writes (x, y, z, w); the library has (w, x, y, z).
            return host_math.joint_pose("free", np.zeros(6), np.concatenate([values[:3], values[6:], values[3:6]]))
        values = self.numbers(pose, 6, what)
        turn = np.deg2rad(values[3:]) if degrees else values[3:]
        return np.asarray(host_math.pose_matrix((values[:3], turn), what))

    def number(self, element, tag: str, default: float, what: str, *, finite: bool = True) -> float:
        """Read a number in a child element `tag` (a path), or the default where it is missing or empty."""
        child = None if element is None else element.find(tag)
        if child is None or not (child.text or "").strip():
            return default
        # These words alone: `float` would accept "nan" too.
        if not finite and (child.text or "").strip().lower() in ("inf", "+inf", "-inf"):
            return float(child.text or "")
        return float(self.numbers(child, 1, what)[0])

    def flag(self, element, tag: str, what: str) -> bool:
        """Read a truth value in a child element, false where there is none."""
        child = None if element is None else element.find(tag)
        text = "" if child is None else (child.text or "").strip().lower()
        # Any other text counted as false would silently change the model.
        if text not in ("", "0", "1", "true", "false"):
            raise self.fault(child, f"<{tag}> of {what} is {text!r}; give true or false")
        return text in ("1", "true")


def _decode(path: str, data: bytes) -> tuple[str, str]:
    """Decode an XML file by its declared encoding or its byte order mark; return text and encoding."""
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), None)
    if encoding is None:
        declared = _DECLARED.match(data.lstrip())
        # The default of XML.
        encoding = "utf-8" if declared is None else declared[1].decode(errors="replace")
        # Declared UTF-16 or UTF-32 without a byte order mark, in single bytes: the declaration is wrong.
        if re.match("(utf|ucs)[-_]?(16|32|2|4)", encoding.lower()):
            raise ValueError(
                f'{path}:1: the XML declaration says {encoding}, in bytes that are not; write encoding="UTF-8", or leave it out'
            )
    try:
        text = data.decode(encoding)
        text.encode("utf-8")  # expat refuses lone surrogates
    except LookupError as error:
        raise ValueError(
            f"{path}:1: the encoding {encoding!r} of the XML declaration is unknown; save the file as UTF-8"
        ) from error
    except UnicodeError as error:
        line = data[: getattr(error, "start", 0)].count(b"\n") + 1
        raise ValueError(
            f"{path}:{line}: the text is not {encoding} ({getattr(error, 'reason', error)}); save the file as UTF-8, or name its "
            "encoding in the XML declaration"
        ) from error
    return text, encoding
