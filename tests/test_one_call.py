"""Programs in one call: each operation that they may hold, factorisations as loops, whole simulations, and what stays outside."""

import itertools
import re
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxdyn as jd
from jaxdyn import _call_writer, _factor_loops, _one_call
from jaxdyn._marked_call import in_call
from jaxdyn._one_call import one_call
from jaxdyn.report.cases import cases

FEW, MANY = jnp.linspace(0.1, 0.9, 12).reshape(3, 4), jnp.linspace(0.1, 0.9, 60000).reshape(300, 200)
WHERE = jnp.array([[1, 2], [0, 3], [1, 2]])


def _gathered(x):
    return x[WHERE[:, 0], WHERE[:, 1]], x[jnp.argmax(x, 1) % 3], jnp.take(x, WHERE[:, 1], axis=1)


def _scattered(x):
    rows = jnp.arange(x.shape[0])
    several = x.at[WHERE[:, 0], WHERE[:, 1]].add(2.0).at[rows, rows % 4].multiply(3.0)
    return several.at[1].set(x[2]).at[:, 1].max(0.5).at[0].min(0.2), x.at[jnp.array([1, 99, -1]), 0].set(
        7.0, mode="drop"
    )


def _moved(x):
    parts = lax.split(x, (1, x.shape[0] - 1), 0)
    picked = lax.dynamic_slice(x, (x[0, 0].astype(int), 1), (2, 2))
    put = lax.dynamic_update_slice(x, picked, (jnp.argmin(x[:, 0]), 0))
    padded = lax.pad(x, x.dtype.type(0.5), [(1, 2, 0), (0, 0, 1)])
    shapes = lax.expand_dims(x, (0,)).squeeze(0).T[::-1], x[:, None].repeat(2, 1), jnp.stack(jnp.unstack(x[:, 0]))
    return (
        parts,
        picked,
        put,
        padded,
        shapes,
        jnp.concatenate([x, x + 1]),
        jnp.arange(3).astype(x.dtype) + x[:3, 0],
        jnp.array(x, copy=True),
    )


def _smooth(x):
    by_hand = [
        getattr(jnp, name)(x) for name in "sqrt cbrt exp exp2 expm1 log log1p sin cos tan sinh cosh tanh".split()
    ]
    inverse = [jnp.arcsin(x), jnp.arccos(x), jnp.arctan(x), jnp.arcsinh(x), jnp.arccosh(1 + x), jnp.arctanh(x)]
    others = lax.rsqrt(x), lax.logistic(x), lax.erf(x), jnp.arctan2(x, 1 - x), x**3, x**2.3, x**x, lax.square(x)
    return by_hand, inverse, others


def _exact(x):
    whole = (100 * x).astype(jnp.int32)
    bits = (
        whole << 2,
        whole >> 1,
        lax.shift_right_logical(whole, jnp.int32(2)),
        whole & 5,
        whole | 5,
        whole ^ 5,
        ~whole,
        whole % 7,
    )
    floats = jnp.floor(9 * x), jnp.ceil(9 * x), jnp.round(9 * x), jnp.sign(x - 0.5), abs(x - 0.5), -x, x / (1 + x)
    chosen = (
        jnp.where(x > 0.5, x, 1 - x),
        jnp.clip(x, 0.2, 0.7),
        jnp.maximum(x, 0.3),
        jnp.minimum(x, 0.3),
        jnp.isfinite(x),
    )
    compared = x == 0.5, x != 0.5, x < 0.5, x <= 0.5, x > 0.5, x >= 0.5, jnp.nextafter(x, 2.0), (9 * x) % 2.5
    return bits, floats, chosen, compared, lax.add(x, x), lax.sub(x, 1 - x), lax.mul(x, x)


def _reduced(x):
    sums = x.sum(), x.sum(0), x.max(1), x.min(), x[:, :2].prod(1), (x > 0.2).all(0), (x > 0.2).any(1)
    places = jnp.argmax(x, 1), jnp.argmin(x, 0), jnp.argmax(jnp.where(x > 0.5, jnp.nan, x), 1)
    return (
        sums,
        places,
        jnp.cumsum(x, 0),
        jnp.cumprod(x, 1),
        lax.cummax(x),
        lax.cummin(x),
        x[:, :4].T @ x[:, :3],
        x[:0].sum(0),
    )


@jax.custom_jvp
def _own_jvp(x):
    return 2 * x


_own_jvp.defjvp(lambda primals, tangents: (2 * primals[0], 2 * tangents[0]))


@jax.custom_vjp
def _own_vjp(x):
    return 3 * x


_own_vjp.defvjp(lambda x: (3 * x, None), lambda _, g: (3 * g,))


def _controlled(x):
    def step(carry, row):
        carry = lax.cond(row.sum() > carry.sum() / 9, lambda c: c + row, lambda c: 0.5 * c, carry)
        return carry, lax.switch((9 * row[0]).astype(int) % 3, [jnp.sum, jnp.max, lambda r: r[1]], row)

    ran = lax.scan(step, jnp.zeros(x.shape[1], x.dtype), x, reverse=True)
    halved = lax.while_loop(lambda y: y.max() > 1e-3, lambda y: y / 2, x)
    each = jax.vmap(lambda r: lax.while_loop(lambda y: y.sum() > 0.01, lambda y: y / 2, r))(x)
    inner = jax.checkpoint(jnp.sin)(x), jax.jit(jnp.cos)(x), _own_jvp(x), _own_vjp(x), lax.stop_gradient(x)
    return ran, halved, each, inner, jax.vmap(lambda r: lax.fori_loop(0, 3, lambda i, y: y + r[i], r))(x)


OPERATIONS = (_gathered, _scattered, _moved, _smooth, _exact, _reduced, _controlled)


def _same(found, known, tolerance=1e-13):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(known), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


def _in_call(function, *args):
    """What the function is in one call; fails where it is not."""
    compiled = jax.jit(lambda *args: one_call(function, *args)).lower(*args).compile()
    assert _marks(compiled) == 1
    return compiled(*args)


def _marks(compiled) -> int:
    """How many marked calls the program makes; XLA marks some of its own inside of them."""
    return len(re.findall(r' call\([^\n]*inlineable="false",xla_cpu_small_call', compiled.as_text().split("ENTRY")[1]))


@pytest.mark.parametrize("function", OPERATIONS)
@pytest.mark.parametrize("x", [FEW, MANY, FEW.astype(jnp.float32)], ids=["few", "many", "float32"])
def test_operations_in_a_call_are_those_outside(function, x):
    # Other orders of summation; powers and functions of more than one instruction may differ in the last digits.
    # Float32: some hundred roundings of 1e-7, in another order.
    _same(_in_call(function, x), jax.jit(function)(x), 1e-12 if x.dtype == jnp.float64 else 2e-5)


def test_every_operation_that_is_allowed_was_tried():
    names = set()
    for function in OPERATIONS:
        names |= set(_call_writer._names(jax.make_jaxpr(function)(FEW).jaxpr))
        written = jax.make_jaxpr(lambda x, f=function: _call_writer.written(jax.make_jaxpr(f)(x), [x])[0])(FEW)
        names |= set(_call_writer._names(written.jaxpr))
    # Other names of operations that are there.
    assert set(_call_writer._AS_THEY_ARE) - names <= {"add_any", "copy_p", "clamp", "expand_dims", "pow"} | {"split"}


@pytest.mark.parametrize("n", [1, 2, 7, 15])
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_factors_in_a_call_are_lapacks(n, dtype):
    # Entries are sums of n terms, and the matrices have condition numbers up to some hundred, eps being 2e-16 and 1e-7.
    tolerance = (1e-12 if dtype == jnp.float64 else 1e-4) * n
    A = jax.random.normal(jax.random.key(n), (2, n, n), dtype) + 3 * jnp.eye(n, dtype=dtype)[None]
    b = jnp.ones((2, n, 2), dtype)

    def everything(A, b):
        P = A @ A.mT + jnp.eye(n, dtype=dtype)[None]
        solved = jnp.linalg.solve(A, b), jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(P), True), b)
        T = jnp.tril(A / n) + 3 * jnp.eye(n, dtype=dtype)[None]
        triangular = [
            lax.linalg.triangular_solve(
                T if lower else T.mT,
                b if left else b.mT,
                left_side=left,
                lower=lower,
                transpose_a=turned,
                unit_diagonal=unit,
            )
            for left, lower, turned, unit in itertools.product([True, False], repeat=4)
        ]
        return jnp.linalg.cholesky(P), solved, triangular, lax.linalg.lu(A)

    found, known = _in_call(everything, A, b), jax.jit(everything)(A, b)
    for a, k in zip(jax.tree.leaves(found), jax.tree.leaves(known), strict=True):
        np.testing.assert_allclose(a, k, rtol=tolerance, atol=tolerance * float(jnp.abs(k).max()))


@pytest.mark.parametrize("shape", [(4, 4), (6, 3), (3, 6), (1, 1)])
@pytest.mark.parametrize("full_matrices", [True, False])
@pytest.mark.parametrize("rank", [None, 2])
def test_orthogonal_factors_in_a_call(shape, full_matrices, rank):
    A = jax.random.normal(jax.random.key(1), shape)
    if rank is not None:
        A = A[:, :rank] @ A[:rank, :] if min(shape) > rank else jnp.zeros(shape)

    def factors(A):
        return lax.linalg.qr(A, full_matrices=full_matrices), lax.linalg.qr(
            A, pivoting=True, full_matrices=full_matrices
        )

    found = _in_call(factors, A)
    for Q, R, order in ((*found[0], jnp.arange(shape[1])), found[1]):
        np.testing.assert_allclose(Q.T @ Q, jnp.eye(Q.shape[1]), atol=1e-14)
        np.testing.assert_allclose(Q @ R, A[:, order], atol=1e-13)
        assert not jnp.tril(R, -1).any()
    sizes = jnp.abs(jnp.diagonal(found[1][1]))
    assert (sizes[1:] <= sizes[:-1] * (1 + 1e-12) + 1e-14).all()
    if rank is None:
        # Signs and order are LAPACK's.
        _same(found, jax.jit(factors)(A), 1e-12)


def test_a_matrix_that_is_not_definite_has_no_factor():
    assert jnp.isnan(_factor_loops.cholesky(jnp.diag(jnp.array([1.0, -1.0])))).all()
    assert jnp.isnan(_factor_loops.cholesky(jnp.full((2, 2), jnp.nan))).all()


@pytest.mark.parametrize(
    "function",
    [
        jnp.sort,
        jnp.linalg.svd,
        lambda x: jax.random.normal(jax.random.key(x[0, 0].astype(int)), x.shape) + x,
        jnp.fft.fft,
        lambda x: jnp.repeat(x, 40, 1).T @ jnp.repeat(x, 40, 1),
    ],
)
def test_what_cannot_be_written_stays_as_it_is(function):
    compiled = jax.jit(lambda x: one_call(function, x)).lower(FEW).compile()
    assert _marks(compiled) == 0
    _same(compiled(FEW), function(FEW))


def test_what_is_too_long_stays_as_it_is(monkeypatch):
    monkeypatch.setattr(_call_writer, "MOST_OPERATIONS", 10)
    compiled = jax.jit(lambda x: one_call(_controlled, x)).lower(FEW).compile()
    assert _marks(compiled) == 0
    _same(compiled(FEW), jax.jit(_controlled)(FEW))


def test_arguments_of_any_kind():
    # XLA ends the process where a call does not use one of its arguments.
    def first(x, unused, empty, whole, flag):
        return x + 1, whole, flag, empty

    args = FEW, FEW[0], FEW[:0], jnp.arange(3), jnp.array([True, False])
    _same(_in_call(first, *args), first(*args))
    # As many samples as go in a call, and none.
    lanes = jax.vmap(lambda x: one_call(lambda x: (x * 2, x.sum() > 1), x))
    _same(jax.jit(lanes)(FEW), (2 * FEW, FEW.sum(1) > 1))
    assert jax.jit(lanes)(FEW[:0])[0].shape == (0, 4)


def test_large_known_arguments_in_a_loop():
    # XLA knows them there, would write them into the function and then stop at arguments that this does not use.
    known = jnp.linspace(0.0, 1.0, 2000)  # more than 10 kB

    def body(x, table):
        return [x + jnp.sum(table[-3:])]

    def repeated(x):
        def step(_, state):
            program = jax.make_jaxpr(body)(*state)
            return in_call(program)(*state)[0], state[1]

        return lax.fori_loop(0, 10, step, (x, known))[0]

    _same(jax.jit(repeated)(jnp.ones(4)), 1 + 10 * np.sum(np.linspace(0, 1, 2000)[-3:]) * np.ones(4))


def test_long_chains_that_are_built_in_a_program():
    q = 0.3 * jnp.cos(jnp.arange(100))

    def energies(speed):
        chain = jd.robots.chain(100)
        found = jd.simulate(chain, q, speed * jnp.sin(q), jnp.asarray([0.0, 0.02]), stepsize=0.001, outputs=("energy",))
        return found.energy, found.q[-1]

    energy, end = jax.jit(energies)(0.1)
    np.testing.assert_allclose(energy[1], energy[0], rtol=1e-8)  # of RK4
    np.testing.assert_allclose(end, energies(0.1)[1], rtol=0, atol=1e-12)


def test_callbacks_stay_callbacks():
    seen = []

    def note(x):
        jax.debug.callback(lambda y: seen.append(float(y)), x.sum())
        return 2 * x

    def asked(x):
        return jax.pure_callback(lambda y: np.asarray(y) * 2, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    for function in (note, asked):
        _same(jax.jit(lambda x, f=function: one_call(f, x))(FEW), 2 * FEW)
    jax.effects_barrier()
    np.testing.assert_allclose(seen, [float(FEW.sum())])


def test_a_check_that_fails_gives_no_numbers():
    def checked(x):
        return eqx.error_if(x, x.max() > 1, "too large"), jnp.sum(x > 0)

    compiled = jax.jit(lambda x: one_call(checked, x)).lower(FEW).compile()
    assert _marks(compiled) == 1 and "callback" not in compiled.as_text()
    _same(compiled(FEW), (FEW, 12))
    assert jnp.isnan(compiled(9 * FEW)[0]).all()


def test_numbers_that_a_function_holds_are_traced():
    def product(k):
        return one_call(lambda x: {"y": k * x, "n": jnp.arange(3)}, FEW)["y"].sum()

    np.testing.assert_allclose(jax.jit(jax.value_and_grad(product))(2.0), (2 * FEW.sum(), FEW.sum()), rtol=1e-14)


@pytest.mark.parametrize("believed", [True, False])
def test_the_careful_way_is_taken_where_the_quick_one_may_not_be_believed(believed):
    kernel = jd.ModelBuilder("two")
    rod = jd.inertia.displaced(jd.inertia.box(1.0, (0.1, 0.2, 0.5)), (0, 0, -0.25))
    kernel.add_body("upper", joint="spherical", inertia=rod)
    kernel.add_body("lower", "upper", joint="revolute", axis=(0, 1, 0), pose=(0, 0, -0.5), inertia=rod)
    model = kernel.build()
    q, v = jd.neutral(model), jnp.linspace(0.1, 0.4, model.nv)

    def of(add, x):
        return jd.forward_dynamics(model, q, x, x) + add

    def quick(x):
        return of(1.0, x), jnp.asarray(believed)

    found = jax.jit(lambda x: one_call(partial(of, 0.0), x, quick=quick, careful=partial(of, 2.0)))(v)
    np.testing.assert_allclose(found, jax.jit(partial(of, 1.0 if believed else 2.0))(v), rtol=1e-12)
    # Batches, which are larger than what goes in a call, and derivatives are those of the function itself.
    many = jax.jit(jax.vmap(lambda x: one_call(partial(of, 0.0), x, quick=quick, careful=partial(of, 2.0))))
    several = jnp.stack([v] * (_one_call.MOST_SAMPLES + 1))
    np.testing.assert_allclose(many(several)[1], of(0.0, v), rtol=1e-12)
    slope = jax.jacfwd(lambda x: one_call(partial(of, 0.0), x, quick=quick, careful=partial(of, 2.0)))(v)
    np.testing.assert_allclose(slope, jax.jacfwd(partial(of, 0.0))(v), rtol=1e-11, atol=1e-12)


# --- simulations -----------------------------------------------------------------------------------


def _motion(name, count=1, **options):
    """A compiled simulation of a scene of the report, and its arguments."""
    case = cases()[name]
    scene, (q, v) = case.build()
    ts = jnp.asarray(case.ts[:4])

    def run(q, v, tolerance):
        steps = {"rtol": tolerance, "atol": tolerance} if "stepsize" not in options else {}
        return jd.simulate(scene, q, v, ts, throw=False, **steps, **options)

    args = jnp.asarray(q), jnp.asarray(v), jnp.asarray(1e-9)
    if count > 1:
        args = tuple(jnp.stack([x] * count) for x in args)
    return jax.jit(run if count == 1 else jax.vmap(run)).lower(*args).compile(), args


def _ordinary(monkeypatch, name, **options):
    with monkeypatch.context() as patched:
        patched.setattr(_one_call, "IN_CALLS", False)
        run, args = _motion(name, **options)
    assert _marks(run) == 0
    return run(*args)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("free_body", {}),
        ("double_pendulum", {"outputs": ("energy", "acceleration")}),
        ("rolling_disk", {"outputs": ("multipliers", "constraint_residual")}),
        pytest.param("four_bar", {}, marks=pytest.mark.slow),
        ("car_axis", {"stepsize": 0.003}),
        pytest.param("andrews", {}, marks=pytest.mark.slow),
        pytest.param("double_pendulum", {"solver": jd.Rodas5P()}, marks=pytest.mark.slow),
        pytest.param("double_pendulum", {"method": "variational", "stepsize": 0.01}, marks=pytest.mark.slow),
    ],
)
def test_a_simulation_is_one_call(monkeypatch, name, options):
    run, args = _motion(name, **options)
    found, known = run(*args), _ordinary(monkeypatch, name, **options)
    assert _marks(run) == 1
    assert bool(found.success) and bool(known.success)
    # Rounding may decide about a step; two runs at a tolerance of 1e-9 differ by less than ten times that.
    _same((found.q, found.v), (known.q, known.v), 1e-8)
    # Outside of the call there is nothing that takes a microsecond a step: no loop, no library, no callback.
    entry = run.as_text().split("ENTRY")[1]
    assert "while(" not in entry and "custom-call(" not in entry and "callback" not in run.as_text()


def test_dependent_rows_take_the_careful_way(monkeypatch):
    # Two rows that say the same, which kernels do not serve anywhere.
    once = jd.scenes.pendulum_in_plane()
    scene = jd.Scene(once.system, (*once.constraints, *once.constraints))
    q, v = (jnp.asarray(x) for x in jd.scenes.pendulum_in_plane.start())
    ts = jnp.linspace(0.0, 0.2, 3)

    def run(q, v):
        return jd.simulate(scene, q, v, ts, throw=False, rtol=1e-8, atol=1e-8)

    found = jax.jit(run)(q, v)
    with monkeypatch.context() as patched:
        patched.setattr(_one_call, "IN_CALLS", False)
        known = jax.jit(lambda q, v: run(q, v))(q, v)
    assert found.result == known.result
    _same((found.q, found.v), (known.q, known.v), 1e-6)


def test_derivatives_are_those_of_the_ordinary_program(monkeypatch):
    case = cases()["rolling_disk"]
    scene, (q, v) = case.build()
    ts = jnp.linspace(0.0, 0.5, 3)

    def end(v, adjoint):
        found = jd.simulate(scene, q, v, ts, throw=False, rtol=1e-6, atol=1e-6, adjoint=adjoint)
        return jnp.sum(found.q[-1] ** 2)

    v = jnp.asarray(v)
    reverse, forward = (
        jax.jit(jax.grad(end), static_argnums=1)(v, "reverse"),
        jax.jit(jax.jacfwd(end), static_argnums=1),
    )
    with monkeypatch.context() as patched:
        patched.setattr(_one_call, "IN_CALLS", False)
        known = jax.jit(jax.grad(end), static_argnums=1)(v, "reverse")
    _same(reverse, known, 1e-10)
    _same(forward(v, "forward"), known, 1e-5)  # steps of their own at tolerances of 1e-6


def test_times_that_do_not_increase_have_a_code():
    scene, (q, v) = cases()["free_body"].build()

    @jax.jit
    def run(ts):
        return jd.simulate(scene, q, v, ts)

    assert bool(run(jnp.array([0.0, 0.5, 1.0])).success)
    for times in ([0.0, 0.5, 0.5], [0.0, 1.0, 0.5], [0.0, jnp.nan, 1.0]):
        found = run(jnp.array(times))
        assert found.result == jd.RESULTS.unordered_times
        assert jnp.isnan(found.q).all()
