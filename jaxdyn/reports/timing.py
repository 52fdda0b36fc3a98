"""Interleaved timing: all contestants run in one loop, so that drifts of the machine affect all alike."""

import os
import platform
import statistics
import subprocess
import time
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax


def time_interleaved(contestants: dict, rounds: int = 20, least: float = 0.02, most: float = float("inf")) -> dict:
    """Seconds per call of each contestant (a function of no arguments that blocks until done): "best", "median", "rounds".

    Calls shorter than `least` seconds are repeated within a round; a contestant that has used
    `most` seconds drops out after three rounds.
    """
    repeats, spent = {}, {}
    for name, call in contestants.items():
        call()
        start = time.perf_counter()
        call()
        spent[name] = time.perf_counter() - start
        repeats[name] = max(1, int(least / max(spent[name], 1e-7)))
    samples = {name: [] for name in contestants}
    for count in range(rounds):
        for name, call in contestants.items():
            if count >= 3 and spent[name] > most:
                continue
            start = time.perf_counter()
            for _ in range(repeats[name]):
                call()
            passed = time.perf_counter() - start
            spent[name] += passed
            samples[name].append(passed / repeats[name])
    return {name: {"best": min(x), "median": statistics.median(x), "rounds": len(x)} for name, x in samples.items()}


def machine(packages: Sequence[str] = ()) -> dict:
    """Processor, device, cores, load and versions, for the head of a report; `packages` are added to ours."""
    processor = platform.processor()
    try:
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
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": versions,
    }


def commit() -> str | None:
    """Commit of the package's source tree, with "+" for modified files; None outside of a repository."""

    def git(*arguments) -> str:
        call = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(call, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # an installation may be inside another repository
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
