"""Readings of sensors along a motion, with their delay and noise."""

from collections.abc import Mapping, Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.lie import so3
from jaxdyn.model.arguments import Checked, Numbers, as_array, is_concrete, state_dtype
from jaxdyn.sensors.base import Noise, Sensor, check_contacts, check_sensors, check_thrusts, motion_at
from jaxdyn.systems.scene import as_scene
from jaxdyn.systems.system import SceneLike


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
    count = ts.shape[0] if ts.ndim else 0
    for name, (value, rest) in wanted.items():
        if not count or value.shape != (count, *rest):
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
    turns = turns * jnp.cumprod(jnp.concatenate([jnp.ones_like(flips[:1]), flips]))[:, None]
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
