"""Steps of explicit methods on one flat state: against diffrax's own steps, in kernels and in turn."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from pinocchio_bridge import quick

import jaxdyn as jd
from benchmarks.report_cases import cases, test_set
from jaxdyn import scenes
from jaxdyn.compile import kernels

pytestmark = pytest.mark.native


def field(t, y, args):
    """Coupled pendulums in a state of two parts, of which the angles may be a matrix."""
    angles = y["angles"].ravel()
    pull = -jnp.sin(angles) + 0.3 * (jnp.roll(angles, 1) - angles) + 0.1 * jnp.cos(t)
    return {"angles": y["rates"].reshape(y["angles"].shape), "rates": pull - 0.05 * y["rates"]}


@pytest.mark.parametrize(
    "shape", [(7,), *(pytest.param(x, marks=pytest.mark.slow) for x in ((1,), (3, 4), (40,)))], ids=str
)
@pytest.mark.parametrize("solver", [diffrax.Dopri8(), diffrax.Tsit5(), diffrax.Heun()], ids=lambda s: type(s).__name__)
def test_steps_are_those_of_diffrax(solver, shape):
    """States of one piece, of several, and of one that is too large to be cut."""
    keys = jax.random.split(jax.random.key(3), 2)
    size = int(np.prod(shape))
    y0 = {"angles": jax.random.normal(keys[0], shape), "rates": jax.random.normal(keys[1], (size,))}
    term, times = diffrax.ODETerm(field), jnp.asarray([0.2, 0.5, 0.7])

    def two_steps(method):
        state, rows, y = method.init(term, times[0], times[1], y0, None), [], y0
        for t0, t1 in ((times[0], times[1]), (times[1], times[2])):
            y, error, dense, state, _ = method.step(term, t0, t1, y, None, state, made_jump=False)
            output = method.interpolation_cls(t0=t0, t1=t1, **dense)
            rows.append((y, error, output.evaluate(t0 + 0.3 * (t1 - t0)), output.evaluate(t1)))
        return rows

    ours, theirs = (
        quick(lambda: two_steps(jd.solvers.LibrarySteps(solver, field=field)))(),
        quick(lambda: two_steps(solver))(),
    )
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=1e-13), ours, theirs)


def batch(scene, start, size=3):
    """States close to a start, and programs of their motions: both ways, without a cache between them."""
    q, v = (jnp.asarray(x, float) for x in start)
    # Of constraints that move with time, only the velocity as it is satisfies them.
    moving = bool(scene.constraints) and bool(
        jnp.any(jd.constraints.velocity_residual(scene, q, jnp.zeros_like(v)) != 0)
    )
    spread = 0.0 if moving else 0.01
    vs = v[None] * (1 + spread * jnp.arange(float(size))[:, None])
    ts = jnp.linspace(0.0, 0.4, 5)

    def one(v):
        return jd.simulate(scene, q, v, ts, solver=diffrax.Dopri5(), stepsize=0.02, throw=False)

    return one, vs


CASES = {
    "free body": lambda: (scenes.free_body(), scenes.free_body.start()),
    "disk": lambda: (scenes.rolling_disk(), scenes.rolling_disk.start()),
    "car axis": lambda: (test_set.car_axis(), test_set.car_axis.start()),
    "four-bar": lambda: (scenes.four_bar(), scenes.four_bar.start()),
    "dependent rows": lambda: (twice(scenes.rolling_disk()), scenes.rolling_disk.start()),
}


def twice(scene):
    """A disk whose rows are written down a second time."""
    (rolling,) = scene.constraints
    return jd.Scene(scene.system, (rolling, jd.Pfaffian(rolling.A, name="again")))


@pytest.mark.long
@pytest.mark.parametrize(
    "case", [pytest.param(name, marks=[pytest.mark.slow] * (name != "free body")) for name in CASES]
)
def test_stages_at_once_are_those_in_turn(case, monkeypatch):
    """All steps in one kernel, a kernel a step, and without kernels; a batch and one sample."""
    one, vs = batch(*CASES[case]())
    looped, run_natively = [], kernels._run_natively

    def counted(*args):
        computed = run_natively(*args)
        looped.append(computed is not None)
        return computed

    monkeypatch.setattr(kernels, "_run_natively", counted)
    computed, alone = quick(jax.vmap(one))(vs), quick(one)(vs[1])
    assert all(looped) and looped
    monkeypatch.setattr(kernels, "_run_natively", lambda *_: None)
    in_turn = quick(jax.vmap(one))(vs)
    with jd.compilation("plain"):
        plain = quick(jax.vmap(one))(vs)
    for wanted in (in_turn, plain):
        assert bool(computed.success.all()) and bool(wanted.success.all())
        np.testing.assert_allclose(computed.q, wanted.q, rtol=0, atol=1e-12)
        np.testing.assert_allclose(computed.v, wanted.v, rtol=0, atol=1e-12)
    np.testing.assert_allclose(alone.q, computed.q[1], rtol=0, atol=1e-12)


# --- whole motions in both modes ---


def motion(name, **options):
    """A simulation of a scene of the report, for given start and tolerance."""
    case = cases()[name]
    scene, (q, v) = case.build()
    ts = jnp.asarray(case.ts[:4])

    def run(q, v, tolerance):
        steps = {"stepsize": within(tolerance)} if "stepsize" not in options else {}
        return jd.simulate(scene, q, v, ts, throw=False, **steps, **options)

    return run, (jnp.asarray(q), jnp.asarray(v), jnp.asarray(1e-9))


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "options"),
    [
        pytest.param("free_body", {}, marks=pytest.mark.slow),
        pytest.param("double_pendulum", {"outputs": ("energy", "acceleration")}, marks=pytest.mark.slow),
        ("rolling_disk", {"outputs": ("multipliers", "constraint_residual", "energy", "acceleration")}),
        pytest.param("four_bar", {}, marks=pytest.mark.slow),
        pytest.param("car_axis", {"stepsize": 0.003}, marks=pytest.mark.slow),
        pytest.param("andrews", {}, marks=pytest.mark.slow),
        pytest.param("double_pendulum", {"solver": jd.solvers.Rodas5P()}, marks=pytest.mark.slow),
        pytest.param("double_pendulum", {"method": "variational", "stepsize": 0.01}, marks=pytest.mark.slow),
    ],
)
def test_motions_are_those_without_kernels(name, options):
    run, args = motion(name, **options)
    computed = quick(run)(*args)
    with jd.compilation("plain"):
        run, args = motion(name, **options)
        wanted = quick(run)(*args)
    assert bool(computed.success) and bool(wanted.success)
    # Rounding may decide about a step; two runs at a tolerance of 1e-9 differ by less than ten times that, and those of Andrews'
    # mechanism, which turns at 1000 rad/s, by less than a hundred times.
    bound = 1e-7 if name == "andrews" else 1e-8
    for x, y in ((computed.q, wanted.q), (computed.v, wanted.v)):
        np.testing.assert_allclose(x, y, rtol=bound, atol=bound)
    for key in options.get("outputs", ()):
        np.testing.assert_allclose(getattr(computed, key), getattr(wanted, key), rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_long_chains_that_are_built_in_a_program():
    q = 0.3 * jnp.cos(jnp.arange(130))

    def energies(speed):
        chain = jd.robots.chain(130)
        ts = jnp.asarray([0.0, 0.02])
        solution = jd.simulate(chain, q, speed * jnp.sin(q), ts, stepsize=0.001, outputs=("energy",))
        return solution.energy, solution.q[-1]

    energy, end = jax.jit(energies)(0.1)
    np.testing.assert_allclose(energy[1], energy[0], rtol=1e-8)  # of RK4
    np.testing.assert_allclose(end, energies(0.1)[1], rtol=0, atol=1e-12)


def test_times_that_do_not_increase_have_a_code():
    scene, (q, v) = cases()["free_body"].build()

    @jax.jit
    def run(ts):
        return jd.simulate(scene, q, v, ts)

    assert bool(run(jnp.array([0.0, 0.5, 1.0])).success)
    for times in ([0.0, 0.5, 0.5], [0.0, 1.0, 0.5], [0.0, jnp.nan, 1.0]):
        computed = run(jnp.array(times))
        assert computed.result == jd.RESULTS.unordered_times
        assert jnp.isnan(computed.q).all()


@pytest.mark.long
@pytest.mark.parametrize("adjoint", ["forward", pytest.param("direct", marks=pytest.mark.slow)])
def test_forward_mode_over_a_batch_is_that_of_its_samples(adjoint):
    """A loop that is batched first and differentiated then, and the other way round."""
    model, ts = jd.robots.chain(1), jnp.linspace(0.0, 0.2, 3)
    starts = jnp.asarray([[0.3], [-0.4], [1.2]])

    def moved(scale, q):
        options = {"solver": diffrax.Heun(), "stepsize": 0.1, "adjoint": adjoint}
        return jd.simulate(model, scale * q, jnp.zeros(1), ts, **options).q

    def batch(scale):
        return jax.vmap(lambda q: moved(scale, q))(starts)

    both = quick(lambda scale: jax.jvp(batch, (scale,), (1.0,)))
    differentiated_first = quick(
        lambda scale: jax.vmap(lambda q: jax.jvp(lambda s: moved(s, q), (scale,), (1.0,))[1])(starts)
    )(1.0)
    batched_first = both(1.0)[1]
    np.testing.assert_allclose(batched_first, differentiated_first, rtol=1e-13, atol=1e-15)
    slope = (np.asarray(both(1 + 1e-5)[0]) - np.asarray(both(1 - 1e-5)[0])) / 2e-5
    np.testing.assert_allclose(batched_first, slope, atol=1e-9)
