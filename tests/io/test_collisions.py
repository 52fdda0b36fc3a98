"""Contacts of collision shapes of files with the ground: shapes, friction, choice, and what is left out."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from loading import silent

import jaxdyn as jd
from jaxdyn.contact.shapes import hull_vertices

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
SIZES = {
    "box": 'size="0.2 0.3 0.1"',
    "sphere": 'radius="0.1"',
    "cylinder": 'radius="0.1" length="0.3"',
    "capsule": 'radius="0.1" length="0.3"',
    "mesh": 'filename="hull.obj" scale="2 1 1"',
}
COUNTS = {"box": 8, "sphere": 1, "cylinder": 8, "capsule": 2, "mesh": 4, "ellipsoid": 1}
TETRAHEDRON = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]])
OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in TETRAHEDRON) + "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def gaps_of(scene, q):
    """Gap of each contact of a scene by name."""
    touching = touching_of(scene)
    return jax.jit(lambda q: {k: one.contact.position(scene.system, q, 0.0)[0] for k, one in touching.items()})(q)


def touching_of(scene):
    """Contacts of a scene by name."""
    return {force.name: force for force in scene.forces if isinstance(force, jd.contact.UnilateralContact)}


@pytest.fixture
def urdf(tmp_path):
    """A robot of one link for each shape on a slide, which is turned and displaced."""
    links, joints = "", ""
    for name, size in SIZES.items():
        links += f"""<link name="{name}">{INERTIAL}<collision><origin xyz="0 0 0.5" rpy="0.3 0 0"/><geometry>
            <{name} {size}/></geometry></collision></link>"""
        joints += f"""<joint name="j_{name}" type="prismatic"><parent link="base"/><child link="{name}"/><axis xyz="0 0 1"/>
            <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>"""
    (tmp_path / "hull.obj").write_text(OBJ)
    path = tmp_path / "robot.urdf"
    path.write_text(
        f"""<robot name="r"><link name="base"><collision><geometry><box size="1 1 1"/></geometry></collision></link>{links}
        {joints}<gazebo reference="box"><mu1>0.4</mu1></gazebo></robot>"""
    )
    return path


def test_urdf_shapes_touch_the_ground(urdf):
    """Every kind, its friction and its gaps in closed form; the fixed base is named."""
    pytest.importorskip("trimesh")
    scene = silent(urdf, contacts="ground")
    assert any("collision shapes without contacts: base (fixed)" in line for line in scene.not_taken)
    touching = touching_of(scene)
    c, s, distances = np.cos(0.3), np.sin(0.3), gaps_of(scene, jnp.full(5, 0.2))
    least = {
        "box": 0.7 - 0.15 * s - 0.05 * c,
        "sphere": 0.6,
        "cylinder": 0.7 - 0.15 * c - 0.1 * s,
        "capsule": 0.7 - 0.15 * c - 0.1,
        "mesh": 0.7,
    }
    for name in SIZES:
        own = [one for key, one in touching.items() if key.split()[0] == name]
        assert len(own) == COUNTS[name]
        assert {float(one.coefficient) for one in own} == {0.4 if name == "box" else 1.0}
        gaps = [distances[key] for key in distances if key.split()[0] == name]
        np.testing.assert_allclose(min(gaps), least[name], atol=1e-12)


def test_chosen_links_and_refusals(urdf):
    """Only named links have contacts; names and values that do not fit are refused."""
    scene = silent(urdf, contacts=["sphere", "capsule"])
    assert set(touching_of(scene)) == {"sphere", "capsule 0", "capsule 1"}
    assert not touching_of(silent(urdf))
    with pytest.raises(ValueError, match=r"'sphre' .*mean sphere"):
        silent(urdf, contacts=["sphre"])
    for wrong in ("floor", 3, [1]):
        with pytest.raises(ValueError, match="give 'ground'"):
            silent(urdf, contacts=wrong)
    with pytest.raises(ValueError, match=r"contacts\['sphere'\] is 0"):
        silent(urdf, contacts={"sphere": 0})
    lowest = touching_of(silent(urdf, contacts={"sphere": 1, "box": 4}))
    assert sorted(lowest) == ["box 0", "box 1", "box 2", "box 3", "sphere"]


def test_ground_for_a_whole_robot_asks_for_the_links_that_touch(tmp_path):
    """Nine boxes have 72 contacts: the error names the links; a list of them, or their lowest corners, is taken."""
    links = [f"leg {i}" for i in range(9)]
    parts = [
        f"""<link name="{name}">{INERTIAL}<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
        <joint name="j {name}" type="prismatic"><parent link="base"/><child link="{name}"/><axis xyz="0 0 1"/>
        <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>"""
        for name in links
    ]
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="r"><link name="base"/>{"".join(parts)}</robot>')
    with pytest.raises(ValueError, match=r"72 contacts.*List the links"):
        silent(path, contacts="ground")
    assert len(touching_of(silent(path, contacts=links))) == 72
    assert len(touching_of(silent(path, contacts=dict.fromkeys(links, 4)))) == 36


def test_meshes_that_cannot_be_read_are_named(urdf):
    """A missing file; a hull of many vertices, of which twelve are contacts."""
    pytest.importorskip("trimesh")
    (urdf.parent / "hull.obj").unlink()
    scene = silent(urdf, contacts="ground")
    assert any("mesh 'hull.obj' (no such file)" in line for line in scene.not_taken)
    points = np.random.default_rng(0).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    hull, count, error = hull_vertices(0.1 * points, 12)
    assert (len(hull), count) == (12, 500) and 0.01 < error < 0.04
    # The error is the largest lack of the support function.
    directions = np.random.default_rng(1).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    lack = (0.1 * points @ directions.T).max(0) - (hull @ directions.T).max(0)
    assert -1e-15 <= lack.min() and abs(lack.max() - error) < 2e-3
    cube = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    hull, count, error = hull_vertices(np.concatenate([cube, cube, [[0.5, 0.5, 0.5]]]), 12)
    assert (len(hull), count, error) == (8, 8, 0.0)
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    assert len(hull_vertices(flat, 12)[0]) == 3


SDF = """<sdf version="1.9"><world name="w"><gravity>0 0 -9.8</gravity>
<model name="floor"><static>true</static><link name="slab"><collision name="c"><pose>0 0 0.1 0 0 0</pose><geometry><plane>
<normal>0.6 0 0.8</normal></plane></geometry>{floor}</collision></link></model>
<model name="m"><link name="b"><inertial><mass>1</mass></inertial>
{collisions}</link></model></world></sdf>"""
COLLISION = "<collision name='{0}'><geometry><{0}>{1}</{0}></geometry><surface>{2}</surface></collision>"


def friction(mu, more=""):
    return f"<friction><ode><mu>{mu}</mu>{more}</ode></friction>"


def test_sdf_shapes_touch_a_plane(tmp_path):
    """Every kind on an inclined plane of the world; the smaller coefficient; what is left out."""
    path = tmp_path / "w.sdf"
    parts = {
        "box": "<size>0.2 0.3 0.1</size>",
        "sphere": "<radius>0.1</radius>",
        "cylinder": "<radius>0.1</radius><length>0.3</length>",
        "capsule": "<radius>0.1</radius><length>0.3</length>",
        "ellipsoid": "<radii>0.1 0.2 0.3</radii>",
        "cone": "<radius>1</radius><length>1</length>",
    }
    bounce = "<bounce><restitution_coefficient>0.5</restitution_coefficient></bounce>"
    surface = {"box": friction(0.3, "<mu2>0.2</mu2>"), "sphere": friction(0.9), "capsule": bounce}
    text = "".join(COLLISION.format(name, size, surface.get(name, "")) for name, size in parts.items())
    path.write_text(SDF.format(floor=f"<surface>{friction(0.7)}</surface>", collisions=text))
    scene = silent(path, contacts="ground")
    touching = touching_of(scene)
    counts = [len([key for key in touching if key.startswith(f"m::b {i}")]) for i in range(5)]
    assert counts == [8, 1, 8, 2, 1] and len(touching) == 20
    assert float(touching["m::b 0 0"].coefficient) == 0.3 and float(touching["m::b 1"].coefficient) == 0.7
    q = jnp.array([0.5, 0.1, 1.0, 1, 0, 0, 0])
    gap = float(touching["m::b 1"].contact.position(scene.system, q, 0.0)[0])
    np.testing.assert_allclose(gap, 0.6 * 0.5 + 0.8 * (1.0 - 0.1) - 0.1, atol=1e-15)
    # The egg: its centre less its support function.
    gap = float(touching["m::b 4"].contact.position(scene.system, q, 0.0)[0])
    np.testing.assert_allclose(gap, 0.6 * 0.5 + 0.8 * 0.9 - np.hypot(0.06, 0.24), atol=1e-15)
    lines = "; ".join(scene.not_taken)
    for words in ("<cone> of link 'm::b'", "in a second direction: m::b", "restitution of collisions: m::b"):
        assert words in lines
    assert "<collision> of links" not in lines
    assert "<collision> of links: floor::slab, m::b" in "; ".join(silent(path).not_taken)
    with pytest.warns(jd.io.NotTakenWarning, match="cone"):
        assert len(touching_of(jd.load(path, contacts=["m::b"]))) == 20


MJCF = """<mujoco><asset><mesh name="t" vertex="0 0 0  0.1 0 0  0 0.2 0  0 0 0.3"/>
<hfield name="h" nrow="3" ncol="4" size="1 2 0.5 0.1" elevation="0 1 2 0  1 1 2 2  0 0 2 1"/></asset>
<default><geom friction="0.6 0.005 0.0001"/></default>
<worldbody>{ground}<geom name="wall" type="box" size="1 1 1" pos="5 0 0"/>
<body name="b" pos="0 0 2"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
<geom type="box" size="0.1 0.15 0.05"/><geom type="sphere" size="0.1" friction="0.9"/>
<geom type="cylinder" size="0.1 0.15"/><geom type="capsule" size="0.1 0.15" condim="1"/>
<geom type="ellipsoid" size="0.1 0.2 0.3" contype="0" conaffinity="0"/>
<geom type="mesh" mesh="t" condim="6"/></body>
<body name="c" pos="0 0 3"><freejoint/><geom name="ball" size="0.2" contype="2" conaffinity="2"/></body>
<body name="d" pos="0 0 4"><freejoint/><geom name="last" size="0.2" priority="1" friction="0.25"/></body>
</worldbody>{more}</mujoco>"""
FLOOR = '<geom name="floor" type="plane" size="1 1 1" friction="0.7" euler="0 30 0"/>'


def test_mjcf_geoms_touch_a_plane(tmp_path):
    """Every kind, with MuJoCo's rules: bits, condim, priority, pairs, exclusions; distances are those of MuJoCo."""
    path = tmp_path / "scene.xml"
    path.write_text(MJCF.format(ground=FLOOR, more=""))
    scene = silent(path, contacts="ground")
    touching = touching_of(scene)
    assert len(touching) == 8 + 1 + 8 + 2 + 4 + 1
    assert float(touching["b 0 0"].coefficient) == 0.7 and float(touching["b 1"].coefficient) == 0.9
    assert float(touching["b 3 0"].coefficient) == 0.7 and float(touching["d"].coefficient) == 0.25
    assert not any(name.startswith("c") for name in touching)  # bits that do not match
    lines = "; ".join(scene.not_taken)
    assert "collision shapes without contacts: world (fixed)" in lines and "contact geometry of bodies: c" in lines
    assert "torsional and rolling friction of bodies: b" in lines
    assert "contact geometry of bodies: world, b, c, d" in "; ".join(silent(path).not_taken)
    m = mujoco.MjModel.from_xml_path(str(path))
    m.geom_margin[:] = 10.0
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    floor, ours = m.geom("floor").id, {}
    for name, gap in gaps_of(scene, scene.starts["reference"].q).items():
        key = int(name.split()[1]) if name.startswith("b") else 7
        ours[key] = min(ours.get(key, np.inf), float(gap))
    theirs = {}
    for contact in d.contact[: d.ncon]:
        if floor in contact.geom:
            g = int(contact.geom.sum()) - floor - 2
            theirs[g] = min(theirs.get(g, np.inf), contact.dist)
    names = {0: 0, 1: 1, 2: 2, 3: 3, 5: 4, 7: 7}  # the ellipsoid has no contacts, and so no number
    for g, k in names.items():
        np.testing.assert_allclose(ours[k], theirs[g], atol=1e-7 if g == 5 else 1e-10)  # meshes are in float32
    rules = '<contact><pair geom1="floor" geom2="ball" friction="0.3 0.3 0 0 0"/><exclude body1="world" body2="d"/></contact>'
    path.write_text(MJCF.format(ground=FLOOR, more=rules))
    with pytest.warns(jd.io.NotTakenWarning, match=r"world \(fixed\)"):
        touching = touching_of(jd.load(path, contacts=["c", "d"]))
    assert set(touching) == {"c"} and float(touching["c"].coefficient) == 0.3


@pytest.mark.parametrize("second", [0.2, 0.3])
def test_mjcf_override_of_friction_is_mujocos(second, tmp_path):
    """Of all geoms and pairs, by priority or not; another coefficient in the second direction is named."""
    path = tmp_path / "scene.xml"
    pairs = '<contact><pair geom1="floor" geom2="ball" friction="0.6 0.5 0 0 0"/></contact>'
    override = f'<option o_friction="0.2 {second}" o_margin="10"><flag override="{{}}able"/></option>'
    for flag, ball in (("dis", 0.6), ("en", 0.2)):
        path.write_text(MJCF.format(ground=FLOOR, more=pairs + override.format(flag)))
        scene = silent(path, contacts="ground")
        touching = touching_of(scene)
        m = mujoco.MjModel.from_xml_path(str(path))
        m.geom_margin[:] = m.pair_margin[:] = 10.0
        mujoco.mj_forward(m, d := mujoco.MjData(m))
        theirs = {m.body(m.geom_bodyid[contact.geom].max()).name: set() for contact in d.contact}
        for contact in d.contact:
            if m.geom("floor").id in contact.geom:
                theirs[m.body(m.geom_bodyid[contact.geom].max()).name].add(contact.friction[0])
        for name in "bcd":
            assert {float(one.coefficient) for key, one in touching.items() if key[0] == name} == theirs[name]
        assert theirs["c"] == {ball}
        named = [line for line in scene.not_taken if line.startswith("friction of bodies in a second direction: ")]
        expected = ["b, c, d"] if flag == "en" and second == 0.3 else [] if flag == "en" else ["c"]
        assert [line.partition(": ")[2] for line in named] == expected


def test_mjcf_height_fields_and_no_ground(tmp_path):
    """Heights at the nodes and a plane z = 0 where the file has none; a file that disables contacts."""
    path = tmp_path / "scene.xml"
    field = '<geom type="hfield" hfield="h" pos="0 0 0.25"/>'
    path.write_text(MJCF.format(ground=field, more=""))
    touching = touching_of(silent(path, contacts=["d"]))
    on = touching["d"].contact.on
    assert isinstance(on, jd.contact.HeightField)
    m = mujoco.MjModel.from_xml_path(str(path))
    d = mujoco.MjData(m)
    mujoco.mj_kinematics(m, d)
    for y in (-2.0, 0.0, 2.0):
        for x in (-1.0, -1 / 3, 1 / 3, 1.0):
            # MuJoCo's surface is of triangles: a ray down to a node, just inside of the edge.
            start, hit = np.array([x, y, 1.9]) * [1 - 1e-9, 1 - 1e-9, 1], np.zeros(1, np.int32)
            height = 1.9 - mujoco.mj_ray(m, d, start, np.array([0, 0, -1.0]), None, 1, -1, hit) - 0.25
            np.testing.assert_allclose(on.height(jnp.array([x, y])), height, atol=1e-7)
    np.testing.assert_allclose(touching["d"].contact.surface[2, 3], 0.25)
    path.write_text(MJCF.format(ground="", more=""))
    scene = silent(path, contacts=["d"])
    contact = touching_of(scene)["d"].contact
    assert isinstance(contact.on, jd.contact.Plane)
    np.testing.assert_allclose(contact.position(scene.system, scene.starts["reference"].q, 0.0), 3.8, atol=1e-15)
    path.write_text(MJCF.format(ground=FLOOR, more='<option><flag contact="disable"/></option>'))
    scene = silent(path, contacts="ground")
    assert not touching_of(scene) and "contacts, which the file disables" in scene.not_taken
