"""Runs of a report: selection, measurement and timing, scene by scene.

All contestants run in turn in one loop, so that drifts of the machine's speed affect all alike.
"""

import datetime
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import wait_for_code
from jaxdyn.constraints.codes import CODES, code_of
from jaxdyn.reports.plotting import Record, Report, SceneReference, new_figure, write
from jaxdyn.reports.programs import FIXED, SOLVERS, Case, Prepared, case_of_scene, prepare
from jaxdyn.simulation.checks import choose_method
from jaxdyn.simulation.methods import Method
from jaxdyn.simulation.solvers.steps import keeps_fsal
from jaxdyn.systems.scene import Scene


class Motion(NamedTuple):
    """Result of a run: states at the reference's times, and counts if known."""

    q: np.ndarray
    v: np.ndarray
    result: str = "successful"
    steps: int | None = None
    rejected: int | None = None
    evaluations: int | None = None


class Contestant(NamedTuple):
    """One run of a ladder, of ours or of a peer.

    `call()` runs all trajectories and blocks until they are done; this is timed. `motion(call())` is the first
    one, in the coordinates of the scene.
    """

    source: str
    method: str
    solver: str
    setting: float
    fixed: bool
    call: Callable[[], Any]
    motion: Callable[[Any], Motion]
    compile_seconds: float | None = None


def ladder(
    prepared: Prepared, method: str, solver: str, settings: Sequence[float], dtype: str, starts
) -> list[Contestant]:
    """Our contestants that differ only in tolerance or step, sharing one program; `starts` as of `Programs.batch_starts`."""
    batch = len(starts[0])
    run, seconds = prepared.programs.get(method, solver, dtype, batch)
    # Converted once: the timed call must not include transfers and casts.
    inputs = [jnp.asarray(x[0] if batch == 1 else x, dtype) for x in starts]
    chosen = choose_method(prepared.scene, method)

    def motion(outputs) -> Motion:
        q, v, result, stats = outputs
        # The first trajectory of a batch is evaluated, if none failed: those that stop early take less time.
        names = [CODES[code] for code in np.atleast_1d(np.asarray(code_of(result)))]
        name = next((name for name in names if name != "successful"), names[0])
        q, v, stats = jax.tree.map(lambda x: np.asarray(x if batch == 1 else x[0]), (q, v, stats))
        steps = int(stats["num_steps"])
        count = evaluations(solver, steps, prepared.scene, chosen)
        return Motion(q, v, name, steps, int(stats["num_rejected_steps"]), count)

    def contestant(setting):
        number = jnp.asarray(setting, dtype)
        # JAX returns before the computation is done; without blocking the time would be that of the dispatch.
        call = lambda: jax.block_until_ready(run(*inputs, number))  # noqa: E731
        return Contestant("jaxdyn", method, solver, setting, solver in FIXED, call, motion, seconds)

    return [contestant(setting) for setting in settings]


def evaluations(solver: str, steps: int, scene: Scene, method: Method) -> int | None:
    """Number of evaluations of the vector field; None for implicit methods, whose iterations are not counted.

    First-same-as-last methods save one evaluation per step, unless the state is corrected after it.
    Two more determine the first step.
    """
    # The classical Runge-Kutta method has four stages and no first step to choose.
    if solver in FIXED:
        return 4 * steps
    tableau: Any = getattr(SOLVERS[solver](), "tableau", None)
    if tableau is None or tableau.implicit:
        return None
    saves = keeps_fsal(tableau, method.step_constants, method.projects) if method.corrects(scene) else tableau.fsal
    saved = steps - 1 if saves else 0
    return tableau.num_stages * steps - saved + 2


def judge(prepared: Prepared, motion: Motion) -> dict:
    """Errors, residuals and energy error of a motion; None where it did not succeed or there is nothing to measure."""
    names = ("error_end", "error_path", "residual_position", "residual_velocity", "energy_error")
    # A motion that stopped early has NaN in its last rows, which no error measures.
    if motion.result != "successful":
        return dict.fromkeys(names)
    error = prepared.errors(motion.q, motion.v)
    _, energy, residual = prepared.values(motion.q, motion.v)
    values: list[Any] = [error[-1], error.max(), *residual.max(0), np.abs(energy - energy[0]).max()]
    # Residuals of a scene without constraints are zeros by definition and no measurement.
    if not prepared.scene.constraints:
        values[2] = values[3] = None
    if not prepared.case.conserves:
        values[4] = None
    return {name: None if x is None else float(x) for name, x in zip(names, values, strict=True)}


def measure(
    prepared: Prepared,
    contestants: Sequence[Contestant],
    dtype: str,
    batch: int,
    rounds: int = 20,
    maximum: float = 10.0,
) -> list[Record]:
    """Run every contestant, evaluate its motion, and time all of them interleaved.

    `maximum`: seconds after which a slow one drops out of the rounds; one whose first run takes more than a quarter of
    that is timed once only. Its record has the number of rounds.
    """
    motions, times, calls = [], {}, {}
    for i, contestant in enumerate(contestants):
        began = time.perf_counter()
        # The first run gives the motion, and an estimate of the time for the rounds.
        outputs = contestant.call()
        passed = time.perf_counter() - began
        motions.append(contestant.motion(outputs))
        if passed > maximum / 4:
            times[i] = {"best": passed, "median": passed, "rounds": 1}
        else:
            calls[i] = contestant.call
    times |= time_alternately(calls, rounds, maximum=maximum)
    return [
        Record(
            scene=prepared.case.name,
            source=one.source,
            method=one.method,
            solver=one.solver,
            dtype=dtype,
            batch=batch,
            setting=float(one.setting),
            fixed=one.fixed,
            result=motion.result,
            # Per trajectory, so that batches of different sizes compare.
            seconds_best=times[i]["best"] / batch,
            seconds_median=times[i]["median"] / batch,
            rounds=times[i]["rounds"],
            compile_seconds=one.compile_seconds,
            steps=motion.steps,
            rejected=motion.rejected,
            evaluations=motion.evaluations,
            **judge(prepared, motion),
        )
        for i, (one, motion) in enumerate(zip(contestants, motions, strict=True))
    ]


def time_alternately(contestants: dict, rounds: int = 20, minimum: float = 0.02, maximum: float = float("inf")) -> dict:
    """Seconds per call of each contestant over several rounds: {name: {"best", "median", "rounds" (their number)}}.

    **Arguments:** `contestants`: {name: a function of no arguments that returns when its computation is done}. `minimum` (s):
    calls that are shorter are repeated within a round until they take this long together. `maximum` (s): a contestant that has
    used this much time drops out once it has three rounds, enough for a median.
    """
    repeats, spent = {}, {}
    for call in contestants.values():
        call()  # compiles, and is not timed
    wait_for_code()
    for name, call in contestants.items():
        start = time.perf_counter()
        call()
        spent[name] = time.perf_counter() - start
        # Repeated, because a clock and the dispatch would dominate the time of a short call.
        repeats[name] = max(1, int(minimum / max(spent[name], 1e-7)))  # no call is faster than 0.1 us
    samples = {name: [] for name in contestants}
    for index in range(rounds):
        for name, call in contestants.items():
            if index >= 3 and spent[name] > maximum:
                continue
            start = time.perf_counter()
            for _ in range(repeats[name]):
                call()
            elapsed = time.perf_counter() - start
            spent[name] += elapsed
            samples[name].append(elapsed / repeats[name])
    return {name: {"best": min(x), "median": statistics.median(x), "rounds": len(x)} for name, x in samples.items()}


def machine(packages: Sequence[str] = ()) -> dict:
    """Description of the machine for the head of a report: processor, JAX's device, cores, load and versions of packages.

    The load is the average over the last minute. Versions are those of jaxdyn, its main dependencies and `packages`, None for a
    package that is not installed.
    """
    processor = platform.processor()  # on Linux often empty or only the architecture
    try:
        # On Linux this file names the model of the processor.
        processor = next(
            line.split(":", 1)[1].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        )
    except (OSError, StopIteration):
        pass
    versions: dict[str, str | None] = {"python": platform.python_version()}
    for package in ("jaxdyn", "jax", "jaxlib", "diffrax", "numpy", *packages):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    return {
        "processor": processor,
        "device": jax.devices()[0].device_kind,
        # Containers often allow fewer cores than the machine has.
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": versions,
    }


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
    - `peers(prepared, dtype, starts)` -> contestants that are timed in the same loop; see `jaxdyn.reports.run.measure`.
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
