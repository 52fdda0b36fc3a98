"""Rigid-body dynamics in JAX: pure functions of one sample, to be batched, compiled and differentiated."""

from jaxdyn.dynamics import bias_force as bias_force
from jaxdyn.dynamics import center_of_mass as center_of_mass
from jaxdyn.dynamics import centroidal_momentum as centroidal_momentum
from jaxdyn.dynamics import centroidal_momentum_matrix as centroidal_momentum_matrix
from jaxdyn.dynamics import christoffel_symbols as christoffel_symbols
from jaxdyn.dynamics import coriolis_matrix as coriolis_matrix
from jaxdyn.dynamics import forward_dynamics as forward_dynamics
from jaxdyn.dynamics import generalized_force as generalized_force
from jaxdyn.dynamics import gravity_force as gravity_force
from jaxdyn.dynamics import inverse_dynamics as inverse_dynamics
from jaxdyn.dynamics import kinetic_energy as kinetic_energy
from jaxdyn.dynamics import mass_matrix as mass_matrix
from jaxdyn.dynamics import mass_matrix_derivative as mass_matrix_derivative
from jaxdyn.dynamics import potential_energy as potential_energy
from jaxdyn.dynamics import torque_regressor as torque_regressor
from jaxdyn.kinematics import body_jacobian as body_jacobian
from jaxdyn.kinematics import forward_kinematics as forward_kinematics
from jaxdyn.kinematics import frame_pose as frame_pose
from jaxdyn.kinematics import jacobian_dot_v as jacobian_dot_v
from jaxdyn.kinematics import spatial_jacobian as spatial_jacobian
from jaxdyn.link_form import NewtonEulerMatrices as NewtonEulerMatrices
from jaxdyn.link_form import newton_euler_matrices as newton_euler_matrices

__version__ = "0.1.0"
