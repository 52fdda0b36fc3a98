"""Drifted states put back onto their constraints: in kernels and in plain mode, and in fixed steps for derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.flatten_util import ravel_pytree
from motion_helpers import largest_residuals
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from benchmarks.report_cases import test_set
from jaxdyn import scenes
from jaxdyn.constraints.base import holonomic_rows, layout
from jaxdyn.constraints.dynamics import correction
from jaxdyn.constraints.projection import project_state, project_step
from jaxdyn.systems.system import displace, retract

# With the slow tests also without kernels.
BOTH = pytest.mark.parametrize("mode", ["auto", pytest.param("plain", marks=pytest.mark.slow)], indirect=True)
MORE = [pytest.param(name, marks=pytest.mark.slow) for name in ("andrews", "rolling_coin")]
DRIFTS = (0.0, 1e-12, 1e-9, 1e-6, 1e-4)


def drifted(name, **parameters):
    """The scene, and states off its constraints by about `DRIFTS`."""
    scene = getattr(scenes, name)
    q, v = (jnp.asarray(x) for x in scene.start(**parameters))
    scene = scene(**parameters)
    rng = np.random.default_rng(2)
    off = jnp.asarray(rng.normal(size=(2, len(DRIFTS), scene.nv))) * jnp.asarray(DRIFTS)[None, :, None]
    return scene, jax.vmap(lambda e: displace(scene.system, q, e))(off[0]), v[None] + off[1]


def in_fixed_steps(rank_tol, scene, q, v, t):
    """The projection as four steps of a fixed matrix, one after the other; its derivatives are those of the steps."""
    q = retract(scene.system, q)
    holonomic = holonomic_rows(layout(scene))
    B = correction(scene, q, t, rank_tol, holonomic=False)
    B_holonomic = B if holonomic.size in (0, B.shape[1]) else correction(scene, q, t, rank_tol, holonomic=True)
    if holonomic.size:

        def move(place, _):
            step = jnp.matmul(B_holonomic, jd.constraints.position_residual(scene, place, t))
            return displace(scene.system, place, -step), None

        moved, _ = lax.scan(move, q, None, length=4)
        before, after = (jd.constraints.position_residual(scene, x, t) for x in (q, moved))
        better = jnp.max(jnp.abs(after)) <= jnp.max(jnp.abs(before))
        q = jnp.where(better, retract(scene.system, moved), q)

    def slow(v, _):
        return v - jnp.matmul(B, jd.constraints.velocity_residual(scene, q, v, t)), None

    projected, _ = lax.scan(slow, v, None, length=4)
    before, after = (jd.constraints.velocity_residual(scene, q, x, t) for x in (v, projected))
    better = jnp.max(jnp.abs(after)) <= jnp.max(jnp.abs(before))
    return q, jnp.where(better, projected, v)


@pytest.mark.long
@pytest.mark.parametrize(
    "name, parameters",
    [
        ("windows", {"count": 2}),
        pytest.param("rolling_coin", {}, marks=pytest.mark.slow),
        pytest.param("bennett", {}, marks=pytest.mark.slow),
    ],
)
def test_states_come_back_by_the_least_change(name, parameters):
    scene, q, v = drifted(name, **parameters)
    zero = jnp.asarray(0.0)
    rank_tol = 1e-4 if name == "bennett" else None  # its rows depend on each other only where the loop is closed

    def both(q, v):
        computed = project_state(scene, q, v, zero, rank_tol)
        fixed = in_fixed_steps(rank_tol, scene, q, v, zero)
        M, A = jd.mass_matrix(scene.system, computed[0]), jd.constraint_jacobian(scene, computed[0])
        return computed, fixed, largest_residuals(scene, *computed), (M, A)

    (place, speed), fixed, left, (M, A) = quick(jax.vmap(both))(q, v)
    assert float(jnp.max(left)) < 1e-14 * (1 + float(jnp.max(jnp.abs(speed))))
    for k, drift in enumerate(DRIFTS):
        # A second round factors the rows anew where the first one ended, in a metric that differs by the size of the change:
        # what it removes is of second order.
        assert_close(place[k], fixed[0][k], 1e-13 + 1e-3 * drift**2)
        assert_close(speed[k], fixed[1][k], 1e-13 + 1e-3 * drift**2)
        # v changed by M^-1 A^T x, to first order in the drift of q, where the metric is taken.
        force = np.asarray(M[k]) @ np.asarray(speed[k] - v[k])
        rows = np.asarray(A[k]).T
        across = force - rows @ np.linalg.lstsq(rows, force, rcond=1e-6)[0]
        assert np.linalg.norm(across) <= 20 * drift * max(np.linalg.norm(force), 1e-12) + 1e-13


@pytest.mark.long
@BOTH
@pytest.mark.parametrize(
    "name, parameters", [("windows", {"count": 2}), pytest.param("rolling_coin", {}, marks=pytest.mark.slow)]
)
def test_errors_of_a_step_lose_what_the_projection_removes(name, parameters, mode):
    """e - M^-1 A^T (A M^-1 A^T)^+ A e in numpy, with rows on velocities alone for v."""
    scene, (q, v) = getattr(scenes, name)(**parameters), getattr(scenes, name).start(**parameters)
    rng = np.random.default_rng(7)
    errors = tuple(jnp.asarray(rng.normal(size=(3, scene.nv))) for _ in "qv")
    zero = jnp.asarray(0.0)

    @quick
    def both(errors):
        def step(*errors):
            return project_step(scene, q, v, zero, errors)

        by_derivative = jax.jvp(lambda q: jax.vmap(lambda *e: project_step(scene, q, v, zero, e))(*errors), (q,), (q,))
        return (
            jax.vmap(step)(*errors),
            by_derivative,
            (jd.mass_matrix(scene.system, q), jd.constraint_jacobian(scene, q)),
        )

    computed, by_derivative, (M, A) = both(errors)
    M, A = np.asarray(M), np.asarray(A)
    held = holonomic_rows(layout(scene))
    for place, (error, rows) in enumerate(zip(errors, (A[held], A), strict=True)):
        lift = np.linalg.solve(M, rows.T)
        want = np.asarray(error) - np.asarray(error) @ rows.T @ np.linalg.pinv(rows @ lift) @ lift.T
        assert_close(computed[2][place], want, 1e-12)
        assert_close(by_derivative[0][2][place], want, 1e-12)
        assert not np.any(by_derivative[1][2][place])  # step lengths are not differentiated
    assert_close(computed[0], jnp.stack([q] * 3), 1e-14)


@pytest.mark.long
@BOTH
def test_what_a_projection_leaves_open_is_an_error(mode):
    """States so far off that all steps are not enough, or one would lead away; beside them one that is closed."""
    scene, (q, v) = scenes.windows(count=1), scenes.windows.start(count=1)
    off = jnp.asarray([1e-3, 1.9, 2.9])[:, None] * jnp.asarray([[1.0, -0.5, 0.8]])
    none = jnp.zeros_like(q)

    def one(off):
        q1, v1, (error, _), _ = project_step(scene, q + off, v, jnp.asarray(0.0), (none, none))
        return jnp.max(jnp.abs(error)), largest_residuals(scene, q1, v1)[0], jnp.max(jnp.abs(q1 - q - off))

    error, left, moved = map(np.asarray, jax.jit(jax.vmap(one))(off))
    assert left[0] < 1e-15
    assert moved[0] > 1e-4
    assert (left[1:] > 1e-3).all()
    assert error[0] < 1e-12
    assert (error > 0.3 * left)[1:].all()


@pytest.mark.long
@BOTH
def test_a_singular_sample_of_a_batch_is_projected_by_its_rank(mode):
    scene, q, v = drifted("windows", count=2)
    zero = jnp.asarray(0.0)
    program = jax.jit(jax.vmap(lambda q, v: project_state(scene, q, v, zero)))
    matrices = jax.jit(jax.vmap(lambda q, v: in_fixed_steps(None, scene, q, v, zero)))
    # Uprights and couplers in one line: the rows of the windows lose rank.
    flat = jnp.asarray([-np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, -np.pi / 2])
    for states in (q, q.at[1].set(flat)):
        for x, y in zip(program(states, v), matrices(states, v), strict=True):
            assert_close(x, y, 1e-12)


@pytest.mark.long
@pytest.mark.parametrize("name", ["car_axis", "rolling_disk", "chaplygin_sleigh", *MORE])
@pytest.mark.parametrize("off", [1e-3, *(pytest.param(x, marks=pytest.mark.slow) for x in (1e-6, 0.0))])
def test_kernels_project_as_matrices_do(name, off):
    """On the constraints to rounding, and as close to the start of the projection as in plain mode."""
    made = getattr(scenes, name, None) or getattr(test_set, name)
    scene, (q, v) = made(), (jnp.asarray(x, float) for x in made.start())
    q, v = (x + off * jnp.cos(jnp.arange(float(x.size)) + k) for k, x in enumerate((q, v)))
    error = off * jnp.sin(jnp.arange(float(scene.nv)))
    state = q, v, jnp.asarray(0.0), (error, 2 * error)
    run = jax.jit(partial(project_step, scene))
    assert "jaxdyn_kernel" in run.lower(*state).as_text()
    place, speed, errors, _ = run(*state)
    with jd.compilation("plain"):
        wanted = quick(partial(project_step, scene))(*state)[:3]
    assert float(jnp.max(jnp.abs(jd.constraints.velocity_residual(scene, place, speed, state[2])))) < 1e-11
    if holonomic_rows(layout(scene)).size:
        assert float(jnp.max(jnp.abs(jd.constraints.position_residual(scene, place, state[2])))) < 1e-14
    # A round factors the rows anew where it starts, so the least change is one in another metric by the size of the change.
    size = 20 * off**2 * float(1 + jnp.abs(v).max())
    for x, y in zip(jax.tree.leaves((place, speed, errors)), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-13 * float(1 + jnp.abs(y).max()) + size, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("name, of_scene", [("four_bar", True), ("rolling_coin", False)])
def test_derivatives_of_first_and_second_order_are_limits_of_differences(name, of_scene, mode):
    """Along a line through lengths, inertias, q, v and time, 1e-4 away: forward, reverse, and each over the other."""
    scene, q, v = drifted(name)
    rng = np.random.default_rng(5)
    numbers, structure = ravel_pytree((scene, q[-1], v[-1], jnp.asarray(0.3)))
    direction = jnp.asarray(rng.normal(size=numbers.shape)) * jnp.where(numbers == 0, 0.0, 1.0)
    if not of_scene:  # whose frames a line would leave
        direction = direction.at[: ravel_pytree(scene)[0].size].set(0.0)
    weights = jnp.asarray(rng.normal(size=q[-1].size + v[-1].size))

    def value(numbers):
        scene, q, v, t = structure(numbers)
        return jnp.vdot(weights, jnp.concatenate(project_state(scene, q, v, t)))

    def along(function):
        return lambda h: jax.jvp(function, (numbers + h * direction,), (direction,))[1]

    @quick
    def program(steps):
        moved = jax.vmap(lambda h: (value(numbers + h * direction), along(value)(h)))(steps)
        second = jax.jvp(along(value), (0.0,), (1.0,))[1]
        reverse = jnp.vdot(jax.grad(value)(numbers), direction)
        over_forward = jax.grad(along(value))(0.0)
        return moved, reverse, second, over_forward

    h = 1e-5
    (values, slopes), reverse, second, over_forward = program(jnp.asarray([-2.0, -1.0, 0.0, 1.0, 2.0]) * h)
    weights_of = np.asarray([1.0, -8.0, 0.0, 8.0, -1.0]) / (12 * h)
    size = float(jnp.linalg.norm(direction))
    # Differences have 1e-16 / h of rounding, and h^4 of the fifth derivative.
    np.testing.assert_allclose(slopes[2], weights_of @ np.asarray(values), rtol=1e-8, atol=1e-9 * size)
    np.testing.assert_allclose(reverse, slopes[2], rtol=1e-11)
    np.testing.assert_allclose(second, weights_of @ np.asarray(slopes), rtol=1e-7, atol=1e-8 * size)
    np.testing.assert_allclose(over_forward, second, rtol=1e-10)


@pytest.mark.slow
@BOTH
def test_rounding_that_a_projection_leaves_is_no_error(mode):
    """Coins whose slips are rounding, in float32: with that as an error no step of an integrator would be short enough."""
    scene, (q, v) = jax.tree.map(lambda x: x.astype(jnp.float32), (scenes.rolling_coin(), scenes.rolling_coin.start()))
    none, speeds = jnp.zeros_like(v), jnp.linspace(0.5, 2.0, 64, dtype=jnp.float32)

    def one(speed):
        return project_step(scene, q, speed * v, jnp.zeros((), q.dtype), (none, none))[2]

    for error in jax.jit(jax.vmap(one))(speeds):
        assert error.dtype == jnp.float32
        assert not np.any(error)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rolling_coin", "ball_on_incline"])
def test_float32_rolls_to_its_end(name):
    """Coins and balls at 64 speeds with the default tolerances: all reach the end, with the energy of the start."""
    named = getattr(scenes, name)
    scene, (q, v) = jax.tree.map(lambda x: x.astype(jnp.float32), (named(), named.start()))
    ts = jnp.asarray([0.0, 1.0, 3.0], jnp.float32)

    def motion(speed):
        solution = jd.simulate(scene, q, speed * v, ts, outputs=("energy",), throw=False)
        return solution, jd.kinetic_energy(scene.system, solution.q[-1], solution.v[-1])

    motions, kinetic = jax.jit(jax.vmap(motion))(jnp.linspace(0.5, 2.0, 64, dtype=jnp.float32))
    assert np.all(motions.success)
    # Some hundred steps, each of whose errors is below ten times the rounding error.
    drift = np.abs(np.asarray(motions.energy) - np.asarray(motions.energy)[:, :1]).max(1)
    np.testing.assert_array_less(drift, 1e-4 * np.asarray(kinetic))
