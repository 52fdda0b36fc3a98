"""Functions whose derivatives are given by another computation than their values."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxdyn.compile import mode
from jaxdyn.compile.known import partition_tracers


def implicit(tree, args: tuple, solve: Callable, tangent: Callable):
    """solve(tree, *args), whose derivative is given by tangent(tree, *args, steps) -> (value, its change).

    Under `mode.values_of_rules` it is the value of the tangent's rule, which is all that a derivative needs.
    `steps` are those of the tree's leaves and of the args, None where nothing moves. Leaves with known values stay outside of
    the differentiated function: inside it they would be traced, and a recursion could not see their zeros any more.
    """
    if mode.has_values_of_rules():
        with mode.values_of_rules(False):  # rules within the rule are no part of the question
            return tangent(tree, *args, [None] * len(jax.tree.leaves((tree, args))))[0]
    unknown, known = partition_tracers(tree)

    # With symbolic zeros the rule sees which leaves do not change: a state's derivative computes none of the model's.
    @jax.custom_jvp
    def run(traced, *args):
        return _batch_first(solve(known(traced), *args))

    def rule(primals, tangents):
        traced, *args = primals
        zero = jax.custom_derivatives.SymbolicZero
        steps: list = [None] * known.structure.num_leaves
        for place, step in zip(known.places, tangents[0], strict=True):
            steps[place] = step
        steps = [None if isinstance(x, zero) else x for x in (*steps, *tangents[1:])]
        return _batch_first(tangent(known(traced), *args, steps))

    run.defjvp(rule, symbolic_zeros=True)
    return run(unknown, *args)


def _batch_first(tree):
    """The same arrays; in a batch, that is their leading axis.

    Where a loop was batched before it is differentiated, JAX takes the value of a rule for one with its batch where that of the
    function has it.
    """

    def first(x):
        shape = jnp.shape(x)
        if not shape or x.dtype == jax.dtypes.float0:
            return x
        # Two reshapes that cancel: their batching rule moves the axis of the batch to the front.
        return jnp.reshape(jnp.reshape(x, (1, *shape) if len(shape) == 1 else -1), shape)

    return jax.tree.map(first, tree)


def value_and_jvp(function: Callable, args: tuple, steps):
    """function(*args), and its change for `steps` in the leaves of args, None where one does not move; None if none does."""
    base, structure = jax.tree.flatten(args)
    # Only leaves that change are arguments of `jax.jvp`: the others stay constants, whose zeros are seen.
    moving = [i for i, step in enumerate(steps) if step is not None]
    if not moving:
        return function(*args), None

    def at_values(*values):
        here = list(base)
        for i, value in zip(moving, values, strict=True):
            here[i] = value
        return function(*jax.tree.unflatten(structure, here))

    return jax.jvp(at_values, [base[i] for i in moving], [steps[i] for i in moving])
