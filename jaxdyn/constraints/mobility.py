"""The degrees of freedom of a constrained mechanism."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import layout
from jaxdyn.constraints.rank import check_tolerance, pseudo_inverse, tolerance
from jaxdyn.constraints.selection import unit_rows
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, check_state
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike


def degrees_of_freedom(
    scene: SceneLike, q: Float[Array, " nq"], t: Numbers = 0.0, *, rank_tol: float | None = None
) -> int | Int[Array, ""]:
    r"""Degrees of freedom at a configuration: nv minus the rank of the constraints' rows A(q, t).

    Dependent rows count once, so that the count is right for overconstrained linkages. It counts independent velocities at
    this q: it is larger in singular positions, and rolling reduces it though all configurations remain reachable. Loops whose
    rows are dependent only where the loops are closed need a q of `jd.assemble`. Distances are compared in
    units of the mechanism's length, each row scaled to length 1; rows at rounding level count as zero.

    **Arguments:** `scene`, a `Scene` or a system; `q` (nq,); `t`, s; `rank_tol`: singular values below `rank_tol` times the
    largest count as zero, by default $\epsilon^{4/7}$, 1e-9 in float64.

    **Returns:** an int for concrete arguments, an integer array () for traced ones.

    **Raises:** ValueError for shapes that do not fit, or a `rank_tol` outside (0, 1).

    Source: EQUATIONS section 7; the rank is the trace of $A A^+$.

    ```python
    count = jd.degrees_of_freedom(jd.scenes.four_bar(), jd.scenes.four_bar.start()[0])  # 1
    ```
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=t)
    rank_tol = check_tolerance(rank_tol)
    if not layout(scene):
        return scene.nv
    rank = _rank(scene, q, t, rank_tol)
    return scene.nv - int(rank) if is_concrete(rank) else scene.nv - rank


@entry_point
def _rank(scene: Scene, q, t, rank_tol: float | None) -> Int[Array, ""]:
    # Scaled rows: the singular values of metres next to radians depend on the unit. The trace of the projector A A^+ is the rank,
    # by the pseudo-inverse that all other rank decisions use, so that they agree.
    A = unit_rows(scene, q, t)
    return jnp.round(jnp.trace(matmul(A, pseudo_inverse(A, tolerance(rank_tol, A), True)))).astype(jnp.int32)
