"""Keywords of fits that no other test passes, each by its effect."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from test_identify_robot import arm, measured, motion

import jaxdyn as jd
from jaxdyn import identify, inertia
from jaxdyn.identify.regression import free_columns


@pytest.fixture(scope="module")
def truth():
    """Parameters of the arm with friction and rotors."""
    x = identify.nominal_parameters(arm())
    x[20:] = [0.3, 0.2, 0.4, 0.3, 0.1, -0.2, 0.05, 0.02]
    return x


def test_keywords_of_least_squares(truth):
    """Weights are those of rows, `rcond` counts singular values, and groups of blocks give Student's degrees of freedom."""
    model, log = arm(), measured(arm(), motion(1), truth, noise=0.1)
    weights = np.array([1.0, 5.0])
    fit = identify.least_squares(model, log, v_s=0.02, weights=weights, blocks=8)
    base = identify.base_parameters(model, identify.TERMS, v_s=0.02)
    W = identify.regressor(model, log.q, log.v, log.a, v_s=0.02)[:, :, free_columns(2, 2, identify.TERMS)]
    rows = (weights[None, :, None] * W[:, :, base.independent]).reshape(-1, len(base))
    x, *_ = np.linalg.lstsq(rows, (weights * log.tau).reshape(-1), rcond=None)
    np.testing.assert_allclose(fit.values, x, rtol=1e-8)
    # At least two blocks form a group: two groups of four blocks.
    few, many = (identify.least_squares(model, log, v_s=0.02, blocks=n) for n in (4, 20))
    assert few.factor == pytest.approx(scipy.stats.t.ppf(0.975, 1), rel=1e-6) and many.factor < few.factor
    np.testing.assert_allclose(few.values, many.values, rtol=1e-8)
    ranks = [identify.least_squares(model, log, v_s=0.02, weights=weights, rcond=r).rank for r in (1e-6, 0.999)]
    assert ranks[0] == len(base) and ranks[1] < len(base)


def test_keywords_of_identifiability(truth):
    """As many weak directions as asked for, ranks by singular values of unit columns, and only the terms given."""
    model, log = arm(), measured(arm(), motion(1), truth)
    base = identify.base_parameters(model, ("viscous",), v_s=0.02)
    W = identify.regressor(model, log.q, log.v, log.a, v_s=0.02)[:, :, free_columns(2, 2, ("viscous",))]
    rows = W[:, :, base.independent].reshape(-1, len(base))
    s = np.linalg.svd(rows / np.linalg.norm(rows, axis=0), compute_uv=False)
    found = identify.identifiability(model, log, terms=("viscous",), v_s=0.02, count=2)
    assert len(found.weakest) == 2 and not any("coulomb" in name for name in found.base.names)
    np.testing.assert_allclose([one.strength for one in found.weakest], s[::-1][:2] / s[0], rtol=1e-8)
    between = np.sqrt(s[-1] * s[-2]) / s[0]
    assert identify.identifiability(model, log, terms=("viscous",), v_s=0.02, rcond=between).rank == len(base) - 1


def test_order_of_the_filter_of_raw_logs():
    """SciPy's Butterworth filter of this order, forwards and backwards."""
    t = np.linspace(0, 4, 801)
    q = np.sin(3 * t) + 0.1 * np.sin(60 * t)
    for order in (1, 2, 4):
        log = identify.from_raw(t, q[:, None], q[:, None], cutoff=6.0, order=order, trim=50, every=2, outliers="keep")
        low = scipy.signal.filtfilt(*scipy.signal.butter(order, 6.0 / 100.0), q, padlen=100)
        np.testing.assert_allclose(log.q[:, 0], low[50:-50:2], rtol=0, atol=1e-10)


@pytest.mark.long
def test_keywords_of_robot_fits(truth):
    """Bodies that change their density alone; blocks of the jackknife."""
    nominal, log = arm(0.2, 3), measured(arm(), motion(1), truth, noise=0.05)
    given = {"terms": identify.TERMS, "v_s": 0.01, "prior": 1.0, "robust": None, "weights": None}
    density = identify.fit_robot(nominal, log, inertia="mass", **given).fit.model.inertias
    ratio = np.asarray(density / nominal.inertias)
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[:, :1], ratio.shape), rtol=1e-8)
    assert np.abs(ratio[:, 0] - 1).min() > 1e-3
    fits = [identify.fit_robot(nominal, log, blocks=n, **given) for n in (4, 12)]
    np.testing.assert_allclose(fits[0].fit.model.inertias, fits[1].fit.model.inertias, rtol=1e-10)
    assert fits[0].intervals.factor > fits[1].intervals.factor


@pytest.mark.long
def test_keywords_of_drive_gains():
    """A payload on the first body; logs without friction and rotors; blocks of the jackknife."""
    model, held = arm(), np.asarray(inertia.inertial_parameters(0.9, np.array([0.3, 0.0, -0.4]), np.zeros((3, 3))))
    gains, logs = np.array([1.3, 0.8]), []
    for seed, holds in ((1, 0.0), (2, 1.0)):
        bare, x = motion(seed), identify.nominal_parameters(model)
        x[20:] = 0
        x[:10] += holds * held
        log = measured(model, bare, x, noise=1e-3, seed=seed)
        logs.append(identify.Log(log.t, log.q, log.v, log.a, log.tau / gains))

    def fit(body="a", terms=(), blocks=20):
        known = {"inertia": np.zeros((3, 3)), "v_s": 0.01}
        return identify.fit_gains(model, *logs, 0.9, (0.3, 0.0, -0.4), body=body, terms=terms, blocks=blocks, **known)

    found = fit()
    np.testing.assert_allclose(found.gains, gains, atol=4 * found.std.max())
    # On the other body the payload explains the difference of the logs worse.
    try:
        assert fit(body="b").error > 2 * found.error
    except ValueError as error:
        assert "on b identifies the gain of no joint" in str(error)
    few, many = fit(blocks=4), fit(blocks=12)
    assert few.factor > many.factor
    np.testing.assert_allclose(few.gains, many.gains, rtol=1e-8)
    # Terms that are not there cost accuracy.
    assert (fit(terms=identify.TERMS).std > found.std).all()


@pytest.mark.long
def test_replays_of_a_cart():
    """A mass under torques that are held or linear between the samples, with viscous friction, in segments: closed forms."""
    mass, b = 2.0, 0.5
    builder = jd.ModelBuilder("cart", gravity=None)
    builder.add_body("cart", None, "prismatic", (mass, (0, 0, 0), (0.1, 0.1, 0.1)), axis=(1, 0, 0))
    model, t, force = builder.build(), np.linspace(0, 2, 5), np.array([1.0, -1.0, 3.0, 0.0, 0.0])
    blank = np.zeros((5, 1))
    log = identify.Log(t, blank, blank, None, force[:, None])
    h = t[1]
    tight = {"rtol": 1e-11, "atol": 1e-11}
    _, v = identify.rollout(model, log, hold="previous", **tight)
    np.testing.assert_allclose(v[0, :, 0], np.append(0, np.cumsum(force[:-1])) * h / mass, atol=1e-9)
    _, v = identify.rollout(model, log, hold="linear", **tight)
    np.testing.assert_allclose(v[0, :, 0], np.append(0, np.cumsum(force[:-1] + force[1:])) * h / 2 / mass, atol=1e-9)
    # Two segments of two steps: the second starts from the measured rest.
    _, v = identify.rollout(model, log, horizon=2, hold="previous", **tight)
    np.testing.assert_allclose(v[:, :, 0], [[0, 0.25, 0.0], [0, 0.75, 0.75]], atol=1e-9)
    friction = identify.Friction(jnp.array([b]), *jnp.zeros((2, 1)), jnp.asarray(0.01))
    rest, wanted = np.exp(-b * h / mass), [0.0]
    for f in force[:-1]:
        wanted.append(wanted[-1] * rest + f / b * (1 - rest))
    _, v = identify.rollout(model, log, friction, hold="previous", **tight)
    np.testing.assert_allclose(v[0, :, 0], wanted, atol=1e-9)
    exact = identify.Log(t, np.zeros((5, 1)), np.array(wanted)[:, None], None, force[:, None])
    errors = [
        identify.trajectory_error(model, exact, friction=one, hold=hold, **tight)[1]
        for one, hold in ((friction, "previous"), (None, "previous"), (friction, "linear"))
    ]
    assert errors[0] < 1e-6 and min(errors[1:]) > 1


@pytest.mark.long
def test_keywords_of_exciting_motions():
    """Limits with their margin, the columns of the terms at v_s, random starts, the rate of the search, and its end."""
    model = arm()
    few = {"starts": 2, "steps": 12, "period": 4.0, "harmonics": 2}

    def condition(excitation, terms, v_s):
        q, v, a, _ = (np.asarray(x) for x in (lambda log: (log.q, log.v, log.a, log.tau))(excitation.log(25.0)))
        base = identify.base_parameters(model, terms)
        columns = free_columns(2, 2, terms)[base.independent]
        W = identify.regressor(model, q[:-1], v[:-1], a[:-1], v_s=v_s)[:, :, columns].reshape(-1, len(base))
        s = np.linalg.svd(W / np.linalg.norm(W, axis=0), compute_uv=False)
        return s[0] / s[-1]

    found = identify.exciting_motion(model, margin=0.5, velocity=np.array([1.0, 2.0]), **few)
    log = found.log(500.0)
    assert (np.abs(log.v).max(axis=0) <= 0.5 * np.array([1.0, 2.0]) * (1 + 1e-3)).all()
    assert np.abs(log.q).max() <= 0.5 * np.pi * (1 + 1e-3) and max(found.used.values()) <= 1
    assert found.result is jd.RESULTS.max_steps_reached
    # The search samples its period at 100 places, as the log at 25 Hz does.
    assert condition(found, identify.TERMS, 0.1) == pytest.approx(found.condition, rel=1e-6)
    other = identify.exciting_motion(model, terms=("viscous",), v_s=1.0, **few)
    assert condition(other, ("viscous",), 1.0) == pytest.approx(other.condition, rel=1e-6)
    # Below zero, where a sum of squares would have ended, the logarithm goes on.
    assert len(other.history) == 13 and other.history[-1] < 0 and other.logdet > 0
    third = identify.exciting_motion(model, v_s=1.0, **few)
    assert condition(third, identify.TERMS, 1.0) == pytest.approx(third.condition, rel=1e-6)
    still = identify.exciting_motion(model, learning_rate=0.0, **few)
    assert still.condition == pytest.approx(still.start_condition, rel=1e-6) and np.ptp(still.history) < 1e-12
    again = identify.exciting_motion(model, learning_rate=0.0, seed=5, **few)
    assert abs(again.condition / still.condition - 1) > 1e-3
    steps = []
    ended = identify.exciting_motion(model, callback=lambda step, loss: steps.append(loss) or step == 3, **few)
    assert ended.result is jd.RESULTS.stopped and len(ended.history) == 4
    np.testing.assert_array_equal(steps, ended.history)


@pytest.mark.parametrize("transform", [jax.jit, jax.vmap, jax.grad])
@pytest.mark.parametrize(
    ("name", "argument", "call"),
    [
        ("fit_torques", "log", lambda model, log, x: identify.fit_torques(model, measured_at(log, x))),
        ("fit_robot", "model", lambda model, log, x: identify.fit_robot(model.replace(gravity=x[0, :3]), log)),
        ("fit_parameters", "log", lambda model, log, x: identify.fit_parameters(model, measured_at(log, x))),
        ("fit_payload", "loaded", lambda model, log, x: identify.fit_payload(model, log, measured_at(log, x))),
        ("fit_geometry", "q", lambda model, log, x: identify.fit_geometry(model, x, np.eye(4)[None], frame="b")),
        ("least_squares", "log", lambda model, log, x: identify.least_squares(model, measured_at(log, x))),
        ("from_raw", "tau", lambda model, log, x: identify.from_raw(log.t, log.q, x)),
        ("exciting_motion", "system", lambda model, log, x: identify.exciting_motion(model.replace(gravity=x[0, :3]), ())),
        ("save_urdf", "model", lambda model, log, x: jd.save_urdf(model.replace(gravity=x[0, :3]), "never.urdf")),
    ],
)  # fmt: skip
def test_fits_are_refused_within_transformations(name, argument, call, transform):
    """They compute with NumPy: JAX's error on a conversion of arrays did not say so."""
    model, log = arm(), motion(1, n=20)
    with pytest.raises(ValueError, match=f"{argument} of {name} is traced"):
        transform(lambda x: call(model, log, x))(jnp.ones((1, 20, 4) if transform is jax.vmap else (20, 4)))


def measured_at(log, tau):
    """The log with these torques."""
    return identify.Log(log.t, log.q, log.v, log.a, tau[:, :2])
