"""From a function of one sample to its program of numbers: JAX traces it once, and the program is kept.

A program belongs to the function, its static arguments, the known leaves of its tree, and the shapes of everything else.
Its derivatives are traced when they are asked for.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import jax_adapter, mode, stored
from jaxdyn.compile.careful import Careful, digest_of, guard
from jaxdyn.compile.expansion import expand
from jaxdyn.compile.known import Known, partition_tracers
from jaxdyn.compile.mode import phase
from jaxdyn.compile.program import Array, NotNumbers, Program, TooLong
from jaxdyn.compile.rules import change_along, guarded_p, has_marks


def program_of(function: Callable, static: tuple, tree, args: tuple, **how):
    """Flat operands of a function's kernel, and (its program, the structure of its results) or the reason why there is none.

    **Arguments:**

    - `function(*static, tree, *args)`: pure, of one sample. `static` is hashable.
    - `tree`: pytree whose known leaves are compiled in; its traced leaves, and all of `args`, are operands.
    - `how`: the options of `trace_program`.
    """
    traced, known = partition_tracers(tree)
    leaves, structure = jax.tree.flatten(args)
    # Within `shard_map` operands of a primitive vary along the same axes of a mesh, or JAX refuses them.
    leaves = jax_adapter.vary_alike([*map(jnp.asarray, (*traced, *leaves))])
    shapes = tuple((x.shape, x.dtype) for x in leaves)
    return leaves, trace_program(function, static, known, len(traced), structure, shapes, **how)


def trace_program(
    *parts,
    tangent: Callable | None = None,
    maximum: int | None = None,
    calls: bool = False,
    flags: str = "refuse",
    fallback: Callable | None = None,
):
    """The program and the structure of its results, or the reason why there is none.

    **Arguments:**

    - `parts`: function, static arguments, `Known` leaves of the tree and the number of its traced ones, structure of the other
      arguments, shapes and dtypes of all operands.
    - `tangent(*static, tree, *args, steps)`: the function's derivative along `steps`, as of `kernel`.
    - `maximum`: operations beyond which there is no program; by default as `mode` says.
    - `calls`: whether long functions under `jax.jit` become subprograms.
    - `flags`: as of `expand`; with "repair" samples that are flagged are computed by the program of `fallback`, or of the
      function itself, which is traced when the first of them appears (see `careful`).
    """
    # A trace depends on these settings too: they are a part of the key under which the program is kept.
    context = jax.config.read("jax_enable_x64"), mode.state_of_programs()
    return _trace_program(*parts, tangent, maximum, calls, flags, fallback, context)


@functools.lru_cache(maxsize=1024)
def _trace_program(function, static, known: Known, count, structure, shapes, tangent, maximum, calls, flags, fallback,
                   context):  # fmt: skip
    del context  # part of the key alone
    is_pair, flags = flags == "repair", "report" if flags == "repair" else flags
    avals = [jax.ShapeDtypeStruct(*shape) for shape in shapes]
    maximum = mode.max_operations(avals) if maximum is None else maximum
    flat = function_of_leaves(function, static, known, count, structure)

    def make():
        """The program, and plain data: whether it has rules, and the structure of its results, or why there is none."""
        try:
            with phase("tracing"), mode.expanding(calls):
                # Subprograms are the functions under `jit` within this one; itself it is not a call.
                traced = flat_function(function, static, known, count, structure) if calls else flat
                closed, out = jax.make_jaxpr(traced, return_shape=True)(*avals)
            program, has_rules = expand(closed, maximum, name_of(function), calls, flags)
        except (NotNumbers, TooLong) as reason:
            return [], str(reason)
        except Exception as error:
            if not jax_adapter.forgive(error):
                raise
            return [], str(error)
        return [program], (has_rules, jax.tree.map(lambda _: 0, out))

    # Programs without JAX contain pseudo-inverses, which are no operations.
    parts = (
        function,
        static,
        known.structure,
        known.places,
        known.leaves.leaves,
        count,
        structure,
        shapes,
        maximum,
        calls,
        flags,
    )
    key = None if mode.is_standalone() else stored.key_of("trace", *parts)
    programs, data = stored.load_or_make(key, make)
    if isinstance(data, str):
        return data
    (program,), (has_rules, results) = programs, data
    if tangent is not None:
        rule = functools.partial(tangent, *static)
        program.derivative = _derivative_by_rule(rule, known, count, structure, avals, flags, program)
    elif has_rules:
        program.derivative = _derivative_by_jax(flat, avals, flags, program)
    program.fallback = _fallback(function, static, known, count, structure, avals, program.reports_validity)
    if is_pair:
        other = function if fallback is None else fallback
        again = Again(other, static, known, count, structure, shapes, calls, other is function)
        program = guard(program, functools.partial(again.beside, program))
    return program, jax.tree.structure(results)


class Again(NamedTuple):
    """Function that computes the samples which another one of the same arguments marks as not valid.

    `calls`: whether it may have subprograms and branches, which have no derivatives. `is_itself`: whether it is that function.
    """

    function: Callable
    static: tuple
    known: Known
    count: int
    structure: Any
    shapes: tuple
    calls: bool
    is_itself: bool

    def beside(self, fast: Program) -> Careful:
        """The careful program beside the fast one of the other function."""
        outputs, name = fast.outputs[:-1], name_of(self.function)
        inputs = [Array(shape, np.dtype(dtype)) for shape, dtype in self.shapes]
        # What is static in the tree too, such as functions of the user; the numbers in it are a part of the content.
        recipe = self.function, self.static, self.known.structure, self.known.places, *self[3:], mode.state()
        digest, is_kept = digest_of(self.key(outputs), f"{name} {inputs} {outputs} {self.known.digest}", recipe)
        make = functools.partial(_make_careful, self, outputs, digest if is_kept else None)
        by_jax = functools.partial(_by_jax, self, outputs)
        return Careful(inputs, outputs, digest, f"{name} of flagged samples", make, by_jax, self.which, is_kept)

    def key(self, outputs) -> str | None:
        """Name under which the program is kept on disk, if it is."""
        function, static, known, *rest = self
        contents = known.structure, known.places, known.leaves.leaves
        # By the one option that changes its numbers: a thread that traces it again has other options than the user's contexts.
        has_x64 = jax.config.read("jax_enable_x64")
        return stored.key_of("careful", function, static, *contents, *rest, outputs, configuration=has_x64)

    @property
    def which(self) -> str:
        """The argument of `mode.careful`."""
        return "own" if self.is_itself and self.calls else "within"

    def compute(self, outputs, leaves) -> list:
        """The results, with the types of `outputs`."""
        results = jax.tree.leaves(flat_function(*self[:5])(*leaves))
        return [jnp.broadcast_to(jnp.asarray(x, y.dtype), y.shape) for x, y in zip(results, outputs, strict=True)]


def _make_careful(again: Again, outputs, key: str | None) -> Program:
    avals = [jax.ShapeDtypeStruct(*shape) for shape in again.shapes]

    def compute(*leaves):
        return again.compute(outputs, leaves)

    def make():
        with phase("tracing"), mode.expanding(again.calls):
            closed = jax.make_jaxpr(compute)(*avals)
        # The marks of what is left as it is are NaN, which the results then are too.
        maximum, name = 10 * mode.max_operations(avals), name_of(again.function)
        program, has_rules = expand(closed, maximum, name, again.calls, "ignore")
        return [program], has_rules

    (program,), has_rules = stored.load_or_make(key, make)
    if has_rules:
        program.derivative = _derivative_by_jax(compute, avals, "ignore", program)
    return program


def _by_jax(again: Again, outputs, *flat) -> list:
    leaves = [x.reshape(shape) for x, (shape, _) in zip(flat, again.shapes, strict=True)]
    with mode.careful(again.which):
        return [x.reshape(-1) for x in again.compute(outputs, leaves)]


def name_of(function) -> str:
    """Name of a function for messages."""
    return getattr(function, "__qualname__", type(function).__name__)


@functools.lru_cache(maxsize=1024)
def function_of_leaves(function, static, known: Known, count: int, structure):
    """The function of its operands, flat and under `jax.jit`; JAX traces it once for all programs that it is part of."""
    return jax.jit(flat_function(function, static, known, count, structure))


def flat_function(function, static, known: Known, count: int, structure) -> Callable:
    """The function of its operands: the traced leaves of the tree, then those of the arguments."""

    def flat(*leaves):
        return function(*static, known(leaves[:count]), *jax.tree.unflatten(structure, leaves[count:]))

    return flat


def inline_call(function, static, tree, args, fallback: Callable | None = None):
    """The function within another one that becomes a program.

    Where that may have branches, samples that the function marks as not valid are computed by its fallback there.
    """
    traced, known = partition_tracers(tree)
    leaves, structure = jax.tree.flatten(args)
    flat, leaves = function_of_leaves(function, static, known, len(traced), structure), [*traced, *leaves]
    if mode.has_branches() and not (mode.is_careful() or mode.is_standalone()):
        # What marks nothing takes no branches: its trace is the one of programs without them, which may be there.
        with mode.expanding():
            if not has_marks(jax.make_jaxpr(flat)(*leaves).jaxpr):
                return flat(*leaves)
    if fallback is None or not mode.has_branches() or mode.is_careful_within():
        return flat(*leaves)
    leaves = [*map(jnp.asarray, leaves)]
    with mode.careful(""):
        call, out = jax.make_jaxpr(flat, return_shape=True)(*leaves)
        if not has_marks(call.jaxpr):
            return flat(*leaves)
    shapes = tuple((x.shape, x.dtype) for x in leaves)
    again = Again(fallback, static, known, len(traced), structure, shapes, True, fallback is function)
    return jax.tree.unflatten(jax.tree.structure(out), guarded_p.bind(*leaves, call=call, again=again))


def _fallback(function, static, known: Known, count: int, structure, avals, reports: bool) -> Callable:
    """The function itself, from flat arrays to flat arrays, as `Program.fallback` wants it."""

    def one(*flat):
        leaves = [x.reshape(aval.shape) for x, aval in zip(flat, avals, strict=True)]
        with mode.compilation("plain"):
            results = function(*static, known(leaves[:count]), *jax.tree.unflatten(structure, leaves[count:]))
        # Marks of samples that are not valid are those of a program alone. Without them every sample counts as not valid, and
        # is computed by the fallback of `kernel`.
        return [*(jnp.reshape(x, -1) for x in jax.tree.leaves(results)), *([jnp.zeros(1, bool)] if reports else [])]

    return one


# --- derivatives ---


def _derivative_by_rule(tangent: Callable, known: Known, count: int, structure, avals, flags: str, program: Program):
    """The derivative of a program by a rule that is given by hand."""

    def derivative(moving):
        def change(*leaves):
            primal, remaining = leaves[: len(avals)], iter(leaves[len(avals) :])
            steps = [next(remaining) if varies else None for varies in moving]
            # The rule is given steps of all leaves of the tree, and the program moves the traced ones alone.
            tree_steps: list = [None] * known.structure.num_leaves
            for place, step in zip(known.places, steps[:count], strict=True):
                tree_steps[place] = step
            args = jax.tree.unflatten(structure, primal[count:])
            return tangent(known(primal[:count]), *args, [*tree_steps, *steps[count:]])

        of_rule = stored.key_of(tangent)
        key = None if of_rule is None else stored.key_within(program, "rule", moving, of_rule)
        return tangent_program(change, avals, moving, flags, key)

    return derivative


def _derivative_by_jax(flat: Callable, avals, flags: str, program: Program):
    """The derivative of a program by `jax.jvp`, which asks functions within the function for their own rules."""

    def floats(*leaves):
        return [x for x in jax.tree.leaves(flat(*leaves)) if jnp.issubdtype(x.dtype, jnp.floating)]

    def derivative(moving):
        def change(*leaves):
            return change_along(floats, leaves[: len(avals)], moving, leaves[len(avals) :])

        return tangent_program(change, avals, moving, flags, stored.key_within(program, "jvp", moving))

    return derivative


def tangent_program(change: Callable, avals, moving, flags: str, key: str | None = None) -> Program:
    """The program of a tangent; which reports flagged samples where that of the values does; else it is NaN there.

    A rule may call functions with rules of their own, itself included, and then the tangent is differentiated by JAX again:
    its numbers would give the derivative of how a value is computed, where the rule says another one. `key`: under which the
    program is kept on disk, if it is.
    """
    avals = [*avals, *(aval for aval, varies in zip(avals, moving, strict=True) if varies)]

    def make():
        with phase("tracing"), mode.expanding():
            closed = jax.make_jaxpr(change)(*avals)
        # A tangent has two to four times the operations of the values. The bound is there for those that explode.
        of_tangent = flags if flags in ("refuse", "report") else "ignore"
        program, has_rules = expand(closed, 10 * mode.max_operations(avals), "change", flags=of_tangent)
        return [program], has_rules

    (program,), has_rules = stored.load_or_make(key, make)
    if has_rules:
        program.derivative = _derivative_by_jax(change, avals, flags, program)
    return program
