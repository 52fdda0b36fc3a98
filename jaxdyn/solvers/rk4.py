"""The classical fourth-order Runge-Kutta method with a fixed step."""

from collections.abc import Callable
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

# Stage i starts from y0 + A[i] k[i-1]; y1 = y0 + sum B[i] k[i].
_A = np.array([0.0, 0.5, 0.5, 1.0])
_B = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])
# Less the midpoint rule, which has order 2.
_B_ERROR = _B - np.array([0.0, 1.0, 0.0, 0.0])


class _Interpolation(diffrax.AbstractLocalInterpolation):
    """Third-order continuous extension from the four stages, without a further evaluation."""

    t0: jax.Array
    t1: jax.Array
    y0: object
    k: object

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        step = self.t1 - self.t0
        x = (t0 - self.t0) / jnp.where(step == 0, jnp.ones_like(step), step)
        middle = x * x * (1 - 2 * x / 3)
        weights = jnp.stack([x * (1 - x * (1.5 - 2 * x / 3)), middle, middle, x * x * (2 * x / 3 - 0.5)])
        return jax.tree.map(lambda y, k: y + jnp.tensordot(weights.astype(y.dtype), k, 1), self.y0, self.k)


class RK4(diffrax.AbstractSolver):
    """Classical Runge-Kutta method: order 4, four evaluations a step, for fixed steps.

    The stages run in one `lax.scan`, so the dynamics are compiled once and both modes of differentiation pass
    through. Dense output is of order 3 (local error h^4) and keeps the global order 4. The difference from the midpoint rule, of
    h^3, tells steps that are too long (`Watched`); to choose them by it is not worth while.

    Source: Hairer, Norsett & Wanner 1993, tables II.1.2 and section II.6.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., _Interpolation]] = _Interpolation

    def order(self, terms):
        """Order of convergence."""
        return 4

    def error_order(self, terms):
        """Power of h that the error estimate goes with."""
        return 3

    def init(self, terms, t0, t1, y0, args):
        """There is no state between steps."""
        return None

    def func(self, terms, t0, y0, args):
        """Vector field at one point."""
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step from t0 to t1."""
        control = terms.contr(t0, t1)

        def stage(k, a):
            y = jax.tree.map(lambda yi, ki: yi + a.astype(yi.dtype) * ki, y0, k)
            k = terms.vf_prod(t0 + a.astype(jnp.result_type(t0)) * (t1 - t0), y, args, control)
            return k, k

        _, k = jax.lax.scan(stage, jax.tree.map(jnp.zeros_like, y0), jnp.asarray(_A))
        y1 = jax.tree.map(lambda yi, ki: yi + jnp.tensordot(jnp.asarray(_B, yi.dtype), ki, 1), y0, k)
        error = jax.tree.map(lambda ki: jnp.tensordot(jnp.asarray(_B_ERROR, ki.dtype), ki, 1), k)
        return y1, error, {"y0": y0, "k": k}, None, diffrax.RESULTS.successful
