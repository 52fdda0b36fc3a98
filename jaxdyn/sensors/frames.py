"""Sensors on frames: accelerometer, gyroscope, both as an IMU, velocity and pose."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.dynamics.frame_motion import frame_acceleration, frame_velocity
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.lie import so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.topology import frame_index
from jaxdyn.sensors.base import Motion, Sensor, check_part
from jaxdyn.systems.scene import Scene


class _OnFrame(Sensor):
    """A sensor on a frame: `frame` its name, `name` by default KIND of FRAME; `noise`, `delay` (s) as of `Sensor`."""

    frame: str = eqx.field(static=True)

    def default_name(self) -> str:
        """Name "KIND of FRAME"."""
        return f"{type(self).__name__.lower()} of {self.frame}"

    def check(self, scene: Scene) -> None:
        """Refuse a frame that the model does not have. **Raises:** ValueError."""
        frame_index(scene.system, self.frame)

    def _rotation(self, motion: Motion) -> Float[Array, "3 3"]:
        # The columns are the frame's axes in the world: its transpose takes a vector of the world to the frame.
        return frame_pose(motion.model, motion.q, self.frame)[:3, :3]

    def _in_frame_axes(self, motion: Motion, vector) -> Float[Array, "3"]:
        """A vector of the world in the frame's axes."""
        return matmul(self._rotation(motion).T, vector)

    def _velocity(self, motion: Motion) -> Float[Array, "6"]:
        # Linear part first, of the frame's origin, both parts in world axes.
        return frame_velocity(motion.model, motion.q, motion.v, self.frame)

    def _specific_force(self, motion: Motion) -> Float[Array, "3"]:
        model = motion.model
        # The acceleration of the origin, which has the term w x v that the linear part of a twist's rate lacks.
        a = frame_acceleration(model, motion.q, motion.v, motion.a, self.frame)[:3]
        # A gravity of None is that of a model without weight. At rest the reading is -g, upwards.
        return a if model.gravity is None else a - model.gravity.astype(a.dtype)


class Accelerometer(_OnFrame):
    """Specific force (3,), m/s^2, of a frame's origin in its axes: 9.81 upwards at rest, zero in free fall.

    $$R^T (a - g)$$

    **Arguments:** `frame`, a name; `name`, `noise`, `delay` (s) as of `Sensor`.

    Source: Siciliano & Khatib (2016), Springer Handbook of Robotics, section 29.3.

    ```python
    sensor = jd.sensors.Accelerometer("iiwa_link_7", noise=jd.sensors.Noise(0.02))
    ```
    """

    def read(self, motion: Motion) -> Float[Array, "3"]:
        """Specific force in the frame's axes, m/s^2."""
        return self._in_frame_axes(motion, self._specific_force(motion))


class Gyroscope(_OnFrame):
    r"""Angular velocity (3,), rad/s, of a frame in its axes.

    $$R^T \omega$$

    **Arguments:** as of `Accelerometer`.
    """

    def read(self, motion: Motion) -> Float[Array, "3"]:
        """Angular velocity in the frame's axes, rad/s."""
        return self._in_frame_axes(motion, self._velocity(motion)[3:])


class Imu(_OnFrame):
    """Accelerometer and gyroscope in one: specific force (m/s^2), then angular velocity (rad/s), (6,), in the frame's axes.

    **Arguments:** as of `Accelerometer`.
    """

    def read(self, motion: Motion) -> Float[Array, "6"]:
        """Specific force, then angular velocity."""
        # From the world to the frame, once for both parts.
        turn = self._rotation(motion).T
        force, omega = self._specific_force(motion), self._velocity(motion)[3:]
        return jnp.concatenate([matmul(turn, force), matmul(turn, omega)])


class Velocimeter(_OnFrame):
    """Velocity (3,), m/s, of a frame's origin in its axes.

    $$R^T v$$

    **Arguments:** as of `Accelerometer`.
    """

    def read(self, motion: Motion) -> Float[Array, "3"]:
        """Velocity of the origin in the frame's axes, m/s."""
        return self._in_frame_axes(motion, self._velocity(motion)[:3])


class FrameVelocity(_OnFrame):
    """Velocity of a frame's origin (m/s), then its angular velocity (rad/s), (6,), in world axes, as `jd.frame_velocity`.

    **Arguments:** as of `Accelerometer`; `part`: "linear" or "angular" for three of them, None for all.
    """

    part: str | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_part(self.part, _VELOCITIES)

    def read(self, motion: Motion) -> Float[Array, " k"]:
        """Linear, then angular velocity in world axes."""
        return self._velocity(motion)[_VELOCITIES[self.part]]


class FramePose(_OnFrame):
    """Position (m), then orientation as a unit quaternion (w, x, y, z), (7,), of a frame in the world, as of a motion capture.

    **Arguments:** as of `Accelerometer`; `part`: "position" or "orientation" for one of them, None for both.
    """

    part: str | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_part(self.part, _POSES)

    def quaternion_start(self, scene: Scene) -> int | None:
        """Index of the quaternion."""
        return {None: 3, "orientation": 0}.get(self.part)

    def read(self, motion: Motion) -> Float[Array, " k"]:
        """Position and quaternion."""
        # The pose of the frame in the world. Its quaternion has the real part first, as those of q.
        pose = frame_pose(motion.model, motion.q, self.frame)
        return jnp.concatenate([pose[:3, 3], so3.matrix_to_quat(pose[:3, :3])])[_POSES[self.part]]


# Linear before angular, as in the twists of the package.
_VELOCITIES = {None: slice(0, 6), "linear": slice(0, 3), "angular": slice(3, 6)}
_POSES = {None: slice(0, 7), "position": slice(0, 3), "orientation": slice(3, 7)}
