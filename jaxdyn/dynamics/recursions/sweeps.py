"""The recursions for many bodies: the same steps for each body, as sweeps over the tree whose code does not grow with it.

All joints have one degree of freedom. Their motion subspaces are s = (0, 0, a, 0, 0, b) in canonical frames, where a is 0 for
revolute joints, 1 for prismatic ones, and the pitch for helical ones, and b is 1 or 0. What all joints have alike, such as a
zero, is dropped when the sweep is compiled.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import sweep
from jaxdyn.compile.known import is_concrete
from jaxdyn.dynamics.recursions._arrays import dot, join
from jaxdyn.dynamics.recursions.articulated import eliminate, spatial_inertia
from jaxdyn.dynamics.recursions.links import (
    Links,
    from_unit_force,
    from_unit_velocity,
    links_of,
    unit_force,
    unit_velocity,
)
from jaxdyn.dynamics.recursions.newton_euler import move_with_joint, wrench_of_acceleration
from jaxdyn.dynamics.recursions.transforms import (
    Chain,
    PlaneRotation,
    PlaneRotations,
    Transform,
    X,
    Z,
    inertia_to_parent,
    twist_to_child,
    wrench_to_parent,
)
from jaxdyn.model.joints import SCREW_KINDS
from jaxdyn.model.tree import Model


def has_sweeps(model: Model) -> bool:
    """Decide whether the model is one that this module computes."""
    known = is_concrete(model.home, model.screws, model.inertias)
    return known and all(kind in SCREW_KINDS for kind in model.topology.kinds)


class _Body(NamedTuple):
    """Parameters of the bodies (nb, ...): the home pose as screws, s, the pseudo-inertia, the armature."""

    phi: Any  # (2,) cosine and sine
    alpha: Any
    theta: Any
    lengths: Any  # (5,): e, shift, d
    along: Any  # (): a
    about: Any  # (): b
    moments: Any  # (4, 4)
    armature: Any  # ()


def _bodies(links: Links) -> _Body:
    topology, frames = links.model.topology, links.frames
    dtype, n = frames.home.dtype, topology.nb
    screws = frames.screws
    assert screws is not None

    def rows(values):
        return np.array(values, dtype).reshape(n, -1)

    slides = np.array([kind == "prismatic" for kind in topology.kinds], dtype)
    lengths = rows([[x.e, *x.shift, x.d] for x in screws])
    armature = np.zeros(n, dtype) if links.armature is None else links.armature
    angles = (rows([x.phi for x in screws]), rows([x.alpha for x in screws]), rows([x.theta for x in screws]))
    return _Body(*angles, lengths, slides + frames.pitch, 1 - slides, np.stack(links.moments), armature)


def _plane(axis: int, angle) -> PlaneRotation:
    return PlaneRotation(PlaneRotations(axis, angle[:1], angle[1:]), 0)


def _chain(body: _Body, turn, slide) -> Chain:
    """Pose of a body in its parent; `turn` is the cosine and sine of its joint's angle, `slide` its translation."""
    zero = np.zeros(1, turn.dtype)
    e, shift, d = body.lengths[:1], body.lengths[1:4], body.lengths[4:]
    return (
        Transform(join([zero, zero, e], 0), _plane(Z, body.phi)),
        Transform(shift, _plane(X, body.alpha)),
        Transform(join([zero, zero, d + slide.reshape(1)], 0), _plane(Z, turn)),
    )


def _subspace(body: _Body):
    zero = np.zeros(2, body.phi.dtype)
    return join([zero, body.along.reshape(1), zero, body.about.reshape(1)], 0)


def _turn(body: _Body, q):
    """Cosine and sine of the angle of a joint, with that of its home pose, and its translation."""
    angle = q * body.about
    c, s = jnp.cos(angle), jnp.sin(angle)
    cos, sin = body.theta[0], body.theta[1]
    return jnp.stack([c * cos - s * sin, s * cos + c * sin]), q * body.along


def _outward_motion(links: Links, bodies: _Body, q, v, a):
    """Inertial wrenches (nb, 6), gravity included, and the joints' positions (nb, 3): the outward sweep of Newton-Euler."""
    dtype = links.frames.home.dtype
    zero = np.zeros(3, dtype)
    start = zero, zero, np.zeros((3, 3), dtype), zero if links.gravity is None else -links.gravity

    def step(motion, row):
        body, q, v, a = row
        turn, slide = _turn(body, q)
        S = _subspace(body).reshape(6, 1)
        motion = move_with_joint(motion, _chain(body, turn, slide), S, v, a)
        wrench = wrench_of_acceleration(motion[2], motion[3], body.moments)
        return motion, (wrench, join([turn, slide.reshape(1)], 0))

    rows = bodies, q, *(None if x is None else x.reshape(-1, 1) for x in (v, a))
    return sweep(step, links.parents, start, rows)[1]


def rnea(model: Model, q, v, a) -> Float[Array, " nv"]:
    """Inverse dynamics; `v`, `a` may be None, which is zero."""
    links = links_of(model)
    bodies = _bodies(links)
    q, v, a = (None if x is None else unit_velocity(links, x) for x in (q, v, a))
    wrenches, places = _outward_motion(links, bodies, q, v, a)

    def step(total, row):
        body, place, wrench = row
        total = total + wrench
        return wrench_to_parent(_chain(body, place[:2], place[2]), total), dot(_subspace(body), total)

    tau = sweep(step, links.parents, np.zeros(6, q.dtype), (bodies, places, wrenches), inward=True)[1]
    if a is not None and links.armature is not None:
        tau = tau + links.armature * a
    return from_unit_force(links, tau)


class Factors(NamedTuple):
    """Articulated-body factors: per body the place of its joint, the gain U/D (6,) and 1/D."""

    links: Links
    bodies: _Body
    places: Any
    gains: Any
    inverses: Any


def _factorize(links: Links, bodies: _Body, places) -> Factors:
    dtype = links.frames.home.dtype

    def step(total, row):
        body, place = row
        A = total + spatial_inertia(body.moments)
        armature = None if links.armature is None else body.armature
        rest, gain, inverse = eliminate(A, _subspace(body), _column(links), armature)
        return inertia_to_parent(_chain(body, place[:2], place[2]), rest), (gain, inverse)

    gains, inverses = sweep(step, links.parents, np.zeros((6, 6), dtype), (bodies, places), inward=True)[1]
    return Factors(links, bodies, places, gains, inverses)


def _column(links: Links) -> int | None:
    """The coordinate that all joints move along, or None."""
    kinds = set(links.model.topology.kinds)
    return 5 if kinds <= {"revolute", "continuous"} else 2 if kinds == {"prismatic"} else None


def _solve(factors: Factors, tau, wrenches=None) -> Float[Array, " nv"]:
    """Solve M a = tau - (generalised forces of the wrenches), for unit screws."""
    links = factors.links

    def inward(total, row):
        body, place, gain, tau, wrench = row
        F = total if wrench is None else total + wrench
        left = tau - dot(_subspace(body), F)
        return wrench_to_parent(_chain(body, place[:2], place[2]), F + gain * left), left

    rows = factors.bodies, factors.places, factors.gains, tau, wrenches
    left = sweep(inward, links.parents, np.zeros(6, tau.dtype), rows, inward=True)[1]

    def outward(V, row):
        body, place, gain, inverse, left = row
        V = twist_to_child(_chain(body, place[:2], place[2]), V)
        x = left * inverse - dot(gain, V)
        return V + _subspace(body) * x, x

    rows = factors.bodies, factors.places, factors.gains, factors.inverses, left
    return sweep(outward, links.parents, np.zeros(6, tau.dtype), rows)[1]


def _free_and_inverse(model: Model, q, v, tau) -> tuple[Array, Callable]:
    links = links_of(model)
    bodies = _bodies(links)
    wrenches, places = _outward_motion(links, bodies, unit_velocity(links, q), unit_velocity(links, v), None)
    factors = _factorize(links, bodies, places)

    def solve(force, wrenches=None):
        return from_unit_velocity(links, _solve(factors, unit_force(links, force), wrenches))

    return solve(tau, wrenches), solve


def aba(model: Model, q, v, tau) -> Float[Array, " nv"]:
    """Forward dynamics."""
    return _free_and_inverse(model, q, v, tau)[0]


def aba_tangent(model: Model, q, v, tau, force_change: Callable) -> tuple[Array, Array]:
    """Forward dynamics a, and M^-1 times `force_change(a)`."""
    a, times = _free_and_inverse(model, q, v, tau)
    return a, times(force_change(a))
