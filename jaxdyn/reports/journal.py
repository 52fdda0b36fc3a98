"""Journal of finished runs: a file of JSON lines, from which an interrupted report resumes."""

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

from jaxdyn.reports.records import Record, Report, SceneReference

NAME = "records.jsonl"


class _Entry(NamedTuple):
    scene: str
    known: SceneReference
    records: list[Record]


class Journal:
    """Groups of records by key, each from one run; with a directory, they are also in its file `records.jsonl`.

    The first line of the file is the head: commit, machine and versions. Each further line is a group.

    **Raises:** ValueError when the file's records are of another commit, machine, set of versions or kind of report, or
    cannot be read.
    """

    def __init__(self, directory: Path | None, head: dict):
        self.head = head
        self.path = None if directory is None else directory / NAME
        self._entries: dict[str, _Entry] = {}
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            self._read(self.path)
        # The file is written anew, without a line that an interruption has truncated.
        lines = [json.dumps(self.head), *(_line(key, entry) for key, entry in self._entries.items())]
        self.path.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def _read(self, path: Path) -> None:
        remedy = "name another directory, or remove the file to start anew"
        # A truncated last line is normal after an interruption; every other fault means another file.
        try:
            first, *lines = path.read_text(encoding="utf-8").splitlines() or ["{}"]
        except UnicodeDecodeError as error:
            raise ValueError(f"out has {path}, which is not UTF-8 text ({error}); {remedy}") from error
        # A head alone holds no runs, so that its commit and machine do not matter.
        if not lines:
            return
        try:
            before = json.loads(first)
            for name, value_of in (
                ("commit", lambda head: head["commit"]),
                # The load differs from call to call and is left out of the comparison.
                ("machine", lambda head: [head["machine"][key] for key in ("processor", "device", "cores")]),
                ("versions", lambda head: head["machine"]["versions"]),
                ("full", lambda head: head["full"]),
            ):
                if value_of(before) != value_of(self.head):
                    raise ValueError(
                        f"out has {path} with {name} {value_of(before)}, and this report has {value_of(self.head)}; {remedy}"
                    )
            for line in lines:
                try:
                    entry = json.loads(line)
                except json.JSONDecodeError:  # truncated by an interruption
                    continue
                records = [Record(**x) for x in entry["records"]]
                self._entries[entry["key"]] = _Entry(entry["scene"], SceneReference.from_dict(entry["known"]), records)
        except (KeyError, TypeError, json.JSONDecodeError) as error:
            raise ValueError(f"out has {path}, which is not a journal of this version ({error!r}); {remedy}") from error
        # The head of the first run stays: its date and its load of the machine belong to the records.
        self.head = before

    def __contains__(self, key: str) -> bool:
        return key in self._entries

    def add(self, key: str, scene: str, known: SceneReference, records: list[Record]) -> None:
        """Store a finished group."""
        self._entries[key] = _Entry(scene, known, records)
        if self.path is not None:
            # Appended and closed at once: an interruption loses the group in progress alone.
            with self.path.open("a", encoding="utf-8") as file:
                file.write(_line(key, self._entries[key]) + "\n")

    def report(self, keys: Iterable[str]) -> Report:
        """Report of these groups."""
        entries = [self._entries[key] for key in keys]
        scenes = {entry.scene: entry.known for entry in entries}
        return Report(self.head, scenes, tuple(record for entry in entries for record in entry.records))


def _line(key: str, entry: _Entry) -> str:
    records = [asdict(record) for record in entry.records]
    return json.dumps({"key": key, "scene": entry.scene, "known": asdict(entry.known), "records": records})
