"""The Allegro hand from its URDF with a cube: contacts by the names of its fingertips, closure, forces, a short motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd

PLACES = {
    "link_3.0_tip": ((0.03, 0.02, 0.0), (-1, 0, 0)),
    "link_15.0_tip": ((-0.03, 0.0, 0.0), (1, 0, 0)),
    "link_11.0_tip": ((0.03, -0.02, 0.01), (-1, 0, 0)),
}


@pytest.fixture(scope="module")
def hand():
    """The grasp, the place of the cube in q, and a configuration on its contacts."""
    grasp = jd.scenes.allegro_with_cube()
    top = grasp.system.topology
    return grasp, top.q_slices[top.body_names.index("cube")], jd.scenes.allegro_with_cube.start()[0]


def test_the_hand_is_that_of_its_file(robots_dir):
    """Every number of the built-in hand is the URDF's, but for inertias that no body has; it has no friction."""
    path = robots_dir / "allegro_hand_description" / "urdf" / "allegro_right_hand.urdf"
    read, hand = jd.load_model(path), jd.robots.allegro()
    for name in ("parents", "kinds", "joint_names", "body_names", "frame_names", "frame_bodies", "couplings"):
        assert getattr(read.topology, name) == getattr(hand.topology, name), name
    bodies = [int(name.partition("_")[2].partition(".")[0]) for name in hand.body_names]
    last = np.array([number % 4 == 3 for number in bodies])
    np.testing.assert_array_equal(read.inertias[~last], hand.inertias[~last])
    np.testing.assert_allclose(read.inertias[last, :4], hand.inertias[last, :4], rtol=1e-12)
    assert all(jd.inertia.is_feasible(x, tolerance=1e-9) for x in hand.inertias)
    for name in ("home", "screws", "frame_poses", "lower", "upper", "velocity_limit", "effort_limit"):
        np.testing.assert_array_equal(getattr(read, name), getattr(hand, name), err_msg=name)
    assert not np.any(hand.damping) and not np.any(hand.friction)


def test_the_fingers_move_with_the_cube(hand):
    """The start is on the contacts and moves along them; a cube out of reach is refused."""
    grasp, _, _ = hand
    q, v = jd.scenes.allegro_with_cube.start()
    assert float(jnp.abs(jd.constraint_jacobian(grasp, q) @ v).max()) < 1e-15
    with pytest.raises(ValueError, match=r"link_3.0_tip cannot reach"):
        jd.scenes.allegro_with_cube.start(position=(0.3, 0.0, 0.0))


@pytest.mark.long
def test_a_traced_start_out_of_reach_is_not_a_number(hand):
    """A traced position cannot be refused; within reach it is the start of known numbers."""
    start = jax.jit(lambda position: jd.scenes.allegro_with_cube.start(position=position))
    near, far = jnp.array([0.108, 0.013, 0.004]), jnp.array([0.3, 0.0, 0.0])
    for got, want in zip(start(near), jd.scenes.allegro_with_cube.start(position=tuple(near.tolist())), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-12)
    assert np.isnan(start(far)[0]).any()


@pytest.mark.slow
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
