"""One short motion at a time, under `jax.jit`: microseconds a call, by the threads on which XLA runs what stands around kernels.

    python -m benchmarks.single_motions [--scenes rolling_disk four_bar] [--rounds 20]

Adaptive Dopri8 at 1e-8 over a second, 21 save points; states and result code are kept. Each setting has a process of its own.
Best (median) of the rounds.
"""

import argparse
import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp

import jaxdyn as jd
from benchmarks import timing

IN_ORDER = {"XLA_FLAGS": "--xla_cpu_enable_concurrency_optimized_scheduler=false"}
# Whether JAX hands programs to another thread, and variables of the environment.
SETTINGS = {"as it is": (True, {}), "synchronous": (False, {}), "in order": (True, IN_ORDER), "both": (False, IN_ORDER)}
CALLS = 100  # in a round


def measure(name: str, rounds: int) -> dict:
    """Microseconds of a call."""
    named = getattr(jd.scenes, name)
    scene, (q, v) = named(), named.start()
    ts = jnp.linspace(0.0, 1.0, 21)

    @jax.jit
    def motion(q, v):
        moved = jd.simulate(scene, q, v, ts, rtol=1e-8, atol=1e-8, throw=False)
        return moved.q, moved.result

    def calls():
        for _ in range(CALLS):
            jax.block_until_ready(motion(q, v))

    calls()
    row = timing.interleaved({"motion": calls}, rounds, least=0.0)["motion"]
    return {key: 1e6 * row[key] / CALLS for key in ("best", "median")}


def main(argv=None):
    """Run the benchmark; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=["rolling_disk", "four_bar"])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--here", choices=["asynchronous", "synchronous"], help="in this process alone")
    options = parser.parse_args(argv)
    if options.here:
        jax.config.update("jax_enable_x64", True)
        jax.config.update("jax_cpu_enable_async_dispatch", options.here == "asynchronous")
        print(json.dumps({name: measure(name, options.rounds) for name in options.scenes}))
        return
    print("| scene | setting | us |\n|---|---|---|")
    for setting, (is_asynchronous, variables) in SETTINGS.items():
        command = [sys.executable, "-m", "benchmarks.single_motions", "--rounds", str(options.rounds)]
        command += ["--here", "asynchronous" if is_asynchronous else "synchronous", "--scenes", *options.scenes]
        done = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr)
        for name, us in json.loads(done.stdout.splitlines()[-1]).items():
            print(f"| {name} | {setting} | {us['best']:.0f} ({us['median']:.0f}) |")


if __name__ == "__main__":
    main()
