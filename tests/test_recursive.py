"""The recursions against Pinocchio, against the matrix form, and against their own identities; how they compile."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_bridge import as_dtype, assert_close, load_robot, quick, random_states, random_tree, to_pinocchio

from jaxdyn import _dispatch, matrix_form, recursive
from jaxdyn._materialize import materialize
from jaxdyn._trig import sin_cos
from jaxdyn.joints import KINDS

ALL = list(KINDS)
TREES = {
    "every kind": lambda: random_tree(1, ALL),
    "floating, no armature": lambda: random_tree(
        3, ["free", "revolute", "prismatic", "helical", "spherical"], armature=False
    ),
}


def everything(model):
    """All recursive quantities at one sample, with the model's numbers known or (when it is traced) unknown."""

    def at(q, v, a, tau):
        return {
            "rnea": recursive.rnea(model, q, v, a),
            "bias": recursive.bias_force(model, q, v),
            "gravity": recursive.gravity_force(model, q),
            "aba": recursive.aba(model, q, v, tau),
            "crba": recursive.crba(model, q),
            "sqrt": recursive.mass_matrix_sqrt(model, q),
            "inverse": recursive.mass_matrix_inverse_times(model, q, tau),
        }

    return at


@pytest.mark.parametrize(
    "name", ["every kind", *(pytest.param(n, marks=pytest.mark.slow) for n in TREES if n != "every kind")]
)
def test_against_pinocchio(name):
    model = TREES[name]()
    source, bridge = to_pinocchio(model)
    data = source.createData()
    q, v, a, tau, _ = random_states(model, 4, 7)
    got = quick(jax.vmap(everything(model)))(q, v, a, tau)
    # The same with the model's numbers unknown while tracing, and the other implementation.
    traced = quick(lambda model, *x: jax.vmap(lambda *y: recursive.aba(model, *y))(*x))(model, q, v, tau)
    assert_close(traced, got["aba"], 1e-12, "traced")
    other = quick(jax.vmap(lambda *y: matrix_form.forward_dynamics(model, *y)))(q, v, tau)
    assert_close(other, got["aba"], 1e-10, "matrix form")
    for i, q_pin in enumerate(bridge.q_to_pinocchio(q)):
        vi, ai, ti = (np.asarray(x[i]) for x in (v, a, tau))
        mass = pin.crba(source, data, q_pin)
        mass = np.triu(mass) + np.triu(mass, 1).T
        assert_close(got["rnea"][i], pin.rnea(source, data, q_pin, vi, ai), 1e-11, "rnea")
        assert_close(got["bias"][i], pin.nonLinearEffects(source, data, q_pin, vi), 1e-11, "bias")
        assert_close(got["gravity"][i], pin.computeGeneralizedGravity(source, data, q_pin), 1e-11, "gravity")
        assert_close(got["aba"][i], pin.aba(source, data, q_pin, vi, ti), 1e-10, "aba")
        assert_close(got["crba"][i], mass, 1e-11, "crba")
        assert_close(got["inverse"][i], np.linalg.solve(mass, ti), 1e-10, "inverse")
        root = np.asarray(got["sqrt"][i])
        assert_close(root @ root.T, mass, 1e-11, "W W^T")
        assert_close(np.prod(np.diag(root)) ** 2, np.linalg.det(mass), 1e-9, "det M = prod W_kk^2")


def test_root_of_a_chain_is_triangular():
    model = random_tree(4, ["revolute", "prismatic", "helical", "revolute"], parents=[-1, 0, 1, 2])
    root = recursive.mass_matrix_sqrt(model, random_states(model, 1, 0)[0][0])
    assert np.array_equal(np.tril(root, -1), np.zeros((4, 4)))
    assert (np.diag(root) > 0).all()


def test_float32():
    model = as_dtype(TREES["every kind"](), jnp.float32)
    q, v, a, _, _ = random_states(model, 3, 5)
    got = quick(jax.vmap(lambda q, v, a: recursive.rnea(model, q, v, a)))(q, v, a)
    assert got.dtype == jnp.float32
    wide = as_dtype(model, jnp.float64)
    exact = quick(jax.vmap(lambda q, v, a: matrix_form.inverse_dynamics(wide, q, v, a)))
    want = exact(*(jnp.asarray(x, jnp.float64) for x in (q, v, a)))
    # A dozen bodies, each a few roundings of 6e-8 on partly cancelling sums.
    assert_close(got, want, 2e-5)


@pytest.mark.parametrize("dtype,most", [(jnp.float64, 1e7), (jnp.float32, 1e4)])
def test_sine_and_cosine(dtype, most):
    rng = np.random.default_rng(0)
    exact = np.array([0.0, -0.0, 1e-300, np.pi / 4, np.pi / 2, np.pi, -np.pi, 1e-7])
    x = np.concatenate([exact, rng.uniform(-4, 4, 300), rng.uniform(-1, 1, 300) * np.geomspace(4, most, 300)])
    x = np.asarray(x, dtype)
    s, c = sin_cos(jnp.asarray(x))
    eps = float(jnp.finfo(dtype).eps)
    mpmath.mp.prec = 200
    for got, exact in ((s, mpmath.sin), (c, mpmath.cos)):
        want = np.array([float(exact(mpmath.mpf(float(xi)))) for xi in x])
        assert np.abs(np.asarray(got, float) - want).max() < 1.1 * eps
    # Beyond the reach of the split, the error is that of rounding the argument once.
    far = np.asarray([most * 1e3, -most * 1.7e4], dtype)
    s, _ = sin_cos(jnp.asarray(far))
    assert np.abs(np.asarray(s, float) - np.sin(far.astype(float))).max() < 2 * eps * np.abs(far.astype(float)).max()
    assert np.isnan(sin_cos(jnp.asarray([jnp.inf, jnp.nan], dtype))[0]).all()
    second = jax.vmap(jax.grad(jax.grad(lambda x: sin_cos(x)[0])))(jnp.asarray(x[:300]))
    assert_close(second, -np.sin(x[:300].astype(float)), 4 * eps)


def test_materialize_is_the_identity():
    x = jnp.linspace(0.1, 1.0, 5)

    def f(x, keep):
        y = jnp.sin(x) * x
        (y,) = materialize(y) if keep else (y,)
        return jnp.sum(y * y * jnp.exp(y))

    for transform in (
        lambda f: f,
        jax.grad,
        jax.hessian,
        lambda f: jax.jacfwd(jax.grad(f)),
        lambda f: jax.vmap(jax.grad(f)),
    ):
        points = jnp.stack([x, 2 * x]) if transform(f) is not f and "vmap" in repr(transform(f)) else x
        for wrap in (lambda g: g, jax.jit):
            with_it = wrap(transform(lambda x: f(x, True)))(points)
            assert_close(with_it, transform(lambda x: f(x, False))(points), 1e-14)
    assert materialize(1, 0.5, x)[:2] == [1, 0.5]


def test_nothing_is_recomputed():
    """The compiled recursion has at most linearly many fusions, and no flop of it grows with depth (XLA's fusion trap)."""
    counts, flops = [], []
    for n in (4, 8):
        model = random_tree(6, ["revolute"] * n, parents=list(range(-1, n - 1)), armature=False)
        states = [jnp.zeros((64, n)) for _ in range(3)]
        compiled = quick(jax.vmap(lambda q, v, tau, m=model: recursive.aba(m, q, v, tau))).lower(*states).compile()
        counts.append(compiled.as_text().count(" fusion("))
        flops.append(compiled.cost_analysis()["flops"])
    assert counts[1] < 2.6 * counts[0] and flops[1] < 2.6 * flops[0], (counts, flops)
    # Without kept values everything fuses into a few giant fusions that recompute each other.
    assert counts[0] > 100


def test_known_zeros_are_left_out():
    """A robot whose numbers are known while tracing costs fewer operations than the same robot as an argument."""
    _, model, _ = load_robot("panda_description/urdf/panda.urdf", lock=("finger",))
    states = [jnp.zeros((64, 7)) for _ in range(3)]
    known = jax.make_jaxpr(jax.vmap(lambda *x: recursive.rnea(model, *x)))(*states)
    given = jax.make_jaxpr(lambda m, *x: jax.vmap(lambda *y: recursive.rnea(m, *y))(*x))(model, *states)
    known, given = (sum(eqn.primitive.name in ("mul", "add", "sub") for eqn in j.eqns) for j in (known, given))
    assert known < 0.6 * given, (known, given)


def test_dispatch_follows_the_batch():
    """Large batches run on the recursion and small ones on matrices, wherever the vmap stands; all give the same numbers.

    Of inverse dynamics: forward dynamics of a known model runs in a kernel, see test_one_kernel.
    """
    model = random_tree(8, ["revolute", "prismatic", "spherical"])
    q, v, _, tau, _ = random_states(model, 256, 3)

    def f(q, v, a):
        return _dispatch.inverse_dynamics(model, q, v, a)

    def kept(g, *x):
        """Number of `materialize` calls in the compiled program: the mark of the recursion."""
        return quick(g).lower(*x).compile().as_text().count(" conditional(")

    assert kept(f, q[0], v[0], tau[0]) == kept(jax.vmap(f), q[:4], v[:4], tau[:4]) == 0
    split = [x.reshape(16, 16, -1) for x in (q, v, tau)]
    want = quick(jax.vmap(lambda *x: matrix_form.inverse_dynamics(model, *x)))(q, v, tau)
    for g, args in ((jax.vmap(f), (q, v, tau)), (jax.vmap(jax.jit(f)), (q, v, tau)), (jax.vmap(jax.vmap(f)), split)):
        assert kept(g, *args) > 10
        assert_close(quick(g)(*args).reshape(256, -1), want, 1e-10)
    assert_close(f(q[0], v[0], tau[0]), want[0], 1e-12)


def test_tiny_mechanisms_run_in_a_few_calls_whatever_the_batch():
    model = random_tree(8, ["revolute", "prismatic", "revolute"])
    q, v, _, tau, _ = (x[0] for x in random_states(model, 1, 3))
    program = quick(lambda *x: _dispatch.forward_dynamics(model, *x)).lower(q, v, tau).compile()
    text = program.as_text()
    assert text.count(" fusion(") < 20 and " dot(" not in text and " conditional(" not in text
    assert_close(program(q, v, tau), matrix_form.forward_dynamics(model, q, v, tau), 1e-12)


def test_derivatives_of_forward_dynamics():
    """Both implementations, every argument and leaf, forward and reverse, order 2, against finite differences."""
    model = random_tree(9, ["spherical", "helical"])
    q, v, _, tau, _ = random_states(model, _dispatch.LEAST_BATCH, 3)
    leaves = eqx.filter(model, eqx.is_array)

    def loss(leaves, q, v, tau):
        return jnp.sum(jnp.sin(_dispatch.forward_dynamics(eqx.combine(leaves, model), q, v, tau)))

    # Matrix form (one sample) against recursion (a batch), every leaf.
    single = quick(jax.grad(loss, (0, 1, 2, 3)))(leaves, q[0], v[0], tau[0])
    batch = quick(jax.vmap(jax.grad(loss, (0, 1, 2, 3)), (None, 0, 0, 0)))(leaves, q, v, tau)
    for name, one, many in zip(itertools.count(), jax.tree.leaves(single), jax.tree.leaves(batch), strict=False):
        assert_close(many[0], one, 1e-9, f"leaf {name}")
    # Along a line through (q, v, tau), on the recursion: first and second derivative against five-point differences.
    rng = np.random.default_rng(1)
    step = [jnp.asarray(rng.normal(size=x.shape[1:])) for x in (q, v, tau)]
    h = 2e-4
    points = h * jnp.asarray(np.tile([-2.0, -1.0, 0.0, 1.0, 2.0], 52))

    def along(s):
        return loss(leaves, q[0] + s * step[0], v[0] + s * step[1], tau[0] + s * step[2])

    def line(s):
        return along(s), jax.grad(along)(s), jax.jvp(jax.grad(along), (s,), (jnp.ones(()),))[1]

    value, first, second = (np.asarray(x[:5]) for x in quick(jax.vmap(line))(points))
    stencil = np.array([1, -8, 0, 8, -1]) / (12 * h)
    # Differences of numbers near 1 over steps of 2e-4 keep eleven digits, and leave h^4 times a fifth derivative.
    assert_close(first[2], stencil @ value, 1e-8)
    assert_close(second[2], stencil @ first, 1e-8)
