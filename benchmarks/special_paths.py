"""What each special path of `jaxdyn.compile` brings: the same calls with and without it, in fresh processes.

    python -m benchmarks.special_paths [loop rows shared constants] [--clock cpu] [--rounds 9]

Seconds of a first call with an empty cache of object files, and microseconds of a later one, best of the rounds; "brings" is the
part of the time without the path that it saves. Processor time ("cpu") holds on a busy machine too.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

import jaxdyn as jd
from benchmarks import first_calls, timing
from benchmarks.first_calls import CLOCKS
from jaxdyn.compile import array_rules, batch, expansion, kernels, primitive

CALLS = 20  # in a round


def motion(name: str, points: int, batch: int = 0) -> Callable:
    """A second of a given scene, adaptive steps at 1e-8."""
    named = getattr(jd.scenes, name)
    scene, (q, v) = named(), named.start()
    ts = jnp.linspace(0.0, 1.0, points)

    def one(scene, q, v):
        return jd.simulate(scene, q, v, ts, stepsize=jd.simulation.Steps(rtol=1e-8, atol=1e-8), throw=False).q

    if not batch:
        run = jax.jit(one)
        return lambda: run(scene, q, v)
    run, q, v = jax.jit(jax.vmap(one, (None, 0, 0))), jnp.tile(q, (batch, 1)), jnp.tile(v, (batch, 1))
    return lambda: run(scene, q, v)


def accelerations(which) -> Callable:
    """Forward dynamics of 1024 states of a given robot."""
    model, *state = first_calls.robot(*which)
    run = jax.jit(jax.vmap(jd.forward_dynamics, (None, 0, 0, 0)))
    state = [jnp.tile(x, (1024, 1)) for x in state]
    return lambda: run(model, *state)


def without_loop() -> None:
    """Steps are turns of a loop of XLA's."""
    patched: Any = kernels
    patched._run_natively = lambda *_: None


def without_rows() -> None:
    """Rows of save points go one by one."""
    for module in list(sys.modules.values()):
        if module is not batch and getattr(module, "map_rows", None) is batch.map_rows:
            module.map_rows = lax.map  # pyright: ignore[reportAttributeAccessIssue]


def without_shared() -> None:
    """What samples share is computed by each block of them."""
    patched: Any = primitive
    patched.split_program = lambda *_: None


def without_constants() -> None:
    """Known arrays are computed by JAX."""
    patched: Any = expansion
    patched.evaluate_known = array_rules.bind_known


CASES: dict[str, tuple[Callable[[], None], dict[str, Callable[[], Callable]]]] = {
    "loop": (without_loop, {name: lambda name=name: motion(name, 21) for name in ("four_bar", "rolling_disk")}),
    "rows": (
        without_rows,
        {
            "four_bar, 1001 points": lambda: motion("four_bar", 1001),
            "rolling_disk, 101 points": lambda: motion("rolling_disk", 101),
            "64 four_bar, 21 points": lambda: motion("four_bar", 21, 64),
        },
    ),
    "shared": (
        without_shared,
        {"panda": lambda: accelerations(first_calls.PANDA), "g1": lambda: accelerations(first_calls.G1)},
    ),
    "constants": (
        without_constants,
        {name: lambda name=name: motion(name, 21) for name in ("four_bar", "rolling_disk")},
    ),
}


def here(path: str, case: str, is_off: bool, clock: str, rounds: int) -> tuple[float, float]:
    """Seconds of the first call and of a later one, in this process."""
    jax.config.update("jax_enable_x64", True)
    switch, cases = CASES[path]
    if is_off:
        switch()
    call, now = cases[case](), CLOCKS[clock]
    start = now()
    jax.block_until_ready(call())
    first, later = now() - start, []
    for _ in range(rounds):
        start = now()
        for _ in range(CALLS):
            jax.block_until_ready(call())
        later.append((now() - start) / CALLS)
    return first, min(later)


def elsewhere(path: str, case: str, is_off: bool, clock: str, rounds: int) -> tuple[float, float]:
    """The same in a fresh process with an empty cache."""
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, "-m", "benchmarks.special_paths", path, "--here", case, "--clock", clock]
        command += ["--rounds", str(rounds), *(["--off"] if is_off else [])]
        done = subprocess.run(command, env=os.environ | {"XDG_CACHE_HOME": cache}, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{path}, {case} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main(argv=None) -> None:
    """Measure and print; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("paths", nargs="*", metavar="PATH", help=", ".join(CASES))
    parser.add_argument("--clock", choices=list(CLOCKS), default="wall")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--here", help=argparse.SUPPRESS)
    parser.add_argument("--off", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    names = timing.chosen_names(options.paths, CASES)
    if options.here:
        print(json.dumps(here(names[0], options.here, options.off, options.clock, options.rounds)))
        return
    print(
        "| path | case | first call, with / without (s) | later call, with / without (us) | brings |\n|---|---|---|---|---|"
    )
    for path in names:
        for case in CASES[path][1]:
            on, off = (elsewhere(path, case, x, options.clock, options.rounds) for x in (False, True))
            later = f"{1e6 * on[1]:.0f} / {1e6 * off[1]:.0f}"
            brings = f"{1 - on[0] / off[0]:.0%}, {1 - on[1] / off[1]:.0%}"
            print(f"| {path} | {case} | {on[0]:.2f} / {off[0]:.2f} | {later} | {brings} |", flush=True)


if __name__ == "__main__":
    main()
