"""Base classes of methods in diffrax's interface: dense output, and methods that wrap another one."""

from abc import abstractmethod
from typing import Any, TypeAlias

import diffrax
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, PyTree

from jaxdyn.model.arguments import Number

Flag: TypeAlias = bool | Bool[Array, ""]
# A step's end, its error estimate or None, the data of its dense output, the method's state, and a code.
StepOutput: TypeAlias = tuple[PyTree, PyTree, dict[str, PyTree], PyTree, diffrax.RESULTS]


class DenseOutput(diffrax.AbstractLocalInterpolation):
    """Dense output within a step from t0 to t1."""

    t0: jax.Array
    t1: jax.Array

    @abstractmethod
    def at(self, t) -> PyTree:
        """State at a time t of the step."""

    def fraction(self, t) -> Any:
        """Fraction of the step at t, ()."""
        # A batch element that has ended takes steps of no length.
        step = self.t1 - self.t0
        return (t - self.t0) / jnp.where(step == 0, jnp.ones_like(step), step)

    def evaluate(self, t0, t1=None, left=True):
        """State at t0, or with t1 the difference of the states at t1 and t0."""
        return self.at(t0) if t1 is None else jax.tree.map(lambda a, b: a - b, self.at(t1), self.at(t0))


class StageInterpolation(DenseOutput):
    """Dense output from the ends y0, y1 of a step and its stages k, pytrees of arrays."""

    y0: object
    y1: object
    k: object


class Wrapped(diffrax.AbstractWrappedSolver):
    """A diffrax method made of another one, `solver`, with the same order and root finder."""

    solver: diffrax.AbstractSolver

    # Forwarded settings may be placeholders while equinox takes a tree apart: `PyTree`.

    @property
    def term_structure(self) -> PyTree:
        """Structure of the terms of the wrapped method."""
        return self.solver.term_structure

    # diffrax sets these on the method that it is given; they belong to the wrapped one.
    @property
    def root_finder(self) -> PyTree:
        """Root finder of an implicit wrapped method."""
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_find_max_steps(self) -> PyTree:
        """Iteration limit of an implicit wrapped method."""
        return self.solver.root_find_max_steps  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def scan_kind(self) -> PyTree:
        """Kind of loop over the stages of a wrapped Runge-Kutta method."""
        return self.solver.scan_kind  # pyright: ignore[reportAttributeAccessIssue]

    def order(self, terms: PyTree) -> int | None:
        """Order of convergence of the wrapped method."""
        return self.solver.order(terms)

    def error_order(self, terms: PyTree) -> ArrayLike | None:
        """Order of the error estimate of the wrapped method."""
        return self.solver.error_order(terms)

    def init(self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree) -> PyTree:
        """State of the wrapped method before the first step."""
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms: PyTree, t0: Number, y0: PyTree, args: PyTree) -> PyTree:
        """Vector field at one point."""
        return self.solver.func(terms, t0, y0, args)
