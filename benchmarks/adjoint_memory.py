"""Memory and time of the gradient of a trajectory fit's loss by each adjoint, as a Markdown table.

    python -m benchmarks.adjoint_memory [--steps 100 1000 4000]

The arm is a chain of seven joints that falls for so many fixed steps of RK4, and the gradient is that of its squared end by the
arm's 70 inertial numbers. Each row runs in a process of its own; memory is that
of the compiled program's temporary buffers.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
ADJOINTS = ("reverse", "direct", "backsolve", "forward")


def measured(adjoint: str, steps: int) -> dict:
    """KiB, seconds and the gradient's norm."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    import jaxdyn as jd
    from jaxdyn.simulation.solvers import RK4

    builder, parent = jd.ModelBuilder("arm"), None
    for i in range(7):
        pose = jnp.eye(4).at[2, 3].set(-0.2 if i else 0.0)
        body = (1.0, (0.02, 0.01, -0.1), (0.01, 0.009, 0.004))
        builder.add_body(f"link{i}", parent, inertia=body, axis=tuple(jnp.eye(3)[i % 3].tolist()), pose=pose)
        parent = f"link{i}"
    model, ts, dt = builder.build(), None, 1e-3
    ts = jnp.asarray([0.0, dt * steps])
    q = 0.3 * jax.random.normal(jax.random.key(0), (7,))

    def loss(inertias):
        arm = model.replace(inertias=inertias)

        motion = jd.simulate(
            arm, q, jnp.zeros(7), ts, solver=RK4(), stepsize=jd.Steps(dt, max_steps=steps + 1), adjoint=adjoint
        )
        return jnp.sum(motion.q[-1] ** 2)

    run = jax.jit((jax.jacfwd if adjoint == "forward" else jax.grad)(loss))
    begun = time.perf_counter()
    compiled = run.lower(model.inertias).compile()
    cold = time.perf_counter() - begun
    memory: Any = compiled.memory_analysis()
    gradient, times = None, []
    for _ in range(3):
        begun = time.perf_counter()
        gradient = jax.block_until_ready(compiled(model.inertias))
        times.append(time.perf_counter() - begun)
    kib = memory.temp_size_in_bytes / 1024
    return {"kib": kib, "cold": cold, "warm": min(times), "norm": float(jnp.linalg.norm(gradient))}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, nargs="+", default=[100, 1000, 4000])
    parser.add_argument("--only", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        print(json.dumps(measured(options.only, options.steps[0])))
        return
    print(
        "| adjoint | steps | memory (KiB) | compiling (s) | a call (s) | norm of the gradient |\n|---|---|---|---|---|---|"
    )
    for adjoint in ADJOINTS:
        for steps in options.steps:
            command = [sys.executable, "-m", "benchmarks.adjoint_memory", "--only", adjoint]
            command += ["--steps", str(steps)]
            done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
            if done.returncode:
                print(f"| {adjoint} | {steps} | {done.stderr.strip().splitlines()[-1]} |")
                continue
            x = json.loads(done.stdout.splitlines()[-1])
            print(
                f"| {adjoint} | {steps} | {x['kib']:.0f} | {x['cold']:.1f} | {x['warm']:.3g} | {x['norm']:.10g} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
