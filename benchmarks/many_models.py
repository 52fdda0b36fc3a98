"""Memory of a process that compiles for one model after the other: MB a model, and seconds.

    python -m benchmarks.many_models [--models 1000] [--bodies 3]

Chains whose numbers differ. "known" closes over each model, which makes a kernel and a program of XLA's for every one of them;
"known, caches cleared" calls `jax.clear_caches` after every hundred, which frees what XLA made and leaves the kernels; "given"
passes the model as an argument, so that all share one kernel. Each in a process of its own, with an empty cache of object files.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time

import jax
import jax.numpy as jnp

import jaxdyn as jd

WAYS = ("known", "known, caches cleared", "given")


def resident() -> float:
    """MB that the process holds now."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20


def compile_for_each(way: str, models: int, bodies: int) -> dict:
    """Forward dynamics of so many models."""
    chain = jd.robots.chain(bodies)
    q, v, tau = (jnp.full(bodies, x) for x in (0.1, 0.2, 0.3))
    given = jax.jit(jd.forward_dynamics)

    def call(i):
        model = chain.replace(inertias=(1 + 1e-3 * i) * chain.inertias)
        if way == "given":
            return given(model, q, v, tau)
        return jax.jit(lambda q, v, tau: jd.forward_dynamics(model, q, v, tau))(q, v, tau)

    for i in range(10):  # what the first ones bring is not counted
        jax.block_until_ready(call(i))
    before, start = resident(), time.perf_counter()
    for i in range(10, 10 + models):
        jax.block_until_ready(call(i))
        if way == "known, caches cleared" and i % 100 == 0:
            jax.clear_caches()
    return {"MB": resident() - before, "seconds": time.perf_counter() - start}


def main(argv=None):
    """Run the benchmark; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", type=int, default=1000)
    parser.add_argument("--bodies", type=int, default=3)
    parser.add_argument("--way", choices=WAYS, help="this one alone, in this process")
    options = parser.parse_args(argv)
    if options.way:
        jax.config.update("jax_enable_x64", True)
        print(json.dumps(compile_for_each(options.way, options.models, options.bodies)))
        return
    print(f"{options.models} chains of {options.bodies} bodies")
    for way in WAYS:
        with tempfile.TemporaryDirectory() as cache:
            args = ["--models", str(options.models), "--bodies", str(options.bodies), "--way", way]
            command = [sys.executable, "-m", "benchmarks.many_models", *args]
            done = subprocess.run(command, env={**os.environ, "XDG_CACHE_HOME": cache}, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr)
        row = json.loads(done.stdout.splitlines()[-1])
        each = 1e3 * row["MB"] / options.models
        print(f"{way}: {row['MB']:.0f} MB more, {each:.0f} kB a model; {row['seconds']:.1f} s")


if __name__ == "__main__":
    main()
