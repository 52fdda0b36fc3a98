"""Rigid-body arithmetic on the host: known numbers by NumPy in float64, traced ones by JAX.

Builds of models do not use the functions of `se3` and `inertia`: a chain of fixed links merged in float32 would lose
digits before the model exists, and refusals need concrete numbers. Traced numbers (by `jax.grad`,
`jax.vmap`, `jax.jit`) go through the same formulas; faults that only values show are then not refused.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.model.arguments import store_leaf
from jaxdyn.model.topology import KINDS, SCREW_KINDS, joint_neutral

# Positions of (xx, xy, yy, xz, yz, zz) in a symmetric 3x3 matrix, row by row.
SYMMETRIC = np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])
TRIANGLE = (np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2]))
# Rotations further than this from orthonormal are mistakes and not rounding: float32 files reach 1e-7; axes of the ground are
# typed with about six digits, and targets with four or five.
ORTHONORMAL, ORTHONORMAL_GROUND, ORTHONORMAL_TARGET = 1e-6, 1e-5, 1e-4
_V, _W = slice(0, 3), slice(3, 6)

Values = np.ndarray | jax.Array


def numbers(value, shapes: dict[tuple[int, ...], str], what: str, *, finite: bool = True) -> Values:
    """Convert `value` to an array of one of the `shapes` (each with a description for the message): float64, or traced.

    **Raises:** ValueError naming `what` for another shape, a value that is no number, and, when known, NaN and, when `finite`,
    infinity.
    """
    expected = " or ".join(shapes.values())
    known = is_concrete(value)
    try:
        if known and np.asarray(value).dtype.kind not in "biuf":  # numpy reads texts as numbers, "1_0" as ten
            raise TypeError
        array = np.asarray(value, np.float64) if known else jnp.asarray(value, float)
    # Values that are traced take jax's default dtype; only known ones are promoted to float64.
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} is {value!r}, expected {expected}") from error
    if array.shape not in shapes:
        raise ValueError(f"{what} has shape {array.shape}, expected {expected}")
    if known and not np.all(np.isfinite(array) | (~np.isnan(array) & (not finite))):
        raise ValueError(f"{what} is {array.tolist()}; every number must be finite")
    return array


def unit(axis, what: str) -> Values:
    """Normalise a direction (3,). **Raises:** ValueError naming `what` for another shape, NaN or a zero vector."""
    axis = numbers(axis, {(3,): "(3,)"}, what)
    if not is_concrete(axis):
        return axis / jnp.sqrt(jnp.sum(axis * axis))
    if not axis.any():
        raise ValueError(f"{what} is {axis.tolist()}; give a direction other than zero")
    axis = axis / np.abs(axis).max()  # so that the squares of very short or long vectors neither vanish nor overflow
    return axis / np.linalg.norm(axis)


def hat(vector: Values) -> Values:
    """Skew matrix (3, 3) with hat(a) b = a x b."""
    x, y, z = vector
    return array_namespace(vector).array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_from_rpy(rpy) -> Values:
    """Rotation R = Rz(yaw) Ry(pitch) Rx(roll) of the fixed-axis angles of URDF (rad)."""
    xp = array_namespace(rpy)
    (cr, cp, cy), (sr, sp, sy) = xp.cos(rpy), xp.sin(rpy)
    return xp.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Fixed-axis angles of a rotation, the inverse of `rotation_from_rpy`, exact to rounding at pitch = +-pi/2 too.

    At these pitches yaw is arbitrary; roll is computed after yaw has been undone, so the product is right.
    """
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    # hypot instead of arcsin: no loss of digits at pitch = +-pi/2 and no domain error from rounding.
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    roll = np.arctan2(s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1])
    return np.array([roll, pitch, yaw])


def pose_of(rotation, position) -> Values:
    """Pose (4, 4) of a rotation (3, 3) and a position (3,), known or traced."""
    xp = array_namespace(rotation, position)
    rotation, position = xp.asarray(rotation, float), xp.asarray(position, float)
    upper = xp.concatenate([rotation, position[:, None]], axis=1)
    return xp.concatenate([upper, np.eye(4)[3:] if xp is np else jnp.eye(4)[3:]])


def pose_matrix(pose, what: str) -> Values:
    """Pose matrix (4, 4) from None (identity), a (4, 4) matrix, a position (3,) or a pair (xyz, rpy).

    **Raises:** ValueError naming `what` for another shape and, when known, NaN, a rotation that is not orthonormal, a
    reflection.
    """
    if pose is None:
        return np.eye(4)
    given = numbers(pose, {(4, 4): "a (4, 4) matrix", (3,): "a position (3,)", (2, 3): "a pair (xyz, rpy)"}, what)
    if given.shape == (3,):
        return pose_of(np.eye(3), given)
    if given.shape == (2, 3):
        # Known angles of a pair with a traced position stay in float64: only the position is traced.
        turned = rotation_from_rpy(given[1] if not is_concrete(pose[1]) else np.asarray(pose[1], float))
        return pose_of(turned, given[0])
    if not is_concrete(given):
        return given
    rotation = given[:3, :3]
    if fault := rotation_fault(rotation, ORTHONORMAL):
        raise ValueError(f"{what}: the rotation {rotation.tolist()} {fault}; give a proper rotation or (xyz, rpy)")
    if np.any(given[3] != [0, 0, 0, 1]):
        raise ValueError(f"{what}: the last row is {given[3].tolist()}, expected [0, 0, 0, 1]")
    return given


def pose_leaf(pose, what: str) -> Float[Array, "4 4"]:
    """Convert a pose to an array leaf; its numbers may be traced, and jax arrays (4, 4) are used unchanged."""
    if isinstance(pose, jax.Array) and pose.shape == (4, 4):
        return pose
    # A position keeps its own dtype; the route through `pose_matrix` would give it the default one.
    if isinstance(pose, jax.Array) and pose.shape == (3,):
        return store_leaf(pose_of(np.eye(3), pose), pose.dtype)
    return store_leaf(pose_matrix(pose, what), float)


def rotation_fault(rotation: Values, tolerance: float) -> str:
    """Description of the fault of a known matrix (3, 3) that is no rotation; empty for a rotation."""
    # Measured before the determinant: a matrix that is far from orthonormal may have any determinant.
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > tolerance:
        return f"is not orthonormal: |R^T R - 1| = {error:.2g}"
    return "is a reflection" if np.linalg.det(rotation) < 0 else ""


def inverse(pose: Values) -> Values:
    """Inverse of a motion (4, 4)."""
    return pose_of(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3])


def adjoint(pose: Values) -> np.ndarray:
    """Adjoint Ad = [[R, hat(p) R], [0, R]] (6, 6)."""
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = pose[:3, :3]
    # Linear part first, so that the lever is in the upper right block.
    result[:3, 3:] = hat(pose[:3, 3]) @ pose[:3, :3]
    return result


def rotation_matrix(axis, angle) -> Values:
    """Rotation (3, 3) about a unit axis (3,) by an angle (rad): 1 + sin(a) hat(n) + (1 - cos(a)) hat(n)^2."""
    xp = array_namespace(axis, angle)
    axis, angle = xp.asarray(axis, float), xp.asarray(angle, float)
    cross = hat(axis)
    # 1 - cos(a) as 2 sin(a/2)^2, which does not cancel for small angles.
    return xp.eye(3) + xp.sin(angle) * cross + 2 * xp.sin(angle / 2) ** 2 * cross @ cross


def rotation_from_z(axis: np.ndarray) -> np.ndarray:
    """Rotation (4, 4) by the smallest angle that takes z to a unit axis; by pi about x for -z."""
    turn = np.eye(4)
    # z x axis: its length is the sine of the angle, so arctan2 with axis[2] is exact near 0 and pi.
    across = np.array([-axis[1], axis[0], 0.0])
    sine = np.linalg.norm(across)
    if sine > 0:
        turn[:3, :3] = rotation_matrix(across / sine, np.arctan2(sine, axis[2]))
    elif axis[2] < 0:
        turn[:3, :3] = np.diag([1.0, -1.0, -1.0])
    return turn


def joint_pose(kind: str, screw: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Pose of `topology.joint_transform` in float64: that of the body frame relative to its home pose."""
    pose = np.eye(4)
    if kind in SCREW_KINDS:
        v, axis = screw[:3], screw[3:]
        if axis.any():
            # Chasles: a rotation about the line through axis x v, and a translation of v . axis per radian along it.
            pose[:3, :3] = rotation_matrix(axis, q[0])
            pose[:3, 3] = (np.eye(3) - pose[:3, :3]) @ np.cross(axis, v) + axis * (v @ axis) * q[0]
        else:
            pose[:3, 3] = v * q[0]
    elif kind == "planar":
        pose[:3, :3] = rotation_matrix(np.array([0.0, 0.0, 1.0]), q[2])
        pose[:2, 3] = q[:2]
    else:
        # Divided by the norm, as in `joint_transform`: coordinates of files have few digits.
        w, v = q[-4] / np.linalg.norm(q[-4:]), q[-3:] / np.linalg.norm(q[-4:])
        pose[:3, :3] = np.eye(3) + 2 * hat(v) @ (w * np.eye(3) + hat(v))
        if kind == "free":
            pose[:3, 3] = q[:3]
    return pose


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Quaternion (w, x, y, z) of a rotation (3, 3), w >= 0, by the largest of four equal forms, so that no digits cancel."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    squares = np.array([1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i])  # 4 w^2, 4 x^2, 4 y^2, 4 z^2
    products = np.array(
        [[0, h - f, c - g, d - b], [h - f, 0, b + d, c + g], [c - g, b + d, 0, f + h], [d - b, c + g, f + h, 0]]
    )
    k = int(np.argmax(squares))
    quat = products[k].copy()
    quat[k] = squares[k]
    quat = quat / np.linalg.norm(quat)
    # Both signs are the same rotation; a fixed one makes results reproducible.
    return quat if quat[0] >= 0 else -quat


def inertia_numbers(inertia, what: str) -> Values:
    """Ten inertial parameters from None (massless), (10,), or (mass, com, inertia about the com).

    **Raises:** ValueError naming `what` for another shape and, when known, NaN, a negative mass or a matrix that is not
    symmetric.
    """
    if inertia is None:
        return np.zeros(10)
    if isinstance(inertia, tuple | list) and len(inertia) == 3:
        mass = numbers(inertia[0], {(): "a number"}, f"{what}: mass")
        com = numbers(inertia[1], {(3,): "(3,)"}, f"{what}: centre of mass")
        shapes = {(3, 3): "(3, 3)", (3,): "principal moments (3,)"}
        at_com = numbers(inertia[2], shapes, f"{what}: rotational inertia")
        at_com = array_namespace(at_com).diag(at_com) if at_com.ndim == 1 else at_com
        if is_concrete(at_com) and np.abs(at_com - at_com.T).max() > ORTHONORMAL * np.abs(at_com).max():
            raise ValueError(f"{what}: the rotational inertia {at_com.tolist()} is not symmetric")
        xp = array_namespace(mass, com, at_com)
        mass, com, at_com = (xp.asarray(x, float) for x in (mass, com, at_com))
        # Steiner's theorem, with the symmetric part taken row by row: an asymmetry below the tolerance is dropped.
        with np.errstate(over="ignore", invalid="ignore"):
            about_origin = at_com + mass * (com @ com * xp.eye(3) - xp.outer(com, com))
            parameters = xp.concatenate([mass[None], mass * com, about_origin[TRIANGLE]])
        # Finite factors can have an infinite product.
        if is_concrete(parameters) and not np.isfinite(parameters).all():
            raise ValueError(f"{what}: mass {mass} kg at {com.tolist()} m overflows; give numbers in kg and m")
    else:
        parameters = numbers(inertia, {(10,): "ten numbers (10,), (mass, com, inertia about the com) or None"}, what)
    if is_concrete(parameters) and parameters[0] < 0:
        raise ValueError(f"{what}: the mass is {parameters[0]} kg; it must not be negative")
    return parameters


# Files give moments with few digits: those of a plate are often a little more than their sum.
_DIGITS = 1e-3


def inertia_fault(parameters: np.ndarray) -> str:
    """Description of the fault of unphysical inertial parameters (10,); empty for those of bodies, points, rods and plates."""
    mass, _, moment = about_com(np.asarray(parameters, np.float64))
    if mass < 0:
        return f"its mass is negative ({mass:.6g} kg)"
    if mass == 0 and np.any(parameters[1:4]):
        return f"it has first moments {np.asarray(parameters[1:4]).tolist()} kg m and no mass"
    low, middle, high = np.linalg.eigvalsh(moment)
    # The shift to the centre of mass leaves a few roundings of the precision that the numbers came in.
    rounding = np.finfo(parameters.dtype).eps if parameters.dtype.kind == "f" else 0.0
    slack = 64 * rounding * np.abs(parameters[4:]).max() + 1e-9 * max(high, -low)
    if low < -slack:
        return f"a principal moment of inertia is negative ({low:.6g} kg m^2)"
    if high - low - middle > slack + _DIGITS * high:
        return (
            f"its principal moments of inertia {low:.6g}, {middle:.6g}, {high:.6g} kg m^2 break the triangle inequality: one is "
            "more than the sum of the others"
        )
    return ""


def rotational_inertia(parameters: Values) -> Values:
    """Rotational inertia (3, 3) about the frame's origin."""
    return parameters[4:][SYMMETRIC]


def about_com(parameters: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass (3,), rotational inertia about it (3, 3). A massless body has its centre at the origin."""
    mass, first = parameters[0], parameters[1:4]
    com = first / mass if mass != 0 else np.zeros(3)
    about_origin: Any = rotational_inertia(parameters)
    return float(mass), com, about_origin - (com @ first * np.eye(3) - np.outer(com, first))


def spatial_inertia(parameters: np.ndarray) -> np.ndarray:
    """Spatial inertia (6, 6), linear part first."""
    # The matrix of the first moments is skew, so that the two other blocks are negatives of each other.
    first = hat(parameters[1:4])
    return np.block([[parameters[0] * np.eye(3), -first], [first, rotational_inertia(parameters)]])


def pseudo_inertia(parameters: np.ndarray) -> np.ndarray:
    """Pseudo-inertia (4, 4) in float64, so that decisions about float32 models and factors of theirs keep their digits."""
    rotational = rotational_inertia(parameters)
    sigma = 0.5 * np.trace(rotational) * np.eye(3) - rotational
    matrix = np.empty((4, 4), parameters.dtype)
    matrix[:3, :3], matrix[:3, 3], matrix[3, :3], matrix[3, 3] = sigma, parameters[1:4], parameters[1:4], parameters[0]
    return matrix


def parameters_from_pseudo(matrix: np.ndarray) -> np.ndarray:
    """Ten inertial parameters of a pseudo-inertia (4, 4)."""
    sigma = matrix[:3, :3]
    return np.concatenate([matrix[3:, 3], matrix[:3, 3], (np.trace(sigma) * np.eye(3) - sigma)[TRIANGLE]])


def move_inertia(pose: Values, parameters: Values) -> Values:
    """Transform ten inertial parameters from frame b to frame a by `pose` T_ab (`inertia.transform_inertia` in float64)."""
    xp = array_namespace(pose, parameters)
    pose, parameters = xp.asarray(pose, float), xp.asarray(parameters, float)
    rotation, shift = pose[:3, :3], pose[:3, 3]
    mass, first = parameters[0], rotation @ parameters[1:4]
    inertia = rotation @ rotational_inertia(parameters) @ rotation.T
    # No division by the mass, so that massless bodies transform too.
    ph = xp.outer(shift, first)
    scale = 2 * shift @ first + mass * shift @ shift
    inertia = inertia + scale * xp.eye(3) - ph - ph.T - mass * xp.outer(shift, shift)
    return xp.concatenate([mass[None], first + mass * shift, inertia[TRIANGLE]])


def idle_joints(topology, home, screws, inertias, armature, q) -> dict[int, bool]:
    """Joints whose articulated inertia S^T I^A S (plus armature) is singular, with such joints further out locked.

    det M is the product of det(S^T I^A S) over the joints (Featherstone 2008, section 7.2), so the mass matrix is
    singular exactly when there is one, and is regular once all of them are locked. `q` lists each joint's coordinates.

    **Returns:** the joints, each with whether S^T I S vanishes for the composite inertia of all bodies that it carries.
    """
    composite = np.array([spatial_inertia(parameters) for parameters in inertias])
    articulated = composite.copy()
    idle = {}
    # From the leaves to the root, as in the articulated-body algorithm: a child's inertia is complete before its
    # parent's.
    for i in reversed(range(topology.nb)):
        kind = topology.kinds[i]
        S = screws[i][:, None] if kind in SCREW_KINDS else np.eye(6)[:, KINDS[kind].columns]
        rotor = np.zeros(S.shape[1]) if armature is None else armature[topology.v_slices[i]]
        whole = np.diag(S.T @ composite[i] @ S) + rotor
        D = S.T @ articulated[i] @ S + np.diag(rotor)
        v, w = np.linalg.norm(S[:3], axis=0), np.linalg.norm(S[3:], axis=0)
        mass, first, second = (np.linalg.norm(composite[i][a, b]) for a, b in ((_V, _V), (_W, _V), (_W, _W)))
        # Roots first: products of tiny inertias would vanish.
        root, carried = np.sqrt(np.abs(whole)), articulated[i]
        # Where the exact value is zero, rounding leaves about 1e-16 of the products that S^T I S is summed from. XLA takes
        # numbers below the normal ones for zero.
        zero = np.finfo(float).tiny + 1e-13 * (v * v * mass + 2 * v * w * first + w * w * second)
        if np.any(np.abs(whole) <= zero):
            idle[i] = True
        # D of exactly dependent joints is rounding of the numbers it is the difference of; 1e-12 of them is a margin.
        elif np.abs(np.linalg.eigvalsh(D / np.outer(root, root))).min() <= 1e-12:
            idle[i] = False
        else:
            U = articulated[i] @ S
            carried = articulated[i] - U @ np.linalg.solve(D, U.T)
        if (parent := topology.parents[i]) >= 0:
            # A joint already found idle passes its full inertia on, as if locked; the test of its parents stays
            # independent of it.
            X = adjoint(inverse(home[i] @ joint_pose(kind, screws[i], q[i])))
            composite[parent] += X.T @ composite[i] @ X
            articulated[parent] += X.T @ carried @ X
    return idle


def check_regular(topology, home, screws, inertias, armature) -> None:
    """Refuse a tree whose mass matrix is singular in every configuration. **Raises:** ValueError that names the joints."""
    if not is_concrete(home, screws, inertias, armature):
        return
    # A mass matrix that is singular at one configuration is legitimate; at a random one too, it is so at all of them.
    # A fixed seed, so that the same file is always accepted or always refused.
    rng = np.random.default_rng(0)
    neutral = [joint_neutral(kind) for kind in topology.kinds]
    if not idle_joints(topology, home, screws, inertias, armature, neutral):
        return
    # Quaternions need not be of unit length here: `joint_pose` divides by the norm.
    elsewhere = [q + rng.uniform(-1, 1, q.size) for q in neutral]
    if not (idle := idle_joints(topology, home, screws, inertias, armature, elsewhere)):
        return
    names = [topology.joint_names[i] for i in sorted(idle)]
    # Joints are visited from the leaves, so the first one is the outermost cause.
    i, alone = next(iter(idle.items()))
    fault = (
        "moves no inertia: S^T I S = 0 for all that it carries"
        if alone
        else "can move (together with joints beyond it, if any) without moving any inertia"
    )
    others = "" if len(idle) == 1 else f" (so it is, in all, with {', '.join(names)})"
    raise ValueError(
        f"joint {topology.joint_names[i]!r} (body {topology.body_names[i]!r}) {fault}, so the mass matrix is singular"
        f"{others}; give the bodies an inertia, give the joints an armature, or fix them (of a URDF: lock={names})"
    )
