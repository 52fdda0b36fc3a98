"""Position limits of joints during a motion: where one is passed, as a report or as the end of the run."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene

CHOICES = ("report", "stop", None)


class JointLimitWarning(UserWarning):
    """A motion has passed a position limit of the model, and went on."""


def check_limits(scene: Scene, limits: Any, modal: bool) -> None:
    """Refuse an unknown choice, and limits of a system that has none.

    **Raises:** ValueError.
    """
    if limits not in CHOICES:
        raise ValueError(f"limits is {limits!r}; choose from {', '.join(map(repr, CHOICES))}")
    if limits is not None and not isinstance(scene.system, Model):
        raise ValueError(
            f"limits is {limits!r}, and a {type(scene.system).__name__} has no joint limits; pass limits=None"
        )
    if limits == "stop" and modal:
        raise ValueError(
            "limits is 'stop', which a scene whose forces have modes (jd.contact.DryFriction, jd.contact.UnilateralContact) "
            "does not take; pass limits='report'"
        )


def limit_margins(model: Model, q: Float[Array, " nq"]) -> Float[Array, " n"]:
    """How far each entry of q is above its lower and below its upper limit, plus rounding, eps^(1/2) of the limit's size.

    Negative where a limit is passed, rad or m; a large number where there is none.
    """
    none = jnp.full_like(q, float(jnp.finfo(q.dtype).max) ** 0.5)

    def margin(limit, room):
        slack = jnp.finfo(q.dtype).eps ** 0.5 * jnp.maximum(jnp.abs(limit), jnp.ones_like(limit))
        return jnp.where(jnp.isfinite(limit), room + slack, none)

    lower, upper = model.lower.astype(q.dtype), model.upper.astype(q.dtype)
    return jnp.concatenate([margin(lower, q - lower), margin(upper, upper - q)])


def passed(margins: Float[Array, "nt n"], reached: Bool[Array, " nt"]) -> Int[Array, ""]:
    """The entry of q whose limit is passed at the first save point where one is, or -1."""
    below = reached & (margins < 0).any(1)
    entry = jnp.argmin(margins[jnp.argmax(below)]) % (margins.shape[1] // 2)
    return jnp.where(below.any(), entry, -1).astype(jnp.int32)


def joint_of(model: Model, entry: int) -> str:
    """Name of the joint that an entry of q belongs to."""
    places = zip(model.topology.q_slices, model.joint_names, strict=True)
    return next(name for place, name in places if place.start <= entry < place.stop)


def limit_in_words(model: Model, entry: int, q) -> str:
    """Which joint is at or beyond which of its limits, for a concrete configuration."""
    lower, upper, value = (float(np.asarray(x)[entry]) for x in (model.lower, model.upper, q))
    beyond, limit = ("lower", lower) if value - lower < upper - value else ("upper", upper)
    return f"joint {joint_of(model, entry)!r} is at {value:.6g}, its {beyond} limit is {limit:.6g}"


def reported(scene: Scene, solution: Any, concrete: bool) -> Any:
    """The solution with `stats["passed_limit"]`; a concrete one that passes a limit warns, one that is traced does not."""
    margins = jax.vmap(limit_margins, (None, 0))(scene.system, solution.q)
    entry = passed(margins, jnp.isfinite(solution.q).all(1))
    if concrete and int(entry) >= 0:
        first = int(np.argmax(np.asarray(margins < 0).any(1)))
        words = limit_in_words(scene.system, int(entry), solution.q[first])
        warnings.warn(
            f"{words}, at t = {float(solution.ts[first]):.6g} s; the motion goes on (limits='stop' ends it there)",
            JointLimitWarning,
            stacklevel=3,
        )
    return eqx.tree_at(lambda s: s.stats, solution, solution.stats | {"passed_limit": entry})
