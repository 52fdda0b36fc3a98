"""Gains of drives from a known payload: exact without noise, inside their intervals with it, refused where nothing tells them."""

import numpy as np
import pytest
from test_identify_robot import arm, motion

import jaxdyn as jd
from jaxdyn import identify, inertia
from jaxdyn.cli.identify_tables import gains_text

MASS, CENTRE = 0.9, (0.05, 0.02, -0.3)
MOMENTS = np.diag([0.004, 0.003, 0.002])


def six():
    """Six joints in changing directions."""
    builder, parent = jd.ModelBuilder("six"), None
    for i in range(6):
        body = (2.0 - 0.2 * i, (0.02, 0.01, -0.15), (0.02, 0.018, 0.006))
        pose = np.eye(4)
        pose[2, 3] = -0.3 if i else 0.0
        builder.add_body(f"l{i}", parent, inertia=body, axis=np.eye(3)[(0, 1, 1, 2, 1, 2)[i]], pose=pose)
        parent = f"l{i}"
    return builder.build()


def waves(seed, nv, n=500):
    """A log of a sum of sines without torques."""
    generator, t = np.random.default_rng(seed), np.linspace(0, 12, n)
    w = 2 * np.pi * generator.uniform(0.1, 0.6, (4, nv))
    size, phase = generator.uniform(0.2, 0.6, (4, nv)), generator.uniform(0, 2 * np.pi, (4, nv))
    angle = w * t[:, None, None] + phase
    signals = (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle))
    return identify.Log(t, *(np.sum(size * x, axis=1) for x in signals), np.zeros((n, nv)))


def logs_of(model, gains, noise=0.0, seed=0):
    """Currents of one log without the payload and of one with it; friction and rotors too."""
    x, nv, generator = identify.nominal_parameters(model), model.nv, np.random.default_rng(seed)
    x[10 * model.nb :] = np.concatenate([np.full(nv, c) for c in (0.3, 0.4, 0.05, 0.02)])
    payload = np.asarray(inertia.inertial_parameters(MASS, np.array(CENTRE), MOMENTS))
    result = []
    for which, holds in enumerate((False, True)):
        log, own = waves(10 * seed + which, nv), x.copy()
        own[10 * (model.nb - 1) : 10 * model.nb] += holds * payload
        current = (identify.regressor(model, log.q, log.v, log.a, v_s=0.05) @ own) / gains
        current += noise * np.sqrt(np.mean(current**2, axis=0)) * generator.normal(size=current.shape)
        result.append(identify.Log(log.t, log.q, log.v, log.a, current))
    return result


@pytest.mark.parametrize("known", [True, False])
def test_gains_are_exact_without_noise(known):
    """Gains of 0.8 to 1.2, and of drives that log amperes; with the payload's inertia known, and found beside them."""
    model = six()
    for gains in (np.linspace(0.8, 1.2, 6), np.array([40.0, 50, 30, 8, 12, 5])):
        found = identify.fit_gains(
            model, *logs_of(model, gains), MASS, CENTRE, inertia=MOMENTS if known else None, v_s=0.05
        )
        np.testing.assert_allclose(found.gains, gains, rtol=1e-6)
        assert found.identifiable == model.joint_names and found.error < 1e-6


def test_gains_are_inside_their_intervals_and_mend_the_fit():
    """1 % of noise. The robot fitted to scaled logs is then nearer than one fitted to the currents."""
    model, gains = six(), np.linspace(0.8, 1.2, 6)
    unloaded, loaded = logs_of(model, gains, noise=0.01, seed=1)
    found = identify.fit_gains(model, unloaded, loaded, MASS, CENTRE)
    assert found.v_s in (0.03, 0.1) and found.identifiable == model.joint_names
    assert np.all(np.abs(found.gains - gains) <= found.factor * found.std)
    assert np.all(found.std < 0.02 * gains)
    scaled = found.scale(unloaded)
    np.testing.assert_array_equal(scaled.tau, unloaded.tau * found.gains)
    x = identify.least_squares(model, scaled, v_s=0.05)
    truth = x.base.values(np.append(identify.nominal_parameters(model)[:60], np.repeat([0.3, 0.4, 0.05, 0.02], 6)))
    wrong = identify.least_squares(model, unloaded, v_s=0.05)
    off = [np.linalg.norm((one.values - truth) / (1 + np.abs(truth))) for one in (x, wrong)]
    assert off[0] < 0.2 * off[1]


def test_a_joint_alone_is_the_linear_fit():
    """One joint: i = W z + h p is linear in z and h, and its least squares are the gain."""
    builder = jd.ModelBuilder("one")
    builder.add_body("a", axis=(0, 1, 0), inertia=(1.0, (0.02, 0.01, -0.5), (0.1, 0.09, 0.02)))
    model, gain = builder.build(), np.array([1.3])
    unloaded, loaded = logs_of(model, gain, noise=0.02)
    found = identify.fit_gains(model, unloaded, loaded, MASS, CENTRE, inertia=MOMENTS, v_s=0.05)
    base = identify.base_parameters(model, identify.TERMS)
    rows = [identify.regressor(model, log.q, log.v, log.a, v_s=0.05)[:, 0] for log in (unloaded, loaded)]
    payload = rows[1][:, :10] @ np.asarray(inertia.inertial_parameters(MASS, np.array(CENTRE), MOMENTS))
    table = np.concatenate(rows)[:, base.independent]
    table = np.append(table, np.append(np.zeros(len(rows[0])), payload)[:, None], axis=1)
    h = np.linalg.lstsq(table, np.append(unloaded.tau, loaded.tau), rcond=None)[0][-1]
    np.testing.assert_allclose(found.gains, 1 / h, rtol=1e-6)


@pytest.mark.slow
def test_intervals_of_gains_cover():
    """20 arms: 95 % intervals hold the truth nine times in ten or more."""
    inside = []
    for seed in range(20):
        gains = np.random.default_rng(seed).uniform(0.8, 1.2, 6)
        found = identify.fit_gains(six(), *logs_of(six(), gains, 0.01, seed), MASS, CENTRE, v_s=0.05)
        inside.append(np.abs(found.gains - gains) <= found.factor * found.std)
    assert 0.88 <= np.mean(inside) <= 0.995


def test_logs_of_fewer_samples_than_unknowns_are_refused():
    """A joint that is fitted exactly shows no error: its intervals were up to 970 times too narrow."""
    short = [log[::100] for log in logs_of(arm(), np.ones(2), 0.01)]
    with pytest.raises(ValueError, match="too few for the 17 unknowns"):
        identify.fit_gains(arm(), *short, MASS, CENTRE, v_s=0.05)


def test_what_the_payload_does_not_tell_is_said():
    model = arm()
    log = motion(1)
    x = identify.nominal_parameters(model)
    log = identify.Log(log.t, log.q, log.v, log.a, identify.regressor(model, log.q, log.v, log.a) @ x)
    with pytest.raises(ValueError, match=r"not identifiable at any joint|gain of no joint"):
        identify.fit_gains(model, log, log, 1e-9, (0, 0, -0.3), v_s=0.05)
    # A turntable about the vertical feels a payload's inertia alone, which is not known.
    builder = jd.ModelBuilder("table")
    builder.add_body("a", axis=(0, 0, 1), inertia=(1.0, (0.1, 0, 0), (0.1, 0.09, 0.02)))
    builder.add_body("b", "a", pose=(0.3, 0, 0), axis=(0, 1, 0), inertia=(0.5, (0, 0, -0.2), (0.02, 0.02, 0.01)))
    table = builder.build()
    found = identify.fit_gains(table, *logs_of(table, np.array([0.9, 1.1]), 0.01), MASS, CENTRE, v_s=0.05)
    assert "b_joint" in found.identifiable
    for words, options in (
        ("body is 'c'", {"body": "c"}),
        ("mass is -1", {"mass": -1.0}),
        ("a point", {"centre": (0, 0)}),
    ):
        with pytest.raises(ValueError, match=words):
            identify.fit_gains(model, log, log, **{"mass": 1.0, "centre": (0, 0, 0.1), **options})


def test_weights_that_have_not_settled_are_said(monkeypatch):
    """One round, whose weights are not those of its fit; and two rounds of one evaluation, whose fits end before a minimum."""
    model, gains = six(), np.linspace(0.8, 1.2, 6)
    unloaded, loaded = logs_of(model, gains, noise=0.01, seed=1)
    noise = np.random.default_rng(2).normal(size=unloaded.tau.shape) * np.array([1.0, 0, 0, 0, 0, 0])
    unloaded = identify.Log(unloaded.t, unloaded.q, unloaded.v, unloaded.a, unloaded.tau + noise)
    found = identify.fit_gains(model, unloaded, loaded, MASS, CENTRE, v_s=0.05)
    assert bool(found.success)
    for limits in ({"MAX_ROUNDS": 1}, {"MAX_ROUNDS": 2, "_STEPS": 1}):
        with monkeypatch.context() as patch:
            for name, least in limits.items():
                patch.setattr(f"jaxdyn.identify.payloads.{name}", least)
            short = identify.fit_gains(model, unloaded, loaded, MASS, CENTRE, v_s=0.05)
        assert short.result is jd.RESULTS.max_steps_reached
        assert "NOT CONVERGED: max steps reached" in gains_text(short, model.joint_names)
    assert "NOT" not in gains_text(found, model.joint_names)
