"""Identifiability of parameters from logs: rank, condition and the least identifiable directions."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.regression import BaseParameters, base_parameters, condense, free_columns
from jaxdyn.identify.torque_terms import TERMS, Terms
from jaxdyn.model.tree import Model

# Most parameters named of a direction, and the smallest component that is named.
_NAMED, _SHARE = 4, 0.15


class Direction(NamedTuple):
    """Combination of base parameters: its singular value over the largest one, and a text of its largest components."""

    strength: float
    words: str


class Identifiability(NamedTuple):
    """Identifiability of a robot's parameters from logs.

    - `base`: the identifiable combinations on any motion. `rank`: the number of them that these logs excite.
    - `condition`: of the regressor in them, columns of unit length, over the directions that are excited.
    - `weakest`: the least identifiable directions, the weakest first; those not excited at all have strength 0.
    - `silent`: base parameters that the logs do not determine. `unidentifiable`: parameters that no motion determines.
    """

    base: BaseParameters
    rank: int
    condition: float
    weakest: list[Direction]
    silent: tuple[str, ...]
    unidentifiable: tuple[str, ...]

    def summary(self) -> str:
        """Text of the result."""
        lines = [
            f"the logs excite {self.rank} of {len(self.base)} identifiable combinations, condition "
            f"{self.condition:.4g}"
            + (" (well above 100: weak directions follow the prior)" if self.condition > 300 else "")
        ]
        if self.silent:
            lines.append(f"not excited by these logs: {', '.join(self.silent)}")
        for d in self.weakest:
            if d.strength > 0:
                lines.append(f"least identifiable direction, relative singular value {d.strength:.2g}: {d.words}")
        if self.unidentifiable:
            lines.append(f"unidentifiable on any motion, the file's values stay: {', '.join(self.unidentifiable)}")
        return "\n".join(lines)


def identifiability(
    model: Model,
    log: Log | Sequence[Log],
    terms: Terms = TERMS,
    *,
    v_s: float = 0.01,
    rcond: float = 1e-6,
    count: int = 3,
) -> Identifiability:
    """Identifiability of the bodies and the terms of a model from the motions of logs; their torques do not matter.

    **Arguments:** as `least_squares`; `count`: number of the weakest directions to name.

    **Returns:** `Identifiability`.

    **Raises:** ValueError as `least_squares`.

    Source: Gautier & Khalil (1992), "Exciting trajectories for the identification of base inertial parameters of robots".
    """
    logs = as_logs(log, model)
    base = base_parameters(model, terms, v_s=v_s)
    # These columns are independent on a general motion, so that any loss of rank is due to the logs.
    columns = free_columns(model.nb, model.nv, base_terms(terms))[base.independent]
    A = condense(model, logs, v_s=v_s).R[:, columns]
    scale = np.linalg.norm(A, axis=0)
    # Columns that the logs do not excite become zero; scaled to unit length, their rounding errors would count as excited.
    scale[scale <= 1e-12 * scale.max(initial=0.0)] = np.inf
    _, s, Vt = np.linalg.svd(A / scale, full_matrices=False)
    rank = int(np.sum(s > rcond * s.max(initial=0.0)))
    # A parameter with any share in the null space is not determined, whatever its other components.
    unknown = np.sum(Vt[rank:] ** 2, axis=0) > 1e-12
    # Singular values descend: the last ones are the weakest directions.
    order = range(len(s) - 1, max(len(s) - 1 - count, -1), -1)
    weakest = [Direction(float(s[i] / s[0]) if i < rank else 0.0, _words(Vt[i], base.names)) for i in order]
    silent = tuple(name for name, is_unknown in zip(base.names, unknown, strict=True) if is_unknown)
    condition = float(s[0] / s[rank - 1]) if rank else np.inf
    return Identifiability(base, rank, condition, weakest, silent, base.unidentifiable)


def base_terms(terms) -> tuple[str, ...]:
    """Terms that are in `TERMS`."""
    return tuple(term for term in ((terms,) if isinstance(terms, str) else terms) if term in TERMS)


def _words(direction: np.ndarray, names: Sequence[str]) -> str:
    order = [i for i in np.argsort(-np.abs(direction))[:_NAMED] if abs(direction[i]) > _SHARE]
    # The sign of a singular vector is arbitrary: the largest component is written as positive.
    signs = np.sign(direction[order[0]]) if order else 1.0
    parts = [f"{signs * direction[i]:+.2f} {names[i]}" for i in order]
    return " ".join(parts).removeprefix("+") + (" ..." if np.sum(direction[order] ** 2) < 0.9 else "")
