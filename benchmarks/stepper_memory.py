"""What reverse mode keeps of 400 steps of `jd.stepper` for 1024 arms of seven joints under a linear feedback, float64.

python -m benchmarks.stepper_memory
"""

import jax
import jax.numpy as jnp

import jaxdyn as jd

SAMPLES, STEPS = 1024, 400


def kept(inside: bool, remat: bool) -> float:
    """Megabytes that the gradient in the gains needs beside its inputs, as XLA plans them."""
    model = jd.robots.iiwa()
    step = jd.stepper(
        jd.Scene(model, forces=(jd.forces.CoulombFriction(0.3, 0.05), jd.forces.EffortLimits(50.0))), 0.01, remat=remat
    )

    def loss(gains, q, v):
        def law(q, v, t):
            return -gains[0] @ q - gains[1] @ v

        def advance(state, _):
            return step(state, law if inside else law(*state, 0.0)), None

        q, v = jax.lax.scan(advance, (q, v), None, length=STEPS)[0]
        return jnp.sum(q * q)

    states = jnp.zeros((SAMPLES, 7)), jnp.zeros((SAMPLES, 7))
    gradient = jax.grad(lambda gains: jnp.sum(jax.vmap(loss, (None, 0, 0))(gains, *states)))
    plan = jax.jit(gradient).lower(jnp.ones((2, 7, 7))).compile().memory_analysis()
    return plan.temp_size_in_bytes / 1e6


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(f"{STEPS} steps of {SAMPLES} iiwa arms, states alone {SAMPLES * STEPS * 14 * 8 / 1e6:.0f} MB:")
    for inside, remat, words in (
        (True, True, "the law given to step"),
        (False, True, "its torques given to step"),
        (False, False, "the same, remat=False"),
    ):
        print(f"{words:28s} {kept(inside, remat):8.0f} MB", flush=True)
