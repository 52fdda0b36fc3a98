"""Simulation of scenes; the only subpackage that integrates.

`run` is `jd.simulate`, `methods` are the differential equations of a scene, `solvers/` the methods of diffrax and of our own,
`hybrid/` motion with events, `variational` steps for long motions. Imports `reduction`, `constraints` and what is below them.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxdyn.simulation.contact_steps import ContactStep as ContactStep
    from jaxdyn.simulation.events import JointLimitWarning as JointLimitWarning
    from jaxdyn.simulation.methods import Baumgarte as Baumgarte
    from jaxdyn.simulation.options import Pose as Pose
    from jaxdyn.simulation.options import Steps as Steps
    from jaxdyn.simulation.solvers.choice import Stiffness as Stiffness

__all__ = ["Baumgarte", "ContactStep", "JointLimitWarning", "Pose", "Steps", "Stiffness"]


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return __all__


def __getattr__(name: str) -> Any:
    # At their first use: diffrax, which one of them imports, is not needed by runs whose programs are on disk.
    homes = {
        "Baumgarte": "methods",
        "ContactStep": "contact_steps",
        "JointLimitWarning": "events",
        "Pose": "options",
        "Steps": "options",
        "Stiffness": "solvers.choice",
    }
    if name not in homes:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{homes[name]}"), name)
