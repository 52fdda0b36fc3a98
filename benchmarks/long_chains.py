"""Forward dynamics of chains and binary trees of up to 500 links: time, how it grows, time to compile, and the residual.

    python -m benchmarks.long_chains [--batch 1 8] [--rounds 20]

The residual is |ID(q, v, FD(q, v, tau)) - tau| relative to the largest of the bias forces. The power of the number of links with
which time grows is fitted to the best times from 50 links on. All contestants take turns in one loop.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import timing
from jaxdyn.model.description import table
from jaxdyn.model.robots import random_tree

COUNTS = (50, 100, 200, 500, 1000)


def program(count: int, branching: int, batch: int):
    """A compiled call as a function of no arguments, seconds to compile it, and the residual of the first sample."""
    model = random_tree(1, count, branching=branching, skew=0.3, taper=1.0, kinds=("revolute",))
    state = [jnp.asarray(x) for x in np.random.default_rng(0).normal(size=(3, batch, count)) * 0.3]

    def accelerations(q, v, tau):
        return jax.vmap(lambda *x: jd.forward_dynamics(model, *x))(q, v, tau)

    began = time.perf_counter()
    run = jax.jit(accelerations).lower(*state).compile()
    seconds = time.perf_counter() - began
    q, v, tau = (x[0] for x in state)
    back = jd.inverse_dynamics(model, q, v, run(*state)[0])
    bias = jd.inverse_dynamics(model, q, v, jnp.zeros_like(v))
    return (lambda: jax.block_until_ready(run(*state))), seconds, float(jnp.abs(back - tau).max() / jnp.abs(bias).max())


def main(argv=None) -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", nargs="+", type=int, default=(1, 8))
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    made = {
        (kind, batch, count): program(count, branching, batch)
        for branching, kind in ((1, "chain"), (2, "tree"))
        for batch in options.batch
        for count in COUNTS
    }
    times = timing.time_alternately({place: run for place, (run, _, _) in made.items()}, options.rounds)
    rows = []
    for kind, batch in dict.fromkeys(place[:2] for place in made):
        best = [1e6 * times[kind, batch, count]["best"] / batch for count in COUNTS]
        power = float(np.polyfit(np.log(COUNTS), np.log(best), 1)[0])
        rows.append(
            {
                "kind": kind,
                "batch": batch,
                "best_us": dict(zip(COUNTS, best, strict=True)),
                "power": power,
                "compile": max(made[kind, batch, count][1] for count in COUNTS),
                "residual": max(made[kind, batch, count][2] for count in COUNTS),
            }
        )
    timing.write("long_chains", {"machine": timing.machine(), "rows": rows})
    header = [
        "links in a",
        "batch",
        *(f"{count}: us" for count in COUNTS),
        "grows as n^",
        "longest compile s",
        "residual",
    ]
    print(
        table(
            header,
            [
                [
                    row["kind"],
                    str(row["batch"]),
                    *(f"{x:.4g}" for x in row["best_us"].values()),
                    f"{row['power']:.2f}",
                    f"{row['compile']:.1f}",
                    f"{row['residual']:.1e}",
                ]
                for row in rows
            ],
        )
    )


if __name__ == "__main__":
    main()
