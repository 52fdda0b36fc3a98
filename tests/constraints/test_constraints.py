"""Rows of constraints: against the motion subspaces of joints, finite differences of poses, and material points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick, random_states

import jaxdyn as jd
from jaxdyn import inertia, se3
from jaxdyn.constraints.base import layout, rows

# Twists (v, omega) that each joint leaves free, in frame B.
FREE = {
    "revolute": [5],
    "prismatic": [2],
    "cylindrical": [2, 5],
    "spherical": [3, 4, 5],
    "point": [3, 4, 5],
    "planar": [0, 1, 5],
    "weld": [],
}
POSE_A, POSE_B = ((0.3, -0.1, 0.2), (0.4, -0.7, 1.1)), ((-0.2, 0.1, 0.5), (-1.0, 0.3, 0.6))


@pytest.fixture(scope="module")
def pair():
    """Two free bodies, and one on a second tree with revolute, prismatic and spherical joints."""
    builder = jd.ModelBuilder("pair")
    brick = inertia.box(1.0, (0.2, 0.3, 0.4))
    builder.add_body("a", None, "free", brick).add_body("b", None, "free", brick)
    builder.add_body("c", None, "revolute", brick, axis=(0, 1, 1), pose=(0.1, 0.2, 0.3))
    builder.add_body("d", "c", "prismatic", brick, axis=(1, 0, 1)).add_body("e", "d", "spherical", brick)
    builder.add_frame("grip", "e", ((0.1, 0.0, 0.2), (0.3, 0.0, 0.0)))
    return builder.build()


@pytest.fixture(scope="module")
def state(pair):
    q, v, *_ = random_states(pair, 1, 1)
    return q[0], v[0]


def all_constraints():
    """One of each kind, most of them violated: rows do not depend on that."""
    closing = [jd.loop("a", POSE_A, "b", POSE_B, joint, name=joint) for joint in (*FREE, "universal")]
    flat = [
        jd.loop("a", POSE_A, "grip", None, j, in_plane=True, name=f"flat {j}")
        for j in ("revolute", "prismatic", "weld")
    ]
    return (
        *closing,
        *flat,
        jd.loop(None, POSE_A, "grip", POSE_B, "weld", name="to world"),
        jd.constraints.distance("a", (0.1, 0.2, 0.3), "d", None, 0.7),
        jd.constraints.gear("c_joint", "d_joint", 2.5, 0.1),
        jd.constraints.lock_joint("c_joint", 0.3),
        jd.constraints.lock_joint("e_joint", (0.8, 0.6, 0.0, 0.0)),
        jd.rolling_wheel("a", POSE_A, 0.3, plane=((0.0, 0.1, 0.0), (0.1, 0.2, 0.0))),
        jd.rolling_wheel("a", POSE_A, 0.3, plane_body="d", lateral=False, name="half wheel"),
        jd.rolling_sphere("b", (0.1, 0.0, 0.0), 0.2, spin=True),
        jd.rolling_sphere("b", None, 0.2, on="sphere", surface_body="grip", surface_radius=0.5, name="on ball"),
        jd.rolling_sphere("b", None, 0.2, on="sphere", surface_radius=4.0, inside=True, name="in ball"),
        jd.rolling_sphere("b", None, 0.2, on="cylinder", surface=POSE_A, surface_radius=0.4, name="on pipe"),
        jd.rolling_sphere(
            "b", None, 0.2, on="cylinder", surface_radius=0.9, inside=True, contact=False, name="in pipe"
        ),
        jd.constraints.knife_edge("a", POSE_B, plane=POSE_A),
        jd.Holonomic(lambda q, t: jnp.stack([q[0] * q[7] - t**2, jnp.sin(q[3] + t)]), name="moving"),
        jd.Holonomic(lambda model, q, t: jd.forward_kinematics(model, q)[4, 0, 3], with_system=True, name="by system"),
        jd.Pfaffian(lambda q, t: jnp.outer(q[:2], q[1:18]) * (1 + t), lambda q, t: jnp.stack([jnp.cos(t), q[0]])),
    )


@pytest.fixture(scope="module")
def everything(pair, state):
    """Names and places, and rows and residuals of all constraints as a function of the state and the time."""
    scene = jd.Scene(pair, all_constraints())

    @quick
    def evaluate(q, v, t):
        row = rows(scene, q, v, t)
        return {
            "A": row.A,
            "gamma": row.gamma,
            "velocity": row.velocity,
            "phi": jd.constraints.position_residual(scene, q, t),
            "psi": jd.constraints.velocity_residual(scene, q, v, t),
        }

    return layout(scene), evaluate


def moved(model, q, v, dt):
    """Configuration on the curve of constant body velocity through q."""
    return jd.integrate(model, q, v, dt)


def fourth_order(function, h):
    """Central difference of fourth order at zero."""
    return (8 * (function(h) - function(-h)) - (function(2 * h) - function(-2 * h))) / (12 * h)


@pytest.mark.long
def test_rows_and_gamma_are_rates_along_the_motion(pair, state, everything):
    """A v - b = d/dt phi and gamma = -d/dt (A v - b) at zero acceleration, by differences along a curve on the manifold."""
    (q, v), (places, evaluate), t, h = state, everything, 0.4, 5e-4
    here = evaluate(q, v, t)
    assert_close(here["velocity"], here["psi"], 1e-14)
    # psi is affine in v, and A is its slope.
    assert_close(here["A"] @ v, here["psi"] - evaluate(q, 0 * v, t)["psi"], 1e-12)

    def along(name):
        return fourth_order(lambda s: np.asarray(evaluate(moved(pair, q, v, s), v, t + s)[name]), h)

    held = np.concatenate([np.arange(p.start, p.nonholonomic) for p in places])
    assert_close(here["psi"][held], along("phi"), 1e-8)  # error h^4 of the differences
    assert_close(here["gamma"], -along("psi"), 1e-8)


@pytest.mark.parametrize("joint", [*FREE, "universal"])
def test_loops_remove_what_the_joint_removes_and_nothing_else(pair, state, everything, joint):
    """At a closed loop the rows vanish on the joint's own twists alone, and are independent."""
    (q, _), (places, evaluate) = state, everything
    place = next(p for p in places if p.name == joint)
    rng = np.random.default_rng(3)
    twist = np.zeros(6)
    twist[FREE.get(joint, [])] = rng.normal(size=len(FREE.get(joint, []))) * 0.5
    relative = np.asarray(se3.exp(jnp.asarray(twist)))
    free = [np.eye(6)[k] for k in FREE.get(joint, [])]
    if joint == "universal":  # turns about z of A, then about z of B, which stands at a right angle
        first, second = (np.asarray(se3.exp(jnp.asarray([0, 0, 0, 0, 0, angle]))) for angle in rng.normal(size=2))
        quarter = np.asarray(se3.exp(jnp.asarray([0, 0, 0, np.pi / 2, 0, 0])))
        relative = first @ quarter @ second
        free = [np.eye(6)[5], np.concatenate([np.zeros(3), relative[:3, :3].T[:, 2]])]
    pose_a, pose_b = (np.asarray(jd.loop("a", POSE_A, "b", POSE_B).__dict__[k]) for k in ("pose_a", "pose_b"))
    T_a = np.asarray(jd.forward_kinematics(pair, q)[0])
    T_b = T_a @ pose_a @ relative @ np.linalg.inv(pose_b)
    step = jd.difference(pair, q, q.at[7:14].set(jnp.asarray([*T_b[:3, 3], *quaternion(T_b[:3, :3])])))
    computed = evaluate(jd.integrate(pair, q, step), jnp.zeros(pair.nv), 0.0)
    held = [p for p in places if p.nonholonomic > p.start]
    first = sum(p.nonholonomic - p.start for p in held[: held.index(place)])
    count = place.end - place.start
    assert count == 6 - len(free)
    np.testing.assert_allclose(computed["phi"][first : first + count], 0, atol=1e-13)
    A = np.asarray(computed["A"][place.start : place.end])
    Ad = np.asarray(se3.Ad(jnp.asarray(pose_b)))
    for twist in free:
        velocity = np.zeros(pair.nv)
        velocity[6:12] = Ad @ twist
        np.testing.assert_allclose(A @ velocity, 0, atol=1e-13)
    assert np.linalg.matrix_rank(A, tol=1e-6) == count
    # Both bodies moving as one rigid body is always free.
    together = np.zeros(pair.nv)
    together[:6] = rng.normal(size=6)
    together[6:12] = np.asarray(se3.Ad(jnp.asarray(np.linalg.inv(T_b) @ T_a))) @ together[:6]
    np.testing.assert_allclose(A @ together, 0, atol=1e-12)


def quaternion(rotation):
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def test_rolling_rows_are_velocities_of_the_touching_points(pair, state, everything):
    """Velocities of the two material points in contact by differences of poses, for points computed by hand."""
    (q, v), (places, evaluate) = state, everything
    psi = np.asarray(evaluate(q, v, 0.0)["psi"])
    fk = quick(lambda q: jd.forward_kinematics(pair, q))
    names = list(pair.body_names)

    def pose(body, q, offset):
        local = np.asarray(jd.loop("a", offset, "b", None).__dict__["pose_a"])
        return (np.asarray(fk(q))[names.index(body)] if body else np.eye(4)) @ local

    def velocity(body, point):
        local = np.linalg.inv(pose(body, q, None)) @ np.append(point, 1.0)
        return fourth_order(lambda s: (pose(body, moved(pair, q, v, s), None) @ local)[:3], 2e-3)

    def check(name, point, normal, directions, body, ground):
        place = next(p for p in places if p.name == name)
        relative = velocity(body, point) - velocity(ground, point)
        got = psi[place.nonholonomic : place.end][: len(directions)]
        np.testing.assert_allclose(got, directions @ relative, atol=1e-8)  # error h^4 of the differences
        # Slip directions are an orthonormal part of the tangent plane.
        np.testing.assert_allclose(directions @ normal, 0, atol=1e-13)

    plane, wheel = pose(None, q, ((0.0, 0.1, 0.0), (0.1, 0.2, 0.0))), pose("a", q, POSE_A)
    n, axis = plane[:3, 2], wheel[:3, 2]
    down = -(n - (n @ axis) * axis)
    point = wheel[:3, 3] + 0.3 * down / np.linalg.norm(down)
    forward = np.cross(axis, n) / np.linalg.norm(np.cross(axis, n))
    check("wheel a", point, n, np.stack([forward, np.cross(n, forward)]), "a", None)

    plane = pose("d", q, None)
    n = plane[:3, 2]
    down = -(n - (n @ axis) * axis)
    point = wheel[:3, 3] + 0.3 * down / np.linalg.norm(down)
    forward = np.cross(axis, n) / np.linalg.norm(np.cross(axis, n))
    check("half wheel", point, n, forward[None], "a", "d")

    center = pose("b", q, (0.1, 0.0, 0.0))[:3, 3]
    check("sphere b", center - [0, 0, 0.2], np.array([0, 0, 1.0]), np.eye(3)[:2], "b", None)
    blade, ground = pose("a", q, POSE_B), pose(None, q, POSE_A)
    across = np.cross(ground[:3, 2], blade[:3, 0])
    check("knife edge a", blade[:3, 3], ground[:3, 2], across[None] / np.linalg.norm(across), "a", None)


def test_a_wheel_lying_flat_has_finite_rows_and_derivatives():
    builder = jd.ModelBuilder("flat").add_body("wheel", None, "free", inertia.cylinder(1.0, 0.3, 0.02))
    model = builder.build()
    scene = jd.Scene(
        model,
        (jd.rolling_wheel("wheel", None, 0.3), jd.constraints.knife_edge("wheel", ((0, 0, 0), (0, -np.pi / 2, 0)))),
    )
    q, v = jnp.asarray([0, 0, 0.0, 1, 0, 0, 0]), jnp.ones(6)
    total = quick(
        jax.value_and_grad(lambda q: jnp.sum(rows(scene, q, v, 0.0).gamma) + jnp.sum(jd.constraint_jacobian(scene, q)))
    )
    value, slope = total(q)
    assert np.isfinite(value) and np.isfinite(slope).all()


def test_couplings_of_a_model_become_gears():
    builder = jd.ModelBuilder("pair")
    for name in ("p", "q"):
        builder.add_body(name, None, "revolute", inertia.box(1.0, (1, 1, 1)))
    builder.add_coupling("q_joint", "p_joint", -2.0, 0.3)
    model = builder.build()
    computed = quick(
        lambda q: jd.constraints.position_residual(jd.Scene(model, jd.constraints.model_couplings(model)), q)
    )(jnp.asarray([0.5, 0.7]))
    assert_close(computed, [0.7 + 2.0 * 0.5 - 0.3], 1e-15)


def test_quaternion_rates_enter_rows_on_the_manifold(pair, state):
    """A v is the derivative of phi along dq/dt = H(q) v."""
    q, v = state
    scene = jd.Scene(pair, (jd.Holonomic(lambda q, t: jnp.sum(q**3), name="cubes"),))
    want = 3 * jnp.sum(q**2 * jd.configuration_rate(pair, q, v))
    assert_close(quick(lambda q, v: jd.constraint_jacobian(scene, q) @ v)(q, v), want[None], 1e-13)


def test_names_and_refusals(pair):
    twice = jd.Scene(pair, (jd.constraints.lock_joint("c_joint"), jd.constraints.lock_joint("c_joint")))
    assert [p.name for p in layout(twice)] == ["lock c_joint", "lock c_joint (1)"]
    q, v = jnp.zeros(pair.nq).at[jnp.array([3, 10, 16])].set(1.0), jnp.zeros(pair.nv)
    bad = {
        r"constraints\[0\] is a": (lambda q, t: q[:1],),
        "'empty' has no": (jd.Holonomic(lambda q, t: q[:0], name="empty"),),
        "'x': phi returned": (jd.Holonomic(lambda q, t: jnp.eye(2), name="x"),),
        "'y': A returned": (jd.Pfaffian(lambda q, t: jnp.ones((1, 3)), name="y"),),
        "'y': b returned": (jd.Pfaffian(lambda q, t: jnp.ones((1, 17)), lambda q, t: q[:2], name="y"),),
        "'a-zz': frame 'zz'": (jd.loop("a", None, "zz", None),),
        "'gear c_joint-e_joint': joint": (jd.constraints.gear("c_joint", "e_joint", 1.0),),
        "'lock nn': joint": (jd.constraints.lock_joint("nn"),),
        "value has shape": (jd.constraints.lock_joint("e_joint", 0.0),),
    }
    for message, constraints in bad.items():
        scene = jd.Scene(pair, constraints)
        for of_state in (
            rows,
            jd.constraints.velocity_residual,
            lambda scene, q, v: jd.constraints.position_residual(scene, q),
        ):
            with pytest.raises(ValueError, match=message):
                of_state(scene, q, v)
    made = {
        "joint 'hinge' is": lambda: jd.loop("a", None, "b", None, "hinge"),
        "both frames are": lambda: jd.loop("a", None, "a", None),
        "length is 0": lambda: jd.constraints.distance("a", None, "b", None, 0.0),
        "radius is -1": lambda: jd.rolling_wheel("a", None, -1.0),
        "surface_radius is None": lambda: jd.rolling_sphere("a", None, 1.0, on="sphere"),
        "not fit inside": lambda: jd.rolling_sphere("a", None, 2.0, on="sphere", surface_radius=1.0, inside=True),
        "name is ''": lambda: jd.Holonomic(lambda q, t: q, name=""),
        "phi is 3": lambda: jd.Holonomic(3),
        "both joints are": lambda: jd.constraints.gear("c_joint", "c_joint", 1.0),
    }
    for message, make in made.items():
        with pytest.raises(ValueError, match=message):
            make()


@pytest.mark.parametrize(
    ("joint", "turn", "planar"),
    [
        ("revolute", "x", False),
        ("weld", "x", False),
        *(
            pytest.param(joint, turn, False, marks=pytest.mark.slow)
            for joint, turn in (("weld", "y"), ("weld", "z"), ("cylindrical", "y"), ("planar", "x"), ("prismatic", "z"))
        ),
        ("weld", "z", True),
        ("prismatic", "z", True),
    ],
)
def test_upside_down_is_not_closed(joint, turn, planar):
    """A frame at exactly half a turn from its place: the residual is huge, not zero, and assembly turns it back."""
    builder = jd.ModelBuilder("free", gravity=None)
    builder.add_body("body", None, "free", jd.inertia.box(1.0, (0.1, 0.2, 0.3)))
    model = builder.build()
    scene = jd.Scene(model, (jd.loop(None, None, "body", None, joint, in_plane=planar),))
    q = jnp.zeros(7).at[3 + 1 + "xyz".index(turn)].set(1.0)  # half a turn
    assert np.abs(jd.constraints.position_residual(scene, q)).max() > 1e8
    if not planar:
        assembled = jd.assemble(scene, q)
        R = np.asarray(jd.frame_pose(model, assembled.q, "body"))[:3, :3]
        np.testing.assert_allclose(R[2, 2], 1.0, atol=1e-10)
