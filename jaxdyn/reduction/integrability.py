"""Classification of constraints: integrability, and the spurious terms of their substitution into L."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import is_concrete, is_known
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, velocity_residual
from jaxdyn.constraints.dynamics import tolerance
from jaxdyn.constraints.selection import independent_rows
from jaxdyn.dynamics.centroidal import kinetic_energy, potential_energy
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_shape, check_state, zeros_if_none
from jaxdyn.reduction.bases import (
    Independent,
    affine_rows,
    constraint_jacobian_compiled,
    pivot_rows,
    tangent_basis,
)
from jaxdyn.reduction.minimal import reduce
from jaxdyn.systems.lagrangian import LagrangianSystem
from jaxdyn.systems.mass_factor import solve_positive
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import velocity_to_rate


class Involutivity(NamedTuple):
    """Involutivity of a distribution: the decision and its evidence.

    - `value`: true where brackets stay in it; the motion then stays on a family of surfaces, as under holonomic rows.
    - `ranks`: dimensions of the distribution and of the span of its brackets, by level, until they stop growing.
    - `singular_values`: of the unit fields of each level, from which the ranks follow.
    - `complete`: false where brackets of more fields than were computed (6) are needed, at a singular configuration.
    """

    value: bool
    ranks: tuple[int, ...]
    singular_values: tuple[np.ndarray, ...]
    complete: bool = True


# Levels of brackets at a singular configuration: the derivatives of each cost three times those of the one before.
_LEVELS = 6
# Points around the configuration, and the way to them in metres and radians: three legs of constant velocities.
_POINTS, _LEGS, _STEPS, _LENGTH = 8, 3, 10, 0.1


def involutive(
    scene: Scene, q: Float[Array, " nq"], t: Numbers = 0.0, *, dof: int | None = None, rank_tol: float | None = None
) -> Involutivity:
    r"""Test the distribution of admissible velocities for involutivity (Frobenius's theorem) at a configuration.

    Fields $X_i$ span $\ker A$; each level adds the brackets $[X_i, Y] = (dY) X_i - (dX_i) Y$ with the fields Y of the level
    before, until the rank stops growing or the holonomic rows allow no more. nv - ranks[-1] is the number of holonomic
    constraints in the rows, ranks[-1] - ranks[0] that of the nonholonomic ones. Rows A v = b with b != 0 are
    tested together with their drift v0 + d/dt.

    At a singular configuration (two trailers at right angles) ranks pause: (2, 3, 4, 4, 5) where they are (2, 3, 4, 5) around it.
    The last rank is the same at all places that motions reach, if the rows are analytic. So it is looked up at one of them.

    **Arguments:** `q` (nq,) and `t`, concrete; `dof` and `rank_tol` as in `tangent_basis`. The rank of A is assumed to be
    constant around q.

    **Returns:** `Involutivity`.

    **Raises:** ValueError for traced numbers, scenes without constraints, and rows whose derivatives are not finite.

    ```python
    jd.reduction.involutive(jd.scenes.rolling_disk(), q).ranks  # (2, 3, 4)
    ```

    Source: Murray, Li & Sastry (1994), section 7.2; Jean (1996), ESAIM: COCV 1, 241, for trailers; EQUATIONS section 6.
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=t)
    if not layout(scene):
        raise ValueError("the scene has no constraints; every velocity is admissible")
    if not is_known(scene, q, t):
        raise ValueError("involutive branches on ranks and needs concrete numbers; call it outside of jit and vmap")
    scene = independent_rows(scene, q, t, rank_tol)
    reference = tangent_basis(scene, q, t, dof=dof, rank_tol=rank_tol)
    count, limit = reference.shape[1], tolerance(rank_tol, q)
    # Of the rows of A as many sums as are independent at q, and columns B by which they change.
    A = np.asarray(constraint_jacobian_compiled(scene, q, t))
    rows = np.linalg.svd(A)[0].T[: scene.nv - count]
    frame = reference, jnp.asarray(rows), jnp.asarray(np.linalg.pinv(rows @ A))
    # Brackets stay tangent to the holonomic constraints.
    A_holonomic = A[holonomic_rows(layout(scene))]
    maximum = scene.nv - (
        int(np.linalg.matrix_rank(A_holonomic, tol=1e-9 * np.abs(A_holonomic).max())) if A_holonomic.size else 0
    )

    def fields_at(points):
        """Fields at configurations as a function of the levels of brackets; finite at the first configuration."""

        def fields(levels):
            values = np.asarray(_fields(scene, frame, points, t, levels), float)
            if not np.isfinite(values[0]).all():
                raise ValueError(
                    f"the rows have derivatives of order {len(levels)} that are not finite at q = {np.asarray(q).tolist()}; "
                    "choose another configuration"
                )
            return values

        return fields

    points = _points_around(scene, frame, q, t)
    growth = count, limit, maximum
    grown = _grow(fields_at(points[:2]), *growth) or _grow(fields_at(points[[0, 0]]), *growth)
    assert grown is not None  # the first configuration is finite, or an error was raised
    ranks, evidence = grown
    dimension = max(ranks[-1])
    if any(here < around for here, around in ranks):
        ranks, evidence = _grow(fields_at(points), *growth, target=dimension) or grown
    at_q = tuple(here for here, _ in ranks)
    return Involutivity(dimension == at_q[0], at_q, evidence, at_q[-1] == dimension)


def _grow(fields: Callable, count: int, limit: float, maximum: int, target: int | None = None):
    """Ranks by level at the first two configurations, and singular values at the first; None where fields are not finite.

    **Arguments:** `fields(levels)` (points, nq, n): the last level of brackets; `count` of the fields that span the distribution;
    `limit`: singular values below this share of the largest are zero; `maximum` of the ranks; `target`: the rank at the first
    configuration that ends the search there, None for a search until ranks stop growing.
    """
    # A level is a tuple of pairs (i, k), for [X_i, Y_k] with Y_k of the level before; X_count is the drift, which is
    # bracketed with the others and spans nothing itself.
    levels: tuple[tuple[tuple[int, int], ...], ...] = ()
    new = fields(levels)[..., :count]
    spanned, ranks, evidence = new[..., :0], [], []
    while np.isfinite(new).all():
        sizes = [np.linalg.svd(columns, compute_uv=False) for columns in np.concatenate([spanned, new], -1)[:2]]
        evidence.append(sizes[0])
        # A level spans that before. Much longer brackets raise the threshold, which must not take dimensions away again.
        before = ranks[-1] if ranks else (0, 0)
        ranks.append(tuple(max(int(np.sum(x > limit * x[0])), n) for x, n in zip(sizes, before, strict=True)))
        if target is None:
            # Every pass but the last adds a dimension, of which there are at most nq.
            ends = len(ranks) > 1 and (ranks[-1] == before or max(ranks[-1]) >= maximum)
            # With constant rank, the fields that are independent at a point span the level around it.
            # Directions in the span already are removed once; pivoting, the largest first, then needs only the new columns.
            inside, rest = spanned[1], new[1]
            rest = rest - inside @ np.linalg.lstsq(inside, rest, rcond=None)[0] if inside.shape[1] else rest
        else:
            ends = ranks[-1][0] >= target or len(ranks) == _LEVELS
            # Fields that depend on others at one point may not do so around it: those that are sums of others go.
            rest = new.reshape(-1, new.shape[-1])
        if ends:
            return ranks, tuple(evidence)
        columns, pivots = pivot_rows(rest.T)
        kept = columns[pivots > limit * sizes[1][0]].tolist()
        spanned = np.concatenate([spanned, new[..., kept]], -1)
        pairs = [(i, k) for k in kept for i in range(count + 1) if levels or i > k]  # [X_k, X_i] = -[X_i, X_k]
        levels = (*levels, tuple(pairs))
        new = fields(levels)
    return None


def _generators(scene, frame):
    """Rates of (q, t), (n, nq + 1), as a function of these: those of the columns of N(q, t), and of the drift (v0, d/dt)."""
    reference, rows, lift = frame

    @jax.jit
    def generators(x):
        q, t = x[:-1], x[-1]
        A, b = affine_rows(scene, q, t)
        A, b = matmul(rows, A), matmul(rows, b)
        # N = R - B (A B)^-1 A R with constant R and B: of all frames the one with the shortest derivatives.
        solved = jnp.linalg.solve(matmul(A, lift), jnp.concatenate([matmul(A, reference), b[:, None]], 1))
        moved = matmul(lift, solved)
        frame = jnp.concatenate([reference - moved[:, :-1], moved[:, -1:]], 1)
        rates = jax.vmap(lambda v: velocity_to_rate(scene.system, q, v))(frame.T)
        times = jnp.zeros((rates.shape[0], 1), q.dtype).at[-1].set(1.0)
        return jnp.concatenate([rates, times], 1)

    return generators


@eqx.filter_jit
def _points_around(scene, frame, q, t):
    """Configurations (n, nq): q, and some that admissible motions from there reach, by steps of the classical method."""
    generators, x = _generators(scene, frame), jnp.concatenate([q, t[None]])
    ways = np.random.default_rng(0).normal(size=(_POINTS, _LEGS, frame[0].shape[1]))
    ways = np.repeat(ways / np.linalg.norm(ways, axis=-1, keepdims=True), _STEPS, axis=1) * (_LENGTH / _STEPS)

    def step(x, way):
        def rate(x):
            return matmul(way, generators(x)[:-1])

        first = rate(x)
        second = rate(x + first / 2)
        third = rate(x + second / 2)
        return x + (first + 2 * second + 2 * third + rate(x + third)) / 6, None

    ends = jax.vmap(lambda way: jax.lax.scan(step, x, way)[0])(jnp.asarray(ways, q.dtype))
    return jnp.concatenate([x[None], ends])[:, :-1]


@eqx.filter_jit
def _fields(scene, frame, points, t, levels):
    """Rates of q (points, nq, n) of the last level of brackets; level 0 has the columns of N(q, t) and the drift (v0, d/dt)."""
    generators = _generators(scene, frame)

    def brackets(inner, pairs):
        outer, within = np.array(pairs).T

        def fields(x):
            # Linearised once: both derivatives are reused by all pairs of the level.
            X, forward = jax.linearize(generators, x)
            Y, inward = jax.linearize(inner, x)
            along = jax.vmap(inward)(X), jax.vmap(forward)(Y)
            return along[0][outer, within] - along[1][within, outer]

        return fields

    # Each level differentiates the one before: the order of derivatives is the number of levels.
    last = generators
    for pairs in levels:
        last = brackets(last, pairs)
    return jax.vmap(lambda q: last(jnp.concatenate([q, t[None]]))[:, :-1].T)(points)


class SpuriousTerms(NamedTuple):
    """Equations of motion M_r nudot + bias = tau_r, correct ones and those with constraints substituted into L.

    - `terms` (nr,): the spurious terms, correct minus wrong bias, N or N m. Zero where substitution is valid.
    - `bias_force`, `wrong_bias_force` (nr,); `acceleration`, `wrong_acceleration` (nr,): nudot from each.
    - `mass_matrix` (nr, nr), the same in both.
    """

    terms: Float[Array, " nr"]
    bias_force: Float[Array, " nr"]
    wrong_bias_force: Float[Array, " nr"]
    acceleration: Float[Array, " nr"]
    wrong_acceleration: Float[Array, " nr"]
    mass_matrix: Float[Array, "nr nr"]


def spurious_terms(
    scene: Scene,
    q: Float[Array, " nq"],
    nu: Float[Array, " nr"],
    tau: Float[Array, " nv"] | None = None,
    t: Numbers = 0.0,
    *,
    independent: Sequence[int],
) -> SpuriousTerms:
    r"""Spurious terms from substituting constraints into the Lagrangian before differentiation.

    With $q = (r, s)$ and $\dot s = -a(r)^T \dot r$, the Lagrange equations of $L(r, \dot r, -a^T \dot r)$ differ from the correct
    ones by

    $$\frac{\partial L}{\partial \dot s} \cdot \left( \dot a_i - \sum_j \frac{\partial a_j}{\partial r_i} \dot r_j \right),$$

    which vanish identically when the rows are integrable, and by accident elsewhere (an upright rolling disk).

    **Arguments:** `q` (nq,); `nu` (nr,) = rdot; `tau` (nv,), N m or N (None: zero); `t`, s; `independent`: indices of r in
    q. Neither L nor the rows may depend on s (a Chaplygin system), nor may the rows prescribe a slip.

    **Returns:** `SpuriousTerms`.

    **Raises:** ValueError for a system with v other than dq/dt, and, on concrete numbers, for rows and L that depend on s.

    Source: Murray, Li & Sastry (1994), eq. 6.15; EQUATIONS section 6, errata E32 and E33.
    """
    scene = as_scene(scene)
    tau = zeros_if_none(tau, scene.nv)
    q, tau, t = check_state(scene.system, q=q, tau=tau, t=t)
    if not layout(scene):
        raise ValueError("the scene has no constraints, so there is nothing to substitute; add some")
    if scene.nq != scene.nv:
        raise ValueError(f"the system has nq = {scene.nq}, nv = {scene.nv}; substitution needs v = dq/dt")
    if not isinstance(independent, Sequence) or isinstance(independent, str):
        raise ValueError(f"independent is {independent!r}; give a tuple of indices of velocities")
    choice = Independent.of(independent, scene, "independent")
    nu = as_shape(nu, "nu", q.dtype, (choice.size(scene),), of=" = (nr,)")
    terms, depends = _substitute(independent_rows(scene, q, t), choice, q, nu, tau, t)
    if is_concrete(depends) and float(depends) > 1e-9:
        raise ValueError(
            f"L or the rows depend on the eliminated coordinates (by {float(depends):.3g}), or the rows prescribe a slip; "
            "choose other independent velocities, or use jd.reduced_dynamics"
        )
    return terms


@entry_point
def _substitute(scene, choice: Independent, q, nu, tau, t):
    kept = np.asarray(choice.velocities, int)
    rest = np.setdiff1d(np.arange(scene.nv), kept)
    # The correct equations, from the projection along N.
    right = reduce(scene, choice, q, nu, tau, t)

    def at(r):
        return choice.at(scene, q.at[kept].set(r), t).N

    def restricted_lagrangian(r, rdot):
        return _lagrangian(scene.system, q.at[kept].set(r), matmul(at(r), rdot), t)

    r = q[kept]
    # The wrong equations come from the substituted Lagrangian itself, so that they do not presuppose the formula of `terms`.
    momentum = jax.grad(restricted_lagrangian, argnums=1)
    _, change = jax.jvp(lambda r: momentum(r, nu), (r,), (nu,))
    wrong = change - jax.grad(restricted_lagrangian)(r, nu)
    # a = -N on the eliminated rows: (rate of a_i) - d/dr_i (a . rdot).
    push = jax.grad(lambda v: _lagrangian(scene.system, q, v, t))(right.velocity)[rest]
    _, along = jax.jvp(lambda r: -at(r)[rest], (r,), (nu,))
    slope = jax.jacfwd(lambda r: -matmul(at(r)[rest], nu))(r)
    terms = matmul(push, along - slope)
    rate = solve_positive(right.mass_matrix, right.force - wrong)
    value = SpuriousTerms(terms, right.bias_force, wrong, right.nu_rate, rate, right.mass_matrix)
    # Largest derivative of L and the rows with respect to s, at this velocity.
    forms = jax.jacfwd(lambda s: constraint_jacobian(scene, q.at[rest].set(s), t))(q[rest])
    pull = jax.grad(lambda s: _lagrangian(scene.system, q.at[rest].set(s), right.velocity, t))(q[rest])
    residual = velocity_residual(scene, q, jnp.zeros_like(q), t)
    return value, jnp.max(jnp.abs(jnp.concatenate([forms.ravel(), pull, residual])))


def _lagrangian(system, q, v, t):
    """Lagrangian of a system: its own function, or T - V."""
    if isinstance(system, LagrangianSystem):
        # T - V of such a system would lack terms linear in v.
        return system.value(q, v, t)
    return kinetic_energy(system, q, v, t) - potential_energy(system, q, t)
