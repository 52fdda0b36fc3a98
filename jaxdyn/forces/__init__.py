"""Generalised forces listed in a `Scene`: springs, drives, limits and friction of joints, and dissipation functions.

Imports `dynamics` and what is below it.
"""

from types import ModuleType as _ModuleType

from jaxdyn.forces.drives import ElasticTransmission as ElasticTransmission
from jaxdyn.forces.drives import FirstOrderDrive as FirstOrderDrive
from jaxdyn.forces.drives import RayleighDissipation as RayleighDissipation
from jaxdyn.forces.drives import SecondOrderDrive as SecondOrderDrive
from jaxdyn.forces.drives import SlidingFriction as SlidingFriction
from jaxdyn.forces.drives import elastic_joints as elastic_joints
from jaxdyn.forces.elements import CoulombFriction as CoulombFriction
from jaxdyn.forces.elements import Drive as Drive
from jaxdyn.forces.elements import ExternalWrench as ExternalWrench
from jaxdyn.forces.elements import JointDamping as JointDamping
from jaxdyn.forces.elements import JointSpring as JointSpring
from jaxdyn.forces.elements import external_wrenches as external_wrenches
from jaxdyn.forces.piecewise import EffortLimits as EffortLimits
from jaxdyn.forces.piecewise import JointStops as JointStops
from jaxdyn.forces.piecewise import PiecewiseForce as PiecewiseForce
from jaxdyn.forces.piecewise import TorqueSpeedLimits as TorqueSpeedLimits
from jaxdyn.systems.scene import DriveDynamics as DriveDynamics


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
