"""Simulations of a few samples in one call against the same as ordinary programs: time to run and to compile.

    python -m benchmarks.one_call [SCENE ...] [--batch 1 8 32] [--tolerance 1e-6] [--rounds 20]

Scenes of `jaxdyn report`, known to the compiled function, by Dopri8. Both programs take turns in one loop.
"""

import argparse
import time

import diffrax
import jax
import jax.numpy as jnp

import jaxdyn as jd
from benchmarks import timing
from jaxdyn import _one_call
from jaxdyn._table import table
from jaxdyn.report.cases import cases

SCENES = ("free_body", "double_pendulum", "rolling_disk", "car_axis", "four_bar", "andrews")


def program(name: str, batch: int, tolerance: float, in_calls: bool):
    """A compiled simulation as a function of no arguments, in calls or not, and seconds to compile it."""
    case = cases()[name]
    scene, (q, v) = case.build()
    ts = jnp.asarray(case.ts)

    def one(q, v):
        how = {"rtol": tolerance, "atol": tolerance, "solver": diffrax.Dopri8(), "throw": False}
        found = jd.simulate(scene, q, v, ts, **how)
        return found.q, found.v, found.result, found.stats

    args = jnp.asarray(q), jnp.asarray(v)
    if batch > 1:
        one, args = jax.vmap(one), tuple(jnp.stack([x] * batch) for x in args)
    usual, _one_call.IN_CALLS = _one_call.IN_CALLS, in_calls
    try:
        began = time.perf_counter()
        run = jax.jit(one).lower(*args).compile()
        return (lambda: jax.block_until_ready(run(*args))), time.perf_counter() - began
    finally:
        _one_call.IN_CALLS = usual


def main(argv=None) -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE")
    parser.add_argument("--batch", nargs="+", type=int, default=(1, 8, 32))
    parser.add_argument("--tolerance", type=float, default=1e-6)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    rows = []
    for name in timing.chosen_names(options.scenes, SCENES):
        for batch in options.batch:
            made = {way: program(name, batch, options.tolerance, way == "call") for way in ("call", "ordinary")}
            found = timing.interleaved({way: run for way, (run, _) in made.items()}, options.rounds)
            times = {way: 1e6 * found[way]["best"] for way in made}
            medians = {way: 1e6 * found[way]["median"] for way in made}
            row = {"scene": name, "batch": batch, "compile": {way: seconds for way, (_, seconds) in made.items()}}
            rows.append(row | {"best_us": times, "median_us": medians})
            print(rows[-1], flush=True)
    timing.write("one_call", {"machine": timing.machine(), "tolerance": options.tolerance, "rows": rows})
    header = ["scene", "batch", "call us", "ordinary us", "ratio", "compile s", "ordinary s"]
    print()
    print(
        table(
            header,
            [
                [
                    row["scene"],
                    str(row["batch"]),
                    *(f"{row['best_us'][way]:.3g} ({row['median_us'][way]:.3g})" for way in ("call", "ordinary")),
                    f"{row['best_us']['call'] / row['best_us']['ordinary']:.2f}",
                    *(f"{row['compile'][way]:.1f}" for way in ("call", "ordinary")),
                ]
                for row in rows
            ],
        )
    )


if __name__ == "__main__":
    main()
