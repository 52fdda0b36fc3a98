"""Names and places of joints, payloads, wrenches through joints, degrees of freedom, and one loader for every format."""

import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_bridge import assert_close, quick, random_inertia, random_states, random_tree, to_pinocchio

import jaxdyn as jd

KINDS = ("free", "revolute", "planar", "helical", "spherical", "prismatic", "revolute")
URDF = """<robot name="arm">
  <link name="base"><inertial><mass value="3"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="upper"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tool"><inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="1"/><dynamics damping="0.5"/></joint>
  <joint name="mount" type="fixed"><parent link="upper"/><child link="tool"/><origin xyz="0 0 0.4" rpy="0.1 0.2 0.3"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def tree() -> jd.Model:
    return random_tree(3, KINDS)


@pytest.fixture
def urdf(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    return path


def test_places_of_joints(tree):
    assert (tree.q_index("j1"), tree.v_index("j1")) == (7, 6)
    assert (tree.q_index("j0"), tree.v_index("j4")) == (slice(0, 7), slice(11, 14))
    q = jnp.arange(float(tree.nq))
    assert float(q[tree.q_index("j3")]) == q[tree.topology.q_slices[3]][0]
    with pytest.raises(ValueError, match=r"'j9' .*'tree3'"):
        tree.q_index("j9")


def test_selection_matrix_takes_the_motors(tree):
    S = tree.selection_matrix(["j5", "j4"])
    v = jnp.arange(float(tree.nv))
    np.testing.assert_array_equal(S.T @ v, [v[14], v[11], v[12], v[13]])
    np.testing.assert_array_equal(tree.selection_matrix(), np.eye(tree.nv)[:, 6:])  # all but the floating base
    assert tree.selection_matrix([]).shape == (tree.nv, 0)
    with pytest.raises(ValueError, match="joint once"):
        tree.selection_matrix(["j1", "j1"])
    with pytest.raises(ValueError, match=r"\['j1'\]"):
        tree.selection_matrix("j1")


def test_payload_is_a_body_welded_there():
    own, carried = (random_inertia(np.random.default_rng(k)) for k in range(2))
    pose = np.asarray(jd.se3.exp(jnp.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])))

    def arm(welded):
        builder = jd.ModelBuilder("arm").add_body("upper", axis=(0, 1, 0), inertia=own)
        builder.add_body("lower", "upper", axis=(1, 0, 0), pose=(0, 0, 0.4), inertia=own)
        if welded:
            return builder.add_body("hand", "lower", "fixed", carried, pose=pose).build()
        return builder.add_frame("hand", "lower", pose).build()

    bare, welded = arm(False), arm(True)
    assert_close(bare.with_payload("hand", carried).inertias, welded.inertias, 1e-14)
    parts = jd.inertia.mass_com_inertia(jnp.asarray(carried))
    assert_close(bare.with_payload("hand", parts).inertias, welded.inertias, 1e-13)
    # Batched and traced: the force is linear in the payload, and that is its derivative.
    q, v = jnp.array([0.3, 0.7]), jnp.array([0.5, -0.4])
    force = jax.jit(lambda ten: jd.bias_force(bare.with_payload("hand", ten), q, v))
    scale = jnp.array([0.0, 1.0, 2.0])
    computed = jax.vmap(lambda s: force(s * carried))(scale)
    assert_close(computed[1], jd.bias_force(welded, q, v))
    assert_close(computed[2] - computed[0], 2 * (computed[1] - computed[0]))
    assert_close(jax.jacfwd(lambda s: force(s * carried))(0.3), computed[1] - computed[0])


def test_payload_refuses(tree):
    bare = jd.ModelBuilder().add_body("a", inertia=random_inertia(np.random.default_rng(0))).add_frame("lab").build()
    with pytest.raises(ValueError, match="'lab' is fixed"):
        bare.with_payload("lab", np.ones(10))
    with pytest.raises(ValueError, match=r"\(4, 10\).*jax.vmap"):
        tree.with_payload("f1", np.ones((4, 10)))
    with pytest.raises(ValueError, match=r"\[\(\), \(2,\), \(3, 3\)\]"):
        tree.with_payload("f1", (1.0, np.ones(2), np.eye(3)))


def test_wrench_through_joints_is_that_of_pinocchio(tree, mode):
    theirs, bridge = to_pinocchio(tree)
    data = theirs.createData()
    states = random_states(tree, 3, 0)
    wrenches = jax.jit(jax.vmap(lambda q, v, a, pull: jd.dynamics.joint_wrench(tree, q, v, a, external=pull)))(
        *states[:3], states[4]
    )
    for k in range(3):
        q, v, a, _, pulls = (np.asarray(x[k]) for x in states)
        offsets = [pin.SE3(offset[:3, :3], offset[:3, 3]) for offset in bridge.offsets]
        outer = pin.StdVec_Force(
            [pin.Force.Zero(), *(o.act(pin.Force(w)) for o, w in zip(offsets, pulls, strict=True))]
        )
        pin.rnea(theirs, data, bridge.q_to_pinocchio(q), v, a, outer)
        wanted = [o.actInv(f).vector for o, f in zip(offsets, list(data.f)[1:], strict=True)]
        assert_close(wrenches[k], wanted)


def test_part_of_the_wrench_along_the_joint_is_its_force():
    tree = random_tree(3, KINDS[:5])  # all kinds but one that slides
    q, v, a, _, pulls = (x[0] for x in random_states(tree, 1, 1))

    @quick
    def compute(q, v, a):
        wrenches, one, world = (
            jd.dynamics.joint_wrench(tree, q, v, a, *name, external=pulls, axes=axes)
            for name, axes in (((), "body"), (("j4",), "body"), ((), "world"))
        )
        tau = jd.inverse_dynamics(tree, q, v, a, external=pulls) - tree.armature * a
        jacobians = [jd.body_jacobian(tree, q, name) for name in tree.body_names]
        turns = jd.forward_kinematics(tree, q)[:, :3, :3]
        return tau, wrenches, one, world, jacobians, turns

    tau, wrenches, one, world, jacobians, turns = jax.tree.map(np.asarray, compute(q, v, a))
    for i, place in enumerate(tree.topology.v_slices):
        # The joint's own columns of the body Jacobian are its motion subspace.
        assert_close(jacobians[i][:, place].T @ wrenches[i], tau[place])
        assert_close(world[i], np.concatenate([turns[i] @ wrenches[i, :3], turns[i] @ wrenches[i, 3:]]))
    assert_close(one, wrenches[4])
    with pytest.raises(ValueError, match="axes is 'frame'"):
        jd.dynamics.joint_wrench(tree, q, v, a, axes="frame")


@pytest.mark.parametrize("name", ["four_bar", "rolling_coin", "bennett"])
def test_wrenches_of_constraints_on_bodies(name):
    """They do on the coordinates what the constraints do; undriven joints of a loop then bear nothing along their axes."""
    make = getattr(jd.scenes, name)
    scene = make()
    q, v = make.start()

    @quick
    def compute(q, v):
        dynamics = jd.constrained_dynamics(scene, q, v)
        pulls = jd.constraints.body_wrenches(scene, q, dynamics.multipliers)
        forces = sum(jd.constraint_forces(scene, q, dynamics.multipliers).values())
        wrenches = jd.dynamics.joint_wrench(scene.system, q, v, dynamics.acceleration, external=pulls)
        jacobians = [jd.body_jacobian(scene.system, q, name) for name in scene.system.body_names]
        return jd.dynamics.generalized_force(scene.system, q, pulls), forces, wrenches, jacobians

    pulled, forces, wrenches, jacobians = jax.tree.map(np.asarray, compute(q, v))
    assert_close(pulled, forces)
    for i, place in enumerate(scene.system.topology.v_slices):
        own = jacobians[i][:, place]
        assert np.abs(own.T @ wrenches[i]).max() < 1e-9 * max(1.0, float(np.abs(wrenches).max()))


@pytest.mark.parametrize(
    ("name", "freedom"),
    [("four_bar", 1), ("bennett", 1), ("rolling_coin", 3), pytest.param("chaplygin_sleigh", 2, marks=pytest.mark.slow)],
)
def test_degrees_of_freedom(name, freedom):
    make = getattr(jd.scenes, name)
    scene, q = make(), make.start()[0]
    computed = jd.degrees_of_freedom(scene, q)
    assert computed == freedom and isinstance(computed, int)
    assert freedom == scene.nv - np.linalg.matrix_rank(jd.constraint_jacobian(scene, q), tol=1e-8)
    traced = jax.jit(jax.vmap(lambda q: jd.degrees_of_freedom(scene, q)))(jnp.stack([q, q]))
    np.testing.assert_array_equal(traced, [freedom, freedom])
    assert jd.degrees_of_freedom(scene.system, q) == scene.nv


def test_a_flat_parallelogram_has_a_freedom_more():
    rod = jd.inertia.displaced(jd.inertia.rod(1.0, 1.0, "x"), (0.5, 0, 0))
    builder = jd.ModelBuilder("parallelogram").add_body("crank", inertia=rod)
    builder.add_body("rocker", pose=(1, 0, 0), inertia=rod)
    builder.add_body("bar", "crank", pose=(1, 0, 0), inertia=rod)
    scene = jd.Scene(builder.build(), [jd.loop("bar", (1, 0, 0), "rocker", (1, 0, 0))])
    # Order of q: bar, crank, rocker stand as the builder sorts them; angles of the open and of the flat position.
    at = {name: scene.system.q_index(f"{name}_joint") for name in ("crank", "rocker", "bar")}

    def place(angle):
        q = jnp.zeros(3).at[at["crank"]].set(angle).at[at["rocker"]].set(angle)
        return q.at[at["bar"]].set(-angle)

    assert jd.degrees_of_freedom(scene, place(0.7)) == 1
    assert jd.degrees_of_freedom(scene, place(0.0)) == 2


def test_fixed_joints_name_frames(urdf):
    model = jd.load_model(urdf)
    q = jnp.array([0.4])
    np.testing.assert_array_equal(jd.frame_pose(model, q, "mount"), jd.frame_pose(model, q, "tool"))
    np.testing.assert_array_equal(jd.body_jacobian(model, q, "shoulder"), jd.body_jacobian(model, q, "upper"))
    theirs = pin.buildModelFromUrdf(str(urdf))
    data = theirs.createData()
    pin.framesForwardKinematics(theirs, data, np.asarray(q))
    wanted = data.oMf[theirs.getFrameId("mount", pin.FrameType.FIXED_JOINT)].homogeneous
    assert_close(jd.frame_pose(model, q, "mount"), wanted)
    both = jd.join(model, model, prefix=("a_", "b_"))
    assert_close(jd.frame_pose(both, jnp.array([0.4, 0.1]), "a_mount"), wanted)
    with pytest.raises(ValueError, match=r"'mount' .*no coordinates"):
        model.v_index("mount")
    with pytest.raises(ValueError, match="did you mean mount"):
        jd.frame_pose(model, q, "mont")


def test_load_takes_every_format(urdf, tmp_path, monkeypatch):
    scene = jd.load(urdf)
    assert isinstance(scene, jd.io.LoadedScene) and scene.system.joint_names == ("shoulder",)
    assert float(scene.applied_force(jnp.zeros(1), jnp.ones(1))[0]) == -0.5
    assert jd.load(urdf, floating_base=True).system.nv == 7
    mjcf = '<mujoco><worldbody><body name="b"><joint name="j"/><geom size="1"/></body></worldbody></mujoco>'
    for name, text in (("a.xml", URDF), ("b.xml", mjcf), ("c.mjcf", mjcf)):
        (tmp_path / name).write_text(text)
    assert jd.load(tmp_path / "a.xml").system.joint_names == ("shoulder",)
    with pytest.warns(jd.io.NotTakenWarning):
        assert jd.load(tmp_path / "b.xml").system.joint_names == ("j",)
    with pytest.raises(ValueError, match=r"floating_base .*MJCF"):
        jd.load(tmp_path / "c.mjcf", floating_base=True)
    with pytest.raises(ValueError, match=r"x\.step: .*known format"):
        jd.load("x.step")
    with pytest.raises(ValueError, match=r"gone\.xml' .*No such"):
        jd.load(tmp_path / "gone.xml")
    # A name of robot_descriptions, whose module says where the file is; nothing is fetched here.
    fake = types.ModuleType("robot_descriptions.go2_description")
    fake.URDF_PATH = str(urdf)
    pytest.importorskip("robot_descriptions", reason="robot_descriptions is not installed")
    monkeypatch.setitem(sys.modules, fake.__name__, fake)
    assert jd.load("go2_description").system.name == "arm"
    with pytest.raises(ValueError, match="did you mean go2_desc"):
        jd.load("go2_descriptio")


def test_one_motion_of_a_batch_is_a_log(tmp_path):
    model = jd.ModelBuilder().add_body("a", inertia=np.ones(10)).build()
    starts = jnp.array([[0.1], [0.2]])
    ts = jnp.linspace(0.0, 0.1, 3)
    motion = jax.vmap(lambda q: jd.simulate(model, q, jnp.zeros(1), ts, outputs=("torque",)))(starts)
    for name in ("motions.csv", "motions.npz"):
        getattr(motion, f"to_{name[-3:]}")(tmp_path / name, model)
        log = jd.read_log(tmp_path / name, rollout=2)
        np.testing.assert_array_equal(log.q, motion.q[1])
        np.testing.assert_array_equal(log.tau, motion.torque[1])
        with pytest.raises(ValueError, match=r"2 motions; .*rollout=1"):
            jd.read_log(tmp_path / name)
        with pytest.raises(ValueError, match="rollout is 3"):
            jd.read_log(tmp_path / name, rollout=3)
