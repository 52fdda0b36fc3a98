"""Laws in contact coordinates: the documents' F_m of an arm that touches and rolls on a sphere, written out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick
from test_control import KD, KP, decayed
from test_sphere_arm import A1, ETA, MASS, RADIUS, TIP, at_contact, light, printed_J_f, start

import jaxdyn as jd
from jaxdyn import scenes, se3

OBJECT, FINGER, CENTER = jd.contact.Sphere(RADIUS, poles="y"), jd.contact.Sphere(TIP), (0.5, 0.0, 0.0)
PAIRS = {
    "spheres": (OBJECT, FINGER),
    "plane and sphere": (jd.contact.Plane(), FINGER),
    "sphere and plane": (OBJECT, jd.contact.Plane()),
    "ellipsoids": (jd.contact.Ellipsoid([0.2, 0.1, 0.15], poles="y"), jd.contact.Ellipsoid([0.03, 0.02, 0.05])),
}


@pytest.mark.long
@pytest.mark.parametrize(
    "pair", [pytest.param(p, marks=() if p in ("spheres", "plane and sphere") else pytest.mark.slow) for p in PAIRS]
)
def test_contact_coordinates_are_the_inverse_of_the_pose(pair):
    """Of touching surfaces, also with a gap along the normal; their rates are those of Montana's forward form."""
    surfaces = PAIRS[pair]

    @quick
    def compute(eta, twist):
        at = jd.contact.montana(*surfaces, eta)
        moved = at.finger.pose
        # The finger moves by V_of = Ad V_c, and lifts along its own normal.
        lifted = at.g_of @ moved @ se3.exp(jnp.asarray([0, 0, -0.01, 0, 0, 0])) @ se3.inverse(moved)
        velocity = se3.Ad_apply(moved, twist)
        computed = jd.contact.contact_coordinates
        again, rate = jax.jvp(lambda s: computed(*surfaces, at.g_of @ se3.exp(s * velocity)), (0.0,), (1.0,))
        return again, computed(*surfaces, lifted), rate, at.forward @ twist

    twist = jnp.asarray([0.2, -0.1, 0.0, 0.4, 0.3, 0.5])
    again, difference, rate, want = compute(ETA, twist)
    np.testing.assert_allclose(again, ETA, atol=1e-12)
    np.testing.assert_allclose(difference, ETA, atol=1e-12)
    np.testing.assert_allclose(rate, want, atol=1e-10)


ELLIPSOIDS = jd.contact.Ellipsoid([0.1, 0.02, 0.01]), jd.contact.Ellipsoid([0.3, 0.01, 0.005])


@pytest.mark.parametrize(
    "pair",
    [(jd.contact.Sphere(0.2), jd.contact.Sphere(0.1)), pytest.param(ELLIPSOIDS, marks=pytest.mark.slow)],
    ids=["spheres", "ellipsoids"],
)
def test_surfaces_without_a_single_pair_of_closest_points_give_nan(pair):
    """Concentric ones, whose search ends where it begins, with zero steps; the other batch element keeps its numbers."""

    def first(p):
        pose = jnp.eye(4).at[:3, 3].set(p)
        eta = jd.contact.contact_coordinates(*pair, pose)
        return eta[0], eta

    both = jax.jit(jax.vmap(jax.value_and_grad(first, has_aux=True)))
    (_, eta), slopes = both(jnp.array([[0.0, 0, 0], [0.0, 0, 0.5]]))
    assert np.isnan(eta[0]).all() and np.isnan(slopes[0]).all()
    # One above the other: points at the pole u = pi/2.
    np.testing.assert_allclose(eta[1, 0], np.pi / 2, atol=1e-12)


def task_of(scene):
    return jd.control.ContactCoordinates(scene.system, "tip", OBJECT, FINGER, CENTER)


def body_forces(twist, pose):
    """M, -ad_V^T M V and the weight G of the ball at the tip, in its axes."""
    M = np.diag([MASS] * 3 + [0.4 * MASS * TIP**2] * 3)
    (p, h), (v, w) = np.split(M @ twist, 2), np.split(twist, 2)
    turning = np.concatenate([np.cross(w, p), np.cross(w, h) + np.cross(v, p)])
    return M, turning, np.concatenate([pose[:3, :3].T @ [0.0, 0.0, -9.81 * MASS], np.zeros(3)])


@pytest.mark.slow
def test_law_of_a_tip_that_slides_is_the_printed_one():
    """tau = J^T F_m with F_m of erratum E21 for the arm whose mass is the ball: five errors, and one force."""
    scene, (q, v) = light("frictionless"), start("frictionless")
    task, t = task_of(scene), 0.3
    law = jd.control.HybridForce(scene, task, goal, KP, KD, force=jnp.asarray([5.0]))

    @quick
    def compute(q, v):
        eta, rates = jax.jvp(task, (q,), (v,))
        J_F, J_F_rate = jax.jvp(lambda eta: at_contact(eta).J_F, (eta,), (rates,))
        pose = jd.frame_pose(scene.system, q, "tip")
        return law(q, v, t), eta, rates, J_F, J_F_rate, pose, jd.body_jacobian(scene.system, q, "tip")

    tau, eta, rates, J_F, J_F_rate, pose, J = (np.asarray(x) for x in compute(q, v))
    np.testing.assert_allclose(eta, ETA, atol=1e-12)
    M, turning, weight = body_forces(J_F @ rates, pose)
    place, speed, bend = target_motion(t)
    wanted = bend - KD * (rates - speed) - KP * (eta - place)
    A = np.eye(6)[2] @ np.asarray(se3.Ad(se3.inverse(at_contact(ETA).finger.pose)))
    # The gap opens against the tip's outward normal: A is the scene's row with the other sign.
    F_m = M @ (J_F @ wanted + J_F_rate @ rates) + turning - weight + A * 5.0
    np.testing.assert_allclose(tau, J.T @ F_m, atol=1e-10)


def goal(t):
    """A moving target of the contact coordinates."""
    return ETA + 0.1 * jnp.sin(t + jnp.arange(5.0))


def target_motion(t):
    s = np.sin(t + np.arange(5.0))
    return np.asarray(ETA) + 0.1 * s, 0.1 * np.cos(t + np.arange(5.0)), -0.1 * s


def rates_goal(t):
    return jnp.stack([jnp.sin(t), 0.5 + 0.2 * t])


@pytest.mark.long
def test_law_of_a_tip_that_rolls_is_the_printed_one():
    """Erratum E22: two rates of the place on the tip, and four forces, for the arm whose mass is the ball."""
    scene, (q, v) = light("rolling"), start("rolling")
    task, t, kp, lam = task_of(scene), 0.3, 4.0, jnp.asarray([5.0, 0.3, -0.2, 0.01])
    law = jd.control.HybridForce(scene, task.rolling, rates_goal, kp, of="velocity", force=lam)

    @quick
    def compute(q, v):
        eta, rates = jax.jvp(task, (q,), (v,))
        J_f, J_f_rate = jax.jvp(printed_J_f, (eta,), (rates,))
        pose, J = jd.frame_pose(scene.system, q, "tip"), jd.body_jacobian(scene.system, q, "tip")
        rows, contact = jd.constraint_jacobian(scene, q), se3.Ad(se3.inverse(at_contact(ETA).finger.pose))
        return law(q, v, t), rates[2:4], J_f, J_f_rate, pose, J, rows, contact

    tau, rates, J_f, J_f_rate, pose, J, rows, contact = (np.asarray(x) for x in compute(q, v))
    M, turning, weight = body_forces(J_f @ rates, pose)
    wanted = np.array([np.cos(t), 0.2]) - kp * (rates - np.asarray(rates_goal(t)))
    A = A1 @ contact
    # The same forces by the printed rows, which span those of the scene.
    printed = np.linalg.lstsq((A @ J).T, rows.T @ np.asarray(lam), rcond=None)[0]
    np.testing.assert_allclose((A @ J).T @ printed, rows.T @ np.asarray(lam), atol=1e-12)
    F_m = M @ (J_f @ wanted + J_f_rate @ rates) + turning - weight - A.T @ printed
    np.testing.assert_allclose(tau, J.T @ F_m, atol=1e-10)


TS = jnp.linspace(0.0, 1.5, 16)


@pytest.mark.slow
def test_contact_coordinates_of_the_whole_arm_follow():
    """All five errors by the closed form, their late rate to 1 %, the normal force as wanted, on the arm with its links."""
    scene = scenes.sphere_arm()
    q, v = scenes.sphere_arm.start(rolling=(0.0, 0.0))
    task, place = task_of(scene), ETA + jnp.asarray([0.05, -0.04, 0.1, -0.05, 0.1])
    law = jd.control.HybridForce(scene, task, place, KP, KD, force=jnp.asarray([5.0]), ki=2.0)
    solution = jd.simulate(scene, q, v, TS, control=law, stepsize=0.02, outputs=("multipliers",))
    errors = np.asarray(jax.vmap(lambda q: task(q) - place)(solution.q))
    exact = decayed(np.asarray(TS), errors[0], np.zeros(5))
    np.testing.assert_allclose(errors, exact, atol=1e-6)  # of RK4's steps of 20 ms
    slopes = [np.polyfit(TS[-6:], np.log(np.abs(e[-6:])), 1)[0] for e in (errors, exact)]
    np.testing.assert_allclose(*slopes, rtol=0.01)  # rates; the errors themselves are compared above
    np.testing.assert_allclose(solution.multipliers[:, 0], 5.0, atol=1e-7)


def test_what_does_not_fit_is_refused():
    model = scenes.sphere_arm().system
    parametrised = jd.contact.Parametrised(lambda a: jnp.stack([a[0], a[1], a @ a]))
    for call, words in (
        (lambda: jd.contact.contact_coordinates(jd.contact.Plane(), jd.contact.Plane(), jnp.eye(4)), "both planes"),
        (lambda: jd.contact.contact_coordinates(jd.contact.Plane(), parametrised, jnp.eye(4)), "Parametrised"),
        (lambda: jd.contact.contact_coordinates(jd.contact.Plane(), FINGER, jnp.eye(3)), "pose has shape"),
        (lambda: jd.control.ContactCoordinates(model, "toe", OBJECT, FINGER), "'toe'"),
        (lambda: jd.control.ContactCoordinates(scenes.sphere_arm(), "tip", OBJECT, FINGER), "model is a"),
    ):
        with pytest.raises(ValueError, match=words):
            call()
