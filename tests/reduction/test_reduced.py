"""Reduced dynamics against Kane's equations body by body, the saddle-point solve, and closed forms; motions against them."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn import scenes
from jaxdyn.compile import kernels
from jaxdyn.reduction.bases import as_basis, independent_velocities

RHO = 0.5


def disk_basis(q, t):
    """Columns for the heading rate and the rolling rate."""
    zero, one = jnp.zeros_like(q[0]), jnp.ones_like(q[0])
    roll = jnp.stack([RHO * jnp.cos(q[2]), RHO * jnp.sin(q[2]), zero, one])
    return jnp.stack([jnp.stack([zero, zero, one, zero]), roll], 1)


def body_twists(model, q, v):
    """Body twists (nb, 6), by differentiating the poses along the motion."""
    pose, rate = jax.jvp(lambda q: jd.forward_kinematics(model, q), (q,), (jd.configuration_rate(model, q, v),))
    hat = jnp.linalg.inv(pose) @ rate
    return jnp.stack([hat[:, 0, 3], hat[:, 1, 3], hat[:, 2, 3], hat[:, 2, 1], hat[:, 0, 2], hat[:, 1, 0]], 1)


def kane(scene, q, nu, tau, basis):
    """Kane's equations: partial twists of every body times its active and inertia wrenches; (mass, bias, force)."""
    model, choice = scene.system, as_basis(basis, scene)

    def motion(q, t, nu):
        place = choice.at(scene, q, t)
        return place.N @ nu + place.v0

    @quick
    def twists(q, nu, nu_rate):
        f = lambda q, t, nu: body_twists(model, q, motion(q, t, nu))  # noqa: E731
        v, t = motion(q, jnp.zeros(()), nu), jnp.zeros(())
        V, A = jax.jvp(f, (q, t, nu), (jd.configuration_rate(model, q, v), jnp.ones(()), nu_rate))
        return V, A, v, jd.forward_kinematics(model, q)[:, :3, :3]

    nu, units = np.asarray(nu), np.eye(len(nu))
    V, A, v, rotations = (np.asarray(x) for x in twists(q, nu, 0 * nu))
    # V and v are affine in nu, A in its rate.
    changes = [[np.asarray(x) for x in twists(q, nu + unit, 0 * nu)] for unit in units]
    partial = np.stack([change[0] - V for change in changes])
    force = np.stack([change[2] - v for change in changes]) @ np.asarray(tau)

    def inertia_wrenches(A):
        total = []
        for parameters, twist, rate, rotation in zip(np.asarray(model.inertias), V, A, rotations, strict=True):
            m, mc = parameters[0], parameters[1:4]
            xx, xy, yy, xz, yz, zz = parameters[4:]
            about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            g = np.zeros(3) if model.gravity is None else rotation.T @ np.asarray(model.gravity)
            # Momentum about the body's origin, and its rate in the turning axes.
            linear = lambda x, m=m, mc=mc: m * x[:3] + np.cross(x[3:], mc)  # noqa: E731
            angular = lambda x, mc=mc, about=about: np.cross(mc, x[:3]) + about @ x[3:]  # noqa: E731
            v, w = twist[:3], twist[3:]
            push = linear(rate) + np.cross(w, linear(twist)) - m * g
            turn = angular(rate) + np.cross(w, angular(twist)) + np.cross(v, linear(twist)) - np.cross(mc, g)
            total.append(np.concatenate([push, turn]))
        return np.stack(total)

    equations = lambda A: np.einsum("rbi,bi->r", partial, inertia_wrenches(A))  # noqa: E731
    bias = equations(A)
    mass = np.stack([equations(np.asarray(twists(q, nu, unit)[1])) - bias for unit in units], 1)
    return mass, bias, force


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "kept"), [("four_bar", (0,)), ("chaplygin_sleigh", (0, 2))], ids=["four-bar", "sleigh"]
)
def test_reduced_equations_are_those_of_kane(name, kept):
    """A loop of three bodies in one of its velocities; a body with v != dq/dt in an orthonormal basis."""
    family = getattr(scenes, name)
    scene, (q, v) = family(), family.start()
    tau = jnp.asarray(np.random.default_rng(1).normal(size=scene.nv))
    basis = kept if name == "four_bar" else jd.reduction.tangent_basis(scene, q)

    @quick
    def compute(q, v, tau):
        place = as_basis(basis, scene).at(scene, q, jnp.zeros(()))
        nu = jnp.linalg.lstsq(place.N, v - place.v0)[0]
        reduced = jd.reduced_dynamics(scene, q, nu, tau, basis=basis)
        return nu, reduced, jd.constrained_dynamics(scene, q, v, tau).acceleration

    nu, reduced, a = compute(q, v, tau)
    mass, bias, force = kane(scene, q, nu, tau, basis)
    assert nu.shape == (len(kept),)
    assert bool(reduced.result == jd.RESULTS.successful)
    assert_close(reduced.mass_matrix, mass, 1e-11)
    assert_close(reduced.bias_force, bias, 1e-11)
    assert_close(reduced.force, force, 1e-11)
    assert_close(reduced.velocity, v, 1e-12)
    assert_close(reduced.acceleration, a, 1e-10)


def test_rolling_disk_in_two_velocities():
    """Mass diag(I1, I2 + m rho^2), no bias, I1 thdd = tau_theta, (I2 + m rho^2) phdd = tau_phi (EQUATIONS section 6)."""
    m, steer, roll = 2.0, 0.125, 0.25
    scene = scenes.rolling_disk(mass=m, radius=RHO, steer_inertia=steer, roll_inertia=roll)
    q, v = scenes.rolling_disk.start(radius=RHO, heading=0.7, steering=1.3, rolling=2.0)
    nu, tau = v[2:], jnp.asarray([0.2, -0.4, 0.3, 0.9])
    c, s = np.cos(0.7), np.sin(0.7)
    push = [0.3, 0.9 + RHO * (0.2 * c - 0.4 * s)]
    rate = np.array(push) / [steer, roll + m * RHO**2]
    forward = RHO * np.array([rate[1] * c - 1.3 * 2.0 * s, rate[1] * s + 1.3 * 2.0 * c])
    solve = quick(lambda q, nu, tau: [jd.reduced_dynamics(scene, q, nu, tau, basis=b) for b in ((2, 3), disk_basis)])
    for computed in solve(q, nu, tau):
        assert_close(computed.mass_matrix, np.diag([steer, roll + m * RHO**2]), 1e-14)
        np.testing.assert_allclose(computed.bias_force, 0, atol=1e-14)
        assert_close(computed.force, push, 1e-14)
        assert_close(computed.nu_rate, rate, 1e-13)
        assert_close(computed.acceleration, [*forward, *rate], 1e-13)


@pytest.mark.long
def test_constraints_that_move_with_a_prescribed_slip():
    """A(q, t) v = b(q, t) with all of them varying, against the saddle-point system; a basis of one's own with its v0."""

    def lagrangian(q, v):
        return 0.5 * (v[0] ** 2 + (2.0 + jnp.cos(q[0])) * v[1] ** 2 + v[2] ** 2) + 0.3 * v[0] * v[2] - q[1] ** 2

    def row(q, t):
        return jnp.stack([jnp.sin(q[1]) + 2.0, q[2], 1.0 + t * q[0]])

    def slip(q, t):
        return jnp.cos(t) * q[1]

    def basis(q, t):
        a, b = row(q, t), slip(q, t)
        zero, one = jnp.zeros_like(t), jnp.ones_like(t)
        N = jnp.stack([jnp.stack([-a[1] / a[0], one, zero]), jnp.stack([-a[2] / a[0], zero, one])], 1)
        return N, jnp.stack([b / a[0], zero, zero])

    scene = jd.Scene(jd.LagrangianSystem(lagrangian, 3), (jd.Pfaffian(row, slip, name="slip"),))
    q, t = jnp.asarray([0.4, -0.3, 0.8]), jnp.asarray(0.7)
    tau, nu = jnp.asarray([0.1, 0.5, -0.2]), jnp.asarray([0.6, -0.9])

    @quick
    def compute(q, nu, tau, t):
        one = jd.reduced_dynamics(scene, q, nu, tau, t, basis=(1, 2))
        other = jd.reduced_dynamics(scene, q, nu, tau, t, basis=basis)
        near = as_basis(jnp.eye(3)[:, 1:], scene)
        place = near.at(scene, q, t)
        own = place.N.T @ (one.velocity - place.v0)
        last = jd.reduced_dynamics(scene, q, own, tau, t, basis=near)
        return one, other, last, jd.constrained_dynamics(scene, q, one.velocity, tau, t).acceleration

    *computed, a = compute(q, nu, tau, t)
    for reduced in computed:
        assert bool(reduced.result == jd.RESULTS.successful)
        np.testing.assert_allclose(row(q, t) @ reduced.velocity, slip(q, t), rtol=1e-12)
        assert_close(reduced.acceleration, a, 1e-12)
    assert_close(computed[1].nu_rate, computed[0].nu_rate, 1e-12)


def test_orthonormal_basis_is_smooth_and_can_be_continued():
    """Along a turn of the disk: orthonormal, tangent, differentiable; a new reference does not change N; no jumps."""
    scene = scenes.rolling_disk(radius=2.0)  # a fixed reference becomes singular half a turn away
    place = lambda angle: jnp.asarray([0.1, -0.2, 0.0, 0.3]).at[2].set(angle)  # noqa: E731
    start = jd.reduction.tangent_basis(scene, place(0.0))

    @quick
    def at(angle, reference):
        f = lambda angle: as_basis(reference, scene).at(scene, place(angle), jnp.zeros(())).N  # noqa: E731
        return (
            *jax.jvp(f, (angle,), (jnp.ones(()),)),
            as_basis(reference, scene).at(scene, place(angle), 0.0 * angle).quality,
        )

    N, rate, _ = at(0.4, start)
    assert_close(N.T @ N, np.eye(2), 1e-14)
    h = 1e-3
    f = lambda angle: at(angle, start)[0]  # noqa: E731
    want = (8 * (f(0.4 + h) - f(0.4 - h)) - (f(0.4 + 2 * h) - f(0.4 - 2 * h))) / (12 * h)
    np.testing.assert_allclose(rate, want, atol=1e-11)  # h^4 times the fifth derivative
    np.testing.assert_allclose(at(0.4, N)[0], N, atol=1e-15)
    angles = np.linspace(0.0, 2 * np.pi, 41)
    reference, steps = start, []
    for angle in angles:
        N, _, quality = at(angle, reference)
        assert float(quality) > 0.9
        steps.append(np.abs(N - reference).max())
        reference = N
    assert max(steps) < 2 * np.pi / 40
    # Radius 2: <R, N> of the rolling column is (1 + 4 cos(angle))/5, zero at 1.82 rad.
    assert abs(float(at(np.arccos(-0.25), start)[2])) < 1e-6


@pytest.mark.long
def test_a_singular_choice_is_reported():
    """Where the pendulum is level, x does not determine y; a traced place gets the code, a concrete one the fix."""
    scene, level = scenes.pendulum_in_plane(), jnp.asarray([1.0, 0.0])
    codes = quick(
        jax.vmap(lambda q: jd.reduced_dynamics(scene, q, jnp.ones(1), basis=(0,)).result == jd.RESULTS.singular_basis)
    )
    assert codes(jnp.stack([jnp.asarray([0.6, -0.8]), level])).tolist() == [False, True]
    with pytest.raises(ValueError, match=r"basis is not valid at this q: choose other .*, here \(1,\) of 2"):
        jd.reduced_dynamics(scene, level, jnp.ones(1), basis=(0,))
    # The same row twice; lam = -(m/l^2)(|v|^2 - g y) gives the motion of EQUATIONS section 6.
    twice = jd.Scene(scene.system, scene.constraints * 2)
    q = jnp.asarray([0.6, -0.8])
    for basis, nu in (((0,), 1.2), (jd.reduction.tangent_basis(twice, q, dof=1), 1.5)):
        dynamics = quick(lambda q, nu, basis=basis: jd.reduced_dynamics(twice, q, nu, basis=basis))(
            q, jnp.asarray([nu])
        )
        speed = dynamics.velocity @ dynamics.velocity
        assert_close(dynamics.acceleration, jnp.asarray([0.0, -9.81]) - (speed + 9.81 * 0.8) * q, 1e-12)
        assert_close(speed, 1.5**2, 1e-12)
    disk, (q, v) = scenes.rolling_disk(), scenes.rolling_disk.start()
    with pytest.raises(ValueError, match=r"return 2 independent columns .* \(rank 1 of 2, largest"):
        jd.reduced_dynamics(disk, q, v[2:], basis=lambda q, t: disk_basis(q, t)[:, :1] * jnp.ones((1, 2)))
    with pytest.raises(ValueError, match=r"\(rank 2 of 2, largest \|A N\| 0.5\)"):
        jd.reduced_dynamics(disk, q, v[2:], basis=lambda q, t: 2 * disk_basis(q, t) - jnp.eye(4)[:, 2:])
    with pytest.raises(ValueError, match=r"return 2 independent columns .* \(rank 1 of 1, largest \|A N\| 0\)"):
        jd.reduced_dynamics(disk, q, v[2:3], basis=lambda q, t: disk_basis(q, t)[:, :1])
    assert independent_velocities(disk, q) in ((1, 2), (2, 3), (0, 2))


def test_bad_arguments():
    scene, (q, v) = scenes.rolling_disk(), scenes.rolling_disk.start()
    bad = {
        (2, 2): "give different indices",
        (7,): "each 0 to 3",
        "qr": "tuple of indices",
        None: "tuple of indices",
        (0, 1, 2): r"nu has shape \(2,\), expected \(3,\)",
        (0, 1, 2, 3): r"basis is \(0, 1, 2, 3\), all velocities; leave out those",
    }
    for basis, message in bad.items():
        with pytest.raises(ValueError, match=message):
            jd.reduced_dynamics(scene, q, v[2:], basis=basis)
    with pytest.raises(ValueError, match=r"basis has shape \(3, 2\), expected \(4, nr\)"):
        jd.reduced_dynamics(scene, q, v[2:], basis=jnp.ones((3, 2)))
    with pytest.raises(ValueError, match=r"basis returned shape \(2,\)"):
        jd.reduced_dynamics(scene, q, v[2:], basis=lambda q, t: q[:2])
    functions = (
        (lambda q: disk_basis(q, 0.0), r"basis takes \(q\), but is called as \(q, t\)"),
        (lambda q, t: None, "basis: the returned N is"),
        (lambda q, t: disk_basis(q, t).astype(complex), "basis: the returned N is complex"),
        (lambda q, t: (disk_basis(q, t), q.astype(complex)), "basis: the returned v0 is complex"),
        (lambda q, t: (disk_basis(q, t),), r"basis returned shape \(1, 4, 2\)"),
    )
    for function, message in functions:
        with pytest.raises(ValueError, match=message):
            jd.reduced_dynamics(scene, q, v[2:], basis=function)
    with pytest.raises(ValueError, match="basis is complex"):
        jd.reduced_dynamics(scene, q, v[2:], basis=disk_basis(q, 0.0).astype(complex))
    with pytest.raises(ValueError, match=r"basis takes \(q\), but is called as \(q, t\)"):
        jd.Reduced(lambda q: disk_basis(q, 0.0))
    with pytest.raises(ValueError, match="no constraints"):
        jd.reduced_dynamics(jd.Scene(scene.system), q, v, basis=(0,))
    twice, q = scenes.pendulum_in_plane(), jnp.asarray([0.6, -0.8])
    twice = jd.Scene(twice.system, twice.constraints * 2)
    assert jd.reduction.tangent_basis(twice, q).shape == (2, 1)
    with pytest.raises(ValueError, match="give dof"):
        jax.jit(lambda q: jd.reduction.tangent_basis(twice, q))(q)
    # One velocity is tangent to the circle: two columns would break the row.
    with pytest.raises(ValueError, match="dof is 2, but the rows leave 1 of nv = 2"):
        jd.reduction.tangent_basis(twice, q, dof=2)
    assert np.isnan(quick(lambda q: jd.reduction.tangent_basis(twice, q, dof=2))(q)).all()


@pytest.mark.slow
def test_derivatives_at_rest_and_float32():
    """Second derivatives of the reduced equations at rest are finite; float32 keeps its type."""
    scene, (q, v) = scenes.spherical_pendulum(), scenes.spherical_pendulum.start()
    reference = jd.reduction.tangent_basis(scene, q)
    value = lambda x: jnp.sum(jd.reduced_dynamics(scene, q + x[:3], x[3:], basis=reference).acceleration)  # noqa: E731
    curve, slope = quick(jax.jacfwd(lambda x: 2 * (jax.grad(value)(x),), has_aux=True))(jnp.zeros(5))
    assert np.isfinite(curve).all()
    assert_close(curve, curve.T, 1e-12)
    # At rest a = -g (z - z q q^T / |q|^2), whatever nu is to first order.
    pull = jax.grad(lambda q: jnp.sum(-9.81 * (jnp.eye(3)[2] - q[2] * q / (q @ q))))(q)
    assert_close(slope, [*pull, 0.0, 0.0], 1e-12)

    scene, (q, v) = scenes.rolling_disk(), scenes.rolling_disk.start(heading=0.4)
    low = jax.tree.map(lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, (scene, q, v))
    for basis in ((2, 3), jd.reduction.tangent_basis(scene, q)):
        dynamics = quick(lambda scene, q, nu, basis=basis: jd.reduced_dynamics(scene, q, nu, basis=basis))(
            low[0], low[1], low[2][2:]
        )
        assert dynamics.acceleration.dtype == dynamics.mass_matrix.dtype == jnp.float32
        assert bool(dynamics.result == jd.RESULTS.successful)
        exact = jd.constrained_dynamics(scene, q, jnp.asarray(dynamics.velocity, jnp.float64)).acceleration
        np.testing.assert_allclose(dynamics.acceleration, exact, atol=1e-5)


TIGHT = {"stepsize": jd.simulation.Steps(rtol=1e-12, atol=1e-12)}


def moved(scene, state, ts, outputs=("constraint_residual",), **options):
    """Solution from a start, compiled without optimisation."""
    run = quick(lambda scene, q, v, ts: jd.simulate(scene, q, v, ts, outputs=outputs, **(TIGHT | options)))
    return run(scene, *state, jnp.asarray(ts))


def steering(q, v, t):
    """Torques on the disk's heading and rolling that change with time and state."""
    zero = jnp.zeros_like(t)
    return jnp.stack([zero, zero, 0.1 * jnp.cos(t) - 0.02 * v[2], 0.3 * jnp.sin(2 * t)])


@pytest.mark.slow
def test_rolling_disk_with_torques_full_and_reduced():
    """Four coordinates with multipliers and two velocities: one motion to 1e-10; m d/dt (rho phidot (cos, sin))."""
    scene, state = scenes.rolling_disk(mass=2.0, radius=RHO), scenes.rolling_disk.start(radius=RHO)
    ts = np.linspace(0.0, 5.0, 6)
    wanted = ("multipliers", "acceleration", "constraint_residual")
    full = moved(scene, state, ts, wanted, control=steering)
    for method in (jd.Reduced((2, 3)), "reduced"):
        computed = moved(scene, state, ts, wanted, control=steering, method=method)
        assert bool(computed.success) and bool(full.success)
        np.testing.assert_allclose(computed.q, full.q, atol=1e-10)
        np.testing.assert_allclose(computed.v, full.v, atol=1e-10)
        assert float(computed.constraint_residual.max()) < 1e-13
        (_, _, theta, _), (_, _, turn, roll), rate = computed.q.T, computed.v.T, computed.acceleration[:, 3]
        c, s = np.cos(theta), np.sin(theta)
        force = 2.0 * RHO * np.stack([rate * c - turn * roll * s, rate * s + turn * roll * c], 1)
        np.testing.assert_allclose(computed.multipliers, force, atol=1e-12)
    # d/dt of the energy is the power of the two torques: rates by the decoupled equations of EQUATIONS section 6.
    q, v = np.asarray(full.q), np.asarray(full.v)
    torques = np.stack([steering(q[i], v[i], jnp.asarray(ts[i])) for i in range(6)])
    np.testing.assert_allclose(full.acceleration[:, 2:], torques[:, 2:] / [0.125, 0.25 + 2.0 * RHO**2], atol=1e-10)


@pytest.mark.long
@pytest.mark.parametrize("method", [jd.Reduced((0, 2)), pytest.param("reduced", marks=pytest.mark.slow)], ids=str)
def test_sleigh_in_minimal_velocities(method):
    """tanh and sech: printed state at t = 10, v = (forward, sideways, yaw rate) with the yaw rate and speed kept."""
    computed = moved(scenes.chaplygin_sleigh(), scenes.chaplygin_sleigh.start(), [0.0, 10.0], method=method)
    assert bool(computed.success)
    np.testing.assert_allclose(computed.q[-1], [-8.600842105481, -0.4306517115655, 3.570508149338], atol=1e-10)
    np.testing.assert_allclose(computed.v[-1], [1.169390226108, 0.0, 0.00670176830728], atol=1e-10)


@pytest.mark.long
def test_pendulum_in_one_velocity():
    """Holonomic rows: exact positions of problem A01 (elliptic functions), q on the constraint to rounding."""
    computed = moved(
        scenes.pendulum_in_plane(), scenes.pendulum_in_plane.start(), [0.0, 1.0, 5.0, 10.0], method="reduced"
    )
    assert bool(computed.success)
    assert float(computed.constraint_residual.max()) < 1e-13
    want = [
        [-1.0, 0.0],
        [0.986291751131875319, -0.165010853125541169],
        [-0.942305435043757335, -0.334754338414000581],
        [-0.27508746257611686, -0.961419205099125064],
    ]
    np.testing.assert_allclose(computed.q, want, atol=1e-10)


@pytest.mark.native
@pytest.mark.parametrize("name", ["four_bar", "rolling_disk"])
def test_motions_are_one_native_loop(name, monkeypatch):
    """With the default basis, whose rank is decided in every stage. By XLA a step costs ten times as much."""
    monkeypatch.setattr(kernels, "_run_by_jax", None)
    scene, start = getattr(scenes, name)(), getattr(scenes, name).start()
    motions = [
        jd.simulate(scene, *start, jnp.linspace(0.0, 0.2, 3), method=method) for method in ("reduced", "projected")
    ]
    np.testing.assert_allclose(motions[0].q, motions[1].q, atol=1e-7)


@pytest.mark.slow
def test_a_basis_that_becomes_singular_ends_the_run():
    """A pendulum that swings to the level: x serves until there; adaptive steps stop before, fixed ones just behind."""
    scene, state = scenes.pendulum_in_plane(), scenes.pendulum_in_plane.start(angle=0.0, rate=6.0)
    ts = np.linspace(0.0, 1.0, 21)
    whole = moved(scene, state, ts, method="reduced")
    assert bool(whole.success)
    level = np.interp(0.0, np.asarray(whole.q[:9, 1]), ts[:9])
    for stepsize, late in ((None, 1e-3), (0.01, 0.011)):
        run = quick(
            lambda step=stepsize: jd.simulate(scene, *state, jnp.asarray(ts), method=jd.Reduced((0,)), stepsize=step)
        )
        computed = run()
        assert bool(computed.result == jd.RESULTS.singular_basis)
        assert -5e-3 < float(computed.stats["time_reached"]) - level < late + 5e-3  # `level` is interpolated linearly
        before = ts < level - 0.01
        np.testing.assert_allclose(computed.q[before], whole.q[before], atol=1e-6)
        assert np.isnan(computed.q[ts > level + 0.05]).all()
    with pytest.raises(RuntimeError, match=r"stopped at t = 0\.\d+ s of 1 s. The minimal velocities .* jd.Reduced\(\)"):
        jd.simulate(scene, *state, ts, method=jd.Reduced((0,)))
    with pytest.raises(
        ValueError, match=r"basis is not regular at q0: choose other independent velocities, here \(1,\)"
    ):
        jd.simulate(scene, *scenes.pendulum_in_plane.start(), ts, method=jd.Reduced((0,)))
    with pytest.raises(ValueError, match="cannot follow the basis"):
        jd.simulate(scene, *state, ts, method="reduced", adjoint="backsolve")


def test_accelerations_of_baumgarte():
    """phi'' + 2 alpha phi' + beta^2 phi = 0 along them."""
    scene, (q, v) = scenes.pendulum_in_plane(), scenes.pendulum_in_plane.start(angle=0.4, rate=0.5)
    alpha, beta = 3.0, 5.0
    off, drift = q * 1.01, v + jnp.asarray([0.1, 0.02])
    a = quick(lambda q, v: jd.simulation.Baumgarte(alpha, beta).acceleration(scene, q, v, jnp.zeros(()), None))(
        off, drift
    )
    off, drift, a = np.asarray(off), np.asarray(drift), np.asarray(a)
    phi, rate = 0.5 * (off @ off - 1.0), off @ drift
    np.testing.assert_allclose(off @ a + drift @ drift, -2 * alpha * rate - beta**2 * phi, rtol=1e-12)


@pytest.mark.slow
def test_baumgarte_pulls_back_but_errs():
    """The residual is between those of the other methods."""
    scene, (q, v) = scenes.pendulum_in_plane(), scenes.pendulum_in_plane.start(angle=0.4, rate=0.5)
    options = {"stepsize": jd.simulation.Steps(rtol=1e-8, atol=1e-8)}
    opened, pulled, held = (
        moved(scene, (q, v), [0.0, 5.0], method=method, **options).constraint_residual[-1, 0]
        for method in ("multipliers", "baumgarte", "projected")
    )
    assert held < 1e-14 < pulled < 0.1 * opened


@pytest.mark.slow
def test_large_batches_end():
    """Two LAPACK calls of a large batch at once can wait for each other for ever (jaxlib 0.10): there are never two.

    In a process of its own, as one that is blocked cannot be stopped from within.
    """
    program = """
import jax, numpy as np, jaxdyn as jd
jax.config.update("jax_enable_x64", True)
from benchmarks.report_cases.test_set import andrews
scene = andrews()
q, v = andrews.start()

def success(share):
    ts, steps = jax.numpy.stack([0 * share, 0.002 * share]), jd.simulation.Steps(rtol=1e-4, atol=1e-4, max_steps=4096)
    return jd.simulate(scene, q, v, ts, method="reduced", stepsize=steps, throw=False).success

found = jax.jit(jax.vmap(success))
for _ in range(4):
    assert np.all(found(np.linspace(0.5, 1.0, 1024)))
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=600)


def test_without_constraints_it_is_the_dynamics_of_the_scene():
    """nu = v, N = 1, with the scene's forces."""
    model = jd.robots.chain(3)
    scene = jd.Scene(model, forces=(jd.forces.JointDamping(0.3),))
    q, v, tau = jnp.array([0.4, -0.9, 1.3]), jnp.array([1.1, 0.2, -0.7]), jnp.array([0.5, -0.2, 0.1])
    dynamics = quick(lambda q, v, tau: jd.reduced_dynamics(scene, q, v, tau))(q, v, tau)
    assert bool(dynamics.success)
    assert_close(dynamics.mass_matrix, jd.mass_matrix(model, q), 1e-13)
    assert_close(dynamics.bias_force, jd.bias_force(model, q, v), 1e-12)
    assert_close(dynamics.acceleration, jd.forward_dynamics(model, q, v, tau - 0.3 * v), 1e-12)
    assert_close(dynamics.nu_rate, dynamics.acceleration, 1e-13)
    assert_close(dynamics.velocity, v, 1e-15)
