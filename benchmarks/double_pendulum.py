"""Cost of one double pendulum in four formulations: operations and time per evaluation of the accelerations.

    python -m benchmarks.double_pendulum [--batch 4096] [--rounds 20]

Operations are those that XLA counts in the compiled program, sines, roots and the like apart; the library's own sines, of joints,
are polynomials and count as such. The time is the best and the median of interleaved rounds.
"known" has the numbers of the mechanism closed over, "given" takes them as an argument.
"""

import argparse

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import timing

FORMULATIONS = ("lagrangian", "model", "immersion", "loop")


def acceleration(scene, q, v):
    """Acceleration without applied forces."""
    if scene.constraints:
        return jd.constrained_dynamics(scene, q, v, method="schur").acceleration
    return jd.forward_dynamics(scene.system, q, v, jnp.zeros_like(v))


def programs(batch: int) -> dict:
    """Compiled programs and their arguments, by formulation and by how the numbers come."""
    angles, rates = (jnp.asarray(x) for x in np.random.default_rng(0).normal(size=(2, batch, 2)))
    found = {}
    for name in FORMULATIONS:
        scene = jd.scenes.double_pendulum(formulation=name)
        start = lambda a, r, name=name: jd.scenes.double_pendulum.start(formulation=name, angles=a, rates=r)  # noqa: E731
        state = jax.jit(jax.vmap(start))(angles, rates)
        numbers, rest = eqx.partition(scene, eqx.is_array)
        given = lambda numbers, q, v, rest=rest: jax.vmap(acceleration, (None, 0, 0))(eqx.combine(numbers, rest), q, v)  # noqa: E731
        known = lambda q, v, scene=scene: jax.vmap(acceleration, (None, 0, 0))(scene, q, v)  # noqa: E731
        found[name, "known"] = jax.jit(known).lower(*state).compile(), state
        found[name, "given"] = jax.jit(given).lower(numbers, *state).compile(), (numbers, *state)
    return found


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
        for key, (program, arguments) in compiled.items()
    }
    times = timing.interleaved(contestants, options.rounds)
    print(f"float64, batch {options.batch}")
    print(f"{'':24}{'flops':>10}{'sines, roots':>14}{'ns best':>10}{'ns median':>12}{'to model':>10}")
    rows = []
    for (name, numbers), (program, _) in compiled.items():
        cost = program.cost_analysis()
        flops, sines = (cost.get(key, 0.0) / options.batch for key in ("flops", "transcendentals"))
        best, median = (1e9 * times[name, numbers][key] / options.batch for key in ("best", "median"))
        ratio = times[name, numbers]["best"] / times["model", numbers]["best"]
        rows.append(
            {
                "formulation": name,
                "numbers": numbers,
                "flops": flops,
                "transcendentals": sines,
                "best": best,
                "median": median,
            }
        )
        print(f"{name + ', ' + numbers:24}{flops:10.0f}{sines:14.0f}{best:10.1f}{median:12.1f}{ratio:10.2f}")
    print(timing.write("double_pendulum", {"machine": timing.machine(), "batch": options.batch, "rows": rows}))


if __name__ == "__main__":
    main()
