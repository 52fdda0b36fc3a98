"""Inverse dynamics under constraints: the inverse of the forward dynamics, virtual work, dense least squares, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linearisation import admissible
from mechanisms import delta, delta_hips, stewart
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn import scenes


def four_bar():
    scene = scenes.four_bar()
    scene = jd.Scene(
        scene.system,
        scene.constraints,
        (jd.forces.JointDamping(0.3), jd.forces.JointSpring(jnp.array([1.0, 0.0, 2.0]))),
    )
    return scene, scenes.four_bar.start()[0], ["1"], None


def platform():
    scene, q = stewart()
    return scene, jd.assemble(scene, q).q, [f"leg{i}" for i in range(6)], None


def delta_robot():
    scene, q = delta()
    return scene, jd.assemble(scene, q, hold={"x": 0.05, "y": -0.03}).q, [f"hip{i}" for i in range(3)], None


def redundant():
    """Three motors and two degrees of freedom; the motion is given by two of them."""
    return (
        scenes.parallel_manipulator(gravity=(0.0, -9.81, 0.0)),
        scenes.parallel_manipulator.start()[0],
        [0, 2, 4],
        [0, 2],
    )


def overconstrained():
    """All five rows of a hinge in space, of which two are independent."""
    return scenes.four_bar(in_plane=False), scenes.four_bar.start()[0], [0], None


def rolling():
    scene = scenes.differential_drive()
    q, _ = scenes.differential_drive.start()
    return scene, q, list(range(scene.nv))[-2:], None


CASES = [four_bar, platform, delta_robot, redundant, overconstrained, rolling]


@pytest.mark.long
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=pytest.mark.slow if case in (platform, delta_robot) else (), id=case.__name__)
        for case in CASES
    ],
)
def test_inverse_of_constrained_dynamics(case):
    """The torques give back the acceleration and the multipliers, which satisfy the equations of motion."""
    scene, q, motors, independent = case()
    rng = np.random.default_rng(3)
    count = len(motors if independent is None else independent)
    speed, rate = jnp.asarray(rng.normal(size=count)), jnp.asarray(rng.normal(size=count))

    @quick
    def compute(scene, q, speed, rate):
        inverse = jd.constrained_inverse_dynamics(scene, q, speed, rate, motors=motors, independent=independent)
        v = inverse.velocity
        forward = jd.constrained_dynamics(scene, q, v, inverse.tau)
        force = scene.applied_force(q, v)
        left = jd.inverse_dynamics(scene.system, q, v, inverse.acceleration) - (0 if force is None else force)
        left = left - jd.constraint_jacobian(scene, q).T @ inverse.multipliers - inverse.tau
        return inverse, forward, jd.constraints.velocity_residual(scene, q, v), left

    inverse, forward, slip, left = compute(scene, q, speed, rate)
    assert inverse.result == jd.RESULTS.successful
    size = float(jnp.max(jnp.abs(inverse.tau)))
    places = [scene.system.v_index(name) for name in motors] if isinstance(motors[0], str) else motors
    chosen = places if independent is None else independent
    np.testing.assert_array_equal(inverse.tau[jnp.asarray(places)], inverse.torques)
    assert_close(inverse.velocity[jnp.asarray(chosen)], speed, 1e-12)
    assert_close(inverse.acceleration[jnp.asarray(chosen)], rate, 1e-12)
    assert np.abs(slip).max() < 1e-12
    assert np.abs(left).max() < 1e-12 * max(size, 1.0) * 10
    assert_close(forward.acceleration, inverse.acceleration, 1e-12)
    assert_close(forward.multipliers, inverse.multipliers, 1e-12)


@pytest.mark.long
def test_torques_of_a_delta_robot_are_those_of_virtual_work():
    """J^T tau = power of gravity and inertia, by differences of the closed form of the hips along a straight path."""
    scene, guess = delta()
    point, velocity = jnp.array([0.05, -0.03, -0.65]), jnp.array([0.3, 0.2, -0.1])
    q = jd.assemble(scene, guess, hold=dict(zip("xyz", np.asarray(point), strict=True))).q
    names = [f"hip{i}" for i in range(3)]
    hips = np.asarray(q)[[scene.system.v_index(name) for name in names]]
    np.testing.assert_allclose(hips, delta_hips(point), atol=1e-12)
    path = lambda s: delta_hips(point + s * velocity)  # noqa: E731
    rate = jax.jacfwd(path)
    speed, acceleration = rate(0.0), jax.jacfwd(rate)(0.0)
    inverse = jd.constrained_inverse_dynamics(scene, q, speed, acceleration, motors=names)
    place = jnp.asarray([scene.system.v_index(name) for name in "xyz"])
    assert_close(inverse.velocity[place], velocity, 1e-10)
    np.testing.assert_allclose(inverse.acceleration[place], 0.0, atol=1e-10)
    # For any admissible velocity u: u . tau = u . (M a + h), by the Jacobian of the closed form.
    left = jd.inverse_dynamics(scene.system, q, inverse.velocity, inverse.acceleration)
    for u in np.eye(3):
        whole = admissible(scene, q, place, jnp.asarray(u))
        along = jax.jvp(delta_hips, (point,), (jnp.asarray(u),))[1]
        np.testing.assert_allclose(along @ inverse.torques, whole @ left, atol=1e-10)


@pytest.mark.long
def test_more_motors_than_degrees_of_freedom():
    """The least weighted sum of squares, by a dense solve of the saddle point; equal weights by default."""
    scene, q, motors, independent = redundant()
    rate, weights = jnp.array([0.4, -0.7]), np.array([1.0, 3.0, 0.5])
    given = {"motors": motors, "independent": independent}
    inverse = jd.constrained_inverse_dynamics(scene, q, [0.2, 0.5], rate, **given, weights=weights)
    left = np.asarray(jd.inverse_dynamics(scene.system, q, inverse.velocity, inverse.acceleration))
    N = np.linalg.svd(np.asarray(jd.constraint_jacobian(scene, q)))[2][4:].T
    B = N.T @ np.eye(6)[:, motors]
    W = np.diag(1 / weights)
    want = W @ B.T @ np.linalg.solve(B @ W @ B.T, N.T @ left)
    assert_close(inverse.torques, want, 1e-11)
    # The values of all three motors, which agree with one motion, and the matrix of the motors, give the same.
    plain = jd.constrained_inverse_dynamics(scene, q, inverse.velocity, rate, **given)
    every = jd.constrained_inverse_dynamics(
        scene, q, inverse.velocity, plain.acceleration[jnp.array(motors)], motors=motors
    )
    by_matrix = jd.constrained_inverse_dynamics(
        scene, q, inverse.velocity, rate, motors=np.eye(6)[:, motors], independent=independent
    )
    for other in (every, by_matrix):
        assert_close(other.torques, plain.torques, 1e-10)
    assert np.sum(plain.torques**2) < np.sum(inverse.torques**2)


def test_without_constraints_it_is_inverse_dynamics():
    model = jd.robots.iiwa()
    rng = np.random.default_rng(5)
    q, v, a = jnp.asarray(rng.normal(size=(3, 7)))
    inverse = jd.constrained_inverse_dynamics(model, q, v, a)
    assert_close(inverse.torques, jd.inverse_dynamics(model, q, v, a), 1e-12)
    assert inverse.multipliers.shape == (0,) and inverse.q_dot.shape == (7,)


@pytest.mark.long
def test_derivatives_and_batches():
    """Forward and reverse mode against differences, in the state, the accelerations and the masses; a batch is the loop."""
    *_, motors, independent = redundant()

    def torques(mass, angle, rate):
        scene = scenes.parallel_manipulator(mass=mass, gravity=(0.0, -9.81, 0.0))
        q, v = scenes.parallel_manipulator.start(point=jnp.stack([angle, 0.05]), velocity=(0.3, -0.2))
        return jd.constrained_inverse_dynamics(scene, q, v, rate, motors=motors, independent=independent).torques

    x = jnp.array(1.3), jnp.array(0.1), jnp.array([0.4, -0.7])
    forward = quick(jax.jacfwd(torques, (0, 1, 2)))(*x)
    reverse = quick(jax.jacrev(torques, (0, 1, 2)))(*x)
    value = quick(torques)
    for k, (one, other) in enumerate(zip(forward, reverse, strict=True)):
        assert_close(one, other, 1e-10)
        step = jnp.ones_like(x[k]) * 1e-5
        plus, minus = (value(*x[:k], x[k] + s * step, *x[k + 1 :]) for s in (1, -1))
        slope = one @ jnp.ones_like(x[k]) if x[k].ndim else one
        np.testing.assert_allclose((plus - minus) / 2e-5, slope, rtol=1e-7, atol=1e-7)  # central differences
        assert np.abs(slope).max() > 1e-3
    rates = jnp.asarray(np.random.default_rng(1).normal(size=(5, 2)))
    batch = quick(jax.vmap(lambda rate: torques(*x[:2], rate)))(rates)
    assert_close(batch, np.stack([value(*x[:2], rate) for rate in rates]), 1e-12)


@pytest.mark.long
def test_refusals_and_codes():
    scene, (q, v) = scenes.four_bar(), scenes.four_bar.start()
    model = scene.system
    solve = jd.constrained_inverse_dynamics
    for match, call in (
        ("joint 'crank' is", lambda: solve(scene, q, v, [0.0], motors=["crank"])),
        ("motors is", lambda: solve(scene, q, v, [0.0, 0.0], motors=[0, 0])),
        ("a_independent has shape", lambda: solve(scene, q, v, [0.0, 1.0], motors=[0])),
        ("v has shape", lambda: solve(scene, q, v[:2], [0.0], motors=[0])),
        (r"weights is \[-1.\]", lambda: solve(scene, q, v, [0.0], motors=[0], weights=[-1.0])),
        ("names no velocities", lambda: solve(scene, q, v, [0.0], motors=np.eye(3)[:, :1])),
        ("motors: they cannot", lambda: solve(jd.Scene(model), q, v, jnp.ones(3), motors=[0], independent=[0, 1, 2])),
        ("no motion has", lambda: solve(scene, q, v, jnp.ones(3))),
    ):
        with pytest.raises(ValueError, match=match):
            call()
    # A dead centre: the rocker does not determine the crank where crank and coupler are in one line.
    dead = jd.assemble(scene, jnp.array([0.9, 0.0, 2.0]), hold={"2": 0.0}).q
    with pytest.raises(ValueError, match="for the velocities"):
        solve(scene, dead, jnp.zeros(3), [1.0], motors=["3"])
    with pytest.raises(ValueError, match="do not determine"):
        solve(scene, dead, [0.0], [0.0], motors=["3"])
    codes = quick(lambda a: solve(jd.Scene(model), q, v, a, motors=[0], independent=[0, 1, 2]).result)(jnp.ones(3))
    assert codes == jd.RESULTS.underactuated
    assert solve(scene, dead, jnp.zeros(3), [1.0], motors=["3"], throw=False).result == jd.RESULTS.contradictory_rows


@pytest.mark.long
def test_small_motions_are_judged_by_their_size():
    """A crank and a rocker of a four-bar at rest: values that contradict each other do at any size."""
    scene, (q, v) = scenes.four_bar(gravity=None), scenes.four_bar.start()
    still, ratio = jnp.zeros(3), v[2] / v[0]
    solve = quick(
        lambda rate: jd.constrained_inverse_dynamics(scene, q, still, rate, motors=["1"], independent=["1", "3"]).result
    )
    for size in (1.0, 1e-6, 1e-12):
        assert solve(size * jnp.stack([1.0, ratio])) == jd.RESULTS.successful
        assert solve(size * jnp.stack([1.0, ratio + 1e-6])) == jd.RESULTS.contradictory_rows


def test_all_velocities_have_one_order():
    model = jd.robots.chain(2)
    q, v, a = jnp.array([0.4, -0.7]), jnp.array([0.3, 0.5]), jnp.array([1.0, 2.0])
    with pytest.raises(ValueError, match="in the order"):
        jd.constrained_inverse_dynamics(model, q, v, a, motors=model.joint_names[::-1])


def test_velocities_that_nothing_drives_move_as_forces_make_them():
    """An acrobot whose elbow alone is driven: the acceleration of the other joint is that of forward dynamics."""
    model = jd.robots.chain(2)
    q, v = jnp.array([0.4, -0.7]), jnp.array([0.3, 0.5])
    inverse = jd.constrained_inverse_dynamics(model, q, v, [1.5], motors=[1])
    assert_close(jd.forward_dynamics(model, q, v, inverse.tau), inverse.acceleration, 1e-12)
    assert_close(inverse.acceleration[1], 1.5, 1e-12)
    assert float(inverse.tau[0]) == 0.0


def test_torques_near_a_dead_centre_lose_only_the_digits_of_the_motion():
    """A particle on a circle, pushed along x where x hardly moves: m (theta'' + g cos(theta)) = -F sin(theta)."""
    mass, gravity, rate, angular = 1.7, 9.81, 0.8, 0.25
    particle = jd.ExplicitSystem(lambda q: mass * jnp.eye(2), lambda q, v: jnp.stack([0 * q[0], mass * gravity]), 2)
    scene = jd.Scene(particle, [jd.Holonomic(lambda q, t: 0.5 * (q @ q - 1.0))])
    solve = quick(
        jax.vmap(lambda q, v, a: jd.constrained_inverse_dynamics(scene, q, v, a[None], motors=[0], independent=[0]))
    )
    angles = 10.0 ** -np.arange(1, 7)
    sin, cos = np.sin(angles), np.cos(angles)
    motion = solve(np.stack([cos, sin], 1), rate * np.stack([-sin, cos], 1), -sin * angular - cos * rate**2)
    assert (motion.result == jd.RESULTS.successful).all()
    wanted = mass * (angular + gravity * cos) / -sin
    # theta'' follows from x'' = -sin(theta) theta'' - ..., whose rounding it divides by sin(theta).
    assert (np.abs(motion.torques[:, 0] / wanted - 1) < 10 * np.finfo(float).eps / sin).all()
