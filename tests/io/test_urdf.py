"""URDF files: every robot of example-robot-data against Pinocchio, locking, mimic joints, refusals, the way back."""

import contextlib
import sys
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest

import jaxdyn as jd
from jaxdyn import robots
from tests.pinocchio_bridge import ROBOTS, quick, to_jaxdyn

FILES = sorted(str(path.relative_to(ROBOTS)) for path in Path(ROBOTS).rglob("*.urdf"))
# Of 70 files that are URDF or make one, these are refused: by file, line and what to do, which is done below.
MENDED = {
    "ur_description/urdf/ur3.urdf": ":6: the robot has no <link>; this is xacro: expand it",
    "alex_description/urdf/alex_psyonic_hands.urdf": r":1030: joint 'Left_index_q2' follows 'index_q1'.*mimic='ignore'",
    "romeo_description/urdf/romeo.urdf": r":1647: joint 'RThumb3'.*lock=\[",
    "romeo_description/urdf/romeo_laas_small.urdf": r":1037: joint 'r_gripper_joint'.*lock=\[",
}
# One follows a joint that is missing, which a model alone ignores.
LOADED = [name for name in FILES if name not in MENDED or "mimic=" in MENDED[name]]
MIMIC = ["panda_description/urdf/panda.urdf", "baxter_description/urdf/baxter.urdf"]
# A joint that follows another one; siblings out of the order of their names, and continuous joints; one body.
TIAGO, ONE_BODY = "tiago_pro_description/robots/tiago_pro.urdf", "hector_description/robots/quadrotor_base.urdf"
ROUND_TRIPS = [(MIMIC[0], False), (TIAGO, False), ("g1_description/urdf/g1_29dof_rev_1_0.urdf", True)]
ROUND_TRIPS += [(ONE_BODY, False), (ONE_BODY, True)]
TALOS = "talos_data/robots/talos_reduced.urdf"
INERTIAS = [TALOS, "romeo_description/urdf/romeo_small.urdf", "pr2_description/urdf/pr2.urdf"]
LEAVES = ("home", "screws", "inertias", "frame_poses", "gravity", "armature", "damping", "friction", "lower", "upper")
LEAVES += ("velocity_limit", "effort_limit", "coupling_values")


def in_pinocchio(name, floating=False):
    return pin.buildModelFromUrdf(str(Path(ROBOTS) / name), *[pin.JointModelFreeFlyer()] * floating)


def locked_in_pinocchio(source, names, q=None):
    """The model without these joints, which are held at a configuration, by default the neutral one."""
    numbers = [source.getJointId(name) for name in names]
    return pin.buildReducedModel(source, numbers, pin.neutral(source) if q is None else q)


def assert_same_as_pinocchio(model, source):
    """Every number that both hold: names, tree, placements, axes, inertias, frames, limits, friction."""
    model = jax.tree.map(np.asarray, model)
    assert model.joint_names == tuple(source.names)[1:]
    assert (model.nb, model.nv) == (source.njoints - 1, source.nv)
    assert model.topology.parents == tuple(parent - 1 for parent in source.parents[1:])
    total = sum(inertia.mass for inertia in source.inertias[1:])
    np.testing.assert_allclose(model.inertias[:, 0].sum(), total, rtol=1e-13)
    for i, (ours, theirs) in enumerate(zip(model.inertias, source.inertias[1:], strict=True)):
        theirs = theirs.toDynamicParameters()
        scale = max(np.abs(theirs).max(), 1e-6)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * scale, err_msg=model.body_names[i])
    carried = {frame.name: frame for frame in source.frames if frame.type == pin.FrameType.BODY}
    carried.pop("universe", None)
    assert set(model.frame_names) == set(carried)
    for name, body, pose in zip(model.frame_names, model.topology.frame_bodies, model.frame_poses, strict=True):
        assert body == carried[name].parentJoint - 1, name
        np.testing.assert_allclose(pose, carried[name].placement.homogeneous, atol=1e-14, err_msg=name)
    if not model.nb:
        return
    reference, _ = to_jaxdyn(source)
    assert model.topology.kinds == reference.topology.kinds
    np.testing.assert_allclose(model.home, reference.home, atol=1e-14)
    np.testing.assert_allclose(model.screws, reference.screws, atol=1e-15)
    for i, kind in enumerate(model.topology.kinds):
        joint, q, v = source.joints[i + 1], model.topology.q_slices[i], model.topology.v_slices[i]
        if kind == "free":
            continue
        if kind != "continuous":
            assert model.lower[q] == source.lowerPositionLimit[joint.idx_q]
            assert model.upper[q] == source.upperPositionLimit[joint.idx_q]
        assert model.effort_limit[v] == source.effortLimit[joint.idx_v]
        assert model.velocity_limit[v] == source.velocityLimit[joint.idx_v]
        for ours, theirs in ((model.damping, source.damping), (model.friction, source.friction)):
            assert (0.0 if ours is None else ours[v]) == theirs[joint.idx_v]


def assert_same_models(one, two, rtol=1e-12):
    assert one.topology == two.topology
    for name in LEAVES:
        a, b = getattr(one, name), getattr(two, name)
        if name in ("damping", "friction") and (a is None) != (b is None):
            # Written as zero, where the file says anything of a joint's dynamics: readers of URDF ask for both.
            assert not np.any(a if b is None else b), name
            continue
        assert (a is None) == (b is None), name
        if a is not None:
            finite = np.abs(a)[np.isfinite(a)]
            np.testing.assert_allclose(b, a, rtol=rtol, atol=rtol * finite.max(initial=0.0), err_msg=name)


def some(names: list[str], step: int, *more) -> list:
    """All of the names, of which others than every `step`-th run with the slow tests."""
    slow = [pytest.mark.slow if i % step and x not in MENDED else () for i, x in enumerate(names)]
    return [pytest.param(x, *more, marks=marks) for x, marks in zip(names, slow, strict=True)]


@pytest.mark.parametrize(("name", "floating"), some(LOADED, 3, False) + some(LOADED, 6, True))
def test_robot_is_the_one_that_pinocchio_loads(name, floating):
    model = jd.load_model(Path(ROBOTS) / name, floating_base=floating)
    assert_same_as_pinocchio(model, in_pinocchio(name, floating))


@pytest.mark.parametrize("name", [TALOS, "tiago_description/robots/tiago_no_hand.urdf"])
@pytest.mark.parametrize("floating", [False, True])
def test_locked_joints_give_pinocchios_reduced_model(name, floating):
    source = in_pinocchio(name, floating)
    rng = np.random.default_rng(1)
    names = [joint for joint in list(source.names)[1:] if joint != "root_joint"]
    values = dict(zip(names[1::3], rng.uniform(-1, 1, len(names)).tolist(), strict=False))
    q = pin.neutral(source)
    for joint, value in values.items():
        place = source.joints[source.getJointId(joint)]
        number = [np.cos(value), np.sin(value)] if place.nq == 2 else value
        q[place.idx_q : place.idx_q + place.nq] = number
    for lock, place in ((values, q), (list(values), None)):
        model = jd.load_model(Path(ROBOTS) / name, floating_base=floating, lock=lock)
        assert_same_as_pinocchio(model, locked_in_pinocchio(source, values, place))


# Small files for single features and faults ---------------------------------------------------------------------------

SOLID = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


def link(name, inside=SOLID):
    return f'<link name="{name}">{inside}</link>'


def joint(name, parent, child, inside="", kind="revolute"):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">\n{ends}\n{inside}</joint>'


@pytest.fixture
def urdf(tmp_path):
    """Writes a robot from its parts, one line each, and returns the path."""

    def write(*parts, head='<robot name="r">', tail="</robot>"):
        path = tmp_path / "robot.urdf"
        path.write_text("\n".join((head, *parts, tail)))
        return path

    return write


def test_features_of_a_joint(urdf):
    inside = (
        '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/><axis xyz="0 3 4"/>'
        '<limit lower="-1" upper="2" effort="30" velocity="4"/>'
        '<dynamics damping="0.5" friction="0.25" armature="0.125"/>'
    )
    path = urdf(link("a"), joint("j", "a", "b", inside), link("b"), '<gazebo:thing x="1"/>', "<!-- seen -->")
    with pytest.warns(jd.io.NotTakenWarning, match="unknown <gazebo:thing>"):
        model = jd.load_model(path, gravity=None)
    assert (model.name, model.gravity, model.joint_names, model.frame_names) == ("r", None, ("j",), ("b", "a"))
    np.testing.assert_allclose(model.screws[0], [0, 0, 0, 0, 0.6, 0.8], atol=1e-16)
    np.testing.assert_allclose(model.home[0, :3, :3], pin.rpy.rpyToMatrix(0.1, 0.2, 0.3), atol=1e-15)
    values = [getattr(model, name)[0] for name in ("lower", "upper", "effort_limit", "velocity_limit")]
    assert values == [-1, 2, 30, 4]
    assert [model.damping[0], model.friction[0], model.armature[0]] == [0.5, 0.25, 0.125]


def test_defaults_of_a_joint(urdf):
    model = jd.load_model(urdf(link("a"), joint("j", "a", "b"), link("b")), dtype=np.float32)
    np.testing.assert_array_equal(model.screws[0], [0, 0, 0, 1, 0, 0])  # the format's default axis is x
    np.testing.assert_array_equal(model.home[0], np.eye(4))
    assert [float(model.lower[0]), float(model.upper[0])] == [-np.inf, np.inf]
    assert (model.damping, model.friction, model.armature) == (None, None, None)
    assert model.home.dtype == np.float32
    half = jd.load_model(urdf(link("a"), joint("j", "a", "b", '<limit upper="1"/>'), link("b")))
    assert [float(half.lower[0]), float(half.upper[0]), float(half.effort_limit[0])] == [0, 1, np.inf]
    limit = '<limit upper="1" effort="5"/>'
    free = jd.load_model(urdf(link("a"), joint("j", "a", "b", limit, "continuous"), link("b")))
    assert [float(free.upper[0]), float(free.effort_limit[0])] == [np.inf, 5]


def test_what_is_only_seen_is_not_read(urdf):
    broken = '<visual><origin xyz="what"/><geometry><mesh filename="package://a/b.dae" scale="x"/></geometry></visual>'
    assert jd.load_model(urdf(link("a"), joint("j", "a", "b"), link("b", SOLID + broken))).nb == 1


def test_planar_and_floating_joints_are_pinocchios(urdf):
    origin = '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/>'
    chain = (link("a"), link("b"), joint("f", "b", "c", origin, "floating"), link("c"))
    path = urdf(*chain, joint("p", "a", "b", f'{origin}<axis xyz="0 0 1"/>', "planar"))
    model, source = jd.load_model(path), pin.buildModelFromUrdf(str(path))
    assert model.topology.kinds == ("planar", "free") and model.body_names == ("b", "c")
    quat = np.array([0.1, 0.5, -0.3, 0.8])
    quat /= np.linalg.norm(quat)
    q = np.concatenate([[0.4, -0.7, 2.1, 0.3, 0.2, -0.9], quat])
    theirs = np.concatenate([[0.4, -0.7, np.cos(2.1), np.sin(2.1), 0.3, 0.2, -0.9], np.roll(quat, -1)])
    data = source.createData()
    pin.forwardKinematics(source, data, theirs)
    poses = quick(jd.forward_kinematics)(model, q)
    np.testing.assert_allclose(poses, [x.homogeneous for x in list(data.oMi)[1:]], atol=1e-14)
    # Locked there, the poses of the links are the same.
    held = jd.load_model(path, lock={"p": q[:3], "f": q[3:]})
    assert held.nb == 0 and held.frame_names == ("a", "b", "c")
    np.testing.assert_allclose(held.frame_poses[1:], poses, atol=1e-14)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0, -1), (1, -2, 0.5)])
def test_planar_joint_moves_in_the_plane_normal_to_its_axis(urdf, axis):
    axis_text = f'<axis xyz="{" ".join(map(str, axis))}"/>'
    origin = '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/>'
    tip = joint("t", "b", "c", '<origin xyz="0 0 1"/>', "fixed")
    path = urdf(link("a"), link("b"), joint("p", "a", "b", origin + axis_text, "planar"), tip, link("c"))
    model = jd.load_model(path)
    assert model.body_names == ("b_plane",) and set(model.frame_names) == {"b_plane", "a", "b", "c"}

    def link_pose(name, q):
        held = jd.load_model(path, lock={"p": q})
        return np.asarray(held.frame_poses[held.frame_names.index(name)])

    home = pin.SE3(pin.rpy.rpyToMatrix(0.1, 0.2, 0.3), np.array([1.0, 2, 3]))
    np.testing.assert_allclose(link_pose("b", [0, 0, 0]), home.homogeneous, atol=1e-15)
    unit = np.array(axis) / np.linalg.norm(axis)
    moved = home.inverse() * pin.SE3(link_pose("b", [0.4, -0.7, 0.0]))
    np.testing.assert_allclose(moved.rotation, np.eye(3), atol=1e-15)
    np.testing.assert_allclose([unit @ moved.translation, moved.translation @ moved.translation], [0, 0.65], atol=1e-14)
    turned = home.inverse() * pin.SE3(link_pose("b", [0.4, -0.7, 0.9]))
    np.testing.assert_allclose(pin.log3(turned.rotation), 0.9 * unit, atol=1e-14)
    np.testing.assert_allclose(turned.translation, moved.translation, atol=1e-15)
    # The free model goes where the locked ones stand.
    body = quick(jd.forward_kinematics)(model, np.array([0.4, -0.7, 0.9]))[0]
    for name in ("b", "c"):
        pose = body @ np.asarray(model.frame_poses[model.frame_names.index(name)])
        np.testing.assert_allclose(pose, link_pose(name, [0.4, -0.7, 0.9]), atol=1e-14)
    whole = pin.Inertia(1.0, np.zeros(3), np.eye(3)) + pin.Inertia(1.0, np.array([0, 0, 1.0]), np.eye(3))
    turn = pin.SE3(np.asarray(model.frame_poses[model.frame_names.index("b")]))
    np.testing.assert_allclose(model.inertias[0], turn.act(whole).toDynamicParameters(), atol=1e-14)


def test_base_is_locked_where_it_is_told(urdf):
    path = urdf(link("a"), joint("j", "a", "b"), link("b"))
    model = jd.load_model(path, floating_base=True, lock={"root_joint": [1, 2, 3, 0, 0, 0, 2]})
    assert model.joint_names == ("j",)
    home = np.diag([-1.0, -1, 1, 1]) + np.outer([1, 2, 3, 0], [0, 0, 0, 1])
    np.testing.assert_allclose(model.home[0], home, atol=1e-16)


def test_root_joint_gives_way_to_a_joint_of_that_name(urdf):
    model = jd.load_model(urdf(link("a"), joint("root_joint", "a", "b"), link("b")), floating_base=True)
    assert model.joint_names == ("_root_joint", "root_joint")


def test_mimic_joints():
    panda, baxter = (Path(ROBOTS) / name for name in MIMIC)
    assert jd.load_model(panda).topology.couplings == ()
    model = jd.load_model(panda, mimic="couple")
    follower, leader = (f"panda_finger_joint{i}" for i in (2, 1))
    assert [(model.joint_names[i], model.joint_names[k]) for i, k in model.topology.couplings] == [(follower, leader)]
    np.testing.assert_array_equal(model.coupling_values, [[1.0, 0.0]])
    assert model.nv == 9
    with pytest.raises(ValueError, match=r"panda_finger_joint2 .*mimic='couple'"):
        jd.load_model(panda, mimic="error")
    with pytest.raises(ValueError, match="mimic is 'follow'"):
        jd.load_model(panda, mimic="follow")
    model = jd.load_model(baxter, mimic="couple")
    assert sorted(model.coupling_values[:, 0].tolist()) == [-1, -1]
    # A follower of a locked joint is locked where the coupling puts it.
    held = jd.load_model(panda, mimic="couple", lock={leader: 0.03})
    assert_same_models(held, jd.load_model(panda, lock={leader: 0.03, follower: 0.03}))
    assert jd.load_model(panda, lock=[leader]).nv == 8
    with pytest.raises(ValueError, match=f"'{follower}' follows '{leader}'"):
        jd.load_model(panda, mimic="couple", lock=[follower])
    with pytest.raises(ValueError, match=f"'{follower}' is held at"):
        jd.load_model(panda, mimic="couple", lock={leader: 0.03, follower: 0.01})


def test_chains_of_mimic_joints(urdf):
    follow = '<axis xyz="0 0 1"/><mimic joint="{}" multiplier="{}" offset="{}"/>'
    parts = [link(name) for name in "abcd"]
    parts += [joint("j1", "a", "b"), joint("j2", "b", "c", follow.format("j1", 2, 0.5))]
    path = urdf(*parts, joint("j3", "c", "d", follow.format("j2", -1, 0)))
    model = jd.load_model(path, mimic="couple")
    assert model.topology.couplings == ((1, 0), (2, 1))
    np.testing.assert_array_equal(model.coupling_values, [[2, 0.5], [-1, 0]])
    held = jd.load_model(path, mimic="couple", lock={"j1": 0.1})
    assert_same_models(held, jd.load_model(path, lock={"j1": 0.1, "j2": 0.7, "j3": -0.7}))


TREE = (link("a"), link("b"))


def hinge(inside="", *rest, kind="revolute"):
    """Two links and their joint j, with more elements in it, and further parts."""
    return *TREE, joint("j", "a", "b", inside, kind), *rest


def test_followers_of_fixed_joints_are_held_at_their_offset(urdf):
    follow = '<axis xyz="0 0 1"/><mimic joint="{}" multiplier="2" offset="{}"/>'
    path = urdf(
        *(link(name) for name in "abcd"),
        joint("still", "a", "b", "", "fixed"),
        joint("first", "b", "c", follow.format("still", 0.3)),
        joint("second", "c", "d", follow.format("first", 0.1)),
    )
    assert jd.load_model(path).nv == 2
    held = jd.load_model(path, mimic="couple", floating_base=True)
    assert held.joint_names == ("root_joint",)
    pose = jd.frame_pose(held, jnp.array([0.0, 0, 0, 1, 0, 0, 0]), "d")
    angle = 0.3 + 2 * 0.3 + 0.1
    np.testing.assert_allclose(pose[:2, 0], [np.cos(angle), np.sin(angle)], atol=1e-14)


COUPLED = joint("j", "a", "b", '<mimic joint="k"/>'), joint("k", "b", "c", "", "{}"), link("c")
# name: (parts, line of the fault, message). The parts start on line 2; a joint has its ends on its second line.
BAD_FILES = {
    "tags crossed": ((link("a"), "<link name='x'>", "</lonk>"), 4, "malformed XML: .*lonk"),
    "entity": ((link("a"), "<link name='&x;'/>"), 3, "malformed XML: undefined entity .*&x;"),
    "no links": ((), 1, "the robot has no <link>"),
    "link without name": ((link("a"), "<link/>"), 3, "a <link> has no name"),
    "joint without name": ((*TREE, joint("", "a", "b")), 4, "a <joint> has no name"),
    "link twice": ((*TREE, link("a")), 4, "the link name 'a' is taken at .*:2; rename one"),
    "joint twice": (hinge("", joint("j", "a", "b")), 7, "the joint name 'j' is taken at .*:4"),
    "type": (hinge(kind="hinge"), 4, "joint 'j' has type 'hinge', which is unknown; types are"),
    "no type": ((*TREE, '<joint name="j"><parent link="a"/><child link="b"/></joint>'), 4, "'j' has type None"),
    "no parent": ((*TREE, '<joint name="j" type="fixed"><child link="b"/></joint>'), 4, "'j' has no <parent>"),
    "no child": ((*TREE, '<joint name="j" type="fixed"><parent link="a"/></joint>'), 4, "'j' has no <child>"),
    "parent without link": ((*TREE, joint("j", "a", "b").replace('link="a"', "")), 5, "<parent> .*has no link"),
    "unknown link": ((*TREE, joint("j", "a", "x")), 5, "joint 'j': the child link 'x' is not in the file"),
    "two roots": ((*TREE, link("c"), joint("j", "a", "b")), None, "2 root links: a, c; join them by a joint"),
    "two parents": (hinge("", joint("k", "a", "b")), 7, "'b' is the child of joints 'j' and 'k'"),
    "cycle": (hinge("", joint("k", "b", "a")), 7, "links a, b form a cycle"),
    "text for numbers": (hinge('<origin xyz="1 2 x"/>'), 6, "xyz of <origin> of joint 'j' is '1 2 x'"),
    "two for three": (hinge('<axis xyz="1 2"/>'), 6, "'1 2'; give 3 finite numbers"),
    "NaN mass": ((link("a", SOLID.replace('"1"/>', '"nan"/>', 1)),), 2, "value of <mass> of link 'a' is 'nan'"),
    "negative mass": ((link("a", SOLID.replace('value="1"', 'value="-2"')),), 2, "link 'a': the mass is -2.0 kg"),
    "inertia with a gap": ((link("a", SOLID.replace('izz="1"', "")),), 2, "<inertia> of link 'a' has no izz"),
    "zero axis": (hinge('<axis xyz="0 0 0"/>'), 4, "joint 'j': axis is .*direction other than zero"),
    "quaternion": (hinge('<origin quat_xyzw="0 0 0 1"/>'), 6, "has quat_xyzw.*write it as rpy"),
    "crossed limits": (hinge('<limit lower="1" upper="-1"/>'), 4, "lower limit 1.0 is above"),
    "no inertia": ((*TREE[:1], link("b", ""), joint("j", "a", "b")), None, "joint 'j' .*moves no inertia"),
    "mimic without joint": (hinge("<mimic/>"), 6, "<mimic> of joint 'j' has no joint"),
    "mimic of nothing": ((*TREE, COUPLED[0]), 4, "'j' follows 'k'; joint 'k' is unknown; .*mimic='ignore'"),
    "mimic of floating": ((*TREE, *(part.format("floating") for part in COUPLED)), 4, "but 'k' is free"),
    "second inertial": ((link("a", SOLID + SOLID),), 2, "second <inertial> .*on line 2"),
    "negative effort": (hinge('<limit effort="-1"/>'), 6, "effort of <limit> of .*its magnitude"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files(case, urdf):
    parts, line, message = BAD_FILES[case]
    path = urdf(*parts)
    with pytest.raises(ValueError, match=f"(?s){path}:{'' if line is None else f'{line}:'}.*({message})"):
        jd.load_model(path, mimic="couple")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "robot.urdf:1: malformed XML"),
        ("links and joints", "robot.urdf:1: malformed XML"),
        ("\n<mujoco/>", "robot.urdf:2: the root element is <mujoco>, expected <robot>"),
        ("<robot><link name='a'/></robot>", "robot.urdf:1: the robot has no name"),
        ('<robot xmlns:xacro="http://ros.org/xacro"/>', "robot.urdf:1: .*xacro IN > OUT"),
        ('<!DOCTYPE robot [\n<!ENTITY x "b">]><robot name="&x;"/>', "robot.urdf:2: .*entity 'x'"),
    ],
)
def test_files_that_are_no_urdf(content, message, tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(content)
    with pytest.raises(ValueError, match=message):
        jd.load_model(path)
    with pytest.raises(ValueError, match=message):
        jd.io.urdf_inertia_report(path)


def test_bad_arguments(urdf, tmp_path):
    path = urdf(*TREE, joint("elbow", "a", "b"), link("c"), joint("weld", "b", "c", kind="fixed"))
    for lock, message in {
        "elbow": "lock is 'elbow'; give a list",
        ("elbwo",): r"lock: joint 'elbwo' is unknown \(did you mean elbow",
        ("weld",): "lock: joint 'weld' is fixed already",
        ("root_joint",): "lock: joint 'root_joint' is unknown",
    }.items():
        with pytest.raises(ValueError, match=message):
            jd.load_model(path, lock=lock)
    for value, message in {(1.0, 2.0): r"has shape \(2,\)", np.nan: "nan.*finite", "up": "'up', expected"}.items():
        with pytest.raises(ValueError, match=f"value of joint 'elbow'.*{message}"):
            jd.load_model(path, lock={"elbow": value})
    with pytest.raises(ValueError, match=r"quaternion .* is zero"):
        jd.load_model(path, floating_base=True, lock={"root_joint": np.zeros(7)})
    with pytest.raises(ValueError, match=r"nowhere.urdf' .*check the path"):
        jd.load_model(tmp_path / "nowhere.urdf")
    with pytest.raises(ValueError, match="cannot be read"):
        jd.load_model(tmp_path)


def test_units_that_look_wrong_are_said_aloud(urdf):
    """Degrees and millimetres; 1e16 stands for no limit."""
    limit = '<origin xyz="350 0 0"/><limit lower="-90" upper="1e16" effort="1" velocity="1"/>'
    heavy = '<inertial><mass value="1"/><inertia ixx="2e4" iyy="2e4" izz="2e4" ixy="0" ixz="0" iyz="0"/></inertial>'
    text = (path := urdf(link("a"), link("b", heavy), joint("j", "a", "b", limit))).read_text()
    for read in (jd.load_model, jd.load):
        with pytest.warns(jd.io.UnitsWarning) as caught:
            read(path)
        for part in ("robot.urdf", "rad of joint 'j' (degrees?)", "body 'b' 350 m", "radius of gyration 141.421 m"):
            assert part in str(caught[0].message)
    path.write_text(text.replace("-90", "-1e16").replace("2e4", "0.1").replace("350", "0.35"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jd.load_model(path)


def test_inertia_report_names_links(urdf):
    flat = SOLID.replace('ixx="1"', 'ixx="-1"')
    long = SOLID.replace('ixx="1"', 'ixx="3"')
    frame = joint("f", "flat", "frame", kind="fixed")
    moves = [joint(f"j{i}", *ends) for i, ends in enumerate((("a", "flat"), ("a", "long"), ("a", "bare")))]
    end = joint("j3", "bare", "tip", '<axis xyz="0 1 0"/>')
    links = {"a": "", "flat": flat, "long": long, "bare": "", "frame": "", "tip": SOLID}
    path = urdf(*(link(*one) for one in links.items()), frame, *moves, end)
    report = jd.io.urdf_inertia_report(path)
    assert [(name, problem.split(":")[0]) for name, problem in report] == [
        ("flat", "not positive definite"),
        ("long", "triangle inequality violated"),
        ("bare", "massless"),
    ]
    assert [name for name, _ in jd.model.inertia_report(jd.load_model(path))] == ["flat", "long", "bare"]


@pytest.mark.parametrize("name", INERTIAS)
def test_inertia_reports_of_robots(name):
    # The same judgement on the matrices as they are printed in the file, read by other means.
    expected = set()
    for inertial in ET.parse(Path(ROBOTS) / name).iterfind("link/inertial"):
        values = {key: float(value) for key, value in inertial.find("inertia").attrib.items()}
        rows = [[values["i" + "".join(sorted(a + b))] for a in "xyz"] for b in "xyz"]
        moments = np.linalg.eigvalsh(np.array(rows))
        mass = float(inertial.find("mass").get("value"))
        if mass == 0 and not moments.any():
            expected.add("massless")
        elif mass > 0 and moments[0] <= 0:
            expected.add("not positive definite")
        elif mass > 0 and moments[2] > (1 + 1e-12) * (moments[0] + moments[1]):
            expected.add("triangle inequality violated")
    report = jd.io.urdf_inertia_report(Path(ROBOTS) / name)
    assert {problem.split(":")[0] for _, problem in report if "no <inertial>" not in problem} == expected


# The way back --------------------------------------------------------------------------------------------------------


def saved(model, path, **options):
    jd.save_urdf(model, path)
    return jd.load_model(path, gravity=model.gravity, **options)


@pytest.mark.parametrize(("name", "floating"), ROUND_TRIPS)
def test_round_trip_of_robots(name, floating, tmp_path):
    model = jd.load_model(Path(ROBOTS) / name, floating_base=floating, mimic="couple")
    path = tmp_path / "out.urdf"
    again = saved(model, path, floating_base=floating, mimic="couple")
    assert_same_models(model, again)
    # Pinocchio reads the same robot from the file.
    source = in_pinocchio(path, floating)
    assert model.joint_names == tuple(source.names)[1:]
    for ours, theirs in zip(np.asarray(model.inertias), source.inertias[1:], strict=True):
        np.testing.assert_allclose(ours, theirs.toDynamicParameters(), atol=1e-13 * np.abs(ours).max(initial=1.0))


@pytest.mark.parametrize("seed", range(4))
def test_round_trip_of_random_trees(seed, tmp_path):
    kinds = ("revolute", "continuous", "prismatic", "planar", "free", "fixed")
    model = robots.random_tree(seed, 14, branching=2.5, kinds=kinds)
    again = saved(model, tmp_path / "out.urdf")
    # A root link is needed, and there was none at the world's origin.
    assert set(again.frame_names) - set(model.frame_names) == {"world"}
    keep = [again.frame_names.index(name) for name in model.frame_names]
    assert again.joint_names == model.joint_names and again.topology.parents == model.topology.parents
    assert again.topology.kinds == model.topology.kinds
    for name in ("home", "screws", "inertias"):
        np.testing.assert_allclose(getattr(again, name), getattr(model, name), rtol=1e-12, atol=1e-13, err_msg=name)
    np.testing.assert_allclose(again.frame_poses[np.array(keep)], model.frame_poses, atol=1e-13)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, np.pi / 2 + 1e-5])
def test_round_trip_at_the_singularity_of_the_angles(pitch, tmp_path):
    builder = jd.ModelBuilder().add_body("base", joint="fixed")
    builder.add_body("b", "base", inertia=(1, (0, 0, 0), (1, 1, 1)), pose=((0, 0, 0), (0.7, pitch, -1.9)))
    model = builder.build()
    assert_same_models(model, saved(model, tmp_path / "out.urdf"), rtol=1e-15)


def test_round_trip_of_all_that_a_model_can_hold(tmp_path):
    ball = (2.0, (0.1, 0.2, 0.3), (0.03, 0.04, 0.05))
    builder = jd.ModelBuilder("all", gravity=(0.0, 1.0, -9.0)).add_body("base", joint="fixed")
    builder.add_body("a", "base", "revolute", ball, armature=0.1, lower=-1.0, velocity_limit=3.0)
    builder.add_body("b", "a", "continuous", ball, damping=0.2, effort_limit=9.0, axis=(1, 2, 3))
    builder.add_body("c", "b", "prismatic", ball, friction=0.3, upper=1 / 3, axis=(0, -1, 0))
    builder.add_body("d", "c", "planar", ball, damping=0.4)
    builder.add_body("e", "d", "free", ball).add_frame("tool", "e", ((1, 2, 3), (4, 5, 6)))
    builder.add_body("m", "e", armature=1e-3).add_body("rotor", "e", armature=1.0, inertia=[0] * 4 + [1, 0, 1, 0, 0, 1])
    builder.add_coupling("c_joint", "a_joint", 0.5, -0.25)
    model = builder.build()
    assert_same_models(model, saved(model, tmp_path / "out.urdf", mimic="couple"), rtol=1e-15)


@pytest.mark.parametrize(
    ("fixed", "moving", "order"),
    [
        # Depth-first through the fixed links x (joint p) and y (joint q): n, then d, e by way of x, then a by way of y.
        ("base:x:p base:y:q", "base:n d<x e<x a<y", "n d e a"),
        # Without a frame to hang on, one is added: x hangs on b, which comes up between a and c.
        ("base:b:b", "base:a base:c z<b x<b", "a x z c"),
        ("base:b:b base:b2:d", "base:a base:c base:f z<b 0<b2", "a z c 0 f"),
    ],
)
def test_siblings_keep_their_order(fixed, moving, order, tmp_path):
    ball = (2.0, (0.1, 0.2, 0.3), (0.03, 0.04, 0.05))
    builder = jd.ModelBuilder().add_body("base", joint="fixed")
    for parent, name, joint_name in (word.split(":") for word in fixed.split()):
        builder.add_body(name, parent, "fixed", joint_name=joint_name, pose=(1, 2, 3))
    for word in moving.split():
        name, parent = word.split("<") if "<" in word else word.split(":")[::-1]
        builder.add_body(f"body {name}", parent, inertia=ball, joint_name=name, pose=(0, 0, 1))
    model = builder.build()
    assert model.joint_names == tuple(order.split())
    assert_same_models(model, saved(model, tmp_path / "out.urdf"), rtol=1e-15)


def test_names_that_xml_must_escape(tmp_path):
    builder = jd.ModelBuilder('"<&>"').add_body("bäse & <co>", joint="fixed")
    model = builder.add_body('"b"', "bäse & <co>", inertia=(1, (0, 0, 0), (1, 1, 1)), joint_name="'j'<").build()
    assert_same_models(model, saved(model, tmp_path / "out.urdf"))


def test_what_urdf_cannot_express_is_refused_by_name(tmp_path):
    ball = (2.0, (0.1, 0.2, 0.3), (0.03, 0.04, 0.05))
    refusals = {
        "joint 'b_joint' is helical": dict(joint="helical", pitch=0.1),
        "joint 'b_joint' is spherical": dict(joint="spherical"),
        "joint 'b_joint' is helical; URDF": dict(joint="helical", screw=(0, 1, 0, 0, 0, 1)),
        r"joint 'b_joint' is planar and has limits \(lower, velocity\)": dict(
            joint="planar", lower=(-1, -np.inf, -np.inf), velocity_limit=3.0
        ),
        "joint 'b_joint': damping .* differs between directions": dict(joint="planar", damping=(1.0, 2.0, 3.0)),
        "body 'b' has first moments .* without mass": dict(inertia=[0, 1, 0, 0, 1, 0, 1, 0, 0, 1]),
    }
    for message, options in refusals.items():
        builder = jd.ModelBuilder().add_body(**{"name": "b", "inertia": ball, **options})
        with pytest.warns(UserWarning, match="no mass") if "inertia" in options else contextlib.nullcontext():
            model = builder.build()
        with pytest.raises(ValueError, match=message):
            jd.save_urdf(model, tmp_path / "out.urdf")
        assert not (tmp_path / "out.urdf").exists()
    model = robots.iiwa()
    with pytest.raises(ValueError, match="screw of length 2; URDF has unit axes"):
        jd.save_urdf(model.replace(screws=2 * model.screws), tmp_path / "out.urdf")
    with pytest.raises(OSError, match="nowhere"):
        jd.save_urdf(robots.iiwa(), tmp_path / "nowhere" / "out.urdf")


def test_armature_alone_is_written_with_damping_and_friction(tmp_path):
    """Pinocchio and urdfdom refuse <dynamics> without them."""
    model = jd.ModelBuilder().add_body("b", inertia=(1.0, (0, 0, 0), (1, 1, 1)), armature=0.25).build()
    again = saved(model, tmp_path / "out.urdf")
    assert again.armature == model.armature and not (np.any(again.damping) or np.any(again.friction))
    source = pin.buildModelFromUrdf(str(tmp_path / "out.urdf"))
    assert source.nv == 1 and not source.damping.any() and not source.friction.any()


TEXT = """<robot name="机械臂"><link name="底座"/><link name="前臂"><inertial><mass value="2"/><inertia
ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="肘" type="revolute">
<parent link="底座"/><child link="前臂"/><axis xyz="0 0 1"/></joint></robot>"""


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "gbk", "gb18030", "big5", "cp932"])
def test_encodings_that_the_declaration_names(encoding, tmp_path):
    text = TEXT.replace("臂", "手") if encoding == "cp932" else TEXT
    text = text.replace("机", "機").replace("肘", "肘") if encoding in ("big5", "cp932") else text
    path = tmp_path / "arm.urdf"
    declared = encoding.removesuffix("-sig")
    path.write_bytes(f'<?xml version="1.0" encoding="{declared}"?>\n{text}'.encode(encoding))
    assert jd.load_model(path).joint_names == jd.load(path).system.joint_names == ("肘",)
    path.rename(path := tmp_path / "arm.xml")
    assert jd.load(path).system.body_names == jd.load_model(path).body_names


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (f'<?xml version="1.0"?>\n\n{TEXT}'.encode("gbk"), (":3: the text is not utf-8", "save the file as UTF-8")),
        (b'<?xml version="1.0" encoding="gbk"?>\n<robot name="\xff\xff"/>', (":2: the text is not gbk",)),
        (b'<?xml version="1.0" encoding="quux"?><robot/>', (":1: the encoding 'quux'", "unknown")),
        (b'<?xml version="1.0" encoding="utf-16"?><robot/>', (":1: the XML declaration says utf-16", "leave it out")),
        (b'<?xml version="1.0" encoding="hex"?><robot/>', (":1: the encoding 'hex'",)),
        ('<?xml version="1.0" encoding="gbk"?>\n<robot name="机">\n<link></robot>'.encode("gbk"), (":3: malformed",)),
    ],
)
def test_bad_encodings_are_named_with_their_line(data, words, tmp_path):
    for path in (tmp_path / "arm.urdf", tmp_path / "arm.xml"):
        path.write_bytes(data)
        for reader in (jd.load_model, jd.load, jd.pictures.shapes):
            with pytest.raises(ValueError, match="arm") as caught:
                reader(path)
            assert all(word in str(caught.value) for word in (*words, f"{path}:"))


@pytest.mark.parametrize("text", ["1_0", "１０", "0x10", "1,0", "nan", "inf", "1e999"])
def test_numbers_that_only_python_reads_are_refused(text, urdf):
    path = urdf(link("a"), link("b", SOLID.replace('"1"', f'"{text}"', 1)), joint("j", "a", "b"))
    with pytest.raises(ValueError, match=f"value of <mass> of link 'b' is '{text}'; give a finite number"):
        jd.load_model(path)


def test_warnings_point_at_the_line_of_the_caller(urdf):
    heavy = SOLID.replace('izz="1"', 'izz="5"')
    limit = '<axis xyz="0 0 1"/><limit lower="-180" upper="180" effort="1" velocity="1"/>'
    closing = '<gazebo><joint name="g" type="screw"><parent>a</parent><child>b</child></joint></gazebo>'
    path = urdf(link("a"), link("b", heavy), joint("j", "a", "b", limit), closing)
    for call in (lambda: jd.load(path), lambda: jd.load_model(path)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
        line = call.__code__.co_firstlineno
        assert {(one.filename, one.lineno) for one in caught} == {(__file__, line)}
        assert len(caught) == (2 if "load_model" in call.__code__.co_names else 3)
        (inertia,) = (one for one in caught if "triangle inequality" in str(one.message))
        assert f"{path}:" in str(inertia.message)


XACRO = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:arg name="length" default="1.0"/><xacro:property name="half" value="${$(arg length) / 2}"/>
<link name="a"/><link name="b"><inertial><origin xyz="0 0 ${half}"/><mass value="2"/><inertia
ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j" type="continuous">
<parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint></robot>"""


def test_xacro_files_are_expanded(tmp_path, monkeypatch):
    pytest.importorskip("xacro", reason="xacro is not installed")
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(XACRO)
    (tmp_path / "arm.yaml").write_text("name_mot: [j]\n")
    for arguments, half in ((None, 0.5), ({"length": 3}, 1.5)):
        scene = jd.load(path, arguments=arguments)
        np.testing.assert_allclose(scene.system.inertias[0, :4], [2, 0, 0, 2 * half], rtol=1e-15)
        assert scene.actuators is not None and scene.actuators.names == ("j",)
        assert_same_models(jd.load_model(path, arguments=arguments), scene.system)
    assert not jd.pictures.shapes(path).missing and jd.io.urdf_inertia_report(path) == []
    for text, words in ((XACRO.replace("half}", "third}"), "third"), (XACRO.replace("1.0", "none"), "none")):
        path.write_text(text)
        with pytest.raises(ValueError, match=f"{path}: xacro: .*{words}.*arguments="):
            jd.load(path)
    path.write_text(XACRO.replace('ixx="1"', 'ixx="$(arg length)"'))
    # Moments of 3, 1 and 1 kg m^2 break the triangle inequality.
    ((name, problem),) = jd.io.urdf_inertia_report(path, arguments={"length": 3})
    assert name == "b" and "inequality" in problem
    path.write_text(XACRO.replace('"2"', '"two"'))
    with pytest.raises(ValueError, match=r"xacro \(expanded\):\d+: .* 'two'"):
        jd.load(path)
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(ImportError, match=r"arm.urdf.xacro.*pip install jaxdyn\[xacro\]"):
        jd.load(path)
    plain = path.with_name("arm.urdf")
    plain.write_text("<robot name='a'><link name='b'/></robot>")
    with pytest.raises(ValueError, match=r"arguments .*no .xacro"):
        jd.load(plain, arguments={"length": 1})


@pytest.mark.parametrize("name", some(FILES, 6))
def test_load_takes_every_robot_or_says_how(name):
    path = Path(ROBOTS) / name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if name not in MENDED:
            assert jd.load(path, floating_base=True).system.nb > 0
            return
        with pytest.raises(ValueError, match=f"(?s){name}{MENDED[name]}") as refusal:
            jd.load(path)
        if "lock=[" in str(refusal.value):
            names = str(refusal.value).split("lock=[")[1].split("]")[0].replace("'", "").split(", ")
            assert not set(names) & set(jd.load(path, lock=names).system.joint_names)
            assert_same_as_pinocchio(jd.load_model(path, lock=names), locked_in_pinocchio(in_pinocchio(name), names))
        elif "mimic=" in str(refusal.value):
            assert jd.load(path, mimic="ignore").system.nb > 0


ARM_WITHOUT_INERTIAS = """<robot name='r'><link name='base'/><link name='arm'/><link name='tool'/><link name='hand'/>
<joint name='j' type='continuous'><origin xyz='0 0 0.3'/><parent link='base'/><child link='arm'/><axis xyz='0 1 0'/></joint>
<joint name='f' type='fixed'><parent link='arm'/><child link='tool'/></joint>
<joint name='k' type='continuous'><origin xyz='0.5 0 0'/><parent link='tool'/><child link='hand'/><axis xyz='0 1 0'/></joint>
</robot>"""


def test_arms_without_inertias_load_for_kinematics(tmp_path):
    """The error names the option, which counts for links that move; kinematics do not depend on it."""
    path = tmp_path / "arm.urdf"
    path.write_text(ARM_WITHOUT_INERTIAS)
    with pytest.raises(ValueError, match=r"missing_inertia=jd.inertia.sphere\(1.0, 0.1\)"):
        jd.load_model(path)
    ball = jd.inertia.sphere(2.0, 0.1)
    for model in (jd.load_model(path, missing_inertia=ball), jd.load(path, missing_inertia=ball).system):
        np.testing.assert_array_equal(model.inertias, np.stack([ball, ball]))
    hand = jd.frame_pose(model, jnp.array([0.4, 0.2]), "hand")[:3, 3]
    np.testing.assert_allclose(hand, [0.5 * np.cos(0.4), 0, 0.3 - 0.5 * np.sin(0.4)], atol=1e-15)
    free = jd.load_model(path, missing_inertia=ball, floating_base=True, lock=["k"])
    np.testing.assert_allclose(free.inertias[:, 0], [2.0, 2.0])
    for bad in (np.nan, "1 kg"):
        with pytest.raises(ValueError, match="missing_inertia"):
            jd.load_model(path, missing_inertia=bad)


def test_packages_of_xacro_files_without_ros(tmp_path):
    """$(find NAME) is a folder of `packages`, or one beside or above the file; includes are expanded alike."""
    pytest.importorskip("xacro", reason="xacro is not installed")
    robot, parts = tmp_path / "robot_description" / "urdf", tmp_path / "parts" / "xacro"
    robot.mkdir(parents=True)
    parts.mkdir(parents=True)
    head = "<robot xmlns:xacro='http://www.ros.org/wiki/xacro' name='r'>"
    (robot / "r.urdf.xacro").write_text(
        f"{head}<xacro:include filename='$(find parts)/xacro/parts.xacro'/>"
        "<xacro:include filename=\"$(find robot_description)/urdf/base.xacro\"/><xacro:hinge length='0.5'/></robot>"
    )
    (robot / "base.xacro").write_text(f"{head}<link name='base'/></robot>")
    (parts / "sizes.xacro").write_text(f"{head}<xacro:property name='mass' value='3'/></robot>")
    (parts / "parts.xacro").write_text(
        f"{head}<xacro:include filename='sizes.xacro'/><xacro:macro name='hinge' params='length'>"
        "<link name='arm'><inertial><origin xyz='${length} 0 0'/><mass value='${mass}'/>"
        "<inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/></inertial></link>"
        "<joint name='j' type='continuous'><parent link='base'/><child link='arm'/></joint></xacro:macro></robot>"
    )
    path = robot / "r.urdf.xacro"
    for model in (jd.load_model(path), jd.load(path, packages={"parts": tmp_path / "parts"}).system):
        np.testing.assert_allclose(model.inertias[0, :2], [3.0, 1.5])
    text = path.read_text()
    path.write_text(text.replace("find parts", "find elsewhere"))
    reason = r"the folder of package 'elsewhere', which the file names by \$\(find elsewhere\), is not known"
    with pytest.raises(ValueError, match=reason):
        jd.load_model(path)
    np.testing.assert_allclose(jd.load_model(path, packages={"elsewhere": str(tmp_path / "parts")}).inertias[0, 0], 3.0)
    assert jd.io.urdf_inertia_report(path, packages={"elsewhere": tmp_path / "parts"}) == []  # the arm's inertia is one
    with pytest.raises(ValueError, match=r"packages\['elsewhere'\] is 'nowhere'"):
        jd.load_model(path, packages={"elsewhere": "nowhere"})
    other = tmp_path / "r.urdf"
    other.write_text("<robot name='r'><link name='a'/></robot>")
    with pytest.raises(ValueError, match=r"packages .*no \.xacro"):
        jd.load_model(other, packages={"a": "b"})
