"""Joint torques in addition to those of the links: friction, rotor inertia and further terms, each a column of the regressor.

    viscous, coulomb, offset, armature   v, tanh(v / v_s), 1, a

    load        |tau_rigid| tanh(v / v_s)   Coulomb friction in proportion to the torque that the gear carries
    dahl        z, dz/dt = |v| (sign v - z) / z0   pre-sliding: friction that reverses over a displacement of about z0
    asymmetric  |v|                         viscous friction that differs between the directions
    quadratic   v |v|                       friction that grows faster than the velocity
    spring      sin q and cos q             springs and counterbalances between a link and its parent

Source: Dahl (1968), "A solid friction model"; Hamon, Gautier & Garrec (2010), load-dependent friction of geared joints.
"""

import itertools
from collections.abc import Callable, Iterable, Sequence, Set
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.identify.logs import Log, filter_like_log, refine_samples, samples_for_jumps
from jaxdyn.model.arguments import Number, SystemLike, as_number, warn
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene

TERMS = ("viscous", "coulomb", "offset", "armature")
# Terms that are physical only when they are not negative.
POSITIVE = ("viscous", "coulomb", "armature")


if TYPE_CHECKING:
    Terms = str | Sequence[str]  # names of `TERMS`
else:
    Terms = Any  # checked by `check_terms`


class Friction(eqx.Module):
    r"""Torque of a joint's friction, to be supplied by the motor.

    $$\tau_f = \mathrm{viscous} \cdot v + \mathrm{coulomb} \tanh(v / v_s) + \mathrm{offset}$$

    Called as a force of a scene, `friction(system, q, v, t)`, it gives $-\tau_f$. The offset (N m) is a constant of the
    measurement (sensor bias, cable) or of asymmetric dry friction.

    - `viscous` (nv,) N m s/rad, `coulomb` (nv,) N m, `offset` (nv,) N m; for prismatic joints N s/m, N, N.
    - `v_s`: velocity at which the smoothed Coulomb friction has 76 % of its level (rad/s or m/s).
    """

    viscous: Float[Array, " nv"]
    coulomb: Float[Array, " nv"]
    offset: Float[Array, " nv"]
    v_s: Float[Array, ""]

    def torque(self, v: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """Torque (nv,) at the velocity v (nv,)."""
        return self.viscous * v + self.coulomb * jnp.tanh(v / self.v_s) + self.offset

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        return -self.torque(v)


def friction_of(scene: Scene) -> Friction:
    """The friction law of a scene: its first force of that kind."""
    return next(force for force in scene.forces if isinstance(force, Friction))


# Leaf of a scene with the coefficients of each term.
LEAVES: dict[str, Callable[[Any], Any]] = {
    "viscous": lambda scene: friction_of(scene).viscous,
    "coulomb": lambda scene: friction_of(scene).coulomb,
    "offset": lambda scene: friction_of(scene).offset,
    "armature": lambda scene: scene.system.armature,
}


def smoothing_by_filter(scene: Scene, log: Log) -> np.ndarray:
    """Change (n, nv) of the column of Coulomb friction by the low-pass of a log, zero for a log that was not filtered.

    The log's torque went through the low-pass, and the scene has the unfiltered law.
    """
    v_s = float(friction_of(scene).v_s)
    return coulomb_through_filter(log, v_s) - coulomb_column(log, v_s)


def friction_regressor(v: Float[Array, " nv"], a: Float[Array, " nv"], terms, v_s) -> Float[Array, "nv terms_nv"]:
    """Regressor of friction and rotors, (nv, nv * len(terms)): one diagonal block per term, in the order of `terms`."""
    # tanh instead of the sign: a step at zero velocity would have no derivative, and adaptive steps shrink there.
    columns = {"viscous": v, "coulomb": jnp.tanh(v / v_s), "offset": jnp.ones_like(v), "armature": a}
    blocks = [jnp.diag(columns[term]) for term in terms]
    return jnp.concatenate(blocks, axis=1) if blocks else jnp.zeros((v.shape[0], 0), v.dtype)


def check_terms(terms: Terms, v_s: Number) -> tuple[str, ...]:
    """Check terms, and return a tuple. **Raises:** ValueError for an unknown or repeated term, or a v_s that is not positive."""
    if not isinstance(terms, (str, Sequence, Set)):
        raise ValueError(f"terms is {terms!r}; give some of {TERMS}, each once")
    terms = (terms,) if isinstance(terms, str) else tuple(terms)
    unknown = [term for term in terms if term not in TERMS]
    if unknown or len(set(terms)) < len(terms):
        raise ValueError(f"terms is {terms}; give some of {TERMS}, each once")
    as_number(v_s, "v_s", "rad/s or m/s, such as 0.01")
    return terms


# Displacement over which pre-sliding friction reverses (rad, m).
PRESLIDING = 0.003


class TorqueTerm(eqx.Module):
    r"""Torque that is linear in coefficients of each joint.

    $$\tau_j = \sum_k \mathrm{columns}_{jk} \mathrm{coefficients}_{kj}$$

    in each sample.

    - `name`: as in reports.
    - `columns(log, load, v_s)`: (n, nv, k) or (n, nv), from a log, the torque (n, nv) that the rigid bodies need along it
      (N m, N) and the smoothing velocity. A column may depend on earlier samples of the same log.
    - `needs_load`: whether it uses `load`, which is a zero array otherwise.
    - `is_smooth`: whether the log's low-pass leaves it unchanged. Other terms are evaluated at eight times the samples and then
      low-passed like the measured torque.
    """

    name: str = eqx.field(static=True)
    columns: Callable[[Log, np.ndarray, float], np.ndarray] = eqx.field(static=True)
    needs_load: bool = eqx.field(static=True, default=False)
    is_smooth: bool = eqx.field(static=True, default=False)

    def __call__(self, log: Log, load: np.ndarray, v_s: float) -> np.ndarray:
        """The columns (n, nv, k). **Raises:** ValueError for columns of another shape, or not finite."""
        value = np.asarray(self.columns(log, load, v_s), np.float64)
        value = value[:, :, None] if value.ndim == 2 else value
        if value.ndim != 3 or value.shape[:2] != (len(log), log.nv) or not np.isfinite(value).all():
            raise ValueError(
                f"term {self.name!r} gave an array of shape {value.shape} for {len(log)} samples of {log.nv} torques; it "
                "must be (n, nv) or (n, nv, k), of finite numbers"
            )
        return value


def coulomb_column(log: Log, v_s: float) -> np.ndarray:
    """Column tanh(v / v_s), (n, nv)."""
    return np.tanh(np.asarray(log.v, np.float64) / v_s)


def coulomb_through_filter(log: Log, v_s: float) -> np.ndarray:
    """Column tanh(v / v_s), (n, nv), low-passed like the log."""
    fine, factor = samples_for_jumps(log)
    return filter_like_log(log, coulomb_column(fine, v_s), factor=factor)


def _load(log, load, v_s):
    return np.abs(load) * coulomb_column(log, v_s)


def _asymmetric(log, load, v_s):
    return np.abs(np.asarray(log.v))


def _quadratic(log, load, v_s):
    v = np.asarray(log.v)
    return v * np.abs(v)


def _spring(log, load, v_s):
    q = _angles(log, "spring")
    # Both functions, so that the unknown angle of rest stays linear in the coefficients.
    return np.stack([np.sin(q), np.cos(q)], axis=2)


def _dahl(log, load, v_s):
    q = _angles(log, "dahl")
    z = np.empty_like(q)
    # The state before the log is unknown: friction starts fully developed in the direction of motion.
    z[0] = np.tanh(np.asarray(log.v)[0] / v_s)
    for i in range(1, len(q)):
        path = q[i] - q[i - 1]
        # Exact solution of dz/dt = |v| (sign v - z) / z0 for a displacement in one direction.
        z[i] = np.sign(path) + (z[i - 1] - np.sign(path)) * np.exp(-np.abs(path) / PRESLIDING)
    return z


def _angles(log: Log, name: str) -> np.ndarray:
    q = np.asarray(log.q, np.float64)
    if q.shape[1] != log.nv:
        raise ValueError(
            f"term {name!r} needs joints with one coordinate each; the log has {q.shape[1]} columns of q, {log.nv} of tau"
        )
    return q


EXTRA = {
    "load": TorqueTerm("load", _load, needs_load=True),
    "dahl": TorqueTerm("dahl", _dahl),
    "asymmetric": TorqueTerm("asymmetric", _asymmetric),
    "quadratic": TorqueTerm("quadratic", _quadratic),
    "spring": TorqueTerm("spring", _spring),
}


def candidates(model: Model) -> tuple[TorqueTerm, ...]:
    """Terms of `EXTRA` that a model may have: pre-sliding and springs need one angle for each torque."""
    return tuple(term for term in EXTRA.values() if model.nq == model.nv or term.name not in ("spring", "dahl"))


if TYPE_CHECKING:
    Term = str | TorqueTerm
    RobotTerms = Term | Sequence[Term | tuple[Term, Iterable[int]]]  # names of `TERMS` and `EXTRA`, and terms
else:
    RobotTerms = Any  # checked by `split_terms`


def split_terms(
    terms: RobotTerms, nv: int
) -> tuple[tuple[str, ...], tuple[TorqueTerm, ...], tuple[tuple[str, tuple[int, ...]], ...]]:
    """Split terms into names of `TERMS`, `TorqueTerm`s, and the name and the torque indices of each `TorqueTerm`.

    `terms` are names of `TERMS` and `EXTRA`, and `TorqueTerm`s, in any order. A pair (extra term, indices) limits the term to
    these torques.

    **Raises:** ValueError for an unknown or a repeated term, and for indices of no torque.
    """
    given = (terms,) if isinstance(terms, str | TorqueTerm) else tuple(terms)
    basic = tuple(term for term in given if isinstance(term, str) and term in TERMS)
    extra, where = [], []
    for item in given:
        if isinstance(item, str) and item in TERMS:
            continue
        term, joints = item if isinstance(item, tuple) else (item, range(nv))
        if isinstance(term, str) and term in EXTRA:
            term = EXTRA[term]
        if not isinstance(term, TorqueTerm):
            known = ", ".join((*TERMS, *EXTRA))
            raise ValueError(f"term {term!r} is unknown; give some of {known}, or a jd.identify.TorqueTerm")
        joints = tuple(sorted({int(joint) for joint in joints}))
        if not joints or not 0 <= joints[0] <= joints[-1] < nv:
            raise ValueError(f"term {term.name!r} is for torques {joints}; there are {nv}, from 0 to {nv - 1}")
        extra.append(term)
        where.append((term.name, joints))
    names = [*basic, *(term.name for term in extra)]
    if len(set(names)) < len(names):
        raise ValueError(f"terms are {', '.join(names)}; each may be given once")
    # The names alone are checked here, so that any positive v_s will do.
    return check_terms(basic, 1.0), tuple(extra), tuple(where)


def term_columns(terms: Sequence[TorqueTerm], log: Log, load: np.ndarray, v_s: float) -> np.ndarray:
    """Columns of all terms (n, nv, k) side by side, low-passed like the log."""
    fine, factor = (log, 1) if all(term.is_smooth for term in terms) else samples_for_jumps(log)
    # The load is known at the log's own samples only.
    fine_load = load if factor == 1 else refine_samples(load, factor)
    parts = [
        term(log, load, v_s) if term.is_smooth else filter_like_log(log, term(fine, fine_load, v_s), factor=factor)
        for term in terms
    ]
    # The empty part gives the shape where there are no terms.
    return np.concatenate([np.zeros((len(log), log.nv, 0)), *parts], axis=2)


class ExtraTorque(eqx.Module):
    """Fitted `TorqueTerm`s: `coefficients` (k, nv), rows in the order of the terms' columns, `counts` of each term."""

    terms: tuple[TorqueTerm, ...]
    counts: tuple[int, ...] = eqx.field(static=True)
    coefficients: np.ndarray
    v_s: float

    @property
    def needs_load(self) -> bool:
        """True where a term depends on the torque of the rigid bodies."""
        return any(term.needs_load for term in self.terms)

    def torque(self, log: Log, load: np.ndarray) -> np.ndarray:
        """Torque (n, nv) of all terms along a log, with the rigid bodies' torque `load` (n, nv) (N m, N)."""
        columns = term_columns(self.terms, log, load, self.v_s)
        return np.einsum("ijk,kj->ij", columns, self.coefficients)

    @property
    def named(self) -> dict[str, list]:
        """Deprecated name of `by_term`."""
        warn("ExtraTorque.named is deprecated; read by_term", DeprecationWarning)
        return self.by_term

    @property
    def by_term(self) -> dict[str, list]:
        """Coefficients of each term: one list of nv numbers, or k of them."""
        edges = np.cumsum((0, *self.counts))
        parts = [self.coefficients[a:b] for a, b in itertools.pairwise(edges)]
        return {
            term.name: (part[0] if len(part) == 1 else part).tolist()
            for term, part in zip(self.terms, parts, strict=True)
        }
