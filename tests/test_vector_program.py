"""Programs of single numbers as programs of vectors: against the numbers themselves, dense matrices and the dense way."""

import math
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn import _banded, _in_vectors, _one_kernel, closed_projection, closed_recursion, constrained, scenes
from jaxdyn._one_kernel import as_folds, kernel_of
from jaxdyn._scalar_program import scalar_program
from jaxdyn._vector_program import Group, VectorProgram, vector_program
from jaxdyn.constrained import _in_numbers, solve_rows
from jaxdyn.constraints.base import rows


@pytest.mark.parametrize(
    ("m", "width", "lead"), [(80, 4, ()), (7, 1, ()), (9, 3, (5,)), (16, 2, (2, 3)), (1, 1, ())], ids=str
)
def test_band_matrices_are_those_of_lapack(m, width, lead):
    """L D L^T against the matrix, solutions against a dense solver."""
    rng = np.random.default_rng(m)
    band = rng.normal(size=(m, width, *lead)) * 0.3
    band[:, -1] = 4.0 + rng.random((m, *lead))
    dense, lower, right = np.zeros((*lead, m, m)), np.zeros((*lead, m, m)), rng.normal(size=(m, *lead))
    for r in range(m):
        for j in range(width):
            if r - j < 0:
                band[r, width - 1 - j] = 0.0
            else:
                dense[..., r, r - j] = dense[..., r - j, r] = band[r, width - 1 - j]
    numbers = jnp.asarray(band.reshape(-1, *lead))
    factor = jax.jit(lambda x: _banded.in_vectors(_banded.banded_factor_p, x, width=width))(numbers)
    found = jax.jit(lambda *x: _banded.in_vectors(_banded.banded_solution_p, jnp.concatenate(x), width=width))(
        factor, right
    )
    entries = np.asarray(factor).reshape(m, width, *lead)
    for r in range(m):
        for j in range(min(width, r + 1)):
            lower[..., r, r - j] = 1.0 if j == 0 else entries[r, width - 1 - j]
    pivots = np.moveaxis(entries[:, -1], 0, -1)[..., None, :]
    np.testing.assert_allclose((lower * pivots) @ np.swapaxes(lower, -1, -2), dense, rtol=0, atol=1e-13)
    wanted = np.linalg.solve(dense, np.moveaxis(right, 0, -1)[..., None])[..., 0]
    np.testing.assert_allclose(np.moveaxis(np.asarray(found), 0, -1), wanted, rtol=0, atol=1e-13)


def parts(x, y, factors, n):
    """Equal parts with known numbers of their own, sums over all of them, other orders, some that are like no other."""
    bent = jnp.sin(factors * x) / jnp.sqrt(1.0 + y * y)
    crossed = bent[::-1] * x - jnp.where(y > 0, y, bent)
    crossed = jnp.concatenate([crossed[:3], crossed[3:4] * x[0], crossed[4:]])
    total = jnp.max(crossed) + jnp.sum(bent[1::2])
    return {
        "crossed": crossed,
        "some": crossed[jnp.asarray([4, 1, 1])],
        "total": total,
        "n": n + 1,
        "known": factors[:2],
    }


@pytest.mark.parametrize("batch", [(), (6,), (2, 3)], ids=str)
def test_vectors_give_what_the_numbers_give(batch):
    """For one sample, whose small groups are operations on arrays, and for batches, whose groups are kernels."""
    factors = np.array([1.0, 2.0, -1.0, 0.5, 3.0, 1.5, 2.5])
    x, y = jax.random.normal(jax.random.key(2), (2, *batch, 7))
    n = jnp.full(batch, 4)

    def function(x, y, n):
        return parts(x, y, factors, n)

    args = [jax.ShapeDtypeStruct(a.shape[len(batch) :], a.dtype) for a in (x, y, n)]
    program, shapes, structure = scalar_program(function, *args, most=1000, in_vectors=True)
    short = vector_program(program, [7, 7, 1], [math.prod(shape) for shape, _ in shapes])
    assert short.operations < len(program.eqns) / 2
    found = jax.jit(lambda *a: as_folds(*a, program=short, shapes=shapes, depth=len(batch)))(x, y, n)
    wanted = function
    for _ in batch:
        wanted = jax.vmap(wanted)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-14),
        jax.tree.unflatten(structure, found),
        wanted(x, y, n),
    )


def test_known_numbers_that_compare_equal_are_kept_apart():
    """Zeros of both signs, and numbers of several dtypes, that operations in one group take in the same places."""
    one, other = np.array([1.0, 0.0, 2.0, 0.0]), np.array([1.0, -0.0, 2.0, 0.0])

    def function(x):
        return (
            jnp.where(x > 0, one, other),
            jnp.where(x > 1, one.astype(np.float32), np.float32(3)),
            jnp.where(x > 2, one.astype(int), 5),
        )

    x = jnp.array([-1.0, -1.0, 3.0, 3.0])
    program, shapes, structure = scalar_program(
        function, jax.ShapeDtypeStruct((4,), x.dtype), most=100, in_vectors=True
    )
    short = vector_program(program, [4], [4, 4, 4])
    found = jax.tree.unflatten(structure, jax.jit(lambda x: as_folds(x, program=short, shapes=shapes, depth=0))(x))
    for a, b in zip(found, function(x), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(np.signbit(found[0]), [False, True, False, False])


def windows(count):
    scene = scenes.windows(count=count)
    keys = jax.random.split(jax.random.key(5), 3)
    return scene, *(s * jax.random.normal(key, (scene.nv,)) for key, s in zip(keys, (0.2, 1.0, 1.0), strict=True))


@pytest.fixture
def in_vectors(monkeypatch):
    """Vectors for mechanisms that are short enough for numbers."""
    monkeypatch.setattr(_one_kernel, "MOST", 500)
    jax.clear_caches()
    _one_kernel._kernel.cache_clear()
    yield
    jax.clear_caches()
    _one_kernel._kernel.cache_clear()


@pytest.mark.parametrize("batch", [None, 3], ids=str)
def test_windows_in_vectors_move_as_by_dense_matrices(in_vectors, batch):
    """Accelerations and multipliers of ten windows against dense factors; about as many operations as for fourteen."""
    counted = []
    for count in (10, 14):
        scene, q, v, tau = windows(count)
        kernel = kernel_of(_in_numbers, scene, q, v, tau, jnp.zeros(()), in_vectors=True)
        assert kernel is not None and isinstance(kernel.program, VectorProgram)
        counted.append(kernel.program.operations)
        assert any(not isinstance(step, Group) for step in kernel.program.steps)  # band matrices
        if count == 14:
            continue
        wanted = solve_rows(scene, q, v, tau, 0.0, rows(scene, q, v, 0.0), "schur")
        args = q, v, tau, jnp.zeros(())
        if batch is not None:
            args = [jnp.broadcast_to(x, (batch, *x.shape)) for x in args]
        put = partial(as_folds, program=kernel.program, shapes=kernel.shapes, depth=0 if batch is None else 1)
        a, lam, quality = jax.jit(put)(*args)
        scale = float(jnp.max(jnp.abs(wanted.multipliers)))
        assert (np.asarray(quality) > 1e-6).all()
        np.testing.assert_allclose(a, np.broadcast_to(wanted.acceleration, a.shape), rtol=1e-11, atol=1e-11 * scale)
        np.testing.assert_allclose(lam, np.broadcast_to(wanted.multipliers, lam.shape), rtol=1e-11, atol=1e-11 * scale)
    # Only the numbers that a reduction folds in pairs are more, by the logarithm.
    assert counted[1] <= 1.1 * counted[0]


@pytest.mark.parametrize("lead", [(5,), (2, 3)], ids=str)
def test_large_batches_go_in_portions(in_vectors, monkeypatch, lead):
    """Samples that differ, two of them after another, as all at once."""
    scene, q, v, tau = windows(10)
    kernel = kernel_of(_in_numbers, scene, q, v, tau, jnp.zeros(()), in_vectors=True)
    assert kernel is not None
    rng = np.random.default_rng(0)
    q, v, tau = (jnp.asarray(np.asarray(x) + 0.01 * rng.normal(size=(*lead, *x.shape))) for x in (q, v, tau))
    args, found = (q, v, tau, jnp.zeros(lead)), []
    for at_once in (2, 100):
        monkeypatch.setattr(_in_vectors, "_AT_ONCE", at_once)
        found.append(as_folds(*args, program=kernel.program, shapes=kernel.shapes, depth=len(lead)))
    for a, b in zip(*found, strict=True):
        assert a.shape == b.shape and a.shape[: len(lead)] == lead
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11 * np.max(np.abs(b)))


@pytest.mark.parametrize("often", [True, False])
def test_windows_in_vectors_are_closed_as_by_the_recursion(in_vectors, often):
    """Residuals and steps of a projection against the recursion as it is, with folds and without."""
    scene, q, v, _ = windows(10)
    tree = scene.system, scene.constraints
    found = jax.jit(
        lambda q, v: _of_closing(closed_projection.ClosingInKernels(*tree, q, _kernels(tree, q, v, often)), q, v)
    )(q, v)
    wanted = _of_closing(closed_projection.Closing(*tree, q), q, v)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)


def _kernels(tree, q, v, often):
    found = closed_projection.kernels(*tree, q, v, long=True, often=often)
    assert found is not None and all(isinstance(kernel.program, VectorProgram) for kernel in found)
    return found


def _of_closing(closing, q, v):
    phi = closing.apart(q)
    return phi, closing.slip(q, v), closing.step(phi), closing.quality


def test_wide_bands_are_written_out(in_vectors, monkeypatch):
    """Where the rows' matrix has no narrow band its factor is written in numbers, with the same result."""
    scene, q, v, tau = windows(10)
    args = q, v, tau, jnp.zeros(())
    monkeypatch.setattr(_one_kernel, "LEAST_EQUAL", 1)  # a long sequence is like no other
    put = []
    for width in (closed_recursion.MOST_WIDTH, 1):
        monkeypatch.setattr(closed_recursion, "MOST_WIDTH", width)
        jax.clear_caches()
        _one_kernel._kernel.cache_clear()
        kernel = kernel_of(_in_numbers, scene, *args, in_vectors=True)
        assert kernel is not None and isinstance(kernel.program, VectorProgram)
        put.append(as_folds(*args, program=kernel.program, shapes=kernel.shapes, depth=0))
    for a, b in zip(*put, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_long_mechanisms_end_where_others_do(in_vectors, monkeypatch):
    """Three windows for half a second taken for a long mechanism, and as they are; with residuals at the save points."""
    scene = scenes.windows(count=3)
    q0, v0 = scenes.windows.start(count=3)
    ts = jnp.linspace(0.0, 0.5, 3)

    def run(q0, v0):
        outputs = ("constraint_residual",)
        return jd.simulate(scene, q0, v0, ts, stepsize=0.125, solver=diffrax.Dopri8(), throw=False, outputs=outputs)

    wanted = jax.jit(run)(q0, v0)
    monkeypatch.setattr(constrained, "MOST_BODIES", 6)
    monkeypatch.setattr(_one_kernel, "LEAST_EQUAL", 1)
    jax.clear_caches()
    _one_kernel._kernel.cache_clear()
    assert constrained.has_long_recursion(scene)
    found = jax.jit(run)(q0, v0)
    assert bool(found.success)
    np.testing.assert_allclose(found.q, wanted.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.v, wanted.v, rtol=0, atol=1e-12)
    assert np.max(found.constraint_residual) < 1e-13


@pytest.mark.slow
def test_a_simulation_in_vectors_is_the_ordinary_one(in_vectors, monkeypatch):
    """Ten windows for half a second, and without kernels at all: by the same steps, and by those that are chosen.

    The error of the first step that is chosen is estimated as some rounding errors, so that the second one differs by a third.
    Dense output then differs by more than the ends of steps.
    """
    scene = scenes.windows(count=10)
    q0, v0 = scenes.windows.start(count=10)
    ts = jnp.linspace(0.0, 0.5, 3)

    def run(q0, v0):
        chosen = jd.simulate(scene, q0, v0, ts, rtol=1e-11, atol=1e-11, throw=False)
        return chosen, jd.simulate(scene, q0, v0, ts, stepsize=0.125, solver=diffrax.Dopri8(), throw=False)

    found, found_fixed = jax.jit(run)(q0, v0)
    monkeypatch.setattr(_one_kernel, "MOST_IN_VECTORS", 0)
    jax.clear_caches()
    _one_kernel._kernel.cache_clear()
    wanted, wanted_fixed = jax.jit(run)(q0, v0)
    assert bool(found.success) and bool(found_fixed.success)
    np.testing.assert_allclose(found_fixed.q, wanted_fixed.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found_fixed.v, wanted_fixed.v, rtol=0, atol=1e-12)
    # Both are as far from the motion as their tolerance allows.
    np.testing.assert_allclose(found.q[-1], wanted.q[-1], rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.v[-1], wanted.v[-1], rtol=0, atol=1e-10)
