"""Torques are linear in the parameters: the stacked regressor, what it can identify, and linear least squares."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.dynamics import quantities as dynamics
from jaxdyn.identify.condensed import Blocks, Condensed, condense_blocks, condensed_rows
from jaxdyn.identify.friction import TERMS, Terms, check_terms, friction_regressor
from jaxdyn.identify.jackknife import block_groups, jackknife, student
from jaxdyn.identify.logs import Log, as_logs, check_log
from jaxdyn.identify.threads import on_one_thread
from jaxdyn.identify.whiteness import stretches
from jaxdyn.model.arguments import Number, Numbers, as_array, check_shapes
from jaxdyn.model.joints import KINDS
from jaxdyn.model.tree import Model, integrate, neutral

_NUMBERS = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
# The numbers that stay when a body's ten are grouped, for a joint about z: Khalil & Dombre keep them and put m, m cz
# and
# Iyy into the body before. About other axes the elimination finds others by itself.
_KEPT_FIRST = (9, 1, 2, 4, 5, 7, 8)
_KEPT_LAST = (6, 3, 0)
_BLOCK = 256


def parameter_names(model: Model, terms: Terms = TERMS) -> tuple[str, ...]:
    """Names of x: the ten numbers of each body (`body.m`, `body.mcx`, ...), then the terms (`joint.viscous`)."""
    joints = []
    for name, kind in zip(model.joint_names, model.topology.kinds, strict=True):
        n = KINDS[kind].nv
        joints += [name] if n == 1 else [f"{name}[{i}]" for i in range(n)]
    bodies = [f"{body}.{number}" for body in model.body_names for number in _NUMBERS]
    return tuple(bodies + [f"{joint}.{term}" for term in terms for joint in joints])


def nominal_parameters(model: Model) -> np.ndarray:
    """The model's own x (10 nb + 4 nv,): inertias, damping, friction, no offset, armature; zero what it lacks."""
    leaves = {"viscous": model.damping, "coulomb": model.friction, "armature": model.armature, "offset": None}
    parts = [np.asarray(model.inertias, np.float64).reshape(-1)]
    parts += [np.zeros(model.nv) if leaves[term] is None else np.asarray(leaves[term], np.float64) for term in TERMS]
    return np.concatenate(parts)


def free_columns(nb: int, nv: int, terms) -> np.ndarray:
    """Positions in x of the inertial parameters and of the terms given."""
    start = 10 * nb
    blocks = [start + nv * TERMS.index(term) + np.arange(nv) for term in terms]
    return np.concatenate([np.arange(start), *blocks]).astype(int)


def regressor(model: Model, q: Numbers, v: Numbers, a: Numbers, *, v_s: Number = 0.01) -> np.ndarray:
    """Rows [Y(q, v, a), friction and rotor columns] for samples (n, nq), (n, nv), (n, nv): (n, nv, 10 nb + 4 nv).

    Computed in the model's dtype in blocks of equal size (one compilation for logs of any length), returned in float64.
    """
    check_shapes(model)
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


def _torques(model: Model, log: Log, x: np.ndarray, v_s: float) -> np.ndarray:
    """Torques (n, nv) of all parameters x along a log; no more than some samples' regressor is held at a time."""
    pieces = [log[start : start + 4 * _BLOCK] for start in range(0, len(log), 4 * _BLOCK)]
    return np.concatenate([log_regressor(model, part, v_s=v_s) @ x for part in pieces])


@eqx.filter_jit
def _moved(model, displacements):
    return jax.vmap(lambda displacement: integrate(model, neutral(model), displacement))(displacements)


@eqx.filter_jit
def _regressor_block(model, q, v, a, v_s):
    def one(q, v, a):
        return jnp.concatenate(
            [dynamics.torque_regressor(model, q, v, a), friction_regressor(v, a, TERMS, v_s)], axis=1
        )

    return jax.vmap(one)(q, v, a)


def condense(model: Model, log: Log | Sequence[Log], *, v_s=0.01, weights=None) -> Condensed:
    """Stack the regressor (all terms) over one log or several and condense it by QR: memory does not grow with the logs."""
    weights = check_weights(weights, model.nv)
    blocks = condense_model(model, as_logs(log), v_s=v_s)
    return condensed_rows(blocks.rows(weights), blocks.count())


def condense_model(
    model: Model,
    logs: Sequence[Log],
    *,
    v_s=0.01,
    coulomb: Sequence[np.ndarray] | None = None,
    extra: Sequence[np.ndarray] = (),
    blocks: int = 1,
    weights: Sequence[np.ndarray] | None = None,
) -> Blocks:
    """`condense_blocks` of the regressor with all terms.

    `coulomb`: for each log, columns (n, nv) of Coulomb friction instead of tanh(v / v_s); `extra`: more terms (n, nv, k);
    `weights`: for each log, those of its torques (n, nv).
    """
    start = 10 * model.nb + model.nv * TERMS.index("coulomb")

    def rows(which, piece):
        log = logs[which][piece]
        W = log_regressor(model, log, v_s=v_s)
        if coulomb is not None:
            joints = np.arange(model.nv)
            W[:, joints, start + joints] = coulomb[which][piece]
        return W

    return condense_blocks(logs, rows, 10 * model.nb, extra=extra, blocks=blocks, weights=weights)


class BaseParameters(eqx.Module):
    """The linear combinations of the parameters that joint torques can tell apart: base = matrix @ x.

    - `matrix` (nbase, p): grouping matrix; the columns of `independent` are the identity.
    - `independent` (nbase,): positions of the parameters that stand first in each combination.
    - `parameter_names` (p,): names of all the parameters x; `names` (nbase,): of the independent ones.
    """

    matrix: np.ndarray
    independent: np.ndarray
    parameter_names: tuple[str, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.independent)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that stand first in each combination."""
        return tuple(self.parameter_names[i] for i in self.independent)

    @property
    def expressions(self) -> tuple[str, ...]:
        """Each combination in words, e.g. `link2.Izz + 1 link3.Iyy - 0.4 link3.mcz`."""
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
        """Parameters that no torque depends on, alone or in a combination."""
        used = np.any(self.matrix != 0, axis=0)
        return tuple(name for name, u in zip(self.parameter_names, used, strict=True) if not u)

    def values(self, parameters: Numbers) -> np.ndarray:
        """Values (nbase,) of the combinations for parameters x (p,)."""
        return self.matrix @ np.asarray(parameters, np.float64).reshape(-1)


def base_parameters(model: Model, terms: Terms = (), *, v_s: float = 0.01, seed: int = 0) -> BaseParameters:
    """Base inertial parameters: the smallest set of combinations that determines every joint torque of the model.

    The regressor is stacked over random states. A column that depends linearly on the columns before it is grouped into
    them: W_D = W_I beta, so that W x = W_I (x_I + beta x_D). Columns go from the base to the tip, and within a body in
    the order in which Khalil & Dombre keep them.

    **Arguments:** `model`; `terms`, the friction and rotor terms to consider beside the links (of `TERMS`); `seed` of
    the random states.

    **Returns:** `BaseParameters`. The iiwa's 70 numbers give 43.

    **Raises:** ValueError when the rank is not clear in the model's precision (use a float64 model).

    Source: Gautier (1991), "Numerical calculation of the base inertial parameters"; Khalil & Dombre (2002), chapter 9.
    """
    terms = check_terms(terms, v_s)
    names = parameter_names(model, terms)
    p = len(names)
    count = max(2 * p // max(model.nv, 1) + 1, 30)
    generator = np.random.default_rng(seed)
    # Away from the neutral configuration by up to about half a turn; limits do not matter to what is identifiable.
    displacement, v, a = generator.normal(size=(3, count, model.nv))
    q = _moved(model, jnp.asarray(2 * displacement, model.home.dtype))
    W = regressor(model, q, v, a, v_s=v_s)[:, :, free_columns(model.nb, model.nv, terms)].reshape(-1, p)
    scale = np.linalg.norm(W, axis=0)
    # A column of rounding errors is zero too.
    noise = np.finfo(np.dtype(model.home.dtype)).eps
    scale[scale < 1e3 * noise * scale.max(initial=0.0)] = np.inf

    order = np.array(
        [10 * body + k for kept in (_KEPT_FIRST, _KEPT_LAST) for body in range(model.nb) for k in kept]
        + list(range(10 * model.nb, p)),
        int,
    )
    pivots = np.abs(np.diag(np.linalg.qr((W / scale)[:, order], mode="r")))
    tolerance = np.sqrt(noise) if noise < 1e-10 else 10 * np.sqrt(noise)
    kept = pivots > tolerance
    independent = np.sort(order[kept])
    scaled = (W / scale)[:, independent]
    singular = np.linalg.svd(W / scale, compute_uv=False)
    rank = int(np.sum(singular > tolerance * singular.max(initial=0.0)))
    if rank != len(independent):
        raise ValueError(
            f"base parameters of {model.name!r} are not clear in {model.home.dtype}: {len(independent)} by "
            f"elimination, {rank} by singular values; use a float64 model (jax_enable_x64)"
        )
    dependent = np.setdiff1d(np.arange(p), independent)
    beta = np.linalg.lstsq(scaled, (W / scale)[:, dependent], rcond=None)[0]
    beta[np.abs(beta) < 10 * tolerance] = 0.0
    matrix = np.zeros((len(independent), p))
    matrix[np.arange(len(independent)), independent] = 1.0
    finite = np.isfinite(scale[dependent])
    factor = np.where(finite, scale[dependent], 0.0)
    matrix[:, dependent] = beta * factor / scale[independent][:, None]
    return BaseParameters(matrix, independent, names)


class LeastSquares(eqx.Module):
    """Result of `least_squares`: base parameters with standard deviations. No body may exist that has them.

    - `base`: which combinations; `values`, `std`, `nominal` (nbase,): fitted, standard deviation, of the model given. Standard
      deviations count blocks of consecutive samples, as in `Intervals`; `factor`: a 95 % interval is plus and minus this many.
    - `parameters` (10 nb + 4 nv,): one x with these values, the one nearest to the model's; its numbers mean nothing
      alone.
    - `sigma`: root mean square of the (weighted) residual; `condition`: of the regressor with columns of unit length;
      `rank`: combinations that the log excites, at most nbase.
    - `covariance` (nbase, nbase) for independent errors of all samples, which those of a filtered log are not: how combinations
      hang together, not how well they are known.
    """

    base: BaseParameters
    values: np.ndarray
    std: np.ndarray
    nominal: np.ndarray
    parameters: np.ndarray
    covariance: np.ndarray
    sigma: float
    condition: float
    rank: int
    factor: float
    model: Model
    terms: tuple[str, ...] = eqx.field(static=True)
    v_s: float = eqx.field(static=True)

    def torques(self, log: Log) -> np.ndarray:
        """Torques (n, nv) that the fit predicts along a log."""
        check_log(log, self.model)
        return _torques(self.model, log, self.parameters, self.v_s)

    def error(self, log: Log) -> float:
        """Torque error along a log, in per cent of the measured torque: 100 |tau_fit - tau| / |tau| over all joints."""
        return torque_error(self.torques(log), log.tau)

    def table(self) -> list[tuple[str, float, float, float]]:
        """Rows (combination, nominal, fitted, standard deviation)."""
        return list(zip(self.base.names, self.nominal.tolist(), self.values.tolist(), self.std.tolist(), strict=True))

    def summary(self) -> str:
        """The fit in words and a table."""
        unknown = len(self.values) - self.rank
        lines = [
            f"linear least squares, {self.model.name}: {len(self.values)} combinations of "
            f"{len(self.base.parameter_names)} parameters, rank {self.rank}, condition {self.condition:.4g}, "
            f"residual {self.sigma:.4g} N m",
        ]
        if unknown:
            lines.append(
                f"the log does not excite {unknown} combinations: they keep the nominal value where std is infinite"
            )
        width = max(map(len, self.base.names), default=0)
        lines.append(f"{'combination':{width}}  {'nominal':>12}  {'fitted':>12}  {'std':>12}")
        lines += [f"{name:{width}}  {x0:12.5g}  {x:12.5g}  {s:12.3g}" for name, x0, x, s in self.table()]
        return "\n".join(lines)


@on_one_thread
def least_squares(
    model: Model,
    log: Log | Sequence[Log],
    terms: Terms = TERMS,
    *,
    v_s: float = 0.01,
    weights: Numbers | None = None,
    rcond: float = 1e-6,
    blocks: int = 20,
) -> LeastSquares:
    """Base parameters, friction and rotor inertia by linear least squares on the torques: min |weights (W x - tau)|^2.

    **Arguments:**

    - `model`: geometry and nominal parameters; `log` with v and a, or several such logs.
    - `terms`: what is fitted beside the links: tau_f = viscous v + coulomb tanh(v / v_s) + offset, and armature a.
    - `weights` (nv,): one over the noise of each joint's torque; ones by default.
    - `rcond`: directions whose singular value is below this times the largest are not excited by the log; along them
      the model's values stay.
    - `blocks`: consecutive samples are cut into about this many blocks, whose scatter gives the standard deviations.

    **Returns:** `LeastSquares`.

    **Raises:** ValueError when log and model do not fit together or the log has fewer rows than combinations.

    Source: Atkeson, An & Hollerbach (1986); Gautier (1991).
    """
    terms = check_terms(terms, v_s)
    logs = as_logs(log, model)
    base = base_parameters(model, terms, v_s=v_s)
    weights = check_weights(weights, model.nv)
    parts = condense_model(model, logs, v_s=v_s, blocks=blocks)
    condensed = condensed_rows(parts.rows(weights), parts.count())
    if condensed.rows <= len(base):
        samples = sum(map(len, logs))
        raise ValueError(f"the log has {samples} samples of {model.nv} torques, too few for {len(base)} combinations")
    x0 = nominal_parameters(model)
    columns = free_columns(model.nb, model.nv, terms)
    # What is not fitted (friction terms left out) stays at the model's value, on the other side.
    residual = condensed.d - condensed.R @ x0
    fit = truncated(condensed.R[:, columns[base.independent]], residual, rcond)
    rest = condensed.rest + fit.rest
    sigma = float(np.sqrt(rest / (condensed.rows - fit.rank)))
    covariance = sigma**2 * fit.half @ fit.half.T
    places = columns[base.independent]
    fitted = x0.copy()
    fitted[places] += fit.change
    worth = stretches([_torques(model, log, fitted, v_s) - np.asarray(log.tau, np.float64) for log in logs])
    std, factor = _scatter(parts, fitted, places, fit.half, weights, worth)
    std = np.where(fit.unknown, np.inf, std)
    nominal = base.values(x0[columns])
    parameters = x0.copy()
    parameters[columns] += np.linalg.pinv(base.matrix) @ fit.change
    return LeastSquares(
        base=base,
        values=nominal + fit.change,
        std=std,
        nominal=nominal,
        parameters=parameters,
        covariance=covariance,
        sigma=sigma,
        condition=fit.condition,
        rank=fit.rank,
        factor=factor,
        model=model,
        terms=terms,
        v_s=float(v_s),
    )


def _scatter(
    blocks: Blocks, x: np.ndarray, places, half: np.ndarray, weights, worth: float
) -> tuple[np.ndarray, float]:
    """Standard deviations of x[places] from groups of blocks left out in turn, and the factor of a 95 % interval.

    In coordinates y with x[places] = half y, in which all samples together have the curvature 1.
    """
    groups = block_groups(len(blocks), worth)
    slopes = blocks.scores(x, weights)[:, places] @ half
    grams = np.einsum("pi,bpq,qj->bij", half, blocks.grams(weights)[:, places][:, :, places], half, optimize=True)
    slopes, grams = (np.stack([part[group].sum(axis=0) for group in groups]) for part in (slopes, grams))
    changes, _ = jackknife(grams, slopes, np.zeros((half.shape[1],) * 2))
    return np.sqrt(np.sum((half @ changes) ** 2, axis=1)), student(len(groups) - 1)


def noise_level(condensed: Condensed, *, rcond: float = 1e-9) -> float:
    """Root mean square residual of the unconstrained least squares, the torque noise of a condensed log.

    **Raises:** ValueError when the log has no more rows than the regressor's rank: then nothing is left to tell the
    noise.
    """
    fit = truncated(condensed.R, condensed.d, rcond)
    if condensed.rows <= fit.rank:
        raise ValueError(
            f"the log has {condensed.rows} torques for {fit.rank} unknowns; log more, or give sigma yourself"
        )
    return float(np.sqrt((condensed.rest + fit.rest) / (condensed.rows - fit.rank)))


class Truncated(NamedTuple):
    """min |A change - b| with columns scaled to unit length and directions below rcond left at zero.

    `half` half^T is the covariance of `change` for noise of size 1 in b; `unknown` marks what the rows do not determine.
    """

    change: np.ndarray
    rest: float
    half: np.ndarray
    unknown: np.ndarray
    condition: float
    rank: int


def truncated(A: np.ndarray, b: np.ndarray, rcond: float) -> Truncated:
    """`Truncated` of a matrix (n, p) and a vector (n,)."""
    scale = np.linalg.norm(A, axis=0)
    # A column of rounding errors is no column: scaled up it would count as excited.
    scale[scale <= 1e-12 * scale.max(initial=0.0)] = np.inf
    U, s, Vt = np.linalg.svd(A / scale, full_matrices=False)
    rank = int(np.sum(s > rcond * s.max(initial=0.0)))
    change = (Vt[:rank].T @ ((U[:, :rank].T @ b) / s[:rank])) / scale
    half = (Vt[:rank].T / s[:rank]) / scale[:, None]
    # Any share in a direction that is not excited leaves a parameter unknown.
    unknown = np.sum(Vt[rank:] ** 2, axis=0) > 1e-12
    condition = float(s[0] / s[rank - 1]) if rank else np.inf
    return Truncated(change, float(np.sum((b - A @ change) ** 2)), half, unknown, condition, rank)


def torque_error(predicted: Numbers, measured: Numbers) -> float:
    """100 |predicted - measured| / |measured| over all samples and joints (Frobenius norms), in per cent."""
    measured = np.asarray(measured, np.float64)
    return float(100 * np.linalg.norm(np.asarray(predicted, np.float64) - measured) / np.linalg.norm(measured))


def check_weights(weights, nv: int) -> np.ndarray:
    """Weights (nv,), ones when None. **Raises:** ValueError unless they are nv positive numbers."""
    if weights is None:
        return np.ones(nv)
    weights = np.asarray(weights, np.float64)
    if weights.shape != (nv,) or not np.all(weights > 0):
        raise ValueError(f"weights is {weights.tolist()}; give {nv} positive numbers, one over the noise of each joint")
    return weights
