"""Control laws: Modules called as `law(q, v, t) -> tau`, with gains and targets as leaves.

`errors` defines gains, and control errors as constraint rows; `motion` has the laws of free motion, `hybrid_force` those of
motion and force on constraints, `legs` and `unactuated` those of robots and objects without motors of their own.

Sources: EQUATIONS sections 8 to 10.
"""

from types import ModuleType as _ModuleType

from jaxdyn.control.hybrid_force import GaugeInvariant as GaugeInvariant
from jaxdyn.control.hybrid_force import HybridForce as HybridForce
from jaxdyn.control.ilqr import OptimalControl as OptimalControl
from jaxdyn.control.ilqr import ilqr as ilqr
from jaxdyn.control.legs import Foot as Foot
from jaxdyn.control.legs import GroundForces as GroundForces
from jaxdyn.control.legs import LeggedDynamics as LeggedDynamics
from jaxdyn.control.legs import foot as foot
from jaxdyn.control.legs import missing_wrench as missing_wrench
from jaxdyn.control.legs import underactuated_inverse_dynamics as underactuated_inverse_dynamics
from jaxdyn.control.motion import CartesianStiffness as CartesianStiffness
from jaxdyn.control.motion import ComputedTorque as ComputedTorque
from jaxdyn.control.motion import ContactCoordinates as ContactCoordinates
from jaxdyn.control.motion import OperationalSpace as OperationalSpace
from jaxdyn.control.unactuated import Attitude as Attitude
from jaxdyn.control.unactuated import GraspForce as GraspForce
from jaxdyn.control.unactuated import WholeBody as WholeBody
from jaxdyn.control.unactuated import standing as standing


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
