"""Constraints: functions of the user, loops closed by joints, couplings, and rolling."""

from types import ModuleType as _ModuleType

from jaxdyn.constraints.base import Constraint as Constraint
from jaxdyn.constraints.base import Holonomic as Holonomic
from jaxdyn.constraints.base import Pfaffian as Pfaffian
from jaxdyn.constraints.base import constraint_jacobian as constraint_jacobian
from jaxdyn.constraints.base import position_residual as position_residual
from jaxdyn.constraints.base import velocity_residual as velocity_residual
from jaxdyn.constraints.dynamics import projections as projections
from jaxdyn.constraints.dynamics import second_fundamental_form as second_fundamental_form
from jaxdyn.constraints.frames import body_wrenches as body_wrenches
from jaxdyn.constraints.frames import constraint_wrenches as constraint_wrenches
from jaxdyn.constraints.loops import distance as distance
from jaxdyn.constraints.loops import gear as gear
from jaxdyn.constraints.loops import lock_joint as lock_joint
from jaxdyn.constraints.loops import loop as loop
from jaxdyn.constraints.loops import model_couplings as model_couplings
from jaxdyn.constraints.rolling import knife_edge as knife_edge
from jaxdyn.constraints.rolling import rolling_sphere as rolling_sphere
from jaxdyn.constraints.rolling import rolling_wheel as rolling_wheel
from jaxdyn.constraints.selection import choose_rows as choose_rows


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
