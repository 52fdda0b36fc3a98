"""What a method that wraps another one passes on."""

import diffrax
from jax.typing import ArrayLike
from jaxtyping import PyTree

from jaxdyn.model.arguments import Number


class Wrapped(diffrax.AbstractWrappedSolver):
    """A diffrax method made of another one, `solver`, whose order and root finder are its own."""

    solver: diffrax.AbstractSolver

    # Settings that are passed on may stand for others while equinox takes a tree apart: `PyTree`.

    @property
    def term_structure(self) -> PyTree:
        """As the wrapped method's."""
        return self.solver.term_structure

    # diffrax sets these on the method that it is given; they belong to the wrapped one.
    @property
    def root_finder(self) -> PyTree:
        """Of the wrapped method, if it is implicit."""
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_find_max_steps(self) -> PyTree:
        """Of the wrapped method, if it is implicit."""
        return self.solver.root_find_max_steps  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def scan_kind(self) -> PyTree:
        """Of the wrapped method, if it is of Runge-Kutta type."""
        return self.solver.scan_kind  # pyright: ignore[reportAttributeAccessIssue]

    def order(self, terms: PyTree) -> int | None:
        """Order of convergence, that of the wrapped method."""
        return self.solver.order(terms)

    def error_order(self, terms: PyTree) -> ArrayLike | None:
        """Order of the error estimate, that of the wrapped method."""
        return self.solver.error_order(terms)

    def func(self, terms: PyTree, t0: Number, y0: PyTree, args: PyTree) -> PyTree:
        """Vector field at one point."""
        return self.solver.func(terms, t0, y0, args)
