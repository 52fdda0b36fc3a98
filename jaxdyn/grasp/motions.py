"""Motions of a hand with its object: object velocities that the fingers follow, internal motions, manipulability.

The contacts require J_h thetadot = G^T V. With a hand Jacobian of any shape and rank the velocities that satisfy this are

    V = H w,    thetadot = J_h^+ G^T H w + K u,

where the columns of H span the object velocities V with G^T V in the range of J_h, all of them where the grasp is
manipulable, and those of K the kernel of J_h: motions of redundant fingers with their tips at rest.

Source: Murray, Li & Sastry (1994), section 6.3 (redundant hands by an internal motion beside the object's, hands that are not
manipulable by a basis of their feasible motions); EQUATIONS section 10.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import entry_point, gram_eigenvectors
from jaxdyn.compile.known import is_known
from jaxdyn.constraints.base import constraint_jacobian, layout
from jaxdyn.constraints.rank import NEGLIGIBLE, condition_number, eps_of, pseudo_inverse, rank_of, tolerance
from jaxdyn.constraints.selection import independent_rows
from jaxdyn.grasp.hand import Grasp, check_grasp
from jaxdyn.lie.series import safe_sqrt
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number, Numbers, as_number, check_state
from jaxdyn.reduction.bases import Basis, Parametrization, min_quality, orthonormal, split_directions
from jaxdyn.systems.mass_factor import solve_lower
from jaxdyn.systems.scene import Scene


class HandMotions(Basis):
    """Basis N of the velocities nu = (w, u) of a grasp, from references at one configuration; see `hand_motions`.

    - `object` (no, nw): reference $R_o$ of $H = P R_o T^{-1}$, with $P = 1 - B^+ B$, $B = (1 - J_h J_h^+) G^T$, and T the
      Cholesky factor of $R_o^T P R_o$. With nw = no it is H itself, constant.
    - `internal` (nh, nk): reference $R_i$ of K, likewise of $1 - J_h^+ J_h$.

    H and K are as smooth as $J_h$ and G wherever their ranks are constant: no signs or pivots are chosen. It is a
    basis for `jd.reduced_dynamics` and, around the configuration of its references, for `jd.Reduced`.
    """

    object: Float[Array, "no nw"]
    internal: Float[Array, "nh nk"]

    def size(self, scene: Scene) -> int:
        """Number of velocities nw + nk."""
        return self.object.shape[1] + self.internal.shape[1]

    def at(self, scene: Scene, q: Float[Array, " nq"], t: Number) -> Parametrization:
        """Basis N (nv, nw + nk) of the velocities.

        It is H in the rows of the object and $(J_h^+ G^T H, K)$ in those of the joints.
        """
        hands, objects = velocity_rows(scene)
        A = constraint_jacobian(scene, q, t)
        # The rows are A = [-J_h  G^T].
        Jh, seen = -A[:, hands], A[:, objects]
        rank = hands.size - self.internal.shape[1]
        inverse = pseudo_inverse(Jh, tolerance(None, Jh), rank < min(Jh.shape))
        H, pivot, fits = self._object(A, Jh, seen, inverse)
        N = jnp.zeros((scene.nv, self.size(scene)), A.dtype)
        N = N.at[objects, : H.shape[1]].set(H)
        N = N.at[hands, : H.shape[1]].set(matmul(inverse, matmul(seen, H)))
        if self.internal.shape[1]:
            reference = self.internal.astype(A.dtype)
            K, minimum, _ = orthonormal(reference - matmul(inverse, matmul(Jh, reference)))
            N = N.at[hands, H.shape[1] :].set(K)
            pivot = jnp.minimum(pivot, minimum)
        # A rank other than at the references changes the number of motions.
        fits = fits & (rank_of(Jh, inverse) == rank)
        size = condition_number(A, inverse)
        size = jnp.where(size > 0, size, jnp.ones_like(size))
        good = fits & jnp.isfinite(pivot)
        return Parametrization(N, jnp.zeros((scene.nv,), A.dtype), jnp.where(good, pivot / size, jnp.zeros_like(size)))

    def _object(self, A, Jh, seen, inverse):
        """H, its least pivot, and the flag that its number of columns is that of the feasible object velocities."""
        reference = self.object.astype(A.dtype)
        lost = seen - matmul(Jh, matmul(inverse, seen))
        # A constant H needs no projection, and is valid only where G^T lies in the range of J_h.
        if reference.shape[0] == reference.shape[1]:
            whole = jnp.max(jnp.abs(lost), initial=0.0) <= _negligible(A) * jnp.max(jnp.abs(A))
            return reference, jnp.ones((), A.dtype), whole
        # B, whose kernel are the feasible velocities; its rank follows from the trace of a projection.
        across = pseudo_inverse(lost, tolerance(None, lost), True)
        fits = rank_of(lost, across) == reference.shape[0] - reference.shape[1]
        # No motion of the object is feasible: there is nothing to orthonormalise.
        if not reference.shape[1]:
            return reference, jnp.ones((), A.dtype), fits
        H, pivot, _ = orthonormal(reference - matmul(across, matmul(lost, reference)))
        return H, pivot, fits

    def advice(self, scene: Scene, q: Float[Array, " nq"], t: Number) -> str:
        """Advise the basis at this configuration."""
        return "use jd.grasp.hand_motions(grasp, q)"


def check_motions(motions: HandMotions) -> HandMotions:
    """Check the references that a user gives. **Raises:** ValueError for anything but `HandMotions`."""
    if not isinstance(motions, HandMotions):
        raise ValueError(f"motions is {motions!r}; give jd.grasp.hand_motions(grasp, q), or None")
    return motions


def hand_motions(
    grasp: Grasp, q: Float[Array, " nq"], t: Numbers = 0.0, *, sizes: tuple[int, int] | None = None
) -> HandMotions:
    """Bases of the feasible object velocities and of the hand's internal motions, at q.

    In the given units of V and thetadot (m/s and rad/s), the columns are orthonormal. Where the grasp is
    manipulable H = 1, so that w is the object's velocity V. Otherwise the choice of the basis is arbitrary; it is constant under
    differentiation and continued smoothly to other configurations by `HandMotions`.

    **Arguments:**

    - `q` (nq,), on the contacts; `t`, s.
    - `sizes`: (nw, nk), numbers of columns of H and K. By default those of the ranks at q where q is concrete; where it is
      traced those of a J_h of full rank.

    **Returns:** `HandMotions`: `.object` (no, nw), `.internal` (nh, nk).

    **Raises:** ValueError where neither the object nor the hand can move, and for impossible sizes.

    ```python
    motions = jd.grasp.hand_motions(grasp, q)
    dynamics = jd.grasp.hand_dynamics(grasp, q, nu, tau, motions=motions)
    ```

    Source: Murray, Li & Sastry (1994), section 6.3; EQUATIONS section 10.
    """
    check_grasp(grasp)
    q, t = check_state(grasp.system, q=q, t=t)
    nh, no = len(grasp.hand_velocities), len(grasp.object_velocities)
    on_object, on_hand, ranks = _projections(independent_rows(grasp, q, t), q, t)
    count = layout(grasp)[-1].end
    if sizes is None:
        if is_known(grasp, q, t):
            sizes = no - int(ranks[0]), nh - int(ranks[1])
        # A traced q has no rank to read: generic rank is assumed.
        else:
            rank = min(count, nh)
            sizes = max(no - (count - rank), 0), nh - rank
    if not (isinstance(sizes, tuple) and len(sizes) == 2 and all(isinstance(n, (int, np.integer)) for n in sizes)):
        raise ValueError(f"sizes is {sizes!r}; give (nw, nk), the numbers of motions of the object and of the hand")
    nw, nk = sizes
    if not (0 <= nw <= no and 0 <= nk <= nh):
        raise ValueError(f"sizes is {sizes}; give (nw, nk) with nw from 0 to {no} and nk from 0 to {nh}")
    if nw + nk == 0:
        raise ValueError(
            f"the contacts leave neither the object {grasp.object!r} nor the hand any motion here; use contacts with fewer "
            "rows, or give sizes=(nw, nk) where q is traced"
        )
    # The unit matrix, so that w is V itself; eigenvectors would be any rotation of it.
    whole = jnp.eye(no, dtype=q.dtype) if nw == no else split_directions(on_object)[:, no - nw :]
    # The eigenvectors of the range come last.
    return HandMotions(whole, split_directions(on_hand)[:, nh - nk :])


def velocity_rows(grasp: Any) -> tuple[np.ndarray, np.ndarray]:
    """Indices in v of the velocities of the joints and of the object."""
    return np.array(grasp.hand_velocities, int), np.array(grasp.object_velocities, int)


@entry_point
def _projections(grasp: Grasp, q, t):
    """Projections 1 - B^+ B and 1 - J_h^+ J_h, and the ranks of B and J_h."""
    hands, objects = velocity_rows(grasp)
    A = constraint_jacobian(grasp, q, t)
    Jh, seen = -A[:, hands], A[:, objects]
    inverse = pseudo_inverse(Jh, tolerance(None, Jh), True)
    lost = seen - matmul(Jh, matmul(inverse, seen))
    # Entries at rounding level are set to zero, so that they do not count as rank.
    lost = jnp.where(jnp.abs(lost) <= _negligible(A) * jnp.max(jnp.abs(A)), jnp.zeros_like(lost), lost)
    across = pseudo_inverse(lost, tolerance(None, lost), True)
    on_object = jnp.eye(objects.size, dtype=A.dtype) - matmul(across, lost)
    on_hand = jnp.eye(hands.size, dtype=A.dtype) - matmul(inverse, Jh)
    return on_object, on_hand, (rank_of(lost, across), rank_of(Jh, inverse))


def _negligible(like) -> float:
    """Relative size below which an entry is rounding error."""
    return eps_of(like) ** NEGLIGIBLE


# Manipulability of a hand: ellipsoids of object velocities and of wrenches.
#
# Joint velocities thetadot = X w, X = J_h^+ G^T H, are the shortest ones that give the object the velocity V = H w. Those with
# |thetadot| <= 1 give the velocities of an ellipsoid whose semi-axes are 1 / sigma_i(X); torques with |tau| <= 1 give the
# wrenches X^T tau of one with the semi-axes sigma_i(X) in the same directions: fast directions are weak ones.


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
    some = force_axes > min_quality(q.dtype) ** 1.5 * force_axes[-1]
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
