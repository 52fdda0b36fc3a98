"""Contacts during a motion: their forces as outputs, and where one of them pulls or leaves its cone, which ends the motion.

The rows of a contact are two-sided; whether its cone admits the multipliers is tested during the motion. Let m(t) be the least
margin of all contacts (`FrictionCone.margin`). The motion ends at the first zero of m that a step or a save point shows, found
by bisection of the step's dense output. A cone that is entered and left within one step is not seen.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Bool, Float, Int

from jaxdyn.contact.forces import contact_forces, contacts_with_cones
from jaxdyn.systems.scene import Scene

OUTPUTS = ("contact_forces", "contact_margins")
CHOICES = ("stop", "report")


def check_contacts(scene: Scene, contacts: str, outputs) -> None:
    """Refuse an unknown choice, cones that do not fit, and contact forces of a scene without cones.

    **Raises:** ValueError.
    """
    if contacts not in CHOICES:
        raise ValueError(f"contacts is {contacts!r}; choose from {', '.join(map(repr, CHOICES))}")
    if scene.cones is not None:
        contacts_with_cones(scene)
    elif any(name in OUTPUTS for name in outputs):
        wanted = next(name for name in outputs if name in OUTPUTS)
        raise ValueError(
            f"outputs has {wanted!r} and the scene has no cones; give its contacts cones, as in jd.Scene(..., "
            "cones=jd.contact.friction_cone('hard-finger', mu=0.8))"
        )


def can_end(scene: Scene, contacts: str) -> bool:
    """Whether a contact can end the motion."""
    return contacts == "stop" and scene.cones is not None


def allowances(scene: Scene, multipliers: Float[Array, " nc"]) -> Float[Array, " k"]:
    """Margin of each contact with a cone, plus the rounding of its force, eps^(1/2) |f|; N. Negative where it is lost."""
    contacts = contact_forces(scene, multipliers)
    slack = jnp.finfo(multipliers.dtype).eps ** 0.5
    return jnp.stack(
        [contacts.margins[name] + slack * jnp.sum(jnp.abs(contacts.forces[name])) for name in contacts.margins]
    )


class Loss(NamedTuple):
    """Whether and when an allowance fell below zero, and which entry, -1 for none."""

    happened: Bool[Array, ""]
    time: Float[Array, ""]
    entry: Int[Array, ""]


def first_loss(rows: Float[Array, "nt k"], reached, ts, within) -> Loss:
    """The first allowance that is used up, from those at the save points and at the event that ended a step.

    `within` is None, or whether there was such an event, its time and the allowances (k,) there.
    """
    below = reached & (rows < 0).any(1)
    first = jnp.argmax(below)
    loss = Loss(below.any(), ts[first], jnp.argmin(rows[first]).astype(jnp.int32))
    if within is not None:
        happened, time, margins = within
        # A singular basis may have ended the step too: then no margin is near zero.
        happened = happened & (jnp.min(margins) <= jnp.finfo(rows.dtype).eps ** 0.25 * (1 + jnp.max(jnp.abs(margins))))
        located = Loss(happened, time, jnp.argmin(margins).astype(jnp.int32))
        earlier = happened & ~(loss.happened & (loss.time <= time))
        loss = jax.tree.map(lambda a, b: jnp.where(earlier, a, b), located, loss)
    return loss._replace(entry=jnp.where(loss.happened, loss.entry, -1))


def event(allowance, basis, start, dtype) -> diffrax.Event:
    """Ends a step where the least allowance falls to zero, or where what `basis` gives has no longer the sign of `start`."""

    def condition(t, y, args, **_):
        least = allowance(t, y, args)
        if basis is not None:
            least = jnp.where(basis(t, y, args) * start > 0, least, -jnp.ones_like(least))
        return least.astype(float)  # as diffrax's own branches are

    eps = float(jnp.finfo(dtype).eps)
    return diffrax.Event(condition, Bisection(rtol=8 * eps, atol=8 * eps, flip=True), direction=False)


def reported(scene: Scene, multipliers: Float[Array, " nc"], outputs) -> dict[str, dict[str, Array]]:
    """The outputs that are asked for, each by the contacts' names."""
    if not set(OUTPUTS) & set(outputs):
        return {}
    contacts = contact_forces(scene, multipliers)
    return {
        name: value for name, value in zip(OUTPUTS, (contacts.forces, contacts.margins), strict=True) if name in outputs
    }


class Bisection(optimistix.Bisection):
    """Bisection of a function that falls through zero, until the interval is at rounding, however steep the function is."""

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the interval has become small."""
        width = jnp.abs(state.upper - state.lower)
        return width <= self.atol + self.rtol * jnp.abs(y), optimistix.RESULTS.successful
