"""Scenes from Lagrangians, metrics and immersions against the printed formulas and against each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn import geometry, scenes, se3

G = 9.81
STATES = np.random.default_rng(8).normal(size=(3, 20, 4))


def states(count):
    """Twenty random q, v, a."""
    return (jnp.asarray(x[:, :count]) for x in STATES)


def matrix(rows):
    """An array from nested lists of traced numbers."""
    return jnp.stack([jnp.stack([jnp.asarray(x, float) for x in row]) for row in rows])


def check(pairs, tol=1e-11):
    for name, (got, want) in pairs.items():
        assert_close(got, want, tol, name)


@quick
@jax.vmap
def first_pages(q, v, a):
    """Particle, spherical pendulum and planar arm, each against what is printed."""
    pairs = {}
    particle = scenes.particle_in_plane(mass=1.3).system
    newton = 1.3 * a[:2] + jnp.asarray([0.0, 1.3 * G])
    pairs["particle"] = jd.inverse_dynamics(particle, q[:2], v[:2], a[:2]), newton
    pairs["particle P"] = geometry.flat(particle, q[:2], v[:2]), 1.3 * v[:2]

    swing = scenes.pendulum(mass=1.3, length=0.7).system
    angle, rate, turn = q[:1], v[:1], a[:1]
    pairs |= {
        "swing": (
            jd.inverse_dynamics(swing, angle, rate, turn),
            1.3 * 0.49 * turn + 1.3 * G * 0.7 * jnp.sin(angle),
        ),
        "swing T": (jd.kinetic_energy(swing, angle, rate), 1.3 * 0.49 * rate[0] ** 2 / 2),
        "swing V": (jd.potential_energy(swing, angle), 1.3 * G * 0.7 * (1 - jnp.cos(angle[0]))),
    }

    q, v, a = q[:2], v[:2], a[:2]
    sphere = scenes.spherical_pendulum_in_angles(mass=1.3, length=0.7).system
    s, c, ml = jnp.sin(q[0]), jnp.cos(q[0]), 1.3 * 0.7
    printed = ml * 0.7 * jnp.stack([a[0] - s * c * v[1] ** 2 + G / 0.7 * s, s**2 * a[1] + 2 * s * c * v[0] * v[1]])
    moving = jd.forward_dynamics(sphere, q, v, jnp.zeros(2))
    momentum = lambda q, v: ml * 0.7 * jnp.sin(q[0]) ** 2 * v[1]  # noqa: E731
    printed_lagrangian = ml * 0.7 / 2 * (v[0] ** 2 + s**2 * v[1] ** 2) + ml * G * c
    pairs |= {
        "sphere L": (sphere.value(q, v, jnp.zeros(())), printed_lagrangian),
        "sphere": (jd.inverse_dynamics(sphere, q, v, a), printed),
        "sphere M": (jd.mass_matrix(sphere, q), ml * 0.7 * jnp.diag(jnp.stack([1 + 0 * s, s**2]))),
        "sphere N": (jd.gravity_force(sphere, q), ml * G * jnp.stack([s, 0 * s])),
        "sphere C": (jd.coriolis_matrix(sphere, q, v), ml * 0.7 * s * c * matrix([[0, -v[1]], [v[1], v[0]]])),
        "first integral": (jax.jvp(momentum, (q, v), (v, moving))[1], 0.0 * s),
    }

    arm = scenes.planar_arm(gravity=G).system
    (m1, m2), l1, (r1, r2), (I1, I2) = (1.0, 0.8), 1.0, (0.5, 0.4), (0.1, 0.05)
    alpha, beta, delta = I1 + I2 + m1 * r1**2 + m2 * (l1**2 + r2**2), m2 * l1 * r2, I2 + m2 * r2**2
    c2, bs = jnp.cos(q[1]), beta * jnp.sin(q[1])
    gamma = jnp.zeros((2, 2, 2)).at[(0, 0, 0), (0, 1, 1), (1, 0, 1)].set(-bs).at[1, 0, 0].set(bs)
    C = matrix([[-bs * v[1], -bs * (v[0] + v[1])], [bs * v[0], 0.0]])
    c1, c12 = jnp.cos(q[0]), jnp.cos(q[0] + q[1])
    rate = jax.jvp(lambda q: jd.mass_matrix(arm, q), (q,), (v,))[1]
    computed = jd.coriolis_matrix(arm, q, v)
    return pairs | {
        "arm M": (
            jd.mass_matrix(arm, q),
            matrix([[alpha + 2 * beta * c2, delta + beta * c2], [delta + beta * c2, delta]]),
        ),
        "arm symbols": (geometry.christoffel_symbols(arm, q, "first"), gamma),
        "arm C": (computed, C),
        "arm skew": (rate - 2 * computed, bs * (2 * v[0] + v[1]) * jnp.asarray([[0.0, 1.0], [-1.0, 0.0]])),
        "arm N": (
            jd.gravity_force(arm, q),
            G * jnp.stack([m1 * r1 * c1 + m2 * (l1 * c1 + r2 * c12), m2 * r2 * c12]),
        ),
        "arm h": (jd.bias_force(arm, q, v), computed @ v + jd.gravity_force(arm, q)),
    }


@pytest.mark.long
def test_first_pages_of_mechanics():
    check(first_pages(*states(4)))
    arm = scenes.planar_arm().system
    q, v, a = jnp.asarray([0.0, np.pi / 3]), jnp.asarray([1.0, 2.0]), jnp.asarray([1.0, -1.0])
    assert_close(jd.inverse_dynamics(arm, q, v, a), [-0.90702503, 0.43712813], 1e-8)  # as many digits are given
    assert_close(jd.mass_matrix(arm, q), [[1.648, 0.338], [0.338, 0.178]], 1e-13)
    assert_close(jd.coriolis_matrix(arm, q, v), [[-0.55425626, -0.83138439], [0.27712813, 0]], 1e-8)


def printed_spatial_arm(theta):
    """M, J_2, J_3, Gamma_ijk and N of the 3-dof arm, EQUATIONS section 1 with its errata."""
    (_, l1), (_, r1, r2), (_, m2, m3) = (0.5, 0.4), (0.2, 0.25, 0.15), (3.0, 2.0, 1.0)
    (_, _, z1), (x2, y2, z2), (x3, y3, z3) = (0.01, 0.02, 0.03), (0.03, 0.01, 0.04), (0.02, 0.015, 0.025)
    s2, c2, s3, c3 = jnp.sin(theta[1]), jnp.cos(theta[1]), jnp.sin(theta[2]), jnp.cos(theta[2])
    s23, c23 = jnp.sin(theta[1] + theta[2]), jnp.cos(theta[1] + theta[2])
    reach = l1 * c2 + r2 * c23
    M11 = y2 * s2**2 + y3 * s23**2 + z1 + z2 * c2**2 + z3 * c23**2 + m2 * r1**2 * c2**2 + m3 * reach**2
    M22 = x2 + x3 + m3 * l1**2 + m2 * r1**2 + m3 * r2**2 + 2 * m3 * l1 * r2 * c3
    M23, M33 = x3 + m3 * r2**2 + m3 * l1 * r2 * c3, x3 + m3 * r2**2
    M = matrix([[M11, 0, 0], [0, M22, M23], [0, M23, M33]])
    J2 = matrix([[-r1 * c2, 0, 0, 0, -s2, c2], [0, 0, -r1, -1, 0, 0], [0] * 6]).T
    J3 = matrix([[-reach, 0, 0, 0, -s23, c23], [0, l1 * s3, -r2 - l1 * c3, -1, 0, 0], [0, 0, -r2, -1, 0, 0]]).T
    t = m3 * reach
    g112 = (y2 - z2 - m2 * r1**2) * c2 * s2 + (y3 - z3) * c23 * s23 - t * (l1 * s2 + r2 * s23)
    g113 = (y3 - z3) * c23 * s23 - t * r2 * s23
    g223 = -m3 * l1 * r2 * s3
    gamma = jnp.zeros((3, 3, 3)).at[(0, 0), (0, 1), (1, 0)].set(g112).at[1, 0, 0].set(-g112)
    gamma = gamma.at[(0, 0), (0, 2), (2, 0)].set(g113).at[2, 0, 0].set(-g113)
    gamma = gamma.at[(1, 1, 1), (1, 2, 2), (2, 1, 2)].set(g223).at[2, 1, 1].set(-g223)
    N = -G * jnp.stack([0 * c2, (m2 * r1 + m3 * l1) * c2 + m3 * r2 * c23, m3 * r2 * c23])
    return M, J2, J3, gamma, N


LINK_MASSES = (3.0, 2.0, 1.0)
CENTRES = ((0.0, 0.0, 0.2), (0.0, 0.25, 0.0), (0.0, 0.15, 0.0))
LINK_MOMENTS = ((0.01, 0.02, 0.03), (0.03, 0.01, 0.04), (0.02, 0.015, 0.025))


@quick
@jax.vmap
def spatial_arm(q, v, a):
    model = scenes.spatial_arm().system
    M, J2, J3, gamma, N = printed_spatial_arm(q)

    def in_space(q):
        """Rotation, and translational and rotational Jacobian in the world's axes, of each link."""
        turned = [jd.frame_pose(model, q, f"centre{i}")[:3, :3] for i in (1, 2, 3)]
        jacobians = [jd.body_jacobian(model, q, f"centre{i}") for i in (1, 2, 3)]
        return [(R, R @ J[:3], R @ J[3:]) for R, J in zip(turned, jacobians, strict=True)]

    links, rates = jax.jvp(in_space, (q,), (v,))
    computed = [jnp.concatenate([R.T @ Jt, R.T @ JR]) for R, Jt, JR in links]
    by_links, bias, weight = jnp.zeros((3, 3)), jnp.zeros(3), jnp.zeros(3)
    in_space_axes, in_body_axes, pushed, wrenches = jnp.zeros((3, 3)), jnp.zeros((3, 3)), jnp.zeros(3), []
    for i, ((R, Jt, JR), (R_rate, Jt_rate, JR_rate)) in enumerate(zip(links, rates, strict=True)):
        mass, moments = LINK_MASSES[i], jnp.diag(jnp.asarray(LINK_MOMENTS[i]))
        inertia, w = R @ moments @ R.T, JR @ v
        by_links = by_links + mass * Jt.T @ Jt + JR.T @ inertia @ JR
        even = mass * Jt.T @ Jt_rate + JR.T @ inertia @ JR_rate
        bias = bias + (even - JR.T @ jd.so3.hat(inertia @ w) @ JR) @ v
        in_space_axes = in_space_axes + even + JR.T @ jd.so3.hat(w) @ inertia @ JR
        Jv, Jw = R.T @ Jt, R.T @ JR
        Jv_rate, Jw_rate = R_rate.T @ Jt + R.T @ Jt_rate, R_rate.T @ JR + R.T @ JR_rate
        in_body_axes = in_body_axes + mass * Jv.T @ (Jv_rate + jd.so3.hat(Jw @ v) @ Jv)
        in_body_axes = in_body_axes + Jw.T @ moments @ Jw_rate - Jw.T @ jd.so3.hat(moments @ Jw @ v) @ Jw
        weight = weight + mass * Jt.T @ jnp.asarray([0.0, 0.0, -G])
        force, torque = jnp.roll(a, i), jnp.roll(v, -i)
        pushed = pushed + Jt.T @ force + JR.T @ torque
        at_joint = R.T @ torque + jnp.cross(jnp.asarray(CENTRES[i]), R.T @ force)
        wrenches.append(jnp.concatenate([R.T @ force, at_joint]))
    whole = jax.jacfwd(lambda q: jd.center_of_mass(model, q))(q)
    mass_rate = jax.jvp(lambda q: jd.mass_matrix(model, q), (q,), (v,))[1]
    h1, h2 = 0.2, 0.5 - 0.25 * jnp.sin(q[1])
    h3 = 0.5 - 0.4 * jnp.sin(q[1]) - 0.15 * jnp.sin(q[1] + q[2])
    mass_matrix, gravity = jd.mass_matrix(model, q), jd.gravity_force(model, q)
    coriolis = jd.bias_force(model, q, v) - gravity
    pairs = {
        "J1": (computed[0], jnp.zeros((6, 3)).at[5, 0].set(1.0)),
        "J2": (computed[1], J2),
        "J3": (computed[2], J3),
        "M": (mass_matrix, M),
        "M by link Jacobians": (by_links, M),
        "symbols": (geometry.christoffel_symbols(model, q, "first"), gamma),
        "C v": (coriolis, jnp.einsum("ijk,j,k->i", gamma, v, v)),
        "C v by link Jacobians": (bias, coriolis),
        "tensor": (jnp.einsum("ijk,j,k->i", gamma, v, v), in_space_axes @ v),
        "in space axes": (in_space_axes + in_space_axes.T, mass_rate),
        "in body axes": (in_body_axes + in_body_axes.T, mass_rate),
        "in body axes C v": (in_body_axes @ v, coriolis),
        "V": (jd.potential_energy(model, q), G * (3.0 * h1 + 2.0 * h2 + 1.0 * h3)),
        "N": (gravity, N),
        "weight at the centre of mass": (-sum(LINK_MASSES) * whole.T @ jnp.asarray([0.0, 0.0, -G]), N),
        "wrenches": (jd.dynamics.generalized_force(model, q, jnp.stack(wrenches)), pushed),
        "weights through centre-of-mass Jacobians": (-weight, N),
    }
    return pairs, (mass_matrix, coriolis, gravity)


@pytest.mark.slow
def test_spatial_arm():
    """Twenty random states and the one of EQUATIONS, whose numbers have eight or nine digits."""
    drawn = zip(states(3), (*scenes.spatial_arm.start(), jnp.zeros(3)), strict=True)
    pairs, (M, coriolis, N) = spatial_arm(*(jnp.concatenate([x, last[None]]) for x, last in drawn))
    check(pairs)
    assert_close(M[-1][(0, 1, 1, 2), (0, 1, 2, 2)], [0.457483792, 0.449281062, 0.088390531, 0.0425], 2e-9)
    assert_close(coriolis[-1], [0.08628446, 0.01508056, -0.02029184], 1e-7)
    assert_close(N[-1], [0, -9.53782516, -1.40577764], 1e-8)
    twists = jd.dynamics.spatial_jacobian(scenes.spatial_arm().system, jnp.zeros(3), "centre3").T
    assert_close(twists, [[0, 0, 0, 0, 0, 1], [0, -0.5, 0, -1, 0, 0], [0, -0.5, 0.4, -1, 0, 0]], 1e-15)


def euler_quaternion(angles):
    """Quaternion of Rz(phi) Ry(theta) Rz(psi)."""
    half, plus, minus = angles[1] / 2, (angles[0] + angles[2]) / 2, (angles[0] - angles[2]) / 2
    c, s = jnp.cos(half), jnp.sin(half)
    return jnp.stack([c * jnp.cos(plus), -s * jnp.sin(minus), s * jnp.cos(minus), c * jnp.sin(plus)])


def matrix_of(angles):
    """Rz(phi) Ry(theta) Rz(psi)."""
    (sf, st, sp), (cf, ct, cp) = jnp.sin(angles), jnp.cos(angles)
    first, last = ([[c, -s, 0], [s, c, 0], [0, 0, 1]] for s, c in ((sf, cf), (sp, cp)))
    return matrix(first) @ matrix([[ct, 0, st], [0, 1, 0], [-st, 0, ct]]) @ matrix(last)


def test_rigid_body_in_euler_angles():
    """Metric, geodesic form and torques; equal to Euler's equations, to a quaternion model, and to that model immersed."""
    moments = jnp.asarray([1.0, 2.0, 3.0])
    system = scenes.rigid_body_in_euler_angles().system
    builder = jd.ModelBuilder("body", gravity=None)
    builder.add_body("body", None, "spherical", (1.0, (0.0, 0.0, 0.0), (1.0, 2.0, 3.0)))
    model = builder.build()
    immersed = jd.geometry.constrain_by_immersion(model, euler_quaternion, 3)

    def rates(q):
        st, ct, sp, cp = jnp.sin(q[1]), jnp.cos(q[1]), jnp.sin(q[2]), jnp.cos(q[2])
        return matrix([[-st * cp, sp, 0], [st * sp, cp, 0], [ct, 0, 1]])

    @quick
    @jax.vmap
    def both(q, v, a):
        q = q.at[1].set(1.2 + 0.3 * jnp.sin(q[1]))  # away from sin(theta) = 0
        E, (w, w_rate) = rates(q), jax.jvp(lambda q, v: rates(q) @ v, (q, v), (v, a))
        torque = moments * w_rate + jnp.cross(w, moments * w)
        about_axes = jd.inverse_dynamics(system, q, v, a)
        st, ct, sp, cp = jnp.sin(q[1]), jnp.cos(q[1]), jnp.sin(q[2]), jnp.cos(q[2])
        printed = matrix([[-cp / st, sp, cp * ct / st], [sp / st, cp, -sp * ct / st], [0, 0, 1]])
        acceleration = jd.forward_dynamics(system, q, v, about_axes)
        sphi, cphi = jnp.sin(q[0]), jnp.cos(q[0])
        in_space = matrix([[0, -sphi, st * cphi], [0, cphi, st * sphi], [1, 0, ct]])
        b = jnp.cross(moments * w, w) / moments  # Arnold's B(w, w)
        free = jd.forward_dynamics(model, euler_quaternion(q), w, jnp.zeros(3))
        return {
            "turned": (matrix_of(q) @ E, in_space),
            "determinant": (jnp.linalg.det(E), -st),
            "free": (free, b),
            "metric": (jd.mass_matrix(system, q), E.T @ jnp.diag(moments) @ E),
            "torque": (about_axes, E.T @ torque),
            "body axes": (printed @ about_axes, torque),
            "geodesic": (geometry.flat(system, q, geometry.covariant_rate(system, q, v, v, a)), about_axes),
            "acceleration": (acceleration, a),
            "model": (jd.forward_dynamics(model, euler_quaternion(q), w, torque), w_rate),
            "velocity": (immersed.velocities(q, v, jnp.zeros(()))[0], w),
            "immersed": (jd.inverse_dynamics(immersed, q, v, a), about_axes),
            "immersed bias": (jd.bias_force(immersed, q, v), about_axes - jd.mass_matrix(system, q) @ a),
        }

    check(both(*states(3)))
    q, w = jnp.asarray([1.0, 0.0, 0.0, 0.0]), jnp.asarray([0.3, 0.5, -0.7])
    assert_close(jd.forward_dynamics(model, q, w, jnp.zeros(3)), [0.35, -0.21, -0.05], 1e-14)


def hanging(angle):
    """End of a rod of length 1 at an angle from the downward vertical."""
    return jnp.stack([jnp.sin(angle), -jnp.cos(angle)])


FORMULATIONS = ("lagrangian", "immersion", "model", "loop")


@pytest.mark.slow
def test_double_pendulum_in_four_formulations():
    """One mechanism: the same accelerations, energies and equations as printed, for bars and for point masses."""
    built = {name: scenes.double_pendulum(formulation=name) for name in FORMULATIONS}
    points = scenes.double_pendulum(reaches=(1.0, 0.7), moments=(0.0, 0.0), gravity=G).system

    @quick
    @jax.vmap
    def both(angles, rates, a):
        rows, energies = [], []
        for name, scene in built.items():
            q, v = scenes.double_pendulum.start(formulation=name, angles=angles, rates=rates)
            got = jd.constrained_dynamics(scene, q, v).acceleration
            theta = got[0]
            phi = got[0] + got[1] if name == "model" else got[-1]
            rows.append(jnp.stack([theta, phi]))
            kinetic, potential = (jd.kinetic_energy(scene.system, q, v), jd.potential_energy(scene.system, q))
            energies.append(jnp.stack([kinetic, potential]))
        (m1, m2), (l1, l2) = (1.0, 0.5), (1.0, 0.7)
        c, s = jnp.cos(angles[0] - angles[1]), jnp.sin(angles[0] - angles[1])
        rho = matrix([[(m1 + m2) * l1**2, m2 * l1 * l2 * c], [m2 * l1 * l2 * c, m2 * l2**2]])
        D = m2 * l1**2 * l2**2 * (m1 + m2 * s**2)
        gamma = jnp.zeros((2, 2, 2))
        gamma = gamma.at[0, 0, 0].set(m2**2 * l1**2 * l2**2 * c * s / D).at[0, 1, 1].set(m2**2 * l1 * l2**3 * s / D)
        gamma = gamma.at[1, 0, 0].set(-(m1 + m2) * m2 * l1**3 * l2 * s / D)
        gamma = gamma.at[1, 1, 1].set(-(m2**2) * l1**2 * l2**2 * c * s / D)
        pull = G * jnp.stack([(m1 + m2) * l1 * jnp.sin(angles[0]), m2 * l2 * jnp.sin(angles[1])])
        turning = m2 * l1 * l2 * s * jnp.stack([rates[1] ** 2, -(rates[0] ** 2)])
        pairs = {f"acceleration by {name}": (other, rows[0]) for name, other in zip(built, rows, strict=True)}
        pairs |= {f"energy by {name}": (other, energies[0]) for name, other in zip(built, energies, strict=True)}
        # The first link by its angle, the second by its angle and its end: the metric of the separate bodies is singular.
        ends = lambda s: jnp.append(s, l1 * hanging(s[0]) + l2 * hanging(s[1]))  # noqa: E731
        separate = lambda x: jnp.diag(jnp.asarray([m1 * l1**2, 0.0, m2, m2]))  # noqa: E731
        hinge = a  # (Fx, Fy), with which the first link holds the second
        sines, cosines = jnp.sin(angles), jnp.cos(angles)
        lever = lambda i, l: l * (hinge[1] * sines[i] - hinge[0] * cosines[i])  # noqa: E731
        forces = jnp.stack([-m1 * G * l1 * sines[0] + lever(0, l1), lever(1, l2), hinge[0], -hinge[1] - m2 * G])
        return pairs | {
            "metric by pull-back": (geometry.pull_back(separate, ends)(angles), rho),
            "symbols by pull-back": (geometry.christoffel_symbols(geometry.pull_back(separate, ends), angles), gamma),
            "forces by pull-back": (geometry.pull_back(lambda x: forces, ends)(angles), -pull),
            "metric": (jd.mass_matrix(points, angles), rho),
            "symbols": (geometry.christoffel_symbols(points, angles), gamma),
            "motion": (jd.inverse_dynamics(points, angles, rates, a), rho @ a + turning + pull),
        }

    check(both(*states(2)))
    q, v = scenes.double_pendulum.start()
    assert_close(jd.forward_dynamics(points, q, v, 0 * q), [-7.48670516, 11.47569246], 1e-8)  # digits given


@pytest.mark.long
def test_lagrangian_takes_no_more_operations_than_bodies():
    """As operations of JAX, which XLA counts; and the bias of a metric takes fewer than its Christoffel symbols."""

    def operations(function, *arguments):
        with jd.compilation("plain"):
            return jax.jit(jax.vmap(function)).lower(*arguments).compile().cost_analysis()["flops"]

    batch = jnp.ones((4096, 2))
    count = {
        name: operations(lambda q, scene=scene: jd.forward_dynamics(scene.system, q, q, q), batch)
        for name in ("lagrangian", "immersion", "model")
        for scene in (scenes.double_pendulum(formulation=name),)
    }
    assert 0 < count["lagrangian"] < count["immersion"] <= count["model"], count
    metric = scenes.rigid_body_in_euler_angles().system
    symbols = lambda q, v: jnp.einsum("ijk,j,k->i", geometry.christoffel_symbols(metric, q, "first"), v, v)  # noqa: E731
    state = jnp.ones((4096, 3))
    bias = operations(lambda q, v: jd.bias_force(metric, q, v), state, state)
    assert 0 < 1.5 * bias < operations(symbols, state, state)


def test_disk_and_link_in_contact():
    """Printed metric and forces, without and with friction; the reactions are those of the two normal forces."""
    m, m2, moment, moment2, torque = 1.0, 0.6, 0.5, 0.2, 0.7

    @quick
    @jax.vmap
    def both(q, v, force):
        q = 0.4 * q
        f1, f2 = force[0], force[1]
        scene = scenes.disk_and_link(torque=torque, friction=force[:2])
        k, s, c = jnp.tan(q[3]), jnp.sin(q[3]), jnp.cos(q[3])
        along = (q[0] - q[2] + s) / c
        a = along / c
        rho = matrix(
            [
                [m + m2 * k**2, 0, -m2 * k**2, a * m2 * k],
                [0, moment, 0, 0],
                [-m2 * k**2, 0, m2 + m2 * k**2, -a * m2 * k],
                [a * m2 * k, 0, -a * m2 * k, moment2 + m2 * a**2],
            ]
        )
        dry = jnp.stack([-m2 * G * k, 0 * k, m2 * G * k, torque - a * m2 * G])
        friction = jnp.stack([f1 * s * k + f1 * c - f2, -f1 - f2, -f1 * s * k - f1 * c, a * f1 * s])
        pulled = scene.applied_force(q, v) - jd.gravity_force(scene.system, q)
        disk, link = jd.geometry.reaction_force(scene, q, v)
        nu, u = link[1] / c, disk[1] + link[1]
        zero = jnp.zeros(())
        (z1, height, _), (y1, y2, _) = scene.system.configurations(q, zero)
        return {
            "touching": (jnp.stack([(y1 - z1) * s + (y2 - height) * c, height]), jnp.ones(2)),
            "along": ((y1 - z1) * c - (y2 - height) * s, -along),
            "metric": (jd.mass_matrix(scene.system, q), rho),
            "force": (pulled, dry + friction),
            "reaction on the disk": (disk, jnp.stack([-nu * s, u - nu * c, zero])),
            "reaction on the link": (link, jnp.stack([nu * s, nu * c, -nu * along])),
        }

    check(both(*states(4)))


def one_way_block(mass, direction):
    friction = jd.forces.SlidingFriction(0.3, mass * G, direction)
    return jd.Scene(scenes.sliding_block(mass=mass).system, forces=(friction,))


def test_block_slides_until_it_stops():
    """It stops after v0 / (mu g), v0^2 / (2 mu g) further on; slid the other way it is the mirror image."""
    stop = 2.0 / (0.3 * G)
    q0, v0 = scenes.sliding_block.start(velocity=2.0)
    solution = jd.simulate(one_way_block(1.7, 1), q0, v0, jnp.asarray([0.0, stop]), stepsize=stop / 2)
    assert_close(solution.q[-1], [2.0**2 / (2 * 0.3 * G)], 1e-13)  # the method is exact for a parabola
    assert_close(solution.v[-1], [0.0], 1e-13)
    assert_close(one_way_block(1.7, -1).applied_force(q0, -v0), [0.3 * 1.7 * G], 1e-15)


@pytest.mark.long
def test_a_block_that_has_stopped_gains_no_energy():
    """Past its stop adaptive steps end with a code, and fixed ones stay at rest to the change of a step."""
    stop, h = 2.0 / (0.3 * G), 1e-3
    scene, (q0, v0) = one_way_block(1.0, 1), scenes.sliding_block.start(velocity=2.0)
    ts = jnp.asarray([0.0, 3 * stop])
    with pytest.raises(RuntimeError, match=r"jd\.contact\.DryFriction"):
        jd.simulate(scene, q0, v0, ts, stepsize=jd.simulation.Steps(max_steps=500))
    solution = jd.simulate(scene, q0, v0, ts, throw=False, stepsize=jd.simulation.Steps(max_steps=500))
    assert not bool(solution.success) and abs(float(solution.stats["time_reached"]) - stop) < 1e-3
    solution = jd.simulate(scene, q0, v0, ts, stepsize=h, throw=False)
    assert abs(float(solution.v[-1, 0])) < 0.3 * G * h and abs(float(solution.q[-1, 0]) - 4 / (0.6 * G)) < 2 * h
    assert_close(scene.applied_force(q0, -v0), [0.3 * G], 1e-15)


def test_derivatives_at_rest():
    """Parameters reach through an immersion; first and second derivatives agree with the Lagrangian's, hanging still."""

    def acceleration(formulation, x):
        scene = scenes.double_pendulum(
            formulation=formulation, masses=(x[0], x[1]), length=x[2], reaches=(x[3], x[4]), gravity=x[5]
        )
        return jd.forward_dynamics(scene.system, x[6:8], x[8:10], jnp.zeros(2))

    at = jnp.asarray([1.0, 0.5, 1.0, 0.5, 0.35, G, 0.0, 0.0, 0.0, 0.0])
    both = quick(
        lambda x: [
            (jax.jacrev(f)(x), jax.jacfwd(jax.jacrev(f))(x))
            for f in (lambda x: acceleration("lagrangian", x), lambda x: acceleration("immersion", x))
        ]
    )
    (first, second), (other, twice) = both(at)
    assert_close(first, other, 1e-11)
    assert_close(second, twice, 1e-11)


def test_separate_scenes_are_joined_with_their_forces():
    """Kron's method with forces on each unit, moving: a motor drives one end of a spring, through both frictions."""

    def sliding(mass):
        return jd.LagrangianSystem(lambda q, v, t, p: 0.5 * p * v[0] ** 2 - 2.0 * q[0] ** 2, 1, parameters=mass)

    units = tuple(jd.Scene(sliding(m), forces=(jd.forces.JointDamping(c),)) for m, c in ((1.3, 0.4), (0.7, 0.9)))
    between = lambda q, v, t: (3.0 * jnp.ones(1), jnp.sin(q[0]))  # noqa: E731
    xi = lambda s, t: (2.0 * s, 3.0 * s + jnp.sin(t))  # noqa: E731
    scene = jd.geometry.constrain_by_immersion(units, xi, 1, moving=True, force=between)
    s, v, t = jnp.asarray([0.3]), jnp.asarray([-0.6]), jnp.asarray(0.4)

    @quick
    def compute(s, v, t):
        reactions = jd.geometry.reaction_force(scene, s, v, (jnp.ones(1), jnp.zeros(1)), t)
        return jd.constrained_dynamics(scene, s, v, t=t).acceleration, reactions

    a, reactions = jax.tree.map(np.asarray, compute(s, v, t))
    s, v, t = (np.asarray(x) for x in (s, v, t))
    first, second = 2.0 * v, 3.0 * v + np.cos(t)
    place = 3.0 * s + np.sin(t)
    mass = 4 * 1.3 + 9 * 0.7
    force = 2 * (3.0 - 0.4 * first - 8.0 * s) + 3 * (np.sin(2 * s) - 0.9 * second - 4.0 * place + 0.7 * np.sin(t))
    assert_close(a, force / mass, 1e-13)
    pushed = a + 2.0 / mass  # the force on the first unit is one larger
    want = 1.3 * 2 * pushed + 8.0 * s - 4.0 + 0.4 * first
    assert_close(reactions[0], want, 1e-13)
    assert_close(3 * reactions[1], -2 * reactions[0], 1e-13)
    with pytest.raises(ValueError, match="force has 1"):
        jd.geometry.reaction_force(scene, jnp.asarray(s), jnp.asarray(v), (jnp.ones(1),), t)


def test_inertia_of_a_box_and_its_change_of_frame():
    """Printed moments of a box, and M_2 = Ad^T M_1 Ad, V_1 = Ad V_2 for frames fixed to one body."""
    mass, (l, w, h) = 2.4, (0.3, 0.5, 0.8)
    moments = mass / 12 * np.array([w * w + h * h, l * l + h * h, l * l + w * w])
    M = np.diag([mass] * 3 + list(moments))
    pose = se3.exp(jnp.asarray([0.3, -0.2, 0.5, 0.4, 1.1, -0.6]))
    centred, moved = (scenes.free_box(mass=mass, size=(l, w, h), frame=frame).system for frame in (None, pose))
    q, V = scenes.free_box.start(velocity=(0.3, -1.0, 0.4))
    computed = quick(lambda q, V: [(jd.mass_matrix(m, q), jd.kinetic_energy(m, q, V)) for m in (centred, moved)])
    ((at_centre, energy), (away, other)), Ad = computed(q, V), se3.Ad(pose)
    assert_close(at_centre, M, 1e-15)
    assert_close(energy, mass * V[:3] @ V[:3] / 2 + V[3:] @ (moments * V[3:]) / 2, 1e-14)
    assert_close(away, Ad.T @ M @ Ad, 1e-13)
    assert_close(other, (Ad @ V) @ M @ (Ad @ V) / 2, 1e-13)


def test_unknown_formulations_are_refused():
    with pytest.raises(ValueError, match="formulation is 'newton'"):
        scenes.double_pendulum(formulation="newton")
    with pytest.raises(ValueError, match=r"takes moments\[1\]"):
        scenes.double_pendulum(formulation="loop", moments=(0.0, 0.0))
