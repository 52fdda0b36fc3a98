"""Fixed steps that are too long say so, and others do not."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import slider
from pinocchio_bridge import quick

import jaxdyn as jd
from jaxdyn.compile import mode

SOLVERS = {"RK4": None, "Tsit5": diffrax.Tsit5(), "Dopri8": diffrax.Dopri8(), "Rodas5P": jd.solvers.Rodas5P()}


def codes(result):
    return np.asarray(result == jd.RESULTS.successful), np.asarray(result == jd.RESULTS.coarse_steps)


@pytest.mark.parametrize("name", SOLVERS)
def test_steps_that_are_too_long_are_refused(name):
    """A spring of rate w from q = 1, 400 steps of 1/100 s: cos(w t), w h from 0.005 to 5.

    An error of a tenth and more carries a code always, one below a thousandth never. Between them the estimate may overrate it.
    """
    model, ts = slider(), np.linspace(0.0, 4.0, 41)

    def run(rate):
        scene = jd.Scene(model, forces=(jd.forces.JointSpring(rate**2),))
        solution = jd.simulate(scene, jnp.ones(1), jnp.zeros(1), ts, solver=SOLVERS[name], stepsize=0.01, throw=False)
        return solution.q[:, 0], solution.result

    rates = np.geomspace(0.5, 500.0, 61)
    q, result = quick(jax.vmap(run))(jnp.asarray(rates))
    fine, coarse = codes(result)
    error = np.abs(np.asarray(q) - np.cos(rates[:, None] * ts)).max(1)
    assert not fine[~(error < 0.1)].any()
    assert fine[error < 1e-3].all()
    assert coarse.any() and fine.any()
    # What is refused for being too coarse is given all the same.
    assert np.isfinite(q[coarse]).all()


def test_stiff_decay_within_the_limit_is_right():
    """A damper whose steps are near the limit of stability: what has decayed does not count, what grows does."""
    model = slider()

    def run(rate):
        scene = jd.Scene(model, forces=(jd.forces.JointDamping(rate),))
        ts = np.linspace(0.0, 1.0, 3)
        solution = jd.simulate(scene, jnp.zeros(1), jnp.full(1, 1e-3), ts, stepsize=0.01, throw=False)
        return solution.q[-1, 0] * rate / 1e-3, solution.result

    rates = jnp.asarray([50.0, 300.0, 1000.0])
    solutions, result = quick(jax.vmap(run))(rates)
    fine, coarse = codes(result)
    np.testing.assert_array_equal(fine, [True, False, False])
    np.testing.assert_array_equal(coarse, [False, True, True])
    assert abs(solutions[0] - 1) < 1e-3


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_rest_is_not_coarse(dtype):
    """Nothing moves, or only by rounding: hanging still, upside down, and turned to a cosine that is not zero exactly."""
    model = jd.robots.chain(3, dtype=dtype)
    starts = jnp.asarray([[0.0, 0.0, 0.0], [np.pi, 0.0, 0.0], [0.0, np.pi, -np.pi]], dtype)
    ts = jnp.linspace(0.0, 0.5, 3, dtype=dtype)
    run = quick(jax.vmap(lambda q: jd.simulate(model, q, jnp.zeros(3, dtype), ts, stepsize=0.001, throw=False)))
    fine, _ = codes(run(starts).result)
    assert fine.all()


@pytest.mark.slow
def test_steps_that_are_too_many_for_the_dtype():
    """In float32 the rounding of two million steps is a tenth of the motion; in float64 it is nothing."""
    model = slider()

    def run(dtype):
        start = jnp.ones(1, dtype), jnp.ones(1, dtype)
        ts = jnp.asarray([0.0, 2000.0], dtype)
        single = jax.tree.map(lambda x: jnp.asarray(x, dtype), model)
        return jd.simulate(single, *start, ts, stepsize=0.001, throw=False).result

    assert run(jnp.float64) == jd.RESULTS.successful
    assert run(jnp.float32) == jd.RESULTS.coarse_steps


def test_what_to_do_is_said():
    """Contact by penalty at 1e8 N/m with steps of 1 ms, which ended at a wrong place without a word."""
    scene = jd.Scene(slider(), forces=(jd.forces.JointSpring(1e8), jd.forces.JointDamping(1e4)))
    with pytest.raises(RuntimeError, match=r"too long.*Fix"):
        jd.simulate(scene, [0.01], [0.0], [0.0, 0.002], stepsize=0.001)


@pytest.mark.slow
def test_reduced_and_projected_steps_are_watched():
    """A four-bar loop by both methods, at a step that serves and at one that is as long as the motion."""
    scene = jd.scenes.windows(count=1)
    q, v = jd.scenes.windows.start(count=1)
    for method in ("projected", "reduced"):

        def run(h, method=method):
            solution = jd.simulate(
                scene, q, v, [0.0, 1.2], method=method, stepsize=jd.simulation.Steps(h, max_steps=256), throw=False
            )
            return solution.result

        fine, _ = codes(quick(jax.vmap(run))(jnp.asarray([0.01, 0.6])))
        np.testing.assert_array_equal(fine, [True, False], err_msg=method)


@pytest.mark.long
@pytest.mark.parametrize("name", ["RK4", "Tsit5", pytest.param("Dopri8", marks=pytest.mark.slow)])
def test_torques_held_from_step_to_step_are_those_within_each(name):
    """A unit mass under forces that jump where steps end: v_k = sum of tau_i dt, and its derivative in every tau_i, exactly."""
    model, dt, count = slider(), 0.1, 24  # tenths are rounded, and so are ends of steps, differently
    ts = jnp.asarray(np.arange(count) * dt)
    tau = jnp.asarray(np.random.default_rng(0).normal(size=(count, 1)))
    choice = {"stepsize": dt, "solver": SOLVERS[name]}

    def velocity(tau):
        control = jd.identify.SampledTorque(ts, tau, "previous")
        motion = jd.simulate(model, jnp.zeros(1), jnp.zeros(1), ts, control=control, **choice)
        return motion.v[:, 0]

    v, back = jax.vjp(velocity, tau)
    np.testing.assert_allclose(v[1:], jnp.cumsum(tau[:-1, 0]) * dt, rtol=1e-11, atol=1e-13)
    (derivative,) = back(jnp.zeros(count).at[-1].set(1.0))
    np.testing.assert_allclose(derivative[:, 0], jnp.full(count, dt).at[-1].set(0.0), rtol=1e-11, atol=1e-13)

    def by_number(q, v, t):  # as a table of a learned policy is read
        return tau[jnp.floor(t / dt).astype(int)]

    motion = jd.simulate(model, jnp.zeros(1), jnp.zeros(1), ts, control=by_number, **choice)
    np.testing.assert_allclose(motion.v[:, 0], v, rtol=1e-11, atol=1e-13)


def test_torques_are_held_in_a_run_that_steps_do_not_fill():
    """Forces of 1, 2, ... N on 1 kg from tenth to tenth of a second, to 0.25 s."""
    control = jd.identify.SampledTorque([0.0, 0.1, 0.2, 0.3], [[1.0], [2.0], [3.0], [4.0]], "previous")
    motion = jd.simulate(slider(), [0.0], [0.0], [0.0, 0.25], control=control, stepsize=0.1)
    np.testing.assert_allclose(motion.v[-1], 0.1 + 0.2 + 0.05 * 3, rtol=1e-14)


@jax.jit
def is_swapped(q):
    return (q[0] > q[1]).astype(jnp.uint32)


KEY = jax.random.key(0)
SORTED = {
    "key": lambda q, v, t: -jnp.where(jax.random.uniform(KEY) < 2, jnp.sort(q), q),
    "sort": lambda q, v, t: -jnp.sort(q),
    "places": lambda q, v, t: -q[jnp.argsort(q)],
    "uint32": lambda q, v, t: -jnp.where(is_swapped(q) == 1, q[::-1], q),
}


@pytest.mark.parametrize("law", SORTED)
def test_gradients_through_controls_without_a_kernel(law, caplog, monkeypatch):
    """Two masses under forces -(q1, q0) while q0 > q1: RK4 multiplies the state by 1 + hA + ... + (hA)^4 / 24."""
    monkeypatch.setattr(mode, "_said", set())
    builder = jd.ModelBuilder("two masses", gravity=None)
    for name in "ab":
        builder.add_body(name, joint="prismatic", axis=(1, 0, 0), inertia=(1.0, (0, 0, 0), (1, 1, 1)))
    model, ts, q = builder.build(), jnp.array([0.0, 0.1]), jnp.array([0.4, -0.2])

    def end(q, law=SORTED[law]):
        return jd.simulate(model, q, jnp.zeros(2), ts, control=law, stepsize=0.025).q[-1]

    zero, swap = np.zeros((2, 2)), np.eye(2)[::-1]
    z = 0.025 * np.block([[zero, np.eye(2)], [-swap, zero]])
    step = np.eye(4) + z @ (np.eye(4) + z @ (np.eye(4) + z @ (np.eye(4) + z / 4) / 3) / 2)
    np.testing.assert_allclose(jax.jacrev(end)(q), np.linalg.matrix_power(step, 4)[:2, :2], rtol=0, atol=1e-12)
    if law == "sort":
        assert "equations_of_motion runs on JAX's own operations: sort" in caplog.text
