"""Interleaved timing: all contestants run in turn in one loop, so that drifts of the machine's speed affect all alike."""

import os
import platform
import statistics
import time
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax

from jaxdyn.compile import wait_for_code


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
