"""Impacts: velocities behind them, with rebounds by Newton's hypothesis."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.hybrid.modes import Elements, Mode
from jaxdyn.simulation.hybrid.reactions import Reaction, coefficients, directions, react
from jaxdyn.simulation.hybrid.rows import StateTerms, by_normal_row, tolerance
from jaxdyn.systems.scene import Scene


class Collision(NamedTuple):
    """Data of an impact beside the state: a mode, directions of sliding (n, 2), and the fate of each contact.

    `rebound` (n,) multiplies coefficients of restitution. Contacts that are `held` (n,) rest behind the impact whatever the sign
    of their impulse, as their flight would be too short to be seen; elements that are `stopped` (n,) stick behind it.
    """

    mode: Mode
    slip: Array
    rebound: Array
    held: Array
    stopped: Array


def rebounds(elements: Elements, terms: StateTerms, restitution) -> Array:
    """Velocity of each gap (n,) after an impact by Newton's hypothesis: e times that with which it closes."""
    zero = jnp.zeros((), restitution.dtype)
    rates = jnp.stack([-terms.row.velocity[one.normal] if one.opens else zero for one in elements.each])
    # A contact that rests closes with the rounding of its velocity.
    return restitution * jnp.where(rates > 10 * tolerance(zero.dtype), rates, 0.0)


def impact(scene: Scene, elements: Elements, collision: Collision, terms: StateTerms, v) -> tuple[Array, Reaction]:
    """Velocity (nv,) after an impact, and its impulses."""
    # An impact changes no positions: the rows and the mass matrix are those before it.
    of = coefficients(scene, elements, v.dtype)
    rebound = rebounds(elements, terms, of.restitution * collision.rebound)
    friction = jnp.where(collision.held, 0.0, of.sliding)
    # Finite forces have no impulse, nor has the friction under them.
    loads = jnp.zeros_like(rebound)
    along = directions(scene, elements, collision.mode, jnp.zeros_like(collision.slip), collision.slip)
    target = by_normal_row(elements, rebound) - terms.row.velocity
    reaction = react(elements, collision.mode, terms.gram, friction, loads, along, target)
    return v + terms.metric.unwhiten(matmul(terms.gram.Y, reaction.along)), reaction
