"""Motions with events: friction that sticks and slips, contacts that open and close, against closed forms."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from refusals import refusals
from scipy.optimize import brentq

import jaxdyn as jd
from jaxdyn.forces.piecewise import Pieces
from jaxdyn.simulation.hybrid import transitions
from jaxdyn.simulation.hybrid.event_loop import _cases
from jaxdyn.simulation.hybrid.modes import Gram, Mode, elements_of

G, MU, MU_S, LOAD, RATE = 9.81, 0.3, 0.5, 6.0, 2.0
PLANE = ((0, 0, 0), (-np.pi / 2, 0, 0))  # z of the ground along y of the world


def load(q, v, t):
    return jnp.stack([LOAD * jnp.sin(RATE * t)])


def block(mu=MU, static=MU_S, normal=G, **options):
    system = jd.scenes.sliding_block().system
    return jd.Scene(system, forces=(jd.contact.DryFriction(mu, normal, 0, static=static, **options),))


def block_velocity(start, speed, sign):
    """Of the block of one kilogram while it slides in a direction."""

    def at(t):
        return speed + LOAD / RATE * (np.cos(RATE * start) - np.cos(RATE * t)) - sign * MU * G * (t - start)

    return at


TS = jnp.linspace(0.0, 4.0, 41)
TIGHT: Any = {"stepsize": within(1e-11)}


@pytest.fixture(scope="module")
def shaken():
    return jd.simulate(block(), [0.0], [2.0], TS, control=load, outputs=("acceleration", "contact_forces"), **TIGHT)


@pytest.mark.long
def test_block_turns_sticks_and_slips_at_the_times_of_the_closed_form(shaken):
    first, back = block_velocity(0.0, 2.0, 1), None
    turns = brentq(first, 1.5, 3.0, xtol=1e-15)
    back = block_velocity(turns, 0.0, -1)
    sticks = brentq(back, turns + 0.5, 3.6, xtol=1e-15)
    slips = brentq(lambda t: LOAD * np.sin(RATE * t) - MU_S * G, sticks, 3.9, xtol=1e-15)
    assert list(shaken.events.name[:4]) == ["friction: turn", "friction: stick", "friction: slip", ""]
    np.testing.assert_allclose(shaken.events.time[:3], [turns, sticks, slips], rtol=0, atol=1e-10)
    assert int(shaken.events.count) == 3 and np.isnan(shaken.events.time[3:]).all()
    again = block_velocity(slips, 0.0, 1)
    at = np.asarray(TS)
    want = np.select([at < turns, at < sticks, at < slips], [first(at), back(at), 0 * at], again(at))
    np.testing.assert_allclose(shaken.v[:, 0], want, rtol=0, atol=1e-9)
    np.testing.assert_allclose(shaken.events.times("friction: slip"), [slips], atol=1e-10)


@pytest.mark.long
def test_steps_of_fixed_length_end_at_events_and_go_on(shaken):
    """To the order of RK4; the points of the steps stay where they were, so that the end is met."""
    errors = []
    for stepsize in (0.08, 0.04):
        motion = jd.simulate(block(), [0.0], [2.0], TS, control=load, stepsize=stepsize)
        assert motion.success and list(motion.events.name[:4]) == list(shaken.events.name[:4])
        np.testing.assert_allclose(motion.events.time[:3], shaken.events.time[:3], rtol=0, atol=stepsize**4)
        np.testing.assert_allclose(motion.v, shaken.v, rtol=0, atol=stepsize**4)
        errors.append(np.abs(motion.q[-1] - shaken.q[-1]).max())
        # A step for each length, and the few that look for the three events.
        assert 4 / stepsize <= int(motion.stats["num_steps"]) < 4 / stepsize + 3 * 20
    assert 10 < errors[0] / errors[1] < 24


@pytest.mark.long
def test_steps_of_fixed_length_have_gradients_through_events():
    ts = jnp.asarray([0.0, 2.5, 4.0])

    def seen(mu, speed):
        scene = block(mu, 1.6 * mu)
        motion = jd.simulate(scene, [0.0], jnp.stack([speed]), ts, control=load, stepsize=0.02, throw=False)
        return motion.q[-1, 0] + motion.events.time[1]

    run = jax.jit(jax.value_and_grad(seen, (0, 1)))
    values, h = (MU, 2.0), 1e-5
    for i, got in enumerate(run(*values)[1]):
        up, down = (run(*(x + sign * h * (i == k) for k, x in enumerate(values)))[0] for sign in (1, -1))
        assert abs(float(got) - float(up - down) / (2 * h)) < 1e-5 * max(1.0, abs(float(got)))


def test_friction_balances_at_rest_and_lies_on_the_cone_while_it_slides(shaken):
    force, at_rest = shaken.contact_forces["friction"], np.asarray(shaken.v[:, 0] == 0)
    assert at_rest.sum() >= 2
    np.testing.assert_allclose(shaken.acceleration[:, 0], LOAD * np.sin(RATE * TS) + force[:, 0], atol=1e-11)
    np.testing.assert_allclose(force[at_rest, 0], -LOAD * np.sin(RATE * TS[at_rest]), atol=1e-11)
    np.testing.assert_allclose(force[~at_rest, 0], -MU * G * np.sign(shaken.v[~at_rest, 0]), rtol=1e-12)


@pytest.mark.slow
def test_each_lane_of_a_batch_has_its_own_events(shaken):
    speeds = jnp.asarray([2.0, 0.5, -1.0])
    batch = jax.jit(jax.vmap(lambda v: jd.simulate(block(), jnp.zeros(1), v[None], TS, control=load, **TIGHT)))(speeds)
    assert batch.success.all()
    np.testing.assert_allclose(batch.events.time[0], shaken.events.time, atol=1e-12)
    assert len(set(np.asarray(batch.events.time[:, 0]).round(6))) == 3
    for i, speed in enumerate(speeds[1:], 1):
        alone = jd.simulate(block(), jnp.zeros(1), speed[None], TS, control=load, **TIGHT)
        np.testing.assert_allclose(batch.q[i], alone.q, atol=1e-10)
        assert list(batch.events.name[i]) == list(alone.events.name)


@pytest.mark.slow
def test_bowling_ball_rolls_when_the_closed_form_says():
    """Problem 5.4: the friction is that of the contact's own normal force."""
    r, m, inertia, g, mu = 0.10795, 6.35, 0.0296, 9.8, 0.12
    ts = jnp.linspace(0.0, 4.0, 5)
    motion = jd.simulate(jd.scenes.bowling_ball(), *jd.scenes.bowling_ball.start(), ts, stepsize=within(1e-10))
    up, v, w = np.array([0, 0, 1.0]), np.array([8.0, 0, 0]), np.array([-8 * np.pi, 0, 0])
    slip = v + np.cross(w, -r * up)
    rolling = r / (inertia + m * r * r) * np.cross(inertia * w + m * r * np.cross(up, v), up)
    begins = (v - rolling) @ slip / (np.linalg.norm(slip) * mu * g)
    # Slow sliding has a fixed direction, whose beginning is an inner event.
    changes = [name for name in motion.events.name if name and not name.endswith(": inner")]
    assert changes == ["lane: stick"]
    assert abs(motion.events.times("lane: stick")[0] - begins) < 1e-8
    turned = jax.vmap(jd.so3.quat_to_matrix)(motion.q[-1:, 3:])[0]
    np.testing.assert_allclose(turned @ motion.v[-1, :3], rolling, atol=1e-8)
    along = (v * begins - mu * g * slip / np.linalg.norm(slip) * begins**2 / 2) + rolling * (4 - begins)
    np.testing.assert_allclose(motion.q[-1, :3], along + r * up, atol=1e-8)


def box(mu=0.4, size=(0.4, 0.2), mass=2.0):
    (a, h), (m,) = size, (mass,)
    builder = jd.ModelBuilder("box", gravity=(0.0, -G, 0.0))
    builder.add_body("box", None, "planar", (m, (0, 0, 0), (0.1, 0.1, m * (a * a + h * h) / 12)))
    corners = {"left": (-a / 2, -h / 2, 0), "right": (a / 2, -h / 2, 0)}
    feet = [jd.contact.ground_contact("box", at, mu, plane=PLANE, name=name) for name, at in corners.items()]
    return jd.Scene(builder.build(), forces=feet)


@pytest.fixture(scope="module")
def fallen():
    """The box by its start, on one compiled program."""
    times = jnp.linspace(0.0, 1.0, 101)

    def motion(q0, v0, mu=0.4, ts=times):
        return jd.simulate(box(mu), q0, v0, ts, outputs=("energy", "contact_forces"), throw=False, **TIGHT)

    return motion


@pytest.mark.slow
def test_box_that_lands_flat_stops_and_slides(fallen):
    """m v_y is taken by the ground; the impulse of friction is up to mu times that, and slows it from 2 m/s."""
    motion, m, mu = fallen([0.0, 0.5, 0.0], [2.0, 0.0, 0.0]), 2.0, 0.4
    touch = np.sqrt(2 * 0.4 / G)
    after = 2.0 - mu * G * touch
    rest = touch + after / (mu * G)
    assert motion.success
    # Events "inner" change how a mode is computed, and not the motion.
    seen = [i for i, name in enumerate(motion.events.name) if name and "inner" not in name]
    assert list(motion.events.name[seen]) == ["left: touch", "right: touch", "left: stick", "right: stick"]
    np.testing.assert_allclose(motion.events.time[np.array(seen)], [touch, touch, rest, rest], atol=1e-10)
    np.testing.assert_allclose(motion.q[-1], [2 * touch + after**2 / (2 * mu * G), 0.1, 0], atol=1e-9)
    flying = motion.ts < touch
    np.testing.assert_allclose(motion.energy[flying], m * (G * 0.5 + 2.0), rtol=1e-11)
    landed = (motion.ts > touch) & (motion.ts < rest)
    v = after - mu * G * (motion.ts[landed] - touch)
    np.testing.assert_allclose(motion.energy[landed], m * G * 0.1 + m * v**2 / 2, rtol=1e-10)
    for name in ("left", "right"):
        np.testing.assert_allclose(motion.contact_forces[name][-1, 2], m * G / 2, rtol=1e-7)  # shared by least norm


@pytest.mark.slow
@pytest.mark.parametrize("mu", [0.4, 0.8])
def test_box_on_a_corner_is_hit_as_linear_and_angular_momentum_say(fallen, mu):
    """The impulse would have to lie at a slope of 0.61 to hold the corner: with less friction than that it slides."""
    angle, m, (a, h) = 0.3, 2.0, (0.4, 0.2)
    moment = m * (a * a + h * h) / 12
    corner = np.array([-a / 2 * np.cos(angle) + h / 2 * np.sin(angle), -a / 2 * np.sin(angle) - h / 2 * np.cos(angle)])
    touch = np.sqrt(2 * (0.5 + corner[1]) / G)
    ts = jnp.concatenate([jnp.linspace(0, touch, 50), touch + 1e-12 + jnp.linspace(0, 0.7, 51)])
    motion = fallen([0.0, 0.5, angle], [0.0, 0.0, 0.0], mu, ts)
    assert motion.events.name[0] == "left: touch" and abs(motion.events.time[0] - touch) < 1e-10
    speed = G * touch
    x, y = corner
    # Velocities of the corner by impulses along the ground and up.
    yields = np.array([[1 / m + y * y / moment, -x * y / moment], [-x * y / moment, 1 / m + x * x / moment]])
    impulse = np.linalg.solve(yields, [0, speed])
    assert (impulse[0] <= mu * impulse[1]) == (mu == 0.8)
    if mu == 0.4:
        impulse = np.array([mu, 1.0]) * speed / (yields[1] @ [mu, 1.0])
    turn = (x * impulse[1] - y * impulse[0]) / moment
    i = 50
    np.testing.assert_allclose(motion.v[i, 2], turn, atol=1e-9)
    after = impulse / m - np.array([0, speed])
    lost = m * speed**2 / 2 - (moment * turn**2 + m * after @ after) / 2
    np.testing.assert_allclose(motion.energy[0] - motion.energy[i], lost, rtol=1e-9)
    assert (np.diff(motion.energy) < 1e-9).all()


@pytest.mark.slow
def test_contact_lets_go_where_it_would_pull():
    """A bead that slides without friction down a sphere of one metre leaves it at cos(theta) = 2/3."""
    builder = jd.ModelBuilder("bead", gravity=(0.0, 0.0, -G))
    builder.add_body("bead", None, "free", (1.0, (0, 0, 0), (1e-2, 1e-2, 1e-2)))
    touching = jd.rolling_sphere("bead", None, 0.1, on="sphere", surface_radius=0.9, slip=True, name="bead")
    scene = jd.Scene(builder.build(), forces=(jd.contact.UnilateralContact(touching),))
    start = 0.1
    q0 = [np.sin(start), 0.0, np.cos(start), 1.0, 0.0, 0.0, 0.0]
    motion = jd.simulate(scene, q0, jnp.zeros(6), jnp.linspace(0.0, 1.5, 151), stepsize=within(1e-10))
    assert list(motion.events.name[:2]) == ["bead: release", ""]
    leaves = float(motion.events.time[0])
    i = int(np.argmax(motion.ts > leaves))
    back = motion.ts[i] - leaves
    height = motion.q[i, 2] - motion.v[i, 2] * back - G * back**2 / 2
    assert abs(height - 2 / 3 * np.cos(start)) < 1e-8


@pytest.mark.parametrize("kind", ["gap", "ground"])
def test_stops_hit_and_let_go_by_newtons_law(kind):
    """A bar on two stops with any velocity at the start: impulses push, and a rebound below -e u has none. A throw is among them.

    On the ground the tangent rows vanish, as points at the height of the hinge move up and down alone. Two of the starts have no
    mode there: one end stays closed after the impact, and slips the next moment, in either direction.
    """
    builder = jd.ModelBuilder("bar", gravity=(0.0, 0.0, -G))
    builder.add_body("lift", None, "prismatic", (0.0, (0, 0, 0), (0, 0, 0)), axis=(0, 0, 1))
    builder.add_body("bar", "lift", "revolute", (2.0, (0.1, 0, 0), (0.3, 0.3, 0.3)), axis=(0, 1, 0))
    model, arms, bounds = builder.build(), np.array([-0.6, 0.5]), np.array([0.5, 0.8])
    stops = [
        jd.contact.gap_contact(lambda q, t, x=x: q[0] - x * jnp.sin(q[1]), restitution=e, name=f"{x}")
        if kind == "gap"
        else jd.contact.ground_contact("bar", (x, 0, 0), friction=0.5, restitution=e, name=f"{x}")
        for x, e in zip(arms, bounds, strict=True)
    ]
    scene, ts = jd.Scene(model, forces=stops), jnp.asarray([0.0, 1e-6])
    run = lambda v: jd.simulate(scene, jnp.zeros(2), v, ts, throw=False)  # noqa: E731
    velocities = np.random.default_rng(0).normal(size=(64, 2)) * [1.0, 3.0]
    velocities[:2] = [1.0, 0.0], [-1.0, 0.0]
    motions = jax.jit(jax.vmap(run))(jnp.asarray(velocities))
    fails = ~np.asarray(motions.success)
    assert fails.sum() <= (0 if kind == "gap" else 2)
    assert (np.asarray(motions.result.index)[fails] == jd.RESULTS.no_contact_mode.index).all()
    M, J = np.asarray(jd.mass_matrix(model, jnp.zeros(2))), np.stack([np.ones(2), -arms], 1)
    Y = np.linalg.solve(M, J.T)
    for v, after in zip(velocities[~fails], np.asarray(motions.v[:, 1])[~fails], strict=True):
        wanted = bounds * np.maximum(-J @ v, 0.0)
        for acting in ([], [0], [1], [0, 1]):
            p = np.zeros(2)
            p[acting] = np.linalg.solve((J @ Y)[np.ix_(acting, acting)], (wanted - J @ v)[acting])
            if (p >= 0).all() and (J @ (v + Y @ p) >= wanted - 1e-12).all():
                np.testing.assert_allclose(after, v + Y @ p, atol=1e-4)  # gravity over the first microsecond
                break
        else:
            raise AssertionError(f"no impulses for {v}")


def rod(mu, angle, speed, end=0.3, height=0.0):
    """A slender rod of one metre and one kilogram whose end slides on the ground or at a height, not turning."""
    builder = jd.ModelBuilder("rod", gravity=(0.0, -G, 0.0))
    builder.add_body("rod", None, "planar", (1.0, (0, 0, 0), (0.0, 1 / 12, 1 / 12)))
    tip = jd.contact.ground_contact("rod", (-0.5, 0, 0), mu, plane=PLANE, name="tip")
    v0 = speed * jnp.asarray([np.cos(angle), -np.sin(angle), 0.0])
    q0 = [0.0, 0.5 * np.sin(angle) + height, angle]
    return jd.simulate(jd.Scene(builder.build(), forces=[tip]), q0, v0, jnp.linspace(0, end, 4), throw=False)


@pytest.mark.long
def test_painleves_rod_is_stopped_by_an_impulse_and_one_pressed_into_the_ground_has_a_code():
    """No force serves where 1 + 3 cos^2 + 3 mu sin cos sign(v) < 0: there an impulse without collision stops the tip, about which
    the angular momentum is that before. A start below the ground ends its own trajectory of the batch alone."""
    s, c = np.sin(1.0), np.cos(1.0)
    mu, speed, paradox = np.array([0.3, 2.0, 2.0]), np.array([-1.0, -1.0, 1.0]), [False, True, False]
    assert ((1 + 3 * c * c + 3 * mu * s * c * np.sign(speed) < 0) == paradox).all()
    run = jax.jit(jax.vmap(lambda mu, speed, height, end: rod(mu, 1.0, speed, end, height=height)))
    given = np.append(mu, 0.3), np.append(speed, -1.0), np.array([0.0, 0.0, 0.0, -0.05])
    motions = run(*given, np.full(4, 1e-9))
    assert (motions.result == jd.RESULTS.inconsistent_start).tolist() == [False, False, False, True]
    assert motions.success.tolist() == [True, True, True, False]
    # About the tip: m v times its height, over a third of m l^2. The forces of a nanosecond change it by 1e-7.
    np.testing.assert_allclose(motions.v[:3, -1, 2], [0.0, 0.5 * s * 3, 0.0], atol=1e-7)
    assert run(*given, np.full(4, 0.3)).success.tolist() == [True, True, True, False]


def differences(f, at, steps):
    """Central differences of fourth order."""
    return np.array([(8 * (f(at + s) - f(at - s)) - (f(at + 2 * s) - f(at - 2 * s))) / (12 * s.sum()) for s in steps])


@pytest.mark.slow
def test_gradients_go_through_events():
    """Turn, stick and slip: of rows and times of events, in coefficients, normal force and start."""
    ts = jnp.linspace(0.0, 4.0, 5)

    def computed(p):
        scene = block(p[0], p[1], p[2])
        motion = jd.simulate(
            scene, jnp.zeros(1), p[3:], ts, control=load, stepsize=within(1e-13), events=[jd.events.ModeSwitches(4)]
        )
        return jnp.concatenate([motion.q[:, 0], motion.v[:, 0], motion.events.time[:3]])

    at = jnp.asarray([MU, MU_S, G, 2.0])
    weights = jnp.asarray(np.random.default_rng(0).normal(size=13))
    values = jax.jit(lambda p: computed(p) @ weights)
    gradients = jax.jit(jax.vmap(jax.grad(lambda p: computed(p) @ weights)))(jnp.stack([at, at * 1.01]))
    want = differences(values, at, 3e-4 * jnp.eye(4))
    np.testing.assert_allclose(gradients[0], want, rtol=1e-8, atol=1e-7)  # of the differences
    # The time of the last event is where the load comes to what holds: LOAD cos(RATE t) RATE dt = G d mu_s.
    time = np.pi / RATE + np.arcsin(MU_S * G / LOAD) / RATE
    gradient = jax.jit(jax.grad(lambda p: computed(p)[-1]))(at)
    np.testing.assert_allclose(
        gradient, np.array([0, G, MU_S, 0]) / (LOAD * RATE * np.cos(RATE * time)) * -1, atol=1e-9
    )


@pytest.mark.slow
def test_second_derivatives_go_through_events():
    """Of rows and times of a block that turns, sticks and slips: differences of the gradients."""
    ts = jnp.linspace(0.0, 2.5, 4)

    def slides(p):
        motion = jd.simulate(
            block(p[0], p[1]),
            jnp.zeros(1),
            p[2:],
            ts,
            control=load,
            stepsize=within(1e-12),
            events=[jd.events.ModeSwitches(3)],
        )
        return (
            jnp.sum(jnp.sin(motion.q[:, 0]))
            + jnp.sum(motion.v[1:, 0] ** 2)
            + motion.events.time[:2] @ jnp.array([1, 0.3])
        )

    at = jnp.asarray([MU, MU_S, 2.0])
    gradient = jax.jit(jax.grad(slides))
    want = differences(gradient, at, 3e-4 * jnp.eye(3))
    computed = jax.jit(jax.jacfwd(jax.grad(slides)))(at)
    np.testing.assert_allclose(computed, want, rtol=1e-6, atol=1e-6)  # of the differences


@pytest.mark.slow
def test_friction_in_proportion_to_a_multiplier_of_both_sides():
    """A bead on a rough hoop without gravity: N = m v^2/R either way, so v = v0/(1 + mu v0 t/R)."""
    system = jd.LagrangianSystem(lambda q, v, t, p: 0.5 * jnp.sum(v * v) - p["g"] * q[1], 2, parameters={"g": 0.0})
    along = jd.Pfaffian(lambda q, t: jnp.stack([-q[1], q[0]]) / jnp.sqrt(q @ q), name="along")
    ts = jnp.linspace(0.0, 2.0, 5)
    signs = jnp.asarray([1.0, -1.0])  # the multiplier's sign is a matter of how the constraint is written

    def motion(sign):
        hoop = jd.Holonomic(lambda q, t: sign * (jnp.sqrt(q @ q) - 1.0), name="hoop")
        scene = jd.Scene(system, (hoop,), (jd.contact.DryFriction(0.3, "hoop", along),))
        options = {"stepsize": within(1e-11), "outputs": ("multipliers",), "throw": False}
        return jd.simulate(scene, jnp.asarray([1.0, 0.0]), jnp.asarray([0.0, 2.0]), ts, **options)

    run = jax.jit(motion)
    for sign in signs:
        computed = run(sign)
        assert computed.success and int(computed.events.count) == 0
        speed = jnp.sqrt(jnp.sum(computed.v**2, 1))
        np.testing.assert_allclose(speed, 2 / (1 + 0.3 * 2 * ts), rtol=1e-9)
        np.testing.assert_allclose(computed.multipliers[:, 0], -sign * speed**2, rtol=1e-9)


@pytest.mark.long
def test_smooth_friction_creeps_as_it_says():
    """Under a load below mu N: v_s artanh(load/(mu N)); while it slides the force is tanh(|w|/v_s) of mu N."""
    scene, speed = block(smoothing=0.01), 0.01 * np.arctanh(0.5)
    half = 0.5 * MU * G
    motion = jd.simulate(
        scene, [0.0], [1.0], [0.0, 0.1, 2.0], control=lambda q, v, t: jnp.full(1, half), outputs=("contact_forces",)
    )
    np.testing.assert_allclose(motion.v[-1, 0], speed, rtol=1e-7)
    forces = motion.contact_forces["friction"][:, 0]
    np.testing.assert_allclose(forces[:2], -MU * G * np.tanh(motion.v[:2, 0] / 0.01), rtol=1e-10)
    np.testing.assert_allclose(forces[-1], -half, rtol=1e-6)


@pytest.mark.slow
def test_belt_drags_a_block_along_until_the_spring_is_stronger():
    """It sticks to the belt while k x < mu_s N: to the time x_s/v_belt, and slips there."""
    k, belt = 2.0, 0.5
    along = jd.Pfaffian(lambda q, t: jnp.ones(1), lambda q, t: belt, name="belt")
    friction = jd.contact.DryFriction(0.2, 1.0, along, static=0.4, name="belt")
    spring = jd.forces.JointSpring(k, rest=jnp.zeros(1))
    scene = jd.Scene(jd.scenes.sliding_block().system, forces=(friction, spring))
    motion = jd.simulate(scene, [0.0], [belt], jnp.linspace(0.0, 1.5, 4), **TIGHT)
    slips = 0.4 / k / belt
    w = np.sqrt(k)
    # From there a harmonic motion about 0.2/k, until its velocity is the belt's again.
    assert motion.events.name[0] == "belt: slip"
    np.testing.assert_allclose(motion.events.time[0], slips, atol=1e-10)
    t = np.asarray(motion.ts[motion.ts > slips]) - slips
    x = 0.1 + 0.1 * np.cos(w * t) + belt / w * np.sin(w * t)
    stuck = motion.events.time[1] - slips if int(motion.events.count) > 1 else np.inf
    np.testing.assert_allclose(motion.q[motion.ts > slips, 0][t < stuck], x[t < stuck], atol=1e-9)


test_what_does_not_fit_is_refused = refusals(
    (lambda: jd.contact.DryFriction(-0.1, 1.0), "0 <= friction"),
    (lambda: jd.contact.DryFriction(0.5, 1.0, static=0.4), "static"),
    (lambda: jd.contact.DryFriction(0.5, 1.0, -1), "along"),
    (lambda: jd.contact.DryFriction(0.5, 1.0, smoothing=0.0), "smoothing"),
    (lambda: jd.contact.UnilateralContact("lane"), "ground_contact"),
    (lambda: jd.contact.ground_contact("ball", radius=-1.0), "radius"),
    (lambda: jd.simulate(block(), [0.0], [1.0], TS, stepsize=-0.1), "stepsize"),
    (lambda: jd.simulate(block(), [0.0], [1.0], TS, stepsize=diffrax.PIDController(1e-6, 1e-6)), "stepsize"),
    (lambda: jd.simulate(block(), [0.0], [1.0], TS, solver=diffrax.Kvaerno5()), "solver"),
    (lambda: jd.simulate(block(), [0.0], [1.0], TS, adjoint="backsolve"), "adjoint"),
    (lambda: jd.simulate(block(), [0.0], [1.0], TS, outputs=("work",)), "outputs"),
    (lambda: jd.simulate(block(), [0.0], [1.0], TS, events=[jd.events.ModeSwitches(0)]), "max_events"),
    (lambda: jd.simulate(block(normal="rail"), [0.0], [1.0], TS), "rail"),
    (lambda: jd.constrained_dynamics(block(), jnp.zeros(1), jnp.zeros(1)), "CoulombFriction"),
)


def test_modes_that_flip_without_end_are_not_found(monkeypatch):
    """A contact that pulls where it is closed, and penetrates where it is open, next to one that agrees at once."""
    builder = jd.ModelBuilder("ball")
    builder.add_body("ball", None, "free", (1.0, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1)))
    contacts = [jd.contact.ground_contact("ball", name=name) for name in ("a", "b")]
    scene = jd.Scene(builder.build(), forces=contacts)
    elements = elements_of(scene, Pieces((), ()))
    count = elements.count
    flags, none = jnp.ones(2, bool), jnp.zeros(2, bool)

    def search(always):
        def disagreements(elements, problem, mode, slip, reaction):
            flips = jnp.array([True, False]) & always
            return jnp.stack([mode.closed & flips, ~mode.closed & flips, none, none, none], 1), none, slip

        monkeypatch.setattr(transitions, "_disagreements", disagreements)
        problem = transitions.Problem(
            Gram.of(jnp.eye(count)), jnp.zeros(count), *jnp.zeros((3, 2)), flags, none, none, none, *jnp.ones(2)
        )
        mode = Mode(flags, none, none, jnp.zeros(0, bool), *jnp.zeros((2, 2)))
        return transitions.choose_mode(elements, problem, mode, jnp.zeros((2, 2)))

    choice = jax.jit(jax.vmap(search))(jnp.array([True, False]))
    assert choice.done.all() and choice.wrong.tolist() == [True, False]
    change = transitions.Transition(None, None, None, None, ~choice.wrong[0], jnp.asarray(False), None)
    ((paradox, _), (unsettled, code)) = _cases(change)
    assert bool(unsettled) and not bool(paradox) and code is jd.RESULTS.no_contact_mode


def point(friction, restitution=0.0):
    """A point of 1 kg above the ground, by its coordinates."""
    builder = jd.ModelBuilder("point")
    for name, parent, axis in (("x", None, (1, 0, 0)), ("y", "x", (0, 1, 0))):
        builder.add_body(name, parent, "prismatic", axis=axis)
    builder.add_body("z", "y", "prismatic", (1.0, (0, 0, 0), (1, 1, 1)), axis=(0, 0, 1))
    contact = jd.contact.ground_contact("z", friction=friction, restitution=restitution)
    return jd.Scene(builder.build(), forces=[contact])


@pytest.mark.long
@pytest.mark.parametrize("adjoint", ["reverse", pytest.param("direct", marks=pytest.mark.slow)])
def test_the_direction_of_friction_in_an_impact_has_derivatives(adjoint):
    """A point strikes the ground while it slides: v+ = v - mu (1 + e) |w| v / |v| along it, with e |w| upwards.

    With directions that were constants to derivatives, gradients of a bounce were wrong by some per cent.
    """
    scene, g, mu, e = point(0.3, 0.5), 9.81, 0.3, 0.5
    end, weights = 0.1, jnp.array([0.3, -1.0, 0.7, 0.2, 1.1, -0.6])

    def simulated(x):
        q = jnp.array([0.0, 0.0, 1.0]) * x[0]
        solution = jd.simulate(scene, q, x[1:], jnp.array([0.0, end]), adjoint=adjoint)
        return weights @ jnp.concatenate([solution.q[-1], solution.v[-1]])

    def exact(x):
        height, v, w = x[0], x[1:3], x[3]
        hit = (w + jnp.sqrt(w * w + 2 * g * height)) / g
        speed = g * hit - w
        after, rest = v - mu * (1 + e) * speed * v / jnp.sqrt(v @ v), end - hit
        q = jnp.append(v * hit + after * rest, e * speed * rest - g * rest**2 / 2)
        return weights @ jnp.concatenate([q, after, (e * speed - g * rest)[None]])

    x = jnp.array([0.02, 1.2, 0.3, -1.0])
    assert float(simulated(x)) == pytest.approx(float(exact(x)), abs=1e-10)
    np.testing.assert_allclose(jax.jit(jax.grad(simulated))(x), jax.grad(exact)(x), atol=1e-9)
    if adjoint == "direct":
        np.testing.assert_allclose(jax.jit(jax.hessian(simulated))(x), jax.hessian(exact)(x), rtol=1e-7, atol=1e-7)


@pytest.mark.long
def test_a_body_that_hits_the_ground_and_slides_obeys_coulombs_law():
    """The impulse follows from the momenta, which are conserved in the flight behind it.

    It is on the cone and against the velocity behind the impact, whose direction the search had left an error of up to 1e-6.
    """
    mu, e, corner, end = 0.2, 0.4, np.array([0.1, -0.05, -0.08]), 0.01
    inertia = np.array([[0.02, 0.004, -0.003], [0.004, 0.03, 0.002], [-0.003, 0.002, 0.015]])
    builder = jd.ModelBuilder("stone", gravity=(0.0, 0.0, 0.0))
    builder.add_body("stone", None, "free", (1.0, np.zeros(3), inertia))
    ground = jd.contact.ground_contact("stone", corner, friction=mu, restitution=e)
    scene, q = jd.Scene(builder.build(), forces=[ground]), jnp.array([0.0, 0.0, 0.08, 1.0, 0.0, 0.0, 0.0])
    for v in ([1.2, -0.3, -1.0, 2.0, -1.0, 4.0], [0.5, 0.9, -2.0, -3.0, 2.0, 1.0], [-1.0, 0.4, -1.5, 1.0, 3.0, -2.0]):
        v = np.array(v)
        after = jd.simulate(scene, q, jnp.asarray(v), jnp.array([0.0, end]), stepsize=within(1e-12))
        assert float(after.events.time[0]) == 0.0 and np.isnan(after.events.time[1])
        R, twist = np.asarray(jd.frame_pose(scene.system, after.q[-1], "stone"))[:3, :3], np.asarray(after.v[-1])
        impulse, turn = R @ twist[:3] - v[:3], R @ inertia @ twist[3:] - inertia @ v[3:]
        slip = v[:3] + impulse + np.cross(np.linalg.solve(inertia, inertia @ v[3:] + turn), corner)
        np.testing.assert_allclose(turn, np.cross(corner, impulse), atol=1e-11)
        np.testing.assert_allclose(slip[2], -e * (v[:3] + np.cross(v[3:], corner))[2], atol=1e-10)
        assert np.linalg.norm(slip[:2]) > 0.1
        np.testing.assert_allclose(impulse[:2], -mu * impulse[2] * slip[:2] / np.linalg.norm(slip[:2]), atol=1e-10)


@pytest.mark.long
def test_the_direction_in_which_friction_yields_has_derivatives():
    """A force that turns and grows moves a point from rest: gradients are the differences of values.

    Sliding begins in a fixed direction, which was a constant to derivatives: they were off by 3e-4.
    """
    scene, weights = point(0.3), jnp.array([0.3, -1.0, 0.0, 0.2, 0.7, 0.0])

    @jax.jit
    def simulated(p):
        force = lambda q, v, t: jnp.array([p[0] * t, p[1] * t**2, 0.0])  # noqa: E731
        solution = jd.simulate(scene, jnp.zeros(3), jnp.zeros(3), jnp.array([0.0, 1.0]), control=force)
        return weights @ jnp.concatenate([solution.q[-1], solution.v[-1]])

    p, h = jnp.array([6.0, 4.0]), 1e-3
    differences = [(simulated(p + h * e) - simulated(p - h * e)) / (2 * h) for e in jnp.eye(2)]
    # The differences are of second order in h, and values have the tolerance of the run.
    np.testing.assert_allclose(jax.jit(jax.grad(simulated))(p), differences, atol=1e-7)
