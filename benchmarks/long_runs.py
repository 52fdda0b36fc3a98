"""Energy error against run time of long motions: variational steps beside RK4 with fixed and Dopri8 with adaptive steps.

    python -m benchmarks.long_runs [--length 1.0] [SCENE ...]

Per scene: variational and RK4 steps of two lengths, Dopri8 at two tolerances, over the same time. Printed are the largest
energy error (relative to the largest kinetic energy) in the first and in the last tenth of the motion, the steps, and the time
of one run, the better of two; residuals of constraints are in the file. An error that grows from the first tenth to the last
one will go on growing; a method of bounded error keeps it. Methods keep constraints by projection but for the variational one.
"""

import argparse
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import timing

# Length of the motion (s), and the longest variational step.
SCENES = {
    "free_body": (2400.0, 0.1),
    "double_pendulum": (10050.0, 0.01),
    "four_bar": (300.0, 0.04),
    "chaplygin_sleigh": (500.0, 0.1),
}
SAVES = 2001


class Integration(NamedTuple):
    """One way to integrate: its name, the options of `simulate`, and the numbers for which it is run by their names."""

    name: str
    options: dict[str, Any]
    numbers: dict[str, dict[str, float]]


def integrations(step: float) -> list[Integration]:
    """Variational steps, RK4 steps of the same lengths, and tolerances."""
    steps = {f"{h:g} s": {"size": h} for h in (step, step / 2)}
    tolerances = {f"{tol:g}": {"rtol": tol, "atol": tol} for tol in (1e-6, 1e-10)}
    return [
        Integration("variational", {"method": "variational"}, steps),
        Integration("RK4", {}, steps),
        Integration("Dopri8", {}, tolerances),
    ]


def measure(name: str, length: float) -> Iterator[dict]:
    """Errors and times of all ways to integrate one scene."""
    scene, (q, v) = getattr(jd.scenes, name)(), getattr(jd.scenes, name).start()
    duration, step = SCENES[name]
    ts = jnp.linspace(0.0, length * duration, SAVES)
    outputs = ("energy", "constraint_residual") if scene.constraints else ("energy",)
    for integration in integrations(step):

        def run(q, v, numbers, options=integration.options):
            steps = jd.Steps(**numbers, max_steps=2**24)
            return jd.simulate(scene, q, v, ts, outputs=outputs, stepsize=steps, throw=False, **options)

        compiled = jax.jit(run).lower(q, v, next(iter(integration.numbers.values()))).compile()
        for label, numbers in integration.numbers.items():
            times = []
            for _ in range(2):  # the first one compiles kernels
                start = time.perf_counter()
                motion = jax.block_until_ready(compiled(q, v, numbers))
                times.append(time.perf_counter() - start)
            energy, tenth = np.asarray(motion.energy), SAVES // 10
            kinetic = np.asarray(jax.vmap(lambda q, v: jd.kinetic_energy(scene.system, q, v))(motion.q, motion.v))
            error = np.abs(energy - energy[0]) / np.nanmax(kinetic)
            yield {
                "scene": name,
                "run": f"{integration.name}, {label}",
                "first": float(error[:tenth].max()),
                "last": float(error[-tenth:].max()),
                "residual": float(motion.constraint_residual.max()) if scene.constraints else None,
                "steps": int(motion.stats["num_steps"]),
                "seconds": min(times),
            }


def main(argv=None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=list(SCENES), metavar="SCENE")
    parser.add_argument("--length", type=float, default=1.0, help="factor on the length of the motions")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    # As in docs/simulation.md, whose table `make figures` replaces.
    print("| scene, length | method | error, first tenth | last tenth | steps | time, s |\n" + "|---" * 6 + "|")
    rows = []
    for name in timing.chosen_names(options.scenes, SCENES):
        place = f"{name.replace('_', ' ')}, {options.length * SCENES[name][0]:g} s"
        for row in measure(name, options.length):
            print(
                f"| {place} | {row['run']} | {row['first']:.1e} | {row['last']:.1e} | {row['steps']} | {row['seconds']:.2g} |",
                flush=True,
            )
            rows.append(row)
    timing.write("long_runs", {"machine": timing.machine(), "length": options.length, "rows": rows})


if __name__ == "__main__":
    main()
