"""Cost of one double pendulum in four formulations: operations and time per evaluation of the accelerations.

    python -m benchmarks.double_pendulum [--batch 4096] [--rounds 20]

Operations are those of the kernel of one sample; sines, roots and the like are among them, and are counted apart too. The time is
the best and the median of interleaved rounds.
"known" has the numbers of the mechanism closed over, "given" takes them as an argument.
"""

import argparse

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import timing
from benchmarks.operations import Operations, operations

FORMULATIONS = ("lagrangian", "model", "immersion", "loop")


def acceleration(scene, q, v):
    """Acceleration without applied forces."""
    if scene.constraints:
        return jd.constrained_dynamics(scene, q, v, method="schur").acceleration
    return jd.forward_dynamics(scene.system, q, v, jnp.zeros_like(v))


def programs(batch: int) -> dict:
    """Compiled programs, their arguments and their operations, by formulation and by how the numbers come."""
    angles, rates = (jnp.asarray(x) for x in np.random.default_rng(0).normal(size=(2, batch, 2)))
    computed = {}
    for name in FORMULATIONS:
        scene = jd.scenes.double_pendulum(formulation=name)
        start = lambda a, r, name=name: jd.scenes.double_pendulum.start(formulation=name, angles=a, rates=r)  # noqa: E731
        state = jax.jit(jax.vmap(start))(angles, rates)
        numbers, rest = eqx.partition(scene, eqx.is_array)
        given = lambda numbers, q, v, rest=rest: acceleration(eqx.combine(numbers, rest), q, v)  # noqa: E731
        known = lambda q, v, scene=scene: acceleration(scene, q, v)  # noqa: E731
        one = [x[0] for x in state]
        batched = jax.jit(jax.vmap(known)).lower(*state).compile()
        computed[name, "known"] = batched, state, operations(known, *one)
        batched = jax.jit(jax.vmap(given, (None, 0, 0))).lower(numbers, *state).compile()
        computed[name, "given"] = batched, (numbers, *state), operations(given, numbers, *one)
    return computed


def main() -> None:
    """Print the table and write it into out/."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--batch", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    compiled = programs(options.batch)
    contestants = {
        key: lambda program=program, arguments=arguments: jax.block_until_ready(program(*arguments))
        for key, (program, arguments, _) in compiled.items()
    }
    times = timing.time_alternately(contestants, options.rounds)
    print(f"float64, batch {options.batch}")
    print(f"{'':24}{'operations':>12}{'sines, roots':>14}{'ns best':>10}{'ns median':>12}{'to model':>10}")
    rows = []
    for (name, numbers), (_, _, counted) in compiled.items():
        counted = counted or Operations(0, 0, 0)  # no kernel
        best, median = (1e9 * times[name, numbers][key] / options.batch for key in ("best", "median"))
        ratio = times[name, numbers]["best"] / times["model", numbers]["best"]
        rows.append(
            {
                "formulation": name,
                "numbers": numbers,
                "operations": counted.all,
                "functions": counted.functions,
                "best": best,
                "median": median,
            }
        )
        print(
            f"{name + ', ' + numbers:24}{counted.all:12}{counted.functions:14}{best:10.1f}{median:12.1f}{ratio:10.2f}"
        )
    print(timing.write("double_pendulum", {"machine": timing.machine(), "batch": options.batch, "rows": rows}))


if __name__ == "__main__":
    main()
