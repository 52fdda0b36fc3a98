"""Result codes of all computations, by name and by number."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int, PyTree

from jaxdyn.compile.known import is_concrete, stop_gradient
from jaxdyn.model.arguments import check_flag

_messages: list[str] = []


# No equinox module, whose fields would be printed in place of the name.
@jax.tree_util.register_pytree_node_class
class Result:
    """One of `RESULTS`, or a batch of them. Codes are compared by `==`, entry by entry."""

    __slots__ = ("index",)
    index: Int[Array | np.ndarray, "..."]

    def __init__(self, index):
        self.index = index

    def tree_flatten(self):
        """Leaves and structure, for JAX."""
        return (self.index,), None

    @classmethod
    def tree_unflatten(cls, _, leaves):
        """A result from its leaf, for JAX."""
        return cls(*leaves)

    def __eq__(self, other) -> Any:
        if not isinstance(other, Result):
            raise ValueError(
                f"a result is compared with {other!r}; compare it with jd.RESULTS.successful or another code"
            )
        # Known codes are compared at once, within a trace too.
        with jax.ensure_compile_time_eval():
            return jnp.asarray(self.index == other.index)

    def __ne__(self, other) -> Any:
        return ~(self == other)

    def __repr__(self) -> str:
        # The leaf of a tree that JAX has mapped may be any object.
        if not is_concrete(self.index) or not isinstance(self.index, np.ndarray | jax.Array):
            return f"Result({self.index})"
        return str(np.asarray(CODES)[np.asarray(self.index)])

    @property
    def message(self) -> str:
        """The sentence of a concrete code; of a batch, the list of them."""
        return str(np.asarray(_messages)[np.asarray(self.index)]) if is_concrete(self.index) else "traced"

    def error_if(self, token: PyTree, condition: Bool[ArrayLike, ""]) -> PyTree:
        """The `token`, which raises this code's sentence at run time where the condition holds."""
        return eqx.branched_error_if(token, condition, self.index, _messages)


def _code(message: str) -> Result:
    _messages.append(message)
    return Result(np.array(len(_messages) - 1, np.int32))


class _Enumeration(type):
    def __getitem__(cls, result: Result) -> str:
        return result.message

    def __len__(cls) -> int:
        return len(CODES)

    def __instancecheck__(cls, value) -> bool:
        return isinstance(value, Result)


class RESULTS(metaclass=_Enumeration):
    """Result codes of constrained dynamics, simulations, quadratic programs, searches and fits.

    `print(result)` shows the name of a code, and `RESULTS[result]` its sentence.
    """

    successful = _code("successful")
    # Of equation solvers: those of lineax and optimistix, by their names.
    max_steps_reached = _code("The maximum number of solver steps was reached.")
    singular = _code("A linear solver met a singular matrix.")
    breakdown = _code("An iterative linear solver broke down.")
    stagnation = _code("An iterative linear solver stagnated.")
    conlim = _code("A linear solver met a matrix of too large a condition number.")
    nonfinite_input = _code("A linear solver was given NaN or infinity.")
    nonlinear_max_steps_reached = _code("The maximum number of steps of a nonlinear solver was reached.")
    nonlinear_divergence = _code("A nonlinear solver diverged.")
    nonfinite = _code("A solver met NaN or infinity.")
    # Of constrained dynamics.
    singular_mass_matrix = _code(
        "The mass matrix is not positive definite to rounding: a joint moves no inertia, or next to none."
    )
    dependent_rows = _code("The constraint rows are dependent; take method='rank_aware'.")
    contradictory_rows = _code("No acceleration satisfies the constraint rows: they contradict each other.")
    singular_basis = _code("The minimal velocities do not determine the others here; choose another basis.")
    not_assembled = _code("No configuration and velocity that satisfy the constraints were found.")
    # Of simulations: those of diffrax, by its names, and ours.
    dt_min_reached = _code("The minimum step size was reached in the differential equation solver.")
    event_occurred = _code("An event ended the motion.")
    max_steps_rejected = _code("Too many steps were rejected.")
    internal_error = _code("diffrax met an error of its own.")
    nonfinite_start = _code("The initial state is not finite, or a quaternion in it is zero.")
    nonfinite_state = _code("The state became NaN or infinite.")
    unordered_times = _code("The save points are not finite and increasing.")
    bad_stepsize = _code("The step is not positive and finite, or does not fit a sampled control.")
    bad_tolerance = _code("A tolerance is negative or not finite.")
    coarse_steps = _code(
        "The fixed steps are too long, or too many for the dtype: the motion may be wrong by a tenth of it or more."
    )
    coarse_start = _code("The initial state has an angle of so many turns that its dtype holds too little of the rest.")
    inconsistent_start = _code("The initial state is not on the constraints.")
    no_freedom = _code("The constraints remove all degrees of freedom: no motion is possible.")
    open_constraints = _code("The constraints opened, and the projection could not close them.")
    contact_lost = _code("A contact pulled or left its friction cone.")
    joint_limit_passed = _code("A joint passed one of its position limits.")
    control_singular = _code(
        "The control came to where its task cannot be followed: task and constraints, or its motors, lose rank."
    )
    too_many_events = _code("Events followed each other without end, or there were more than max_events.")
    painleve_paradox = _code(
        "Friction and normal force of a sliding contact left no forces, or more than one (Painleve's paradox)."
    )
    no_contact_mode = _code("No mode of the contacts was found that agrees with their forces.")
    no_single_contact = _code(
        "Surfaces that roll do not touch in one point any more: their relative curvature is not positive."
    )
    unnormalized_start = _code("A quaternion of the initial state is not of unit length.")
    targets_not_reached = _code("No configuration that reaches the targets was found.")
    no_descent = _code("No step along the search direction reduces the cost.")
    underactuated = _code("The motors cannot produce this motion.")
    # Of quadratic programs.
    infeasible = _code("No x satisfies the rows and cones of the quadratic program.")
    stalled = _code("The quadratic program was not solved to the tolerance within the given steps.")
    indefinite = _code("The matrix Q of the quadratic program is not positive definite.")
    # Of fits.
    stopped = _code("The callback or the time limit stopped the fit.")
    # Of constrained dynamics; at the end, see `CODES`.
    unclear_rank = _code(
        "The rank of the constraint rows is unclear: singular values that count and those that do not differ by less than a "
        "factor of 100. Give more digits, or a rank_tol."
    )
    # Of searches for the nearest configuration.
    not_nearest = _code(
        "The configuration satisfies the constraints, but the search for the nearest one to the guess or the posture did not "
        "converge."
    )
    # Of steps with contacts.
    no_contact_impulses = _code("No contact impulses that satisfy Coulomb's law were found for the step.")
    # Of terminal events.
    bad_event = _code("The function of a terminal event is not above zero at the start.")

    @staticmethod
    def where(condition: Bool[ArrayLike, ""], code: Result, otherwise: Result) -> Result:
        """The first code where a condition () holds, else the second."""
        # Equal known codes stay known when the condition is traced.
        if code.index is otherwise.index:
            return code
        with jax.ensure_compile_time_eval():
            return Result(jnp.where(condition, code.index, otherwise.index))


# A code in arrays and files is the index of its name: append new names at the end of `RESULTS`, or old files change meaning.
CODES = tuple(name for name, code in vars(RESULTS).items() if isinstance(code, Result))


def require_finite(result: Any, *values) -> Any:
    """The result, or `nonfinite` where it is `successful` and a value is not finite."""
    is_finite = jnp.stack([jnp.isfinite(x).all() for x in values]).all()
    return RESULTS.where(is_finite | (result != RESULTS.successful), result, RESULTS.nonfinite)


def code_of(result: Any) -> Array:
    """Index of a result, traced or batched, in `CODES` (uint8)."""
    return jnp.asarray(result.index, jnp.uint8)


def is_successful(result: Any) -> bool:
    """Decide whether a concrete result, or all of a batch, are `successful`, without a program of XLA."""
    return bool(np.all(np.asarray(result.index) == np.asarray(RESULTS.successful.index)))


def name_of(result: Any) -> str:
    """Name of one concrete result."""
    return CODES[int(np.asarray(result.index))]


class Outcome(eqx.Module):
    """Base of outcomes with a `result`, one of `RESULTS`."""

    @property
    def success(self) -> Bool[Array, "..."]:
        """True where `result` is `RESULTS.successful`."""
        return self.result == RESULTS.successful  # pyright: ignore[reportAttributeAccessIssue]


def require_success(outcome: Any, throw: bool | None, message: Callable[[Any], str]) -> Any:
    """The outcome, or an error where it failed: by default for concrete ones, and always or never as `throw` says.

    `message` makes the text from the outcome without tangents, whose numbers can be read under `jax.grad` too.

    **Raises:** ValueError with the message; under tracing the program raises the text of the result's code.
    """
    throw = throw if throw is None else check_flag(throw, "throw")
    if not is_concrete(outcome.result):
        # Under tracing the result is unknown, so that only an error at run time is possible.
        return outcome.result.error_if(outcome, ~outcome.success) if throw else outcome
    if (throw is None or throw) and not is_successful(outcome.result):
        raise ValueError(message(stop_gradient(outcome)))
    return outcome


def first_of(cases: Sequence[tuple[Any, Any]], otherwise: Any) -> Any:
    """Code of the first case (condition, code) whose condition holds, else the one given."""
    # Backwards, so that the first case replaces the others.
    for condition, code in reversed(cases):
        otherwise = RESULTS.where(condition, code, otherwise)
    return otherwise
