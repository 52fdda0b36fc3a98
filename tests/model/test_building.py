"""ModelBuilder, the reports on inertias, and the built-in mechanisms."""

import contextlib
import re
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusals

import jaxdyn as jd
from jaxdyn import inertia, robots
from jaxdyn.model import host_math, topology
from tests.pinocchio_bridge import quick, to_pinocchio

BALL = (2.0, (0.1, 0.2, 0.3), (0.03, 0.04, 0.05))


def built(**options):
    """The model of one body with the given options of `add_body`."""
    return jd.ModelBuilder("one").add_body("b", **{"inertia": BALL, **options}).build()


def test_order_is_depth_first_by_joint_name_whatever_the_order_of_addition():
    #        world -> c, a;  a -> z, m(fixed);  m -> k
    bodies = {"a": None, "c": None, "z": "a", "m": "a", "k": "m"}
    for order in (["c", "a", "z", "m", "k"], ["a", "m", "k", "z", "c"]):
        builder = jd.ModelBuilder("order")
        for name in order:
            joint = "fixed" if name == "m" else "prismatic"
            builder.add_body(name, bodies[name], joint, BALL, joint_name=f"j{name}", pose=(1, 0, 0))
        model = builder.build()
        # k hangs on a through the fixed m, and m comes before z.
        assert model.body_names == ("a", "k", "z", "c")
        assert model.joint_names == ("ja", "jk", "jz", "jc")
        assert model.topology.parents == (-1, 0, 0, -1)
        assert model.frame_names == ("a", "k", "z", "c", "m")
        assert model.topology.frame_bodies == (0, 1, 2, 3, 0)
        np.testing.assert_array_equal(model.home[:, 0, 3], [1, 2, 1, 1])


def test_fixed_bodies_are_merged_with_their_inertia():
    pose, rpy = (0.3, -0.2, 0.5), (0.4, -0.9, 1.3)
    builder = jd.ModelBuilder().add_body("a", None, "free", BALL)
    builder.add_body("b", "a", "fixed", BALL, pose=(pose, rpy)).add_body("c", "b", "fixed", BALL, pose=(pose, rpy))
    builder.add_frame("f", "c", (0, 0, 1)).add_frame("w", None, (1, 2, 3))
    model = builder.build()
    T = pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(pose))
    ball = pin.Inertia(2.0, np.array([0.1, 0.2, 0.3]), np.diag([0.03, 0.04, 0.05]))
    expected = ball + T.act(ball) + (T * T).act(ball)
    np.testing.assert_allclose(model.inertias[0], expected.toDynamicParameters(), rtol=1e-13, atol=1e-14)
    assert model.frame_names == ("a", "w", "b", "c", "f") and model.topology.frame_bodies == (0, -1, 0, 0, 0)
    np.testing.assert_allclose(model.frame_poses[3], (T * T).homogeneous, atol=1e-15)
    np.testing.assert_allclose(model.frame_poses[4][:3, 3], (T * T).act(np.array([0.0, 0, 1])), atol=1e-15)


def test_inertia_fixed_to_the_world_is_dropped_and_its_frame_kept():
    model = jd.ModelBuilder().add_body("base", joint="fixed", inertia=BALL, pose=(1, 2, 3)).build()
    assert (model.nb, model.nq, model.nv) == (0, 0, 0)
    assert model.frame_names == ("base",) and model.topology.frame_bodies == (-1,)
    np.testing.assert_array_equal(model.frame_poses[0][:3, 3], [1, 2, 3])


@pytest.mark.parametrize("kind", topology.KINDS)
def test_every_kind_has_its_sizes(kind):
    model = built(joint=kind)
    sizes = topology.KINDS[kind]
    assert (model.nq, model.nv) == (sizes.nq, sizes.nv) == (model.lower.shape[0], model.effort_limit.shape[0])
    assert np.isinf(model.lower).all() and np.isinf(model.effort_limit).all()
    assert model.armature is None and model.damping is None and model.friction is None and model.coupling_values is None


def test_screws():
    def screw(**options):
        return np.asarray(built(**options).screws[0])

    np.testing.assert_allclose(screw(axis=(0, 3, 4)), [0, 0, 0, 0, 0.6, 0.8], atol=1e-16)
    np.testing.assert_allclose(screw(axis=(0, 3e-200, 4e-200)), [0, 0, 0, 0, 0.6, 0.8], atol=1e-16)
    np.testing.assert_allclose(screw(joint="prismatic", axis=(0, -2, 0)), [0, -1, 0, 0, 0, 0], atol=0)
    np.testing.assert_allclose(screw(joint="helical", axis=(0, 0, 5), pitch=0.1), [0, 0, 0.1, 0, 0, 1], atol=1e-16)
    np.testing.assert_allclose(screw(joint="helical", screw=(0, 2, 0, 0, 0, 2)), [0, 1, 0, 0, 0, 1], atol=0)
    np.testing.assert_allclose(screw(joint="helical", screw=(1, 2, 3, 0, 0, 2)), [0.5, 1, 1.5, 0, 0, 1], atol=0)


def test_joint_leaves_are_absent_until_one_joint_has_them():
    builder = jd.ModelBuilder().add_body("a", None, "planar", BALL, damping=0.5, lower=(-1, -2, -3), effort_limit=7)
    builder.add_body("b", "a", "revolute", BALL, armature=0.1, upper=2.0, velocity_limit=4)
    model = builder.build()
    np.testing.assert_array_equal(model.armature, [0, 0, 0, 0.1])
    np.testing.assert_array_equal(model.damping, [0.5, 0.5, 0.5, 0])
    assert model.friction is None
    np.testing.assert_array_equal(model.lower, [-1, -2, -3, -np.inf])
    np.testing.assert_array_equal(model.upper, [np.inf, np.inf, np.inf, 2])
    np.testing.assert_array_equal(model.velocity_limit, [np.inf, np.inf, np.inf, 4])
    np.testing.assert_array_equal(model.effort_limit, [7, 7, 7, np.inf])


def test_couplings_are_static_pairs_with_values_as_leaves():
    builder = jd.ModelBuilder().add_body("a", None, inertia=BALL).add_body("b", "a", inertia=BALL)
    builder.add_body("c", "b", "prismatic", BALL).add_coupling("c_joint", "a_joint", -0.5, 0.25)
    model = builder.build()
    assert model.topology.couplings == ((2, 0),)
    np.testing.assert_array_equal(model.coupling_values, [[-0.5, 0.25]])
    assert model.replace(coupling_values=[[1.0, 0.0]]).coupling_values.tolist() == [[1, 0]]
    with pytest.raises(ValueError, match="coupling_values"):
        built().replace(coupling_values=[[1.0, 0.0]])


def test_gravity_and_dtype():
    assert built().gravity.tolist() == [0, 0, -9.81]
    assert jd.ModelBuilder(gravity=None).add_body("b", inertia=BALL).build().gravity is None
    model = jd.ModelBuilder(dtype=jnp.float32).add_body("b", inertia=BALL, armature=1).build()
    assert {leaf.dtype for leaf in jax.tree.leaves(model)} == {jnp.dtype("float32")}
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(model))


def test_models_with_the_same_tree_share_compiled_code():
    assert built().topology == built(inertia=(1.0, (0, 0, 0), (1, 1, 1))).topology
    assert hash(built().topology) == hash(built(axis=(1, 0, 0)).topology)
    assert built().topology != built(joint="continuous").topology


@pytest.mark.long
@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3).filter(lambda x: max(map(abs, x)) > 1e-6),
    st.lists(st.floats(-10, 10), min_size=3, max_size=3),
    st.lists(st.floats(-10, 10), min_size=3, max_size=3),
    st.floats(-2, 2),
)
def test_any_axis_and_pose(axis, xyz, rpy, pitch):
    model = built(joint="helical", axis=axis, pose=(xyz, rpy), pitch=pitch)
    v, omega = np.split(np.asarray(model.screws[0]), 2)
    assert abs(np.linalg.norm(omega) - 1) < 1e-15
    np.testing.assert_allclose(np.cross(omega, axis), 0, atol=1e-12 * np.linalg.norm(axis))
    np.testing.assert_allclose(v, pitch * omega, atol=1e-15)
    rotation = pin.rpy.rpyToMatrix(np.array(rpy))
    np.testing.assert_allclose(model.home[0, :3, :3], rotation, atol=1e-14)
    np.testing.assert_array_equal(model.home[0, :3, 3], xyz)
    again = built(joint="helical", axis=axis, pose=np.asarray(model.home[0]), pitch=pitch)
    np.testing.assert_array_equal(again.home, model.home)


A, EYE = np.eye(4), (1.0, (0, 0, 0), (1, 1, 1))
REFLECTION, STRETCHED, SHEARED = np.diag([1.0, 1, -1, 1]), np.diag([1.0, 1, 1.1, 1]), A + np.eye(4, k=-3)
BAD_BODIES = {
    "unknown kind": (dict(joint="hinge"), "'hinge'.*unknown.*revolute"),
    "unknown parent": (dict(parent="nobody"), "'nobody' is unknown"),
    "own parent": (dict(parent="b"), "'b' is unknown.*before its"),
    "zero axis": (dict(axis=(0, 0, 0)), r"'b': axis is \[0.0, 0.0, 0.0\]"),
    "NaN axis": (dict(axis=(0, np.nan, 0)), "axis is.*finite"),
    "axis shape": (dict(axis=(0, 1)), r"axis has shape \(2,\), expected \(3,\)"),
    "axis text": (dict(axis="z"), "axis is 'z', expected"),
    "axis of spherical": (dict(joint="spherical", axis=(1, 0, 0)), "spherical joint has no axis"),
    "pitch of revolute": (dict(pitch=0.1), "pitch is 0.1.*helical"),
    "screw and axis": (dict(screw=(0, 0, 0, 0, 0, 1), axis=(1, 0, 0)), "screw is given together"),
    "screw without omega": (dict(screw=(1, 0, 0, 0, 0, 0)), "needs omega other than zero"),
    "screw without v": (dict(joint="prismatic", screw=(0, 0, 0, 0, 0, 0)), "needs v other than zero"),
    "screw with pitch": (dict(screw=(0, 0, 1, 0, 0, 2)), "has a pitch.*helical"),
    "screw that turns": (dict(joint="prismatic", screw=(0, 0, 1, 0, 0, 2)), "turns.*helical"),
    "screw shape": (dict(screw=(0, 0, 1)), r"screw has shape \(3,\)"),
    "negative mass": (dict(inertia=(-1.0, (0, 0, 0), (1, 1, 1))), "the mass is -1.0 kg"),
    "NaN mass": (dict(inertia=(np.nan, (0, 0, 0), (1, 1, 1))), "mass is nan.*finite"),
    "inertia shape": (dict(inertia=(1.0, 2.0, 3.0, 4.0)), r"inertia has shape \(4,\), expected ten numbers"),
    "com shape": (dict(inertia=(1.0, (0, 0), (1, 1, 1))), r"centre of mass has shape \(2,\)"),
    "asymmetric": (dict(inertia=(1.0, (0, 0, 0), np.eye(3) + np.eye(3, k=1))), "not symmetric"),
    "pose shape": (dict(pose=(1, 2)), r"pose has shape \(2,\), expected a \(4, 4\) matrix"),
    "reflection": (dict(pose=REFLECTION), "pose: the rotation.*is a reflection"),
    "stretched": (dict(pose=STRETCHED), r"not orthonormal: \|R\^T R - 1\| = 0.21"),
    "last row": (dict(pose=SHEARED), r"last row is \[1.0, 0.0, 0.0, 1.0\]"),
    "crossed limits": (dict(lower=1.0, upper=-1.0), "lower limit 1.0 is above upper limit -1.0"),
    "limit shape": (dict(joint="free", lower=1.0), r"lower has shape \(\), expected \(7,\)"),
    "NaN limit": (dict(effort_limit=np.nan), "effort_limit is nan"),
    "limits of continuous": (dict(joint="continuous", upper=1.0), "continuous joint has no position limits"),
    "armature of fixed": (dict(joint="fixed", armature=1.0), "armature is 1.0, but the joint is fixed"),
    "negative damping": (dict(damping=-1.0), "damping is -1.0; it must not be negative"),
    "damping shape": (dict(damping=(1.0, 2.0)), r"damping has shape \(2,\), expected a number or \(1,\)"),
    "empty name": (dict(name=""), "name is ''"),
    "empty joint name": (dict(joint_name=""), "joint_name is ''"),
    "name taken": (dict(name="a"), "the name 'a' is taken"),
    "name taken by a frame": (dict(name="f"), "the name 'f' is taken"),
    "joint name taken": (dict(joint_name="a_joint"), "joint name 'a_joint' is that of body 'a'"),
}


@pytest.mark.parametrize("case", BAD_BODIES)
def test_bad_bodies(case):
    options, message = BAD_BODIES[case]
    builder = jd.ModelBuilder().add_body("a", inertia=EYE).add_frame("f", "a")
    with pytest.raises(ValueError, match=f"(?s){message}"):
        builder.add_body(**{"name": "b", "inertia": EYE, **options})
    assert builder.build().body_names == ("a",)  # nothing half-built


def test_bad_frames_couplings_and_settings():
    builder = jd.ModelBuilder().add_body("a", inertia=EYE).add_body("b", "a", "prismatic", EYE)
    builder.add_body("s", "b", "spherical", EYE).add_body("c", "s", "fixed").add_frame("f", "a")
    bad = {
        "the name 'f' is taken": lambda: builder.add_frame("f", "a"),
        "parent 'q' is unknown": lambda: builder.add_frame("g", "q"),
        r"frame 'g': pose has shape \(2, 2\)": lambda: builder.add_frame("g", "a", np.eye(2)),
        r"joint 'a_jiont' is unknown \(did you mean a_joint": lambda: builder.add_coupling("b_joint", "a_jiont"),
        "'s_joint' is spherical": lambda: builder.add_coupling("s_joint", "a_joint"),
        "'c_joint' is fixed": lambda: builder.add_coupling("b_joint", "c_joint"),
        "would follow itself": lambda: builder.add_coupling("b_joint", "b_joint"),
        "is nan|is .*nan.*finite": lambda: builder.add_coupling("b_joint", "a_joint", np.nan),
        r"gravity has shape \(2,\)": lambda: jd.ModelBuilder(gravity=(0, 0)),
        "dtype is .*floating-point": lambda: jd.ModelBuilder(dtype=jnp.int32),
    }
    for message, act in bad.items():
        with pytest.raises(ValueError, match=message):
            act()
    builder.add_coupling("b_joint", "a_joint")
    for ends, message in ((("b_joint", "a_joint"), "'a_joint' already"), (("a_joint", "b_joint"), "follow itself")):
        with pytest.raises(ValueError, match=message):
            builder.add_coupling(*ends)
    with jax.enable_x64(False):
        assert built().home.dtype == jnp.float32
        with pytest.raises(ValueError, match=r"float64, .*32 bits"):
            jd.ModelBuilder(dtype=jnp.float64)


def singular(*bodies):
    builder = jd.ModelBuilder()
    for body in bodies:
        builder.add_body(**body)
    return builder


HUB = dict(name="hub", inertia=EYE)
POINT = (1.0, (0, 0, 1), (0, 0, 0))
SINGULAR = {
    "massless leaf": ([HUB, dict(name="tip", parent="hub")], "'tip_joint'.*moves no inertia"),
    "point mass on its axis": ([dict(name="tip", inertia=POINT)], "'tip_joint'.*moves no inertia"),
    "displaced axis through a point mass": (
        [dict(name="tip", joint="helical", inertia=(3.0, (0.3, 0.1, 7), (0, 0, 0)), screw=(0.1, -0.3, 0, 0, 0, 1))],
        "'tip_joint'.*moves no inertia",
    ),
    "free point mass": (
        [dict(name="tip", joint="free", inertia=(1.0, (1, 2, 3), (0, 0, 0)))], "'tip_joint'.*without moving any"
    ),
    "spherical rod": (
        [HUB, dict(name="tip", parent="hub", joint="spherical", inertia=(1.0, (0, 0, 1), (0.1, 0.1, 0)))],
        "'tip_joint'.*moves no inertia",
    ),
    "two massless": (
        [HUB, dict(name="x", parent="hub"), dict(name="y", parent="x")],
        r"'y_joint'.*with x_joint, y_joint.*lock=\['x_joint', 'y_joint'\]",
    ),
    "two turns about one axis": (
        [dict(name="x"), dict(name="y", parent="x", inertia=EYE, pose=(0, 0, 1))], "'x_joint'.*without moving any"
    ),
    "four slides in space": (
        [dict(name=name, parent=parent, joint="prismatic", axis=axis, inertia=POINT if name == "w" else None)
         for name, parent, axis in zip("xyzw", [None, *"xyz"], [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)], strict=True)],
        "'x_joint'.*without moving any",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SINGULAR)
def test_joints_without_inertia_are_refused_by_name(case):
    bodies, message = SINGULAR[case]
    with pytest.raises(ValueError, match=f"(?s){message}"):
        singular(*bodies).build()
    # An armature on every joint makes any of them regular.
    assert singular(*[{**body, "armature": 0.1} for body in bodies]).build().nb == len(bodies)


def test_what_is_singular_at_one_configuration_alone_is_accepted():
    # A point mass at the end of two rods without mass can be folded onto the first axis, and is at neutral.
    two = [dict(name="x", axis=(0, 0, 1)), dict(name="y", parent="x", axis=(0, 0, 1), pose=(1, 0, 0))]
    two[1]["inertia"] = (1.0, (-1, 0, 0), (0, 0, 0))
    assert singular(*two).build().nb == 2
    # Massless links of a gimbal carry a ball.
    gimbal = [dict(name="x", axis=(1, 0, 0)), dict(name="y", parent="x", axis=(0, 1, 0)), dict(name="z", parent="y")]
    gimbal[2]["inertia"] = EYE
    assert singular(*gimbal).build().nb == 3
    # A micrometre cube of water in free flight, and a needle with a slight but real moment about its axis.
    assert built(joint="free", inertia=(1e-15, (0, 0, 0), (1.7e-28,) * 3)).nb == 1
    assert built(joint="spherical", inertia=(1.0, (0, 0, 0.5), (0.1, 0.1, 1e-9))).nb == 1
    # Products of such inertias underflow, a warning of NumPy's that is an error here. Below the normal numbers they are zero.
    rod = (1e-300, (0, 0, -0.5), (1e-301,) * 3)
    light = built(inertia=rod, axis=(0, 1, 0))
    acceleration = jd.forward_dynamics(light, jnp.ones(1), jnp.zeros(1), jnp.zeros(1))
    np.testing.assert_allclose(acceleration, -9.81 * 0.5 * np.sin(1.0) / 0.35, rtol=1e-10)
    with pytest.raises(ValueError, match="moves no inertia"):
        built(inertia=(1e-310, (0, 0, -0.5), (1e-311,) * 3))


def test_inertia_report_and_repair():
    builder = jd.ModelBuilder().add_body("whole", inertia=BALL)
    builder.add_body("flat", "whole", inertia=(1.0, (0, 0, 1), (0.1, -0.2, 0.3)))
    builder.add_body("long", "flat", inertia=(1.0, (1, 0, 1), (0.1, 0.2, 0.4)))
    builder.add_body("none", "long", armature=1.0)
    builder.add_body("rotor", "none", inertia=[0, 0, 0, 0, 1, 0, 1, 0, 0, 1])
    model = builder.build()
    *report, (rotor, text) = jd.model.inertia_report(model)
    assert report == [
        ("flat", "not positive definite: principal moments -0.2, 0.1, 0.3 kg m^2"),
        ("long", "triangle inequality violated: principal moments 0.1, 0.2, 0.4 kg m^2"),
        ("none", "massless"),
    ]
    assert rotor == "rotor" and text.startswith("mass 0.0 kg with")
    repaired = jd.model.repair_inertias(model)
    assert [name for name, _ in jd.model.inertia_report(repaired)] == ["none", "rotor"]
    assert all(inertia.is_feasible(repaired.inertias[i]) for i in (0, 1, 2))
    np.testing.assert_array_equal(repaired.inertias[jnp.array([0, 3, 4])], model.inertias[jnp.array([0, 3, 4])])
    np.testing.assert_allclose(repaired.inertias[:, 0], model.inertias[:, 0], rtol=1e-14)
    # What is not feasible has to change; first moments (kg m) stay near those that were given.
    np.testing.assert_allclose(repaired.inertias[1:3, 1:4], model.inertias[1:3, 1:4], atol=0.1)
    assert jd.model.inertia_report(robots.iiwa()) == jd.model.inertia_report(robots.iiwa(dtype=jnp.float32)) == []


def test_iiwa_kinematics_are_the_published_ones():
    model = robots.iiwa()
    poses = quick(jax.vmap(jd.forward_kinematics, (None, 0)))
    q = jnp.radians(jnp.array([[0.0] * 7, [60, 30, 60, 30, 60, 30, 60]]))
    straight, bent = poses(model, q)[:, -1]
    np.testing.assert_allclose(straight[:3, :3], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(straight[:3, 3], [0, 0, 1.261], atol=1e-15)
    rotation = [
        [-0.5939002959880204, 0.8043869080239565, -0.015625],
        [-0.8043869080239565, -0.5932991120359317, 0.03094940802395521],
        [0.015625, 0.03094940802395527, 0.9993988160479114],
    ]
    np.testing.assert_allclose(bent[:3, :3], rotation, atol=1e-15)
    np.testing.assert_allclose(bent[:3, 3], [0.2970356451892219, 0.1727696964662288, 1.154681973689345], atol=1e-15)
    assert model.frame_names[-1] == "iiwa_link_0" and model.topology.frame_bodies[-1] == -1
    np.testing.assert_allclose(model.inertias[:, 0].sum(), 25.61, rtol=1e-15)
    np.testing.assert_allclose(model.upper[6], 3.0543261909900763, rtol=1e-15)


def test_ur5_has_the_places_and_masses_of_its_description(robots_dir):
    """Frames against the URDF of example-robot-data, whose right angles have eleven digits; moments are ours."""
    model, theirs = robots.ur5(), jd.load_model(robots_dir / "ur_description" / "urdf" / "ur5_robot.urdf")
    assert model.nv == 6 and jd.model.inertia_report(model) == []
    np.testing.assert_allclose(model.inertias[:, :4], theirs.inertias[:, :4], atol=1e-9)
    np.testing.assert_allclose(model.upper, theirs.upper, rtol=1e-11)
    pose = quick(lambda model, q: jd.frame_pose(model, q, "tool0"))
    for q in jnp.asarray(np.random.default_rng(0).uniform(-3, 3, (3, 6))):
        np.testing.assert_allclose(pose(model, q), pose(theirs, q), atol=1e-10)


@pytest.mark.parametrize("floating", [True, False])
def test_quadruped_stands_on_its_feet(floating):
    model = robots.quadruped(floating_base=floating)
    assert (model.nv, jd.model.inertia_report(model)) == (18 if floating else 12, [])
    q = jd.neutral(model)
    for leg in ("FL", "FR", "RL", "RR"):
        for joint, angle in (("hip", 0.0), ("thigh", 0.8), ("knee", -1.6)):
            q = q.at[model.q_index(f"{leg}_{joint}")].set(angle)

    @quick
    def places(model, q):
        feet = [jd.frame_pose(model, q, f"{leg}_foot")[:3, 3] for leg in ("FL", "RR")]
        return jnp.stack(feet), jd.center_of_mass(model, q)

    # Thigh and shank make an isosceles triangle: the feet stand under the hips, 0.4 cos 0.8 below.
    feet, center = places(model, q)
    below = -0.4 * np.cos(0.8)
    np.testing.assert_allclose(feet, [(0.2, 0.14, below), (-0.2, -0.14, below)], atol=1e-15)
    moving = 6.0 * floating + 4 * 1.5
    np.testing.assert_allclose(model.inertias[:, 0].sum(), moving, rtol=1e-14)
    # Thighs and shanks, 0.5 kg each, have their centres 0.1 sin 0.8 behind the hips.
    np.testing.assert_allclose(center[:2], [-0.4 * np.sin(0.8) / moving, 0.0], atol=1e-15)


def test_iiwa_torques_are_the_published_ones():
    source, _ = to_pinocchio(robots.iiwa())
    a = np.array([0, 0, 0, 0, 0, 0, 1000.0])
    tau = pin.rnea(source, source.createData(), np.zeros(7), np.zeros(7), a)
    weight = np.array([0, 9.81 * (0.0003 * 6.35 + 0.0001 * 3.5), 0, -9.81 * 0.0001 * 3.5, 0, 0, 0])
    np.testing.assert_allclose(tau, np.array([1, 0, 1, 0, 1, 0, 1]) + weight, atol=1e-12)


def test_chain_has_the_frequencies_of_the_hanging_rods():
    # Two hanging rods: M = m l^2 [[4/3, 1/2], [1/2, 1/3]], K = m g l diag(3/2, 1/2) in absolute angles.
    model = robots.chain(2, length=0.7, mass=3.0)
    source, _ = to_pinocchio(model)
    M = pin.crba(source, source.createData(), np.zeros(2))
    absolute = np.array([[1.0, 0], [-1, 1]])  # relative angles from absolute ones
    np.testing.assert_allclose(absolute.T @ M @ absolute, 3 * 0.49 * np.array([[4 / 3, 0.5], [0.5, 1 / 3]]), rtol=1e-14)
    assert robots.chain(3).body_names == ("rod_0", "rod_1", "rod_2")
    with pytest.raises(ValueError, match="n is 0"):
        robots.chain(0)


def test_long_chains_are_built_without_recursion():
    assert robots.chain(1500).nb == 1500


def test_random_trees_are_seeded_and_have_every_kind():
    model = robots.random_tree(3, 21, branching=2)
    assert set(model.topology.kinds) == set(topology.KINDS)
    for kind in topology.KINDS:
        assert model.topology.kinds.count(kind) == 3
    again, other = robots.random_tree(3, 21, branching=2), robots.random_tree(4, 21, branching=2)
    np.testing.assert_array_equal(model.home, again.home)
    assert not np.allclose(model.home, other.home)
    assert jd.model.inertia_report(model) == []
    assert max(model.topology.parents.count(i) for i in range(21)) == 2
    assert robots.random_tree(0, 6, branching=1).topology.parents == (-1, 0, 1, 2, 3, 4)
    assert robots.random_tree(0, 6, branching=6).topology.parents == (-1, 0, 0, 0, 0, 0)
    assert robots.random_tree(0, 7, kinds=("revolute", "fixed")).nb < 7
    parallel = robots.random_tree(0, 4, skew=0.0, kinds=("revolute",))
    np.testing.assert_allclose(parallel.home[:, :3, :3], np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-15)
    np.testing.assert_array_equal(*(robots.random_tree(jax.random.key(5), 4).home for _ in range(2)))
    assert jd.neutral(model).shape == (model.nq,)
    bad = {"nb is 0": dict(nb=0), "branching 0.5": dict(nb=2, branching=0.5), "'hinge'": dict(nb=3, kinds=("hinge",))}
    for message, options in bad.items():
        with pytest.raises(ValueError, match=message):
            robots.random_tree(0, **options)


@pytest.mark.parametrize("seed", range(3))
def test_mass_matrix_is_singular_exactly_where_a_build_is_refused(seed):
    # Half of the bodies have no inertia: the smallest eigenvalue of Pinocchio's mass matrix is the second opinion.
    rng = np.random.default_rng(seed)
    refused = 0
    for _ in range(25):
        kinds = rng.choice(["revolute", "prismatic", "helical", "continuous"], 7)
        parents = [None if i == 0 else f"b{rng.integers(max(0, i - 2), i)}" for i in range(7)]
        heavy = rng.random(7) < 0.6
        axes, poses = rng.normal(size=(7, 3)), rng.normal(size=(7, 2, 3))

        def assemble(armature, kinds=kinds, parents=parents, heavy=heavy, axes=axes, poses=poses):
            builder = jd.ModelBuilder()
            for i in range(7):
                options = {"axis": axes[i], "pose": poses[i], "armature": armature}
                builder.add_body(f"b{i}", parents[i], str(kinds[i]), BALL if heavy[i] else None, **options)
            return builder.build()

        # The same mechanism with an armature that is taken away again.
        source, _ = to_pinocchio(assemble(1.0))
        source.armature = np.zeros(7)
        for i in np.flatnonzero(~heavy):
            source.inertias[source.getJointId(f"b{i}_joint")] = pin.Inertia.Zero()
        M = pin.crba(source, source.createData(), rng.uniform(-1, 1, 7))
        size = np.sqrt(np.maximum(np.diag(M), 1e-30))
        regular = np.linalg.eigvalsh(M / np.outer(size, size))[0] > 1e-10
        with contextlib.nullcontext() if regular else pytest.raises(ValueError, match="singular"):
            assemble(None)
        refused += not regular
    assert 0 < refused < 25


@pytest.mark.parametrize(
    ("moments", "words"),
    [
        ((1, 1, -1), r"body 'a': a principal moment of inertia is negative \(-1 kg m\^2\)"),
        ((1, 1, 5), "body 'a': its principal moments of inertia 1, 1, 5 kg m.2 break the triangle inequality"),
        ((1, 1, 2), None),  # a plate
        ((1, 1, 2.001), None),  # a plate, in a file's digits
        ((1, 1, 0), None),  # a rod
        ((0, 0, 0), None),  # a point
    ],
)
def test_inertias_that_no_body_has_are_named(moments, words):
    """However a model is made of them, at the line that makes it; limits of bodies are none of them."""
    body = (1.0, (0.3, 0.2, 1.0), moments)
    builder = jd.ModelBuilder().add_body("a", axis=(0, 1, 0), inertia=body)
    numbers = np.asarray(host_math.inertia_numbers(body, "a"))
    sound = jd.ModelBuilder().add_body("a", inertia=jd.inertia.sphere(1.0, 1.0)).build()
    for make in (builder.build, lambda: sound.replace(inertias=numbers[None])):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            make()
        assert len(caught) == (words is not None)
        if words:
            assert re.match(words, str(caught[0].message)) and "jd.model.repair_inertias" in str(caught[0].message)
            assert caught[0].filename == __file__


def test_screws_that_a_kind_leaves_out_are_refused():
    """They would have no effect: dynamics use the entries of the joint's kind."""
    ball = jd.inertia.sphere(1.0, 1.0)
    model = jd.ModelBuilder().add_body("a", joint="prismatic", inertia=ball)
    model = model.add_body("b", "a", joint="revolute", inertia=ball).build()
    for body, screw in ((0, (0, 0, 1, 0, 0.1, 0)), (1, (0.2, 0, 0, 0, 0, 1))):
        with pytest.raises(ValueError, match=f"replace: screws of body '{'ab'[body]}' is .* its joint is"):
            model.replace(screws=model.screws.at[body].set(jnp.array(screw, float)))
    # Scaled axes scale the coordinate, and entries of rounding stay.
    scaled = model.replace(screws=2 * model.screws.at[1, 0].set(1e-12))
    q = jnp.array([0.3, 0.4])
    np.testing.assert_allclose(jd.mass_matrix(scaled, q), 4 * jd.mass_matrix(model, 2 * q), atol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_numbers_that_are_not_finite_are_refused_with_their_body(bad):
    """Whatever entry is bad, however the model is made of it."""
    sound = jd.ModelBuilder().add_body("a", inertia=jd.inertia.sphere(1.0, 1.0), damping=0.1)
    sound = sound.add_body("b", "a", inertia=jd.inertia.sphere(2.0, 1.0)).add_frame("tip", "b").build()
    for i in range(10):
        numbers = np.array(sound.inertias)
        numbers[1, i] = bad
        for make, words in (
            (lambda x: jd.ModelBuilder().add_body("b", inertia=x[1]), "body 'b': inertia is .*must be finite"),
            (lambda x: sound.replace(inertias=x), "replace: inertias of body 'b' is"),
            (lambda x: sound.replace(inertias=jnp.asarray(x, jnp.float32)), "replace: inertias of body 'b' is"),
            # One bad number among those of a sound body, and of one that needs repair.
            (lambda x: jd.model.repair_inertias(eqx.tree_at(lambda m: m.inertias, sound, jnp.asarray(x))), "body 'b'"),
            (lambda x: sound.with_payload("tip", x[1]), "inertia is .*; give finite numbers"),
            (lambda x: jd.inertia.nearest_feasible(x[1]), "parameters is .* cannot be repaired"),
        ):
            with pytest.raises(ValueError, match=words):
                make(numbers)
        broken = eqx.tree_at(lambda m: m.inertias, sound, jnp.asarray(numbers))
        assert jd.model.inertia_report(broken)[0][0] == "b" and not jd.inertia.is_feasible(numbers[1])
    for leaf, words in (
        ("gravity", "gravity is"),
        ("home", "home of body 'b'"),
        ("screws", "screws of body 'b'"),
        ("frame_poses", "frame_poses of frame 'tip'"),
        ("damping", "damping of joint 'b_joint'"),
    ):
        values = np.array(getattr(sound, leaf))
        values.flat[-1] = bad
        with pytest.raises(ValueError, match=f"replace: {words}"):
            sound.replace(**{leaf: values})
    assert sound.replace(upper=np.array([np.inf, np.inf])).upper[1] == np.inf
    with pytest.raises(ValueError, match="replace: upper of joint 'b_joint'"):
        sound.replace(upper=np.array([np.inf, bad]))
    with pytest.raises(ValueError, match=r"'b': .* overflows"):
        jd.ModelBuilder().add_body("b", inertia=(1e308, (10, 0, 0), (1, 1, 1)))


@pytest.mark.parametrize("text", ["1_0", "1", 1j])
def test_texts_are_no_numbers(text):
    with pytest.raises(ValueError, match=r"'a': .*expected a number"):
        jd.ModelBuilder().add_body("a", inertia=(text, (0, 0, 0), (1, 1, 1)))


test_swapped_arguments_of_inertias_are_named = refusals(
    (lambda: inertia.transform_inertia(jnp.ones(10), jnp.eye(4)), r"pose .*\(4, 4\), parameters"),
    (lambda: inertia.displaced(jnp.zeros(3), jnp.ones(10)), r"parameters .*\(10,\), position"),
    (lambda: inertia.inertial_parameters(1.0, jnp.eye(3), jnp.zeros(3)), r"com .*\(3, 3\)"),
    (lambda: inertia.spatial_inertia(jnp.eye(4)), r"parameters .*\(10,\)"),
    (lambda: inertia.pseudo_inertia(jnp.eye(4)), r"parameters .*\(10,\)"),
    (lambda: inertia.to_log_cholesky(jnp.eye(4)), r"parameters .*\(10,\)"),
)


@pytest.mark.long
def test_a_motion_that_starts_where_a_gimbal_locks_says_so():
    """Three hinges with massless links: where the first and the last are parallel, no inertia answers to their difference."""
    builder = jd.ModelBuilder("gimbal", gravity=None)
    for name, parent, axis in (("x", None, (1, 0, 0)), ("y", "x", (0, 1, 0)), ("z", "y", (0, 0, 1))):
        builder.add_body(name, parent, axis=axis, inertia=BALL if name == "z" else None)
    model, v = builder.build(), jnp.asarray([0.1, 0.2, 0.3])

    def result(angle):
        q = jnp.stack([jnp.asarray(0.1), angle, jnp.asarray(0.2)])
        return jd.simulate(model, q, v, [0.0, 0.1], outputs=("energy",), throw=False)

    for angle in (np.pi / 2, -np.pi / 2):
        assert result(jnp.asarray(angle)).result == jd.RESULTS.singular_mass_matrix
    with pytest.raises(RuntimeError, match="not positive definite"):
        jd.simulate(model, [0.1, np.pi / 2, 0.2], v, [0.0, 0.1])
    codes = jax.jit(jax.vmap(lambda angle: result(angle).success))(jnp.asarray([np.pi / 2, 0.3]))
    assert codes.tolist() == [False, True]
    # Next to it the motion is that of a free body, whose energy is constant.
    near = result(jnp.asarray(1.57))
    assert bool(near.success)
    np.testing.assert_allclose(near.energy, near.energy[0], rtol=1e-7)  # rates of 1e3 amplify the tolerance


def test_strings_of_numpy_are_names():
    """Names and kinds out of an array of NumPy give the model and the results of Python's strings."""

    def energies(text):
        builder = jd.ModelBuilder("pair")
        for name, parent, kind in (("a", None, "spherical"), ("b", "a", "revolute")):
            parent = None if parent is None else text(parent)
            builder.add_body(text(name), parent, text(kind), (1.0, (0.0, 0.1, 0.2), (0.1, 0.1, 0.1)))
        model = builder.build()
        q = jd.random_configuration(model, jax.random.key(0))
        scene = jd.Scene(model, [jd.constraints.lock_joint(text("b_joint"), q[-1:], name=text("lock"))])
        options = {"outputs": (text("energy"), jd.simulation.Pose(text("b"))), "adjoint": text("forward")}
        motion = jd.simulate(scene, q, jnp.ones(4).at[3].set(0.0), jnp.array([0.0, 0.1]), stepsize=0.05, **options)
        return jax.tree.structure(model), motion.energy, motion.poses["b"]

    assert jax.tree.all(jax.tree.map(np.array_equal, energies(str), energies(np.str_)))
