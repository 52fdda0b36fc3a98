"""Rollouts through `jd.simulate` and their gradients: microseconds a step and sample, and gradient over rollout.

    python -m benchmarks.rollouts [--batches 1 1024] [--steps 100] [--rounds 20]

A Panda under RK4 with constant torques, one save point a step. The gradient is that of a sum over the motion in start states,
torques and inertias at once; "given" is the rollout with inertias as arguments. Calls are interleaved; printed are best (median)
and seconds of the first call.
"""

import argparse
import time

import equinox as eqx
import jax
import jax.numpy as jnp

import jaxdyn as jd
from benchmarks import timing
from benchmarks.dynamics import load, states


def measure(batch: int, steps: int, rounds: int, dt: float = 1e-3) -> dict:
    """Both functions on one batch."""
    model, _ = load("panda")
    (q, v, tau), _ = states(model, batch, jnp.float64)
    ts = dt * jnp.arange(steps + 1)

    def motion(model, q, v, tau):
        control = jax.tree_util.Partial(_constant, tau)
        moved = jd.simulate(model, q, v, ts, control=control, stepsize=dt)
        return moved.q, moved.v

    def total(model, q, v, tau):
        return sum(jnp.sum(x**2) for x in jax.vmap(motion, (None, 0, 0, 0))(model, q, v, tau))

    def of_inertias(masses, q, v, tau):
        return total(with_masses(masses), q, v, tau)

    def with_masses(masses):
        return eqx.tree_at(lambda m: m.inertias, model, masses)

    calls = {
        "rollout": jax.jit(jax.vmap(lambda q, v, tau: motion(model, q, v, tau))),
        "given": jax.jit(lambda m, q, v, tau: jax.vmap(lambda q, v, tau: motion(with_masses(m), q, v, tau))(q, v, tau)),
        "gradient": jax.jit(jax.grad(of_inertias, (0, 1, 2, 3))),
    }
    args = {"rollout": (q, v, tau), "given": (model.inertias, q, v, tau), "gradient": (model.inertias, q, v, tau)}
    first = {}
    for name, call in calls.items():
        start = time.perf_counter()
        jax.block_until_ready(call(*args[name]))
        first[name] = time.perf_counter() - start
    runs = {
        name: (lambda call=call, name=name: jax.block_until_ready(call(*args[name]))) for name, call in calls.items()
    }
    us = timing.interleaved(runs, rounds, least=0.0)
    for row in us.values():
        for key in ("best", "median"):
            row[key] *= 1e6 / (batch * steps)
    return {"batch": batch, "us": us, "first": first}


def _constant(tau, q, v, t):
    return tau


def main(argv=None):
    """Run the benchmark; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", nargs="+", type=int, default=[1, 1024])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    print(timing.machine())
    for batch in options.batches:
        row = measure(batch, options.steps, options.rounds)
        for name, us in row["us"].items():
            print(
                batch, name, f"{us['best']:.3g} ({us['median']:.3g}) us a step, first call {row['first'][name]:.2f} s"
            )
        print(
            "gradient / rollout",
            f"{row['us']['gradient']['best'] / row['us']['rollout']['best']:.2f}",
            "gradient / given",
            f"{row['us']['gradient']['best'] / row['us']['given']['best']:.2f}",
        )


if __name__ == "__main__":
    main()
