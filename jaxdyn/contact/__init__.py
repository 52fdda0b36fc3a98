"""Contacts: friction cones and wrench cones, optimal forces within them, force closure, and kinematics of rolling.

Source: Murray, Li & Sastry (1994), chapter 5; EQUATIONS sections 8, 10 and 11.
"""

from jaxdyn.contact.cones import FrictionCone as FrictionCone
from jaxdyn.contact.cones import friction_cone as friction_cone
from jaxdyn.contact.cones import surface_cone as surface_cone
from jaxdyn.contact.cones import wrench_basis as wrench_basis
from jaxdyn.contact.cones import wrench_cone as wrench_cone
from jaxdyn.contact.cones import wrench_cone_of_polygon as wrench_cone_of_polygon
from jaxdyn.contact.contact_equations import ContactKinematics as ContactKinematics
from jaxdyn.contact.contact_equations import contact_coordinates as contact_coordinates
from jaxdyn.contact.contact_equations import montana as montana
from jaxdyn.contact.contact_equations import relative_pose as relative_pose
from jaxdyn.contact.forces import ContactForces as ContactForces
from jaxdyn.contact.forces import ForceClosure as ForceClosure
from jaxdyn.contact.forces import contact_forces as contact_forces
from jaxdyn.contact.forces import force_closure_of_map as force_closure_of_map
from jaxdyn.contact.forces import optimal_forces as optimal_forces
from jaxdyn.contact.qp import QPSolution as QPSolution
from jaxdyn.contact.qp import solve_qp as solve_qp
from jaxdyn.contact.rolling import RollingContact as RollingContact
from jaxdyn.contact.rolling import RollingModel as RollingModel
from jaxdyn.contact.rolling import rolling_contact as rolling_contact
from jaxdyn.contact.shape_contacts import HeightField as HeightField
from jaxdyn.contact.shape_contacts import shape_contacts as shape_contacts
from jaxdyn.contact.shapes import Box as Box
from jaxdyn.contact.shapes import Capsule as Capsule
from jaxdyn.contact.shapes import ConvexHull as ConvexHull
from jaxdyn.contact.surfaces import Cylinder as Cylinder
from jaxdyn.contact.surfaces import Ellipsoid as Ellipsoid
from jaxdyn.contact.surfaces import Parametrised as Parametrised
from jaxdyn.contact.surfaces import Plane as Plane
from jaxdyn.contact.surfaces import Sphere as Sphere
from jaxdyn.contact.surfaces import Surface as Surface
from jaxdyn.contact.surfaces import SurfaceGeometry as SurfaceGeometry
from jaxdyn.contact.surfaces import surface_geometry as surface_geometry
from jaxdyn.contact.unilateral import DryFriction as DryFriction
from jaxdyn.contact.unilateral import UnilateralContact as UnilateralContact
from jaxdyn.contact.unilateral import gap_contact as gap_contact
from jaxdyn.contact.unilateral import ground_contact as ground_contact

__all__ = [
    "Box",
    "Capsule",
    "ContactForces",
    "ContactKinematics",
    "ConvexHull",
    "Cylinder",
    "DryFriction",
    "Ellipsoid",
    "ForceClosure",
    "FrictionCone",
    "HeightField",
    "Parametrised",
    "Plane",
    "QPSolution",
    "RollingContact",
    "RollingModel",
    "Sphere",
    "Surface",
    "SurfaceGeometry",
    "UnilateralContact",
    "contact_coordinates",
    "contact_forces",
    "force_closure_of_map",
    "friction_cone",
    "gap_contact",
    "ground_contact",
    "montana",
    "optimal_forces",
    "relative_pose",
    "rolling_contact",
    "shape_contacts",
    "solve_qp",
    "surface_cone",
    "surface_geometry",
    "wrench_basis",
    "wrench_cone",
    "wrench_cone_of_polygon",
]


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return __all__
