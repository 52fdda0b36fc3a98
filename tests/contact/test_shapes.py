"""Gaps of shapes against numerical minimisation, MuJoCo and differences; drops on the ground."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from jaxdyn.contact import Box, Capsule, ConvexHull, Cylinder, Ellipsoid, HeightField, Plane, Sphere, shape_contacts
from jaxdyn.lie import so3

POINTS = 0.1 * np.random.default_rng(0).normal(size=(10, 3))
# Each with the geom of MuJoCo, whose sizes are half lengths.
SHAPES = {
    "sphere": (Sphere(0.1), 'type="sphere" size="0.1"'),
    "ellipsoid": (Ellipsoid((0.1, 0.15, 0.2)), 'type="ellipsoid" size="0.1 0.15 0.2"'),
    "capsule": (Capsule(0.1, 0.3), 'type="capsule" size="0.1 0.15"'),
    "box": (Box((0.2, 0.3, 0.1)), 'type="box" size="0.1 0.15 0.05"'),
    "cylinder": (Cylinder(0.1, 0.3), 'type="cylinder" size="0.1 0.15"'),
    "hull": (ConvexHull(POINTS), 'type="mesh" mesh="hull"'),
}
HEIGHTS = 0.05 * np.random.default_rng(1).random((8, 9))
FIELD = HeightField(HEIGHTS, 0.3)


def poses(count, seed=2):
    """Random rotations (count, 3, 3) and positions (count, 3)."""
    rng = np.random.default_rng(seed)
    return Rotation.random(count, random_state=rng).as_matrix(), 0.3 * rng.normal(size=(count, 3))


def gaps(contacts, R, p):
    """Gaps, points, normals and slip directions of all contacts, (n,) each, for poses (m, ...)."""
    touch = jax.jit(jax.vmap(lambda R, p: [c.contact.touching(R, p) for c in contacts]))(R, p)
    return [np.stack(x, 1) for x in zip(*touch, strict=True)]


def extreme(shape, direction):
    """Extreme point of a shape in its own axes by brute force, in NumPy."""
    d = np.asarray(direction)
    if isinstance(shape, Box):
        return 0.5 * np.asarray(shape.size) * np.sign(d)
    if isinstance(shape, ConvexHull):
        return POINTS[np.argmax(POINTS @ d)]
    if isinstance(shape, Capsule):
        return np.array([0, 0, 0.5 * float(shape.length) * np.sign(d[2])]) + float(shape.radius) * d
    if isinstance(shape, Cylinder):
        flat = d[:2] / np.linalg.norm(d[:2])
        return np.array([*(float(shape.radius) * flat), 0.5 * float(shape.length) * np.sign(d[2])])
    # An ellipsoid: the largest value over spherical coordinates, with no formula for it.
    axes = np.asarray(shape.semi_axes)

    def point(u):
        return axes * np.array([np.cos(u[0]) * np.cos(u[1]), np.cos(u[0]) * np.sin(u[1]), np.sin(u[0])])

    starts = [(a, b) for a in (-0.8, 0.8) for b in (0.0, 2.0, 4.0)]
    best = min((minimize(lambda u: -point(u) @ d, s, tol=1e-15) for s in starts), key=lambda r: r.fun)
    return point(best.x)


@pytest.mark.parametrize("name", SHAPES)
def test_least_gaps_on_a_slope_are_distances(name):
    """Against the extreme point of each shape; the point of contact is on the shape, and the normal that of the plane."""
    shape = SHAPES[name][0]
    contacts = shape_contacts("body", shape, friction=0.5)
    R, p = poses(40)
    found, points, normals, directions = (gaps(contacts, R, p)[i] for i in (2, 0, 1, 3))
    least = np.array([(R_ @ extreme(shape, -R_[2]) + p_)[2] for R_, p_ in zip(R, p, strict=True)])
    np.testing.assert_allclose(found.min(1), least, atol=1e-10 if name != "ellipsoid" else 1e-9)  # of the minimiser
    np.testing.assert_allclose(points[..., 2], found, atol=1e-15)
    assert (normals == [0, 0, 1]).all() and (directions == np.eye(2, 3)).all()


def mujoco_model(geom, ground):
    vertices = " ".join(f"{x:.17g}" for x in POINTS.ravel())
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><mesh name="hull" vertex="{vertices}"/></asset><worldbody><geom name="ground" {ground}/>
        <body name="b"><freejoint/><geom name="g" {geom} margin="10"/></body></worldbody></mujoco>"""
    )


def mujoco_distance(m, R, p):
    """Least distance of MuJoCo's contacts between the ground and the shape, of which the margin makes all poses one."""
    d = mujoco.MjData(m)
    # The compiler turns a mesh to its principal axes.
    local, turn = m.geom("g").pos, Rotation.from_quat(m.geom("g").quat[[1, 2, 3, 0]])
    assert np.isfinite(local).all() and turn is not None
    quaternion = Rotation.from_matrix(R).as_quat()[[3, 0, 1, 2]]
    d.qpos[:] = [*p, *quaternion]
    mujoco.mj_kinematics(m, d)
    mujoco.mj_collision(m, d)
    return min(d.contact.dist[: d.ncon])


@pytest.mark.parametrize("name", SHAPES)
def test_gaps_on_a_plane_against_mujoco(name):
    """The least one; meshes of MuJoCo have vertices in float32."""
    shape, geom = SHAPES[name]
    m = mujoco_model(geom, 'type="plane" size="1 1 1"')
    R, p = poses(40, 3)
    theirs = [mujoco_distance(m, *one) for one in zip(R, p, strict=True)]
    ours = gaps(shape_contacts("body", shape), R, p)[2].min(1)
    np.testing.assert_allclose(ours, theirs, atol=1e-7 if name == "hull" else 1e-10)


ROUND = {
    "sphere": (Sphere(0.2), 'type="sphere" size="0.2"'),
    "capsule": (Capsule(0.15, 0.4), 'type="capsule" size="0.15 0.2"'),
    "box": (Box((0.4, 0.3, 0.5)), 'type="box" size="0.2 0.15 0.25"'),
}


@pytest.mark.parametrize("name", ROUND)
def test_sphere_on_shapes_against_mujoco_and_minimisation(name):
    """Outside and inside; outside of it also by a minimisation over the points of the shape."""
    on, geom = ROUND[name]
    m = mujoco_model('type="sphere" size="0.1"', geom)
    R, p = poses(60, 4)
    ours, points, normals = (gaps(shape_contacts("body", Sphere(0.1), on=on), R, p)[i][:, 0] for i in (2, 0, 1))
    theirs = np.array([mujoco_distance(m, *one) for one in zip(R, p, strict=True)])
    # MuJoCo has contacts of a sphere whose centre is in a box up to its radius alone, and another face when that is nearer.
    np.testing.assert_allclose(ours, theirs, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-14)
    # The contact point is on the sphere, against the normal.
    np.testing.assert_allclose(points, p - 0.1 * normals, atol=1e-14)
    for centre, gap in zip(p, ours, strict=True):
        if gap < 0:
            continue
        if name == "box":
            bounds = [(-0.5 * x, 0.5 * x) for x in np.asarray(on.size)]
            reach = 0.0
        else:
            half = 0.5 * float(on.length) if name == "capsule" else 0.0
            bounds, reach = [(0, 0), (0, 0), (-half, half)], float(on.radius)
        found = minimize(lambda x, c=centre: np.sum((x - c) ** 2), np.zeros(3), bounds=bounds, tol=1e-16)
        np.testing.assert_allclose(gap, np.sqrt(found.fun) - reach - 0.1, atol=1e-7)  # of the minimiser


def surface_distance(field, points, others=None):
    """Least distance from each of the points (n, 3) to a height field, by minimisation."""
    found = []
    height = jax.jit(field.height)
    grad = jax.jit(jax.grad(field.height))
    for point in points:

        def cost(u, point=point):
            d = np.array([*u, float(height(u))]) - point
            return d @ d, 2 * (d[:2] + d[2] * np.asarray(grad(u)))

        found.append(np.sqrt(minimize(cost, point[:2], jac=True, tol=1e-15).fun))
    return np.array(found)


def test_height_field_is_a_natural_spline():
    """Heights at the nodes, scipy's splines between them, their derivatives, and the edge beyond."""
    from scipy.interpolate import CubicSpline

    x, y = (0.3 * (np.arange(n) - 0.5 * (n - 1)) for n in HEIGHTS.shape)
    spots = np.random.default_rng(0).uniform(-1, 1, size=(30, 2)) * [1.0, 1.1]
    along = CubicSpline(x, HEIGHTS, bc_type="natural")

    def theirs(u, i=0, j=0):
        return CubicSpline(y, along(u[0], i), bc_type="natural")(u[1], j)

    np.testing.assert_allclose(jax.vmap(FIELD.height)(spots), [theirs(u) for u in spots], atol=1e-14)
    found = jax.vmap(FIELD.expand)(jnp.asarray(spots))
    for name, axes in {"first": [()], "second": [(0,), (1,)], "third": [(0, 0), (0, 1), (1, 1)]}.items():
        for more in axes:
            for k in range(2):
                index = (*more, k)
                value = [theirs(u, index.count(0), index.count(1)) for u in spots]
                np.testing.assert_allclose(getattr(found, name)[(slice(None), *index)], value, atol=1e-11)
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    for field in (FIELD, HeightField(HEIGHTS, 0.3, smooth=False)):
        np.testing.assert_allclose(jax.vmap(field.height)(nodes), HEIGHTS.ravel(), atol=1e-14)
        beyond = jnp.array([5.0, y[3]])
        np.testing.assert_allclose(field.height(beyond), HEIGHTS[-1, 3], atol=1e-14)
        assert (jax.grad(field.height)(beyond)[0] == 0.0) and np.isfinite(jax.hessian(field.height)(beyond)).all()
    linear = HeightField(HEIGHTS, (0.3, 0.3), origin=(x[0], y[0]), smooth=False)
    middle = jnp.array([x[2] + 0.1, y[4] + 0.2])
    a, b = HEIGHTS[2, 4:6] @ [1 / 3, 2 / 3], HEIGHTS[3, 4:6] @ [1 / 3, 2 / 3]
    np.testing.assert_allclose(linear.height(middle), 2 / 3 * a + 1 / 3 * b, atol=1e-15)
    expanded = linear.expand(middle)
    np.testing.assert_allclose(expanded.first, jax.grad(linear.height)(middle), atol=1e-14)
    np.testing.assert_allclose(expanded.second, jax.hessian(linear.height)(middle), atol=1e-12)


def hills(xy):
    """Smooth ground of a function."""
    return 0.05 * jnp.sin(3 * xy[0]) * jnp.cos(2 * xy[1] + 0.3)


@pytest.mark.parametrize("ground", [FIELD, HeightField(hills)], ids=["grid", "function"])
@pytest.mark.parametrize("name", ["sphere", "ellipsoid", "capsule", "box"])
def test_gaps_on_uneven_ground(name, ground):
    """Zero where shapes touch; near it the distance up to the square of the gap; rates are those of the distance."""
    shape = SHAPES[name][0]
    contacts = shape_contacts("body", shape, on=ground)
    R, p = (jnp.asarray(x) for x in poses(6, 5))

    def gap(R, p, i):
        return contacts[i].contact.touching(R, p).gap

    for i in range(min(2, len(contacts))):
        touch = jax.jit(lambda R, p, i=i: contacts[i].contact.touching(R, p))
        for R_, p_ in zip(R, p, strict=True):
            # Lowered until the gap is zero, by bisection.
            low, high = -1.0, 1.0
            for _ in range(60):
                middle = 0.5 * (low + high)
                low, high = (low, middle) if touch(R_, jnp.array([*p_[:2], middle])).gap > 0 else (middle, high)
            at = touch(R_, jnp.array([*p_[:2], low]))
            # The surfaces touch in the point: it is on the ground, and the normals are opposite.
            assert abs(at.point[2] - ground.height(at.point[:2])) < 1e-12
            own = R_.T @ (np.asarray(at.point) - [*p_[:2], low])
            if name == "ellipsoid":
                axes = np.asarray(shape.semi_axes)
                assert abs(np.sum((own / axes) ** 2) - 1) < 1e-12
                outer = own / axes**2
                np.testing.assert_allclose(R_ @ outer / np.linalg.norm(outer), -at.normal, atol=1e-11)
            np.testing.assert_allclose(np.asarray(at.directions) @ at.normal, 0.0, atol=1e-14)
            rate = jax.jacfwd(lambda p, R_=R_, i=i: gap(R_, p, i))(jnp.array([*p_[:2], low]))
            np.testing.assert_allclose(rate, at.normal, atol=1e-10)
            # Of a ball or a corner the distance is that of its centre.
            if name != "ellipsoid":
                radius = 0.0 if name == "box" else 0.1
                for h in (-2e-3, 2e-3):
                    lifted = touch(R_, jnp.array([*p_[:2], low]) + h * at.normal)
                    centre = np.asarray(lifted.point) + radius * np.asarray(lifted.normal)
                    assert abs(lifted.gap - h) < 2 * h * h  # curvature below 2/m
                    true = surface_distance(ground, [centre])[0]
                    side = np.sign(centre[2] - float(ground.height(jnp.asarray(centre[:2]))))
                    assert abs(lifted.gap - (side * true - radius)) < 2 * h * h


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("ground", [Plane(), FIELD], ids=["plane", "uneven"])
def test_derivatives_of_gaps_against_differences(name, ground):
    """Along a line of poses: of first and second order, and of the third where the shape touches, as its error is the gap."""
    contacts = shape_contacts("body", SHAPES[name][0], on=ground)
    (R,), (p,) = (jnp.asarray(x) for x in poses(1, 6))
    axis, way = jnp.array([0.3, -0.5, 0.4]), jnp.array([0.2, -0.1, 0.3])

    def gap(s, p, i):
        return contacts[i].contact.touching(so3.exp(s * axis) @ R, p + s * way).gap

    for i in range(len(contacts)) if ground != FIELD else (0, -1):
        value = jax.jit(lambda z, i=i: gap(0.0, jnp.array([p[0], p[1], z]), i))
        low, high = -1.0, 1.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if value(middle) > 0 else (middle, high)
        for place, orders in ((p, 2), (jnp.array([p[0], p[1], low]), 3)):
            functions = [lambda s, place=place, i=i: gap(s, place, i)]
            for _ in range(orders):
                functions.append(jax.jacfwd(functions[-1]))
            values = [jax.jit(f) for f in functions]
            h = 1e-3
            for order, (lower, upper) in enumerate(zip(values[:-1], values[1:], strict=True)):
                # Of fourth order in h. The third derivative is exact at the place of contact alone: to second order in h.
                difference = (8 * (lower(h) - lower(-h)) - (lower(2 * h) - lower(-2 * h))) / (12 * h)
                np.testing.assert_allclose(upper(0.0), difference, atol=3e-9, err_msg=f"{i} {order}")
