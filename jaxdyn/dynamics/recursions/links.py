"""Joint transforms and motion subspaces of every joint kind, in canonical link frames (see `frames`).

Inside the recursions the velocity of a one-degree-of-freedom joint is that of a unit screw, rad/s or m/s; `unit_velocity` and
`unit_force` convert where a model's screws have another norm.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdyn.compile.known import as_numpy_if_known
from jaxdyn.dynamics.recursions.frames import Frames, PlaneAngle, canonical_frames, pseudo_inertias
from jaxdyn.dynamics.recursions.transforms import (
    Chain,
    GeneralRotation,
    PlaneRotation,
    PlaneRotations,
    Transform,
    X,
    Z,
    constants,
    contract,
    dot,
    entry,
    join,
    outer,
    part,
)
from jaxdyn.model.topology import KINDS, SCREW_KINDS
from jaxdyn.model.tree import Model

TURN_ABOUT_Z = ("revolute", "continuous", "helical", "planar")
SCREW_COORDINATE = {"revolute": 5, "continuous": 5, "prismatic": 2}  # of (v, omega), in canonical frames


class Links(NamedTuple):
    """Data of a model for the recursions, in canonical link frames; numpy arrays where the values are known."""

    model: Model
    frames: Frames
    moments: list  # (4, 4) pseudo-inertia of each body
    subspaces: list  # (6, nj) motion subspace S of each joint, in the frame of the body that it moves
    gravity: Any  # (3,) or None
    armature: Any  # (nv,) of unit screws, or None
    scale: Any  # (nv,): unit velocity = scale * v; None where all are one

    @property
    def parents(self) -> tuple[int, ...]:
        """Parent of each body, -1 for the world."""
        return self.model.topology.parents


def links_of(model: Model) -> Links:
    """Canonical frames, pseudo-inertias and motion subspaces of a model."""
    topology, frames = model.topology, canonical_frames(model)
    subspaces = [_subspace(kind, entry(frames.pitch, i)) for i, kind in enumerate(topology.kinds)]
    rate, scale = frames.rate, None
    # Unit screws, the rule, need no scaling operations at all.
    if not (isinstance(rate, np.ndarray) and (rate == 1).all()):
        widths = [KINDS[kind].nv for kind in topology.kinds]
        spread = np.repeat(np.eye(model.nb, dtype=model.home.dtype), widths, axis=0)
        scale = dot(spread, rate)
    armature = as_numpy_if_known(model.armature)
    if armature is not None and scale is not None:
        # Armature acts on v^2 of the model; on unit velocities it is divided by the square of the scale.
        armature = armature / (scale * scale)
    inertias = pseudo_inertias(model, frames)
    return Links(model, frames, inertias, subspaces, as_numpy_if_known(model.gravity), armature, scale)


def unit_velocity(of, v) -> Any:
    """Velocities (nv,), or None, of unit screws, `of` links or bodies with a `scale`; equally, forces of the model's screws."""
    return v if of.scale is None or v is None else v * of.scale


def unit_force(of, tau) -> Any:
    """The inverse: generalised forces (nv,) on unit screws; equally, velocities of the model's screws."""
    return tau if of.scale is None else tau / of.scale


def by_joint(links: Links, values) -> list:
    """Split a vector (nv,) into the entries (nj,) of each joint."""
    return [part(values, place.start, place.stop) for place in links.model.topology.v_slices]


def columns_of(kind: str) -> tuple[int | None, ...]:
    """Coordinate of (v, omega) whose unit vector each column of S is, or None."""
    return (SCREW_COORDINATE.get(kind),) if kind in SCREW_KINDS else KINDS[kind].columns


def _subspace(kind: str, pitch):
    dtype = pitch.dtype
    if kind != "helical":
        return np.eye(6, dtype=dtype)[:, [k for k in columns_of(kind) if k is not None]]
    along, about = np.eye(6, dtype=dtype)[:, 2], np.eye(6, dtype=dtype)[:, 5]
    return (along * pitch + about).reshape(6, 1)


def joint_transforms(links: Links, q) -> list[Chain]:
    """Poses of all bodies in their parents at the configuration q (nq,), as factors from the parent to the child."""
    topology = links.model.topology
    turning = [i for i, kind in enumerate(topology.kinds) if kind in TURN_ABOUT_Z]
    # All cosines and sines in one vector operation.
    angle = _angles(links, q, turning) if turning else None
    rotations = None if angle is None else PlaneRotations(Z, *angle)
    chains = []
    for i, kind in enumerate(topology.kinds):
        place = topology.q_slices[i]
        qi = part(q, place.start, place.stop)
        turn = PlaneRotation(rotations, turning.index(i)) if rotations and kind in TURN_ABOUT_Z else None
        joint = _joint_transform(kind, qi, entry(links.frames.rate, i), entry(links.frames.pitch, i), turn)
        screws = links.frames.screws
        if screws is None or kind in ("spherical", "free"):
            chains.append(compose(entry(links.frames.home, i), joint))
            continue
        home = screws[i]
        theta = None if kind in TURN_ABOUT_Z and kind != "planar" else home.theta  # those have it in their angle
        dtype = links.frames.home.dtype
        steps = [
            Transform(np.array([0, 0, home.e], dtype), _plane_rotation(Z, home.phi, dtype)),
            Transform(home.shift.astype(dtype), _plane_rotation(X, home.alpha, dtype)),
            Transform(np.array([0, 0, home.d], dtype), None if theta is None else _plane_rotation(Z, theta, dtype)),
            joint,
        ]
        chains.append(_simplify(steps))
    return chains


def _angles(links: Links, q, turning):
    """Cosines and sines (n,) of the joints' rotations about z, including the constant theta of the home pose."""
    topology, dtype = links.model.topology, links.frames.home.dtype
    pick = np.zeros((len(turning), links.model.nq), dtype)
    # A selection by a constant matrix stays one operation, whatever joints lie between.
    for row, i in enumerate(turning):
        pick[row, topology.q_slices[i].stop - 1] = 1
    angle = dot(pick, q)
    rate = links.frames.rate
    if not (isinstance(rate, np.ndarray) and (rate == 1).all()):
        angle = angle * (rate[turning] if isinstance(rate, np.ndarray) else jnp.stack([rate[i] for i in turning]))
    if links.frames.screws is None:
        return jnp.cos(angle), jnp.sin(angle)
    # A planar joint translates between theta and its own angle, so the two cannot be added.
    thetas = [links.frames.screws[i].theta if topology.kinds[i] != "planar" else PlaneAngle(1.0, 0.0) for i in turning]
    # Quarter turns only exchange sine and cosine, exactly; other angles are added to q.
    offset = np.array([0.0 if 0 in turn else np.arctan2(turn.sin, turn.cos) for turn in thetas], dtype)
    if offset.any():
        angle = angle + offset
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    c, s = (np.array([turn[k] if 0 in turn else 1.0 - k for turn in thetas], dtype) for k in (0, 1))
    return (c * cos - s * sin, s * cos + c * sin) if s.any() or (c < 0).any() else (cos, sin)


def _joint_transform(kind: str, q, rate, pitch, turn) -> Transform:
    """Transform of a joint at q (nqj,)."""
    up = np.array([0, 0, 1], q.dtype)
    if kind == "prismatic":
        slide = q if isinstance(rate, np.ndarray) and rate == 1 else q * rate
        return Transform(up * slide, None)
    if kind == "helical":
        return Transform(up * (q * (rate * pitch)), turn)
    if kind in SCREW_KINDS:
        return Transform(None, turn)
    if kind == "planar":
        return Transform(join([part(q, 0, 2), np.zeros(1, q.dtype)], 0), turn)
    if kind == "spherical":
        return Transform(None, GeneralRotation(quaternion_rotation(q)))
    return Transform(part(q, 0, 3), GeneralRotation(quaternion_rotation(part(q, 3, 7))))


def quaternion_rotation(q):
    """Rotation (3, 3) of a quaternion (w, x, y, z) of any length but zero."""
    dtype = q.dtype
    products = outer(q * (2 / dot(q, q)), q)
    return constants(dtype).eye3 + contract(_QUATERNION.astype(dtype), products, (2, 3), (0, 1))


def _quaternion_tensor() -> np.ndarray:
    """Tensor of the rotation R = 1 + 2 (w hat(u) + hat(u)^2) of a unit quaternion (w, u)."""
    hat, tensor = constants(float).hat, np.zeros((3, 3, 4, 4))
    tensor[:, :, 0, 1:] = hat
    square = np.einsum("ija,jkb->ikab", hat, hat)
    # Each product of two entries once, in the upper triangle: the expanded program then computes it once.
    for a, b in np.ndindex(3, 3):
        tensor[:, :, 1 + min(a, b), 1 + max(a, b)] += square[:, :, a, b]
    return tensor


_QUATERNION = _quaternion_tensor()


def _plane_rotation(axis: int, turn: PlaneAngle, dtype) -> PlaneRotation | None:
    if turn == (1, 0):
        return None
    return PlaneRotation(PlaneRotations(axis, np.array([turn.cos], dtype), np.array([turn.sin], dtype)), 0)


def compose(home, joint: Transform) -> Chain:
    """Compose a general home pose (4, 4) and a joint's transform."""
    rotation, place = part(part(home, 0, 3), 0, 3, 1), entry(part(home, 0, 3), 3, 1)
    shift = place if joint.shift is None else place + dot(rotation, joint.shift)
    turned = rotation if joint.rotation is None else dot(rotation, joint.rotation.matrix(3))
    return (Transform(shift, GeneralRotation(turned)),)


def _simplify(steps) -> Chain:
    """Drop identity factors and add up shifts without a rotation between them."""
    chain, shift = [], None
    for step in steps:
        if step.shift is not None and not (isinstance(step.shift, np.ndarray) and not step.shift.any()):
            shift = step.shift if shift is None else shift + step.shift
        if step.rotation is not None:
            chain.append(Transform(shift, step.rotation))
            shift = None
    return (*chain, Transform(shift, None)) if shift is not None else tuple(chain)


def as_vector(parts, like):
    """Concatenate the entries of all joints to a vector (nv,)."""
    parts = [x if x.ndim else x.reshape(1) for x in parts]
    if not parts:
        return jnp.zeros((0,), like.dtype)
    return lax.concatenate([jnp.asarray(x, like.dtype) for x in parts], 0)
