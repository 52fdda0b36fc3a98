"""Pictures: solids of files and of inertias, drawings, pages for a browser."""

import base64
import re
import shutil
import subprocess
import urllib.request
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import jaxdyn as jd
from jaxdyn.model import host_math
from jaxdyn.pictures import default_solids, motion, stage
from jaxdyn.pictures.drawing import cone_sides, scale_forces
from jaxdyn.pictures.solids import SIZES, merge_meshes, refine, sharpen, simplify


def volume(vertices, faces) -> float:
    """Volume by the divergence theorem: positive where triangles run counter-clockwise from outside."""
    return float(np.einsum("ni,ni->", vertices[faces[:, 0]], np.cross(*(vertices[faces[:, k]] for k in (1, 2)))) / 6)


def inertia_of(vertices, faces, mass: float) -> np.ndarray:
    """Inertia (3, 3) about the origin of a uniform solid of triangles: sums over its tetrahedra from the origin."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    six = np.einsum("ni,ni->n", a, np.cross(b, c))
    total = a + b + c
    second = sum(np.einsum("n,ni,nj->ij", six, x, x) for x in (a, b, c, total)) / 120
    second = second * mass / (six.sum() / 6)
    return np.trace(second) * np.eye(3) - second


@pytest.mark.parametrize(
    ("kind", "size", "exact"),
    [
        ("box", (0.1, 0.2, 0.3), 0.006),
        ("ellipsoid", (0.1, 0.2, 0.3), 4 / 3 * np.pi * 0.006),
        ("cylinder", (0.2, 0.5), np.pi * 0.04 * 0.5),
        ("capsule", (0.2, 0.5), np.pi * 0.04 * 0.5 + 4 / 3 * np.pi * 0.008),
    ],
)
def test_triangles_of_solids_enclose_their_volume(kind, size, exact):
    pose = host_math.pose_matrix(((0.3, -0.2, 0.1), (0.3, 0.2, 0.5)), "pose")
    assert kind in SIZES
    vertices, faces = jd.pictures.Shape("body", kind, size, pose).triangles()
    # Polygons of 24 sides lie inside of their circles: 1.1 % of the area, 3 % of a ball.
    assert volume(vertices, faces) == pytest.approx(exact, rel=1e-12 if kind == "box" else 0.04)
    mirrored = jd.pictures.Shape("body", "mesh", (1.0, -1.0, 1.0), pose, vertices=vertices, faces=faces)
    assert volume(*mirrored.triangles()) > 0
    again = sharpen(*merge_meshes([(vertices, faces)]))
    assert volume(*again) == pytest.approx(volume(vertices, faces), rel=1e-12)


def test_simplified_meshes_are_small_and_close():
    vertices, faces = jd.pictures.Shape("b", "ellipsoid", (1.0, 0.8, 0.6)).triangles()
    few, triangles = simplify(vertices, faces, 100)
    assert len(few) <= 100 < len(vertices)
    assert np.abs(np.ptp(few, axis=0) / np.ptp(vertices, axis=0) - 1).max() < 0.15
    assert volume(few, triangles) == pytest.approx(volume(vertices, faces), rel=0.2)
    assert simplify(vertices, faces, 10_000)[0] is vertices


def solids_of(scene, given=()) -> jd.pictures.Shapes:
    """Solids that are drawn: those that are given, and of inertias where a body has none."""
    return default_solids.complete_solids(scene, jd.pictures.Shapes(given))


@pytest.mark.parametrize("moments", [(0.01, 0.02, 0.025), (0.02, 0.02, 0.03), (0.02, 0.02, 0.005), (0.02, 0.02, 0.02)])
def test_solids_of_inertia_have_that_inertia(moments):
    turn = host_math.rotation_from_rpy((0.3, -0.4, 0.9))
    com, mass = np.array([0.1, 0.05, -0.02]), 2.0
    inertia = (mass, com, turn @ np.diag(moments) @ turn.T)
    model = jd.ModelBuilder("one").add_body("body", joint="spherical", inertia=inertia).build()
    (solid,) = [shape for shape in solids_of(jd.Scene(model)) if shape.kind != "capsule"]
    vertices, faces = solid.triangles()
    computed = inertia_of(vertices - com, faces, mass)
    # Round solids are polygons of 24 sides.
    np.testing.assert_allclose(computed, inertia[2], atol=(1e-12 if solid.kind == "box" else 0.03) * max(moments))


def test_every_scene_of_bodies_has_solids_and_a_stage():
    """Without kinematics compiled: solids are on frames of the model, finite and right side out.

    Scenes are built here, not as the names of cases, since cases are collected by every process of the tests.
    """
    built = {name: getattr(jd.scenes, name)() for name in jd.scenes.names()}
    with_bodies = {name: scene for name, scene in built.items() if isinstance(scene.system, jd.Model)}
    assert len(with_bodies) > 20
    for name, scene in with_bodies.items():
        shapes = solids_of(scene)
        assert shapes and shapes.frames() <= set(scene.system.frame_names), name
        for shape in shapes:
            assert volume(*shape.triangles()) > 0, name


URDF = """<robot name="arm">
  <material name="red"><color rgba="0.8 0.1 0.1 1"/></material>
  <link name="base"><visual><geometry><cylinder radius="0.1" length="0.2"/></geometry></visual></link>
  <link name="upper">
    <inertial><origin xyz="0 0 0.25"/><mass value="1"/>
      <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.001"/></inertial>
    <visual><origin xyz="0 0 0.25" rpy="0 0 0.3"/><geometry><box size="0.1 0.1 0.5"/></geometry>
      <material name="red"/></visual>
    <visual><geometry><mesh filename="package://arm/part.obj" scale="2 2 2"/></geometry></visual>
  </link>
  <link name="tip"><visual><geometry><sphere radius="0.06"/></geometry></visual></link>
  <link name="lower">
    <inertial><origin xyz="0 0 0.2"/><mass value="1"/>
      <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.001"/></inertial>
    <visual><geometry><mesh filename="gone.stl"/></geometry></visual>
  </link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.5"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0 0 0.4"/></joint>
</robot>"""

OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture(scope="module")
def urdf(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("share") / "arm"
    folder.mkdir()
    (folder / "part.obj").write_text(OBJ)
    (folder / "arm.urdf").write_text(URDF)
    return folder / "arm.urdf"


@pytest.fixture(scope="module")
def solids(urdf) -> jd.pictures.Shapes:
    with pytest.warns(jd.io.NotTakenWarning, match=r"gone\.stl.*no such file"):
        return jd.pictures.shapes(urdf)


def test_solids_of_urdf(urdf, solids):
    pytest.importorskip("trimesh")
    assert [(shape.frame, shape.kind) for shape in solids] == [
        ("base", "cylinder"), ("upper", "box"), ("upper", "mesh"), ("tip", "ellipsoid")
    ]  # fmt: skip
    assert solids.missing == ("mesh 'gone.stl' (no such file)",)
    box, mesh = solids[1], solids[2]
    assert box.color == (0.8, 0.1, 0.1)
    assert volume(*box.triangles()) == pytest.approx(0.005, rel=1e-12)
    assert volume(*mesh.triangles()) == pytest.approx(8 / 6, rel=1e-12)  # twice as large as in its file
    np.testing.assert_allclose(box.pose[:3, :3], host_math.rotation_from_rpy((0, 0, 0.3)))
    # The lower arm has the tip's ball; nothing of inertia is added to bodies that have a solid.
    scene = jd.Scene(jd.load_model(urdf))
    assert {shape.source for shape in solids_of(scene, solids)} == {"file"}
    assert [shape.frame for shape in solids_of(scene, [box]) if shape.source == "inertia"] == ["lower"]


def test_solids_of_mjcf(tmp_path):
    pytest.importorskip("mujoco")
    path = tmp_path / "robot.xml"
    path.write_text("""<mujoco><asset><material name="blue" rgba="0 0 1 1"/>
      <mesh name="part" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/><mesh name="lost" file="lost.stl"/></asset><worldbody>
      <geom type="plane" size="1 1 1"/><geom type="box" size="0.1 0.2 0.3" pos="0 0 1"/>
      <body name="arm" pos="0 0 1"><joint axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.05" material="blue"/>
        <geom type="mesh" mesh="part" pos="0.1 0.2 0.3"/><geom type="mesh" mesh="lost" mass="0"/>
        <geom type="sphere" size="0.3" group="3"/></body></worldbody></mujoco>""")
    with pytest.warns(jd.io.NotTakenWarning, match=r"lost\.stl"):
        solids = jd.pictures.shapes(path)
    assert [(shape.frame, shape.kind) for shape in solids] == [(None, "box"), ("arm", "capsule"), ("arm", "mesh")]
    assert volume(*solids[0].triangles()) == pytest.approx(8 * 0.006, rel=1e-12)
    assert solids[1].color == (0.0, 0.0, 1.0) and solids[0].color is None
    # mujoco moves a mesh to its centre and turns it to its axes of inertia, and the geom with it.
    vertices = solids[2].triangles()[0]
    np.testing.assert_allclose(vertices.min(0), (0.1, 0.2, 0.3), atol=1e-6)  # of float32


def test_solids_of_sdf(tmp_path):
    path = tmp_path / "robot.sdf"
    path.write_text("""<sdf version='1.7'><model name='m'><link name='a'>
      <visual name='v'><pose>0 0 1 0 0 0</pose><geometry><box><size>1 2 3</size></box></geometry>
        <material><diffuse>0.2 0.3 0.4 1</diffuse></material><transparency>0.5</transparency></visual>
      <visual name='w'><geometry><sphere><radius>0.5</radius></sphere></geometry></visual>
      <visual name='x'><geometry><cylinder><radius>0.5</radius><length>2</length></cylinder></geometry></visual>
      <visual name='y'><geometry><mesh><uri>model://m/no.dae</uri></mesh></geometry></visual></link></model></sdf>""")
    with pytest.warns(jd.io.NotTakenWarning, match=r"model://m/no\.dae"):
        solids = jd.pictures.shapes(path)
    assert [shape.kind for shape in solids] == ["box", "ellipsoid", "cylinder"]
    assert solids[0].color == (0.2, 0.3, 0.4) and solids[0].opacity == 0.5
    np.testing.assert_allclose(solids[0].triangles()[0].max(0), (0.5, 1.0, 2.5))
    assert solids[2].size == (0.5, 2.0)


def test_shapes_refuse_what_they_cannot_read(tmp_path):
    path = tmp_path / "robot.urdf"
    text = "<robot name='r'><link name='a'><visual><geometry>\n{}</geometry></visual></link></robot>"
    for content, words in ((text.format("<box size='1 2'/>"), r":2: size .*give 3"), ("<html/>", "expected <robot>")):
        path.write_text(content)
        with pytest.raises(ValueError, match=rf"robot\.urdf.*{words}"):
            jd.pictures.shapes(path)
    (tmp_path / "broken.stl").write_bytes(b"no mesh")
    path.write_text(text.format("<mesh filename='broken.stl'/>"))
    with pytest.warns(jd.io.NotTakenWarning, match=r"broken\.stl"):
        assert jd.pictures.shapes(path) == ()


def solution_of(scene, qs, ts, **outputs) -> jd.Solution:
    """A solution made by hand, of one motion: what is drawn does not ask how a motion was found."""
    qs = jnp.asarray(qs)
    rates = jnp.zeros((len(qs), scene.nv))
    return jd.Solution(jnp.asarray(ts, float), qs, rates, jd.RESULTS.successful, {}, **outputs)


def batch_of(*solutions) -> jd.Solution:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *solutions)


@pytest.fixture(scope="module")
def turning():
    """A four-bar linkage, two motions of nine rows, with numbers for the forces of its loop and its joint torques."""
    scene = jd.scenes.four_bar()
    q, _ = jd.scenes.four_bar.start()
    rng = np.random.default_rng(0)
    qs = np.asarray(q) + 0.3 * np.sin(np.linspace(0, 3, 9))[None, :, None] * np.array([[[1.0, 0.5, -1]], [[0.5, 1, 1]]])
    forces = jnp.asarray(rng.normal(size=(2, 9, 2)))
    torque = jnp.asarray(rng.normal(size=(2, 9, 3)))
    ts = np.linspace(0.0, 0.4, 9)
    return scene, batch_of(*(solution_of(scene, qs[k], ts, multipliers=forces[k], torque=torque[k]) for k in range(2)))


def test_marks_and_forces_of_a_loop(turning):
    """The wrench of the multipliers does the work lam^T A dq along any displacement dq."""
    scene, solution = turning
    moved = motion.motion_of(scene, solution)
    (mark,) = motion.marks(moved)
    force, *torques = motion.forces(moved)
    assert mark.kind == "loop" and force.kind == "bearing"
    assert force.places.shape == force.vectors.shape == (2, 9, 3)
    np.testing.assert_array_equal(force.places, mark.b)
    rows = np.asarray(jd.constraint_jacobian(scene, solution.q[0, 0]))
    dq = 1e-6 * np.random.default_rng(0).normal(size=scene.nv)
    computed = []
    for sign in (1.0, -1.0):
        poses = motion.poses_of(scene.system, (np.asarray(solution.q[0, 0]) + sign * dq)[None])
        ends = scene.constraints[0].ends()
        first, second = (default_solids.frame_poses(scene.system, poses, body) @ np.asarray(at) for body, at in ends)
        computed.append((second - first)[0, :3, 3])
    work = force.vectors[0, 0] @ (computed[0] - computed[1]) / 2
    # A central difference over a step of 1e-6; the start closes the loop to rounding.
    assert work == pytest.approx(float(np.asarray(solution.multipliers[0, 0]) @ rows @ dq), rel=1e-6)
    # Torques are along the joints' axes, which are across the plane.
    assert [torque.name for torque in torques] == list(scene.system.joint_names)
    sizes = np.stack([torque.vectors[..., 2] for torque in torques], axis=-1)
    np.testing.assert_allclose(sizes, solution.torque, atol=1e-12)


@pytest.mark.long
def test_force_of_a_wheel_is_at_its_contact_and_as_newton_has_it():
    scene = jd.scenes.rolling_coin()
    q, v = jd.scenes.rolling_coin.start()
    dynamics = jd.constrained_dynamics(scene, q, v)
    solution = solution_of(scene, q[None], [0.0], multipliers=dynamics.multipliers[None])
    moved = motion.motion_of(scene, solution)
    (normal, friction), (mark,) = motion.forces(moved), motion.marks(moved)
    assert mark.kind == "contact" and (normal.kind, friction.kind) == ("normal", "friction")
    np.testing.assert_allclose(normal.places[..., 2], 0.0, atol=1e-12)  # on the ground
    np.testing.assert_allclose(normal.vectors[..., :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(friction.vectors[..., 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(mark.axis[0, 0], [0, 0, 1.0], atol=1e-12)
    # The ground is all that touches the coin: the force that its motion asks for.
    asked = np.asarray(jd.inverse_dynamics(scene.system, q, v, dynamics.acceleration))[:3]
    total = normal.vectors[0, 0] + friction.vectors[0, 0]
    np.testing.assert_allclose(total, moved.poses[0, 0, 0, :3, :3] @ asked, atol=1e-10)


def test_each_kind_of_force_has_a_scale_of_its_own():
    """A small friction is drawn as long as a large normal force; two bearings keep their ratio."""

    def force(kind, size):
        return motion.Force(kind, kind, np.zeros((1, 1, 3)), np.array([[[size, 0.0, 0.0]]]))

    sizes = ("normal", 1e3), ("friction", 1.0), ("bearing", 4.0), ("bearing", 2.0)
    drawn = [(f.kind, f.vectors[0, 0, 0] * scale) for f, scale in scale_forces([force(*x) for x in sizes], 0.5)]
    assert drawn == [("normal", 0.5), ("friction", 0.5), ("bearing", 0.5), ("bearing", 0.25)]


def test_marks_of_turning_solids_are_their_whole_surface():
    """Painted halves of a ball and of a wheel are equally large, and together the solid."""
    model = jd.scenes.rolling_coin().system
    for kind, size in (("ellipsoid", (0.5,) * 3), ("cylinder", (0.5, 0.1))):
        solid = jd.pictures.Shape("coin", kind, size, source="constraint")
        dark, light = stage.paint_sectors(jd.pictures.Shapes([solid]), model)
        areas = []
        for part in (dark, light):
            vertices, faces = part.triangles()
            a, b, c = (vertices[faces[:, k]] for k in range(3))
            areas.append(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
        assert areas[0] == pytest.approx(areas[1], rel=1e-9)
        assert len(dark.faces) + len(light.faces) == len(solid.triangles()[1])
    # A solid of a file keeps its colours, and a mark of a point is without an attitude.
    marks = ((0.5, {}), (0.01, {"source": "mark"}))
    kept = jd.pictures.Shapes([jd.pictures.Shape("coin", "ellipsoid", (size,) * 3, **more) for size, more in marks])
    assert stage.paint_sectors(kept, model) == kept


def test_a_link_with_three_joints_is_a_plate():
    """Closed, counter-clockwise from outside, of the triangle's area."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    builder = jd.ModelBuilder("links").add_body("link", inertia=(1.0, (0.3, 0.2, 0.0), (0.1, 0.1, 0.2)))
    for name, place in zip("ab", corners[1:], strict=True):
        builder.add_body(name, "link", inertia=(1.0, (0.2, 0.0, 0.0), (0.1, 0.1, 0.1)), pose=tuple(place))
    (plate,) = [x for x in solids_of(jd.Scene(builder.build())) if x.frame == "link" and x.kind == "mesh"]
    vertices, faces = plate.triangles()
    assert volume(vertices, faces) == pytest.approx(0.25 * np.ptp(vertices[:, 2]), rel=1e-9)


def test_points_and_frames_are_named_and_leave_paths(turning):
    scene, solution = turning
    first = jax.tree.map(lambda x: x[0], solution)
    axes = jd.draw(scene, first, frames=("rocker",), points={"P": ("coupler", (0.3, 0.1, 0.0))})
    assert {text.get_text() for text in axes.texts} == {"rocker", "P"}
    (path,) = [np.array(line.get_data_3d()).T for line in axes.lines if line.get_color() == "0.25"]
    poses = [np.asarray(jd.frame_pose(scene.system, q, "coupler")) for q in first.q]
    np.testing.assert_allclose(path, [pose[:3, :3] @ [0.3, 0.1, 0.0] + pose[:3, 3] for pose in poses], atol=1e-12)
    with pytest.raises(ValueError, match="frame 'elbow'"):
        jd.draw(scene, first.q[0], frames=("elbow",))
    with pytest.raises(ValueError, match=r"points\['P'\] is"):
        jd.draw(scene, first.q[0], points={"P": (0.3, 0.1, 0.0)})


@pytest.mark.parametrize("name", ("four_bar", "bicycle"))
def test_labels_are_within_the_figure_and_the_box_fills_it(name):
    axes = jd.draw(getattr(jd.scenes, name)(), getattr(jd.scenes, name).start()[0])
    figure = axes.figure
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    boxes = [axis.get_tightbbox(renderer).get_points() for axis in (axes.xaxis, axes.yaxis, axes.zaxis)]
    low, high = np.concatenate(boxes).min(0), np.concatenate(boxes).max(0)
    width, height = figure.bbox.size
    assert (low > -1).all() and (high < (width + 1, height + 1)).all()
    assert (high - low)[0] > 0.6 * width or (high - low)[1] > 0.6 * height


def test_friction_cones_are_where_their_forces_are():
    """Apex at the contact, axis along the force of a unit normal multiplier, the slope of the cone, and its sides."""
    scene, q = jd.scenes.hand_with_ball(mu=0.6), jd.scenes.hand_with_ball.start()[0]
    computed = motion.cones(motion.motion_of(scene, q))
    assert [cone.name for cone in computed] == ["tip1", "tip2", "tip3"]
    ball = np.asarray(jd.frame_pose(scene.system, q, "ball"))
    for cone, one in zip(computed, scene.constraints, strict=True):
        frame = ball @ np.asarray(one.pose)
        np.testing.assert_allclose(cone.apex[0, 0], frame[:3, 3], atol=1e-12)
        np.testing.assert_allclose(cone.axis[0, 0], frame[:3, 2], atol=1e-12)
        assert cone.slope == pytest.approx(0.6) and cone.across is None
        sides = cone_sides(cone, 0, 0.1)
        rim = (sides[:, 1] - frame[:3, 3]) @ frame[:3, :3]
        np.testing.assert_allclose(rim[:, 2], 0.1, atol=1e-12)
        np.testing.assert_allclose(np.hypot(rim[:, 0], rim[:, 1]), 0.06, atol=1e-12)
    # In a plane the cone is a wedge in that plane; a scene without cones, and a surface, have none.
    flat = motion.cones(motion.motion_of(jd.scenes.hand_with_bar(), jd.scenes.hand_with_bar.start()[0]))
    assert len(flat) == 2 and all(abs(float(cone.across[0, 0, 2])) < 1e-12 for cone in flat)
    assert cone_sides(flat[0], 0, 0.1).shape == (1, 3, 3)
    for name in ("four_bar", "box_on_table"):
        assert motion.cones(motion.motion_of(getattr(jd.scenes, name)(), getattr(jd.scenes, name).start()[0])) == []


def test_what_a_hand_holds_is_seen_through_and_has_its_shape():
    """A ball with contacts on its surface, a cube of the same three moments, a bar between two contacts."""
    shapes = {}
    for name, held in (("hand_with_ball", "ball"), ("allegro_with_cube", "cube"), ("hand_with_bar", "bar")):
        shapes[name] = [shape for shape in solids_of(getattr(jd.scenes, name)()) if shape.frame == held]
    (ball,), (cube,) = shapes["hand_with_ball"], shapes["allegro_with_cube"]
    assert ball.kind == "ellipsoid" and ball.size == pytest.approx((0.1,) * 3) and 0 < ball.opacity < 0.5
    assert cube.kind == "box" and cube.size == pytest.approx((0.06,) * 3) and 0 < cube.opacity < 0.5
    assert [s.kind for s in shapes["hand_with_bar"]] == ["capsule"] * 2


def test_triangles_are_cut_and_stay_the_surface():
    vertices, faces = jd.pictures.Shape("b", "box", (1.0, 0.5, 0.1)).triangles()
    many, cut = refine(vertices, faces, 0.2)
    sides = np.linalg.norm(many[np.roll(cut, -1, 1)] - many[cut], axis=2)
    assert sides.max() <= 0.2 and len(cut) > len(faces)
    assert volume(many, cut) == pytest.approx(0.05, rel=1e-12)


def test_forces_are_drawn_where_they_are_given(tmp_path):
    scene, q = jd.scenes.hand_with_ball(), jd.scenes.hand_with_ball.start()[0]
    lines = [len(jd.draw(scene, q, multipliers=x).lines) for x in (None, np.ones(9))]
    assert lines[1] - lines[0] == 3
    with pytest.raises(ValueError, match=r"multipliers .*\(9,\)"):
        jd.draw(scene, q, multipliers=np.ones(4))


@pytest.mark.long
def test_draw_and_animate(turning, solids, urdf, tmp_path):
    scene, solution = turning
    axes = jd.draw(scene, solution.q[0, 0])
    assert axes.name == "3d" and axes.get_xlabel() == "x (m)"
    axes.figure.savefig(tmp_path / "one.png")
    assert (tmp_path / "one.png").stat().st_size > 5_000
    options = {"fps": 10, "frames": ("rocker",), "points": {"P": ("coupler", (1.0, 0.0, 0.0))}}
    jd.animate(scene, solution, tmp_path / "turn.gif", **options)
    with Image.open(tmp_path / "turn.gif") as picture:
        assert picture.n_frames == 5  # of 0.4 s
    jd.draw(jd.load_model(urdf), jnp.asarray([0.3, -0.2]), axes, shapes=solids)


SQUARE = jd.pictures.Shape("elsewhere", "box", (1.0, 1.0, 1.0))
# What is wrong, by the words of the error, for a scene, its solution and a folder.
REFUSED = {
    r"LagrangianSystem, which has no bodies.*jd\.plot\.states": lambda *_: jd.draw(jd.scenes.pendulum(), jnp.zeros(1)),
    r"shape \(2,\).*\(3,\) = \(nq,\)": lambda scene, *_: jd.draw(scene, jnp.zeros(2)),
    r"\.gif or \.mp4": lambda scene, turn, folder: jd.animate(scene, turn, folder / "turn.avi"),
    "on frames elsewhere, which model": lambda scene, turn, _: jd.draw(scene, turn.q[0, 0], shapes=[SQUARE]),
    "give jd": lambda scene, turn, _: jd.draw(scene, turn.q[0, 0], shapes="robot.urdf"),
    "projection '3d'": lambda scene, turn, _: jd.draw(scene, turn.q[0, 0], Figure().add_subplot()),
    "ffmpeg is not installed; install it": lambda scene, turn, folder: jd.animate(scene, turn, folder / "turn.mp4"),
    "is the scene that of the solution": lambda _, turn, __: motion.motion_of(jd.scenes.windows(), turn),
    r"write to a file \.html": lambda scene, turn, folder: jd.pictures.save_html(folder / "turn.txt", scene, turn),
    "there is no directory": lambda scene, turn, folder: jd.pictures.save_html(folder / "no" / "a.html", scene, turn),
    "which has no bodies": lambda _, __, folder: jd.pictures.save_html(folder / "a.html", jd.scenes.pendulum(), [0.0]),
    "port is 70000; give a number": lambda scene, turn, _: jd.view(scene, turn, port=70000),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_cannot_be_shown_is_refused(words, turning, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match=words):
        REFUSED[words](*turning, tmp_path)


def test_rows_that_were_not_reached_repeat_the_last():
    model = jd.ModelBuilder("rod").add_body("rod", axis=(0, 1, 0), inertia=(1.0, (0, 0, -0.5), (0.1, 0.1, 0.1))).build()
    qs = np.linspace(0.0, 1.0, 6)[:, None]
    solution, ts = solution_of(model, qs, np.linspace(0.0, 1.0, 6)), np.linspace(0.0, 1.0, 6)
    broken = qs.copy()
    broken[3:] = np.nan
    moved = motion.motion_of(model, solution_of(model, broken, ts))
    np.testing.assert_array_equal(moved.q[0, 3:], np.broadcast_to(qs[2], (3, 1)))
    np.testing.assert_allclose(moved.poses[0, 1, 0], jd.forward_kinematics(model, solution.q[1])[0], atol=1e-15)
    np.testing.assert_allclose(motion.motion_of(model, solution, rows=3).ts, (0.0, 0.4, 1.0), atol=1e-12)
    with pytest.raises(ValueError, match="not finite"):
        motion.motion_of(model, solution_of(model, np.full((6, 1), np.nan), ts))
    with pytest.raises(ValueError, match="differs from motion"):
        motion.motion_of(model, batch_of(solution, solution_of(model, qs, 2 * ts)))


@pytest.fixture(scope="module")
def page(turning, tmp_path_factory) -> Path:
    pytest.importorskip("viser")
    path = tmp_path_factory.mktemp("page") / "turn.html"
    jd.pictures.save_html(path, *turning)
    return path


def messages_of(path: Path) -> list[tuple[float, dict]]:
    """What a page holds: times and messages of its recording."""
    import msgspec
    import zstandard

    (data,) = re.findall(r'window\.__VISER_EMBED_DATA__="([^"]*)"', path.read_text(encoding="utf-8"))
    raw = base64.b64decode(data)
    inner = zstandard.ZstdDecompressor().decompress(raw[8:], max_output_size=int.from_bytes(raw[:8], "little"))
    size = int.from_bytes(inner[:8], "little")
    return msgspec.msgpack.decode(inner[8 : 8 + size])["messages"]


def test_page_is_one_small_file_with_the_whole_motion(page, turning, capsys):
    scene, solution = turning
    assert 300_000 < page.stat().st_size <= 2_000_000
    text = page.read_text(encoding="utf-8")
    assert "<script src=" not in text and '<link rel="stylesheet" href="http' not in text
    messages = messages_of(page)
    assert messages[-1][0] == pytest.approx(0.4)  # s
    # Positions of a body over time are those of the kinematics, of the solid motion and of the ghost.
    for n in (0, 1):
        name = f"/motion{n}/{scene.system.body_names[-1]}"
        computed = [(t, m["position"]) for t, m in messages if m["type"] == "SetPositionMessage" and m["name"] == name]
        last = jd.forward_kinematics(scene.system, solution.q[n, -1])[-1]
        np.testing.assert_allclose(computed[-1][1], last[:3, 3], atol=1e-12)
    kinds = {m["type"] for _, m in messages}
    assert {"MeshMessage", "ArrowMessage", "GridMessage", "SetCameraPositionMessage"} <= kinds
    assert capsys.readouterr().out == ""


def test_view_serves_a_page_on_this_machine(turning, monkeypatch, capsys):
    pytest.importorskip("viser")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    scene, solution = turning
    viewer = jd.view(scene, solution, block=False)
    try:
        port = int(re.fullmatch(r"http://127\.0\.0\.1:(\d+)", viewer.url)[1])
        with urllib.request.urlopen(viewer.url) as answer:
            assert b"<html" in answer.read()
        said = capsys.readouterr().out
        assert viewer.url in said and "save_html" in said and "viser" not in said
        with pytest.raises(ValueError, match=f"port {port} cannot be used"):
            jd.view(scene, solution, port=port, block=False)
        assert viewer._repr_html_().startswith("<iframe srcdoc=")
    finally:
        viewer.stop()
        viewer.stop()
    jd.view(scene, solution.q[0, 0], block=False, browser=False).stop()  # one configuration


def test_page_of_one_configuration_in_float32(tmp_path):
    pytest.importorskip("viser")
    box = jd.inertia.box(1.0, (0.1, 0.2, 0.3))
    model = jd.ModelBuilder("box", dtype=jnp.float32).add_body("box", joint="spherical", inertia=box).build()
    jd.pictures.save_html(tmp_path / "one.html", model, jd.neutral(model))
    assert messages_of(tmp_path / "one.html")[-1][0] == 0.0


@pytest.mark.slow
def test_page_shows_the_mechanism_in_a_browser(page, tmp_path):
    """A screenshot by Chromium: the page is not empty, and the linkage's colours are in its middle."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium on this machine")
    flags = (
        "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update "
        "--disable-sync --use-angle=swiftshader --enable-unsafe-swiftshader --window-size=800,600 --virtual-time-budget=15000"
    )
    picture = tmp_path / "page.png"
    own = [f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={picture}"]
    subprocess.run([browser, *flags.split(), *own, page.as_uri()], timeout=170, capture_output=True, check=True)
    middle = np.asarray(Image.open(picture).convert("RGB"), float)[150:520, 100:700]
    # Bodies are coloured, the ground and its grid are grey.
    coloured = np.ptp(middle, axis=2) > 25
    assert 0.005 < coloured.mean() < 0.5


def test_bodies_with_a_slash_in_their_names_are_where_they_are(monkeypatch):
    """By viser's own scene tree, where the pose of a node is the product of those of all that its path names."""
    pytest.importorskip("viser")
    builder = jd.ModelBuilder()
    names = ("x", "x/y", "x%2Fy", "x/solid0", "world", "/", "x//y")
    for k, name in enumerate(names):
        inertia = jd.inertia.displaced(jd.inertia.sphere(1.0, 0.1), (0.2, 0.0, 0.0))
        builder.add_body(name, joint_name=f"j{k}", pose=(1.0 + k, 0.5 * k, 0.0), inertia=inertia)
    model = builder.build()
    q = jnp.linspace(0.3, 1.0, model.nq)
    viewer = jd.view(model, q, browser=False, block=False)
    try:
        node = viewer._server.scene.get_handle_by_name
        handles = {frame: handle for _, frame, handle in viewer._content.bodies}
        for name in names:
            placed, path = np.eye(4), ""
            for step in handles[name].name.strip("/").split("/"):
                path += f"/{step}"
                if (handle := node(path)) is not None:
                    q_of_node = np.concatenate([handle.position, handle.wxyz])
                    placed = placed @ host_math.joint_pose("free", np.zeros(6), q_of_node)
            np.testing.assert_allclose(placed, jd.frame_pose(model, q, name), atol=1e-6)  # viser sends float32
            assert sum(handle.name == handles[name].name for handle in handles.values()) == 1
    finally:
        viewer.stop()


# --- keywords ---------------------------------------------------------------------------------------------------------


def red_box(model):
    """One red box on the model's last body."""
    return jd.pictures.Shapes([jd.pictures.Shape(model.body_names[-1], "box", (0.5, 0.5, 0.5), color=(1.0, 0.0, 0.0))])


@pytest.mark.long
def test_speed_and_shapes_of_an_animation(tmp_path):
    """Two seconds of motion at twice the speed and five frames a second are six frames; a red box is red."""
    model = jd.robots.chain(2)
    motion = jd.simulate(model, jnp.ones(2), jnp.zeros(2), jnp.linspace(0.0, 2.0, 21))
    reds = []
    for shapes in (None, red_box(model)):
        jd.animate(model, motion, tmp_path / "a.gif", fps=5, speed=2.0, shapes=shapes)
        with Image.open(tmp_path / "a.gif") as picture:
            assert picture.n_frames == 6
            pixels = np.asarray(picture.convert("RGB"), int)
        reds.append(int(np.sum((pixels[..., 0] > 120) & (pixels[..., 1:].max(axis=2) < 60))))
    assert reds[1] > reds[0] + 100


@pytest.mark.long
def test_shapes_of_pages(tmp_path):
    """The box's sides are in the page, and among the solids of the view; without shapes there are those of the inertias."""
    pytest.importorskip("viser")
    model = jd.robots.chain(2)
    sizes = []
    for shapes in (None, red_box(model)):
        jd.pictures.save_html(tmp_path / "a.html", model, jnp.ones(2), shapes=shapes)
        sizes.append((tmp_path / "a.html").stat().st_size)
        viewer = jd.view(model, jnp.ones(2), shapes=shapes, browser=False, block=False)
        boxes = [one for one in viewer._parts if one.kind == "box" and one.size == (0.5, 0.5, 0.5)]
        viewer.stop()
        assert len(boxes) == (shapes is not None)
    assert sizes[0] != sizes[1]


def test_solids_of_xacro_files(tmp_path):
    """Arguments and folders of packages, as for `jd.load`."""
    pytest.importorskip("xacro")
    (tmp_path / "parts").mkdir()
    head = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    (tmp_path / "parts" / "p.xacro").write_text(f"{head}<xacro:arg name='size' default='1'/></robot>")
    path = tmp_path / "r.xacro"
    path.write_text(
        f"{head}<xacro:include filename='$(find parts)/p.xacro'/><link name='a'><visual><geometry>"
        "<sphere radius='$(arg size)'/></geometry></visual></link></robot>"
    )
    packages = {"parts": tmp_path / "parts"}
    (one,) = jd.pictures.shapes(path, packages=packages)
    (two,) = jd.pictures.shapes(path, packages=packages, arguments={"size": "2.5"})
    assert one.size == (1.0, 1.0, 1.0) and two.size == (2.5, 2.5, 2.5)
