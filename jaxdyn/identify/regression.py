"""Stacked regressor of joint torques, condensed to triangles by QR, and base parameters.

A fit needs the triangles alone, at a cost independent of the logs' length. The rows of one torque hold the inertial columns and
that torque's own terms. For each block of consecutive samples and each torque they are replaced by the triangle of their QR
factorisation, which keeps all squares and products. Weights of torques, samples to leave out, and columns to leave out can then
be chosen afterwards, and the error of parameters on a block is known without its samples.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.dynamics import quantities as dynamics
from jaxdyn.identify.logs import Log
from jaxdyn.identify.torque_terms import TERMS, Terms, check_terms, friction_regressor
from jaxdyn.model.arguments import Number, Numbers, as_array, check_seed, check_shapes, is_concrete
from jaxdyn.model.configuration import integrate, neutral
from jaxdyn.model.topology import KINDS
from jaxdyn.model.tree import Model


@dataclasses.dataclass(frozen=True)
class Blocks:
    """Regressor and torques of logs, condensed for each block of samples and each torque.

    - `triangles`: for each block a list of nv upper-trapezoidal matrices (m, k + 1): the columns of that torque, and the torque
      measured (N m). `columns`: for each torque the indices (k,) of its columns in the parameters x (size,).
    - `samples` (blocks,): samples in each block. `logs` (blocks,): which log each block comes from.
    """

    triangles: list[list[np.ndarray]]
    columns: tuple[np.ndarray, ...]
    size: int
    samples: np.ndarray
    logs: np.ndarray

    def __len__(self) -> int:
        return len(self.triangles)

    @property
    def nv(self) -> int:
        """Number of torques."""
        return len(self.columns)

    def merge(self, chosen=None) -> list[np.ndarray]:
        """One triangle for each torque, of some blocks (an array of bool or of indices; None: all)."""
        chosen_blocks = np.arange(len(self)) if chosen is None else np.arange(len(self))[chosen]
        return [
            triangle_of(np.concatenate([self.triangles[block][joint] for block in chosen_blocks]))
            for joint in range(self.nv)
        ]

    def squares(self, x: np.ndarray, chosen=None) -> np.ndarray:
        """Sums of squared errors (blocks, nv) of the parameters x on some blocks."""
        chosen_blocks = np.arange(len(self)) if chosen is None else np.arange(len(self))[chosen]
        # The triangle's last column is the torque: R [x, -1] has the length of the error W x - w.
        columns = [np.append(x[places], -1.0) for places in self.columns]
        return np.array(
            [[np.sum((R @ c) ** 2) for R, c in zip(self.triangles[i], columns, strict=True)] for i in chosen_blocks]
        )

    def scores(self, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Half the gradients (blocks, p) of each block's weighted squared error at x."""
        result = np.zeros((len(self), self.size))
        for row, triangles in zip(result, self.triangles, strict=True):
            for places, weight, R in zip(self.columns, weights, triangles, strict=True):
                row[places] += weight**2 * (R[:, :-1].T @ (R @ np.append(x[places], -1.0)))
        return result

    def grams(self, weights: np.ndarray) -> np.ndarray:
        """W^T W of each block (blocks, p, p), rows weighted."""
        result = np.zeros((len(self), self.size, self.size))
        for matrix, triangles in zip(result, self.triangles, strict=True):
            # Torques share the inertial columns, so that their Gram matrices overlap and add up there.
            for places, weight, R in zip(self.columns, weights, triangles, strict=True):
                matrix[np.ix_(places, places)] += weight**2 * (R[:, :-1].T @ R[:, :-1])
        return result

    def rows(self, weights: np.ndarray, chosen=None) -> np.ndarray:
        """Rows [W, w] (m, p + 1) with the squares and products of some blocks, each torque's times its weight."""
        parts = []
        for places, weight, R in zip(self.columns, weights, self.merge(chosen), strict=True):
            part = np.zeros((len(R), self.size + 1))
            part[:, np.append(places, self.size)] = weight * R
            parts.append(part)
        return np.concatenate(parts)

    def count(self, chosen=None) -> int:
        """Number of torques measured in some blocks."""
        samples = self.samples if chosen is None else self.samples[chosen]
        return int(samples.sum()) * self.nv


def triangle_of(rows: np.ndarray) -> np.ndarray:
    """Upper-trapezoidal matrix with the squares and products of rows.

    Of rows [W, w] of a regressor and torques it has the same |W x - w| for every x. Unlike the normal matrix W^T W it keeps the
    condition number from being squared.
    """
    return np.asarray(np.linalg.qr(rows, mode="r"))


def block_slices(lengths: Sequence[int], total: int) -> list[tuple[int, slice]]:
    """Cut logs of these lengths into about `total` blocks, (log, its samples), each within one log; a log has at least one."""
    result = []
    for which, length in enumerate(lengths):
        count = min(max(1, round(total * length / sum(lengths))), length)
        edges = np.linspace(0, length, count + 1).astype(int)
        result += [(which, slice(a, b)) for a, b in itertools.pairwise(edges)]
    return result


NUMBERS = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
# The order of elimination of a body's ten numbers, for a joint about z: Khalil & Dombre keep the first ones and group m, m cz and
# Iyy into the parent. For other axes the elimination arrives at others.
_KEPT_FIRST = (9, 1, 2, 4, 5, 7, 8)
_KEPT_LAST = (6, 3, 0)
# Samples of one compiled call: without blocks of one size every length of a log would be compiled again.
_BLOCK = 256
# Samples whose regressor is held at a time while logs are condensed.
_SAMPLES = 1024


def coordinate_names(model: Model) -> list[str]:
    """Names (nv,) of the velocity coordinates: of their joints, with an index where a joint has several."""
    sizes = zip(model.joint_names, (KINDS[kind].nv for kind in model.topology.kinds), strict=True)
    return [name if n == 1 else f"{name}[{i}]" for name, n in sizes for i in range(n)]


def parameter_names(model: Model, terms: Terms = TERMS) -> tuple[str, ...]:
    """Names of x: the ten numbers of each body (`body.m`, `body.mcx`, ...), then the terms (`joint.viscous`)."""
    joints = coordinate_names(model)
    bodies = [f"{body}.{number}" for body in model.body_names for number in NUMBERS]
    return tuple(bodies + [f"{joint}.{term}" for term in check_terms(terms, v_s=1.0) for joint in joints])


def nominal_parameters(model: Model) -> np.ndarray:
    """Parameters x (10 nb + 4 nv,) of the model: inertias, damping, friction, no offset, armature; zero where it has none."""
    leaves = {"viscous": model.damping, "coulomb": model.friction, "armature": model.armature, "offset": None}
    parts = [np.asarray(model.inertias, np.float64).reshape(-1)]
    parts += [np.zeros(model.nv) if leaves[term] is None else np.asarray(leaves[term], np.float64) for term in TERMS]
    return np.concatenate(parts)


def free_columns(nb: int, nv: int, terms) -> np.ndarray:
    """Indices in x of the inertial parameters and of the terms given."""
    start = 10 * nb
    blocks = [start + nv * TERMS.index(term) + np.arange(nv) for term in terms]
    return np.concatenate([np.arange(start), *blocks]).astype(int)


def regressor(model: Model, q: Numbers, v: Numbers, a: Numbers, *, v_s: Number = 0.01) -> np.ndarray:
    """Rows [Y(q, v, a), friction and rotor columns] for samples (n, nq), (n, nv), (n, nv): (n, nv, 10 nb + 4 nv).

    Computed in the model's dtype in blocks of equal size (one compilation for logs of any length), returned in float64.

    **Raises:** ValueError for traced arrays.
    """
    check_shapes(model)
    if not is_concrete(q, v, a):
        raise ValueError(
            "q, v and a are traced; regressor takes the numbers of a log. Under jit: jd.dynamics.torque_regressor"
        )
    q, v, a = (np.asarray(as_array(x, name), model.home.dtype) for name, x in (("q", q), ("v", v), ("a", a)))
    n = len(q)
    parts = []
    for start in range(0, n, _BLOCK):
        rows = np.minimum(np.arange(start, start + _BLOCK), n - 1)  # the last block repeats the last sample
        part = _regressor_block(model, q[rows], v[rows], a[rows], jnp.asarray(v_s, model.home.dtype))
        parts.append(np.asarray(part, np.float64)[: n - start])
    return np.concatenate(parts)


def log_regressor(model: Model, log: Log, *, v_s: Number = 0.01) -> np.ndarray:
    """`regressor` of a log's samples. **Raises:** ValueError for a log without v or a."""
    if log.v is None or log.a is None:
        raise ValueError("the log has no v or no a; measure them, or make them from q with jd.identify.from_raw")
    return regressor(model, log.q, log.v, log.a, v_s=v_s)


def model_torques(model: Model, log: Log, x: np.ndarray, v_s: float) -> np.ndarray:
    """Torques (n, nv) of all parameters x along a log, in chunks that bound the memory of the regressor."""
    pieces = [log[start : start + 4 * _BLOCK] for start in range(0, len(log), 4 * _BLOCK)]
    return np.concatenate([log_regressor(model, part, v_s=v_s) @ x for part in pieces])


@eqx.filter_jit
def _displace_neutral(model, displacements):
    return jax.vmap(lambda displacement: integrate(model, neutral(model), displacement))(displacements)


@eqx.filter_jit
def _regressor_block(model, q, v, a, v_s):
    def one(q, v, a):
        return jnp.concatenate(
            [dynamics.torque_regressor(model, q, v, a), friction_regressor(v, a, TERMS, v_s)], axis=1
        )

    return jax.vmap(one)(q, v, a)


def condense_model(
    model: Model,
    logs: Sequence[Log],
    *,
    v_s=0.01,
    coulomb: Sequence[np.ndarray] | None = None,
    extra: Sequence[np.ndarray] = (),
    carried: Sequence[np.ndarray] = (),
    blocks: int = 1,
    weights: Sequence[np.ndarray] | None = None,
) -> Blocks:
    """Condense logs, block by block, by the regressor with all terms.

    The parameters are those of `parameter_names`, then one number for each torque of the first extra term, of the second, ...,
    then those carried.

    **Arguments:** for each log, `coulomb`: columns (n, nv) of Coulomb friction instead of tanh(v / v_s); `extra`: more terms
    (n, nv, k); `carried`: more columns (n, nv, k) whose numbers all torques share; `weights`: those of its torques (n, nv), ones
    by default. `blocks`: their approximate number, over all logs.
    """
    shared, joints = 10 * model.nb, np.arange(model.nv)
    of_coulomb = shared + model.nv * TERMS.index("coulomb") + joints
    terms = len(TERMS) + (extra[0].shape[2] if len(extra) else 0)
    edge = shared + model.nv * terms
    size = edge + (carried[0].shape[2] if len(carried) else 0)
    places = tuple(
        np.concatenate([np.arange(shared), shared + j + model.nv * np.arange(terms), np.arange(edge, size)])
        for j in joints
    )
    triangles, samples, owners = [], [], []
    for which, part in block_slices([len(log) for log in logs], blocks):
        triangle_of_row = [np.zeros((0, len(own) + 1)) for own in places]
        for start in range(part.start, part.stop, _SAMPLES):
            piece = slice(start, min(start + _SAMPLES, part.stop))
            log = logs[which][piece]
            W, tau = log_regressor(model, log, v_s=v_s), np.asarray(log.tau, np.float64)
            if coulomb is not None:
                W[:, joints, of_coulomb] = coulomb[which][piece]
            # Each term is a diagonal block: a torque keeps its own column, the others are zero.
            own = W[:, :, shared:].reshape(len(log), model.nv, -1, model.nv)
            more = [columns[which][piece] for columns in (extra, carried) if len(columns)]
            for j in joints:
                # The torque is the last column, so that it is weighted with its row.
                parts = [W[:, j, :shared], own[:, j, :, j], *(x[:, j] for x in more), tau[:, j, None]]
                table = np.concatenate(parts, axis=1)
                table = table if weights is None else table * weights[which][piece, j, None]
                # Sequential QR: the triangle so far joins the next rows, so that memory does not grow with the log.
                triangle_of_row[j] = triangle_of(np.concatenate([triangle_of_row[j], table]))
        triangles.append(triangle_of_row)
        samples.append(part.stop - part.start)
        owners.append(which)
    return Blocks(triangles, places, size, np.array(samples), np.array(owners))


class BaseParameters(eqx.Module):
    """Identifiable linear combinations of the parameters: base = matrix @ x.

    - `matrix` (nbase, p): grouping matrix; the columns of `independent` are the identity.
    - `independent` (nbase,): indices of the parameters that come first in each combination.
    - `parameter_names` (p,): names of all the parameters x; `names` (nbase,): of the independent ones.
    """

    matrix: np.ndarray
    independent: np.ndarray
    parameter_names: tuple[str, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.independent)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that come first in each combination."""
        return tuple(self.parameter_names[i] for i in self.independent)

    @property
    def expressions(self) -> tuple[str, ...]:
        """Text of each combination, e.g. `link2.Izz + 1 link3.Iyy - 0.4 link3.mcz`."""
        lines = []
        for i, row in zip(self.independent, self.matrix, strict=True):
            rest = [
                (c, name) for k, (c, name) in enumerate(zip(row, self.parameter_names, strict=True)) if k != i and c
            ]
            lines.append(
                "".join(
                    [self.parameter_names[i]] + [f" {'-' if c < 0 else '+'} {abs(c):.4g} {name}" for c, name in rest]
                )
            )
        return tuple(lines)

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Parameters on which no torque depends, in any combination."""
        used = np.any(self.matrix != 0, axis=0)
        return tuple(name for name, u in zip(self.parameter_names, used, strict=True) if not u)

    def values(self, parameters: Numbers) -> np.ndarray:
        """Values (nbase,) of the combinations for parameters x (p,)."""
        return self.matrix @ np.asarray(parameters, np.float64).reshape(-1)


def base_parameters(model: Model, terms: Terms = (), *, v_s: float = 0.01, seed: int = 0) -> BaseParameters:
    r"""Base inertial parameters: the smallest set of combinations that determines every joint torque of the model.

    The regressor is stacked over random states. A column that depends linearly on the columns before it is grouped into
    them: $W_D = W_I \beta$, so that $W x = W_I (x_I + \beta x_D)$. Columns go from the base to the tip, and within a body in
    the order in which Khalil & Dombre keep them.

    **Arguments:** `model`; `terms`, the friction and rotor terms to include in addition to the links (of `TERMS`); `seed` of
    the random states.

    **Returns:** `BaseParameters`. The iiwa's 70 numbers give 43.

    **Raises:** ValueError for unknown terms, a `v_s` or a seed that does not fit, and when the rank is not clear in the
    model's precision (use a float64 model).

    Source: Gautier (1991), "Numerical calculation of the base inertial parameters"; Khalil & Dombre (2002), chapter 9.
    """
    terms = check_terms(terms, v_s)
    names = parameter_names(model, terms)
    p = len(names)
    # Twice as many rows as columns: a rank must not be low for lack of states.
    count = max(2 * p // max(model.nv, 1) + 1, 30)
    generator = np.random.default_rng(check_seed(seed))
    # Away from the neutral configuration by up to about half a turn; identifiability does not depend on limits.
    displacement, v, a = generator.normal(size=(3, count, model.nv))
    q = _displace_neutral(model, jnp.asarray(2 * displacement, model.home.dtype))
    W = regressor(model, q, v, a, v_s=v_s)[:, :, free_columns(model.nb, model.nv, terms)].reshape(-1, p)
    base, rank = group_columns(W, names, model.nb, np.dtype(model.home.dtype))
    # Two tests of the rank: they differ where a pivot is close to the tolerance.
    if rank != len(base):
        raise ValueError(
            f"base parameters of {model.name!r} are not clear in {model.home.dtype}: {len(base)} by "
            f"elimination, {rank} by singular values; use a float64 model (jax_enable_x64)"
        )
    return base


def group_columns(W: np.ndarray, names: tuple[str, ...], nb: int, dtype: np.dtype) -> tuple[BaseParameters, int]:
    """Base parameters of a stacked regressor (rows, p), whose first 10 nb columns are those of bodies, and its rank by SVD.

    `dtype`: of the computation of its entries, whose rounding decides which columns are dependent.
    """
    p, scale = W.shape[1], np.linalg.norm(W, axis=0)
    # A column of rounding errors is zero too, and must not be scaled to unit length.
    noise = np.finfo(dtype).eps
    scale[scale < 1e3 * noise * scale.max(initial=0.0)] = np.inf

    order = np.array(
        [10 * body + k for kept in (_KEPT_FIRST, _KEPT_LAST) for body in range(nb) for k in kept]
        + list(range(10 * nb, p)),
        int,
    )
    # QR without column pivoting: the order decides which of dependent parameters stands for the combination.
    pivots = np.abs(np.diag(np.linalg.qr((W / scale)[:, order], mode="r")))
    # Pivots of unit columns are rounding errors or far above: the root of rounding is between both on a logarithmic scale.
    tolerance = np.sqrt(noise) if noise < 1e-10 else 10 * np.sqrt(noise)
    kept = pivots > tolerance
    independent = np.sort(order[kept])
    scaled = (W / scale)[:, independent]
    singular = np.linalg.svd(W / scale, compute_uv=False)
    rank = int(np.sum(singular > tolerance * singular.max(initial=0.0)))
    dependent = np.setdiff1d(np.arange(p), independent)
    beta = np.linalg.lstsq(scaled, (W / scale)[:, dependent], rcond=None)[0]
    # Rounding errors would otherwise appear in the combinations as parameters.
    beta[np.abs(beta) < 10 * tolerance] = 0.0
    matrix = np.zeros((len(independent), p))
    matrix[np.arange(len(independent)), independent] = 1.0
    finite = np.isfinite(scale[dependent])
    factor = np.where(finite, scale[dependent], 0.0)
    # Back from unit columns, W x = (W / scale) (scale x).
    matrix[:, dependent] = beta * factor / scale[independent][:, None]
    return BaseParameters(matrix, independent, names), rank


def noise_level(triangle: np.ndarray, count: int, *, what: str = "the log") -> float:
    """Root mean square residual of the unconstrained least squares of `count` torques, their noise; `what`, for the message.

    **Raises:** ValueError where the torques are no more than the regressor's rank: then the noise is not identifiable.
    """
    fit = least_squares_by_svd(triangle[:, :-1], triangle[:, -1], 1e-9)
    if count <= fit.rank:
        # Not the number of unknowns: a log of few rows determines as many combinations of them as it has rows.
        raise ValueError(
            f"{what} has {count} torques, which determine {fit.rank} combinations of parameters and leave no error to "
            "estimate noise by; log more samples"
        )
    return float(np.sqrt(fit.rest / (count - fit.rank)))


class SvdSolution(NamedTuple):
    """Solution of min |A change - b| with columns scaled to unit length and directions below rcond left at zero.

    `rest`: the squared error. `half` half^T is the covariance of `change` for noise of size 1 in b; `unknown` marks entries that
    the rows do not determine. `singular` values and `directions`, in rows, of the scaled columns; the first `rank` count.
    """

    change: np.ndarray
    rest: float
    half: np.ndarray
    unknown: np.ndarray
    singular: np.ndarray
    directions: np.ndarray
    rank: int

    @property
    def condition(self) -> float:
        """Ratio of the largest singular value to the least that counts."""
        return float(self.singular[0] / self.singular[self.rank - 1]) if self.rank else np.inf


def least_squares_by_svd(A: np.ndarray, b: np.ndarray, rcond: float) -> SvdSolution:
    """Least squares of a matrix (n, p) and a vector (n,) by a truncated singular value decomposition."""
    scale = np.linalg.norm(A, axis=0)
    # A column of rounding errors would count as excited once it is scaled to unit length.
    scale[scale <= 1e-12 * scale.max(initial=0.0)] = np.inf
    U, s, Vt = np.linalg.svd(A / scale, full_matrices=False)
    rank = int(np.sum(s > rcond * s.max(initial=0.0)))
    change = (Vt[:rank].T @ ((U[:, :rank].T @ b) / s[:rank])) / scale
    half = (Vt[:rank].T / s[:rank]) / scale[:, None]
    # Any component in a direction that is not excited leaves a parameter undetermined.
    unknown = np.sum(Vt[rank:] ** 2, axis=0) > 1e-12
    return SvdSolution(change, float(np.sum((b - A @ change) ** 2)), half, unknown, s, Vt, rank)


def torque_error(predicted: Numbers, measured: Numbers) -> float:
    r"""Torque error over all samples and joints (Frobenius norms), in per cent.

    $$100 |\tau_\mathrm{predicted} - \tau_\mathrm{measured}| / |\tau_\mathrm{measured}|$$
    """
    measured = np.asarray(measured, np.float64)
    return float(100 * np.linalg.norm(np.asarray(predicted, np.float64) - measured) / np.linalg.norm(measured))


def check_weights(weights, nv: int) -> np.ndarray:
    """Weights (nv,), ones when None. **Raises:** ValueError unless they are nv positive numbers."""
    if weights is None:
        return np.ones(nv)
    weights = np.asarray(weights, np.float64)
    if weights.shape != (nv,) or not np.all((weights > 0) & (weights < np.inf)):
        raise ValueError(f"weights is {weights.tolist()}; give {nv} positive numbers, one over the noise of each joint")
    return weights
