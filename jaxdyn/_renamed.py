"""Names that have moved or changed. They are found with a warning until the next release."""

import functools
import importlib
import warnings
from collections.abc import Callable
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
        "generalized_force frame_acceleration"
    ),
    "geometry": ("constrain_by_immersion reaction_force"),
    "reduction": ("tangent_basis gauge_invariant involutive spurious_terms"),
    "solvers": ("LieGroup Rodas5P"),
    "simulation": ("Baumgarte JointLimitWarning Stiffness"),
    "model": ("Topology inertia_report repair_inertias"),
    "control": ("LeggedDynamics underactuated_inverse_dynamics"),
}
# Old name below `jaxdyn`: where its object is, and the new name.
_RENAMED = {
    "christoffel_symbols": (
        "dynamics.quantities.first_kind_symbols",
        "jd.geometry.christoffel_symbols(model, q, 'first')",
    ),
    "contact.RESULTS": ("constraints.codes.RESULTS", "jd.RESULTS"),
    "contact.force_closure": ("contact.closure.force_closure_of_map", "jd.contact.force_closure_of_map"),
    "io.joint_torques": ("io.urdf_write.read_torque_terms", "jd.io.read_torque_terms"),
}
_RENAMED["dynamics.christoffel_symbols"] = _RENAMED["christoffel_symbols"]
_HOME = {name: namespace for namespace, names in _MOVED.items() for name in names.split()}
_MODULES = {"solvers": "simulation.solvers"}


def find(name: str) -> Any:
    """Find a name of `jaxdyn` that has moved, and warn; AttributeError for others."""
    # Warnings name the caller of the package's `__getattr__`, which calls this.
    if name not in _HOME:
        return _find(name, name, "jaxdyn", stacklevel=4)
    namespace = _HOME[name]
    warnings.warn(f"jd.{name} is now jd.{namespace}.{name}", DeprecationWarning, stacklevel=3)
    return getattr(importlib.import_module(f"jaxdyn.{_MODULES.get(namespace, namespace)}"), name)


def old_names(module: str) -> Callable[[str], Any]:
    """`__getattr__` of a namespace, which finds its old names."""
    namespace = module.removeprefix("jaxdyn.")
    return lambda name: _find(f"{namespace}.{name}", name, module)


def _find(old: str, name: str, module: str, stacklevel: int = 3) -> Any:
    if old not in _RENAMED:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    place, new = _RENAMED[old]
    warnings.warn(f"jd.{old} is now {new}", DeprecationWarning, stacklevel=stacklevel)
    home, _, present = place.rpartition(".")
    return getattr(importlib.import_module(f"jaxdyn.{home}"), present)


def rename_argument(old: str, new: str) -> Callable[[Callable], Callable]:
    """Decorator of a function whose argument `new` was called `old`: the old keyword warns."""

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def call(*args: Any, **named: Any) -> Any:
            if old in named:
                if new in named:
                    raise TypeError(f"{function.__name__} got {new!r} and {old!r}, its old name; give {new!r}")
                warnings.warn(f"{function.__name__}({old}=) is now {function.__name__}({new}=)", DeprecationWarning, 2)
                named[new] = named.pop(old)
            return function(*args, **named)

        return call

    return decorate


class RenamedMethod:
    """Old name of a method or field, as `placed = RenamedMethod("contacts_at")` in the class that has the new one."""

    def __init__(self, new: str):
        self.new = new

    def __set_name__(self, owner: type, name: str):
        self.old = f"{owner.__name__}.{name}"

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        # The class itself is asked by tools that list its names.
        if instance is None:
            return self
        warnings.warn(f"{self.old} is deprecated; its name is {self.new}", DeprecationWarning, stacklevel=2)
        return getattr(instance, self.new)
