"""Joint torques beyond viscous and Coulomb friction: columns of the regressor, each with a coefficient for every joint.

    load        |tau_rigid| tanh(v / v_s)   Coulomb friction in proportion to the torque that the gear carries
    dahl        z, dz/dq = (sign v - z) / z0   pre-sliding: friction that needs a way of about z0 to turn round
    asymmetric  |v|                         viscous friction that differs between the directions
    quadratic   v |v|                       friction that grows faster than the velocity
    spring      sin q and cos q             springs and counterbalances between a link and the one before

Source: Dahl (1968), "A solid friction model"; Hamon, Gautier & Garrec (2010), load-dependent friction of geared joints.
"""

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from jaxdyn.identify.friction import TERMS, check_terms
from jaxdyn.identify.logs import Log, as_measured

# The way in which pre-sliding friction turns round (rad, m).
PRESLIDING = 0.003


class TorqueTerm(eqx.Module):
    """A torque that is linear in numbers of each joint: tau_j = sum over k of columns[:, j, k] coefficients[k, j].

    - `name`: as in reports.
    - `columns(log, load, v_s)`: (n, nv, k) or (n, nv), from a log, the torque (n, nv) that the rigid bodies need along it
      (N m, N) and the smoothing velocity. It may look at samples before, but belongs to one log.
    - `needs_load`: whether it uses `load`, which is a zero array otherwise.
    """

    name: str = eqx.field(static=True)
    columns: Callable[[Log, np.ndarray, float], np.ndarray] = eqx.field(static=True)
    needs_load: bool = eqx.field(static=True, default=False)

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
    """tanh(v / v_s), (n, nv)."""
    return np.tanh(np.asarray(log.v, np.float64) / v_s)


def _load(log, load, v_s):
    return np.abs(load) * coulomb_column(log, v_s)


def _asymmetric(log, load, v_s):
    return np.abs(np.asarray(log.v))


def _quadratic(log, load, v_s):
    v = np.asarray(log.v)
    return v * np.abs(v)


def _spring(log, load, v_s):
    q = _angles(log, "spring")
    return np.stack([np.sin(q), np.cos(q)], axis=2)


def _dahl(log, load, v_s):
    q = _angles(log, "dahl")
    z = np.empty_like(q)
    z[0] = np.tanh(np.asarray(log.v)[0] / v_s)
    for i in range(1, len(q)):
        path = q[i] - q[i - 1]
        # The solution along a way in one direction.
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


if TYPE_CHECKING:
    Term = str | TorqueTerm
    RobotTerms = Term | Sequence[Term | tuple[Term, Iterable[int]]]  # names of `TERMS` and `EXTRA`, and terms
else:
    RobotTerms = Any  # `split_terms` looks at them


def split_terms(
    terms: RobotTerms, nv: int
) -> tuple[tuple[str, ...], tuple[TorqueTerm, ...], tuple[tuple[str, tuple[int, ...]], ...]]:
    """Names of `TERMS`; `TorqueTerm`s; and (name, numbers of the torques that have it) of these.

    `terms` are names of `TERMS` and of `EXTRA` and `TorqueTerm`s, in any order; or pairs of such an extra term and the numbers
    of the torques that have it, instead of all.

    **Raises:** ValueError for an unknown or a repeated term, and for numbers that are none of a torque.
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
            raise ValueError(f"term {term!r} is unknown; take some of {known}, or a jd.identify.TorqueTerm")
        joints = tuple(sorted({int(joint) for joint in joints}))
        if not joints or not 0 <= joints[0] <= joints[-1] < nv:
            raise ValueError(f"term {term.name!r} is for torques {joints}; there are {nv}, from 0 to {nv - 1}")
        extra.append(term)
        where.append((term.name, joints))
    names = [*basic, *(term.name for term in extra)]
    if len(set(names)) < len(names):
        raise ValueError(f"terms are {', '.join(names)}; each may be given once")
    return check_terms(basic, 1.0), tuple(extra), tuple(where)


def term_columns(terms: Sequence[TorqueTerm], log: Log, load: np.ndarray, v_s: float) -> np.ndarray:
    """Columns of all terms (n, nv, k) side by side."""
    parts = [term(log, load, v_s) for term in terms]
    return np.concatenate([np.zeros((len(log), log.nv, 0)), *parts], axis=2)


class ExtraTorque(eqx.Module):
    """Fitted `TorqueTerm`s: `coefficients` (k, nv), rows in the order of the terms' columns, `counts` of each term."""

    terms: tuple[TorqueTerm, ...]
    counts: tuple[int, ...] = eqx.field(static=True)
    coefficients: np.ndarray
    v_s: float

    @property
    def needs_load(self) -> bool:
        """Whether a term looks at the torque of the rigid bodies."""
        return any(term.needs_load for term in self.terms)

    def torque(self, log: Log, load: np.ndarray) -> np.ndarray:
        """Torque (n, nv) of all terms along a log, with the rigid bodies' torque `load` (n, nv) (N m, N)."""
        columns = as_measured(log, term_columns(self.terms, log, load, self.v_s))
        return np.einsum("ijk,kj->ij", columns, self.coefficients)

    @property
    def named(self) -> dict[str, list]:
        """Coefficients of each term: one list of nv numbers, or k of them."""
        edges = np.cumsum((0, *self.counts))
        parts = [self.coefficients[a:b] for a, b in itertools.pairwise(edges)]
        return {
            term.name: (part[0] if len(part) == 1 else part).tolist()
            for term, part in zip(self.terms, parts, strict=True)
        }
