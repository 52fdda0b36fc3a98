"""Sensors against MuJoCo's, against closed forms, and by the statistics of their noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn import scenes, sensors

FILE = """
<mujoco>
  <option timestep="0.001"><flag contact="disable"/></option>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint/>
      <inertial pos="0.1 0 0.05" mass="3" diaginertia="0.1 0.2 0.15"/>
      <site name="imu" pos="0.1 -0.2 0.05" euler="30 20 -40"/>
      <body name="arm" pos="0.3 0 0" euler="0 20 0">
        <joint name="shoulder" axis="0 1 0" pos="0 0 0.05" armature="0.1"/>
        <inertial pos="0 0 -0.2" mass="1" diaginertia="0.02 0.02 0.01"/>
        <site name="upper" pos="0.02 0 -0.1" euler="10 0 90"/>
        <body name="tool" pos="0 0 -0.4" euler="0 0 30">
          <inertial pos="0.05 0.02 -0.1" mass="0.5" fullinertia="0.01 0.012 0.008 0.001 0.0005 -0.0002"/>
          <site name="wrist" pos="0 0 -0.02" euler="0 45 0"/>
          <body name="finger" pos="0.05 0 -0.1">
            <joint name="slide" type="slide" axis="1 0 0"/>
            <inertial pos="0 0 -0.05" mass="0.2" diaginertia="1e-3 1e-3 5e-4"/>
          </body>
        </body>
      </body>
    </body>
    <body name="bar" pos="2 0 1">
      <joint name="swing" axis="0 1 0"/>
      <inertial pos="0.5 0 0" mass="1" diaginertia="0.01 0.1 0.1"/>
      <site name="middle" pos="0.5 0 0"/>
    </body>
  </worldbody>
  <sensor>
    <accelerometer name="acc" site="imu" noise="0.02"/>
    <gyro name="gyro" site="imu"/>
    <velocimeter name="speed" site="imu"/>
    <force name="elbow_f" site="upper"/>
    <torque name="elbow_t" site="upper"/>
    <force name="wrist_f" site="wrist"/>
    <torque name="wrist_t" site="wrist"/>
    <jointpos name="pos" joint="slide"/>
    <jointvel name="vel" joint="slide"/>
    <framepos name="place" objtype="site" objname="wrist"/>
    <framequat name="turn" objtype="xbody" objname="arm"/>
    <framelinvel name="moving" objtype="site" objname="wrist"/>
    <frameangvel name="turning" objtype="site" objname="wrist"/>
    <accelerometer site="middle"/>
    <clock name="now"/>
  </sensor>
</mujoco>
"""


@pytest.mark.long
def test_mujoco_reads_the_same(tmp_path):
    """All sensors of a file in a random motion, of a floating tree with a tool that is welded to its arm."""
    mujoco = pytest.importorskip("mujoco")
    from mujoco_bridge import Oracle

    path = tmp_path / "robot.xml"
    path.write_text(FILE)
    with pytest.warns(jd.io.NotTakenWarning, match="sensors: now"):
        scene = jd.load(path)
    oracle = Oracle(path, scene.system)
    rng = np.random.default_rng(1)
    q = np.asarray(scene.starts["reference"].q) + 0.3 * rng.normal(size=scene.nq)
    free = scene.system.topology.q_slices[scene.system.topology.kinds.index("free")]
    q[free][3:] /= np.linalg.norm(q[free][3:])
    v = rng.normal(size=scene.nv)
    oracle.set(q, v)
    mujoco.mj_sensorPos(oracle.m, oracle.data)
    readings = sensors.measure(jd.Scene(scene.system), scene.sensors, jnp.asarray(q), jnp.asarray(v))
    names = [oracle.m.sensor(i).name or f"sensor{i}" for i in range(oracle.m.nsensor)]
    assert set(readings) == set(names) - {"now"}
    for i, name in enumerate(names):
        if name == "now":
            continue
        want = oracle.data.sensordata[oracle.m.sensor_adr[i] :][: oracle.m.sensor_dim[i]]
        got = np.asarray(readings[name])
        if name == "turn" and got @ want < 0:
            got = -got
        np.testing.assert_allclose(
            got, want, atol=1e-9 * max(1, np.abs(want).max()), err_msg=name
        )  # MuJoCo's own solve
    noisy = {sensor.name: sensor.noise for sensor in scene.sensors}
    assert float(noisy["acc"].std) == 0.02 and noisy["gyro"] is None


def pendulum():
    builder = jd.ModelBuilder("pendulum")
    builder.add_body("rod", None, "continuous", (2.0, (0.5, 0, 0), (0.0, 0.2, 0.2)), axis=(0, 1, 0), joint_name="hinge")
    return builder.add_frame("tip", "rod", (1.0, 0, 0)).build()


def test_pendulum_in_closed_form():
    """Specific force of the tip: -l w^2 + g sin along the rod, l alpha + g cos across it; the hinge bears the rest."""
    model, angle, rate = pendulum(), 0.7, 1.3
    q, v = jnp.array([angle]), jnp.array([rate])
    imu, hinge, free = sensors.Imu("tip"), sensors.ForceTorque("rod"), jd.ModelBuilder("ball")
    readings = sensors.measure(model, [imu, hinge], q, v)
    alpha = float(jd.forward_dynamics(model, q, v, jnp.zeros(1))[0])
    # x of the rod points down by the angle, so gravity has the component g sin(angle) along it.
    along, across = 9.81 * np.sin(angle), 9.81 * np.cos(angle)
    np.testing.assert_allclose(readings["imu of tip"][:3], [-(rate**2) - along, 0, -alpha + across], atol=1e-12)
    np.testing.assert_allclose(readings["imu of tip"][3:], [0, rate, 0], atol=1e-12)
    np.testing.assert_allclose(
        readings["wrench of rod"],
        [2 * (-0.5 * rate**2 - along), 0, 2 * (-0.5 * alpha + across), 0, 0, 0],
        atol=1e-10,
    )
    body = free.add_body("ball", None, "free", jd.inertia.sphere(1.0, 0.1)).build()
    falling = sensors.measure(body, [sensors.Accelerometer("ball")], jnp.array([0, 0, 0, 1.0, 0, 0, 0]), jnp.zeros(6))
    np.testing.assert_allclose(falling["accelerometer of ball"], 0, atol=1e-12)


@pytest.mark.long
def test_forces_under_constraints():
    """Contact forces are the multipliers; the wrench in a joint includes those of the loop."""
    scene, (q, v) = scenes.four_bar(), scenes.four_bar.start()
    dynamics = jd.constrained_dynamics(scene, q, v)
    readings = sensors.measure(scene, [sensors.ContactForce("knee"), sensors.ForceTorque("rocker")], q, v)
    np.testing.assert_array_equal(readings["force of knee"], dynamics.multipliers)
    # The rocker turns about a hinge: its moment equation about that is met by the loop, which leaves the hinge without torque.
    assert abs(float(readings["wrench of rocker"][5])) < 1e-9
    without = jd.dynamics.joint_wrench(scene.system, q, v, dynamics.acceleration, "3")
    assert np.abs(readings["wrench of rocker"] - without).max() > 0.1


def test_mount_inside_a_body():
    """A mount carries the part beyond it: the inertia that is cut off, at rest its weight."""
    model = jd.robots.iiwa()
    q = jnp.asarray(np.random.default_rng(0).normal(size=7))
    whole = sensors.ForceTorque("iiwa_link_5", name="joint")
    same = sensors.ForceTorque("iiwa_link_5", name="mount", inertia=model.inertias[4], joints=["iiwa_joint_6"])
    tool = sensors.ForceTorque("iiwa_link_5", name="tool", inertia=jd.inertia.sphere(0.5, 0.1), joints=[])
    readings = sensors.measure(model, [whole, same, tool], q, jnp.ones(7), jnp.ones(7))
    assert_close(readings["mount"], readings["joint"], 1e-12)
    still = sensors.Motion(jd.Scene(model), q, jnp.zeros(7), jnp.zeros(7), jnp.zeros(0))
    weight = jd.frame_pose(model, q, "iiwa_link_5")[:3, :3].T @ jnp.array([0, 0, 0.5 * 9.81])
    np.testing.assert_allclose(tool.read(still), [*weight, 0, 0, 0], atol=1e-12)


@pytest.mark.long
def test_resolution_delay_and_noise():
    model, ts = pendulum(), jnp.linspace(0.0, 2.0, 2001)
    q, v = 0.5 * ts[:, None] ** 1, 0.5 * jnp.ones((2001, 1))
    encoder = sensors.Encoder("hinge", resolution=0.01, delay=0.1)
    noisy = sensors.Gyroscope("tip", noise=sensors.Noise(0.1, bias=[0.0, 0.2, 0.0]))
    walking = sensors.Tachometer("hinge", noise=sensors.Noise(walk=0.3))

    @quick
    def read(key):
        return sensors.record(model, [encoder, noisy, walking], ts, q, v, key=key)

    readings = read(jax.random.key(0))
    late = np.maximum(0.5 * (np.asarray(ts) - 0.1), 0)
    error = late - readings["encoder of hinge"][:, 0]
    assert np.all((error > -1e-9) & (error < 0.01 + 1e-9))
    counts = np.asarray(readings["encoder of hinge"]) / 0.01
    np.testing.assert_allclose(counts, counts.round(), atol=1e-6)
    omega = np.asarray(readings["gyroscope of tip"])
    # Five standard errors of the mean, of the deviation, and of the correlation of 2001 samples.
    np.testing.assert_allclose(omega.mean(0), [0, 0.7, 0], atol=5 * 0.1 / np.sqrt(2001))
    np.testing.assert_allclose(omega.std(0), 0.1, rtol=5 / np.sqrt(2 * 2001))
    assert abs(np.corrcoef(omega[1:, 0], omega[:-1, 0])[0, 1]) < 5 / np.sqrt(2001)
    ends = jax.vmap(lambda key: read(key)["tachometer of hinge"][-1, 0])(jax.random.split(jax.random.key(1), 400))
    np.testing.assert_allclose(np.std(ends), 0.3 * np.sqrt(2.0), rtol=5 / np.sqrt(800))  # root of time
    again, other = read(jax.random.key(0)), read(jax.random.key(5))
    np.testing.assert_array_equal(omega, again["gyroscope of tip"])
    assert np.abs(omega - other["gyroscope of tip"]).max() > 0.1
    clean = sensors.record(model, [noisy], ts, q, v)["gyroscope of tip"]
    np.testing.assert_allclose(clean, np.broadcast_to([0, 0.5, 0], clean.shape), atol=1e-12)


def hat(x):
    return np.cross(np.eye(3), x)


def about(x):
    """The matrix of I x as a function of the six moments Ixx, Ixy, Iyy, Ixz, Iyz, Izz."""
    return np.array([[x[0], x[1], 0, x[2], 0, 0], [0, x[0], x[1], 0, x[2], 0], [0, 0, 0, x[0], x[1], x[2]]])


def test_inertia_of_a_floating_body_from_imu_and_force_sensor():
    """Closed form: the wrench in a mount is linear in the ten parameters beyond it, with the IMU's readings as regressor."""
    wrist = jd.ModelBuilder("hand").add_body("hand", None, "free", jd.inertia.box(1.0, (0.1, 0.2, 0.1))).build()
    want = jnp.asarray(jd.inertia.displaced(jd.inertia.box(0.8, (0.05, 0.1, 0.2)), (0.02, -0.01, 0.1)))
    imu, mount = sensors.Imu("hand"), sensors.ForceTorque("hand", inertia=want)
    rng = np.random.default_rng(2)
    rows, wrenches = [], []
    for _ in range(6):
        v, a = rng.normal(size=(2, 6))
        q = rng.normal(size=7)
        q[3:] /= np.linalg.norm(q[3:])
        motion = sensors.Motion(jd.Scene(wrist), *map(jnp.asarray, (q, v, a)), jnp.zeros(0))
        f, w, alpha = *np.split(np.asarray(imu.read(motion)), 2), a[3:]
        force = np.concatenate([f[:, None], hat(alpha) + hat(w) @ hat(w), np.zeros((3, 6))], 1)
        torque = np.concatenate([np.zeros((3, 1)), -hat(f), about(alpha) + hat(w) @ about(w)], 1)
        rows += [force, torque]
        wrenches.append(mount.read(motion))
    parameters = np.linalg.lstsq(np.concatenate(rows), np.concatenate(wrenches))[0]
    np.testing.assert_allclose(parameters, want, atol=1e-12)


def test_refusals():
    model, q, v = pendulum(), jnp.zeros(1), jnp.zeros(1)
    measure = sensors.measure
    with pytest.raises(ValueError, match="frame 'hip' is not in model"):
        measure(model, [sensors.Imu("hip")], q, v)
    with pytest.raises(ValueError, match="joint 'hip' is not in model"):
        measure(model, [sensors.Encoder("hip")], q, v)
    with pytest.raises(ValueError, match="constraint 'knee' is not in the scene"):
        measure(model, [sensors.ContactForce("knee")], q, v)
    with pytest.raises(ValueError, match="the name 'imu of tip' occurs twice"):
        measure(model, [sensors.Imu("tip"), sensors.Imu("tip")], q, v)
    with pytest.raises(ValueError, match="sensors is 'imu'"):
        measure(model, "imu", q, v)
    with pytest.raises(ValueError, match="has no bodies for sensors"):
        measure(scenes.double_pendulum(), [sensors.Imu("tip")], jnp.zeros(2), jnp.zeros(2))
    with pytest.raises(ValueError, match="resolution is 0"):
        sensors.Encoder("hinge", resolution=0)
    with pytest.raises(ValueError, match="delay is -1"):
        sensors.Imu("tip", delay=-1)
    with pytest.raises(ValueError, match=r"std is -0.1; give standard deviations"):
        sensors.Noise(-0.1)
    with pytest.raises(ValueError, match="joints are given without inertia"):
        sensors.ForceTorque("tip", joints=["hinge"])
    with pytest.raises(ValueError, match="is not on the frame's body"):
        measure(model, [sensors.ForceTorque("tip", inertia=jnp.ones(10), joints=["hinge"])], q, v)
    with pytest.raises(ValueError, match="ts does not increase"):
        sensors.record(model, [sensors.Imu("tip")], [0.0, 0.0], jnp.zeros((2, 1)), jnp.zeros((2, 1)))
    with pytest.raises(ValueError, match=r"v has shape \(3, 1\), expected \(2, 1\)"):
        sensors.record(model, [sensors.Imu("tip")], [0.0, 1.0], jnp.zeros((2, 1)), np.zeros((3, 1)))
    with pytest.raises(ValueError, match=r"ts has shape \(0,\); give the times \(n,\) of one sample or more"):
        sensors.record(model, [sensors.Imu("tip")], np.zeros(0), jnp.zeros((0, 1)), np.zeros((0, 1)))


PUSHED = """
<mujoco>
  <option timestep="0.001"><flag contact="disable" limit="disable"/></option>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="a" axis="0 1 0" stiffness="7" damping="0.3"/>
      <inertial pos="0.1 0 0.05" mass="3" diaginertia="0.1 0.2 0.15"/>
      <body name="lower" pos="0.3 0 0" euler="0 20 0">
        <joint name="b" axis="0 0 1" stiffness="5" springref="0.4" range="-28.64788975654116 28.64788975654116"/>
        <inertial pos="0 0.05 -0.2" mass="1" diaginertia="0.02 0.02 0.01"/>
        <site name="s" pos="0.1 0.02 0.03" euler="10 20 30"/>
        <body name="hand" pos="0 0 -0.4" euler="0 0 30">
          <joint name="c" axis="1 0 0" damping="0.2"/>
          <inertial pos="0.05 0.02 -0.1" mass="0.5" fullinertia="0.01 0.012 0.008 0.001 0.0005 -0.0002"/>
        </body>
        <body name="tool" pos="0.1 0 -0.1" euler="20 0 0">
          <inertial pos="0.05 0 0" mass="0.3" diaginertia="1e-3 2e-3 2e-3"/>
          <site name="flange" pos="0 0.01 0" euler="0 40 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <sensor>
    <accelerometer name="acc" site="s"/><force name="f" site="s"/><torque name="t" site="s"/>
    <force name="flange_f" site="flange"/><torque name="flange_t" site="flange"/>
  </sensor>
</mujoco>
"""


@pytest.mark.long
def test_outer_forces_springs_and_stops_against_mujoco(tmp_path):
    """Wrenches of a scene on the sensor's body, before a mount on it and beyond, springs, dampers, and a stop that is hit."""
    mujoco = pytest.importorskip("mujoco")
    path = tmp_path / "pushed.xml"
    path.write_text(PUSHED)
    m, loaded = mujoco.MjModel.from_xml_path(str(path)), jd.load(path)
    data = mujoco.MjData(m)
    q, v = np.array([0.3, -0.7, 0.5]), np.array([1.2, -0.8, 0.9])
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(m, data)
    # Of MuJoCo as a torque of the size that the closed form has: its own stops are soft constraints.
    forces = [*loaded.forces, jd.forces.JointStops(1e3, 2.0, joints="b")]
    data.qfrc_applied[1] = 1e3 * 0.2 + 2.0 * 0.8
    pushes = {"lower": [3, -2, 5, 0.1, 0.2, -0.3], "hand": [-1, 4, 2, 0.3, -0.1, 0.2], "tool": [2, 1, -3, 0.2, 0, 0.1]}
    for name, push in pushes.items():
        i = m.body(name).id
        data.xfrc_applied[i] = push
        # MuJoCo pushes at the centre of mass.
        torque = push[3:] + np.cross(data.xipos[i] - data.xpos[i], push[:3])
        forces.append(jd.forces.ExternalWrench(name, np.append(push[:3], torque)))
    mujoco.mj_forward(m, data)
    scene = jd.Scene(loaded.system, forces=forces)
    readings = sensors.measure(scene, loaded.sensors, jnp.asarray(q), jnp.asarray(v))
    for i in range(m.nsensor):
        want = data.sensordata[m.sensor_adr[i] :][:3]
        np.testing.assert_allclose(readings[m.sensor(i).name], want, atol=1e-10 * max(1, np.abs(want).max()))


@pytest.mark.long
@pytest.mark.parametrize("mode", ["delay", "noise"])
def test_orientations_are_delayed_and_disturbed_on_the_group(mode):
    """A body that turns about a fixed axis beyond a full turn: its delayed orientation is that of an earlier time."""
    axis, rate, late = np.array([2.0, -1.0, 2.0]) / 3, 5.7, 0.0123
    ball = jd.ModelBuilder("ball", gravity=None).add_body("ball", None, "free", jd.inertia.sphere(1.0, 0.1)).build()
    ts = np.linspace(0, 2, 201)
    half = rate * ts / 2
    turns = np.column_stack([np.cos(half), np.sin(half)[:, None] * axis])
    # Rows of either sign, as files have them.
    q = np.column_stack([ts, 2 * ts, 0 * ts, turns * np.where(np.arange(201) % 7 < 3, -1, 1)[:, None]])
    v = np.tile([0.0, 0, 0, *(rate * axis)], (201, 1))
    std = np.array([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
    noise, delay = (sensors.Noise(std, bias=0.1 * std), 0.0) if mode == "noise" else (None, late)
    list_of = [
        sensors.FramePose("ball", delay=delay, noise=noise),
        sensors.FramePose("ball", name="turn", part="orientation", delay=delay),
        sensors.Encoder("ball_joint" if "ball_joint" in ball.joint_names else "ball", delay=delay, noise=noise),
    ]
    read = quick(
        lambda delay: sensors.record(
            ball, [eqx.tree_at(lambda s: s.delay, s, delay) for s in list_of], ts, q, v, key=jax.random.key(3)
        )
    )
    readings = read(jnp.asarray(delay))
    before = np.maximum(ts - delay, 0)
    truth = np.column_stack([np.cos(rate * before / 2), np.sin(rate * before / 2)[:, None] * axis])
    assert_close(readings["turn"], truth, 1e-12)
    for sensor in (list_of[0], list_of[2]):
        got = np.asarray(readings[sensor.name])
        np.testing.assert_allclose(np.linalg.norm(got[:, 3:], axis=1), 1, atol=1e-12)
        assert (np.sum(got[1:, 3:] * got[:-1, 3:], 1) > 0.9).all()
        place = got[:, :3] - np.column_stack([before, 2 * before, 0 * before])
        error = jax.vmap(jd.so3.quat_multiply)(jax.vmap(jd.so3.quat_conjugate)(jnp.asarray(truth)), got[:, 3:])
        errors = np.column_stack([place, jax.vmap(jd.so3.quat_log)(error)])
        if mode == "delay":
            np.testing.assert_allclose(errors, 0, atol=1e-12)
        else:
            # Five standard errors of a deviation, of 201 samples.
            np.testing.assert_allclose(errors.std(0), std, rtol=5 / np.sqrt(2 * 201))
    if mode == "delay":
        slope = jax.jacfwd(lambda delay: read(delay)["turn"][100])(jnp.asarray(delay))
        turned = rate * before[100] / 2
        assert_close(slope, -rate / 2 * np.array([-np.sin(turned), *(np.cos(turned) * axis)]), 1e-12)
        # A single sample is the reading at all earlier times.
        alone = sensors.record(ball, list_of, ts[:1], q[:1], v[:1])
        assert_close(alone["turn"], truth[:1], 1e-12)
    else:
        with pytest.raises(ValueError, match=r"std of its Noise has 7 entries, its readings have 6 errors"):
            sensors.record(
                ball, [sensors.FramePose("ball", noise=sensors.Noise(np.ones(7)))], ts, q, v, key=jax.random.key(0)
            )


def test_noise_of_another_size_than_the_reading_is_refused():
    arm, q = jd.robots.iiwa(), jnp.zeros((2, 7))
    for options in ({"std": [1.0, 2.0, 3.0]}, {"bias": [1.0, 2.0]}, {"walk": jnp.ones(7)}):
        imu = jd.sensors.Imu("iiwa_link_7", noise=jd.sensors.Noise(**options))
        (name, value), *_ = options.items()
        words = f"sensor '{imu.name}': {name} of its Noise has {len(value)} entries, its readings have 6 errors; give"
        with pytest.raises(ValueError, match=words):
            jd.sensors.record(arm, [imu], [0.0, 0.1], q, q, key=jax.random.key(0))


FLYER = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 1">
      <joint name="j1" axis="0 1 0"/>
      <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.02 0.03"/>
      <body name="arm" pos="0.4 0 0">
        <joint name="j2" axis="0 0 1"/>
        <inertial pos="0.1 0.02 0" mass="0.7" diaginertia="0.01 0.02 0.015"/>
        <site name="wrist" pos="0.05 0 0" euler="10 20 30"/>
        <site name="before" pos="0.1 0 0.02" euler="10 0 30"/>
        <body name="tool" pos="0.3 0 0">
          <inertial pos="0.05 0 0.02" mass="0.3" diaginertia="0.001 0.002 0.003"/>
          <site name="mount" pos="0.01 0 0" euler="0 40 0"/>
          <site name="propeller" pos="0.1 0.05 0" euler="0 30 20"/>
          <body name="tip" pos="0.2 0 0">
            <joint name="j3" axis="0 1 0"/>
            <inertial pos="0.02 0 0" mass="0.1" diaginertia="0.0001 0.0002 0.0003"/>
            <site name="jet" pos="0.01 0.01 0"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general name="p" site="propeller" gear="0.1 0 1 0 0 0.2" forcelimited="true" forcerange="-1.5 1.5"/>
    <general name="k" site="jet" gear="1 0 0 0 0.1 0" biastype="affine" biasprm="0.2 0 -0.3"/>
    <general name="b" site="before" gear="0 1 0 0.1 0 0"/>
    <general name="again" site="jet" gear="0 0 1 0 0 0"/>
    <motor name="m" joint="j1"/>
  </actuator>
  <sensor>
    <force name="f" site="mount"/><torque name="t" site="mount"/>
    <force name="fw" site="wrist"/><torque name="tw" site="wrist"/>
  </sensor>
</mujoco>"""


@pytest.mark.long
def test_thrusts_act_where_they_are(tmp_path):
    """MuJoCo counts them where they are as `xfrc_applied` alone; its own actuators count as torques of the joints."""
    mujoco = pytest.importorskip("mujoco")
    path = tmp_path / "flyer.xml"
    path.write_text(FLYER)
    m, scene = mujoco.MjModel.from_xml_path(str(path)), jd.load(path)
    data, control = mujoco.MjData(m), np.array([2.0, 3.0, -0.7, 0.4, 0.5])
    data.qpos[:], data.qvel[:], data.ctrl[:] = [0.3, -0.4, 0.5], [0.7, -1.0, 0.4], control
    mujoco.mj_forward(m, data)
    q, v = jnp.asarray(data.qpos), jnp.asarray(data.qvel)
    tau = scene.actuators(scene.system, q, v, jnp.asarray(control))
    thrusts = scene.actuators.thrusts(scene.system, q, v, jnp.asarray(control))
    measured = jd.sensors.measure(scene, scene.sensors, q, v, tau)
    np.testing.assert_allclose(np.concatenate(list(measured.values())), data.sensordata, atol=1e-10)
    acceleration, forces = data.qacc.copy(), data.actuator_force.copy()
    for k, site in enumerate(("propeller", "jet", "before", "jet")):
        i = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SITE, site)
        R, body = data.site_xmat[i].reshape(3, 3), m.site_bodyid[i]
        force, torque = R @ m.actuator_gear[k, :3] * forces[k], R @ m.actuator_gear[k, 3:] * forces[k]
        data.xfrc_applied[body, :3] += force
        data.xfrc_applied[body, 3:] += torque + np.cross(data.site_xpos[i] - data.xipos[body], force)
    m.actuator_gear[:4] = 0
    mujoco.mj_forward(m, data)
    np.testing.assert_allclose(data.qacc, acceleration, rtol=1e-10)
    measured = jd.sensors.measure(scene, scene.sensors, q, v, tau, thrusts=thrusts)
    np.testing.assert_allclose(np.concatenate(list(measured.values())), data.sensordata, atol=1e-10)
    rows = jax.tree.map(lambda x: jnp.stack([x, x]), thrusts)
    states = (jnp.stack([x, x]) for x in (q, v, tau))
    recorded = jd.sensors.record(scene, scene.sensors, jnp.arange(2.0), *states, thrusts=rows)
    np.testing.assert_allclose(recorded["tw"][1], measured["tw"], atol=1e-12)
    with pytest.raises(ValueError, match=r"thrusts\['jet'\] has shape \(3,\)"):
        jd.sensors.measure(scene, scene.sensors, q, v, tau, thrusts={"jet": jnp.ones(3)})
    with pytest.raises(ValueError, match=r"thrusts\['jet'\] has shape \(6,\)"):
        jd.sensors.record(scene, scene.sensors, [0.0], q[None], v[None], tau[None], thrusts={"jet": jnp.ones(6)})
