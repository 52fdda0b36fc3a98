"""Figures of the documents: `python -m benchmarks.figures [--list] [WORD ...]` (`make figures`).

A table of measured figures is below a heading whose text names its command, `python -m benchmarks.NAME ...`. This runs the
commands and writes what they print in place: a table of a page is replaced by the printed table with the same first row. A
line below it gives the commit, the machine and the versions. With words, only commands that contain one of them run. Tables
whose command prints no table with that row are named. Commands that write pages on their own (`--readme`) are run, and their
tables get the line.

`--list` runs nothing: each table with its command and the number of commits to the code that it measures since it was measured,
or, without that line, since its text was last changed. `--stale` lists those of more than LIMIT commits only.
"""

import argparse
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
_TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
_STAMP = re.compile(r"\n\*Measured at commit ([0-9a-f]+),.*\*\n")
_COMMAND = re.compile(
    r"python -m ((?:benchmarks|jaxdyn)\.[^`\n]*?)(?=[`\n])|\b(jaxdyn report)\b|make (bench|demo|test[\w-]*)"
)
# A table of which more cells than this begin with a number has figures; the others have words.
_NUMBERS = 0.4
# Commits to the measured code after which a table is to be measured again.
LIMIT = 200
# Code that a command measures, by the first word of it that begins so: folders of the package. Others measure all of it.
_DYNAMICS = ("compile", "dynamics", "model")
_STEPS = (*_DYNAMICS, "constraints", "contact", "forces", "simulation")
_MEASURED = {
    "benchmarks.constraints": (*_DYNAMICS, "constraints"),
    "benchmarks.contact_": _STEPS,
    "benchmarks.dynamics": _DYNAMICS,
    "benchmarks.export": ("exports", *_DYNAMICS),
    "benchmarks.extremes": _STEPS,
    "benchmarks.files": ("io",),
    "benchmarks.fresh_pages": _DYNAMICS,
    "benchmarks.identify_": ("identify",),
    "benchmarks.inverse_kinematics": ("tasks", "constraints"),
    "benchmarks.long_chains": _DYNAMICS,
    "benchmarks.optimal_control": ("control", *_DYNAMICS),
    "benchmarks.scale": ("scale",),
    "benchmarks.stiff": _STEPS,
    "benchmarks.work_precision": (*_STEPS, "reports"),
}


class Table(NamedTuple):
    """Table of figures of a page: where it is in the text, its commands, and the commit at which it was measured."""

    page: Path
    start: int
    end: int
    commands: tuple[str, ...]
    commit: str | None


def header(table: str) -> str:
    """First row of a table, without its spaces."""
    return re.sub(r"\s+", "", table.splitlines()[0])


def has_figures(table: str) -> bool:
    """Decide whether most cells of a table are numbers."""
    rows = [[cell.strip() for cell in row.strip().strip("|").split("|")] for row in table.splitlines()[2:]]
    cells = [cell for row in rows for cell in row[1:]]
    return sum(bool(re.match(r"[-+<>~*]*\s*\d", cell)) for cell in cells) > _NUMBERS * max(len(cells), 1)


def tables(page: Path) -> list[Table]:
    """Tables of figures of a page, with the commands named in their section, or else at the head of the page."""
    text = page.read_text(encoding="utf-8")
    # Blocks of code have no tables and no headings, but their commands count.
    plain = re.sub(r"```.*?```", lambda block: re.sub(r"[^\n]", " ", block[0]), text, flags=re.DOTALL)
    headings = [0, *(match.start() for match in re.finditer(r"^#+ ", plain, re.MULTILINE)), len(text)]
    found = []
    for match in _TABLE.finditer(plain):
        if not has_figures(match[0]):
            continue
        first = max(place for place in headings if place <= match.start())
        last = min(place for place in headings if place > match.start())
        head = text[: re.search(r"^## |\Z", plain, re.MULTILINE).start()]  # pyright: ignore[reportOptionalMemberAccess]
        commands = _commands(text[first:last]) or _commands(head)
        stamp = _STAMP.match(text, match.end())
        found.append(Table(page, match.start(), match.end(), commands, stamp[1] if stamp else None))
    return found


def _commands(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(next(filter(None, groups)).split("#")[0].strip() for groups in _COMMAND.findall(text)))


def replace(page: Path, command: str, printed: str, note: str) -> tuple[int, list[str]]:
    """Write printed tables over those of the page that name the command; their number, and the headers without a match."""
    fresh: dict[str, list[str]] = {}
    for match in _TABLE.finditer(printed):
        fresh.setdefault(header(match[0]), []).append(match[0])
    text, written, missing = page.read_text(encoding="utf-8"), 0, []
    chosen = []
    for table in (table for table in tables(page) if command in table.commands):
        old = text[table.start : table.end]
        # Tables with one header are taken in their order.
        if same := fresh.get(header(old)):
            chosen.append((table, same.pop(0)))
        else:
            missing.append(old.splitlines()[0])
    # From the last on, so that the places of the others stay.
    for table, new in reversed(chosen):
        stamp = _STAMP.match(text, table.end)
        text = text[: table.start] + new + f"\n*{note}*\n" + text[stamp.end() if stamp else table.end :]
        written += 1
    page.write_text(text, encoding="utf-8")
    return written, missing


def stamp(page: Path, command: str, note: str) -> int:
    """Write the note below the tables of the page that name the command; their number."""
    text = page.read_text(encoding="utf-8")
    chosen = [table for table in tables(page) if command in table.commands]
    for table in reversed(chosen):
        old = _STAMP.match(text, table.end)
        text = text[: table.end] + f"\n*{note}*\n" + text[old.end() if old else table.end :]
    page.write_text(text, encoding="utf-8")
    return len(chosen)


def measured_code(commands: tuple[str, ...]) -> tuple[str, ...]:
    """Folders whose code the commands measure, from the root of the repository."""
    found = [next((rooms for name, rooms in _MEASURED.items() if c.startswith(name)), ("",)) for c in commands] or [
        ("",)
    ]
    rooms = sorted({room for folders in found for room in folders})
    return tuple(f"jaxdyn/{room}" for room in rooms) if rooms[0] else ("jaxdyn",)


def age(table: Table) -> tuple[int, str]:
    """Commits to the measured code since a table was measured, as its note says, or since its text was last changed; a line."""
    text = table.page.read_text(encoding="utf-8")
    if table.commit:
        commit, what = table.commit, "measured"
    else:
        first, last = (text.count("\n", 0, place) + 1 for place in (table.start, table.end - 1))
        blame = _git("blame", "--line-porcelain", f"-L{first},{last}", "--", str(table.page))
        names = re.findall(r"(?m)^([0-9a-f]{40}) ", blame)
        times = dict(zip(names, map(int, re.findall(r"(?m)^committer-time (\d+)", blame)), strict=True))
        commit, what = max(times, key=lambda name: times[name]), "no note; text changed"
        commit = "HEAD" if not commit.strip("0") else commit[:8]  # not committed yet
    code = measured_code(table.commands)
    count = int(_git("rev-list", "--count", "--no-merges", f"{commit}..HEAD", "--", *code))
    return count, f"{what} at {commit}, {count} commits to {', '.join(code)} ago"


def has_history() -> bool:
    """Decide whether git knows all commits of the repository: an archive has none, and a shallow clone few."""
    ended = subprocess.run(
        ["git", "rev-parse", "--is-shallow-repository"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return ended.returncode == 0 and ended.stdout.strip() == "false"


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def main(argv=None) -> int:
    """List or measure; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="run only commands that contain one of these")
    parser.add_argument("--list", action="store_true", help="run nothing; print tables, commands and ages")
    parser.add_argument("--stale", action="store_true", help=f"run nothing; print tables older than {LIMIT} commits")
    options = parser.parse_args(argv)
    every = [table for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))) for table in tables(page)]
    if options.list or options.stale:
        listed = [(table, *age(table)) for table in every]
        listed = [row for row in listed if not options.stale or row[1] > LIMIT or not row[0].commands]
        for table, _, note in listed:
            line = table.page.read_text(encoding="utf-8").count("\n", 0, table.start) + 1
            print(f"{table.page.relative_to(ROOT)}:{line}: {'; '.join(table.commands) or 'NO COMMAND'} ({note})")
        return int(bool(listed) if options.stale else any(not table.commands for table in every))
    # Imported on use: it asks the machine.
    from benchmarks import timing

    machine = timing.machine()
    failed = 0
    for command in dict.fromkeys(command for table in every for command in table.commands):
        # A command with a placeholder or of another machine is run by hand.
        runs = command.startswith("benchmarks.") and not re.search(r"\[|\.\.\.|[A-Z]{2}|<", command)
        if not runs or (options.words and not any(word in command for word in options.words)):
            continue
        print(f"python -m {command}", flush=True)
        ended = subprocess.run(
            [sys.executable, "-m", *shlex.split(command)], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False
        )
        if ended.returncode:
            print(f"  ended with status {ended.returncode}; its tables stay")
            failed += 1
            continue
        versions = ", ".join(f"{name} {number}" for name, number in machine["versions"].items() if number)
        note = (
            f"Measured at commit {_git('rev-parse', '--short', 'HEAD')}, {machine['processor']}, {machine['cores']} cores, "
            f"{versions}; `python -m {command}`."
        )
        for page in dict.fromkeys(table.page for table in every if command in table.commands):
            if re.search(r"--(readme|docs|out docs)", command):  # it has written its pages
                print(f"  {page.relative_to(ROOT)}: {stamp(page, command, note)} tables have a note")
                continue
            written, missing = replace(page, command, ended.stdout, note)
            print(f"  {page.relative_to(ROOT)}: {written} tables written")
            for row in missing:
                print(f"    not printed by it: {row}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
