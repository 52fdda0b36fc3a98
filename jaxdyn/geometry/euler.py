"""Arnold's form of Euler's equations on the groups SO(3) and SE(3) with a left-invariant metric."""

from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.lie import se3, so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import as_array, batch_hint
from jaxdyn.model.numbers import as_float
from jaxdyn.systems.mass_factor import solve_positive


def arnold_form(inertia: Float[Array, "n n"], c: Float[Array, " n"], a: Float[Array, " n"]) -> Float[Array, " n"]:
    r"""Arnold's bilinear form B(c, a) of a rotational or spatial inertia.

    $$\langle B(c, a), b \rangle = \langle [a, b], c \rangle \quad \text{for all } b, \qquad \langle x, y \rangle = x^T I y$$

    On SO(3) it satisfies $I B(c, a) = (I c) \times a$, on SE(3) $I B(c, a) = \mathrm{ad}_a^T I c$. Without forces a rigid body
    moves by Euler's equations $\dot V = B(V, V)$: the geodesics of the metric, as the left translations of Lemma 7.1 show.

    **Arguments:** `inertia` (3, 3), kg m^2, in body axes, with angular velocities `c`, `a` (3,), rad/s; or (6, 6), a spatial
    inertia in a body frame (`jd.inertia.spatial_inertia`), with body twists (v, omega) (6,).

    **Returns:** (3,), rad/s^2, or (6,), m/s^2 and rad/s^2; NaN where the inertia is not positive definite.

    **Raises:** ValueError for other shapes.

    Source: Arnold (1989), Mathematical Methods of Classical Mechanics, appendix 2; Loparo & Vakalis, section 7; EQUATIONS
    section 12.
    """
    # Integer inertias are promoted first: their dtype must not round c and a.
    inertia = as_float(inertia, "inertia")
    c, a = as_array(c, "c", inertia.dtype), as_array(a, "a", inertia.dtype)
    if inertia.shape not in ((3, 3), (6, 6)):
        raise ValueError(f"inertia has shape {inertia.shape}; give (3, 3) or (6, 6){batch_hint(inertia, (3, 3))}")
    for name, value in (("c", c), ("a", a)):
        if value.shape != inertia.shape[:1]:
            raise ValueError(
                f"{name} has shape {value.shape}, expected {inertia.shape[:1]}{batch_hint(value, inertia.shape[:1])}"
            )
    return _arnold_form(inertia, c, a)


@entry_point
def _arnold_form(inertia, c, a):
    # Euler's equations in momentum form; B follows by one solve with the inertia, which is never inverted.
    momentum = matmul(inertia, c)
    # On SO(3) ad_a^T p = p x a.
    force = so3.cross(momentum, a) if a.shape[0] == 3 else se3.adT_apply(a, momentum)
    return solve_positive(inertia, force)
