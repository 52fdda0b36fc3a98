"""Loops closed by a joint between two bodies, couplings of joints, and locks.

A loop holds a frame A of one body and a frame B of another together as a joint would: with T = T_A^-1 T_B = (R, p) it
has only the residuals that this joint removes. Translations are entries of p (m). Rotations are twice the tangents of
half angles: smooth, equal to the angle to first order, and large where the frames are turned upside down, so that a
correction never ends at the false solution that a sine has there.

    axis rows     2 (R_02, R_12) / (1 + R_22)            z of B along z of A
    attitude rows 4 vee(R) / (1 + tr R) = 2 tan(theta/2) n    axes of B along those of A
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import Constraint
from jaxdyn.constraints.frames import Pair
from jaxdyn.model.arguments import (
    Checked,
    DType,
    Number,
    Numbers,
    as_float,
    as_number,
    check_body,
    check_flag,
    check_name,
    check_new_name,
)
from jaxdyn.model.host_math import pose_leaf
from jaxdyn.model.topology import KINDS, SCREW_KINDS, body_index, joint_difference
from jaxdyn.model.tree import Model


def _above_zero(x):
    """x, and at least rounding, with what to add to the numerators of the quotients by it: 1 where x is zero, else 0."""
    # Exactly upside down the numerators vanish too: without the addition a mechanism would count as closed there. With it the
    # residual is huge, as it is nearby, and a Newton step turns the frames by about a radian.
    tiny = float(jnp.finfo(x.dtype).eps)
    is_zero = x < tiny
    return jnp.where(is_zero, jnp.full_like(x, tiny), x), jnp.where(is_zero, jnp.ones_like(x), jnp.zeros_like(x))


def _axis(R):
    """Twice the tangent of half the angle between the axes z, split along x and y."""
    height, push = _above_zero(1.0 + R[2][2])
    return 2.0 * (R[0][2] + push) / height, 2.0 * R[1][2] / height


def attitude(R):
    """Twice the tangent of half the angle, along the axis of the rotation: three numbers."""
    size, push = _above_zero(1.0 + R[0][0] + R[1][1] + R[2][2])
    return tuple(2.0 * (R[j][i] - R[i][j] + push) / size for i, j in ((1, 2), (2, 0), (0, 1)))


def _turn(R):
    """Twice the tangent of half the angle about z, when that is the only angle."""
    size, push = _above_zero(1.0 + 0.5 * (R[0][0] + R[1][1]))
    return ((R[1][0] - R[0][1] + push) / size,)


class Kind(NamedTuple):
    """Rows that a joint removes: entries of p, then functions of the entries R[i][j]."""

    slides: tuple[int, ...]
    turn: Callable | None = None
    turns: int = 0

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.slides) + self.turns

    def residual(self, R, p):
        """Residual (n,) of a rotation and a position."""
        return jnp.stack([*(p[i] for i in self.slides), *(() if self.turn is None else self.turn(R))])


# Rows by joint. A revolute loop has the two rows of `_axis` and no third one about z, which is its free motion.
_SPATIAL = {
    "point": Kind((0, 1, 2)),
    "spherical": Kind((0, 1, 2)),
    "revolute": Kind((0, 1, 2), _axis, 2),
    # The crosspiece holds z of A and z of B at a right angle: their product, R_22, is zero.
    "universal": Kind((0, 1, 2), lambda R: (R[2][2],), 1),
    "prismatic": Kind((0, 1), attitude, 3),
    "cylindrical": Kind((0, 1), _axis, 2),
    "planar": Kind((2,), _axis, 2),
    "weld": Kind((0, 1, 2), attitude, 3),
}
_IN_PLANE = {
    "point": Kind((0, 1)),
    "revolute": Kind((0, 1)),
    "prismatic": Kind((1,), _turn, 1),
    "weld": Kind((0, 1), _turn, 1),
}


class Loop(Pair):
    """A loop closed by a joint between two bodies; made by `jd.loop`."""

    name: str = eqx.field(static=True)
    joint: str = eqx.field(static=True)
    body_a: str | None = eqx.field(static=True)
    body_b: str | None = eqx.field(static=True)
    in_plane: bool = eqx.field(static=True)
    pose_a: Float[Array, "4 4"]
    pose_b: Float[Array, "4 4"]

    @property
    def kind(self) -> Kind:
        """The rows that the joint removes."""
        return (_IN_PLANE if self.in_plane else _SPATIAL)[self.joint]

    def sizes(self, system, dtype):
        """Rows that the joint removes; none are nonholonomic."""
        check_bodies(self.name, system, (self.body_a, self.body_b))
        return self.kind.count, 0

    def ends(self):
        """Frames A and B, each a body and a pose in it."""
        return (self.body_a, self.pose_a), (self.body_b, self.pose_b)

    def structure_key(self):
        """The joint."""
        return self.joint, self.in_plane

    def pose_residual(self, R, p):
        """Residual of the joint, (n,)."""
        return self.kind.residual(R, p)


def loop(
    body_a: str | None,
    pose_a: Numbers | None,
    body_b: str | None,
    pose_b: Numbers | None,
    joint: str = "revolute",
    *,
    in_plane: bool = False,
    name: str | None = None,
) -> Loop:
    """Close a loop: hold a frame of one body and a frame of another together as a joint would.

    | joint              | rows | free motion of frame B against frame A             |
    |--------------------|------|-----------------------------------------------------|
    | revolute           | 5    | turns about z                                       |
    | prismatic          | 5    | slides along z of A, attitudes equal                |
    | cylindrical        | 4    | turns about and slides along z                      |
    | universal          | 4    | turns about z of A and about z of B, perpendicular  |
    | spherical, point   | 3    | turns every way                                     |
    | planar             | 3    | slides in the x-y plane of A, turns about z         |
    | weld               | 6    | none                                                |

    In a mechanism that moves in one plane, three rows of a spatial joint are redundant. They are allowed
    (`constrained_dynamics` handles dependent rows), but cost time. With `in_plane=True` only the rows within the x-y
    plane of frame A exist: 2 for revolute and point, 3 for weld, 2 for prismatic, which then slides along x of A.

    **Arguments:**

    - `body_a`, `body_b`: names of bodies or frames of the scene's model; None is the world.
    - `pose_a`, `pose_b`: of the joint's frame in the body's: None (identity), (4, 4), (3,) or (xyz, rpy); m and rad.
    - `joint`: see the table.
    - `in_plane`: only the rows within the x-y plane of frame A.
    - `name`: for errors and reports; by default made of the two bodies.

    **Raises:** ValueError for an unknown joint, a bad pose or twice the same body; when used, for a system that is no
    `Model` and for names that it does not have.
    """
    name = check_new_name(name, f"{body_a or 'world'}-{body_b or 'world'}")
    what = f"loop {name!r}"
    kinds = _IN_PLANE if check_flag(in_plane, f"{what}: in_plane") else _SPATIAL
    if not isinstance(joint, str) or joint not in kinds:
        raise ValueError(f"{what}: joint {joint!r} is unknown; choose from {', '.join(kinds)}")
    if body_a == body_b:
        raise ValueError(f"{what}: both frames are on {body_a or 'the world'!r}; name two different bodies")
    return Loop(
        name=name,
        joint=str(joint),
        body_a=check_body(body_a, f"{name!r}: body_a"),
        body_b=check_body(body_b, f"{name!r}: body_b"),
        in_plane=in_plane,
        pose_a=pose_leaf(pose_a, f"{what}: pose_a"),
        pose_b=pose_leaf(pose_b, f"{what}: pose_b"),
    )


class Distance(Pair):
    """Two points at a fixed distance; made by `jd.constraints.distance`."""

    name: str = eqx.field(static=True)
    body_a: str | None = eqx.field(static=True)
    body_b: str | None = eqx.field(static=True)
    pose_a: Float[Array, "4 4"]
    pose_b: Float[Array, "4 4"]
    length: Float[Array, ""]

    def sizes(self, system, dtype):
        """One row."""
        check_bodies(self.name, system, (self.body_a, self.body_b))
        return 1, 0

    def ends(self):
        """Frames A and B, each a body and a pose in it."""
        return (self.body_a, self.pose_a), (self.body_b, self.pose_b)

    def structure_key(self):
        """No static part: all distances are one batch."""
        return ()

    def pose_residual(self, R, p):
        """(|p|^2 - length^2) / (2 length), (1,), m: smooth everywhere, and the change of length to first order."""
        # Not |p| - length, whose derivative does not exist at p = 0, where a rough guess may begin.
        length = self.length.astype(p.dtype)
        return ((jnp.sum(p**2) - length**2) / (2.0 * length))[None]


def distance(
    body_a: str | None,
    point_a: Numbers | None,
    body_b: str | None,
    point_b: Numbers | None,
    length: float,
    *,
    name: str | None = None,
) -> Distance:
    """Hold two points at a distance, as a massless rod with ball joints does.

    **Arguments:** `body_a`, `body_b`: bodies or frames, None for the world; `point_a`, `point_b` (3,), in the body's
    frame, m; `length`, m, positive (for zero take `loop(..., joint="point")`).

    **Raises:** ValueError for bad points or a length that is not positive.
    """
    name = check_new_name(name, f"distance {body_a or 'world'}-{body_b or 'world'}")
    return Distance(
        name=name,
        body_a=check_body(body_a, f"{name!r}: body_a"),
        body_b=check_body(body_b, f"{name!r}: body_b"),
        pose_a=pose_leaf(point_a, f"{name!r}: point_a"),
        pose_b=pose_leaf(point_b, f"{name!r}: point_b"),
        length=as_number(length, f"{name!r}: length", "m"),
    )


class Gear(Constraint):
    """Two joints with a fixed ratio of their coordinates; made by `jd.constraints.gear`."""

    name: str = eqx.field(static=True)
    joint_a: str = eqx.field(static=True)
    joint_b: str = eqx.field(static=True)
    ratio: Float[Array, ""]
    offset: Float[Array, ""]

    def sizes(self, system: Checked[Model], dtype: DType) -> tuple[int, int]:
        """One row."""
        for joint in (self.joint_a, self.joint_b):
            kind = system.topology.kinds[joint_index(self.name, system, joint)]
            if kind not in SCREW_KINDS:
                raise ValueError(f"{self.name!r}: joint {joint!r} is {kind}; couple joints of one degree of freedom")
        return 1, 0

    def position(self, system: Model, q: Float[Array, " nq"], t: Number) -> Float[Array, "1"]:
        """q_a - ratio q_b - offset, (1,)."""
        starts = [
            system.topology.q_slices[joint_index(self.name, system, j)].start for j in (self.joint_a, self.joint_b)
        ]
        return (q[starts[0]] - self.ratio.astype(q.dtype) * q[starts[1]] - self.offset.astype(q.dtype))[None]


def gear(joint_a: str, joint_b: str, ratio: Numbers, offset: Numbers = 0.0, *, name: str | None = None) -> Gear:
    r"""Couple two joints of one degree of freedom.

    $$q_a = \mathrm{ratio} \cdot q_b + \mathrm{offset}$$

    A prismatic joint with a revolute one is a rack and pinion (ratio in m/rad) or the other way round.

    **Raises:** ValueError when both are the same joint; when used, for joints that do not exist or do not fit.
    """
    if joint_a == joint_b:
        raise ValueError(f"gear: both joints are {joint_a!r}; name two different ones")
    name = check_new_name(name, f"gear {joint_a}-{joint_b}")
    what = f"{name!r}: "
    return Gear(
        name,
        check_name(joint_a, what + "joint_a"),
        check_name(joint_b, what + "joint_b"),
        as_float(ratio, what + "ratio", (), float),
        as_float(offset, what + "offset", (), float),
    )


class JointLock(Constraint):
    """A joint held at a value; made by `jd.constraints.lock_joint`."""

    name: str = eqx.field(static=True)
    joint: str = eqx.field(static=True)
    value: Float[Array, " nqj"]

    def sizes(self, system: Checked[Model], dtype: DType) -> tuple[int, int]:
        """One row per degree of freedom of the joint."""
        i = joint_index(self.name, system, self.joint)  # raises for systems without joints
        kind = system.topology.kinds[i]
        if self.value.shape != (KINDS[kind].nq,):
            raise ValueError(
                f"{self.name!r}: value has shape {self.value.shape}, but joint {self.joint!r} is {kind} with "
                f"{KINDS[kind].nq} coordinates"
            )
        return KINDS[kind].nv, 0

    def position(self, system: Model, q: Float[Array, " nq"], t: Number) -> Float[Array, " nvj"]:
        """Displacement of the joint from its value, on the joint's manifold, (nv of the joint,)."""
        i = joint_index(self.name, system, self.joint)
        # By the manifold's difference: coordinates of a ball joint are four, its rows are three.
        return joint_difference(system.topology.kinds[i], self.value.astype(q.dtype), q[system.topology.q_slices[i]])


def lock_joint(joint: str, value: Numbers = 0.0, *, name: str | None = None) -> JointLock:
    """Hold a joint at a value.

    **Arguments:** `joint`, its name; `value`, a number (rad or m) or all its coordinates (with a unit quaternion).

    **Raises:** ValueError for a value that is not finite; when used, for an unknown joint or a value of another size.
    """
    array = jnp.atleast_1d(as_float(value, f"lock_joint {joint!r}: value", None, float))
    if is_concrete(value) and not np.isfinite(np.asarray(value, float)).all():
        raise ValueError(f"lock_joint {joint!r}: value is {value}; give finite numbers")
    return JointLock(check_new_name(name, f"lock {joint}"), check_name(joint, "lock_joint: joint"), array)


def model_couplings(model: Model) -> tuple[Gear, ...]:
    """The couplings that a model records (mimic joints of a file, `add_coupling`) as constraints of a scene, one `gear` each.

    ```python
    scene = jd.Scene(model, jd.constraints.model_couplings(model))
    ```
    """
    names, values = model.joint_names, () if model.coupling_values is None else model.coupling_values
    return tuple(
        gear(names[joint], names[source], *value)
        for (joint, source), value in zip(model.topology.couplings, values, strict=True)
    )


def check_bodies(name: str, system, bodies) -> None:
    """Raise a ValueError that names the constraint when the system has no such bodies."""
    if not isinstance(system, Model):
        raise ValueError(
            f"constraint {name!r} acts on bodies, and a {type(system).__name__} has none; write it as Holonomic or "
            "Pfaffian in the system's coordinates"
        )
    for body in bodies:
        try:
            body_index(system, body)
        except ValueError as error:
            raise ValueError(f"constraint {name!r}: {error}; both bodies have to be of the scene's model") from None


def joint_index(name: str, system, joint: str) -> int:
    """Index of a joint by name. **Raises:** ValueError that names the constraint."""
    if not isinstance(system, Model):
        raise ValueError(f"constraint {name!r} acts on joints, and a {type(system).__name__} has none; use Holonomic")
    if joint not in system.joint_names:
        raise ValueError(
            f"constraint {name!r}: joint {joint!r} is not in model {system.name!r}; it has {list(system.joint_names)}"
        )
    return system.joint_names.index(joint)
