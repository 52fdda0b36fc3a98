"""The recursions for many bodies: the same steps for each body, as sweeps over the tree whose code does not grow with it.

All joints have one degree of freedom, except that of a floating base, the root of all bodies. It is computed apart: outward
sweeps start with its carry, and inward ones end with it. What joints have alike, such as a zero, is dropped from the code.

- Known geometry: canonical frames (see `frames`), with s = (0, 0, a, 0, 0, b): a is 0 for revolute joints, 1 for prismatic ones,
  the pitch for helical ones; b is 0 or 1.
- Geometry that is an argument: the model's own frames and screws.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import sweep
from jaxdyn.compile.known import as_numpy_if_known, is_concrete
from jaxdyn.dynamics.recursions.frames import MOMENTS, canonical_frames, pseudo_inertias
from jaxdyn.dynamics.recursions.links import compose, quaternion_rotation, unit_force, unit_velocity
from jaxdyn.dynamics.recursions.newton_euler import eliminate, move_with_joint, spatial_inertia, wrench_of_acceleration
from jaxdyn.dynamics.recursions.transforms import (
    Chain,
    GeneralRotation,
    PlaneRotation,
    PlaneRotations,
    Transform,
    X,
    Z,
    contract,
    dot,
    inertia_to_parent,
    join,
    part,
    twist_to_child,
    wrench_to_parent,
)
from jaxdyn.model.topology import SCREW_KINDS, screw_transform
from jaxdyn.model.tree import Model, nearest_rotation

_TURNS = ("revolute", "continuous")


def has_base(model: Model) -> bool:
    """Decide whether a floating base carries all other bodies."""
    kinds, parents = model.topology.kinds, model.topology.parents
    return len(kinds) > 1 and kinds[0] == "free" and -1 not in parents[1:]


def has_sweeps(model: Model) -> bool:
    """Decide whether the joints are such that this module computes them."""
    kinds = {"revolute" if kind in _TURNS else kind for kind in model.topology.kinds[has_base(model) :]}
    # With given geometry the formula of a joint's pose is chosen by its kind.
    return kinds <= set(SCREW_KINDS) and (len(kinds) == 1 or is_concrete(model.home, model.screws))


class _Bodies:
    """Data of the bodies. `rows`: arrays (nb, ...) of all but a floating base; the methods take one row of them.

    `base`: rows of the floating base, if there is one.
    """

    rows: Any
    base: Any = None
    Row: Any
    scale: Any = None  # unit velocity = scale * v, (nv,), or None

    def __init__(self, model: Model):
        self.model, self.first = model, int(has_base(model))
        self.parents = tuple(x - self.first for x in model.topology.parents[self.first :])
        self.gravity, self.armature = as_numpy_if_known(model.gravity), as_numpy_if_known(model.armature)
        kinds = set(model.topology.kinds[self.first :])
        self.kind = "revolute" if kinds <= set(_TURNS) else kinds.pop() if len(kinds) == 1 else None
        self.dtype = model.home.dtype

    def split(self, rows: tuple) -> None:
        """Set rows of all bodies, armatures (nv,) the last of them."""
        *others, armature = rows
        own, of_base = (None, None) if armature is None else (armature[6 * self.first :], armature[:6])
        self.rows = self.Row(*(None if x is None else x[self.first :] for x in others), own)
        if self.first:
            self.base = self.Row(*(None if x is None else x[0] for x in others), of_base)

    # The coordinate of (v, omega) that all joints move along, or None.
    column: int | None = None
    # Of one row: the base's home pose (4, 4); the numbers that a body's pose in its parent depends on, with q, and the pose, from
    # these; the motion subspace (6,); the pseudo-inertia (4, 4).
    home: Callable[[Any], Any]
    place: Callable[[Any, Any], Any]
    chain: Callable[[Any, Any], Chain]
    subspace: Callable[[Any], Any]
    moments: Callable[[Any], Any]


class _Canonical(_Bodies):
    """Known geometry. Rows: home poses as screws, s, inertias, armatures."""

    class Row(NamedTuple):
        phi: Any  # (2,) cosine and sine
        alpha: Any
        theta: Any
        lengths: Any  # (5,): e, shift, d
        along: Any  # (): a
        about: Any  # (): b
        inertia: Any  # (4, 4) in the canonical frame; (10,) of the body, where these are given
        to_frame: Any  # (4, 4), where they are
        armature: Any  # (), or None

    def __init__(self, model: Model):
        super().__init__(model)
        frames, dtype, n = canonical_frames(model), self.dtype, model.nb
        screws, kinds = frames.screws, model.topology.kinds
        assert screws is not None
        self.homes = frames.home
        self.column = {"revolute": 5, "prismatic": 2}.get(self.kind or "")
        if not (frames.rate == 1).all():
            self.scale = np.concatenate([np.ones(5 * self.first, dtype), frames.rate])
            # Armature acts on v^2 of the model; on unit velocities it is divided by the square of the scale.
            self.armature = None if self.armature is None else self.armature / self.scale**2

        def rows(values):
            return np.array(values, dtype).reshape(n, -1)

        slides = np.array([kind == "prismatic" for kind in kinds], dtype)
        if is_concrete(model.inertias):
            inertias, to_frame = np.stack(pseudo_inertias(model, frames)), None
        else:
            inertias, to_frame = model.inertias, np.linalg.inv(frames.placement)
        of_bodies = (
            rows([x.phi for x in screws]), rows([x.alpha for x in screws]), rows([x.theta for x in screws]),
            rows([[x.e, *x.shift, x.d] for x in screws]), slides + frames.pitch, 1 - slides, inertias, to_frame,
            self.armature,
        )  # fmt: skip
        self.split(of_bodies)

    def home(self, row):
        return self.homes[0]

    def place(self, row, q):
        angle = q * row.about
        c, s = jnp.cos(angle), jnp.sin(angle)
        cos, sin = row.theta[0], row.theta[1]
        return jnp.stack([c * cos - s * sin, s * cos + c * sin, q * row.along])

    def chain(self, row, place) -> Chain:
        zero, lengths = np.zeros(2, self.dtype), row.lengths

        def plane(axis: int, angle):
            return PlaneRotation(PlaneRotations(axis, angle[:1], angle[1:]), 0)

        return (
            Transform(join([zero, lengths[:1]], 0), plane(Z, row.phi)),
            Transform(lengths[1:4], plane(X, row.alpha)),
            Transform(join([zero, lengths[4:] + place[2:]], 0), plane(Z, place[:2])),
        )

    def subspace(self, row):
        zero = np.zeros(2, self.dtype)
        return join([zero, row.along.reshape(1), zero, row.about.reshape(1)], 0)

    def moments(self, row):
        if row.to_frame is None:
            return row.inertia
        moments = contract(MOMENTS.astype(self.dtype), row.inertia, (2,), (0,))
        return contract(dot(row.to_frame, moments), row.to_frame, (1,), (1,))


class _Given(_Bodies):
    """Geometry that is an argument. Rows: home poses, screws, inertias, armatures; a place is a rotation and a position."""

    class Row(NamedTuple):
        home: Any  # (4, 4)
        screw: Any  # (6,)
        inertia: Any  # (10,)
        armature: Any  # (), or None

    def __init__(self, model: Model):
        super().__init__(model)
        self.split((model.home, model.screws, model.inertias, self.armature))

    def home(self, row):
        place = join([nearest_rotation(row.home[:3, :3]), row.home[:3, 3:]], 1)
        return join([place, np.eye(4, dtype=self.dtype)[3:]], 0)

    def place(self, row, q):
        home, pose = row.home, screw_transform(str(self.kind), self.subspace(row), q)
        rotation = nearest_rotation(home[:3, :3])
        turned, place = dot(rotation, pose[:3, :3]), home[:3, 3] + dot(rotation, pose[:3, 3])
        return join([turned.reshape(9), place], 0)

    def chain(self, row, place) -> Chain:
        return (Transform(part(place, 9, 12), GeneralRotation(part(place, 0, 9).reshape(3, 3))),)

    def subspace(self, row):
        return row.screw * self.model.topology.screw_mask[self.first].astype(self.dtype)

    def moments(self, row):
        return contract(MOMENTS.astype(self.dtype), row.inertia, (2,), (0,))


def _bodies(model: Model) -> _Bodies:
    return (_Canonical if is_concrete(model.home, model.screws) else _Given)(model)


def _to_unit_coordinates(bodies: _Bodies, q) -> Any:
    """Coordinates of unit screws; those of a floating base, a position and a quaternion, as they are."""
    if bodies.scale is None:
        return q
    return q * np.concatenate([np.ones(bodies.first, bodies.dtype), bodies.scale])


# --- a floating base ---


def _split(bodies: _Bodies, *values) -> list[tuple]:
    """Parts of vectors (nv,), or None: that of a floating base (6,), or None, and that of all other joints."""
    if not bodies.first:
        return [(None, x) for x in values]
    return [(None, None) if x is None else (part(x, 0, 6), part(x, 6, x.shape[0])) for x in values]


def _eliminate_base(bodies: _Bodies, A) -> tuple[list, list]:
    """Gains and inverse pivots of the six degrees of freedom of the base, of the articulated inertia A."""
    gains, inverses, armature = [], [], bodies.base.armature
    for k, s in enumerate(np.eye(6, dtype=bodies.dtype)):
        A, gain, inverse = eliminate(A, s, k, None if armature is None else armature[k])
        gains.append(gain)
        inverses.append(inverse)
    return gains, inverses


def _accelerate_base(gains: list, inverses: list, force, F) -> Any:
    """Acceleration of the base (6,), from the wrench F (6,) of the bodies that it carries."""
    left = []
    for k, gain in enumerate(gains):
        left.append(force[k] - F[k])
        F = F + gain * left[-1]
    x: Any = None
    for k in reversed(range(6)):
        along, free = np.eye(6, dtype=F.dtype)[k], left[k] * inverses[k]
        x = along * free if x is None else x + along * (free - dot(gains[k], x))
    return x


# --- sweeps ---


def _wrenches(bodies: _Bodies, q, v, a) -> tuple[Any, Any, Any]:
    """Inertial wrenches (nb, 6), gravity included, places (nb, n), and the wrench of a floating base: the outward sweep."""
    zero = np.zeros(3, bodies.dtype)
    start = zero, zero, np.zeros((3, 3), bodies.dtype), zero if bodies.gravity is None else -bodies.gravity
    (of_base, v), (rate, a), own = *_split(bodies, v, a), None
    if bodies.first:
        S = np.eye(6, dtype=bodies.dtype)
        pose = Transform(part(q, 0, 3), GeneralRotation(quaternion_rotation(part(q, 3, 7))))
        start = move_with_joint(start, compose(bodies.home(bodies.base), pose), S, of_base, rate)
        own = wrench_of_acceleration(start[2], start[3], bodies.moments(bodies.base))
        q = part(q, 7, q.shape[0])

    def step(motion, row):
        row, q, v, a = row
        place, S = bodies.place(row, q), bodies.subspace(row).reshape(6, 1)
        motion = move_with_joint(motion, bodies.chain(row, place), S, v, a)
        return motion, (wrench_of_acceleration(motion[2], motion[3], bodies.moments(row)), place)

    rows = bodies.rows, q, *(None if x is None else x.reshape(-1, 1) for x in (v, a))
    wrenches, places = sweep(step, bodies.parents, start, rows)[1]
    return wrenches, places, own


def rnea(model: Model, q, v, a) -> Float[Array, " nv"]:
    """Inverse dynamics (see `newton_euler.rnea`); `v` and `a` may be None, which is zero."""
    bodies = _bodies(model)
    q, v, a = _to_unit_coordinates(bodies, q), *(unit_velocity(bodies, x) for x in (v, a))
    wrenches, places, own = _wrenches(bodies, q, v, a)

    def step(total, row):
        row, place, wrench = row
        total = total + wrench
        return wrench_to_parent(bodies.chain(row, place), total), dot(bodies.subspace(row), total)

    end, tau = sweep(step, bodies.parents, np.zeros(6, bodies.dtype), (bodies.rows, places, wrenches), inward=True)
    if bodies.first:
        tau = join([end + own, tau], 0)
    if a is not None and bodies.armature is not None:
        tau = tau + bodies.armature * a
    return unit_velocity(bodies, tau)


def bias_force(model: Model, q, v) -> Float[Array, " nv"]:
    """Bias force C v + N (nv,)."""
    return rnea(model, q, v, None)


def gravity_force(model: Model, q) -> Float[Array, " nv"]:
    """Gravity force N (nv,)."""
    return rnea(model, q, None, None)


class _Factors(NamedTuple):
    """Articulated-body factors: per body its place, the gain U/D (6,) and 1/D; those of a floating base, in lists."""

    bodies: _Bodies
    places: Any
    gains: Any
    inverses: Any
    of_base: Any = None


def _factorize(bodies: _Bodies, places) -> _Factors:
    def step(total, row):
        row, place = row
        A = total + spatial_inertia(bodies.moments(row))
        rest, gain, inverse = eliminate(A, bodies.subspace(row), bodies.column, row.armature)
        return inertia_to_parent(bodies.chain(row, place), rest), (gain, inverse)

    start = np.zeros((6, 6), bodies.dtype)
    end, (gains, inverses) = sweep(step, bodies.parents, start, (bodies.rows, places), inward=True)
    if not bodies.first:
        return _Factors(bodies, places, gains, inverses)
    of_base = _eliminate_base(bodies, end + spatial_inertia(bodies.moments(bodies.base)))
    return _Factors(bodies, places, gains, inverses, of_base)


def _solve(factors: _Factors, force, wrenches=None, own=None) -> Float[Array, " nv"]:
    """Solve M a = force - (generalised forces of the wrenches, `own` that of a floating base)."""
    bodies, places, gains, inverses, of_base = factors
    zero = np.zeros(6, bodies.dtype)
    ((base_force, force),) = _split(bodies, unit_force(bodies, force))

    def inward(total, row):
        row, place, gain, force, wrench = row
        F = total if wrench is None else total + wrench
        left = force - dot(bodies.subspace(row), F)
        return wrench_to_parent(bodies.chain(row, place), F + gain * left), left

    def outward(V, row):
        row, place, gain, inverse, left = row
        V = twist_to_child(bodies.chain(row, place), V)
        x = left * inverse - dot(gain, V)
        return V + bodies.subspace(row) * x, x

    rows = bodies.rows, places, gains, force, wrenches
    end, left = sweep(inward, bodies.parents, zero, rows, inward=True)
    start = zero
    if of_base is not None:
        gains_of_base, inverses_of_base = of_base
        start = _accelerate_base(gains_of_base, inverses_of_base, base_force, end if own is None else end + own)
    a = sweep(outward, bodies.parents, start, (bodies.rows, places, gains, inverses, left))[1]
    return unit_force(bodies, a if of_base is None else join([start, a], 0))


def acceleration_and_inverse(model: Model, q, v, tau) -> tuple[Array, Callable]:
    """Forward dynamics a (nv,), and the function f -> M^-1 f, from one factorisation of M."""
    bodies = _bodies(model)
    wrenches, places, own = _wrenches(bodies, _to_unit_coordinates(bodies, q), unit_velocity(bodies, v), None)
    factors = _factorize(bodies, places)
    return _solve(factors, tau, wrenches, own), lambda force: _solve(factors, force)


def aba(model: Model, q, v, tau) -> Float[Array, " nv"]:
    """Forward dynamics (see `newton_euler.aba`)."""
    return acceleration_and_inverse(model, q, v, tau)[0]
