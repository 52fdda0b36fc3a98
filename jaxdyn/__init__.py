"""Rigid-body dynamics in JAX: pure functions of one sample, to be batched, compiled and differentiated."""

import ast
import importlib
import importlib.util
import pkgutil
from typing import Any

import jaxdyn.trace_context  # noqa: F401 (made before the user traces a function)

__version__ = "0.2.0"


def _read_stub() -> tuple[dict[str, tuple[str, str]], list[str]]:
    """Names in the package's type stub, each with its module and its name there, and those that are public.

    The stub is the only list of names: type checkers and editors see what `__getattr__` finds, as in SPEC 1 of Scientific Python.
    """
    homes, public = {}, []
    for node in ast.parse(pkgutil.get_data(__name__, "__init__.pyi") or b"").body:
        if isinstance(node, ast.ImportFrom):
            homes |= {alias.asname or alias.name: (node.module or "", alias.name) for alias in node.names}
        elif isinstance(node, ast.Assign):
            public = ast.literal_eval(node.value)
    return homes, public


_HOMES, __all__ = _read_stub()


def __getattr__(name: str) -> Any:
    """Import a name at its first use (PEP 562); AttributeError for others."""
    if name == "load_urdf":  # a deprecated name, which warns when it is called
        return importlib.import_module("jaxdyn.io").load_urdf
    if name not in _HOMES or name not in __all__:
        # Subpackages that are not public are attributes too, as after `import jaxdyn.compile`.
        if not name.startswith("_") and importlib.util.find_spec(f"{__name__}.{name}") is not None:
            return importlib.import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, present = _HOMES[name]
    home = None if module == __name__ else importlib.import_module(module)
    value = getattr(home, present) if hasattr(home, present) else importlib.import_module(f"{module}.{present}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Public names; the modules behind them are internal."""
    return __all__
