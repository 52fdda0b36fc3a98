"""Runs of a report: selection and measurement, scene by scene, resumable."""

import datetime
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxdyn.reports.case import Case, case_of_scene
from jaxdyn.reports.journal import Journal
from jaxdyn.reports.measurement import Contestant, flop_counter, ladder, measure
from jaxdyn.reports.page import write
from jaxdyn.reports.plotting import new_figure
from jaxdyn.reports.programs import FIXED, SOLVERS, Prepared, prepare
from jaxdyn.reports.records import Record, Report, SceneReference
from jaxdyn.reports.timing import commit, machine
from jaxdyn.simulation.checks import choose_method

# Contestants of other libraries for a scene, a dtype and starts (q, v, ts); see `Contestant`.
Peers = Callable[[Prepared, str, tuple], Sequence[Contestant]]


def combinations(case: Case, constrained: bool, *, full: bool, plain: bool = True) -> list[tuple[str, str]]:
    """Pairs of methods and solvers: the usual ones, or every sensible pair; `plain` is float64 and one trajectory."""
    stiff = ["Rodas5P", "Kvaerno5", "Kvaerno3"] if full else ["Rodas5P", "Kvaerno5"]
    implicit = stiff if case.stiff or (full and plain) else []
    explicit = ["Dopri8", "Tsit5", "RK4"]
    if not constrained:
        return [("free", solver) for solver in [*explicit, *(["Dopri5"] if full and plain else []), *implicit]]
    pairs = [("projected", solver) for solver in [*explicit, *implicit]]
    if not full:
        return [*pairs, ("reduced", "Dopri8")] if case.reduces else [*pairs, ("multipliers", "Dopri8")]
    others = ("reduced", "multipliers") if case.reduces else ("multipliers",)
    return pairs + [(method, solver) for method in others for solver in explicit]


def settings(case: Case, solver: str, dtype: str, *, full: bool) -> list[float]:
    """Tolerances, or steps (s), from the coarsest to the finest."""
    single = dtype == "float32"
    if solver in FIXED:
        doublings = (range(5) if single else range(7)) if full else ((0, 2) if single else (0, 2, 4))
        return [float(np.ptp(case.ts)) / case.steps / 2**k for k in doublings]
    # float32 has about seven digits, and smaller tolerances would never be met.
    digits = (range(2, 7) if single else range(3, 13)) if full else ((2, 4, 6) if single else (4, 6, 8, 11))
    return [10.0**-k for k in digits]


def report(
    scenes: str | Case | Iterable[str | Case],
    *,
    full: bool = False,
    dtypes: Sequence[str] | None = None,
    batches: Sequence[int] | None = None,
    integrators: Sequence[Sequence[str]] | None = None,
    rounds: int = 20,
    out: str | Path | None = None,
    peers: Peers | None = None,
    echo: Callable[[str], object] | None = None,
    ways: Sequence[Sequence[str]] | None = None,
) -> Report:
    """Measure error against run time of scenes with every sensible method and solver.

    Tolerances and steps are traced, so a ladder shares one compiled program. All runs of one scene, dtype and batch are
    timed interleaved; compilation is separate. float64 must be enabled, for the references.

    **Arguments:**

    - `scenes`: names of `jd.scenes`, from their default starts for one second against a converged solution; and your own, each a
      `jaxdyn.reports.Case` with its start, its times, and its motion where it is known.
    - `full`: many methods, solvers and tolerances, in float64 and float32, one trajectory and 256 at once; else a quick
      ladder of the usual ones in float64, one trajectory.
    - `dtypes`, `batches`: values instead of these. `integrators`: pairs of a method and a solver instead of these.
    - `rounds`: timings of each run, at least 20 for a figure to be quoted.
    - `out`: directory for report.json, report.txt and report.html, and for records.jsonl, from which an
      interrupted call resumes.
    - `peers(prepared, dtype, starts)` -> contestants that are timed in the same loop; see `jaxdyn.reports.measurement`.
    - `echo`: receives lines of progress, e.g. `print`.
    - `ways`: the former name of `integrators`.

    **Returns:** a `Report`; `print(report.table())`; `jaxdyn.reports.write(report, directory)` writes its page.

    **Raises:** ValueError for an unknown name, an invalid dtype, batch or integrator, nothing to measure, float64
    that is not enabled, and a directory with records of another commit, machine or set of versions; ImportError for `out`
    without matplotlib.

    ```python
    quick = jd.report("pendulum_in_plane")
    ```
    """
    if ways is not None:
        warnings.warn("`ways` of jd.report is deprecated; pass `integrators`", DeprecationWarning, stacklevel=2)
        integrators = ways
    # Before anything is measured, since a report runs for hours.
    chosen = _check_arguments(scenes, dtypes, batches, integrators, rounds)
    dtypes = dtypes or (("float64", "float32") if full else ("float64",))
    batches = batches or ((1, 256) if full else (1,))
    say = echo or (lambda line: None)
    groups = []
    for case in chosen:
        # Chosen integrators are run at any batch: the user knows what they cost.
        sizes = [batch for batch in batches if integrators or case.largest is None or batch <= case.largest]
        groups += [(case, dtype, batch) for dtype in dtypes for batch in sizes]
        if len(sizes) < len(batches):
            say(
                f"{case.name}: batches above {case.largest} are skipped, because they take minutes; choose "
                "`integrators` to run them"
            )
    if not groups:
        raise ValueError(
            f"batches {list(batches)} leave nothing to measure of {', '.join(case.name for case in chosen)}; choose "
            "`integrators`, or smaller batches"
        )
    if out is not None:
        new_figure(1.0, 1.0)  # fails now without matplotlib, and not after hours of runs
    head = {
        "machine": machine(),
        "commit": commit(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "full": full,
    }
    journal = Journal(None if out is None else Path(out), head)
    prepared, began = None, time.perf_counter()
    # Part of the key: another choice of integrators must not resume from these records.
    only = "".join(f", {method} {solver}" for method, solver in integrators or ()) + (", with peers" if peers else "")
    keys = [f"{case.name}, {dtype}, batch {batch}, {rounds} rounds{only}" for case, dtype, batch in groups]
    todo = [(key, *group) for key, group in zip(keys, groups, strict=True) if key not in journal]
    if len(todo) < len(groups):
        say(f"{len(groups) - len(todo)} of {len(groups)} are already finished, in {journal.path}")
    for done, (key, case, dtype, batch) in enumerate(todo, 1):
        # Groups of a case follow each other, so that its scene and reference are made once.
        if prepared is None or prepared.case is not case:
            prepared = prepare(case)
        records = _group(prepared, dtype, batch, integrators, full, rounds, peers)
        # Written after each group, from which an interrupted call resumes.
        journal.add(key, case.name, _reference_entry(prepared), records)
        # Since the first group of this call: finished groups of the journal took no time now.
        passed = time.perf_counter() - began
        left = passed / done * (len(todo) - done)
        say(f"{done}/{len(todo)} {key}: {len(records)} runs; {passed:.0f} s, about {left:.0f} s left")
    result = journal.report(keys)
    if out is not None:
        write(result, out)
    return result


def _group(prepared: Prepared, dtype, batch, integrators, full, rounds, peers) -> list[Record]:
    """Records of one scene, dtype and number of trajectories, timed in one loop."""
    case, scene = prepared.case, prepared.scene
    starts = prepared.programs.batch_starts(batch)
    plain = dtype == "float64" and batch == 1
    pairs = list(integrators) if integrators else combinations(case, bool(scene.constraints), full=full, plain=plain)
    # Once for each method: solvers differ in the number of evaluations only.
    counters = {method: flop_counter(prepared, method, batch) for method in dict(pairs)}
    contestants = [
        rung
        for method, solver in pairs
        for rung in ladder(
            prepared, method, solver, settings(case, solver, dtype, full=full), dtype, starts, counters[method]
        )
    ]
    if peers is not None:
        # In the same loop, so that drifts of the machine's speed affect all alike.
        contestants += peers(prepared, dtype, starts)
    return measure(prepared, contestants, dtype, batch, rounds)


def _reference_entry(prepared: Prepared) -> SceneReference:
    reference = prepared.reference
    published = tuple(x._asdict() for x in prepared.case.published)
    return SceneReference(prepared.case.text, reference.kind, reference.source, reference.error, published)


def _check_arguments(scenes, dtypes, batches, integrators, rounds) -> list[Case]:
    """Check the arguments of `report` and return its cases."""
    given = (scenes,) if isinstance(scenes, str | Case) else tuple(scenes)
    names = [case.name if isinstance(case, Case) else case for case in given]
    for argument, values in (("scenes", names), ("dtypes", dtypes), ("batches", batches), ("integrators", integrators)):
        if values is not None and len(values) == 0:
            raise ValueError(f"{argument} is empty; omit it for the defaults")
    for dtype in dtypes or ():
        if dtype not in ("float64", "float32"):
            raise ValueError(f"dtypes has {dtype!r}; choose from float64, float32")
    for pair in integrators or ():
        if not isinstance(pair, tuple | list) or len(pair) != 2 or pair[1] not in SOLVERS:
            raise ValueError(
                f'integrators has {pair!r}; give pairs such as ("projected", "Dopri8"), solvers: {", ".join(SOLVERS)}'
            )
    for batch in batches or ():
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
