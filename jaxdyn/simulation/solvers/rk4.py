"""The classical fourth-order Runge-Kutta method with a fixed step."""

from collections.abc import Callable
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxdyn.simulation.solvers.base import StageInterpolation

_B = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])


class _Interpolation(StageInterpolation):
    """Third-order continuous extension from the four stages, without a further evaluation."""

    def at(self, t):
        x = self.fraction(t)
        middle = x * x * (1 - 2 * x / 3)
        weights = jnp.stack([x * (1 - x * (1.5 - 2 * x / 3)), middle, middle, x * x * (2 * x / 3 - 0.5)])
        return jax.tree.map(lambda y, k: y + jnp.tensordot(weights.astype(y.dtype), k, 1), self.y0, self.k)


class RK4(diffrax.AbstractERK):
    """Classical Runge-Kutta method: order 4, four evaluations a step, for fixed steps.

    Dense output is of order 3 (local error h^4) and keeps the global order 4. The error estimate is the difference from the
    midpoint rule, of order h^3. It detects steps that are too long (`ErrorMonitoredSteps`) and is too coarse to control them.

    Source: Hairer, Norsett & Wanner 1993, tables II.1.2 and section II.6.
    """

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=_B,
        b_error=_B - np.array([0.0, 1.0, 0.0, 0.0]),
        c=np.array([0.5, 0.5, 1.0]),
    )
    interpolation_cls: ClassVar[Callable[..., _Interpolation]] = _Interpolation

    def order(self, terms: PyTree) -> int:
        """Order of convergence."""
        return 4

    def error_order(self, terms: PyTree) -> int:
        """Power of the step length in the error estimate."""
        return 3
