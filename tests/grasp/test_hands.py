"""Hands of any shape: redundant fingers, grasps that are not manipulable, internal forces, and measures of a hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, placed, quick
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

import jaxdyn as jd
from jaxdyn import inertia

# Kind of contact and number of joints of each finger, sizes of w and u; "flat" fingers have parallel axes, so that the
# rows of J_h depend on each other.
HANDS = {
    "redundant": ((("hard-finger", 5, ""), ("soft-finger", 5, "")), (6, 3)),
    "tall": ((("hard-finger", 2, ""), ("hard-finger", 2, "")), (4, 0)),
    "both": ((("hard-finger", 5, ""), ("hard-finger", 2, "")), (5, 2)),
    "flat": ((("hard-finger", 4, "flat"), ("soft-finger", 4, "")), (5, 2)),
}


def fingers(hand):
    """A model of chains with random axes and inertias, and a free object."""
    random = np.random.default_rng(4)
    builder = jd.ModelBuilder(hand, gravity=(0.3, -0.5, -9.81))
    for i, (_, count, flat) in enumerate(HANDS[hand][0]):
        parent, fixed = None, random.normal(size=3)
        for j in range(count):
            axis = fixed if flat else random.normal(size=3)
            place = random.normal(size=3) * (0.3 if j else 1.0)
            body = inertia.box(random.uniform(0.2, 0.5), (0.3, 0.2, 0.1))
            builder.add_body(f"f{i}_{j}", parent, "revolute", body, axis=axis, pose=place)
            parent = f"f{i}_{j}"
        builder.add_frame(f"tip{i}", parent, (0.3, 0.1, -0.2))
    builder.add_body("obj", None, "free", inertia.box(1.0, (0.2, 0.3, 0.1)))
    return builder.build()


@functools.cache
def family(hand):
    """A function of a seed: a grasp whose fingertips touch the object at a random place, its q, nu and tau."""
    model = fingers(hand)
    kinds = [kind for kind, *_ in HANDS[hand][0]]
    tips = quick(lambda q: [jd.frame_pose(model, q, f"tip{i}") for i in range(len(kinds))])
    sizes = HANDS[hand][1]

    def made(seed):
        random = np.random.default_rng(seed)
        q = random.normal(size=model.nq)
        turn = Rotation.random(rng=seed)
        xyzw = turn.as_quat()
        q[-7:] = [*random.normal(size=3), xyzw[3], *xyzw[:3]]
        body = placed(turn.as_matrix(), q[-7:-4])
        poses = [np.linalg.inv(body) @ np.asarray(tip) for tip in tips(jnp.asarray(q))]
        frames = [placed(Rotation.random(rng=seed + k).as_matrix(), pose[:3, 3]) for k, pose in enumerate(poses)]
        contacts = [jd.grasp.contact(kind, f"tip{i}", frames[i]) for i, kind in enumerate(kinds)]
        nu, tau = jnp.asarray(random.normal(size=sum(sizes))), jnp.asarray(random.normal(size=model.nv))
        return jd.grasp.Grasp(model, "obj", contacts), jnp.asarray(q), nu, tau

    return made


@quick
def solved(grasp, motions, q, nu, tau):
    """The equations in (w, u), those with multipliers, and the rate of M~ along the motion."""
    dynamics = jd.grasp.hand_dynamics(grasp, q, nu, tau, motions=motions)
    along = (jd.configuration_rate(grasp.system, q, dynamics.velocity),)
    rate = jax.jvp(lambda q: jd.grasp.hand_dynamics(grasp, q, nu, tau, motions=motions).mass_matrix, (q,), along)[1]
    return {
        "hand": dynamics,
        "rate": rate,
        "full": jd.constrained_dynamics(grasp, q, dynamics.velocity, tau),
        "mass": jd.mass_matrix(grasp.system, q),
        "A": jd.constraint_jacobian(grasp, q),
        "kinetic": jd.kinetic_energy(grasp.system, q, dynamics.velocity),
        "potential": jax.jvp(lambda q: jd.potential_energy(grasp.system, q), (q,), along)[1],
    }


@pytest.mark.slow
@pytest.mark.parametrize("hand", [pytest.param(name, marks=[pytest.mark.slow] * (name != "tall")) for name in HANDS])
def test_equations_of_any_hand_are_those_with_multipliers(hand):
    """M~ is the projection of the saddle-point system, on random grasps; lemma 6.1; forces (6.24); energies and powers."""
    for seed in range(20 if hand == "both" else 10):
        grasp, q, nu, tau = family(hand)(seed)
        motions = jd.grasp.hand_motions(grasp, q)
        assert (motions.object.shape[1], motions.internal.shape[1]) == HANDS[hand][1]
        at = jax.tree.map(np.asarray, solved(grasp, motions, q, nu, tau))
        computed, A, N = at["hand"], at["A"], at["hand"].basis
        assert bool(computed.result == jd.RESULTS.successful)
        # N spans the velocities that the contacts leave, and no more.
        assert N.shape[1] == null_space(A, rcond=1e-10).shape[1] == np.linalg.matrix_rank(N)
        np.testing.assert_allclose(A @ N, 0, atol=1e-11 * np.abs(A).max() * np.abs(N).max())
        # N M~^-1 N^T is the inverse of M in the directions of the motion, from the saddle-point matrix.
        saddle = np.block([[at["mass"], A.T], [A, np.zeros((len(A), len(A)))]])
        inverse = np.linalg.pinv(saddle, rcond=1e-13)[: len(N), : len(N)]
        assert_close(N @ np.linalg.solve(computed.mass_matrix, N.T), inverse, 1e-10)
        assert_close(computed.velocity, N @ nu, 1e-13)
        assert_close(computed.acceleration, at["full"].acceleration, 1e-10)
        assert_close(computed.contact_forces, at["full"].multipliers, 1e-9)
        skew = at["rate"] - 2 * computed.coriolis_matrix
        assert np.abs(computed.coriolis_matrix).max() > 1e-2
        np.testing.assert_allclose(skew + skew.T, 0, atol=1e-10 * np.abs(at["rate"]).max())
        assert np.linalg.eigvalsh(computed.mass_matrix).min() > 0
        assert_close(0.5 * nu @ computed.mass_matrix @ nu, at["kinetic"], 1e-11)
        assert_close(computed.gravity_force @ nu, at["potential"], 1e-11)
        assert_close(computed.force @ nu, tau @ computed.velocity, 1e-11)
        assert_close(computed.input_map, N[:-6].T, 0)
        pushed = computed.input_map @ tau[:-6] + N[-6:].T @ tau[-6:]
        assert_close(pushed, computed.force, 1e-11)


@pytest.mark.long
def test_a_square_hand_is_its_own_object_dynamics():
    """With J_h square and regular nu is V, and both functions agree."""
    grasp, (q, v) = jd.scenes.hand_with_bar(), jd.scenes.hand_with_bar.start()
    tau = jnp.linspace(-0.3, 0.4, grasp.nv)
    motions = jd.grasp.hand_motions(grasp, q)
    assert_close(motions.object, np.eye(3), 0)
    assert motions.internal.shape == (4, 0)
    one, other = quick(
        lambda q: (
            jd.grasp.hand_dynamics(grasp, q, v[4:], tau, motions=motions),
            jd.grasp.object_dynamics(grasp, q, v[4:], tau),
        )
    )(q)
    for name in ("mass_matrix", "coriolis_matrix", "gravity_force", "input_map", "acceleration", "contact_forces"):
        assert_close(getattr(one, name), getattr(other, name), 1e-11, name)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), (grasp, q, v[4:], tau, motions))
    rough = jd.grasp.hand_dynamics(*single[:4], motions=single[4])
    assert rough.acceleration.dtype == jnp.float32
    assert_close(rough.acceleration, one.acceleration, 1e-3)


@functools.cache
def gripped():
    """The three-finger hand with a ball: its grasp, q, v, and what is found of it, by functions of (grasp, q)."""
    grasp, (q, v) = jd.scenes.hand_with_ball(), jd.scenes.hand_with_ball.start()

    @quick
    def compute(grasp, q, wrench):
        G, Jh = jd.grasp.grasp_map(grasp, q), jd.grasp.hand_jacobian(grasp, q)
        lam = jd.grasp.forces_for_wrench(grasp, q, wrench, 2.0)
        return {"G": G, "Jh": Jh, "lam": lam, "torques": jd.grasp.joint_torques(grasp, q, lam)}

    return grasp, q, v, compute


@pytest.mark.long
def test_forces_for_a_wrench():
    """G lam = F with the preload as internal force; power balance tau . thetadot = F . V; a basis of internal forces."""
    grasp, q, v, compute = gripped()
    wrench = jnp.asarray([0.3, -0.2, 4.0, 0.05, -0.03, 0.02])
    at = compute(grasp, q, wrench)
    G, lam = np.asarray(at["G"]), np.asarray(at["lam"])
    assert_close(G @ lam, wrench, 1e-12)
    # Three fingers that press the equator at equal angles squeeze and do no more.
    squeeze = 2.0 * jd.grasp.normal_forces(grasp)
    np.testing.assert_allclose(G @ squeeze, 0, atol=1e-14)
    E = np.asarray(jd.grasp.internal_force_basis(grasp, q))
    assert_close(E.T @ E, np.eye(3), 1e-13)
    np.testing.assert_allclose(G @ E, 0, atol=1e-14)
    assert_close(E @ (E.T @ lam), squeeze, 1e-12)
    assert_close(at["torques"] @ v[:9], wrench @ v[9:], 1e-12)
    # The continued basis is the same where it comes from, and smooth beside it.
    again = jd.grasp.internal_force_basis(grasp, q, reference=jnp.asarray(E))
    assert_close(again, E, 1e-12)
    np.testing.assert_allclose(jd.grasp.joint_torques(grasp, q, at["lam"]), at["Jh"].T @ lam, atol=1e-14)


@pytest.mark.slow
def test_a_hand_holds_its_ball_within_cones():
    """Least forces in the cones against weight, of a batch, with a gradient in mu; infeasible where friction is too small."""
    grasp, q, _, _ = gripped()

    def held(mu, wrench=None):
        cone = jd.contact.friction_cone("hard-finger", mu)
        return jd.grasp.hold(grasp, q, wrench, cones=cone, preload=0.1)

    many = quick(jax.vmap(held))(jnp.asarray([0.5, 0.8]))
    weight = jd.gravity_force(grasp.system, q)[9:]
    G, Jh = (np.asarray(f(grasp, q)) for f in (jd.grasp.grasp_map, jd.grasp.hand_jacobian))
    for mu, forces, torques in zip((0.5, 0.8), many.contact_forces, many.torques, strict=True):
        np.testing.assert_allclose(G @ forces, weight, atol=1e-7)
        computed = jd.grasp.contact_forces(grasp, forces, jd.contact.friction_cone("hard-finger", mu))
        np.testing.assert_allclose(computed.margin, 0.1, atol=1e-6)  # as little as is allowed
        assert_close(torques, Jh.T @ forces, 1e-12)
    assert bool(many.success.all())
    size = lambda mu: jnp.sum(held(mu).contact_forces ** 2)  # noqa: E731
    slope = quick(jax.grad(size))(0.5)
    run = quick(size)
    assert_close(slope, (run(0.5 + 1e-4) - run(0.5 - 1e-4)) / 2e-4, 1e-6)
    assert slope < -1.0
    # Without friction nothing carries a ball that lies between three vertical walls.
    level, _ = jd.scenes.hand_with_ball.start(turned=(0.0, 0.0, 0.0))
    loose = jd.grasp.hold(grasp, level, cones=jd.contact.friction_cone("hard-finger", 0.0))
    assert bool(loose.result == jd.RESULTS.infeasible)


def test_force_closure_of_a_hand():
    """Three hard fingers resist every wrench; two do not turn a bar's like about the line between them."""
    grasp, q, _, _ = gripped()
    computed = jd.grasp.force_closure(grasp, q, required=True)
    assert computed.closed and computed.margin > 0.1
    np.testing.assert_allclose(jd.grasp.grasp_map(grasp, q) @ computed.forces, 0, atol=1e-9)
    contacts = [one for one in grasp.constraints[:2]]
    two = jd.grasp.Grasp(grasp.system, "ball", contacts, cones=grasp.cones)
    with pytest.raises(ValueError, match="no force closure"):
        jd.grasp.force_closure(two, q, required=True)
    assert not jd.grasp.force_closure(two, q).closed


@pytest.mark.long
def test_manipulability_in_closed_form():
    """The ball's G has the axes sqrt(3), sqrt(3) and sqrt(3/2) r; J_h is a product of three-joint fingers."""
    grasp, q, v, _ = gripped()
    radius, links = 0.1, 0.2
    motions = jd.grasp.hand_motions(grasp, q)
    measure = lambda q: jd.grasp.manipulability(grasp, q, length=radius, motions=motions)  # noqa: E731
    at = quick(measure)(q)
    # Forces at the equator: G G^T = diag(3, 3, 3, 3/2 r^2, 3/2 r^2, 3 r^2).
    assert_close(at.grasp_axes, np.sqrt([3, 3, 3, 3, 1.5, 1.5]), 1e-12)
    assert_close(at.grasp_isotropy, np.sqrt(0.5), 1e-12)
    assert bool(at.is_manipulable)
    # |det J_i| = l1 l2 |sin q3| r_i, r_i the horizontal distance from the finger's base to its tip.
    angles = np.asarray(q[:9]).reshape(3, 3)
    reach = links * (np.cos(angles[:, 1]) + np.cos(angles[:, 1] + angles[:, 2]))
    G, Jh = (np.asarray(f(grasp, q)) for f in (jd.grasp.grasp_map, jd.grasp.hand_jacobian))
    each = links**2 * np.abs(np.sin(angles[:, 2])) * reach
    assert_close(abs(np.linalg.det(Jh)), np.prod(each), 1e-12)
    # The ellipsoid: thetadot of unit length give velocities on it.
    scale = np.repeat([1.0, radius], 3)
    X = np.linalg.solve(Jh, G.T) / scale
    assert_close(at.force_axes, np.linalg.svd(X)[1][::-1], 1e-11)
    assert_close(at.velocity_axes, 1 / np.asarray(at.force_axes), 1e-13)
    assert_close(at.sigma_min, at.velocity_axes[-1], 0)
    assert_close(at.volume, 1 / np.sqrt(np.linalg.det(X.T @ X)), 1e-10)
    D = np.asarray(at.directions) * scale[:, None]
    assert_close(D.T @ D, np.eye(6), 1e-12)
    rates = X @ (D * np.asarray(at.velocity_axes))
    assert_close(np.linalg.norm(rates, axis=0), np.ones(6), 1e-11)
    # Slopes of the volume and of the least axis along a motion.
    rate = jd.configuration_rate(grasp.system, q, v)
    both = lambda q: (lambda at: jnp.stack([at.volume, at.sigma_min]))(measure(q))  # noqa: E731
    slope, both = quick(jax.jacrev(both))(q) @ rate, quick(both)
    h = 1e-5
    assert_close(slope, (both(q + h * rate) - both(q - h * rate)) / (2 * h), 1e-6)
    with pytest.raises(ValueError, match=r"length is 0\.0"):
        jd.grasp.manipulability(grasp, q, length=0.0)


def test_manipulability_of_fingers_that_slide():
    """Each finger slides in x and y: J_h = 1, so the hand's ellipsoids are those of G; a bar of half a length h."""
    builder = jd.ModelBuilder("sliders", gravity=None)
    for i in (1, 2):
        builder.add_body(
            f"x{i}", None, "prismatic", inertia.sphere(0.1, 0.02), axis=(1, 0, 0), pose=(-((-1.0) ** i), 0, 0)
        )
        builder.add_body(f"y{i}", f"x{i}", "prismatic", inertia.sphere(0.1, 0.02), axis=(0, 1, 0))
    builder.add_body("bar", None, "planar", inertia.rod(0.5, 2.0))
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]).T
    contacts = [
        jd.grasp.contact("hard-finger", f"y{i}", placed(turn, [-((-1.0) ** i), 0, 0]), in_plane=True) for i in (1, 2)
    ]
    grasp = jd.grasp.Grasp(builder.build(), "bar", contacts)
    at = jd.grasp.manipulability(grasp, jnp.zeros(7))
    assert_close(at.force_axes, np.sqrt([2.0, 2.0, 2.0]), 1e-12)  # G G^T = diag(2, 2, 2 h^2)
    assert_close(at.isotropy, 1.0, 1e-12)
    assert_close(jd.grasp.manipulability(grasp, jnp.zeros(7), length=0.5).isotropy, 0.5, 1e-12)


def test_refusals():
    """What does not fit is refused by name."""
    grasp, q, _, _ = gripped()
    motions = jd.grasp.hand_motions(grasp, q)
    with pytest.raises(ValueError, match="nu has shape"):
        jd.grasp.hand_dynamics(grasp, q, jnp.zeros(5), motions=motions)
    with pytest.raises(ValueError, match="motions has rows"):
        bar = jd.scenes.hand_with_bar()
        jd.grasp.hand_dynamics(bar, jd.scenes.hand_with_bar.start()[0], jnp.zeros(3), motions=motions)
    for match, call in (
        ("sizes is", lambda: jd.grasp.hand_motions(grasp, q, sizes=(7, 0))),
        (r"mu is -0\.5", lambda: jd.contact.friction_cone("hard-finger", -0.5)),
        ("preload has shape", lambda: jd.grasp.forces_for_wrench(grasp, q, jnp.zeros(6), jnp.zeros(4))),
        ("wrench has shape", lambda: jd.grasp.hold(grasp, q, jnp.zeros(3))),
        ("have no cones", lambda: jd.grasp.hold(jd.scenes.hand_with_ball(mu=None), q)),
        (
            r"'tip3'\] have no",
            lambda: jd.grasp.hold(grasp, q, cones={"tip1": jd.contact.friction_cone("hard-finger", 0.5)}),
        ),
    ):
        with pytest.raises(ValueError, match=match):
            call()
    hollow = jd.ModelBuilder("o").add_body("obj", None, "free", (1.0, (0, 0, 0), (0.1, 0.1, -0.1))).build()
    with pytest.raises(ValueError, match="not positive definite"):
        jd.grasp.Grasp(grasp.system, hollow, [jd.grasp.contact("hard-finger", "tip1", None)])
