"""Kernels with places that are not known while tracing, against JAX's own operations; messages where there is no kernel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.scipy.linalg import block_diag
from kernel_helpers import quick

import jaxdyn as jd
from jaxdyn.compile import mode
from jaxdyn.compile.kernels import kernel
from jaxdyn.compile.trace import program_of

TABLE = jnp.asarray(np.random.default_rng(0).normal(size=(6, 4)))
KNOTS = jnp.array([-1.0, -0.5, 0.0, 0.0, 0.4, 2.0])


def whole(x):
    """Integers of which some are beyond tables of six rows, and some below."""
    return jnp.floor(4 * x).astype(int)


def as_float(x):
    return x.astype(float)


CASES = {
    "entry": lambda x: TABLE[whole(x[0]), 2] * x,
    "row": lambda x: TABLE[whole(x[0])] * x[1],
    "rows": lambda x: TABLE[whole(x)].T @ x,
    "two places": lambda x: TABLE[whole(x), whole(2 * x)] * x,
    "own entries": lambda x: jnp.outer(x, x)[whole(x)[:2]].sum(0),
    "filled": lambda x: TABLE.at[whole(x), 1].get(mode="fill", fill_value=jnp.nan) * x,
    "clipped": lambda x: TABLE.at[whole(x), 1].get(mode="clip") * x,
    "slice": lambda x: lax.dynamic_slice(TABLE * x[0], (whole(x[1]), whole(x[2])), (2, 3)),
    "slice of an update": lambda x: lax.dynamic_update_slice(TABLE, x[None, :3], (whole(x[1]), whole(x[3]))),
    "added": lambda x: jnp.zeros(5).at[whole(x)].add(x),
    "added twice": lambda x: jnp.zeros((3, 2)).at[jnp.clip(whole(x), 0, 2), jnp.array([0, 1, 0, 1])].add(x * x),
    "set": lambda x: jnp.outer(x, x).at[whole(x[0])].set(jnp.sin(x)),
    "set beyond": lambda x: jnp.zeros(4).at[whole(x[0]) + 2].set(x[1], mode="drop"),
    "added in a batch": lambda x: jax.vmap(lambda i, y: jnp.zeros(4).at[i].add(y))(jnp.clip(whole(x), 0, 3), x),
    "searchsorted": lambda x: x * as_float(jnp.searchsorted(KNOTS, x)),
    "searchsorted from the right": lambda x: (
        x * as_float(jnp.searchsorted(KNOTS, jnp.append(x, 0.0), side="right")[:4])
    ),
    "interp": lambda x: jnp.interp(x, KNOTS[jnp.array([0, 1, 2, 4, 5])], TABLE[:5, 1]) * x,
    "argmax": lambda x: x * as_float(jnp.argmax(x) + jnp.argmin(jnp.outer(x, x), axis=1)),
    "argmax of ties": lambda x: x * as_float(jnp.argmax(jnp.sign(x)) + jnp.argmax(x > 5.0)),
    "argmax of NaN": lambda x: x * as_float(jnp.argmax(jnp.log(x)) + jnp.argmin(jnp.sqrt(x))),
    "select": lambda x: jnp.select([x < -0.5, x < 0, x < 0.3], [x, x**2, jnp.sin(x)], -x),
    "choose": lambda x: lax.select_n(jnp.clip(whole(x), 0, 2), x, jnp.cos(x), x**3),
    "cumprod": lambda x: jnp.cumprod(jnp.outer(x, x), axis=1) + lax.cumsum(x, reverse=True)[None],
    "cummax": lambda x: lax.cummax(jnp.outer(x, x), axis=0) - lax.cummin(x, reverse=True)[None],
    "cut": lambda x: lax.pad(jnp.outer(x, x), 0.5, ((-1, 2, 0), (1, -2, 1))),
    "cut of one entry": lambda x: lax.pad(x, 0.0, ((-2, -1, 0),)),
    "solve": lambda x: jnp.linalg.solve(jnp.sin(9 * jnp.outer(x, jnp.arange(1.0, 5.0))), x),
    "solve of columns": lambda x: jnp.linalg.solve(jnp.cos(9 * jnp.outer(x, jnp.arange(1.0, 5.0))), TABLE[:4]),
    "inverse": lambda x: jnp.linalg.inv(jnp.sin(9 * jnp.outer(x, jnp.arange(1.0, 5.0)))),
    "block_diag": lambda x: block_diag(jnp.outer(x, x)[:2, :2], x[:3, None] * x[None, :2]),
}


# Before jax 0.12 a search is a bisection whose indices are of a type that programs do not have: JAX runs it.
HAS_SEARCHES = jax.__version_info__ >= (0, 12)
needs_searches = pytest.mark.skipif(not HAS_SEARCHES, reason="jax 0.12 is the first whose searches have kernels")


@pytest.mark.parametrize(
    "case", [pytest.param(x, marks=needs_searches) if x.startswith(("search", "interp")) else x for x in CASES]
)
def test_kernels_of_unknown_places(case):
    """Values in a batch, and first derivatives in both modes."""
    function = CASES[case]
    fast = kernel(lambda _, x: function(x))
    assert not isinstance(program_of(lambda _, x: function(x), (), None, (jnp.ones(4),))[1], str)
    # Matrices of condition numbers up to 1e4 magnify the rounding of both.
    loose = 1e5 if case.startswith(("solve", "inverse")) else 1.0
    x = jnp.asarray(np.random.default_rng(1).uniform(-0.7, 1.6, (40, 4)))
    x = x.at[0, 1].set(0.0) if "sorted" in case else x  # on a knot; elsewhere a tie, whose derivative is a choice
    has_derivatives = case not in ("argmax of NaN", "filled")

    def all_of(f):
        modes = (jax.jacfwd, jax.jacrev) if has_derivatives else ()
        return quick(jax.vmap(lambda x: (f(x), *(mode(f)(x) for mode in modes))))

    (value, *found), (wanted, *slopes) = all_of(lambda x: fast(None, x))(x), all_of(function)(x)
    np.testing.assert_allclose(value, wanted, rtol=loose * 1e-13, atol=loose * 1e-14)
    for slope in found:
        np.testing.assert_allclose(slope, slopes[0], rtol=loose * 1e-12, atol=loose * 1e-13)


def law_by_sorting(q, v, t):
    return -0.1 * jnp.sort(v)


def law_by_searching(q, v, t):
    gains = jnp.array([1.0, 2.0, 3.0])
    return -0.1 * gains[jnp.clip(jnp.searchsorted(jnp.array([0.01, 0.02, 0.03]), t), 0, 2)] * v


def test_message_names_the_users_function_once(monkeypatch, caplog):
    """Whatever of the run has no kernel for it: loop, step, sums of a gradient."""
    monkeypatch.setattr(mode, "_said", set())
    scene, ts = jd.scenes.double_pendulum(), jnp.linspace(0.0, 0.05, 3)
    start = jd.scenes.double_pendulum.start()

    def end(q, law):
        return jd.simulate(scene, q, start[1], ts, control=law).q[-1].sum()

    for law in (law_by_searching, law_by_sorting):
        caplog.clear()
        assert np.isfinite(end(start[0], law))
        if law is law_by_sorting:
            assert np.isfinite(jax.grad(end)(start[0], law)).all()
        messages = [record.getMessage() for record in caplog.records if record.name == "jaxdyn"]
        if law is law_by_searching:
            assert not (messages and HAS_SEARCHES)
        else:
            assert len(messages) == 1
            assert messages[0].startswith("jaxdyn: law_by_sorting (test_look_ups.py:")
            assert "sort has no kernel" in messages[0] and messages[0].endswith("or sort outside of the function")
