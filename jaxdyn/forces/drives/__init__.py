"""Drives between a control and the joints: elastic joints, torque dynamics with a state, torque-speed curves.

List them among the forces of a `Scene`; docs/drives.md has examples.
"""

from jaxdyn.forces.drives.elastic import ElasticTransmission as ElasticTransmission
from jaxdyn.forces.drives.elastic import elastic_joints as elastic_joints
from jaxdyn.forces.drives.lags import FirstOrder as FirstOrder
from jaxdyn.forces.drives.lags import SecondOrder as SecondOrder
from jaxdyn.forces.limits import TorqueSpeedLimits as TorqueSpeedLimits
from jaxdyn.systems.drives import DriveDynamics as DriveDynamics
