"""Cost of redundant rows: a planar four-bar, the same in space with five rows of which two count, and a robot with four loops.

    python -m benchmarks.redundant_rows [--rounds 20]

Microseconds a sample: of one call under `jit`, and of batches. "held": the robot's scene with its choice of rows
(`jd.constraints.choose_rows`); its file has few digits, so that the rows of a scene without one are searched in each call.
"""

import argparse

import jax
import jax.numpy as jnp

import jaxdyn as jd
from benchmarks import timing
from benchmarks.first_calls import robot_file
from benchmarks.overconstrained import tilted_four_bar

CASSIE = "cassie_description/robots/cassie_v2.sdf"


def cases() -> dict:
    """Scenes with a state on their constraints, and the size of a batch."""
    bars, (q, v) = jd.scenes.four_bar(), jd.scenes.four_bar.start()
    robot = jd.load(robot_file(CASSIE), floating_base=True)
    stands = jd.assemble(robot, robot.starts["reference"].q).q
    at_rest = jnp.zeros(robot.nv)
    return {
        "four-bar in the plane": (bars, q, v, 1024),
        "four-bar in space": (tilted_four_bar().scene, q, v, 1024),
        "robot with four loops": (robot, stands, at_rest, 256),
        "robot with four loops, held": (jd.constraints.choose_rows(robot, stands), stands, at_rest, 256),
    }


def functions(scene: jd.Scene) -> dict:
    """What is timed, of one sample."""
    times = jnp.asarray([0.0, 0.05])

    def accelerate(q, v):
        return jd.constrained_dynamics(scene, q, v).acceleration

    return {
        "acceleration": accelerate,
        "projection": lambda q, v: jd.constraints.projections(scene, q).P_T,
        "gradient": jax.grad(lambda q, v: jnp.sum(accelerate(q, v)), 1),
        "50 steps of RK4": lambda q, v: jd.simulate(scene, q, v, times, stepsize=1e-3, throw=False).q[-1],
    }


def main(argv=None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    rounds = parser.parse_args(argv).rounds
    jax.config.update("jax_enable_x64", True)
    print("| us a sample | batch | " + " | ".join(functions(jd.scenes.four_bar())) + " |\n|---|---|---|---|---|---|")
    for title, (scene, q, v, count) in cases().items():
        for batch in (1, count):
            state = jnp.tile(q, (batch, 1)), jnp.tile(v, (batch, 1))
            cells = []
            for function in functions(scene).values():
                run = jax.jit(jax.vmap(function))
                jax.block_until_ready(run(*state))
                best = min(
                    timing.once(lambda run=run, state=state: jax.block_until_ready(run(*state))) for _ in range(rounds)
                )
                cells.append(f"{best / batch * 1e6:.3g}")
            print(f"| {title} | {batch} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
