"""Sensors: what instruments on a mechanism read in a motion, their noise, resolution and delay.

A sensor is a Module with a name; `measure` gives the readings of several at one instant, `record` those along a motion.
"""

from types import ModuleType as _ModuleType

from jaxdyn.sensors.base import Motion as Motion
from jaxdyn.sensors.base import Noise as Noise
from jaxdyn.sensors.base import Sensor as Sensor
from jaxdyn.sensors.base import measure as measure
from jaxdyn.sensors.base import record as record
from jaxdyn.sensors.frames import Accelerometer as Accelerometer
from jaxdyn.sensors.frames import FramePose as FramePose
from jaxdyn.sensors.frames import FrameVelocity as FrameVelocity
from jaxdyn.sensors.frames import Gyroscope as Gyroscope
from jaxdyn.sensors.frames import Imu as Imu
from jaxdyn.sensors.frames import Velocimeter as Velocimeter
from jaxdyn.sensors.joints import ContactForce as ContactForce
from jaxdyn.sensors.joints import Encoder as Encoder
from jaxdyn.sensors.joints import ForceTorque as ForceTorque
from jaxdyn.sensors.joints import Tachometer as Tachometer
from jaxdyn.sensors.joints import Touch as Touch


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
