"""Sensors of contact forces: at rest they carry the weight; accelerations and wrenches include the contacts."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd

G = 9.81
LEGS = {"left": -0.2, "right": 0.3}


@pytest.fixture(scope="module")
def table():
    """A plate of 2 kg on two legs of 0.5 kg, each a body on a slide with a foot of two balls; it stands on z = 0."""
    builder = jd.ModelBuilder("table")
    builder.add_body("plate", None, "free", (2.0, (0.0, 0.0, 0.0), (0.05, 0.05, 0.08)))
    contacts = []
    for name, x in LEGS.items():
        inertia = (0.5, (0.0, 0.0, 0.0), (1e-3, 1e-3, 1e-3))
        builder.add_body(
            name, "plate", "prismatic", inertia, joint_name=f"slide {name}", pose=(x, 0, -0.3), lower=-1.0, upper=0.0
        )
        foot = jd.contact.Capsule(0.05, 0.4)
        pose = ((0, 0, 0), (np.pi / 2, 0, 0))
        contacts += jd.contact.shape_contacts(name, foot, pose, friction=0.5, name=f"{name} foot")
    return jd.Scene(builder.build(), forces=contacts)


@pytest.mark.long
def test_feet_carry_the_weight(table):
    """A step at rest with legs on their limits: forces by statics; what an IMU, a foot and a leg feel."""
    q, v = jnp.array([0, 0, 0.35, 1, 0, 0, 0, 0, 0.0]), jnp.zeros(8)
    step = jax.jit(jd.stepper(table, 0.005, limits="hold", report=True))
    (q, v), report = step((q, v), jnp.zeros(8))
    assert bool(report.success) and float(jnp.abs(v).max()) < 1e-12
    # Moments about the other foot; the plate's weight is at x = 0.
    weights = {"left": (2 * 0.3 / 0.5 + 0.5) * G, "right": (2 * 0.2 / 0.5 + 0.5) * G}
    names = [f"{leg} foot {i}" for leg in LEGS for i in range(2)]
    sensors = [
        *(jd.sensors.Touch(leg) for leg in LEGS),
        *(jd.sensors.ContactForce(name) for name in names),
        jd.sensors.Accelerometer("plate"),
        jd.sensors.ForceTorque("left", name="leg"),
    ]
    tau = report.limit_forces
    read = jax.jit(lambda *args, contacts: jd.sensors.measure(table, sensors, *args, contacts=contacts))
    readings = read(q, v, tau, contacts=report.forces)
    for leg, weight in weights.items():
        np.testing.assert_allclose(readings[f"touch of {leg}"], [weight], rtol=1e-9)
        for i in range(2):
            np.testing.assert_allclose(
                readings[f"force of {leg} foot {i}"], report.forces[f"{leg} foot {i}"], atol=1e-12
            )
    np.testing.assert_allclose(
        readings["accelerometer of plate"],
        [0, 0, G],
        atol=1e-8,
    )
    # The plate presses on the leg: its weight less what the ground gives.
    np.testing.assert_allclose(readings["leg"][:3], [0, 0, 0.5 * G - weights["left"]], atol=1e-8)
    forces = {name: jnp.stack([x, 2 * x]) for name, x in report.forces.items()}
    log = jd.sensors.record(table, sensors[:1], [0.0, 1.0], jnp.stack([q, q]), jnp.stack([v, v]), contacts=forces)
    np.testing.assert_allclose(log["touch of left"][:, 0], [weights["left"], 2 * weights["left"]], rtol=1e-9)


def test_refusals(table):
    """Forces that are missing or do not fit, frames without contacts, and unknown contacts."""
    q, v = jnp.array([0, 0, 0.35, 1, 0, 0, 0, 0, 0.0]), jnp.zeros(8)
    forces = {f"{leg} foot {i}": jnp.zeros(3) for leg in LEGS for i in range(2)}
    with pytest.raises(
        ValueError, match=r"contacts has the forces of \[\], and the scene has the contacts \['left foot 0'"
    ):
        jd.sensors.measure(table, [jd.sensors.Touch("left")], q, v)
    with pytest.raises(ValueError, match=r"contacts\['left foot 0'\] has shape \(2,\), expected \(3\)"):
        jd.sensors.measure(table, [jd.sensors.Touch("left")], q, v, contacts=forces | {"left foot 0": jnp.zeros(2)})
    with pytest.raises(ValueError, match="frame 'plate' has no contacts"):
        jd.sensors.measure(table, [jd.sensors.Touch("plate")], q, v, contacts=forces)
    with pytest.raises(ValueError, match="constraint 'toe' is not in the scene; its constraints are 'left foot 0'"):
        jd.sensors.measure(table, [jd.sensors.ContactForce("toe")], q, v, contacts=forces)


def test_touch_sensors_of_a_file(tmp_path):
    """Taken with contacts, and named without."""
    path = tmp_path / "foot.xml"
    path.write_text(
        """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body name="foot" pos="0 0 0.1"><freejoint/><site name="sole"/>
        <geom size="0.1" mass="1"/></body></worldbody><sensor><touch name="t" site="sole"/></sensor></mujoco>"""
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene, bare = jd.load(path, contacts="ground"), jd.load(path)
    assert not bare.sensors and "sensors: t" in bare.not_taken and "volume of touch sensors: t" in scene.not_taken
    (sensor,) = scene.sensors
    q = scene.starts["reference"].q
    reading = jd.sensors.measure(scene, scene.sensors, q, jnp.zeros(6), contacts={"foot": jnp.array([0.1, 0.2, 3.0])})
    assert isinstance(sensor, jd.sensors.Touch) and reading["t"].tolist() == [3.0]
