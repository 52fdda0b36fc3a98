"""The Allegro hand from its URDF with a cube: contacts by the names of its fingertips, closure, forces, a short motion."""

import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close
from scipy.spatial.transform import Rotation

import jaxdyn as jd

# Index and ring finger on one face of a cube of 60 mm, the thumb on the opposite one; the middle finger is free.
PLACES = {
    "link_3.0_tip": ((0.03, 0.02, 0.0), (-1, 0, 0)),
    "link_15.0_tip": ((-0.03, 0.0, 0.0), (1, 0, 0)),
    "link_11.0_tip": ((0.03, -0.02, 0.01), (-1, 0, 0)),
}
GUESS = [-0.248, 0.833, 0.756, 0.583, 1.288, 0.56, 0.477, 0.493, 0.0, 0.9, 0.8, 0.6, 0.288, 0.946, 0.792, 0.585]


@pytest.fixture(scope="module")
def hand(robots_dir):
    """The grasp and a configuration on its contacts."""
    model = jd.load_urdf(robots_dir / "allegro_hand_description" / "urdf" / "allegro_right_hand.urdf")
    cube = jd.ModelBuilder("cube", gravity=model.gravity).add_body(
        "cube", None, "free", jd.inertia.box(0.1, (0.06,) * 3), joint_name="object"
    )
    cones = jd.contact.friction_cone("hard-finger", 0.8)
    grasp = jd.grasp.Grasp(model, cube.build(), jd.grasp.point_contacts(PLACES), cones=cones)
    x, y, z, w = Rotation.from_rotvec([0.404, -1.79, -0.078]).as_quat()
    top = grasp.system.topology
    q = np.zeros(grasp.nq)
    place = top.q_slices[top.body_names.index("cube")]
    q[place] = [0.108, 0.013, 0.004, w, x, y, z]
    q[np.setdiff1d(np.arange(grasp.nq), np.arange(place.start, place.stop))] = GUESS
    return grasp, place, jd.assemble(grasp, jnp.asarray(q)).q


def test_allegro_hand_grasps_a_cube(hand):
    """Fingertips meet their points; three hard fingers have force closure and hold the cube's weight within cones."""
    grasp, _, q = hand
    cube = jd.frame_pose(grasp.system, q, "cube")
    for name, (point, _) in PLACES.items():
        tip = jd.frame_pose(grasp.system, q, name)[:3, 3]
        np.testing.assert_allclose(cube[:3, :3] @ jnp.asarray(point) + cube[:3, 3], tip, atol=1e-12)
    assert jd.grasp.force_closure(grasp, q, required=True).margin > 0.1
    motions = jd.grasp.hand_motions(grasp, q)
    assert motions.object.shape == (6, 6) and motions.internal.shape == (16, 7)
    held = jd.grasp.hold(grasp, q, preload=0.1)
    assert bool(held.success)
    weight = cube[:3, :3].T @ jnp.asarray([0.0, 0.0, 0.981])
    wrench = jd.grasp.grasp_map(grasp, q) @ held.contact_forces
    np.testing.assert_allclose(wrench, [*weight, 0, 0, 0], atol=1e-7)


def test_contacts_that_do_not_touch_are_refused_with_their_gap(hand):
    """A cube 10 mm off along x: simulate names the contacts and how far they are open."""
    grasp, place, q = hand
    off = q.at[place.start].add(0.01)
    # The largest component in the axes of the cube.
    gap = 0.01 * float(jnp.abs(jd.frame_pose(grasp.system, q, "cube")[0, :3]).max())
    with pytest.raises(ValueError, match=rf"link_.*tip' open by {gap:.3g}"):
        jd.simulate(grasp, off, jnp.zeros(grasp.nv), jnp.linspace(0.0, 0.1, 3))


@pytest.mark.slow
def test_allegro_hand_holds_the_cube_in_motion(hand):
    """Under `GraspForce` the cube stays where it is and every contact inside its cone."""
    grasp, place, q = hand
    law = jd.control.GraspForce(grasp, q[place], 100.0, 20.0, preload=2.0, damping=10.0)
    ts, rest = jnp.linspace(0.0, 0.1, 3), jnp.zeros(grasp.nv)
    found = jd.simulate(
        grasp, q, rest, ts, control=law, stepsize=0.01, outputs=("contact_margins", "constraint_residual")
    )
    assert bool(found.success)
    assert_close(found.q[-1, place], q[place], 1e-8)
    assert min(float(margin.min()) for margin in found.contact_margins.values()) > 0.1
    assert float(found.constraint_residual.max()) < 1e-11
