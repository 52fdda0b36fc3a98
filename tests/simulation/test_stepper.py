"""One step at a time, joint stops and limits of effort."""

import re
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refusals

import jaxdyn as jd
from jaxdyn.compile import target

DT, TAU = 0.01, jnp.asarray([3.0, -1.0])


def arm():
    builder, rod = jd.ModelBuilder("arm"), (1.0, (0.0, 0.0, -0.5), (0.1, 0.1, 0.01))
    builder.add_body(
        "upper", None, "revolute", rod, axis=(0, 1, 0), joint_name="1", lower=-0.5, upper=0.5, effort_limit=2.0
    )
    builder.add_body(
        "lower", "upper", "continuous", rod, axis=(0, 1, 0), joint_name="2", pose=((0, 0, -1.0), (0, 0, 0))
    )
    return builder.build()


@pytest.fixture(scope="module")
def scene():
    drive = jd.forces.Drive(5.0, 0.5, 0.2, joints=("2",))
    return jd.Scene(
        arm(),
        forces=(jd.forces.JointStops(2e3, 20.0), jd.forces.CoulombFriction(0.3, 0.05), drive, jd.forces.EffortLimits()),
    )


def run(scene, start, taus, **options):
    step = jd.stepper(scene, DT, **options)

    def advance(state, tau):
        state = step(state, tau)
        return state, state

    return jax.lax.scan(advance, start, taus)[1]


START = jnp.asarray([0.45, 0.1]), jnp.asarray([1.0, -2.0])


@pytest.mark.long
def test_steps_are_those_of_simulate(scene):
    """With friction, a stop that is hit, a drive, and an effort above its limit."""
    q, v = jax.jit(lambda taus: run(scene, START, taus, substeps=2))(jnp.broadcast_to(TAU, (30, 2)))
    ts = DT * jnp.arange(31.0)
    motion = jd.simulate(scene, *START, ts, control=lambda q, v, t: TAU, stepsize=DT / 2, outputs=("torque",))
    np.testing.assert_allclose(q, motion.q[1:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(v, motion.v[1:], rtol=0, atol=1e-11)
    np.testing.assert_array_equal(motion.torque, jnp.broadcast_to(jnp.asarray([2.0, -1.0]), (31, 2)))
    assert motion.q[:, 0].max() > 0.5, "the stop is hit"


@pytest.mark.slow
def test_batches_and_gradients_of_steps(scene):
    """Of a batch, through a scan, kept or computed again; against differences."""
    taus = 1.5 * jnp.sin(jnp.arange(40.0)).reshape(20, 2)

    def loss(scale, remat):
        q, v = run(scene, START, scale * taus, remat=remat)
        return jnp.sum(q[-1] ** 2) + jnp.sum(v[-1] * q[-1])

    gradient = jax.jit(jax.vmap(jax.grad(lambda s: loss(s, True))))(jnp.asarray([0.5, 1.0]))
    kept = jax.jit(jax.grad(lambda s: loss(s, False)))(1.0)
    np.testing.assert_allclose(gradient[1], kept, rtol=1e-12)
    value = jax.jit(lambda s: loss(s, True))
    np.testing.assert_allclose(gradient[0], (value(0.5 + 1e-5) - value(0.5 - 1e-5)) / 2e-5, rtol=1e-7)


@pytest.mark.slow
def test_a_law_is_held_over_a_step_and_keeps_nothing(scene):
    """The same steps as of its torques; what a gradient keeps of each step more is its state alone."""
    gain = jnp.asarray([[3.0, 0.5], [0.2, 1.0]])
    step = jd.stepper(scene, DT)

    def run_law(gain, start, count, inside):
        def law(q, v, t):
            return -jnp.tanh(gain @ q) - 0.1 * jnp.tanh(gain @ v)

        def advance(state, _):
            return step(state, law if inside else law(*state, 0.0)), None

        return jax.lax.scan(advance, start, None, length=count)[0]

    inside, outside = (jax.jit(lambda g, way=way: run_law(g, START, 5, way)[0])(gain) for way in (True, False))
    np.testing.assert_allclose(inside, outside, rtol=1e-13)
    starts = jax.tree.map(lambda x: jnp.tile(x, (64, 1)), START)

    def kept(count):
        def loss(gain):
            return jnp.sum(jax.vmap(lambda s: run_law(gain, s, count, True)[0])(starts))

        return jax.jit(jax.grad(loss)).lower(gain).compile().memory_analysis().temp_size_in_bytes

    # Four numbers a step and sample; buffers are aligned.
    assert kept(300) - kept(100) == pytest.approx(8 * 4 * 200 * 64, rel=0.01)


def test_stop_holds_a_joint_and_never_pulls():
    """Rest is tau/k beyond the limit; leaving, the damper does not hold it back."""
    model, stops = arm(), jd.forces.JointStops(2e3, 20.0)
    q, still = np.array([0.51, 3.0]), np.zeros(2)
    push = jax.jit(lambda q, v: stops(model, q, v, 0.0))
    np.testing.assert_allclose(push(q, still), [-20.0, 0.0], rtol=1e-12)
    np.testing.assert_allclose(push(-q, np.array([-0.1, 0])), [22.0, 0.0], rtol=1e-12)
    np.testing.assert_array_equal(push(q, np.array([-2.0, 0])), [0.0, 0.0])
    np.testing.assert_array_equal(push(np.array([0.49, 0.0]), np.ones(2)), [0.0, 0.0])
    slopes = jax.jit(jax.jacfwd(push))(q, still)
    np.testing.assert_allclose(slopes, [[-2e3, 0], [0, 0]])


def test_limits_cut_the_control_and_nothing_else():
    limits, tau = jd.forces.EffortLimits([1.0, jnp.inf]), jnp.asarray([-3.0, 50.0])
    scene = jd.Scene(arm(), forces=(limits,))
    np.testing.assert_array_equal(scene.clip_effort(tau), [-1.0, 50.0])
    np.testing.assert_array_equal(jax.jacfwd(scene.clip_effort)(tau), [[0, 0], [0, 1]])
    np.testing.assert_array_equal(scene.applied_force(jnp.zeros(2), jnp.ones(2)), [0, 0])


test_what_does_not_fit_is_refused = refusals(
    (lambda: jd.stepper(arm(), 0.0), "dt"),
    (lambda: jd.stepper(arm(), 0.1, substeps=0), "substeps"),
    (lambda: jd.stepper(jd.Scene(arm(), forces=(jd.contact.DryFriction(0.1, 1.0, smoothing=0.1),)), 0.1), "smoothing"),
    (lambda: jd.stepper(arm(), 0.1)((jnp.zeros(3), jnp.zeros(2)), TAU), "q has shape"),
    (lambda: jd.stepper(arm(), 0.1)((jnp.zeros(2), jnp.zeros(2)), jnp.zeros(3)), "tau"),
    (lambda: jd.stepper(arm(), 0.1)((jnp.zeros(2), jnp.zeros(2)), lambda q, v, t: jnp.zeros(3)), "tau"),
    (lambda: jd.forces.JointStops(-1.0), "stiffness"),
    (lambda: jd.forces.JointStops(joints="9")(arm(), jnp.zeros(2), jnp.zeros(2), 0.0), "9"),
    (lambda: jd.forces.EffortLimits(-1.0), "negative"),
    (lambda: jd.forces.EffortLimits([1.0]).clip_effort(arm(), jnp.zeros(2)), "shape"),
)


@pytest.mark.slow
def test_second_derivatives_and_forward_mode_of_steps():
    """A pendulum-like oscillator of rate w: one step of RK4 is the Taylor series of cos(w h) to (w h)^4."""
    system = jd.LagrangianSystem(lambda q, v: 0.5 * v @ v - 0.5 * 9.0 * q @ q, 1)

    def after(adjoint, x):
        return jd.stepper(system, 0.1, adjoint=adjoint)((x[:1], x[1:]), jnp.zeros(1))[0][0] ** 2

    x, z = jnp.asarray([0.7, -0.4]), 0.3
    row = np.array([1 - z**2 / 2 + z**4 / 24, (z - z**3 / 6) / 3])
    for adjoint in ("reverse", "forward", "direct"):
        hessian = jax.hessian(lambda x: after(adjoint, x))(x)  # noqa: B023
        np.testing.assert_allclose(hessian, 2 * np.outer(row, row), rtol=1e-12)
    slopes = jax.jacfwd(lambda x: after("forward", x))(x)
    np.testing.assert_allclose(slopes, 2 * (row @ x) * row, rtol=1e-12)
    with pytest.raises(ValueError, match="adjoint is 'back'"):
        jd.stepper(system, 0.1, adjoint="back")


@pytest.mark.native
@pytest.mark.parametrize(("substeps", "forward"), [(1, 1), (2, 2)])
def test_reverse_mode_takes_a_single_step_once(substeps, forward, monkeypatch):
    """Its history is its inputs; that of several substeps is computed again, as `remat` says."""
    monkeypatch.setattr(target, "make_ahead", lambda number: None)  # a kernel forgets its program when it has code
    step = jd.stepper(arm(), DT, substeps)
    q, v = jnp.asarray([0.2, -0.3]), jnp.asarray([1.0, 0.5])
    run = jax.jit(jax.grad(lambda q: jnp.sum(step((q, v), TAU)[0] ** 2)))
    numbers = re.findall(r"program = (\d+)", run.lower(q).as_text())
    names = [getattr(target._kernels[int(number)].program, "name", "") for number in numbers]
    assert (names.count("loop of _iterate"), names.count("loop of _iterate_back")) == (forward, 1)
    # Central differences with this h have errors of 1e-10 by rounding, and of 1e-12 by their order.
    h = 1e-6
    ends = [[jnp.sum(step((q + s * h * e, v), TAU)[0] ** 2) for s in (1, -1)] for e in jnp.eye(2)]
    np.testing.assert_allclose(run(q), [(up - down) / (2 * h) for up, down in ends], rtol=1e-8)


@pytest.mark.long
def test_steps_and_derivatives_where_rows_are_dependent():
    """Samples of a batch whose two rows are the same, which the native loops refuse, next to others: as with one row, or two."""

    def one(q, t):
        return jnp.asarray([[1.0, 1.0, 0.0]])

    def two(q, t):
        return jnp.stack([one(q, t)[0], jnp.stack([1.0, 1.0, 1.0 + q[2]])])

    def both(q, t):
        return jnp.where(q[2] > 0, two(q, t), one(q, t))

    qs = jnp.asarray([[0.3, -0.2, -0.5], [0.3, -0.2, 0.5], [0.1, 0.4, -0.7], [-0.2, 0.3, 0.2], [0.2, 0.1, -0.3]])
    vs = jnp.asarray([[0.5, -0.5, 0.2], [0.5, -0.5, 0.0], [0.1, -0.1, -0.4], [0.3, -0.3, 0.0], [0.0, 0.0, 0.1]])

    def end(rows, q, v, tau):
        scene = jd.Scene(jd.robots.chain(3), (jd.Pfaffian(rows),))

        def advance(state, _):
            return jd.stepper(scene, 0.02)(state, tau), None

        q, v = jax.lax.scan(advance, (q, v), length=3)[0]
        return jnp.sum(jnp.sin(q)) + jnp.sum(v * jnp.arange(1.0, 4.0))

    computed, by_one, by_two = (
        jax.jit(jax.vmap(jax.value_and_grad(partial(end, rows), (0, 1, 2))))(qs, vs, jnp.ones((5, 3)))
        for rows in (both, one, two)
    )
    for mine, single, double in zip(*map(jax.tree.leaves, (computed, by_one, by_two)), strict=True):
        assert jnp.isfinite(mine).all()
        want = np.where((qs[:, 2] > 0).reshape(-1, *[1] * (mine.ndim - 1)), double, single)
        np.testing.assert_allclose(mine, want, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize(("dt", "substeps", "is_coarse"), [(0.01, 1, False), (0.3, 1, True), (0.3, 2, False)])
def test_coarse_steps_are_reported_as_by_simulate(dt, substeps, is_coarse):
    """Of a double pendulum, also where steps may end at limits of the effort that are not met."""
    model, state = jd.robots.chain(2), (jnp.asarray([1.0, 0.5]), jnp.zeros(2))
    motion = jd.simulate(model, *state, jnp.asarray([0.0, dt]), stepsize=dt / substeps, throw=False)
    for forces in ((), (jd.forces.EffortLimits(50.0),)):
        scene = jd.Scene(model, forces=forces)
        (q, v), report = jax.jit(jd.stepper(scene, dt, substeps, report=True))(state, jnp.zeros(2))
        assert (report.result == jd.RESULTS.coarse_steps) == (motion.result == jd.RESULTS.coarse_steps) == is_coarse
        assert bool(report.success) != is_coarse and not report.forces
        plain = jd.stepper(scene, dt, substeps)(state, jnp.zeros(2))
        np.testing.assert_allclose(np.stack([q, v]), np.stack(plain), rtol=0, atol=1e-13)
        np.testing.assert_allclose(q, motion.q[-1], rtol=0, atol=1e-12)


def test_report_of_a_step_has_derivatives_in_both_modes_and_at_rest():
    def end(q, adjoint):
        return jd.stepper(jd.robots.chain(2), 0.01, report=True, adjoint=adjoint)((q, jnp.zeros(2)), jnp.zeros(2))[0][0]

    reverse = jax.jacrev(lambda q: end(q, "reverse"))(jnp.zeros(2))
    np.testing.assert_allclose(reverse, jax.jacfwd(lambda q: end(q, "forward"))(jnp.zeros(2)), rtol=0, atol=1e-14)


def test_exported_steps_have_no_report():
    step = jd.stepper(jd.robots.chain(1), 0.01, report=True)
    with pytest.raises(ValueError, match="have no report"):
        jd.export(lambda q, v: step((q, v), jnp.zeros(1))[0][0], jnp.zeros(1), jnp.zeros(1), name="step")


@pytest.mark.parametrize(("stops", "substeps"), [(False, 3), (True, 3), pytest.param(False, 1, marks=pytest.mark.slow)])
def test_steps_are_the_same_at_any_time(stops, substeps):
    """Bit for bit, in a scan that computes t, and in float32: the length and the number of steps do not depend on rounding of t.

    By t + dt - t one step in four of 5 substeps was one too many, and had no result.
    """
    scene = jd.Scene(arm(), forces=[jd.forces.JointStops(1e3)]) if stops else jd.scenes.double_pendulum()
    step, state = jd.stepper(scene, 0.01, substeps=substeps), (jnp.array([0.3, -0.2]), jnp.array([1.0, 0.5]))
    wanted = np.asarray(step(state, jnp.zeros(2))[0])

    @jax.jit
    def ends(k):
        return jax.lax.scan(lambda k, _: (k + 1, step(state, jnp.zeros(2), k * 0.01)[0]), k, length=200)[1]

    np.testing.assert_array_equal(ends(0), np.broadcast_to(wanted, (200, 2)))
    np.testing.assert_array_equal(step(state, jnp.zeros(2), 1e14)[0], wanted)
    single = jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, scene)
    at = [jd.stepper(single, 0.01, substeps=substeps)(state, jnp.zeros(2), t)[0] for t in (0.0, 1e6)]
    assert at[0].dtype == jnp.float32
    np.testing.assert_array_equal(*at)
