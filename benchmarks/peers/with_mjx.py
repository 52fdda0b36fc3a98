"""MuJoCo MJX: the trees without loops of `with_mujoco`, in JAX, compiled with all of their steps."""

import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from benchmarks.peers.steps import steps_between
from benchmarks.peers.twins import TWINS
from benchmarks.peers.with_mujoco import INTEGRATORS, STAGES, to_mujoco
from jaxdyn.reports.run import Contestant, Motion

SCENES = ("double_pendulum", "free_body")


def contestants(prepared, starts) -> list[Contestant]:
    """Rungs of RK4, one compiled program."""
    if prepared.case.name not in SCENES:
        return []
    twin = TWINS[prepared.case.name]()
    q, v = (jnp.asarray(x) for x in twin.there(*starts[:2]))
    span = float(prepared.reference.ts[1] - prepared.reference.ts[0])
    points = len(prepared.reference.ts) - 1
    source = to_mujoco(twin)
    source.opt.integrator = INTEGRATORS["RK4"]
    model, blank = mjx.put_model(source), mjx.make_data(source)

    def all_of_them(q, v, between):
        timed = model.tree_replace({"opt.timestep": span / between})

        def one(q, v):
            def save(data, _):
                data = jax.lax.fori_loop(0, between, lambda i, data: mjx.step(timed, data), data)
                return data, (data.qpos, data.qvel)

            return jax.lax.scan(save, blank.replace(qpos=q, qvel=v), length=points)[1]

        return jax.vmap(one)(q, v)

    began = time.perf_counter()
    run = jax.jit(all_of_them).lower(q, v, 1).compile()
    seconds = time.perf_counter() - began

    def contestant(between):
        call = lambda: jax.block_until_ready(run(q, v, between))  # noqa: E731

        def motion(computed) -> Motion:
            rows = [np.concatenate([x[:1], np.asarray(y[0])]) for x, y in zip((q, v), computed, strict=True)]
            steps = between * points
            return Motion(*twin.back(*rows), "successful", steps, 0, STAGES["RK4"] * steps)

        return Contestant(
            f"MJX {mujoco.__version__}", "joint angles", "RK4", span / between, True, call, motion, seconds
        )

    return [contestant(between) for between in steps_between(prepared, 3)]
