"""Whether a call gives the same bits whatever was called before: one line a case, and exit status 1 where they differ.

    python -m benchmarks.history [CASE ...]

Each case has two calls of functions that take arrays of the same shapes: A, of a mechanism with other masses or under another
mode of compilation, and B. One fresh process calls A and then B, another one B alone; each prints a hash of what B gives.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import timing


def heavier(scene, factor: float):
    """The scene with other masses."""
    system = scene.system.replace(inertias=scene.system.inertias * factor)
    return jd.Scene(system, scene.constraints, forces=scene.forces)


def motion(name: str, factor: float):
    """A second of a scene of the gallery, and how many steps it takes."""
    named = getattr(jd.scenes, name)
    solution = jd.simulate(heavier(named(), factor), *named.start(), jnp.linspace(0.0, 1.0, 11))
    return solution.q, solution.v, solution.stats["num_steps"]


def assembly(factor: float):
    """A four-bar that is put together, and its degrees of freedom."""
    scene, (q, v) = heavier(jd.scenes.four_bar(), factor), jd.scenes.four_bar.start()
    closed = jd.assemble(scene, q + 1e-2, v)
    return closed.q, closed.v, jd.degrees_of_freedom(scene, closed.q)


def accelerations(factor: float):
    """Forward dynamics of a chain, and its derivatives by torques."""
    model = jd.robots.chain(4)
    model = model.replace(inertias=model.inertias * factor)
    q = v = tau = jnp.linspace(0.1, 0.4, 4)
    forward = jd.forward_dynamics(model, q, v, tau)
    return forward, jax.jacfwd(lambda tau: jd.forward_dynamics(model, q, v, tau))(tau), jd.mass_matrix(model, q)


_step = jax.jit(lambda model, q, v: jd.forward_dynamics(model, q, v, jnp.zeros_like(v)))


def jitted(mode: str):
    """A function under the user's own `jax.jit`, which both modes share."""
    with jd.compilation(mode):
        return _step(jd.robots.iiwa(), jnp.linspace(-1.0, 1.0, 7), jnp.linspace(1.0, 2.0, 7))


CASES: dict[str, tuple[Callable, Callable]] = {
    "four_bar": (lambda: motion("four_bar", 1.3), lambda: motion("four_bar", 1.1)),
    "bennett": (lambda: motion("bennett", 1.3), lambda: motion("bennett", 1.1)),
    "assembly": (lambda: assembly(1.3), lambda: assembly(1.1)),
    "accelerations": (lambda: accelerations(1.3), lambda: accelerations(1.1)),
    "mode": (lambda: jitted("plain"), lambda: jitted("auto")),
    "plain": (lambda: jitted("auto"), lambda: jitted("plain")),
}


def digest(tree) -> str:
    """A hash of all bits."""
    return hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(tree))).hexdigest()[:16]


def elsewhere(case: str, calls: str) -> str:
    """The hash of what the last of the calls gives, in a fresh process with an empty cache of object files."""
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, "-m", "benchmarks.history", case, "--here", calls]
        done = subprocess.run(command, env=os.environ | {"XDG_CACHE_HOME": cache}, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{case} failed:\n{done.stderr[-2000:]}")
    return done.stdout.split()[-1]


def main(argv=None) -> None:
    """Run the cases; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--here", choices=["AB", "B"], help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    names = timing.chosen_names(options.cases, CASES)
    if options.here:
        jax.config.update("jax_enable_x64", True)
        for call in options.here:
            computed = digest(CASES[names[0]]["AB".index(call)]())
        print(computed)
        return
    differ = False
    print("| case | A, then B | B alone | |\n|---|---|---|---|")
    for name in names:
        after, alone = elsewhere(name, "AB"), elsewhere(name, "B")
        differ |= after != alone
        print(f"| {name} | {after} | {alone} | {'equal' if after == alone else 'DIFFERENT'} |", flush=True)
    sys.exit(int(differ))


if __name__ == "__main__":
    main()
