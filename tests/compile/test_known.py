"""Values that are computed once for known trees."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.compile.known import once
from jaxdyn.simulation import checks


class Pair(eqx.Module):
    """A tree of two leaves."""

    first: object
    second: object


@pytest.fixture
def counted():
    """A function that is computed once, and the trees for which it has been computed."""
    seen = []

    @once
    def total(tree, *, factor=1.0):
        seen.append(tree)
        return factor * float(np.sum(np.asarray(tree.first) + np.asarray(tree.second)))

    return total, seen


def test_the_same_leaves_are_computed_once(counted):
    total, seen = counted
    x = jnp.arange(3.0)
    pair = Pair(x, 1.0)
    assert [total(pair), total(pair), total(Pair(x, 1.0))] == [6.0, 6.0, 6.0]
    assert len(seen) == 1
    # Another array, another static value, another type of number, and another mode are other keys.
    assert total(Pair(jnp.arange(3.0), 1.0)) == 6.0 and len(seen) == 2
    assert total(pair, factor=2.0) == 12.0 and len(seen) == 3
    assert total(Pair(x, 1)) == 6.0 and len(seen) == 4
    total(Pair(x, 0.0))
    total(Pair(x, -0.0))
    assert len(seen) == 6
    with jd.compilation("plain"):
        total(pair)
    with jax.enable_x64(False):
        total(pair)
    assert len(seen) == 8


def test_what_can_be_changed_is_compared_by_value(counted):
    total, seen = counted
    x, items = np.arange(3.0), {"a": 1.0}
    pair = Pair(x, 1.0)
    assert total(pair) == total(pair) == 6.0 and len(seen) == 1
    x[0] = 5.0
    assert total(pair) == 11.0 and len(seen) == 2

    @once
    def value(tree):
        return tree["a"]

    assert value(items) == 1.0
    items["a"] = 2.0
    assert value(items) == 2.0


def test_nothing_is_kept_within_a_trace(counted):
    _, seen = counted

    @once
    def double(tree):
        seen.append(tree)
        return 2.0 * jnp.asarray(tree.first)

    pair, x = Pair(jnp.ones(()), 1.0), jnp.asarray(3.0)
    assert jax.jit(lambda x: x + double(pair))(x) == 5.0
    assert jax.grad(lambda x: double(Pair(x, 1.0)))(x) == 2.0
    assert double(pair) == 2.0 and len(seen) == 3


@pytest.mark.native
def test_a_second_run_finds_what_its_numbers_do_not_decide(monkeypatch):
    """And refuses what the first one would have refused: numbers are checked in every call."""
    scene, (q, v) = jd.scenes.four_bar(), jd.scenes.four_bar.start()
    ts, seen, check = jnp.linspace(0.0, 0.1, 3), [], checks.check_drives
    monkeypatch.setattr(checks, "check_drives", lambda *args: seen.append(args) or check(*args))
    first, again = (jd.simulate(scene, q, v, ts).q for _ in range(2))
    assert len(seen) == 1 and (first == again).all()
    longer = eqx.tree_at(lambda x: x.system.home, scene, scene.system.home * 1.0)
    np.testing.assert_array_equal(jd.simulate(longer, q, v, ts).q, first)
    assert len(seen) == 2
    with pytest.raises(ValueError, match="on the constraints"):
        jd.simulate(scene, q + 0.1 * jnp.arange(3.0), v, ts)
    with pytest.raises(ValueError, match="q0 is nan"):
        jd.simulate(scene, q.at[0].set(jnp.nan), v, ts)
    with pytest.raises(ValueError, match="outputs has 'heat'"):
        jd.simulate(scene, q, v, ts, outputs=("heat",))
    with pytest.raises(ValueError, match="adjoint is 'backward'"):
        jd.simulate(scene, q, v, ts, adjoint="backward")
