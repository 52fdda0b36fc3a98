"""Force closure against known grasps, and against the linear program over the edges of pyramids."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refusals
from scipy.optimize import linprog

import jaxdyn as jd

HARD, SOFT = jd.contact.friction_cone("hard-finger", 0.5), jd.contact.friction_cone("soft-finger", 0.5, 0.02)


def frame(normal):
    """A right-handed frame (3, 3) whose z is the normal."""
    other = np.array([1.0, 0, 0]) if abs(normal[0]) < 0.9 * np.linalg.norm(normal) else np.array([0, 1.0, 0])
    x = np.cross(other, normal)
    x, z = x / np.linalg.norm(x), normal / np.linalg.norm(normal)
    return np.stack([x, np.cross(z, x), z], 1)


def grasp(points, normals, kind):
    """G (6, m) of contacts at points, with normals into the object."""
    columns = []
    for point, normal in zip(np.asarray(points), np.asarray(normals), strict=True):
        R = frame(normal)
        hat = np.array([[0, -point[2], point[1]], [point[2], 0, -point[0]], [-point[1], point[0], 0]])
        columns.append(np.block([[R, np.zeros((3, 3))], [hat @ R, R]]) @ np.asarray(jd.contact.wrench_basis(kind)))
    return np.concatenate(columns, 1)


def edges(cone, faces, mu, gamma=None):
    """Generators (m, k) of the inscribed pyramid: its edges lie on the round cone."""
    angles = 2 * np.pi / faces * (np.arange(faces) + 0.5)
    forces = np.stack([mu * np.cos(angles), mu * np.sin(angles), np.ones(faces)])
    if gamma is None:
        return forces
    return np.concatenate([np.append(forces, np.full((1, faces), s * gamma), 0) for s in (1, -1)], 1)


def by_edges(G, generators):
    """Largest t with W lam = 0, 1 . lam = 1, lam >= t, for generators of each contact; closed if t > 0 and W has full rank."""
    size = generators.shape[0]
    W = np.concatenate([G[:, i : i + size] @ generators for i in range(0, G.shape[1], size)], 1)
    n = W.shape[1]
    computed = linprog(
        np.append(np.zeros(n), -1),
        np.concatenate([-np.eye(n), np.ones((n, 1))], 1),
        np.zeros(n),
        np.concatenate([np.concatenate([W, np.ones((1, n))]), np.zeros((len(W) + 1, 1))], 1),
        np.append(np.zeros(len(W)), 1.0),
        bounds=(None, None),
    )
    return computed.status == 0 and computed.x[-1] > 1e-9 and np.linalg.matrix_rank(W, 1e-9) == len(W)


def three(radius=0.1):
    directions = np.stack([[np.cos(a), np.sin(a), 0] for a in 2 * np.pi / 3 * np.arange(3)])
    return radius * directions, -directions


def random_grasps(count, seed, fingers=3):
    random = np.random.default_rng(seed)
    for _ in range(count):
        points = random.normal(size=(fingers, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        yield points, -points + 0.4 * random.normal(size=(fingers, 3))


@pytest.fixture
def three_fingers():
    return grasp(*three(), "hard-finger")


ANTIPODAL = [[0.1, 0, 0], [-0.1, 0, 0]], [[-1.0, 0, 0], [1.0, 0, 0]]


def test_two_soft_fingers_that_oppose_each_other_close():
    computed = jd.contact.force_closure_of_map(grasp(*ANTIPODAL, "soft-finger"), [SOFT] * 2)
    assert computed.closed and computed.rank == 6
    # They press with half a newton each; the torque that they may exert is the tighter margin, 0.02 m x 0.5 N.
    np.testing.assert_allclose(computed.margin, 0.01, atol=1e-9)
    np.testing.assert_allclose(computed.forces, [0, 0, 0.5, 0] * 2, atol=1e-7)


def test_two_hard_fingers_do_not_resist_a_torque_about_their_line():
    computed = jd.contact.force_closure_of_map(grasp(*ANTIPODAL, "hard-finger"), [HARD] * 2)
    assert not computed.closed and computed.rank == 5 and computed.margin == 0
    np.testing.assert_allclose(np.abs(computed.direction), [0, 0, 0, 1, 0, 0], atol=1e-12)


def test_three_hard_fingers_close_by_a_third_of_their_friction():
    G = grasp(*three(), "hard-finger")
    computed = jd.contact.force_closure_of_map(G, [HARD] * 3)
    assert computed.closed
    # By symmetry each presses with a third of a newton along its normal.
    np.testing.assert_allclose(computed.margin, 0.5 / 3, atol=1e-9)
    np.testing.assert_allclose(G @ computed.forces, 0, atol=1e-9)
    # Without friction their lines lie in a plane and meet in a point: what they resist are forces in that plane.
    smooth = jd.contact.force_closure_of_map(G, [jd.contact.friction_cone("hard-finger", 0.0)] * 3)
    assert not smooth.closed and smooth.rank == 2


def test_feet_and_rigid_grips():
    foot = jd.contact.wrench_cone(0.1, 0.05, 0.5)
    alone = jd.contact.force_closure_of_map(np.eye(6), [foot])
    assert not alone.closed
    assert ((np.linalg.svd(np.asarray(foot))[2] @ alone.direction) ** 2).sum() > 0  # a direction in space
    np.testing.assert_allclose(alone.direction, [0, 0, 1, 0, 0, 0], atol=1e-9)
    assert jd.contact.force_closure_of_map(np.concatenate([np.eye(6), -np.eye(6)], 1), [foot, foot]).closed
    rigid = jd.contact.force_closure_of_map(np.eye(6), [jd.contact.friction_cone("rigid")])
    assert rigid.closed and rigid.margin == np.inf


def test_seven_points_without_friction_close_and_six_do_not():
    # The faces of a box, each touched off its centre so that torques about all axes are resisted, and a last one.
    points = np.array(
        [[1, 0.3, 0], [-1, -0.3, 0], [0, 1, 0.3], [0, -1, -0.3], [0.3, 0, 1], [-0.3, 0, -1], [-1, 0.8, 0.5]]
    )
    normals = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1], [1, 0, 0.0]])
    cone = jd.contact.friction_cone("frictionless")
    G = grasp(points, normals, "frictionless")
    assert not jd.contact.force_closure_of_map(G[:, :6], [cone] * 6).closed
    computed = jd.contact.force_closure_of_map(G, [cone] * 7)
    assert computed.closed == by_edges(G, np.ones((1, 1)))


def test_planar_grasps():
    # Wrenches (fx, fy, tz) of two fingers with friction that oppose each other along x.
    G = np.array([[0, 1, 0, -1], [1, 0, -1, 0], [-0.1, 0, -0.1, 0]])
    cone = jd.contact.friction_cone("hard-finger", 0.4, in_plane=True)
    computed = jd.contact.force_closure_of_map(G, [cone] * 2)
    assert computed.closed
    np.testing.assert_allclose(computed.margin, 0.2, atol=1e-9)
    assert not jd.contact.force_closure_of_map(np.abs(G), [cone] * 2).closed


def agree(count, seed):
    closed = disputed = 0
    for points, normals in random_grasps(count, seed):
        G = grasp(points, normals, "hard-finger")
        pyramid = jd.contact.force_closure_of_map(G, [HARD] * 3, faces=8)
        disputed += pyramid.closed != by_edges(G, edges(HARD, 8, 0.5))
        exact = jd.contact.force_closure_of_map(G, [HARD] * 3)
        # The round cone is between the pyramids within it and around it.
        assert pyramid.margin <= exact.margin + 1e-8
        if exact.closed:
            forces = exact.forces.reshape(3, 3)
            margins = 0.5 * forces[:, 2] - np.hypot(forces[:, 0], forces[:, 1])
            np.testing.assert_allclose(margins.min(), exact.margin, atol=2e-9)
            np.testing.assert_allclose([forces[:, 2].sum(), *(G @ exact.forces)], [1, *[0] * 6], atol=1e-8)
            closed += 1
        else:
            assert (exact.direction @ G @ np.kron(np.eye(3), edges(HARD, 64, 0.5)) > -1e-7).all()
            assert not by_edges(G, edges(HARD, 64, 0.5))
    assert disputed == 0
    return closed


@pytest.mark.parametrize("count, seed", [(20, 1), pytest.param(200, 2, marks=pytest.mark.slow)])
def test_random_grasps_agree_with_the_program_over_edges(count, seed):
    assert 0.05 * count < agree(count, seed) < 0.95 * count


def test_cuts_that_do_not_reach_the_margin_are_no_answer(monkeypatch):
    """One round of tangent planes bounds the margin from above alone."""
    cone = jd.contact.friction_cone("hard-finger", mu=2.0)
    G = np.random.default_rng(3).normal(size=(6, 18))
    assert jd.contact.force_closure_of_map(G, [cone] * 6).margin > 1e-3
    monkeypatch.setattr("jaxdyn.contact.forces._ROUNDS", 1)
    with pytest.raises(RuntimeError, match="with 1 rounds"):
        jd.contact.force_closure_of_map(G, [cone] * 6)


def test_units_of_length_do_not_matter():
    G = grasp(*three(), "hard-finger")
    millimetres = G * np.array([1, 1, 1, 1e3, 1e3, 1e3])[:, None]
    np.testing.assert_allclose(
        jd.contact.force_closure_of_map(millimetres, [HARD] * 3).margin,
        jd.contact.force_closure_of_map(G, [HARD] * 3).margin,
        atol=1e-9,
    )


test_bad_input_is_refused = refusals(
    (lambda G: jd.contact.force_closure_of_map(G, [HARD] * 2), "9 columns"),
    (lambda G: jd.contact.force_closure_of_map(G, 3), "cones is a"),
    (lambda G: jd.contact.force_closure_of_map(G, [HARD] * 3, side="left"), "side is 'left'"),
    (lambda G: jd.contact.force_closure_of_map(G, [HARD] * 3, faces=2), "faces is 2"),
    (lambda G: jd.contact.force_closure_of_map(G[0], [HARD] * 3), "G has shape"),
    (lambda G: jd.contact.force_closure_of_map(np.full_like(G, np.nan), [HARD] * 3), "not a number"),
    (
        lambda G: jax.jit(lambda G: jnp.ones(()) * jd.contact.force_closure_of_map(G, [HARD] * 3).margin)(G),
        "outside of jit",
    ),
    given=("three_fingers",),
)
