"""Steps of fixed length through contacts: Coulomb's law, closed forms, loops, limits and derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import slider
from motion_helpers import within
from refusals import refusals

import jaxdyn as jd
from jaxdyn.compile import kernel
from jaxdyn.contact import coulomb

G = 9.81
CORNERS = np.array([(a, b, -0.1) for a in (-0.3, 0.3) for b in (-0.2, 0.2)])
STILL = jnp.zeros(6)


def free_body(contacts, inertia=(0.1, 0.2, 0.15), dtype=None):
    builder = jd.ModelBuilder("body", dtype=dtype)
    builder.add_body("body", None, "free", (1.0, (0.0, 0.0, 0.0), inertia))
    return jd.Scene(builder.build(), forces=contacts)


@functools.cache
def box(friction=0.5, restitution=0.0, slope=0.0, corners=4, turns=0.0):
    """A box of 1 kg on four corners, or on eight, four of them at a wall of the same slope about y."""
    plane = ((0.0, 0.0, 0.0), (0.0, slope, turns))
    points = [(point, plane) for point in CORNERS]
    if corners == 8:  # each corner twice
        points = points + points
    contacts = [
        jd.contact.ground_contact("body", p, friction, restitution=restitution, plane=at, name=f"{i}")
        for i, (p, at) in enumerate(points)
    ]
    return free_body(contacts)


@functools.cache
def ball(friction, restitution=0.0, radius=0.1):
    contact = jd.contact.ground_contact("body", None, friction, restitution=restitution, radius=radius, name="0")
    return free_body([contact], (0.4 * radius**2,) * 3)


def on_slope(slope):
    place = 0.1 * np.array([np.sin(slope), 0.0, np.cos(slope)])
    return jnp.asarray([*place, np.cos(slope / 2), 0.0, np.sin(slope / 2), 0.0])


def run(scene, dt, start, count, tau=STILL, **options):
    """States and reports of `count` steps."""
    step = jd.stepper(scene, dt, report=True, **options)

    def advance(state, _):
        state, report = step(state, tau)
        return state, (state, report)

    return jax.lax.scan(advance, start, None, length=count)[1]


def moved(scene, dt, start, count, *tau, **options):
    """The same by one program."""
    return jax.jit(lambda start, *tau: run(scene, dt, start, count, *tau, **options))(start, *tau)


def table(friction):
    """A body on a grid of points."""
    places = [(x, y, -0.1) for x in (-0.3, -0.1, 0.1, 0.3) for y in (-0.2, 0.0, 0.2)]
    return free_body([jd.contact.ground_contact("body", at, friction, name=f"{i}") for i, at in enumerate(places)])


GROUNDED = jnp.asarray([0, 0, 0.1, 1, 0, 0, 0.0])


def turn(quaternion):
    """Rotation matrix, by hand."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * K + 2 * K @ K


@pytest.mark.long
@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_velocities_and_forces_satisfy_coulombs_law(restitution):
    """Boxes that are thrown: every corner after every step, by the geometry of a rigid body in NumPy."""
    mu, dt, rng = 0.4, 0.01, np.random.default_rng(0)
    q = np.tile([0, 0, 0.25, 1, 0, 0, 0.0], (16, 1)) + 0.3 * rng.normal(size=(16, 7)) * [0, 0, 0, 1, 1, 1, 1]
    q[:, 3:] /= np.linalg.norm(q[:, 3:], axis=1)[:, None]
    v = rng.normal(size=(16, 6))
    scene = box(mu, restitution)
    (qs, vs), report = jax.jit(jax.vmap(lambda q, v: run(scene, dt, (q, v), 60)))(q, v)
    assert np.asarray(report.success).all()
    qs, vs = np.asarray(qs), np.asarray(vs)
    forces = np.stack([report.forces[f"{i}"] for i in range(4)], 2)
    stuck = slid = open_ = 0
    residuals = []
    for q, v, force in zip(qs.reshape(-1, 7), vs.reshape(-1, 6), forces.reshape(-1, 4, 3), strict=True):
        R = turn(q[3:])
        for point, f in zip(CORNERS, force, strict=True):
            velocity, gap = R @ (v[:3] + np.cross(v[3:], point)), (q[:3] + R @ point)[2]
            slip, scale = velocity[:2], 10.0 / dt  # impulses of 0.1 N s over a step
            assert f[2] >= -1e-10 * scale
            residuals.append((np.linalg.norm(f[:2]) - mu * f[2]) / scale)
            # Friction opposes sliding with all of its force: the residual of the cone.
            residuals.append(np.linalg.norm(mu * f[2] * slip + np.linalg.norm(slip) * f[:2]) / scale)
            if f[2] <= 1e-9 * scale:
                open_ += 1
                # It stays open in the next step, but for what forces move it in one.
                assert gap + dt * velocity[2] >= -G * dt**2 or gap < 0
            elif restitution == 0 and gap >= 0:
                assert abs(gap + dt * velocity[2]) <= 1e-6 * dt
            stuck += f[2] > 1e-6 and np.linalg.norm(slip) < 1e-10
            slid += f[2] > 1e-6 and np.linalg.norm(slip) > 1e-3
    assert min(stuck, slid, open_) > 100, (stuck, slid, open_)
    # The two corners of an edge that lands obliquely cannot both stick while they close different gaps in one step.
    assert np.quantile(residuals, 0.99) < 1e-10
    assert np.max(residuals) < 1e-6


def gauss_seidel(W, q, sweeps=20000):
    """Solution of Coulomb's law by projected Gauss-Seidel, contact by contact, in coordinates with a coefficient of one."""
    x = np.zeros_like(q)
    for _ in range(sweeps):
        before = x.copy()
        for k in range(0, len(q), 3):
            at = slice(k, k + 3)
            s = W[at] @ x + q[at]
            s[0] += np.hypot(s[1], s[2])
            z = x[at] - s / np.linalg.eigvalsh(W[at, at])[-1]
            size = np.hypot(z[1], z[2])
            if size <= -z[0]:
                z = np.zeros(3)
            elif size > z[0]:
                z = (z[0] + size) / 2 * np.array([1.0, z[1] / size, z[2] / size])
            x[at] = z
        if np.abs(x - before).max() < 1e-15:
            break
    return x


@pytest.mark.long
def test_impulses_are_those_of_gauss_seidel():
    """Feet of a legged robot, whose rows are independent, with small friction, for which the impulses are unique."""
    rng, groups, count = np.random.default_rng(1), ((3, 3),), 24
    problems = []
    for _ in range(count):
        Y = np.concatenate([rng.normal(size=(6, 9)), np.kron(np.eye(3), np.ones((3, 1))) @ np.zeros((3, 9))])
        Y[6:] += np.kron(np.eye(3), np.ones((3, 3))) * rng.normal(size=(9, 9))
        D = np.tile([1.0, 0.3, 0.3], 3)
        W = D[:, None] * (Y.T @ Y) * D / 10
        problems.append((W, rng.normal(size=9) - np.tile([0.7, 0, 0], 3)))
    W, q = (np.stack(x) for x in zip(*problems, strict=True))

    def solve(W, q):
        # Numbers of size one.
        size = jnp.max(jnp.abs(q))
        return coulomb.solve(groups, False, W, q / size, jnp.ones(9), jnp.zeros(())), size

    solution, size = jax.jit(jax.vmap(kernel(solve, derivative=False)))(W, q)
    assert np.asarray(solution.solved).all()
    for i in range(count):
        np.testing.assert_allclose(solution.x[i] * size[i], gauss_seidel(W[i], q[i]), atol=1e-10)


def test_frictionless_impulses_are_the_least_in_the_metric_of_the_mass():
    """By non-negative least squares of SciPy: a box that falls on an edge."""
    from scipy.optimize import nnls

    scene, dt = box(0.0), 0.01
    v = jnp.asarray([0.3, -0.2, -1.0, 0.7, -1.5, 0.4])
    end, report = jax.jit(jd.stepper(scene, dt, report=True))((GROUNDED, v), STILL)
    force = np.array([report.forces[f"{i}"] for i in range(4)])
    assert np.abs(force[:, :2]).max() < 1e-9
    # Inertia is that of the body's axes, and gravity that of the middle of the step.
    q, M = np.asarray(end[0]), np.diag([1, 1, 1, 0.1, 0.2, 0.15])
    R = turn(q[3:])
    J = np.stack([np.concatenate([R[2], np.cross(p, R[2])]) for p in CORNERS])
    after = np.asarray(end[1])
    free = after - np.linalg.solve(M, J.T @ force[:, 2] * dt)
    gap = q[2] + CORNERS @ R[2]
    # Corners touch at the start: what comes out is what gravity and the turning of the way have driven in, and not the approach.
    driven, bent = np.minimum(-(J @ free), np.abs(J @ (free - v))), gap / dt - J @ v
    bound = np.where(gap < 0, np.minimum(-gap / dt, np.maximum(driven, bent)), -gap / dt)
    # min |L^-1 (J^T p)|^2 / 2 + p . (J free - bound): by its dual, nnls of the stacked equations.
    L = np.linalg.cholesky(J @ np.linalg.solve(M, J.T) + 1e-13 * np.eye(4))
    p, _ = nnls(L.T, -np.linalg.solve(L, J @ free - bound), maxiter=100)
    np.testing.assert_allclose(after, free + np.linalg.solve(M, J.T @ p), atol=1e-8)  # the shift of L is 1e-13


@pytest.mark.long
def test_a_box_on_a_slope_does_not_creep():
    """A hundred seconds below the friction angle on four corners, and ten on each of them twice."""
    start = on_slope(0.4), STILL
    for corners, count in ((4, 10_000), (8, 1_000)):
        (q, v), report = moved(box(0.5, slope=0.4, corners=corners), 0.01, start, count)
        assert np.asarray(report.success).all()
        assert np.abs(np.asarray(q) - np.asarray(start[0])).max() < 1e-12
        assert np.abs(np.asarray(v)).max() < 1e-12


def test_redundant_contacts_have_the_forces_of_least_norm():
    scene, slope = box(0.5, slope=0.4), 0.4
    (q, _), report = moved(scene, 0.01, (on_slope(slope), STILL), 1)
    R = turn(np.asarray(q[0, 3:]))
    # Rows of a corner in the frame of the plane: the tangents, then the normal, in the body's axes.
    rows = np.eye(3)
    J = np.concatenate([np.concatenate([rows, np.cross(p[None], rows)], 1) for p in CORNERS])
    weight = np.concatenate([R.T @ [0, 0, G], np.zeros(3)])
    least = np.linalg.lstsq(J.T, weight, rcond=None)[0].reshape(4, 3)
    force = np.stack([report.forces[f"{i}"][0] for i in range(4)])
    np.testing.assert_allclose(force, least, atol=1e-6)  # half of the digits are those of dependent rows


@pytest.mark.long
def test_a_ball_bounces():
    """Restitution of one keeps the energy; of e, each bounce has the part e^2 of the height, to the order of the step."""
    start = GROUNDED.at[2].add(1.0), STILL
    (q, v), _ = moved(ball(0.0, 1.0), 0.01, start, 300)
    np.testing.assert_allclose(G * (q[:, 2] - 0.1) + v[:, 2] ** 2 / 2, G, rtol=1e-12)
    (q, v), _ = moved(ball(0.0, 0.5), 0.001, start, 3000)
    z = np.asarray(q[:, 2]) - 0.1
    peaks = [z[i] for i in range(1, len(z) - 1) if z[i - 1] < z[i] >= z[i + 1]]
    np.testing.assert_allclose(peaks[:4], 0.25 ** np.arange(1, 5), atol=0.003)
    assert z.min() > -1e-5
    assert abs(z[-1]) < 1e-12
    assert np.abs(v[-1]).max() < 1e-12


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_an_approach_that_no_step_has_seen_comes_out_by_restitution(restitution):
    """A ball that starts with 1 m/s at the ground, or nearer than a step: its velocity is e of that, to what gravity adds in two
    steps."""
    dt, step = 0.005, jax.jit(jd.stepper(ball(0.3, restitution), 0.005))
    for gap in (0.0, 1e-3):
        _, v = step((GROUNDED.at[2].add(gap), STILL.at[2].set(-1.0)), STILL)
        np.testing.assert_allclose(v[2], restitution, atol=2 * G * dt)


def test_a_sliding_ball_rolls_with_five_sevenths_of_its_speed():
    dt = 0.002
    (q, v), _ = moved(ball(0.3), dt, (GROUNDED, STILL.at[0].set(1.0)), 500)
    assert np.hypot(v[-1, 0], v[-1, 2]) == pytest.approx(5 / 7, abs=dt**2 * 10)
    assert v[-1, 4] * 0.1 == pytest.approx(5 / 7, abs=dt**2 * 10)
    # The gap is that of the step's curvature, and does not grow.
    assert np.abs(q[:, 2] - 0.1).max() < 0.6 * dt**2 * 5 / 7 * 50 / 7
    assert abs(q[-1, 2] - q[-100, 2]) < 1e-10  # the last slip of 1e-10 m/s


@functools.cache
def hopper(friction=0.8):
    """A trunk in the x-y plane on a leg of five bars, closed at the foot."""
    builder = jd.ModelBuilder("hopper", gravity=(0.0, -G, 0.0))
    builder.add_body("trunk", None, "planar", (2.0, (0, 0, 0), (0.01, 0.01, 0.02)), joint_name="root")
    for side, x in (("l", -0.05), ("r", 0.05)):
        link = (0.2, (0.1, 0, 0), (1e-4, 1e-3, 1e-3))
        builder.add_body(f"{side}1", "trunk", "continuous", link, pose=(x, 0, 0), joint_name=f"hip {side}")
        builder.add_body(f"{side}2", f"{side}1", "continuous", link, pose=(0.2, 0, 0), joint_name=f"knee {side}")
    closing = jd.loop("l2", (0.2, 0, 0), "r2", (0.2, 0, 0), in_plane=True, name="foot")
    ground = ((0.0, 0.0, 0.0), (-np.pi / 2, 0.0, 0.0))
    foot = jd.contact.ground_contact("l2", (0.2, 0, 0), friction, plane=ground, name="toe")
    return jd.Scene(builder.build(), (closing,), forces=[foot])


def stance(height=0.31, speed=0.0):
    """The foot below the trunk at a height of the trunk of 0.31 m, knees outwards."""
    foot = np.array([0.0, -0.3])
    left, _ = jd.scenes.linkages.two_link_leg(np.array([-0.05, 0]), 0.2, foot, np.zeros(2), 1)
    right, _ = jd.scenes.linkages.two_link_leg(np.array([0.05, 0]), 0.2, foot, np.zeros(2), -1)
    q = np.array([0.0, height, 0.0, *left, *right], float)
    return jnp.asarray(q), jnp.zeros(7).at[0].set(speed)


def policy(weights, q, v):
    """Springs of the leg, and a share of the weights."""
    push = jnp.tanh(weights) * 2.0
    return jnp.concatenate([jnp.zeros(3), jnp.stack([-2.0 + push[0], push[1], 2.0 + push[2], push[3]])]) - 0.01 * v


@pytest.mark.slow
def test_a_closed_leg_hops_and_its_gradient():
    """Loops stay closed in positions and velocities; gradients of 32 steps by both modes, and by differences."""
    scene, dt, start = hopper(), 0.005, stance(speed=0.3)
    step = jd.stepper(scene, dt, report=True, adjoint="direct")

    def hop(weights):
        def advance(state, w):
            state, report = step(state, policy(w, *state))
            return state, (state, report)

        return jax.lax.scan(advance, start, weights)[1]

    weights = 0.1 * jnp.asarray(np.random.default_rng(0).normal(size=(32, 4)))
    (q, v), report = jax.jit(hop)(weights)
    assert np.asarray(report.success).all()
    bare = jd.Scene(scene.system, scene.constraints)
    assert np.abs(jax.vmap(lambda q: jd.constraints.position_residual(bare, q))(q)).max() < 1e-10
    assert np.abs(jax.vmap(lambda q, v: jd.constraints.velocity_residual(bare, q, v))(q, v)).max() < 1e-10
    touches = np.asarray(report.forces["toe"][:, -1]) > 0
    assert 3 < touches.sum() < 30, touches

    def loss(weights):
        (q, v), _ = hop(weights)
        return q[-1, 0] + v[-1, 1] + jnp.sum(q[-1, 3:] ** 2)

    gradient, forward = jax.jit(jax.grad(loss))(weights), jax.jit(jax.jacfwd(loss))(weights)
    np.testing.assert_allclose(gradient, forward, rtol=0, atol=1e-10 * np.abs(forward).max())
    direction, value = jnp.asarray(np.random.default_rng(1).normal(size=(32, 4))), jax.jit(loss)

    def difference(h):
        return (value(weights + h * direction) - value(weights - h * direction)) / (2 * h)

    # Richardson's extrapolation; the rest is rounding.
    best = (4 * difference(5e-5) - difference(1e-4)) / 3
    np.testing.assert_allclose(jnp.sum(gradient * direction), best, rtol=1e-8)


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    """By state, torque, friction and the plane: rolling, sliding, and falling; second order by differences of the first."""
    scene = ball.__wrapped__(0.3)
    step = jd.stepper(scene, 0.01)
    states = {
        "slides": (GROUNDED, jnp.asarray([1.0, 0.2, -0.3, 0.1, 0.3, 0.2])),
        "rolls": (GROUNDED, jnp.asarray([0.5, 0, -0.1, 0.1, 5.0, 0.2])),
        "flies": (GROUNDED.at[2].set(0.4), jnp.asarray([1.0, 0.2, -0.3, 0.1, 0.3, 0.2])),
    }
    weights = np.arange(1.0, 14.0)

    def value(x, q, v):
        end = step((q, v + x[:6]), x[6:])
        return jnp.sum(weights * jnp.concatenate(end))

    gradient, jvp = jax.jit(jax.grad(value)), jax.jit(jax.jacfwd(value))
    hessian = jax.jit(jax.hessian(value))
    values, gradients = (jax.vmap(f, (0, None, None)) for f in (value, jax.grad(value)))
    x, h = jnp.zeros(12), 1e-5
    steps = h * jnp.eye(12)
    for name, (q, v) in states.items():
        expected = (values(steps, q, v) - values(-steps, q, v)) / (2 * h)
        found = gradient(x, q, v)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8, err_msg=name)
        np.testing.assert_allclose(jvp(x, q, v), found, rtol=1e-10, atol=1e-12, err_msg=name)
        second = (gradients(steps, q, v) - gradients(-steps, q, v)) / (2 * h)
        np.testing.assert_allclose(hessian(x, q, v), second, rtol=1e-6, atol=1e-7, err_msg=name)

    def of_friction(friction, height):
        plane = jnp.eye(4).at[2, 3].set(height)
        contact = jd.contact.ground_contact("body", None, friction, radius=0.1, plane=plane, name="0")
        end = jd.stepper(jd.Scene(scene.system, forces=[contact]), 0.01)(states["slides"], STILL)
        return jnp.sum(weights * jnp.concatenate(end))

    found, h = jax.jit(jax.grad(of_friction, (0, 1)))(0.3, 0.001), 1e-6
    places = np.array([0.3, 0.001]) + h * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    ends = jax.jit(jax.vmap(of_friction))(*places.T)
    expected = (ends[0] - ends[1]) / (2 * h), (ends[2] - ends[3]) / (2 * h)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.long
@pytest.mark.parametrize("smoothing", [0.0, 1e-3])
def test_second_derivatives_where_the_rows_of_contacts_turn(smoothing):
    """The tip of a double pendulum closes: Hessians are symmetric and the differences of gradients, these those of values.

    W changes with the place here, and impulses with W. Without that product Hessians were off by half of their size, and with
    smooth friction gradients by 1e-3, as they missed that of the speed that counts as none.
    """
    builder, rod = jd.ModelBuilder("arm"), (1.0, (0, 0, -0.25), (0.02, 0.02, 0.01))
    builder.add_body("a", None, "revolute", rod, axis=(0, 1, 0), pose=(0, 0, 0.8))
    builder.add_body("b", "a", "revolute", rod, axis=(0, 1, 0), pose=(0, 0, -0.5))
    tip = jd.contact.shape_contacts("b", jd.contact.Sphere(1e-3), (0, 0, -0.5), friction=0.5, name="tip")
    scene = jd.Scene(builder.build(), forces=list(tip))
    step = jd.stepper(scene, 0.004, smoothing=smoothing)
    x = jnp.array([0.5030538659654246, 0.26718114270442905, -2.198251178967941, 1.5813294315252768])
    weights = jnp.array([0.3, -1.0, 0.7, 0.2])
    assert jd.stepper(scene, 0.004, report=True)((x[:2], x[2:]), jnp.zeros(2))[1].forces["tip"][2] > 50

    def loss(x):
        return weights @ jnp.concatenate(step((x[:2], x[2:]), jnp.zeros(2)))

    loss, gradient, hessian = jax.jit(loss), jax.jit(jax.grad(loss)), jax.jit(jax.hessian(loss))(x)
    h = 1e-5
    slopes, differences = ([(f(x + h * e) - f(x - h * e)) / (2 * h) for e in jnp.eye(4)] for f in (loss, gradient))
    np.testing.assert_allclose(gradient(x), slopes, atol=1e-8 * np.abs(slopes).max())
    size = np.abs(hessian).max()
    np.testing.assert_allclose(hessian, differences, atol=1e-7 * size)  # of second order in h
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12 * size)


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_ball_that_rolls_fast_does_not_sink(slope):
    """At 2 m/s, where v^2/r is above 2 g: below the ground by the bend of one step, w^2 r h^2/2, and as fast as it should be."""
    h, radius, spin, end = 0.0025, 0.1, 20.0, 1.0
    normal, down = np.array([np.sin(slope), 0, np.cos(slope)]), np.array([np.cos(slope), 0, -np.sin(slope)])
    contact = jd.contact.ground_contact("body", None, 1.0, radius=radius, plane=((0, 0, 0), (0, slope, 0)), name="0")
    scene = free_body([contact], (0.4 * radius**2,) * 3)
    start = jnp.asarray([*(radius * normal), 1, 0, 0, 0]), jnp.asarray([*(spin * radius * down), 0, spin, 0])
    (q, v), _ = moved(scene, h, start, round(end / h))
    acceleration = 5 / 7 * G * np.sin(slope)
    fastest = spin + acceleration / radius * end
    assert np.min(q[:, :3] @ normal) - radius > -1.1 * fastest**2 * radius * h**2 / 2
    np.testing.assert_allclose(v[-1, 4], fastest, rtol=1e-3)
    np.testing.assert_allclose(q[-1, :3] @ down, spin * radius * end + acceleration * end**2 / 2, rtol=1e-3)


@pytest.mark.long
def test_grazing_has_finite_derivatives_and_smoothing_a_hover():
    """At rest without load both modes are finite. With smoothing the force f acts at a gap of kappa / f."""
    weightless = jd.Scene(ball(0.3).system.replace(gravity=None), forces=ball(0.3).forces)
    step = jd.stepper(weightless, 0.01)
    assert np.isfinite(jax.jit(jax.jacrev(lambda v: step((GROUNDED, v), STILL)[1]))(STILL)).all()
    energy = 1e-4
    (q, _), report = moved(ball(0.3), 0.01, (GROUNDED.at[2].add(1e-4), STILL), 400, smoothing=energy)
    assert np.asarray(report.success).all()
    assert report.forces["0"][-1, -1] == pytest.approx(G, rel=1e-6)
    assert q[-1, 2] - 0.1 == pytest.approx(energy / G, rel=1e-6)

    def after(z):
        end = jd.stepper(ball(0.3), 0.01, smoothing=energy)((q[0].at[2].set(z), STILL), STILL)
        return end[1][2]

    slope, h = jax.jit(jax.grad(after))(0.1003), 1e-7
    ends = jax.jit(jax.vmap(after))(np.array([0.1003 + h, 0.1003 - h]))
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-6)


@pytest.mark.long
def test_batches_are_single_samples_and_float32():
    """Batches of 0, 3 and 512 samples that fly, slide and rest."""
    scene, rng = box(0.5), np.random.default_rng(2)
    q = np.tile([0, 0, 0.1, 1, 0, 0, 0.0], (512, 1))
    q[:, 2] += np.where(np.arange(512) % 3 == 0, 0.3, 0.0)
    v = rng.normal(size=(512, 6)) * (np.arange(512) % 4 > 0)[:, None]
    step = jd.stepper(scene, 0.01, report=True)
    batch = jax.jit(jax.vmap(lambda q, v: step((q, v), STILL)))
    (_, velocities), report = batch(q, v)
    # Impacts of a box with four corners, whose forces are not unique, are the hardest.
    assert np.asarray(report.success).all()
    for count in (0, 3):
        np.testing.assert_allclose(batch(q[:count], v[:count])[0][1], velocities[:count], rtol=0, atol=1e-12)
    single = jax.jit(lambda q, v: step((q, v), STILL))
    for i in range(6):
        np.testing.assert_allclose(single(q[i], v[i])[0][1], velocities[i], rtol=0, atol=1e-12)
    contacts = [jd.contact.ground_contact("body", p, 0.5, name=f"{i}") for i, p in enumerate(CORNERS)]
    half = jd.Scene(free_body([], dtype=jnp.float32).system, forces=contacts)
    coarse = jax.jit(jax.vmap(lambda q, v: jd.stepper(half, 0.01, report=True)((q, v), jnp.zeros(6, jnp.float32))))
    (_, slow), report = coarse(q.astype(np.float32), v.astype(np.float32))
    assert slow.dtype == jnp.float32
    both = np.asarray(report.success) & ~np.isnan(np.asarray(velocities)[:, 0])
    assert both.mean() > 0.95
    # Dependent rows have half of seven digits. Forces that are not unique may be others, with other velocities of sliding.
    errors = np.abs(np.asarray(slow)[both] - np.asarray(velocities)[both]).max(1)
    assert np.median(errors) < 1e-4
    assert np.quantile(errors, 0.8) < 1e-2


@pytest.mark.long
def test_joint_limits_hold():
    """A pendulum falls onto its limit, and rests there by the torque of its weight."""
    builder = jd.ModelBuilder("pendulum")
    rod = (1.0, (0.0, 0.0, -0.5), (0.1, 0.1, 0.01))
    builder.add_body("rod", None, "revolute", rod, axis=(0, 1, 0), lower=-0.5, upper=0.7)
    builder.add_body("bob", "rod", "continuous", rod, axis=(0, 1, 0), pose=(0, 0, -1.0))
    model = builder.build()
    damped = jd.Scene(model, forces=[jd.forces.JointDamping(1.0)])
    fall = jax.jit(lambda start, tau: run(damped, 0.01, start, 1500, tau, limits="hold"))
    for side, q, limit in ((1.0, 0.6, 0.7), (-1.0, -0.4, -0.5)):
        tau = jnp.asarray([side * 20.0, 0.0])
        (qs, v), report = fall((jnp.asarray([q, 0.0]), jnp.zeros(2)), tau)
        assert (side * (qs[:, 0] - limit)).max() < 1e-12
        assert qs[-1, 0] == pytest.approx(limit, abs=1e-12)
        assert abs(v[-1, 0]) < 1e-12
        expected = jd.gravity_force(model, qs[-1])[0] - tau[0]
        # Inertial forces are those of half a step without the limit, which are of the order of the square of the step.
        np.testing.assert_allclose(report.limit_forces[-1, 0], expected, rtol=2e-4)


def test_a_step_without_a_solution_is_no_number():
    """A wall that moves against a mass that cannot give way: a code, NaN, and derivatives of NaN."""
    system = jd.ExplicitSystem(lambda q: jnp.eye(1), lambda q, v: jnp.zeros(1), 1)
    wall = jd.contact.gap_contact(lambda q, t: -t + 0 * q[0], name="wall")
    step = jd.stepper(jd.Scene(system, forces=[wall]), 0.1, report=True)
    (q, v), report = jax.jit(step)((jnp.ones(1), jnp.ones(1)), jnp.zeros(1))
    assert report.result == jd.RESULTS.no_contact_impulses
    assert np.isnan(q).all()
    assert np.isnan(v).all()
    assert np.isnan(jax.jit(jax.grad(lambda v: step((jnp.ones(1), v), jnp.zeros(1))[0][1][0]))(jnp.ones(1))).all()


@pytest.mark.long
def test_order_two_between_contacts():
    """A closed leg in the air: errors fall by four as steps halve."""
    scene, start = hopper(), stance(height=1.0)
    start = start[0], start[1].at[2].set(2.0)
    tau = jnp.zeros(7).at[3].set(0.3)
    ends = []
    for dt in (0.02, 0.01, 0.005, 0.000625):
        (q, v), _ = moved(scene, dt, start, round(0.2 / dt), tau)
        ends.append(np.concatenate([q[-1], v[-1]]))
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    assert errors[0] / errors[1] == pytest.approx(4, abs=0.6)
    assert errors[1] / errors[2] == pytest.approx(4, abs=0.4)


def test_substeps_are_steps():
    """Two in one call, with the mean of their forces."""
    scene, start = ball(0.3), (GROUNDED, jnp.asarray([1.0, 0, -0.5, 0, 0, 0]))
    state, report = jax.jit(jd.stepper(scene, 0.01, substeps=2, report=True))(start, STILL)
    states, reports = moved(scene, 0.005, start, 2)
    np.testing.assert_allclose(state[1], states[1][-1], rtol=0, atol=1e-13)
    np.testing.assert_allclose(report.forces["0"], np.mean(reports.forces["0"], 0), rtol=1e-10, atol=1e-12)


test_refusals = refusals(
    (lambda: jd.stepper(ball(0.3), 0.01, smoothing=-1.0), "smoothing"),
    (lambda: jd.stepper(ball(0.3).system, 0.01, smoothing=0.1), "smoothing is for"),
    (lambda: jd.stepper(ball(0.3), 0.01, limits="stop"), "hold"),
    (lambda: jd.stepper(free_body([jd.contact.DryFriction(0.1, 1.0, smoothing=0.1)]), 0.01), "CoulombFriction"),
)


def test_friction_at_rest_has_its_own_coefficient():
    """A ball that cannot turn on a slope of tan 0.45: at rest it stays by 0.5, and from a push it slides with 0.3."""
    slope, dt = np.arctan(0.45), 0.01
    plane = ((0.0, 0.0, 0.0), (0.0, slope, 0.0))
    contacts = [
        jd.contact.ground_contact("body", p, 0.3, static=0.5, plane=plane, name=f"{i}") for i, p in enumerate(CORNERS)
    ]
    scene, q = free_body(contacts), on_slope(slope)
    (_, (rests, slides)), report = jax.jit(jax.vmap(lambda v: run(scene, dt, (q, v), 20)))(
        jnp.stack([STILL, STILL.at[0].set(0.5)])
    )
    assert np.asarray(report.success[0]).all() and np.abs(rests).max() < 1e-12
    rate = G * (np.sin(slope) - 0.3 * np.cos(slope))
    np.testing.assert_allclose(np.diff(slides[:, 0]), rate * dt, rtol=1e-6)


def test_dry_friction_and_drives_in_steps_with_contacts():
    """A block on a rail: it slides to rest under a load that is given, and rests under a drive that is weaker at rest."""
    friction = jd.contact.DryFriction(0.3, 10.0, 0, static=0.4)
    model, dt = slider(2.0), 0.01
    start = jnp.zeros(1), jnp.full(1, 0.5)
    (_, v), report = moved(jd.Scene(model, forces=[friction]), dt, start, 50, jnp.zeros(1))
    np.testing.assert_allclose(v[:, 0], np.maximum(0.5 - 1.5 * dt * np.arange(1, 51), 0), atol=1e-12)
    assert report.forces["friction"][0] == pytest.approx([-3.0, 10.0])
    drive = jd.forces.FirstOrderDrive(0.05)
    scene = jd.Scene(model, forces=[drive, friction])
    step = jd.stepper(scene, dt)
    for load, moves in ((3.9, False), (4.1, True)):
        start = (jnp.zeros(1), jnp.zeros(1), scene.drive_state(jnp.zeros(1), jnp.zeros(1)))
        q, v, z = jax.lax.fori_loop(0, 100, lambda _, s, load=load: step(s, jnp.full(1, load)), start)
        assert z[0] == pytest.approx(load, rel=1e-6)
        assert bool(abs(v[0]) > 1e-15) == moves
        assert moves or abs(q[0]) < 1e-15
    gradient = jax.jit(jax.grad(lambda u: step(start, u)[2][0]))(jnp.full(1, 4.0))
    assert gradient[0] == pytest.approx(dt / 0.05 - (dt / 0.05) ** 2 / 2, rel=1e-12)


def test_friction_of_a_wall_has_the_force_that_holds_the_body_against_it():
    """A body that is pressed against a vertical wall slides down it, or stops and rests, whatever side it is pressed to."""
    mu, dt, start = 0.2, 0.01, jnp.asarray([0.0, -0.5])
    system = jd.scenes.pendulum_in_plane().system
    wall, friction = jd.Holonomic(lambda q, t: q[:1], name="wall"), jd.contact.DryFriction(mu, "wall", 1)
    scene, mass = jd.Scene(system, (wall,), (friction,)), float(jd.mass_matrix(system, jnp.zeros(2))[0, 0])
    slide = jax.jit(lambda tau: run(scene, dt, (jnp.zeros(2), start), 30, tau))
    for push in (-30.0, 30.0, 100.0):
        (_, v), report = slide(jnp.asarray([push, 0.0]))
        expected = start[1] + dt * np.arange(1, 31) * (mu * abs(push) / mass - G)
        np.testing.assert_allclose(v[:, 1], np.minimum(expected, 0.0), atol=1e-12)
        level = mu * abs(push) if expected[-1] < 0 else mass * G
        np.testing.assert_allclose(report.forces["friction"][-1], [level, abs(push)], rtol=1e-10)


@pytest.mark.slow
def test_friction_of_a_rod_changes_the_force_that_loads_it():
    """A bead on a circle: steps of order one to the motion with events, and their derivative."""
    rod = jd.scenes.pendulum_in_plane()
    along = jd.Pfaffian(lambda q, t: jnp.stack([-q[1], q[0]]), name="along")
    scene = jd.Scene(rod.system, rod.constraints, (jd.contact.DryFriction(0.3, rod.constraints[0].name, along),))
    ts, none = jnp.linspace(0.0, 2.0, 5), jnp.zeros(2)
    motion = jd.simulate(scene, [1.0, 0.0], none, ts, stepsize=within(1e-11))
    errors = []
    for count in (400, 800):
        (q, _), report = moved(scene, 2.0 / count, (motion.q[0], none), count, none)
        assert np.asarray(report.success).all()
        errors.append(np.abs(q[count // 4 - 1 :: count // 4] - motion.q[1:]).max())
    assert errors[1] < 0.004 and errors[0] / errors[1] == pytest.approx(2, rel=0.1)
    step = jd.stepper(scene, 0.01)
    speed = lambda v: step((jnp.asarray([0.6, -0.8]), v * jnp.asarray([0.8, 0.6])), none)[1][0]  # noqa: E731
    gradient, second = jax.grad(speed)(1.0), jax.grad(jax.grad(speed))(1.0)
    differences = (speed(1 + 1e-5) - speed(1 - 1e-5)) / 2e-5
    assert float(gradient) == pytest.approx(float(differences), rel=1e-9)
    assert float(second) == pytest.approx(float(jax.grad(speed)(1 + 1e-5) - jax.grad(speed)(1 - 1e-5)) / 2e-5, rel=1e-6)


def test_a_table_on_twelve_points_stands_and_slides():
    """Many contacts, whose equations are solved by a loop: forces of least norm, and the motion of a sliding block."""
    slide, dt = jax.jit(lambda v: run(table(0.5), 0.01, (GROUNDED, v), 10)), 0.01
    (q, _), report = slide(STILL)
    np.testing.assert_allclose(q, np.tile(GROUNDED, (10, 1)), rtol=0, atol=1e-13)
    # Half of the digits are those of forces that are not unique.
    np.testing.assert_allclose([report.forces[f"{i}"][1, 2] for i in range(12)], G / 12, rtol=0, atol=1e-7)
    (_, v), _ = slide(STILL.at[0].set(1.0))
    np.testing.assert_allclose(v[:, 0], 1.0 - 0.5 * G * dt * np.arange(1, 11), rtol=0, atol=1e-10)


@pytest.mark.long
def test_derivatives_of_a_block_that_slides_on_twelve_points():
    """Speeds after a step of a sliding block are v + h (f / m - mu g): the derivatives by friction, force and speed."""
    dt = 0.01

    def speed(mu, force, before):
        return jd.stepper(table(mu), dt)((GROUNDED, STILL.at[0].set(before)), STILL.at[0].set(force))[1][0]

    x = 0.5, 0.3, 1.0
    value, found = jax.jit(jax.value_and_grad(speed, (0, 1, 2)))(*x)
    assert float(value) == pytest.approx(1 + dt * (0.3 - 0.5 * G), abs=1e-10)
    # Forces are unique to half of the digits.
    np.testing.assert_allclose(found, [-G * dt, dt, 1.0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(speed, (0, 1, 2)))(*x), found, rtol=0, atol=1e-10)


def test_many_contacts_are_announced():
    points = 0.1 * np.random.default_rng(0).normal(size=(17, 3))
    scene = free_body([jd.contact.ground_contact("body", point, 0.5, name=f"p{i}") for i, point in enumerate(points)])
    with pytest.warns(UserWarning, match=r"17 contacts.*lowest=1"):
        jd.stepper(scene, 0.01)
