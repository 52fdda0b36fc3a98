"""The degrees of freedom of a constrained mechanism."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import layout
from jaxdyn.constraints.rank import checked_tolerance, pseudo_inverse, tolerance
from jaxdyn.constraints.selection import scaled_rows
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, check_state
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike


def degrees_of_freedom(
    scene: SceneLike, q: Float[Array, " nq"], t: Numbers = 0.0, *, rank_tol: float | None = None
) -> int | Int[Array, ""]:
    """Degrees of freedom at a configuration: nv minus the rank of the constraints' rows A(q, t).

    Dependent rows count once, so overconstrained linkages have the freedom that they have. It is the freedom of velocities at
    this q: it is larger in singular positions, and rolling takes from it without taking configurations away. Rows of
    loops that are dependent only where the loops are closed need a q of `jd.assemble`. Rows are compared with distances in
    units of the mechanism's length, each scaled to length 1; rows that are rounding count as zero.

    **Arguments:** `scene`, a `Scene` or a system; `q` (nq,); `t`, s; `rank_tol`: singular values below `rank_tol` times the
    largest count as zero, by default eps^(4/7), 1e-9 in float64.

    **Returns:** an int for numbers that are known, an array () of integers for traced ones.

    **Raises:** ValueError for shapes that do not fit, or a `rank_tol` outside (0, 1).

    Source: EQUATIONS section 7; the rank is the trace of A A^+.

    ```python
    freedom = jd.degrees_of_freedom(jd.scenes.four_bar(), jd.scenes.four_bar.start()[0])  # 1
    ```
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=t)
    rank_tol = checked_tolerance(rank_tol)
    if not layout(scene):
        return scene.nv
    rank = _rank(scene, q, t, rank_tol)
    return scene.nv - int(rank) if is_concrete(rank) else scene.nv - rank


@entry_point
def _rank(scene: Scene, q, t, rank_tol: float | None) -> Int[Array, ""]:
    A = scaled_rows(scene, q, t)
    return jnp.round(jnp.trace(matmul(A, pseudo_inverse(A, tolerance(rank_tol, A), True)))).astype(jnp.int32)
