"""Logs: what is refused, files there and back, and the filter protocol against the one the data came with."""

import importlib.util

import numpy as np
import pytest
from test_jumps import recorded

import jaxdyn as jd
from jaxdyn import identify
from jaxdyn.identify.logs import check_log
from jaxdyn.identify.raw_logs import spline_lines

N = 60


@pytest.fixture
def signals():
    generator = np.random.default_rng(0)
    t = np.linspace(0.0, 1.0, N) ** 1.1
    return dict(t=t, **{name: generator.normal(size=(N, 2)) for name in ("q", "v", "a", "tau")})


@pytest.fixture(scope="module")
def arm():
    builder = jd.ModelBuilder("arm")
    builder.add_body("upper", joint_name="shoulder", inertia=(1.0, (0.1, 0, 0), (0.1, 0.1, 0.1)))
    builder.add_body("lower", "upper", joint_name="elbow", pose=(1, 0, 0), inertia=(1.0, (0.1, 0, 0), (0.1, 0.1, 0.1)))
    return builder.build()


def spoilt(signals, name, rows, value):
    signals = {key: np.array(x) for key, x in signals.items()}
    signals[name][rows] = value
    return signals


def test_bad_logs_raise(signals):
    with pytest.raises(ValueError, match=r"q is nan at row 7, column 2 .*drop these rows"):
        identify.Log(**spoilt(signals, "q", (7, 1), np.nan))
    with pytest.raises(ValueError, match="t is inf at row 3"):
        identify.Log(**spoilt(signals, "t", 3, np.inf))
    with pytest.raises(ValueError, match=r"unequal lengths: t has 60 rows, q has 59 rows, v has 60"):
        identify.Log(**signals | dict(q=signals["q"][1:]))
    back = spoilt(signals, "t", 5, signals["t"][4])
    with pytest.raises(ValueError, match=r"time does not increase at row 5: t\[4\]=.* \(1 such rows\)"):
        identify.Log(**back)
    with pytest.raises(ValueError, match="tau is missing"):
        identify.Log(signals["t"], signals["q"])
    with pytest.raises(ValueError, match=r"q has shape \(60,\)"):
        identify.Log(**signals | dict(q=signals["t"]))
    with pytest.raises(ValueError, match="v has 1 columns, tau has 2"):
        identify.Log(**signals | dict(v=signals["v"][:, :1]))
    with pytest.raises(ValueError, match="no samples"):
        identify.Log(**{name: x[:0] for name, x in signals.items()})
    with pytest.raises(ValueError, match="joint_names has 1 names, tau has 2"):
        identify.Log(**signals, joint_names=("a",))
    with pytest.raises(ValueError, match="indexed by slices"):
        identify.Log(**signals)[3]


def test_log_must_fit_the_model(signals, arm):
    log = identify.Log(**signals)
    check_log(log, arm)
    with pytest.raises(ValueError, match=r"1 columns of q, model 'arm' has 2 \(joints shoulder, elbow\)"):
        check_log(identify.Log(signals["t"], *(signals[k][:, :1] for k in ("q", "v", "a", "tau"))), arm)
    with pytest.raises(ValueError, match="the log has no a"):
        check_log(identify.Log(**signals | dict(a=None)), arm)
    with pytest.raises(ValueError, match=r"joints are elbow, shoulder.*joint_names=model.joint_names"):
        check_log(identify.Log(**signals, joint_names=("elbow", "shoulder")), arm)


def test_split_shares_no_sample(signals):
    log = identify.Log(**signals)
    first, second = identify.split(log, 0.7)
    assert (len(first), len(second)) == (42, 18)
    np.testing.assert_array_equal(np.concatenate([first.tau, second.tau]), log.tau)
    for fraction in (0.0, 1.0, 0.001, -0.5, np.nan):
        with pytest.raises(ValueError, match="leaves one part empty"):
            identify.split(log, fraction)


@pytest.mark.parametrize("suffix", ["csv", "npz"])
@pytest.mark.parametrize("names", [None, ("shoulder", "elbow")])
def test_files_there_and_back(signals, tmp_path, suffix, names):
    path = tmp_path / f"log.{suffix}"
    for given in (signals, signals | dict(v=None, a=None)):
        log = identify.Log(**given, joint_names=names)
        jd.io.write_log(path, log)
        back = jd.read_log(path)
        assert back.joint_names == names
        for name in ("t", "q", "v", "a", "tau"):
            np.testing.assert_array_equal(getattr(back, name), getattr(log, name))  # every digit


def test_columns_with_joint_names_follow_the_model(signals, tmp_path):
    path = tmp_path / "log.csv"
    jd.io.write_log(path, identify.Log(**signals, joint_names=("elbow", "shoulder")))
    log = jd.read_log(path, joint_names=("shoulder", "elbow"))
    np.testing.assert_array_equal(log.q, signals["q"][:, ::-1])
    np.testing.assert_array_equal(jd.read_log(path, joint_names=("elbow",)).tau, signals["tau"][:, :1])
    with pytest.raises(ValueError, match="missing columns q_wrist, v_wrist, a_wrist, tau_wrist"):
        jd.read_log(path, joint_names=("elbow", "wrist"))


def test_npz_takes_whole_signals(signals, tmp_path):
    np.savez(tmp_path / "log.npz", **signals, note=np.array("ignored"))
    np.testing.assert_array_equal(jd.read_log(tmp_path / "log.npz").a, signals["a"])
    np.savez(tmp_path / "flat.npz", t=signals["t"], q=signals["t"], tau=signals["t"])
    with pytest.raises(ValueError, match=r"flat.npz: q has shape \(60,\)"):
        jd.read_log(tmp_path / "flat.npz")


BAD_FILES = {
    "empty": ("", "the file is empty"),
    "no time": ("q1,tau1\n0,0\n", "missing column t; the file has q1, tau1"),
    "no torque": ("t,q1\n0,0\n", "missing columns tau1"),
    "hole": ("t,q1,q3,tau1,tau2,tau3\n0,0,0,0,0,0\n", "missing columns q2;"),
    "repeated": ("t,q1,q1,tau1\n0,0,0,0\n", "repeated columns q1"),
    "mixed": ("t,q1,q_a,tau1\n0,0,0,0\n", "both numbered .* and named"),
    "word": ("t,q1,tau1\n0,0,0\n1,oops,0\n", "line 3, column q1: 'oops' is no number"),
    "blank": ("t,q1,tau1\n0,0,\n", "line 2, column tau1: '' is no number"),
    "short row": ("t,q1,tau1\n0,0,0\n1,0\n", "line 3 has 2 cells, the header 3"),
    "nan": ("t,q1,tau1\n0,0,0\n1,nan,0\n", "q is nan at row 1, column 1"),
    "backwards": ("t,q1,tau1\n0,0,0\n-1,0,0\n", "time does not increase at row 1"),
    "header only": ("t,q1,tau1\n", "no samples"),
    "no header": (
        "0.0,-0.000000,1.0\n1,2,3\n",
        "line 1 is 0.0, -0.000000, 1.0, ...: numbers, no header; the first line names",
    ),
    "decimal commas": ("t;q1;tau1\n0;0;0\n1;0,5;0\n", "column q1: '0,5' is no number; write decimal points"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_raise(tmp_path, case):
    text, message = BAD_FILES[case]
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"bad\.csv: .*{message}"):
        jd.read_log(path)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_separators(tmp_path, separator):
    path = tmp_path / "log.csv"
    path.write_text(
        "\n".join(separator.join(row) for row in (("t", "q1", "tau1"), ("0", "0.5", "1"), ("1", "0.25", "2")))
    )
    log = jd.read_log(path)
    np.testing.assert_array_equal(log.q[:, 0], [0.5, 0.25])
    np.testing.assert_array_equal(log.tau[:, 0], [1, 2])


def test_joints_of_other_names(signals, tmp_path):
    """The message offers the mapping, and the mapping does it."""
    path = tmp_path / "log.csv"
    jd.io.write_log(path, identify.Log(**signals, joint_names=("m1", "m2")))
    with pytest.raises(ValueError, match=r"missing columns q_shoulder.*rename them: m1=shoulder m2=elbow"):
        jd.read_log(path, joint_names=("shoulder", "elbow"))
    log = jd.read_log(path, joint_names=("shoulder", "elbow"), rename={"m1": "shoulder", "m2": "elbow"})
    np.testing.assert_array_equal(log.tau, signals["tau"])
    with pytest.raises(ValueError, match="rename: no column is of joint m3"):
        jd.read_log(path, rename={"m3": "wrist"})


def test_unreadable_files_raise(tmp_path, signals):
    with pytest.raises(FileNotFoundError, match=r"gone\.csv: no such log file"):
        jd.read_log(tmp_path / "gone.csv")
    with pytest.raises(ValueError, match=r"are \.csv or \.npz, not '\.mat'"):
        jd.read_log(tmp_path / "log.mat")
    with pytest.raises(ValueError, match=r"are \.csv or \.npz, not '\.txt'"):
        jd.io.write_log(tmp_path / "log.txt", identify.Log(**signals))
    np.savez(tmp_path / "log.npz", t=np.arange(3.0), q1=np.arange(3.0), tau1=np.arange(2.0))
    with pytest.raises(ValueError, match="unequal lengths: t has 3 rows, q1 has 3 rows, tau1 has 2 rows"):
        jd.read_log(tmp_path / "log.npz")


def test_from_raw_recovers_a_slow_sine():
    """A 1 Hz motion is far below the cut-off: rates are its derivatives.

    Errors: linear interpolation (w dt)^2 / 8 = 5e-6, jitter of the time stamps up to that again, filter (1/8)^8 = 6e-8.
    """
    generator = np.random.default_rng(1)
    t = np.sort(np.linspace(0, 8, 8001) + generator.uniform(-3e-4, 3e-4, 8001))
    w = 2 * np.pi
    log = identify.from_raw(t, np.sin(w * t)[:, None], np.cos(w * t)[:, None])
    middle = log[len(log) // 4 : -len(log) // 4]
    expected = dict(q=np.sin(w * middle.t), v=w * np.cos(w * middle.t), a=-(w**2) * np.sin(w * middle.t))
    for name, value in (expected | dict(tau=np.cos(w * middle.t))).items():
        np.testing.assert_allclose(getattr(middle, name)[:, 0], value, atol=1e-4 * np.abs(value).max())


def test_rates_are_those_of_splines():
    """At 20 samples a period the share (w h)^4 / 180 = 5.4e-5 is missing; central differences lose (w h)^2 / 6 = 1.6 %."""
    t = np.linspace(0, 40, 1601)
    step, w = t[1] - t[0], 2 * np.pi * 2
    log = identify.from_raw(t, np.sin(w * t)[:, None], np.cos(w * t)[:, None], cutoff=10.0, trim=200, every=1)
    # A cubic spline through a sine has these slopes at its knots.
    slope = 3 * np.sin(w * step) / (step * (2 + np.cos(w * step)))
    # The Butterworth filter's share, forward and backward, which q has lost once, v twice and a three times.
    low = 1 / (1 + (np.tan(w * step / 2) / np.tan(np.pi * 10.0 * step)) ** 8)
    for order, name in enumerate(("q", "v", "a")):
        size = np.sqrt(2) * np.std(getattr(log, name)[:-1, 0])  # 60 periods
        assert size == pytest.approx(low ** (order + 1) * slope**order, rel=1e-9)
    assert slope == pytest.approx(w * (1 - (w * step) ** 4 / 180), rel=1e-5)


def test_from_raw_refuses():
    t = np.linspace(0, 2, 2001)
    x = np.sin(t)[:, None]
    with pytest.raises(ValueError, match="300 samples are too few for the filter: at least 409"):
        identify.from_raw(t[:300], x[:300], x[:300])
    with pytest.raises(ValueError, match=r"cutoff=600.0 Hz must lie between 0 and half the sampling rate, 500 Hz"):
        identify.from_raw(t, x, x, cutoff=600.0)
    with pytest.raises(ValueError, match=r"gap of 0.5\d* s after row 999 .*longer than half a period of cutoff=8"):
        identify.from_raw(np.where(t < 1, t, t + 0.5), x, x)
    with pytest.raises(ValueError, match="q has 2 columns and tau 1"):
        identify.from_raw(t, np.hstack([x, x]), x)


@pytest.mark.data
def test_from_raw_is_the_protocol_of_the_recorded_data(data_dir):
    """The arrays of the script that defines the protocol, but for its differences and for what continues the signals at the ends.

    The script takes SciPy's fifteen samples, `from_raw` three periods of the cut-off. What is left of that after the ends are
    dropped is below 1e-2 of the largest acceleration; far from the ends it has died away to 1e-7. The script's differences are
    of second order: they lose (w h)^2 / 6 of v, twice that of a, 4e-4 at the cut-off and less below it.
    """
    folder = data_dir / "franka_panda"
    if not folder.is_dir():
        pytest.skip(f"no Franka log at {folder}")
    spec = importlib.util.spec_from_file_location("prepare", folder / "prepare.py")
    prepare = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(prepare)
    t, q, _, tau = prepare.raw()
    log = identify.from_raw(t, q, tau)
    for name, value in zip(("t", "q", "v", "a", "tau"), prepare.prepared(), strict=True):
        computed = np.asarray(getattr(log, name))
        size = np.abs(value).max()
        np.testing.assert_allclose(computed, value, rtol=0, atol=1e-2 * size)
        inside = slice(len(value) // 4, -len(value) // 4)
        bound = {"v": 4e-4, "a": 8e-4}.get(name, 1e-7)
        np.testing.assert_allclose(computed[inside], value[inside], rtol=0, atol=bound * size)
    train, test = identify.split(log, 0.7)
    rows = prepare.split(len(log))
    np.testing.assert_array_equal(train.t, log.t[rows[0]])
    np.testing.assert_array_equal(test.t, log.t[rows[1]])
    assert identify.torque_error(1.1 * log.tau, log.tau) == pytest.approx(prepare.error_percent(1.1 * log.tau, log.tau))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"every": 0}, "every is 0; give a whole number of at least 1"),
        ({"trim": -1}, "trim is -1; give a whole number of at least 0"),
        ({"order": 0}, "order is 0; give a whole number of at least 1"),
    ],
)
def test_from_raw_refuses_counts(options, words):
    t = np.linspace(0, 2, 2001)
    with pytest.raises(ValueError, match=words):
        identify.from_raw(t, t[:, None], t[:, None], **options)


@pytest.mark.parametrize("cell", ["1_0", "１０", "0x1"])
def test_cells_that_only_python_reads_are_refused(cell, tmp_path):
    (tmp_path / "log.csv").write_text(f"t,q1,tau1\n0,0,0\n1,{cell},0\n", encoding="utf-8")
    with pytest.raises(ValueError, match=f"line 3, column q1: '{cell}' is no number"):
        jd.read_log(tmp_path / "log.csv")


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("t,q1 [deg],tau1", r"column q1 is in deg; .* convert"),
        ("t [ms],q1 [rad],tau1", "column t is in ms"),
        ("t [s],q1 [base.x; mm],tau1", "column q1 is in mm"),
        ("t,q_a [rad],v_a [°/s],tau_a", "column v_a is in °/s"),
        ("t,q1 [rad],tau1 [N·mm]", "column tau1 is in N·mm"),
        ("t,q0,q1,tau0,tau1", r"columns are numbered from 0 \(q0, tau0\); number them from 1"),
        ("t,q_a,tau1", r"columns of q are named \(q_a\), those of tau numbered; use one kind"),
    ],
)
def test_units_and_numbers_that_would_be_misread_are_refused(header, words, tmp_path):
    path, n = tmp_path / "log.csv", header.count(",") + 1
    path.write_text("\n".join([header, *(",".join([str(i)] * n) for i in range(3))]), encoding="utf-8")
    with pytest.raises(ValueError, match=words):
        jd.read_log(path)
    # The same unit of a column that is not read does no harm.
    path.write_text("t [s],q1 [rad],tau1 [N m],speed [rpm]\n0,1,2,3\n1,1,2,3\n", encoding="utf-8")
    assert jd.read_log(path).q.shape == (2, 1)


@pytest.mark.parametrize("order", [("1", "10", "2"), None])
def test_joints_whose_names_are_numbers(order, tmp_path):
    """A model sorts its joints by their names as texts: 1, 10, 2. Their columns are no numbers of columns."""
    path = tmp_path / "log.csv"
    path.write_text("t,q_1,q_10,q_2,tau_1,tau_10,tau_2\n0,1,10,2,1,10,2\n1,1,10,2,1,10,2\n")
    log = jd.read_log(path, joint_names=order)
    assert log.joint_names == ("1", "10", "2")
    np.testing.assert_array_equal(log.q, [[1, 10, 2]] * 2)
    np.testing.assert_array_equal(log.tau, log.q)


def test_logs_in_other_encodings_are_refused_with_their_line(tmp_path):
    (tmp_path / "log.csv").write_bytes("t,q_机,tau_机\n0,0,0\n".encode("gbk"))
    with pytest.raises(ValueError, match=r"log.csv: line 1 is not UTF-8 .*; save the file as UTF-8"):
        jd.read_log(tmp_path / "log.csv")
    (tmp_path / "log.csv").write_text("t,q_机,tau_机\n0,0,0\n1,2,3\n", encoding="utf-8-sig")
    np.testing.assert_array_equal(jd.read_log(tmp_path / "log.csv").tau, [[0.0], [3.0]])


@pytest.mark.parametrize("t", [np.array(["0", "1_0"]), np.array([0.0, 1j]), ["0", "1"]])
def test_logs_of_texts_and_complex_numbers_are_refused(t):
    with pytest.raises(ValueError, match=r"t holds .*; give real numbers"):
        identify.Log(t, np.zeros((2, 1)), tau=np.zeros((2, 1)))


def test_lines_between_rare_samples_become_splines():
    """A 5 Hz torque recorded at 50 Hz and written at 500 Hz as lines loses 3 % of its size: the splines give it back."""
    t = np.arange(0, 4, 0.002)
    exact = np.stack([np.sin(2 * np.pi * 5 * t), np.cos(2 * np.pi * 3 * t)], axis=1)
    lines = np.stack([np.interp(t, t[::10], column) for column in exact[::10].T], axis=1)
    inner = slice(50, -50)  # away from the ends of the spline
    with pytest.warns(identify.LogWarning, match="2 columns of torques are lines between rarer samples"):
        splines = spline_lines(t, lines, "torques")
    # The lines' own loss is 1 - sinc(0.1)^2 in the mean; a spline's error is of fourth order.
    assert np.abs(lines - exact)[inner].max() > 0.03 and np.abs(splines - exact)[inner].max() < 2e-3
    with pytest.warns(identify.LogWarning, match="torques are lines"):
        log = identify.from_raw(t, exact, lines, cutoff=20.0, trim=100, every=1)
    wanted = identify.from_raw(t, exact, exact, cutoff=20.0, trim=100, every=1)
    np.testing.assert_allclose(log.tau, wanted.tau, atol=2e-3)


def test_other_columns_are_no_lines():
    """Smooth and noisy columns, held samples, one that rests at times, and one of a few lines stay the same arrays."""
    t, rng = np.arange(0, 4, 0.002), np.random.default_rng(0)
    held = np.repeat(rng.normal(size=200), 10)
    rests = np.where(np.sin(3 * t) > 0, np.sin(20 * t), 0.0)
    few = np.interp(t, [0, 1, 2.5, 4], [0, 1, -1, 0])
    for column in (np.sin(t), rng.normal(size=2000), held, rests, few, np.zeros(2000), np.round(np.sin(t), 2)):
        x = column[:, None]
        assert spline_lines(t, x, "torques") is x


# --- cut-off frequencies from the spectra of raw logs ---


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
    with pytest.raises(ValueError, match="cutoff is 'low'; give a frequency"):
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
    logs = recorded(data_dir)
    for log in logs:
        for part in (log, identify.split(log, 0.6)[0]):
            assert 4 <= identify.choose_cutoff(part).frequency <= 7  # six seconds have lines 0.17 Hz apart
    # Four seconds, hardly two periods: two of the three logs tell it, and one is refused, not sent through at 100 Hz.
    assert [identify.choose_cutoff(identify.split(log, 0.6)[1]).frequency < 7.6 for log in logs[1:3]] == [True, True]
    with pytest.raises(ValueError, match="noise of the positions"):
        identify.choose_cutoff(identify.split(logs[3], 0.6)[1])
