"""Friction cones against their inequalities in numpy, wrench cones against linear programs and a published matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick
from refusals import refusals
from scipy.optimize import linprog

import jaxdyn as jd

X, Y, MU = 0.11, 0.05, 0.6
TRIANGLE = np.array([[0.1, 0.0], [-0.05, 0.06], [-0.07, -0.08]])
CORNERS = np.array([[X, Y], [-X, Y], [X, -Y], [-X, -Y]])


def corner_generators(corners, mu):
    """Wrenches (6, 4 n) of forces on the edges of the pyramids, one corner at a time."""
    columns = []
    for x, y in corners:
        for fx, fy in ((mu, mu), (mu, -mu), (-mu, mu), (-mu, -mu)):
            columns.append([fx, fy, 1.0, y, -x, x * fy - y * fx])
    return np.array(columns).T


def outside(generators, wrench):
    """Distance (1-norm, torques in metres of size 0.1) of a wrench from the cone of the generators, by a linear program."""
    scale = np.array([1, 1, 1, 0.1, 0.1, 0.1])[:, None]
    unit = np.eye(6)
    rows = np.concatenate([generators / scale, unit, -unit], 1)
    cost = np.concatenate([np.zeros(generators.shape[1]), np.ones(12)])
    return linprog(cost, A_eq=rows, b_eq=wrench / scale[:, 0]).fun


def random_wrenches(count, generators, seed):
    """Wrenches half inside of the cone and half about its boundary, of normal force about one."""
    random = np.random.default_rng(seed)
    weights = random.exponential(size=(count, generators.shape[1])) * (
        random.random((count, generators.shape[1])) < 0.3
    )
    inside = weights @ generators.T
    inside /= np.maximum(inside[:, 2:3], 1e-3)
    return inside + random.normal(size=(count, 6)) * [0.2, 0.2, 0, 0.02, 0.02, 0.02] * random.integers(0, 2, (count, 1))


def agree_with_program(U, corners, mu, count, seed):
    generators = corner_generators(corners, mu)
    disputed = inside = 0
    for wrench in random_wrenches(count, generators, seed):
        excess = (U @ wrench).max()
        if abs(excess) > 1e-9:
            inside += excess < 0
            disputed += (excess < 0) != (outside(generators, wrench) < 1e-10)
    return disputed, inside


def test_rectangle_has_the_published_rows():
    s = MU * (X + Y)
    published = [
        *[(a, 0, -MU, 0, 0, 0) for a in (1, -1)],
        *[(0, a, -MU, 0, 0, 0) for a in (1, -1)],
        *[(0, 0, -Y, a, 0, 0) for a in (1, -1)],
        *[(0, 0, -X, 0, a, 0) for a in (1, -1)],
        (-Y, -X, -s, MU, MU, -1),
        (-Y, X, -s, MU, -MU, -1),
        (Y, -X, -s, -MU, MU, -1),
        (Y, X, -s, -MU, -MU, -1),
        (Y, X, -s, MU, MU, 1),
        (Y, -X, -s, MU, -MU, 1),
        (-Y, X, -s, -MU, MU, 1),
        (-Y, -X, -s, -MU, -MU, 1),
    ]
    U = np.asarray(jd.contact.wrench_cone(X, Y, MU))
    assert U.shape == (16, 6)
    np.testing.assert_allclose(U, np.array(published), atol=1e-15)


@pytest.mark.parametrize("count, seed", [(400, 2), pytest.param(2000, 3, marks=pytest.mark.slow)])
def test_rectangle_agrees_with_a_linear_program(count, seed):
    disputed, inside = agree_with_program(np.asarray(jd.contact.wrench_cone(X, Y, MU)), CORNERS, MU, count, seed)
    assert disputed == 0 and count / 8 < inside < 7 * count / 8


def test_polygon_of_a_rectangle_is_the_rectangle():
    rows = np.asarray(jd.contact.wrench_cone_of_polygon(CORNERS, MU))
    known = np.asarray(jd.contact.wrench_cone(X, Y, MU))
    unit = lambda A: A / np.linalg.norm(A, axis=1, keepdims=True)  # noqa: E731
    assert rows.shape == (16, 6)
    for row in unit(rows):
        assert abs(unit(known) - row).max(1).min() < 1e-12


def test_triangle_agrees_with_a_linear_program():
    U = np.asarray(jd.contact.wrench_cone_of_polygon(TRIANGLE, MU))
    disputed, inside = agree_with_program(U, TRIANGLE, MU, 300, 4)
    assert disputed == 0 and 50 < inside < 280
    # Points within the triangle and another order of its corners change nothing.
    more = np.asarray(jd.contact.wrench_cone_of_polygon([[0.0, 0.0], *TRIANGLE[::-1]], MU))
    assert more.shape == U.shape and max(abs(U - row).max(1).min() for row in more) < 1e-12


def test_rectangle_is_differentiable_in_its_sizes():
    wrench = jnp.array([0.1, -0.2, 1.0, 0.01, 0.02, 0.03])
    jacobian = quick(jax.jacfwd(lambda s: jd.contact.wrench_cone(s[0], s[1], s[2]) @ wrench))(jnp.array([X, Y, MU]))
    step = 1e-6
    at = quick(jax.vmap(lambda s: jd.contact.wrench_cone(s[0], s[1], s[2]) @ wrench))
    sizes = jnp.array([X, Y, MU])[None] + step * jnp.concatenate([jnp.eye(3), -jnp.eye(3)])
    high, low = np.split(np.asarray(at(sizes)), 2)
    np.testing.assert_allclose(jacobian.T, (high - low) / (2 * step), atol=1e-9)


@pytest.mark.parametrize("kind, gamma", [("hard-finger", None), ("soft-finger", 0.02)])
def test_cone_and_pyramids_hold_the_inequalities(kind, gamma):
    cone = jd.contact.friction_cone(kind, MU, gamma)
    forces = np.random.default_rng(5).normal(size=(4000, cone.size)) * np.array([0.4, 0.4, 1.0, 0.02])[: cone.size]
    slip = MU * forces[:, 2] - np.hypot(forces[:, 0], forces[:, 1])
    least = slip if gamma is None else np.minimum(slip, gamma * forces[:, 2] - abs(forces[:, 3]))
    np.testing.assert_allclose(jax.vmap(cone.margin)(forces), least, atol=1e-15)
    for faces in (4, 7):
        within = (forces @ np.asarray(cone.pyramid(faces, "inscribed")).T).max(1) <= 0
        around = (forces @ np.asarray(cone.pyramid(faces, "circumscribed")).T).max(1) <= 0
        assert (least[within] >= 0).all() and around[least >= 0].all()
        # Enlarged by 1 / cos(pi / faces) the inner one contains the cone, so it is the largest with these faces.
        wide = jd.contact.friction_cone(kind, MU / np.cos(np.pi / faces), gamma)
        np.testing.assert_allclose(wide.pyramid(faces, "inscribed"), cone.pyramid(faces, "circumscribed"), atol=1e-14)
    four = np.abs(forces[:, :2]).max(1) - MU * forces[:, 2]
    np.testing.assert_allclose((forces @ np.asarray(cone.pyramid(4, "circumscribed"))[:4].T).max(1), four, atol=1e-14)


def test_cones_of_the_other_kinds():
    assert float(jd.contact.friction_cone("frictionless").margin(jnp.array([2.0]))) == 2.0
    assert jd.contact.friction_cone("rigid").linear_rows().shape == (0, 6)
    assert float(jd.contact.friction_cone("rigid").margin(jnp.ones(6))) == np.inf
    planar = jd.contact.friction_cone("hard-finger", MU, in_plane=True)
    np.testing.assert_allclose(planar.margin(jnp.array([-0.5, 1.0])), MU - 0.5, atol=1e-15)
    assert float(planar.normal_force(jnp.array([-0.5, 1.0]))) == 1.0
    foot = jd.contact.surface_cone(jd.contact.wrench_cone(X, Y, MU))
    wrench = jnp.array([0.1, -0.2, 1.0, 0.01, 0.02, 0.03])
    np.testing.assert_allclose(foot.margin(wrench), -(foot.linear_rows() @ wrench).max(), atol=1e-15)


def test_margins_are_smooth_and_on_the_safe_side():
    cone, smoothing = jd.contact.friction_cone("soft-finger", MU, 0.02), 1e-2
    forces = jnp.array([[0, 0, 0, 0], [0, 0, 1, 0], [0.3, -0.1, 1, 0.005], [1e-160, 0, 1e-9, 0]])
    soft = lambda f: cone.margin(f, smoothing)  # noqa: E731

    @quick
    @jax.vmap
    def computed(f):
        step = 1e-5 * jnp.eye(4)
        differences = (jax.vmap(soft)(f[None] + step) - jax.vmap(soft)(f[None] - step)) / 2e-5
        second = jax.hessian(cone.margin)(f), jax.hessian(soft)(f)
        return cone.margin(f), soft(f), jax.grad(cone.margin)(f), jax.grad(soft)(f), differences, second

    exact, smooth, kinked, gradient, differences, second = computed(forces)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((kinked, second)))
    assert (exact - smoothing * (1 + np.log(3)) <= smooth).all() and (smooth <= exact).all()
    np.testing.assert_allclose(gradient, differences, atol=1e-6)


def test_margins_batch_and_keep_the_dtype():
    cone = jd.contact.friction_cone("hard-finger", jnp.float32(0.5))
    forces = jnp.ones((3, 3), jnp.float32)
    computed = jax.jit(jax.vmap(lambda f: cone.margin(f, 1e-3)))(forces)
    assert computed.dtype == jnp.float32 and computed.shape == (3,)
    slope = jax.grad(lambda mu: jd.contact.friction_cone("hard-finger", mu).margin(jnp.array([0.1, 0.2, 3.0])))(0.5)
    np.testing.assert_allclose(slope, 3.0)


test_bad_input_is_refused = refusals(
    (lambda: jd.contact.friction_cone("sticky"), "sticky"),
    (lambda: jd.contact.friction_cone("hard-finger", -0.5), r"mu is -0\.5"),
    (lambda: jd.contact.friction_cone("hard-finger"), "mu is None"),
    (lambda: jd.contact.friction_cone("hard-finger", 0.5, 0.1), "gamma is 0.1"),
    (lambda: jd.contact.friction_cone("soft-finger", 0.5, -0.1), "gamma is -0.1"),
    (lambda: jd.contact.friction_cone("soft-finger", 0.5, 0.1, in_plane=True), "in a plane"),
    (lambda: jd.contact.friction_cone("frictionless", 0.5), "mu is 0.5"),
    (lambda: jd.contact.friction_cone("hard-finger", [0.5, 0.5]), "mu has shape"),
    (lambda: jd.contact.friction_cone("hard-finger", 0.5).margin(jnp.zeros(4)), "force has shape"),
    (lambda: jd.contact.friction_cone("hard-finger", 0.5).pyramid(2), "faces is 2"),
    (lambda: jd.contact.friction_cone("hard-finger", 0.5).pyramid(4, "left"), "side is 'left'"),
    (lambda: jd.contact.surface_cone(jnp.zeros((4, 3))), "rows has shape"),
    (lambda: jd.contact.surface_cone(jnp.zeros((0, 6))), "one row"),
    (lambda: jd.contact.wrench_cone(-0.1, 0.1, 0.5), "half_x is -0.1"),
    (lambda: jd.contact.wrench_cone(0.1, 0.0, 0.5), "half_y is 0.0"),
    (lambda: jd.contact.wrench_cone(0.1, 0.1, -0.5), "mu is -0.5"),
    (lambda: jd.contact.wrench_cone(0.1, float("nan"), 0.5), "half_y is nan"),
    (lambda: jd.contact.wrench_cone_of_polygon([[0, 0], [1, 1], [2, 2]], 0.5), "on a line"),
    (lambda: jd.contact.wrench_cone_of_polygon([[0, 0], [1, 1]], 0.5), "at least three"),
    (lambda: jd.contact.wrench_cone_of_polygon(CORNERS, 0.0), "mu is 0.0"),
    (lambda: jax.jit(lambda c: jd.contact.wrench_cone_of_polygon(c, 0.5))(CORNERS), "outside of jit"),
)
