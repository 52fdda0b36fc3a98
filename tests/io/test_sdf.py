"""SDF files: poses of every version, trees and loops, couplings, and what is refused."""

from pathlib import Path
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
from loading import silent
from pinocchio_bridge import quick
from scipy.linalg import expm

import jaxdyn as jd
from jaxdyn.constraints.loops import JointLock
from jaxdyn.model import host_math

INERTIAL = """<inertial><pose>0.1 0.02 0.03 0.2 0.1 0.3</pose><mass>2</mass><inertia>
<ixx>0.3</ixx><iyy>0.4</iyy><izz>0.5</izz><ixy>0.01</ixy><ixz>0.02</ixz><iyz>0.03</iyz></inertia></inertial>"""


def write(tmp_path, text: str, version: str = "1.7") -> Path:
    path = tmp_path / "robot.sdf"
    path.write_text(f"<sdf version='{version}'>\n{text}\n</sdf>", encoding="utf-8")
    return path


def joint(name, parent, child, kind="revolute", pose="", axis="<xyz>0 0 1</xyz>", rest="") -> str:
    axis = f"<axis>{axis}</axis>" if axis else ""
    pose = f"<pose>{pose}</pose>" if pose else ""
    ends = f"<parent>{parent}</parent><child>{child}</child>"
    return f"<joint name='{name}' type='{kind}'>{ends}{pose}{axis}{rest}</joint>"


def link(name, pose="0 0 0 0 0 0", rest=INERTIAL) -> str:
    return f"<link name='{name}'><pose>{pose}</pose>{rest}</link>"


def poses(scene, q) -> dict[str, np.ndarray]:
    """World pose (4, 4) of every frame, from the model's leaves."""
    model, moved = scene.system, [np.eye(4)]  # the last of the bodies is the world
    top = model.topology
    for i, (kind, parent) in enumerate(zip(top.kinds, top.parents, strict=True)):
        step = host_math.joint_pose(kind, np.asarray(model.screws[i]), np.asarray(q)[top.q_slices[i]])
        moved.insert(-1, moved[parent] @ np.asarray(model.home[i]) @ step)
    frames = zip(top.frame_names, top.frame_bodies, np.asarray(model.frame_poses), strict=True)
    return {name: moved[body] @ pose for name, body, pose in frames}


def residual(scene, constraint, q) -> float:
    """Largest residual of a loop."""
    ends = zip(constraint.ends(), ({None: np.eye(4)} | poses(scene, q),) * 2, strict=True)
    first, second = (computed[body] @ np.asarray(pose) for (body, pose), computed in ends)
    relative = jnp.asarray(host_math.inverse(first) @ second)
    return float(np.abs(constraint.pose_residual(relative[:3, :3], relative[:3, 3])).max())


def loaded(tmp_path, parts: str, version: str = "1.7") -> jd.io.LoadedScene:
    """The scene of a model of these parts."""
    return silent(write(tmp_path, f"<model name='m'>{parts}</model>", version))


def same(a: jd.io.LoadedScene, b: jd.io.LoadedScene) -> None:
    """The two scenes have the same mechanism."""
    assert a.system.joint_names == b.system.joint_names
    for leaf in ("home", "screws", "inertias"):
        np.testing.assert_allclose(getattr(a.system, leaf), getattr(b.system, leaf), atol=1e-14)


# One mechanism in four dialects: links turned and shifted, axes given in model axes.
TURNED = "0.1 0.2 0.3 0.3 0.2 0.1"
AXIS = "<xyz>0.6 0 0.8</xyz>"


def two_links(axis: str) -> str:
    links = link("a") + link("b", TURNED)
    return links + joint("w", "world", "a") + joint("j", "a", "b", pose="0.1 0 0 0 0 0.4", axis=axis)


@pytest.mark.parametrize(
    ("version", "axis"),
    [
        ("1.4", AXIS),
        ("1.5", f"{AXIS}<use_parent_model_frame>1</use_parent_model_frame>"),
        ("1.6", f"{AXIS}<use_parent_model_frame>true</use_parent_model_frame>"),
        ("1.7", AXIS.replace("<xyz>", "<xyz expressed_in='__model__'>")),
        ("1.11", AXIS.replace("<xyz>", "<xyz expressed_in='a'>")),
    ],
)
def test_axes_in_the_models_frame_in_every_version(tmp_path, version, axis):
    scene = loaded(tmp_path, two_links(axis), version)
    turn = poses(scene, jnp.zeros(2))["b"][:3, :3]
    model = scene.system
    i = model.joint_names.index("j")
    # The screw is in the axes of the link; the joint's frame is beside its origin, so a body is in between.
    np.testing.assert_allclose(turn @ np.asarray(model.screws[i, 3:]), [0.6, 0, 0.8], atol=1e-14)
    assert model.body_names[i] == "b_j"


def test_axes_in_the_joints_frame(tmp_path):
    scene = loaded(tmp_path, two_links(AXIS), "1.5")
    same(scene, loaded(tmp_path, two_links(AXIS)))
    turn = host_math.rotation_from_rpy(np.array([0, 0, 0.4]))
    i = scene.system.joint_names.index("j")
    np.testing.assert_allclose(scene.system.screws[i, 3:], turn @ [0.6, 0, 0.8], atol=1e-14)


def test_poses_relative_to_frames_links_and_joints(tmp_path):
    plain = link("a") + link("b", "1 0 0 0 0 1.5707963267948966") + joint("w", "world", "a")
    plain += joint("j", "a", "b", axis="<xyz>1 0 0</xyz>")
    chained = f"""
    {link("a")}{joint("w", "world", "a")}
    <frame name='f' attached_to='a'><pose degrees='true'>0 0 0 0 0 90</pose></frame>
    <frame name='g' attached_to='f'><pose relative_to='f'>0 -1 0 0 0 0</pose></frame>
    <link name='b'><pose relative_to='j'/>{INERTIAL}</link>
    <joint name='j' type='revolute'><parent>f</parent><child>b</child>
      <pose relative_to='g' rotation_format='quat_xyzw'>0 0 0 0 0 0 2</pose><axis><xyz expressed_in='g'>1 0 0</xyz></axis></joint>
    """
    same(loaded(tmp_path, plain), b := loaded(tmp_path, chained, "1.9"))
    np.testing.assert_allclose(poses(b, jnp.zeros(2))["g"][:3, 3], [1, 0, 0], atol=1e-15)


@pytest.mark.parametrize("name", ["a", "j", "m"])
def test_a_model_may_have_the_name_of_what_is_in_it(tmp_path, name):
    parts = link("a", "0 0 0.5 0 0 0") + link("b", TURNED) + joint("j", "a", "b", axis="<xyz>0 1 0</xyz>")
    text = f"<model name='{name}'><pose>0 0 2 0 0 0.3</pose><plugin name='p' filename='f'/>{parts}</model>"
    scene = silent(write(tmp_path, text))
    same(scene, silent(write(tmp_path, text.replace(f"<model name='{name}'", "<model name='other'"))))
    assert scene.system.name == name
    assert f"<plugin> of models: {name}" in scene.not_taken
    np.testing.assert_allclose(poses(scene, scene.starts["reference"].q)["a"][:3, 3], [0, 0, 2.5], atol=1e-15)


def test_nested_models_and_placement_frames(tmp_path):
    inner = f"<frame name='tip' attached_to='hand'><pose>0 0 0.5 0 0 0</pose></frame>{link('hand', '0 0 1 0 0 0')}"
    text = f"""<model name='m'><pose>0 0 2 0 0 0</pose>{link("arm")}{joint("w", "world", "arm")}
    <model name='tool' placement_frame='tip'><pose relative_to='arm'>1 0 0 0 0 0</pose>{inner}</model>
    {joint("j", "arm", "tool::hand")}</model>"""
    scene = silent(write(tmp_path, text, "1.8"))
    assert scene.system.body_names == ("arm", "tool::hand")
    computed = poses(scene, jnp.zeros(2))
    np.testing.assert_allclose(computed["tool::tip"][:3, 3], [1, 0, 2], atol=1e-15)
    np.testing.assert_allclose(computed["tool::hand"][:3, 3], [1, 0, 1.5], atol=1e-15)


def test_worlds_static_models_and_free_roots(tmp_path):
    text = f"""<world name='lab'><gravity>0 0 -3.7</gravity>
    <model name='floor'><static>true</static>{link("slab")}{link("post")}{joint("s", "slab", "post")}</model>
    <model name='ball'><pose>0 0 2 0 0 0.5</pose>{link("core", "0.1 0 0 0 0 0", "")}</model>
    <model name='gate'>{link("door", "1 0 0 0 0 0")}{joint("hinge", "floor::slab", "door")}</model></world>"""
    path = write(tmp_path, text.replace("floor::slab", "world"))
    scene = silent(path)
    model = scene.system
    assert model.name == "lab"
    joints = {"gate::hinge": "continuous", "root_joint": "free"}
    assert dict(zip(model.joint_names, model.topology.kinds, strict=True)) == joints
    np.testing.assert_allclose(model.gravity, [0, 0, -3.7])
    computed = poses(scene, scene.starts["reference"].q)
    expected = host_math.pose_matrix(((0, 0, 2), (0, 0, 0.5)), "") @ host_math.pose_matrix((0.1, 0, 0), "")
    np.testing.assert_allclose(computed["ball::core"], expected, atol=1e-15)
    # A link without <inertial> has the format's default.
    np.testing.assert_allclose(model.inertias[model.body_names.index("ball::core")], [1, 0, 0, 0, 1, 0, 1, 0, 0, 1])
    fixed = silent(path, floating_base=False)
    assert fixed.system.joint_names == ("gate::hinge",)
    np.testing.assert_allclose(poses(fixed, jnp.zeros(1))["ball::core"], expected, atol=1e-15)


KINDS = [
    ("revolute", "", lambda x: (0, 0, 0, 0, 0, x)),
    ("continuous", "", lambda x: (0, 0, 0, 0, 0, x)),
    ("prismatic", "", lambda x: (0, 0, x, 0, 0, 0)),
    ("screw", "<screw_thread_pitch>0.5</screw_thread_pitch>", lambda x: (0, 0, 0.5 * x / (2 * np.pi), 0, 0, x)),
    ("screw", "<thread_pitch>-4</thread_pitch>", lambda x: (0, 0, x / 4, 0, 0, x)),
]
FIXED = link("a") + joint("w", "world", "a", "fixed", axis="")


@pytest.mark.parametrize(("kind", "rest", "motion"), KINDS)
def test_joints_of_one_axis_move_as_screws_at_their_frame(tmp_path, kind, rest, motion):
    place = "0.3 0.1 0.2 0.4 0.5 0.6"
    scene = loaded(tmp_path, FIXED + link("b", TURNED) + joint("j", "a", "b", kind, place, rest=rest))
    shift, home = (host_math.pose_matrix(np.reshape(np.array(x.split(), float), (2, 3)), "") for x in (place, TURNED))
    v = np.array(motion(0.7), float)
    step = np.zeros((4, 4))
    step[:3, :3], step[:3, 3] = host_math.hat(v[3:]), v[:3]
    expected = home @ shift @ expm(step) @ host_math.inverse(shift)
    np.testing.assert_allclose(poses(scene, jnp.array([0.7]))["b"], expected, atol=1e-14)


@pytest.mark.parametrize("kind", ["universal", "revolute2"])
def test_joints_of_two_axes_turn_first_about_the_parents(tmp_path, kind):
    rest = "<axis2><xyz>0 1 0</xyz></axis2>"
    scene = loaded(tmp_path, FIXED + link("b") + joint("j", "a", "b", kind, rest=rest))
    assert scene.system.joint_names == ("j", "j_axis2")
    turn = host_math.rotation_matrix(np.array([0, 0, 1.0]), 0.3) @ host_math.rotation_matrix(np.array([0, 1.0, 0]), 0.5)
    np.testing.assert_allclose(poses(scene, jnp.array([0.3, 0.5]))["b"][:3, :3], turn, atol=1e-15)


def test_a_tree_that_runs_against_a_joint_keeps_its_angle(tmp_path):
    """Parent and child exchanged in the file: the same angle turns the child against the parent."""
    anchor = "0.2 0 0 0.1 0.2 0.3"
    parts, relative = link("a") + link("b", TURNED) + joint("j", "a", "b", pose=anchor), []
    for root, inner in (("b", ["w"]), ("a", ["w"])):
        scene = loaded(tmp_path, parts + joint("w", "world", root))
        assert [scene.system.joint_names[p] for p in scene.system.topology.parents if p >= 0] == inner
        q = jnp.zeros(2).at[scene.system.joint_names.index("j")].set(0.4)
        relative.append(host_math.inverse(poses(scene, q)["a"]) @ poses(scene, q)["b"])
    np.testing.assert_allclose(*relative, atol=1e-14)


FOUR_BAR = (
    link("crank")
    + link("rod", "0 0 0.3 0 0 0")
    + link("rocker", "0.8 0 0 0 0 0")
    + joint("a", "world", "crank", axis="<xyz>0 1 0</xyz>")
    + joint("b", "crank", "rod", axis="<xyz>0 1 0</xyz><dynamics><spring_stiffness>3</spring_stiffness></dynamics>")
    + joint("c", "world", "rocker", axis="<xyz>0 1 0</xyz><dynamics><damping>2</damping></dynamics>")
)


@pytest.mark.parametrize(
    ("kind", "rest", "rows"),
    [
        ("revolute", "", 5),
        ("ball", "", 3),
        ("universal", "<axis2><xyz>1 0 0</xyz></axis2>", 4),
        ("fixed", "", 6),
        ("prismatic", "", 5),
    ],
)
def test_a_second_parent_closes_a_loop_where_the_file_places_it(tmp_path, kind, rest, rows):
    axis = "<xyz>0 1 0</xyz>" if kind not in ("ball", "fixed") else ""
    scene = loaded(tmp_path, FOUR_BAR + joint("d", "rod", "rocker", kind, "0 0 0.3 0.2 0 0", axis, rest))
    assert [c.name for c in scene.constraints] == ["d"]
    assert scene.constraints[0].kind.count == rows
    assert residual(scene, scene.constraints[0], scene.starts["reference"].q) < 1e-15


def test_joints_with_springs_and_damping_stay_in_the_tree(tmp_path):
    """The file names the sprung joint last; the deeper one of those without a spring or damping is cut."""
    first = joint("d", "rod", "rocker", pose="0 0 0.3 0 0 0", axis="<xyz>0 1 0</xyz>")
    spring = "<dynamics><spring_stiffness>3</spring_stiffness></dynamics>"
    last = first.replace("</axis>", f"{spring}</axis>")
    scene = loaded(tmp_path, FOUR_BAR.replace(spring, "") + last)
    assert [c.name for c in scene.constraints] == ["b"]
    sprung = first.replace("</axis>", "<dynamics><friction>1</friction><damping>1</damping></dynamics></axis>")
    cut = "<physics><simbody><must_be_loop_joint>1</must_be_loop_joint></simbody></physics></joint>"
    with pytest.warns(jd.io.NotTakenWarning, match="loops: d"):
        scene = jd.load(write(tmp_path, f"<model name='m'>{sprung.replace('</joint>', cut)}{FOUR_BAR}</model>"))
    assert [c.name for c in scene.constraints] == ["d"]


def test_limits_dynamics_and_springs(tmp_path):
    axis = """<xyz>0 0 1</xyz><limit><lower>-1</lower><upper>1e16</upper><effort>5</effort><velocity>-1</velocity></limit>
    <dynamics><damping>0.2</damping><friction>0.3</friction><spring_stiffness>7</spring_stiffness>
    <spring_reference>0.1</spring_reference></dynamics>"""
    scene = loaded(tmp_path, link("a") + joint("j", "world", "a", axis=axis))
    model = scene.system
    assert model.topology.kinds == ("revolute",)
    assert (float(model.lower[0]), float(model.upper[0])) == (-1, np.inf)
    assert (float(model.effort_limit[0]), float(model.velocity_limit[0])) == (5, np.inf)
    assert [type(force).__name__ for force in scene.forces] == ["JointSpring", "JointDamping", "CoulombFriction"]
    spring, damping, _ = (force(model, jnp.array([0.4]), jnp.array([2.0]), 0.0) for force in scene.forces)
    np.testing.assert_allclose([spring[0], damping[0]], [-7 * 0.3, -0.4], atol=1e-15)


@pytest.mark.parametrize("kind", ["fixed", "revolute"])
def test_mimicked_axes_are_couplings(tmp_path, kind):
    """Followers of fixed joints are held at their offset."""
    mimic = "<xyz>0 0 1</xyz><mimic joint='a'><multiplier>2</multiplier><offset>0.5</offset><reference>0.1</reference></mimic>"
    leader = joint("a", "world", "x", kind, axis="" if kind == "fixed" else "<xyz>0 0 1</xyz>")
    text = link("x") + link("y", "0 0 1 0 0 0") + leader + joint("b", "x", "y", axis=mimic)
    scene = jd.load(write(tmp_path, f"<model name='m'>{text}</model>", "1.11"))
    (constraint,) = scene.constraints
    if kind == "fixed":
        assert isinstance(constraint, JointLock) and scene.not_taken == ()
        np.testing.assert_allclose(constraint.value, [0.5 - 2 * 0.1], rtol=1e-15)
    else:
        gap = constraint.position(scene.system, jnp.array([0.3, 2 * (0.3 - 0.1) + 0.5]), 0.0)
        np.testing.assert_allclose(gap, 0, atol=1e-15)


@pytest.mark.parametrize(("flip", "order"), [(1, ("hub", "in")), (-1, ("hub", "in")), (1, ("in", "hub"))])
def test_gearboxes_couple_the_angles_against_the_reference_body(tmp_path, flip, order):
    """theta_2 = -ratio theta_1 about the gearbox's axes, whichever way the two joints and their axes are given."""
    text = link("hub") + link("in") + link("out") + joint("w", "world", "hub", "fixed", axis="")
    text += joint("i", *order, axis=f"<xyz>0 0 {flip}</xyz>") + joint("o", "hub", "out")
    text += joint("g", "in", "out", "gearbox", rest="<axis2><xyz>0 0 1</xyz></axis2><gearbox_ratio>0.25</gearbox_ratio>"
                  "<gearbox_reference_body>hub</gearbox_reference_body>")  # fmt: skip
    scene = loaded(tmp_path, text)
    model = scene.system
    q = jnp.zeros(2).at[model.joint_names.index("i")].set(0.8)
    (constraint,) = scene.constraints
    follows = -float(constraint.position(model, q, 0.0)[0])  # the gear's row is q_o - ratio q_i
    q = q.at[model.joint_names.index("o")].set(follows)
    computed = poses(scene, q)
    angle = {name: np.arctan2(computed[name][1, 0], computed[name][0, 0]) for name in ("in", "out")}
    np.testing.assert_allclose(angle["out"], -0.25 * angle["in"], atol=1e-15)
    assert abs(abs(angle["in"]) - 0.8) < 1e-15


def test_what_is_not_taken_is_named(tmp_path):
    text = link("a", rest="<gravity>false</gravity><collision name='c'/><sensor name='s' type='imu'/>")
    text += joint("j", "world", "a") + "<plugin name='p' filename='x'/><include><uri>model://cup</uri></include>"
    with pytest.warns(jd.io.NotTakenWarning) as caught:
        scene = jd.load(write(tmp_path, f"<model name='m'>{text}</model>"))
    message = str(caught[0].message)
    for part in ("<collision> of links: a", "<sensor> of links: a", "without gravity", "<plugin> of", "model://cup"):
        assert part in message and any(part in line for line in scene.not_taken)


def model_of(text: str) -> str:
    return f"<model name='m'>\n{text}\n</model>"


BAD = {
    "malformed": ("<model name='m'><link></model>", ":2: malformed XML: mismatched tag"),
    "name": (model_of("<link/>"), ":3: a <link> of m has no name"),
    "twice": (model_of(link("a") + "\n" + link("a")), ":5: the link name 'a' is taken"),
    "no link": ("<model name='m'/>", "no <link>"),
    "type": (model_of(link("a") + joint("j", "world", "a", "revolut")), "did you mean revolute"),
    "unknown link": (model_of(link("arm") + joint("j", "world", "amr")), "frame 'amr' is unknown (did you mean arm?)"),
    "no child": (model_of(link("a") + "<joint name='j' type='fixed'><parent>a</parent></joint>"), "has no <child>"),
    "itself": (model_of(link("a") + joint("j", "a", "a")), "joins 'a' to itself"),
    "pose": (model_of(link("a", "0 0 0")), "<pose> of link 'a' is '0 0 0'; give 6 finite numbers"),
    "nan": (model_of(link("a", "0 0 nan 0 0 0")), "finite"),
    "zero axis": (model_of(link("a") + joint("j", "world", "a", axis="<xyz>0 0 0</xyz>")), "is zero; give a direction"),
    "screw": (model_of(link("a") + joint("j", "world", "a", "screw")), "<screw_thread_pitch> (m per turn)"),
    "mass": (model_of(link("a", rest="<inertial><mass>-1</mass></inertial>")), "must not be negative"),
    "auto": (model_of(link("a", rest="<inertial auto='true'/>")), "computed from its shapes"),
    "number": (model_of(link("a", rest="<inertial><mass>2kg</mass></inertial>")), "<mass> of link 'a' is '2kg'"),
    "circle": (
        model_of("<link name='a'><pose relative_to='b'/></link><link name='b'><pose relative_to='a'/></link>"),
        "in a cycle",
    ),
    "attached": (model_of(link("a") + "<frame name='f' attached_to='g'/><frame name='g' attached_to='f'/>"), "in a cycle"),
    "limits": (
        model_of(link("a") + joint("j", "world", "a", axis="<xyz>0 0 1</xyz><limit><lower>2</lower><upper>1</upper></limit>")),
        "lower limit 2.0 is above upper limit 1.0",
    ),
    "massless": (
        model_of(link("a", rest="<inertial><mass>0</mass><inertia><ixx>0</ixx><iyy>0</iyy><izz>0</izz></inertia></inertial>")
                 + joint("j", "world", "a")),
        "moves no inertia",
    ),
    "gearbox": (
        model_of(link("a") + link("b") + joint("g", "a", "b", "gearbox", rest="<axis2><xyz>0 0 1</xyz></axis2>")),
        "has no <gearbox_reference_body>",
    ),
    "mimic": (model_of(link("a") + joint("j", "world", "a", axis="<xyz>0 0 1</xyz><mimic joint='k'/>")), "is not a joint"),
    "flag": (model_of(link("a", rest="<gravity>maybe</gravity>")), "give true or false"),
    "worlds": (f"<world name='a'>{model_of(link('a'))}</world><world name='b'/>", "several worlds"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD)
def test_bad_files_are_refused_with_file_and_line(tmp_path, fault):
    text, message = BAD[fault]
    with pytest.raises(ValueError) as caught:
        jd.load(write(tmp_path, text))
    assert "robot.sdf" in str(caught.value)
    assert message in str(caught.value), str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot/>", "the root element is <robot>"),
        ("<sdf version='2.0'/>", "the version is '2.0'; 1.4 to 1.12"),
        ("", "malformed XML: no element found"),
        ('<!DOCTYPE s [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><sdf version="1.6">&b;</sdf>', "the entity 'a'"),
        ("<sdf version='1.6'>" + model_of(link("a").replace("pose", "pose frame='b'", 1)) + "</sdf>", "no settled"),
    ],
)
def test_files_of_other_kinds_are_refused(tmp_path, text, message):
    path = tmp_path / "robot.sdf"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError) as caught:
        jd.load(path)
    assert f"{path}:" in str(caught.value)
    assert message in str(caught.value)


def test_a_file_that_is_not_there_is_named():
    with pytest.raises(ValueError, match=r"nowhere\.sdf.*check the path"):
        jd.load("nowhere.sdf")


class Exponentials:
    """An SDF file of version 1.6 by the product of exponentials in world axes, with nothing of the reader's.

    Each joint is a twist in world axes at the file's placement; a link stands at exp(twist_1 q_1) ... times its pose.
    """

    def __init__(self, path, model: jd.Model):
        self.model = model
        root = ElementTree.parse(path).getroot().find("model")
        assert root is not None

        def six(element) -> np.ndarray:
            text = element.findtext("pose")
            values = np.array([float(x) for x in text.split()]) if text else np.zeros(6)
            pose = np.eye(4)
            r, p, y = map(host_math.rotation_matrix, np.eye(3), values[3:])
            pose[:3, :3], pose[:3, 3] = y @ p @ r, values[:3]
            return pose

        self.home = {element.get("name"): six(element) for element in root.findall("link")}
        self.inertia = {}
        for element in root.findall("link"):
            inertial = element.find("inertial")
            pose, mass = six(inertial), float(inertial.findtext("mass"))
            numbers = {k: float(inertial.findtext(f"inertia/{k}")) for k in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")}
            xx, yy, zz, xy, xz, yz = numbers.values()
            moment = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            self.inertia[element.get("name")] = (mass, pose[:3, 3], pose[:3, :3] @ moment @ pose[:3, :3].T)
        self.twists = {}
        carriers = dict(zip(model.frame_names, model.topology.frame_bodies, strict=True))
        for element in root.findall("joint"):
            name = element.get("name")
            if name not in model.joint_names:
                continue
            place = self.home[element.findtext("child")] @ six(element)
            xyz = np.array([float(x) for x in element.findtext("axis/xyz").split()])
            in_model = (element.findtext("axis/use_parent_model_frame") or "0").strip() == "1"
            axis = (np.eye(3) if in_model else place[:3, :3]) @ xyz
            axis = axis / np.linalg.norm(axis)
            # The sign: the outer link is the child, or the tree runs the other way.
            outer = carriers[element.findtext("child")] == model.joint_names.index(name)
            sign = 1.0 if outer else -1.0
            turns = element.get("type") == "revolute"
            v, w = (np.cross(place[:3, 3], axis), axis) if turns else (axis, np.zeros(3))
            self.twists[name] = sign * np.concatenate([v, w])
        self.carriers = carriers

    def dynamics(self, q) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """World poses of the links, mass matrix (nv, nv), gravity force (nv,)."""
        model, top = self.model, self.model.topology
        moved, columns = [], []
        for i, name in enumerate(model.joint_names):
            twist = self.twists[name]
            before = np.eye(4) if top.parents[i] < 0 else moved[top.parents[i]]
            step = np.zeros((4, 4))
            step[:3, :3], step[:3, 3] = host_math.hat(twist[3:]), twist[:3]
            columns.append(host_math.adjoint(before) @ twist)
            moved.append(before @ expm(step * float(q[i])))
        M, gravity, places = np.zeros((model.nv, model.nv)), np.zeros(model.nv), {}
        for name, home in self.home.items():
            body = self.carriers[name]
            places[name] = home if body < 0 else moved[body] @ home
            mass, com, moment = self.inertia[name]
            J = np.array(columns).T * (top.ancestors[body] if body >= 0 else 0.0)
            turn, point = places[name][:3, :3], places[name][:3, :3] @ com + places[name][:3, 3]
            velocity = J[:3] - host_math.hat(point) @ J[3:]
            M += mass * velocity.T @ velocity + J[3:].T @ turn @ moment @ turn.T @ J[3:]
            gravity -= mass * velocity.T @ np.asarray(model.gravity)
        return places, M, gravity


def cassie(robots_dir, name: str) -> Path:
    path = robots_dir / "cassie_description" / "robots" / name
    if not path.exists():
        pytest.skip(f"example-robot-data has no {name}")
    return path


def check_cassie(path: Path, *, dynamics: bool = True) -> jd.io.LoadedScene:
    scene = silent(path, floating_base=False)
    model = scene.system
    q = jnp.asarray(np.random.default_rng(0).normal(size=model.nv))
    exponentials = Exponentials(path, model)
    places, M, gravity = exponentials.dynamics(q)
    computed = poses(scene, q)
    assert max(np.abs(computed[name] - place).max() for name, place in places.items()) < 1e-13
    for name, (mass, com, moment) in exponentials.inertia.items():
        if name in model.body_names:
            expected = host_math.inertia_numbers((mass, com, moment), name)
            np.testing.assert_allclose(model.inertias[model.body_names.index(name)], expected, atol=1e-15)
    if not dynamics:
        return scene
    np.testing.assert_allclose(quick(jd.mass_matrix)(model, q), M, atol=1e-12)
    np.testing.assert_allclose(quick(jd.gravity_force)(model, q), gravity, atol=1e-12)
    return scene


def test_cassie_is_a_tree_of_hinges_closed_by_four_balls(robots_dir):
    path = cassie(robots_dir, "cassie_v2.sdf")
    scene = check_cassie(path, dynamics=False)
    assert scene.nv == 22
    assert [c.joint for c in scene.constraints] == ["spherical"] * 4
    assert max(residual(scene, c, jnp.zeros(22)) for c in scene.constraints) < 1e-14
    free = silent(path)
    assert (free.system.nb, free.nv) == (23, 28)
    np.testing.assert_allclose(free.system.inertias[:, 0].sum(), 32.94, atol=1e-12)
    np.testing.assert_allclose(free.starts["reference"].q[:7], [0, 0, 1.01, 1, 0, 0, 0], atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["cassie_v2.sdf", "cassie.sdf", "cassie_reduced.sdf", "cassie_simple.sdf", "cassie_wo_gearbox_spring.sdf"]
)
def test_dynamics_of_every_cassie(robots_dir, name):
    scene = check_cassie(cassie(robots_dir, name))
    kinds = [getattr(c, "joint", "gear") for c in scene.constraints]
    assert kinds.count("spherical") == 4
    assert kinds.count("gear") == (10 if name == "cassie.sdf" else 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cassie_v2.sdf", "cassie.sdf"])
def test_cassies_loops_close_from_a_rough_guess(robots_dir, name):
    scene = silent(cassie(robots_dir, name))
    rough = jnp.asarray(0.1 * np.random.default_rng(0).normal(size=scene.nv))
    assembly = jd.assemble(scene, jd.integrate(scene.system, scene.starts["reference"].q, rough), throw=False)
    counted = (1 - assembly.dropped) * jd.constraints.position_residual(scene, assembly.q, 0.0)
    assert np.abs(counted).max() < 1e-13
    # Rows that repeat others but for the digits of the file stay open: by 1e-10 m in cassie_v2.sdf.
    assert assembly.gaps.max() < 5e-10
    # The rank that was decided on the way is that of the place, or a code says that the digits hide it.
    motion = jd.constrained_dynamics(scene, assembly.q, jnp.zeros(scene.nv))
    wanted = jd.RESULTS.unclear_rank if name == "cassie.sdf" else jd.RESULTS.successful
    assert assembly.result == motion.result == wanted
    if name == "cassie_v2.sdf":
        assert int(motion.rank) == int((1 - assembly.dropped).sum()) == 10
