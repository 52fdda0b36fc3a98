"""Optimal contact forces: least norm, a given resultant wrench, and a margin from the boundary of every cone."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.contact.cones import FrictionCone
from jaxdyn.contact.qp import QPSolution, solve_qp
from jaxdyn.model.arguments import Checked, Numbers
from jaxdyn.model.numbers import as_float


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
