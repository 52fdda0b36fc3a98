"""Closed loops in single numbers: against the dense equations, their derivatives, and what the dispatch makes of batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick, random_states, random_tree

from jaxdyn import _dispatch, closed_recursion, constrained, scenes, se3
from jaxdyn._anywhere import anywhere, flattened, mended
from jaxdyn.assembly import residuals
from jaxdyn.closed_projection import Closing
from jaxdyn.constrained import constrained_dynamics, solve_rows
from jaxdyn.constrained_motion import consistent
from jaxdyn.constraints import loop
from jaxdyn.constraints.base import position_residual, rows
from jaxdyn.dynamics import bias_force, mass_matrix
from jaxdyn.model import integrate
from jaxdyn.projection import project_state
from jaxdyn.scene import Scene

POSE = ((0.1, -0.2, 0.3), (0.5, 0.2, -0.4))
OTHER = ((-0.3, 0.1, 0.2), (-0.2, 0.7, 0.3))
# A floating base carries three branches: the loops have bodies in common, one reaches the world, one its own ancestor.
KINDS = ("free", "revolute", "spherical", "helical", "planar", "revolute", "prismatic", "free")
PARENTS = (-1, 0, 1, 0, 0, 4, 3, 0)
JOINTS = {
    "few": (("b2", "b5", "revolute"), (None, "b6", "point")),
    "turning": (("b5", "b7", "prismatic"), ("b1", "b7", "universal"), ("b0", "b2", "planar")),
    "in plane": (("b3", "b7", "weld"),),
}


def mechanism(name):
    """A scene with loops that are open where the states are: the equations hold there as well."""
    model = random_tree(5, KINDS, parents=PARENTS)
    loops = [loop(a, POSE, b, OTHER, joint, in_plane=name == "in plane") for a, b, joint in JOINTS[name]]
    return Scene(model, loops)


@pytest.fixture(
    scope="module", params=["few", *(pytest.param(name, marks=pytest.mark.slow) for name in ("turning", "in plane"))]
)
def solved(request):
    """Solutions at three states, and what they have to satisfy."""
    scene = mechanism(request.param)
    q, v, tau = random_states(scene.system, 3, 1)[:3]

    def both(q, v, tau):
        row = rows(scene, q, v)
        found = closed_recursion.closed_dynamics(scene.system, scene.constraints, q, v, tau)
        dense = solve_rows(scene, q, v, tau, 0.0, row)
        M, h = mass_matrix(scene.system, q), bias_force(scene.system, q, v)
        closing = Closing(scene.system, scene.constraints, q)
        residuals = closing.apart(q), closing.slip(q, v), closing.step(row.gamma), closing.quality
        return (*found, residuals), (dense.acceleration, dense.multipliers), (M, h, row.A, row.gamma)

    return scene, (q, v, tau), quick(jax.vmap(both))(q, v, tau)


def test_accelerations_and_multipliers_are_those_of_the_dense_solve(solved):
    _, _, ((a, lam, quality, _), (want_a, want_lam), _) = solved
    assert float(jnp.min(quality)) > 1e-6
    # The rows' matrix squares the condition number of the rows, 1e3 at worst here.
    assert_close(a, want_a, 1e-9)
    assert_close(lam, want_lam, 1e-9)


def test_equations_of_motion_and_rows_hold(solved):
    _, (_, _, tau), ((a, lam, *_), _, (M, h, A, gamma)) = solved
    a, lam, M, h, A, gamma = (np.asarray(x) for x in (a, lam, M, h, A, gamma))
    pushed = np.einsum("nij,ni->nj", A, lam)
    assert_close(np.einsum("nij,nj->ni", M, a) + h, np.asarray(tau) + pushed, 1e-9)
    assert_close(np.einsum("nij,nj->ni", A, a), gamma, 1e-9)


def test_residuals_are_those_of_the_rows_and_a_step_is_the_least_one(solved):
    scene, (q, v, _), ((_, _, quality, residuals), _, (M, _, A, gamma)) = solved
    phi, psi, step, alone = (np.asarray(x) for x in residuals)
    M, A, gamma = (np.asarray(x) for x in (M, A, gamma))
    assert_close(phi, jax.vmap(lambda q: position_residual(scene, q))(q), 1e-12)
    assert_close(psi, np.einsum("nij,nj->ni", A, v), 1e-11)
    assert_close(np.einsum("nij,nj->ni", A, step), gamma, 1e-9)
    # The least step in the metric M is a combination of the rows: M step = A^T x.
    for m, a, s in zip(M, A, step, strict=True):
        force = m @ s
        assert_close(a.T @ np.linalg.lstsq(a.T, force, rcond=None)[0], force, 1e-9)
    assert_close(alone, quality, 1e-9)


@pytest.mark.parametrize("method", ["recursion", pytest.param("range_space", marks=pytest.mark.slow)])
def test_derivatives_are_those_of_the_dense_solve(method):
    model = random_tree(5, ("revolute", "spherical", "helical"), parents=(-1, 0, 0))
    scene = Scene(model, (loop("b1", POSE, "b2", OTHER, "universal"),))
    q0, v, tau = (x[0] for x in random_states(scene.system, 3, 0)[:3])
    rng = np.random.default_rng(3)
    weights = jnp.asarray(rng.normal(size=scene.nv)), jnp.asarray(rng.normal(size=4))

    def value(inertias, twist, dq, v, tau, method):
        # Poses and quaternions move on their manifolds: off them the two are different functions.
        first, *others = scene.constraints
        pose, q = first.pose_a @ se3.exp(twist), integrate(scene.system, q0, dq)
        first = type(first)(first.name, first.joint, first.body_a, first.body_b, first.in_plane, pose, first.pose_b)
        here = Scene(scene.system.replace(inertias=inertias), (first, *others))
        if method == "recursion":
            fixed = jax.lax.stop_gradient((here.system, here.constraints, q, v, tau))
            a, lam, _ = closed_recursion.closed_dynamics(*fixed)
            a, lam = _dispatch.with_derivatives(here.system, here.constraints, q, v, tau, a, lam)
        else:
            found = solve_rows(here, q, v, tau, 0.0, rows(here, q, v), method)
            a, lam = found.acceleration, found.multipliers
        return jnp.vdot(weights[0], a) + jnp.vdot(weights[1], lam)

    at = scene.system.inertias, jnp.zeros(6), jnp.zeros(scene.nv), v, tau
    steps = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in at)

    def derivatives(method):
        return quick(
            lambda *at: (
                jax.grad(value, (0, 1, 2, 3, 4))(*at, method),
                jax.jvp(lambda *x: value(*x, method), at, steps),
            )
        )(*at)

    want = jax.tree.leaves(derivatives("rank_aware"))
    for x, y in zip(jax.tree.leaves(derivatives(method)), want, strict=True):
        assert_close(x, y, 1e-8)  # derivatives of the dense solve lose the square of the rows' condition number


def test_large_batches_run_on_it_and_a_singular_sample_is_solved_with_its_rank(monkeypatch):
    monkeypatch.setattr(_dispatch, "LEAST_BATCH", 4)
    scene = scenes.windows(count=2)
    q0, v0 = scenes.windows.start(count=2)
    q = jnp.stack([q0, q0.at[0].add(0.1), q0 - 0.3, q0 + 0.2])
    # Uprights and couplers in one line: the rows of the windows lose rank.
    flat = jnp.asarray([-np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, -np.pi / 2])
    v = jnp.tile(v0, (4, 1))

    def run(q, v, method="rank_aware"):
        found = constrained_dynamics(scene, q, v, jnp.zeros(5), method=method)
        return found.acceleration, found.multipliers, found.rank

    def dense(q, v):
        found = solve_rows(scene, q, v, jnp.zeros(5), 0.0, rows(scene, q, v))
        return found.acceleration, found.multipliers, found.rank

    program = jax.jit(jax.vmap(run)).lower(q, v).compile()
    plain = jax.jit(jax.vmap(lambda q, v: run(q, v, "schur"))).lower(q, v).compile().as_text()
    assert "lapack" not in plain  # no factorisation is called, all is written out
    with_singular = q.at[1].set(flat)
    for states in (q, with_singular):
        for x, y in zip(program(states, v), jax.vmap(dense)(states, v), strict=True):
            assert_close(x, y, 1e-10)
    assert program(q, v)[2].tolist() == [4, 4, 4, 4]
    assert program(with_singular, v)[2].tolist()[1] < 4


def test_pattern_has_every_entry_of_the_factor():
    rng = np.random.default_rng(0)
    supports = [frozenset(rng.choice(12, 3, replace=False).tolist()) for _ in range(9)]
    Y = np.zeros((12, 9))
    for r, support in enumerate(supports):
        Y[list(support), r] = rng.normal(size=len(support))
    L = np.linalg.cholesky(Y.T @ Y + 1e-3 * np.eye(9))
    want = [np.flatnonzero(np.abs(L[r, :r]) > 1e-12).tolist() for r in range(9)]
    assert closed_recursion.pattern(supports) == want


def test_long_programs_are_left_to_matrices():
    scene = scenes.windows(count=40)
    assert constrained.has_short_recursion(scene)
    model = random_tree(0, ("revolute",) * 30, parents=tuple(range(-1, 29)))
    names = model.body_names
    many = [loop(names[i], None, names[i + 3], None, "spherical") for i in range(26)]
    assert not constrained.has_short_recursion(Scene(model, many))


def test_anywhere_asks_the_whole_batch():
    def pick(x):
        return jax.lax.cond(anywhere(x > 2.5), lambda: x + 10, lambda: x)

    grid = jnp.arange(4.0).reshape(2, 2)
    assert jax.vmap(jax.vmap(pick))(grid).tolist() == [[10, 11], [12, 13]]
    assert jax.jit(jax.vmap(pick))(grid[0]).tolist() == [0, 1]
    assert jax.vmap(jax.grad(pick))(grid[1]).tolist() == [1, 1]
    assert pick(jnp.asarray(3.0)) == 13 and pick(jnp.asarray(1.0)) == 1
    assert "select" not in str(jax.make_jaxpr(jax.vmap(pick))(grid[0]))


def _root(x, scale):
    """sqrt(scale x) that is computed another way where x is below 1."""
    found = jnp.sqrt(scale * x), (jnp.asarray(0, jnp.int32),)
    careful = lambda x, scale: (jnp.exp(0.5 * jnp.log(scale * x)), (jnp.asarray(1, jnp.int32),))  # noqa: E731
    return mended(x < 1, careful, found, (x, scale), lambda y, x, scale: jnp.sqrt(scale * x))


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("few", [0, 1, 50, 96])
def test_samples_that_need_it_are_mended(nested, few):
    x = jnp.where(jnp.arange(96) % 96 < few, 0.5, 2.0) + jnp.arange(96) / 1000
    shape = (8, 12) if nested else (96,)
    run = jax.vmap(_root, (0, None))
    scales = jnp.asarray(3.0)
    if nested:
        run = jax.vmap(jax.vmap(_root, (0, None)), (0, 0))
        scales = jnp.arange(1.0, 9.0)
    y, (way,) = jax.jit(run)(x.reshape(shape), scales)
    want = np.sqrt(np.asarray(x).reshape(shape) * (np.asarray(scales)[:, None] if nested else 3.0))
    assert_close(y, want, 1e-14)
    assert way.reshape(-1).tolist() == [1] * few + [0] * (96 - few)
    slope = jax.grad(lambda x: jnp.sum(run(x, scales)[0]))(x.reshape(shape))
    moved = jax.jvp(lambda s: run(x.reshape(shape), s)[0], (scales,), (jnp.ones_like(scales),))[1]
    assert_close(slope, want / (2 * np.asarray(x).reshape(shape)), 1e-13)
    assert_close(moved, want / (2 * (np.asarray(scales)[:, None] if nested else 3.0)), 1e-13)


def test_one_sample_is_mended():
    for run in (_root, jax.jit(_root)):
        for x, way in ((0.25, 1), (4.0, 0)):
            y, (found,) = run(jnp.asarray(x), jnp.asarray(1.0))
            assert found == way
            assert_close(y, np.sqrt(x), 1e-15)


def test_a_sample_is_not_changed_by_a_singular_one_beside_it(monkeypatch):
    monkeypatch.setattr(_dispatch, "LEAST_BATCH", 4)
    scene = scenes.windows(count=2)
    q0, v0 = scenes.windows.start(count=2)
    q = jnp.stack([q0, q0.at[0].add(0.1), q0 - 0.3, q0 + 0.2])
    flat = jnp.asarray([-np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, -np.pi / 2])

    @jax.jit
    @jax.vmap
    def run(q):
        found = constrained_dynamics(scene, q, v0, jnp.zeros(5))
        return found.acceleration, found.multipliers, project_state(scene, q, v0, 0.0)

    others = np.array([0, 2, 3])
    for x, y in zip(jax.tree.leaves(run(q)), jax.tree.leaves(run(q.at[1].set(flat))), strict=True):
        assert np.array_equal(x[others], y[others])


def test_gradients_beside_a_singular_sample(monkeypatch):
    monkeypatch.setattr(_dispatch, "LEAST_BATCH", 4)
    scene = scenes.windows(count=2)
    q0, v0 = scenes.windows.start(count=2)
    flat = jnp.asarray([-np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, -np.pi / 2])
    q = jnp.stack([q0, flat, q0 - 0.3, q0 + 0.2])
    turn = jnp.cos(jnp.arange(5.0))

    def pulled(solved):
        return jax.vmap(jax.grad(lambda q, tau: jnp.sum(turn * solved(q, tau)), (0, 1)), (0, None))(q, jnp.zeros(5))

    def dense(q, tau):
        return solve_rows(scene, q, v0, tau, 0.0, rows(scene, q, v0)).acceleration

    found = jax.jit(lambda: pulled(lambda q, tau: constrained_dynamics(scene, q, v0, tau).acceleration))()
    others = np.array([0, 2, 3])
    for x, y in zip(found, jax.jit(lambda: pulled(dense))(), strict=True):
        assert_close(x[others], y[others], 1e-9)  # through normal equations the condition number is lost twice
        assert np.isfinite(np.asarray(x)).all()


def test_nested_batches_are_computed_along_one_axis():
    """Arguments of both batches, of one of them, and of none."""
    rng = np.random.default_rng(3)
    x, y, z, w = (jnp.asarray(rng.normal(size=shape)) for shape in ((3, 4, 2), (3,), (4, 2), (2,)))

    def plain(x, rest):
        y, z, w = rest
        return {"a": y * jnp.sin(x) @ w, "b": z + w}

    def nested(function):
        return jax.vmap(jax.vmap(function, (0, (None, 0, None))), (0, (0, None, None)))

    found = jax.jit(nested(flattened(plain)))
    for one, other in zip(
        jax.tree.leaves(found(x, (y, z, w))), jax.tree.leaves(nested(plain)(x, (y, z, w))), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    text = str(jax.make_jaxpr(found)(x, (y, z, w)))
    assert "f64[12,2] = sin" in text
    assert "f64[3,4,2] = sin" not in text
    single = x[0, 0], (y[0], z[0], w)
    for one, other in zip(jax.tree.leaves(flattened(plain)(*single)), jax.tree.leaves(plain(*single)), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", ["few", "windows", pytest.param("turning", marks=pytest.mark.slow)])
def test_residuals_body_by_body_are_those_of_the_constraints(name, monkeypatch):
    """Open loops under nested `vmap`s, the derivative of the output of that name, and the check of a motion's states."""
    scene = scenes.windows() if name == "windows" else mechanism(name)
    states = [random_states(scene.system, 2, k) for k in range(3)]
    q, v = (jnp.stack([jnp.asarray(state[i]) for state in states]) for i in range(2))

    def one(q, v):
        return residuals(scene, q, v), jax.jacfwd(lambda v: residuals(scene, q, v))(v), consistent(scene, q, v, 0.0)

    def found():
        return jax.jit(jax.vmap(jax.vmap(one)))(q, v)

    by_matrices = found()
    monkeypatch.setattr(_dispatch, "LEAST_BATCH", 1)
    for x, y in zip(found(), by_matrices, strict=True):
        assert_close(x, y, 1e-12)
    assert not np.any(by_matrices[2])
