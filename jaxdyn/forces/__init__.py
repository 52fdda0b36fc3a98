"""Generalised forces listed in a `Scene`: joint springs, drives and friction, and dissipation functions.

Imports `dynamics` and what is below it.
"""

from jaxdyn.forces.dissipation import RayleighDissipation as RayleighDissipation
from jaxdyn.forces.dissipation import SlidingFriction as SlidingFriction
from jaxdyn.forces.elements import CoulombFriction as CoulombFriction
from jaxdyn.forces.elements import Drive as Drive
from jaxdyn.forces.elements import ExternalWrench as ExternalWrench
from jaxdyn.forces.elements import JointDamping as JointDamping
from jaxdyn.forces.elements import JointSpring as JointSpring
from jaxdyn.forces.limits import EffortLimits as EffortLimits
from jaxdyn.forces.limits import JointStops as JointStops
from jaxdyn.forces.piecewise import PiecewiseForce as PiecewiseForce

__all__ = [
    "CoulombFriction",
    "Drive",
    "EffortLimits",
    "ExternalWrench",
    "JointDamping",
    "JointSpring",
    "JointStops",
    "PiecewiseForce",
    "RayleighDissipation",
    "SlidingFriction",
]


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return __all__
