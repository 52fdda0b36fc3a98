"""Simulation of scenes; the only subpackage that integrates.

`run` is `jd.simulate`, `methods` are the differential equations of a scene, `solvers/` the methods of diffrax and of our own,
`hybrid/` motion with events, `variational` steps for long motions, `stiffness` the rates of a scene. Imports `reduction`,
`constraints` and what is below them.
"""

from jaxdyn.simulation.contact_steps import ContactStep as ContactStep
from jaxdyn.simulation.stiffness import Stiffness as Stiffness
from jaxdyn.simulation.terminal_events import JointLimitWarning as JointLimitWarning

__all__ = [
    "ContactStep",
    "JointLimitWarning",
    "Stiffness",
]


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return __all__
