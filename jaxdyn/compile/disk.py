"""Files that a second process reads instead of compiling again: machine code, programs, and what XLA made of them.

A file is found by a hash of everything that its contents depend on. It is written under another name and moved to its final one,
so that two processes that write it at once do not disturb each other. It ends with a checksum, and one that is damaged counts as
missing. Where the folder cannot be written, everything stays in memory, with one warning.
"""

import contextlib
import functools
import hashlib
import logging
import os
import tempfile
from importlib import metadata
from pathlib import Path

logger = logging.getLogger("jaxdyn")
MAX_CACHE_BYTES = 512 * 2**20
_CHECKSUM_BYTES = 32

_folder: Path | None = None
_is_off = False


def cache_folder() -> Path:
    """Folder of the files: `jaxdyn/kernels` in the user's folder for caches."""
    if _folder is not None:
        return _folder
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache"
    return Path(base) / "jaxdyn" / "kernels"


def set_cache_folder(folder) -> None:
    """Keep the files elsewhere; None for the default place."""
    global _folder, _is_off
    _folder, _is_off = None if folder is None else Path(folder), False


@functools.cache
def hash_of_sources(folder: Path) -> bytes:
    """Hash of the source files of a package or of a part of it."""
    digest = hashlib.sha256()
    for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.ll")]):
        data = path.read_bytes()
        digest.update(f"{path.relative_to(folder)} {len(data)} ".encode() + data)
    return digest.digest()


def version_of(package: str) -> str:
    """Version of an installed package, or an empty text."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def read(name: str) -> bytes | None:
    """Contents of a file; None where it is missing or damaged."""
    try:
        path = cache_folder() / name
        data = path.read_bytes()
    except (OSError, RuntimeError):  # a home that cannot be determined is a RuntimeError
        return None
    contents, checksum = data[:-_CHECKSUM_BYTES], data[-_CHECKSUM_BYTES:]
    if hashlib.sha256(contents).digest() != checksum:
        logger.warning("jaxdyn: %s is damaged and is built again", path)
        return None
    # The time of last use, by which the folder is pruned: file systems often do not note reads.
    with contextlib.suppress(OSError):
        os.utime(path)
    return contents


def write(name: str, contents: bytes) -> None:
    """Write a file, as far as the folder can be written."""
    global _is_off
    if _is_off:
        return
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        handle, part = tempfile.mkstemp(dir=folder, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(contents + hashlib.sha256(contents).digest())
            os.replace(part, folder / name)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(part)
            raise
        _prune(folder)
    except (OSError, RuntimeError) as error:
        # A full disk or a read-only home must not stop a computation.
        _is_off = True
        logger.warning("jaxdyn: nothing is kept on disk, and is compiled again at the next start: %s", error)


@functools.cache  # once in a process
def _prune(folder: Path) -> None:
    """Remove the files that were used longest ago where all of them are more than `MAX_CACHE_BYTES`."""
    files = []
    for path in folder.glob("*"):
        with contextlib.suppress(OSError):
            status = path.stat()
            files.append((status.st_mtime, status.st_size, path))
    excess = sum(size for _, size, _ in files) - MAX_CACHE_BYTES
    for _, size, path in sorted(files):
        if excess <= 0:
            return
        with contextlib.suppress(OSError):
            path.unlink()
        excess -= size
