"""Result codes of all computations, by name and by number."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxdyn.compile.known import is_concrete

_names: list[str] = []


class RESULTS(eqx.Enumeration):
    """Result codes of constrained dynamics, simulations, quadratic programs, searches and fits."""

    successful = "successful"
    # Of equation solvers: those of lineax and optimistix, by their names.
    max_steps_reached = "The maximum number of solver steps was reached."
    singular = "A linear solver met a singular matrix."
    breakdown = "An iterative linear solver broke down."
    stagnation = "An iterative linear solver stagnated."
    conlim = "A linear solver met a matrix of too large a condition number."
    nonfinite_input = "A linear solver was given NaN or infinity."
    nonlinear_max_steps_reached = "The maximum number of steps of a nonlinear solver was reached."
    nonlinear_divergence = "A nonlinear solver diverged."
    nonfinite = "A solver met NaN or infinity."
    # Of constrained dynamics.
    singular_mass_matrix = (
        "The mass matrix is not positive definite to rounding: a joint moves no inertia, or next to none."
    )
    dependent_rows = "The constraint rows are dependent; take method='rank_aware'."
    contradictory_rows = "No acceleration satisfies the constraint rows: they contradict each other."
    singular_basis = "The minimal velocities do not determine the others here; choose another basis."
    not_assembled = "No configuration and velocity that satisfy the constraints were found."
    # Of simulations: those of diffrax, by its names, and ours.
    dt_min_reached = "The minimum step size was reached in the differential equation solver."
    event_occurred = "An event ended the motion."
    max_steps_rejected = "Too many steps were rejected."
    internal_error = "diffrax met an error of its own."
    nonfinite_start = "The initial state is not finite, or a quaternion in it is zero."
    nonfinite_state = "The state became NaN or infinite."
    unordered_times = "The save points are not finite and increasing."
    bad_stepsize = "The step is not positive and finite."
    bad_tolerance = "A tolerance is negative or not finite."
    coarse_steps = (
        "The fixed steps are too long, or too many for the dtype: the motion may be wrong by a tenth of it or more."
    )
    coarse_start = "The initial state has an angle of so many turns that its dtype holds too little of the rest."
    inconsistent_start = "The initial state is not on the constraints."
    no_freedom = "The constraints remove all degrees of freedom: no motion is possible."
    open_constraints = "The constraints opened, and the projection could not close them."
    contact_lost = "A contact pulled or left its friction cone."
    joint_limit_passed = "A joint passed one of its position limits."
    control_singular = "The control came to where its task cannot be followed: task and constraints lose rank."
    too_many_events = "Events followed each other without end, or there were more than max_events."
    painleve_paradox = (
        "Friction and normal force of a sliding contact left no forces, or more than one (Painleve's paradox)."
    )
    no_contact_mode = "No mode of the contacts was found that agrees with their forces."
    no_single_contact = (
        "Surfaces that roll do not touch in one point any more: their relative curvature is not positive."
    )
    unnormalized_start = "A quaternion of the initial state is not of unit length."
    targets_not_reached = "No configuration that reaches the targets was found."
    no_descent = "No step along the search direction reduces the cost."
    underactuated = "The motors cannot produce this motion."
    # Of quadratic programs.
    infeasible = "No x satisfies the rows and cones of the quadratic program."
    stalled = "The quadratic program was not solved to the tolerance within the given steps."
    indefinite = "The matrix Q of the quadratic program is not positive definite."
    # Of fits.
    stopped = "The callback or the time limit stopped the fit."

    # An enumeration of equinox does not list its names.
    _names.extend(name for name in vars() if not name.startswith("_"))


# A code in arrays and files is the index of its name: append new names at the end of `RESULTS`, or old files change meaning.
CODES = tuple(_names)


def require_finite(result: Any, *values) -> Any:
    """The result, or `nonfinite` where it is `successful` and a value is not finite."""
    is_finite = jnp.stack([jnp.isfinite(x).all() for x in values]).all()
    return RESULTS.where(is_finite | (result != RESULTS.successful), result, RESULTS.nonfinite)  # pyright: ignore[reportArgumentType]


def code_of(result: Any) -> Array:
    """Index of a result, traced or batched, in `CODES` (uint8)."""
    # An item of an enumeration is no array that could be stored; comparisons of it are.
    return jnp.argmax(jnp.stack([result == getattr(RESULTS, name) for name in CODES]), 0).astype(jnp.uint8)


def is_successful(result: Any) -> bool:
    """Decide whether one concrete result is `successful`, without a program of XLA."""
    return np.array_equal(jax.tree.leaves(result), jax.tree.leaves(RESULTS.successful))


def name_of(result: Any) -> str:
    """Name of one concrete result."""
    return CODES[int(code_of(result))]


class Outcome(eqx.Module):
    """Base of outcomes with a `result`, one of `RESULTS`."""

    @property
    def success(self) -> Bool[Array, "..."]:
        """True where `result` is `RESULTS.successful`."""
        return self.result == RESULTS.successful  # pyright: ignore[reportAttributeAccessIssue]


def require_success(outcome: Any, throw: bool | None, message: Callable[[], str]) -> Any:
    """The outcome, or an error where it failed: by default for concrete ones, and always or never as `throw` says.

    **Raises:** ValueError with the message; under tracing the program raises the text of the result's code.
    """
    failed = ~outcome.success
    if not is_concrete(outcome.result):
        # Under tracing the result is unknown, so that only an error at run time is possible.
        return outcome.result.error_if(outcome, failed) if throw else outcome
    if (throw is None or throw) and bool(jnp.any(failed)):
        raise ValueError(message())
    return outcome


def first_of(cases: Sequence[tuple[Any, Any]], otherwise: Any) -> Any:
    """Code of the first case (condition, code) whose condition holds, else the one given."""
    # Backwards, so that the first case replaces the others.
    for condition, code in reversed(cases):
        otherwise = RESULTS.where(condition, code, otherwise)
    return otherwise
