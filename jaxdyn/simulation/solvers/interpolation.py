"""Dense output of methods whose stages are kept."""

from abc import abstractmethod

import diffrax
import jax
import jax.numpy as jnp


class StageInterpolation(diffrax.AbstractLocalInterpolation):
    """Dense output within a step from t0 to t1, from its ends y0, y1 and its stages k, pytrees of arrays."""

    t0: jax.Array
    t1: jax.Array
    y0: object
    y1: object
    k: object

    @abstractmethod
    def at(self, x):
        """The state at the fraction x () of the step."""

    def evaluate(self, t0, t1=None, left=True):
        """The state at t0, or with t1 the difference of those at t1 and t0 (s)."""
        if t1 is not None:
            return jax.tree.map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        step = self.t1 - self.t0
        return self.at((t0 - self.t0) / jnp.where(step == 0, jnp.ones_like(step), step))
