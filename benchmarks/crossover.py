"""Where one way of computing dynamics overtakes another: what the limits of `jaxdyn/_dispatch.py` are chosen by.

    python -m benchmarks.crossover [--rounds 20]

Microseconds per sample of forward and inverse dynamics by the matrix form, the recursion and the loops over bodies, each
inside a `lax.scan` of calls, so that the cost of calling from Python does not count: batches of an arm of seven bodies, single
samples of mechanisms of one to four freedoms, and of chains of 16 to 256 bodies.
"""

import argparse

import jax
import jax.numpy as jnp

import jaxdyn as jd
from benchmarks import timing
from jaxdyn import _dispatch, looped, matrix_form, recursive
from jaxdyn._materialize import at_least
from jaxdyn._table import table

WAYS = {
    "forward": {"matrices": matrix_form.forward_dynamics, "recursion": recursive.aba, "loops": looped.forward_dynamics},
    "inverse": {
        "matrices": matrix_form.inverse_dynamics,
        "recursion": recursive.rnea,
        "loops": looped.inverse_dynamics,
    },
}
BATCHES = (16, 64, 128, 256, 512, 1024)
SMALL = ("revolute",), ("spherical",), ("revolute", "revolute"), ("revolute",) * 3, ("revolute",) * 4
LENGTHS = (16, 32, 64, 128, 256)


def program(way, model, batch: int, calls: int):
    """A compiled function of no arguments that makes `calls` evaluations of `batch` samples, each of the one before."""
    q = jd.integrate(model, jd.neutral(model), 0.1 * jnp.cos(jnp.arange(model.nv)))
    v = 0.1 * jnp.sin(1 + jnp.arange(model.nv))

    def one(q, v, force):
        # Values are kept as if batches of this size were large; one sample keeps none, as tiny mechanisms do not.
        with at_least(batch if batch > 1 else _dispatch.LEAST_BATCH):
            return way(model, q, v, force)

    several = one if batch == 1 else jax.vmap(one)
    if batch > 1:
        q, v = (x + 1e-3 * jnp.arange(float(batch))[:, None] * jnp.cos(x) for x in (q, v))

    def repeated(q, v):
        return jax.lax.scan(lambda force, _: (1e-3 * several(q, v, force), None), jnp.zeros_like(v), None, calls)[0]

    run = jax.jit(repeated).lower(q, v).compile()
    return lambda: run(q, v).block_until_ready()


def rows(kind: str, cases, rounds: int):
    """Cells for (label, model, batch, names of ways): microseconds per sample by each way, and the cheapest one's name."""
    for label, model, batch, names in cases:
        calls = max(1, 512 // (batch * model.nb))
        runs = {name: program(WAYS[kind][name], model, batch, calls) for name in names}
        timed = timing.interleaved(runs, rounds)
        found = {name: 1e6 * timed[name]["best"] / (calls * batch) for name in names}
        cells = [f"{found[name]:.3g}" if name in found else "" for name in WAYS[kind]]
        yield [kind, label, str(batch), *cells, min(found, key=found.get)]  # pyright: ignore[reportArgumentType]


def cases():
    """What is compared: where each limit of the dispatch lies."""
    arm = jd.robots.iiwa()
    found = [("arm of 7", arm, batch, ("matrices", "recursion")) for batch in BATCHES]
    for joints in SMALL:
        model = jd.robots.random_tree(0, len(joints), kinds=joints, branching=1)
        found.append((f"{len(joints)} bodies, {model.nv} freedoms", model, 1, ("matrices", "recursion")))
    return found + [(f"chain of {n}", jd.robots.chain(n), 1, ("matrices", "loops")) for n in LENGTHS]


def main(argv=None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    limits = {name: getattr(_dispatch, name) for name in ("LEAST_BATCH", "FEW_FREEDOMS", "MOST_BODIES", "MOST_IN_MASK")}
    print(", ".join(f"{name} = {value}" for name, value in limits.items()))
    found = [row for kind in WAYS for row in rows(kind, cases(), options.rounds)]
    header = ["dynamics", "mechanism", "batch", *WAYS["forward"], "cheapest"]
    print(table(header, found))
    print("Microseconds per sample, the best of the rounds.")
    print(
        "written to", timing.write("crossover", timing.machine() | {"limits": limits, "header": header, "rows": found})
    )


if __name__ == "__main__":
    main()
