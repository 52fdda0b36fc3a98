"""Wrapped angles and corrupted samples of logs: a planar arm of two point masses, whose torque is written down here."""

import warnings

import numpy as np
import pytest

import jaxdyn as jd
from benchmarks.identify_franka import samples
from benchmarks.identify_robots import kuka_samples
from jaxdyn import identify
from jaxdyn.cli import main
from jaxdyn.identify.log_repair import find_outliers, repair_log, unwrap_angles

LENGTHS, MASSES, ROTATIONAL, GRAVITY = (0.5, 0.4), (2.0, 1.0), 0.01, 9.81
FILTER = dict(cutoff=20.0, trim=50, every=2)


def torque_columns(q, v, a):
    """Torque (n, 2, 2) for each kilogram at the ends of the links, and (n, 2) of their known rotational inertia."""
    l1, l2 = LENGTHS
    c2, s2 = np.cos(q[:, 1]), np.sin(q[:, 1])
    pull = GRAVITY * np.cos(q[:, 0]), GRAVITY * np.cos(q[:, 0] + q[:, 1])
    first = np.stack([l1**2 * a[:, 0] + l1 * pull[0], 0 * c2], axis=1)
    lower = l2**2 * (a[:, 0] + a[:, 1]) + l1 * l2 * c2 * a[:, 0] + l1 * l2 * s2 * v[:, 0] ** 2 + l2 * pull[1]
    upper = l1**2 * a[:, 0] + l1 * l2 * c2 * (a[:, 0] + a[:, 1]) + l1 * pull[0]
    second = np.stack([lower + upper - l1 * l2 * s2 * (v[:, 0] + v[:, 1]) ** 2, lower], axis=1)
    both = a[:, 0] + a[:, 1]
    return np.stack([first, second], axis=2), ROTATIONAL * np.stack([a[:, 0] + both, both], axis=1)


def fit_masses(log):
    """Masses (2,) of a log with v and a, by least squares on the torque written down above."""
    columns, known = torque_columns(np.asarray(log.q), np.asarray(log.v), np.asarray(log.a))
    return np.linalg.lstsq(columns.reshape(-1, 2), (np.asarray(log.tau) - known).ravel())[0]


def sine(t, *waves):
    """A sum of sines with its derivatives, each (n,)."""
    terms = [
        (size * np.sin(w * t + s), size * w * np.cos(w * t + s), -size * w**2 * np.sin(w * t + s))
        for size, w, s in waves
    ]
    return np.sum(terms, axis=0)


@pytest.fixture(scope="module")
def clean():
    """Ten seconds of 500 samples; the first joint comes to -4.5 and 4.8 rad, the second stays within +-1.5."""
    t = np.linspace(0.0, 10.0, 5001)
    q, v, a = (
        np.stack(pair, axis=1)
        for pair in zip(
            sine(t, (3.5, 1.3, 0.0), (1.4, 3.1, 0.5)), sine(t, (1.0, 2.3, 1.0), (0.5, 4.1, 2.0)), strict=True
        )
    )
    columns, known = torque_columns(q, v, a)
    return identify.Log(t, q, tau=columns @ np.array(MASSES) + known, joint_names=("shoulder", "elbow"))


def make_arm(kind="continuous", masses=MASSES, **limits):
    builder = jd.ModelBuilder("arm")
    parent, pose = None, None
    for name, joint, mass, length in zip(("upper", "lower"), ("shoulder", "elbow"), masses, LENGTHS, strict=True):
        builder.add_body(
            name, parent, joint=kind, joint_name=joint, pose=pose, axis=(0, -1, 0),
            inertia=(mass, (length, 0, 0), 3 * (ROTATIONAL,)), **limits,
        )  # fmt: skip
        parent, pose = name, (length, 0, 0)
    return builder.build()


def wrap(log):
    return change(log, "q", slice(None), slice(None), (np.asarray(log.q) + np.pi) % (2 * np.pi) - np.pi)


def change(log, signal, rows, column, value):
    signals = {name: np.array(getattr(log, name)) for name in ("q", "tau")}
    signals[signal][rows, column] = value
    return identify.Log(log.t, signals["q"], tau=signals["tau"], joint_names=log.joint_names)


def from_raw(log, **options):
    return identify.from_raw(log.t, log.q, log.tau, joint_names=log.joint_names, **FILTER, **options)


def test_clean_logs_are_left_alone(clean):
    """Warnings are errors in tests: none is given."""
    assert repair_log(clean) is clean
    assert repair_log(clean, make_arm()) is clean
    assert find_outliers(clean) == []
    # The filter shifts the masses by this much; a corrupted log is judged by the same bound below.
    np.testing.assert_allclose(fit_masses(from_raw(clean)), MASSES, rtol=2e-3)


@pytest.mark.parametrize("kind", [None, "continuous", "revolute"])
def test_wrapped_angles_give_the_fit_of_the_unwrapped_ones(clean, kind):
    wrapped = wrap(clean)
    count = int(np.sum(np.abs(np.diff(wrapped.q[:, 0])) > 3))
    assert count == 6
    model = None if kind is None else make_arm(kind)
    with pytest.warns(jd.identify.LogWarning, match=rf"whole turns were unwrapped: joint shoulder \({count} jumps\)$"):
        log = from_raw(wrapped, model=model)
    reference = from_raw(clean)
    np.testing.assert_allclose(log.q, reference.q, atol=1e-10)
    np.testing.assert_allclose(fit_masses(log), fit_masses(reference), rtol=1e-10)


def test_wraps_that_are_not_unwrapped_are_refused(clean):
    wrapped = wrap(clean)
    row = int(np.flatnonzero(np.abs(np.diff(wrapped.q[:, 0])) > 3)[0])
    with pytest.raises(
        ValueError, match=rf'q of joint shoulder jumps from .* at row {row} to .* at row {row + 1} .*unwrap="auto"'
    ):
        from_raw(wrapped, unwrap=False)
    sliding = make_arm("prismatic")
    with pytest.raises(ValueError, match=f"joint shoulder jumps from .* at row {row} to"):
        from_raw(wrapped, model=sliding)


def test_only_jumps_near_whole_turns_are_wraps(clean):
    """A jump of 6 rad is none of 2 pi; it is refused, and does not come back, so it cannot be left out either."""
    log = change(clean, "q", slice(3000, None), 1, np.asarray(clean.q)[3000:, 1] + 6.0)
    for outliers in ("refuse", "drop"):
        with pytest.raises(
            ValueError, match=r"q of joint elbow jumps from .* at row 2999 to .* at row 3000 .*cut the log there"
        ):
            from_raw(log, outliers=outliers)
    # Forced, it is brought within half a turn, as numpy does it.
    with pytest.warns(jd.identify.LogWarning, match=r"joint elbow \(1 jump\)"):
        forced = unwrap_angles(log, near=False)
    np.testing.assert_allclose(forced.q[:, 1], np.unwrap(log.q[:, 1]), atol=1e-12)


@pytest.mark.parametrize("speed", [0.5, 40.0, 1200.0, 1500.0])
def test_joints_that_turn_fast(speed):
    """Wraps are recognized up to 0.95 of half a turn between samples; faster motions that are not wrapped stay."""
    t = np.linspace(0.0, 4.0, 2001)
    q = (speed * (t + 0.01 * np.sin(t)))[:, None]
    log = identify.Log(t, q, tau=0 * q)
    assert repair_log(log) is log
    if speed < np.pi / (1.01 * t[1]):
        with pytest.warns(jd.identify.LogWarning) if speed * 4 > np.pi else warnings.catch_warnings():
            unwrapped = repair_log(wrap(log))
        np.testing.assert_allclose(unwrapped.q, q, atol=1e-9)


def test_noise_does_not_hide_wraps_nor_look_like_them(clean):
    generator = np.random.default_rng(0)
    noise = 0.02 * generator.normal(size=clean.q.shape)  # forward and back over the edge, several times in each passage
    noisy = identify.Log(clean.t, np.asarray(clean.q) + noise, tau=clean.tau + generator.normal(size=noise.shape))
    assert repair_log(noisy) is noisy
    with pytest.warns(jd.identify.LogWarning, match="unwrapped"):
        np.testing.assert_allclose(repair_log(wrap(noisy)).q, noisy.q, atol=1e-10)


# At the ends steps below five times the fastest motion are no outliers.
PLACES = [(start, size) for start in (0, 7, 2600, "end") for size in (-300.0, -2 * np.pi + 0.3, 1.0)]
PLACES += [(7, -0.05), (2600, 0.05)]


@pytest.mark.parametrize(("start", "size"), PLACES)
@pytest.mark.parametrize("length", [1, 2, 3])
def test_corrupted_positions_are_refused_or_left_out(clean, size, length, start):
    start = len(clean) - length if start == "end" else start
    rows = slice(start, start + length)
    bad = change(clean, "q", rows, 1, np.asarray(clean.q)[rows, 1] + size)
    with pytest.raises(ValueError, match=rf"q of joint elbow is \S+ at rows? {start}\D.*outliers=\"drop\""):
        from_raw(bad)
    with pytest.warns(
        jd.identify.LogWarning,
        match=rf"{length} corrupted samples? left out and interpolated: q of joint elbow \({length}\)$",
    ):
        repaired = repair_log(bad, outliers="drop")
    # Linear interpolation over 2 ms a sample: gap^2 / 8 of the largest acceleration, 13 rad/s^2; at the ends gap (gap + h) / 2.
    gap, is_end = 2e-3 * (length + 1), start == 0 or start + length == len(clean)
    np.testing.assert_allclose(repaired.q, clean.q, atol=13.5 * gap**2 * (0.6 if is_end else 0.125))
    np.testing.assert_array_equal(np.delete(repaired.q, np.r_[rows], axis=0), np.delete(clean.q, np.r_[rows], axis=0))
    assert repair_log(bad, outliers="keep") is bad


def test_corrupted_torques(clean):
    bad = change(clean, "tau", 1234, 0, 1e4)
    with pytest.raises(ValueError, match=r"tau of joint shoulder is 10000 at row 1234 \(t=2.468 s\)"):
        from_raw(bad)
    with pytest.warns(
        jd.identify.LogWarning, match=r"1 corrupted sample left out and interpolated: tau of joint shoulder \(1\)"
    ):
        np.testing.assert_allclose(fit_masses(from_raw(bad, outliers="drop")), MASSES, rtol=2e-3)
    # Steps, bang-bang torques and spikes within what friction does are no faults.
    generator = np.random.default_rng(1)
    for tau in (np.sign(np.sin(3 * clean.t)), generator.choice([-1.0, 1.0], len(clean)), 0 * clean.t):
        log = change(clean, "tau", slice(None), 0, tau)
        assert repair_log(log) is log


def test_several_faults_in_one_log(clean):
    generator = np.random.default_rng(2)
    bad = wrap(clean)
    rows = 20 + 100 * np.arange(40) + generator.integers(0, 40, 40)
    for row in rows:
        bad = change(bad, "q", row, 1, generator.uniform(20, 50))
    with pytest.raises(ValueError, match=rf"q of joint elbow is .* at row {rows[0]} .*\(and 39 more\)"):
        repair_log(unwrap_quietly(bad))
    with pytest.warns(jd.identify.LogWarning) as caught:
        masses = fit_masses(from_raw(bad, outliers="drop"))
    assert ["unwrapped" in str(one.message) for one in caught] == [True, False]
    assert "40 corrupted samples left out" in str(caught[1].message)
    np.testing.assert_allclose(masses, MASSES, rtol=2e-3)


def unwrap_quietly(log):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jd.identify.LogWarning)
        return unwrap_angles(log)


def test_velocity_limits_make_smaller_jumps_impossible(clean):
    """0.07 rad in 2 ms are 35 rad/s: less than five times what the log has anyway, but beyond a limit of 10 rad/s."""
    log = change(clean, "q", slice(3000, None), 0, np.asarray(clean.q)[3000:, 0] + 0.07)
    fastest = np.quantile(np.abs(np.diff(clean.q[:, 0])), 0.99) / 2e-3
    assert 0.5 * 5 * fastest < 34 < 36 < 5 * fastest
    assert repair_log(log) is log
    with pytest.raises(ValueError, match=r"q of joint shoulder jumps .* per second, velocity limit 10\)"):
        repair_log(log, make_arm(velocity_limit=10.0))
    # Motions faster than a limit that is too low are no jumps.
    assert repair_log(clean, make_arm(velocity_limit=1.0)) is clean


@pytest.mark.parametrize(("options", "words"), [
    (dict(unwrap="yes"), 'unwrap is \'yes\'; give "auto", True or False'),
    (dict(outliers="ignore"), "outliers is 'ignore'; give"),
])  # fmt: skip
def test_options_are_checked(clean, options, words):
    with pytest.raises(ValueError, match=words):
        from_raw(clean, **options)


@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_files(clean, tmp_path, suffix):
    path = tmp_path / f"log.{suffix}"
    jd.io.write_log(path, wrap(clean))
    with pytest.warns(jd.identify.LogWarning, match="joint shoulder"):
        np.testing.assert_allclose(jd.read_log(path).q, clean.q, atol=1e-10)
    np.testing.assert_array_equal(jd.read_log(path, unwrap=False, outliers="keep").q, wrap(clean).q)
    jd.io.write_log(path, change(clean, "q", 77, 1, 9.0))
    with pytest.raises(ValueError, match=rf"log\.{suffix}: q of joint elbow is 9 at row 77 "):
        jd.read_log(path)
    with pytest.warns(jd.identify.LogWarning, match="1 corrupted sample"):
        np.testing.assert_allclose(jd.read_log(path, outliers="drop").q, clean.q, atol=1e-4)


@pytest.mark.long
def test_command_line(clean, tmp_path, capsys):
    """The first moments, which torques determine, are those of 2 and 1 kg, and messages name the joint and the options."""
    urdf, path, out = tmp_path / "arm.urdf", tmp_path / "log.csv", tmp_path / "fitted.urdf"
    jd.save_urdf(make_arm(masses=(1.5, 1.2)), urdf)
    args = ["identify", "--urdf", str(urdf), "--log", str(path), "--out", str(out), "--cutoff", "20"]
    args += ["--terms", "viscous", "--v-s", "0.01", "--prior", "1e-6", "--weights", "none", "--robust", "none"]
    bad = change(wrap(clean), "q", 3210, 1, 25.0)
    jd.io.write_log(path, bad)
    assert main(args) == 2
    text = capsys.readouterr().err
    assert "q of joint elbow is 25 at row 3210" in text and "--outliers drop" in text and 'outliers="' not in text
    assert main([*args, "--unwrap", "no", "--outliers", "drop"]) == 2
    text = capsys.readouterr().err
    assert "joint shoulder jumps" in text and "--unwrap auto" in text
    assert main([*args, "--outliers", "drop"]) == 0
    text = capsys.readouterr().out
    assert "log.csv: angles that jump by whole turns were unwrapped: joint shoulder (" in text
    assert "log.csv: 1 corrupted sample left out and interpolated: q of joint elbow (1)" in text
    jd.io.write_log(path, clean)
    assert main([*args[:-1], "none", "--out", str(tmp_path / "clean.urdf")]) == 0
    assert "unwrapped" not in (text := capsys.readouterr().out) and "corrupted" not in text
    base = identify.base_parameters(make_arm(), identify.TERMS)
    models = make_arm(), jd.load_model(tmp_path / "clean.urdf"), jd.load_model(out)
    true, reference, fitted = (np.asarray(base.values(identify.nominal_parameters(model))) for model in models)
    np.testing.assert_allclose(fitted, reference, atol=1e-4)
    # The low-pass flattens what is quadratic in the motion; that is 1 % of the largest number at this cut-off.
    np.testing.assert_allclose(fitted, true, atol=0.01 * true.max())


def recorded(data_dir):
    """The raw log of a Franka and three of a KUKA."""
    try:
        return [samples(data_dir), *(kuka_samples(data_dir, name) for name in "ABC")]
    except SystemExit as missing:
        pytest.skip(str(missing))


@pytest.mark.long
@pytest.mark.data
def test_recorded_logs_are_left_alone(data_dir):
    """With noise, jitter and rounding added, parts of them, and with as few samples as hold the motion."""
    generator = np.random.default_rng(3)
    for log in recorded(data_dir):
        for every in (1, 2, 3, 5, 10, 20):
            for part in (log[::every], log[: len(log) // 3 : every], log[len(log) // 2 :: every]):
                t, q, tau = (np.asarray(x) for x in (part.t, part.q, part.tau))
                jitter = 0.4 * np.diff(t).min() * generator.uniform(-1, 1, len(t))
                noise = generator.normal(size=q.shape)
                for one in (
                    part,
                    identify.Log(t + jitter, q, tau=tau),
                    identify.Log(t, np.round(q, 3), tau=np.round(tau, 1)),
                    identify.Log(t, q + 1e-3 * noise, tau=tau + 0.1 * tau.std() * noise),
                ):
                    assert repair_log(one) is one


@pytest.mark.long
@pytest.mark.data
def test_corrupted_samples_of_recorded_logs_are_found(data_dir):
    generator = np.random.default_rng(4)
    for log in recorded(data_dir):
        for _ in range(20):
            row, length, column = (
                generator.integers(5, len(log) - 8),
                generator.integers(1, 4),
                generator.integers(log.nv),
            )
            rows = slice(int(row), int(row + length))
            size = generator.choice([-1, 1]) * 10 ** generator.uniform(-0.5, 2)
            found = find_outliers(change(log, "q", rows, column, np.asarray(log.q)[rows, column] + size))
            assert [(one.signal, one.column, one.rows) for one in found] == [
                ("q", column, range(rows.start, rows.stop))
            ]
