"""Interleaved timing: every contestant runs in turn within one loop, so that drifts of the machine hit all alike."""

import json
import os
import platform
import statistics
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

OUT = Path(__file__).resolve().parent.parent / "out"


def interleaved(contestants: dict, rounds: int = 20, least: float = 0.02) -> dict:
    """Seconds per call of each contestant (a function of no arguments that blocks until done): best and median of `rounds`.

    Calls shorter than `least` seconds are repeated within a round.
    """
    repeats = {}
    for name, call in contestants.items():
        call()
        start = time.perf_counter()
        call()
        repeats[name] = max(1, int(least / max(time.perf_counter() - start, 1e-7)))
    samples = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, call in contestants.items():
            start = time.perf_counter()
            for _ in range(repeats[name]):
                call()
            samples[name].append((time.perf_counter() - start) / repeats[name])
    return {name: {"best": min(x), "median": statistics.median(x)} for name, x in samples.items()}


def once(call) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def machine() -> dict:
    """Processor, cores and versions, for the head of a report."""
    processor = platform.processor()
    try:
        processor = next(
            line.split(":", 1)[1].strip() for line in open("/proc/cpuinfo") if line.startswith("model name")
        )
    except (OSError, StopIteration):
        pass
    versions = {}
    for package in ("jax", "jaxlib", "pin", "frax", "mujoco-mjx", "jaxdyn"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    return {"processor": processor, "cores": os.cpu_count(), "load": os.getloadavg()[0], "versions": versions}


def write(name: str, report: dict) -> Path:
    """Write a report as JSON into out/."""
    OUT.mkdir(exist_ok=True)
    path = OUT / f"{name}.json"
    path.write_text(json.dumps(report, indent=1))
    return path
