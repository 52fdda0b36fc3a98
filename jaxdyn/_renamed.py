"""Names that moved from `jaxdyn` to its namespaces. They are found with a warning until the next release."""

import importlib
import warnings
from typing import Any

# Namespace, and the names that it has taken.
_MOVED = {
    "forces": (
        "CoulombFriction Drive EffortLimits ExternalWrench JointDamping JointSpring JointStops PiecewiseForce "
        "RayleighDissipation SlidingFriction"
    ),
    "constraints": (
        "distance gear knife_edge lock_joint model_couplings body_wrenches constraint_wrenches projections "
        "second_fundamental_form"
    ),
    "contact": ("rolling_contact RollingModel DryFriction UnilateralContact gap_contact ground_contact"),
    "io": ("load_mjcf load_sdf Actuators LoadedScene NotTakenWarning Start UnitsWarning urdf_inertia_report write_log"),
    "pictures": ("Shape Shapes shapes save_html"),
    "dynamics": (
        "aba rnea crba ArticulatedBodies articulated_bodies base_twists link_adjoints centroidal_momentum "
        "centroidal_momentum_matrix ComDynamics com_dynamics joint_wrench jacobian_dot_v NewtonEulerMatrices "
        "mass_matrix_derivative mass_matrix_sqrt torque_regressor WorkspaceDynamics workspace_dynamics spatial_jacobian "
        "generalized_force frame_acceleration christoffel_symbols"
    ),
    "geometry": ("constrain_by_immersion reaction_force"),
    "reduction": ("tangent_basis gauge_invariant involutive spurious_terms"),
    "solvers": ("LieGroup Rodas5P"),
    "simulation": ("JointLimitWarning Stiffness"),
    "model": ("Topology inertia_report repair_inertias"),
    "control": ("LeggedDynamics underactuated_inverse_dynamics"),
}
_HOME = {name: namespace for namespace, names in _MOVED.items() for name in names.split()}
_MODULES = {"solvers": "simulation.solvers"}


def __getattr__(name: str) -> Any:
    """Find a name of `jaxdyn` that has moved, and warn; AttributeError for others."""
    if name not in _HOME:
        raise AttributeError(f"module 'jaxdyn' has no attribute {name!r}")
    namespace = _HOME[name]
    warnings.warn(f"jd.{name} is now jd.{namespace}.{name}", DeprecationWarning, stacklevel=2)
    return getattr(importlib.import_module(f"jaxdyn.{_MODULES.get(namespace, namespace)}"), name)
