"""Laws of motion and force on constraints: errors decay as the gains say, forces follow, and where the laws differ."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick
from refusals import refusals
from scipy.optimize import brentq
from test_control import KD, KP, assert_decays, decayed

import jaxdyn as jd
from jaxdyn import scenes
from jaxdyn.control.errors import hierarchical_acceleration

TS = jnp.linspace(0.0, 2.0, 21)
PRESS = jnp.asarray([2.0])


def first_two(q):
    return q[:2]


def circle(t):
    """A moving target for two coordinates."""
    return jnp.stack([0.3 * jnp.sin(t), 0.4 * jnp.cos(t)])


def start_rate(task, target, q, v):
    """Rate of the error at the start."""
    return jax.jvp(task, (q,), (v,))[1] - jax.jvp(target, (0.0,), (1.0,))[1]


@pytest.fixture(scope="module")
def pendulum():
    """A particle on a sphere below its centre, and a start."""
    return scenes.spherical_pendulum(mass=1.3), *scenes.spherical_pendulum.start(theta=1.0, phi_rate=0.7)


@pytest.fixture(scope="module")
def torques(pendulum):
    """The laws on the sphere as functions of the state: geometric and gauge-invariant, of matched gains p and k."""
    p, k, scene = 2.0, 3.0, pendulum[0]
    hybrid = jd.control.HybridForce(scene, first_two, circle, k * p, p + k, force=PRESS)
    gauge = jd.control.GaugeInvariant(scene, first_two, circle, p, k, force=PRESS)
    return p, quick(lambda q, v, t: (hybrid(q, v, t), gauge(q, v, t)))


@pytest.mark.long
@pytest.mark.parametrize("ki", [pytest.param(None, marks=pytest.mark.slow), 4.0])
def test_motion_and_force_on_a_sphere(pendulum, ki):
    """Errors by the closed form; the force is the wanted one at every moment."""
    scene, q0, v0 = pendulum
    law = jd.control.HybridForce(scene, first_two, circle, KP, KD, force=lambda t: PRESS + jnp.sin(t), ki=ki)
    solution = jd.simulate(scene, q0, v0, TS, control=law, stepsize=0.005, outputs=("multipliers",))
    assert_decays(TS, solution.q[:, :2] - jax.vmap(circle)(TS), start_rate=start_rate(first_two, circle, q0, v0))
    np.testing.assert_allclose(solution.multipliers[:, 0], 2.0 + np.sin(TS), rtol=1e-10)


def test_wrong_mass_shifts_the_force_by_the_stated_error(pendulum):
    """lam - lam_d = -(A M^-1 A^T)^-1 A M^-1 ((M' - M) a + h' - h), which bounds it."""
    plant, q, v = pendulum
    law = jd.control.HybridForce(scenes.spherical_pendulum(mass=1.6), first_two, circle, KP, KD, force=PRESS)

    @quick
    def compute(q, v):
        lam = jd.constrained_dynamics(plant, q, v, law(q, v, 0.3), 0.3).multipliers
        return lam, law.acceleration(q, v, 0.3), jd.constraint_jacobian(plant, q)

    lam, a, A = (np.asarray(x) for x in compute(q, v))
    # M = m 1 and h = (0, 0, m g).
    wrong = 0.3 * a + np.array([0.0, 0.0, 0.3 * 9.81])
    normal = np.linalg.inv(A @ A.T / 1.3) @ A / 1.3
    np.testing.assert_allclose(lam - PRESS, -normal @ wrong, rtol=1e-10)
    assert np.abs(lam - PRESS)[0] > 1.0


@pytest.mark.slow
def test_integral_action_takes_a_force_error_away():
    """At the lowest place a wrong mass moves nothing and presses with a constant error, which decays as exp(-KI t)."""
    plant, q0, v0 = scenes.spherical_pendulum(mass=1.3), jnp.asarray([0.0, 0.0, -1.0]), jnp.zeros(3)
    model = scenes.spherical_pendulum(mass=1.6)
    law = jd.control.HybridForce(model, first_two, jnp.zeros(2), KP, KD, force=PRESS, ki=4.0)
    outputs = ("multipliers", "control_state", "torque")
    solution = jd.simulate(plant, q0, v0, TS, control=law, stepsize=0.005, outputs=outputs)
    np.testing.assert_allclose(solution.q, np.tile(q0, (TS.size, 1)), atol=1e-12)
    error = solution.multipliers[:, 0] - PRESS[0]
    np.testing.assert_allclose(error, 0.3 * 9.81 * np.exp(-4.0 * TS), atol=1e-7)  # of RK4's steps
    fitted = np.polyfit(TS, np.log(error), 1)[0]
    np.testing.assert_allclose(fitted, -4.0, rtol=0.01)  # the promised rate; the errors themselves are compared above
    np.testing.assert_allclose(solution.control_state[:, 0], 0.3 * 9.81 * (1 - np.exp(-4.0 * TS)) / 4.0, atol=1e-7)
    again = jax.vmap(law)(solution.q, solution.v, TS, solution.control_state)
    np.testing.assert_allclose(solution.torque, again, atol=1e-12)


@pytest.mark.long
def test_velocities_of_a_rolling_disk():
    """A J = 0: steering and rolling rates follow by one gain each, the forces of both rows as wanted."""
    scene = scenes.rolling_disk()
    q0, v0 = scenes.rolling_disk.start()

    def rates(q, v):
        return v[2:]

    def target(t):
        return jnp.stack([jnp.sin(t), 1.0 + 0.5 * t])

    kp, force = np.array([3.0, 5.0]), jnp.asarray([0.7, -0.4])
    law = jd.control.HybridForce(scene, rates, target, kp, of="velocity", force=force, ki=2.0)
    solution = jd.simulate(scene, q0, v0, TS, control=law, stepsize=0.005, outputs=("multipliers",))
    errors = np.asarray(solution.v[:, 2:] - jax.vmap(target)(TS))
    np.testing.assert_allclose(errors, errors[0] * np.exp(-np.outer(TS, kp)), atol=1e-8)
    np.testing.assert_allclose(solution.multipliers, np.tile(force, (TS.size, 1)), atol=1e-10)


@pytest.mark.long
def test_three_motors_of_a_parallel_manipulator():
    """The carried point follows; torques are the shortest that do it, and internal ones move nothing."""
    scene = scenes.parallel_manipulator()
    q, v = scenes.parallel_manipulator.start()

    def point(q):
        tip = jd.frame_pose(scene.system, q, "a2")
        return tip[:2, 3] + tip[:2, 0]

    def target(t):
        return jnp.stack([0.2 * jnp.cos(t), 0.15 * jnp.sin(t)])

    motors, internal = (0, 2, 4), jnp.asarray([1.0, -2.0, 0.5])
    laws = [jd.control.HybridForce(scene, point, target, KP, KD, actuated=motors, internal=x) for x in (None, internal)]

    @quick
    def compute(q, v):
        tau = [law(q, v, 0.3) for law in laws]
        moved = [jd.constrained_dynamics(scene, q, v, x, 0.3) for x in tau]
        M, h = jd.mass_matrix(scene.system, q), jd.bias_force(scene.system, q, v)
        full = M @ laws[0].acceleration(q, v, 0.3) + h
        bend = jax.jvp(lambda q: jax.jvp(point, (q,), (v,))[1], (q,), (v,))[1]
        return tau, moved, full, jd.constraints.projections(scene, q).P_omega, jax.jacfwd(point)(q), bend, point(q)

    tau, moved, full, P_w, J, bend, place = compute(q, v)
    rate = jax.jvp(target, (0.3,), (1.0,))[1]
    wanted = -target(0.3) - KD * (J @ v - rate) - KP * (place - target(0.3))
    for x, computed in zip(tau, moved, strict=True):
        assert not np.asarray(x)[[1, 3, 5]].any()
        np.testing.assert_allclose(J @ computed.acceleration + bend, wanted, rtol=1e-9)
    shortest = np.linalg.pinv(np.asarray(P_w)[:, motors], rcond=1e-9) @ np.asarray(P_w @ full)
    np.testing.assert_allclose(tau[0][np.array(motors)], shortest, rtol=1e-9)
    assert np.abs(tau[1] - tau[0]).max() > 0.01
    assert np.abs(moved[1].multipliers - moved[0].multipliers).max() > 0.01
    np.testing.assert_allclose(moved[1].acceleration, moved[0].acceleration, atol=1e-9)


@pytest.mark.parametrize("holonomic", [True, False])
def test_gauge_invariant_law_on_a_moving_plane(holonomic):
    """On z = x/2 + sin 2t, as positions and as rates: the energy of the velocity error decays, the force is the wanted one."""
    p, k, mass, t = 2.0, 3.0, 1.3, 0.35
    height = lambda q, t: q[2:] - 0.5 * q[:1] - jnp.sin(2 * t)  # noqa: E731
    row, speed = jnp.array([[-0.5, 0.0, 1.0]]), lambda q, t: 2 * jnp.cos(2 * t)[None]
    plane = jd.Holonomic(height) if holonomic else jd.Pfaffian(lambda q, t: row, speed)
    particle = jd.LagrangianSystem(lambda q, v: 0.5 * mass * jnp.sum(v**2) - 9.81 * mass * q[2], 3)
    scene = jd.Scene(particle, [plane])
    law = jd.control.GaugeInvariant(scene, first_two, circle, p, k, force=PRESS)
    q, v = jnp.array([0.3, -0.1, 0.15 + np.sin(2 * t)]), jnp.array([0.2, 0.7, 0.1 + 2 * np.cos(2 * t)])

    @quick
    def evaluate(q, v):
        plant = jd.constrained_dynamics(scene, q, v, law(q, v, t), t)
        energy = lambda q, v, t: jnp.sum(law.composite_error(q, v, t) ** 2)  # noqa: E731
        return plant.multipliers, *jax.jvp(energy, (q, v, t), (v, plant.acceleration, 1.0))

    force, energy, rate = evaluate(q, v)
    slow = v[:2] - jax.jvp(circle, (t,), (1.0,))[1] + p * (q[:2] - circle(t))
    np.testing.assert_allclose(energy, mass * (jnp.sum(slow**2) + (0.5 * slow[0]) ** 2), rtol=1e-12)
    np.testing.assert_allclose(rate, -2 * k * energy, rtol=1e-11)
    np.testing.assert_allclose(force, PRESS, rtol=1e-11)


def test_geometric_and_gauge_invariant_laws_are_equal_for_matched_gains(pendulum, torques):
    """Kd' = Kp + Kd, Kp' = Kd Kp: equal where ed + Kp e = 0, elsewhere different by the Coriolis force of that error."""
    _, q, v = pendulum
    p, both = torques
    hybrid, gauge = both(q, v, 0.3)

    def motion(q):
        """J: columns of motions of unit rates of the first two coordinates."""
        return jnp.linalg.inv(jnp.concatenate([q[None], jnp.eye(3)[:2]]))[:, 1:]

    @quick
    def compute(q, v):
        wanted = jax.jacfwd(circle)(0.3) - p * (q[:2] - circle(0.3))
        # M = 1.3 and C = 0, of which the part along the sphere.
        difference = 1.3 * jax.jvp(motion, (q,), (v,))[1] @ (v[:2] - wanted)
        return difference - q * (q @ difference) / (q @ q), motion(q) @ wanted

    difference, v = compute(q, v)
    np.testing.assert_allclose(np.asarray(hybrid) - np.asarray(gauge), difference, atol=1e-10)
    assert np.abs(difference).max() > 0.01
    np.testing.assert_allclose(*both(q, v, 0.3), atol=1e-10)


def test_gauge_invariant_law_gives_its_own_u(pendulum):
    """u_r = sdot + Gamma_r s - Kd eps and u_o of EQUATIONS section 9, by differences of B along the motion."""
    scene, q, v = pendulum
    p, k, t, step = 2.0, 3.0, 0.3, 1e-5
    law = jd.control.GaugeInvariant(scene, first_two, circle, p, k, force=PRESS)

    @quick
    def at(q, v, t):
        gauge = jd.reduction.gauge_invariant(scene, q, v, law(q, v, t), t, dof=2)
        J = jnp.linalg.inv(jnp.concatenate([q[None], jnp.eye(3)[:2]]))[:, 1:]
        s = jax.jacfwd(circle)(t) - p * (q[:2] - circle(t))
        a = jd.constrained_dynamics(scene, q, v, law(q, v, t), t).acceleration
        return gauge, gauge.W.T @ J @ s, gauge.W.T @ J @ (v[:2] - s), a

    gauge, own, eps, a = jax.tree.map(np.asarray, at(q, v, t))
    q, v = np.asarray(q), np.asarray(v)
    ahead, behind = (np.asarray(at(q + h * v + 0.5 * h * h * a, v + h * a, t + h)[1]) for h in (step, -step))
    # V2 is carried along: V2^T d/dt (V2 s) = sdot, and Gamma_r = V2^T Gamma V2.
    want = gauge.V2.T @ ((ahead - behind) / (2 * step) + gauge.Gamma @ gauge.V2 @ gauge.V2.T @ own - k * eps)
    np.testing.assert_allclose(gauge.reduced_force, want, rtol=1e-7)  # of differences
    np.testing.assert_allclose(
        gauge.Gamma_o @ gauge.reduced_velocity - gauge.Lambda_r.T @ np.asarray(PRESS), gauge.normal_force, rtol=1e-10
    )


def test_rank_loss_is_told(pendulum):
    """At the equator the first two coordinates do not tell the motion, and the law says so."""
    scene = pendulum[0]
    law = jd.control.HybridForce(scene, first_two, circle, KP, KD)
    told = quick(lambda q, v: (law.is_regular(q, v), law(q, v)))
    assert bool(told(pendulum[1], pendulum[2])[0])
    is_regular, torque = told(jnp.asarray([0.6, 0.8, 0.0]), jnp.zeros(3))
    assert not bool(is_regular) and np.isfinite(torque).all()


@pytest.mark.long
def test_constraints_hold_where_the_task_depends_on_them():
    """A stretched arm whose tip is on a wall: the height is given up, and the wall keeps its row and its force."""
    model, angle = jd.robots.chain(2), 0.5
    tip = lambda q: jnp.stack([jnp.sin(q[0]) + jnp.sin(q[0] + q[1]), -jnp.cos(q[0]) - jnp.cos(q[0] + q[1])])  # noqa: E731
    wall = jd.Holonomic(lambda q, t: tip(q)[:1] - 2 * jnp.sin(angle), name="wall")
    scene = jd.Scene(model, (wall,))
    hybrid = jd.control.HybridForce(scene, lambda q: tip(q)[1:], [-1.5], 9.0, 4.0, force=[5.0])
    gauge = jd.control.GaugeInvariant(scene, lambda q: tip(q)[1:], [-1.5], 3.0, 4.0, force=[5.0])
    # Along the wall, which is the direction in which the arm folds: (1, -2) does not move the tip.
    q, v = jnp.array([angle, 0.0]), jnp.array([0.3, -0.6])
    row = jd.constrained_dynamics(scene, q, v)
    A = jd.constraint_jacobian(scene, q)
    gamma = A @ row.acceleration
    np.testing.assert_allclose(A @ v, 0, atol=1e-15)
    np.testing.assert_allclose(A @ hybrid.acceleration(q, v), gamma, rtol=1e-12)
    for law in (hybrid, gauge):
        plant = jd.constrained_dynamics(scene, q, v, law(q, v))
        np.testing.assert_allclose(plant.multipliers, 5.0, rtol=1e-12)
        if law is hybrid:
            np.testing.assert_allclose(plant.acceleration, law.acceleration(q, v), atol=1e-12)


@pytest.mark.long
def test_a_motion_into_rank_loss_ends_with_a_code(pendulum):
    """A target beside the sphere: x goes as the gains say until z is 0.1, where the run ends."""
    scene, reach = pendulum[0], jnp.asarray([1.5, 0.0])
    q0, v0 = jnp.asarray([0.6, 0.0, -0.8]), jnp.zeros(3)
    law = jd.control.HybridForce(scene, first_two, reach, KP, KD, least_regularity=0.1)
    solution = jd.simulate(scene, q0, v0, TS, control=law, throw=False)
    assert solution.result == jd.RESULTS.control_singular and not bool(solution.success)
    # The row of x is at the angle to the sphere's normal whose sine is |z|.
    np.testing.assert_allclose(quick(lambda q, v: law.regularity(q, v))(q0, v0), 0.8, rtol=1e-12)

    def beside(t):
        return 1.5 + decayed(np.array([t]), np.array([-0.9]), np.zeros(1))[0, 0] - np.sqrt(1 - 0.1**2)

    time = brentq(beside, 0.0, 2.0, xtol=1e-14)
    np.testing.assert_allclose(solution.stats["time_reached"], time, rtol=1e-7)
    q, ts = np.asarray(solution.q), np.asarray(TS)
    assert np.isfinite(q[ts < time]).all() and np.isnan(q[ts > time]).all()
    with pytest.raises(RuntimeError, match=r"lose rank.*least_regularity"):
        jd.simulate(scene, q0, v0, TS, control=law)


@pytest.fixture(scope="module")
def pushed_bead():
    """A bead on the unit circle that one motor pushes along x: none can at the angle 0, where it moves along y."""
    bead = jd.LagrangianSystem(lambda q, v: 0.65 * jnp.sum(v**2), 2)
    ring = jd.Scene(bead, [jd.Holonomic(lambda q, t: jnp.sum(q**2)[None] - 1.0, name="ring")])
    return ring, jd.control.HybridForce(ring, lambda q: q[1:], [-0.5], KP, KD, actuated=[0], least_regularity=0.1)


def test_regularity_counts_the_motors(pushed_bead):
    """|cos| of the angle for the task y, |sin| for a motor along x; of several passive joints by a QR of the whitened motions."""
    law = pushed_bead[1]
    regularity = quick(
        jax.vmap(lambda angle: law.regularity(jnp.stack([jnp.cos(angle), jnp.sin(angle)]), jnp.zeros(2)))
    )
    angles = np.array([0.0, 0.2, 0.9, np.pi / 2, 2.0])
    expected = np.minimum(np.abs(np.sin(angles)), np.abs(np.cos(angles)))
    np.testing.assert_allclose(regularity(angles), expected, atol=1e-15)
    dead, v = jnp.array([1.0, 0.0]), jnp.array([0.0, 0.3])
    assert not bool(law.is_regular(dead, v)) and bool(law.is_regular(jnp.array([0.6, 0.8]), jnp.zeros(2)))
    assert np.isfinite(law(dead, v)).all()

    scene = scenes.parallel_manipulator()
    q, v = scenes.parallel_manipulator.start()
    robot, driven = (
        jd.control.HybridForce(scene, lambda q: q[:1], jnp.zeros(1), KP, KD, actuated=motors)
        for motors in (["a1", "b1"], None)
    )
    U = np.linalg.cholesky(jd.mass_matrix(scene.system, q)).T
    Y = np.linalg.solve(U.T, np.asarray(jd.constraint_jacobian(scene, q)).T)
    fixed, idle = Y @ np.linalg.pinv(Y, rcond=1e-9), U[:, [1, 3, 4, 5]]
    sines = np.abs(np.diagonal(np.linalg.qr(fixed @ idle)[1])) / np.linalg.norm(idle, axis=0)
    assert sines.min() < 0.9 * driven.regularity(q, v)
    np.testing.assert_allclose(robot.regularity(q, v), sines.min(), rtol=1e-10)
    assert bool(robot.is_regular(q, v))


@pytest.mark.long
def test_a_motion_to_where_motors_do_not_hold_ends_with_a_code(pushed_bead):
    """The height goes as the gains say until it is 0.1, where the bead moves almost across its motor."""
    ring, law = pushed_bead
    solution = jd.simulate(ring, jnp.array([0.8, 0.6]), jnp.zeros(2), TS, control=law, throw=False)
    assert solution.result == jd.RESULTS.control_singular
    time = brentq(lambda t: decayed(np.array([t]), np.array([1.1]), np.zeros(1))[0, 0] - 0.6, 0.0, 2.0, xtol=1e-14)
    np.testing.assert_allclose(solution.stats["time_reached"], time, rtol=1e-7)


@pytest.mark.slow
def test_gains_are_tuned_over_perturbed_systems():
    """The cost of the page on tuning: its gradient in three gains against differences, and a step that lowers it."""
    from benchmarks.control_figures import MASSES, tuning_cost

    gains, masses = jnp.log(jnp.asarray([4.0, 3.0, 1.0])), jnp.asarray(MASSES[:8])
    cost = jax.jit(lambda gains: jnp.mean(jax.vmap(lambda m: tuning_cost(gains, m, end=0.5))(masses)))
    value, slope = jax.jit(jax.value_and_grad(cost))(gains)
    step = 1e-4
    for i, direction in enumerate(step * np.eye(3)):
        np.testing.assert_allclose(
            slope[i], (cost(gains + direction) - cost(gains - direction)) / (2 * step), rtol=1e-6
        )
    assert cost(gains - 0.1 * slope / jnp.linalg.norm(slope)) < value


def _hybrid(pendulum, kp=1.0, kd=1.0, **options):
    return jd.control.HybridForce(pendulum[0], first_two, circle, kp, kd, **options)


STATE = jnp.asarray([0.6, 0.0, -0.8]), jnp.zeros(3), 0.0


test_bad_input_is_refused = refusals(
    (lambda s: _hybrid([s[0].system]), "no constraints"),
    (lambda s: _hybrid(s, of="force"), "of is 'force'"),
    (lambda s: _hybrid(s, kd=None), "kd is None"),
    (lambda s: _hybrid(s, of="velocity"), "kd is given"),
    (lambda s: _hybrid(s, ki=-2.0), "ki is -2.0"),
    (lambda s: _hybrid(s, internal=[1.0]), "internal is given"),
    (lambda s: _hybrid(s, actuated=[0, 7]), "actuated is"),
    (lambda s: _hybrid(s, actuated=[0], ki=1.0), "omit them"),
    (lambda s: _hybrid(s, actuated=[0]), "name a motor"),
    (lambda s: _hybrid(s, force=jnp.zeros(2))(*STATE), "force has shape"),
    (lambda s: _hybrid(s, least_regularity=-1.0), "least_regularity is -1"),
    (lambda s: jd.control.GaugeInvariant(s[0], first_two, circle, 1.0, 0.0), "kd is 0.0"),
    (lambda s: jd.control.GaugeInvariant(s[0], lambda q: q[:1], jnp.zeros(1), 1.0, 1.0)(*STATE), "1 coordinates"),
    given=("pendulum",),
)


@pytest.mark.parametrize("angle", [1e-2, 1e-4, 1e-6])
def test_a_task_that_nearly_depends_on_a_constraint_leaves_it_alone(angle):
    """Both rows hold to the rounding of the acceleration that they need, which grows as the inverse of the angle."""
    rng = np.random.default_rng(2)
    root, (first, change), start = rng.normal(size=(4, 4)), rng.normal(size=(2, 4)), rng.normal(size=4)
    inertia = jnp.asarray(root @ root.T + 4 * np.eye(4))
    system = jd.ExplicitSystem(lambda q: inertia, lambda q, v: 0 * q, 4)
    rows, wanted = np.stack([first, first + angle * change]), np.array([0.7, -0.4])
    orders = [(jnp.asarray(rows[i : i + 1]), jnp.asarray(wanted[i : i + 1])) for i in (0, 1)]
    a = np.asarray(hierarchical_acceleration(system, jnp.zeros(4), 0.0, orders, jnp.asarray(start)))
    assert np.abs(a).max() > 0.1 / angle
    assert (
        np.abs(rows @ a - wanted) < 100 * np.finfo(float).eps * np.linalg.norm(rows, axis=1) * np.linalg.norm(a)
    ).all()
