"""Elimination in native code and by JAX: independent rows, and solutions, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.compile import eliminate, eliminate_rows, kernel, solver_of

pytestmark = pytest.mark.native


def by_hand(B, first, least, most):
    """The mask of the rows that are kept, the distances of the others, and the pivots, by projections onto complements."""
    kept, pivots = [], np.zeros(len(B))
    for _ in range(min(B.shape)):
        basis = np.linalg.qr(B[kept].T)[0] if kept else np.zeros((B.shape[1], 0))
        lengths = np.linalg.norm(B - B @ basis @ basis.T, axis=1)
        lengths[kept] = 0
        order = lengths + np.where((first > 0) & (lengths > least), lengths.max(), 0)
        row = int(np.flatnonzero(order >= 0.999 * order.max())[0])
        if lengths[row] <= least or len(kept) == most:
            break
        kept.append(row)
        pivots[row] = lengths[row]
    basis = np.linalg.qr(B[kept].T)[0] if kept else np.zeros((B.shape[1], 0))
    rest = np.linalg.norm(B - B @ basis @ basis.T, axis=1)
    rest[kept] = 0
    mask = np.zeros(len(B))
    mask[kept] = 1
    return mask, rest, pivots


@pytest.mark.parametrize("shape", [(3, 5), (6, 4), (1, 1), (7, 7)])
@pytest.mark.parametrize("mode", ["auto", "plain"])
def test_rows_by_elimination(mode, shape):
    """Rows of a batch that repeat, nearly repeat and vanish; ties, rows that come first, and a bound of their number."""
    rng, (n, _) = np.random.default_rng(shape[0]), shape
    B = rng.normal(size=(8, *shape))
    B[0] /= np.linalg.norm(B[0], axis=1)[:, None]  # all rows are equally far
    B[1, -1], B[2, n // 2] = B[1, 0], 0
    B[3, -1] = B[3, 0] * (1 + 1e-7)
    first = np.array([rng.random(n) < 0.4 for _ in B], float)
    most = np.array([n, n, n, n, n, 1, 2, 0], float)
    with jd.compilation(mode):
        computed = jax.jit(jax.vmap(eliminate_rows, (0, 0, None, 0)))(B, first, 1e-4, most)
    for i in range(len(B)):
        wanted = by_hand(B[i], first[i], 1e-4, most[i])
        np.testing.assert_array_equal(computed[0][i], wanted[0])
        for one, other in zip(computed[1:], wanted[1:], strict=True):
            np.testing.assert_allclose(one[i], other, rtol=0, atol=1e-12)


@pytest.mark.parametrize("mode", ["auto", "plain"])
def test_rows_that_are_no_numbers(mode):
    """They are not kept, and neither is what follows them; no call waits for ever."""
    B = jnp.ones((3, 2)).at[0, 0].set(jnp.nan)
    with jd.compilation(mode):
        kept, rest, pivots = jax.jit(eliminate_rows)(B, jnp.zeros(3), 1e-4, 2.0)
    assert kept.tolist() == [0, 0, 0] and pivots.tolist() == [0, 0, 0] and np.isnan(rest[0])


@pytest.mark.parametrize("mode", ["auto", "plain"])
@pytest.mark.parametrize("count", [3, 24, 25, 40])
def test_solutions_of_few_and_many_unknowns(mode, count):
    """Written out and by a loop; pivots by leading minors; derivatives of the solution, and a pivot of zero."""
    rng = np.random.default_rng(count)
    matrices, rights = rng.normal(size=(5, count, count)) + count * np.eye(count), rng.normal(size=(5, count, 1))

    @kernel
    def solve(_, matrix, right):
        return eliminate(matrix, right, 1e-10)

    with jd.compilation(mode):
        found, pivots = jax.jit(jax.vmap(solve, (None, 0, 0)))((), matrices, rights)
        # d tr(b^T A^-1 b) / dA = -A^-T b b^T A^-T
        slope = jax.grad(lambda A: jnp.sum(rights[0].T @ solve((), A, rights[0])[0]))(matrices[0])
        of_right = jax.grad(lambda b: jnp.sum(rights[1].T @ solve((), matrices[0], b)[0]))(rights[0])
        none = matrices[0].copy()
        none[0] = none[:, 0] = 0
        assert abs(eliminate(jnp.asarray(none), jnp.zeros((count, 1)), 1e-10)[1][0]) == 0
    np.testing.assert_allclose(found, np.linalg.solve(matrices, rights), rtol=0, atol=1e-13)
    minors = [np.linalg.det(matrices[0][:k, :k]) if k else 1.0 for k in (0, 1, 2, 3)]
    np.testing.assert_allclose(pivots[0][:3], np.divide(minors[1:], minors[:-1]), rtol=1e-12)
    inverse = np.linalg.inv(matrices[0]).T
    np.testing.assert_allclose(of_right, inverse @ rights[1], rtol=0, atol=1e-13)
    np.testing.assert_allclose(slope, -inverse @ rights[0] @ rights[0].T @ inverse, rtol=0, atol=1e-13)


@pytest.mark.parametrize("count", [4, 30])
def test_solutions_of_regular_systems_have_derivatives_of_both_orders(count):
    """Along t, of A + t B with the right side b + t c: those of JAX's solution by LAPACK."""
    rng = np.random.default_rng(count)
    A, B = rng.normal(size=(2, count, count)) + 2 * count * np.array([1, 0])[:, None, None] * np.eye(count)
    b, c = rng.normal(size=(2, count, 1))

    def energy(solve, t):
        return jnp.sum(solve(A + t * B, b + t * c) ** 2)

    by_kernel = kernel(lambda _, t: energy(lambda matrix, right: solver_of(matrix)(right), t))
    found = [jax.jit(f)(0.3) for f in derivatives(lambda t: by_kernel((), t))]
    wanted = [f(0.3) for f in derivatives(lambda t: energy(jnp.linalg.solve, t))]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


def derivatives(f):
    """The function, its first derivatives in both modes, and its second one."""
    return f, jax.grad(f), jax.jacfwd(f), jax.grad(jax.grad(f)), jax.jacfwd(jax.grad(f))
