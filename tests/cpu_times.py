"""Where the time of the tests goes, of a file that `pytest --cpu-times FILE` wrote:

    python -m pytest -m "not slow" --cpu-times out/times.txt && python tests/cpu_times.py out/times.txt

Prints the sums of the slowest files and the slowest tests, in seconds of the processor, as tables for a page.
"""

import sys
from collections import defaultdict
from pathlib import Path

SLOWEST = 40


def tables(text: str) -> str:
    """The two tables in Markdown."""
    times = [(float(seconds), test) for seconds, test in (line.split(" ", 1) for line in text.splitlines())]
    files: dict[str, list[float]] = defaultdict(list)
    for seconds, test in times:
        files[test.split("::")[0].removeprefix("tests/")].append(seconds)
    rows = sorted(((sum(x), len(x), max(x), name) for name, x in files.items()), reverse=True)
    lines = ["| file | tests | sum, s | longest, s |", "|---|---|---|---|"]
    lines += [f"| {name} | {count} | {total:.1f} | {longest:.1f} |" for total, count, longest, name in rows[:SLOWEST]]
    lines += [f"| all | {len(times)} | {sum(x for x, _ in times):.1f} | {max(x for x, _ in times):.1f} |", ""]
    lines += ["| test | s |", "|---|---|"]
    lines += [
        f"| {test.removeprefix('tests/')} | {seconds:.1f} |" for seconds, test in sorted(times, reverse=True)[:SLOWEST]
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    print(tables(Path(sys.argv[1]).read_text()))
