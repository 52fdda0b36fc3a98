"""Loops of URDF files: a YAML file beside them, and `<gazebo>` elements; against Pinocchio and against loops made by hand."""

import warnings

import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
import scipy.linalg
import scipy.optimize

import jaxdyn as jd

INERTIAL = """<inertial><origin xyz="{x} 0.01 {z}"/><mass value="1.3"/>
<inertia ixx="0.02" iyy="0.03" izz="0.025" ixy="0.001" ixz="0" iyz="0"/></inertial>"""
LIMIT = '<limit lower="-2" upper="2" effort="9" velocity="9"/>'
# A crank of 0.3 m, a rod of 0.8 m and a rocker that meets the rod's end where all angles are zero. The rod's end, "tip_A", is
# fixed, or turns on the joint "d".
BARS = f"""<robot name="bars"><link name="base"/>
<link name="crank">{INERTIAL.format(x=0, z=0.15)}</link><link name="rod">{INERTIAL.format(x=0.4, z=0)}</link>
<link name="rocker">{INERTIAL.format(x=0.05, z=0.15)}</link>
<link name="tip_A">{INERTIAL.format(x=0, z=0)}</link><link name="tip_B"/>
<joint name="a" type="revolute">
  <parent link="base"/><child link="crank"/><axis xyz="0 1 0"/>{LIMIT}</joint>
<joint name="b" type="revolute">
  <origin xyz="0 0 0.3"/><parent link="crank"/><child link="rod"/><axis xyz="0 1 0"/>{LIMIT}</joint>
<joint name="c" type="revolute">
  <origin xyz="0.7 0 0"/><parent link="base"/><child link="rocker"/><axis xyz="0 1 0"/>{LIMIT}</joint>
<joint name="d" type="fixed"><origin xyz="0.8 0 0"/><parent link="rod"/><child link="tip_A"/><axis xyz="0 1 0"/>{LIMIT}</joint>
<joint name="e" type="fixed"><origin xyz="0.1 0 0.3" rpy="0 TURN 0"/><parent link="rocker"/><child link="tip_B"/></joint>
EXTRA</robot>"""
YAML = "closed_loop: [['tip_A', 'tip_B']]\ntype: ['{}']\n"


def write(tmp_path, yaml: str | None = None, extra: str = "", turn: float = 0.0, name: str = "bars"):
    path = tmp_path / f"{name}.urdf"
    path.write_text(BARS.replace("EXTRA", extra).replace("TURN", str(turn)), encoding="utf-8")
    if yaml is not None:
        path.with_suffix(".yaml").write_text(yaml, encoding="utf-8")
    return path


def null_space(rows) -> np.ndarray:
    """The projector on what the rows leave."""
    free = scipy.linalg.null_space(np.asarray(rows), rcond=1e-9)
    return free @ free.T


@pytest.mark.long
@pytest.mark.parametrize("kind", ["3d", pytest.param("6D", marks=pytest.mark.slow)])
def test_rows_and_accelerations_are_pinocchios(tmp_path, kind):
    """The null space of Pinocchio's rows, and the accelerations of M a + h = tau within it, at rest."""
    path = write(tmp_path, YAML.format(kind), turn=0.3)
    if kind == "6D":
        path.write_text(path.read_text().replace('name="d" type="fixed"', 'name="d" type="revolute"'))
    scene = jd.load(path)
    (row,) = scene.constraints
    assert (row.name, row.joint) == ("tip_A-tip_B", {"3d": "spherical", "6D": "weld"}[kind])
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    assert scene.system.joint_names == tuple(model.names)[1:]

    def gap(q):
        pin.framesForwardKinematics(model, data, q)
        first, second = (data.oMf[model.getFrameId(name)] for name in ("tip_A", "tip_B"))
        return pin.log6(first.actInv(second)).vector[: int(kind[0])]

    tolerances = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
    q = scipy.optimize.least_squares(gap, np.array([0.2, -0.1, 0.15, 0.1])[: model.nv], **tolerances).x
    assert np.abs(q).max() > 0.1 and np.abs(gap(q)).max() < 1e-14
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    first, second = (
        pin.getFrameJacobian(model, data, model.getFrameId(name), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        for name in ("tip_A", "tip_B")
    )
    jacobian = (first - second)[: int(kind[0])]  # the frames coincide
    free = scipy.linalg.null_space(jacobian, rcond=1e-9)
    assert free.shape[1] == 1
    ours = jd.constraint_jacobian(scene, jnp.asarray(q))
    np.testing.assert_allclose(null_space(ours), free @ free.T, atol=1e-12)
    tau = np.array([0.3, -0.2, 0.5, 0.1])[: model.nv]
    M, h = pin.crba(model, data, q), pin.rnea(model, data, q, 0 * tau, 0 * tau)
    M = np.triu(M) + np.triu(M, 1).T
    expected = free @ np.linalg.solve(free.T @ M @ free, free.T @ (tau - h))
    dynamics = jd.constrained_dynamics(scene, jnp.asarray(q), jnp.zeros(model.nv), jnp.asarray(tau)).acceleration
    np.testing.assert_allclose(dynamics, expected, atol=1e-10)


def test_a_6d_loop_closes_where_the_frames_coincide(tmp_path):
    scene = jd.load(write(tmp_path, YAML.format("6d")))
    np.testing.assert_allclose(jd.constraints.position_residual(scene, jnp.zeros(3), jnp.asarray(0.0)), 0.0, atol=1e-15)


def test_balls_held_joints_and_motors(tmp_path):
    yaml = YAML.format("3d") + "name_mot: [a]\njoint_name: [b, c]\njoint_type: [SPHERICAL, FIXED]\n"
    path = write(tmp_path, yaml)
    scene = jd.load(path)
    model = scene.system
    assert dict(zip(model.joint_names, model.topology.kinds, strict=True)) == {"a": "revolute", "b": "spherical"}
    np.testing.assert_allclose(model.home[1][:3, 3], [0, 0, 0.3])
    assert "rocker" in model.frame_names
    assert scene.actuators.names == ("a",)
    tau = scene.actuators(model, jd.neutral(model), jnp.zeros(4), jnp.array([2.5]))
    np.testing.assert_array_equal(tau, [2.5, 0, 0, 0])
    np.testing.assert_allclose(
        jd.constraints.position_residual(scene, jd.neutral(model), jnp.asarray(0.0)), 0.0, atol=1e-15
    )


def test_the_yaml_file_is_named_or_left_out(tmp_path):
    path = write(tmp_path, YAML.format("3d"))
    assert not jd.load(path, loops=False).constraints
    other = tmp_path / "other.yml"
    other.write_text("closed_loop: [[tip_A, b]]\ntype: 3d\n", encoding="utf-8")  # the joint b stands for the rod
    (row,) = jd.load(path, loops=other).constraints
    assert (row.body_a, row.body_b) == ("tip_A", "rod")
    path.with_suffix(".yaml").write_text("colour: &a red\nother: *a\n", encoding="utf-8")  # about something else
    assert not jd.load(path).constraints
    path.with_suffix(".yaml").write_text("{", encoding="utf-8")
    assert not jd.load(path).constraints


def gazebo(kind: str, rest: str = "", child: str = "rocker") -> str:
    return f"""<gazebo><joint name="close" type="{kind}"><parent>rod</parent><child>{child}</child>
    <pose>0.1 0 0.3 0 0 0.4</pose>{rest}</joint></gazebo>"""


@pytest.mark.parametrize(
    ("kind", "loop", "axes", "rows"),
    [
        ("revolute", "revolute", "<axis><xyz>0.3 1 0.2</xyz></axis>", 5),
        ("ball", "spherical", "", 3),
        ("fixed", "weld", "", 6),
        ("prismatic", "prismatic", "<axis><xyz>1 0 0</xyz></axis>", 5),
        ("universal", "universal", "<axis><xyz>0 1 0</xyz></axis><axis2><xyz>1 0 0</xyz></axis2>", 4),
    ],
)
def test_joints_in_gazebo_elements_close_loops(tmp_path, kind, loop, axes, rows):
    """Against the same loop made by hand: its frames coincide at zero, z of each along its axis."""
    scene = jd.load(write(tmp_path, extra=gazebo(kind, axes)))
    (row,) = scene.constraints
    assert (row.name, row.joint, row.body_a, row.body_b) == ("close", loop, "rod", "rocker")
    turn = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])

    def frame(axis):
        """Any frame with z along an axis given in the joint's."""
        z = turn @ (np.array(axis) / np.linalg.norm(axis))
        x = np.cross([0.1, 0.2, 0.97], z)
        x /= np.linalg.norm(x)
        return np.column_stack([x, np.cross(z, x), z])

    first = {"revolute": (0.3, 1, 0.2), "prismatic": (1, 0, 0), "universal": (0, 1, 0)}.get(kind, (0, 0, 1))
    turns = [frame(first), frame((1, 0, 0) if kind == "universal" else first)]
    poses = [np.eye(4), np.eye(4)]
    for pose, R, p in zip(poses, turns, [(0.8, 0, 0), (0.1, 0, 0.3)], strict=True):
        pose[:3, :3], pose[:3, 3] = R, p
    by_hand = jd.Scene(scene.system, [jd.loop("rod", poses[0], "rocker", poses[1], loop)])
    residual = jd.constraints.position_residual(scene, jnp.zeros(3), jnp.asarray(0.0))
    assert residual.shape == (rows,)
    np.testing.assert_allclose(residual, 0.0, atol=1e-15)
    q = jnp.array([0.2, -0.3, 0.1])
    ours, theirs = (np.asarray(jd.constraint_jacobian(s, jnp.zeros(3))) for s in (scene, by_hand))
    np.testing.assert_allclose(null_space(ours), null_space(theirs), atol=1e-12)
    open_by = [
        float(np.linalg.norm(jd.constraints.position_residual(s, q, jnp.asarray(0.0))[:3])) for s in (scene, by_hand)
    ]
    if kind not in ("prismatic", "universal"):
        np.testing.assert_allclose(*open_by, rtol=1e-12)


def plugin(leader: str, follower: str, multiplier: float = 2.0, offset: float = 0.3) -> str:
    return f"""<gazebo><plugin name="m" filename="mimic.so"><joint>{leader}</joint><mimicJoint>{follower}</mimicJoint>
    <multiplier>{multiplier}</multiplier><offset>{offset}</offset></plugin></gazebo>"""


def test_mimicking_plugins_are_couplings(tmp_path):
    (row,) = jd.load(write(tmp_path, extra=plugin("a", "c", -0.5, 0.2))).constraints
    assert (row.joint_a, row.joint_b, float(row.ratio), float(row.offset)) == ("c", "a", -0.5, 0.2)


def test_plugins_that_mimic_fixed_joints(tmp_path):
    """A follower of a fixed joint is held at its offset, a fixed follower stays; with the options of the loader."""
    fixed = '<joint name="still" type="fixed"><parent link="rod"/><child link="end"/></joint><link name="end"/>'
    free = jd.load(write(tmp_path)).system
    held = jd.load(write(tmp_path, extra=fixed + plugin("still", "c"))).system
    assert set(free.joint_names) - set(held.joint_names) == {"c"}
    reference = jd.load_model(tmp_path / "bars.urdf", lock={"c": 0.3})
    np.testing.assert_allclose(held.frame_poses, reference.frame_poses, atol=1e-15)
    still = jd.load(write(tmp_path, extra=fixed + plugin("c", "still")))
    assert still.constraints == () and still.system.nv == free.nv
    follows = jd.load(write(tmp_path, extra=plugin("a", "c")), lock={"a": 0.1}).system
    reference = jd.load_model(tmp_path / "bars.urdf", lock={"a": 0.1, "c": 0.5})
    np.testing.assert_allclose(follows.home, reference.home, atol=1e-15)
    assert jd.load(tmp_path / "bars.urdf", mimic="ignore").constraints == ()
    with pytest.raises(ValueError, match=r"bars.urdf:\d+: .*'z'.*lock=.*mimic='ignore'"):
        jd.load(write(tmp_path, extra=plugin("z", "c")))
    assert jd.load(tmp_path / "bars.urdf", lock={"c": 0.3}).system.nv == free.nv - 1
    with pytest.raises(ValueError, match=r"bars.urdf:\d+: .*'a' already"):
        jd.load(write(tmp_path, extra=plugin("a", "c") + plugin("b", "c")))
    with pytest.raises(ValueError, match=r"'couple', but .*MJCF"):
        (tmp_path / "b.mjcf").write_text("<mujoco/>")
        jd.load(tmp_path / "b.mjcf", mimic="couple")


def test_what_of_the_conventions_is_not_taken_is_named(tmp_path):
    yaml = "closed_loop: []\ntype: []\njoint_name: [b]\njoint_type: [CARDAN]\n"
    damped = "<axis><xyz>0 1 0</xyz><dynamics><damping>1</damping></dynamics></axis>"
    extra = gazebo("revolute", damped) + gazebo("gearbox").replace('"close"', '"box"')
    with pytest.warns(jd.io.NotTakenWarning) as caught:
        scene = jd.load(write(tmp_path, yaml, extra))
    for part in ("b (CARDAN)", "box (gearbox)", "damping of <gazebo> joints: close"):
        assert part in str(caught[0].message)
    assert len(scene.not_taken) == 3


@pytest.mark.parametrize(
    ("yaml", "words"),
    [
        ("closed_loop: [[tip_A]]\ntype: [3d]\n", ("bars.yaml", "closed_loop", "pairs of frames")),
        ("closed_loop: [[tip_A, tip_C]]\ntype: [3d]\n", ("bars.yaml", "tip_C", "tip_B")),
        ("closed_loop: [[tip_A, tip_B]]\ntype: [4d]\n", ("tip_A, tip_B", "'4d'", "3d or 6d")),
        ("closed_loop: [[tip_A, tip_B]]\ntype: []\n", ("type has 0 entries, closed_loop 1",)),
        ("closed_loop: []\nname_mot: [x]\n", ("name_mot", "'x'")),
        ("closed_loop: []\njoint_name: [b]\n", ("joint_name has 1 entries, joint_type 0",)),
        ("closed_loop: []\njoint_name: [d]\njoint_type: [SPHERICAL]\n", ("bars.urdf", "'d'", "moves")),
        ("closed_loop: &a [[tip_A, tip_B]]\ntype: [3d]\nname_mot: *a\n", ("bars.yaml", "aliases", "refused")),
        ("closed_loop: []\nname_mot: 3\n", ("name_mot is 3", "list of names")),
        ("name_mot: [b]\njoint_name: [b]\njoint_type: [SPHERICAL]\n", ("'b' is spherical",)),
    ],
)
def test_bad_yaml_files(tmp_path, yaml, words):
    with pytest.raises(ValueError) as caught:
        jd.load(write(tmp_path, yaml))
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (gazebo("ball", child="nowhere"), ("bars.urdf:", "'close'", "nowhere")),
        (gazebo("revolute", "<axis><xyz>0 0 0</xyz></axis>"), ("bars.urdf:", "zero")),
        (gazebo("revolute", "<axis><xyz expressed_in='rod'>0 0 1</xyz></axis>"), ("expressed in 'rod'",)),
        (gazebo("ball").replace("<pose>", "<pose relative_to='rod'>"), ("relative to 'rod'",)),
        (gazebo("ball").replace("<parent>rod</parent>", ""), ("no <parent>",)),
    ],
)
def test_bad_gazebo_elements(tmp_path, extra, words):
    with pytest.raises(ValueError) as caught:
        jd.load(write(tmp_path, extra=extra))
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_bad_loops_arguments(tmp_path):
    path = write(tmp_path)
    with pytest.raises(ValueError, match=r"nowhere\.yaml cannot be read"):
        jd.load(path, loops=tmp_path / "nowhere.yaml")
    with pytest.raises(ValueError, match="loops is True"):
        jd.load(path, loops=True)
    empty = tmp_path / "empty.yaml"
    empty.write_text("a: 1", encoding="utf-8")
    with pytest.raises(ValueError, match="names no loops"):
        jd.load(path, loops=empty)
    empty.write_text("[", encoding="utf-8")
    with pytest.raises(ValueError, match="malformed YAML"):
        jd.load(path, loops=empty)
    sdf = tmp_path / "x.sdf"
    sdf.write_text("<sdf version='1.7'/>", encoding="utf-8")
    with pytest.raises(ValueError, match="is SDF"):
        jd.load(sdf, loops=empty)


def test_loops_that_cannot_close_are_named_with_their_gap(tmp_path):
    """The rocker's end moved out of reach: rod and rocker end 3.16 m or more apart less their reach."""
    path = write(tmp_path, YAML.format("3d"))
    path.write_text(path.read_text().replace('xyz="0.7 0 0"', 'xyz="4 0 0"'))
    scene = jd.load(path)
    with warnings.catch_warnings(), pytest.raises(ValueError, match=r"tip_A-tip_B.*\d"):
        warnings.simplefilter("error")
        jd.assemble(scene, scene.starts["reference"].q, guesses=2)
