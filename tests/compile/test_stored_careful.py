"""Samples that a kernel cannot compute, in processes that find all or a part of their programs on disk."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.compile import kernel, mark_invalid, target, trace

pytestmark = [pytest.mark.native, pytest.mark.slow]


def accelerations(scene, q):
    """By the package's entry point."""
    return jd.constrained_dynamics(scene, q, jnp.zeros_like(q)).acceleration


def work(scene, q):
    """A number that is differentiated."""
    return jnp.sum(accelerations(scene, q) ** 2)


def compute(q_flat) -> dict:
    """Results at eight states of a parallelogram, or of rows that are written down twice; state 3 is the flat one, or none is."""
    scene = jd.scenes.four_bar(lengths=(2.0, 1.0, 2.0, 1.0))
    q = jd.scenes.four_bar.start()[0]
    states = jnp.stack([q + 0.01 * i for i in range(8)]).at[3].set(q_flat * q)
    batch = jax.jit(jax.vmap(lambda q: accelerations(scene, q)))
    slope = jax.jit(jax.grad(lambda q: work(scene, q)))
    # By threads at once: native code asks for one careful program in each of them.
    with ThreadPoolExecutor(3) as pool:
        eager = pool.submit(accelerations, scene, states[3])
        jitted = pool.submit(jax.jit(lambda q: accelerations(scene, q)), states[3])
        many = pool.submit(batch, states)
    windows, start = jd.scenes.windows(count=1), jd.scenes.windows.start(count=1)
    # From its flat position when that is asked for; 0.2 s take it away from there.
    ts = jnp.linspace(0.0, 0.2, 3) + (0.0 if q_flat == 0 else 0.1)
    motion = jd.simulate(windows, *start, ts, stepsize=0.02, solver=diffrax.Dopri5(), throw=False)
    return {
        "eager": eager.result(),
        "jit": jitted.result(),
        "batch": many.result(),
        "gradient": slope(states[3]),
        "gradient of a batch": jax.jit(jax.vmap(slope))(states),
        "motion": motion.q,
    }


def run() -> None:
    """What a process of its own prints: the results, and how many functions were expanded to programs."""
    jax.config.update("jax_enable_x64", True)
    expand, expanded = trace.expand, []
    trace.expand = lambda *args, **how: expanded.append(args[2]) or expand(*args, **how)
    computed = compute(float(sys.argv[1]))
    numbers = {name: [float(x).hex() for x in np.ravel(value)] for name, value in computed.items()}
    print(json.dumps({"numbers": numbers, "expanded": expanded, "careful": careful_names()}))


def careful_names() -> list[str]:
    """Careful programs of which there is code."""
    return [x.row.name for x in target._kernels.values() if x.row.careful and x.is_made]


def start(folder, function: str, *arguments: str) -> dict:
    """Run a function of this module in a process of its own, with its files in a folder; what it prints."""
    env = os.environ | {
        "XDG_CACHE_HOME": str(folder),
        "PYTHONPATH": os.pathsep.join([*sys.path, os.path.dirname(__file__)]),
    }
    command = [sys.executable, "-c", f"import test_stored_careful as t; t.{function}()", *arguments]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def plain():
    with jd.compilation("plain"):
        return {name: np.ravel(value) for name, value in compute(0.0).items()}


def test_processes_one_after_the_other(tmp_path, plain):
    """The first has no flagged sample; the second makes careful programs, the third finds them, the fourth finds no code."""
    first = start(tmp_path, "run", "1.0")
    assert first["expanded"] and first["careful"] == []
    second, third = start(tmp_path, "run", "0.0"), start(tmp_path, "run", "0.0")
    # Of the functions only the careful ones are new in the second process.
    assert second["careful"] and not set(second["expanded"]) & set(first["expanded"])
    assert third["expanded"] == [] and third["careful"]
    for path in (tmp_path / "jaxdyn" / "kernels").glob("*.o"):
        path.unlink()
    fourth = start(tmp_path, "run", "0.0")
    for made in (second, third, fourth):
        assert made["numbers"] == second["numbers"]
        for name, numbers in made["numbers"].items():
            computed = np.array([float.fromhex(x) for x in numbers])
            assert np.isfinite(computed).all()
            size = np.max(np.abs(plain[name]))
            np.testing.assert_allclose(computed, plain[name], rtol=0, atol=1e-10 * max(1.0, size), err_msg=name)


def wave(_, x):
    """A function of the user's own; marked where x is below zero."""
    return mark_invalid(x < 0, jnp.sin(x))


FALLBACKS = {"cos": lambda _, x: jnp.cos(x), "exp": lambda _, x: jnp.exp(x)}


def run_own() -> None:
    """Functions that are equal but for their fallbacks, in the order that the command gives."""
    jax.config.update("jax_enable_x64", True)
    made = {}
    for name in sys.argv[1:]:
        for compiled in (jax.jit, jd.jit):
            run = compiled(lambda x, name=name: kernel(wave, fallback=FALLBACKS[name])((), x))
            made[f"{name} {compiled.__name__}"] = [float(run(jnp.asarray(x))) for x in (0.5, -0.5)]
    print(json.dumps(made))


def test_fallbacks_of_users_are_not_taken_for_each_other(tmp_path):
    """What is on disk by the order in which one process met them is not what another process calls."""
    for names in (("cos", "exp"), ("exp", "cos"), ("exp",)):
        for key, (valid, flagged) in start(tmp_path, "run_own", *names).items():
            formula = {"cos": np.cos, "exp": np.exp}[key.split()[0]]
            np.testing.assert_allclose([valid, flagged], [np.sin(0.5), formula(-0.5)], rtol=1e-14, err_msg=key)
