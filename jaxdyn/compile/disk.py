"""Files that a second process reads instead of compiling again: machine code, programs, and what XLA made of them.

A file is found by a hash of everything that its contents depend on. It is written under another name and moved to its final one,
so that two processes that write it at once do not disturb each other. It ends with a checksum, and one that is damaged counts as
missing. Where the folder cannot be written, everything stays in memory, with one warning.
"""

import collections
import contextlib
import dataclasses
import enum
import functools
import hashlib
import logging
import os
import sys
import tempfile
import types
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyn.compile.jax_adapter import Tracer

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


# --- hashes of Python objects by what they contain, the same in every process: keys of programs on disk ---
#
# Two objects with one hash behave alike when they are traced. Functions and classes of the packages below are hashed by their
# names, since the versions of these packages are a part of every key (`stored.environment`), and what their code makes by its
# contents. Code of users raises `NoFingerprint`, and what depends on it is not stored: it may reach values that its names do not
# show, such as files, attributes of modules that other functions read, or results kept in memory. A key that is wrong thus can
# only miss.


# Packages whose functions depend on their arguments alone, by their top-level names.
_PACKAGES = {
    "jaxdyn", "jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax", "optax", "jaxtyping", "math", "cmath",
    "functools", "itertools", "operator", "collections", "dataclasses", "enum", "typing", "abc", "numbers", "types",
}  # fmt: skip
# Their parts that read files, or have a state that no argument holds.
_IMPURE_MODULES = ("numpy.random", "numpy.lib", "numpy.memmap", "jaxdyn.io", "jaxdyn.cli", "jaxdyn.scale")
_IMPURE_NAMES = {"load", "loadtxt", "genfromtxt", "fromfile", "memmap", "pure_callback", "io_callback", "callback"}
_PLAIN = (type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented), slice, range)
_MAPPINGS = (dict, collections.OrderedDict, types.MappingProxyType)
_JAX_CLASSES = (jax.custom_jvp, jax.custom_vjp, jax.ShapeDtypeStruct)
_IS_HEAP_TYPE = 1 << 9


class NoFingerprint(Exception):
    """An object whose behaviour its contents do not determine, or not for certain."""


def fingerprint(*values: Any) -> bytes:
    """SHA-256 of the contents of these values. **Raises:** `NoFingerprint`."""
    hasher = _Hasher()
    hasher.add(values)
    return hasher.hash.digest()


class _Hasher:
    def __init__(self):
        self.hash = hashlib.sha256()
        # By identity, of objects that have been added the hash of their contents; of those that contain this one their depth.
        self.added: dict[int, bytes | int] = {}
        self.depth = 0
        self.sentinels: dict[int, int] = {}
        self.held: list = []  # so that no other object gets the identity of one of them

    def write(self, *parts: Any) -> None:
        """Add the texts of plain values, each with its length, so that neighbours do not run into each other."""
        for part in parts:
            data = part if isinstance(part, bytes) else repr(part).encode()
            self.hash.update(len(data).to_bytes(8, "little") + data)

    def add(self, x: object) -> None:
        """Add an object."""
        if type(x) in _PLAIN:
            self.write(type(x).__name__, x)
        elif isinstance(x, np.dtype):
            self.write("dtype", x.str, x.name, x.names)  # eight-bit floats share one `str`
        elif isinstance(x, Tracer):
            raise NoFingerprint("a traced value")
        elif isinstance(x, (np.ndarray, np.generic, jax.Array)):
            self.add_array(x)
        elif isinstance(before := self.added.get(id(x)), int):
            # Within itself, as a function that calls itself.
            self.write("again", self.depth - before)
        else:
            # By a hash of its own, so that an object twice and two equal ones are the same: which of these values are depends on
            # what JAX keeps, and on whether they were read from disk.
            self.write(before or self.hash_of(x))

    def hash_of(self, x: object) -> bytes:
        """Hash of an object's contents."""
        outer, self.hash = self.hash, hashlib.sha256()
        self.added[id(x)], self.depth = self.depth, self.depth + 1
        self.held.append(x)
        self.add_object(x)
        self.depth -= 1
        self.added[id(x)] = contents = self.hash.digest()
        self.hash = outer
        return contents

    def add_array(self, x) -> None:
        """An array by its numbers."""
        is_jax = isinstance(x, jax.Array)
        if is_jax and not (x.is_fully_addressable and isinstance(x.dtype, np.dtype)):
            raise NoFingerprint(f"an array of {x.dtype}, or one that other processes share")
        if (isinstance(x, np.ndarray) and type(x) is not np.ndarray) or x.dtype.hasobject:
            raise NoFingerprint(f"a {type(x).__name__} of {x.dtype}")
        self.write("jax" if is_jax else type(x).__name__, x.shape, getattr(x, "weak_type", False))
        self.add(x.dtype)
        self.write(np.asarray(x).tobytes())

    def add_object(self, x: Any) -> None:
        """An object by its kind."""
        if isinstance(x, types.ModuleType):
            if x.__name__.partition(".")[0] not in _PACKAGES:
                raise NoFingerprint(f"the module {x.__name__}, passed as a value")
            self.write("module", x.__name__)
            return
        if type(x) is object:  # a sentinel, which has no contents: all that counts is which one it is
            self.write("object", self.sentinels.setdefault(id(x), len(self.sentinels)))
            return
        if isinstance(x, type) or callable(x):
            if (name := _name_of(x)) is not None:
                self.write("name", *name)
                return
        if isinstance(x, type):
            raise NoFingerprint(f"the class {x.__module__}.{x.__qualname__}")
        if isinstance(x, types.FunctionType):
            self.add_closure(x)
        elif isinstance(x, types.MethodType):
            self.write("method")
            self.add((x.__func__, x.__self__))
        elif isinstance(x, functools.partial):
            self.write("partial")
            self.add((type(x), x.func, x.args, x.keywords))
        elif type(x).__name__ == "PjitFunction":  # of `jax.jit`, whose options do not change values
            self.write("jit")
            self.add(x.__wrapped__)
        elif isinstance(x, jax.tree_util.PyTreeDef):
            self.add_structure(x)
        elif isinstance(x, enum.Enum):
            self.write("enum", x.name)
            self.add(type(x))
        else:
            self.add_instance(x)

    def add_structure(self, x: Any) -> None:
        """The structure of a pytree: its nodes, with what is static in them."""
        data = x.node_data()
        self.write("tree", x.num_nodes, x.num_leaves, data is None)
        if data is not None:
            self.add(tuple(data))
            for child in x.children():
                self.add_structure(child)

    def add_instance(self, x: Any) -> None:
        """A collection, or an instance of a class that a package defines in Python, by its fields."""
        cls = type(x)
        self.write("instance")
        self.add(cls)
        if isinstance(x, tuple) or cls is list:
            self.write(len(x))
            for item in x:
                self.add(item)
        elif cls in _MAPPINGS:
            self.write(len(x))
            for item in x.items():
                self.add(item)
        elif cls in (set, frozenset):
            self.write(*sorted(fingerprint(item) for item in x))
        elif (cls.__module__ or "").partition(".")[0] in ("jax", "jaxlib") and not isinstance(x, _JAX_CLASSES):
            raise NoFingerprint(f"an instance of {cls.__module__}.{cls.__qualname__}")
        else:
            self.add_fields(x)

    def add_fields(self, x: Any) -> None:
        """The fields of an instance."""
        cls = type(x)
        slots = [slot for base in cls.__mro__ for slot in _as_tuple(vars(base).get("__slots__", ()))]
        is_python = all(base.__flags__ & _IS_HEAP_TYPE or base is object for base in cls.__mro__)
        if not is_python or not (slots or hasattr(x, "__dict__")):
            raise NoFingerprint(f"an instance of {cls.__module__}.{cls.__qualname__}, whose contents are not Python's")
        # Data classes keep what they have computed beside their fields, which would change the key.
        is_data = dataclasses.is_dataclass(x)
        names = (
            {field.name for field in dataclasses.fields(x)}
            if is_data
            else set(vars(x))
            if hasattr(x, "__dict__")
            else set()
        )
        names = sorted(name for name in names | set(slots) - {"__dict__", "__weakref__"} if hasattr(x, name))
        self.add(tuple(names))
        for name in names:
            self.add(getattr(x, name))

    def add_closure(self, function: types.FunctionType) -> None:
        """A function made by a package: its code is that of the package's version, its cells and defaults are values."""
        if function.__globals__.get("__name__", "").partition(".")[0] not in _PACKAGES:
            raise NoFingerprint(f"the user's function {function.__qualname__}")
        code = function.__code__
        self.write("closure", function.__module__, function.__qualname__, code.co_firstlineno, code.co_code)
        self.add((function.__defaults__, function.__kwdefaults__, dict(function.__dict__)))
        for cell in function.__closure__ or ():
            try:
                contents = cell.cell_contents
            except ValueError:
                self.write("an empty cell")
            else:
                self.add(contents)


def _as_tuple(slots) -> tuple[str, ...]:
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _name_of(x: Any) -> tuple[str, str] | None:
    """Module and name under which one of the packages has a function or a class; None where that is another object."""
    module, name = getattr(x, "__module__", None), getattr(x, "__qualname__", None) or getattr(x, "__name__", None)
    if isinstance(x, type) and not x.__flags__ & _IS_HEAP_TYPE and module in ("builtins", "types"):
        return module, x.__qualname__
    if module is None and isinstance(x, np.ufunc):
        module = "numpy"
    if not isinstance(module, str) or not isinstance(name, str) or module.partition(".")[0] not in _PACKAGES:
        return None
    if module.startswith(_IMPURE_MODULES) or name in _IMPURE_NAMES:
        raise NoFingerprint(f"{module}.{name}, which may read more than its arguments")
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return (module, name) if found is x else None
