"""Sensors on frames (accelerometer, gyroscope, IMU, velocity, pose), of joints and of forces, in joints, mounts and contacts."""

from functools import partial
from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.constraints.base import layout
from jaxdyn.constraints.frames import body_wrenches_where
from jaxdyn.constraints.rolling import Touching
from jaxdyn.dynamics.frame_motion import frame_acceleration, frame_velocity, joint_wrench
from jaxdyn.dynamics.kinematics import frame_pose, named_frame
from jaxdyn.forces.elements import sum_wrenches, wrenches_where
from jaxdyn.lie import se3, so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_float, as_number, check_names
from jaxdyn.model.topology import frame_index, joint_index
from jaxdyn.model.tree import Model
from jaxdyn.sensors.base import Motion, Sensor, check_part, constraint_place, with_contacts
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


def _as_resolution(resolution: Numbers | None) -> Array | None:
    return None if resolution is None else as_number(resolution, "resolution", "rad or m", like=float)


def _as_inertia(inertia: Numbers | None) -> Array | None:
    return None if inertia is None else as_float(inertia, "inertia", (10,), float)


def _as_frames(frames: Any) -> tuple[str, ...] | None:
    return None if frames is None else check_names(frames, "frames")


class _OnJoint(Sensor):
    """A sensor of a joint: `joint` its name, `name` by default KIND of JOINT; `noise`, `delay` (s) as of `Sensor`."""

    joint: str = eqx.field(static=True)

    def default_name(self) -> str:
        """Name "KIND of JOINT"."""
        return f"{type(self).__name__.lower()} of {self.joint}"

    def check(self, scene: Scene) -> None:
        """Refuse a joint that the model does not have. **Raises:** ValueError."""
        joint_index(scene.system, self.joint)


class Encoder(_OnJoint):
    """Coordinates of a joint in steps of a resolution, (nq of the joint,), rad or m.

    **Arguments:** `joint`, a name; `resolution`, rad or m, of one count: readings are rounded down to a multiple of it (None: not
    rounded; joints of one degree of freedom); `name`, `noise`, `delay` (s) as of `Sensor`. Derivatives pass through the rounding
    as if there were none.

    **Raises:** ValueError for a resolution that is not positive.

    ```python
    sensor = jd.sensors.Encoder("iiwa_joint_1", resolution=2 * jnp.pi / 2**14, delay=0.001)
    ```
    """

    # A leaf, and not static: another resolution does not cause a second compilation.
    resolution: Array | None = eqx.field(converter=_as_resolution, default=None, kw_only=True)

    def check(self, scene: Scene) -> None:
        """Refuse a joint that the model does not have. **Raises:** ValueError."""
        model = cast(Model, scene.system)
        place = model.topology.q_slices[joint_index(model, self.joint)]
        # A quaternion rounded entry by entry is no unit quaternion.
        if self.resolution is not None and place.stop - place.start > 1:
            raise ValueError(f"{self.name!r}: joint {self.joint!r} has several coordinates; omit resolution")

    def read(self, motion: Motion) -> Float[Array, " n"]:
        """Coordinates of the joint."""
        model = motion.model
        return motion.q[model.topology.q_slices[joint_index(model, self.joint)]]

    def quaternion_start(self, scene: Scene) -> int | None:
        """Index of the quaternion of a spherical or a free joint."""
        top = cast(Model, scene.system).topology
        return {"spherical": 0, "free": 3}.get(top.kinds[top.joint_names.index(self.joint)])

    def quantize(self, readings: Float[Array, "*n k"]) -> Float[Array, "*n k"]:
        """Readings rounded down to multiples of the resolution."""
        if self.resolution is None:
            return readings
        step = self.resolution.astype(readings.dtype)
        # `floor` has a derivative of zero everywhere: the rounding is a constant, and the derivative that of the exact reading.
        return readings + lax.stop_gradient(step * jnp.floor(readings / step) - readings)


class Tachometer(_OnJoint):
    """Velocities of a joint, (nv of the joint,), rad/s or m/s.

    **Arguments:** `joint`, a name; `name`, `noise`, `delay` (s) as of `Sensor`.
    """

    def read(self, motion: Motion) -> Float[Array, " n"]:
        """Velocities of the joint."""
        model = motion.model
        return motion.v[model.topology.v_slices[joint_index(model, self.joint)]]


class ForceTorque(Sensor):
    """Wrench (f, tau) (6,), N and N m, on what lies beyond a frame, at its origin and in its axes: at rest, minus a weight.

    Without `inertia` that is all that the joint of the frame's body carries: the wrench through the joint, drive included. With
    it the frame is a mount inside a rigid body, and beyond it are a part of that body and the joints named.

    Wrenches of the scene's constraints between frames act too, those of its forces on bodies (`jd.forces.external_wrenches`), and
    the `thrusts` of `measure`. On the mount's own body they count as acting beyond it, as the ground does on a foot under
    an ankle, unless `frames` says which of them do. Springs, stops, friction, drives and tau act in the joints, between a body
    and its parent, as do constraints on coordinates, and forces of the user without `frame_wrenches`.

    **Arguments:**

    - `frame`: a name. `name`, `noise`, `delay` (s) as of `Sensor`.
    - `inertia` (10,): inertial parameters of the part of the frame's body beyond the mount, about the body's origin in its axes,
      in the order of `jd.Model.inertias`. `joints`: names of joints that this part carries. `frames`: names of the frames of
      the body, its own among them, that belong to this part, so that wrenches on others do not count (None: all).
    - `part`: "force" or "torque" for three of the numbers, None for all.

    **Raises:** ValueError for joints or frames without an inertia, and for inertias of another shape.

    Source: EQUATIONS section 4, the backward recursion of Newton and Euler.

    ```python
    sensor = jd.sensors.ForceTorque("iiwa_link_7", name="wrist")
    ```
    """

    frame: str = eqx.field(static=True)
    inertia: Array | None = eqx.field(converter=_as_inertia, default=None, kw_only=True)
    joints: tuple[str, ...] = eqx.field(
        static=True, converter=partial(check_names, what="joints"), default=(), kw_only=True
    )
    frames: tuple[str, ...] | None = eqx.field(static=True, converter=_as_frames, default=None, kw_only=True)
    part: str | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_part(self.part, _PARTS)
        # Without an inertia all that the frame's body carries lies beyond it: there is no choice of joints.
        for name, given in (("joints", self.joints), ("frames", self.frames is not None)):
            if self.inertia is None and given:
                raise ValueError(
                    f"{name} are given without inertia; give the inertia of the part beyond the mount, or omit {name}"
                )

    def default_name(self) -> str:
        """Name "wrench of FRAME"."""
        return f"wrench of {self.frame}"

    def check(self, scene: Scene) -> None:
        """Refuse a frame on the ground, and joints that the frame's body does not carry. **Raises:** ValueError."""
        model = cast(Model, scene.system)
        body, _ = named_frame(model, self.frame)
        # -1 is the world, which has no joint.
        if body < 0:
            raise ValueError(f"{self.name!r}: frame {self.frame!r} stands on the ground, no joint carries it")
        for frame in self.frames or ():
            if named_frame(model, frame)[0] != body:
                raise ValueError(
                    f"{self.name!r}: frame {frame!r} is not on the frame's body {model.body_names[body]!r}"
                )
        for joint in self.joints:
            # A mount divides one body: only joints on that body can be on its far side.
            if model.topology.parents[joint_index(model, joint)] != body:
                raise ValueError(
                    f"{self.name!r}: joint {joint!r} is not on the frame's body {model.body_names[body]!r}"
                )

    def read(self, motion: Motion) -> Float[Array, " k"]:
        """Wrench at the frame's origin, in its axes."""
        q, model = motion.q, motion.model
        body, offset = named_frame(model, self.frame)
        pulls = self._outer_wrenches(motion, body)
        if self.inertia is not None:
            # With all other inertias zero the wrench through the joint is that on the part beyond the mount.
            model, beyond = _beyond(model, body, self.inertia, self.joints)
            # Wrenches on bodies before the mount do not load it.
            pulls = None if pulls is None else pulls * beyond[:, None]
        # At the origin and in the axes of the body; AdT takes it to those of the frame, which may be displaced and rotated.
        wrench = joint_wrench(model, q, motion.v, motion.a, model.joint_names[body], external=pulls)
        return se3.AdT_apply(jnp.asarray(offset, q.dtype), wrench)[_PARTS[self.part]]

    def _outer_wrenches(self, motion: Motion, body: int) -> Float[Array, "nb 6"] | None:
        """Wrenches on each body past the joints, of loops, feet and outer forces; None without any."""
        scene, q, model = motion.scene, motion.q, motion.model

        def counts(frame: str) -> bool:
            return self.frames is None or frame in self.frames or named_frame(model, frame)[0] != body

        parts = []
        if any(hasattr(force, "frame_wrenches") for force in scene.forces):
            parts.append(wrenches_where(scene, q, motion.v, motion.t, counts))
        if motion.thrusts:
            parts.append(sum_wrenches(model, q, motion.thrusts, counts, "thrusts"))
        if scene.constraints:
            parts.append(body_wrenches_where(scene, q, motion.multipliers, counts))
        return sum(parts[1:], parts[0]) if parts else None


_PARTS = {None: slice(0, 6), "force": slice(0, 3), "torque": slice(3, 6)}


def _beyond(model: Model, body: int, inertia, joints) -> tuple[Model, Array]:
    """The model with the inertias that lie beyond a mount alone, and 1 for bodies that are there, (nb,)."""
    there = np.zeros(model.nb, bool)
    for joint in joints:
        # The whole subtree: bodies that have this joint's body among their ancestors.
        there |= model.topology.ancestors[:, joint_index(model, joint)]
    kept = jnp.asarray(there, model.inertias.dtype)
    # The mount's own body counts only with its part beyond the mount.
    inertias = (kept[:, None] * model.inertias).at[body].set(inertia.astype(model.inertias.dtype))
    return eqx.tree_at(lambda model: model.inertias, model, inertias), kept.at[body].set(1)


class ContactForce(Sensor):
    """Multipliers of a constraint, (n,), N along rows in m and N m along rows in rad: of a loop, a wheel, a foot on the ground.

    Of a unilateral contact it is the force that `measure` gets as `contacts`: the friction, and the normal force as the last one.

    **Arguments:** `constraint`, its name in the scene, or that of a contact; `name`, `noise`, `delay` (s) as of `Sensor`.

    ```python
    sensor = jd.sensors.ContactForce("knee")  # of jd.scenes.four_bar()
    ```
    """

    constraint: str = eqx.field(static=True)

    def default_name(self) -> str:
        """Name "force of CONSTRAINT"."""
        return f"force of {self.constraint}"

    def check(self, scene: Scene) -> None:
        """Refuse a constraint that the scene does not have. **Raises:** ValueError."""
        constraint_place(scene, self.constraint)

    def read(self, motion: Motion) -> Float[Array, " n"]:
        """Multipliers of the constraint, or the force of the contact."""
        contacts = motion.contacts or {}
        if self.constraint in contacts:
            return contacts[self.constraint]
        return motion.multipliers[constraint_place(motion.scene, self.constraint)]


class Touch(_OnFrame):
    """Sum of the normal forces of unilateral contacts, (1,), N: a switch or a load cell under a foot.

    **Arguments:** `frame`, the name of a body or frame: all contacts on its body count that are between bodies, as those of
    `jd.contact.ground_contact` and `jd.contact.shape_contacts`; `name`, `noise`, `delay` (s) as of `Sensor`. Forces are those
    that `measure` gets as `contacts`.

    **Raises:** (when used) ValueError for a frame without contacts.

    ```python
    sensor = jd.sensors.Touch("FL_foot")
    ```
    """

    def check(self, scene: Scene) -> None:
        """Refuse a frame without contacts. **Raises:** ValueError."""
        if not self._rows(with_contacts(scene)):
            raise ValueError(
                f"{self.name!r}: frame {self.frame!r} has no contacts; list some among the forces of the scene, as "
                "jd.contact.ground_contact(frame, ...)"
            )

    def read(self, motion: Motion) -> Float[Array, "1"]:
        """Sum of the normal forces."""
        return jnp.sum(motion.multipliers[np.array(self._rows(motion.scene), int)])[None]

    def _rows(self, scene: Scene) -> list[int]:
        """Rows of the normals of the contacts on the frame's body."""
        model = cast(Model, scene.system)
        body = named_frame(model, self.frame)[0]
        pairs = zip(scene.constraints, layout(scene), strict=True)
        return [
            place.start
            for constraint, place in pairs
            if isinstance(constraint, Touching)
            and constraint.contact
            and named_frame(model, constraint.body)[0] == body
        ]
