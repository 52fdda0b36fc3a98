"""What a large result costs where its memory is new: mass matrices of 4096 G1s (40 MB) against zeros written to such memory.

    python -m benchmarks.fresh_pages
    MALLOC_MMAP_THRESHOLD_=1000000000 MALLOC_TRIM_THRESHOLD_=1000000000 python -m benchmarks.fresh_pages

glibc maps blocks of more than 32 MB anew in each call, and Linux clears each page when it is first written. A donated array of
the result's shape does without, and so do the second command's settings of glibc. Milliseconds of a call, best (median) of the
rounds, in which all take turns.
"""

import argparse
import mmap

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import dynamics, timing


def cases(batch: int):
    """Functions to call, by what they do."""
    model, _ = dynamics.load("g1")
    (q, _, _), _ = dynamics.states(model, batch, jnp.float64)
    every = jax.vmap(lambda q: jd.mass_matrix(model, q))
    plain = jax.jit(every)
    reuse = jax.jit(lambda q, old: every(q), donate_argnums=1, keep_unused=True)
    kept = [plain(q)]
    size = kept[0].nbytes
    zeros, ones = np.empty(size // 8), np.ones(size // 8)

    def into_old():
        kept[0] = reuse(q, kept[0])
        return kept[0]

    def into_new():
        with mmap.mmap(-1, size) as memory:
            np.frombuffer(memory).fill(0.0)

    def done(call):
        return lambda: jax.block_until_ready(call())

    return {
        "mass matrices": done(lambda: plain(q)),
        "mass matrices into a donated array": done(into_old),
        "zeros to new memory": into_new,
        "zeros to old memory": lambda: zeros.fill(0.0),
        "copy to old memory": lambda: np.copyto(zeros, ones),
    }


def main(argv=None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    print("| what | ms |\n|---|---|")
    for name, x in timing.time_alternately(cases(options.batch), options.rounds).items():
        print(f"| {name} | {1e3 * x['best']:.2f} ({1e3 * x['median']:.2f}) |")


if __name__ == "__main__":
    main()
