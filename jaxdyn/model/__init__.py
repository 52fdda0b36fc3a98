"""Trees of bodies: joint kinds as data, the ten numbers of a body, `Model` and how one is built, ready-made robots.

Imports `lie` and `compile`. Conventions: docs/conventions.md.
"""

from types import ModuleType as _ModuleType

from jaxdyn.model.topology import Topology as Topology
from jaxdyn.model.tree import inertia_report as inertia_report
from jaxdyn.model.tree import repair_inertias as repair_inertias


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
