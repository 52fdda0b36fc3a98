"""Dynamics of trees: quantities and kinematics, and four algorithms that check each other (EQUATIONS sections 2 to 5, 11).

`quantities` and `kinematics` hold the public functions; the algorithms are the recursions,
the matrix form in world axes and in link frames, and scans for many bodies (EQUATIONS sections 2 to 5, 11).

Imports `systems` and what is below it. The four algorithms do not import each other.
"""

from types import ModuleType as _ModuleType

from jaxdyn.dynamics.centroidal import ComDynamics as ComDynamics
from jaxdyn.dynamics.centroidal import SpatialForm as SpatialForm
from jaxdyn.dynamics.centroidal import centroidal_momentum as centroidal_momentum
from jaxdyn.dynamics.centroidal import centroidal_momentum_matrix as centroidal_momentum_matrix
from jaxdyn.dynamics.centroidal import com_dynamics as com_dynamics
from jaxdyn.dynamics.centroidal import spatial_form as spatial_form
from jaxdyn.dynamics.frame_motion import ArticulatedBodies as ArticulatedBodies
from jaxdyn.dynamics.frame_motion import WorkspaceDynamics as WorkspaceDynamics
from jaxdyn.dynamics.frame_motion import articulated_bodies as articulated_bodies
from jaxdyn.dynamics.frame_motion import frame_acceleration as frame_acceleration
from jaxdyn.dynamics.frame_motion import jacobian_dot_v as jacobian_dot_v
from jaxdyn.dynamics.frame_motion import joint_wrench as joint_wrench
from jaxdyn.dynamics.frame_motion import workspace_dynamics as workspace_dynamics
from jaxdyn.dynamics.kinematics import spatial_jacobian as spatial_jacobian
from jaxdyn.dynamics.link_frame import NewtonEulerMatrices as NewtonEulerMatrices
from jaxdyn.dynamics.link_frame import base_twists as base_twists
from jaxdyn.dynamics.link_frame import link_adjoints as link_adjoints
from jaxdyn.dynamics.quantities import aba as aba
from jaxdyn.dynamics.quantities import crba as crba
from jaxdyn.dynamics.quantities import generalized_force as generalized_force
from jaxdyn.dynamics.quantities import mass_matrix_derivative as mass_matrix_derivative
from jaxdyn.dynamics.quantities import mass_matrix_sqrt as mass_matrix_sqrt
from jaxdyn.dynamics.quantities import rnea as rnea
from jaxdyn.dynamics.quantities import torque_regressor as torque_regressor


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
