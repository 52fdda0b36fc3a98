"""Events of `jd.simulate`: conditions that end a motion or are reported, and the number of mode switches of a motion."""

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxdyn.contact.forces import contact_forces, contacts_with_cones
from jaxdyn.forces.piecewise import has_pieces
from jaxdyn.model.arguments import Function, Number, as_array, check_flag
from jaxdyn.model.tree import Model
from jaxdyn.simulation.solution import RESULTS, Solution, joint_of
from jaxdyn.systems.scene import Scene, as_pytree

__all__ = ["ContactLost", "JointLimit", "ModeSwitches", "Progress", "Terminal"]


def __dir__() -> list[str]:
    """Names of the namespace."""
    return __all__


@dataclass(frozen=True)
class ContactLost:
    r"""A contact of a scene with `cones` that pulls or leaves its friction cone.

    The event is where a margin falls below zero by more than rounding, $\epsilon^{1/2}$ of the contact's force.

    **Arguments:** `stop`: if True (the default, also of a run without this event) the run ends there, with the code
    `contact_lost` and the time, which is found within the step. If False it continues, with contacts that hold on both sides.
    """

    stop: bool = True

    def __post_init__(self):
        check_flag(self.stop, "ContactLost: stop")


@dataclass(frozen=True)
class JointLimit:
    r"""A joint that passes a limit of its model (`model.lower`, `model.upper`), which nothing enforces.

    **Arguments:** `stop`: if True (default) the run ends there, with the code `joint_limit_passed` and the time, found within the
    step. If False it continues; `stats["passed_limit"]` is the entry of q of the first limit that is passed at a save point,
    or -1, and a concrete run warns (`jd.simulation.JointLimitWarning`).

    A limit is passed beyond rounding, $\epsilon^{1/2}$ of its size or of one, by which the time is late.
    Without this event limits are ignored. Passages that end within a step are found too, except short ones: of less than about
    1e-3 of what the joint moves in the step with explicit methods, which predict where it comes nearest to the limit, and of
    less than an eighth of the step's time with others. If only a save point shows a passage, its time is that of the save point.
    The same holds for the other events.
    """

    stop: bool = True

    def __post_init__(self):
        check_flag(self.stop, "JointLimit: stop")


@dataclass(frozen=True)
class ModeSwitches:
    """Impacts, and changes between sticking, sliding and separation, of forces with modes; kinks of piecewise forces.

    **Arguments:** `max_events`: number of them after which the run ends with the code `too_many_events`; 256 by default, also of
    a run without this event. Of piecewise forces (`jd.forces.PiecewiseForce`), the number that derivatives follow.
    """

    max_events: int = 256

    def __post_init__(self):
        maximum = self.max_events
        if isinstance(maximum, bool) or not isinstance(maximum, (int, np.integer)) or maximum < 1:
            raise ValueError(f"max_events is {maximum!r}; pass a positive integer, such as 64")


@dataclass(frozen=True)
class Progress:
    """A meter of the time reached, shown during the run by tqdm where it is installed, else as lines of text.

    diffrax makes the steps of such a run.
    """


class Terminal(eqx.Module):
    """A terminal event: the run ends where function(q, v, t) falls below zero.

    The code is `event_occurred`, which counts as a success. `stats["terminal_event"]` is the index of the event among the
    terminal ones, or -1, and `stats["time_reached"]` its time, found within the step, with derivatives. Later rows are NaN.

    **Arguments:** `function`: function(q (nq,), v (nv,), t ()) -> (), smooth, and above zero at the start. An equinox Module or
    a `jax.tree_util.Partial` carries leaves that can be differentiated and batched; a plain function is static: define it once.
    NaN counts as below zero, as behind the end of a root's domain. A traced run that does not start above zero has the code
    `bad_event`. Where it changes its sign several times within a step, the time may be that of a later zero, or of the save
    point that shows it, whose derivative is zero: give shorter steps.

    **Raises:** ValueError for what cannot be called so, and, by `jd.simulate`, for a known start at which it is not above zero
    and for a scene whose forces have modes.

    ```python
    reached = jd.events.Terminal(lambda q, v, t: 0.5 - q[0])
    jd.simulate(model, q0, v0, ts, events=[reached])
    ```
    """

    function: Callable

    def __init__(self, function: Function):
        self.function = as_pytree(function, "Terminal: function", "q, v, t")

    def margin(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, ""]:
        """Value of the function, (), in the dtype of q. **Raises:** ValueError where it is not one number."""
        value = as_array(self.function(q, v, t), "Terminal: function")
        if value.shape != ():
            raise ValueError(f"Terminal: function returned shape {value.shape}; return one number, ()")
        if value.dtype == bool:
            raise ValueError("Terminal: function returned a bool, which cannot fall below zero; return a difference")
        return as_array(value, "Terminal: function", q.dtype)


Event: TypeAlias = ContactLost | JointLimit | ModeSwitches | Progress | Terminal


class Watch(NamedTuple):
    """Events of a run without arrays; None for a kind that was not given."""

    contacts: ContactLost | None = None
    limits: JointLimit | None = None
    switches: ModeSwitches | None = None
    progress: Progress | None = None

    @property
    def max_events(self) -> int:
        """Largest number of mode switches."""
        return (self.switches or ModeSwitches()).max_events


_KINDS = (ContactLost, JointLimit, ModeSwitches, Progress)
_NONE = Watch()


def sort_events(events: Iterable[Event]) -> tuple[Watch, tuple[Terminal, ...]]:
    """Events of a run by their kinds, and the terminal ones. **Raises:** ValueError for other objects, and for a kind twice."""
    if isinstance(events, (tuple, list)) and not events:
        return _NONE, ()
    if not isinstance(events, (tuple, list)):
        raise ValueError(f"events is {events!r}; pass a list, such as [jd.events.JointLimit()]")
    for one in events:
        if not isinstance(one, (*_KINDS, Terminal)):
            raise ValueError(f"events has {one!r}; give objects of jd.events, as jd.events.Terminal(function)")
    by_kind: list[list[Any]] = [[one for one in events if isinstance(one, kind)] for kind in _KINDS]
    for kind, given in zip(_KINDS, by_kind, strict=True):
        if len(given) > 1:
            raise ValueError(f"events has {len(given)} of jd.events.{kind.__name__}; give one")
    watch = Watch(*(given[0] if given else None for given in by_kind))
    return watch, tuple(one for one in events if isinstance(one, Terminal))


def check_events(scene: Scene, watch: Watch, modal: bool) -> None:
    """Refuse events that cannot happen in a scene, and ends at limits in a motion with modes."""
    if watch.switches is not None and not modal and not any(has_pieces(force) for force in scene.forces):
        raise ValueError(
            f"events has {watch.switches}, and no force of the scene has events (jd.contact.DryFriction, "
            "jd.contact.UnilateralContact, jd.forces.PiecewiseForce); omit it"
        )
    if watch.contacts is not None and scene.cones is None:
        raise ValueError(
            f"events has {watch.contacts}, and the scene has no cones; omit it, or give jd.Scene(cones=...)"
        )
    if watch.limits is None:
        return
    if not isinstance(scene.system, Model):
        raise ValueError(f"events has {watch.limits}, and a {type(scene.system).__name__} has no joint limits; omit it")
    if watch.limits.stop and modal:
        raise ValueError(
            f"events has {watch.limits}, which a scene whose forces have modes (jd.contact.DryFriction, "
            "jd.contact.UnilateralContact) does not support; pass jd.events.JointLimit(stop=False)"
        )


def check_terminals(terminals: tuple[Terminal, ...], modal: bool, start: tuple[Any, Any, Any] | None) -> None:
    """Refuse terminal events of motions with modes, and those not above zero at the start (q, v, t), None where it is traced."""
    if terminals and modal:
        raise ValueError(
            "events has a jd.events.Terminal, which a scene whose forces have modes (jd.contact.DryFriction, "
            "jd.contact.UnilateralContact) does not support; end ts earlier"
        )
    for i, one in enumerate(terminals if start is not None else ()):
        value = float(one.margin(*map(jnp.asarray, start or ())))
        # Negated, so that NaN is refused. At zero, rounding would decide whether the run ends at once.
        if not value > 0:
            raise ValueError(
                f"the function of terminal event {i} is {value:.6g} at the start; give one that is above zero there, such as a "
                "distance that the motion has still to go"
            )


def events_of(
    contacts: str | None = None, limits: str | None = None, max_events: int | None = None, progress: bool = False
) -> list[Any]:
    """Events by words: `contacts` and `limits` are "stop" or "report". **Raises:** ValueError for other words."""
    events: list[Any] = []
    for name, word, kind in (("contacts", contacts, ContactLost), ("limits", limits, JointLimit)):
        if word not in ("stop", "report", None):
            raise ValueError(f"{name} is {word!r}; choose from 'stop', 'report'")
        events += [] if word is None else [kind()] if word == "stop" else [kind(stop=False)]
    return events + ([] if max_events is None else [ModeSwitches(max_events)]) + ([Progress()] if progress else [])


# --- conditions that end a run ---
#
# The rows of a contact are two-sided; whether its cone admits the multipliers is tested during the motion. Each of these
# conditions has an allowance, which is negative where it is violated. The run ends at the first zero of the least allowance that
# a step shows at its end or within. The library's own loops locate it by shorter steps (`solvers/guards.py`); diffrax's by
# bisection of the step's dense output. Where a save point alone shows a violation, its time is that of the save point.


class JointLimitWarning(UserWarning):
    """A motion has passed a position limit of the model, and continues."""


class Conditions(NamedTuple):
    """Conditions that can end a run: its contacts, its joint limits, its control, and the number of terminal events."""

    contacts: bool
    limits: bool
    control: bool
    terminals: int

    def counts(self, scene: Scene) -> tuple[int, int, int, int]:
        """Numbers of allowances of contacts, limits, the control and terminal events, in this order among all."""
        contacts = len(contacts_with_cones(scene)) if self.contacts else 0
        return contacts, 2 * scene.nq if self.limits else 0, int(self.control), self.terminals


def contact_allowances(scene: Scene, multipliers: Float[Array, " nc"]) -> Float[Array, " k"]:
    """Margin of each contact with a cone, plus the rounding of its force, eps^(1/2) |f|; N. Negative where it is lost."""
    contacts = contact_forces(scene, multipliers)
    # A contact that is held exactly on its cone is not lost by rounding.
    slack = jnp.finfo(multipliers.dtype).eps ** 0.5
    return jnp.stack(
        [contacts.margins[name] + slack * jnp.sum(jnp.abs(contacts.forces[name])) for name in contacts.margins]
    )


def limit_allowances(model: Model, q: Float[Array, " nq"]) -> Float[Array, " n"]:
    """Distances of q above the lower limits, then below the upper ones, plus rounding, eps^(1/2) of the limit's size.

    Negative where a limit is passed, rad or m; a large number where there is none.
    """
    # A finite number for "no limit": bisection and products of infinity would give NaN.
    none = jnp.full_like(q, float(jnp.finfo(q.dtype).max) ** 0.5)

    def allowance(limit, room):
        slack = jnp.finfo(q.dtype).eps ** 0.5 * jnp.maximum(jnp.abs(limit), jnp.ones_like(limit))
        return jnp.where(jnp.isfinite(limit), room + slack, none)

    lower, upper = model.lower.astype(q.dtype), model.upper.astype(q.dtype)
    return jnp.concatenate([allowance(lower, q - lower), allowance(upper, upper - q)])


class Violation(NamedTuple):
    """The first violation: whether and when there was one, and the entry of the allowances, -1 for none."""

    happened: Bool[Array, ""]
    time: Float[Array, ""]
    entry: Int[Array, ""]

    def codes(self, counts: tuple[int, int, int, int]) -> list[tuple[Any, Any]]:
        """Cases of the result, for `first_of`; `counts` as of `Conditions`."""
        codes: Any = RESULTS
        names = codes.contact_lost, codes.joint_limit_passed, codes.control_singular, codes.event_occurred
        return [(self._within(counts, i), code) for i, code in enumerate(names)]

    def _within(self, counts, kind: int) -> Bool[Array, ""]:
        first = sum(counts[:kind])
        return self.happened & (self.entry >= first) & (self.entry < first + counts[kind])

    def stats(self, conditions: Conditions, counts: tuple[int, int, int, int]) -> dict[str, Array]:
        """Index of the contact that was lost, entry of q whose limit was passed, terminal event, each -1 for none."""
        # The lower limits of all entries come before the upper ones: both belong to the entry modulo their number.
        names = {"lost_contact": (0, counts[0]), "passed_limit": (1, counts[1] // 2), "terminal_event": (3, counts[3])}
        return {
            name: jnp.where(self._within(counts, kind), (self.entry - sum(counts[:kind])) % size, -1).astype(jnp.int32)
            for name, (kind, size) in names.items()
            if conditions[kind]
        }


def first_violation(
    rows: Float[Array, "nt k"],
    reached: Bool[Array, " nt"],
    ts: Float[Array, " nt"],
    time: Float[Array, ""],
    entry: Int[Array, ""] | None,
) -> Violation:
    """First negative allowance, from those at the save points and at the event that ended a step.

    `time` and `entry` are those of such an event, -1 for none; None where no loop looks for one.
    """
    below = reached & (rows < 0).any(1)
    # The first true flag; zero without any, where `happened` is false.
    first = jnp.argmax(below)
    violation = Violation(below.any(), ts[first], jnp.argmin(rows[first]).astype(jnp.int32))
    if entry is not None:
        located = Violation(entry >= 0, time, entry.astype(jnp.int32))
        earlier = located.happened & ~(violation.happened & (violation.time <= time))
        violation = jax.tree.map(lambda a, b: jnp.where(earlier, a, b), located, violation)
    return violation._replace(entry=jnp.where(violation.happened, violation.entry, -1))


def report_limits(scene: Scene, solution: Solution, is_concrete: bool) -> Solution:
    """Add `stats["passed_limit"]` to a solution; a concrete one that passes a limit warns, a traced one does not."""
    model: Any = scene.system
    margins = jax.vmap(limit_allowances, (None, 0))(model, solution.q)
    # Rows that the run did not reach are NaN.
    below = jnp.isfinite(solution.q).all(1) & (margins < 0).any(1)
    entry = jnp.argmin(margins[jnp.argmax(below)]) % (margins.shape[1] // 2)
    entry = jnp.where(below.any(), entry, -1).astype(jnp.int32)
    if is_concrete and int(entry) >= 0:
        first, joint = int(np.argmax(np.asarray(margins < 0).any(1))), joint_of(model, int(entry))
        lower, upper, q = (float(np.asarray(x)[int(entry)]) for x in (model.lower, model.upper, solution.q[first]))
        side, limit = ("lower", lower) if q - lower < upper - q else ("upper", upper)
        words = (
            f"joint {joint!r} is at {q:.6g}, its {side} limit is {limit:.6g}, at t = {float(solution.ts[first]):.6g} s"
        )
        warnings.warn(
            f"{words}; the motion continues (jd.events.JointLimit() ends it there)", JointLimitWarning, stacklevel=3
        )
    return eqx.tree_at(lambda s: s.stats, solution, solution.stats | {"passed_limit": entry})
