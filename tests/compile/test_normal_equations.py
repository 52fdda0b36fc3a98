"""Pseudo-inverses, factors and solutions by native loops over rows, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.compile import cholesky_factor, pseudo_inverse_by_pivots, triangular_solution

pytestmark = pytest.mark.native


@pytest.mark.parametrize("mode", ["auto", "plain"])
@pytest.mark.parametrize("shape", [(1, 1), (5, 3), (28, 12), (33, 33), (70, 50), (130, 97)])
def test_pseudo_inverse_by_pivots(mode, shape):
    """A batch of regular, sparse and dependent matrices, and of columns of zeros; short and long rows, the stack and the heap."""
    rng, (n, m) = np.random.default_rng(n_of(shape)), shape
    Y = rng.normal(size=(5, n, m)) + 3 * np.eye(n, m)
    Y[1] *= rng.random((n, m)) < 0.1
    Y[1] += np.eye(n, m)
    Y[2, :, m // 2] = 0
    Y[3, :, -1] = Y[3, :, 0]
    Y[4, -1, 0] = np.nan
    with jd.compilation(mode):
        found = jax.jit(jax.vmap(lambda Y: pseudo_inverse_by_pivots(Y, 1e-9, 1e-6)))(Y)
    for one, inverse in zip(Y[:4], found[:4], strict=True):
        wanted = np.linalg.pinv(one, rcond=1e-9)
        np.testing.assert_allclose(inverse, wanted, rtol=0, atol=1e-11 * max(np.abs(wanted).max(), 1e-300))
    assert np.isnan(found[4]).any()


def n_of(shape) -> int:
    """A seed for each shape."""
    return 1000 * shape[0] + shape[1]


def test_where_normal_equations_end():
    """Matrices of the least pivot that counts and of smaller ones: the error grows with the condition number alone."""
    rng = np.random.default_rng(0)
    U, _ = np.linalg.qr(rng.normal(size=(30, 20)))
    V, _ = np.linalg.qr(rng.normal(size=(20, 20)))
    for least in (1e-1, 1e-3, 1e-5, 1e-7):
        Y = U * np.geomspace(1, least, 20) @ V.T
        found = pseudo_inverse_by_pivots(jnp.asarray(Y), 1e-9, 5e-7)
        wanted = V / np.geomspace(1, least, 20) @ U.T
        assert np.abs(found - wanted).max() < 1e-14 / least * np.abs(wanted).max(), least


def test_single_precision_and_exported_code():
    """The same in float32, and as code without JAX, whose larger arrays are on the heap."""
    rng = np.random.default_rng(1)
    Y = rng.normal(size=(90, 40)).astype(np.float32)
    found = pseudo_inverse_by_pivots(jnp.asarray(Y), 1e-4, 1e-3)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, np.linalg.pinv(Y), rtol=0, atol=1e-5)
    exported = jd.export(lambda Y: pseudo_inverse_by_pivots(Y, 1e-9, 1e-6), np.ones((90, 40)), name="inverse")
    np.testing.assert_allclose(exported(Y.astype(float)), np.linalg.pinv(Y.astype(float)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("mode", ["auto", "plain"])
@pytest.mark.parametrize("size", [1, 7, 40, 70])
def test_factors_and_solutions(mode, size):
    """Cholesky factors, and solutions with many columns and with one, against NumPy; a batch that shares the factor."""
    rng = np.random.default_rng(size)
    A = rng.normal(size=(3, size, size))
    A = A @ A.transpose(0, 2, 1) + size * np.eye(size)
    A[1] *= np.abs(np.subtract.outer(range(size), range(size))) < 2  # a band
    right = rng.normal(size=(3, size, 9))
    with jd.compilation(mode):
        L = jax.jit(jax.vmap(cholesky_factor))(A)
        np.testing.assert_allclose(L, np.linalg.cholesky(A), rtol=0, atol=1e-12)
        for transposed in (False, True):
            lower = np.array(L).transpose(0, 2, 1) if transposed else np.array(L)
            found = jax.jit(jax.vmap(lambda L, b, way=transposed: triangular_solution(L, b, way)))(L, right)
            np.testing.assert_allclose(found, np.linalg.solve(lower, right), rtol=0, atol=1e-12)
            shared = jax.vmap(lambda b, way=transposed: triangular_solution(L[0], b, way))
            wanted = np.stack([np.linalg.solve(lower[0], b) for b in right[..., 0]])
            np.testing.assert_allclose(shared(right[..., 0]), wanted, rtol=0, atol=1e-12)
        assert not np.isfinite(cholesky_factor(jnp.asarray(A[0] - 9 * size * np.eye(size)))).all()


def test_derivatives_of_factors():
    """First and second derivatives of b^T A^-1 b, in both modes, against the closed form -x x^T, x = A^-1 b."""
    rng = np.random.default_rng(2)
    A = rng.normal(size=(40, 40))
    A, b, step = A @ A.T + 40 * np.eye(40), rng.normal(size=40), rng.normal(size=(40, 40))
    step = step + step.T

    def energy(A):
        L = cholesky_factor(A)
        return b @ triangular_solution(L, triangular_solution(L, jnp.asarray(b)), transposed=True)

    x = np.linalg.solve(A, b)
    slope = jax.jvp(energy, (A,), (step,))[1]
    np.testing.assert_allclose(slope, -x @ step @ x, rtol=1e-12)
    gradient = jax.grad(energy)(A)
    # Of the lower triangle alone, which is read.
    np.testing.assert_allclose(gradient + gradient.T, -2 * np.outer(x, x), rtol=0, atol=1e-13)
    second = jax.jvp(lambda A: jax.jvp(energy, (A,), (step,))[1], (A,), (step,))[1]
    np.testing.assert_allclose(second, 2 * x @ step @ np.linalg.solve(A, step @ x), rtol=1e-11)
    of_right = jax.jacobian(lambda b: triangular_solution(cholesky_factor(A), b))(jnp.asarray(b))
    np.testing.assert_allclose(of_right, np.linalg.inv(np.linalg.cholesky(A)), rtol=0, atol=1e-13)
