"""Manipulability of a hand: ellipsoids of object velocities and of wrenches.

Joint velocities thetadot = X w, X = J_h^+ G^T H, are the shortest ones that give the object the velocity V = H w. Those with
|thetadot| <= 1 give the velocities of an ellipsoid whose semi-axes are 1 / sigma_i(X); torques with |tau| <= 1 give the
wrenches X^T tau of one with the semi-axes sigma_i(X) in the same directions: fast directions are weak ones.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import entry_point, gram_eigenvectors
from jaxdyn.constraints.base import constraint_jacobian
from jaxdyn.grasp.hand import Grasp, check_grasp
from jaxdyn.grasp.motions import HandMotions, check_motions, hand_motions, velocity_rows
from jaxdyn.lie.series import safe_sqrt
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, check_state
from jaxdyn.model.numbers import as_number
from jaxdyn.reduction.bases import least_quality, orthonormal
from jaxdyn.systems.mass_factor import solve_lower


class Manipulability(eqx.Module):
    r"""Ellipsoids of the object's velocities and of wrenches on it, and scalar measures of them.

    Angular velocities count `length` times, so that all is in m/s and N per unit of joint velocity and torque.

    - `velocity_axes` (nw,): semi-axes of the ellipsoid of object velocities for $|\dot\theta| \le 1$, longest first; infinite
      for a motion of the object that the fingers need not follow. `force_axes` (nw,): their inverses, of the
      ellipsoid of wrenches for $|\tau| \le 1$.
    - `directions` (no, nw): twists of the object along them, of unit length in this scaling; constants.
    - `sigma_min` (): least velocity axis. `isotropy` (): least over largest, 1 for a sphere. `volume` (): product of
      the velocity axes, Yoshikawa's measure.
    - `grasp_axes` (no,): semi-axes of the wrenches $G \lambda$ for $|\lambda| \le 1$, the singular values of G, longest first.
      `grasp_isotropy` (): least over largest.
    - `is_manipulable` (): true where the fingers can follow every velocity of the object.
    """

    velocity_axes: Float[Array, " nw"]
    force_axes: Float[Array, " nw"]
    directions: Float[Array, "no nw"]
    sigma_min: Float[Array, ""]
    isotropy: Float[Array, ""]
    volume: Float[Array, ""]
    grasp_axes: Float[Array, " no"]
    grasp_isotropy: Float[Array, ""]
    is_manipulable: Bool[Array, ""]


def manipulability(
    grasp: Grasp, q: Float[Array, " nq"], t: Numbers = 0.0, *, length: Numbers = 1.0, motions: HandMotions | None = None
) -> Manipulability:
    """Velocity and force ellipsoids of the object in the hand (see `Manipulability`).

    Axes have derivatives of all orders where they differ; those of the directions are not available.

    **Arguments:**

    - `q` (nq,), on the contacts; `t`, s.
    - `length` (): m, positive: 1 rad/s about an axis of a planar or free object counts as `length` m/s, so that axes can be
      compared; its size, say. Without it the measure depends on the unit of length.
    - `motions`: as in `hand_dynamics`; to be given where q is traced and J_h is not of full rank.

    **Returns:** `Manipulability`.

    **Raises:** ValueError for a length that is not positive, for inconsistent shapes, and for a hand whose object cannot
    move at all.

    Source: Yoshikawa (1985); Murray, Li & Sastry (1994), sections 5.5 and 5.6 (definition 5.6 of manipulable grasps).
    """
    check_grasp(grasp)
    q, t = check_state(grasp.system, q=q, t=t)
    length = as_number(length, "length", "m", like=q.dtype)
    motions = hand_motions(grasp, q, t) if motions is None else check_motions(motions)
    if not motions.object.shape[1]:
        raise ValueError(
            f"the fingers cannot follow any velocity of {grasp.object!r} here, so there is nothing to measure"
        )
    return _measure(grasp, motions, q, length, t)


@entry_point
def _measure(grasp: Grasp, motions: HandMotions, q, length, t) -> Manipulability:
    hands, objects = velocity_rows(grasp)
    N = motions.at(grasp, q, t).N[:, : motions.object.shape[1]]
    scale = _scale(grasp, length)
    H = scale[:, None] * N[objects]
    # In an orthonormal basis of object velocities the axes do not depend on the choice of H.
    along, _, factor = orthonormal(H)
    # thetadot for the columns of `along`: N_hands times T^-T of H = along T^T.
    X = solve_lower(factor, N[hands].T).T
    force_axes, vectors = _axes(X)
    # Singular values descend, and velocity axes are their inverses: reversed, the longest velocity axis comes first.
    force_axes, vectors = force_axes[::-1], vectors[:, ::-1]
    # Axes of the square root of the dtype's resolution are zero: the fingers need not move.
    some = force_axes > least_quality(q.dtype) ** 1.5 * force_axes[-1]
    velocity_axes = jnp.where(some, 1 / jnp.where(some, force_axes, jnp.ones_like(force_axes)), jnp.inf)
    # Wrenches scale inversely to velocities, so that power remains.
    G = constraint_jacobian(grasp, q, t)[:, objects].T / scale[:, None]
    # Of G^T, so that there is an axis for every velocity of the object, of length zero where the contacts exert no wrench.
    wrenches = _axes(G.T)[0]
    return Manipulability(
        velocity_axes=velocity_axes,
        force_axes=force_axes,
        directions=lax.stop_gradient(matmul(along, vectors) / scale[:, None]),
        sigma_min=velocity_axes[-1],
        isotropy=force_axes[0] / force_axes[-1],
        volume=jnp.prod(velocity_axes),
        grasp_axes=wrenches,
        grasp_isotropy=wrenches[-1] / wrenches[0],
        is_manipulable=jnp.asarray(motions.object.shape[1] == objects.size),
    )


def _axes(X: Float[Array, "n m"]) -> tuple[Float[Array, " m"], Float[Array, "m m"]]:
    """Singular values |X v_i| of X, largest first, and the right vectors v_i."""
    square, vectors = gram_eigenvectors(X)
    return safe_sqrt(square), vectors


def _scale(grasp: Grasp, length) -> Float[Array, " no"]:
    """Scale of each velocity of the object, `length` for angular ones."""
    top = grasp.system.topology
    kind = top.kinds[top.body_names.index(grasp.object)]
    # Only joints that mix translations and rotations need the length; others have coordinates of one unit.
    one = jnp.ones_like(length)
    turns = {"free": (0, 0, 0, 1, 1, 1), "planar": (0, 0, 1)}.get(kind, (0,) * len(grasp.object_velocities))
    return jnp.stack([length if turn else one for turn in turns])
