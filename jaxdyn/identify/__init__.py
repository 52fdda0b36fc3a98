"""Parameters from measurements: least squares, and physically feasible fits by torque or by trajectory error."""

from jaxdyn.identify.feasible import fit_torques as fit_torques
from jaxdyn.identify.friction import TERMS as TERMS
from jaxdyn.identify.friction import Friction as Friction
from jaxdyn.identify.intervals import Intervals as Intervals
from jaxdyn.identify.logs import Log as Log
from jaxdyn.identify.logs import from_raw as from_raw
from jaxdyn.identify.logs import split as split
from jaxdyn.identify.parameters import fit_parameters as fit_parameters
from jaxdyn.identify.regression import BaseParameters as BaseParameters
from jaxdyn.identify.regression import LeastSquares as LeastSquares
from jaxdyn.identify.regression import base_parameters as base_parameters
from jaxdyn.identify.regression import least_squares as least_squares
from jaxdyn.identify.regression import nominal_parameters as nominal_parameters
from jaxdyn.identify.regression import parameter_names as parameter_names
from jaxdyn.identify.regression import regressor as regressor
from jaxdyn.identify.regression import torque_error as torque_error
from jaxdyn.identify.replay import SampledTorque as SampledTorque
from jaxdyn.identify.replay import rollout as rollout
from jaxdyn.identify.replay import trajectory_error as trajectory_error
from jaxdyn.identify.result import Fit as Fit
from jaxdyn.identify.result import ParameterFit as ParameterFit
from jaxdyn.identify.robot import RobotFit as RobotFit
from jaxdyn.identify.robot import fit_robot as fit_robot
from jaxdyn.identify.torque_terms import EXTRA as EXTRA
from jaxdyn.identify.torque_terms import TorqueTerm as TorqueTerm
from jaxdyn.identify.trajectory import fit_trajectory as fit_trajectory
