"""Each element and attribute of a file is read, refused, in `not_taken`, or has no effect on the motion."""

import pathlib
import re
import warnings

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.io import unread
from jaxdyn.io.unread import Left, Part

SOURCES = pathlib.Path(jd.__file__).parent / "io"

# The elements of the formats' own descriptions (sdformat.org, versions 1.4 to 1.12; wiki.ros.org/urdf/XML).
FORMATS = {
    "SDF_LINK": "pose inertial gravity enable_wind self_collide kinematic must_be_base_link velocity_decay collision "
    "visual sensor projector audio_sink audio_source battery light particle_emitter",
    "SDF_LINK inertial": "pose mass inertia density auto_inertia_params fluid_added_mass",
    "SDF_LINK inertial inertia": "ixx ixy ixz iyy iyz izz",
    "SDF_LINK velocity_decay": "linear angular",
    "SDF_JOINT": "parent child gearbox_ratio gearbox_reference_body thread_pitch screw_thread_pitch axis axis2 physics "
    "pose sensor",
    "SDF_JOINT axis": "xyz dynamics limit mimic use_parent_model_frame initial_position",
    "SDF_JOINT axis dynamics": "damping friction spring_reference spring_stiffness",
    "SDF_JOINT axis limit": "lower upper effort velocity stiffness dissipation",
    "SDF_JOINT axis mimic": "multiplier offset reference",
    "SDF_JOINT physics": "simbody ode provide_feedback",
    "SDF_JOINT physics ode": "provide_feedback cfm_damping implicit_spring_damper fudge_factor cfm erp bounce max_force "
    "velocity limit suspension",
    "SDF_MODEL": "static self_collide allow_auto_disable frame pose link joint plugin gripper include model enable_wind",
    "SDF_FRAME": "pose",
    "SDF_WORLD": "audio wind include gravity magnetic_field atmosphere gui physics scene light frame joint model actor "
    "plugin road spherical_coordinates state population",
    "URDF_LINK": "inertial visual collision",
    "URDF_LINK inertial": "origin mass inertia",
    "URDF_JOINT": "origin parent child axis calibration dynamics limit mimic safety_controller",
    "URDF_ROBOT": "link joint gazebo material transmission",
}
ATTRIBUTES = {
    "SDF_LINK inertial": "auto",
    "SDF_LINK pose": "relative_to degrees rotation_format",
    "SDF_JOINT": "name type",
    "SDF_JOINT axis xyz": "expressed_in",
    "SDF_JOINT axis mimic": "joint axis",
    "SDF_MODEL": "name namespace canonical_link placement_frame",
    "SDF_FRAME": "name attached_to",
    "URDF_LINK inertial origin": "xyz rpy",
    "URDF_LINK inertial mass": "value",
    "URDF_LINK inertial inertia": "ixx ixy ixz iyy iyz izz",
    "URDF_JOINT axis": "xyz",
    "URDF_JOINT limit": "lower upper effort velocity",
    "URDF_JOINT dynamics": "damping friction",
    "URDF_JOINT mimic": "joint multiplier offset",
}


def part(path: str):
    table, *tags = path.split()
    entry = getattr(unread, table)
    for tag in tags:
        entry = entry.children[tag]
    return entry


def leaves(entry, path=()):
    """All entries of a table below a part, with the tags on the way."""
    for tag, child in entry.children.items():
        yield (*path, tag), child
        if isinstance(child, Part):
            yield from leaves(child, (*path, tag))


def test_tables_have_all_elements_of_the_formats():
    for path, words in FORMATS.items():
        assert set(words.split()) <= part(path).children.keys(), path
    for path, words in ATTRIBUTES.items():
        assert set(words.split()) <= set(part(path).attributes), path


def test_parts_that_count_as_read_occur_in_the_readers():
    """A table that calls an element read, and a reader that does not know its name, contradict each other."""
    text = "".join(path.read_text() for path in sorted(SOURCES.glob("*.py")) if path.name != "unread.py")
    for name in ("SDF_LINK", "SDF_JOINT", "SDF_MODEL", "SDF_FRAME", "SDF_WORLD", "URDF_LINK", "URDF_JOINT"):
        for path, entry in leaves(getattr(unread, name)):
            if isinstance(entry, Part) and not entry.children:
                words = [path[-1], *(x for x in entry.attributes if x not in ("name", "namespace", "version"))]
                for word in words:
                    assert re.search(rf"\b{word}\b", text), (name, path, word)


def load(path, text: str):
    path.write_text(text, encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return jd.load(path)


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
        "is relative to 'b'; give it in the link's frame",
    ),
    "second inertial": (sdf(INERTIAL + INERTIAL), "a second <inertial> of 'a', the first is on line 1; keep one"),
    "second mass": (sdf("<inertial><mass>1</mass><mass>2</mass></inertial>"), "a second <mass> of 'a'"),
    "axis of an old version": (
        sdf(joint="<axis><xyz>0 1 0</xyz><use_parent_model_frame>1</use_parent_model_frame></axis>"),
        "is of versions 1.5 and 1.6; write expressed_in='__model__'",
    ),
    "frame of a pose": (
        sdf("<pose frame='m'>1 0 0 0 0 0</pose>"),
        "no settled meaning before version 1.7 and none after",
    ),
    "rotation": (
        sdf("<pose rotation_format='axis'>1 0 0 0 0 0</pose>"),
        "rotation_format 'axis'; give euler_rpy, or quat_xyzw",
    ),
    "degrees of a quaternion": (
        sdf("<pose degrees='1' rotation_format='quat_xyzw'>1 0 0 0 0 0 1</pose>"),
        "quat_xyzw' in degrees; give euler_rpy",
    ),
    "reserved link": (
        sdf(model="<link name='__model__'/>"),
        "the link name '__model__' is reserved by the format; rename it",
    ),
    "reserved root": (sdf(model="<link name='__root__'/>"), "the link name '__root__' is reserved"),
    "reserved frame": (sdf(model="<frame name='world'/>"), "the frame name 'world' is reserved"),
    "reserved joint": (
        sdf(model="<joint name='__x__' type='fixed'><parent>world</parent><child>a</child></joint>"),
        "the joint name '__x__' is reserved",
    ),
    "world that moves": (
        sdf(model="<link name='world'><pose>1 0 0 0 0 0</pose></link>"),
        "has a <pose>, but its name is that",
    ),
    "world with a mass": (
        sdf(model=f"<link name='world'>{INERTIAL}</link>"),
        "has an <inertial>, but its name is that of the world",
    ),
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


# Of the arrays of mujoco's compiled model: those without an effect on the motion of bodies (rendering, contacts and their solver,
# user data), those that the compiler derives from others, and those that the reader reads.
WITHOUT_EFFECT = """
    body_bvhadr body_bvhnum body_conaffinity body_contype body_margin body_user body_plugin jnt_group jnt_margin jnt_solimp
    jnt_solref jnt_user jnt_actgravcomp dof_solimp dof_solref site_dataid site_group site_matid site_rgba site_size site_type
    site_user tendon_group tendon_margin tendon_matid tendon_range tendon_rgba tendon_width tendon_user tendon_solimp_fri
    tendon_solimp_lim tendon_solref_fri tendon_solref_lim actuator_user actuator_actearly eq_solimp eq_solref sensor_user
    sensor_history sensor_historyadr sensor_plugin key_time key_mpos key_mquat key_plastic opt_ccd_iterations
    opt_ccd_tolerance opt_cone opt_enableflags opt_impratio opt_integrator opt_iterations opt_jacobian opt_ls_iterations
    opt_ls_tolerance opt_magnetic opt_noslip_iterations opt_noslip_tolerance opt_o_friction opt_o_margin opt_o_solimp
    opt_o_solref opt_sdf_initpoints opt_sdf_iterations opt_sleep_tolerance opt_solver opt_timestep opt_tolerance opt_wind
    opt_apirate
"""
DERIVED = """
    body_dofadr body_dofnum body_geomadr body_geomnum body_invweight0 body_rootid body_simple body_subtreemass body_treeid
    body_weldid jnt_actuatorid jnt_springyield dof_M0 dof_Madr dof_bodyid dof_invweight0 dof_length dof_parentid dof_simplenum
    dof_treeid site_sameframe tendon_actfrcrange tendon_actuatorid tendon_invweight0 tendon_springyield tendon_treeid
    tendon_treenum tendon_type actuator_acc0 actuator_cranklength actuator_ctrlspec actuator_history actuator_historyadr
    actuator_length0 actuator_lengthrange actuator_outadr sensor_adr sensor_datatype sensor_dim sensor_intprm sensor_needstage
    sensor_reftype body_dofnum tendon_dampingpoly
"""


def test_arrays_of_compiled_models_are_read_or_without_effect():
    """A release of mujoco with another array has it here, or fails."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    text = "".join(path.read_text() for path in sorted(SOURCES.glob("mjcf*.py")))
    known = {*WITHOUT_EFFECT.split(), *DERIVED.split()}
    prefixes = ("body_", "jnt_", "dof_", "site_", "tendon_", "wrap_", "actuator_", "eq_", "sensor_", "key_")
    names = [name for name in dir(model) if name.startswith(prefixes)]
    names += [f"opt_{name}" for name in dir(model.opt) if not name.startswith("_")]
    for name in names:
        word = name.replace("opt_", "opt.") if name.startswith("opt_") else name
        assert name in known or word in text or f'"{name.removeprefix("opt_")}"' in text, name


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
