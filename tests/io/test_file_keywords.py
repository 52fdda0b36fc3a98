"""Keywords of readers that no other test passes, each by its effect."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd

URDF = """<robot name="r"><link name="a"/><link name="b"><inertial><origin xyz="0 0 0.5"/><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>{}</joint></robot>"""
SDF = """<sdf version="1.7"><model name="m"><link name="base"/><link name="b"><pose>0 0 1 0 0 0</pose></link>
<joint name="j" type="revolute"><parent>base</parent><child>b</child><axis><xyz>0 1 0</xyz></axis></joint></model></sdf>"""
MJCF = """<mujoco><worldbody><body name="b"><joint name="j" axis="0 1 0"/>
<inertial pos="0 0 0.5" mass="2" diaginertia="1 1 1"/></body></worldbody></mujoco>"""


def test_dtypes_bases_and_gravity(tmp_path):
    """Leaves have the dtype given; a fixed base has no free joint; the torque of gravity is m g l sin(q)."""
    for name, text in (("r.urdf", URDF.format("")), ("m.sdf", SDF), ("b.xml", MJCF)):
        (tmp_path / name).write_text(text)
    readers = (
        lambda dtype: jd.io.load(tmp_path / "r.urdf", dtype=dtype).system,
        lambda dtype: jd.load(tmp_path / "b.xml", dtype=dtype).system,
        lambda dtype: jd.load(tmp_path / "m.sdf", dtype=dtype).system,
    )
    for read in readers:
        assert read(jnp.float32).home.dtype == np.float32 and read(jnp.float64).home.dtype == np.float64
    with pytest.warns(DeprecationWarning, match="load_sdf is deprecated"):
        assert jd.io.load_sdf(tmp_path / "m.sdf").system.nv == 7
    with pytest.warns(DeprecationWarning, match="load_urdf is deprecated"):
        assert jd.load_urdf(tmp_path / "r.urdf").nv == 1
    assert jd.load_model(tmp_path / "m.sdf", floating_base=False).nv == jd.load_model(tmp_path / "b.xml").nv == 1
    assert jd.load(tmp_path / "m.sdf", floating_base=False).system.nv == 1
    for g in (1.62, 9.81):
        model = jd.io.load(tmp_path / "r.urdf", gravity=(0.0, 0.0, -g)).system
        torque = jd.gravity_force(model, jnp.array([0.3]))
        np.testing.assert_allclose(torque, [-2 * g * 0.5 * np.sin(0.3)], rtol=1e-12)


def test_every_reader_names_what_it_does_not_read(tmp_path):
    """`load_model` and `load` in the same words, of a misspelt element and of an attribute; both are silent without any."""
    path = tmp_path / "r.urdf"
    path.write_text(URDF.format('<dynamics dampng="3"/><limt effort="1"/>'))
    words = []
    for read in (jd.load, jd.load_model, jd.io.load):
        with pytest.warns(jd.io.NotTakenWarning) as caught:
            read(path)
        words.append([str(one.message) for one in caught])
    assert words[0] == words[1] == words[2] and len(words[0]) == 1
    assert "attribute dampng of <dynamics>: j; unknown <limt> in <joint>: j" in words[0][0]
    path.write_text(URDF.format(""))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for read in (jd.load, jd.load_model):
            read(path)


def test_the_model_of_a_log_says_which_columns_are_angles(tmp_path):
    """Jumps of 2 pi are unwrapped in a joint that turns; without a model any column may be one, of a slide none is."""
    t = np.linspace(0, 2, 401)
    angle = 4.0 * t
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    path = tmp_path / "log.csv"
    np.savetxt(path, np.stack([t, wrapped, np.cos(t)], 1), delimiter=",", header="t,q1,tau1", comments="")

    def model(kind):
        builder = jd.ModelBuilder("one")
        builder.add_body("a", None, kind, (1.0, (0, 0, 0), (0.1, 0.1, 0.1)), axis=(0, 0, 1))
        return builder.build()

    with pytest.warns(jd.identify.LogWarning, match="unwrapped"):
        log = jd.read_log(path, model=model("revolute"))
    np.testing.assert_allclose(log.q[:, 0], angle, atol=1e-9)
    with pytest.raises(ValueError, match="jump"):
        jd.read_log(path, model=model("prismatic"))
