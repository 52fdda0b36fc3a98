"""Grasps: hands that hold an object by contacts, their maps, and the equations of motion of the object.

Source: Murray, Li & Sastry (1994), chapters 5 and 6.
"""

from jaxdyn.contact.forces import ContactForces as ContactForces
from jaxdyn.contact.forces import contact_forces as contact_forces
from jaxdyn.contact.kinds import wrench_basis as wrench_basis
from jaxdyn.grasp.contacts import Contact as Contact
from jaxdyn.grasp.contacts import contact as contact
from jaxdyn.grasp.dynamics import ObjectDynamics as ObjectDynamics
from jaxdyn.grasp.dynamics import object_dynamics as object_dynamics
from jaxdyn.grasp.hand import Grasp as Grasp
from jaxdyn.grasp.hand import grasp_map as grasp_map
from jaxdyn.grasp.hand import hand_jacobian as hand_jacobian
from jaxdyn.grasp.hand import internal_forces as internal_forces
