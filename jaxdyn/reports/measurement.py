"""Measurement of one scene with many methods: errors against the reference, and timing in one loop.

All contestants run in turn, so that drifts of the machine's speed affect all alike.
"""

import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import wait_for_code
from jaxdyn.constraints.codes import CODES, code_of
from jaxdyn.reports.page import Record
from jaxdyn.reports.programs import FIXED, SOLVERS, Prepared
from jaxdyn.simulation.checks import choose_method
from jaxdyn.simulation.methods import Method
from jaxdyn.simulation.solvers.explicit import keeps_fsal
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
    prepared: Prepared, contestants: Sequence[Contestant], dtype: str, batch: int, rounds: int = 20, most: float = 10.0
) -> list[Record]:
    """Run every contestant, evaluate its motion, and time all of them interleaved.

    `most`: seconds after which a slow one drops out of the rounds; one whose first run takes more than a quarter of
    that is timed once only. Its record has the number of rounds.
    """
    motions, times, calls = [], {}, {}
    for i, contestant in enumerate(contestants):
        began = time.perf_counter()
        # The first run gives the motion, and an estimate of the time for the rounds.
        outputs = contestant.call()
        passed = time.perf_counter() - began
        motions.append(contestant.motion(outputs))
        if passed > most / 4:
            times[i] = {"best": passed, "median": passed, "rounds": 1}
        else:
            calls[i] = contestant.call
    times |= time_interleaved(calls, rounds, most=most)
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


# --- interleaved timing: all contestants run in turn in one loop, so that drifts of the machine's speed affect all alike ---


def time_interleaved(contestants: dict, rounds: int = 20, least: float = 0.02, most: float = float("inf")) -> dict:
    """Seconds per call of each contestant over several rounds: {name: {"best", "median", "rounds" (their number)}}.

    **Arguments:** `contestants`: {name: a function of no arguments that returns when its computation is done}. `least` (s): calls
    that are shorter are repeated within a round until they take this long together. `most` (s): a contestant that has used this
    much time drops out once it has three rounds, enough for a median.
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
        repeats[name] = max(1, int(least / max(spent[name], 1e-7)))  # no call is faster than 0.1 us
    samples = {name: [] for name in contestants}
    for index in range(rounds):
        for name, call in contestants.items():
            if index >= 3 and spent[name] > most:
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
