"""Functions of single numbers in one kernel: against the function itself, in any order of folding, and how they compile."""

import functools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from pinocchio_bridge import random_states, random_tree

import jaxdyn as jd
from jaxdyn import _one_kernel, matrix_form, projection, recursive, scenes
from jaxdyn._dispatch import MOST_BODIES
from jaxdyn._one_kernel import kernel_of
from jaxdyn._scalar_program import scalar_program
from jaxdyn.constrained import constrained_dynamics, solve_rows
from jaxdyn.constraints.base import rows
from jaxdyn.joints import KINDS


@pytest.fixture(autouse=True)
def everywhere(monkeypatch):
    """Kernels in calls outside of loops too, so that these need no loop around them."""
    monkeypatch.setattr(_one_kernel, "AT_ONE_CALL", 0)


def mixed(factors, x, n, flag):
    """Arrays of several dtypes and shapes, known numbers, reductions, and outputs that are arguments or constants."""
    rows = jnp.stack([x, factors * x[::-1], jnp.where(flag, x, -x)])
    total = jnp.sum(rows, axis=0) + jnp.min(rows) * n.astype(x.dtype)
    return {
        "total": total,
        "corner": rows[1:, :2],
        "larger": n + 1,
        "same": x,
        "known": jnp.asarray(factors),
        "which": x > 0,
    }


def mixed_args():
    return jnp.array([0.3, -1.2, 2.5]), jnp.asarray(4, jnp.int32), jnp.asarray(True)


FACTORS = np.array([1.0, 0.0, -2.0])


def of_arrays(function, tree, *args):
    kernel = kernel_of(function, tree, *args)
    assert kernel is not None
    return lambda *args: kernel(lambda *args: pytest.fail("the other way was taken"), *args)


def assert_same(found, wanted):
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(np.asarray(x, float), np.asarray(y, float), rtol=1e-14, atol=1e-14),
        found,
        wanted,
    )
    assert jax.tree.map(lambda x: (x.dtype, x.shape), found) == jax.tree.map(lambda x: (x.dtype, x.shape), wanted)


def test_kernel_gives_what_the_function_gives():
    args = mixed_args()
    kernel, wanted = of_arrays(mixed, FACTORS, *args), mixed(FACTORS, *args)
    assert_same(jax.jit(kernel)(*args), wanted)
    assert_same(kernel(*args), wanted)  # without a program around it


def test_kernel_of_batches():
    x, n, flag = mixed_args()
    many = jnp.arange(24.0).reshape(2, 4, 3) - 11.3
    which = jnp.arange(2) == 0
    kernel = of_arrays(mixed, FACTORS, x, n, flag)

    def over(function):
        return jax.vmap(jax.vmap(function, (0, None, None)), (0, None, 0))

    assert_same(jax.jit(over(kernel))(many, n, which), over(functools.partial(mixed, FACTORS))(many, n, which))


def test_kernel_of_no_samples():
    args = mixed_args()
    kernel = of_arrays(mixed, FACTORS, *args)
    found = jax.jit(jax.vmap(kernel, (0, None, None)))(jnp.zeros((0, 3)), *args[1:])
    assert found["corner"].shape == (0, 2, 2) and found["known"].shape == (0, 3)


@pytest.mark.parametrize("most", [9, 10, 12])
def test_long_functions_are_cut_into_blocks(monkeypatch, most):
    """Each block hands what is needed later to the next ones."""
    args = mixed_args()
    kernel = of_arrays(mixed, FACTORS, *args)
    monkeypatch.setattr(_one_kernel, "MOST_AT_ONCE", 4 * most)
    text = jax.jit(kernel).lower(*args).as_text()
    assert text.count("stablehlo.reduce") > 1
    assert_same(jax.jit(kernel)(*args), mixed(FACTORS, *args))


def in_turn(fold, start, entries):
    return functools.reduce(fold, entries, start)


def backwards(fold, start, entries):
    return functools.reduce(lambda done, entry: fold(entry, done), reversed(entries), start)


def each_from_the_start(fold, start, entries):
    return functools.reduce(fold, [fold(start, entry) for entry in entries])


def start_left_out(fold, start, entries):
    return functools.reduce(fold, entries)


def start_everywhere(fold, start, entries):
    return fold(fold(start, fold(start, fold(entries[0], start))), fold(fold(start, start), fold(start, entries[1])))


@pytest.mark.parametrize("order", [in_turn, backwards, each_from_the_start, start_left_out, start_everywhere])
def test_fold_is_right_in_any_order(monkeypatch, order):
    """XLA may fold in any order and grouping, and with the initial value as often as it likes."""

    def reduce(operands, start, fold, axes):
        (axis,) = axes
        entries = [tuple(lax.index_in_dim(x, i, axis, keepdims=False) for x in operands) for i in range(2)]
        return list(order(lambda one, other: fold(one, other), tuple(start), entries))

    args = mixed_args()
    kernel = of_arrays(mixed, FACTORS, *args)
    monkeypatch.setattr(lax, "reduce", reduce)
    assert_same(jax.jit(kernel)(*args), mixed(FACTORS, *args))


def test_what_is_not_folded_is_no_number(monkeypatch):
    """A compiler that took folding with the initial value for the identity would give NaN."""
    args = mixed_args()
    kernel = of_arrays(mixed, FACTORS, *args)
    monkeypatch.setattr(lax, "reduce", lambda operands, start, fold, axes: [x[..., 0] for x in operands])
    found = jax.jit(kernel)(*args)
    assert all(np.isnan(found[name]).all() for name in ("total", "corner", "same", "known"))


def test_no_kernel():
    x, n, flag = mixed_args()
    assert kernel_of(lambda tree, x: jnp.linalg.inv(x), None, jnp.eye(3)) is None
    assert kernel_of(lambda tree, x: lax.cond(x[0] > 0, jnp.sin, jnp.cos, x), None, x) is None
    assert (
        kernel_of(lambda tree, x: functools.reduce(lambda y, _: y * x[0] + 1, range(_one_kernel.MOST), x[0]), None, x)
        is None
    )
    seen = []

    def traced(factors, x):
        seen.append(kernel_of(mixed, factors, x, n, flag))
        return x

    jax.jit(traced)(jnp.asarray(FACTORS), x)
    assert seen == [None]


def test_what_would_compile_for_minutes_is_no_kernel():
    # Both are short enough; of the longer chain the second block would take too many numbers from the first.
    assert jd.robots.chain(40).nb <= MOST_BODIES
    for links, there in ((30, True), (40, False)):
        none = jnp.zeros(links)
        assert (kernel_of(recursive.aba, jd.robots.chain(links), none, none, none) is not None) == there


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_forward_dynamics_of_every_joint(dtype):
    """Against the world-frame matrix form, for one sample, a few and nested batches."""
    model = random_tree(1, list(KINDS))
    model = jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, model)
    q, v, tau = (jnp.asarray(x, dtype) for x in random_states(model, 6, seed=2)[:3])
    wanted = jax.vmap(lambda *args: matrix_form.forward_dynamics(model, *args))(q, v, tau)
    kernel = of_arrays(recursive.aba, model, q[0], v[0], tau[0])
    size = 1e-10 if dtype == jnp.float64 else 4e-4  # 5 eps times the condition number of M, at most 642
    for found in (
        jnp.stack([jax.jit(kernel)(*args) for args in zip(q, v, tau, strict=True)]),
        jax.jit(jax.vmap(kernel))(q, v, tau),
        jax.jit(jax.vmap(jax.vmap(kernel)))(*(x.reshape(2, 3, -1) for x in (q, v, tau))).reshape(6, -1),
    ):
        assert found.dtype == dtype
        np.testing.assert_allclose(found, wanted, atol=size * float(jnp.abs(wanted).max()), rtol=0)


def test_forward_dynamics_compiles_to_one_kernel_on_cpu_and_to_matrices_elsewhere():
    model = jd.robots.iiwa()
    args = 3 * [jnp.zeros(7)]
    forward = jax.jit(lambda *args: jd.forward_dynamics(model, *args))
    text = forward.lower(*args).compile().as_text()
    assert (
        text.count(" fusion(") <= 4
        and " conditional(" not in text
        and " dot(" not in text
        and " custom-call(" not in text
    )
    other = forward.trace(*args).lower(lowering_platforms=("cuda",)).as_text()
    assert "stablehlo.dot_general" in other
    # One computation holds the recursion, whole: cut in pieces it would compute values again.
    operations = len(scalar_program(lambda *args: recursive.aba(model, *args), *args, most=_one_kernel.MOST)[0].eqns)
    assert operations < _one_kernel.MOST_AT_ONCE


def test_derivatives_of_what_runs_in_a_kernel():
    """Forward and reverse, of one sample, against derivatives of the matrix form."""
    model = random_tree(7, ["free", "revolute", "prismatic"])
    q, v, tau = (x[0] for x in random_states(model, 1, seed=3)[:3])
    wanted = jax.jacfwd(functools.partial(matrix_form.forward_dynamics, model), (0, 1, 2))(q, v, tau)
    for way in (jax.jacfwd, jax.jacrev):
        found = jax.jit(way(functools.partial(jd.forward_dynamics, model), (0, 1, 2)))(q, v, tau)
        for x, y in zip(found, wanted, strict=True):
            np.testing.assert_allclose(x, y, atol=1e-10 * float(jnp.abs(y).max()), rtol=0)


@pytest.mark.parametrize("samples", [1, 3])
def test_loops_in_kernels(samples):
    """Accelerations, multipliers and projections of a few samples against those by matrices."""
    scene = scenes.windows(count=2)
    q, v = (jnp.asarray(x) for x in scenes.windows.start(count=2))
    off = 1e-3 * jnp.cos(jnp.arange(samples * scene.nv).reshape(samples, scene.nv))
    project = partial(projection.project_step, scene)
    state = q[None] + off, v[None] + off, jnp.zeros(samples), (off, 2 * off)
    lowered = jax.jit(jax.vmap(project)).lower(*state)
    assert "stablehlo.reduce" in lowered.as_text()
    place, speed, errors = lowered.compile()(*state)
    wanted = jax.vmap(partial(projection._by_matrices, scene, None))(*state)
    for found, by_matrices in zip((place, speed), wanted, strict=False):
        np.testing.assert_allclose(found, by_matrices, atol=1e-10, rtol=0)
    for found, by_matrices in zip(errors, wanted[2], strict=True):
        # The last round takes the rows where it starts: another one, by the size of the change, of an error of its size.
        np.testing.assert_allclose(found, by_matrices, atol=20e-6, rtol=0)

    found = jax.jit(jax.vmap(lambda q, v: constrained_dynamics(scene, q, v)))(place, speed)
    wanted = jax.vmap(lambda q, v: solve_rows(scene, q, v, 0 * v, 0.0, rows(scene, q, v, 0.0)))(place, speed)
    np.testing.assert_allclose(found.acceleration, wanted.acceleration, atol=1e-10, rtol=0)
    np.testing.assert_allclose(found.multipliers, wanted.multipliers, atol=1e-9, rtol=0)
    np.testing.assert_array_equal(found.rank, wanted.rank)


@pytest.mark.parametrize("samples", [1, 3])
def test_derivatives_of_loops_in_kernels(samples):
    """Forward and reverse, of a few samples, against central differences of the accelerations by matrices."""
    scene = scenes.four_bar()
    q, v = (jnp.asarray(x) for x in scenes.four_bar.start())
    tau, along = 0.3 * jnp.ones(scene.nv), jnp.array([0.2, -0.5, 0.7])

    def acceleration(tau):
        return constrained_dynamics(scene, q, v, tau).acceleration

    def dense(tau):
        return solve_rows(scene, q, v, tau, 0.0, rows(scene, q, v, 0.0)).acceleration

    wanted = (dense(tau + along) - dense(tau - along)) / 2  # linear in tau
    many = jnp.stack([tau] * samples)
    forward = jax.jit(jax.vmap(lambda tau: jax.jvp(acceleration, (tau,), (along,))[1]))(many)
    back = jax.jit(jax.vmap(lambda tau: jax.jacrev(acceleration)(tau) @ along))(many)
    for found in (*forward, *back):
        np.testing.assert_allclose(found, wanted, atol=1e-10, rtol=0)


def test_singular_samples_of_a_small_batch_are_solved_by_matrices():
    """Two windows with uprights that are horizontal lose rank: the kernel does not serve there, for that sample alone."""
    scene = scenes.windows(count=2)
    q, v = (jnp.asarray(x) for x in scenes.windows.start(count=2))
    flat = q.at[:3].add(jnp.pi / 2)
    both = jnp.stack([q, flat])
    found = jax.jit(jax.vmap(lambda q: constrained_dynamics(scene, q, 0 * v)))(both)
    for i, place in enumerate(both):
        wanted = solve_rows(scene, place, 0 * v, 0 * v, 0.0, rows(scene, place, 0 * v, 0.0))
        np.testing.assert_allclose(found.acceleration[i], wanted.acceleration, atol=1e-10, rtol=0)
        assert int(found.rank[i]) == int(wanted.rank)


@pytest.mark.parametrize(
    "place, once",
    [
        (lambda kernel, x: kernel(x), True),
        (lambda kernel, x: lax.cond(x[0] > 0, lambda x: kernel(x)["same"], lambda x: x, x), False),
        (lambda kernel, x: lax.scan(lambda y, _: (y + kernel(y)["same"], None), x, length=3)[0], False),
        (lambda kernel, x: lax.fori_loop(0, 3, lambda _, y: y + kernel(y)["same"], x), False),
        (lambda kernel, x: jax.jit(kernel)(x), False),
        (lambda kernel, x: lax.while_loop(lambda y: y[0] < 0, lambda y: jnp.abs(kernel(y)["same"]), x), False),
    ],
    ids=["call", "branch", "scan", "for", "function", "while"],
)
def test_one_call_takes_the_other_way(monkeypatch, place, once):
    """A kernel costs something at each call of the program, which pays in a loop alone, or in a large batch."""
    monkeypatch.undo()
    x, n, flag = mixed_args()
    kernel = kernel_of(mixed, FACTORS, x, n, flag)
    assert kernel is not None
    taken = []

    def otherwise(*args):
        taken.append(args)
        return mixed(FACTORS, *args)

    here = partial(place, lambda x: kernel(otherwise, x, n, flag))
    jax.jit(here).lower(x)
    assert bool(taken) is once
    if once:
        taken.clear()
        jax.jit(jax.vmap(here)).lower(jnp.zeros((_one_kernel.AT_ONE_CALL, 3)))
        assert not taken


PLACES = np.array([2, 0, 2])


def many_operations(tree, x, y):
    """What derivatives and indexing are made of."""
    table = jnp.outer(x, y)
    picked = table[PLACES] @ tree
    moved = table.at[PLACES, 1].add(x).at[0].set(y)
    slid = lax.dynamic_update_slice(jnp.pad(x, (1, 2), constant_values=0.5), y[:2], (3,))
    parts = jnp.split(slid, 3)
    batched = jnp.einsum("ij,ikj->ik", table, jnp.stack([table, table.T, moved]))
    hessian = jax.hessian(lambda z: jnp.sum(jnp.sin(z) * z[::-1] ** 3) + z[0] / z[1])(x)
    chosen = jnp.where(np.array([True, False, True]), x, y)
    known = lax.cond(np.asarray(True), jnp.cos, jnp.sin, x)
    return picked, moved, slid, parts[1], batched, hessian, chosen, known, jnp.all(table > 0), jnp.max(table, 1)


def test_operations_in_single_numbers():
    tree = np.array([[1.0, 0.0], [0.0, 0.0], [0.5, -1.0]])
    args = jnp.array([0.3, -1.2, 2.5]), jnp.array([0.7, 0.1, -0.4])
    kernel = of_arrays(many_operations, tree, *args)
    assert_same(jax.jit(kernel)(*args), many_operations(tree, *args))


def count(function, *args):
    return len(scalar_program(function, *args, most=1000)[0].eqns)


def test_zeros_ones_and_repetitions_are_not_written_down():
    x = jnp.array([0.3, -1.2, 2.5])
    eye = np.eye(3)
    assert count(lambda x: eye @ x + 0.0, x) == 0
    assert count(lambda x: jnp.stack([jnp.sin(x[0]), jnp.sin(x[0]) * jnp.sin(x[0])]), x) == 2
    assert count(lambda x: (jnp.cos(x), x[0])[1], x) == 0
    assert count(lambda x: jax.hessian(lambda z: z[0] * z[1])(x), x) == 0


NAMES = ("andrews", "car_axis", "rolling_disk", "chaplygin_sleigh", "rolling_coin", "pendulum_in_plane", "suslov")


def at_start(name):
    made = getattr(scenes, name)
    q, v = (jnp.asarray(x, float) for x in made.start())
    return made(), q, v


@pytest.mark.parametrize("name", NAMES)
def test_systems_of_equations_in_kernels(name):
    """Accelerations and multipliers in a program against the rank-aware solve without one, off the constraints too."""
    scene, q, v = at_start(name)
    tau, t = 0.3 * jnp.cos(jnp.arange(float(scene.nv))), jnp.asarray(0.2)
    q = q + 1e-3 * jnp.sin(jnp.arange(float(scene.nq)) + 1)
    q = jd.systems.retract(scene.system, q)

    def dynamics(tau):
        return constrained_dynamics(scene, q, v, tau, t)

    lowered = jax.jit(dynamics).lower(tau)
    assert "stablehlo.reduce" in lowered.as_text()
    found, wanted = lowered.compile()(tau), solve_rows(scene, q, v, tau, t, rows(scene, q, v, t))
    for x, y in ((found.acceleration, wanted.acceleration), (found.multipliers, wanted.multipliers)):
        np.testing.assert_allclose(x, y, atol=1e-10 * (1 + float(jnp.abs(y).max())), rtol=0)
    along = jnp.sin(jnp.arange(float(scene.nv)) + 0.5)
    slope = jax.jit(lambda tau: jax.jvp(lambda tau: dynamics(tau).acceleration, (tau,), (along,))[1])(tau)
    back = jax.jit(jax.jacrev(lambda tau: dynamics(tau).acceleration))(tau) @ along
    change = [solve_rows(scene, q, v, tau + side * along, t, rows(scene, q, v, t)).acceleration for side in (1, -1)]
    for x in (slope, back):
        np.testing.assert_allclose(x, (change[0] - change[1]) / 2, atol=1e-10 * (1 + float(jnp.abs(x).max())), rtol=0)


@pytest.mark.parametrize("name", NAMES[:5])
@pytest.mark.parametrize("off", [1e-3, 1e-6, 0.0])
def test_projection_in_one_kernel(name, off):
    """On the constraints to rounding, and as close to the start of the projection as by matrices."""
    scene, q, v = at_start(name)
    t = jnp.asarray(0.0)
    q, v = (x + off * jnp.cos(jnp.arange(float(x.size)) + k) for k, x in enumerate((q, v)))
    error = off * jnp.sin(jnp.arange(float(scene.nv)))
    state = q, v, t, (error, 2 * error)
    lowered = jax.jit(partial(projection.project_step, scene)).lower(*state)
    assert "stablehlo.reduce" in lowered.as_text()
    place, speed, errors = lowered.compile()(*state)
    wanted = projection._by_matrices(scene, None, jd.systems.retract(scene.system, q), v, t, (error, 2 * error))
    assert float(jnp.max(jnp.abs(projection.velocity_residual(scene, place, speed, t)))) < 1e-11
    if projection.holonomic_rows(projection.layout(scene)).size:
        assert float(jnp.max(jnp.abs(projection.position_residual(scene, place, t)))) < 1e-14
    # A round factors the rows anew where it starts, so the least change is one in another metric by the size of the change.
    size = 20 * off**2 * float(1 + jnp.abs(v).max())
    for x, y in zip(jax.tree.leaves((place, speed, errors)), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-13 * float(1 + jnp.abs(y).max()) + size, rtol=0)


def spoken(system, q, v, t):
    jax.debug.callback(lambda v: heard.append(float(v[0])), v)
    jax.debug.callback(lambda: heard.append("again"))
    return 0.1 * v


heard: list = []


def test_forces_with_effects_have_them_in_every_call():
    """A force that prints is no part of a kernel, and is not heard while it is traced."""
    scene, q, v = at_start("rolling_disk")
    loud = jd.Scene(scene.system, scene.constraints, (spoken,))
    run = jax.jit(lambda q, v: constrained_dynamics(loud, q, v))
    lowered = run.lower(q, v)
    assert not heard and "stablehlo.reduce" in lowered.as_text()  # the rest runs in one
    for speed in (1.0, 2.0):
        found = run(q, v.at[0].set(speed))
    jax.effects_barrier()
    assert sorted(map(str, heard)) == ["1.0", "2.0", "again", "again"]
    assert bool(jnp.isfinite(found.acceleration).all())


def test_dependent_rows_of_equations_are_left_to_the_careful_way():
    """A row that is given twice: the kernel's pivots say so, and the multipliers are those of least norm."""
    scene, q, v = at_start("rolling_disk")
    twice = jd.Scene(scene.system, (*scene.constraints, *scene.constraints[:1]))
    found = jax.jit(lambda q, v: constrained_dynamics(twice, q, v))(q, v)
    wanted = solve_rows(twice, q, v, 0 * v, 0.0, rows(twice, q, v, 0.0))
    assert int(found.rank) == 2
    np.testing.assert_allclose(found.acceleration, wanted.acceleration, atol=1e-10)
    np.testing.assert_allclose(found.multipliers, wanted.multipliers, atol=1e-10)


def test_square_roots_of_batches_stay_square_roots():
    """XLA makes 1/sqrt an instruction of one processor, which LLVM does not make vector instructions of."""
    x = jnp.linspace(0.5, 2.0, 512)
    texts = []
    for for_batches in (False, True):
        kernel = kernel_of(lambda tree, x: (x + 1.0) / jnp.sqrt(x * x + 0.1), (), x[0], for_batches=for_batches)
        program = jax.jit(jax.vmap(lambda x, kernel=kernel: kernel(lambda x: x, x))).lower(x).compile()
        texts.append(program.as_text())
        np.testing.assert_allclose(program(x), (x + 1.0) / np.sqrt(x * x + 0.1), rtol=1e-14)
    assert "rsqrt(" in texts[0] and "rsqrt(" not in texts[1]
