"""Batches that are divided between devices. Their number is fixed when jax starts, hence the process of its own."""

import json
import os
import subprocess
import sys

PROGRAM = """
import json
import jax, jax.numpy as jnp
import numpy as np
jax.config.update("jax_enable_x64", True)
import jaxdyn as jd

mesh = jax.sharding.Mesh(np.asarray(jax.devices()), ("batch",))


def steps(q, v):
    return jd.simulate(jd.scenes.double_pendulum(), q, v, jnp.linspace(0.0, 0.2, 3), stepsize=0.01).q[-1]


def acceleration(q, v):
    return jd.constrained_dynamics(jd.scenes.four_bar(), q, v).acceleration


for name, function in (("double_pendulum", steps), ("four_bar", acceleration)):
    q, v = getattr(jd.scenes, name).start()
    starts = jnp.tile(q, (4, 1)), (1.0 + v) * jnp.linspace(1.0, 1.3, 4)[:, None]
    run = jax.jit(jax.vmap(function))
    found, whole = run(*(jax.device_put(x, jax.NamedSharding(mesh, jax.P("batch"))) for x in starts)), run(*starts)
    apart = np.max(np.abs(np.asarray(found) - np.asarray(whole)) / (1 + np.abs(whole)))
    print(json.dumps({"devices": len(found.devices()), "apart": float(apart), "spread": float(np.ptp(whole[:, 0]))}))
"""


def test_a_batch_on_two_devices_is_that_on_one():
    env = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    checks = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(checks) == 2
    for found in checks:
        assert found["devices"] == 2
        assert found["spread"] > 1e-3
        assert found["apart"] < 1e-12
