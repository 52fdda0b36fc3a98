"""Cut-off frequencies from the spectra of raw logs."""

import numpy as np
import pytest
from scipy.io import loadmat

from jaxdyn import identify


def raw(seed=0, rate=200.0, duration=20.0, top=5, vibration=None, noise=1e-4, slow=1.0):
    """Sums of harmonics of 0.1 Hz up to `top` of them, torques with friction, and a vibration (Hz, amplitude) of one joint."""
    generator = np.random.default_rng(seed)
    n = int(rate * duration) + 1
    t = np.linspace(0, duration, n)
    # Equal velocities at all harmonics.
    w = 2 * np.pi * 0.1 * np.arange(1, top + 1)[:, None] / slow
    phase = generator.uniform(0, 2 * np.pi, (top, 2))
    angle = w * t[:, None, None] + phase
    q, v, a = (np.sum(x, axis=1) for x in (np.sin(angle) / w, np.cos(angle), -w * np.sin(angle)))
    tau = 2 * a + 5 * np.sin(q) + 0.5 * np.tanh(v / 0.01) + 0.3 * v
    if vibration is not None:
        tau[:, 1] += vibration[1] * np.sin(2 * np.pi * vibration[0] * t + np.sin(0.9 * t))
    return identify.Log(t, q + noise * generator.normal(size=q.shape), tau=tau)


def test_the_cutoff_is_ten_times_the_band_of_the_motion():
    """Five harmonics of 0.1 Hz with equal velocities: 99 % of the power needs all five. Noise and sampling change nothing."""
    for log in (raw(), raw(1, noise=1e-3), raw(2, rate=1000.0), raw(3, rate=61.0, duration=33.0)):
        chosen = identify.choose_cutoff(log)
        # The window is two lines wide, of 1 / duration each.
        assert chosen.motion == pytest.approx(0.5, abs=2 / 20)
        assert chosen.frequency == pytest.approx(10 * chosen.motion) and chosen.vibration is None
    assert identify.choose_cutoff(raw(slow=0.25)).motion == pytest.approx(2.0, abs=0.1)
    # A way that does not come back, and jitter of the time stamps.
    log = raw(4)
    moved = identify.Log(log.t, log.q + 3 * log.t[:, None] / log.t[-1], tau=log.tau)
    assert identify.choose_cutoff(moved).motion == pytest.approx(0.5, abs=0.1)
    t = log.t + 1e-3 * np.sin(1000 * log.t)
    assert identify.choose_cutoff(identify.Log(t, log.q, tau=log.tau)).motion == pytest.approx(0.5, abs=0.1)


def test_several_logs_get_the_highest_band_and_the_lowest_rate():
    chosen = identify.choose_cutoff([raw(), raw(slow=0.5)])
    assert chosen.motion == identify.choose_cutoff(raw(slow=0.5)).motion == pytest.approx(1.0, abs=0.1)
    assert identify.choose_cutoff([raw(rate=10.0)]).frequency == pytest.approx(4.0, rel=1e-3)  # of 10 Hz


def test_a_vibration_close_to_the_motion_lowers_it():
    """Amplitude 0.2 at 4.2 Hz, where friction has some 0.02: the cut-off lies between five times the motion and the vibration."""
    chosen = identify.choose_cutoff(raw(vibration=(4.2, 0.2)))
    assert chosen.vibration == pytest.approx(4.2, abs=0.5)
    assert 2.4 < chosen.frequency < 3.8
    # One above ten times the motion is cut off anyway.
    assert identify.choose_cutoff(raw(vibration=(8.0, 0.5))).vibration is None


def test_from_raw_takes_the_cutoff_of_its_log():
    log = raw()
    one = identify.from_raw(log.t, log.q, log.tau, cutoff="auto")
    two = identify.from_raw(log.t, log.q, log.tau, cutoff=identify.choose_cutoff(log).frequency)
    assert one.cutoff == two.cutoff
    np.testing.assert_array_equal(one.a, two.a)


def test_bad_logs_are_refused():
    log = raw()
    with pytest.raises(ValueError, match="cutoff is 'low'"):
        identify.from_raw(log.t, log.q, log.tau, cutoff="low")
    with pytest.raises(ValueError, match="do not move"):
        identify.choose_cutoff(identify.Log(log.t, 0 * log.q + 1, tau=log.tau))
    with pytest.raises(ValueError, match="20 samples are too few"):
        identify.choose_cutoff(log[:20])
    with pytest.raises(ValueError, match="2 columns of q and 1 of tau"):
        identify.choose_cutoff(identify.Log(log.t, log.q, tau=log.tau[:, :1]))


@pytest.mark.data
def test_recorded_arms_get_about_five_hertz(data_dir):
    """Both were excited up to some 0.5 Hz. Parts of the logs, with ends in the midst of the motion, get the same."""
    folder = data_dir / "franka_panda/matlab/data/Exciting_Traj/Trajectory_1/rbt_log"
    t, q, tau = (np.loadtxt(folder / f"exciting_traj_{name}.txt") for name in ("time", "positions", "torques"))
    logs = [identify.Log(t, q.reshape(-1, 7), tau=tau.reshape(-1, 7))]
    for name in "ABC":
        folder = data_dir / f"kuka_kr300/data/recorded_trajectories/2020-10-21 10s FF {name} 08ms"
        rec = loadmat(folder / "data.mat", squeeze_me=True, struct_as_record=False)["rec"]
        logs.append(identify.Log(rec.time_cont, np.deg2rad(rec.act_pos_mot_deg.T), tau=rec.act_torque_abs_nm.T))
    for log in logs:
        for part in (log, identify.split(log, 0.6)[0]):
            assert 4 <= identify.choose_cutoff(part).frequency <= 7  # six seconds have lines 0.17 Hz apart
    # Four seconds, hardly two periods: two of the three logs tell it, and one is refused, not sent through at 100 Hz.
    assert [identify.choose_cutoff(identify.split(log, 0.6)[1]).frequency < 7.6 for log in logs[1:3]] == [True, True]
    with pytest.raises(ValueError, match="noise of the positions"):
        identify.choose_cutoff(identify.split(logs[3], 0.6)[1])
