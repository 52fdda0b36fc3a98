"""Sensors: what instruments on a mechanism read in a motion, their noise, resolution and delay.

A sensor is a Module with a name; `measure` gives the readings of several at one instant, `record` those along a motion.
"""

from types import ModuleType as _ModuleType

from jaxdyn.sensors.base import Motion as Motion
from jaxdyn.sensors.base import Noise as Noise
from jaxdyn.sensors.base import Sensor as Sensor
from jaxdyn.sensors.base import measure as measure
from jaxdyn.sensors.base import record as record
from jaxdyn.sensors.instruments import Accelerometer as Accelerometer
from jaxdyn.sensors.instruments import ContactForce as ContactForce
from jaxdyn.sensors.instruments import Encoder as Encoder
from jaxdyn.sensors.instruments import ForceTorque as ForceTorque
from jaxdyn.sensors.instruments import FramePose as FramePose
from jaxdyn.sensors.instruments import FrameVelocity as FrameVelocity
from jaxdyn.sensors.instruments import Gyroscope as Gyroscope
from jaxdyn.sensors.instruments import Imu as Imu
from jaxdyn.sensors.instruments import Tachometer as Tachometer
from jaxdyn.sensors.instruments import Touch as Touch
from jaxdyn.sensors.instruments import Velocimeter as Velocimeter


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
