"""Contact forces of a scene and their margins from pulling and slipping, and force closure.

Force closure is the ability of contact forces within their cones to balance every wrench on the object. A grasp with map G and
cones FC has force closure, G(FC) = R^p, if and only if G has full rank and there are internal forces strictly
inside the cones, G f = 0 with f in int(FC). Both are tested, the latter by maximising the least margin.

Source: Murray, Li & Sastry (1994), definition 5.2 and proposition 5.3; EQUATIONS section 10.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import layout
from jaxdyn.contact.cones import SIDES, Cones, FrictionCone, surface_cone
from jaxdyn.contact.qp import QPSolution, solve_qp
from jaxdyn.model.arguments import Checked, Numbers, as_array, as_float, as_number, batch_hint, state_dtype
from jaxdyn.systems.scene import Scene


class ContactForces(eqx.Module):
    """Contact forces and their margins in the friction cones.

    - `forces`: by the contact's name, (m,), along the columns of its wrench basis, the normal into the object; N and N m.
    - `margins`: by name, (), the cone's margin: positive while the contact neither pulls nor slips.
    - `margin` (): the least of them.
    """

    forces: dict[str, Float[Array, "..."]]
    margins: dict[str, Float[Array, "..."]]
    margin: Float[Array, "..."]


class ContactWithCone(NamedTuple):
    """Contact with a friction cone: its name, its multipliers in the order of its wrench basis, and the cone."""

    name: str
    rows: np.ndarray
    cone: FrictionCone


def contact_forces(
    scene: Scene, multipliers: Float[Array, " nc"], cones: Cones = None, smoothing: Numbers = 0.0
) -> ContactForces:
    """Force of each contact, and its margin in its friction cone.

    **Arguments:**

    - `scene`: a `Grasp`, or any `Scene` with contacts.
    - `multipliers` (nc,): of the scene's rows: `.multipliers` of `jd.constrained_dynamics`, `.contact_forces` of
      `object_dynamics`, or one sample of a solution's.
    - `cones`: a `FrictionCone` for all contacts, a list with one per constraint, or a dictionary by name; by default those
      of the scene. Constraints missing in a dictionary are skipped.
    - `smoothing`: N, of `FrictionCone.margin`.

    **Returns:** `ContactForces`.

    **Raises:** ValueError for another number of multipliers, no cones, unknown names, cones of another kind than their
    contact, and constraints with a cone that are no contacts.

    Source: Murray, Li & Sastry (1994), section 5.2; the cone is to be tested on all of lam (EQUATIONS section 10).
    """
    multipliers = as_array(multipliers, "multipliers", state_dtype(scene.system))
    places = layout(scene)
    count = places[-1].end if places else 0
    if multipliers.shape != (count,):
        raise ValueError(
            f"multipliers has shape {multipliers.shape}, expected ({count},), one per row of the scene"
            f"{batch_hint(multipliers, (1,))}"
        )
    smoothing = as_number(smoothing, "smoothing", "N", zero=True, like=multipliers.dtype)
    forces, margins = {}, {}
    for contact in contacts_with_cones(scene, cones):
        forces[contact.name] = multipliers[contact.rows]
        margins[contact.name] = contact.cone.margin(forces[contact.name], smoothing)
    return ContactForces(forces, margins, jnp.min(jnp.stack(list(margins.values()))))


def contacts_with_cones(scene: Scene, cones=None) -> tuple[ContactWithCone, ...]:
    """Contacts of the scene with a cone, in the order of its constraints.

    **Raises:** ValueError as `contact_forces` does.
    """
    places = layout(scene)
    chosen = _by_name(scene.cones if cones is None else cones, [place.name for place in places])
    coned = []
    for constraint, place in zip(scene.constraints, places, strict=True):
        if place.name not in chosen:
            continue
        cone, order = chosen[place.name], constraint.wrench_components()
        if order is None:
            raise ValueError(
                f"constraint {place.name!r} is a {type(constraint).__name__} without a normal force; it has no friction "
                "cone: give cones as a dictionary by the names of contacts"
            )
        # Cones name components by their places: a cone of another kind would read friction as normal force.
        if cone.size != len(order):
            raise ValueError(
                f"cone of contact {place.name!r} is of kind {cone.kind!r} with {cone.size} components, the contact has "
                f"{len(order)}; give the cone of the contact's kind"
            )
        # `order` counts within the rows of the constraint, `rows` within those of the scene.
        coned.append(ContactWithCone(place.name, place.start + np.array(order, int), cone))
    return tuple(coned)


def _by_name(cones, names: list[str]) -> dict[str, FrictionCone]:
    if isinstance(cones, FrictionCone):
        return dict.fromkeys(names, cones)
    if isinstance(cones, (tuple, list)):
        if len(cones) != len(names):
            raise ValueError(f"cones has {len(cones)} entries for the {len(names)} contacts {names}; give one for each")
        cones = dict(zip(names, cones, strict=True))
    if not isinstance(cones, dict) or not cones or not set(cones) <= set(names):
        shown = list(cones) if isinstance(cones, dict) else cones
        raise ValueError(
            f"cones is {shown!r}; give a FrictionCone, one per contact, or a dictionary by names of {names}"
        )
    for name, cone in cones.items():
        if not isinstance(cone, FrictionCone):
            raise ValueError(f"cone of contact {name!r} is {cone!r}; use jd.contact.friction_cone(...)")
    return cones


def optimal_forces(
    G: Numbers,
    wrench: Numbers,
    cones: Checked[Sequence[FrictionCone]],
    *,
    preload: Numbers = 0.0,
    target: Numbers | None = None,
    weights: Numbers | None = None,
    tol: float | None = None,
) -> QPSolution:
    r"""Contact forces closest to `target` that exert a wrench, with all margins at least `preload`.

    $$\min_f \tfrac12 (f - f_0)^T \operatorname{diag}(\mathrm{weights}) (f - f_0)
    \quad \text{with} \quad G f = \mathrm{wrench}, \quad \mathrm{margins}(f) \ge \mathrm{preload}$$

    A second-order cone program, by `solve_qp`: batched, and differentiable in G, the wrench, the friction coefficients and
    all other arguments. Rows of G may be dependent, as for a grasp that cannot resist every wrench.

    **Arguments:**

    - `G` (p, m): grasp map. `wrench` (p,): the resultant of the contact forces on the object; to hold it against gravity,
      minus its weight; N and N m.
    - `cones`: one per contact, in the order of G's columns.
    - `preload` (): N, least margin of each contact (`FrictionCone.margins`).
    - `target` $f_0$ (m,), N and N m: zero by default. `weights` (m,): positive, one by default.
    - `tol`: of `solve_qp`.

    **Returns:** `QPSolution`, with the forces in `x`; `result` is infeasible where no forces in the cones balance the wrench.

    **Raises:** ValueError for shapes that do not fit together.

    Source: Murray, Li & Sastry (1994), section 5.3; Boyd & Wegbreit, IEEE Trans. Robotics 23 (2007), 1117-1132.
    """
    G = as_float(G, "G", (None, None))
    wrench = as_float(wrench, "wrench", (G.shape[0],), G.dtype)
    if not isinstance(cones, (tuple, list)) or not all(isinstance(cone, FrictionCone) for cone in cones):
        raise ValueError(f"cones is {cones!r}; pass a list with one FrictionCone per contact, from friction_cone(...)")
    sizes = [cone.size for cone in cones]
    m = sum(sizes)
    if m != G.shape[1]:
        raise ValueError(f"cones have {sizes} components, {m} in all, and G has {G.shape[1]} columns; they must agree")
    preload = as_float(preload, "preload", (), G.dtype)
    target = jnp.zeros((m,), G.dtype) if target is None else as_float(target, "target", (m,), G.dtype)
    weights = jnp.ones((m,), G.dtype) if weights is None else as_float(weights, "weights", (m,), G.dtype)
    bounds = cone_bounds(cones, preload, G.dtype)
    # The square is expanded, without its constant.
    return solve_qp(jnp.diag(weights), -weights * target, A=G, b=wrench, tol=tol, **bounds)


def cone_bounds(cones, preload, dtype) -> dict:
    """Rows and cones of `solve_qp`, by their names there, for margins of at least `preload` in every cone.

    Forces are concatenated in the order of the cones.
    """
    sizes = [cone.size for cone in cones]
    linear, second, place = [], [], 0
    for cone, size in zip(cones, sizes, strict=True):
        sides = (place, sum(sizes) - place - size)
        linear.append(_pad_rows(cone.linear_rows().astype(dtype), sides))
        second.append(_pad_rows(cone.second_order_rows().astype(dtype), sides))
        place += size
    rows, round_rows = jnp.concatenate(linear), jnp.concatenate(second)
    # c - S x = (mu f_n - preload, fx, fy) with S = -rows: the margin enters the first component alone.
    lifted = jnp.zeros(round_rows.shape[:2], dtype).at[:, 0].set(-preload)
    bounds: dict = {"G": rows, "h": jnp.full((rows.shape[0],), -1, dtype) * preload} if rows.shape[0] else {}
    return bounds | ({"cones": [(-round_rows, lifted)]} if round_rows.shape[0] else {})


def _pad_rows(rows: Float[Array, "..."], sides) -> Float[Array, "..."]:
    """Pad rows of one contact's force to rows of all forces."""
    return jnp.pad(rows, [(0, 0)] * (rows.ndim - 1) + [sides])


# --- force closure: the ability of contact forces within their cones to balance every wrench on the object ---


_FIRST_FACES = 8
_ROUNDS = 60
_TIGHT = 1e-9  # distance of the bounds at which the cutting-plane iteration ends
_MINIMUM = 1e-8  # relative to the largest; margins and singular values below are zero


class ForceClosure(eqx.Module):
    r"""Force closure of a grasp: the decision, its margin, and a certificate where it fails.

    - `closed`: the decision. `margin`: the largest t such that internal forces f, $G f = 0$, with total normal force 1 N
      have every margin of every cone at least t (for a friction cone $\mu f_n - |f_t|$, for a contact without friction its
      normal force $f_n$; so t is dimensionless: newtons of margin per newton of grip). Zero where the grasp is open, infinite
      where no contact has a bound.
    - `forces` (m,): those internal forces; zeros where there are none.
    - `direction` (p,): where open, a unit wrench on the object that contact forces cannot balance, in the units and
      axes of G's rows; zeros where closed. Its product with $G f$ is not negative (to 1e-8) for all forces f in the cones,
      so that balancing it would need $G f = -\mathrm{direction}$.
    - `rank`: of G, in the columns along which forces are possible.
    """

    closed: bool = eqx.field(static=True)
    margin: float = eqx.field(static=True)
    forces: Float[np.ndarray, " m"]
    direction: Float[np.ndarray, " p"]
    rank: int = eqx.field(static=True)


class _Rows(NamedTuple):
    """All cones combined: linear rows (k, m), second-order rows (j, 3, m), and the total normal force (m,).

    `kept` (m,): columns of G with forces; directions without force, by a friction coefficient of zero, are excluded.
    """

    linear: np.ndarray
    second: np.ndarray
    normal: np.ndarray
    kept: np.ndarray


def force_closure_of_map(
    G: Numbers,
    cones: Checked[Sequence[FrictionCone | Numbers]],
    *,
    faces: int | None = None,
    side: Checked[str] = "inscribed",
) -> ForceClosure:
    r"""Decide force closure of the grasp with map G, with a margin or with a wrench that it cannot resist.

    Round cones are handled exactly by cutting planes: a linear program (HiGHS) is solved, and faces are added where
    its forces leave the cones, until the margin is determined to 1e-9. With `faces` the cones are pyramids instead, one
    program.

    **Arguments:**

    - `G` (p, m): grasp map, G f is the wrench of contact forces f on the object; `jd.grasp.grasp_map`. Known numbers.
    - `cones`: one per contact in the order of G's columns: `friction_cone(...)`, `surface_cone(...)`, or rows U (k, m_i) with
      $U f \le 0$, for which the total normal force is the mean of $-U f$.
    - `faces`, `side`: of `FrictionCone.pyramid`; None: the round cones.

    **Returns:** `ForceClosure`.

    **Raises:** ValueError for traced arguments, and for cones that do not fit the columns of G.

    ```python
    jd.contact.force_closure_of_map(jd.grasp.grasp_map(hand, q), [jd.contact.friction_cone("hard-finger", 0.5)] * 3).closed
    ```

    Source: Murray, Li & Sastry (1994), proposition 5.3; for the certificate, the theorem of separating hyperplanes.
    """
    if not is_concrete(G, cones):
        raise ValueError(
            "G or cones are traced; a linear program needs known numbers, call force_closure_of_map outside of jit"
        )
    G = np.asarray(as_float(G, "G", (None, None)), float)
    every = _as_cones([cones] if isinstance(cones, FrictionCone) else cones, G.shape[1])
    if side not in SIDES:
        raise ValueError(f"side is {side!r}; choose from {', '.join(SIDES)}")
    rows = _stack(every, faces, side)
    # Rows of G in N and N m are normalised before their rank is decided.
    sizes = np.linalg.norm(G[:, rows.kept], axis=1)
    # Rows that are only rounding of a cancellation count as zero.
    sizes = np.where(sizes > 1e-13 * sizes.max(initial=0), sizes, 0.0)
    unit = np.where(sizes[:, None] > 0, G[:, rows.kept], 0.0) / np.where(sizes > 0, sizes, 1)[:, None]
    # The full left factor: without full row rank its last column is orthogonal to the range of G.
    left, singular, _ = np.linalg.svd(unit)
    rank = int(np.sum(singular > _MINIMUM * singular[0])) if singular.size and singular[0] > 0 else 0
    nothing, none = np.zeros(G.shape[1]), np.zeros(G.shape[0])
    # Without full row rank the last left singular vector is a wrench outside the range of G.
    if rank < G.shape[0]:
        return ForceClosure(False, 0.0, nothing, _wrench(left[:, -1], sizes), rank)
    if not len(rows.linear) and not len(rows.second):
        return ForceClosure(True, float("inf"), nothing, none, rank)
    margin, forces, twist = _largest_margin(unit, rows)
    if margin <= _MINIMUM:
        return ForceClosure(False, 0.0, nothing, _wrench(twist, sizes), rank)
    nothing[rows.kept] = forces
    return ForceClosure(True, margin, nothing, none, rank)


def _as_cones(cones, count: int) -> list[FrictionCone]:
    """Convert rows to cones, as of a surface. **Raises:** ValueError where they do not fit `count` columns."""
    if not isinstance(cones, (tuple, list)):
        raise ValueError(f"cones is a {type(cones).__name__}; pass a list with one cone per contact")
    every = []
    for i, cone in enumerate(cones):
        if not isinstance(cone, FrictionCone):
            rows = as_float(cone, f"cones[{i}]", (None, None))
            cone = surface_cone(rows) if rows.shape[1] == 6 else FrictionCone("surface", False, None, None, rows)
        every.append(cone)
    sizes = [_width(cone) for cone in every]
    if sum(sizes) != count:
        raise ValueError(
            f"cones have {sizes} components, {sum(sizes)} in all, and G has {count} columns; they must agree"
        )
    return every


def _width(cone: FrictionCone) -> int:
    return cone.size if cone.rows is None else cone.rows.shape[1]


def _stack(cones: list[FrictionCone], faces: int | None, side: str) -> _Rows:
    total = sum(_width(cone) for cone in cones)
    linear: list[np.ndarray] = [np.zeros((0, total))]
    second: list[np.ndarray] = [np.zeros((0, 3, total))]
    normal, kept, place = np.zeros(total), [], 0
    for cone in cones:
        columns = slice(place, place + _width(cone))
        place = columns.stop
        # Without friction the cone has no interior along its tangential forces, and without gamma none along its torque.
        used = np.ones(_width(cone), bool)
        if cone.mu is not None and float(cone.mu) == 0:
            used[: 1 if cone.in_plane else 2] = False
        if cone.gamma is not None and float(cone.gamma) == 0:
            used[3] = False
        kept.append(used)
        rows = np.asarray(cone.linear_rows() if faces is None else cone.pyramid(faces, side), float)
        cones_of = np.asarray(cone.second_order_rows(), float)
        if not used.all():  # the remaining conditions: a nonnegative normal force, and perhaps friction
            rows = np.concatenate(
                [rows[np.abs(rows[:, used]).sum(1) > 0], -np.eye(len(used))[-1 if cone.in_plane else 2][None]]
            )
            rows = rows[[np.abs(row[~used]).sum() == 0 for row in rows]]
            cones_of = cones_of if cone.mu is not None and float(cone.mu) > 0 else cones_of[:0]
        linear.append(np.zeros((len(rows), total)))
        linear[-1][:, columns] = rows
        if faces is None and len(cones_of):
            second.append(np.zeros((len(cones_of), 3, total)))
            second[-1][:, :, columns] = cones_of
        if cone.rows is not None:
            normal[columns] = -rows.mean(0)
        elif cone.kind != "rigid":
            normal[columns.start + (len(used) - 1 if cone.in_plane else min(2, len(used) - 1))] = 1.0
    mask = np.concatenate([*kept, np.zeros(0, bool)])
    return _Rows(
        np.concatenate(linear)[:, mask], np.concatenate(second)[:, :, mask], normal[mask], np.flatnonzero(mask)
    )


def _largest_margin(G, rows: _Rows) -> tuple[float, np.ndarray, np.ndarray]:
    """Largest margin t of forces f with G f = 0 and normal force 1; f; and y with y.(G f) >= -t for all f in the cones."""
    # Imported here because scipy's optimisers take long to import.
    from scipy.optimize import linprog

    # Tangent planes outside of the round cones: the margin of the first program is an upper bound.
    angles = 2 * np.pi / _FIRST_FACES * np.arange(_FIRST_FACES)
    faces = [
        c * s[1] + d * s[2] - s[0] for s in rows.second for c, d in zip(np.cos(angles), np.sin(angles), strict=True)
    ]
    above = np.concatenate([rows.linear, np.reshape(faces, (len(faces), G.shape[1]))])
    equal = np.concatenate([np.concatenate([G, rows.normal[None]]), np.zeros((len(G) + 1, 1))], 1)
    # Cones are homogeneous: without a total normal force of 1 the margin would be unbounded.
    right = np.append(np.zeros(len(G)), 1.0)
    # The unknowns are (f, t); `linprog` minimises, hence -t.
    cost = np.append(np.zeros(G.shape[1]), -1.0)
    # HiGHS allows 1e-7 by default, more than the accuracy of the margin.
    options = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    solution = None
    for _ in range(_ROUNDS):
        limits = np.concatenate([above, np.ones((len(above), 1))], 1)
        # Without bounds, because the default of `linprog` is x >= 0 and forces have both signs.
        solution = linprog(cost, limits, np.zeros(len(limits)), equal, right, bounds=(None, None), options=options)
        if solution.status == 2:
            # No internal force has a normal component: the normal force is a combination of the rows of G, n = G^T y.
            return -np.inf, np.zeros(G.shape[1]), np.linalg.lstsq(G.T, rows.normal, rcond=None)[0]
        if solution.status != 0:
            raise RuntimeError(f"the linear program of force closure was not solved: {solution.message}")
        forces, upper = solution.x[:-1], solution.x[-1]
        seen = rows.second @ forces
        friction = np.linalg.norm(seen[:, 1:], axis=1)
        margins = np.concatenate([-rows.linear @ forces, seen[:, 0] - friction])
        # Faces are outside the cones, so t is an upper bound; the margin of its forces is a lower one.
        if upper <= _MINIMUM or margins.min() >= upper - _TIGHT:
            break
        # Tangent planes of the round cones at the current forces cut off the current solution.
        touching = [(s, y / n) for s, y, n in zip(rows.second, seen[:, 1:], friction, strict=True) if n > 0]
        above = np.concatenate([above, *[(y[0] * s[1] + y[1] * s[2] - s[0])[None] for s, y in touching]])
    else:
        raise RuntimeError(f"force closure: the margin was not found to {_TIGHT} with {_ROUNDS} rounds of faces")
    return (
        float(min(margins.min(), upper)) if upper > _MINIMUM else float(upper),
        forces,
        # Marginals are derivatives of the cost -t with respect to the right-hand side, hence the sign.
        -solution.eqlin.marginals[: len(G)],
    )


def _wrench(twist, sizes) -> np.ndarray:
    """Unit wrench in G's units, from the multiplier of its scaled rows."""
    # Rows were divided by their sizes: the same division turns multipliers of scaled rows into those of the rows.
    direction = twist / np.where(sizes > 0, sizes, 1)
    return direction / np.linalg.norm(direction)
