"""Choices of minimal velocities: v = N(q, t) nu + v0(q, t) with A N = 0 and A v0 = b.

N comes from the user, from a choice of independent velocities, or as an orthonormal basis near a given one.
Source: Murray, Li & Sastry (1994), section 6.1; EQUATIONS section 6.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.compile import compiled, is_known
from jaxdyn.constraints.base import constraint_jacobian, layout, velocity_residual
from jaxdyn.constraints.rank import pseudo_inverse, sign_of_determinant, tolerance
from jaxdyn.lie.so3 import _product
from jaxdyn.model.arguments import Number, Numbers, batch_hint, check_state
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky, solve_lower
from jaxdyn.systems.scene import Scene, as_pytree, as_scene
from jaxdyn.systems.system import velocity_to_rate


class Parametrization(NamedTuple):
    """v = N nu + v0 at one place: N (nv, nr), v0 (nv,), and `quality`, which vanishes where N is singular.

    `quality` () is the reciprocal of a condition number, and 0 for an N that is not tangent to the constraints. Where
    the sign of a determinant is defined it bears that sign, so that passing a singular place shows.
    """

    N: Float[Array, "nv nr"]
    v0: Float[Array, " nv"]
    quality: Float[Array, ""]


class Basis(eqx.Module):
    """A choice of N(q, t) and v0(q, t)."""

    def size(self, scene: Scene) -> int | None:
        """Number of minimal velocities, or None where only N itself tells."""
        return None

    def at(self, scene: Scene, q: Float[Array, " nq"], t: Number) -> Parametrization:
        """N, v0 and their quality at a place."""
        raise NotImplementedError

    def along(self, scene: Scene, q: Float[Array, " nq"], nu: Float[Array, " nr"], t: Number) -> "Moving":
        """v = N nu + v0 and its rate Ndot nu + v0dot, by differentiation of `at`."""

        def velocity(q, t):
            parametrization = self.at(scene, q, t)
            return _product(parametrization.N, _fitting(nu, parametrization.N)) + parametrization.v0, parametrization

        v, push, (N, _, quality) = jax.linearize(velocity, q, t, has_aux=True)
        return Moving(v, push(velocity_to_rate(scene.system, q, v), jnp.ones_like(t)), N, quality)

    def advice(self, scene: Scene, q: Float[Array, " nq"], t: Number) -> str:
        """What to do where N is singular, for concrete places."""
        raise NotImplementedError


class Independent(Basis):
    """The velocities `nu = v[velocities]` are kept: A = [A1 A2], the others are v2 = A2^+ (b - A1 nu).

    A2^+ is the inverse of A2, or of its independent rows. N is singular where A2 loses rank: the others are then not
    determined by nu, as at a dead centre.
    """

    velocities: tuple[int, ...] = eqx.field(static=True)

    def size(self, scene):
        """Number of velocities kept."""
        return len(self.velocities)

    def at(self, scene, q, t):
        """N with a unit matrix in the rows of the independent velocities."""
        A, b = _affine_rows(scene, q, t)
        kept = np.asarray(self.velocities, int)
        rest = np.setdiff1d(np.arange(scene.nv), kept)
        A2 = A[:, rest]
        inverse = pseudo_inverse(A2, tolerance(None, A2))
        N = jnp.zeros((scene.nv, kept.size), A.dtype).at[kept].set(jnp.eye(kept.size, dtype=A.dtype))
        N = N.at[rest].set(-_product(inverse, A[:, kept]))
        v0 = jnp.zeros((scene.nv,), A.dtype).at[rest].set(_product(inverse, b))
        size = jnp.sqrt(jnp.sum(inverse * inverse) * jnp.sum(A * A))
        whole = jnp.round(jnp.sum(inverse * A2.T)) == rest.size
        quality = jnp.where(whole, 1.0 / jnp.where(whole, size, jnp.ones_like(size)), jnp.zeros_like(size))
        if A2.shape[0] == A2.shape[1]:
            quality = quality * sign_of_determinant(A2)
        return Parametrization(N, v0, _tangent_only(A, N, quality))

    def advice(self, scene, q, t):
        """Another choice, from the pivots of the rows."""
        other = independent_velocities(scene, q, t)
        return f"choose other independent velocities, here {other} of {scene.nv}"


class Given(Basis):
    """N(q, t), or (N, v0), from a function of the user; v0 defaults to the shortest one with A v0 = b."""

    function: Callable

    def at(self, scene, q, t):
        """N as given, and its v0."""
        A, b = _affine_rows(scene, q, t)
        value = self.function(q, t)
        N, v0 = value if isinstance(value, tuple) else (value, None)
        N = jnp.asarray(N, q.dtype)
        if N.ndim != 2 or N.shape[0] != scene.nv:
            raise ValueError(f"basis returned shape {N.shape}; return N with shape ({scene.nv}, nr) = (nv, nr)")
        inverse = pseudo_inverse(A, tolerance(None, A))
        v0 = _product(inverse, b) if v0 is None else jnp.asarray(v0, q.dtype)
        if v0.shape != (scene.nv,):
            raise ValueError(f"basis returned v0 with shape {v0.shape}, expected {(scene.nv,)} = (nv,)")
        lengths = jnp.sqrt(jnp.sum(lax.stop_gradient(N * N), 0))
        some = jnp.all(lengths > 0)
        pivot = _least_pivot(N / jnp.where(some, lengths, jnp.ones_like(lengths))[None])
        whole = scene.nv - jnp.round(jnp.sum(inverse * A.T)) == N.shape[1]
        off = jnp.abs(_product(A, v0) - b)
        met = jnp.max(off) <= _rounding(A) * (jnp.max(jnp.abs(b)) + jnp.sqrt(jnp.sum(A * A) * jnp.sum(v0 * v0)))
        quality = jnp.where(some & whole & met, pivot, jnp.zeros_like(pivot))
        return Parametrization(N, v0, _tangent_only(A, N, quality))

    def advice(self, scene, q, t):
        """The residual of its columns."""
        A, N = constraint_jacobian(scene, q, t), self.at(scene, q, t).N
        most = scene.nv - np.linalg.matrix_rank(np.asarray(A), tol=1e-9 * float(jnp.max(jnp.abs(A))))
        return (
            f"return {most} independent columns with A N = 0 and, where b != 0, a v0 with A v0 = b (rank "
            f"{np.linalg.matrix_rank(np.asarray(N))} of {N.shape[1]}, largest |A N| "
            f"{float(jnp.max(jnp.abs(_product(A, N)))):.3g})"
        )


class Orthonormal(Basis):
    """The orthonormal basis of ker A(q, t) that a reference R (nv, nr) gives: N = P R T^-1, with P = 1 - A^+ A.

    T is the Cholesky factor of R^T P R, so N is as smooth as A wherever the rank of A is constant and R^T P R regular: no
    signs or pivots are chosen, as a QR factorisation of A^T would. R = `tangent_basis` at one configuration is enough around it;
    to go on, take N(q) as the new R, which leaves N(q), and therefore nu, as they are.
    """

    reference: Float[Array, "nv nr"]

    def size(self, scene):
        """Number of columns of the reference."""
        return self.reference.shape[1]

    def at(self, scene, q, t):
        """The reference, projected and made orthonormal."""
        return self._at(scene, q, t)[0]

    def _at(self, scene, q, t):
        """Also A, A^+, and T."""
        A, b = _affine_rows(scene, q, t)
        reference = self.reference.astype(A.dtype)
        # A factorisation waits for that which gave the reference: two of a large batch at once can block jaxlib 0.10 for ever.
        A = A + 0 * reference[0, 0]
        inverse = pseudo_inverse(A, tolerance(None, A))
        N, pivot, factor = orthonormal(reference - _product(inverse, _product(A, reference)))
        free = scene.nv - jnp.round(jnp.sum(inverse * A.T))
        quality = jnp.where(free == N.shape[1], pivot, jnp.zeros_like(pivot))
        return Parametrization(N, _product(inverse, b), quality), A, inverse, factor

    def along(self, scene, q, nu, t):
        """The same, with the rate of N nu in closed form.

        P = 1 - A^+ A has the rate Pdot = -S - S^T, S = A^+ Adot P, wherever the rank is constant. With L = (A^+)^T R T^-1 and
        B = Adot N follows T^-T d(T^T T)/dt T^-1 = -Z - Z^T, Z = L^T B, and

            Ndot nu = -A^+ B nu - P Adot^T L nu + N U nu,   U the upper triangle of Z + Z^T with half of its diagonal.
        """
        parametrization, A, inverse, factor = self._at(scene, q, t)
        N = parametrization.N
        nu = _fitting(nu, N)
        v = _product(N, nu) + parametrization.v0
        along_motion = (q, t), (velocity_to_rate(scene.system, q, v), jnp.ones_like(t))
        rate = jax.jvp(lambda q, t: constraint_jacobian(scene, q, t), *along_motion)[1]
        drift = jax.jvp(lambda q, t: self.at(scene, q, t).v0, *along_motion)[1]
        turned, L = _product(rate, N), solve_lower(factor, _product(self.reference.astype(A.dtype).T, inverse)).T
        Z = _product(L.T, turned)
        Z = Z + Z.T
        U = jnp.triu(Z) - 0.5 * jnp.diag(jnp.diag(Z))
        across = _product(rate.T, _product(L, nu))
        across = across - _product(inverse, _product(A, across))
        drift = drift - _product(inverse, _product(turned, nu)) - across + _product(N, _product(U, nu))
        return Moving(v, drift, N, parametrization.quality)

    def advice(self, scene, q, t):
        """A reference R for which N is regular here."""
        rank = np.linalg.matrix_rank(np.asarray(constraint_jacobian_compiled(scene, q, t)), tol=1e-9)
        return f"take jd.tangent_basis(scene, q) for reference; the rows have rank {rank} of nv = {scene.nv}"


class Whole(Basis):
    """All velocities of a scene without constraints: nu = v."""

    def size(self, scene):
        """nv."""
        return scene.nv

    def at(self, scene, q, t):
        """N = 1."""
        return Parametrization(jnp.eye(scene.nv, dtype=q.dtype), jnp.zeros((scene.nv,), q.dtype), jnp.ones((), q.dtype))


if TYPE_CHECKING:
    BasisLike = Basis | Sequence[int] | np.ndarray | Array | Callable[[Array, Array], Any]
else:
    BasisLike = Any  # `as_basis` takes them


def as_basis(basis: BasisLike | None, scene: Scene) -> Basis:
    """A `Basis` from indices of independent velocities, a reference matrix or a function.

    **Raises:** ValueError for anything else, and for indices and shapes that do not fit.
    """
    if isinstance(basis, Basis):
        return basis
    if callable(basis):
        return Given(as_pytree(basis, "basis"))
    if isinstance(basis, (tuple, list)) and all(isinstance(i, int) and not isinstance(i, bool) for i in basis):
        if not basis or len(set(basis)) < len(basis) or not all(0 <= i < scene.nv for i in basis):
            raise ValueError(f"basis is {basis}; give different indices of velocities, each 0 to {scene.nv - 1}")
        return Independent(tuple(basis))
    if not isinstance(basis, (np.ndarray, jax.Array)):
        raise ValueError(
            f"basis is {basis!r}; give a tuple of indices of independent velocities, a function N(q, t) -> (nv, nr), "
            "or a reference matrix (nv, nr) from jd.tangent_basis"
        )
    if basis.ndim != 2 or basis.shape[0] != scene.nv or not 0 < basis.shape[1] <= scene.nv:
        raise ValueError(f"basis has shape {basis.shape}, expected ({scene.nv}, nr) = (nv, nr)")
    return Orthonormal(jnp.asarray(basis))


class Moving(NamedTuple):
    """Velocity v (nv,) by minimal velocities, its rate (nv,) as these stay, N (nv, nr) and its quality ()."""

    v: Array
    drift: Array
    N: Array
    quality: Array


def moving(scene: Scene, choice: Basis, q, nu, t) -> Moving:
    """v = N nu + v0 and Ndot nu + v0dot, from one factorisation of the rows."""

    return choice.along(scene, q, nu, t)


def _fitting(nu, N):
    if nu.shape != N.shape[1:]:
        raise ValueError(
            f"nu has shape {nu.shape}, expected {N.shape[1:]} as the basis has columns{batch_hint(nu, (1,))}"
        )
    return nu


def tangent_basis(
    scene: Scene, q: Float[Array, " nq"], t: Numbers = 0.0, *, dof: int | None = None, rank_tol: float | None = None
) -> Float[Array, "nv nr"]:
    """An orthonormal basis (nv, nr) of the velocities with A(q, t) v = 0, as a constant: a reference for `basis`.

    Which one of them is arbitrary, so it is not differentiated; `Orthonormal` continues it smoothly to other places.

    **Arguments:** `q` (nq,); `t`, s; `dof`: nr, by default nv less the rank of A on concrete numbers and less the number
    of rows on traced ones; `rank_tol` as in `constrained_dynamics`.

    **Raises:** ValueError when no freedom is left, or when `dof` has to be given.
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=t)
    if not layout(scene):
        raise ValueError("the scene has no constraints, so every velocity is tangent; add some")
    dof = freedoms(scene, q, t, dof, rank_tol)
    projector, _ = _tangent_projection(scene, q, t, rank_tol)
    return split_directions(projector)[:, scene.nv - dof :]


def freedoms(scene: Scene, q, t, dof: int | None = None, rank_tol: float | None = None) -> int:
    """Number of minimal velocities: as given, else nv less the rank of A, or less the number of rows where traced.

    **Raises:** ValueError when none is left.
    """
    if dof is not None:
        if isinstance(dof, bool) or not isinstance(dof, int) or not 0 < dof <= scene.nv:
            raise ValueError(f"dof is {dof!r}; give the number of freedoms, 1 to nv = {scene.nv}")
        return dof
    count = layout(scene)[-1].end
    known = is_known(scene, q, t)
    dof = scene.nv - (int(_tangent_projection(scene, q, t, rank_tol)[1]) if known else count)
    if dof < 1:
        fix = "leave one out" if known else "if some of them depend on others, give dof, the number of freedoms"
        raise ValueError(f"{count} constraint rows leave no freedom of nv = {scene.nv}: {fix}")
    return dof


@compiled
def _tangent_projection(scene, q, t, rank_tol):
    """1 - A^+ A, and the rank of A."""
    A = constraint_jacobian(scene, q, t)
    inverse = pseudo_inverse(A, tolerance(rank_tol, A))
    return jnp.eye(scene.nv, dtype=A.dtype) - _product(inverse, A), jnp.round(jnp.sum(inverse * A.T))


def split_directions(projection: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Orthonormal eigenvectors of an orthogonal projection, those that it keeps last; constants."""
    return lax.stop_gradient(jnp.linalg.eigh(lax.stop_gradient(0.5 * (projection + projection.T)))[1])


def independent_velocities(scene: Scene, q, t: Number = 0.0) -> tuple[int, ...]:
    """Indices of velocities that determine the others at a concrete place: those left by the pivots of A's columns."""
    A = np.asarray(constraint_jacobian_compiled(scene, q, jnp.asarray(t, q.dtype)), float)
    rest, pivots = A.copy(), []
    for _ in range(min(A.shape)):
        sizes = np.linalg.norm(rest, axis=0)
        pivot = int(np.argmax(sizes))
        if sizes[pivot] <= 1e-9 * np.linalg.norm(A):
            break
        along = rest[:, pivot] / sizes[pivot]
        rest = rest - np.outer(along, along @ rest)
        pivots.append(pivot)
    return tuple(i for i in range(scene.nv) if i not in pivots)


def orthonormal(columns: Float[Array, "n k"]) -> tuple[Float[Array, "n k"], Float[Array, ""], Float[Array, "k k"]]:
    """X T^-1 with T^T T = X^T X for columns X, the least pivot of T relative to the largest, and T^T; smooth in X."""
    factor = cholesky(_product(columns.T, columns))
    pivots = jnp.diagonal(factor)
    return solve_lower(factor, columns.T).T, jnp.min(pivots) / jnp.max(pivots), factor


def minimal_velocity(parametrization: Parametrization, v: Float[Array, " nv"]) -> Float[Array, " nr"]:
    """nu (nr,) with N nu + v0 = v for an admissible v: its coefficients in the columns of N."""
    factor = cholesky(_product(parametrization.N.T, parametrization.N))
    return solve_cholesky(factor, _product(parametrization.N.T, v - parametrization.v0))


def least_quality(dtype) -> float:
    """Quality of a parametrisation below which it counts as singular: reciprocal condition 5e-7 in float64."""
    return float(jnp.finfo(dtype).eps) ** 0.4


constraint_jacobian_compiled = compiled(constraint_jacobian)


def _affine_rows(scene, q, t):
    return constraint_jacobian(scene, q, t), -velocity_residual(scene, q, jnp.zeros((scene.nv,), q.dtype), t)


def _least_pivot(columns):
    """Least pivot of the triangle T with T^T T = columns^T columns, and 0 where they depend on each other."""
    pivot = jnp.min(jnp.diagonal(cholesky(lax.stop_gradient(_product(columns.T, columns)))))
    return jnp.where(jnp.isfinite(pivot), pivot, jnp.zeros_like(pivot))


def _tangent_only(A, N, quality):
    """The quality, or 0 where A N is not 0 but for rounding."""
    limit = _rounding(A) * jnp.sqrt(jnp.sum(A * A) * jnp.sum(N * N))
    return jnp.where(jnp.max(jnp.abs(_product(A, N))) <= limit, quality, jnp.zeros_like(quality))


def _rounding(like) -> float:
    """Relative size of a residual that is taken for rounding."""
    return float(jnp.finfo(like.dtype).eps) ** 0.5
