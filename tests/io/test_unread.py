"""Each element and attribute of a file is read, refused, in `not_taken`, or has no effect on the motion."""

import re

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from loading import silent

import jaxdyn as jd
from jaxdyn.io import unread
from jaxdyn.io.unread import Left, Part


def load(path, text: str):
    path.write_text(text, encoding="utf-8")
    return silent(path)


INERTIAL = "<inertial><mass>2</mass></inertial>"


def sdf(link="", joint="", model="", world="", root="", version="1.11") -> str:
    """A pendulum with more in some of its elements."""
    link = link if "<inertial" in link else INERTIAL + link
    axis = "" if "<axis>" in joint else "<axis><xyz>0 1 0</xyz></axis>"
    hinge = f"<joint name='j' type='revolute'><parent>world</parent><child>a</child>{axis}{joint}</joint>"
    models = f"<model name='m'><link name='a'>{link}</link>{hinge}{model}</model>"
    world = f"<world name='w'>{models}{world}</world>" if world else models
    return f"<sdf version='{version}'>{world}{root}</sdf>"


def within(path, tag: str) -> str:
    """An element with a value that is no default, inside of its parents."""
    text = f"<{tag} name='x'><uri>x</uri>0.7</{tag}>"
    if isinstance(path[-1][1], Left) and path[-1][1].default is not None:
        default = path[-1][1].default
        text = f"<{tag}>{str(not default).lower() if isinstance(default, bool) else 0.7}</{tag}>"
    for outer, _ in reversed(path[:-1]):
        xyz = "<xyz>0 1 0</xyz>" if outer == "axis" else ""
        text = f"<{outer}>{xyz}{text}</{outer}>"
    return text


def reported(table: str) -> list:
    """Entries of a table that are reported, with their parents' tags."""
    found = []

    def visit(entry, path):
        for tag, child in entry.children.items():
            if isinstance(child, Left):
                found.append(((*path, (tag, child)), tag, child.words))
            elif isinstance(child, Part) and tag != "axis2":  # another joint's
                visit(child, (*path, (tag, child)))

    visit(getattr(unread, table), ())
    return found


@pytest.mark.parametrize("table", ["SDF_LINK", "SDF_JOINT", "SDF_MODEL", "SDF_WORLD", "SDF_ROOT", "URDF_GAZEBO"])
def test_what_is_left_out_is_named(table, tmp_path):
    for path, tag, words in reported(table):
        if table == "URDF_GAZEBO":
            text = f"<robot name='r'><link name='a'/><gazebo reference='a'>{within(path, tag)}</gazebo></robot>"
            scene = load(tmp_path / "r.urdf", text)
        else:
            scene = load(tmp_path / "r.sdf", sdf(**{table.partition("_")[2].lower(): within(path, tag)}))
        assert any(line.startswith(words) for line in scene.not_taken), (tag, scene.not_taken)


@pytest.mark.parametrize("place", ["link", "joint", "model", "world", "root"])
def test_what_the_format_lacks_is_named(place, tmp_path):
    """Misspelt elements, attributes and extensions; plain files give no warning."""
    assert load(tmp_path / "plain.sdf", sdf()).not_taken == ()
    scene = load(tmp_path / "r.sdf", sdf(**{place: "<dampng>1</dampng>"}))
    assert any(line.startswith("unknown <dampng> in") for line in scene.not_taken)
    scene = load(tmp_path / "r.sdf", sdf(joint="<axis><xyz unit='deg'>0 1 0</xyz></axis>"))
    assert "attribute unit of <xyz>: j" in scene.not_taken
    urdf = """<robot name='r' xmlns:drake='d'><link name='a'/><link name='b' concave='yes'>
      <inertial><mass value='1' unit='g'/><inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/></inertial>
      <visual><anything/></visual></link>
      <joint name='j' type='continuous'><parent link='a'/><child link='b'/><dynamics dampng='3' stiffness='2'/>
      <drake:rotor_inertia value='0.1'/></joint></robot>"""
    assert load(tmp_path / "r.urdf", urdf).not_taken == (
        "attribute concave of <link>: b",
        "attribute unit of <mass>: b",
        "attribute dampng of <dynamics>: j",
        "attribute stiffness of <dynamics>: j",
        "unknown <drake:rotor_inertia> in <joint>: j",
    )


REFUSED = {
    "pose of an inertial in another frame": (
        sdf("<inertial><pose relative_to='b'>1 0 0 0 0 0</pose><mass>1</mass></inertial>"),
        "is relative to 'b'",
    ),
    "second mass": (sdf("<inertial><mass>1</mass><mass>2</mass></inertial>"), "a second <mass>"),
    "axis of an old version": (
        sdf(joint="<axis><xyz>0 1 0</xyz><use_parent_model_frame>1</use_parent_model_frame></axis>"),
        "is of versions 1.5 and 1.6; write expressed_in='__model__'",
    ),
    "frame of a pose": (sdf("<pose frame='m'>1 0 0 0 0 0</pose>"), "no settled meaning"),
    "rotation": (sdf("<pose rotation_format='axis'>1 0 0 0 0 0</pose>"), "rotation_format 'axis'"),
    "degrees of a quaternion": (
        sdf("<pose degrees='1' rotation_format='quat_xyzw'>1 0 0 0 0 0 1</pose>"),
        "quat_xyzw' in degrees",
    ),
    "reserved link": (sdf(model="<link name='__model__'/>"), "the link name '__model__' is reserved"),
    "reserved frame": (sdf(model="<frame name='world'/>"), "the frame name 'world' is reserved"),
    "world that moves": (sdf(model="<link name='world'><pose>1 0 0 0 0 0</pose></link>"), "has a <pose>"),
    "world with a mass": (sdf(model=f"<link name='world'>{INERTIAL}</link>"), "has an <inertial>"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_would_change_the_motion_is_refused(case, tmp_path):
    text, words = REFUSED[case]
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        load(tmp_path / "r.sdf", text)
    assert re.match(r".*r\.sdf:\d+: ", str(caught.value))


def test_a_link_of_the_world_is_the_world(tmp_path):
    """Joints to it go to the world, and it is no second body."""
    named = load(tmp_path / "r.sdf", sdf(model="<link name='world'/>", version="1.6"))
    plain = load(tmp_path / "p.sdf", sdf(version="1.6"))
    assert named.system.nv == 1 and named.system.body_names == ("a",)
    assert "links with the reserved name of the world, which they stand for: world" in named.not_taken
    q = jnp.array([0.3])
    np.testing.assert_allclose(jd.mass_matrix(named.system, q), jd.mass_matrix(plain.system, q), rtol=1e-15)


def test_gravity_of_old_worlds(tmp_path):
    """Up to version 1.5 it is an element of <physics>; later ones have it in the world."""
    physics = "<physics type='ode'><gravity>0 0 -3.7</gravity></physics>"
    for version, expected in (("1.4", -3.7), ("1.5", -3.7), ("1.6", -9.8), ("1.9", -9.8)):
        scene = load(tmp_path / "r.sdf", sdf(world=physics, version=version))
        np.testing.assert_allclose(scene.system.gravity, [0, 0, expected])


def test_flags_of_mjcf_files(tmp_path):
    """Without constraints MuJoCo has no dry friction and no equalities; intervals of sensors are named."""
    body = "<body name='a'><joint name='j' axis='0 1 0' frictionloss='0.3'/><geom size='0.1' pos='0.3 0 0' contype='0'/></body>"
    for flag in ("constraint", "frictionloss"):
        text = f"<mujoco><option><flag {flag}='disable'/></option><worldbody>{body}</worldbody></mujoco>"
        scene = load(tmp_path / "r.xml", text)
        assert scene.forces == ()
        model = mujoco.MjModel.from_xml_path(str(tmp_path / "r.xml"))
        data = mujoco.MjData(model)
        data.qvel[:] = 1.0
        mujoco.mj_forward(model, data)
        found = jd.constrained_dynamics(scene, jnp.zeros(1), jnp.ones(1)).acceleration
        np.testing.assert_allclose(found, data.qacc, rtol=1e-12)
    sensors = "<sensor><jointpos name='s' joint='j' interval='0.1'/></sensor>"
    scene = load(tmp_path / "r.xml", f"<mujoco><worldbody>{body}</worldbody>{sensors}</mujoco>")
    assert "interval of sensors: s" in scene.not_taken
