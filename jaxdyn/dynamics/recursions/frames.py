"""Canonical link frames, and the inertias in them: joints of one degree of freedom have the z axis of the body that they move.

Where the model's geometry is known while tracing, the remaining freedom of choice (rotation about z, translation along
it) is fixed as Denavit and Hartenberg did: a body's x axis is the common normal of its own joint axis and that of its
first child. The home pose of a body in its parent then is a screw along z, a screw along x, and a screw along z that
joins the joint's own,

    home = screw_z(phi, e) screw_x(alpha, r) screw_z(theta, d),

where the first is the identity for a first child. Each rotates in one plane only, which costs a spatial inertia 58 operations
instead of 240. With traced geometry, home poses stay general; the frame then depends smoothly on the joint's axis.

Source: Denavit & Hartenberg (1955); Khalil & Kleinfinger (1986) for trees; Duff et al. (2017) for the smooth frame.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxdyn.compile.known import is_concrete
from jaxdyn.model.topology import SCREW_KINDS
from jaxdyn.model.tree import Model, Topology, geometry

# Common normals of nearly parallel lines are far away: lengths grow by 1/sin(alpha), and with their
# squares the rounding errors of moments of inertia. Below this sine the shift stays general.
MIN_SINE = 0.2


class PlaneAngle(NamedTuple):
    """Known angle of a rotation in a coordinate plane, as cosine and sine."""

    cos: float
    sin: float


class Home(NamedTuple):
    """Known home pose as three screws: (phi, e) along z, (alpha, shift) about x with any shift, (theta, d) along z."""

    phi: PlaneAngle
    e: float
    alpha: PlaneAngle
    shift: np.ndarray  # (3,), (a, 0, 0) unless the axes are nearly parallel
    theta: PlaneAngle
    d: float


class Frames(NamedTuple):
    """Canonical frames of the bodies; numpy arrays where the geometry is known."""

    placement: Any  # (nb, 4, 4): pose of the canonical frame in the body's frame
    home: Any  # (nb, 4, 4): home pose of the canonical frame in the parent's canonical frame
    screws: list[Home] | None  # the home poses as screws, where they are known
    rate: Any  # (nb,): norm of the joint's screw, 1 for a unit screw: rad or m for a unit of q
    pitch: Any  # (nb,): translation along z per radian (m); zero for all kinds but helical


def canonical_frames(model: Model) -> Frames:
    """Canonical frames of the bodies of a model."""
    known = is_concrete(model.home, model.screws)
    if known:
        home, screws = np.asarray(model.home), np.asarray(model.screws) * model.topology.screw_mask
        screws = screws.astype(home.dtype)
    else:
        home, screws = geometry(model)
    placement, rate, pitch = _joint_axis_frames(model.topology, screws, np if known else jnp)
    if not known:
        outer = jnp.concatenate([placement, np.eye(4, dtype=home.dtype)[None]])
        parents = [parent if parent >= 0 else model.nb for parent in model.topology.parents]
        outer = jnp.stack([outer[parent] for parent in parents]) if parents else outer[:0]
        return Frames(placement, _inverse(outer, jnp) @ home @ placement, None, rate, pitch)
    # Computed cosines of right angles are within a few roundings of 0 and 1; they are snapped to these below.
    eps = 4 * float(np.finfo(home.dtype).eps)
    # Always in float64: the decomposition divides by sines.
    wide = home.astype(float)
    placement = _denavit_hartenberg(model.topology, wide, placement.astype(float), eps)
    outer = [placement[parent] if parent >= 0 else np.eye(4) for parent in model.topology.parents]
    homes = np.array([_inverse(a) @ h @ b for a, h, b in zip(outer, wide, placement, strict=True)]).reshape(-1, 4, 4)
    decomposed = [_decompose(pose, eps) for pose in homes]
    rate = np.where(np.abs(rate - 1) <= eps, np.ones_like(rate), rate)
    return Frames(placement.astype(home.dtype), homes.astype(home.dtype), decomposed, rate, pitch)


def _joint_axis_frames(topology: Topology, screws, xp):
    """Frames (nb, 4, 4) with z along each joint's axis and the origin on it, and norms and pitches of the screws."""
    turns = np.array([kind in SCREW_KINDS and kind != "prismatic" for kind in topology.kinds], bool)[:, None]
    slides = np.array([kind == "prismatic" for kind in topology.kinds], bool)[:, None]
    v, w = screws[:, :3], screws[:, 3:]
    up = xp.broadcast_to(xp.asarray(np.eye(3)[2], screws.dtype), v.shape)
    direction = xp.where(turns, w, xp.where(slides, v, up))
    rate = xp.sqrt(xp.sum(direction**2, 1))
    square = rate**2
    helical = xp.asarray(np.array([kind == "helical" for kind in topology.kinds]), screws.dtype)
    # w x v / |w|^2 is the point of the axis nearest to the body's origin.
    origin = xp.cross(w, v) * (helical / square)[:, None]
    pitch = xp.sum(w * v, 1) * helical / square
    rotation = _align_z(direction / rate[:, None], xp)
    last = xp.broadcast_to(xp.asarray(np.eye(4)[3:], screws.dtype), (topology.nb, 1, 4))
    return xp.concatenate([xp.concatenate([rotation, origin[:, :, None]], 2), last], 1), rate, pitch


def _align_z(axes, xp):
    """Rotations (n, 3, 3) whose third column is the given unit axis (n, 3); smooth except where z changes sign."""
    x, y, z = axes[:, 0], axes[:, 1], axes[:, 2]
    # Duff et al.: the sign keeps the denominator sign + z at least 1 in magnitude, for axes near -z too.
    sign = xp.where(z < 0, xp.full_like(z, -1.0), xp.full_like(z, 1.0))
    a = -1.0 / (sign + z)
    b = x * y * a
    first = xp.stack([1.0 + sign * x * x * a, sign * b, -sign * x], 1)
    second = xp.stack([b, sign + y * y * a, -y], 1)
    return xp.stack([first, second, axes], 2)


def _inverse(pose, xp=np):
    """Inverse of poses (..., 4, 4)."""
    turned = xp.swapaxes(pose[..., :3, :3], -1, -2)
    return xp.concatenate([xp.concatenate([turned, -turned @ pose[..., :3, 3:]], -1), pose[..., 3:, :]], -2)


def _denavit_hartenberg(topology: Topology, home, placement, eps):
    """Rotate frames about their z axes and translate them along these, such that most home poses are screws along x."""
    placement = placement.copy()
    children: list[list[int]] = [[] for _ in topology.parents]
    for i, parent in enumerate(topology.parents):
        if parent >= 0:
            children[parent].append(i)
    screw = [kind in SCREW_KINDS for kind in topology.kinds]
    # From the leaves: a body's frame depends on that of its first child.
    for i in reversed(range(topology.nb)):
        if screw[i] and children[i]:
            child = home[children[i][0]] @ placement[children[i][0]]
            if topology.kinds[i] == "prismatic":  # only the direction of its axis matters
                placement[i, :3, 3] = child[:3, 3]
            first = _decompose(_inverse(placement[i]) @ child, eps)
            placement[i] = placement[i] @ _screw_z(first.phi, first.e)
    for i, parent in enumerate(topology.parents):
        if screw[i] and not children[i]:  # a leaf's frame is that of its parent, moved along x
            outer = _inverse(home[i]) @ (placement[parent] if parent >= 0 else np.eye(4))
            if topology.kinds[i] == "prismatic":
                placement[i, :3, 3] = outer[:3, 3]
            last = _decompose(_inverse(outer) @ placement[i], eps)
            placement[i] = placement[i] @ _inverse(_screw_z(last.theta, last.d))
    return placement


def _screw_z(turn: PlaneAngle, length: float):
    c, s = turn
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, length], [0, 0, 0, 1.0]])


def _snap(x: float, eps: float) -> float:
    """Round x to 0, 1 or -1 within rounding."""
    return float(round(x)) if abs(x) < 2 and abs(x - round(x)) <= eps else float(x)


def _plane_angle(cos: float, sin: float, eps: float) -> PlaneAngle:
    size = np.hypot(cos, sin)
    return PlaneAngle(_snap(cos / size, eps), _snap(sin / size, eps))


def _decompose(pose, eps) -> Home:
    """Decompose a pose into screws along z, x and z."""
    axis, p = pose[:3, 2], pose[:3, 3]
    sine = np.hypot(axis[0], axis[1])
    reach = eps * (1 + np.abs(p).max())  # lengths below are rounding

    def length(x):
        return 0.0 if abs(x) <= reach else float(x)

    e = d = 0.0
    if sine > eps:
        phi, alpha = _plane_angle(-axis[1], axis[0], eps), _plane_angle(axis[2], sine, eps)
    else:
        # Parallel axes have a common normal everywhere; the one through the child's origin gives d = 0.
        alpha = PlaneAngle(1.0 if axis[2] > 0 else -1.0, 0.0)
        beside = np.hypot(p[0], p[1]) > reach
        phi = _plane_angle(p[0], p[1], eps) if beside else PlaneAngle(1.0, 0.0)
    along = phi.cos * p[0] + phi.sin * p[1], phi.cos * p[1] - phi.sin * p[0], p[2]  # in axes rotated by phi
    if sine > MIN_SINE:
        # Feet of the common normal: p = e z + a x + d axis, with axis = (0, -sin alpha, cos alpha).
        d = length(-along[1] / alpha.sin)
        e, shift = length(along[2] - d * alpha.cos), np.array([length(along[0]), 0.0, 0.0])
    elif sine > eps:
        # Nearly parallel axes: the foot of their common normal is far away (`MIN_SINE`).
        shift = np.array([length(x) for x in along])
    else:
        e, shift = length(along[2]), np.array([length(along[0]), 0.0, 0.0])
    # What remains of the rotation after phi and alpha is a rotation about the joint's own z axis.
    turned = np.array([[phi.cos, phi.sin, 0], [-phi.sin, phi.cos, 0], [0, 0, 1]]) @ pose[:3, :3]
    theta = _plane_angle(turned[0, 0], -turned[0, 1], eps)
    return Home(phi, e, alpha, shift, theta, d)


# --- inertias ---
#
# The pseudo-inertia of a body is the 4 x 4 matrix of its moments up to the second, the sum of m (r, 1)(r, 1)^T: the second
# moments, the first moment, the mass. A mass on the axis of a revolute joint moves in the same way whether it belongs to the
# body or to its parent, so such masses can be transferred without changing the equations of motion. The remaining ones are
# the base parameters of the mechanism (Gautier & Khalil 1990), with up to four zeros out of ten numbers. Neither the mass
# matrix nor the pivots of its factorisation change: a transferred inertia annihilates the joint's motion subspace.

# Moments (rows and columns x, y, z, 1 of the pseudo-inertia) that move with the parent as much as with the body.
_Z = np.diag([False, False, True, False])
SHARED = {
    "revolute": np.outer([False, False, True, True], [False, False, True, True]),
    "continuous": np.outer([False, False, True, True], [False, False, True, True]),
    "prismatic": np.outer([True, True, True, False], [True, True, True, False]),
    "helical": _Z,
    "planar": _Z,
    "spherical": np.diag([False, False, False, True]),
    "free": np.zeros((4, 4), bool),
}


def _moments() -> np.ndarray:
    """Tensor (4, 4, 10): pseudo-inertia from (m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz); second moments are tr(I)/2 - I."""
    tensor = np.zeros((4, 4, 10))
    tensor[3, 3, 0] = 1
    for i in range(3):
        tensor[i, 3, 1 + i] = tensor[3, i, 1 + i] = 1
        for place in (4, 6, 9):
            tensor[i, i, place] = 0.5
    for place, (i, j) in {4: (0, 0), 5: (0, 1), 6: (1, 1), 7: (0, 2), 8: (1, 2), 9: (2, 2)}.items():
        # A set, since a diagonal entry has one place and not two.
        for r, c in {(i, j), (j, i)}:
            tensor[r, c, place] -= 1
    return tensor


MOMENTS = _moments()


def pseudo_inertias(model: Model, frames: Frames) -> list:
    """Pseudo-inertias (4, 4) of the bodies in their canonical frames (kg, kg m, kg m^2), numpy arrays where they are known.

    Masses are transferred between bodies only if all values are known, where that costs nothing.
    """
    known = is_concrete(model.inertias, frames.placement)
    xp = np if known else jnp
    dtype = model.home.dtype
    inertias = xp.asarray(model.inertias)
    total = xp.einsum("ijk,nk->nij", xp.asarray(MOMENTS, dtype), inertias)
    placement = frames.placement
    turned = xp.swapaxes(placement[:, :3, :3], 1, 2)
    # Pseudo-inertias transform by congruence with the homogeneous matrix: J' = T J T^T.
    to_frame = xp.concatenate([xp.concatenate([turned, -turned @ placement[:, :3, 3:]], 2), placement[:, 3:]], 1)
    total = to_frame @ total @ xp.swapaxes(to_frame, 1, 2)
    if not known:
        return [total[i] for i in range(model.nb)]
    return _transfer_to_parents(model, total.astype(float), frames.home.astype(float), dtype)


def _transfer_to_parents(model: Model, total, home, dtype) -> list:
    # From the leaves to the root, so that a transferred mass can be transferred again.
    for i in reversed(range(model.nb)):
        shared = np.where(SHARED[model.topology.kinds[i]], total[i], 0)
        total[i] = np.where(SHARED[model.topology.kinds[i]], 0, total[i])
        parent = model.topology.parents[i]
        if parent >= 0:
            total[parent] += home[i] @ shared @ home[i].T
    # Congruences are symmetric to rounding only; the recursions read one triangle.
    symmetric = 0.5 * (total + np.swapaxes(total, 1, 2))
    return [x.astype(dtype) for x in symmetric]
