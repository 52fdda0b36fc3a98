"""Hashes of Python objects by what they contain, the same in every process: keys of programs on disk.

Two objects with one hash behave alike when they are traced. Functions are hashed by their code, defaults, cells and the globals
that they name; functions and classes of the packages below by their names, since the versions of these packages are a part of
every key (`stored.environment`). What cannot be hashed so, such as a file or a function that may read one, raises
`NoFingerprint`: what depends on it is not stored. A key that is wrong thus can only miss.
"""

import builtins
import dataclasses
import dis
import enum
import functools
import hashlib
import sys
import types
from typing import Any

import jax
import numpy as np

from jaxdyn.compile.jax_adapter import Tracer

# Packages whose functions depend on their arguments alone, by their top-level names.
_PACKAGES = {
    "jaxdyn", "jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax", "optax", "jaxtyping", "math", "cmath",
    "functools", "itertools", "operator", "collections", "dataclasses", "enum", "typing", "abc", "numbers", "copy", "warnings",
    "builtins", "types", "fractions", "statistics",
}  # fmt: skip
# Their parts that read files, or have a state that no argument holds.
_IMPURE_MODULES = (
    "numpy.random",
    "numpy.lib._npyio_impl",
    "numpy.lib.npyio",
    "numpy.memmap",
    "jaxdyn.io",
    "jaxdyn.cli",
    "jaxdyn.scale",
)
_IMPURE_NAMES = {"load", "loadtxt", "genfromtxt", "fromfile", "memmap", "pure_callback", "io_callback", "global_rng"}
_IMPURE_BUILTINS = {"open", "eval", "exec", "compile", "globals", "locals", "vars", "input", "id", "hash", "__import__"}
# Entries of classes that say nothing about what instances do.
_CLASS_NOISE = {
    "__dict__", "__weakref__", "__doc__", "_abc_impl", "__annotations__", "__annotate_func__", "__annotations_cache__",
    "__firstlineno__", "__static_attributes__", "__module__", "__qualname__", "__abstractmethods__",
}  # fmt: skip
_PLAIN = (type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented), slice, range)


# Whether code of users is hashed too. Not by default: it may reach values that its names do not show, such as attributes of
# modules that other functions read, or results that were kept in memory before a global changed.
hashes_user_code = False


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
        self.modules: set[int] = set()
        self.held: list = []  # so that no other object gets the identity of one of them

    def write(self, *parts: Any) -> None:
        """Add the texts of plain values, each with its length, so that neighbours do not run into each other."""
        for part in parts:
            data = part if isinstance(part, bytes) else repr(part).encode()
            self.hash.update(len(data).to_bytes(8, "little") + data)

    def add(self, x: Any) -> None:
        """Add an object."""
        if type(x) in _PLAIN:
            self.write(type(x).__name__, x)
        elif isinstance(x, np.dtype):
            self.write("dtype", x.str, x.names)
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

    def hash_of(self, x: Any) -> bytes:
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
        if isinstance(x, jax.Array) and not (x.is_fully_addressable and isinstance(x.dtype, np.dtype)):
            raise NoFingerprint(f"an array of {x.dtype}, or one that other processes share")
        values = np.asarray(x)
        if values.dtype.hasobject:
            raise NoFingerprint("an array of objects")
        kind = "jax" if isinstance(x, jax.Array) else type(x).__name__
        self.write(kind, values.dtype.str, values.shape, getattr(x, "weak_type", False), values.tobytes())

    def add_object(self, x: Any) -> None:
        """An object by its kind."""
        if isinstance(x, types.ModuleType):
            if x.__name__.partition(".")[0] not in _PACKAGES:
                raise NoFingerprint(f"the module {x.__name__}, passed as a value")
            self.write("module", x.__name__)
            return
        if type(x) is object:  # a sentinel, which has no contents
            self.write("object")
            return
        if isinstance(x, type) or callable(x):
            if (name := _name_of(x)) is not None:
                self.write("name", *name)
                return
        if isinstance(x, type):
            self.add_class(x)
        elif isinstance(x, types.FunctionType):
            self.add_function(x)
        elif isinstance(x, types.CodeType):
            self.add_code(x)
        elif isinstance(x, (types.MethodType, staticmethod, classmethod)):
            self.write(type(x).__name__)
            self.add(x.__func__)
            self.add(getattr(x, "__self__", None))
        elif isinstance(x, property):
            self.write("property")
            self.add((x.fget, x.fset, x.fdel))
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
        """A collection, or an instance of a class that Python code defines, by its fields."""
        cls, package = type(x), _package(type(x))
        is_own = package not in _PACKAGES
        fields = [field.name for field in dataclasses.fields(x)] if dataclasses.is_dataclass(x) else None
        if package in ("jax", "jaxlib") and not isinstance(
            x, (jax.custom_jvp, jax.custom_vjp, jax.ShapeDtypeStruct, tuple)
        ):
            raise NoFingerprint(f"an instance of {cls.__module__}.{cls.__qualname__}")
        self.write("instance")
        self.add(cls)
        if isinstance(x, (tuple, list)):
            self.write(len(x))
            for item in x:
                self.add(item)
        elif isinstance(x, (dict, types.MappingProxyType)):
            self.write(len(x))
            for item in x.items():
                self.add(item)
        elif isinstance(x, (set, frozenset)):
            self.write(*sorted(fingerprint(item) for item in x))
        elif any(not base.__flags__ & _IS_HEAP_TYPE and base is not object for base in cls.__mro__):
            raise NoFingerprint(f"an instance of {cls.__module__}.{cls.__qualname__}")
        elif not hasattr(x, "__dict__") and not any("__slots__" in vars(base) for base in cls.__mro__):
            raise NoFingerprint(f"an instance of {cls.__module__}.{cls.__qualname__}, whose contents are not Python's")
        # Instances of these packages keep what they have computed beside their fields, which would change the key.
        state = dict(getattr(x, "__dict__", {})) if is_own or fields is None else {}
        slots = [slot for base in cls.__mro__ for slot in _as_tuple(vars(base).get("__slots__", ()))]
        for name in [*(fields or ()), *slots]:
            if name not in ("__dict__", "__weakref__") and hasattr(x, name):
                state[name] = getattr(x, name)
        self.add(tuple(sorted(state)))
        for name in sorted(state):
            self.add(state[name])

    def add_class(self, cls: type) -> None:
        """A class of the user: its bases and what it defines."""
        if not cls.__flags__ & _IS_HEAP_TYPE and cls.__module__ in ("builtins", "types", "_collections"):
            self.write("builtin", cls.__qualname__)
            return
        if not cls.__flags__ & _IS_HEAP_TYPE or not hashes_user_code:
            raise NoFingerprint(f"the class {cls.__module__}.{cls.__qualname__}")
        self.write("class", cls.__qualname__)
        self.add(type(cls))
        self.add(cls.__bases__)
        for name, value in sorted(vars(cls).items()):
            if name not in _CLASS_NOISE and not isinstance(
                value, (types.MemberDescriptorType, types.GetSetDescriptorType)
            ):
                self.write(name)
                self.add(value)

    def add_function(self, function: types.FunctionType) -> None:
        """A function by its code, and by all that the code can reach."""
        if function.__globals__.get("__name__", "").partition(".")[0] in _PACKAGES:
            # A closure made by a package: its code is that of the package's version.
            code = function.__code__
            self.write("closure", function.__module__, function.__qualname__, code.co_firstlineno, code.co_code)
        else:
            if not hashes_user_code:
                raise NoFingerprint(f"the user's function {function.__qualname__}")
            self.write("function")
            self.add(function.__code__)
            self.add_globals(function)
        self.add((function.__defaults__, function.__kwdefaults__, dict(function.__dict__)))
        for cell in function.__closure__ or ():
            try:
                contents = cell.cell_contents
            except ValueError:
                self.write("an empty cell")
            else:
                self.add(contents)

    def add_code(self, code: types.CodeType) -> None:
        """Code by its instructions, constants and names."""
        self.write(
            code.co_code, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, code.co_flags,
            code.co_argcount, code.co_kwonlyargcount, code.co_posonlyargcount, code.co_exceptiontable,
        )  # fmt: skip
        self.add(code.co_consts)

    def add_globals(self, function: types.FunctionType) -> None:
        """Values of the global names in a function's code, and in the functions that it defines."""
        names = _names(function.__code__)
        for name in sorted(names):
            if name in function.__globals__:
                self.write(name)
                self.add_reachable(function.__globals__[name], names)
            elif name in _IMPURE_BUILTINS and hasattr(builtins, name):
                raise NoFingerprint(f"a function that calls {name}")

    def add_reachable(self, value: Any, names: set[str]) -> None:
        """A global value; of a module, what the names may read of it."""
        if not isinstance(value, types.ModuleType):
            self.add(value)
        elif value.__name__.partition(".")[0] in _PACKAGES:
            _check_pure(value.__name__, names)
            self.write("module", value.__name__)
        elif id(value) not in self.modules:
            self.modules.add(id(value))
            self.write("module", value.__name__)
            if not _is_python(value):
                raise NoFingerprint(f"a function that reads the module {value.__name__}")
            for name in sorted(names & set(vars(value))):
                self.write(name)
                self.add_reachable(vars(value)[name], names)


_IS_HEAP_TYPE = 1 << 9
_INSTALLED = ("site-packages", "dist-packages")


def _is_python(module: types.ModuleType) -> bool:
    """Decide whether a module is one of the user's own, whose values are those that it shows."""
    file = getattr(module, "__file__", None) or ""
    is_library = file.startswith((sys.base_prefix, sys.prefix)) or any(part in file for part in _INSTALLED)
    return file.endswith(".py") and not is_library


def _check_pure(module: str, names: set[str]) -> None:
    """**Raises:** `NoFingerprint` where code that names this module may read a file or a hidden state."""
    impure = names & _IMPURE_NAMES
    if impure or module.startswith(_IMPURE_MODULES) or (module.partition(".")[0] == "numpy" and "random" in names):
        raise NoFingerprint(f"a function that may read more than its arguments: {', '.join(sorted(impure)) or module}")


def _names(code: types.CodeType) -> set[str]:
    """Global names and attributes in code, and in the code within it. **Raises:** `NoFingerprint` for imports."""
    names = set(code.co_names)
    if any(
        x.opname == "IMPORT_NAME" and x.argval.partition(".")[0] not in _PACKAGES for x in dis.get_instructions(code)
    ):
        raise NoFingerprint("a function that imports a module")
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            names |= _names(constant)
    return names


def _package(x: Any) -> str:
    return (getattr(x, "__module__", None) or "").partition(".")[0]


def _as_tuple(slots) -> tuple[str, ...]:
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _name_of(x: Any) -> tuple[str, str] | None:
    """Module and name under which one of the packages has a function or a class; None where that is another object."""
    module, name = getattr(x, "__module__", None), getattr(x, "__qualname__", None) or getattr(x, "__name__", None)
    if module is None and isinstance(x, (types.BuiltinFunctionType, np.ufunc)):
        module = "builtins" if isinstance(x, types.BuiltinFunctionType) else "numpy"
    if not isinstance(module, str) or not isinstance(name, str) or module.partition(".")[0] not in _PACKAGES:
        return None
    if (
        module.startswith(_IMPURE_MODULES)
        or name in _IMPURE_NAMES
        or (module == "builtins" and name in _IMPURE_BUILTINS)
    ):
        raise NoFingerprint(f"{module}.{name}, which may read more than its arguments")
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return (module, name) if found is x else None
