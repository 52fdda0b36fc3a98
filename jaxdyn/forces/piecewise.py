"""Piecewise smooth forces: their switching functions, and scenes with forces fixed to given pieces.

A force with a kink or a jump declares switching functions. `jd.simulate` ends a step where one of them changes its
sign, so that no step crosses a kink, and the derivatives of the motion are those of the pieces, joined by the
derivative of the switching time.
"""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdyn.model.arguments import Number, SystemLike
from jaxdyn.systems.scene import Scene, pass_command


class PiecewiseForce(eqx.Module):
    """Base class of forces that are smooth except where one of their switching functions changes its sign.

    Subclasses define two methods. A call evaluates the piece of the current state.

    - `guards(system, q, v, t) -> (n,)`: the switching functions, each smooth near its own zeros, in any unit.
    - `force(system, q, v, t, positive) -> (nv,)`: the force in the piece whose positive guards are marked by
      `positive` (n,). For a fixed `positive` it is smooth, also across the zeros of the guards.

    ```python
    class Backlash(jd.forces.PiecewiseForce):
        stiffness: jax.Array
        play: jax.Array

        def guards(self, system, q, v, t):
            return jnp.stack([q[0] - self.play, -q[0] - self.play])

        def force(self, system, q, v, t, positive):
            beyond = jnp.where(positive[0], q[0] - self.play, jnp.where(positive[1], q[0] + self.play, 0.0))
            return jnp.zeros_like(v).at[0].set(-self.stiffness * beyond)

    scene = jd.Scene(system, forces=[Backlash(jnp.asarray(300.0), jnp.asarray(0.02))])
    ```
    """

    @abc.abstractmethod
    def guards(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " n"]:
        """Switching functions (n,)."""

    @abc.abstractmethod
    def force(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        positive: Bool[Array, " n"],
    ) -> Float[Array, " nv"]:
        """Force (nv,) in the piece that `positive` marks."""

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        # A guard of exactly zero belongs to the negative side.
        return self.force(system, q, v, t, self.guards(system, q, v, t) > 0)


def has_pieces(force: Any) -> bool:
    """Decide whether a force has switching functions."""
    return isinstance(force, PiecewiseForce) or hasattr(force, "effort_guards")


class _FixedPiece(eqx.Module):
    """Force of a scene fixed to one piece."""

    inner: Any
    positive: Any
    of_efforts: Any

    def __call__(self, system, q, v, t):
        if isinstance(self.inner, PiecewiseForce):
            return self.inner.force(system, q, v, t, self.positive)
        return self.inner(system, q, v, t)

    def clip_effort(self, system, tau, v=None):
        cut = getattr(self.inner, "clip_effort", None)
        # A force without effort limits leaves the command as it is.
        return tau if cut is None else cut(system, tau, self.of_efforts, v=v)


def guards_by_force(scene: Scene, q, v, t, tau, state=None) -> list[tuple[Any, Any]]:
    """Switching functions of each force and of its clipping of `tau` (nv,); None where it has none.

    `tau`: effort of the control before drives and limits; None without a control, or where what is clipped does not depend on
    the state of the motion. `state`: of the scene's drives.
    """
    rows = []
    for force in scene.forces:
        # Guards do not depend on the piece, so that a scene with fixed pieces has those of the scene itself.
        force = force.inner if isinstance(force, _FixedPiece) else force
        own = efforts = None
        if isinstance(force, PiecewiseForce):
            own = jnp.asarray(force.guards(scene.system, q, v, t), q.dtype)
            if own.ndim != 1:
                raise ValueError(f"{type(force).__name__}: guards gives shape {own.shape}; expected (n,)")
        if tau is not None and hasattr(force, "effort_guards"):
            efforts = force.effort_guards(scene.system, tau, v)  # pyright: ignore[reportAttributeAccessIssue]
        # Drives and limits act one after the other: the next one sees the clipped effort.
        if tau is not None:
            tau, _, state = pass_command(force, scene.system, q, v, t, tau, state)
        rows.append((own, efforts))
    return rows


class Pieces(NamedTuple):
    """Layout of a scene's switching functions: for each force the numbers of its own and of its effort limits."""

    counts: tuple[tuple[int, int], ...]
    names: tuple[str, ...]


def pieces_of(scene: Scene, y, q, v, t, tau_of: Callable | None) -> Pieces:
    """Layout of the switching functions of a scene under a control at one state.

    tau_of(y, q, v, t) is the control's effort and the state of the scene's drives; None without a control.
    """

    # Smooth scenes end here: their control need not be traced.
    if not any(map(has_pieces, scene.forces)):
        return Pieces(((0, 0),) * len(scene.forces), ())

    def shapes(y, q, v, t):
        return guards_by_force(scene, q, v, t, *((None,) if tau_of is None else tau_of(y, q, v, t)))

    counts, names = [], []
    # Shapes alone are needed, so nothing is computed or compiled.
    for i, (force, parts) in enumerate(zip(scene.forces, jax.eval_shape(shapes, y, q, v, t), strict=True)):
        counts.append(tuple(0 if part is None else part.shape[0] for part in parts))
        names += [f"{type(force).__name__} ({i}): switch {k}" for k in range(sum(counts[-1]))]
    return Pieces(tuple(counts), tuple(names))


def guards(scene: Scene, q, v, t, tau, state=None) -> Float[Array, " n"]:
    """Values of all switching functions of a scene's forces, (n,)."""
    parts = [part for pair in guards_by_force(scene, q, v, t, tau, state) for part in pair if part is not None]
    return jnp.concatenate(parts) if parts else jnp.zeros((0,), q.dtype)


def fix_pieces(scene: Scene, pieces: Pieces, positive: Bool[Array, " n"]) -> Scene:
    """Copy of a scene with its forces fixed to the pieces that `positive` marks."""
    forces, place = [], 0
    for force, (own, efforts) in zip(scene.forces, pieces.counts, strict=True):
        middle, end = place + own, place + own + efforts
        marks = positive[place:middle], positive[middle:end] if efforts else None
        # The marks are arrays: all pieces share one compiled program.
        forces.append(_FixedPiece(force, *marks) if own + efforts else force)
        place = end
    return eqx.tree_at(lambda scene: scene.forces, scene, tuple(forces))


def values_and_levels(switching: Callable, *state):
    """Values of switching(*state) (k,), and their rounding errors.

    The derivative of a function along its own arguments (q, v) measures the size of the terms that cancel in it.
    """
    # Terms that cancel in the value need not cancel in this derivative, unless all are homogeneous of one degree.
    values, sizes = jax.jvp(switching, state, state)
    return values, jax.lax.stop_gradient(100 * float(jnp.finfo(values.dtype).eps) * (jnp.abs(sizes) + jnp.abs(values)))
