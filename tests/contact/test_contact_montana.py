"""Contact kinematics against closed forms on spheres, the exact kinematics of g_of, and motions that are integrated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick
from refusals import refusals

import jaxdyn as jd
from jaxdyn import se3


def bump(alpha):
    """A surface with a chart that is not orthogonal, convex where it is used."""
    u, v = alpha
    return jnp.stack([u + 0.2 * v, v, -0.5 * u * u - v * v + 0.3 * u * v])


EGG, TIP = jd.contact.Ellipsoid([0.1, 0.2, 0.15]), jd.contact.Ellipsoid([0.03, 0.02, 0.05], poles="x")
FAST = ("sphere on sphere", "ellipsoid on a parametrised surface")
PAIRS = {
    "sphere on sphere": (jd.contact.Sphere(0.1), jd.contact.Sphere(0.02)),
    "ellipsoid on ellipsoid": (EGG, TIP),
    "ellipsoid on plane": (jd.contact.Plane(), TIP),
    "ellipsoid on cylinder": (jd.contact.Cylinder(0.2), TIP),
    "ellipsoid on a parametrised surface": (jd.contact.Parametrised(bump), TIP),
    "ellipsoid in a shallow bowl": (
        jd.contact.Parametrised(lambda a: jnp.stack([a[0], a[1], a[0] ** 2 + 0.5 * a[1] ** 2])),
        TIP,
    ),
}
ETA = jnp.array([0.3, 0.2, -0.5, 0.4, 0.7])


def sphere_J_c(R, r, eta):
    """J_c of spheres written out by hand."""
    uo, _, uf, _, psi = eta
    c, s = np.cos(psi), np.sin(psi)
    zero = np.zeros(2)
    moved_o, moved_f = np.diag([R, R * np.cos(uo)]), np.diag([r, r * np.cos(uf)])
    turn, quarter = np.array([[c, -s], [-s, -c]]), np.array([[0, -1], [1, 0]])
    rows = np.zeros((6, 5))
    rows[:2, :2], rows[:2, 2:4] = turn @ moved_o, -moved_f
    rows[3:5, :2], rows[3:5, 2:4] = turn @ quarter @ moved_o / R, -quarter @ moved_f / r
    rows[5] = [*zero, *zero, 1.0]
    # T M = (-tan(u) / R) (R cos u) = -sin u, along the second coordinate.
    rows[5, 1], rows[5, 3] = np.sin(uo), np.sin(uf)
    return rows


# One program for each kind of surface.
GEOMETRY, KINEMATICS = quick(jd.contact.surface_geometry), quick(jd.contact.montana)


@quick
def SPHERE(ball, alpha):
    computed = jd.contact.surface_geometry(ball, alpha)
    return computed, ball.coordinates(computed.point)


@pytest.mark.parametrize("poles", ["x", "y", "z"])
def test_sphere_has_its_closed_form(poles):
    R, alpha = 0.3, jnp.array([0.4, -0.9])
    computed, coordinates = SPHERE(jd.contact.Sphere(R, poles), alpha)
    np.testing.assert_allclose(computed.metric, np.diag([R, R * np.cos(0.4)]), atol=1e-14)
    np.testing.assert_allclose(computed.curvature, np.eye(2) / R, atol=1e-13)
    np.testing.assert_allclose(computed.torsion, [0, -np.tan(0.4) / R], atol=1e-13)
    np.testing.assert_allclose(computed.frame[:, 2], computed.point / R, atol=1e-14)
    np.testing.assert_allclose(computed.frame.T @ computed.frame, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(coordinates, alpha, atol=1e-14)
    assert np.linalg.det(computed.frame) > 0 and bool(computed.regular)


def test_plane_and_cylinder_have_their_closed_forms():
    alpha = jnp.array([0.4, -0.9])
    flat, pipe = GEOMETRY(jd.contact.Plane(), alpha), GEOMETRY(jd.contact.Cylinder(0.2), alpha)
    np.testing.assert_allclose(flat.metric, np.eye(2), atol=1e-15)
    np.testing.assert_allclose(np.r_[flat.curvature.ravel(), flat.torsion], 0, atol=1e-15)
    np.testing.assert_allclose(flat.frame[:, 2], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(pipe.metric, np.diag([0.2, 1.0]), atol=1e-15)
    np.testing.assert_allclose(pipe.curvature, np.diag([5.0, 0.0]), atol=1e-14)
    np.testing.assert_allclose(pipe.torsion, 0, atol=1e-14)
    np.testing.assert_allclose(pipe.frame[:, 2], [np.cos(0.4), np.sin(0.4), 0], atol=1e-15)


def test_ellipsoid_has_its_gaussian_and_mean_curvature():
    # Goldman (2005), curvature of implicit surfaces: with h the distance of the tangent plane from the centre.
    a, b, c = 0.1, 0.2, 0.15
    for alpha in ([0.3, 0.2], [-0.8, 2.0], [1.1, -1.0]):
        computed = GEOMETRY(EGG, jnp.array(alpha))
        x, y, z = np.asarray(computed.point)
        assert abs(x**2 / a**2 + y**2 / b**2 + z**2 / c**2 - 1) < 1e-14
        h = 1 / np.sqrt(x**2 / a**4 + y**2 / b**4 + z**2 / c**4)
        gauss = h**4 / (a * b * c) ** 2
        mean = h**3 * (a**2 + b**2 + c**2 - x**2 - y**2 - z**2) / (2 * (a * b * c) ** 2)
        np.testing.assert_allclose(np.linalg.det(computed.curvature), gauss, rtol=1e-12)
        np.testing.assert_allclose(np.trace(computed.curvature) / 2, mean, rtol=1e-12)
        np.testing.assert_allclose(computed.curvature, computed.curvature.T, atol=1e-12)


def test_flipping_turns_the_normal_and_the_curvature():
    out = jd.contact.surface_geometry(jd.contact.Parametrised(bump), jnp.array([0.3, 0.2]))
    back = jd.contact.surface_geometry(jd.contact.Parametrised(bump, flip=True), jnp.array([0.2, 0.3]))
    np.testing.assert_allclose(back.point, out.point, atol=1e-15)
    np.testing.assert_allclose(back.frame[:, 2], -out.frame[:, 2], atol=1e-15)
    np.testing.assert_allclose(np.trace(back.curvature), -np.trace(out.curvature), atol=1e-12)


def test_sphere_on_sphere_is_the_closed_form():
    kinematics = KINEMATICS(*PAIRS["sphere on sphere"], ETA)
    np.testing.assert_allclose(kinematics.J_c, sphere_J_c(0.1, 0.02, np.asarray(ETA)), atol=1e-13)
    # Rolling with angular velocity w, the contact runs over each sphere at w R r / (R + r).
    rates = np.asarray(kinematics.rolling) @ np.array([0.6, -0.8])
    for i, (R, alpha) in enumerate(((0.1, ETA[:2]), (0.02, ETA[2:4]))):
        speed = np.hypot(R * rates[2 * i], R * np.cos(alpha[0]) * rates[2 * i + 1])
        np.testing.assert_allclose(speed, 0.1 * 0.02 / 0.12, rtol=1e-12)


def test_ball_on_a_plane_rolls_by_its_radius():
    kinematics = KINEMATICS(jd.contact.Plane(), jd.contact.Sphere(0.1), ETA)
    np.testing.assert_allclose(np.linalg.norm((kinematics.rolling @ np.array([0.6, -0.8]))[:2]), 0.1, rtol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.slow] * (x not in FAST)) for x in PAIRS])
def test_twists_are_those_of_the_relative_pose(name):
    o, f = PAIRS[name]

    @quick
    def both(eta):
        pose, rates = jd.contact.relative_pose(o, f, eta), jax.jacfwd(lambda e: jd.contact.relative_pose(o, f, e))(eta)
        twists = jnp.stack([se3.vee(se3.inverse(pose) @ rates[..., i]) for i in range(5)], 1)
        return jd.contact.montana(o, f, eta), pose, twists

    computed, pose, twists = both(ETA)
    np.testing.assert_allclose(computed.g_of, pose, atol=1e-14)
    np.testing.assert_allclose(computed.J_F, twists, atol=1e-12)
    # The forward form is the inverse on twists that keep contact.
    np.testing.assert_allclose(computed.forward @ computed.J_c, np.eye(5), atol=1e-12)
    np.testing.assert_allclose(computed.J_c @ computed.forward, np.diag([1, 1, 0, 1, 1, 1]), atol=1e-12)
    assert bool(computed.strict)
    # The points and normals that touch are the same, seen from both bodies.
    np.testing.assert_allclose(pose[:3, :3] @ computed.finger.point + pose[:3, 3], computed.object.point, atol=1e-14)
    np.testing.assert_allclose(pose[:3, :3] @ computed.finger.frame[:, 2], -computed.object.frame[:, 2], atol=1e-14)


def test_rolling_returns_without_slip_and_spin():
    """Contact coordinates integrated by Runge and Kutta: the twist of the poses on the way is the one that was asked for."""
    o, f = PAIRS["ellipsoid on ellipsoid"]
    omega = lambda t: jnp.stack([jnp.cos(t), jnp.sin(2 * t)])  # noqa: E731
    twist = quick(lambda eta, hat: se3.Ad_inv_apply(jd.contact.montana(o, f, eta).finger.pose, se3.vee(hat)))

    @quick
    def path(eta):
        def step(carry, _):
            eta, t = carry
            h = 0.005

            def stage(k, part):  # in a loop, which compiles the kinematics once
                k = jd.contact.montana(o, f, eta + part * h * k).rolling @ omega(t + part * h)
                return k, k

            ks = jax.lax.scan(stage, jnp.zeros(5), jnp.array([0.0, 0.5, 0.5, 1.0]))[1]
            new = eta + h / 6 * jnp.array([1.0, 2.0, 2.0, 1.0]) @ ks
            return (new, t + h), (eta, jd.contact.relative_pose(o, f, eta))

        return jax.lax.scan(step, (eta, jnp.zeros(())), None, length=80)[1]

    etas, poses = (np.asarray(x) for x in path(ETA))
    for i in (2, 40, 76):
        rate = (poses[i - 2] - 8 * poses[i - 1] + 8 * poses[i + 1] - poses[i + 2]) / (12 * 0.005)
        # Fourth-order differences of steps of 5 ms: errors of order 1e-8 of the rates of the pose.
        wanted = [0, 0, 0, np.cos(0.005 * i), np.sin(0.01 * i), 0]
        np.testing.assert_allclose(twist(etas[i], np.linalg.inv(poses[i]) @ rate), wanted, atol=1e-6)


@pytest.mark.long
def test_batches_compile_and_differentiate_in_the_shape():
    def size(axes, eta):
        return jnp.sum(jd.contact.montana(jd.contact.Ellipsoid(axes), jd.contact.Sphere(0.02), eta).forward ** 2)

    axes = jnp.array([0.1, 0.2, 0.15])
    etas = jnp.stack([ETA, 0.5 * ETA])
    values, slopes = quick(jax.vmap(jax.value_and_grad(size), (None, 0)))(axes, etas)
    step = 1e-6
    moved = np.asarray(axes) + step * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    other = np.asarray(quick(jax.vmap(size, (0, None)))(moved, ETA))
    np.testing.assert_allclose(values[0], other[0], rtol=1e-12)
    high, low = np.split(other[1:], 2)
    np.testing.assert_allclose(slopes[0], (high - low) / (2 * step), rtol=1e-6)


@pytest.mark.long
def test_where_a_chart_ends_traced_numbers_are_finite_and_told():
    ball = jd.contact.Sphere(0.1)
    pole = jnp.array([jnp.pi / 2, 0.0])
    computed = quick(lambda a: jd.contact.surface_geometry(ball, a))(pole)
    assert not bool(computed.regular)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(computed))
    flat = quick(lambda e: jd.contact.montana(jd.contact.Plane(), jd.contact.Plane(), e))(ETA)
    assert not bool(flat.strict) and np.isfinite(flat.forward).all()
    assert float(ball.chart_margin(pole)) < 1e-12 and float(jd.contact.Plane().chart_margin(pole)) == np.inf
    # The same point in another chart is regular.
    other = jd.contact.Sphere(0.1, poles="x")
    assert bool(jd.contact.surface_geometry(other, other.coordinates(ball.point(pole))).regular)


test_bad_input_is_refused = refusals(
    (lambda: jd.contact.Sphere(-0.1), "radius is -0.1"),
    (lambda: jd.contact.Sphere(0.1, poles="w"), "poles is 'w'"),
    (lambda: jd.contact.Ellipsoid([0.1, 0.0, 0.2]), "semi_axes is"),
    (lambda: jd.contact.Ellipsoid([0.1, 0.2]), "semi_axes has shape"),
    (lambda: jd.contact.Cylinder(0.0), "radius is 0.0"),
    (lambda: jd.contact.surface_geometry(jd.contact.Sphere(0.1), jnp.zeros(3)), "alpha has shape"),
    (lambda: jd.contact.surface_geometry(jd.contact.Sphere(0.1), jnp.array([np.pi / 2, 0.0])), "Sphere is singular"),
    (lambda: jd.contact.surface_geometry("ball", jnp.zeros(2)), "surface is a"),
    (lambda: jd.contact.surface_geometry(jd.contact.Parametrised(lambda a: a), jnp.zeros(2)), "f returned shape"),
    (lambda: jd.contact.montana(jd.contact.Sphere(0.1), jd.contact.Sphere(0.02), jnp.zeros(4)), "eta has shape"),
    (lambda: jd.contact.montana(jd.contact.Plane(), jd.contact.Plane(), ETA), "relative curvature"),
    (
        lambda: jd.contact.montana(
            jd.contact.Parametrised(lambda a: jnp.stack([*a, 50 * a @ a])), jd.contact.Sphere(0.02), jnp.zeros(5)
        ),
        "relative curvature",
    ),
)


@pytest.mark.slow
def test_float32_stays_float32():
    kinematics = jd.contact.montana(
        jd.contact.Sphere(jnp.float32(0.1)), jd.contact.Sphere(jnp.float32(0.02)), ETA.astype(jnp.float32)
    )
    assert kinematics.J_c.dtype == jnp.float32 == kinematics.forward.dtype
    np.testing.assert_allclose(kinematics.J_c, sphere_J_c(0.1, 0.02, np.asarray(ETA)), atol=2e-5)
