"""One short motion at a time: microseconds a call, by the threads on which XLA runs what stands around kernels.

    python -m benchmarks.single_motions [--scenes rolling_disk four_bar] [--rounds 20] [--clock cpu]

Adaptive Dopri8 at 1e-8 over a second, 21 save points; states and result code are kept. Each setting has a process of its own.
Best (median) of the rounds. The scene is

- "known": closed over in a function under `jax.jit`, so that its numbers are compiled in;
- "given": an argument of that function, so that its numbers are inputs of the kernels;
- "called": `jd.simulate` is called outside of `jax.jit`, where scenes are given, and checks its arguments at each call.

"given" over "known" is what numbers that are not compiled in cost. Processor time ("cpu") holds on a busy machine too.
"""

import argparse
import json
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd

IN_ORDER = {"XLA_FLAGS": "--xla_cpu_enable_concurrency_optimized_scheduler=false"}
# Whether JAX hands programs to another thread, and variables of the environment.
SETTINGS = {"as it is": (True, {}), "synchronous": (False, {}), "in order": (True, IN_ORDER), "both": (False, IN_ORDER)}
CALLS = 100  # in a round


CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
KINDS = ("known", "given", "called")


def measure(name: str, rounds: int, clock: str) -> dict:
    """Microseconds of a call of each kind: best and median."""
    named = getattr(jd.scenes, name)
    scene, (q, v) = named(), named.start()
    ts = jnp.linspace(0.0, 1.0, 21)

    def motion(scene, q, v, throw):
        moved = jd.simulate(scene, q, v, ts, stepsize=jd.Steps(rtol=1e-8, atol=1e-8), throw=throw)
        return moved.q, moved.result

    known = jax.jit(lambda q, v: motion(scene, q, v, False))
    given = jax.jit(lambda scene, q, v: motion(scene, q, v, False))
    run = {
        "known": lambda: known(q, v),
        "given": lambda: given(scene, q, v),
        "called": lambda: motion(scene, q, v, True),
    }
    now, spent = CLOCKS[clock], {kind: [] for kind in KINDS}
    for count in range(rounds + 1):  # the first one compiles
        for kind in KINDS:
            start = now()
            for _ in range(CALLS if count else 1):
                jax.block_until_ready(run[kind]())
            if count:
                spent[kind].append(1e6 * (now() - start) / CALLS)
    return {kind: (min(us), float(np.median(us))) for kind, us in spent.items()}


def main(argv=None):
    """Run the benchmark; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=["rolling_disk", "four_bar"])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--clock", choices=list(CLOCKS), default="wall")
    parser.add_argument("--here", choices=["asynchronous", "synchronous"], help="in this process alone")
    options = parser.parse_args(argv)
    if options.here:
        jax.config.update("jax_enable_x64", True)
        jax.config.update("jax_cpu_enable_async_dispatch", options.here == "asynchronous")
        print(json.dumps({name: measure(name, options.rounds, options.clock) for name in options.scenes}))
        return
    print(
        f"| scene | setting | {' | '.join(f'{kind} (us)' for kind in KINDS)} | given / known |\n|---|---|---|---|---|---|"
    )
    for setting, (is_asynchronous, variables) in SETTINGS.items():
        command = [sys.executable, "-m", "benchmarks.single_motions", "--rounds", str(options.rounds)]
        command += ["--clock", options.clock]
        command += ["--here", "asynchronous" if is_asynchronous else "synchronous", "--scenes", *options.scenes]
        done = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr)
        for name, us in json.loads(done.stdout.splitlines()[-1]).items():
            cells = [f"{us[kind][0]:.0f} ({us[kind][1]:.0f})" for kind in KINDS]
            ratio = us["given"][0] / us["known"][0]
            print(f"| {name} | {setting} | {' | '.join(cells)} | {ratio:.2f} |", flush=True)


if __name__ == "__main__":
    main()
