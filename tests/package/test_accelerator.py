"""Public functions on an accelerator against the same functions on the CPU, which other tests compare with oracles.

Numbers are skipped where JAX has the CPU alone; there the programs are written for a GPU, which needs none. Neither this
folder's settings nor beartype are needed:
`PYTHONPATH=tests python -m pytest --noconftest tests/package/test_accelerator.py`.
"""

import re
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_gpu_kernels import CASES as KERNELS

import jaxdyn as jd

jax.config.update("jax_enable_x64", True)

ARM = jd.robots.ur5()
TS = np.linspace(0.0, 0.3, 4)


def _arm_states(batch):
    rng = np.random.default_rng(0)
    return [rng.normal(size=(batch, ARM.nv)) for _ in range(3)]


def _starts(scene, batch):
    """Starts of a scene at nearby velocities, which every scene here takes."""
    q, v = scene.start()
    return [np.repeat(np.asarray(q)[None], batch, 0), np.linspace(0.9, 1.1, batch)[:, None] * np.asarray(v)]


def _end(named, **options):
    scene = named()

    def end(q, v):
        solution = jd.simulate(scene, q, v, TS, throw=False, **options)
        return solution.q[-1], solution.v[-1]

    return end


def _gradient(scene, **options):
    end = _end(scene, **options)
    return jax.grad(lambda q, v: jnp.sum(end(q, v)[0] ** 2), 1)


def _constrained(named):
    scene = named()
    return lambda q, v: jd.constrained_dynamics(scene, q, v).acceleration


FOUR_BAR, BENNETT = jd.scenes.four_bar, jd.scenes.bennett
DISK, BALL = jd.scenes.rolling_disk, jd.scenes.ball_on_incline
PLACE = jd.frame_pose(ARM, jnp.full(6, 0.3), ARM.body_names[-1])

# The name, the function of one sample, its batch of arguments, and the bound relative to the largest number.
CASES = {
    "forward dynamics": (lambda q, v, tau: jd.forward_dynamics(ARM, q, v, tau), _arm_states, 1e-11),
    "inverse dynamics": (lambda q, v, a: jd.inverse_dynamics(ARM, q, v, a), _arm_states, 1e-11),
    "mass matrix": (lambda q: jd.mass_matrix(ARM, q), lambda n: _arm_states(n)[:1], 1e-11),
    "hessian of energy": (
        jax.hessian(lambda q: jd.potential_energy(ARM, q)), lambda n: _arm_states(n)[:1], 1e-11
    ),
    "reverse mode of dynamics": (
        jax.grad(lambda q, v, tau: jnp.sum(jd.forward_dynamics(ARM, q, v, tau)), (0, 1, 2)), _arm_states, 1e-10
    ),
    "constrained dynamics": (_constrained(FOUR_BAR), lambda n: _starts(FOUR_BAR, n), 1e-10),
    "redundant rows": (_constrained(BENNETT), lambda n: _starts(BENNETT, n), 1e-8),
    "free motion": (
        lambda q, v: jd.simulate(ARM, q, v, TS, throw=False).q[-1], lambda n: _arm_states(n)[:2], 1e-7
    ),
    "four-bar": (_end(FOUR_BAR), lambda n: _starts(FOUR_BAR, n), 1e-7),
    "four-bar in fixed steps": (_end(FOUR_BAR, stepsize=1e-3), lambda n: _starts(FOUR_BAR, n), 1e-9),
    "four-bar's gradient": (_gradient(FOUR_BAR, stepsize=3e-3), lambda n: _starts(FOUR_BAR, n), 1e-8),
    "Bennett's linkage": (_end(BENNETT), lambda n: _starts(BENNETT, n), 1e-6),
    "rolling disk": (_end(DISK), lambda n: _starts(DISK, n), 1e-7),
    "rolling disk, minimal velocities": (_end(DISK, method="reduced"), lambda n: _starts(DISK, n), 1e-7),
    "ball on an incline": (_end(BALL), lambda n: _starts(BALL, n), 1e-7),
    "assembly": (
        lambda q, v: jd.assemble(FOUR_BAR(), q + 0.01, throw=False).q, lambda n: _starts(FOUR_BAR, n), 1e-9
    ),
    "inverse kinematics": (
        lambda q: jd.inverse_kinematics(ARM, {ARM.body_names[-1]: PLACE}, 0.3 + 0.1 * q, guesses=1, throw=False).q,
        lambda n: _arm_states(n)[:1], 1e-6,
    ),
}  # fmt: skip


@pytest.mark.skipif(jax.devices()[0].platform == "cpu", reason="JAX has no accelerator here")
@pytest.mark.parametrize("mode", ["auto", "native"])
@pytest.mark.parametrize("batch", [1, 64])
@pytest.mark.parametrize("name", CASES)
def test_an_accelerator_has_the_numbers_of_the_cpu(name, batch, mode):
    function, arguments, bound = CASES[name]
    arguments = arguments(batch)
    results = []
    for device in (jax.devices()[0], jax.devices("cpu")[0]):
        placed = jax.device_put(arguments, device)
        with jd.compilation(mode):
            results.append(jax.tree.map(np.asarray, jax.jit(jax.vmap(function))(*placed)))
    for computed, want in zip(*map(jax.tree.leaves, results), strict=True):
        assert np.isfinite(want).all()
        np.testing.assert_allclose(computed, want, rtol=0, atol=bound * max(1.0, np.abs(want).max()))


@pytest.mark.skipif(jax.devices()[0].platform == "cpu", reason="JAX has no accelerator here")
@pytest.mark.parametrize("name", KERNELS)
def test_kernels_that_run_thread_by_thread_on_a_cpu_run_on_an_accelerator(name):
    """At the same bounds, with donated arguments, and from two threads."""
    function, arguments = KERNELS[name]()
    kinds = {np.asarray(x).dtype for x in arguments}
    call, results = jax.jit(jax.vmap(function), donate_argnums=0), []

    def run(device):
        results.append(jax.tree.map(np.asarray, call(*(jax.device_put(np.array(x), device) for x in arguments))))

    with jd.compilation("native"):
        run(jax.devices("cpu")[0])
        threads = [threading.Thread(target=run, args=(jax.devices()[0],)) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    want, *others = map(jax.tree.leaves, results)
    assert len(others) == 2
    for computed in others:
        for x, y in zip(computed, want, strict=True):
            # Steps of a motion that is adaptive, or near a singular position, amplify roundings.
            bound = 1e-7 if np.dtype(np.float64) in kinds else 1e-4
            np.testing.assert_allclose(x, y, rtol=0, atol=bound * max(1.0, np.abs(y).max(initial=0.0)))


SLOW = "four-bar's gradient", "Bennett's linkage", "four-bar", "four-bar in fixed steps", "ball on an incline"
SLOW = *SLOW, "rolling disk, minimal velocities", "rolling disk", "assembly", "inverse kinematics"


@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.slow) if x in SLOW else x for x in CASES])
def test_programs_can_be_written_for_a_gpu(name):
    """Nothing in them is for the CPU alone, such as native kernels and calls of Python."""
    function, arguments, _ = CASES[name]
    lowered = jax.jit(jax.vmap(function)).trace(*arguments(2)).lower(lowering_platforms=("cuda",))
    calls = set(re.findall(r"custom_call @([\w.]+)", lowered.as_text()))
    # The pseudo-inverse of rows that are not regular, and the choice of minimal velocities.
    assert calls <= {"cusolver_gesvdj_ffi", "cusolver_syevd_ffi"}
