"""Time-stepping methods in diffrax's interface."""

from jaxdyn.solvers.lie import LieGroup as LieGroup
from jaxdyn.solvers.projected import ProjectedSolver as ProjectedSolver
from jaxdyn.solvers.rk4 import RK4 as RK4
from jaxdyn.solvers.rosenbrock import Rodas5P as Rodas5P
