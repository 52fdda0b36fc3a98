"""Riemannian geometry of a metric in coordinates: flat and sharp maps, connection, covariant derivatives, curvature.

A metric is a function g(q) -> (n, n), symmetric positive definite, or a system whose mass matrix it is (a `System`, or a
`Model` with v = dq/dt), at t = 0. The connection is that of Levi-Civita: no torsion, and the metric is constant along it. The
symbols of the second kind are Gamma^i_jk = 1/2 g^il (dg_lj/dq_k + dg_lk/dq_j - dg_jk/dq_l). Functions that need only
their product with two vectors do not form them.

Newton's law in these terms: flat(nabla_v v) = F, with a one-form F. Source: EQUATIONS sections 0, 7 and 12; do Carmo
(1992), Riemannian Geometry, chapters 2 to 4. Arnold's form is that of a left-invariant metric on SO(3) and SE(3).
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.dynamics.quantities import mass_matrix, mass_matrix_derivative, system_quantity
from jaxdyn.lie import se3, so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_array, as_float, batch_hint, check_state, check_system, state_dtype
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import solve_positive
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import System, has_coordinate_rates, symbols

KINDS = ("first", "second")

if TYPE_CHECKING:
    Metric = Callable[..., Any] | Model | System | Scene
else:
    Metric = Any  # `_as_function` checks it


def _compile_for_systems(function: Callable) -> Callable:
    """Compile `function(metric, *args)` for a system; evaluate it anew for a plain function, whose captured values may change."""
    program = entry_point(function)

    @functools.wraps(function)
    def call(metric, *args):
        # The values that a function captures are no operands: a compiled program would keep those of the first call.
        return (program if isinstance(metric, (Model, System)) else function)(metric, *args)

    return call


def flat(metric: Metric, q: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
    """One-form of a vector: the momentum of a velocity, the force of an acceleration.

    $$p = g(q) v$$

    **Arguments:** `metric` as above; `q`, `v` (n,). **Returns:** (n,).
    """
    q, v = _vectors(metric, q=q, v=v)
    return matmul(_as_function(metric)(q), v)


def sharp(metric: Metric, q: Float[Array, " n"], p: Float[Array, " n"]) -> Float[Array, " n"]:
    """Vector of a one-form, the inverse of `flat`.

    $$v = g(q)^{-1} p$$

    **Arguments:** `metric` as above; `q` (n,), a point; `p` (n,), a one-form there.

    **Returns:** (n,); NaN where g is not positive definite.
    """
    return _sharp(metric, *_vectors(metric, q=q, p=p))


@_compile_for_systems
def _sharp(metric, q, p):
    return solve_positive(_as_function(metric)(q), p)


def christoffel_symbols(
    metric: Metric, q: Float[Array, " n"], kind: str = "second", t: Numbers = 0.0
) -> Float[Array, "n n n"]:
    r"""Christoffel symbols of the second or of the first kind, the index i in front.

    $$\Gamma_{ijk} = g_{il} \Gamma^l_{jk} = \tfrac12 \left( \frac{\partial g_{ij}}{\partial q_k}
    + \frac{\partial g_{ik}}{\partial q_j} - \frac{\partial g_{jk}}{\partial q_i} \right)$$

    For a mass matrix the symbols of the first kind give $C_{ij} = \sum_k \Gamma_{ijk} v_k$, which has the same $C v$ and
    $C + C^T$ as `coriolis_matrix`. Those of a `Model` are in closed form.

    **Arguments:** `metric` as above; `q` (n,); `kind`, "first" or "second"; `t`, s, of a system.

    **Returns:** (n, n, n), symmetric in the last two indices.

    **Raises:** ValueError for another kind, and for a model with a joint whose v is not dq/dt (planar, spherical, free).

    Source: Murray, Li & Sastry (1994), eq. 4.23; EQUATIONS section 0.
    """
    if kind not in KINDS:
        raise ValueError(f"kind is {kind!r}; choose from {', '.join(KINDS)}")
    (q,) = _vectors(metric, q=q)
    return _symbols(metric, q, as_array(t, "t", q.dtype), kind)


@_compile_for_systems
def _symbols(metric, q, t, kind):
    g = _as_function(metric, t)
    if isinstance(metric, System):
        first = system_quantity("christoffel_symbols", metric, q, t)
    else:
        first = symbols(mass_matrix_derivative(metric, q) if isinstance(metric, Model) else jax.jacfwd(g)(q))
    # One factorisation of g for all n^2 columns.
    return first if kind == "first" else solve_positive(g(q), first.reshape(q.shape[0], -1)).reshape(first.shape)


def connection(
    metric: Metric, q: Float[Array, " n"], v: Float[Array, " n"], w: Float[Array, " n"]
) -> Float[Array, " n"]:
    r"""Connection of the metric, symmetric and bilinear in v and w; the symbols are not formed.

    $$\Gamma(v, w)^i = \Gamma^i_{jk} v^j w^k$$

    **Arguments:** `metric` as above; `q` (n,), a point; `v`, `w` (n,), vectors there. **Returns:** (n,).
    """
    return _connection(metric, *_vectors(metric, q=q, v=v, w=w))


@_compile_for_systems
def _connection(metric, q, v, w):
    g = _as_function(metric)
    # The three terms of the symbols as two directional derivatives and one gradient: O(1) evaluations of g, no n^3 array.
    _, along_v = jax.jvp(lambda q: matmul(g(q), w), (q,), (v,))
    _, along_w = jax.jvp(lambda q: matmul(g(q), v), (q,), (w,))
    gradient = jax.grad(lambda q: jnp.sum(v * matmul(g(q), w)))(q)
    return solve_positive(g(q), 0.5 * (along_v + along_w - gradient))


def covariant_rate(
    metric: Metric, q: Float[Array, " n"], v: Float[Array, " n"], w: Float[Array, " n"], rate: Float[Array, " n"]
) -> Float[Array, " n"]:
    r"""Covariant derivative of a vector field w(t) along a curve.

    $$\frac{Dw}{dt} = \dot w + \Gamma(\dot q, w)$$

    With $w = v = \dot q$ and the rate a it is the covariant acceleration $\nabla_v v$. It is zero for parallel transport.

    **Arguments:** `metric` as above; `q` (n,), a point of the curve; `v` (n,), its rate; `w` (n,), the field there; `rate` (n,),
    dw/dt.

    **Returns:** (n,).
    """
    q, v, w, rate = _vectors(metric, q=q, v=v, w=w, rate=rate)
    return rate + connection(metric, q, v, w)


def covariant_derivative(
    metric: Metric, field: Callable, q: Float[Array, " n"], v: Float[Array, " n"]
) -> Float[Array, " n"]:
    r"""Covariant derivative of a vector field X(q) -> (n,) in the direction v.

    $$\nabla_v X = dX(v) + \Gamma(v, X)$$

    **Arguments:** `metric` as above; `field`, X; `q`, `v` (n,). **Returns:** (n,).
    """
    q, v = _vectors(metric, q=q, v=v)
    # X and dX(v) from one evaluation; the Jacobian of the field is not formed.
    w, rate = jax.jvp(field, (q,), (v,))
    return covariant_rate(metric, q, v, w, rate)


def geodesic_acceleration(metric: Metric, q: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
    r"""Acceleration of the geodesic through q with velocity v.

    $$\ddot q = -\Gamma(v, v)$$

    `jd.MetricSystem(metric, n)` simulates it.

    **Arguments:** `metric` as above; `q`, `v` (n,). **Returns:** (n,).
    """
    return -connection(metric, q, v, v)


def riemann_tensor(metric: Metric, q: Float[Array, " n"]) -> Float[Array, "n n n n"]:
    r"""Curvature tensor of the metric, with its indices as in R^i_jkl.

    $$R(u, w) z = \nabla_u \nabla_w z - \nabla_w \nabla_u z - \nabla_{[u, w]} z, \quad
    (R(u, w) z)^i = R^i_{jkl} z^j u^k w^l$$

    $$R^i_{jkl} = \frac{\partial \Gamma^i_{lj}}{\partial q_k} - \frac{\partial \Gamma^i_{kj}}{\partial q_l}
    + \Gamma^i_{km} \Gamma^m_{lj} - \Gamma^i_{lm} \Gamma^m_{kj}$$

    **Arguments:** `metric` as above, twice differentiable; `q` (n,). **Returns:** (n, n, n, n), index i in front.

    Source: do Carmo (1992), chapter 4, with the opposite sign of R.
    """
    return _curvature(metric, *_vectors(metric, q=q))


@_compile_for_systems
def _curvature(metric, q):
    start = jnp.zeros((), q.dtype)
    gamma = _symbols(metric, q, start, "second")
    derivative = jax.jacfwd(lambda q: _symbols(metric, q, start, "second"))(q)
    # R is antisymmetric in k and l: half of its terms, minus the same with k and l exchanged.
    # derivative[i, l, j, k] = dGamma^i_lj / dq_k, in the order [i, j, k, l] of the tensor.
    half = derivative.transpose(0, 2, 3, 1) + jnp.einsum("ikm,mlj->ijkl", gamma, gamma)
    return half - half.transpose(0, 1, 3, 2)


def sectional_curvature(
    metric: Metric, q: Float[Array, " n"], u: Float[Array, " n"], w: Float[Array, " n"]
) -> Float[Array, ""]:
    r"""Curvature of the plane of u and w.

    $$\frac{\langle R(u, w) w, u \rangle}{|u|^2 |w|^2 - \langle u, w \rangle^2}$$

    It is $1/r^2$ on a sphere of radius r.

    **Arguments:** `metric` as above; `q`, `u`, `w` (n,), u and w independent. **Returns:** ().
    """
    return _sectional(metric, *_vectors(metric, q=q, u=u, w=w))


@_compile_for_systems
def _sectional(metric, q, u, w):
    g = _as_function(metric)(q)
    curvature = jnp.einsum("ijkl,j,k,l->i", _curvature(metric, q), w, u, w)
    # Lowering the index with g makes <R(u, w) w, u> a scalar in any coordinates.
    dot = lambda a, b: jnp.sum(a * matmul(g, b))  # noqa: E731
    return dot(curvature, u) / (dot(u, u) * dot(w, w) - dot(u, w) ** 2)


def _vectors(metric, **arguments) -> tuple[Array, ...]:
    """The arguments as vectors (n,) of the metric's dtype, which for a function is that of q or else jax's default.

    **Raises:** ValueError that names the argument.
    """
    if isinstance(metric, (Model, System)):
        return check_state(metric, **arguments)
    q = as_array(arguments["q"], "q")
    # A function has no dtype of its own.
    dtype = state_dtype(None, q)
    for name, value in arguments.items():
        if np.ndim(value) != 1 or np.shape(value) != q.shape:
            raise ValueError(f"{name} has shape {np.shape(value)}, expected (n,) as q has{batch_hint(value, (1,))}")
    return tuple(as_array(value, name, dtype) for name, value in arguments.items())


def _as_function(metric, t: Numbers = 0.0) -> Callable:
    """The metric as a function of q, that of a system at the time t.

    **Raises:** ValueError for an argument that gives no metric.
    """
    # The formulas are those of a coordinate basis, v = dq/dt; quasi-velocities would need the structure constants too.
    if isinstance(metric, Model) and not has_coordinate_rates(metric):
        raise ValueError(
            f"metric is model {metric.name!r} with nq = {metric.nq}, nv = {metric.nv}; a metric needs coordinates with "
            "v = dq/dt, so build the model without planar, spherical and free joints, or give g(q) in coordinates"
        )
    if isinstance(metric, (Model, System)):
        return lambda q: mass_matrix(metric, q, t)
    if isinstance(metric, Scene):
        check_system(metric, "metric")
    if not callable(metric):
        raise ValueError(f"metric is {metric!r}; pass a function g(q) -> (n, n) or a system")

    given: Callable = metric

    def evaluate(q):
        # A metric of constants in float64 would promote a float32 q.
        g = as_array(given(q), "metric", q.dtype)
        if g.shape != (q.shape[0], q.shape[0]):
            raise ValueError(
                f"metric returned shape {g.shape}, expected {(q.shape[0], q.shape[0])} for this q{batch_hint(g, (1, 1))}"
            )
        return g

    return evaluate


def arnold_form(inertia: Float[Array, "n n"], c: Float[Array, " n"], a: Float[Array, " n"]) -> Float[Array, " n"]:
    r"""Arnold's bilinear form B(c, a) of a rotational or spatial inertia.

    $$\langle B(c, a), b \rangle = \langle [a, b], c \rangle \quad \text{for all } b, \qquad \langle x, y \rangle = x^T I y$$

    On SO(3) it satisfies $I B(c, a) = (I c) \times a$, on SE(3) $I B(c, a) = \mathrm{ad}_a^T I c$. Without forces a rigid body
    moves by Euler's equations $\dot V = B(V, V)$: the geodesics of the metric, as the left translations of Lemma 7.1 show.

    **Arguments:** `inertia` (3, 3), kg m^2, in body axes, or (6, 6), a spatial inertia in a body frame
    (`jd.inertia.spatial_inertia`); `c`, `a`: angular velocities (3,), rad/s, or body twists (v, omega) (6,).

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
