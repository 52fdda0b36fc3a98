"""Reverse mode through adaptive steps takes the steps of the forward run, whatever controls them."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from motion_helpers import within

import jaxdyn as jd
from jaxdyn.simulation.solvers import diffrax_loop
from jaxdyn.simulation.solvers.base import Adaptive

TS = np.linspace(0.0, 6.0, 5)


def lorenz(t, y, args):
    """The chaotic system: over 6 s a difference grows two hundredfold, so other steps would show."""
    x = y["x"]
    rate = jnp.stack([10 * (x[1] - x[0]), x[0] * (args - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]])
    return {"x": rate + 5.0 * jnp.where(t < 2.5, 0.0, 1.0) * jnp.asarray([1.0, 0.0, 0.0])}


def control(kind, ts, tolerance=1e-9):
    adaptive = Adaptive(tolerance, tolerance, optimistix.rms_norm, 1e-12)
    if kind == "own":
        return adaptive
    if kind == "save points":
        return diffrax.ClipStepSizeController(adaptive, step_ts=ts)
    return diffrax.ClipStepSizeController(
        diffrax.PIDController(tolerance, tolerance, pcoeff=0.4), jump_ts=jnp.asarray([2.5])
    )


def options(kind, solver, ts, **changes):
    controller, adjoint = control(kind, jax.lax.stop_gradient(ts)), diffrax.RecursiveCheckpointAdjoint()
    term, meter = diffrax.ODETerm(lorenz), diffrax.NoProgressMeter()
    return diffrax_loop.DiffraxRun(term, solver, controller, None, adjoint, 4096, meter, None)._replace(**changes)


def moving(x, r, ts):
    return {"x": x}, r, ts


WEIGHTS = np.sin(np.arange(12.0)).reshape(4, 3)
START = jnp.asarray([1.0, 2.0, 20.0]), jnp.asarray(28.0), jnp.asarray(TS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "solver"),
    [
        pytest.param("own", diffrax.Tsit5(), marks=pytest.mark.slow),
        pytest.param("save points", diffrax.Tsit5(), marks=pytest.mark.slow),
        ("jump", diffrax.Dopri5()),
    ],
    ids=["own", "save points", "jump"],
)
def test_reverse_mode_takes_the_steps_of_the_forward_run(kind, solver):
    """Reverse mode of a chaotic motion, "direct", and forward mode over the very steps that were written down.

    Only the rounding of the sums is between them, over motions that magnify it two hundredfold. Derivatives by the save
    points are those of the dense output and, where steps end on them, of the steps' ends.
    """

    def total(x, r, ts, adjoint):
        how = options(kind, solver, ts, adjoint=adjoint)
        rows, facts = diffrax_loop.run_adaptively(moving(x, r, ts), how, True)
        return jnp.sum(WEIGHTS * rows["x"]), facts[:2]

    def repeated(x, r, ts):
        how = options(kind, solver, ts)
        fixed = jax.lax.stop_gradient((x, r, ts))
        _, facts, taken = diffrax_loop._record(moving(*fixed), how, 4096)
        again = diffrax_loop._repeat(how, taken, facts[2])._replace(adjoint=diffrax.ForwardMode())
        return jnp.sum(WEIGHTS * diffrax_loop.run(moving(x, r, ts), again)[0]["x"])

    @jax.jit
    def both(x, r, ts):
        reverse, (result, stats) = jax.grad(total, (0, 1, 2), has_aux=True)(
            x, r, ts, diffrax.RecursiveCheckpointAdjoint()
        )
        return reverse, jax.jacfwd(repeated, (0, 1, 2))(x, r, ts), result == diffrax.RESULTS.successful, stats

    reverse, forward, fine, stats = both(*START)
    assert fine and stats["num_accepted_steps"] > 150
    for mine, theirs in zip(reverse, forward, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-10 * np.abs(theirs).max())
    # Differences of the run itself, as good as its tolerance after the growth of errors allows.
    step = 1e-3
    values = [total(START[0], START[1] + s * step, START[2], diffrax.ForwardMode())[0] for s in (1, -1)]
    np.testing.assert_allclose(reverse[1], (values[0] - values[1]) / (2 * step), rtol=5e-3)
    if kind == "own":
        direct = jax.jit(jax.grad(lambda r: total(START[0], r, START[2], diffrax.DirectAdjoint())[0]))(START[1])
        np.testing.assert_allclose(direct, reverse[1], rtol=1e-5)  # a run of its own


@pytest.mark.slow
def test_room_for_steps(monkeypatch):
    """Where no limit is given, reverse mode has one of its own, and beyond it the run says so."""
    monkeypatch.setattr(diffrax_loop, "ROOM", 64)

    def end(r, ts, given):
        how = options("own", diffrax.Tsit5(), ts)
        rows, (result, stats, reached) = diffrax_loop.run_adaptively(moving(START[0], r, ts), how, given)
        return rows["x"][-1, 0], (rows["x"], result, stats, reached)

    @jax.jit
    @jax.vmap
    def several(t):
        ts, r = t * START[2], START[1]
        plain = end(r, ts, False)[1]
        slope, limited = jax.grad(end, has_aux=True)(r, ts, False)
        wide, free = jax.grad(end, has_aux=True)(r, ts, True)
        return plain, limited, free, slope, wide

    plain, limited, free, slope, wide = several(jnp.asarray([0.02, 1.0]))
    codes = diffrax.RESULTS
    np.testing.assert_array_equal(plain[1] == codes.successful, [True, True])
    np.testing.assert_array_equal(free[1] == codes.successful, [True, True])
    np.testing.assert_array_equal(limited[1] == codes.successful, [True, False])
    np.testing.assert_array_equal(limited[1] == codes.max_steps_reached, [False, True])
    assert free[2]["num_accepted_steps"][1] > 64 and plain[2]["num_steps"][1] == free[2]["num_steps"][1]
    assert limited[2]["num_steps"][1] == 64 and limited[3][1] < TS[-1]
    assert not np.isfinite(limited[0][1, -1]).any() and np.isfinite(limited[0][0]).all()
    assert slope[0] == wide[0] and np.isfinite(wide[1])
    np.testing.assert_array_equal(plain[0], free[0])


@pytest.mark.long
@pytest.mark.parametrize("case", [pytest.param("no step", marks=pytest.mark.slow), "one step"])
def test_runs_that_end_early(case):
    """No step kept, as the rates after the start are no numbers, or one: codes, and derivatives of what was reached."""

    def rates(t, y, r):
        return jax.tree.map(lambda f: f * jnp.where((t > 0) & (case == "no step"), jnp.nan, 1.0), lorenz(t, y, r))

    def total(r):
        ts = jnp.asarray([0.0, 1e-6, 6.0])
        how = options("own", diffrax.Tsit5(), ts, max_steps=1 if case == "one step" else 8, term=diffrax.ODETerm(rates))
        rows, (result, stats, _) = diffrax_loop.run_adaptively(moving(START[0], r, ts), how, True)
        return jnp.sum(jnp.where(jnp.isfinite(rows["x"]), rows["x"], 0.0)), (result, stats)

    slope, (result, stats) = jax.jit(jax.grad(total, has_aux=True))(START[1])
    assert result != diffrax.RESULTS.successful
    assert stats["num_accepted_steps"] == int(case == "one step")
    # At 1e-6 s, x_1 has changed by 1e-6 x_0 r.
    np.testing.assert_allclose(slope, 1e-6 if case == "one step" else 0.0, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"stepsize": within(1e-10)},
        {"stepsize": 5e-3},
        {"stepsize": jd.simulation.Steps(5e-3, max_steps=256), "adjoint": "direct"},
    ],
    ids=["adaptive", "fixed", "direct"],
)
def test_hessian_of_a_motion_is_that_of_the_closed_form(options):
    """Of q0 cos(w T) + v0 sin(w T)/w by q0, v0 and w, forward over reverse and twice reverse; the continuous adjoint."""

    class Oscillator(eqx.Module):
        rate: jax.Array

        def __call__(self, system, q, v, t):
            return -(self.rate**2) * q

    system = jd.LagrangianSystem(lambda q, v: 0.5 * v @ v, 1)

    def end(x, **more):
        scene = jd.Scene(system, forces=[Oscillator(x[2])])
        return jd.simulate(scene, x[:1], x[1:2], jnp.asarray([0.0, 0.4, 1.0]), **options | more).q[-1, 0]

    def closed(x):
        return x[0] * jnp.cos(x[2]) + x[1] * jnp.sin(x[2]) / x[2]

    x = jnp.asarray([0.7, -0.4, 3.0])
    exact = jax.hessian(closed)(x)
    np.testing.assert_allclose(jax.hessian(end)(x), exact, atol=1e-8)
    np.testing.assert_allclose(jax.jacrev(jax.jacrev(end))(x), exact, atol=1e-8)
    if options["stepsize"] == within(1e-10):
        gradient = jax.grad(lambda x: end(x, adjoint="backsolve"))(x)
        np.testing.assert_allclose(gradient, jax.grad(closed)(x), rtol=1e-7)  # to the tolerance of the solution


class Counted(diffrax.RecursiveCheckpointAdjoint):
    """An adjoint of a user, which records that it was used."""

    def loop(self, *args, **options):
        USED.append(type(self).__name__)
        return super().loop(*args, **options)


USED: list[str] = []


@pytest.mark.slow
@pytest.mark.parametrize("steps", [{}, {"stepsize": 0.05}])
def test_an_adjoint_object_is_used(steps):
    """With explicit methods too, whose loops are else the library's own; scenes with modes refuse it by its name."""
    model, ts = jd.robots.chain(2), jnp.linspace(0.0, 0.5, 3)

    def end(v, adjoint):
        return jnp.sum(jd.simulate(model, jnp.ones(2), v, ts, adjoint=adjoint, **steps).q[-1] ** 2)

    given = Counted(checkpoints=5)
    USED.clear()
    gradient = jax.grad(end)(jnp.array([0.3, -0.2]), given)
    assert USED
    # Of the local errors of adaptive steps, 1e-8: fixed ones are the same.
    want = jax.grad(end)(jnp.array([0.3, -0.2]), "reverse")
    np.testing.assert_allclose(gradient, want, rtol=1e-12 if steps else 1e-6)
    with pytest.raises(ValueError, match="adjoint is Counted"):
        jd.simulate(jd.scenes.sliding_block(), [0.0], [2.0], ts, adjoint=given)


def _end_of_pendulum(adjoint, **options):
    """End (2,) of a run by a factor of the inertia and the start, and whether it succeeded."""
    model, tolerance = jd.robots.chain(1), options.pop("tolerance", 1e-8)

    def end(k, q0, steps=400):
        here = model.replace(inertias=model.inertias * k)
        stepsize = jd.simulation.Steps(rtol=tolerance, atol=tolerance, max_steps=steps)
        given = {"adjoint": adjoint, "throw": False, "stepsize": stepsize} | options
        motion = jd.simulate(here, q0[None], jnp.zeros(1), jnp.linspace(0, 2.0, 3), **given)
        return jnp.stack([motion.q[-1, 0], motion.v[-1, 0]]), motion.success

    return end


RUNS = {
    "native": ("reverse", {}),
    "direct": ("direct", {}),
    "forward": ("forward", {}),
    "backsolve": ("backsolve", {}),
    "diffrax": ("reverse", {"solver": diffrax.ImplicitEuler(), "tolerance": 1e-3}),
    "diffrax direct": ("direct", {"solver": diffrax.ImplicitEuler(), "tolerance": 1e-3}),
    "limits": ("reverse", {"events": [jd.events.JointLimit()]}),
}


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "diffrax direct" else name for name in RUNS]
)
def test_cotangents_of_a_failed_run_are_nan(name):
    """Those of a start of NaN and of too few steps; the others of the batch keep theirs, as does a loss that leaves them out."""
    adjoint, options = RUNS[name]
    end = _end_of_pendulum(adjoint, **options)
    starts = jnp.stack([jnp.ones(3), jnp.asarray([1.0, np.nan, 0.5])], 1)
    if adjoint == "forward":
        derivative = jax.jacfwd(lambda x, *steps: end(x[0], x[1], *steps)[0][0])
        slopes = jax.jit(jax.vmap(derivative))(starts)
        short = jax.jit(lambda x: derivative(x, 3))(jnp.ones(2))
    else:
        short = jax.jit(jax.grad(lambda x: end(x[0], x[1], 3)[0][0]))(jnp.ones(2))

        def loss(x, masked):
            ends, good = jax.vmap(end)(x[:, 0], x[:, 1])
            return jnp.sum(jnp.where(good | ~masked, ends[:, 0], 0.0))

        gradients = jax.jit(jax.vmap(jax.grad(loss), (None, 0)))(starts, jnp.asarray([False, True]))
        slopes, others = gradients
        np.testing.assert_array_equal(others[1], 0.0)
        np.testing.assert_allclose(others[::2], slopes[::2], rtol=0, atol=1e-9)
    assert np.isnan(slopes[1]).all()
    assert np.isnan(short).all() or name == "limits"  # where steps that look for an event are not counted
    assert np.isfinite(slopes[::2]).all() and np.all(np.abs(slopes[::2, 1]) > 0.1)


@pytest.mark.parametrize("outer", [pytest.param(jax.jacfwd, marks=pytest.mark.slow), jax.jacrev])
def test_second_derivatives_of_a_failed_run_are_nan(outer):
    """As the first ones, and not zero, which the derivative of a constant NaN would be; a loss that leaves it out has its own."""
    model, (q, v) = jd.scenes.double_pendulum(), jd.scenes.double_pendulum.start()[:2]

    def end(q, masked, max_steps=16):
        steps = jd.simulation.Steps(rtol=1e-9, atol=1e-9, max_steps=max_steps)
        motion = jd.simulate(model, q, v, np.array([0.0, 1.0]), stepsize=steps)
        return jnp.where(masked & ~motion.success, q @ q, motion.q[-1].sum())

    hessian = jax.jit(outer(jax.grad(end)))
    assert np.isnan(hessian(q, False)).all()
    np.testing.assert_array_equal(hessian(q, True), 2 * np.eye(2))


@pytest.mark.parametrize("adjoint", ["reverse", "direct"])
def test_cotangents_of_a_step_that_failed_are_nan(adjoint):
    """A stepper has no code: its values are NaN, and so are its derivatives, by the state, the torque and the parameters."""
    model = jd.robots.chain(2)

    def end(q, k, tau):
        step = jd.stepper(model.replace(inertias=model.inertias * k), 0.01, adjoint=adjoint)
        return step((q, jnp.zeros(2)), tau)[0].sum()

    every = jax.jit(jax.vmap(jax.grad(end, (0, 1, 2))))(
        jnp.asarray([[0.1, 0.2], [np.nan, 0.2]]), jnp.ones(2), jnp.ones((2, 2))
    )
    for slope in every:
        assert np.isfinite(slope[0]).all() and np.isnan(slope[1]).all()
