"""Loops of programs: their branches, and the operations of JAX that take a loop's place on other devices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.compile import kernel, target
from jaxdyn.compile.batch import repeat_while
from jaxdyn.compile.body import symbol_of
from jaxdyn.compile.expansion import expand
from jaxdyn.compile.kernels import Carry, Given, Iteration, Task, run_loop


def _turn(tree, constants, state, _):
    x, count = state
    after = 0.5 * (tree @ x) + constants
    return Iteration((after, count + 1), count < 20, count + 1 < 20)


TASK = Task(_turn, ())


def _iterate(matrix, offset, x):
    return run_loop(TASK, matrix, offset, Given(), Carry((x, jnp.zeros((), jnp.int32)))).state[0]


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


def _many_operations(x):
    # More than `expand.MIN_SUBPROGRAM_OPERATIONS`, so that the function is a subprogram and its branch one of that.
    for _ in range(200):
        x = 0.5 * (x + jnp.sin(x))
    return x


def _refine(state):
    x, count = state
    return 0.5 * (x + 2 / x), count + 1


@jax.jit
def _slow_and_branching(x):
    x, rest = _many_operations(x), x
    (root, count) = repeat_while(
        lambda state: jnp.abs(state[0] ** 2 - 2) > 1e-14, _refine, (1 + 0.1 * rest, jnp.zeros((), jnp.int32)), 3
    )
    return x, root, count


def _branching_turn(tree, constants, state, _):
    x, total, counts, turn = state
    small, root, count = _slow_and_branching(x)
    # A branch in the loop's own program, with results of each kind; its last one is a constant and its flag is an integer's.
    value, is_taken, one = jax.lax.cond(
        x > constants, lambda: (x * tree, True, 1), lambda: (root, False, count.astype(jnp.int64))
    )
    after = jnp.where(is_taken, value - one.astype(value.dtype), small + 1.0), total + value, counts + one, turn + 1
    return Iteration(after, turn < 6, turn + 1 < 6)


@pytest.mark.native
@pytest.mark.parametrize("count", [1, 3, 64])
def test_branches_of_a_loop_are_taken_by_the_samples_that_need_them(count):
    """Branches of the loop and of a subprogram, against the same turns by JAX, to rounding."""
    task = Task(_branching_turn, ())

    def native(x):
        return run_loop(task, scale, limit, Given(), Carry(start(x))).state

    def start(x):
        return x, jnp.zeros(()), jnp.zeros((), jnp.int64), jnp.zeros((), jnp.int32)

    def by_jax(x):
        with jd.compilation("plain"):
            return native(x)

    scale, limit = jnp.asarray(0.75), jnp.asarray(1.2)
    x = jnp.linspace(-1.0, 3.0, count) if count > 1 else jnp.asarray([2.5])
    computed, wanted = (jax.jit(jax.vmap(f))(x) for f in (native, by_jax))
    for mine, theirs in zip(computed, wanted, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-13, atol=1e-14)
    assert len(set(np.asarray(wanted[2]).tolist())) > (count > 3)  # samples have gone different ways


@pytest.mark.native
def test_other_kernels_compute_repetitions_outside():
    """A kernel has no branches: the samples that need a repetition are computed by its fallback."""

    def root(tree, x):
        return repeat_while(lambda state: jnp.abs(state[0] ** 2 - 2) > 1e-14, _refine, (x, jnp.asarray(0)), 60)

    x = jnp.asarray([2.0**0.5, 1.0, 40.0])
    values, counts = jax.jit(jax.vmap(lambda x: kernel(root)((), x)))(x)
    np.testing.assert_allclose(values, 2.0**0.5, rtol=1e-15)
    assert counts[0] <= 1 and counts[1] > 3 and counts[2] > counts[1]


@pytest.mark.native
def test_numbers_that_programs_do_not_have_run_by_jax():
    """An unsigned integer that a function within the loop takes: no native loop, and no error."""

    @jax.jit
    def half(x, count):
        return _many_operations(x) / count.astype(x.dtype)

    def turn(tree, constants, state, _):
        x, count = state
        return Iteration((half(x, count.astype(jnp.uint32)), count + 1), count < 3, count + 1 < 3)

    run = jax.jit(lambda x: run_loop(Task(turn, ()), (), (), Given(), Carry((x, jnp.ones((), jnp.int32)))).state)
    assert "while" in run.lower(jnp.ones(())).as_text()
    assert run(jnp.ones(()))[1] == 3


def test_a_branch_that_repeats_a_call_shares_its_code():
    """The second round of a projection is the subprogram of the first one."""
    long = jax.jit(lambda x, y: (_many_operations(_many_operations(x)) + y, x - y))

    def twice(x, y):
        state = long(x, y)
        return jax.lax.cond(state[0] > 1.0, lambda state: long(*state), lambda state: state, state)

    program = expand(jax.make_jaxpr(twice)(1.0, 2.0), 10**5, calls=True)[0]
    assert [op for op, _, _ in program.operations if op.startswith("call")] == ["call", "call_where"]
    assert len(program.subprograms) == 1


@pytest.mark.native
def test_llvm_works_on_a_loop_while_xla_compiles(monkeypatch):
    """Once, under the user's own `jax.jit` too: a second kernel of the loop is for what the native loop refuses."""
    made = []
    monkeypatch.setattr(target, "make_ahead", made.append)
    task = Task(lambda *args: _turn(*args), ())  # new, so that no other test has lowered its loop

    def iterate(matrix, offset, x):
        return run_loop(task, matrix, offset, Given(), Carry((x, jnp.zeros((), jnp.int32)))).state[0]

    x = np.ones((3, 2))
    for axes, matrix in (((None, None, 0), x[:2]), ((0, None, 0), np.ones((3, 2, 2)))):
        jax.jit(jax.vmap(iterate, axes)).lower(matrix, x[0], x)
    assert len(made) == 1


@pytest.mark.native
def test_llvm_works_on_the_subprograms_of_a_batched_loop_while_it_is_traced(monkeypatch):
    """Once for each width of vectors, whatever is batched further; a loop of one sample may be batched later and waits."""
    tasks = []
    monkeypatch.setattr(target.mode, "make_later", tasks.append)
    task = Task(lambda *args: _branching_turn(*args), ())

    def iterate(x):
        state = x, jnp.zeros(()), jnp.zeros((), jnp.int64), jnp.zeros((), jnp.int32)
        return run_loop(task, jnp.asarray(0.6), jnp.asarray(1.3), Given(), Carry(state)).state[1]

    (call,) = [x for x in jax.make_jaxpr(iterate)(1.0).eqns if "program" in x.params]
    assert not tasks
    for _ in range(2):
        jax.make_jaxpr(jax.vmap(jax.vmap(iterate)))(jnp.ones((2, 3)))
    assert len(tasks) == 1
    tasks[0]()
    width = target.width_of(call.params["program"], 3)
    assert {symbol_of(x, width) for x in call.params["program"].subprograms} <= set(target._called)
