"""Bases of minimal velocities: v = N(q, t) nu + v0(q, t) with A N = 0 and A v0 = b.

N comes from the user, from a choice of independent velocities, or as an orthonormal basis close to a given one.
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

from jaxdyn.compile import entry_point, gram_eigenvectors
from jaxdyn.compile.known import is_concrete, is_known
from jaxdyn.constraints.base import constraint_jacobian, layout, velocity_residual
from jaxdyn.constraints.rank import REGULAR, RESIDUAL, condition_number, eps_of, pseudo_inverse, rank_of, tolerance
from jaxdyn.constraints.redundancy import sign_of_determinant
from jaxdyn.constraints.selection import independent_rows
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number, Numbers, as_array, as_shape, check_state
from jaxdyn.systems.mass_factor import cholesky, solve_lower
from jaxdyn.systems.scene import Scene, as_pytree, as_scene
from jaxdyn.systems.system import velocity_to_rate


class Parametrization(NamedTuple):
    """Parametrisation v = N nu + v0 at one configuration: N (nv, nr), v0 (nv,), and `quality`, zero where N is singular.

    `quality` () is the reciprocal of a condition number, and 0 for an N that is not tangent to the constraints. Where
    the sign of a determinant is defined it has that sign, so that crossing a singularity changes it.
    """

    N: Float[Array, "nv nr"]
    v0: Float[Array, " nv"]
    quality: Float[Array, ""]


class Basis(eqx.Module):
    """Base class of choices of N(q, t) and v0(q, t)."""

    def size(self, scene: Scene) -> int | None:
        """Number of minimal velocities, or None where only N itself determines it."""
        return None

    def at(self, scene: Scene, q: Float[Array, " nq"], t: Number) -> Parametrization:
        """Parametrisation by N, v0 and their quality at a configuration."""
        raise NotImplementedError

    def along(self, scene: Scene, q: Float[Array, " nq"], nu: Float[Array, " nr"], t: Number) -> "VelocityAndDrift":
        """Velocity v = N nu + v0 and its drift Ndot nu + v0dot, by differentiation of `at`."""

        def velocity(q, t):
            parametrization = self.at(scene, q, t)
            N, v0, _ = parametrization
            return matmul(N, as_shape(nu, "nu", N.dtype, N.shape[1:], of=COLUMNS)) + v0, parametrization

        # `linearize` and not `jvp`: the direction, dq/dt for this v, is known only with the value.
        v, push, (N, _, quality) = jax.linearize(velocity, q, t, has_aux=True)
        return VelocityAndDrift(v, push(velocity_to_rate(scene.system, q, v), jnp.ones_like(t)), N, quality)

    def advice(self, scene: Scene, q: Float[Array, " nq"], t: Number) -> str:
        """Advise a fix where N is singular, for concrete configurations."""
        raise NotImplementedError


class Independent(Basis):
    """Basis of independent velocities nu = v[velocities]: A = [A1 A2], the others are v2 = A2^+ (b - A1 nu).

    A2^+ is the inverse of A2, or of its independent rows. N is singular where A2 loses rank: the others are then not
    determined by nu, as at a dead centre.
    """

    velocities: tuple[int, ...] = eqx.field(static=True)

    @staticmethod
    def of(indices: Sequence[int], scene: Scene, name: str) -> "Independent":
        """Basis of some velocities. **Raises:** ValueError for invalid indices, and for all velocities."""
        are_indices = all(isinstance(i, int) and not isinstance(i, bool) and 0 <= i < scene.nv for i in indices)
        if not indices or not are_indices or len(set(indices)) < len(indices):
            raise ValueError(f"{name} is {indices}; give different indices of velocities, each 0 to {scene.nv - 1}")
        if len(indices) == scene.nv:
            raise ValueError(f"{name} is {indices}, all velocities; leave out those that the constraints determine")
        return Independent(tuple(indices))

    def size(self, scene):
        """Number of independent velocities."""
        return len(self.velocities)

    def at(self, scene, q, t):
        """Parametrisation with a unit matrix in the rows of the independent velocities."""
        A, b = _affine_rows(scene, q, t)
        kept = np.asarray(self.velocities, int)
        rest = np.setdiff1d(np.arange(scene.nv), kept)
        A2 = A[:, rest]
        # A2 may have more rows than columns: dependent constraints are allowed.
        inverse = pseudo_inverse(A2, tolerance(None, A2))
        N = jnp.zeros((scene.nv, kept.size), A.dtype).at[kept].set(jnp.eye(kept.size, dtype=A.dtype))
        N = N.at[rest].set(-matmul(inverse, A[:, kept]))
        v0 = jnp.zeros((scene.nv,), A.dtype).at[rest].set(matmul(inverse, b))
        size = condition_number(A, inverse)
        whole = rank_of(A2, inverse) == rest.size
        quality = jnp.where(whole, 1.0 / jnp.where(whole, size, jnp.ones_like(size)), jnp.zeros_like(size))
        if A2.shape[0] == A2.shape[1]:
            # A step may pass a dead centre without meeting it; the sign then differs at its two ends.
            quality = quality * sign_of_determinant(A2)
        return Parametrization(N, v0, _tangent_only(A, N, quality))

    def advice(self, scene, q, t):
        """Advise another choice, from the pivots of the rows."""
        other = independent_velocities(scene, q, t)
        return f"choose other independent velocities, here {other} of {scene.nv}"


class UserBasis(Basis):
    """Basis N(q, t), or (N, v0), from a function of the user; v0 defaults to the least-norm one with A v0 = b."""

    function: Callable

    def at(self, scene, q, t):
        """Parametrisation by the function's N and v0, with its quality."""
        A, b = _affine_rows(scene, q, t)
        value = self.function(q, t)
        N, v0 = value if isinstance(value, tuple) and len(value) == 2 else (value, None)
        N = as_array(N, "basis: the returned N", q.dtype)
        if N.ndim != 2 or N.shape[0] != scene.nv:
            raise ValueError(f"basis returned shape {N.shape}; return N with shape ({scene.nv}, nr) = (nv, nr)")
        inverse = pseudo_inverse(A, tolerance(None, A))
        # The shortest v0 with A v0 = b, also for dependent rows.
        v0 = matmul(inverse, b) if v0 is None else as_array(v0, "basis: the returned v0", q.dtype)
        if v0.shape != (scene.nv,):
            raise ValueError(f"basis returned v0 with shape {v0.shape}, expected {(scene.nv,)} = (nv,)")
        # Columns are scaled to unit length, so that the quality does not depend on the units of nu.
        # The quality decides on singularity and has no derivative.
        lengths = jnp.sqrt(jnp.sum(lax.stop_gradient(N * N), 0))
        some = jnp.all(lengths > 0)
        unit = lax.stop_gradient(N) / jnp.where(some, lengths, jnp.ones_like(lengths))[None]
        pivot = jnp.min(jnp.diagonal(cholesky(matmul(unit.T, unit))))
        # The Cholesky factor of dependent columns is NaN.
        pivot = jnp.where(jnp.isfinite(pivot), pivot, jnp.zeros_like(pivot))
        # Fewer columns would be a further constraint, more of them cannot all be tangent.
        whole = scene.nv - rank_of(A, inverse) == N.shape[1]
        off = jnp.abs(matmul(A, v0) - b)
        met = jnp.max(off) <= _rounding(A) * (jnp.max(jnp.abs(b)) + jnp.sqrt(jnp.sum(A * A) * jnp.sum(v0 * v0)))
        quality = jnp.where(some & whole & met, pivot, jnp.zeros_like(pivot))
        return Parametrization(N, v0, _tangent_only(A, N, quality))

    def advice(self, scene, q, t):
        """Advise by the rank and the residual of its columns."""
        A, N = constraint_jacobian(scene, q, t), self.at(scene, q, t).N
        maximum = scene.nv - np.linalg.matrix_rank(np.asarray(A), tol=1e-9 * float(jnp.max(jnp.abs(A))))
        return (
            f"return {maximum} independent columns with A N = 0 and, where b != 0, a v0 with A v0 = b (rank "
            f"{np.linalg.matrix_rank(np.asarray(N))} of {N.shape[1]}, largest |A N| "
            f"{float(jnp.max(jnp.abs(matmul(A, N)))):.3g})"
        )


class Orthonormal(Basis):
    """Orthonormal basis of ker A(q, t) from a reference R (nv, nr): N = P R T^-1, with P = 1 - A^+ A.

    T is the Cholesky factor of R^T P R, so N is as smooth as A wherever the rank of A is constant and R^T P R regular: no
    signs or pivots are chosen, unlike in a QR factorisation of A^T. R = `tangent_basis` at one configuration is valid
    around it; farther away, take N(q) as the new R, which keeps N(q), and therefore nu, unchanged.
    """

    reference: Float[Array, "nv nr"]

    def size(self, scene):
        """Number of columns of the reference."""
        return self.reference.shape[1]

    def at(self, scene, q, t):
        """Parametrisation by the projected and orthonormalised reference."""
        return self._at(scene, q, t)[0]

    def _at(self, scene, q, t):
        """Parametrisation, and A, A^+ and T."""
        A, b = _affine_rows(scene, q, t)
        reference = self.reference.astype(A.dtype)
        # A data dependence orders this factorisation after that of the reference: two concurrent ones of a large batch
        # can deadlock jaxlib 0.10.
        A = A + 0 * reference[0, 0]
        inverse = pseudo_inverse(A, tolerance(None, A))
        N, pivot, factor = orthonormal(reference - matmul(inverse, matmul(A, reference)))
        free = scene.nv - rank_of(A, inverse)
        quality = jnp.where(free == N.shape[1], pivot, jnp.zeros_like(pivot))
        return Parametrization(N, matmul(inverse, b), quality), A, inverse, factor

    def along(self, scene, q, nu, t):
        """Velocity and drift, with the rate of N nu in closed form.

        P = 1 - A^+ A has the rate Pdot = -S - S^T, S = A^+ Adot P, wherever the rank is constant. With L = (A^+)^T R T^-1 and
        B = Adot N follows T^-T d(T^T T)/dt T^-1 = -Z - Z^T, Z = L^T B, and

            Ndot nu = -A^+ B nu - P Adot^T L nu + N U nu,   U the upper triangle of Z + Z^T with half of its diagonal.
        """
        parametrization, A, inverse, factor = self._at(scene, q, t)
        N = parametrization.N
        nu = as_shape(nu, "nu", N.dtype, N.shape[1:], of=COLUMNS)
        v = matmul(N, nu) + parametrization.v0
        along_motion = (q, t), (velocity_to_rate(scene.system, q, v), jnp.ones_like(t))
        # Rates of A and v0 alone: the factorisation that gave N is not differentiated.
        rate = jax.jvp(lambda q, t: constraint_jacobian(scene, q, t), *along_motion)[1]
        drift = jax.jvp(lambda q, t: self.at(scene, q, t).v0, *along_motion)[1]
        turned, L = matmul(rate, N), solve_lower(factor, matmul(self.reference.astype(A.dtype).T, inverse)).T
        Z = matmul(L.T, turned)
        Z = Z + Z.T
        U = jnp.triu(Z) - 0.5 * jnp.diag(jnp.diag(Z))
        across = matmul(rate.T, matmul(L, nu))
        # P as two products, without the projection matrix (nv, nv).
        across = across - matmul(inverse, matmul(A, across))
        drift = drift - matmul(inverse, matmul(turned, nu)) - across + matmul(N, matmul(U, nu))
        return VelocityAndDrift(v, drift, N, parametrization.quality)

    def advice(self, scene, q, t):
        """Advise a reference R for which N is regular here."""
        rank = np.linalg.matrix_rank(np.asarray(constraint_jacobian_compiled(scene, q, t)), tol=1e-9)
        return f"use jd.reduction.tangent_basis(scene, q) as reference; the rows have rank {rank} of nv = {scene.nv}"


class FullBasis(Basis):
    """Basis of all velocities of a scene without constraints: nu = v."""

    def size(self, scene):
        """Number of velocities nv."""
        return scene.nv

    def at(self, scene, q, t):
        """Parametrisation with N = 1."""
        return Parametrization(jnp.eye(scene.nv, dtype=q.dtype), jnp.zeros((scene.nv,), q.dtype), jnp.ones((), q.dtype))


if TYPE_CHECKING:
    BasisLike = Basis | Sequence[int] | np.ndarray | Array | Callable[[Array, Array], Any]
else:
    BasisLike = Any  # `as_basis` checks them


def as_basis(basis: BasisLike | None, scene: Scene) -> Basis:
    """Convert indices of independent velocities, a reference matrix or a function to a `Basis`.

    **Raises:** ValueError for anything else, and for invalid indices and shapes.
    """
    if isinstance(basis, Basis):
        return basis
    if callable(basis):
        return UserBasis(as_pytree(basis, "basis", "q, t"))
    # True is an int in Python, and would be an index.
    if isinstance(basis, (tuple, list)) and all(isinstance(i, int) and not isinstance(i, bool) for i in basis):
        return Independent.of(basis, scene, "basis")
    if not isinstance(basis, (np.ndarray, jax.Array)):
        raise ValueError(
            f"basis is {basis!r}; give a tuple of indices of independent velocities, a function N(q, t) -> (nv, nr), "
            "or a reference matrix (nv, nr) from jd.reduction.tangent_basis"
        )
    if basis.ndim != 2 or basis.shape[0] != scene.nv or not 0 < basis.shape[1] <= scene.nv:
        raise ValueError(f"basis has shape {basis.shape}, expected ({scene.nv}, nr) = (nv, nr)")
    # A matrix is a reference and need not be tangent: `Orthonormal` projects it.
    return Orthonormal(jnp.asarray(as_array(basis, "basis")))


COLUMNS = " as the basis has columns"  # of nu, in messages


class VelocityAndDrift(NamedTuple):
    """Velocity v (nv,), its drift (nv,), the rate at constant nu, N (nv, nr) and its quality ()."""

    v: Array
    drift: Array
    N: Array
    quality: Array


def tangent_basis(
    scene: Scene, q: Float[Array, " nq"], t: Numbers = 0.0, *, dof: int | None = None, rank_tol: float | None = None
) -> Float[Array, "nv nr"]:
    """Orthonormal basis (nv, nr) of the velocities with A(q, t) v = 0, as a constant: a reference for `basis`.

    The choice is arbitrary and not differentiated; `Orthonormal` continues it smoothly to other configurations.

    **Arguments:** `q` (nq,); `t`, s; `dof`: nr, by default nv minus the rank of A on concrete numbers and minus the number
    of rows on traced ones; `rank_tol` as in `constrained_dynamics`.

    **Returns:** (nv, nr); NaN on traced numbers where the rank of A is not nv - nr, and where it is not clear.

    **Raises:** ValueError when no degree of freedom remains, when `dof` is required or is not nv minus the rank, and for a rank
    that is not clear.
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=t)
    if not layout(scene):
        raise ValueError("the scene has no constraints, so every velocity is tangent; add some")
    scene = independent_rows(scene, q, t, rank_tol)
    dof = count_dof(scene, q, t, dof, rank_tol)
    projector, rank = _tangent_projection(scene, q, t, rank_tol)
    basis = split_directions(projector)[:, scene.nv - dof :]
    # The number of columns is a shape, which the rank has to confirm: another one would leave a direction out, or break a row.
    agrees = rank == scene.nv - dof
    if is_concrete(agrees) and not bool(agrees):
        # This raises where the rank is not clear.
        remaining = count_dof(scene, q, t, None, rank_tol)
        raise ValueError(
            f"dof is {dof}, but the rows leave {remaining} of nv = {scene.nv} velocities here; leave dof out"
        )
    return jnp.where(agrees, basis, jnp.nan)


def count_dof(scene: Scene, q, t, dof: int | None = None, rank_tol: float | None = None) -> int:
    """Number of minimal velocities: `dof` if given, else nv minus the rank of A, or minus the number of rows where traced.

    **Raises:** ValueError when none remains.
    """
    if dof is not None:
        if isinstance(dof, bool) or not isinstance(dof, int) or not 0 < dof <= scene.nv:
            raise ValueError(f"dof is {dof!r}; give the number of degrees of freedom, 1 to nv = {scene.nv}")
        return dof
    count = layout(scene)[-1].end
    # The number of columns is a shape: it cannot follow from a traced rank.
    known = is_known(scene, q, t)
    rank = _tangent_projection(scene, q, t, rank_tol)[1] if known else count
    if np.isnan(rank):
        raise ValueError(
            "the rank of the constraints is not clear: rounding of the scene's numbers hides which rows repeat others; give "
            "numbers with more digits, or a rank_tol"
        )
    dof = scene.nv - int(rank)
    if dof < 1:
        fix = "remove one" if known else "if some of them depend on others, give dof, the number of degrees of freedom"
        raise ValueError(f"{count} constraint rows leave no degree of freedom of nv = {scene.nv}: {fix}")
    return dof


@entry_point
def _tangent_projection(scene, q, t, rank_tol):
    """Projection 1 - A^+ A, and the rank of A."""
    A = constraint_jacobian(scene, q, t)
    inverse = pseudo_inverse(A, tolerance(rank_tol, A))
    return jnp.eye(scene.nv, dtype=A.dtype) - matmul(inverse, A), rank_of(A, inverse)


def split_directions(projection: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Orthonormal eigenvectors of an orthogonal projection, those of its range last; constants."""
    # Eigenvectors of equal eigenvalues have no derivative.
    return gram_eigenvectors(lax.stop_gradient(projection))[1][:, ::-1]


def independent_velocities(scene: Scene, q, t: Number = 0.0) -> tuple[int, ...]:
    """Indices of independent velocities at a concrete configuration: those without pivots of A's columns."""
    # In NumPy, since the pivots are indices that a caller stores as static.
    scene = independent_rows(scene, q, t)
    A = np.asarray(constraint_jacobian_compiled(scene, q, jnp.asarray(t, q.dtype)), float)
    # The pivots of its columns are the dependent velocities.
    columns, pivots = pivot_rows(A.T)
    dependent = columns[pivots > 1e-9 * np.linalg.norm(A)]
    return tuple(np.setdiff1d(np.arange(scene.nv), dependent).tolist())


def pivot_rows(B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the rows of a concrete B by their distance from the span of those before them, and these distances."""
    rest, rows, pivots = np.array(B), [], []
    for _ in range(min(B.shape)):
        lengths = np.linalg.norm(rest, axis=1)
        rows.append(int(np.argmax(lengths)))
        pivots.append(lengths[rows[-1]])
        if pivots[-1] == 0:
            break
        along = rest[rows[-1]] / pivots[-1]
        rest = rest - np.outer(rest @ along, along)
    return np.asarray(rows, int), np.asarray(pivots)


def orthonormal(columns: Float[Array, "n k"]) -> tuple[Float[Array, "n k"], Float[Array, ""], Float[Array, "k k"]]:
    """Orthonormalise columns X: X T^-1 with T^T T = X^T X, the least pivot of T relative to the largest, and T^T."""
    # Cholesky and not QR: no choice of signs, so that the result is smooth in X.
    factor = cholesky(matmul(columns.T, columns))
    pivots = jnp.diagonal(factor)
    # No columns are independent.
    quality = jnp.min(pivots) / jnp.max(pivots) if pivots.size else jnp.ones((), columns.dtype)
    return solve_lower(factor, columns.T).T, quality, factor


def min_quality(dtype) -> float:
    """Quality below which a parametrisation counts as singular: reciprocal condition 5e-7 in float64."""
    return float(jnp.finfo(dtype).eps) ** REGULAR


constraint_jacobian_compiled = entry_point(constraint_jacobian)


def _affine_rows(scene, q, t):
    # The residual of the rows is A v - b, and -b at v = 0.
    return constraint_jacobian(scene, q, t), -velocity_residual(scene, q, jnp.zeros((scene.nv,), q.dtype), t)


def _tangent_only(A, N, quality):
    """Quality, or 0 where A N is nonzero beyond rounding."""
    limit = _rounding(A) * jnp.sqrt(jnp.sum(A * A) * jnp.sum(N * N))
    return jnp.where(jnp.max(jnp.abs(matmul(A, N))) <= limit, quality, jnp.zeros_like(quality))


def _rounding(like) -> float:
    """Relative size below which a residual is rounding error."""
    return eps_of(like) ** RESIDUAL
