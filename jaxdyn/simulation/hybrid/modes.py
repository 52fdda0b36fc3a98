"""Contacts and frictions of a scene as rows of an extended scene, their modes, and the events between modes.

Forces p along the rows change their rates by G p, with G = A M^-1 A^T = Y^T Y, Y = U^-1 A^T, M = U U^T. Rows that depend on each
other (a box on four corners) leave G singular: solutions of G x = r are near those of least norm.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import Rows, layout, position_residual, rows
from jaxdyn.constraints.redundancy import add_constraints
from jaxdyn.contact.unilateral import UnilateralContact, WithModes
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.forces.piecewise import Pieces
from jaxdyn.lie.so3 import matmul
from jaxdyn.systems.mass_factor import MassFactor, cholesky, mass_factor, solve_cholesky
from jaxdyn.systems.scene import Scene

KINDS = ("touch", "release", "stick", "slip", "turn", "inner")
CHANNELS = 3  # guards of an element: its normal force or gap, its friction, the pivot of its equations


class Element(NamedTuple):
    """A contact or friction, and its rows among those of the extended scene."""

    name: str
    place: int  # among the scene's forces
    normal: int  # row whose multiplier is the normal force, -1 if the force is given
    tangent: tuple[int, ...]  # rows that slip
    opens: bool  # true for a unilateral contact, which has a normal row of its own
    smooth: bool  # true if the friction is a function of the state


class Mode(NamedTuple):
    """Mode of a motion: flags of its elements (n,) and of its switching functions (k,)."""

    closed: Array
    stick: Array
    negative: Array  # true where the normal multiplier is negative
    positive: Array  # of the switching functions of piecewise smooth forces
    excess: Array  # friction (n,) beyond the cone, of all normal forces, by which an element that depends on others may stick
    # Speeds (n,). Positive: sliding has a fixed direction up to this speed. Negative: its direction is fixed below its size.
    creep: Array

    def signs(self, dtype) -> Array:
        """Signs of the normal multipliers, (n,)."""
        return jnp.where(self.negative, -1.0, 1.0).astype(dtype)


class Elements(NamedTuple):
    """Elements of a scene, numbers of rows of its own constraints and of all, and its switching functions."""

    each: tuple[Element, ...]
    own: int
    count: int
    pieces: Pieces

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the events: every element with every kind, then every switching function."""
        return (*(f"{one.name}: {kind}" for one in self.each for kind in KINDS), *self.pieces.names)

    @property
    def switches(self) -> int:
        """Number of switching functions."""
        return len(self.pieces.names)

    def split(self, flat) -> tuple[Array, Array]:
        """Split guards into those of the elements, (n, CHANNELS), and the switching functions, (k,)."""
        count = CHANNELS * len(self.each)
        return flat[:count].reshape(-1, CHANNELS), flat[count:]

    @property
    def frictional(self) -> tuple[int, ...]:
        """Indices of the elements whose friction is proportional to a multiplier."""
        return tuple(i for i, one in enumerate(self.each) if one.normal >= 0 and one.tangent)

    @property
    def opening(self) -> np.ndarray:
        """Mask of the unilateral elements, (n,)."""
        return np.array([one.opens for one in self.each])

    @property
    def rough(self) -> np.ndarray:
        """Mask of the elements that can stick, (n,)."""
        return np.array([bool(one.tangent) and not one.smooth for one in self.each])

    @property
    def planar(self) -> np.ndarray:
        """Mask of the elements that slide in two directions and can stick, (n,)."""
        return np.array([len(one.tangent) == 2 and not one.smooth for one in self.each])

    @property
    def smooth(self) -> np.ndarray:
        """Mask of the elements whose friction is a function of the state, (n,)."""
        return np.array([one.smooth for one in self.each])

    def active(self, mode: Mode) -> Array:
        """Mask of the rows that act in a mode, (count,)."""
        # The scene's own constraints act in every mode.
        rows: list[Any] = [jnp.ones((), bool)] * self.count
        for i, one in enumerate(self.each):
            if one.opens:
                rows[one.normal] = mode.closed[i]
            for row in one.tangent:
                rows[row] = jnp.zeros((), bool) if one.smooth else mode.closed[i] & mode.stick[i]
        return jnp.stack(rows)


def force_at(scene: Scene, element: Element) -> Any:
    """Force of the scene that belongs to an element."""
    return scene.forces[element.place]


def normal_load(scene: Scene, element: Element, q, v, t) -> Array:
    """Given normal force of a friction, (), N, zero of other elements, and where it is negative: it would drive the motion."""
    normal: Any = force_at(scene, element).normal if element.normal < 0 else 0.0
    value: Any = normal(scene.system, q, v, t) if callable(normal) else normal
    if jnp.shape(value) != ():
        raise ValueError(f"friction {element.name!r}: normal gives shape {jnp.shape(value)}; expected one number, ()")
    return jnp.maximum(jnp.asarray(value, q.dtype), 0.0)


def extend(scene: Scene) -> Scene:
    """Scene with the rows of its elements behind its own, and without these forces."""
    # Behind the scene's own rows, whose indices stay as they are: outputs take the first `own` multipliers.
    more = [_constraint(force) for force in scene.forces if isinstance(force, WithModes)]
    return add_constraints(scene, more, [force for force in scene.forces if not isinstance(force, WithModes)])


def _constraint(force: Any):
    return force.contact if isinstance(force, UnilateralContact) else force.along


def elements_of(scene: Scene, pieces: Pieces) -> Elements:
    """Elements of a scene; `pieces`: its switching functions.

    **Raises:** ValueError for rows that do not fit, and constraints that are not there.
    """
    places, own = layout(extend(scene)), len(scene.constraints)
    names = [place.name for place in places[:own]]
    elements, used = [], []
    chosen: list[Any] = [(i, force) for i, force in enumerate(scene.forces) if isinstance(force, WithModes)]
    for (i, force), place in zip(chosen, places[own:], strict=True):
        gap_rows, friction_rows = place.nonholonomic - place.start, place.end - place.nonholonomic
        tangent = tuple(range(place.nonholonomic, place.end))
        name = force.name
        # `Events.times` finds events by their names, so that two elements may not share one.
        while name in used:
            name = f"{name} ({i})" if name == force.name else f"{name}'"
        used.append(name)
        if isinstance(force, UnilateralContact):
            if gap_rows != 1 or friction_rows > 2:
                raise ValueError(
                    f"contact {name!r} has {gap_rows} rows on positions and {friction_rows} on velocities; a contact has "
                    "a gap and up to two rows without slip: leave out spin=True"
                )
            elements.append(Element(name, i, place.start, tangent, True, False))
            continue
        if gap_rows or not 1 <= friction_rows <= 2:
            raise ValueError(
                f"friction {name!r}: along has {gap_rows} rows on positions and {friction_rows} on velocities; give "
                "one or two on velocities"
            )
        normal = -1
        if force.constraint is not None:
            if force.constraint not in names:
                raise ValueError(f"friction {name!r}: the scene has no constraint {force.constraint!r}; it has {names}")
            at = names.index(force.constraint)
            normal = places[at].start
            if places[at].end - normal > 1 and scene.constraints[at].wrench_components() is None:
                raise ValueError(
                    f"friction {name!r}: constraint {force.constraint!r} has {places[at].end - normal} rows, and no "
                    "normal force among them; name one with one row"
                )
        elements.append(Element(name, i, normal, tangent, False, force.smoothing is not None))
    return Elements(tuple(elements), places[own].start, places[-1].end, pieces)


class Events(eqx.Module):
    """Events of a motion in their order, as arrays of a fixed length.

    - `time` (ne,), s, NaN behind the last event; differentiable. `index` (ne,) among `names`, -1 behind the last event.
    - `names`: "<element>: <kind>". The kinds of a contact are "touch" and "release"; those of friction "stick" and "slip". A
      "turn" reverses the direction of sliding, or the sign of the normal force of a friction that holds on both sides. An
      "inner" event changes how a mode is computed, and not the motion.
      A touch at which infinitely many bounces accumulate has the time of rest, the limit of their series; its derivative is that
      of the last flight that was followed.
    - `count` (): number of events. Elements that change at the same time have one entry each, that of the guard which was
      crossed first in front.
    """

    time: Float[Array, "*batch ne"]
    index: Int[Array, "*batch ne"]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def count(self) -> Int[Array, "*batch"]:
        """Number of events."""
        return (self.index >= 0).sum(-1)

    @property
    def name(self) -> np.ndarray:
        """Names (ne,) of the events, "" behind the last. **Raises:** ValueError inside `jax.jit`, which has no texts."""
        if not is_concrete(self.index):
            raise ValueError(
                "events.name are texts, which a traced program does not have; take events.index and events.names"
            )
        # The index -1 picks the last entry, the empty name.
        return np.array([*self.names, ""], dtype=object)[np.asarray(jax.device_get(self.index))]

    def times(self, name: str) -> np.ndarray:
        """Times of the events of one name, of a single motion.

        **Raises:** ValueError for an unknown name.
        """
        if name not in self.names:
            raise ValueError(f"events: there is no {name!r}; choose from {list(self.names)}")
        return np.asarray(self.time)[self.name == name]


# --- rows of constraints, contacts and frictions at a state, and the metric in which forces along them act ---


class Gram(NamedTuple):
    """Gram matrix G = Y^T Y (count, count) of rows Y (nv, count); `matrix` is None where there are far more rows."""

    Y: Array
    matrix: Array | None

    @classmethod
    def of(cls, Y) -> "Gram":
        """Gram matrix of whitened rows Y (nv, count)."""
        # Operations of kernels grow as the cube of the rows: those of eight contacts of a body would be too many.
        return cls(Y, None if 2 * Y.shape[0] < Y.shape[1] else matmul(Y.T, Y))

    def times(self, x):
        """Product G x, x (count,) or (count, k)."""
        return matmul(self.Y.T, matmul(self.Y, x)) if self.matrix is None else matmul(self.matrix, x)

    def sizes(self, x):
        """Sizes (count,) of the terms that cancel in G x."""
        if self.matrix is None:
            Y = jnp.abs(self.Y)
            return matmul(Y.T, matmul(Y, jnp.abs(x)))
        return matmul(jnp.abs(self.matrix), jnp.abs(x))

    @property
    def squares(self):
        """Diagonal of G, (count,)."""
        return jnp.sum(self.Y * self.Y, 0) if self.matrix is None else jnp.diagonal(self.matrix)

    def factor(self, active) -> "RowFactor":
        """Factor of the rows whose mask `active` (count,) is one."""
        square, eps = self.squares, float(jnp.finfo(self.Y.dtype).eps)
        # A row of the size of rounding is no row, as that of a direction across the plane of a planar model.
        is_row = square > eps**1.5 * jnp.max(square)
        scale = jnp.where(is_row, 1 / jnp.sqrt(jnp.where(is_row, square, jnp.ones_like(square))), 0.0) * active
        if self.matrix is None:
            # Directions of velocities that no row holds have a zero here, which is known to rounding.
            Y = self.Y * scale[None]
            unit = jnp.eye(len(Y), dtype=Y.dtype)
            return RowFactor(cholesky(matmul(Y, Y.T) + eps**_SHIFT_OF_VELOCITIES * unit), Gram(Y, None), scale)
        matrix = self.matrix * scale[:, None] * scale[None]
        # Rows that do not act have a one on the diagonal, so that the factor exists in every mode. The shift is large enough for
        # factors of dependent rows; each step of the proximal method multiplies the error by about it.
        shift = jnp.diag(1.0 - active + eps**_SHIFT * jnp.ones_like(square))
        return RowFactor(cholesky(matrix + shift), Gram(self.Y, matrix), scale)


_SHIFT, _SHIFT_OF_VELOCITIES = 0.5, 0.6  # exponents of rounding, of the square of a row


class RowFactor(NamedTuple):
    """Cholesky factor of G + eps, or of Y Y^T + eps, of rows scaled to unit length; scales are zero of rows that do not act."""

    factor: Array
    gram: Gram
    scale: Array

    def solve(self, right):
        """Solution x of G x = right (count, k) on the rows that act, zero elsewhere, near the least norm.

        Two steps of the proximal method x <- x + (G + eps)^-1 (right - G x). In the space of velocities the inverse is
        Y^T (Y Y^T + eps)^-2 Y.
        """
        right = right * self.scale[:, None]
        x = self._invert(right)
        for _ in range(2):
            x = x + self._invert(right - self.gram.times(x))
        return x * self.scale[:, None]

    def _invert(self, right):
        if self.gram.matrix is not None:
            return solve_cholesky(self.factor, right)
        Y = self.gram.Y
        return matmul(Y.T, solve_cholesky(self.factor, solve_cholesky(self.factor, matmul(Y, right))))

    def nullity(self):
        """Diagonal (count,) of the projection on the forces without effect, G x = 0; zero of rows that do not act."""
        if self.gram.matrix is None:
            Y = self.gram.Y
            ones = (self.scale > 0).astype(Y.dtype)
            return ones - jnp.sum(Y * solve_cholesky(self.factor, Y), 0)
        # It is the limit of eps (G + eps)^-1.
        eps, unit = float(jnp.finfo(self.scale.dtype).eps), jnp.eye(self.scale.size, dtype=self.scale.dtype)
        return jnp.where(self.scale > 0, eps**_SHIFT * jnp.diagonal(solve_cholesky(self.factor, unit)), 0.0)


class StateTerms(NamedTuple):
    """Terms of a state that do not depend on its mode: rows, mass matrix, and sliding velocities (n, 2)."""

    row: Rows
    metric: MassFactor
    gram: Gram
    slip: Array


def terms_at(scene: Scene, elements: Elements, q, v, t) -> StateTerms:
    """Terms of a scene with its elements."""
    row = rows(extend(scene), q, v, t)
    metric = mass_factor(mass_matrix(scene.system, q, t))
    # Whitened rows Y give A M^-1 A^T as Y^T Y: symmetric, and positive semidefinite for dependent rows too.
    Y = metric.whiten(row.A.T)
    return StateTerms(row, metric, Gram.of(Y), by_element(elements, row.velocity))


def by_element(elements: Elements, rowwise) -> Array:
    """Entries of the rows that slip, (n, 2), zero where there are none."""
    # Padded to two directions, so that elements with one row and with two rows share one array.
    zero = jnp.zeros((), rowwise.dtype)
    return jnp.stack(
        [
            jnp.stack([rowwise[one.tangent[k]] if k < len(one.tangent) else zero for k in range(2)])
            for one in elements.each
        ]
    )


def by_normal_row(elements: Elements, values) -> Array:
    """Values (n,) of the contacts at the rows of their gaps, (count,), zero elsewhere."""
    rows = [jnp.zeros((), values.dtype)] * elements.count
    for i, one in enumerate(elements.each):
        if one.opens:
            rows[one.normal] = values[i]
    return jnp.stack(rows)


def gaps(scene: Scene, elements: Elements, q, t) -> Array:
    """Gaps of the elements that open, (n,); zero of others."""
    residuals = position_residual(extend(scene), q, t)
    # Contacts have one row each among the residuals, behind those of the scene's own constraints.
    at, gap_of_each = residuals.shape[0] - sum(one.opens for one in elements.each), []
    for one in elements.each:
        gap_of_each.append(residuals[at] if one.opens else jnp.zeros((), q.dtype))
        at += one.opens
    return jnp.stack(gap_of_each)


def tolerance(dtype) -> float:
    """Size below which velocities (m/s) and gaps (m) count as zero, relative to the terms that cancel in them."""
    # 1e-10 in float64: above the rounding of a projected state, far below the changes at an event.
    return float(jnp.finfo(dtype).eps) ** 0.64


def force_tolerance(dtype) -> float:
    """Size below which forces count as zero, relative to those of all elements."""
    # 1e-7 in float64, above the rounding of the forces of dependent rows, which is eps/eps^0.5 of them.
    return float(jnp.finfo(dtype).eps) ** 0.45
