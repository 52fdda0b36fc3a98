"""Models joined into one, against the separate models; and the plate that several arms lift together."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_bridge import assert_close, quick, to_pinocchio

import jaxdyn as jd
from jaxdyn import robots, scenes, se3

POSE = se3.exp(jnp.array([0.4, -0.7, 0.2, 0.3, -0.5, 0.9]))


def test_two_copies_and_an_object_are_those_of_pinocchio():
    """Pinocchio's `appendModel` of the same three models, of which the second one is turned in the common world."""
    arm = robots.iiwa()
    box = jd.ModelBuilder("box").add_body("box", None, "free", jd.inertia.box(2.0, (0.2, 0.1, 0.3))).build()
    whole = jd.join(jd.join(arm, arm, prefix=("a_", "b_"), pose=POSE), box)
    _, bridge = to_pinocchio(whole)
    single, _ = to_pinocchio(arm)
    other, _ = to_pinocchio(box)
    appended = pin.Model()
    appended.gravity = single.gravity
    for part, place in ((single, pin.SE3.Identity()), (single, pin.SE3(np.asarray(POSE)))):
        part = part.copy()
        for i in range(1, len(part.names)):
            part.names[i] = f"{appended.njoints}.{part.names[i]}"
        for i, frame in enumerate(part.frames):
            if i:
                part.frames[i].name = f"{appended.nframes}.{frame.name}"
        appended = pin.appendModel(appended, part, 0, place)
    appended = pin.appendModel(appended, other, 0, pin.SE3.Identity())
    rng = np.random.default_rng(0)
    q = np.concatenate([rng.normal(size=17), [1.0, 0.0, 0.0, 0.0]])
    v, tau = rng.normal(size=(2, 20))
    data = appended.createData()
    want = pin.aba(appended, data, bridge.q_to_pinocchio(q), v, tau)
    assert_close(quick(jd.forward_dynamics)(whole, jnp.asarray(q), jnp.asarray(v), jnp.asarray(tau)), want, 1e-9)


def test_couplings_and_limits_are_kept():
    builder = jd.ModelBuilder("geared")
    bar = jd.inertia.rod(1.0, 0.3)
    builder.add_body("a", None, "revolute", bar, lower=-1.0, upper=2.0).add_body("b", "a", "revolute", bar, damping=0.3)
    builder.add_coupling("b_joint", "a_joint", 2.0, 0.1)
    geared = builder.build()
    both = jd.join(robots.chain(2), geared, prefix="g_")
    assert both.topology.couplings == ((3, 2),)
    np.testing.assert_allclose(both.coupling_values, [[2.0, 0.1]])
    np.testing.assert_allclose(both.upper, [np.inf, np.inf, 2.0, np.inf])
    np.testing.assert_allclose(both.damping, [0.0, 0.0, 0.0, 0.3])


def test_the_place_of_the_right_one_can_be_differentiated_and_batched():
    arm = robots.chain(2)
    q = jnp.array([0.3, -0.2, 0.5, 0.7])

    def height(z):
        pose = se3.from_parts(jnp.eye(3), jnp.stack([jnp.zeros(()), jnp.zeros(()), z]))
        return jd.potential_energy(jd.join(arm, arm, prefix="r_", pose=pose), q)

    values, slopes = quick(jax.vmap(jax.value_and_grad(height)))(jnp.array([0.0, 1.5]))
    np.testing.assert_allclose(slopes, -2 * arm.gravity[2], rtol=1e-12)  # two rods of 1 kg
    np.testing.assert_allclose(values[1] - values[0], 1.5 * slopes[0], rtol=1e-12)


BAD = [
    (lambda: jd.join(robots.chain(2), robots.chain(2)), r"'rod_0_joint', 'rod_1_joint'.*pass prefix="),
    (lambda: jd.join(robots.chain(2), "arm"), "right is a str"),
    (lambda: jd.join(robots.chain(2), robots.chain(2), prefix=("a", 1)), r"prefix is \('a', 1\)"),
    (lambda: jd.join(robots.chain(2), robots.chain(2, gravity=None), prefix="b"), "different gravity"),
    (lambda: jd.join(robots.chain(2), robots.chain(2), prefix="b", pose=(1.0, 2.0)), "pose"),
    (lambda: scenes.coordinated_lifting(count=0), "count is 0"),
]


@pytest.mark.parametrize("call, match", BAD)
def test_bad_input_is_refused(call, match):
    with pytest.raises(ValueError, match=match):
        call()


# Coordinated lifting.


def adjoint_inverse(pose):
    return np.asarray(se3.Ad(se3.inverse(jnp.asarray(pose))))


def saddle_point(scene, q, v):
    """Rows, acceleration and multipliers by Pinocchio's mass matrix and Jacobians and one linear system."""
    model, bridge = to_pinocchio(scene.system)
    data, x, v = model.createData(), bridge.q_to_pinocchio(q), np.asarray(v)
    M = pin.crba(model, data, x)
    M = np.triu(M) + np.triu(M, 1).T
    h = pin.nonLinearEffects(model, data, x, v)
    pin.forwardKinematics(model, data, x, v, np.zeros(model.nv))
    pin.updateFramePlacements(model, data)
    plate = data.oMf[model.getFrameId("plate")]
    A, gamma = [], []
    for grip in scene.constraints:
        frame = model.getFrameId(grip.finger)
        J = pin.computeFrameJacobian(model, data, x, frame, pin.LOCAL)
        row = -J
        row[:, -6:] += adjoint_inverse((plate.inverse() * data.oMf[frame]).homogeneous)
        A.append(row)
        pin.forwardKinematics(model, data, x, v, np.zeros(model.nv))
        gamma.append(pin.getFrameAcceleration(model, data, frame, pin.LOCAL).vector)
    A, gamma = np.concatenate(A), np.concatenate(gamma)
    m = len(A)
    solution = np.linalg.solve(np.block([[M, -A.T], [A, np.zeros((m, m))]]), np.concatenate([-h, gamma]))
    return A, solution[: model.nv], solution[model.nv :]


@pytest.mark.long
@pytest.mark.parametrize("count", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_arms_lift_a_plate_together(count):
    """6 k rows [-J_h, Ad^-1_{g_ot}], 6 k - 6 internal forces, motion and wrenches as of the saddle-point system."""
    scene = scenes.coordinated_lifting(count=count)
    q, v = scenes.coordinated_lifting.start(count=count)

    @quick
    def compute(q, v):
        dynamics = jd.constrained_dynamics(scene, q, v)
        return jd.constraint_jacobian(scene, q), dynamics.acceleration, dynamics.multipliers, dynamics.rank

    A, a, lam, rank = compute(q, v)
    rows, acceleration, multipliers = saddle_point(scene, q, v)
    assert_close(A, rows, 1e-12)
    assert A.shape == (6 * count, 7 * count + 6) and int(rank) == 6 * count
    np.testing.assert_allclose(A @ v, 0, atol=1e-14)
    assert_close(a, acceleration, 1e-9)
    assert_close(lam, multipliers, 1e-8)
    # The grips' wrenches and the weight move the plate: Newton and Euler in its own axes.
    G = np.asarray(A[:, -6:].T)
    assert np.linalg.matrix_rank(G) == 6
    moments = np.diag([4 * 0.3**2 / 4 + 4 * 0.04**2 / 12] * 2 + [4 * 0.3**2 / 2])
    linear, omega = np.split(np.asarray(v[-6:]), 2)
    force = 4 * (a[-6:-3] + np.cross(omega, linear) + np.array([0.0, 0.0, 9.81]))
    torque = moments @ a[-3:] + np.cross(omega, moments @ omega)
    assert_close(G @ lam, np.concatenate([force, torque]), 1e-9)
