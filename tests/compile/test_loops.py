"""Loops of programs: the operations of JAX that take a loop's place on other devices have its numbers."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile.batch import while_loop
from jaxdyn.compile.loops import Carry, Given, Iteration, Task, run_loop


def _turn(tree, constants, state, _):
    x, count = state
    after = 0.5 * (tree @ x) + constants
    return Iteration((after, count + 1), count < 20, count + 1 < 20)


def _by_turns(tree, constants, given, carry):
    def step(state):
        return _turn(tree, constants, state, ()).state

    return Carry(while_loop(lambda state: state[1] < 20, step, carry.state))


TASK = Task(_turn, _by_turns, ())


def _iterate(matrix, offset, x):
    carry, always_ends = run_loop(TASK, matrix, offset, Given(), Carry((x, jnp.zeros((), jnp.int32))))
    assert always_ends
    return carry.state[0]


def test_operations_of_a_loop_take_arrays_of_any_shape():
    """The tree of a loop has a matrix, which other devices get as the native loop does: flat."""
    rng = np.random.default_rng(0)
    matrix, offset = rng.normal(size=(2, 2)) / 2, rng.normal(size=2)
    x = rng.normal(size=(5, 2))
    over = jax.vmap(_iterate, (None, None, 0))
    wanted = x.copy()
    for _ in range(20):
        wanted = 0.5 * wanted @ matrix.T + offset
    np.testing.assert_allclose(jax.jit(over)(matrix, offset, x), wanted, rtol=1e-13, atol=1e-14)
    (call,) = [eqn for eqn in jax.make_jaxpr(_iterate)(matrix, offset, x[0]).eqns if "program" in eqn.params]
    loop = call.params["program"]
    count = np.zeros((5, 1), np.int32)
    flat = np.tile(matrix.reshape(-1), (5, 1)), np.tile(offset, (5, 1)), x, count
    np.testing.assert_allclose(loop.as_operations(*flat)[0], wanted, rtol=1e-13, atol=1e-14)
