"""Fits that are stopped: checkpoints after a kill, of other problems and half written; early stops, progress, NaN."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.identify import descent

_SCRIPT = """
import sys, time, jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[2])
from tests.identify.test_long_fits import fitted
fitted(sys.argv[1], method=sys.argv[3], callback=lambda step, loss, system: time.sleep(0.2))
"""


def sine(q, t, p):
    """Of amplitude, rate and phase: many local minima."""
    return p["size"] * jnp.sin(p["rate"] * t + p["phase"])[None]


def mass(q, t, p):
    return jnp.ones((1, 1), q.dtype)


def push(q, v, t, p):
    return -sine(q, t, p)


def system(size=1.0, rate=3.0, phase=0.3):
    parameters = {"size": size, "rate": rate, "phase": phase}
    return jd.ExplicitSystem(mass, push, 1, parameters=parameters)


def recorded(count=60):
    t = np.linspace(0.0, 4.0, count)
    a = np.sin(3.0 * t + 0.3)[:, None] + 0.01 * np.random.default_rng(0).normal(size=(count, 1))
    return jd.identify.Log(t, 0 * a, 0 * a, a, 0 * a + 1e-3)


def pick(system):
    return list(system.parameters.values())


def fitted(path=None, *, method="adam", start=(0.5, 2.9, 0.0), steps=40, **options):
    """Forty steps of a fit that does not converge before."""
    return jd.identify.fit_parameters(
        system(*start),
        recorded(),
        objective=jd.identify.Objective("torque"),
        solver=jd.identify.Solver(method=method, steps=steps, tolerance=0.0),
        execution=jd.identify.Execution(checkpoint=path, **({"every": 1} | options)),
        free=pick,
    )


# Gauss-Newton steps end after six points.
@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "least", "points"), [("adam", 5, 41), pytest.param("gauss-newton", 3, 6, marks=pytest.mark.slow)]
)
def test_a_killed_fit_resumes_to_the_same_numbers(tmp_path, method, least, points):
    path, root = tmp_path / "fit.ckpt", str(Path(__file__).parents[2])
    run = subprocess.Popen(
        [sys.executable, "-c", _SCRIPT, str(path), root, method], env=os.environ | {"PYTHONPATH": root}
    )
    try:
        until = time.monotonic() + 300
        while not path.exists() or len(descent.read(path)) == 0 or _steps(path) < least:
            assert run.poll() is None and time.monotonic() < until
            time.sleep(0.02)
    finally:
        run.send_signal(signal.SIGKILL)
        run.wait()
    begun = _steps(path)
    seen = []
    resumed = fitted(path, method=method, callback=lambda step, *_: seen.append(step))
    whole = fitted(None, method=method)
    assert least <= begun < points and seen[0] in (begun - 1, begun) and len(resumed.history) == points
    np.testing.assert_array_equal(resumed.history, whole.history)
    np.testing.assert_array_equal(resumed.values, whole.values)


def _steps(path):
    return len(descent.read(path)["history"])


@pytest.mark.long
@pytest.mark.parametrize("method", ["gauss-newton", "levenberg-marquardt", "lbfgs"])
def test_a_stopped_fit_resumes_to_the_same_numbers(tmp_path, method):
    path = tmp_path / "fit.ckpt"
    start = dict(method=method, start=(0.2, 2.6, 0.9), steps=12)
    part = fitted(path, callback=lambda step, *_: step == 3, **start)
    assert part.result == jd.RESULTS.stopped and len(part.history) == 4
    resumed, whole = fitted(path, **start), fitted(None, **start)
    np.testing.assert_array_equal(resumed.history, whole.history)
    np.testing.assert_array_equal(resumed.values, whole.values)
    assert resumed.result == whole.result


def test_checkpoints_of_others_and_halves_are_refused(tmp_path):
    path = tmp_path / "fit.ckpt"
    quick = dict(method="gauss-newton", steps=2)
    fitted(path, **quick)
    for other in (dict(start=(0.5, 2.8, 0.0)), dict(method="lbfgs")):
        with pytest.raises(ValueError, match="is of another problem"):
            fitted(path, **(quick | other))
    whole = path.read_bytes()
    for half in (whole[: len(whole) // 2], whole[:-1], whole[:-1] + b"x", b"", b"{}\n"):
        path.write_bytes(half)
        with pytest.raises(ValueError, match="is no complete checkpoint"):
            fitted(path, **quick)
    assert len(fitted(path, resume=False, **quick).history) == 3
    assert [p.name for p in tmp_path.iterdir()] == ["fit.ckpt"]
    with pytest.raises(ValueError, match="every is 0"):
        fitted(path, every=0, **{"method": "gauss-newton", "steps": 2})


def test_a_write_that_fails_leaves_the_checkpoint_before(tmp_path, monkeypatch):
    path = tmp_path / "fit.ckpt"
    descent.write(path, "p", {"y": np.ones(3)})
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        descent.write(path, "p", {"y": np.zeros(3)})
    assert descent.read(path)["y"].shape == (3,) and len(list(tmp_path.iterdir())) == 1


@pytest.mark.long
def test_solvers_agree_and_progress_is_shown(capsys):
    """The optimum of least squares in the linear case, to 1e-6, by every solver."""
    log, linear = recorded(), lambda system: [system.parameters["size"]]
    rows = np.sin(3.0 * log.t + 0.3)
    want = rows @ (log.a + log.tau * -1)[:, 0] / (rows @ rows)
    for method in ("gauss-newton", "levenberg-marquardt", "dogleg", "lbfgs"):
        fit = jd.identify.fit_parameters(
            system(size=0.4),
            log,
            objective=jd.identify.Objective("torque"),
            solver=jd.identify.Solver(method=method, tolerance=1e-12),
            execution=jd.identify.Execution(progress=True),
            free=linear,
        )
        np.testing.assert_allclose(fit.values, [want], rtol=1e-6)
        assert fit.result == jd.RESULTS.successful
        np.testing.assert_allclose(fit.history[-1], fit.history.min(), rtol=1e-12)
    assert "step 0 of at most 200: loss" in capsys.readouterr().err


@pytest.mark.long
def test_many_starts_reach_what_one_does_not():
    far = system(size=0.5, rate=7.0)
    options = dict(free=pick, objective=jd.identify.Objective("torque"))
    alone = jd.identify.fit_parameters(far, recorded(), solver=jd.identify.Solver(steps=50), **options)
    solver = jd.identify.Solver(steps=50, starts=128, spread=1.0)
    many = jd.identify.fit_parameters(far, recorded(), solver=solver, **options)
    assert many.history[-1] < 1e-2 * alone.history[-1]
    computed = many.system.parameters
    np.testing.assert_allclose([abs(computed["size"]), abs(computed["rate"])], [1.0, 3.0], rtol=0.02)


def root_push(q, v, t, p):
    return jnp.sqrt(p["square"]) * jnp.where(t > 2.0, jnp.sqrt(1.0 - p["late"]), 1.0)[None] * jnp.ones_like(q)


@pytest.mark.long
def test_a_nan_names_its_log_sample_and_parameter():
    log = recorded()
    early = jd.identify.Log(log.t / 3, log.q, log.v, log.a, log.tau)
    bad = jd.ExplicitSystem(mass, root_push, 1, parameters={"square": 1.0, "late": 2.0})
    fit = jd.identify.fit_parameters(bad, [early, log], objective=jd.identify.Objective("torque"), free=pick)
    assert fit.result == jd.RESULTS.nonfinite and fit.cause is not None
    first = int(np.argmax(log.t > 2.0))
    assert f"errors of log 2 are not finite from sample {first} on" in fit.cause
    # A step that led there, by gradient descent: the parameter that did it is named.
    start = jd.ExplicitSystem(mass, root_push, 1, parameters={"square": 0.3, "late": 0.9})
    steep = jd.identify.fit_parameters(
        start,
        log,
        objective=jd.identify.Objective("torque"),
        solver=jd.identify.Solver(method="adam", learning_rate=0.9, steps=20),
        free=pick,
    )
    assert steep.result == jd.RESULTS.nonfinite and "; finite with parameters['late'] where it started" in str(
        steep.cause
    )
    assert np.isfinite(steep.values).all() and float(steep.system.parameters["late"]) < 1
