"""Functions of one sample as kernels: the decorator `kernel`, and loops whose iterations are kernels.

A call traces the function once, and calls its program through the primitive (see `trace` and `primitive`). This module decides
what a call means: the kernel, its fallback, or, inside another kernel, the function itself.
"""

import functools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array as Numbers

from jaxdyn.compile import jax_adapter, mode
from jaxdyn.compile.batch import any_sample, while_loop
from jaxdyn.compile.derive import without_unread
from jaxdyn.compile.jax_adapter import forgive, vary_alike
from jaxdyn.compile.known import Known, is_known, partition_tracers
from jaxdyn.compile.loop_text import LoopText
from jaxdyn.compile.operations import over_batch
from jaxdyn.compile.primitive import kernel_p, target
from jaxdyn.compile.program import Array, Program
from jaxdyn.compile.rules import has_marks
from jaxdyn.compile.trace import function_of_leaves, inline_call, name_of, program_of


def kernel(
    function: Callable | None = None,
    *,
    static: int = 0,
    fallback: Callable | None = None,
    derivative: Callable | str | bool | None = None,
    alone: bool = True,
) -> Any:
    """Compute a function of one sample by a native kernel; a decorator.

    The function is pure, written with arrays, and called as `function(*static, tree, *args)`: first as many hashable arguments
    as `static` says, then a pytree whose known leaves are compiled in (a model that is closed over), then pytrees of arrays.
    Batches come from `jax.vmap`, derivatives from JAX. Inside another kernel the function is inlined, and under
    `compilation("plain")` it is the function itself, or its fallback.

    **Arguments:**

    - `fallback(*static, tree, *args)`: computes the same where there is no kernel, and those samples that the function marks
      by `mark_invalid` (see `careful`). Default: the function itself. It depends on nothing traced but its arguments.
    - `derivative`: None for the derivative of the function's numbers; False for functions that are never differentiated, in
      which long functions under `jax.jit` are compiled once and called, and `lax.cond` is a branch; "program" for a function that
      stays a program of its own, with the derivative of its numbers, inside another kernel too; or a rule
      `derivative(*static, tree, *args, steps)` that returns the change of the results for the `steps` of the leaves of tree and
      args (None for a leaf that does not change), where that is cheaper.
    - `alone`: whether the function is a kernel by itself. If not, it is only inlined in others, and elsewhere the fallback is
      called: for functions that share numbers with what is around them, and that alone are too large to be written out.

    **Raises:** whatever the function raises while it is traced.
    """
    if function is None:
        return functools.partial(kernel, static=static, fallback=fallback, derivative=derivative, alone=alone)
    rule = derivative if callable(derivative) else None

    @functools.wraps(function)
    def call(*args):
        given = args[:static], args[static], args[static + 1 :]
        if mode.is_careful_within() and fallback is not None and _has_marks(function, *given):
            return fallback(*args)
        # Code without JAX is one program: others are kept by keys that do not know what they may call.
        if derivative == "program" and not mode.is_standalone():
            results = _by_kernel(function, *given, fallback)
            return function(*args) if results is None else results
        if mode.is_expanding():
            return inline_call(function, *given, fallback)
        if not alone and fallback is not None:
            return fallback(*args)
        # Derivatives of a subprogram's call would be those of its numbers, written out: calls pay where nobody differentiates.
        results = _by_kernel(function, *given, fallback, tangent=rule, calls=derivative is False)
        return (function if fallback is None else fallback)(*args) if results is None else results

    return call


def _has_marks(function, static, tree, args) -> bool:
    """Decide whether a function marks samples as not valid, inside of a kernel."""
    traced, known = partition_tracers(tree)
    leaves, structure = jax.tree.flatten(args)
    with mode.careful(""), mode.expanding(mode.has_branches()):
        flat = function_of_leaves(function, static, known, len(traced), structure)
        return has_marks(jax.make_jaxpr(flat)(*traced, *leaves).jaxpr)


def _by_kernel(function, static, tree, args, fallback: Callable | None, **how) -> Any:
    """The function's results by its kernel; None where there is no kernel."""
    if target is None:
        mode.say_once("llvmlite is not installed, so functions run on JAX's own operations (pip install llvmlite)")
        return None
    if mode.current() == "plain":
        return None
    try:
        results = _bind(function, static, tree, args, fallback, **how)
    except Exception as error:
        # On a version of JAX that the tests have seen, an error is the function's own or a fault of ours. On another one it
        # may be that JAX has changed. The function's own errors are raised once more, before anything is forgiven.
        if jax_adapter.is_version_known():
            raise
        values = (function if fallback is None else fallback)(*static, tree, *args)
        jax_adapter.forgive(error)
        return values
    if isinstance(results, str):
        if fallback is None:
            mode.say_without_kernel(name_of(function), results)
        return None
    return results


def _bind(function, static, tree, args, fallback, **how) -> Any:
    """The results of the kernel, or the reason why there is no kernel, or None."""
    leaves, traced = program_of(function, static, tree, args, flags="repair", fallback=fallback, **how)
    if isinstance(traced, str):
        return traced
    (program, places), out_structure = without_unread(traced[0]), traced[1]
    leaves = [leaves[i] for i in places]
    if program.careful is not None and mode.is_careful_within():
        # A part of another function's fallback: the fast path has failed for the sample, and may fail it here again.
        return None
    # A kernel takes flat arrays. Under a trace reshapes are free.
    changes_shapes = any(x.ndim != 1 for x in leaves) or any(len(x.shape) != 1 for x in program.outputs)
    if not (changes_shapes and is_known(leaves)):
        return jax.tree.unflatten(out_structure, call_program(program, leaves))
    # Outside of a trace every reshape would be a program of XLA of its own.
    with jax.disable_jit(False):
        return jax.tree.unflatten(out_structure, _jit_call(program)(*leaves))


def call_program(program, leaves) -> list:
    """Results of a program in their shapes, of operands in any shape."""
    results = kernel_p.bind(*(x.reshape(-1) if x.ndim != 1 else x for x in leaves), program=program, rows=0)
    return [
        x if len(array.shape) == 1 else x.reshape(array.shape)
        for x, array in zip(results, program.outputs, strict=True)
    ]


@functools.lru_cache(maxsize=1024)
def _jit_call(program):
    return jax.jit(lambda *leaves: call_program(program, leaves))


# --- native loops: a program that is repeated for a sample until it has ended, with rows written on the way ---
#
# An iteration of XLA's `while` costs microseconds, and all samples of a batch wait for the last one. Here every block of W
# samples ends independently. An iteration is a `Program`; the state is in local memory; rows are written at places that depend
# on numbers, which a program cannot express. `loop_text` writes the code.


class Iteration(NamedTuple):
    """The results of one iteration.

    - `state`: the next one. `active`: whether the sample took part; if not, its state is kept. `more`: whether it continues.
    - `rows`: decides about rows, if there are any. `index`: number of the iteration, from zero; `written`: a row for each record.
    """

    state: Any
    active: Numbers
    more: Numbers
    rows: "Passed | None" = None
    index: Any = None
    written: tuple = ()


class Passed(NamedTuple):
    """Rows of times up to `until` can be written now if `kept`, from the arrays `dense`."""

    kept: Numbers
    until: Numbers
    dense: tuple


class Carry(NamedTuple):
    """The carry of a loop: the state, the number of rows written (int32) and the rows (m, n), or None, and the records."""

    state: Any
    saved: Any = None
    rows: Any = None
    records: tuple[Any, ...] = ()


class Task(NamedTuple):
    """The functions of a loop, each defined once, and their static arguments.

    - `turn(*static, tree, constants, state, read) -> Iteration`; `read`: rows of tables, at the places `state.places` (k,),
      int32.
    - `row(*of_row, None, time, *dense)`: the row (n,) of a time; None if there are none.
    - `strides`: for each record, the number of iterations from one row to the next.
    """

    turn: Callable
    static: tuple
    row: Callable | None = None
    of_row: tuple = ()
    strides: tuple[int, ...] = ()


class Given(NamedTuple):
    """Arrays that a loop reads at places that depend on its state.

    - `times` (m + 1,) or None: the rows belong to the last m of them. `tables` (k, ...): each is read at one of the places.
    """

    times: Any = None
    tables: tuple = ()


def run_loop(task: Task, tree, constants, given: Given, carry: Carry) -> Carry:
    """Iterate until every sample has ended.

    **Arguments:** `tree` as of `kernels.kernel`; `constants`, a pytree.
    """
    given, carry = jax.tree.map(jnp.asarray, (given, carry))
    try:
        after = _run_natively(task, tree, constants, given, carry)
    except Exception as error:
        if not forgive(error):
            raise
        after = None
    return _run_by_jax(task, tree, constants, given, carry) if after is None else after


def _run_by_jax(task: Task, tree, constants, given: Given, carry: Carry) -> Carry:
    """The same by JAX, with one decision for a batch."""
    turn: Any = kernel(task.turn, static=len(task.static), fallback=task.turn, derivative=False)
    of_row: Any = None if task.row is None else kernel(task.row, static=len(task.of_row), fallback=task.row)

    def iterate(running):
        _, carry = running
        read = tuple(table[carry.state.places[i]] for i, table in enumerate(given.tables))
        after = turn(*task.static, tree, constants, carry.state, read)
        state = jax.tree.map(lambda new, old: jnp.where(after.active, new, old), after.state, carry.state)
        records = []
        for record, row, stride in zip(carry.records, after.written, task.strides, strict=True):
            # Once in as many iterations as the stride. Other rows are written beyond the end, where XLA drops them.
            asked = after.active & (after.index % stride == 0)
            place = jnp.where(asked, after.index // stride, record.shape[0])
            records.append(record.at[place].set(row, mode="drop"))
        saved, rows = carry.saved, carry.rows
        if of_row is not None:
            saved, rows = _write_rows(partial(of_row, *task.of_row, None), after, given.times, saved, rows)
        return after.active & after.more, Carry(state, saved, rows, tuple(records))

    return lax.while_loop(lambda running: any_sample(running[0]), iterate, (jnp.asarray(True), carry))[1]


def _write_rows(row: Callable, after: Iteration, times, saved, rows):
    """Write the rows of times that have been passed."""
    count, passed = times.shape[0] - 1, after.rows
    assert passed is not None

    def is_due(saved):
        return after.active & passed.kept & (saved < count) & (times[jnp.minimum(saved + 1, count)] <= passed.until)

    def body(carry):
        saved, rows = carry
        here, place = is_due(saved), jnp.minimum(saved, count - 1)
        new = row(times[place + 1], *passed.dense)
        return saved + here.astype(jnp.int32), rows.at[place].set(jnp.where(here, new, rows[place]))

    return while_loop(lambda carry: is_due(carry[0]), body, (saved, rows))


def _run_natively(task: Task, tree, constants, given: Given, carry: Carry) -> Carry | None:
    if mode.current() == "plain" or target is None or mode.is_expanding() or not target.is_available():
        return None
    # An iteration is traced with one row of each table; the loop itself reads rows at places that the state holds.
    read = tuple(jnp.zeros(x.shape[1:], x.dtype) for x in given.tables)
    turn_args = constants, carry.state, read
    leaves, expanded = program_of(task.turn, task.static, tree, turn_args, calls=True, flags="repair")
    if isinstance(expanded, str):
        return None
    program, structure = expanded
    row = None
    if task.row is not None:
        turn = jax.tree.unflatten(structure, range(structure.num_leaves))
        dense = [jnp.zeros(*program.outputs[i]) for i in turn.rows.dense]
        expanded = program_of(task.row, task.of_row, None, (jnp.zeros((), given.times.dtype), *dense))[1]
        if isinstance(expanded, str):
            return None
        row = expanded[0]
    # The tree is split once more, as `program_of` does: the fallback needs its known leaves with the traced ones put back.
    traced, known = partition_tracers(tree)
    # `read` is an argument of an iteration's program, and no operand of the loop, which loads it from the tables.
    loop = _loop(task, program, row, structure, known, len(traced), _Form.of((constants, given, carry)))
    leaves = leaves[: len(leaves) - len(read)]
    after = jax.tree.leaves(carry)[len(jax.tree.leaves(carry.state)) :]
    flat = vary_alike([x.reshape(-1) for x in (*leaves, *jax.tree.leaves(given), *after)])
    # The loop takes the place of a program in the primitive, by whose rule it is batched. It has no derivative.
    results = kernel_p.bind(*flat, program=loop, rows=0)
    return _Form.of(carry)(results)


class _Form(NamedTuple):
    """Structure, shapes and dtypes of a pytree of arrays; called with flat ones, it is such a tree."""

    structure: Any
    arrays: tuple[Array, ...]

    @classmethod
    def of(cls, tree) -> "_Form":
        leaves, structure = jax.tree.flatten(tree)
        return cls(structure, tuple(Array(x.shape, np.dtype(x.dtype)) for x in leaves))

    def __call__(self, flat):
        leaves = [x.reshape(array.shape) for x, array in zip(flat, self.arrays, strict=True)]
        return jax.tree.unflatten(self.structure, leaves)


class Loop:
    """A loop as a kernel; stands in the place of a `Program`.

    Its inputs are those of a turn without the rows that it reads, the times, the tables, and the parts of the carry after the
    state; its results are the carry.
    """

    # Reverse mode is a loop of its own, over the records (`simulation.solvers.reverse`): JAX never differentiates this one.
    derivative = fallback = None
    is_called = False
    # Iterations of a run are unknown. The estimate decides how many samples one thread takes at a time.
    turns = 100

    def __init__(self, task: Task, turn: Program, row, structure, known: Known, count: int, form: _Form):
        self.task, self.turn, self.row, self.known, self.count, self.form = task, turn, row, known, count, form
        self.turn_places: Iteration = jax.tree.unflatten(structure, range(structure.num_leaves))
        numbered = jax.tree.unflatten(form.structure, range(len(form.arrays)))
        self.given, self.carry = numbered[1:]
        self.states = len(jax.tree.leaves(self.carry.state))
        # Places are counted through a tree of numbers with the structure of the arrays: fields keep their names here.
        self.first_leaf = jax.tree.leaves(self.carry)[0]  # of the carry, among the form's arrays
        self.reads = len(self.given.tables)
        self.end = len(turn.inputs) - self.reads
        first = self.end - self.states - count  # of the form's arrays that are not among these inputs
        tables = len(jax.tree.leaves(self.given))
        self.outputs = form.arrays[first + tables :]
        self.inputs = (*turn.inputs[: self.end], *form.arrays[first : first + tables], *self.outputs[self.states :])
        self.subprograms = turn.subprograms
        self.derived: dict = {}
        self.name = f"loop of {turn.name}"
        self.cost = turn.cost  # of one iteration
        # Identity of the code, as `Program.digest`.
        sizes = [(x.size, x.dtype.name) for x in (*self.inputs, *self.outputs)]
        of_row = None if row is None else row.digest
        self.digest = f"loop {turn.digest} {of_row} {sizes} {task.strides} {self.turn_places} {self.given}"

    @property
    def is_kept(self) -> bool:
        """Decide whether another process may find it (see `Program`)."""
        return self.turn.is_kept and (self.row is None or self.row.is_kept)

    def ir(self, width: int, uniform: Sequence[bool], is_quick: bool = False) -> str:
        """The text of the kernel (see `code.kernel_ir`); `uniform` says which arguments are the same for all samples."""
        return LoopText(self, width, uniform).text(is_quick)

    def as_operations(self, *arrays):
        """The same by JAX."""
        return over_batch(self._by_jax, arrays)

    def _by_jax(self, *flat):
        first, tables = self.end - self.states, len(jax.tree.leaves(self.given))
        traced = [x.reshape(array.shape) for x, array in zip(flat, self.inputs[: self.count], strict=False)]
        constants, state = flat[self.count : first], flat[first : self.end]
        given, after = flat[self.end : self.end + tables], flat[self.end + tables :]
        constants, given, carry = self.form([*constants, *given, *state, *after])
        carry = _run_by_jax(self.task, self.known(traced), constants, given, carry)
        return [x.reshape(-1) for x in jax.tree.leaves(carry)]


# The same loop for the same programs: a primitive's parameters are keys of JAX's caches.
_loop = functools.lru_cache(maxsize=256)(Loop)
