"""Rows of one sample by the kernel of one sample: the numbers of `lax.map`, in blocks."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from pinocchio_bridge import quick

import jaxdyn as jd
from jaxdyn.compile.batch import AT_ONCE, map_rows
from jaxdyn.constraints import selection

pytestmark = pytest.mark.native

model = jd.robots.chain(2)


def acceleration(row):
    q, v = row
    return {"a": jd.forward_dynamics(model, q, v, jnp.ones(2)), "e": jd.kinetic_energy(model, q, v)}


def states(count: int):
    return tuple(jnp.asarray(x) for x in np.random.default_rng(count).normal(size=(2, count, 2)))


@pytest.mark.parametrize("count", [1, 2, AT_ONCE, AT_ONCE + 1, 3 * AT_ONCE - 2])
def test_rows_are_those_of_a_map(count):
    rows = states(count)
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-13),
        map_rows(acceleration, rows),
        lax.map(acceleration, rows),
    )


def kernels(function, *args) -> list[str]:
    """Numbers of the kernels that a function calls."""
    return re.findall(r"program = (\d+)", jax.jit(function).lower(*args).as_text())


def test_rows_of_one_sample_take_its_kernel_and_those_of_a_batch_that_of_a_batch():
    def torque(row, weight):
        return jd.inverse_dynamics(model, *row, weight)

    rows, weight = states(5), jnp.ones(2)
    single = kernels(lambda row, weight: torque(row, weight), tuple(x[0] for x in rows), weight)
    of_rows = kernels(lambda rows, weight: map_rows(lambda row: torque(row, weight), rows), rows, weight)
    assert len(single) == 1 and of_rows == single  # although the weight is the same for all rows
    batch = kernels(jax.vmap(lambda row, weight: torque(row, weight), ((0, 0), None)), rows, weight)
    many = tuple(jnp.stack([x] * 3) for x in rows)
    both = kernels(jax.vmap(lambda rows: map_rows(lambda row: torque(row, weight), rows)), many)
    assert len(batch) == len(both) == 1 and batch != single and both != single


def test_rows_of_which_nothing_is_computed_are_not_copied_in_blocks():
    rows = states(3 * AT_ONCE)
    handed_on = jax.make_jaxpr(lambda rows: map_rows(lambda row: row[::-1], rows))(rows)
    computed = jax.make_jaxpr(lambda rows: map_rows(lambda row: row[0] + row[1], rows))(rows)
    assert "scan" not in str(handed_on) and "scan" in str(computed)
    q, v = map_rows(lambda row: row[::-1], rows)
    assert (q == rows[1]).all() and (v == rows[0]).all()


@pytest.mark.parametrize("count", [3, AT_ONCE + 3])
def test_rows_are_batched_and_differentiated(count):
    rows = states(count)
    many = tuple(jnp.stack([x, 0.5 * x]) for x in rows)
    scales = jnp.asarray([1.0, 2.0])

    def total(mapped, rows, scale):
        def of_row(row):
            return jd.forward_dynamics(model.replace(inertias=scale * model.inertias), *row, jnp.ones(2))

        return jnp.sum(mapped(of_row, rows) ** 2)

    def derivatives(way, *at):
        function = partial(total, way)
        return function(*at), jax.grad(function, (0, 1))(*at), jax.jacfwd(function, (0, 1))(*at)

    ours, theirs = (quick(jax.vmap(partial(derivatives, way)))(many, scales) for way in (map_rows, lax.map))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12), ours, theirs)


@pytest.mark.long
@pytest.mark.parametrize("name", ["bennett", "goldberg"])
def test_rows_are_not_counted_where_a_search_left_them_open(name, monkeypatch):
    """Off the constraints every row looks independent: where Newton's method has not closed them the start itself decides."""
    scene, q = getattr(jd.scenes, name)(), jnp.asarray(getattr(jd.scenes, name).start()[0])
    t, apart = jnp.zeros(()), 1e-5
    sure, *_ = selection.eliminate(selection.unit_rows(scene, q, t), apart, jnp.zeros(5))
    for steps in (12, 0):
        monkeypatch.setattr(selection, "_NEWTON_STEPS", steps)
        kept, *_ = selection._select_far_away(scene, q, t, sure, apart)
        assert float(jnp.sum(kept)) == scene.nv - 1, steps
