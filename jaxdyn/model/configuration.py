"""Operations on the configuration manifold of a tree of bodies, and names and units of the entries of q, v and forces."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import array_namespace
from jaxdyn.model.arguments import Numbers, as_float, check_shapes
from jaxdyn.model.topology import (
    KINDS,
    joint_difference,
    joint_integrate,
    joint_neutral,
    joint_random,
    joint_rate,
)
from jaxdyn.model.tree import Model, Topology


def map_joints(topology: Topology, function, q, *rest) -> Array:
    """Apply `function(kind, q of the joint, ...)` to every joint; joints with one coordinate share one operation."""
    parts = []
    i = 0
    while i < topology.nb:
        j = i
        while j < topology.nb and KINDS[topology.kinds[j]].nq == 1:
            j += 1
        last = max(j - 1, i)  # consecutive joints with one coordinate are plain vectors
        qs = slice(topology.q_slices[i].start, topology.q_slices[last].stop)
        args = [
            x[qs] if along_q else x[topology.v_slices[i].start : topology.v_slices[last].stop] for x, along_q in rest
        ]
        parts.append(function(topology.kinds[i], q[qs], *args))
        i = last + 1
    return jnp.concatenate(parts) if parts else q


def neutral(model: Model) -> Float[Array, " nq"]:
    """Configuration at which every body is at its home pose, (nq,)."""
    check_shapes(model)
    parts = [joint_neutral(kind) for kind in model.topology.kinds]
    return jnp.asarray(np.concatenate(parts) if parts else np.zeros(0), model.home.dtype)


def integrate(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], dt: Numbers = 1.0) -> Float[Array, " nq"]:
    """Configuration reached from q after time dt at the constant body velocity v, on the joints' manifold.

    **Arguments:** `q` (nq,); `v` (nv,), body-fixed; `dt` in s.

    **Returns:** (nq,), with unit quaternions.

    **Raises:** ValueError for shapes that do not fit.
    """
    q, v = check_shapes(model, q=q, v=v)
    dt = as_float(dt, "dt", (), q.dtype)
    return model.complete_configuration(q, map_joints(model.topology, joint_integrate, q, (v * dt, False)))


def difference(model: Model, q0: Float[Array, " nq"], q1: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """Body velocity that moves q0 to q1 in unit time: `integrate(model, q0, difference(model, q0, q1)) == q1`.

    Rotations are compared by the smaller angle; at exactly pi one of the two directions is chosen.
    """
    q0, q1 = check_shapes(model, q0=q0, q1=q1)
    return map_joints(model.topology, joint_difference, q0, (q1, True))


def configuration_rate(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, " nq"]:
    r"""Rate dq/dt (nq,) for the body velocity v (nv,), by the kinematic map of the joints.

    $$\dot q = H(q) v$$
    """
    q, v = check_shapes(model, q=q, v=v)
    return model.complete_rate(q, v, joint_rates(model, q, v))


def joint_rates(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Array:
    """Rates of the joints' coordinates in q for the body velocity v (nv,)."""
    return map_joints(model.topology, joint_rate, q, (v, False))


def normalize(model: Model, q: Float[Array, " nq"]) -> Float[Array, " nq"]:
    """Project q (nq,) to the manifold: unit quaternions, other coordinates unchanged."""
    (q,) = check_shapes(model, q=q)

    def unit(kind, qj):
        if kind not in ("spherical", "free"):
            return qj
        # No guard for a zero quaternion: it represents no rotation, and NaN shows the fault.
        quat = qj[-4:] / jnp.sqrt(jnp.sum(qj[-4:] ** 2))
        return quat if kind == "spherical" else jnp.concatenate([qj[:3], quat])

    return model.complete_configuration(q, map_joints(model.topology, unit, q))


def random_configuration(model: Model, key: Array) -> Float[Array, " nq"]:
    """Random configuration (nq,): uniform within finite position limits (else within +-pi or +-1 m), uniform rotations."""
    check_shapes(model)
    topology = model.topology
    # One key per joint, so that a joint's sample does not depend on the kinds of the others.
    keys = jax.random.split(key, topology.nb)
    xp = array_namespace(model.lower, model.upper)
    lower, upper = xp.asarray(model.lower), xp.asarray(model.upper)
    parts = []
    for i, kind in enumerate(topology.kinds):
        place = topology.q_slices[i]
        reach = np.full(KINDS[kind].nq, 1.0 if kind in ("prismatic", "planar", "free") else np.pi)
        if kind == "planar":
            # The third coordinate of a planar joint is an angle.
            reach[2] = np.pi
        low, high = lower[place], upper[place]
        low = xp.where(xp.isfinite(low), low, xp.asarray(-reach, low.dtype))
        high = xp.where(xp.isfinite(high), high, xp.asarray(reach, high.dtype))
        parts.append(joint_random(kind, keys[i], low, high, model.home.dtype))
    return jnp.concatenate(parts) if parts else jnp.zeros((0,), model.home.dtype)


_Q = {"planar": ("x", "y", "theta"), "spherical": ("qw", "qx", "qy", "qz")}
_Q["free"] = ("x", "y", "z", *_Q["spherical"])
_V = {"planar": ("vx", "vy", "wz"), "spherical": ("wx", "wy", "wz"), "free": ("vx", "vy", "vz", "wx", "wy", "wz")}
_UNITS = {"x": "m", "y": "m", "z": "m", "theta": "rad"}


class Columns(NamedTuple):
    """Names of the entries of q (nq,) and v (nv,), and units of these, of accelerations and of generalised forces.

    A joint with one coordinate gives it its own name, others are JOINT.x and the like. Units are "" for systems without joints.
    """

    q: tuple[str, ...]
    v: tuple[str, ...]
    q_units: tuple[str, ...]
    v_units: tuple[str, ...]
    a_units: tuple[str, ...]
    force_units: tuple[str, ...]


def columns_of(system: Any) -> Columns:
    """Names and units of a system's coordinates: those of its joints, or q1, q2, ... without units."""
    # Coordinates of other systems may be anything, so that no unit is known.
    if not isinstance(system, Model):
        q, v = (tuple(f"{name}{i + 1}" for i in range(n)) for name, n in (("q", system.nq), ("v", system.nv)))
        return Columns(q, v, *(("",) * len(x) for x in (q, v, v, v)))
    q, v, q_units, linear = [], [], [], []
    for joint, kind in zip(system.joint_names, system.topology.kinds, strict=True):
        if KINDS[kind].nq == 1:
            q.append(joint)
            v.append(joint)
            q_units.append("m" if kind == "prismatic" else "rad")
            linear.append(kind == "prismatic")
            continue
        q += [f"{joint}.{part}" for part in _Q[kind]]
        v += [f"{joint}.{part}" for part in _V[kind]]
        q_units += [_UNITS.get(part, "1") for part in _Q[kind]]
        # Twists list velocities first by name, so the letter v marks the linear entries.
        linear += [part[0] == "v" for part in _V[kind]]
    rates = [("m/s", "m/s^2", "N") if slides else ("rad/s", "rad/s^2", "N m") for slides in linear]
    units = (tuple(rate[k] for rate in rates) for k in range(3))
    return Columns(tuple(q), tuple(v), tuple(q_units), *units)
