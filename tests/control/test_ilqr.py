"""Iterated LQR: Riccati's equation, quadratic programs with bounds, known swing-ups, mechanisms, batches, refusals."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick
from scipy.optimize import lsq_linear

import jaxdyn as jd
from jaxdyn import scenes
from jaxdyn.contact.qp import minimize_in_box

RNG = np.random.default_rng(4)
A, B = np.eye(3) + 0.2 * RNG.normal(size=(3, 3)), RNG.normal(size=(3, 2))
Q, R, QF, S = np.diag([1.0, 2.0, 0.5]), np.diag([0.1, 0.2]), 5 * np.eye(3), 0.1 * RNG.normal(size=(2, 3))


def linear_step(x, u):
    return jnp.asarray(A) @ x + jnp.asarray(B) @ u


def quadratic(x, u, k):
    return 0.5 * (x @ jnp.asarray(Q) @ x + u @ jnp.asarray(R) @ u) + u @ jnp.asarray(S) @ x


def final(x):
    return 0.5 * x @ jnp.asarray(QF) @ x


@pytest.mark.long
def test_one_iteration_is_the_riccati_equation():
    n, x0 = 15, np.array([1.0, -2.0, 0.5])
    P, gains = QF, []
    for _ in range(n):
        K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + S)
        P = Q + A.T @ P @ A + (A.T @ P @ B + S.T) @ K
        gains.insert(0, K)
    plan = quick(lambda x0: jd.control.ilqr(linear_step, quadratic, final, x0, jnp.zeros((n, 2)), iterations=1))(
        jnp.asarray(x0)
    )
    assert_close(plan.gains, np.stack(gains), 1e-10)
    assert_close(plan.cost, 0.5 * x0 @ P @ x0, 1e-10)
    x, us = x0, []
    for K in gains:
        us.append(K @ x)
        x = A @ x + B @ us[-1]
    assert_close(plan.us, np.stack(us), 1e-10)
    assert plan.result == jd.RESULTS.nonlinear_max_steps_reached
    full = quick(lambda x0: jd.control.ilqr(linear_step, quadratic, final, x0, jnp.zeros((n, 2))))(jnp.asarray(x0))
    assert full.result == jd.RESULTS.successful and int(full.iterations) == 2


@pytest.mark.long
def test_limits_are_those_of_a_quadratic_program():
    """A double integrator with bounded force: least squares with bounds in all controls, by SciPy."""
    dt, n, x0 = 0.1, 30, np.array([3.0, 0.0])
    F, G = np.array([[1, dt], [0, 1]]), np.array([[0.5 * dt**2], [dt]])
    rows, power = [], np.eye(2)
    for _ in range(n):
        rows.insert(0, power @ G)
        power = F @ power
    # sum of 0.01 u^2 + 10 |x_n|^2
    matrix = np.concatenate([0.1 * np.eye(n), np.sqrt(10) * np.concatenate(rows, 1)])
    want = lsq_linear(matrix, np.concatenate([np.zeros(n), -np.sqrt(10) * power @ x0]), (-1.5, 1.0), tol=1e-14)
    plan = jd.control.ilqr(
        lambda x, u: jnp.asarray(F) @ x + jnp.asarray(G) @ u,
        lambda x, u, k: 0.01 * u @ u,
        lambda x: 10 * x @ x,
        jnp.asarray(x0),
        jnp.zeros((n, 1)),
        limits=(-1.5, jnp.array([1.0])),
        tol=1e-14,
    )
    assert plan.result == jd.RESULTS.successful
    np.testing.assert_allclose(plan.us[:, 0], want.x, atol=1e-5)  # SciPy's own tolerance on its optimality
    assert np.isclose(plan.us, -1.5).any() and np.isclose(plan.us, 1.0).any()
    assert np.all((plan.gains == 0).all((1, 2))[np.isclose(plan.us[:, 0], -1.5)])


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_boxes_at_condition_numbers_up_to_1e8(n):
    """The least value of all 3^n sets of bounds, by NumPy, and the flag; no end of NaN."""
    rng = np.random.default_rng(n)
    count, sizes = 60, np.logspace(0, 8, 5)
    eigenvalues = np.concatenate([np.tile(np.logspace(0, -np.log10(size), n), (count, 1)) for size in sizes])
    Q = np.linalg.qr(rng.normal(size=(len(eigenvalues), n, n)))[0]
    H = Q @ (eigenvalues[:, :, None] * Q.transpose(0, 2, 1))
    H = (H + H.transpose(0, 2, 1)) / 2
    g, lower, upper = rng.normal(size=(len(H), n)), *rng.uniform([[-2], [0]], [[0], [2]], (len(H), 2, n)).swapaxes(0, 1)
    found = quick(jax.vmap(minimize_in_box))(H, g, lower, upper)
    assert bool(found.converged.all())
    x = np.asarray(found.x)
    assert np.all((x >= lower) & (x <= upper))
    values = 0.5 * np.einsum("ni,nij,nj->n", x, H, x) + np.sum(g * x, 1)
    least = np.full(len(H), np.inf)
    for bounds in itertools.product((None, 0, 1), repeat=n):
        free = [i for i in range(n) if bounds[i] is None]
        y = np.stack([np.zeros(len(H)) if b is None else (lower, upper)[b][:, i] for i, b in enumerate(bounds)], 1)
        if free:
            right = -(g + np.einsum("nij,nj->ni", H, y))[:, free]
            y[:, free] = np.linalg.solve(H[:, free][:, :, free], right[..., None])[..., 0]
        inside = np.all((y >= lower - 1e-12) & (y <= upper + 1e-12), 1)
        value = 0.5 * np.einsum("ni,nij,nj->n", y, H, y) + np.sum(g * y, 1)
        least = np.where(inside, np.minimum(least, value), least)
    # Solutions by NumPy may pass a bound by 1e-12, hence lie lower by as much.
    np.testing.assert_allclose(values, least, rtol=1e-10, atol=1e-11)


def test_boxes_without_a_minimum_have_a_flag():
    for H, g in (
        (-jnp.eye(2), jnp.ones(2)),
        (jnp.eye(2) * jnp.nan, jnp.ones(2)),
        (jnp.eye(2), jnp.array([1.0, jnp.nan])),
    ):
        assert not bool(minimize_in_box(H, g, -jnp.ones(2), jnp.ones(2)).converged)


def cart_pole():
    builder = jd.ModelBuilder("cart-pole")
    builder.add_body("cart", None, "prismatic", jd.inertia.box(1.0, (0.2, 0.2, 0.1)), axis=(1, 0, 0))
    builder.add_body("pole", "cart", "continuous", (0.2, (0, 0, -0.5), (0.01, 0.01, 0.0)), axis=(0, 1, 0))
    return builder.build()


def controlled(scene, dt, motors):
    """The stepper, with torques of motors alone."""
    step, columns = jd.stepper(scene, dt), jnp.eye(scene.nv)[:, np.asarray(motors)]
    return lambda x, u: step(x, columns @ u)


@pytest.mark.long
@pytest.mark.parametrize("second_order", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_cart_pole_swings_up(second_order):
    """From hanging to standing within the limits of the force; the plan is a motion of the model."""
    model = cart_pole()
    step = controlled(model, 0.04, [0])

    def upright(x):
        q, v = x
        return 200 * (1 + jnp.cos(q[1])) + 10 * q[0] ** 2 + 10 * v @ v

    @jax.jit
    def solve(q0):
        return jd.control.ilqr(
            step,
            lambda x, u, k: 0.01 * u @ u + 0.01 * upright(x),
            upright,
            (q0, jnp.zeros(2)),
            0.1 * jnp.ones((60, 1)),
            limits=(-15.0, 15.0),
            iterations=200,
            second_order=second_order,
        )

    plan = solve(jnp.zeros(2))
    q, v = plan.xs
    assert plan.result == jd.RESULTS.successful
    assert abs(np.cos(q[-1, 1]) + 1) < 1e-2 and np.abs(v[-1]).max() < 0.3
    assert np.abs(plan.us).max() <= 15.0 and np.isclose(np.abs(plan.us), 15.0).any()
    assert np.all(np.diff(plan.costs) <= 0)
    x = (jnp.zeros(2), jnp.zeros(2))
    for u in plan.us:
        x = step(x, u)
    assert_close(x[0], q[-1], 1e-8)


def pendulum(x, u):
    return jnp.stack([x[0] + 0.05 * x[1], x[1] + 0.05 * (u[0] - 5 * jnp.sin(x[0]))])


@jax.jit
def bring_to_rest(x0, us):
    return jd.control.ilqr(
        pendulum, lambda x, u, k: 0.05 * (x @ x + 0.1 * u @ u), lambda x: 5 * x @ x, x0, us, limits=(-3.0, 3.0)
    )


def test_samples_of_a_batch_are_solutions_alone():
    """Whatever the others need."""
    starts, us = jnp.array([[1.0, 0.0], [2.5, -1.0], [0.01, 0.02]]), jnp.zeros((25, 1))
    batch = jax.vmap(bring_to_rest, (0, None))(starts, us)
    assert batch.success.all() and len(set(batch.iterations.tolist())) > 1
    for start, plan, cost in zip(starts, batch.us, batch.cost, strict=True):
        one = bring_to_rest(start, us)
        np.testing.assert_allclose(plan, one.us, atol=1e-6)  # kernels of one sample and of a batch round differently
        np.testing.assert_allclose(cost, one.cost, rtol=1e-10)


@pytest.mark.long
def test_four_bar_by_its_crank():
    """The loop stays closed along the plan, and the crank comes to rest at its target."""
    scene, (q0, _) = scenes.four_bar(), scenes.four_bar.start()
    step = controlled(scene, 0.05, [0])
    plan = jax.jit(
        lambda q0: jd.control.ilqr(
            step,
            lambda x, u, k: 1e-4 * u @ u,
            lambda x: 100 * (x[0][0] - 1.5) ** 2 + x[1] @ x[1],
            (q0, jnp.zeros(3)),
            jnp.zeros((20, 1)),
            iterations=60,
        )
    )(q0)
    q, v = plan.xs
    assert abs(q[-1, 0] - 1.5) < 0.02 and np.abs(v[-1]).max() < 0.3
    assert np.abs(jax.vmap(lambda q: jd.constraints.position_residual(scene, q))(q)).max() < 1e-10


@pytest.mark.long
def test_warm_start_needs_fewer_iterations():
    """The next problem of a controller: the state a step on, the controls shifted."""
    x0, us, solve = jnp.array([1.0, 0.0]), jnp.zeros((25, 1)), bring_to_rest
    first = solve(x0, us)
    after = pendulum(x0, first.us[0])
    warm, cold = solve(after, jnp.concatenate([first.us[1:], first.us[-1:]])), solve(after, us)
    assert int(warm.iterations) < int(cold.iterations)
    assert_close(warm.cost, cold.cost, 1e-6)
    # After a blow the feedback of the plan begins nearer than its controls.
    hit = after + jnp.array([0.2, 0.5])
    starts = [solve(hit, guess).costs[0] for guess in (first.shift().us, first.shift())]
    assert starts[1] < starts[0]
    with pytest.raises(ValueError, match="a plan with"):
        jd.control.ilqr(lambda x, u: x, lambda x, u, k: u @ u, lambda x: x @ x, jnp.zeros(3), first)


@pytest.mark.long
def test_refusals_and_codes():
    x0, us = jnp.zeros(3), jnp.zeros((4, 2))
    for match, call in (
        ("us has shape", lambda: jd.control.ilqr(linear_step, quadratic, final, x0, us[:, 0])),
        ("iterations is 0", lambda: jd.control.ilqr(linear_step, quadratic, final, x0, us, iterations=0)),
        ("tol is 2", lambda: jd.control.ilqr(linear_step, quadratic, final, x0, us, tol=2.0)),
        ("cost takes", lambda: jd.control.ilqr(linear_step, lambda x, u: 0.0, final, x0, us)),
        ("cost returned shape", lambda: jd.control.ilqr(linear_step, lambda x, u, k: x, final, x0, us)),
        ("step returned shapes", lambda: jd.control.ilqr(lambda x, u: x[:2], quadratic, final, x0, us)),
        ("step returned PyTreeDef", lambda: jd.control.ilqr(lambda x, u: (x, u), quadratic, final, x0, us)),
        ("to be below", lambda: jd.control.ilqr(linear_step, quadratic, final, x0, us, limits=(1.0, -1.0))),
        ("regularization is -1", lambda: jd.control.ilqr(linear_step, quadratic, final, x0, us, regularization=-1.0)),
    ):
        with pytest.raises(ValueError, match=match):
            call()
    bad = jd.control.ilqr(linear_step, quadratic, lambda x: jnp.log(x[0]), x0 - 1.0, us)
    assert bad.result == jd.RESULTS.nonfinite
    # No curvature in u and no minimum: damping grows, the cost falls as long as it is asked to.
    endless = jd.control.ilqr(
        lambda x, u: x + u, lambda x, u, k: -jnp.sum(u), lambda x: 0.0 * x[0], jnp.zeros(2), us, iterations=5
    )
    assert endless.result == jd.RESULTS.nonlinear_max_steps_reached and endless.cost < 0
    # A derivative of the wrong sign: no step along the search direction reduces the cost, however large the damping.
    reversed_slope = jax.custom_jvp(lambda x: x)
    reversed_slope.defjvp(lambda primals, tangents: (primals[0], -tangents[0]))
    wrong = jd.control.ilqr(
        lambda x, u: x + u,
        lambda x, u, k: 0.1 * (u @ u),
        lambda x: jnp.sum((reversed_slope(x) - 1.0) ** 2),
        jnp.zeros(2),
        us,
    )
    assert wrong.result == jd.RESULTS.no_descent
