"""The arm whose tip touches a sphere: the documents' matrices and equations of motion, by hand from contact coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick
from refusals import refusals

import jaxdyn as jd
from jaxdyn import scenes, se3

RADIUS, TIP, MASS = 0.15, 0.03, 0.2
ETA, ROLLING, SLIDE, SPIN = jnp.array([0.2, -0.1, 0.15, 0.1, 0.3]), (0.5, -0.3), (0.2, 0.1), 0.7
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
A1 = np.eye(6)[[0, 1, 2, 5]]
KINDS = ("frictionless", "rolling")


def start(kind):
    free = {"slide": SLIDE, "spin": SPIN} if kind == "frictionless" else {}
    return scenes.sphere_arm.start(contact=kind, rolling=ROLLING, **free)


def light(kind):
    """The scene with all mass in the ball at its tip: the body of the documents' Newton-Euler equations."""
    scene = scenes.sphere_arm(contact=kind)
    model = scene.system
    return jd.Scene(model.replace(inertias=model.inertias.at[:-1].set(0.0)), scene.constraints)


def at_contact(eta):
    return jd.contact.montana(jd.contact.Sphere(RADIUS, poles="y"), jd.contact.Sphere(TIP), eta)


# For numbers: one program.
touching = quick(at_contact)


@pytest.fixture(scope="module")
def solved():
    """What the library computes of both scenes at the start: rows, maps, projections, accelerations."""
    computed = {}
    for kind in KINDS:
        scene, (q, v) = light(kind), start(kind)

        @quick
        def compute(q, v, wrench, scene=scene):
            model = scene.system
            J = jd.body_jacobian(model, q, "tip")
            forward = jd.constrained_dynamics(scene, q, v, J.T @ wrench)
            twist_rate = J @ forward.acceleration + jd.dynamics.jacobian_dot_v(model, q, v, "tip")
            # Twists of the tip against the sphere, in the axes of C_f: V_c = X v.
            X = se3.Ad(se3.inverse(at_contact(ETA).finger.pose)) @ J
            P_w = jd.constraints.projections(scene, q).P_omega
            return {
                "rows": jd.constraint_jacobian(scene, q) @ jnp.linalg.inv(X),
                "twist": J @ v,
                "pose": jd.frame_pose(model, q, "tip"),
                "P_w": jnp.linalg.solve(X.T, P_w @ X.T),
                "rate": twist_rate,
                "multipliers": forward.multipliers,
            }

        computed[kind] = {name: np.asarray(x) for name, x in compute(q, v, WRENCH).items()}
    return computed


WRENCH = jnp.array([0.4, -1.2, 2.1, 0.03, -0.05, 0.02])


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_start_is_at_its_contact_coordinates(solved, kind):
    at = solved[kind]
    contact = touching(ETA)
    pose = np.array(contact.g_of)
    pose[:3, 3] += [0.5, 0.0, 0.0]
    np.testing.assert_allclose(at["pose"], pose, atol=1e-14)
    sliding = (*SLIDE, 0.0, *ROLLING, SPIN) if kind == "frictionless" else (0.0, 0.0, 0.0, *ROLLING, 0.0)
    twist = quick(se3.Ad_inv_apply)(contact.finger.pose, jnp.asarray(at["twist"]))
    np.testing.assert_allclose(twist, sliding, atol=1e-13)


def test_rows_are_the_printed_ones(solved):
    """A = e3^T and A1 in the axes of the contact; the gap opens against the tip's outward normal."""
    np.testing.assert_allclose(solved["frictionless"]["rows"], [[0, 0, -1, 0, 0, 0]], atol=1e-12)
    rows = solved["rolling"]["rows"]
    # Directions without slip are any two in the tangent plane: the same span.
    turn = rows @ A1.T
    np.testing.assert_allclose(rows, turn @ A1, atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(turn[[0, 3]], [[0, 0, -1, 0], [0, 0, 0, -1]], atol=1e-12)


def test_projection_of_wrenches_is_the_printed_diagonal(solved):
    """P_w = diag(1, 1, 0, 1, 1, 1), as the ball's centre of mass is on the contact's normal."""
    np.testing.assert_allclose(solved["frictionless"]["P_w"], np.diag([1, 1, 0, 1, 1, 1]), atol=1e-12)
    # Rolling: what remains are torques about the tangents, with the forces at the contact that go with them.
    inertia = 0.4 * MASS * TIP**2
    arm = MASS * TIP / (inertia + MASS * TIP**2)
    P_w = solved["rolling"]["P_w"]
    want = np.zeros((6, 6))
    want[3, 3] = want[4, 4] = 1.0
    want[0, 4], want[1, 3] = -arm, arm
    np.testing.assert_allclose(P_w, want, atol=1e-11)


def newton_euler(J, J_rate, rates, rows, pose):
    """d/dt of the rates, twist rate and multipliers of M V' - ad_V^T M V = F + G + A^T lam, V = J rates, by one system."""
    inertia = np.diag([MASS] * 3 + [0.4 * MASS * TIP**2] * 3)
    v, w = np.split(J @ rates, 2)
    # -ad_V^T (p, h) = (w x p, w x h + v x p)
    p, h = inertia[:3, :3] @ v, inertia[3:, 3:] @ w
    turning = np.concatenate([np.cross(w, p), np.cross(w, h) + np.cross(v, p)])
    weight = np.concatenate([pose[:3, :3].T @ [0.0, 0.0, -9.81 * MASS], np.zeros(3)])
    right = WRENCH + weight - turning - inertia @ (J_rate @ rates)
    solution = np.linalg.solve(np.concatenate([inertia @ J, -rows.T], 1), right)
    n = J.shape[1]
    return solution[:n], J @ solution[:n] + J_rate @ rates, solution[n:]


@pytest.mark.slow
def test_frictionless_motion_is_that_of_the_printed_equations(solved):
    """Equation E21: six unknowns, the accelerations of the five contact coordinates and the normal force."""
    at, kinematics = solved["frictionless"], at_contact(ETA)
    rates = kinematics.forward @ jnp.array([*SLIDE, 0.0, *ROLLING, SPIN])
    J, J_rate = jax.jvp(lambda eta: at_contact(eta).J_F, (ETA,), (rates,))
    rows = np.eye(6)[2:3] @ np.asarray(se3.Ad(se3.inverse(kinematics.finger.pose)))
    _, twist_rate, lam = newton_euler(np.asarray(J), np.asarray(J_rate), np.asarray(rates), rows, at["pose"])
    np.testing.assert_allclose(at["rate"], twist_rate, atol=1e-10)
    np.testing.assert_allclose(at["multipliers"], -lam, atol=1e-10)


def printed_J_f(eta):
    """J_f = Ad [0; -R_o (K_f + R_psi K_o R_psi) M_f; 0], written out."""
    at, psi = at_contact(eta), eta[4]
    turn = jnp.stack([jnp.stack([jnp.cos(psi), -jnp.sin(psi)]), jnp.stack([-jnp.sin(psi), -jnp.cos(psi)])])
    metric = TIP * jnp.diag(jnp.stack([jnp.ones(()), jnp.cos(eta[2])]))
    bent = -QUARTER @ (jnp.eye(2) / TIP + turn @ turn / RADIUS) @ metric
    return se3.Ad(at.finger.pose) @ jnp.concatenate([jnp.zeros((3, 2)), bent, jnp.zeros((1, 2))])


@pytest.mark.long
def test_rolling_motion_is_that_of_the_printed_equations(solved):
    """Equation E22: the two rates of the contact's place on the tip, and four multipliers."""

    @quick
    def compute(eta):
        kinematics = at_contact(eta)
        eta_rate = kinematics.rolling @ jnp.asarray(ROLLING)
        contact = se3.Ad(se3.inverse(kinematics.finger.pose))
        return eta_rate, *jax.jvp(printed_J_f, (eta,), (eta_rate,)), contact

    at, (eta_rate, J, J_rate, contact) = solved["rolling"], (np.asarray(x) for x in compute(ETA))
    rates = np.asarray(eta_rate[2:4])
    np.testing.assert_allclose(J @ rates, at["twist"], atol=1e-13)
    # alpha_o_dot = M_o^-1 R_psi M_f alpha_f_dot.
    metric = TIP * np.diag([1.0, np.cos(ETA[2])])
    c, s = np.cos(ETA[4]), np.sin(ETA[4])
    along = np.diag([1.0, 1.0 / np.cos(ETA[0])]) / RADIUS @ np.array([[c, -s], [-s, -c]]) @ metric @ rates
    np.testing.assert_allclose(eta_rate[:2], along, atol=1e-13)
    _, twist_rate, lam = newton_euler(J, J_rate, rates, A1 @ contact, at["pose"])
    np.testing.assert_allclose(at["rate"], twist_rate, atol=1e-10)
    # The forces in the tip's axes are the same, whatever the directions without slip.
    np.testing.assert_allclose(at["multipliers"] @ at["rows"], lam @ A1, atol=1e-10)


def test_coordinates_are_five_and_two():
    for kind, count in zip(KINDS, (5, 2), strict=True):
        assert jd.reduction.tangent_basis(scenes.sphere_arm(contact=kind), start(kind)[0]).shape == (6, count)


test_bad_input_is_refused = refusals(
    (lambda: scenes.sphere_arm(contact="soft"), "contact is 'soft'"),
    (lambda: scenes.sphere_arm.start(contact="soft"), "contact is 'soft'"),
    (lambda: scenes.sphere_arm.start(contact="rolling", spin=1.0), "contact has neither"),
    (lambda: scenes.sphere_arm.start(center=(3.0, 0.0, 0.0)), "do not close"),
    (lambda: jd.rolling_sphere("ball", None, 0.1, slip=True, contact=False), "leaves no rows"),
)
