"""The whole-body law of robots with legs: errors decay as the gains say, forces stay in cones, and what cannot be is told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import load_both, quick
from refusals import refusals
from test_control import KD, KP, decayed
from test_legs import crouched, feet_of

import jaxdyn as jd
from jaxdyn import inertia

TS = jnp.linspace(0.0, 2.0, 21)
BASE = (0, 1, 2)
FORCES, PRELOADED = (jd.control.GroundForces(preload, passive=BASE) for preload in (0.0, 1.0))


def biped_model():
    """A trunk that moves in the x-z plane, on two legs of a thigh and a shank each, that bend forwards and backwards."""
    upright = np.eye(4)
    upright[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # the plane's y is the world's z
    builder = jd.ModelBuilder("biped", gravity=(0.0, 0.0, -9.81))
    builder.add_body("trunk", None, "planar", inertia.box(6.0, (0.4, 0.15, 0.1)), pose=upright)
    for name, x in (("front", 0.15), ("hind", -0.15)):
        bar = (0.5, (0.0, -0.1, 0.0), (2e-3, 1e-4, 2e-3))
        builder.add_body(f"{name}_thigh", "trunk", "continuous", bar, pose=(x, 0.0, 0.0))
        builder.add_body(f"{name}_shank", f"{name}_thigh", "continuous", bar, pose=(0.0, -0.2, 0.0))
        builder.add_frame(f"{name}_foot", f"{name}_shank", (0.0, -0.2, 0.0))
    return builder.build()


@pytest.fixture(scope="module")
def biped():
    """The model, a configuration with bent legs, its feet and where its centre of mass is."""
    model = biped_model()
    q = jnp.asarray([0.0, 0.35, 0.0, 0.5, -1.0, -0.5, 1.0])
    cone = jd.contact.friction_cone("hard-finger", mu=0.6)
    feet = [jd.control.foot(name, cone) for name in ("front_foot", "hind_foot")]
    return model, q, feet, jd.center_of_mass(model, q)


def law_of(biped, shift=(0.0, 0.0, 0.0), kp=KP, kd=KD, **options):
    model, q, feet, center = biped
    # The attitude of the trunk, whose plane stands upright in the world.
    attitude = jd.frame_pose(model, q, "trunk")[:3, :3]
    options = {"orientation": attitude, "posture": q, "forces": FORCES} | options
    return jd.control.WholeBody(model, feet, center + jnp.asarray(shift), kp, kd, **options)


@pytest.fixture(scope="module")
def evaluated(biped):
    """One program for all of a law's values at a state."""
    model, _, feet, _ = biped

    @quick
    def evaluate(law, q, v):
        wanted = law.dynamics(q, v)
        dynamics = jd.constrained_dynamics(jd.control.standing(model, q, feet), q, v, wanted.tau)
        return wanted, dynamics, law.acceleration(q, v), law.shortfall(q, v), law.missing_wrench(q, v)

    return evaluate


@pytest.mark.long
def test_it_stands_still_at_its_target(biped, evaluated):
    """The held robot does not move, and the multipliers are the program's forces, which carry the weight."""
    model, q, _, _ = biped
    wanted, computed, _, _, missing = evaluated(law_of(biped, forces=PRELOADED), q, jnp.zeros(model.nv))
    assert bool(wanted.success) and np.asarray(wanted.margins).min() > 1.0 - 1e-6
    assert not np.asarray(wanted.tau)[np.array(BASE)].any()
    np.testing.assert_allclose(computed.acceleration, 0.0, atol=1e-8)
    np.testing.assert_allclose(computed.multipliers, wanted.forces, atol=1e-7)  # the tolerance of the program
    # Weight of 78 N, and a regularisation of 1e-6.
    np.testing.assert_allclose(missing, 0.0, atol=1e-3)
    np.testing.assert_allclose(sum(f[2] for f in wanted.by_foot().values()), 8.0 * 9.81, rtol=1e-7)


def test_the_wanted_acceleration_is_the_one_that_follows(biped, evaluated):
    """In motion, with feet that stay: a of the full equations is the law's, and the tasks get what their gains ask for."""
    model, q, feet, _ = biped
    scene = jd.control.standing(model, q, feet)
    J = np.asarray(jd.constraint_jacobian(scene, q))
    v = jnp.asarray((np.eye(model.nv) - np.linalg.pinv(J) @ J) @ [0.2, -0.1, 0.4, 0.0, 0.1, 0.0, -0.2])
    law = law_of(biped, (0.01, 0.0, -0.01))
    wanted, computed, a, short, _ = evaluated(law, q, v)
    np.testing.assert_allclose(computed.acceleration, a, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(short, 0.0, atol=1e-9)

    def rate(time):
        return jd.com_jacobian(model, jd.integrate(model, q, time * v)) @ v

    speed, bend = jax.jvp(rate, (0.0,), (1.0,))
    error = jd.center_of_mass(model, q) - law.center.target(0.0)
    np.testing.assert_allclose(jd.com_jacobian(model, q) @ a + bend, -KD * speed - KP * error, atol=1e-9)
    assert bool(wanted.success)


def assert_follows(model, law, computed):
    """The centre of mass by the closed form, its late rate to 1 %, and the base's attitude unchanged."""
    errors = np.asarray(jax.vmap(lambda q: law.center.position(model, q, 0.0))(computed.q))
    exact = decayed(np.asarray(TS), errors[0], np.zeros(3))
    np.testing.assert_allclose(errors, exact, atol=1e-7)  # of RK4's steps of 20 ms
    slopes = [np.polyfit(TS[-6:], np.log(np.linalg.norm(e[-6:], axis=1)), 1)[0] for e in (errors, exact)]
    np.testing.assert_allclose(*slopes, rtol=0.01)
    turned = jax.vmap(lambda q: law.turn.position(model, q, 0.0))(computed.q)
    np.testing.assert_allclose(turned, 0.0, atol=1e-7)


def test_what_the_feet_cannot_carry_has_a_code(biped, evaluated):
    """A jump sideways that needs more friction than there is: infeasible, with the wrench missing."""
    model, q, feet, _ = biped
    law, at_rest = law_of(biped, (2.0, 0.0, 0.0)), jnp.zeros(model.nv)
    wanted, _, a, _, missing = evaluated(law, q, at_rest)
    assert wanted.result == jd.RESULTS.infeasible
    # 8 kg at 12 m/s^2 along x are more than mu times the weight; glued feet could do it, with the shortest forces.
    assert np.asarray(wanted.margins).min() < -1.0
    sums = sum(wanted.by_foot().values())
    np.testing.assert_allclose(sums, 8.0 * np.asarray([KP * 2.0, 0.0, 9.81]), atol=1e-8)
    assert np.abs(wanted.forces).max() < 200.0
    assert float(missing[0]) > 1.0
    np.testing.assert_allclose(missing, jd.control.missing_wrench(model, q, at_rest, a, feet, passive=BASE), atol=1e-6)


def test_feet_come_first(biped, evaluated):
    """Straight legs cannot lift the trunk: the feet stay where they are, and the shortfall is what is asked for in vain."""
    model, q, feet, _ = biped
    straight = q.at[3:].set(0.0).at[1].set(0.4)
    at_rest = jnp.zeros(model.nv)
    wanted, _, a, short, _ = evaluated(
        law_of((model, straight, feet, jd.center_of_mass(model, straight)), (0, 0, 0.1)), straight, at_rest
    )
    J = np.concatenate([one.jacobian(model, straight) for one in feet])
    np.testing.assert_allclose(J @ a, 0.0, atol=1e-9)
    np.testing.assert_allclose(short[2], KP * 0.1, rtol=1e-6)
    assert bool(wanted.success)


@pytest.mark.slow
def test_batches_and_gradients_in_gains(biped):
    """vmap equals the loop; the slope of the torques in a gain and a target against differences."""
    model, q, _, _ = biped
    v = jnp.zeros(model.nv)

    def size(kp, shift):
        return jnp.sum(law_of(biped, shift * jnp.asarray([1.0, 0.0, 0.5]), kp=kp)(q, v) ** 2)

    value = quick(size)
    kps, shifts = jnp.asarray([4.0, 9.0, 20.0]), jnp.asarray([0.01, -0.02, 0.015])
    many = quick(jax.vmap(size))(kps, shifts)
    np.testing.assert_allclose(many, [value(*x) for x in zip(kps, shifts, strict=True)], rtol=1e-8)
    slopes = quick(jax.grad(size, (0, 1)))(9.0, 0.02)
    for i, (slope, step) in enumerate(zip(slopes, (1e-3, 1e-5), strict=True)):
        high, low = (value(9.0 + s * step * (i == 0), 0.02 + s * step * (i == 1)) for s in (1, -1))
        # Differences of numbers with the tolerance of the program, 1e-9.
        np.testing.assert_allclose(slope, (high - low) / (2 * step), rtol=1e-4)
        assert abs(slope) > 0


test_bad_input_is_refused = refusals(
    (lambda x: law_of(x, kp=-1.0), "kp is -1.0"),
    (lambda x: law_of(x, orientation=jd.control.Attitude(jnp.eye(3), kd=0.0)), "kd is 0.0"),
    (lambda x: law_of(x, orientation=jd.control.Attitude(jnp.eye(3), "tail")), "'tail'"),
    (lambda x: law_of(x, posture=None, stiffness=1.0), "posture is None"),
    (lambda x: law_of(x, posture=jnp.zeros(3)), "posture has shape"),
    (lambda x: law_of((x[0], x[1], [], x[3])), "contacts is empty"),
    (lambda x: law_of(x, forces=None), "no free joint"),
    (lambda x: jd.control.standing(x[0], x[1], []), "contacts is empty"),
    (
        lambda x: jd.control.WholeBody(*x[::2], jnp.zeros(2), KP, KD, forces=FORCES)(x[1], jnp.zeros(7)),
        "target has shape",
    ),
    given=("biped",),
)


def test_former_keywords_are_taken_with_a_warning(biped):
    model, _, feet, center = biped
    attitude = jnp.eye(3)
    with pytest.warns(DeprecationWarning, match=r"GroundForces|Attitude"):
        old = jd.control.WholeBody(
            model, feet, center, KP, KD, orientation=attitude, base="trunk", turn_kp=2.0, passive=BASE, preload=1.0
        )
    turn = jd.control.Attitude(attitude, "trunk", kp=2.0)
    new = jd.control.WholeBody(model, feet, center, KP, KD, orientation=turn, forces=PRELOADED)
    assert jax.tree.structure(old) == jax.tree.structure(new)
    jax.tree.map(np.testing.assert_array_equal, old, new)


@pytest.mark.slow
@pytest.mark.parametrize("file", ["solo12.urdf", "talos_reduced.urdf"])
def test_real_robots_shift_their_weight(file):
    """Four points, or two flat feet with wrench cones: standing exact to 1e-8, the centre of mass by the closed form."""
    model, _, _ = load_both(file, True)
    q, feet = crouched(model, file), feet_of(file)
    attitude, center = jnp.eye(3), jd.center_of_mass(model, q)
    at_rest, scene = jnp.zeros(model.nv), jd.control.standing(model, q, feet)
    options = {
        "orientation": attitude,
        "posture": q,
        "stiffness": 4.0,
        "damping": 4.0,
        "forces": jd.control.GroundForces(0.1),
    }

    law = jd.control.WholeBody(model, feet, center, KP, KD, **options)
    wanted = quick(lambda q: law.dynamics(q, at_rest))(q)
    computed = quick(lambda tau: jd.constrained_dynamics(scene, q, at_rest, tau))(wanted.tau)
    assert bool(wanted.success)
    np.testing.assert_allclose(computed.acceleration, 0.0, atol=1e-8)

    law = jd.control.WholeBody(model, feet, center + jnp.asarray([0.01, 0.02, -0.01]), KP, KD, **options)
    outputs = ("contact_margins", "multipliers")
    computed = jd.simulate(scene, q, at_rest, TS, control=law, stepsize=0.02, outputs=outputs)
    assert_follows(model, law, computed)
    assert min(float(x.min()) for x in computed.contact_margins.values()) > 0.0
