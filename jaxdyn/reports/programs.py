"""Cases of a report and what is prepared of them: compiled simulations, the reference motion, errors relative to it."""

import inspect
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn import scenes
from jaxdyn.constraints.assembly import residuals
from jaxdyn.contact.unilateral import has_modes
from jaxdyn.dynamics.centroidal import kinetic_energy, potential_energy
from jaxdyn.lie.so3 import quat_to_matrix
from jaxdyn.model.tree import Model
from jaxdyn.reports.references import CLOSED_FORMS
from jaxdyn.reports.references import Reference as Reference
from jaxdyn.simulation.checks import choose_method
from jaxdyn.simulation.events import ContactLost
from jaxdyn.simulation.options import Steps
from jaxdyn.simulation.run import simulate
from jaxdyn.simulation.solvers import RK4, Rodas5P
from jaxdyn.systems.scene import Scene


class Case(NamedTuple):
    """Scene of the report with its measurements.

      - `name`, `text`: name and description.
      - `build()` -> (scene, (q0, v0)); `reference(start)` -> `Reference`, or None where a
    converged solution at `ts` is the reference.
      - `steps`: fixed steps of the coarsest run; `conserves`: whether the energy is constant; `stiff`.
      - `reduces`: whether the method "reduced" finds the scene's degrees of freedom.
    """

    name: str
    text: str
    build: Callable[[], tuple[Scene, tuple]]
    reference: Callable[[Any], Reference] | None
    ts: np.ndarray
    steps: int
    conserves: bool = True
    stiff: bool = False
    reduces: bool = True


def case_of_scene(name: str) -> Case:
    """Case of a scene of `jd.scenes`: its default start, one second, and its closed form, or else a converged solution.

    **Raises:** ValueError for other names, and for scenes with forces that have modes, whose steps end at events.
    """
    if name not in scenes.names():
        raise ValueError(
            f"scenes has {name!r}, which is no scene of jd.scenes: choose from {', '.join(scenes.names())}; for a scene of your "
            "own, as of a file, pass a jaxdyn.reports.Case to jd.report"
        )
    if has_modes(getattr(scenes, name)()):
        raise ValueError(f"scenes has {name!r}, whose steps end at events; a report compares steps of given lengths")
    scene = getattr(scenes, name)
    # The first line of a scene's docstring describes it.
    text = (inspect.getdoc(scene) or name).partition("\n")[0]
    # The energy of an arbitrary scene need not be constant, so its error is not reported.
    build = lambda: (scene(), tuple(np.asarray(x) for x in scene.start()))  # noqa: E731
    ts, known = np.linspace(0.0, 1.0, 11), CLOSED_FORMS.get(name)
    reference = None if known is None else lambda start: known(ts)
    return Case(name, text, build, reference, ts, 250, conserves=False)


# Solvers by name; those in FIXED run with fixed steps.
SOLVERS: dict[str, Callable[[], diffrax.AbstractSolver]] = {
    "Dopri8": diffrax.Dopri8,
    "Dopri5": diffrax.Dopri5,
    "Tsit5": diffrax.Tsit5,
    "Kvaerno3": diffrax.Kvaerno3,
    "Kvaerno5": diffrax.Kvaerno5,
    "Rodas5P": Rodas5P,
    "RK4": RK4,
}
FIXED = frozenset({"RK4"})
MAX_STEPS = 2**17
# Fraction of the time span over which the starts of a batch are spread along the motion.
SPREAD = 0.1


class Program(NamedTuple):
    """Compiled simulation: `run(q, v, ts, setting)` -> (q, v, result, stats), each with a leading axis if `batch` > 1."""

    run: Callable
    seconds: float


class Programs:
    """Compiled simulations of a scene, cached; start, times and tolerance or step are arguments."""

    def __init__(self, scene: Scene, start, ts):
        self.scene, self.start, self.ts = scene, start, ts
        self._cache: dict[tuple, Program] = {}

    def get(self, method: str, solver: str, dtype: str = "float64", batch: int = 1) -> Program:
        """Program for a method, a solver, a dtype and a number of trajectories, compiled once."""
        # The resolved name, so that "auto" and the method it chooses share one program.
        key = (choose_method(self.scene, method).name, solver, dtype, batch)
        if key not in self._cache:
            self._cache[key] = self._compile(*key)
        return self._cache[key]

    def _compile(self, method, solver, dtype, batch) -> Program:
        # Integer leaves are indices and keep their type.
        scene = jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, self.scene)

        def one(q, v, ts, setting):
            # The setting is an argument of the program: a ladder of tolerances compiles once.
            size, tolerance = (setting, None) if solver in FIXED else (None, setting)
            steps = Steps(size, rtol=tolerance, atol=tolerance, max_steps=MAX_STEPS)
            # Only the integration is measured: contacts that pull are reported and do not end it.
            options = {"method": method, "solver": SOLVERS[solver](), "stepsize": steps, "throw": False}
            options["events"] = () if scene.cones is None else (ContactLost(stop=False),)
            solution = simulate(scene, q, v, ts, **options)
            return solution.q, solution.v, solution.result, solution.stats

        several = one if batch == 1 else jax.vmap(one, (0, 0, 0, None))
        sizes = () if batch == 1 else (batch,)
        shapes = [jax.ShapeDtypeStruct((*sizes, len(x)), dtype) for x in (*self.start, self.ts)]
        began = time.perf_counter()
        # Compiled ahead of time, so that the time of compilation is measured apart from the run.
        run = jax.jit(several).lower(*shapes, jax.ShapeDtypeStruct((), dtype)).compile()
        return Program(run, time.perf_counter() - began)

    def solve(self, method: str, solver: str, tolerance: float, start=None, ts=None) -> tuple[np.ndarray, np.ndarray]:
        """Simulate one motion in float64: q (nt, nq) and v (nt, nv); NaN in rows that were not reached."""
        inputs = *(self.start if start is None else start), self.ts if ts is None else ts, tolerance
        q, v, _, _ = self.get(method, solver).run(*(jnp.asarray(x, float) for x in inputs))
        return np.asarray(q), np.asarray(v)

    def batch_starts(self, batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Starts q (batch, nq), v (batch, nv) and times (batch, nt): states along the first tenth of the motion.

        All are on the constraints, and no two trajectories take the same steps; the first is the reference's.

        **Raises:** RuntimeError when the motion through them stops early.
        """
        ts, (q, v) = self.ts, self.start
        delays = SPREAD * (ts[-1] - ts[0]) * np.arange(batch) / batch
        states, ahead = [(q, v)], len(ts) - 1
        # The times of one program have a fixed length, so long batches are reached in several runs.
        while len(states) < batch:
            first = len(states) - 1
            times = ts[0] + SPREAD * (ts[-1] - ts[0]) * np.arange(first, first + ahead + 1) / batch
            solutions = self.solve("auto", "Dopri8", 1e-12, states[-1], times)
            if not all(np.isfinite(x).all() for x in solutions):
                raise RuntimeError("no starts for a batch: a simulation at tolerances of 1e-12 stopped early")
            states += [*zip(*(x[1:] for x in solutions), strict=True)]
        # The last run may give more states than the batch needs.
        q, v = (np.stack(x) for x in zip(*states[:batch], strict=True))
        return q, v, ts + delays[:, None]


class Prepared(NamedTuple):
    """Case with its scene built and its reference motion.

    `values(q, v)` -> observables (nt, n), energy (nt,) and residuals (nt, 2) of a motion, in float64.
    """

    case: Case
    scene: Scene
    reference: Reference
    programs: Programs
    values: Callable[[Any, Any], list[np.ndarray]]

    def errors(self, q, v) -> np.ndarray:
        """Error of a motion q (nt, nq), v (nt, nv) in each row, (nt,): see `largest_error`."""
        return largest_error(self.values(q, v)[0], self.values(self.reference.q, self.reference.v)[0])


def prepare(case: Case) -> Prepared:
    """Build the scene and its reference.

    **Raises:** RuntimeError when a solution of our own is the reference and cannot be computed.
    """
    scene, start = case.build()
    known = None if case.reference is None else case.reference(start)
    ts = case.ts if known is None else known.ts
    programs, numbers = Programs(scene, start, ts), jnp.asarray(ts, float)

    def row(q, v, t):
        energy = kinetic_energy(scene.system, q, v, t) + potential_energy(scene.system, q, t)
        return observables(scene, q, v), energy, residuals(scene, q, v, t) if scene.constraints else jnp.zeros(2)

    # All motions have the times of the reference, so one program evaluates each of them.
    compiled = jax.jit(jax.vmap(row))

    def values(q, v):
        return [np.asarray(x) for x in compiled(jnp.asarray(q, float), jnp.asarray(v, float), numbers)]

    # A known motion is preferred: a solution of our own shares our equations of motion.
    return Prepared(case, scene, known or compute_reference(programs, values, case.reduces), programs, values)


def observables(scene: Scene, q, v):
    """Compared quantities (n,): the entries of q, with rotation matrices for quaternions, and those of v."""
    # q and -q are the same rotation: quaternions themselves cannot be compared.
    parts = [q]
    if isinstance(scene.system, Model):
        parts = []
        for kind, place in zip(scene.system.topology.kinds, scene.system.topology.q_slices, strict=True):
            turning = kind in ("spherical", "free")
            parts += [q[place][:-4], quat_to_matrix(q[place][-4:]).reshape(-1)] if turning else [q[place]]
    return jnp.concatenate([*parts, v])


def largest_error(computed: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Largest error max |y - r|/(1 + |r|) over the columns of y (nt, n) and r (nt, n), (nt,).

    It is absolute for entries that are small and relative for large ones, as in the test set for IVP solvers.
    """
    return np.max(np.abs(computed - known) / (1 + np.abs(known)), 1)


def compute_reference(programs: Programs, values: Callable, reduces: bool = True) -> Reference:
    """Reference solution at tolerances of 1e-13, with its error estimated by another integrator.

    That is method "reduced" for a scene with constraints that `reduces`, another solver for others. The two
    share the equations of motion, so the estimate covers the integration only.

    **Raises:** RuntimeError when one of them stops early.
    """
    # Another method or solver makes other errors of integration on the same equations of motion.
    other = ("reduced", "Dopri8") if programs.scene.constraints and reduces else ("auto", "Tsit5")
    # Tolerances below 1e-13 are within the rounding of float64.
    fine, rough = (programs.solve(*pair, 1e-13) for pair in (("auto", "Dopri8"), other))
    error = float(largest_error(values(*rough)[0], values(*fine)[0]).max())
    if not np.isfinite(error):
        raise RuntimeError("no converged reference: a simulation at tolerances of 1e-13 stopped early; loosen them")
    return Reference(programs.ts, *fine, "converged", f"Dopri8 at 1e-13, compared with {', '.join(other)}", error)
