"""What `jaxdyn` exports. `__init__.py` reads this list, and imports a name at its first use."""

from typing import Any

from jaxdyn import (
    constraints,
    contact,
    control,
    dynamics,
    forces,
    geometry,
    grasp,
    identify,
    io,
    model,
    pictures,
    reduction,
    scale,
    scenes,
    sensors,
    simulation,
)
from jaxdyn.compile import compilation, jit
from jaxdyn.constraints import Holonomic, Pfaffian, constraint_jacobian, loop, rolling_sphere, rolling_wheel
from jaxdyn.constraints.assembly import assemble
from jaxdyn.constraints.codes import RESULTS
from jaxdyn.constraints.dynamics import constrained_dynamics
from jaxdyn.constraints.frames import constraint_forces
from jaxdyn.constraints.selection import degrees_of_freedom
from jaxdyn.control.inverse_kinematics import follow, inverse_kinematics
from jaxdyn.dynamics.centroidal import center_of_mass, com_jacobian, kinetic_energy, potential_energy
from jaxdyn.dynamics.frame_motion import frame_jacobian, frame_velocity
from jaxdyn.dynamics.kinematics import body_jacobian, forward_kinematics, frame_pose
from jaxdyn.dynamics.link_frame import newton_euler_matrices
from jaxdyn.dynamics.quantities import (
    bias_force,
    coriolis_matrix,
    forward_dynamics,
    gravity_force,
    inverse_dynamics,
    mass_matrix,
)
from jaxdyn.exports import Exported, export
from jaxdyn.io import load, load_model, read_log, save_urdf
from jaxdyn.lie import se2, se3, so3
from jaxdyn.model import inertia, robots
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.configuration import (
    configuration_rate,
    difference,
    integrate,
    neutral,
    normalize,
    random_configuration,
)
from jaxdyn.model.joining import join
from jaxdyn.model.tree import Model
from jaxdyn.pictures import animate, draw, plot, view
from jaxdyn.reduction.inverse_dynamics import constrained_inverse_dynamics
from jaxdyn.reduction.minimal import reduced_dynamics
from jaxdyn.reports import report
from jaxdyn.simulation import events, solvers
from jaxdyn.simulation.controls import Controller, Sampled
from jaxdyn.simulation.methods import Multipliers, Projected, Reduced
from jaxdyn.simulation.run import simulate
from jaxdyn.simulation.solution import Solution
from jaxdyn.simulation.stepping import stepper
from jaxdyn.simulation.stiffness import stiffness
from jaxdyn.simulation.variational import Variational
from jaxdyn.systems.lagrangian import LagrangianSystem
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import ExplicitSystem, MetricSystem

__version__: str
__all__ = [
    "RESULTS",
    "Controller",
    "ExplicitSystem",
    "Exported",
    "Holonomic",
    "LagrangianSystem",
    "MetricSystem",
    "Model",
    "ModelBuilder",
    "Multipliers",
    "Pfaffian",
    "Projected",
    "Reduced",
    "Sampled",
    "Scene",
    "Solution",
    "Variational",
    "animate",
    "assemble",
    "bias_force",
    "body_jacobian",
    "center_of_mass",
    "com_jacobian",
    "compilation",
    "configuration_rate",
    "constrained_dynamics",
    "constrained_inverse_dynamics",
    "constraint_forces",
    "constraint_jacobian",
    "constraints",
    "contact",
    "control",
    "coriolis_matrix",
    "degrees_of_freedom",
    "difference",
    "draw",
    "dynamics",
    "events",
    "export",
    "follow",
    "forces",
    "forward_dynamics",
    "forward_kinematics",
    "frame_jacobian",
    "frame_pose",
    "frame_velocity",
    "geometry",
    "grasp",
    "gravity_force",
    "identify",
    "inertia",
    "integrate",
    "inverse_dynamics",
    "inverse_kinematics",
    "io",
    "jit",
    "join",
    "kinetic_energy",
    "load",
    "load_model",
    "loop",
    "mass_matrix",
    "model",
    "neutral",
    "newton_euler_matrices",
    "normalize",
    "pictures",
    "plot",
    "potential_energy",
    "random_configuration",
    "read_log",
    "reduced_dynamics",
    "reduction",
    "report",
    "robots",
    "rolling_sphere",
    "rolling_wheel",
    "save_urdf",
    "scale",
    "scenes",
    "se2",
    "se3",
    "sensors",
    "simulate",
    "simulation",
    "so3",
    "solvers",
    "stepper",
    "stiffness",
    "view",
]

def __getattr__(name: str) -> Any: ...
def __dir__() -> list[str]: ...
