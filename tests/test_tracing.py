"""What is traced once, for which trees, and what a program knows of the batch around it."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn._dispatch import LEAST_BATCH, is_large_batch
from jaxdyn._implicit import along
from jaxdyn._tracing import compiled, is_concrete, is_one_sample, traced_once


def test_a_tree_is_traced_once_and_its_known_leaves_stay_known():
    seen = []

    def times(tree, x, power):
        seen.append([is_concrete(leaf) for leaf in tree])
        return tree[0] * x**power + tree[1]

    known, x, y = (jnp.asarray(number, float) for number in (2.0, 3.0, 1.0))

    def program(x, y):
        return traced_once(times, (known, y), x, static=(3,)) + traced_once(times, (known, y), 2 * x, static=(3,))

    assert float(jax.jit(program)(x, y)) == 2 * 27 + 1 + 2 * 216 + 1
    assert float(jax.jit(jax.grad(program))(x, y)) == 6 * 9 + 12 * 36
    assert float(jax.jit(jax.grad(program, 1))(x, y)) == 2
    assert jax.jit(jax.vmap(program, (0, None)))(jnp.arange(3.0), y).tolist() == [2.0, 20.0, 146.0]
    assert seen == [[True, False]]
    # Another static argument, or another leaf though of the same value, is another program.
    assert float(jax.jit(lambda x: traced_once(times, (known, x), x, static=(2,)))(3.0)) == 21
    assert float(jax.jit(lambda x: traced_once(times, (known + 0, x), x, static=(2,)))(3.0)) == 21
    assert len(seen) == 3
    assert traced_once(times, (known, 1.0), 3.0, 2) == 19 and seen[3] == [True, True]  # nothing is traced here


def test_entries_that_are_set_later_are_seen():
    numbers = np.array([1.0, 2.0])

    def total(tree, x):
        return jnp.sum(tree[0]) * x

    def run():
        return float(jax.jit(lambda x: traced_once(total, (numbers,), x))(1.0))

    assert run() == 3 and run() == 3
    numbers[0] = 5.0
    assert run() == 7


def test_a_program_that_is_called_with_known_numbers_holds_one_sample():
    seen = []

    def look(x):
        seen.append((is_one_sample(), is_large_batch(x)))
        inside = jax.vmap(lambda y: jnp.where(is_large_batch(y), y, -y))(jnp.full((LEAST_BATCH,), 1.0) * x)
        return x + jnp.sum(inside)

    program = compiled(look)
    assert float(program(1.0)) == 1.0 + LEAST_BATCH  # a batch inside of it is still counted
    assert seen.pop() == (True, False) and not seen
    assert jax.vmap(program)(jnp.ones(2)).tolist() == [1.0 + LEAST_BATCH] * 2
    assert float(jax.grad(program)(1.0)) == 1.0 + LEAST_BATCH
    assert float(jax.jit(program)(1.0)) == 1.0 + LEAST_BATCH
    assert [alone for alone, _ in seen] == [False, False, False]
    assert not is_one_sample()


def test_along_gives_the_value_and_its_change():
    def function(a, b):
        return a * b[0], b[1]

    value, change = along(function, (2.0, (3.0, 4.0)), [1.0, None, 5.0])
    assert value == (6.0, 4.0) and change == (3.0, 5.0)
    assert along(function, (2.0, (3.0, 4.0)), [None, None, None]) == ((6.0, 4.0), None)
