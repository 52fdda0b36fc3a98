"""Steps of a quadruped that stands on one to four points of each foot: first call, and time of a step of one sample.

    python -m benchmarks.many_contacts [--points 1 2 3 4] [--steps 500] [--gradient]

With `--gradient` a gradient of all steps by the first velocity, in place of the steps.

The robot is that of `benchmarks.contact_steps`, held by springs and dampers of its joints.
"""

import argparse
import tempfile
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxdyn as jd
from benchmarks.contact_steps import FRICTION, LEG, mjcf
from jaxdyn.compile import wait_for_code

PLACES = [(x, y, -LEG) for x in (0.01, -0.01) for y in (0.01, -0.01)]


def scene(points: int) -> jd.Scene:
    """The quadruped with contacts in some points of each foot."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", jd.io.NotTakenWarning)
        path = Path(folder) / "quadruped.xml"
        path.write_text(mjcf())
        model = jd.load(path).system
    feet = [
        jd.contact.ground_contact(f"shank_{leg}", place, FRICTION, name=f"{leg}{i}")
        for leg in ("fl", "fr", "hl", "hr")
        for i, place in enumerate(PLACES[:points])
    ]
    return jd.Scene(model, forces=feet)


def measure(points: int, steps: int, with_gradient: bool) -> tuple[float, float]:
    """Seconds of the first call, and processor time of a step, or of its part of a gradient, in microseconds."""
    robot = scene(points)
    step, rest = jd.stepper(robot, dt=0.002), jnp.tile(jnp.array([0.0, 0.8, -1.6]), 4)
    q = jd.neutral(robot.system).at[2].set(0.28).at[7:].set(rest)

    def stand(state, _):
        q, v = state
        return step(state, jnp.concatenate([jnp.zeros(6), 40 * (rest - q[7:]) - v[6:]])), None

    def run(q, v):
        return jax.lax.scan(stand, (q, v), length=steps)[0]

    call = jax.jit(jax.grad(lambda q, v: jnp.sum(run(q, v)[0] ** 2), 1) if with_gradient else run)
    start = time.perf_counter()
    jax.block_until_ready(call(q, jnp.zeros(robot.nv)))
    first = time.perf_counter() - start
    wait_for_code()
    used = []
    for _ in range(5):
        start = time.process_time()
        jax.block_until_ready(call(q, jnp.zeros(robot.nv)))
        used.append(time.process_time() - start)
    return first, min(used) / steps * 1e6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", choices=range(1, 5), default=[1, 2, 3, 4])
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--gradient", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print("| contacts | first call, s | step, us |\n|---|---|---|")
    for points in options.points:
        print(
            "| {} | {:.1f} | {:.3g} |".format(4 * points, *measure(points, options.steps, options.gradient)), flush=True
        )


if __name__ == "__main__":
    main()
