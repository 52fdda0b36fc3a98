"""Rollouts through `jd.simulate` and their gradients: microseconds a step and sample, and gradient over rollout.

    python -m benchmarks.rollouts [--scenes panda hand_with_ball rolling_disk] [--batches 1 1024] [--steps 100] [--rounds 20]

RK4 steps of 1 ms. A Panda moves under constant torques with one save point a step, for "end" with one at the end; scenes with
constraints (any name of `jd.scenes`) are projected at every step and keep the end. The gradient is that of a sum over the
motion in start states and torques at once, for the Panda also in inertias, for scenes in velocities and torques; "given" is
the rollout with inertias as arguments. Calls are interleaved; printed are best (median) and seconds of the first call.
"""

import argparse
import time

import equinox as eqx
import jax
import jax.numpy as jnp

import jaxdyn as jd
from benchmarks import timing
from benchmarks.dynamics import load, states

STEP = 1e-3  # s


def panda_calls(batch: int, steps: int):
    """Functions of the Panda, and their arguments."""
    model, _ = load("panda")
    (q, v, tau), _ = states(model, batch, jnp.float64)
    all_steps = STEP * jnp.arange(steps + 1)

    def motion(model, q, v, tau, ts=all_steps):
        control = jax.tree_util.Partial(_constant, tau)
        moved = jd.simulate(model, q, v, ts, control=control, stepsize=STEP)
        return moved.q, moved.v

    def with_masses(masses):
        return eqx.tree_at(lambda m: m.inertias, model, masses)

    def of_inertias(masses, q, v, tau):
        return _total(jax.vmap(motion, (None, 0, 0, 0))(with_masses(masses), q, v, tau))

    calls = {
        "rollout": jax.jit(jax.vmap(lambda q, v, tau: motion(model, q, v, tau))),
        "end": jax.jit(jax.vmap(lambda q, v, tau: motion(model, q, v, tau, all_steps[jnp.array([0, -1])]))),
        "given": jax.jit(lambda m, q, v, tau: jax.vmap(lambda q, v, tau: motion(with_masses(m), q, v, tau))(q, v, tau)),
        "gradient": jax.jit(jax.grad(of_inertias, (0, 1, 2, 3))),
    }
    return calls, {
        "rollout": (q, v, tau),
        "end": (q, v, tau),
        "given": (model.inertias, q, v, tau),
        "gradient": (model.inertias, q, v, tau),
    }


def scene_calls(name: str, batch: int, steps: int):
    """Functions of a scene with constraints, and their arguments: its start at speeds that differ by a hundredth."""
    named = getattr(jd.scenes, name)
    scene, (q, v) = named(), named.start()
    ts = jnp.asarray([0.0, STEP * steps])
    contacts = {} if scene.cones is None else {"events": [jd.events.ContactLost(stop=False)]}

    def motion(v, tau):
        control = jax.tree_util.Partial(_constant, tau)
        moved = jd.simulate(scene, q, v, ts, control=control, stepsize=STEP, **contacts)
        return moved.q[-1], moved.v[-1]

    args = v * (1 + 0.01 * jnp.arange(batch) / batch)[:, None], jnp.zeros((batch, scene.nv))

    def total(v, tau):
        return _total(jax.vmap(motion)(v, tau))

    calls = {"rollout": jax.jit(jax.vmap(motion)), "gradient": jax.jit(jax.grad(total, (0, 1)))}
    return calls, dict.fromkeys(calls, args)


def measure(name: str, batch: int, steps: int, rounds: int) -> dict:
    """All functions of one scene on one batch."""
    calls, args = panda_calls(batch, steps) if name == "panda" else scene_calls(name, batch, steps)
    first = {}
    for kind, call in calls.items():
        start = time.perf_counter()
        made = jax.block_until_ready(call(*args[kind]))
        first[kind] = time.perf_counter() - start
        if not all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(made)):
            raise RuntimeError(f"the {kind} of {name} at batch {batch} holds NaN")
    runs = {
        kind: (lambda call=call, kind=kind: jax.block_until_ready(call(*args[kind]))) for kind, call in calls.items()
    }
    us = timing.time_alternately(runs, rounds, minimum=0.0)
    for row in us.values():
        for key in ("best", "median"):
            row[key] *= 1e6 / (batch * steps)
    return {"batch": batch, "us": us, "first": first}


def _total(arrays):
    return sum(jnp.sum(x**2) for x in arrays)


def _constant(tau, q, v, t):
    return tau


def main(argv=None):
    """Run the benchmark; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=["panda"])
    parser.add_argument("--batches", nargs="+", type=int, default=[1, 1024])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    print(timing.machine())
    for name in options.scenes:
        for batch in options.batches:
            row = measure(name, batch, options.steps, options.rounds)
            for kind, us in row["us"].items():
                seconds = row["first"][kind]
                print(
                    f"{name}, {batch}, {kind}: {us['best']:.3g} ({us['median']:.3g}) us a step, first call {seconds:.2f} s"
                )
            best = {kind: us["best"] for kind, us in row["us"].items()}
            print(
                *(
                    f"gradient / {kind} {best['gradient'] / t:.2f}"
                    for kind, t in best.items()
                    if kind in ("rollout", "given")
                )
            )


if __name__ == "__main__":
    main()
