"""What the benchmarks share: timing, the machine, and where results go."""

import json
import time
from pathlib import Path

from jaxdyn.reports import run
from jaxdyn.reports.run import time_alternately as time_alternately

OUT = Path(__file__).resolve().parent.parent / "out"


def once(call) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def chosen_names(given, known) -> list[str]:
    """The names given, or all known ones. **Raises:** ValueError for one that is not known."""
    for name in given:
        if name not in known:
            raise ValueError(f"there is no {name!r}; choose from {', '.join(known)}")
    return list(given or known)


def machine() -> dict:
    """Processor, cores and versions, for the head of a report."""
    return run.machine(("pin", "frax", "mujoco", "mujoco-mjx"))


def write(name: str, report: dict) -> Path:
    """Write a report as JSON into out/."""
    OUT.mkdir(exist_ok=True)
    path = OUT / f"{name}.json"
    path.write_text(json.dumps(report, indent=1))
    return path
