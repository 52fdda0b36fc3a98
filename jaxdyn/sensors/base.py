"""Base class of sensors, and the readings of several at one instant or along a motion, with their noise and delay."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.constraints.base import constraint_jacobian, layout
from jaxdyn.constraints.dynamics import constrained_dynamics
from jaxdyn.constraints.redundancy import add_constraints
from jaxdyn.contact.unilateral import UnilateralContact
from jaxdyn.lie import so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import (
    Checked,
    DType,
    Numbers,
    as_array,
    as_float,
    as_number,
    check_mapping,
    check_name,
    check_state,
    is_concrete,
    state_dtype,
    zeros_if_none,
)
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike


class Motion(NamedTuple):
    """An instant `t` (s) of a motion: `q` (nq,), `v` (nv,), `a` (nv,), its rate, and `multipliers` (nc,) of the constraints.

    `thrusts`: wrenches (6,) by the names of frames, which are a part of tau. `contacts`: forces (n,) of unilateral contacts by
    their names, friction before the normal force.
    """

    scene: Scene
    q: Array
    v: Array
    a: Array
    multipliers: Array
    t: Numbers = 0.0
    thrusts: Mapping[str, Any] | None = None
    contacts: Mapping[str, Array] | None = None

    @property
    def model(self) -> Model:
        """The tree of bodies of the scene; `Sensor.check` has refused other systems."""
        return cast(Model, self.scene.system)


class Noise(eqx.Module):
    r"""Errors of a sensor: reading + bias + walk(t) + white noise.

    Errors of an orientation are small rotations, so that it stays a unit quaternion: three angles, rad, about the axes of the
    frame in place of its four numbers.

    Each argument is a number, or has one for each entry of the reading, in its units.

    **Arguments:**

    - `std`: standard deviation of the white noise of a sample. A density d (per root of Hz) sampled every dt is $d / \sqrt{dt}$.
    - `bias`: a constant error. `walk`: the standard deviation of the bias's random walk after 1 s; it grows as the root of time.

    **Raises:** ValueError for deviations that are negative.

    Source: IEEE Std 952-1997, annex C, the terms of angle random walk and rate random walk.
    """

    std: Array
    bias: Array
    walk: Array

    def __init__(self, std: Numbers = 0.0, *, bias: Numbers = 0.0, walk: Numbers = 0.0):
        values = {name: as_array(value, name) for name, value in (("std", std), ("bias", bias), ("walk", walk))}
        for name, value in values.items():
            if np.ndim(value) > 1:
                raise ValueError(f"{name} has shape {value.shape}; give one number, or one per entry of the reading")
            if is_concrete(value) and not np.isfinite(value).all():
                raise ValueError(f"{name} is {value}; give finite numbers")
            # A bias may have either sign; deviations may not.
            if name != "bias" and is_concrete(value) and (np.asarray(value) < 0).any():
                raise ValueError(f"{name} is {value}; give standard deviations, which are not negative")
        self.std, self.bias, self.walk = (jnp.asarray(value, float) for value in values.values())

    def check(self, name: str, entries: int) -> None:
        """Refuse errors of another number of entries than the readings of a sensor. **Raises:** ValueError."""
        for key in ("std", "bias", "walk"):
            if (size := getattr(self, key).size) not in (1, entries):
                raise ValueError(
                    f"sensor {name!r}: {key} of its Noise has {size} entries, its readings have {entries} errors; give "
                    "one number, or one for each: an orientation has three angles (rad)"
                )

    def __call__(self, readings: Float[Array, "n k"], ts: Float[Array, " n"], key: Array) -> Float[Array, "n k"]:
        """Readings (n, k) at the times ts (n,), s, with errors drawn by a key."""
        # Two keys: the white noise and the walk of the bias are independent.
        white, steps = (jax.random.normal(one, readings.shape, readings.dtype) for one in jax.random.split(key))
        # The first span is zero, so that the walk starts from the bias at the first sample.
        spans = jnp.sqrt(jnp.diff(ts, prepend=ts[:1]).astype(readings.dtype))
        # Leaves are cast to the dtype of the readings: float64 noise would promote them.
        entries = (1, readings.shape[1])
        std, bias, walk = (
            jnp.broadcast_to(x.astype(readings.dtype).reshape(1, -1), entries) for x in (self.std, self.bias, self.walk)
        )
        # Increments have the variance of their spans, so that the walk does not depend on the rate of sampling.
        drift = walk * jnp.cumsum(steps * spans[:, None], 0)
        return readings + bias + drift + std * white


def _as_delay(delay: Numbers) -> Array:
    return as_number(delay, "delay", "s", zero=True, like=float)


class Sensor(eqx.Module):
    """Base class of sensors.

    - `name`: of its readings, by default `default_name()`. `noise`: its errors, or None; `delay` (), s: how much later its
      readings come. Both are applied by `record`.
    """

    name: str = eqx.field(static=True, default="", kw_only=True)
    noise: Noise | None = eqx.field(default=None, kw_only=True)
    delay: Array = eqx.field(converter=_as_delay, default=0.0, kw_only=True)

    def __post_init__(self):
        self.name = check_name(self.name, "name") or self.default_name()
        if not (self.noise is None or isinstance(self.noise, Noise)):
            raise ValueError(f"sensor {self.name!r}: noise is {self.noise!r}; give a jd.sensors.Noise, or None")

    def default_name(self) -> str:
        """Name of the readings where none is given."""
        return type(self).__name__.lower()

    def read(self, motion: Motion) -> Float[Array, " k"]:
        """The reading (k,) without errors."""
        raise NotImplementedError

    def quantize(self, readings: Float[Array, "*n k"]) -> Float[Array, "*n k"]:
        """Readings in steps of the resolution; unchanged for sensors without one."""
        return readings

    def quaternion_start(self, scene: Scene) -> int | None:
        """Index of the first of the four numbers of a unit quaternion in the readings, None without one."""
        return None

    def check(self, scene: Scene) -> None:
        """Refuse a scene that has not what the sensor is on. **Raises:** ValueError."""


def check_part(part: object, parts: dict) -> None:
    """Check that a sensor has such a part. **Raises:** ValueError."""
    if not (part is None or isinstance(part, str)) or part not in parts:
        raise ValueError(f"part is {part!r}; choose from {', '.join(map(repr, parts))}")


def check_sensors(scene: Scene, sensors: object) -> tuple[Sensor, ...]:
    """Sensors with names of their own, on a scene that has what they are on. **Raises:** ValueError."""
    if isinstance(sensors, Sensor):
        sensors = (sensors,)
    if not isinstance(sensors, (tuple, list)) or not all(isinstance(sensor, Sensor) for sensor in sensors):
        raise ValueError(f"sensors is {sensors!r}; give a list of sensors, such as [jd.sensors.Imu('hand')]")
    if not isinstance(scene.system, Model):
        raise ValueError(f"scene: a {type(scene.system).__name__} has no bodies for sensors; pass a Model or its scene")
    # Readings are a dictionary by name: equal names would overwrite each other.
    names = [sensor.name for sensor in sensors]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"sensors: the name {twice[0]!r} occurs twice; give the sensors different names")
    for sensor in sensors:
        sensor.check(scene)
    return tuple(sensors)


def measure(
    scene: SceneLike,
    sensors: Checked[Sequence[Sensor]],
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"] | None = None,
    t: Numbers = 0.0,
    *,
    thrusts: Mapping[str, Numbers] | None = None,
    contacts: Mapping[str, Numbers] | None = None,
) -> dict[str, Float[Array, " k"]]:
    """Readings of sensors at one instant, without errors and delay, in steps of their resolution.

    Accelerations and constraint forces are those of `constrained_dynamics` under tau and the scene's forces.

    **Arguments:** `scene` of a `Model`; `sensors`, a list; `q` (nq,); `v` (nv,); `tau` (nv,), N m or N (None: zero); `t`, s;
    `thrusts`: wrenches (f, tau) (6,) by the names of frames, at their origins and in their axes, whose generalised force is a
    part of `tau`, as of propellers (`scene.actuators.thrusts` of an MJCF file). `ForceTorque` feels them where they act; all of
    `tau` acts in the joints without them. `contacts`: of a scene with unilateral contacts, their forces by name, N: the normal
    force, then friction, as `ContactStep.forces`. Sensors feel them as those of constraints, and `ContactForce` and `Touch` read
    them.

    **Returns:** readings (k,) by the sensors' names, in SI units.

    **Raises:** ValueError for shapes that do not fit, sensors of equal names, and frames or joints that do not exist.

    ```python
    arm = jd.robots.iiwa()
    readings = jd.sensors.measure(arm, [jd.sensors.Imu("iiwa_link_7")], jnp.full(7, 0.3), jnp.zeros(7))
    ```
    """
    scene = as_scene(scene)
    sensors = check_sensors(scene, sensors)
    q, v, tau, t = check_state(scene.system, q=q, v=v, tau=zeros_if_none(tau, scene.nv), t=t)
    thrusts = check_thrusts(scene, thrusts, (6,), q.dtype)
    return readings_of(sensors, motion_at(scene, q, v, tau, t, thrusts, check_contacts(scene, contacts, (), q.dtype)))


def motion_at(scene: Scene, q, v, tau, t, thrusts, forces: Array) -> Motion:
    """Motion of a scene under torques and the forces of its contacts, stacked by rows, the normal one first.

    Its scene has the rows of the contacts behind its own.
    """
    # Solved once for all sensors: accelerations and multipliers belong to the same motion.
    touching = {force.name: force.contact for force in scene.forces if isinstance(force, UnilateralContact)}
    if not touching:
        dynamics = constrained_dynamics(scene, q, v, tau, t)
        return Motion(scene, q, v, dynamics.acceleration, dynamics.multipliers, t, thrusts)
    smooth = tuple(force for force in scene.forces if not isinstance(force, UnilateralContact))
    rows = constraint_jacobian(Scene(scene.system, tuple(touching.values())), q, t)
    dynamics = constrained_dynamics(add_constraints(scene, (), smooth), q, v, tau + matmul(forces, rows), t)
    multipliers = jnp.concatenate([dynamics.multipliers, forces])
    places = layout(Scene(scene.system, tuple(touching.values())))
    contacts = {
        name: jnp.roll(forces[place.start : place.end], -1) for name, place in zip(touching, places, strict=True)
    }
    return Motion(with_contacts(scene, smooth), q, v, dynamics.acceleration, multipliers, t, thrusts, contacts)


def with_contacts(scene: Scene, forces: Sequence = ()) -> Scene:
    """Scene with the rows of its unilateral contacts behind its own, and other forces."""
    touching = [force.contact for force in scene.forces if isinstance(force, UnilateralContact)]
    return add_constraints(scene, touching, forces)


def check_contacts(scene: Scene, contacts: object, rows: tuple[int, ...], dtype) -> Array:
    """Forces of the unilateral contacts of a scene, stacked by their rows, (*rows, k); () of a scene without.

    **Raises:** ValueError for contacts whose forces are missing, unknown names and shapes that do not fit.
    """
    touching = {force.name: force.contact for force in scene.forces if isinstance(force, UnilateralContact)}
    given = check_mapping(contacts, "contacts", "report.forces")
    if given.keys() != touching.keys():
        raise ValueError(
            f"contacts has the forces of {sorted(given)}, and the scene has the contacts {sorted(touching)}; pass the forces of "
            "a step, contacts=report.forces of jd.stepper(scene, dt, report=True)"
        )
    parts = [jnp.zeros((*rows, 0), dtype)]
    for name, contact in touching.items():
        wanted = (*rows, sum(contact.sizes(scene.system, dtype)))
        # The row of the gap comes before those of slip.
        parts.append(jnp.roll(as_float(given[name], f"contacts[{name!r}]", wanted, dtype), 1, -1))
    return jnp.concatenate(parts, -1)


def check_thrusts(scene: Scene, thrusts: object, shape: tuple[int, ...], dtype: DType) -> dict[str, Array]:
    """Check wrenches by the names of frames. **Raises:** ValueError for unknown frames, and for another shape."""
    given = check_mapping(thrusts, "thrusts", '{"propeller": wrench}')
    for frame in given:
        frame_index(scene.system, frame)
    return {frame: as_float(wrench, f"thrusts[{frame!r}]", shape, dtype) for frame, wrench in given.items()}


def readings_of(sensors: Sequence[Sensor], motion: Motion) -> dict[str, Array]:
    """Readings at an instant whose accelerations and multipliers are known."""
    return {sensor.name: sensor.quantize(sensor.read(motion)) for sensor in sensors}


def constraint_place(scene: Scene, name: str) -> slice:
    """Rows of a constraint by its name. **Raises:** ValueError for a name of none."""
    # The layout depends on structure only, so that the slice is static under tracing.
    places = layout(with_contacts(scene))
    for place in places:
        if place.name == name:
            return slice(place.start, place.end)
    names = ", ".join(repr(place.name) for place in places) or "none"
    raise ValueError(f"constraint {name!r} is not in the scene; its constraints are {names}")


def record(
    scene: SceneLike,
    sensors: Checked[Sequence[Sensor]],
    ts: Numbers,
    q: Numbers,
    v: Numbers,
    tau: Numbers | None = None,
    *,
    thrusts: Mapping[str, Numbers] | None = None,
    contacts: Mapping[str, Numbers] | None = None,
    key: Array | None = None,
) -> dict[str, Float[Array, "n k"]]:
    """Readings of sensors along a motion: delayed, with noise, then in steps of their resolution.

    A reading at t is that of t - delay, between samples by straight lines, and before the first one that of the first. It then
    gets the sensor's noise. Each sensor draws by its own key, of its place in the list. Orientations are interpolated and
    disturbed on the group: they stay unit quaternions, whose sign is that of the sample before.

    **Arguments:** `scene` of a `Model`; `sensors`, a list; `ts` (n,), s, increasing; `q` (n, nq), `v` (n, nv), `tau` (n, nv), N m
    or N (None: zero), as of a `Solution`; `thrusts`, as of `measure`, wrenches (n, 6) by the names of frames; `contacts`, as
    of `measure`, forces (n, k) by the names of contacts; `key` of `jax.random` for the noise, None for readings without it.

    **Returns:** readings (n, k) by the sensors' names.

    **Raises:** ValueError for shapes that do not fit, times that do not increase, and as `measure` does.

    ```python
    sensors = [jd.sensors.Encoder("1", resolution=0.001, noise=jd.sensors.Noise(1e-4), delay=0.01)]
    motion = jd.simulate(jd.scenes.four_bar(), *jd.scenes.four_bar.start(), jnp.linspace(0.0, 0.1, 11))
    readings = jd.sensors.record(jd.scenes.four_bar(), sensors, motion.ts, motion.q, motion.v, key=jax.random.key(0))
    ```
    """
    scene = as_scene(scene)
    sensors = check_sensors(scene, sensors)
    dtype = state_dtype(scene.system)
    ts, q, v = (as_array(x, name, dtype) for name, x in (("ts", ts), ("q", q), ("v", v)))
    tau = np.zeros(v.shape) if tau is None else tau
    tau = as_array(tau, "tau", dtype)
    wanted = {"ts": (ts, ()), "q": (q, (scene.nq,)), "v": (v, (scene.nv,)), "tau": (tau, (scene.nv,))}
    if not (ts.ndim and len(ts)):
        raise ValueError(f"ts has shape {ts.shape}; give the times (n,) of one sample or more")
    count = len(ts)
    for name, (value, rest) in wanted.items():
        if value.shape != (count, *rest):
            raise ValueError(f"{name} has shape {value.shape}, expected {(count, *rest)}, one row per time in ts")
    # `jnp.interp` needs increasing times and does not test them.
    if is_concrete(ts) and not (np.diff(np.asarray(ts)) > 0).all():
        raise ValueError("ts does not increase; give the times of the samples in order")

    thrusts = check_thrusts(scene, thrusts, (count, 6), dtype)

    forces = check_contacts(scene, contacts, (count,), dtype)

    def read(q, v, tau, t, thrusts, forces):
        # Accelerations are solved for, and not differences of v, which would amplify its rounding.
        motion = motion_at(scene, q, v, tau, t, thrusts, forces)
        return [sensor.read(motion) for sensor in sensors]

    readings = jax.vmap(read)(q, v, tau, ts, thrusts, forces)
    for sensor, values in zip(sensors, readings, strict=True):
        if sensor.noise is not None:
            at = sensor.quaternion_start(scene)
            # An orientation has four numbers and three angles of error.
            sensor.noise.check(sensor.name, values.shape[1] if at is None else at + 3)
    # One key for each sensor: the noise of one does not depend on the number of readings of another.
    try:
        keys = [None] * len(sensors) if key is None else list(jax.random.split(key, len(sensors)))
    except (TypeError, ValueError):
        raise ValueError(f"key is {key!r}; give a random key, such as jax.random.key(0), or None") from None
    results = {}
    for sensor, values, one in zip(sensors, readings, keys, strict=True):
        at, late = sensor.quaternion_start(scene), ts - sensor.delay.astype(dtype)
        noise = None if one is None else sensor.noise
        if at is None:
            # Before the first time `jnp.interp` returns the first reading.
            values = jax.vmap(lambda column, late=late: jnp.interp(late, ts, column), 1, 1)(values)
            values = values if noise is None else noise(values, ts, cast(Array, one))
        else:
            values = _interpolate_pose(values, at, ts, late)
            values = values if noise is None else _disturb_pose(values, at, noise, ts, one)
        # The converter is the last element of the chain: it rounds the noise as well.
        results[sensor.name] = sensor.quantize(values)
    return results


def _interpolate_pose(values, at: int, ts, late) -> Float[Array, "n k"]:
    """Readings with a quaternion from index `at` on, at the times `late`: orientations along the shortest rotations."""
    turns = values[:, at : at + 4]
    # A quaternion and its negative are one orientation: neighbours get the signs by which they are close.
    flips = jnp.where(jnp.sum(turns[1:] * turns[:-1], 1) < 0, -1.0, 1.0).astype(values.dtype)
    turns = turns * jnp.cumprod(jnp.concatenate([jnp.ones(1, values.dtype), flips]))[:, None]
    if len(ts) > 1:
        i = jnp.clip(jnp.searchsorted(ts, lax.stop_gradient(late), side="right") - 1, 0, len(ts) - 2)
        share = jnp.clip((late - ts[i]) / (ts[i + 1] - ts[i]), 0.0, 1.0)

        def between(first, second, share):
            step = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(first), second))
            return so3.quat_multiply(first, so3.quat_exp(share * step))

        turns = jax.vmap(between)(turns[i], turns[i + 1], share)
    rest = jax.vmap(lambda column: jnp.interp(late, ts, column), 1, 1)(values[:, :at]) if at else values[:, :0]
    return jnp.concatenate([rest, turns], 1)


def _disturb_pose(values, at: int, noise: Noise, ts, key) -> Float[Array, "n k"]:
    """Readings with a quaternion from index `at` on, with errors: its are rotations about the axes of the frame."""
    errors = noise(jnp.zeros((len(ts), at + 3), values.dtype), ts, key)
    turns = jax.vmap(lambda q, angles: so3.quat_multiply(q, so3.quat_exp(angles)))(values[:, at:], errors[:, at:])
    return jnp.concatenate([values[:, :at] + errors[:, :at], turns], 1)
