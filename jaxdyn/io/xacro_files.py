"""Expansion of xacro files by the package xacro, also where no ROS finds the packages that they name.

`$(find NAME)` is the folder of a package. xacro asks the index of an installed ROS for it. Here the folders that the caller gives
come first, then a folder NAME beside the file or above it, as repositories of robots have them, and ROS only after these.
"""

import os
import pathlib
import re
import tempfile
from collections.abc import Mapping
from typing import Any

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
        found = _INCLUDE.sub(lambda mark: mark[1] + mark[2] + self._included(mark[3], path) + mark[2], found)
        here.write_text(found, encoding="utf-8")
        return here

    def restore(self, text: str) -> str:
        """A message with the paths of the files in place of those of their copies."""
        for path, copy in self.done.items():
            text = text.replace(str(copy), str(path))
        return text

    def _included(self, name: str, path: pathlib.Path) -> str:
        # A name with an expression is known to xacro alone; it is relative to the file itself.
        if "${" in name or "$(" in name:
            return name if name.startswith(("$", "/")) else str(path.parent / name)
        wanted = path.parent / name
        return str(self.copy(wanted)) if wanted.is_file() else str(wanted)

    def _folder(self, name: str, path: pathlib.Path) -> str | None:
        if name in self.packages:
            return str(pathlib.Path(self.packages[name]).absolute())
        for above in path.parents:
            for folder in (above, above / name):
                if folder.name == name and folder.is_dir():
                    return str(folder)
        self.missing.append(name)
        return None
