"""Methods for fixed steps: the classical Runge-Kutta method, and maps from one state to the next."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxdyn.model.arguments import Number
from jaxdyn.simulation.solvers.base import DenseOutput, Flag, StageInterpolation, StepOutput

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

    Dense output is of order 3 (local error $h^4$) and keeps the global order 4. The error estimate is the difference from the
    midpoint rule, of order $h^3$. It detects steps that are too long (`ErrorMonitoredSteps`) and is too coarse to control them.

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


class _MeanVelocityInterpolation(DenseOutput):
    """Dense output from a step's ends: v is the parabola through v0 and v1 with the mean velocity over the step.

    q is displaced by its integral, on the manifold. Other entries of the state change at a constant rate. Local errors of q
    and v are h^4 and h^3, those of cubic Hermite interpolation, plus the error of the step.
    """

    y0: dict
    y1: dict
    mean: jax.Array
    displace: Callable

    def at(self, t):
        s, h = (x.astype(self.mean.dtype) for x in (self.fraction(t), self.t1 - self.t0))
        first, last = self.y0["v"], self.y1["v"]
        y = jax.tree.map(lambda a, b: a + s * (b - a), self.y0, self.y1)
        # Integral of the parabola, as a fraction of the step; its derivative is v.
        path = s * (1 - s) ** 2 * first + s * s * (s - 1) * last + s * s * (3 - 2 * s) * self.mean
        v = (1 - s) * (1 - 3 * s) * first + s * (3 * s - 2) * last + 6 * s * (1 - s) * self.mean
        return y | {"q": self.displace(self.y0["q"], h * path), "v": v}


class Stepper(diffrax.AbstractSolver):
    """A one-step map of order 2 that does not call the vector field, for fixed steps.

    **Arguments:**

    - `begin(t0, y0, args)` -> what the first step needs in addition to y.
    - `advance(t0, t1, y, args, carried)` -> y1, the mean velocity of the step, what is carried on, and whether it succeeded.
      y is a dictionary with "q" and "v". What these two depend on comes through `args`, so that gradients reach it.
    - `displace(q, step)` -> configuration.
    """

    begin: Callable | None = None
    advance: Callable | None = None
    displace: Callable | None = None
    term_structure: ClassVar = diffrax.AbstractTerm

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        """Dense output from the ends of a step and its mean velocity."""

        def interpolation(**given):
            return _MeanVelocityInterpolation(displace=self.displace, **given)  # pyright: ignore[reportArgumentType]

        return interpolation

    def order(self, terms: PyTree) -> int:
        """Order of convergence."""
        return 2

    def init(self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree) -> PyTree:
        """Data that the first step needs."""
        return self.begin(t0, y0, args)  # pyright: ignore[reportOptionalCall]

    def func(self, terms: PyTree, t0: Number, y0: PyTree, args: PyTree) -> PyTree:
        """Vector field at one point."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree, solver_state: PyTree, made_jump: Flag
    ) -> StepOutput:
        """Make one step from t0 to t1; NaN where it failed."""
        y1, mean, carried, solved = self.advance(t0, t1, y0, args, solver_state)  # pyright: ignore[reportOptionalCall]
        # Other entries of the state are constant within a step.
        y1 = y0 | jax.tree.map(lambda y: jnp.where(solved, y, jnp.full_like(y, jnp.nan)), y1)
        codes: Any = diffrax.RESULTS
        result = codes.where(solved, codes.successful, codes.nonlinear_divergence)
        return y1, None, {"y0": y0, "y1": y1, "mean": mean}, carried, result
