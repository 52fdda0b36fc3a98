"""Functions on eight devices against one: a program of its own, as the number of devices is fixed when jax starts.

python tests/divided.py compare    a line of JSON for each function: `test_sharding.py` reads them
python tests/divided.py cached     the same for one function, and whether the compilation cache had its program
"""

import json
import os
import re
import sys
from collections import Counter
from functools import partial

os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import jax.numpy as jnp
import numpy as np
from jax import monitoring

import jaxdyn as jd
from jaxdyn.identify import methods

jax.config.update("jax_enable_x64", True)
COLLECTIVES = "all-reduce|all-gather|all-to-all|reduce-scatter|collective-permute|collective-broadcast"
AUTO, EXPLICIT = jax.sharding.AxisType.Auto, jax.sharding.AxisType.Explicit
model = jd.robots.iiwa()
states = tuple(jax.random.normal(jax.random.key(0), (3, 16, model.nv)))


def exchanged(program) -> dict:
    """What devices exchange in a compiled program, by the names of XLA."""
    return Counter(re.findall(rf"\s({COLLECTIVES})(?:-start)?\(", program.as_text()))


def compare(name, function, *args):
    """Whether results on many devices are those on one, and what the compiled program exchanges."""
    program = jax.jit(function).lower(*args).compile()
    divided, whole = program(*args), jax.jit(function)(*jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), args))
    leaves = [*zip(jax.tree.leaves(divided), jax.tree.leaves(whole), strict=True)]
    difference = max(float(np.max(np.abs(np.asarray(a) - b) / (1 + np.abs(b)))) for a, b in leaves)
    shards = len({str(shard.index) for shard in leaves[0][0].addressable_shards})
    kernels = program.as_text().count('custom_call_target="jaxdyn_kernel"')
    computed = {"name": name, "apart": difference, "calls": exchanged(program), "shards": shards, "kernels": kernels}
    print(json.dumps(computed))


def dynamics(q, v, tau):
    return jd.forward_dynamics(model, q, v, tau)


def rollout(q, v):
    times = jnp.linspace(0.0, 0.02, 3)
    return jd.simulate(model, q, v, times, stepsize=0.01, throw=False).q[-1]


many = jax.vmap(dynamics)


def size(q, v, tau):
    return jnp.sum(dynamics(q, v, tau) ** 2)


gradient = jax.vmap(jax.grad(size, (0, 1, 2)))


def fit(scale, q, v, a):
    """Mean square of the torques of a model whose inertias are scaled, and its derivative in the scale."""

    def loss(scale):
        scaled = model.replace(inertias=model.inertias * scale)
        return jnp.mean(jax.vmap(lambda q, v, a: jnp.sum(jd.inverse_dynamics(scaled, q, v, a) ** 2))(q, v, a))

    return jax.value_and_grad(loss)(scale)


def local_fit(mesh):
    """The same where the user divides the batch: JAX inserts the sum over devices of the derivative itself."""

    def each(scale, *rows):
        loss, slope = fit(scale, *rows)
        return jax.lax.pmean(loss, "batch"), slope / mesh.size

    rows = [jax.P("batch")] * 3
    return jax.shard_map(each, mesh=mesh, in_specs=(jax.P(), *rows), out_specs=(jax.P(), jax.P()))


def acceleration(q, v):
    return jd.constrained_dynamics(jd.scenes.four_bar(), q, v).acceleration


def divided(mesh):
    here = jax.NamedSharding(mesh, jax.P("batch"))
    return [jax.device_put(x, here) for x in states]


def compare_all():
    scale, shared = jnp.asarray(1.1), jax.vmap(dynamics, (0, 0, None))
    for kind, axis in (("", AUTO), (" explicit", EXPLICIT)):
        mesh = jax.make_mesh((8,), ("batch",), axis_types=(axis,))
        rows = divided(mesh)
        compare("dynamics" + kind, many, *rows)
        compare("gradient" + kind, gradient, *rows)
        compare("fit" + kind, fit, scale, *rows)
    mesh = jax.make_mesh((8,), ("batch",), axis_types=(AUTO,))
    q, v, _ = rows = divided(mesh)
    compare("rollout", jax.vmap(rollout), q, v)
    compare("shared torque", shared, q, v, states[2][0])
    everywhere = jax.NamedSharding(mesh, jax.P())
    compare("one of three", many, jax.device_put(states[0], everywhere), v, states[2])
    compare("fit in shard_map", local_fit(mesh), scale, *rows)
    here = jax.NamedSharding(mesh, jax.P("batch"))
    factors = jnp.linspace(1.0, 2.0, 16)[:, None]
    q, v = jd.scenes.four_bar.start()
    start = [jax.device_put(x, here) for x in (jnp.tile(q, (16, 1)), factors * v)]
    compare("four-bar", jax.vmap(acceleration), *start)
    rows = jax.P("batch")
    local = jax.shard_map(jax.vmap(acceleration), mesh=mesh, in_specs=rows, out_specs=rows)
    compare("four-bar in shard_map", local, *start)
    plane = jax.make_mesh((2, 4), ("one", "other"), axis_types=(AUTO, AUTO))
    grid = jax.NamedSharding(plane, jax.P("one", "other"))
    compare("two axes", jax.vmap(many), *(jax.device_put(x.reshape(4, 4, model.nv), grid) for x in states))


def compare_cached():
    seen = []
    monitoring.register_event_listener(lambda event, **_: seen.append(event))
    q, v, _ = divided(jax.make_mesh((8,), ("batch",), axis_types=(AUTO,)))
    shared = jax.vmap(dynamics, (0, 0, None))
    program = jax.jit(shared).lower(q, v, states[2][0])
    seen.clear()
    program.compile()
    print(json.dumps(sum(event.endswith("cache_hits") for event in seen)))
    compare("cached", shared, q, v, states[2][0])


def arm(mass):
    """Two links about parallel axes, and their torques along a motion that is known."""
    builder = jd.ModelBuilder("arm")
    for name, parent in (("a", None), ("b", "a")):
        body = (mass, (0.02, 0.01, -0.5), mass * np.array([0.1, 0.09, 0.02]))
        builder.add_body(name, parent, pose=(0, 0, -1.0 if parent else 0.0), axis=(0, 1, 0), inertia=body)
    return builder.build()


def log_of(model, phase):
    t = np.linspace(0.0, 1.0, 41)
    angle = np.array([2.0, 3.0]) * t[:, None] + phase
    q, v, a = np.sin(angle), np.array([2.0, 3.0]) * np.cos(angle), -np.array([4.0, 9.0]) * np.sin(angle)
    return jd.identify.Log(t, q, v, a, np.asarray(jax.vmap(partial(jd.inverse_dynamics, model))(q, v, a)))


def compare_fits(*names):
    true, nominal = arm(1.2), arm(1.0)
    logs = [log_of(true, phase) for phase in (0.3, 1.1)]
    damped = jd.Scene(true, forces=(jd.forces.JointDamping(0.1 * jnp.ones(2)),))
    motion, torque = jd.identify.Objective(horizon=10, substeps=2), jd.identify.Objective("torque")
    damping = jd.identify.Parameters(damped).free(lambda scene: scene.forces[0].coefficient)
    inertias = jd.identify.Parameters(nominal).inertias()
    fits = {
        "trajectory": (nominal, inertias, motion, "lbfgs"),
        "slopes": (damped, damping, motion, "gauss-newton"),
        "torque": (damped, damping, torque, "lbfgs"),
    }
    evaluate, programs = methods._evaluate, []

    def fit(name, devices=None):
        system, tree, objective, method = fits[name]
        solver, execution = jd.identify.Solver(method, steps=2), jd.identify.Execution(devices=devices)
        return jd.identify.fit_parameters(system, logs, tree, objective, solver, execution)

    def noted(*args):
        programs.append(evaluate.lower(*args).compile()) if not programs else None
        return programs[0](*args)

    for name in names:
        one = fit(name)
        methods._evaluate = noted
        many = fit(name, jax.devices())
        methods._evaluate = evaluate
        calls = exchanged(programs.pop().compiled) if programs else {}
        history = [np.asarray(computed.history).tolist() for computed in (one, many)]
        print(json.dumps({"name": name, "calls": calls, "history": history}))


if __name__ == "__main__":
    what, *names = sys.argv[1:]
    {"compare": compare_all, "cached": compare_cached, "fits": compare_fits}[what](*names)
