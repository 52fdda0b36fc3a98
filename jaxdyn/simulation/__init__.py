"""Motions: `run` is `jd.simulate`, `methods` how a scene becomes an ordinary differential equation, `solvers/` the methods of
diffrax and of our own, `hybrid/` motions with events, `variational` steps for long motions, `time_scales` how stiff a scene is.

Imports `reduction`, `constraints` and what is below them; the only room that integrates.
"""

from jaxdyn.simulation.limits import JointLimitWarning as JointLimitWarning
from jaxdyn.simulation.time_scales import Stiffness as Stiffness

__all__ = [
    "JointLimitWarning",
    "Stiffness",
]


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return __all__
