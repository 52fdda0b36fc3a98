"""Several logs, torque terms and their choice, weights, and intervals that cover."""

import itertools

import jax
import numpy as np
import pytest
from two_links import planar_arm, sines

import jaxdyn as jd
from benchmarks.identify_selection import false_choices
from benchmarks.identify_selection import motion as random_motion
from jaxdyn import identify, inertia
from jaxdyn.cli.identify_tables import payload_text
from jaxdyn.identify.condensed_fit import Setting, eliminate, fit_blocks, share_of_extra
from jaxdyn.identify.log_repair import check_saturation
from jaxdyn.identify.logs import filter_like_log, idle_coordinates, motion_paths, samples_for_jumps
from jaxdyn.identify.raw_logs import check_log_content, check_rest, motion_band, vibration
from jaxdyn.identify.regression import block_slices, condense_model
from jaxdyn.identify.robot_logs import RobotLogs, huber_weights
from jaxdyn.identify.selection import improving_torques, is_clear, log_errors, splits, standard_error
from jaxdyn.identify.torque_terms import PRESLIDING, split_terms
from jaxdyn.identify.uncertainty import block_groups, effective_sample_size, is_white, jackknife, model_error_factors


@jax.jit
@jax.vmap
def change_inertia(x, step):
    return inertia.from_log_cholesky(inertia.to_log_cholesky(x) + step)


def arm(stretch=0.0, seed=0):
    """The arm of two links; `stretch` is the size of a random change of both."""
    model, step = planar_arm(), stretch * np.random.default_rng(seed).normal(size=(2, 10))
    return model.replace(inertias=change_inertia(model.inertias, step))


def motion(seed, n=300, duration=6.0):
    """A log of a sum of sines with exact derivatives, without torques yet."""
    return identify.Log(*sines(2, n, seed, duration), np.zeros((n, 2)))


def measured(model, log, x=None, more=0.0, noise=0.0, seed=0):
    """The log with the torques of parameters x, of the model's own by default, and noise."""
    x = identify.nominal_parameters(model) if x is None else x
    tau = identify.regressor(model, log.q, log.v, log.a) @ x + more
    return identify.Log(log.t, log.q, log.v, log.a, tau + noise * np.random.default_rng(seed).normal(size=tau.shape))


# A fit of the terms that are named alone, by squares.
GIVEN = {"v_s": 0.01, "prior": 1.0, "robust": None}
PLAIN = {"terms": identify.TERMS, **GIVEN}


@pytest.fixture(scope="module")
def truth():
    """Parameters of an arm with friction, rotors and offsets."""
    return true_parameters()


def true_parameters(model=None):
    x = identify.nominal_parameters(arm() if model is None else model)
    x[20:] = [0.3, 0.2, 0.4, 0.3, 0.1, -0.2, 0.05, 0.02]
    return x


PAYLOAD = np.asarray(inertia.displaced(inertia.sphere(0.6, 0.05), (0.02, 0, -0.7)))


def with_payload(x):
    return x + np.concatenate([np.zeros(10), PAYLOAD, np.zeros(8)])


def sources_of(found):
    """Where each number comes from, by name."""
    return dict(zip(found.names, found.sources, strict=True))


# --- several logs -----------------------------------------------------------------------------------------------------


def test_blocks_cross_no_joint():
    slices = block_slices([100, 10, 57], 8)
    for log, length in enumerate([100, 10, 57]):
        own = [part for which, part in slices if which == log]
        assert [own[0].start, own[-1].stop] == [0, length]
        assert all(a.stop == b.start for a, b in itertools.pairwise(own))
    assert len(slices) in (8, 9) and [log for log, _ in slices] == sorted(log for log, _ in slices)


def test_condensed_blocks_keep_all_squares_and_products(truth):
    """Against the stacked matrix itself: gram, squared errors, slopes, for all blocks and for some, weighted."""
    model, weights = arm(), np.array([1.0, 3.0])
    logs = [measured(model, motion(1, 2100, 40.0), truth), measured(model, motion(2, 150), truth)]
    blocks = condense_model(model, logs, blocks=6)
    assert blocks.logs.tolist() == [0] * (len(blocks) - 1) + [1] and blocks.samples.sum() == 2250
    chosen = np.array([1, len(blocks) - 1])
    parts = block_slices([len(log) for log in logs], 6)
    x = np.random.default_rng(0).normal(size=28)

    def stacked(parts):
        rows = [logs[which][part] for which, part in parts]
        W = np.concatenate([identify.regressor(model, log.q, log.v, log.a) for log in rows])
        return W, np.concatenate([log.tau for log in rows])

    for picked, given in ((chosen, [parts[i] for i in chosen]), (None, parts)):
        W, tau = stacked(given)
        whole = np.concatenate([W, tau[:, :, None]], axis=2) * weights[:, None]
        rows = blocks.rows(weights, picked)
        gram = np.einsum("nij,nik->jk", whole, whole)
        np.testing.assert_allclose(rows.T @ rows, gram, atol=1e-12 * np.abs(gram).max())
        error = W @ x - tau
        np.testing.assert_allclose(blocks.squares(x, picked).sum(axis=0), np.sum(error**2, axis=0), rtol=1e-11)
        assert blocks.count(picked) == tau.size
    slopes = np.einsum("nij,ni->j", W, weights**2 * error)
    np.testing.assert_allclose(blocks.scores(x, weights).sum(axis=0), slopes, atol=1e-11 * np.abs(slopes).max())
    gram = np.einsum("nij,i,nik->jk", W, weights**2, W)
    np.testing.assert_allclose(blocks.grams(weights).sum(axis=0), gram, atol=1e-12 * np.abs(gram).max())


def test_fits_of_several_logs_are_fits_of_all_their_rows(truth):
    model = arm()
    first, second = measured(model, motion(1), truth, noise=0.1), measured(model, motion(2, 100), truth, noise=0.1)
    t = np.concatenate([first.t, second.t + 100])
    both = identify.Log(t, *(np.concatenate([getattr(x, k) for x in (first, second)]) for k in ("q", "v", "a", "tau")))
    for fit in (identify.least_squares, identify.fit_torques):
        one, two = fit(model, both), fit(model, [first, second])
        x, y = (f.parameters if fit is identify.least_squares else f.vector for f in (one, two))
        np.testing.assert_allclose(x, y, rtol=1e-7, atol=1e-7)
    with pytest.raises(ValueError, match=r"log 2 of 2: the log has no a"):
        identify.fit_torques(model, [first, identify.Log(second.t, second.q, second.v, None, second.tau)])
    with pytest.raises(ValueError, match="log is list; give"):
        identify.fit_torques(model, [])


def test_presliding_starts_anew_in_every_log():
    """It follows dz/dq = (sign v - z) / z0, from the side the motion starts on; a log does not know the one before."""
    (dahl,) = split_terms("dahl", 1)[1]
    q = np.concatenate([np.linspace(0, 0.01, 40), np.linspace(0.01, 0.004, 40)])[:, None]
    log = identify.Log(np.arange(80.0), q, np.gradient(q, axis=0), q, q)
    z = dahl(log, np.zeros_like(q), 1e-9)[:, 0, 0]
    np.testing.assert_allclose(z[:40], 1.0, rtol=1e-12)
    np.testing.assert_allclose(z[40:], -1 + 2 * np.exp(-(0.01 - q[40:, 0]) / PRESLIDING), rtol=1e-12)
    assert dahl(log[60:], np.zeros((20, 1)), 1e-9)[0, 0, 0] == -1.0


# --- torque terms -----------------------------------------------------------------------------------------------------


def test_elimination_is_exact():
    """Minimising over c first, then over x, is minimising over both."""
    generator = np.random.default_rng(0)
    rows, ridge = generator.normal(size=(50, 3 + 5 + 1)), np.array([0.1, 1.0, 3.0])
    R, coefficients = eliminate(rows, 3, ridge)
    x = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=None)[0]
    whole = np.concatenate([rows, np.concatenate([np.diag(ridge), np.zeros((3, 6))], axis=1)])
    both = np.linalg.lstsq(whole[:, :-1], whole[:, -1], rcond=None)[0]
    np.testing.assert_allclose(np.append(coefficients(x), x), both, rtol=1e-11)
    rest = np.sum((R[:, :-1] @ x - R[:, -1]) ** 2)
    np.testing.assert_allclose(rest, np.sum((whole[:, :-1] @ both - whole[:, -1]) ** 2), rtol=1e-11)


def test_terms_that_are_there_are_recovered(truth):
    """Pre-sliding, quadratic friction and a term of the user's own, without noise; and the fit predicts another log."""
    model = arm()
    own = identify.TorqueTerm("cable", lambda log, load, v_s: np.asarray(log.q) ** 2)
    terms = (identify.EXTRA["dahl"], identify.EXTRA["quadratic"], own)
    coefficients = np.array([[0.5, 0.2], [0.03, 0.04], [0.3, -0.2]])

    def log(seed, n=300):
        bare = motion(seed, n)
        more = sum(c * term(bare, bare.tau, 0.01)[:, :, 0] for c, term in zip(coefficients, terms, strict=True))
        return measured(model, bare, truth, more)

    fit = identify.fit_robot(model, [log(1), log(2, 200)], (*identify.TERMS, *terms), weights=None, **GIVEN)
    assert fit.choice.trials == () and fit.fit.terms == (*identify.TERMS, "dahl", "quadratic", "cable")
    # The noise that weighs the priors is the floor, so they pull a little.
    np.testing.assert_allclose(fit.fit.extra.coefficients, coefficients, atol=1e-4)
    base = identify.base_parameters(model, identify.TERMS)
    np.testing.assert_allclose(base.values(fit.fit.vector), base.values(truth), atol=1e-4)
    assert fit.fit.error(log(3)) < 1e-2
    assert fit.fit.extra.by_term["cable"] == pytest.approx([0.3, -0.2], abs=1e-4)
    # Printed: a line on the fit, one on the setting, the header, and a line for each base parameter.
    head, _, *lines = str(fit).splitlines()
    assert head.startswith("Fit: torque fit by newton, successful, loss ")
    assert len(lines) == 1 + len(fit.intervals.base.names)
    assert len(str(fit.fit).splitlines()) == 2 + len(fit.fit.names)


def test_load_dependent_friction_follows_the_fitted_robot(truth):
    model = arm()
    (load,) = split_terms("load", 2)[1]

    def log(seed, noise=0.01):
        bare = motion(seed)
        bodies = truth.copy()
        bodies[20:26] = 0
        carried = identify.regressor(model, bare.q, bare.v, bare.a) @ bodies
        return measured(model, bare, truth, 0.1 * load(bare, carried, 0.01)[:, :, 0], noise)

    fit = identify.fit_robot(model, log(1), (*identify.TERMS, "load"), **GIVEN)
    np.testing.assert_allclose(fit.fit.extra.coefficients, 0.1, atol=3e-3)
    assert fit.fit.error(log(2, noise=0.0)) < 0.2


@pytest.mark.long
def test_loads_that_have_not_settled_are_said(truth, monkeypatch):
    """Friction in proportion to the load of the fit before: three fits leave it three standard deviations off."""
    model, terms, bare = arm(0.2, 3), (*identify.TERMS, "load"), measured(arm(), motion(1), truth)
    load = bare.tau - identify.regressor(arm(), bare.q, bare.v, bare.a)[:, :, 20:] @ truth[20:]
    log = measured(arm(), bare, truth, 0.1 * np.abs(load) * np.tanh(bare.v / 0.01), 0.002, 1)
    fit = identify.fit_robot(model, log, terms, **GIVEN)
    assert fit.fit.result is jd.RESULTS.successful
    held = measured(arm(), motion(3), with_payload(truth), noise=0.02, seed=3)
    assert bool(identify.fit_payload(model, log, held, robot=fit).success)
    monkeypatch.setattr("jaxdyn.identify.payloads.MAX_ROUNDS", 1)
    short = identify.fit_payload(model, log, held, robot=fit)
    assert short.result is jd.RESULTS.max_steps_reached and "NOT CONVERGED" in payload_text(short)
    basic, extra, where = split_terms(terms, 2)
    problem = RobotLogs(model, (log,), basic, extra, "full", 20)
    for rounds, code in ((3, jd.RESULTS.max_steps_reached), (30, jd.RESULTS.successful)):
        assert problem.refine(Setting(0.01, where, 1.0), None, rounds).result is code


def test_friction_goes_through_the_filter_of_the_log(truth):
    """Raw samples of an arm with Coulomb friction, low-passed: a jump of the torque is then a slope, and so is the column's."""
    model = arm()
    raw = measured(model, motion(1, 12001, 24.0), truth)
    log = identify.from_raw(raw.t, raw.q, raw.tau, cutoff=8.0, trim=200, every=4)
    assert log.cutoff == log[10:].cutoff == 8.0 and raw.cutoff is None
    fit = identify.fit_robot(model, log, weights=None, **PLAIN).fit
    plain = identify.least_squares(model, log, v_s=0.01)  # whose column of friction did not go through the filter
    assert fit.error(log) < 0.2 * plain.error(log)
    np.testing.assert_allclose(identify.fit_torques(model, log, v_s=0.01).vector, fit.vector, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(fit.friction.coulomb, truth[22:24], rtol=0.01)
    # Smooth signals pass as they are, and a log without a filter leaves every column alone.
    np.testing.assert_allclose(filter_like_log(log, log.v)[50:-50], log.v[50:-50], atol=2e-3)
    column = np.tanh(raw.v / 0.01)
    assert filter_like_log(raw, column) is column


def test_columns_that_jump_are_low_passed_as_when_they_were_sampled():
    """sign(v) at 500 Hz through the low-pass, against the column from the log, which has a thirtieth of the samples."""
    t = np.linspace(0, 20, 10001)[:, None]
    q, v = np.sin(2 * t) + 0.3 * np.sin(3.1 * t), 2 * np.cos(2 * t) + 0.93 * np.cos(3.1 * t)
    log = identify.from_raw(t[:, 0], q, np.sign(v), cutoff=5.0, trim=250, every=6)
    finer, factor = samples_for_jumps(log)
    fine = filter_like_log(log, np.tanh(finer.v / 1e-3), factor=factor)
    coarse = filter_like_log(log, np.tanh(log.v / 1e-3))
    inner = slice(40, -40)  # without the transients of the filter at the ends of the log
    errors = [np.sqrt(np.mean((x - log.tau)[inner] ** 2)) for x in (fine, coarse)]
    assert errors[0] < 0.005 and errors[0] < 0.3 * errors[1]
    unfiltered = identify.Log(t[:, 0], q, v, v, v)
    assert samples_for_jumps(unfiltered) == (unfiltered, 1)


@pytest.mark.long
def test_choice_by_cross_validation(truth):
    """What is there is chosen where it is, what is not there is left out, and every trial is told."""
    model = arm()
    dahl = identify.EXTRA["dahl"]

    def log(seed):
        bare = motion(seed)
        return measured(model, bare, truth, 0.5 * np.array([1, 0]) * dahl(bare, bare.tau, 0.01)[:, :, 0], 0.05, seed)

    told = []
    fit = identify.fit_robot(model, [log(1), log(2)], prior=1.0, callback=told.append)
    extra = dict(fit.choice.setting.extra)
    assert extra["dahl"] == (0,) and "spring" not in extra
    # A smooth sign of 0.003 or 0.03 rad/s differs from one of 0.01 in few samples of these logs.
    assert 0.001 <= fit.choice.setting.v_s <= 0.03
    assert len(told) == len(fit.choice.trials) and "halves of the samples" in fit.choice.by
    plain = identify.fit_robot(model, [log(1), log(2)], **PLAIN)
    assert fit.fit.error(log(3)) < plain.fit.error(log(3))


@pytest.mark.long
@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(100), marks=pytest.mark.slow)])
def test_terms_that_are_not_there_are_not_chosen(seeds):
    """Exact models, viscous and Coulomb friction, normal noise: at most one log in twenty gets a term, or a robust loss."""
    rows = false_choices(seeds)
    terms, losses = ([row for row in rows if row[name]] for name in ("extra", "robust"))
    assert len(terms) <= len(seeds) / 20 and len(losses) <= len(seeds) / 20, (terms, losses)


def test_splits_are_logs_or_halves_of_quarters(truth):
    model = arm()
    logs = [measured(model, motion(seed), truth) for seed in range(3)]
    parts, by = splits(condense_model(model, logs, blocks=9))
    assert by == "logs" and [part.tolist() for part in parts] == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
    parts, by = splits(condense_model(model, logs[:2], blocks=8))
    assert by.startswith("6 halves") and [part.tolist() for part in parts] == [
        [0, 1, 2, 3], [0, 1, 4, 5], [0, 1, 6, 7], [2, 3, 4, 5], [2, 3, 6, 7], [4, 5, 6, 7],
    ]  # fmt: skip
    with pytest.raises(ValueError, match="too short to leave a part"):
        splits(condense_model(model, logs[:1], blocks=1))


def test_clear_improvements():
    """Half of the error everywhere is clear; a thousandth is too little, and four splits of six are not most of them."""
    before = np.ones((6, 3))
    after = np.stack([np.full(6, 0.5), np.full(6, 0.999), [0.1, 0.9, 0.9, 0.9, 1.1, 1.1]], axis=1)
    assert improving_torques(before, after) == (0,) and improving_torques(before, after, minimum=0.0) == (0, 1)
    assert standard_error(np.array([1.0, 2.0, 3.0, 4.0])) == pytest.approx(np.sqrt(5 / 3) / 2)
    # Half of the sum, half of each torque: squares of 1 and 4 have the logarithms log 5 and log 2.
    assert log_errors(np.array([1.0, 4.0])) == pytest.approx((np.log(5) + np.log(2)) / 2)
    assert is_clear(before, 0.9 * before) and not is_clear(before, 0.9 * before, minimum=0.2)
    # One block of six gains much, and another loses a little: the mean gain is less than its standard error.
    assert not is_clear(before, np.array([0.1, 1.1, 1.0, 1.0, 1.0, 1.0])[:, None] * before)


def test_weights_of_samples_come_from_the_fitted_half_alone(truth):
    """A robust loss that is of no use has no gain: weights from all samples gave one of tens of per cent."""
    model, noise = arm(), 0.1 * np.random.default_rng(0).standard_t(2.5, size=(600, 2))
    problem = RobotLogs(model, (measured(model, motion(1, 600, 12.0), truth, noise),), identify.TERMS, (), "full", 8)
    plain = Setting(0.01, (), 1.0)
    before, after = problem.loss_squares(plain, [plain, plain._replace(robust=1.345)])
    # The same as fits of half of the samples by hand.
    rest, part = np.arange(4), np.arange(4, 8)
    own = RobotLogs(model, (problem.logs[0][:300],), identify.TERMS, (), "full", 4)
    own.chart = problem.chart
    estimate = fit_blocks(problem.chart, own.data(plain), plain, problem.sizes, own.weights)
    wanted = problem.data(plain).blocks.squares(estimate.x, part)
    np.testing.assert_allclose(before[4:], wanted, rtol=0.02)  # fits that compare settings end early
    assert before.shape == after.shape == (8, 2) and len(rest) == 4
    assert abs(np.mean(log_errors(before) - log_errors(after))) < 0.1


def test_weights_are_one_over_the_root_of_the_noise_of_each_joint(truth):
    model = arm()
    bare = motion(1, 600)
    log = measured(model, bare, truth, np.random.default_rng(5).normal(size=(600, 2)) * [0.5, 0.02])
    fit, even = (identify.fit_robot(model, log, weights=weights, **PLAIN) for weights in ("auto", None))
    assert fit.weights[1] / fit.weights[0] == pytest.approx(5, rel=0.08)
    base = fit.intervals.combinations
    off = [np.linalg.norm((base.values(f.fit.vector) - base.values(truth))[3:6]) for f in (fit, even)]
    assert off[0] < off[1]


def test_bad_arguments_raise(truth):
    model = arm()
    log = measured(model, motion(1), truth)
    for words, arguments in (
        (r"term 'stiction' is unknown; give some of viscous.*dahl", {"terms": "stiction"}),
        (r"term 'dahl' is for torques \(2,\); there are 2", {"terms": (("dahl", (2,)),)}),
        ("each may be given once", {"terms": ("dahl", "dahl")}),
        ("v_s is 'fast'", {"v_s": "fast"}),
        ("v_s is -1.0", {"v_s": -1.0, "prior": 1.0}),
        ("prior is 0", {"prior": 0.0}),
        ("prior is inf", {"prior": np.inf}),
        (r"weights is \[1.0, -1.0\]", {"weights": (1.0, -1.0)}),
        (r"weights is \[1.0, inf\]", {"weights": (1.0, np.inf)}),
        ("blocks is 1", {"blocks": 1}),
    ):
        with pytest.raises(ValueError, match=words):
            identify.fit_robot(model, log, **arguments)
    bad = identify.TorqueTerm("bad", lambda log, load, v_s: np.ones(3))
    with pytest.raises(ValueError, match=r"term 'bad' gave an array of shape \(3,\) for 300 samples"):
        identify.fit_robot(model, log, bad, v_s=0.01, prior=1.0, robust=None)


# --- intervals --------------------------------------------------------------------------------------------------------


def coverage(noises, count, size=0.05):
    """Share of 95 % intervals of base parameters that hold the truth, over random arms; noises(seed, n) are (n, 2).

    And root mean squares (n,) of the errors of each number in standard deviations: intervals that are too wide hold any truth.
    """
    inside, sizes = [], []
    for seed in range(count):
        model, bare = arm(0.2, seed), motion(seed)
        x = true_parameters(model)
        log = measured(model, bare, x, size * noises(seed, len(bare)))
        fit = identify.fit_robot(arm(), log, **PLAIN).intervals
        off = np.abs(fit.base.values - fit.combinations.values(x))
        inside.append(off <= fit.factor * fit.base.std)
        sizes.append(off / fit.base.std)
    return np.mean(inside), np.sqrt(np.mean(np.square(sizes), axis=0))


def white(seed, n):
    return np.random.default_rng(100 + seed).normal(size=(n, 2))


def correlated(seed, n):
    """Noise whose correlation lasts some ten samples, as a low-pass leaves it."""
    kernel = np.exp(-(np.linspace(-2, 2, 21) ** 2))
    return np.stack([np.convolve(x, kernel / np.linalg.norm(kernel), "same") for x in white(seed, n).T], axis=1)


def lasting(seed, n, keep=0.97):
    """Noise whose correlation decays exponentially over some 33 samples: on 300 of them ten groups of blocks are too short."""
    noise = white(seed, n)
    for i in range(1, n):
        noise[i] = keep * noise[i - 1] + np.sqrt(1 - keep**2) * noise[i]
    return noise


# Torques that the fits below lack: of 0.2 to 2 % of the measured ones.
LEFT_OUT = {
    "ripple": lambda q, v, rigid, v_s: 0.05 * np.sin(11 * q + [0, 1]),
    "quadratic": lambda q, v, rigid, v_s: 0.05 * v * np.abs(v),
    # At the second joint: at the first one, about a horizontal axis, a spring is the link's weight.
    "spring": lambda q, v, rigid, v_s: 0.1 * np.sin(q + 0.5) * np.array([0.0, 1.0]),
    "load": lambda q, v, rigid, v_s: 0.05 * np.abs(rigid) * np.tanh(v / v_s),
    "asymmetric": lambda q, v, rigid, v_s: 0.05 * np.abs(v),
}


def recorded_coverage(kind, seeds, rate=500):
    """Shares of 95 % intervals of base parameters and of friction that hold the truth, over logs of an arm as it is recorded.

    Encoders with 2e-5 rad of noise at 500 Hz; torques with 0.01 N m of it at 50 Hz, written as lines between these samples.
    `kind`: of `LEFT_OUT`, a torque in addition, which no term of the fit explains; "lines", none; "exact", nor noise and lines.
    """
    noise = 0.0 if kind == "exact" else 1.0
    bodies, friction = [], []
    for seed in seeds:
        rng, model, v_s = np.random.default_rng(seed), arm(), 0.02
        x = identify.nominal_parameters(model)
        size = rng.uniform([[0.05], [0.1], [0.005]], [[0.5], [0.5], [0.05]], (3, 2))
        x[20:] = np.concatenate([size[0], size[1], 0.1 * rng.normal(size=2), size[2]])
        t = np.arange(0, rng.uniform(10, 20), 1 / rate)
        q, v, a = random_motion(rng, t)
        W = identify.regressor(model, q, v, a, v_s=v_s)
        tau = W @ x + noise * 0.01 * rng.normal(size=q.shape)
        tau = tau + (LEFT_OUT[kind](q, v, W[:, :, :20] @ x[:20], v_s) if kind in LEFT_OUT else 0.0)
        if kind != "exact":
            tau = np.stack([np.interp(t, t[::10], column) for column in tau[::10].T], axis=1)
        q = q + noise * 2e-5 * rng.normal(size=q.shape)
        cutoff = identify.choose_cutoff(identify.Log(t, q, tau=tau)).frequency
        every = max(1, int(rate / (15 * cutoff)))
        log = identify.from_raw(t, q, tau, cutoff=cutoff, every=every, trim=38 * every)
        fit = identify.fit_robot(model, log, **{**PLAIN, "v_s": v_s}).intervals
        inside = np.abs(fit.base.values - fit.combinations.values(x)) <= fit.factor * fit.base.std
        is_friction = np.array([name.endswith((".viscous", ".coulomb", ".offset")) for name in fit.base.names])
        bodies.append(inside[~is_friction])
        friction.append(inside[is_friction])
    return np.mean(bodies), np.mean(friction)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::jaxdyn.identify.LogWarning")
def test_intervals_cover_where_torques_are_interpolated():
    """Before lines were replaced by splines 70 % of the intervals of Coulomb friction held the truth."""
    # Of some 40 numbers of each kind, correlated within a log, fewer than 85 % at 95 % are rare.
    assert min(recorded_coverage("lines", range(6))) >= 0.85


@pytest.mark.long
@pytest.mark.parametrize("rate", [500, 200, 100])
def test_intervals_cover_without_noise(rate):
    """What the preparation of a log changes is all there is; by central differences 70 % of them at 100 Hz held the truth."""
    assert min(recorded_coverage("exact", range(6), rate)) >= 0.95


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxdyn.identify.LogWarning")
def test_intervals_cover_on_two_hundred_recorded_logs():
    bodies, friction = recorded_coverage("lines", range(200))
    print(f"nothing left out: {bodies:.3f} {friction:.3f}")
    assert 0.93 <= bodies <= 0.97 and 0.93 <= friction <= 0.97


# Least shares that hold the truth, of base parameters and of friction; without the fits of more terms, on 40 of the logs:
# quadratic 0.95 and 0.40, spring 0.49 and 0.80, load 0.95 and 0.80, asymmetric 0.84 and 0.90, ripple 0.91 and 0.95.
COVERED = {
    "ripple": (0.87, 0.94),
    "quadratic": (0.95, 0.87),
    "spring": (0.91, 0.95),
    "load": (0.95, 0.92),
    "asymmetric": (0.95, 0.95),
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxdyn.identify.LogWarning")
@pytest.mark.parametrize("kind", LEFT_OUT)
def test_intervals_are_wider_where_a_term_is_left_out(kind):
    """Ripple is of none of the terms that are tried; by the scatter alone 73 % of the intervals held the truth."""
    bodies, friction = recorded_coverage(kind, range(200))
    print(f"{kind}: {bodies:.3f} {friction:.3f}")
    assert bodies >= COVERED[kind][0] and friction >= COVERED[kind][1]


def test_numbers_of_a_direction_without_data_and_prior_have_no_interval(truth):
    """A joint that moves one way shows the sum of Coulomb friction and offset: their deviations were 1e-6, and they 0.2 off."""
    model, t = arm(), np.linspace(0, 1, 50)
    wave = np.sin(3 * t)[:, None] * [1.0, 0.0]
    q, v, a = (wave + t[:, None] * [0, 2.0], 3 * np.cos(3 * t)[:, None] * [1.0, 0.0] + [0, 2.0], -9 * wave)
    log = measured(model, identify.Log(t, q, v, a, 0 * q), truth, noise=0.0)
    found = identify.fit_robot(model, log, **PLAIN).intervals.parameters
    source = sources_of(found)
    lost = {name for name, word in source.items() if word == "undetermined"}
    # At constant speed viscous friction is constant too, and no torque accelerates the rotor.
    assert lost == {"b_joint.coulomb", "b_joint.offset", "b_joint.viscous", "b_joint.armature"}
    assert not np.isfinite([found.std[found.names.index(name)] for name in lost]).any()
    assert source["a_joint.coulomb"] in ("data", "prior")


def test_a_term_that_is_left_out_is_named_and_within_the_intervals(truth):
    """Quadratic friction at one joint, which viscous friction imitates; with the term the intervals need no second fit."""
    model, log = arm(), motion(2, 600, 12.0)
    more = np.stack([0 * log.v[:, 0], 0.05 * log.v[:, 1] * np.abs(log.v[:, 1])], axis=1)
    log = measured(model, log, truth, more, noise=0.02)
    lacking = identify.fit_robot(model, log, **PLAIN).intervals
    whole = identify.fit_robot(model, log, (*identify.TERMS, "quadratic"), **GIVEN).intervals
    assert ("quadratic", 1) in lacking.omitted and {joint for _, joint in lacking.omitted} == {1}
    assert whole.omitted == ()
    place = lacking.parameters.names.index("b_joint.viscous")
    off = abs(lacking.parameters.values[place] - truth[21])
    # Outside of an interval as wide as that of the true model, and within the one that holds both fits.
    assert whole.factor * whole.parameters.std[place] < off < lacking.factor * lacking.parameters.std[place]
    apart = abs(whole.parameters.values[place] - lacking.parameters.values[place])
    both = apart + whole.factor * whole.parameters.std[place]
    # One Newton step, with the weights of the fit without the term.
    np.testing.assert_allclose(lacking.factor * lacking.parameters.std[place], both, rtol=0.2)
    # Parameters of a joint's friction do not move where only the other one has the term.
    assert identify.fit_robot(model, measured(model, log, truth, noise=0.02), **PLAIN).intervals.omitted == ()


def test_a_wrong_model_widens_the_scatter_of_long_logs():
    """White errors leave it alone; slow ones of a log that seems worth 40 independent samples double it."""
    log = motion(0, 4000, 80.0)
    noise, slow = white(0, 4000), lasting(1, 4000, keep=0.98)
    np.testing.assert_array_equal(model_error_factors([log], [noise]), 1.0)
    size = effective_sample_size([slow[:, :1]])
    factors = model_error_factors([log], [np.stack([slow[:, 0], noise[:, 1]], axis=1)])
    assert size > 12 and factors[0] == pytest.approx(np.sqrt(size / 10)) and factors[1] == 1.0
    # Two logs count twice as much, and so does their cap.
    assert model_error_factors([log, log], [slow, slow])[0] == pytest.approx(factors[0])


def test_groups_of_blocks_are_as_long_as_errors_last():
    """Twice as long at least, where that leaves six groups; and of two blocks, however short errors are."""
    sizes = [[len(group) for group in block_groups(20, worth)] for worth in (np.inf, 16.0, 1.0)]
    assert sizes == [[2] * 10, [3] * 4 + [2] * 4, [4, 4, 3, 3, 3, 3]]
    assert len(block_groups(3, np.inf)) == 2 and len(block_groups(570, 1e4)) == 285
    log = motion(0)
    two = [identify.whiteness(log, x).effective_samples.min() for x in (white(0, 300), lasting(0, 300))]
    assert effective_sample_size([white(0, 300), lasting(0, 300)]) == pytest.approx(sum(two))


def test_the_share_of_the_variance_that_groups_see_is_that_of_theory():
    """Mean of noise of correlation keep^k: groups of L see 1 - T / (2 L) of its variance, T = 2 / -log keep."""
    keep, length, groups = 0.95, 80, 50
    noise = np.random.default_rng(0).normal(size=(400, length * groups))
    for i in range(1, noise.shape[1]):
        noise[:, i] = keep * noise[:, i - 1] + np.sqrt(1 - keep**2) * noise[:, i]
    sums = noise.reshape(400, groups, length).sum(axis=2)
    seen = []
    for series, total in zip(sums, noise.mean(axis=1), strict=True):
        slopes = (length * total - series)[:, None]
        root, *_ = jackknife(np.full((groups, 1, 1), float(length)), slopes, np.zeros((1, 1)))
        seen.append(np.sum(root**2))
    expected = 1 - 2 / -np.log(keep) / (2 * length)
    # 400 means know their variance to 7 %.
    assert abs(np.mean(seen) / np.var(noise.mean(axis=1)) / expected - 1) < 0.2
    assert expected < 0.8


def test_intervals_cover_and_are_not_too_wide():
    """1 % of noise on the torques, 8 arms of 13 combinations: 95 % intervals hold the truth nine times in ten.

    The weight of the first link and a spring at its joint are one torque: no log supports the spring, which the prior would take
    for the difference of the arm from the nominal one.
    """
    share, sizes = coverage(white, 8)
    assert share >= 0.90
    # 8 arms know a mean square to a half.
    assert sizes.min() > 0.4 and sizes.max() < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("noises", [white, correlated, lasting])
def test_intervals_cover_for_many_arms(noises):
    """As above; 40 arms, and noise that is correlated: over a thirtieth of the log, and over a fifth.

    Errors that are not white may be those of the model, so that the log, worth 30 independent samples, counts as ten.
    """
    share, sizes = coverage(noises, 40)
    print(f"{noises.__name__}: {share:.3f}, errors in standard deviations {sizes.min():.2f} to {sizes.max():.2f}")
    assert share >= 0.90 and sizes.min() > (0.7 if noises is white else 0.7 / np.sqrt(3)) and sizes.max() < 2.0


def test_what_no_data_touch_is_from_the_prior(truth):
    model = arm()
    fit = identify.fit_robot(model, measured(model, motion(1), truth, noise=0.05), **GIVEN).intervals
    sources = sources_of(fit.parameters)
    assert sources["a.Ixx"] == sources["b.Izz"] == "prior"  # the arm moves in a plane
    assert sources["b_joint.viscous"] == sources["b_joint.coulomb"] == "data"
    assert sources_of(fit.base)["b.mcz"] == "data"
    no_friction = measured(model, motion(1), truth * np.repeat([1, 0, 1], [20, 4, 4]), noise=0.05)
    fit = identify.fit_robot(model, no_friction, **PLAIN).intervals.parameters
    at_bound = fit.values[20:24] == 0
    assert np.isnan(fit.std[20:24][at_bound]).all() and np.isfinite(fit.std[20:24][~at_bound]).all()


def test_share_of_the_variance_that_extra_terms_cause():
    """Of a Gaussian with a known covariance, against the variances with the extra coefficient held fixed."""
    A = np.random.default_rng(0).normal(size=(30, 4))
    covariance = np.linalg.inv(A.T @ A)
    held = np.linalg.inv((A.T @ A)[:3, :3])
    shares = share_of_extra(np.eye(4)[:3], covariance, np.array([3]))
    np.testing.assert_allclose(shares, 1 - np.diag(held) / np.diag(covariance)[:3], rtol=1e-10)
    np.testing.assert_array_equal(share_of_extra(np.eye(4), covariance, np.array([], int)), 0.0)
    np.testing.assert_allclose(share_of_extra(np.eye(4)[3:], covariance, np.array([3])), 1.0, rtol=1e-12)


def test_white_residuals():
    """White noise, noise of a second difference and filtered white noise are white; slow errors at one joint are not."""
    t = np.linspace(0, 20, 2001)
    raw = identify.Log(t, np.zeros((2001, 2)), tau=np.random.default_rng(0).normal(size=(2001, 2)))
    assert is_white([raw], [raw.tau]).all() and is_white([raw], [np.diff(raw.tau, 2, axis=0)]).all()
    slow = raw.tau + [[1.0, 0.0]] * np.sin(2 * t)[:, None]
    assert is_white([raw], [slow]).tolist() == [False, True]
    low = identify.from_raw(t, raw.q, slow, cutoff=5.0, trim=50, every=1)
    assert is_white([low], [low.tau]).tolist() == [False, True]
    assert is_white([low, low], [low.tau, low.tau]).tolist() == [False, True]
    generator = np.random.default_rng(1)
    assert is_white([raw, raw[:1]], [slow, slow[:1]]).tolist() == [False, True]
    assert is_white([raw[:1]], [slow[:1]]).all()
    false = [not is_white([raw], [generator.normal(size=(2001, 1))]).all() for _ in range(300)]
    assert sum(false) <= 3


def test_white_noise_stays_white_where_torques_are_shifted():
    """Half a sample, where splines take most of the noise near half the sampling rate, and keep what is slower."""
    generator, t = np.random.default_rng(1), np.arange(2001) / 100
    logs = [identify.Log(t, np.zeros((2001, 1)), tau=generator.normal(size=(2001, 1))) for _ in range(100)]
    shifted = [identify.shift_torques(log, 0.005) for log in logs]
    assert sum(not is_white([log], [log.tau], 0.2)[0] for log in shifted) <= 1
    assert not is_white(shifted[:1], [shifted[0].tau + np.sin(2 * shifted[0].t)[:, None]])[0]


def test_dahl_friction_is_confounded_with_coulomb_friction(truth):
    """A term that is there, at one joint: the split between it and Coulomb friction is known badly, viscous friction well."""
    model, dahl = arm(), identify.EXTRA["dahl"]
    bare = motion(1, 600)
    log = measured(model, bare, truth, 0.5 * np.array([1, 0]) * dahl(bare, bare.tau, 0.01)[:, :, 0], 0.05)
    fit = identify.fit_robot(model, log, (*identify.TERMS, ("dahl", (0,))), **GIVEN)
    sources, base = sources_of(fit.intervals.parameters), sources_of(fit.intervals.base)
    assert sources["a_joint.coulomb"] == sources["a_joint.dahl"] == "confounded"
    assert sources["a_joint.viscous"] == sources["b_joint.coulomb"] == "data"
    assert base["a_joint.coulomb"] == "confounded" and base["b_joint.coulomb"] == "data"
    assert "confounded" not in identify.fit_robot(model, log, **PLAIN).intervals.parameters.sources


@pytest.mark.long
def test_a_joint_that_hardly_moved_has_no_friction_from_data(truth):
    """0.005 rad in 6 s: its friction and rotor are marked, a warning names it, and it gets no extra terms."""
    model, bare = arm(), motion(1, 300)
    size = np.array([1.0, 0.005 / np.ptp(bare.q[:, 1])])
    slow = identify.Log(bare.t, bare.q * size, bare.v * size, bare.a * size, bare.tau)
    assert idle_coordinates(model, [slow]) == (1,) and idle_coordinates(model, [slow, bare]) == ()
    log = measured(model, slow, truth, noise=0.05)
    with pytest.warns(identify.LogWarning, match=r"log 1: b_joint .* hardly moved"):
        fit = identify.fit_robot(model, log)
    sources, base = sources_of(fit.intervals.parameters), sources_of(fit.intervals.base)
    of_joint = [sources[f"b_joint.{term}"] for term in identify.TERMS]
    of_joint += [source for name, source in base.items() if name.startswith("b_joint.")]
    assert set(of_joint) <= {"hardly moved", "bound"}
    assert not any(1 in joints for _, joints in fit.choice.setting.extra)
    (line,) = check_log_content(model, log, ("a", "b"))
    assert line.startswith("b (0.005 rad) hardly moved: friction and rotor inertia there are not identifiable")


def test_travels_of_joints_with_several_coordinates():
    """A floating body that moves by 0.3 m and turns by 0.1 rad, by its velocity; a slide, by its position."""
    builder = jd.ModelBuilder("floating")
    builder.add_body("base", joint="free", inertia=(1.0, (0, 0, 0), np.ones(3)))
    builder.add_body("slide", "base", joint="prismatic", inertia=(1.0, (0, 0, 0), np.ones(3)))
    model = builder.build()
    t = np.linspace(0, 1, 101)
    v = np.zeros((101, 7))
    v[:, 0], v[:, 5], v[:, 6] = 0.3, 0.1, 0.001
    q = np.concatenate([np.zeros((101, 6)), np.ones((101, 1)), 0.001 * t[:, None]], axis=1)
    log = identify.Log(t, q, v, v, v)
    np.testing.assert_allclose(np.ptp(motion_paths(model, log)[0], axis=0), [0.3, 0, 0, 0, 0, 0.1, 0.001], atol=1e-12)
    assert idle_coordinates(model, [log]) == (1, 2, 3, 4, 6)


# --- what looks wrong -------------------------------------------------------------------------------------------------


def test_log_checks(truth):
    model, names = arm(), ("a", "b")
    good = measured(model, motion(1), truth)
    assert check_log_content(model, good, names) == []

    def changed(**signals):
        values = {name: getattr(good, name) for name in ("t", "q", "v", "a", "tau")} | signals
        return check_log_content(model, identify.Log(**values), names)

    (line,) = changed(tau=good.tau / 150)
    assert line.startswith("torques of a, b are about 1/") and "gear ratios" in line
    (line,) = changed(tau=1000 * good.tau)
    assert "N mm" in line
    assert any("are they in degrees" in line for line in changed(q=np.rad2deg(good.q)))
    still = changed(q=good.q * [1, 0], v=good.v * [1, 0], a=good.a * [1, 0])
    assert any(line.startswith("b (0 rad) hardly moved") for line in still)
    for signals in ({"q": good.q * [1, -1]}, {"v": np.rad2deg(good.v)}, {"t": 1000 * good.t}, {"q": good.q[:, ::-1]}):
        assert any("do not follow the velocities" in line for line in changed(**signals))
    # A wrapped angle, an offset of the velocity, and samples left out for a while are no contradiction.
    wrapped = changed(q=(good.q + np.pi) % (2 * np.pi) - np.pi, v=good.v + 0.1)
    whole = [np.delete(x, slice(100, 150), axis=0) for x in (good.t, good.q, good.v, good.a, good.tau)]
    assert wrapped == [] and check_log_content(model, identify.Log(*whole), names) == []


def test_saturated_torques_are_named():
    """In a log as it is, and before the low-pass; a coarse sensor, and a torque of zero at one side, are not."""
    log = measured(arm(), motion(1, 3000, 60.0))
    limit = np.quantile(np.abs(log.tau[:, 1]), 0.9)
    clipped = identify.Log(log.t, log.q, log.v, log.a, np.clip(log.tau, [-np.inf, -limit], [np.inf, limit]))
    (line,) = check_log_content(arm(), clipped, ("a", "b"))
    assert line.startswith("torques of b_joint stay at their largest value")
    with pytest.warns(identify.LogWarning, match="torques of 2 stay"):
        identify.from_raw(log.t, log.q, clipped.tau)
    step = np.ptp(log.tau, axis=0) / 20
    for tau in (step * np.round(log.tau / step), np.maximum(log.tau, 0)):
        assert check_saturation(identify.Log(log.t, log.q, log.v, log.a, tau)) == []


def test_fits_warn_of_torques_that_do_not_fit_of_other_units_and_of_starts_at_rest(truth):
    """By the lines of the command, with the number of the log; the rest is a second with a torque of its own."""
    model, good = arm(), measured(arm(), motion(1), truth, noise=0.01)
    given = {**PLAIN, "weights": None}
    turned = identify.Log(good.t, good.q, good.v, good.a, -good.tau)
    with pytest.warns(identify.LogWarning, match="the fit leaves most .* of a_joint, b_joint"):
        identify.fit_robot(model, turned, **given)
    scaled = identify.Log(good.t, good.q, good.v, good.a, 1000 * good.tau)
    with pytest.warns(identify.LogWarning) as found:
        identify.fit_robot(model, [good, scaled], **given)
    (line,) = [str(one.message) for one in found if "N mm" in str(one.message)]
    assert line.startswith("log 2: torques of a_joint, b_joint are about ")
    held = [np.concatenate([np.full((50, 2), row), x]) for row, x in ((good.q[0], good.q), (0, good.v), (0, good.a))]
    tau = np.concatenate([good.tau[:1] + np.array([[0.0, 3.0]]) * np.ones((50, 1)), good.tau])
    still = identify.Log(np.arange(350) * good.t[1], *held, tau)
    with pytest.warns(identify.LogWarning, match="log 1: ._joint stands still for the first 1 s"):
        identify.fit_robot(model, still, **given)


def test_an_error_at_rest_is_named():
    """A joint that is held by friction for a second before it moves, with an error there; another without."""
    t = np.linspace(0, 5, 501)
    v = np.where(t > 1, np.sin(t - 1), 0)[:, None] * [1, 1]
    residual = np.where(t < 0.9, 10.0, 0.5)[:, None] * [1, 0] + 0.1
    log = identify.Log(t, v, v, v, v)
    (line,) = check_rest(log, residual, ("a", "b"))
    assert line.startswith("a stands still for the first 1 s") and "friction at rest" in line
    assert check_rest(log, 0 * residual, "ab") == check_rest(identify.Log(t, v, 0 * v, v, v), residual, "ab") == []


def test_vibration_is_told_from_friction():
    """A residual at the motion's own frequencies is none; one at 15 Hz is, and the edge is ten times the motion's band."""
    t = np.linspace(0, 10, 2001)[:, None]
    w = 2 * np.pi
    log = identify.Log(t[:, 0], np.sin(w * t), w * np.cos(w * t), -(w**2) * np.sin(w * t), t)
    slow, fast = np.sin(4 * np.pi * t), np.sin(30 * np.pi * t)
    assert motion_band(log) == pytest.approx(1.0, abs=0.21)  # the window's width is two tenths of a hertz
    share, edge = vibration(log, slow + fast)
    assert share == pytest.approx(0.5, abs=1e-3) and edge == 10 * motion_band(log)
    assert vibration(log, slow)[0] < 1e-6
    still = identify.Log(t[:, 0], 0 * t, 0 * t, 0 * t, t)
    assert motion_band(still) == 0.0 and vibration(still, fast) == (0.0, 0.0)


# --- payloads ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_payload_is_what_loaded_logs_differ_by(truth):
    """A wrong nominal robot, friction and noise: mass, centre and inertia come back within their intervals."""
    model, nominal = arm(), arm(0.2, 3)
    unloaded = [measured(model, motion(seed), truth, noise=0.02, seed=seed) for seed in (1, 2)]
    loaded = measured(model, motion(3), with_payload(truth), noise=0.02, seed=3)
    fit = identify.fit_payload(nominal, unloaded, loaded, **PLAIN)
    assert fit.body == "b" and fit.error < 0.5 * fit.without
    # A planar arm shows m x, m z and the inertia about its axis alone, and not the mass without them.
    seen = [1, 3, 6]
    off = np.abs(fit.inertia - PAYLOAD)[seen]
    assert np.all(off <= fit.factor * fit.std[seen] + 1e-3) and off.max() < 0.03
    assert inertia.is_feasible(fit.inertia)
    with pytest.raises(ValueError, match="body is 'hand'"):
        identify.fit_payload(nominal, unloaded, loaded, "hand")


# --- outliers ---------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_robust_loss_is_bent_less_by_torques_that_no_robot_makes(truth):
    """Bursts at one joint: Huber's fit is nearer to the truth, and is what cross-validation takes; weights are closed forms."""
    model = arm()
    burst = np.zeros((300, 2))
    burst[40:55, 1] = burst[180:190, 1] = 4.0
    log = measured(model, motion(1), truth, burst, 0.05)

    def fit(log, robust):
        return identify.fit_robot(model, log, **{**PLAIN, "robust": robust})

    fits = [fit(log, robust).intervals for robust in (None, 1.345)]
    off = [np.linalg.norm(f.base.values - f.combinations.values(truth)) for f in fits]
    assert off[1] < 0.5 * off[0]
    chosen = fit([log, measured(model, motion(2), truth, 0, 0.05)], "auto")
    # Losses are compared by errors of their own; squares and the loss that is taken are among the trials.
    loss = chosen.choice.setting.robust
    assert loss in (1.345, 3.0) and {trial.setting.robust for trial in chosen.choice.trials} == {None, loss}
    errors = [np.array([[0.5], [-1.0], [1.0], [4.0], [0.0]])]
    (weights,) = huber_weights(errors, 2.0)  # the median size is 1
    np.testing.assert_allclose(weights[:, 0], np.sqrt([1, 1, 1, 2 * 1.4826 / 4, 1]), rtol=1e-12)
    np.testing.assert_array_equal(huber_weights([np.zeros((3, 1))], 1.0)[0], 1.0)
    for bad in (0.0, "huber"):
        with pytest.raises(ValueError, match="robust is"):
            fit(log, bad)


# --- what logs tell ---------------------------------------------------------------------------------------------------


def test_identifiability_in_words(truth):
    """Rank and condition are those of the stacked regressor; a log at constant speed of one joint is said to tell less."""
    model = arm()
    log = measured(model, motion(1), truth)
    told = identify.identifiability(model, log)
    W = identify.regressor(model, log.q, log.v, log.a).reshape(600, -1)[:, told.base.independent]
    s = np.linalg.svd(W / np.linalg.norm(W, axis=0), compute_uv=False)
    assert told.rank == len(told.base) == len(s) and told.condition == pytest.approx(s[0] / s[-1], rel=1e-8)
    assert [d.strength for d in told.weakest] == pytest.approx((s[::-1] / s[0])[:3], rel=1e-6)
    assert "a.Ixx" in told.unidentifiable and "unidentifiable on any motion" in told.summary()
    held = identify.Log(log.t, log.q * [1, 0], log.v * [1, 0], log.a * [1, 0], log.tau)
    told = identify.identifiability(model, held)
    assert {"b_joint.viscous", "b_joint.coulomb", "b_joint.armature"} <= set(told.silent)
    assert told.rank < len(told.base) and "not excited by these logs" in told.summary()
    assert told.weakest[0].strength == 0


def test_whiteness_of_known_noise():
    """White noise is worth its samples; a first-order process with factor r lasts dt (1 + r) / (1 - r)."""
    n, r = 40000, 0.9
    noise = np.random.default_rng(0).normal(size=n)
    slow = np.zeros(n)
    for i in range(1, n):
        slow[i] = r * slow[i - 1] + noise[i]
    t = 0.01 * np.arange(n)
    x = np.stack([noise, slow, np.zeros(n)], axis=1)
    log = identify.Log(t, x, tau=x)
    computed = identify.whiteness(log, x)
    # The sum of the correlation up to its first zero has a standard error of some per cent.
    assert computed.correlation_time[0] == pytest.approx(0.01, rel=0.1)
    assert computed.effective_samples[0] == pytest.approx(n, rel=0.1)
    assert computed.correlation_time[1] == pytest.approx(0.19, rel=0.15)
    assert computed.correlation_time[2] == pytest.approx(0.01)
    constant = identify.whiteness(log, np.stack([noise, np.full(n, 0.3), np.full(n, 1e-9)], axis=1))
    np.testing.assert_allclose(constant.effective_samples[1:], 1.0)
    for wrong in (np.nan, np.inf):
        x[7, 1] = wrong
        with pytest.raises(ValueError, match=f"residual is {wrong} in row 7, column 1"):
            identify.whiteness(log, x)
    with pytest.raises(ValueError, match=r"residual has shape \(3, 1\)"):
        identify.whiteness(log, np.zeros((3, 1)))


# --- excitation -------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_exciting_motion_tells_more_within_its_limits():
    """Rest at both ends, all limits kept on a fine grid, torques by inverse dynamics; better condition than where it began."""
    model = arm().replace(lower=np.array([-1.0, -0.5]), upper=np.array([1.0, 2.0]), velocity_limit=np.array([2.0, 3.0]))
    model = model.replace(effort_limit=np.array([25.0, 9.0]))
    computed = identify.exciting_motion(model, period=4.0, harmonics=3, steps=60, starts=2)
    assert computed.condition < 0.9 * computed.start_condition and computed.logdet > 1
    assert max(computed.used.values()) <= 1 and computed.history[-1] < computed.history[0]
    log = computed.log(rate=250.0, periods=2)
    assert len(log) == 2001 and log.joint_names == model.joint_names
    middle, half = np.array([0.0, 0.75]), 0.9 * np.array([1.0, 1.25])
    assert np.all(np.abs(log.q - middle) <= half * (1 + 1e-3))  # peaks may lie between the samples that were looked at
    assert np.all(np.abs(log.v) <= 0.9 * np.array([2.0, 3.0]) * (1 + 1e-3))
    assert np.all(np.abs(log.tau) <= 0.9 * np.array([25.0, 9.0]) * (1 + 1e-3))
    np.testing.assert_allclose(log.v[[0, 1000, 2000]], 0, atol=1e-12)
    np.testing.assert_allclose(log.q[:1000], log.q[1000:2000], atol=1e-10)
    told = identify.identifiability(model, measured(model, log), v_s=0.1)
    assert told.rank == len(told.base) and told.condition == pytest.approx(computed.condition, rel=0.15)
    tau = identify.regressor(model, log.q, log.v, log.a)[:, :, :20] @ np.asarray(model.inertias).reshape(-1)
    np.testing.assert_allclose(log.tau, tau, atol=1e-10)
    for own, sampled in zip(computed.motion(log.t[77]), (log.q, log.v, log.a), strict=True):
        np.testing.assert_allclose(own, sampled[77], atol=1e-12)


@pytest.mark.slow
def test_exciting_motion_of_the_best_condition():
    model = arm().replace(effort_limit=np.array([25.0, 9.0]))
    computed = identify.exciting_motion(model, period=4.0, harmonics=3, objective="condition", steps=60, starts=2)
    assert computed.condition < computed.start_condition


def test_exciting_motion_says_no():
    model = arm()
    for words, arguments in (
        ("objective is 'trace'", {"objective": "trace"}),
        ("harmonics is 1; give at least 2", {"harmonics": 1}),
        ("margin is 1.5; give a share", {"margin": 1.5}),
        ("velocity has limits", {"velocity": [0.0, 1.0]}),
    ):
        with pytest.raises(ValueError, match=words):
            identify.exciting_motion(model, **arguments)
    lying = jd.ModelBuilder("lying").add_body("a", axis=(0, 1, 0), inertia=(1.0, (0.5, 0, 0), (0.1, 0.1, 0.1))).build()
    with pytest.raises(ValueError, match="holding the robot at the middle of its ranges needs"):
        identify.exciting_motion(lying, torque=1.0, steps=1)
