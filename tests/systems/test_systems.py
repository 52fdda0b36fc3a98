"""Systems given by a Lagrangian or by their equations, against bodies, closed forms and each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn.systems.mass_factor import solve_positive

# Planar 2R arm of EQUATIONS section 1: m, l1, r, I.
MASS, LENGTH, REACH, MOMENT = (1.0, 0.8), 1.0, (0.5, 0.4), (0.1, 0.05)
GRAVITY = 9.81


def lagrangian(q, v, t, p):
    a, b = q[0], q[0] + q[1]
    wa, wb = v[0], v[0] + v[1]
    tip = p["length"] * jnp.stack([jnp.cos(a), jnp.sin(a)])
    tip_rate = p["length"] * wa * jnp.stack([-jnp.sin(a), jnp.cos(a)])
    rates = (
        p["reach"][0] * wa * jnp.stack([-jnp.sin(a), jnp.cos(a)]),
        tip_rate + p["reach"][1] * wb * jnp.stack([-jnp.sin(b), jnp.cos(b)]),
    )
    heights = p["reach"][0] * jnp.sin(a), tip[1] + p["reach"][1] * jnp.sin(b)
    kinetic = 0.5 * sum(p["mass"][i] * jnp.sum(rates[i] ** 2) for i in range(2))
    kinetic = kinetic + 0.5 * (p["moment"][0] * wa**2 + p["moment"][1] * wb**2)
    return kinetic - GRAVITY * sum(p["mass"][i] * heights[i] for i in range(2))


PARAMETERS = {"mass": MASS, "length": LENGTH, "reach": REACH, "moment": MOMENT}
PARAMETERS = {name: jnp.asarray(value) for name, value in PARAMETERS.items()}


def printed_mass(q):
    m1, m2 = MASS
    alpha = sum(MOMENT) + m1 * REACH[0] ** 2 + m2 * (LENGTH**2 + REACH[1] ** 2)
    beta, delta = m2 * LENGTH * REACH[1], MOMENT[1] + m2 * REACH[1] ** 2
    c = jnp.cos(q[1])
    return jnp.stack(
        [jnp.stack([alpha + 2 * beta * c, delta + beta * c]), jnp.stack([delta + beta * c, delta + 0 * c])]
    )


def printed_coriolis(q, v):
    s = MASS[1] * LENGTH * REACH[1] * jnp.sin(q[1])
    return jnp.stack([jnp.stack([-s * v[1], -s * (v[0] + v[1])]), jnp.stack([s * v[0], 0 * s])])


def printed_gravity(q):
    c1, c12 = jnp.cos(q[0]), jnp.cos(q[0] + q[1])
    second = MASS[1] * REACH[1] * c12
    return GRAVITY * jnp.stack([MASS[0] * REACH[0] * c1 + MASS[1] * LENGTH * c1 + second, second])


def bodies():
    builder = jd.ModelBuilder("2R", gravity=(0.0, -GRAVITY, 0.0))
    for i, parent in enumerate((None, "link0")):
        inertia = (MASS[i], (REACH[i], 0.0, 0.0), (0.0, 0.0, MOMENT[i]))
        builder.add_body(f"link{i}", parent, inertia=inertia, pose=(i * LENGTH, 0.0, 0.0))
    return builder.build()


@quick
def everything(system, q, v, a):
    return {
        "mass_matrix": jd.mass_matrix(system, q),
        "bias_force": jd.bias_force(system, q, v),
        "gravity_force": jd.gravity_force(system, q),
        "coriolis": jd.coriolis_matrix(system, q, v) @ v,
        "inverse_dynamics": jd.inverse_dynamics(system, q, v, a),
        "forward_dynamics": jd.forward_dynamics(system, q, v, a),
        "kinetic": jd.kinetic_energy(system, q, v),
        "potential": jd.potential_energy(system, q),
    }


def test_three_ways_to_give_one_arm_agree():
    """Lagrangian by automatic differentiation, printed equations, and bodies on joints."""
    rng = np.random.default_rng(0)
    q, v, a = (jnp.asarray(x) for x in rng.normal(size=(3, 2)))
    explicit = jd.ExplicitSystem(
        printed_mass,
        lambda q, v: printed_coriolis(q, v) @ v + printed_gravity(q),
        2,
        potential=lambda q: -lagrangian(q, jnp.zeros(2), 0.0, PARAMETERS),
    )
    computed = [
        everything(s, q, v, a) for s in (jd.LagrangianSystem(lagrangian, 2, parameters=PARAMETERS), explicit, bodies())
    ]
    for other in computed[1:]:
        for name, value in computed[0].items():
            assert_close(other[name], value, 1e-13, name)
    assert_close(computed[0]["inverse_dynamics"], printed_mass(q) @ a + printed_coriolis(q, v) @ v + printed_gravity(q))


def test_gyroscopic_and_moving_systems():
    """A charge in a magnetic field, seen from a frame that moves with speed u(t): known force, known Jacobi integral."""
    field, pull = 1.7, 0.6

    def moving(q, v, t, p):
        absolute = v + jnp.stack([pull * t, jnp.zeros_like(t)])  # frame accelerates at `pull` along x
        return 0.5 * p["m"] * jnp.sum(absolute**2) + 0.5 * p["b"] * (q[0] * v[1] - q[1] * v[0])

    system = jd.LagrangianSystem(moving, 2, parameters={"m": 2.0, "b": field})
    q, v = jnp.array([0.4, -1.2]), jnp.array([0.8, 0.3])
    bias = quick(lambda q, v: jd.bias_force(system, q, v, 0.9))
    want = np.array([2.0 * pull - field * v[1], field * v[0]])  # m xdd + m pull - b ydot = 0, m ydd + b xdot = 0
    assert_close(bias(q, v), want, 1e-14)
    assert_close(jd.kinetic_energy(system, q, v, 0.9), 1.0 * jnp.sum(v * v), 1e-14)


def test_parameters_are_differentiated_and_batched():
    q, v, tau = jnp.array([0.3, 1.1]), jnp.array([0.7, -0.4]), jnp.array([0.2, 0.1])

    def acceleration(scale):
        system = jd.LagrangianSystem(lagrangian, 2, parameters=PARAMETERS | {"mass": PARAMETERS["mass"] * scale})
        return jd.forward_dynamics(system, q, v, tau)

    step = 1e-5
    one, scales = quick(acceleration), jnp.array([0.5, 1.0, 2.0])
    slope = (one(1.0 + step) - one(1.0 - step)) / (2 * step)
    assert_close(quick(jax.jacfwd(acceleration))(1.0), slope, 1e-8)  # central differences
    assert_close(quick(jax.vmap(acceleration))(scales), np.stack([one(s) for s in scales]), 1e-13)


def test_small_systems_are_solved_without_lapack():
    """Equal to numpy, NaN where not positive definite; in kernels there is no call for each sample."""
    root = np.random.default_rng(5).normal(size=(7, 7))
    whole = root @ root.T + np.eye(7)
    solve = quick(solve_positive)
    for n in (1, 2, 3, 6, 7):
        right = root[:n, :3]
        assert_close(solve(whole[:n, :n], right), np.linalg.solve(whole[:n, :n], right), 1e-13)
    assert np.isnan(solve(np.asarray([[1.0, 2.0], [2.0, 1.0]]), np.ones(2))).all()
    system, batch = jd.LagrangianSystem(lagrangian, 2, parameters=PARAMETERS), jnp.ones((3, 2))
    motion = jax.jit(jax.vmap(lambda q: jd.forward_dynamics(system, q, q, q)))
    assert "lapack" not in motion.lower(batch).as_text()


def test_potential_split_off_gives_the_same_system():
    rest = lambda q, t, p: -lagrangian(q, jnp.zeros(2), t, p)  # noqa: E731
    moving = lambda q, v, t, p: lagrangian(q, v, t, p) + rest(q, t, p)  # noqa: E731
    whole = jd.LagrangianSystem(lagrangian, 2, parameters=PARAMETERS)
    split = jd.LagrangianSystem(moving, 2, parameters=PARAMETERS, potential=rest)
    q, v, a = (jnp.asarray(x) for x in np.random.default_rng(1).normal(size=(3, 2)))
    want = everything(whole, q, v, a)
    for name, value in everything(split, q, v, a).items():
        assert_close(value, want[name], 1e-13, name)
    assert_close(split.value(q, v, jnp.zeros(())), whole.value(q, v, jnp.zeros(())), 1e-13)


def test_coriolis_matrix_holds_gyroscopic_terms():
    """C v + N = h and C + C^T = dM/dt for a Lagrangian with terms linear in v."""

    def charged(q, v):
        return 0.5 * (1 + q[0] ** 2) * v[0] ** 2 + 0.5 * v[1] ** 2 + q[0] * q[1] ** 2 * v[1] - jnp.sin(q[0])

    system, (q, v) = jd.LagrangianSystem(charged, 2), np.random.default_rng(3).normal(size=(2, 2))
    q, v = jnp.asarray(q), jnp.asarray(v)
    C, N, h, rate = quick(
        lambda q, v: (
            jd.coriolis_matrix(system, q, v),
            jd.gravity_force(system, q),
            jd.bias_force(system, q, v),
            jax.jvp(lambda q: jd.mass_matrix(system, q), (q,), (v,))[1],
        )
    )(q, v)
    field = q[1] ** 2  # of the one-form q0 q1^2 dq1
    printed = np.array([q[0] * v[0] ** 2 - field * v[1] + np.cos(q[0]), field * v[0]])
    assert_close(h, printed, 1e-13)
    assert_close(C @ v + N, h, 1e-13)
    assert_close(C + C.T, rate, 1e-13)


def test_dissipation():
    """Rayleigh's function of damped joints is their damping; sliding friction is mu N against the sliding."""
    system = jd.LagrangianSystem(lagrangian, 2, parameters=PARAMETERS)
    q, v, t = jnp.array([0.3, 1.1]), jnp.array([0.7, -0.4]), jnp.zeros(())
    damping = jnp.array([0.4, 0.9])
    rayleigh = jd.forces.RayleighDissipation(
        jax.tree_util.Partial(lambda d, q, v, t: 0.5 * jnp.sum(d * v * v), damping)
    )
    assert_close(rayleigh(system, q, v, t), jd.forces.JointDamping(damping)(system, q, v, t), 1e-15)
    sliding = jd.forces.SlidingFriction(0.3, lambda system, q, v, t: 2.0 + q[0], -1, 1)
    assert_close(sliding(system, q, v, t), [0.0, 0.3 * 2.3], 1e-15)
    rows = jd.forces.SlidingFriction(0.3, 2.0, 1, lambda q, t: jnp.stack([jnp.ones(()), q[1]]))
    assert_close(rows(system, q, v, t), [-0.6, -0.66], 1e-15)
    for match, call in (
        ("function returned shape", lambda: jd.forces.RayleighDissipation(lambda q, v, t: v)(system, q, v, t)),
        ("direction is 0", lambda: jd.forces.SlidingFriction(0.3, 2.0, 0)),
        (r"coefficient is -0\.3", lambda: jd.forces.SlidingFriction(-0.3, 2.0, 1)),
        ("along is 2", lambda: jd.forces.SlidingFriction(0.3, 2.0, 1, 2)(system, q, v, t)),
        ("along is 'x'", lambda: jd.forces.SlidingFriction(0.3, 2.0, 1, "x")),
    ):
        with pytest.raises(ValueError, match=match):
            call()


def test_starts_without_a_motion_are_refused():
    """Degenerate, not finite, not quadratic, too few or too many coordinates: at the start of any motion."""

    def three(q, v):
        x, y, z = v
        return 0.5 * (x * x + y * y + z * z)

    def start(lagrangian, nq, q=0.0, **options):
        system, state = jd.LagrangianSystem(lagrangian, nq, **options), jnp.full(nq, q)
        return lambda: jd.forward_dynamics(system, state, jnp.zeros(nq), jnp.zeros(nq))

    idle = (
        r"mass matrix of this LagrangianSystem has rank 1 of 2 at q = \[0.0, 0.0\].*velocity \[.*1.0.*\] moves no mass"
    )
    swing = lambda q, v: 0.5 * v[0] ** 2 + jnp.cos(q[0])  # noqa: E731
    refused = {
        idle: start(swing, 2),
        "index 2 is": start(lambda q, v: 0.5 * jnp.sum(v * v) - q[2], 2),
        "not enough values": start(three, 2),
        "lagrangian is nan": start(lambda q, v: 0.5 * v[0] ** 2 + jnp.log(q[0]), 1, -1.0),
        "not positive definite": start(lambda q, v: 0.5 * (v[0] ** 2 - v[1] ** 2), 2),
        "not quadratic in": start(lambda q, v: 0.5 * v[0] ** 2 + v[0] ** 4, 1),
        "1 at rest": start(lambda q, v: 0.5 * v[0] ** 2 + 1.0, 1, potential=lambda q: q[0]),
    }
    for message, motion in refused.items():
        with pytest.raises(ValueError, match=message):
            motion()
    with pytest.raises(ValueError, match=idle):
        jd.simulate(jd.Scene(jd.LagrangianSystem(swing, 2)), jnp.zeros(2), jnp.zeros(2), jnp.array([0.0, 1.0]))
    flat = jd.MetricSystem(lambda q: jnp.ones((2, 2)), 2)
    with pytest.raises(ValueError, match="this MetricSystem has"):
        jd.forward_dynamics(flat, jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))


def test_bad_systems_are_refused():
    with pytest.raises(ValueError, match="nq is 0"):
        jd.LagrangianSystem(lagrangian, 0)
    with pytest.raises(ValueError, match="lagrangian is 3"):
        jd.LagrangianSystem(3, 2)
    system = jd.ExplicitSystem(lambda q: jnp.eye(3), lambda q, v: v, 2)
    q = jnp.zeros(2)
    for match, call in (
        ("mass_matrix returned shape", lambda: jd.mass_matrix(system, q)),
        ("no potential energy", lambda: jd.potential_energy(system, q)),
        ("q has shape", lambda: jd.mass_matrix(system, jnp.zeros(3))),
        ("wrenches on bodies", lambda: jd.forward_dynamics(system, q, q, q, external=jnp.zeros((1, 6)))),
        ("lagrangian returned shape", lambda: jd.mass_matrix(jd.LagrangianSystem(lambda q, v: v * v, 2), q)),
    ):
        with pytest.raises(ValueError, match=match):
            call()
