"""Motions by other tools, as contestants of a report: each in a module of its own, each left out where it is not installed.

| module | tool | what it integrates with |
|---|---|---|
| `symbolic` | equations by hand, SymPy, NumPy | SciPy's compiled DOP853 and LSODA; RK4 on arrays for a batch |
| `compiled` | equations by hand, CasADi | SUNDIALS' CVODES; Dopri8 and RK4 in C, with OpenMP for a batch |
| `with_mujoco` | MuJoCo | its own integrators in C, in threads for a batch |
| `with_pinocchio` | Pinocchio | SciPy's compiled DOP853; RK4 from Python, in threads for a batch |
| `with_mjx` | MuJoCo MJX | its own integrators, in JAX |
| `with_pydy` | PyDy: Kane's equations | SciPy's compiled DOP853 |

Each runs in coordinates of its own, and its states are put into those of the scene before they are compared. MuJoCo has no
rows for rolling (a contact with friction is another model) and no points on axles that move with time.
"""

import importlib
import time
from collections.abc import Callable, Sequence

from jaxdyn.reports.run import Contestant

MODULES = ("symbolic", "compiled", "with_mujoco", "with_pinocchio", "with_mjx", "with_pydy")
# Peers that take equations and run them from start to end in compiled code, by the beginning of their source.
COMPILED = ("C,", "CasADi")

# Seconds.
LONGEST = 4.0


class Peers:
    """`peers(prepared, dtype, starts)` of a report, from those of `modules` that can be imported.

    `say` takes a line for each that cannot, and for each ladder that is cut short.
    """

    def __init__(self, say: Callable[[str], object] = print, modules: Sequence[str] = MODULES):
        self.say, self.modules = say, []
        for name in modules:
            try:
                self.modules.append(importlib.import_module(f"benchmarks.peers.{name}"))
            except ImportError as error:
                say(f"without the peer {name}: {error}")

    def __call__(self, prepared, dtype: str, starts) -> list[Contestant]:
        """Rungs of all peers that can do the scene; none in float32."""
        if dtype != "float64":
            return []
        ladders: dict[tuple, list[Contestant]] = {}
        for module in self.modules:
            for rung in module.contestants(prepared, starts):
                ladders.setdefault((rung.source, rung.solver), []).append(rung)
        return [rung for ladder in ladders.values() for rung in self._affordable(ladder)]

    def _affordable(self, ladder: list[Contestant]) -> list[Contestant]:
        """The coarsest rung, and finer ones that take less than LONGEST, going by the time of the coarsest."""
        first = ladder[0]
        first.call()  # what it does but once
        began = time.perf_counter()
        first.call()
        passed = time.perf_counter() - began
        kept = [rung for rung in ladder if rung is first or passed * _work(first) / _work(rung) < LONGEST]
        if len(kept) < len(ladder):
            self.say(f"{first.source}, {first.solver}: {len(ladder) - len(kept)} finer rungs take too long")
        return kept


def _work(rung: Contestant) -> float:
    """What the time of a rung goes with, turned over: its step, or the step that its tolerance leads to at order 8."""
    return rung.setting if rung.fixed else rung.setting ** (1 / 8)
