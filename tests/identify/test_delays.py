"""Delays between positions and torques: found where they are, to their intervals, and none where there is none."""

import numpy as np
import pytest
from test_identify_robot import arm, motion

from jaxdyn import identify

GIVEN = {"terms": identify.TERMS, "v_s": 0.05, "prior": 1.0, "robust": None}
WAVES = np.arange(1, 5)[:, None] * 1.3
NARROW = {"v_s": 0.5, "size": 0.15, "waves": np.array([[2.9, 3.9], [3.1, 4.1], [3.4, 4.3], [3.7, 4.4]])}
NUMBERS = [0.3, 0.2, 0.4, 0.3, 0.1, -0.2, 0.05, 0.02]


def late(seed, delay, noise=0.05, n=600, v_s=0.05, waves=WAVES, size=1.0):
    """A log whose torques are those that the arm needed `delay` (2,) before, by exact evaluation at those times."""
    model = arm()
    x = identify.nominal_parameters(model)
    x[20:] = NUMBERS
    t, columns = np.linspace(0, 12.0, n), []
    q, v, a = motion_at(seed, t, waves, size)
    for joint, d in enumerate(delay):
        before = motion_at(seed, t - d, waves, size)
        columns.append((identify.regressor(model, *before, v_s=v_s) @ x)[:, joint])
    tau = np.stack(columns, axis=1)
    return identify.Log(t, q, v, a, tau + noise * np.random.default_rng(seed).normal(size=tau.shape))


def motion_at(seed, t, waves=WAVES, size=1.0):
    """q, v, a of `motion(seed)` at any times, or of other frequencies (4, 1) or (4, 2), rad/s."""
    generator = np.random.default_rng(seed)
    amplitude, phase = size * generator.uniform(0.3, 1.0, (4, 2)), generator.uniform(0, 2 * np.pi, (4, 2))
    angle = waves * t[:, None, None] + phase
    parts = (np.sin(angle), waves * np.cos(angle), -(waves**2) * np.sin(angle))
    return tuple(np.sum(amplitude * x, 1) for x in parts)


@pytest.mark.long
def test_delays_are_found_to_their_intervals():
    """12 ms at one joint, -5 ms at the other; and the robot's numbers come out as without delays."""
    truth = np.array([0.012, -0.005])
    logs, test = [late(1, truth), late(2, truth)], late(3, truth, 0.0)
    fit = identify.fit_robot(arm(), logs, delay="auto", **GIVEN)
    off = np.abs(fit.delays.seconds - truth)
    assert np.all(off <= fit.delays.factor * fit.delays.std) and off.max() < 1e-3
    assert np.all(fit.delays.std < 1e-3) and np.all(fit.delays.squares[1].sum(0) < fit.delays.squares[0].sum(0))
    plain = identify.fit_robot(arm(), logs, **GIVEN)
    assert plain.delays is None and plain.align(test) is test
    assert fit.fit.error(fit.align(test)) < 0.3 * plain.fit.error(test)
    x = identify.nominal_parameters(arm())
    x[20:] = NUMBERS
    # Friction turns round faster than these samples tell, so nearness is what is asked; intervals: below, with slower friction.
    base = fit.intervals.combinations.values
    near, far = (np.linalg.norm(base(f.fit.vector) - base(x)) for f in (fit, plain))
    assert near < 0.3 * far
    given = identify.fit_robot(arm(), logs, delay=fit.delays.seconds, **GIVEN)
    np.testing.assert_allclose(given.fit.vector, fit.fit.vector, rtol=1e-8, atol=1e-10)


@pytest.mark.long
def test_shifts_that_do_not_settle_are_refused(monkeypatch):
    """One round of the first-order model does not reach the delay."""
    monkeypatch.setattr("jaxdyn.identify.robot._ROUNDS", 1)
    with pytest.raises(ValueError, match="delays do not converge"):
        identify.fit_robot(arm(), [late(1, (0.02, 0.02))], delay="auto", **GIVEN)


@pytest.mark.long
def test_a_delay_that_is_not_there_is_not_found():
    fit = identify.fit_robot(arm(), [late(1, (0, 0)), late(2, (0, 0))], delay="auto", **GIVEN)
    assert np.all(np.abs(fit.delays.seconds) <= fit.delays.factor * fit.delays.std)


@pytest.mark.long
def test_intervals_know_that_delays_were_fitted_too():
    """Against the information of independent samples: by how much two unknown delays widen the intervals of all other numbers."""
    smooth, truth = GIVEN | {"v_s": 0.5}, np.array([0.012, -0.008])
    log = late(1, truth, 0.01, **NARROW)  # in which friction and a delay resemble each other
    fit = identify.fit_robot(arm(), log, delay="auto", **smooth)
    assert np.all(fit.delays.seconds != 0)
    given = identify.fit_robot(arm(), log, delay=fit.delays.seconds, **smooth)
    spread = fit.intervals.parameters
    assert spread.names[-2:] == ("a_joint.delay", "b_joint.delay")
    np.testing.assert_array_equal(spread.values[-2:], fit.delays.seconds)
    np.testing.assert_array_equal(spread.std[-2:], fit.delays.std)
    seen = fit.intervals.base.std / given.intervals.base.std

    aligned, base = fit.align(log), fit.intervals.combinations
    rows = identify.regressor(arm(), aligned.q, aligned.v, aligned.a, v_s=0.5)[..., base.independent]
    slopes = np.gradient(rows @ base.values(fit.fit.vector), aligned.t, axis=0)
    wide = np.concatenate([rows, slopes[:, :, None] * np.eye(2)], axis=2)
    stds = []
    for columns in (rows, wide):
        flat = columns.reshape(-1, columns.shape[-1])
        stds.append(np.sqrt(np.diag(np.linalg.inv(flat.T @ flat)))[: len(base.values(fit.fit.vector))])
    expected = stds[1] / stds[0]
    assert expected.max() > 1.3 and seen.max() > 1.2
    # Ten groups of samples know a standard deviation to a quarter: their mean is compared, and none may be far off.
    assert 0.7 < np.mean(np.log(seen)) / np.mean(np.log(expected)) < 1.6
    np.testing.assert_allclose(np.log(seen), np.log(expected), atol=0.35)


@pytest.mark.slow
def test_intervals_of_all_numbers_cover_with_delays():
    """16 logs: 95 % intervals of base parameters and delays hold the truth nine times in ten or more."""
    smooth, x, inside = GIVEN | {"v_s": 0.5}, identify.nominal_parameters(arm()), []
    x[20:] = NUMBERS
    for seed in range(16):
        generator = np.random.default_rng(seed)
        truth = generator.uniform(0.004, 0.015, 2) * generator.choice([-1, 1], 2)
        fit = identify.fit_robot(arm(), late(seed, truth, 0.01, **NARROW), delay="auto", **smooth)
        base = fit.intervals.base
        off = np.append(base.values - fit.intervals.combinations.values(x), fit.delays.seconds - truth)
        inside.append(np.abs(off) <= fit.intervals.factor * np.append(base.std, fit.delays.std))
    assert 0.9 <= np.mean(inside) <= 0.99


@pytest.mark.slow
def test_intervals_of_delays_cover():
    """20 arms of two joints: the 95 % intervals hold the truth nine times in ten."""
    inside = []
    for seed in range(20):
        truth = np.random.default_rng(seed).uniform(-0.01, 0.01, 2)
        delays = identify.fit_robot(arm(), late(seed, truth), delay="auto", **GIVEN).delays
        inside.append(np.abs(delays.seconds - truth) <= delays.factor * delays.std)
    assert np.mean(inside) >= 0.85


def test_shifted_torques_are_those_of_later_times():
    log = motion(0, 600, 12.0)
    wave = np.stack([np.sin(3 * log.t), np.cos(2 * log.t)], axis=1)
    log = identify.Log(log.t, log.q, log.v, log.a, wave, cutoff=8.0)
    moved = identify.shift_torques(log, (0.013, -0.021))
    assert moved.cutoff == 8.0 and len(log) - len(moved) == 3
    expected = np.stack([np.sin(3 * (moved.t + 0.013)), np.cos(2 * (moved.t - 0.021))], axis=1)
    # Cubic splines: 5 / 384 (w h)^4, and more at the ends.
    np.testing.assert_allclose(moved.tau, expected, atol=1e-5)
    assert identify.shift_torques(log, 0.0) is log
    for words, delay in (("delay is", (0.1, 0.1, 0.1)), ("delay is nan", np.nan), ("nothing is left", 13.0)):
        with pytest.raises(ValueError, match=words):
            identify.shift_torques(log, delay)
    with pytest.raises(ValueError, match="delay is 'late'"):
        identify.fit_robot(arm(), log, delay="late", **GIVEN)
