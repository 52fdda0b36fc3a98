"""Single calls from Python: the ways to call one function of one state, and the floor of each.

    python -m benchmarks.single_calls [--rounds 20]

Best of the rounds in microseconds, interleaved: forward dynamics of an iiwa and the acceleration of a four-bar, by an exported
function, by `jit` around a model that it closes over, with the model as an argument, and without `jit`. Beside them: Pinocchio's
`aba` and `constraintDynamics` from Python, and `jit` of an addition, which is JAX's own part.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin

import jaxdyn as jd
from benchmarks import timing
from benchmarks.constraints import peers, to_pinocchio


def ways(function, model, *state) -> dict:
    """Calls of `function(model, *state)`."""
    known, given = jax.jit(lambda *state: function(model, *state)), jax.jit(function)
    numbers = [np.asarray(x) for x in state]
    exported = jd.export(lambda *state: function(model, *state), *numbers, name="single")
    return {
        "exported": lambda: exported(*numbers),
        "jit, model known": lambda: known(*state).block_until_ready(),
        "jit, model given": lambda: given(model, *state).block_until_ready(),
        "without jit": lambda: function(model, *state).block_until_ready(),
    }


def main(argv=None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    rounds = parser.parse_args(argv).rounds
    jax.config.update("jax_enable_x64", True)
    arm, bars = jd.robots.iiwa(), jd.scenes.four_bar()
    q, v = jnp.full(arm.nq, 0.3), jnp.full(arm.nv, 0.1)
    angles, rates = jd.scenes.four_bar.start()
    floor = jax.jit(lambda x: x + 1)
    source, _ = to_pinocchio(jd.Scene(arm))
    data, state = source.createData(), [np.asarray(x) for x in (q, v, v)]
    peer = peers(bars, angles, rates)["constraintDynamics"]
    cases = {
        "forward dynamics of an iiwa": ways(jd.forward_dynamics, arm, q, v, v)
        | {"Pinocchio": lambda: pin.aba(source, data, *state)},
        "acceleration of a four-bar": ways(
            lambda scene, q, v: jd.constrained_dynamics(scene, q, v).acceleration, bars, angles, rates
        )
        | {"Pinocchio": peer},
    }
    for title, calls in cases.items():
        times = timing.time_alternately(calls | {"jit of an addition": lambda: floor(q).block_until_ready()}, rounds)
        print(f"{title}: " + ", ".join(f"{name} {x['best'] * 1e6:.2f}" for name, x in times.items()) + " us")


if __name__ == "__main__":
    main()
