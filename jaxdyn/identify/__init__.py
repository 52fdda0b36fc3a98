"""Identification of parameters from logs: least squares, feasible fits of robots, and fits of any numbers of any system."""

from types import ModuleType as _ModuleType
from typing import Any as _Any

from jaxdyn.identify.condensed_fit import Intervals as Intervals
from jaxdyn.identify.excitation_search import Excitation as Excitation
from jaxdyn.identify.excitation_search import exciting_motion as exciting_motion
from jaxdyn.identify.geometry import GeometryFit as GeometryFit
from jaxdyn.identify.geometry import choose_poses as choose_poses
from jaxdyn.identify.geometry import fit_geometry as fit_geometry
from jaxdyn.identify.linear_fit import Identifiability as Identifiability
from jaxdyn.identify.linear_fit import LeastSquares as LeastSquares
from jaxdyn.identify.linear_fit import identifiability as identifiability
from jaxdyn.identify.linear_fit import least_squares as least_squares
from jaxdyn.identify.log_repair import LogWarning as LogWarning
from jaxdyn.identify.logs import Log as Log
from jaxdyn.identify.logs import split as split
from jaxdyn.identify.mechanisms import Construction as Construction
from jaxdyn.identify.mechanisms import Measured as Measured
from jaxdyn.identify.mechanisms import complete_log as complete_log
from jaxdyn.identify.options import Execution as Execution
from jaxdyn.identify.options import Objective as Objective
from jaxdyn.identify.options import Solver as Solver
from jaxdyn.identify.parameter_tree import Parameters as Parameters
from jaxdyn.identify.parameters import fit_parameters as fit_parameters
from jaxdyn.identify.parameters import parameter_error as parameter_error
from jaxdyn.identify.payloads import DriveGains as DriveGains
from jaxdyn.identify.payloads import Payload as Payload
from jaxdyn.identify.payloads import fit_gains as fit_gains
from jaxdyn.identify.payloads import fit_payload as fit_payload
from jaxdyn.identify.raw_logs import Cutoff as Cutoff
from jaxdyn.identify.raw_logs import choose_cutoff as choose_cutoff
from jaxdyn.identify.raw_logs import from_raw as from_raw
from jaxdyn.identify.regression import BaseParameters as BaseParameters
from jaxdyn.identify.regression import base_parameters as base_parameters
from jaxdyn.identify.regression import nominal_parameters as nominal_parameters
from jaxdyn.identify.regression import parameter_names as parameter_names
from jaxdyn.identify.regression import regressor as regressor
from jaxdyn.identify.regression import torque_error as torque_error
from jaxdyn.identify.result import Fit as Fit
from jaxdyn.identify.result import SampledTorque as SampledTorque
from jaxdyn.identify.result import rollout as rollout
from jaxdyn.identify.result import trajectory_error as trajectory_error
from jaxdyn.identify.robot import Delays as Delays
from jaxdyn.identify.robot import RobotFit as RobotFit
from jaxdyn.identify.robot import fit_robot as fit_robot
from jaxdyn.identify.robot import fit_torques as fit_torques
from jaxdyn.identify.robot import shift_torques as shift_torques
from jaxdyn.identify.torque_terms import EXTRA as EXTRA
from jaxdyn.identify.torque_terms import TERMS as TERMS
from jaxdyn.identify.torque_terms import Friction as Friction
from jaxdyn.identify.torque_terms import TorqueTerm as TorqueTerm
from jaxdyn.identify.uncertainty import Whiteness as Whiteness
from jaxdyn.identify.uncertainty import whiteness as whiteness
from jaxdyn.model.arguments import warn as _warn


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]


__all__ = __dir__()  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> _Any:
    if name == "completed":  # the deprecated name of `complete_log`, which warns when it is called
        from jaxdyn.identify.mechanisms import completed

        return completed
    if name == "ParameterFit":
        _warn("jd.identify.ParameterFit is deprecated; the result of every fit is jd.identify.Fit", DeprecationWarning)
        return Fit
    if name == "fit_trajectory":
        raise AttributeError(
            "jd.identify.fit_trajectory is gone; call jd.identify.fit_parameters(scene, log, jd.identify.Parameters(scene)"
            '.inertias(), jd.identify.Objective("trajectory"))'
        )
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
