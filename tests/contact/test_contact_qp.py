"""Quadratic programs against quadprog, Clarabel, linear programs and their own optimality conditions; their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick
from scipy.optimize import linprog

import jaxdyn as jd

N, ROWS, CONES = 6, 9, 2
MU = 0.6


def problems(count, seed, *, cones=True, feasible=True):
    """Q, q, G, h, A, b, S, c in batches: dependent equality rows, rows of very different lengths, active constraints."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(count, N, N))
    Q = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(N)
    q = 3 * random.normal(size=(count, N))
    inside = random.normal(size=(count, N))
    lengths = 10 ** random.uniform(-1, 1, size=(count, ROWS, 1))
    G = random.normal(size=(count, ROWS, N)) * lengths
    h = np.einsum("bmn,bn->bm", G, inside)
    slack = 0.3 * random.exponential(size=h.shape) * lengths[..., 0]
    h = h + slack if feasible else random.normal(size=h.shape) * lengths[..., 0]
    A = random.normal(size=(count, 2, N))
    A = np.concatenate([A, A.sum(1, keepdims=True)], 1)
    b = np.einsum("bpn,bn->bp", A, inside)
    S = random.normal(size=(count, CONES, 3, N)) * (1.0 if cones else 0.0)
    y = random.normal(size=(count, CONES, 3))
    y[..., 0] = np.linalg.norm(y[..., 1:], axis=-1) + 0.3 * random.exponential(size=y.shape[:2])
    return Q, q, G, h, A, b, S, np.einsum("bkdn,bn->bkd", S, inside) + y


def one(Q, q, G, h, A, b, S, c):
    return jd.contact.solve_qp(Q, q, G, h, A, b, cones=[(S, c)])


many = quick(jax.vmap(one))


def largest_residual(data, computed):
    """Largest violation of the conditions of optimality, of numbers of order one to ten."""
    Q, q, G, h, A, b, S, c = data
    x, z, y, w = (
        np.asarray(v)
        for v in (computed.x, computed.multipliers, computed.equality_multipliers, computed.cone_multipliers[0])
    )
    scale = 1 + abs(q).max(1)
    slack, cone = h - np.einsum("bmn,bn->bm", G, x), c - np.einsum("bkdn,bn->bkd", S, x)
    depth = lambda v: v[..., 0] - np.linalg.norm(v[..., 1:], axis=-1)  # noqa: E731
    gradient = np.einsum("bij,bj->bi", Q, x) + q + np.einsum("bmn,bm->bn", G, z) + np.einsum("bpn,bp->bn", A, y)
    gradient += np.einsum("bkdn,bkd->bn", S, w)
    wrong = [abs(gradient), abs(np.einsum("bpn,bn->bp", A, x) - b), -slack, -z, -depth(cone), -depth(w)]
    wrong += [
        abs(slack * z),
        abs((cone * w).sum(-1)),
        abs(slack - computed.slack),
        abs(cone - computed.cone_slack[0]).max(-1),
    ]
    return max((part.max(1) / scale).max() for part in wrong)


@pytest.mark.long
def test_conditions_of_optimality_hold():
    data = problems(200, 1)
    computed = many(*data)
    assert (computed.result == jd.RESULTS.successful).all()
    # The last Newton steps leave rounding, times lengths of rows of ten and multipliers of a hundred.
    assert largest_residual(data, computed) < 1e-10
    # All kinds of ends occur: cones left alone, on their boundary, at their apex; rows active or not.
    size, slack = (np.asarray(x)[..., 0] for x in (computed.cone_multipliers[0], computed.cone_slack[0]))
    for case in (size < 1e-9, (size > 1e-3) & (slack > 1e-3)):
        assert case.sum() > 20
    assert (np.asarray(computed.multipliers) > 1e-3).sum() > 100


def test_agrees_with_clarabel():
    clarabel, sparse = pytest.importorskip("clarabel"), pytest.importorskip("scipy.sparse")
    data = problems(200, 1)
    computed = np.asarray(many(*data).x)
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas = False, 1e-12, 1e-12, 1e-12
    kinds = [clarabel.ZeroConeT(2), clarabel.NonnegativeConeT(ROWS), *[clarabel.SecondOrderConeT(3)] * CONES]
    for i in range(100):
        Q, q, G, h, A, b, S, c = (part[i] for part in data)
        rows = sparse.csc_matrix(np.concatenate([A[:2], G, S.reshape(-1, N)]))
        level = np.concatenate([b[:2], h, c.ravel()])
        other = clarabel.DefaultSolver(sparse.csc_matrix(np.triu(Q)), q, rows, level, kinds, settings).solve()
        # Clarabel's own conditions of optimality are met to about 1e-8, and x is as sensitive as Q is ill-conditioned.
        np.testing.assert_allclose(computed[i], other.x, atol=2e-5)
        assert abs(computed[i] @ Q @ computed[i] / 2 + q @ computed[i] - other.obj_val) < 1e-7 * (
            1 + abs(other.obj_val)
        )


def test_infeasible_lanes_are_told_and_leave_the_others_alone():
    data = problems(200, 3, cones=False, feasible=False)
    computed = many(*data)
    is_feasible = []
    for i in range(200):
        _, _, G, h, A, b, _, _ = (part[i] for part in data)
        is_feasible.append(linprog(np.zeros(N), G, h, A[:2], b[:2], bounds=(None, None)).status == 0)
    is_feasible = np.array(is_feasible)
    assert 10 < is_feasible.sum() < 190
    np.testing.assert_array_equal(computed.result == jd.RESULTS.successful, is_feasible)
    np.testing.assert_array_equal(computed.result == jd.RESULTS.infeasible, ~is_feasible)
    assert np.isfinite(computed.x).all()
    # Contradicting equality rows, and a matrix that is not positive definite, in single lanes of a batch.
    Q, q, G, h, A, b, S, c = problems(3, 4)
    Q[1] *= -1
    b[2, 2] += 1.0
    computed = many(Q, q, G, h, A, b, S, c)
    assert [
        str(computed.result == code) for code in (jd.RESULTS.successful, jd.RESULTS.indefinite, jd.RESULTS.infeasible)
    ] == [str(np.arange(3) == i) for i in range(3)]


@pytest.mark.long
def test_derivatives_are_those_of_differences():
    data = problems(200, 1)
    random = np.random.default_rng(5)
    change = [0.3 * random.normal(size=x.shape) for x in data]
    # Equality rows stay consistent, or there is no solution to differentiate.
    for rows in change[4:6]:
        rows[:, 2] = rows[:, 0] + rows[:, 1]
    change, weights = tuple(change), random.normal(size=(200, N))

    @quick
    @jax.vmap
    def slopes(data, change, weights):
        value = lambda *data: weights @ one(*data).x  # noqa: E731
        return jax.jvp(value, data, change)[1], jax.grad(lambda data: value(*data))(data)

    forward, gradients = slopes(data, change, weights)
    forward = np.asarray(forward)
    reverse = sum(np.sum((np.asarray(g) * d).reshape(200, -1), 1) for g, d in zip(gradients, change, strict=True))
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9)

    def at(step):
        computed = many(*(x + step * d for x, d in zip(data, change, strict=True)))
        return np.sum(weights * np.asarray(computed.x), 1)

    def difference(step):
        return (8 * (at(step) - at(-step)) - at(2 * step) + at(-2 * step)) / (12 * step)

    coarse, fine = difference(2e-5), difference(1e-5)
    # Where a constraint comes or goes within the steps, differences with two steps differ.
    smooth = abs(coarse - fine) < 1e-7 * (1 + abs(fine))
    assert smooth.sum() > 150
    np.testing.assert_allclose(forward[smooth], fine[smooth], rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_the_second_derivative_is_that_of_differences():
    S, c = jnp.eye(3)[None] * jnp.array([-1.0, -1.0, -1.0])[None, None], jnp.zeros((1, 3))

    def norm(q):
        return jnp.sum(jd.contact.solve_qp(jnp.diag(jnp.array([1.0, 2.0, 3.0])), q, cones=[(S, c)]).x ** 2)

    hessian = quick(jax.hessian(norm))
    gradient = quick(jax.grad(norm))
    for q in ([0.1, 1.0, -2.0], [-3.0, 0.1, 0.2], [3.0, 0.1, 0.2]):  # on the boundary, inside, at the apex
        q, step = jnp.array(q), 1e-5
        differences = np.stack([(gradient(q + step * e) - gradient(q - step * e)) / (2 * step) for e in np.eye(3)])
        np.testing.assert_allclose(hessian(q), differences, atol=1e-6)


def test_projections_in_closed_form():
    # On a box, on the half-space of a sum, and without any constraint.
    target = jnp.array([2.0, -0.5, 0.3])
    unit = jnp.eye(3)
    bounded = quick(jd.contact.solve_qp)
    box = bounded(unit, -target, jnp.concatenate([unit, -unit]), jnp.ones(6))
    np.testing.assert_allclose(box.x, [1, -0.5, 0.3], atol=1e-14)
    np.testing.assert_allclose(box.multipliers, [1, 0, 0, 0, 0, 0], atol=1e-14)
    # Rows twice leave the multipliers open but not x; infinite bounds are none.
    twice = bounded(unit, -target, jnp.stack([unit[0]] * 6), jnp.array([1.0, 1.0, 1.0, jnp.inf, 5.0, jnp.inf]))
    np.testing.assert_allclose(twice.x, [1, -0.5, 0.3], atol=1e-12)
    np.testing.assert_allclose(twice.multipliers.sum(), 1, atol=1e-12)
    free = quick(lambda A, b: jd.contact.solve_qp(unit, -target, A=A, b=b))(jnp.ones((2, 3)), jnp.ones(2))
    np.testing.assert_allclose(free.x, target - (target.sum() - 1) / 3, atol=1e-14)
    np.testing.assert_allclose(free.equality_multipliers, [0.8 / 6] * 2, atol=1e-14)


def test_float32():
    target = jnp.array([2.0, -0.5, 0.3], jnp.float32)
    unit = jnp.eye(3, dtype=jnp.float32)
    solution = quick(jd.contact.solve_qp)(unit, -target, jnp.concatenate([unit, -unit]), jnp.ones(6, jnp.float32))
    assert solution.x.dtype == jnp.float32 and bool(solution.result == jd.RESULTS.successful)
    np.testing.assert_allclose(solution.x, [1, -0.5, 0.3], atol=1e-5)


@pytest.mark.slow
def test_too_few_steps_are_told():
    """After one step some are solved by the Newton steps that follow it; the others say that they are not."""
    Q, q, G, h, *_ = problems(40, 9)
    limited = jax.jit(jax.vmap(lambda *data: jd.contact.solve_qp(*data, max_steps=1)))(Q, q, G, h)
    whole = jax.jit(jax.vmap(jd.contact.solve_qp))(Q, q, G, h)
    stalled = np.asarray(limited.result == jd.RESULTS.stalled)
    assert stalled.any() and (np.asarray(limited.steps) == 1).all()
    assert (np.asarray(limited.result == jd.RESULTS.successful) == ~stalled).all()
    np.testing.assert_allclose(limited.x[~stalled], whole.x[~stalled], atol=1e-8)


@pytest.mark.slow
def test_known_zeros_of_rows_cost_nothing():
    """Rows that are numpy arrays while a program is traced: the same solution by half the operations."""
    Q, q, G, *_ = (np.asarray(x[:3]) for x in quadruped(3, 1))
    h, rows = jnp.zeros(20), G[0]

    def operations(function, *args):
        programs = []

        def collect(jaxpr):
            for eqn in jaxpr.eqns:
                if eqn.primitive.name == "jaxdyn_kernel":
                    programs.append(eqn.params["program"])
                for value in eqn.params.values():
                    inner = getattr(value, "jaxpr", value)
                    if hasattr(inner, "eqns"):
                        collect(inner)

        collect(jax.make_jaxpr(function)(*args).jaxpr)
        return sum(sum(program.counts().values()) for program in programs if hasattr(program, "counts"))

    known, given = (lambda Q, q: jd.contact.solve_qp(Q, q, rows, h)), (lambda Q, q, G: jd.contact.solve_qp(Q, q, G, h))
    if all_operations := operations(given, Q[0], q[0], rows):
        assert operations(known, Q[0], q[0]) < 0.5 * all_operations
    computed = quick(jax.vmap(known))(Q, q)
    np.testing.assert_allclose(computed.x, quick(jax.vmap(given))(Q, q, jnp.asarray(G)).x, atol=1e-9)


def quadruped(count, seed):
    """Twelve forces of four feet that track a wrench: Q, q, pyramids G, h, and cones S, c."""
    random = np.random.default_rng(seed)
    feet = np.array([[0.2, 0.13, -0.3], [0.2, -0.13, -0.3], [-0.2, 0.13, -0.3], [-0.2, -0.13, -0.3]])
    G, S = np.zeros((count, 20, 12)), np.zeros((count, 4, 3, 12))
    Q, q = np.zeros((count, 12, 12)), np.zeros((count, 12))
    weight = np.diag([1, 1, 1, 10, 10, 10.0])
    for i in range(count):
        A = np.zeros((6, 12))
        for k in range(4):
            p = feet[k] + 0.03 * random.normal(size=3)
            n = np.array([0, 0, 1]) + 0.2 * random.normal(size=3)
            x = np.cross([0, 1.0, 0], n)
            x, n = x / np.linalg.norm(x), n / np.linalg.norm(n)
            R = np.stack([x, np.cross(n, x), n], 1)
            A[:3, 3 * k : 3 * k + 3], A[3:, 3 * k : 3 * k + 3] = R, np.cross(p, R.T).T
            for j, (a, s) in enumerate([(0, 1), (0, -1), (1, 1), (1, -1)]):
                G[i, 5 * k + j, 3 * k + a], G[i, 5 * k + j, 3 * k + 2] = s, -MU
            G[i, 5 * k + 4, 3 * k + 2] = -1
            S[i, k, 0, 3 * k + 2], S[i, k, 1, 3 * k], S[i, k, 2, 3 * k + 1] = -MU, -1, -1
        w = [*60 * random.normal(size=2), 120 + 20 * random.normal(), *15 * random.normal(size=3)]
        Q[i], q[i] = A.T @ weight @ A + 1e-2 * np.eye(12), -A.T @ weight @ w
    return tuple(map(jnp.asarray, (Q, q, G, np.zeros((count, 20)), S, np.zeros((count, 4, 3)))))


@pytest.mark.slow
def test_no_lane_of_ten_thousand_stalls():
    quadprog = pytest.importorskip("quadprog")
    Q, q, G, h, S, c = quadruped(10_000, 6)
    flat = jax.jit(jax.vmap(lambda *data: jd.contact.solve_qp(*data, tol=1e-9)))(Q, q, G, h)
    round_ = jax.jit(jax.vmap(lambda Q, q, S, c: jd.contact.solve_qp(Q, q, cones=[(S, c)], tol=1e-9)))(Q, q, S, c)
    for computed in (flat, round_):
        assert (computed.result == jd.RESULTS.successful).all()
    for i in range(200):
        other = quadprog.solve_qp(np.array(Q[i]), -np.array(q[i]), -np.array(G[i]).T.copy(), -np.array(h[i]), 0)[0]
        np.testing.assert_allclose(flat.x[i], other, atol=1e-8)
    gradient = jnp.einsum("bij,bj->bi", Q, round_.x) + q + jnp.einsum("bkdn,bkd->bn", S, round_.cone_multipliers[0])
    assert float(jnp.abs(gradient).max() / jnp.abs(q).max()) < 1e-10


BAD = [
    (dict(Q=jnp.diag(jnp.array([1.0, -1.0]))), "not positive definite"),
    (dict(Q=jnp.zeros((2, 2))), "not positive definite"),
    (dict(Q=jnp.ones((2, 3))), "Q has shape"),
    (dict(q=jnp.ones(3)), "q has shape"),
    (dict(q=jnp.array([1.0, jnp.nan])), "not a number"),
    (dict(h=None), "h is None"),
    (dict(h=jnp.ones(2)), "h has shape"),
    (dict(G=jnp.ones((1, 3))), "G has shape"),
    (dict(A=jnp.ones((1, 2))), "b is None"),
    (dict(cones=[jnp.ones((1, 3, 2))]), r"cones\[0\]"),
    (dict(cones=[(jnp.ones((1, 3, 2)), jnp.ones((1, 2)))]), "c has shape"),
    (dict(cones=[(jnp.ones((1, 0, 2)), jnp.ones((1, 0)))]), "one row"),
    (dict(tol=0.0), "tol is 0.0"),
    (dict(max_steps=0), "max_steps is 0"),
]


@pytest.mark.parametrize("change, match", BAD)
def test_bad_input_is_refused(change, match):
    good = dict(Q=jnp.eye(2), q=jnp.ones(2), G=jnp.ones((1, 2)), h=jnp.ones(1))
    with pytest.raises(ValueError, match=match):
        jd.contact.solve_qp(**{**good, **change})


def test_data_that_are_not_finite_have_a_code():
    """In every argument, under jit, where nothing can be refused; an infinite h is no bound."""
    program = [np.eye(2), [-2.0, 0.0], [[1.0, 0.0]], [1.0], [[0.0, 1.0]], [0.5]]
    program = [np.asarray(x, float) for x in program]
    rows = [program]
    for i in range(6):
        for bad in (np.nan, np.inf):
            changed = [x.copy() for x in program]
            changed[i].flat[0] = bad
            rows.append(changed)
    batch = [jnp.stack([row[i] for row in rows]) for i in range(6)]
    results = jax.jit(jax.vmap(lambda *given: jd.contact.solve_qp(*given).result))(*batch)
    np.testing.assert_array_equal(np.flatnonzero(results != jd.RESULTS.nonfinite), [0, 8])


def test_projection_on_a_cone_near_its_apex():
    """Closed form (t + |u|) / 2 (1, u / |u|) at distances from the apex down to 1e-8 of y, of any size; and its derivatives."""
    rng = np.random.default_rng(0)
    outside = np.concatenate([sign * 10 ** rng.uniform(-8, 0, 150) for sign in (1, -1)])
    angle, size = rng.uniform(0, 2 * np.pi, 300), 10 ** rng.uniform(-2, 2, 300)
    u = (1 + outside)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    y = size[:, None] * np.concatenate([-np.ones((300, 1)), u], 1)

    def nearest(y):
        return jd.contact.solve_qp(jnp.eye(3), -y, cones=(-jnp.eye(3)[None], jnp.zeros((1, 3))))

    found = jax.jit(jax.vmap(nearest))(jnp.asarray(y))
    assert bool(found.success.all())
    length = np.linalg.norm(y[:, 1:], axis=1)
    edge = np.concatenate([np.ones((300, 1)), y[:, 1:] / length[:, None]], 1)
    want = np.where(outside[:, None] > 0, (y[:, :1] + length[:, None]) / 2 * edge, 0.0)
    np.testing.assert_allclose(found.x / size[:, None], want / size[:, None], atol=1e-13)
    slope = jax.jit(jax.vmap(jax.jacrev(lambda y: nearest(y).x)))(jnp.asarray(y))[:, 0, 0]
    clear = np.abs(outside) > 1e-7  # nearer to the apex than 1.5e-8 a solution counts as at it
    np.testing.assert_allclose(slope[clear], np.where(outside > 0, 0.5, 0.0)[clear], atol=1e-10)


def test_derivative_at_a_kink_is_the_mean_of_both_sides():
    """Rows that are active with a multiplier of zero: the mean of the solutions with and without them, by NumPy."""
    rng = np.random.default_rng(2)
    root, x, rows = rng.normal(size=(4, 4)), rng.normal(size=4), rng.normal(size=(2, 4))
    Q = root @ root.T + np.eye(4)
    inverse = np.linalg.inv(Q)
    for count in (1, 2):
        G = rows[:count]
        solve = lambda q, G=G: jd.contact.solve_qp(Q, q, G, G @ x).x  # noqa: E731
        held = inverse - inverse @ G.T @ np.linalg.solve(G @ inverse @ G.T, G @ inverse)
        for derivative in (jax.jacfwd, jax.jacrev):
            assert_close(derivative(solve)(jnp.asarray(-Q @ x)), -(inverse + held) / 2, 1e-10)
    cone = jax.jacrev(lambda y: jd.contact.solve_qp(jnp.eye(3), -y, cones=(-jnp.eye(3)[None], jnp.zeros((1, 3)))).x)
    np.testing.assert_allclose(cone(jnp.array([1.0, 0.6, 0.8]))[0, 0], 0.75, rtol=1e-10)


def test_derivatives_of_a_program_without_solution_are_nan():
    """Infeasible rows in a batch; the other element keeps its derivative."""

    def solve(q):
        return jd.contact.solve_qp(jnp.eye(1), q[:1], jnp.array([[1.0], [-1.0]]), jnp.stack([q[1], 0.0 * q[1]])).x[0]

    slopes = jax.jit(jax.vmap(jax.grad(solve)))(jnp.array([[-0.5, 1.0], [-0.5, -1.0]]))
    np.testing.assert_allclose(slopes[0], [-1.0, 0.0], atol=1e-10)
    assert np.isnan(slopes[1]).all()
