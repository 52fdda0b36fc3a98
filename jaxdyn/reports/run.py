"""Runs of a report: selection and measurement, scene by scene."""

import datetime
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxdyn.reports.measurement import Contestant, ladder, machine, measure
from jaxdyn.reports.page import Record, Report, SceneReference, write
from jaxdyn.reports.plotting import new_figure
from jaxdyn.reports.programs import FIXED, SOLVERS, Case, Prepared, case_of_scene, prepare
from jaxdyn.simulation.checks import choose_method

# Contestants of other libraries for a scene, a dtype and starts (q, v, ts); see `Contestant`.
Peers = Callable[[Prepared, str, tuple], Sequence[Contestant]]


def combinations(case: Case, constrained: bool) -> list[tuple[str, str]]:
    """Usual pairs of methods and solvers for a scene."""
    solvers = ["Dopri8", "Tsit5", "RK4", *(["Rodas5P", "Kvaerno5"] if case.stiff else [])]
    if not constrained:
        return [("free", solver) for solver in solvers]
    other = "reduced" if case.reduces else "multipliers"
    return [*(("projected", solver) for solver in solvers), (other, "Dopri8")]


def settings(case: Case, solver: str, dtype: str) -> list[float]:
    """Tolerances, or steps (s), from the coarsest to the finest."""
    single = dtype == "float32"
    if solver in FIXED:
        return [float(np.ptp(case.ts)) / case.steps / 2**k for k in ((0, 2) if single else (0, 2, 4))]
    # float32 has about seven digits, and smaller tolerances would never be met.
    return [10.0**-k for k in ((2, 4, 6) if single else (4, 6, 8, 11))]


def report(
    scenes: str | Case | Iterable[str | Case],
    *,
    dtypes: Sequence[str] = ("float64",),
    batches: Sequence[int] = (1,),
    integrators: Sequence[Sequence[str]] | None = None,
    rounds: int = 20,
    out: str | Path | None = None,
    peers: Peers | None = None,
    echo: Callable[[str], object] | None = None,
) -> Report:
    """Measure error against run time of scenes with every sensible method and solver.

    Tolerances and steps are traced, so a ladder shares one compiled program. All runs of one scene, dtype and batch are
    timed interleaved; compilation is separate. float64 must be enabled, for the references.

    **Arguments:**

    - `scenes`: names of `jd.scenes`, from their default starts for one second against their closed form, or else a
      converged solution; and your own, each a `jaxdyn.reports.Case` with its start, its times, and its motion where it is known.
    - `dtypes`: of "float64" and "float32"; `batches`: numbers of trajectories at once.
    - `integrators`: pairs of a method and a solver instead of the usual ones.
    - `rounds`: timings of each run, at least 20 for a figure to be quoted.
    - `out`: directory for report.json, report.txt and report.html.
    - `peers(prepared, dtype, starts)` -> contestants that are timed in the same loop; see `jaxdyn.reports.measurement.measure`.
    - `echo`: receives lines of progress, e.g. `print`.

    **Returns:** a `Report`; `print(report.table())`; `jaxdyn.reports.write(report, directory)` writes its page.

    **Raises:** ValueError for an unknown name, an invalid dtype, batch or integrator, and float64 that is not enabled;
    ImportError for `out` without matplotlib.

    ```python
    quick = jd.report("pendulum_in_plane")
    ```
    """
    # Before anything is measured, since a report may run for hours.
    chosen = _check_arguments(scenes, dtypes, batches, integrators, rounds)
    if out is not None:
        new_figure(1.0, 1.0)  # fails now without matplotlib
        Path(out).mkdir(parents=True, exist_ok=True)
    say = echo or (lambda line: None)
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    head = {"machine": machine(), "date": now}
    known, records, began = {}, [], time.perf_counter()
    groups = [(case, dtype, batch) for case in chosen for dtype in dtypes for batch in batches]
    prepared = None
    for done, (case, dtype, batch) in enumerate(groups, 1):
        # Groups of a case follow each other, so that its scene and reference are made once.
        if prepared is None or prepared.case is not case:
            prepared = prepare(case)
            reference = prepared.reference
            known[case.name] = SceneReference(prepared.case.text, reference.kind, reference.source, reference.error)
        runs = _group(prepared, dtype, batch, integrators, rounds, peers)
        records += runs
        passed = time.perf_counter() - began
        left = passed / done * (len(groups) - done)
        say(
            f"{done}/{len(groups)} {case.name}, {dtype}, batch {batch}: {len(runs)} runs; {passed:.0f} s, about {left:.0f} s left"
        )
    result = Report(head, known, tuple(records))
    if out is not None:
        write(result, out)
    return result


def _group(prepared: Prepared, dtype, batch, integrators, rounds, peers) -> list[Record]:
    """Records of one scene, dtype and number of trajectories, timed in one loop."""
    case, starts = prepared.case, prepared.programs.batch_starts(batch)
    pairs = integrators or combinations(case, bool(prepared.scene.constraints))
    contestants = [
        rung
        for method, solver in pairs
        for rung in ladder(prepared, method, solver, settings(case, solver, dtype), dtype, starts)
    ]
    if peers is not None:
        # In the same loop, so that drifts of the machine's speed affect all alike.
        contestants += peers(prepared, dtype, starts)
    return measure(prepared, contestants, dtype, batch, rounds)


def _check_arguments(scenes, dtypes, batches, integrators, rounds) -> list[Case]:
    """Check the arguments of `report` and return its cases."""
    given = (scenes,) if isinstance(scenes, str | Case) else tuple(scenes)
    names = [case.name if isinstance(case, Case) else case for case in given]
    for argument, values in (("scenes", names), ("dtypes", dtypes), ("batches", batches), ("integrators", integrators)):
        if values is not None and len(values) == 0:
            raise ValueError(f"{argument} is empty; omit it for the defaults")
    for dtype in dtypes:
        if dtype not in ("float64", "float32"):
            raise ValueError(f"dtypes has {dtype!r}; choose from float64, float32")
    for pair in integrators or ():
        if not isinstance(pair, tuple | list) or len(pair) != 2 or pair[1] not in SOLVERS:
            raise ValueError(
                f'integrators has {pair!r}; give pairs such as ("projected", "Dopri8"), solvers: {", ".join(SOLVERS)}'
            )
    for batch in batches:
        if isinstance(batch, bool) or not isinstance(batch, int) or batch < 1:
            raise ValueError(f"batches has {batch!r}; give positive integers")
    # True is an int to Python.
    if isinstance(rounds, bool) or not isinstance(rounds, int) or rounds < 1:
        raise ValueError(f"rounds is {rounds!r}; give a positive integer")
    if jnp.zeros(()).dtype != jnp.float64:
        raise ValueError('a report needs float64; call jax.config.update("jax_enable_x64", True) first')
    # Records are kept by the scene's name, so that equal names would be mixed up.
    if len(set(names)) < len(names):
        raise ValueError(f"scenes have the names {', '.join(names)}; give each its own")
    chosen = [case if isinstance(case, Case) else case_of_scene(case) for case in given]
    for case in chosen if integrators else ():
        scene, _ = case.build()
        for method in dict(integrators or ()):
            try:
                choose_method(scene, method)
            except ValueError as error:
                raise ValueError(f"integrators has {method!r}, which {case.name} does not support: {error}") from None
    return chosen
