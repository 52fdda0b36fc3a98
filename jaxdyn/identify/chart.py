"""Chart: unconstrained coordinates of all feasible bodies around nominal ones, and their distances from these.

A body's pseudo-inertia is P = U0 (U U^T) U0^T with U0 the factor of the nominal body and U =
log_cholesky_factor(theta): the nominal body, stretched, sheared, shifted and made heavier. Every theta is a physical
body, theta = 0 the nominal one, and theta has no units.

P0^-1 P has the eigenvalues of U U^T, so that the distances of a body from the nominal one are the same in every frame and unit.
Both are sums of squares of residuals, for least squares:

    entropic           tr(P0^-1 P) - log det(P0^-1 P) - 4 = sum of U_ij^2 off the diagonal + sum of U_ii^2 - 2 log U_ii - 1
    affine-invariant   |log(P0^-1/2 P P0^-1/2)|_F^2       = |log(U U^T)|_F^2

Near the nominal body the first is half of the second.

Source: Lee, Wensing & Park (2020), Geometric robot dynamic identification: a convex programming approach.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import gram_eigenvectors
from jaxdyn.model import host_math
from jaxdyn.model.tree import Model

# Coordinates of a body: all ten, its density alone, or none.
INERTIA = {"full": 10, "mass": 1, "fixed": 0}
METRICS = ("entropic", "affine")
_UPPER = np.triu_indices(4, 1)


# Entries of the factor that the coordinates after the first one change, and of a factor over exp(alpha): these and the last, 1.
LOG_CHOLESKY_PLACES = [(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
_FACTORS = np.zeros((10, 4, 4))
for _k, _place in enumerate([*LOG_CHOLESKY_PLACES, (3, 3)]):
    _FACTORS[(_k, *_place)] = 1
# d(U U^T) = dU + dU^T at U = 1, for the derivatives dU of `inertia.log_cholesky_factor`; the first coordinate scales all of U.
# Traces of products of these are the curvature of the divergence along straight lines in x: tr(P^-1 dP P^-1 dP).
LOG_CHOLESKY_BASIS = np.concatenate([np.eye(4)[None], _FACTORS[:9]])
LOG_CHOLESKY_BASIS = LOG_CHOLESKY_BASIS + np.swapaxes(LOG_CHOLESKY_BASIS, 1, 2)
# The linear map (10, 4, 4) of `inertia.parameters_from_pseudo`.
FROM_PSEUDO = np.stack([host_math.parameters_from_pseudo(unit) for unit in np.eye(16).reshape(16, 4, 4)], axis=1)
FROM_PSEUDO = FROM_PSEUDO.reshape(10, 4, 4)


class Chart(eqx.Module):
    """Map from unconstrained coordinates theta to feasible inertias.

    - `factors` (bodies, 4, 4): upper-triangular U0 of the nominal pseudo-inertias of `bodies`, those that can change. Massless
      bodies stay massless.
    - `nominal` (nb, 10): inertias of all bodies of the model.
    """

    factors: Float[Array, "bodies 4 4"]
    nominal: Float[Array, "nb 10"]
    bodies: tuple[int, ...] = eqx.field(static=True)
    inertia: str = eqx.field(static=True)

    @property
    def count(self) -> int:
        """Number of coordinates of a body."""
        return INERTIA[self.inertia]

    @eqx.filter_jit
    def relative_factors(self, theta: Float[Array, "bodies n"]) -> Float[Array, "bodies 4 4"]:
        """Factors U of every body, relative to the nominal one."""
        fill = jnp.zeros((theta.shape[0], 10 - theta.shape[1]), theta.dtype)  # "mass": alpha alone moves
        theta = jnp.concatenate([theta, fill], axis=1)
        # `inertia.log_cholesky_factor` of all bodies: a product with a table compiles five times as fast as its entries do.
        entries = jnp.concatenate([jnp.exp(theta[:, 1:4]), theta[:, 4:], jnp.ones_like(theta[:, :1])], axis=1)
        return jnp.exp(theta[:, :1, None]) * jnp.einsum("bk,kij->bij", entries, _FACTORS.astype(theta.dtype))

    @eqx.filter_jit
    def inertias(self, theta: Float[Array, "bodies n"]) -> Float[Array, "nb 10"]:
        """Ten inertial parameters of every body."""
        if not self.bodies:
            return self.nominal
        upper = jnp.einsum("bij,bjk->bik", self.factors, self.relative_factors(theta))
        fitted = jnp.einsum("kij,bil,bjl->bk", FROM_PSEUDO.astype(upper.dtype), upper, upper)
        if len(self.bodies) == len(self.nominal):
            return fitted
        return self.nominal.at[np.array(self.bodies)].set(fitted)


def check_bodies(model) -> None:
    """Check that a system has bodies. **Raises:** ValueError for a system that is no `Model`."""
    if not isinstance(model, Model):
        raise ValueError(
            f"model is a {type(model).__name__}; this fit searches the inertias of a Model's bodies: fit numbers of other "
            "systems and of scenes with jd.identify.fit_parameters"
        )


def make_chart(model: Model, inertia: str, bodies=None) -> Chart:
    """Chart around a model. `bodies`: indices of those whose inertias can change, all that have mass by default.

    **Raises:** ValueError for unknown `inertia`, and for bodies whose nominal parameters are not strictly feasible.
    """
    if inertia not in INERTIA:
        raise ValueError(f"inertia is {inertia!r}; give one of {tuple(INERTIA)}")
    numbers = np.asarray(model.inertias, np.float64)
    massive = tuple(int(i) for i in np.flatnonzero(numbers[:, 0] > 0)) if inertia != "fixed" else ()
    bodies = massive if bodies is None else tuple(i for i in massive if i in tuple(bodies))
    matrices = [host_math.pseudo_inertia(numbers[i]) for i in bodies]
    bad = [model.body_names[i] for i, P in zip(bodies, matrices, strict=True) if not _is_feasible(P, inertia)]
    if bad:
        raise ValueError(
            f"inertia of {', '.join(bad)} is not that of a solid body (pseudo-inertia not positive definite): "
            "a feasible fit cannot start there; repair it first with jd.model.repair_inertias(model), give rods and points "
            "some thickness, or fit inertia='mass' alone"
        )
    factors = np.array([pseudo_factor(P, inertia) for P in matrices]).reshape(-1, 4, 4)
    return Chart(jnp.asarray(factors, np.dtype(model.home.dtype)), model.inertias, bodies, inertia)


def _is_feasible(matrix: np.ndarray, inertia: str) -> bool:
    """Decide whether a pseudo-inertia is positive definite, or semidefinite (rods, points) where only the density is fitted."""
    values = np.linalg.eigvalsh(matrix)
    # Relative to the largest eigenvalue: the scale of a body's mass does not matter.
    return bool(values[0] > (1e-14 if inertia == "full" else -1e-9) * values[-1])


def pseudo_factor(matrix: np.ndarray, inertia: str) -> np.ndarray:
    """U0 with U0 U0^T = P0: upper triangular, or any root where the density alone is fitted."""
    if inertia == "full":
        return upper_root(matrix)
    values, vectors = np.linalg.eigh(matrix)
    # A rod's or point's pseudo-inertia is singular and has no Cholesky factor.
    return vectors * np.sqrt(np.maximum(values, 0))


def upper_root(matrices: np.ndarray) -> np.ndarray:
    """Upper-triangular factors U (..., n, n) with U U^T the matrices."""
    # Reversing rows and columns turns the lower factor of LAPACK into an upper one.
    return np.linalg.cholesky(matrices[..., ::-1, ::-1])[..., ::-1, ::-1]


def barrier_residual(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """r with r^2 = exp(x) - x - 1 and the sign of x: smooth, x / sqrt(2) near zero, huge where exp(x) is huge or next to zero."""
    # exp(x) - x - 1 cancels near zero. At 0.1 the remainder of the series is 3e-13.
    small = jnp.abs(x) < 0.1
    # The unused branch must be finite too: NaN from 0/0 there would pass through `where` into the gradient.
    safe = jnp.where(small, jnp.ones_like(x), x)
    # (exp(x) - x - 1) / x^2 = 1/2 + x/6 + x^2/24 + ...
    series = 1 / 2 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x * (1 / 720 + x * (1 / 5040 + x / 40320)))))
    share = jnp.where(small, series, (jnp.expm1(safe) - safe) / safe**2)
    return x * jnp.sqrt(share)


def entropic_residual(U: Float[Array, "4 4"]) -> Float[Array, "10"]:
    """Ten numbers whose squares add up to the entropic divergence of U U^T from 1, U upper triangular."""
    return jnp.concatenate([barrier_residual(2 * jnp.log(jnp.diagonal(U))), U[_UPPER]])


def affine_residual(U: Float[Array, "4 4"]) -> Float[Array, "10"]:
    """Ten numbers whose squares add up to the squared affine-invariant distance of U U^T from 1."""
    logarithm = symmetric_log(U @ U.T)
    # Entries off the diagonal occur twice in the Frobenius norm.
    return jnp.concatenate([jnp.diagonal(logarithm), np.sqrt(2.0) * logarithm[_UPPER]])


@jax.custom_jvp
def symmetric_log(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Logarithm of a symmetric positive definite matrix; NaN for one that is not positive definite.

    Its derivative, of first order, is that of Daleckii and Krein, which stays finite at equal eigenvalues.
    """
    values, vectors = symmetric_eigenvectors(matrix)
    return (vectors * jnp.log(values)[None, :]) @ vectors.T


@symmetric_log.defjvp
def _symmetric_log_jvp(primals, tangents):
    values, vectors = symmetric_eigenvectors(primals[0])
    one, other = values[:, None], values[None, :]
    # (log a - log b) / (a - b) = atanh(x) / x * 2 / (a + b), x = (a - b) / (a + b).
    x = (one - other) / (one + other)
    # Equal eigenvalues make the quotient 0/0, with the limit 1 / a. At 0.01 the remainder of the series is below rounding.
    small = jnp.abs(x) < 1e-2
    safe = jnp.where(small, 0.5 * jnp.ones_like(x), x)
    series = 1 + x**2 * (1 / 3 + x**2 * (1 / 5 + x**2 * (1 / 7 + x**2 / 9)))
    quotients = jnp.where(small, series, jnp.arctanh(safe) / safe) * 2 / (one + other)
    change = (tangents[0] + tangents[0].T) / 2
    logarithm = (vectors * jnp.log(values)[None, :]) @ vectors.T
    return logarithm, vectors @ (quotients * (vectors.T @ change @ vectors)) @ vectors.T


def symmetric_eigenvectors(matrix: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues (n,) and eigenvectors, in columns, of a symmetric matrix that is meant to be positive definite."""
    vectors = gram_eigenvectors(matrix)[1]
    return jnp.sum(vectors * (matrix @ vectors), 0), vectors
