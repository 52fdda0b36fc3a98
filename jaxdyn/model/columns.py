"""Names and units of the entries of q, v and generalised forces, by joints."""

from typing import Any, NamedTuple

from jaxdyn.model.joints import KINDS
from jaxdyn.model.tree import Model

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
