"""The degrees of freedom of a constrained mechanism."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxdyn.compile import compiled, is_concrete
from jaxdyn.constraints.base import constraint_jacobian, layout
from jaxdyn.constraints.rank import checked_tolerance, pseudo_inverse, tolerance
from jaxdyn.constraints.tolerances import coordinate_sizes
from jaxdyn.lie.so3 import _product
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
    units of the mechanism's length, each scaled down to length 1; rows that are rounding count as zero.

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


@compiled
def _rank(scene: Scene, q, t, rank_tol: float | None) -> Int[Array, ""]:
    A = _scaled_rows(scene, q, t)
    return jnp.round(jnp.trace(_product(A, pseudo_inverse(A, tolerance(rank_tol, A), True)))).astype(jnp.int32)


@compiled
def _scaled_rows(scene: Scene, q, t) -> Float[Array, "nc nv"]:
    """Rows with distances in units of the mechanism's length, each scaled down to length 1."""
    sizes, length = coordinate_sizes(scene.system, q.dtype)
    A = constraint_jacobian(scene, q, t) * sizes[None]
    # Rows that are nothing but rounding, as those out of the plane of a planar linkage, must not be scaled to length 1.
    return A / jnp.maximum(jnp.linalg.norm(A, axis=1, keepdims=True), jnp.minimum(length, jnp.ones_like(length)))


def nearly_dependent(scene: SceneLike, q: Float[Array, " nq"], below: float = 1e-5) -> float | None:
    """Largest singular value of the scaled rows, over the largest of all, that is neither rounding nor above `below`.

    None where there is none. Such rows say the same as others but for the digits that a file was written with: whether they
    count is then for the rank tolerance to say, and it has to say the same all along a motion.
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=0.0)
    if not layout(scene):
        return None
    singular = np.linalg.svd(np.asarray(_scaled_rows(scene, q, t), np.float64), compute_uv=False)
    ratios = singular / max(singular.max(initial=0.0), np.finfo(float).tiny)
    doubtful = ratios[(ratios > 64 * float(jnp.finfo(q.dtype).eps)) & (ratios < below)]
    return float(doubtful.max()) if doubtful.size else None
