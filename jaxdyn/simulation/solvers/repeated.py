"""The steps of a run taken again as operations of JAX, for derivatives that the kernels of `driver` and `reverse` do not have.

The loop of `driver` and the way back of `reverse` are machine code: they have values, and no derivatives of their own. Their
derivatives, which are the second ones of a run and its forward mode, are those of the same steps taken here, by steps that have
derivatives of any order and both modes. When steps end is a constant, as it is to `reverse`.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn.compile.batch import cond
from jaxdyn.simulation.solvers.explicit import ExplicitSteps, Plan
from jaxdyn.simulation.solvers.reverse import step_share


def repeated_rows(plan: Plan, times, kept, count, y0, args, ts, steps):
    """Rows of the state (nt - 1, n) at ts[1:], flat; zero where the run did not come to.

    **Arguments:** `times` (room, 2), `kept` (room,), `count` (): from where to where the steps went, which were kept, and how
    many there were; `y0` (n,), flat; `steps`, the number of fixed ones, or None.
    """
    times, kept, count, steps = lax.stop_gradient((times, kept, count, steps))
    room = kept.shape[0]
    solver = ExplicitSteps(plan.solver(), plan.project, plan.step_constants, plan.branching, field=plan.field)

    def moved(i, t):
        """A time at which step i (from 1) ends or begins, which follows the ends of the run."""
        share = step_share(i, t, lax.stop_gradient(ts[-1]), steps)
        start, end = ts[0] - lax.stop_gradient(ts[0]), ts[-1] - lax.stop_gradient(ts[-1])
        return t + (1 - share) * start + share * end

    def step(args, y, t0, t1):
        state = jnp.zeros_like(y), jnp.asarray(False)
        made: Any = solver.step(None, t0, t1, plan.structure(y), args, state, True)
        return made[0], made[2]

    @jax.checkpoint
    def advanced(args, y, i, t0, t1):
        return ravel_pytree(step(args, y, moved(i, t0), moved(i + 1, t1))[0])[0]

    def advance(y, row):
        i, (t0, t1), is_kept = row
        active = is_kept & (i < count)
        # Of the steps that may have been taken most were not; those of a batch are passed over together.
        after = cond(active, advanced, lambda args, y, *_: y, args, y, i, t0, t1)
        return jnp.where(active, after, y), y

    number = jnp.arange(room, dtype=count.dtype)
    _, states = lax.scan(advance, y0, (number, times, kept))
    taken = kept & (number < count)

    @jax.checkpoint
    def row(args, states, t):
        known = lax.stop_gradient(t)
        holds = taken & (times[:, 0] < known) & (known <= times[:, 1])
        i = jnp.argmax(holds)
        t0, t1 = moved(i, times[i, 0]), moved(i + 1, times[i, 1])
        _, dense = step(args, states[i], t0, t1)
        inner: Any = solver.interpolation_cls(t0=t0, t1=t1, **dense)
        at = ravel_pytree(inner.evaluate(t))[0]
        return jnp.where(holds.any(), at, jnp.zeros_like(at))

    return lax.map(partial(row, args, states), ts[1:])
