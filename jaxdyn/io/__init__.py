"""Reading and writing mechanisms. File libraries are imported here alone, and only when a file is read."""

from types import ModuleType as _ModuleType
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

from jaxdyn.io.formats import load as load
from jaxdyn.io.formats import load_model as load_model
from jaxdyn.io.loaded import Actuators as Actuators
from jaxdyn.io.loaded import LoadedScene as LoadedScene
from jaxdyn.io.loaded import NotTakenWarning as NotTakenWarning
from jaxdyn.io.loaded import Start as Start
from jaxdyn.io.loaded import UnitsWarning as UnitsWarning
from jaxdyn.io.urdf import urdf_inertia_report as urdf_inertia_report
from jaxdyn.io.urdf_write import read_torque_terms as read_torque_terms
from jaxdyn.io.urdf_write import save_urdf as save_urdf
from jaxdyn.model.arguments import deprecated as _deprecated

if _TYPE_CHECKING:
    from jaxdyn.io.logs import read_log as read_log
    from jaxdyn.io.logs import write_log as write_log


def __getattr__(name: str) -> _Any:
    # At their first use: identification, which they import, takes longer to import than a mechanism to read.
    if name in ("read_log", "write_log"):
        from jaxdyn.io import logs

        return getattr(logs, name)
    # Deprecated names, which warn when they are called.
    if name in ("load_mjcf", "load_sdf", "load_urdf"):
        return _deprecated(f"jd.io.{name}", load_model if name == "load_urdf" else load)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    names = [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
    return sorted({*names, "read_log", "write_log"})
