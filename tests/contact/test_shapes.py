"""Gaps of shapes against numerical minimisation, MuJoCo and differences; drops on the ground."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from refusals import refusals
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import jaxdyn as jd
from jaxdyn.contact.shapes import UPRIGHT

POINTS = 0.1 * np.random.default_rng(0).normal(size=(10, 3))
# Each with the geom of MuJoCo, whose sizes are half lengths.
SHAPES = {
    "sphere": (jd.contact.Sphere(0.1), 'type="sphere" size="0.1"'),
    "ellipsoid": (jd.contact.Ellipsoid((0.1, 0.15, 0.2)), 'type="ellipsoid" size="0.1 0.15 0.2"'),
    "capsule": (jd.contact.Capsule(0.1, 0.3), 'type="capsule" size="0.1 0.15"'),
    "box": (jd.contact.Box((0.2, 0.3, 0.1)), 'type="box" size="0.1 0.15 0.05"'),
    "cylinder": (jd.contact.Cylinder(0.1, 0.3), 'type="cylinder" size="0.1 0.15"'),
    "hull": (jd.contact.ConvexHull(POINTS), 'type="mesh" mesh="hull"'),
}
HEIGHTS = 0.05 * np.random.default_rng(1).random((8, 9))
FIELD, COARSE = (jd.contact.HeightField(HEIGHTS, 0.3, smooth=smooth) for smooth in (True, False))


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
    if isinstance(shape, jd.contact.Box):
        return 0.5 * np.asarray(shape.size) * np.sign(d)
    if isinstance(shape, jd.contact.ConvexHull):
        return POINTS[np.argmax(POINTS @ d)]
    if isinstance(shape, jd.contact.Capsule):
        return np.array([0, 0, 0.5 * float(shape.length) * np.sign(d[2])]) + float(shape.radius) * d
    if isinstance(shape, jd.contact.Cylinder):
        flat = d[:2] / np.linalg.norm(d[:2])
        return np.array([*(float(shape.radius) * flat), 0.5 * float(shape.length) * np.sign(d[2])])
    # An ellipsoid: the largest value over spherical coordinates, with no formula for it.
    axes = np.asarray(shape.semi_axes)

    def point(u):
        return axes * np.array([np.cos(u[0]) * np.cos(u[1]), np.cos(u[0]) * np.sin(u[1]), np.sin(u[0])])

    starts = [(a, b) for a in (-0.8, 0.8) for b in (0.0, 2.0, 4.0)]
    best = min((minimize(lambda u: -point(u) @ d, s, tol=1e-15) for s in starts), key=lambda r: r.fun)
    return point(best.x)


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
def test_least_gaps_on_a_plane_are_distances(name):
    """Against the extreme point of each shape and MuJoCo; the point of contact is on the shape, the normal that of the plane."""
    shape, geom = SHAPES[name]
    R, p = poses(80)
    points, normals, found, directions = gaps(jd.contact.shape_contacts("body", shape, friction=0.5), R, p)
    least = np.array([(R_ @ extreme(shape, -R_[2]) + p_)[2] for R_, p_ in zip(R[:40], p[:40], strict=True)])
    np.testing.assert_allclose(
        found[:40].min(1), least, atol=1e-10 if name != "ellipsoid" else 1e-9
    )  # of the minimiser
    np.testing.assert_allclose(points[..., 2], found, atol=1e-15)
    assert (normals == [0, 0, 1]).all() and (directions == np.eye(2, 3)).all()
    m = mujoco_model(geom, 'type="plane" size="1 1 1"')
    theirs = [mujoco_distance(m, *one) for one in zip(R[40:], p[40:], strict=True)]
    # Meshes of MuJoCo have vertices in float32.
    np.testing.assert_allclose(found[40:].min(1), theirs, atol=1e-7 if name == "hull" else 1e-10)


ROUND = {
    "sphere": (jd.contact.Sphere(0.2), 'type="sphere" size="0.2"'),
    "capsule": (jd.contact.Capsule(0.15, 0.4), 'type="capsule" size="0.15 0.2"'),
    "box": (jd.contact.Box((0.4, 0.3, 0.5)), 'type="box" size="0.2 0.15 0.25"'),
}


@pytest.mark.parametrize("name", ROUND)
def test_sphere_on_shapes_against_mujoco_and_minimisation(name):
    """Outside and inside; outside of it also by a minimisation over the points of the shape."""
    on, geom = ROUND[name]
    m = mujoco_model('type="sphere" size="0.1"', geom)
    R, p = poses(60, 4)
    ball = jd.contact.shape_contacts("body", jd.contact.Sphere(0.1), on=on)
    points, normals, ours, _ = (x[:, 0] for x in gaps(ball, R, p))
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


def surface_distance(height_and_slope, point):
    """Least distance from a point (3,) to a height field, by minimisation."""

    def cost(u):
        value, slope = height_and_slope(u)
        d = np.array([*u, float(value)]) - point
        return d @ d, 2 * (d[:2] + d[2] * np.asarray(slope))

    return np.sqrt(minimize(cost, point[:2], jac=True, tol=1e-15).fun)


def test_height_field_is_a_natural_spline():
    """Heights at the nodes, scipy's splines between them, their derivatives, and the edge beyond."""
    from scipy.interpolate import CubicSpline

    x, y = (0.3 * (np.arange(n) - 0.5 * (n - 1)) for n in HEIGHTS.shape)
    spots = np.random.default_rng(0).uniform(-1, 1, size=(30, 2)) * [1.0, 1.1]
    along = CubicSpline(x, HEIGHTS, bc_type="natural")

    def theirs(u, i=0, j=0):
        return CubicSpline(y, along(u[0], i), bc_type="natural")(u[1], j)

    heights, found = jax.jit(jax.vmap(lambda u: (FIELD.height(u), FIELD.expand(u))))(jnp.asarray(spots))
    np.testing.assert_allclose(heights, [theirs(u) for u in spots], atol=1e-14)
    for name, axes in {"first": [()], "second": [(0,), (1,)], "third": [(0, 0), (0, 1), (1, 1)]}.items():
        for more in axes:
            for k in range(2):
                index = (*more, k)
                value = [theirs(u, index.count(0), index.count(1)) for u in spots]
                np.testing.assert_allclose(getattr(found, name)[(slice(None), *index)], value, atol=1e-11)
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    for field in (FIELD, COARSE):

        @jax.jit
        @jax.vmap
        def expand(u, f=field):
            return f.height(u), jax.grad(lambda u: f.height(u))(u), jax.hessian(lambda u: f.height(u))(u)

        height, slope, bend = expand(np.concatenate([nodes, [[5.0, y[3]]]]))  # and beyond the edge
        np.testing.assert_allclose(height, [*HEIGHTS.ravel(), HEIGHTS[-1, 3]], atol=1e-14)
        assert slope[-1, 0] == 0.0 and np.isfinite(bend[-1]).all()
    linear = jd.contact.HeightField(HEIGHTS, (0.3, 0.3), origin=(x[0], y[0]), smooth=False)
    middle = jnp.array([x[2] + 0.1, y[4] + 0.2])
    a, b = HEIGHTS[2, 4:6] @ [1 / 3, 2 / 3], HEIGHTS[3, 4:6] @ [1 / 3, 2 / 3]
    np.testing.assert_allclose(linear.height(middle), 2 / 3 * a + 1 / 3 * b, atol=1e-15)
    height = lambda u: linear.height(u)  # noqa: E731
    expanded, first, second = jax.jit(lambda u: (linear.expand(u), jax.grad(height)(u), jax.hessian(height)(u)))(middle)
    np.testing.assert_allclose(expanded.first, first, atol=1e-14)
    np.testing.assert_allclose(expanded.second, second, atol=1e-12)


def hills(xy):
    """Smooth ground of a function."""
    return 0.05 * jnp.sin(3 * xy[0]) * jnp.cos(2 * xy[1] + 0.3)


@pytest.mark.long
@pytest.mark.parametrize(
    ("ground", "name"),
    [
        pytest.param(
            ground, name, marks=pytest.mark.slow if kind == "function" and name != "sphere" else (), id=f"{name}-{kind}"
        )
        for kind, ground in {"grid": FIELD, "function": jd.contact.HeightField(hills)}.items()
        for name in ("sphere", "ellipsoid", "capsule", "box")
    ],
)
def test_gaps_on_uneven_ground(name, ground):
    """Zero where shapes touch; near it the distance up to the square of the gap; rates are those of the distance."""
    shape = SHAPES[name][0]
    contact = jd.contact.shape_contacts("body", shape, on=ground)[-1].contact
    touch = jax.jit(lambda R, p: (contact.touching(R, p), jax.jacfwd(lambda p: contact.touching(R, p).gap)(p)))
    height_and_slope = jax.jit(jax.value_and_grad(lambda u: ground.height(u)))
    for R, p in zip(*(jnp.asarray(x) for x in poses(3, 5)), strict=True):
        place = lowered(lambda p, R=R: touch(R, p)[0].gap, p)
        at, rate = touch(R, place)
        # The surfaces touch in the point: it is on the ground, and the normals are opposite.
        assert abs(at.point[2] - ground.height(at.point[:2])) < 1e-12
        own = R.T @ (np.asarray(at.point) - place)
        if name == "ellipsoid":
            axes = np.asarray(shape.semi_axes)
            assert abs(np.sum((own / axes) ** 2) - 1) < 1e-12
            outer = own / axes**2
            np.testing.assert_allclose(R @ outer / np.linalg.norm(outer), -at.normal, atol=1e-11)
        np.testing.assert_allclose(np.asarray(at.directions) @ at.normal, 0.0, atol=1e-14)
        np.testing.assert_allclose(rate, at.normal, atol=1e-10)
        if name == "ellipsoid":
            continue
        # Of a ball or a corner the distance is that of its centre.
        radius = 0.0 if name == "box" else 0.1
        for h in (-2e-3, 2e-3):
            lifted = touch(R, place + h * at.normal)[0]
            assert abs(lifted.gap - h) < 2 * h * h  # curvature below 2/m
            centre = np.asarray(lifted.point) + radius * np.asarray(lifted.normal)
            side = np.sign(centre[2] - float(ground.height(jnp.asarray(centre[:2]))))
            assert abs(lifted.gap - (side * surface_distance(height_and_slope, centre) - radius)) < 2 * h * h


# A sphere is a special ellipsoid, a capsule has one at each end (on uneven ground), and a hull has corners as a box.
LIKE = {"plane": ("sphere", "hull"), "uneven": ("sphere", "capsule", "hull")}


def lowered(gap, p):
    """Position with another height, at which the gap is zero."""
    low, high = -1.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if gap(p.at[2].set(middle)) > 0 else (middle, high)
    return p.at[2].set(low)


@pytest.mark.long
@pytest.mark.parametrize(
    ("ground", "name"),
    [
        pytest.param(ground, name, marks=pytest.mark.slow if name in LIKE[kind] else (), id=f"{kind}-{name}")
        for kind, ground in {"plane": jd.contact.Plane(), "uneven": FIELD}.items()
        for name in SHAPES
    ],
)
def test_derivatives_of_gaps_against_differences(name, ground):
    """Along a line of poses, up to second order, and where the shape touches up to third: its error is the gap."""
    contacts = jd.contact.shape_contacts("body", SHAPES[name][0], on=ground)
    # Uneven ground takes long to trace and compile to third order.
    contacts = contacts if isinstance(ground, jd.contact.Plane) else (contacts[0], contacts[-1])
    (R,), (p,) = (jnp.asarray(x) for x in poses(1, 6))
    axis, way = jnp.array([0.3, -0.5, 0.4]), jnp.array([0.2, -0.1, 0.3])

    def gaps_at(s, p):
        return jnp.stack([c.contact.touching(jd.so3.exp(s * axis) @ R, p + s * way).gap for c in contacts])

    def derive(function):
        return lambda s, p: jax.jvp(lambda s: function(s, p), (s,), (1.0,))

    @jax.jit
    def values(s, p):
        ((value, first), (_, second)), (_, (_, third)) = jax.vmap(derive(derive(derive(gaps_at))), (0, None))(s, p)
        return value, first, second, third

    h = 1e-3
    steps = h * jnp.arange(-2.0, 3.0)
    touching = lowered(lambda p: values(steps, p)[0][2, 0], p)
    # The lowest point of a rim depends on the normal below its centre, whose third derivative is that of a quadratic slope.
    most = 2 if name == "cylinder" and isinstance(ground, jd.contact.HeightField) else 3
    for place, which, orders in (
        (p, slice(None), 3 if isinstance(ground, jd.contact.Plane) else 2),
        (touching, 0, most),
    ):
        found = [np.asarray(x) for x in values(steps, place)]
        for order in range(orders):
            lower = found[order]
            difference = (8 * (lower[3] - lower[1]) - (lower[4] - lower[0])) / (12 * h)  # of fourth order
            np.testing.assert_allclose(found[order + 1][2][which], difference[which], atol=1e-8, err_msg=f"{order + 1}")


BALL, CAN = jd.contact.Sphere(0.1), jd.contact.Cylinder(0.1, 0.3)
UNEVEN, NODES = (jd.contact.HeightField(heights, 1.0) for heights in (np.zeros((4, 4)), np.ones((3, 3))))
# Positions, and turns where there are some.
PLACES = {
    "cylinder upright, and at the end of its ramp": (CAN, jd.contact.Plane(), (0, 0, 0.1), (0, 0, 0.1, UPRIGHT, 0, 0)),
    "upright cylinder on uneven ground": (CAN, UNEVEN, (0, 0, 0.1)),
    "sphere at a node of the grid, and on a corner": (BALL, NODES, (0, 0, 1.1), (1, 1, 1.0)),
    "equal centres": (BALL, jd.contact.Sphere(0.2), (0, 0, 0)),
    "on the axis of a capsule": (BALL, jd.contact.Capsule(0.2, 0.4), (0, 0, 0.1)),
    "centre, face and corner of a box": (
        BALL, jd.contact.Box((0.2, 0.3, 0.4)), (0, 0, 0), (0.05, 0.05, 0.2), (0.1, 0.15, 0.2)
    ),
    "sphere on the plane": (BALL, jd.contact.Plane(), (0, 0, 0)),
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("case", [pytest.param(x, marks=[pytest.mark.slow] * ("uneven" in x)) for x in PLACES])
def test_derivatives_are_finite_in_singular_places(case):
    """Gaps, normals and slip directions, with first and second derivatives; the gap of a box is exact on its faces."""
    shape, on, *places = PLACES[case]
    contacts = jd.contact.shape_contacts("body", shape, on=on)

    def all_of(x):
        touch = [c.contact.touching(jd.so3.exp(x[3:]), x[:3]) for c in contacts]
        return jnp.concatenate([jnp.concatenate([t.gap[None], t.normal, t.directions.ravel()]) for t in touch])

    def twice(function):
        return lambda x: (function(x),) * 2

    by_rows = jax.jacrev(twice(all_of), has_aux=True)
    second = jax.jacfwd(twice(jax.jacfwd(all_of)), has_aux=True)
    for derivative in map(jax.jit, (by_rows, second)):
        for place in places:
            x = jnp.zeros(6).at[: len(place)].set(jnp.array(place, float))
            assert all(np.isfinite(y).all() for y in derivative(x)), place


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_normal_of_a_box_a_rounding_above_its_face_is_that_of_the_face(dtype):
    """The centre of a sphere as near as numbers are, outside and inside, on each face."""
    contact = jd.contact.shape_contacts("body", jd.contact.Sphere(0.1), on=jd.contact.Box((2.0, 2.0, 2.0)))[0].contact
    for axis in range(3):
        for side in (-1.0, 1.0):
            for steps in (-2, -1, 0, 1, 2):
                p = np.full(3, 0.25)
                p[axis] = side * (1.0 + steps * float(jnp.finfo(dtype).eps))
                touch = contact.touching(jnp.eye(3, dtype=dtype), jnp.asarray(p, dtype))
                np.testing.assert_array_equal(touch.normal, side * np.eye(3)[axis])


def on_body(shape, **options):
    return jd.contact.shape_contacts("body", shape, **options)


SLENDER = jd.contact.Ellipsoid((1, 1, 2))
test_what_does_not_fit_is_refused = refusals(
    (lambda: on_body(jd.contact.Box((1, 1, 1)), on=jd.contact.Sphere(1.0)), "exchange them"),
    (lambda: on_body(SLENDER, on=jd.contact.Box((1, 1, 1))), "only a Sphere"),
    (lambda: on_body(jd.contact.Cylinder(1.0)), "Cylinder needs its"),
    (lambda: on_body(jd.contact.Plane()), "shape is a"),
    (lambda: on_body(jd.contact.Sphere(1.0), on=SLENDER), "on is a"),
    (lambda: on_body(jd.contact.Capsule(1.0, 1.0), on=COARSE), "set smooth=True"),
    (lambda: on_body(jd.contact.Sphere(1.0), friction=-1.0), "friction is -1.0"),
    (lambda: on_body(jd.contact.Sphere(0.1), lowest=1), "a Sphere on"),
    (lambda: on_body(jd.contact.Box((1, 1, 1)), lowest=4, on=FIELD), "a Box on"),
    (lambda: on_body(jd.contact.Box((1, 1, 1)), lowest=0), "lowest is 0"),
    (lambda: jd.contact.Box((1, 0, 1)), "three positive lengths"),
    (lambda: jd.contact.Capsule(0.1, -1.0), "length is -1"),
    (lambda: jd.contact.ConvexHull(np.zeros((0, 3))), "has no points"),
    (lambda: jd.contact.ConvexHull([[np.inf, 0.0, 0.0]]), "has infinite numbers"),
    (lambda: jd.contact.HeightField([[1.0, 2.0]], 1.0), "finite heights or"),
    (lambda: jd.contact.HeightField(HEIGHTS), "of the heights"),
    (lambda: jd.contact.HeightField(HEIGHTS, -1.0), "of the heights"),
    (lambda: jd.contact.HeightField(hills, 1.0), "omit them for"),
    (lambda: jd.contact.HeightField(lambda u: u).height(jnp.zeros(2)), "return one number"),
)


def body_of(*contacts, inertia=(1.0, (0.0, 0.0, 0.0), (0.004, 0.005, 0.006))):
    """A free body with contacts."""
    builder = jd.ModelBuilder("body").add_body("body", None, "free", inertia)
    return jd.Scene(builder.build(), forces=contacts)


def steps(scene, state, count, dt=0.005):
    """States and reports of steps without torques."""
    step, rest = jd.stepper(scene, dt, report=True), jnp.zeros(scene.nv)

    def advance(state, _):
        state, report = step(state, rest)
        return state, (state, report)

    return jax.jit(lambda state: jax.lax.scan(advance, state, None, length=count)[1])(state)


THREE_SIDES = jd.contact.ConvexHull([(0.1, 0, -0.05), (-0.05, 0.09, -0.05), (-0.05, -0.09, -0.05), (0, 0, 0.1)])
# Turns at the start, and the height at rest.
DROPS = {
    "sphere": (jd.contact.Sphere(0.1), (0.3, 0, 0), 0.1, True),
    "capsule": (jd.contact.Capsule(0.1, 0.3), (np.pi / 2 + 0.1, 0, 0), 0.1, True),
    "hull": (THREE_SIDES, (0.1, 0.05, 0), 0.05, True),
    "lying cylinder": (jd.contact.Cylinder(0.1, 0.3), (np.pi / 2 + 0.1, 0, 0), 0.1, False),
    "upright cylinder": (jd.contact.Cylinder(0.1, 0.3), (0.05, 0.02, 0), 0.15, False),
    "box": (jd.contact.Box((0.2, 0.3, 0.1)), (0.1, 0.05, 0), 0.05, False),
}


# A capsule has two points where others have one or four, and a box falls on its corners below.
@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.slow] * (x in ("capsule", "box"))) for x in DROPS])
def test_shapes_dropped_on_the_ground_come_to_rest(name):
    """At the height of the shape, with its weight as force, and without gaining energy; by steps and by events."""
    shape, turn, height, has_events = DROPS[name]
    scene = body_of(*jd.contact.shape_contacts("body", shape, friction=0.5))
    quaternion = Rotation.from_euler("xyz", turn).as_quat()[[3, 0, 1, 2]]
    q, v = jnp.array([0, 0, height + 0.06, *quaternion]), jnp.zeros(6)
    (qs, vs), report = steps(scene, (q, v), 1000)
    assert np.asarray(report.success).all()
    np.testing.assert_allclose(qs[-1, 2], height, atol=1e-9)
    assert float(jnp.abs(vs[-1]).max()) < 1e-9
    np.testing.assert_allclose(sum(f[-1, -1] for f in report.forces.values()), 9.81, rtol=1e-9)
    energy = jax.vmap(lambda q, v: jd.kinetic_energy(scene.system, q, v) + jd.potential_energy(scene.system, q))(qs, vs)
    # Steps are of order one where contacts close: a corner that is about to touch pushes a step too early.
    assert float(jnp.max(jnp.diff(energy))) < 1e-3 * float(energy[0])
    if has_events:
        motion = jd.simulate(scene, q, v, jnp.linspace(0.0, 3.0, 31), outputs=("energy",))
        np.testing.assert_allclose(motion.q[-1, 2], height, atol=1e-9)
        assert float(jnp.abs(motion.v[-1]).max()) < 1e-9 and float(jnp.max(jnp.diff(motion.energy))) < 1e-8


@pytest.mark.long
def test_ball_thrown_at_a_moving_box_conserves_momentum():
    """Action and reaction on two free bodies without gravity, linear and angular about the origin."""
    builder = jd.ModelBuilder("two", gravity=None)
    for name, mass in (("ball", 0.5), ("box", 2.0)):
        builder.add_body(name, None, "free", (mass, (0.0, 0.0, 0.0), (0.01 * mass,) * 3))
    options = {"on": jd.contact.Box((0.4, 0.4, 0.4)), "surface_body": "box", "friction": 0.6, "restitution": 0.5}
    scene = jd.Scene(builder.build(), forces=jd.contact.shape_contacts("ball", BALL, **options))
    model = scene.system
    parts = {"ball": ((-0.6, 0.05, 0.1), (2.0, 0.3, 0.1, 1.0, 2.0, -1.0)), "box": ((0, 0, 0), (0, 0.1, 0, 0.2, 0, 0.1))}
    q, v = np.zeros(14), np.zeros(12)
    for name, (place, twist) in parts.items():
        i = model.body_names.index(name)
        q[model.topology.q_slices[i]], v[model.topology.v_slices[i]] = (*place, 1, 0, 0, 0), twist

    def momentum(q, v):
        total, about = 0.0, 0.0
        for i, name in enumerate(model.body_names):
            own, twist = q[model.topology.q_slices[i]], v[model.topology.v_slices[i]]
            mass = {"ball": 0.5, "box": 2.0}[name]
            turn = Rotation.from_quat(own[[4, 5, 6, 3]]).as_matrix()
            total = total + mass * turn @ twist[:3]
            about = about + np.cross(own[:3], mass * turn @ twist[:3]) + 0.01 * mass * turn @ twist[3:]
        return np.concatenate([total, about])

    errors = []
    for count in (60, 120, 240):
        (qs, vs), report = steps(scene, (jnp.asarray(q), jnp.asarray(v)), count, 0.3 / count)
        assert np.asarray(report.success).all() and float(max(f[:, -1].max() for f in report.forces.values())) > 10
        changes = np.array([momentum(*x) for x in zip(np.asarray(qs), np.asarray(vs), strict=True)]) - momentum(q, v)
        errors.append([np.abs(changes[:, part]).max() for part in (slice(3), slice(3, 6))])
    # Velocities are those of axes that turn in a step: both momenta hold to its square.
    errors = np.array(errors)
    assert (errors[0] < 1e-4).all() and (np.abs(errors[:-1] / errors[1:] - 4) < 0.2).all(), errors


@pytest.mark.long
def test_gradient_of_steps_on_uneven_ground():
    """A ball that rolls over a height field: derivatives by its start and by the heights against differences."""

    def last(speed, bump):
        field = jd.contact.HeightField(jnp.asarray(HEIGHTS).at[4, 4].add(bump), 0.3)
        contacts = jd.contact.shape_contacts("body", BALL, on=field, friction=0.5)
        step = jd.stepper(body_of(*contacts, inertia=jd.inertia.sphere(1.0, 0.1)), 0.005)
        state = jnp.array([-0.1, 0.05, 0.135, 1.0, 0, 0, 0]), jnp.zeros(6).at[0].set(speed)
        state, _ = jax.lax.scan(lambda s, _: (step(s, jnp.zeros(6)), None), state, None, length=40)
        return state[0][0] + 0.3 * state[0][2]

    value, h = jax.jit(last), 1e-5
    found = jax.jit(jax.grad(last, (0, 1)))(1.0, 0.0)
    differences = (value(1 + h, 0.0) - value(1 - h, 0.0)) / (2 * h), (value(1.0, h) - value(1.0, -h)) / (2 * h)
    np.testing.assert_allclose(found, differences, rtol=1e-6)
    assert min(abs(float(x)) for x in found) > 1e-3


@pytest.mark.parametrize("name", ["box", "hull"])
def test_lowest_corners_are_those_of_all_in_order(name):
    """Gaps and points, of which also the derivatives are those of the corner; as many as there are at the most."""
    shape = SHAPES[name][0]
    every, lowest = jd.contact.shape_contacts("b", shape), jd.contact.shape_contacts("b", shape, lowest=4)
    R, p = poses(50)
    point, gap, some, least = (part for x in (every, lowest) for part in gaps(x, R, p)[::2])
    order = np.argsort(gap, 1)[:, :4]
    np.testing.assert_allclose(least, np.take_along_axis(gap, order, 1), rtol=0, atol=1e-15)
    np.testing.assert_allclose(some, np.take_along_axis(point, order[:, :, None], 1), rtol=0, atol=1e-15)
    slopes = [
        jax.jacfwd(lambda w, one=one: one.contact.touching(jd.so3.exp(w) @ R[0], p[0] + w).gap)(jnp.zeros(3))
        for one in (every[order[0, 2]], lowest[2])
    ]
    np.testing.assert_allclose(*slopes, rtol=0, atol=1e-15)
    assert len(jd.contact.shape_contacts("b", shape, lowest=100)) == len(every)


def test_a_box_falls_on_its_lowest_corners_as_on_all():
    """Impacts on corners, edges and a face."""
    size, turned = (0.3, 0.2, 0.1), np.array([0.9, 0.3, 0.2, 0.1])
    state = jnp.array([0, 0, 0.3, *(turned / np.linalg.norm(turned))]), jnp.array([0.5, 0.2, 0, 1.0, 2.0, 0.5])
    ends, box = [], on_body(jd.contact.Box(size), friction=0.6, restitution=0.2)
    for contacts in (box, on_body(jd.contact.Box(size), friction=0.6, restitution=0.2, lowest=4)):
        scene = body_of(*contacts, inertia=jd.inertia.box(2.0, size))
        ends.append(steps(scene, state, 160)[0][0])
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-10)
    np.testing.assert_allclose(ends[1][-1, 2], 0.05, atol=1e-10)
    with pytest.raises(ValueError, match=r"lowest corner.*jd\.stepper"):
        jd.simulate(scene, *state, [0.0, 0.1])
