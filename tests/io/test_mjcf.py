"""MJCF files against MuJoCo itself: frames, masses, dynamics, springs, actuators and constraints."""

import importlib.util
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from loading import silent
from mujoco_bridge import APART, Oracle, agreement

import jaxdyn as jd

MIXED = """
<mujoco model="mixed">
  <compiler angle="radian"/>
  <option gravity="0.3 -0.2 -9.7"/>
  <default><joint armature="0.01" damping="0.2"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="base" pos="0.1 0.2 1" euler="0.1 0.2 0.3">
      <freejoint name="root"/>
      <inertial pos="0.01 0.02 0.03" mass="3" fullinertia="0.03 0.04 0.05 0.001 0.002 0.003"/>
      <site name="imu" pos="0.1 0 0.2" euler="0.3 0 0.2"/>
      <body name="arm" pos="0.3 0.1 0" quat="0.9 0.1 0.2 0.3">
        <joint name="z" axis="0.2 0.3 1" pos="0.05 -0.1 0.02" ref="0.4" stiffness="3" springref="0.2"/>
        <joint name="a" type="slide" axis="1 1 0" ref="-0.1" frictionloss="0.3"/>
        <joint name="m" axis="1 0 0" pos="0 0.2 0" range="-1 2" limited="true" actuatorfrcrange="-2 1"/>
        <geom type="capsule" fromto="0 0 0 0.2 0.1 0.3" size="0.04"/>
        <body pos="0.2 0 0.1">
          <joint type="ball" pos="0.02 0.03 -0.04" damping="0.1" stiffness="2"/>
          <geom type="box" size="0.1 0.05 0.07" pos="0.1 0 0"/>
        </body>
        <body name="imu" pos="0 0.3 0"><geom size="0.05"/></body>
      </body>
    </body>
    <body name="rod" pos="1 0 0">
      <joint name="r" axis="0 1 0" ref="0.3"/><geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="t" stiffness="4" damping="0.3" springlength="0.1 0.3">
      <joint joint="z" coef="0.7"/><joint joint="r" coef="-1.2"/>
    </fixed>
    <fixed name="u"><joint joint="a" coef="1"/></fixed>
    <spatial name="cord" stiffness="3"><site site="imu"/><site site="imu2"/></spatial>
  </tendon>
  <equality>
    <connect name="c" body1="imu" anchor="0.1 0 -0.4" body2="rod"/>
    <weld name="w" body1="imu" body2="rod"/>
    <joint name="j" joint1="m" joint2="r" polycoef="0.1 0.5"/>
    <joint name="cubic" joint1="m" joint2="r" polycoef="0.1 0.5 0.3 -0.2"/>
    <joint name="held" joint1="z" polycoef="0.1"/>
    <tendon name="tt" tendon1="t" tendon2="u" polycoef="0.1 0.5 0.3"/>
    <joint name="off" joint1="z" active="false"/>
  </equality>
  <actuator>
    <motor name="m1" joint="z" gear="3" ctrlrange="-1 1" ctrllimited="true" armature="0.02"/>
    <position name="p1" joint="m" kp="20" kv="1" forcerange="-3 3" forcelimited="true"/>
    <motor name="tm" tendon="t" gear="2"/>
    <motor name="thrust" site="imu" gear="0 0 1 0.1 0 0.2"/>
    <damper name="d" joint="a" kv="2" ctrlrange="0 1"/>
    <intvelocity name="stateful" joint="a" kp="2" actrange="-1 1"/>
    <muscle name="muscle" joint="a" lengthrange="0 1"/>
  </actuator>
  <keyframe>
    <key name="home" qpos="0 0 1 0.7 0.7 0 0.1 .1 .2 .3 1 0.1 0 0 .6" qvel="1 2 3 4 5 6 .1 .2 .3 .4 .5 .6 .8"
         ctrl="1 2 3 4 5 6 7" act="0.4 0"/>
  </keyframe>
</mujoco>
""".replace("</worldbody>", '<site name="imu2" pos="0 0 2"/></worldbody>')
BODY = '<body name="b"><joint name="h" axis="0 1 0"/><geom name="g" size="0.1" pos="0 0 -1"/></body>'


TWINS = BODY.replace("<geom", '<joint name="twin" axis="0 1 0"/><geom')


def write(tmp_path, text: str) -> Path:
    path = tmp_path / "robot.xml"
    path.write_text(text, encoding="utf-8")
    return path


def of_body(tmp_path, body: str = BODY, rest: str = "", name: str = "small") -> Path:
    return write(tmp_path, f'<mujoco model="{name}"><worldbody>{body}</worldbody>{rest}</mujoco>')


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    path = write(tmp_path_factory.mktemp("mjcf"), MIXED)
    return path, silent(path)


@pytest.mark.long
def test_every_kind_of_joint_and_part_agrees_with_mujoco(mixed):
    """Free, ball, three joints on one body, references, anchors, inertial frames, tendons, drives, equalities."""
    errors = agreement(*mixed)
    parts = {"mass", "M", "bias", "acceleration", "frames", "passive", "actuation", "activation", "rows"}
    assert parts == errors.keys()
    assert max(errors.values()) < 1e-12, errors


def test_names_of_bodies_joints_and_frames(mixed):
    _, scene = mixed
    model = scene.system
    assert model.name == "mixed"
    assert model.joint_names == ("r", "root", "z", "a", "m", "body3_joint")
    assert model.body_names == ("rod", "base", "arm_z", "arm_a", "arm_m", "body3_joint")
    assert {"arm", "imu", "imu_site", "imu2", "body3"} <= set(model.frame_names)
    assert [constraint.name for constraint in scene.constraints] == ["c", "w", "j", "cubic", "held", "tt"]
    kinds = [type(force).__name__ for force in scene.forces]
    assert kinds == ["JointSpring", "JointDamping", "CoulombFriction", "TendonForce"]
    np.testing.assert_allclose(model.gravity, [0.3, -0.2, -9.7])
    np.testing.assert_allclose(model.armature[model.topology.v_slices[2]], 0.01 + 9 * 0.02)
    np.testing.assert_allclose(model.lower[model.topology.q_slices[4]], -1)
    assert np.isinf(np.asarray(model.lower[model.topology.q_slices[2]]))


def test_keyframes_are_starts_in_our_coordinates(mixed):
    path, scene = mixed
    oracle, start = Oracle(path, scene.system), scene.starts["home"]
    key = oracle.m.key("home")
    T, _ = oracle.rotation(key.qpos, np.asarray(start.v))
    np.testing.assert_allclose(np.asarray(start.q)[oracle.to_q], key.qpos, atol=1e-15)
    np.testing.assert_allclose(T @ np.asarray(start.v)[oracle.to_v], key.qvel, atol=1e-14)
    assert scene.actuators.names == ("m1", "p1", "tm", "thrust", "d", "stateful")
    np.testing.assert_array_equal(start.control, [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(start.activation, [0.4])
    np.testing.assert_allclose(np.asarray(scene.starts["reference"].q)[oracle.to_q], oracle.m.qpos0, atol=1e-15)


def test_what_is_not_taken_is_named_by_a_warning(mixed):
    path, scene = mixed
    with pytest.warns(jd.io.NotTakenWarning) as caught:
        jd.load(path)
    assert len(caught) == 1
    text = str(caught[0].message)
    for part in ("robot.xml", "muscles: muscle", "geometry of bodies: world, arm", "spatial tendons: cord", "off"):
        assert part in text
    assert all(line in text for line in scene.not_taken)


def test_a_file_without_anything_else_warns_of_nothing(tmp_path):
    body = BODY.replace("<geom ", '<geom contype="0" conaffinity="0" ')
    scene = jd.load(of_body(tmp_path, body, '<option><flag gravity="disable"/></option>'))
    assert scene.system.gravity is None
    assert scene.constraints == scene.forces == scene.not_taken == ()
    assert scene.actuators is None
    assert scene.system.body_names == ("b",)  # an axis through the body's origin needs no body in between


def test_an_anchor_along_the_axis_needs_no_body_in_between(tmp_path):
    body = BODY.replace("axis", 'pos="0 0.3 0" axis')
    assert silent(of_body(tmp_path, body)).system.body_names == ("b",)


def test_equalities_with_the_world_with_sites_and_within_a_body(tmp_path):
    body = f"""
    <body name="mocap" mocap="true" pos="0 0 1"/><site name="s" pos="0.3 0 0" euler="30 0 0"/>
    {BODY.replace("</body>", '<site name="t" pos="0.1 0.2 0"/><body name="tip"><geom size="0.1"/></body></body>')}
    """
    rest = """<equality>
    <weld name="to mocap" body1="mocap" body2="b"/><weld name="to site" site1="s" site2="t"/>
    <connect name="to world" body1="b" anchor="0 0 0.1"/><weld name="inside" body1="b" body2="tip"/>
    <weld name="point" body1="b" torquescale="0"/>
    </equality>"""
    path = of_body(tmp_path, body, rest)
    scene = silent(path)
    assert [(c.name, c.joint) for c in scene.constraints] == [
        ("to mocap", "weld"),
        ("to site", "weld"),
        ("to world", "spherical"),
        ("point", "spherical"),
    ]
    assert any("inside" in line for line in scene.not_taken)
    assert any("mocap bodies" in line for line in scene.not_taken)
    q = scene.starts["reference"].q
    residuals = np.abs(jd.constraints.position_residual(scene, q, jnp.asarray(0.0)))
    assert np.delete(residuals, np.s_[6:12]).max() < 1e-15
    assert residuals[6:12].max() > 0.1  # nothing says that a file's sites meet


def test_missing_meshes_and_textures_are_left_out(tmp_path):
    assets = """<asset><mesh name="seen" file="seen.stl"/><mesh name="heavy" file="heavy.stl"/>
    <texture name="wood" type="2d" file="wood.png"/><material name="m" texture="wood"/></asset>"""
    geoms = (
        '<geom type="mesh" mesh="seen" mass="0"/><geom type="mesh" mesh="heavy"/><geom size="0.1" material="m"/></body>'
    )
    scene = silent(of_body(tmp_path, BODY.replace("</body>", geoms), assets))
    text = "; ".join(scene.not_taken)
    for part in ("missing file 'seen.stl';", "'heavy.stl', and with it mass of bodies b", "missing file 'wood.png'"):
        assert part in text


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("<mujoco><worldbody><body></worldbody></mujoco>", ("robot.xml:1", "malformed XML")),
        ('<mujoco>\n<worldbody><body foo="3"/></worldbody></mujoco>', ("robot.xml:2", "foo")),
        ("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>", ("robot.xml:1", "mass")),
        (f"<mujoco><worldbody>{TWINS}</worldbody></mujoco>", ("robot.xml", "singular", "'h'")),
        ('<!DOCTYPE x [<!ENTITY a "b">]><mujoco model="&a;"/>', ("robot.xml:1", "entity 'a'", "refused")),
    ],
)
def test_bad_files_are_refused_with_file_and_line(tmp_path, text, parts):
    with pytest.raises(ValueError) as caught, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # mujoco's own, of the singular matrix
        jd.load(write(tmp_path, text))
    assert all(part in str(caught.value) for part in parts), str(caught.value)


def test_a_file_that_is_not_there_is_named():
    with pytest.raises(ValueError, match=r"nowhere\.xml.*check the path"):
        jd.load("nowhere.xml")


def test_without_mujoco_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"pip install jaxdyn\[mjcf\]"):
        jd.load(of_body(tmp_path))


def test_controls_of_another_number_are_refused(mixed):
    _, scene = mixed
    q = scene.starts["reference"].q
    with pytest.raises(ValueError, match=r"control .*\(6,\).*m1, p1"):
        scene.actuators(scene.system, q, jnp.zeros(scene.nv), jnp.zeros(2))
    with pytest.raises(ValueError, match=r"activation .*\(1,\).*stateful"):
        scene.actuators(scene.system, q, jnp.zeros(scene.nv), jnp.zeros(6))
    with pytest.raises(ValueError, match=r"activation .*\(2,\).*\(1,\)"):
        scene.actuators.drive(lambda q, v, t: jnp.zeros(6), jnp.zeros(2))


@pytest.mark.parametrize("convert", [list, np.array, jnp.array])
def test_states_and_controls_of_integers_drive_as_in_mujoco(convert, tmp_path):
    drives = """<motor joint="h" gear="0.7"/><position joint="h" kp="2.5" kv="0.3"/><motor site="s" gear="0 0 0.2 0.3 0.5 0"/>
      <general joint="h" dyntype="filter" dynprm="0.3" gainprm="0.4"/>"""
    file = tmp_path / "drives.xml"
    file.write_text(f"""<mujoco><worldbody><body><joint name="h" axis="0 1 0"/>
      <geom size="0.1" pos="0.3 0 0" contype="0" conaffinity="0"/><site name="s" pos="0.3 0 0"/></body></worldbody>
      <actuator>{drives}</actuator></mujoco>""")
    scene, oracle = jd.load(file), mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(oracle)
    data.qpos[:], data.qvel[:], data.ctrl[:], data.act[:] = 2, 3, [1, 1, 2, 5], 1
    mujoco.mj_forward(oracle, data)
    q, v, control, activation = (convert([int(x) for x in y]) for y in (data.qpos, data.qvel, data.ctrl, data.act))
    drive = scene.actuators
    np.testing.assert_allclose(drive(scene.system, q, v, control, activation), data.qfrc_actuator, rtol=1e-14)
    np.testing.assert_allclose(drive.activation_rate(control, activation), data.act_dot, rtol=1e-14)
    np.testing.assert_allclose(drive.thrusts(scene.system, q, v, control, activation)["s"], [0, 0, 0.4, 0.6, 1, 0])


def test_a_model_of_float32_integrates_activations_of_float32(tmp_path):
    """An integrator under u = cos t, with x64 switched on."""
    file = tmp_path / "rate.xml"
    file.write_text("""<mujoco><worldbody><body><joint name="h"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody>
      <actuator><general joint="h" dyntype="integrator"/></actuator></mujoco>""")
    scene = jd.load(file, dtype=jnp.float32)
    driven = jd.Scene(scene.system, forces=[scene.actuators.drive(lambda q, v, t: jnp.cos(t)[None], [0.5])])
    motion = jd.simulate(driven, [0.0], [0.0], [0.0, 1.0], outputs=("drive_state",))
    assert motion.drive_state.dtype == motion.q.dtype == jnp.float32
    np.testing.assert_allclose(motion.drive_state[-1], 0.5 + np.sin(1.0), rtol=1e-5)
    np.testing.assert_allclose(motion.q[-1], 1.25 - np.sin(1.0), rtol=1e-4)


DYNAMICS = """<general name="f" joint="h" dyntype="{0}" dynprm="0.08" gear="3" gainprm="2" ctrlrange="-1 1"/>
  <general name="servo" joint="h" dyntype="{0}" dynprm="0.05" gainprm="15" biastype="affine" biasprm="0 -15 -1.5"/>
  <intvelocity name="rate" joint="k" kp="6" kv="0.5" actrange="-0.3 0.3"/>
  <motor name="plain" joint="k" gear="2"/>"""
CHILD = """<body name="c" pos="0 0 -.4"><joint name="k" axis="0 1 0" damping="0.05"/>
  <geom size="0.05" pos="0 0 -.3" mass="1"/></body></body>"""


@pytest.mark.parametrize(("dynamics", "integrator"), [("filter", "RK4"), ("filterexact", "Euler")])
def test_motions_under_activations_are_those_of_mujoco(dynamics, integrator, tmp_path):
    """A filter with a gear, a position servo with a filter and damping, an integrator that reaches the end of its range.

    MuJoCo's exact filter is exact in its Euler steps, for controls that are constant in a step; the motion is not.
    """
    body = BODY.replace("</body>", CHILD).replace("<geom ", '<geom contype="0" conaffinity="0" ')
    option = f'<option timestep="5e-4" integrator="{integrator}"/>'
    path = of_body(tmp_path, body, f"{option}<actuator>{DYNAMICS.format(dynamics)}</actuator>")
    scene = jd.load(path)
    control, initial = np.array([1.5, 0.4, 0.8, -0.3]), np.array([0.2, -0.1, 0.0])
    m = mujoco.MjModel.from_xml_path(str(path))
    data, theirs = mujoco.MjData(m), []
    data.ctrl[:], data.act[:] = control, initial
    for _ in range(3):
        mujoco.mj_step(m, data, 400)
        theirs.append(np.concatenate([data.act, data.qpos, data.qvel]))
    driven = jd.Scene(
        scene.system, (), (*scene.forces, scene.actuators.drive(lambda q, v, t: jnp.asarray(control), initial))
    )
    zero = jnp.zeros(2)
    motion = jd.simulate(driven, zero, zero, 0.2 * np.arange(4), stepsize=5e-4, outputs=("drive_state",))
    np.testing.assert_allclose(motion.drive_state[1:, :2], [row[:2] for row in theirs], rtol=1e-9)
    np.testing.assert_allclose(motion.drive_state[1:, 2], [0.16, 0.3, 0.3], atol=1e-3)
    if integrator == "RK4":
        computed = np.hstack([motion.drive_state, motion.q, motion.v])[1:]
        # The integrator stops within a step, which ours passes by less than a step.
        np.testing.assert_allclose(computed[:1], theirs[:1], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(computed, theirs, rtol=1e-3, atol=1e-3)


# Packages whose wheels hold MJCF files; none is a dependency. What is installed is tested.
COLLECTION = ("mujoco", "brax", "dm_control", "gymnasium", "gymnasium_robotics", "mujoco_playground", "robosuite")
LARGEST = 100  # degrees of freedom; what is larger there repeats the same humanoid


def files_of(package: str) -> list[Path]:
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        pytest.skip(f"the package {package} is not installed")
    paths = sorted(Path(spec.submodule_search_locations[0]).rglob("*.xml"))
    return [path for path in paths if b"<mujoco" in path.read_bytes()]


@pytest.mark.slow
@pytest.mark.parametrize("package", COLLECTION)
def test_every_mjcf_file_of_installed_packages_agrees(package):
    """Where MuJoCo itself loads a file, so do we, and all numbers agree, or what makes them differ is named."""
    faults, count = [], 0
    for path in files_of(package):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                m = mujoco.MjModel.from_xml_path(str(path))
        except ValueError:
            continue  # fragments that others include, and files whose meshes other packages hold
        if not 0 < m.nv <= LARGEST:
            continue
        try:
            scene = silent(path)
        except ValueError as error:
            if "mass matrix is singular" not in str(error) or np.linalg.matrix_rank(_mass_matrix(m)) == m.nv:
                faults.append(f"{path}: {error}")
            continue
        errors = agreement(path, scene)
        if any(line.startswith(APART) for line in scene.not_taken):
            errors = {name: errors[name] for name in ("mass", "frames", "passive")}
        faults += [f"{path}: {name} differs by {e:.1e}" for name, e in errors.items() if not e < 1e-9]
        count += 1
        jax.clear_caches()
    assert count
    assert not faults, "\n".join(faults)


def _mass_matrix(m) -> np.ndarray:
    data, M = mujoco.MjData(m), np.zeros((m.nv, m.nv))
    data.qpos[:] = np.random.default_rng(0).normal(size=m.nq)
    mujoco.mj_forward(m, data)
    mujoco.mj_fullM(m, data, M)
    return M


@pytest.mark.long
def test_plain_motors_behind_a_drive(tmp_path):
    """Actuators without activation have no state: the motion is that under their torque."""
    path = tmp_path / "motor.xml"
    path.write_text("""<mujoco><worldbody><body><joint name="j" axis="0 1 0"/>
      <geom size=".05" pos="0 0 -.5" contype="0" conaffinity="0"/></body></worldbody>
      <actuator><motor joint="j" gear="2"/></actuator></mujoco>""")
    robot = jd.load(path)
    drive = robot.actuators.drive(lambda q, v, t: jnp.array([0.7]))
    scene, ts = jd.Scene(robot.system, forces=[*robot.forces, drive]), jnp.array([0.0, 1.0])
    want = jd.simulate(robot.system, [0.0], [0.0], ts, control=lambda q, v, t: jnp.array([1.4])).q
    driven = jd.simulate(scene, [0.0], [0.0], ts, outputs=("drive_state",))
    np.testing.assert_allclose(driven.q, want, atol=1e-10)
    assert driven.drive_state.shape == (2, 0)
