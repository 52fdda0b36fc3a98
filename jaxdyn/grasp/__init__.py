"""Grasps: hands that hold an object by contacts, their maps, and the equations of motion of the object.

Source: Murray, Li & Sastry (1994), chapters 5 and 6.
"""

from types import ModuleType as _ModuleType

from jaxdyn.contact.cones import wrench_basis as wrench_basis
from jaxdyn.contact.forces import ContactForces as ContactForces
from jaxdyn.contact.forces import contact_forces as contact_forces
from jaxdyn.grasp.dynamics import ObjectDynamics as ObjectDynamics
from jaxdyn.grasp.dynamics import hand_dynamics as hand_dynamics
from jaxdyn.grasp.dynamics import object_dynamics as object_dynamics
from jaxdyn.grasp.forces import HandForces as HandForces
from jaxdyn.grasp.forces import force_closure as force_closure
from jaxdyn.grasp.forces import forces_for_wrench as forces_for_wrench
from jaxdyn.grasp.forces import hold as hold
from jaxdyn.grasp.forces import internal_force_basis as internal_force_basis
from jaxdyn.grasp.forces import joint_torques as joint_torques
from jaxdyn.grasp.forces import normal_forces as normal_forces
from jaxdyn.grasp.hand import Contact as Contact
from jaxdyn.grasp.hand import Grasp as Grasp
from jaxdyn.grasp.hand import contact as contact
from jaxdyn.grasp.hand import grasp_map as grasp_map
from jaxdyn.grasp.hand import hand_jacobian as hand_jacobian
from jaxdyn.grasp.hand import internal_forces as internal_forces
from jaxdyn.grasp.hand import point_contacts as point_contacts
from jaxdyn.grasp.motions import HandMotions as HandMotions
from jaxdyn.grasp.motions import Manipulability as Manipulability
from jaxdyn.grasp.motions import hand_motions as hand_motions
from jaxdyn.grasp.motions import manipulability as manipulability


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
