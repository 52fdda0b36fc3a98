"""Who writes to a store: one file for each process of a run, and one for each chunk that is being computed.

Files stand in a directory beside the store, `runs.zarr.lock`, and are made whole (written under another name and linked), so that
of several processes one succeeds. A file of a process that is dead is taken over: on the same host a process is
looked for by its number and time of start, on another one its file is too old, as every process touches its own every few
seconds. Should two processes ever compute one chunk, both write the same numbers.
"""

import contextlib
import getpass
import json
import os
import socket
import threading
import time
import uuid
from pathlib import Path
from typing import Any

from jaxdyn.scale.processes import Process

BEAT = 5.0  # s between touches of a process' own file
SILENT = 60.0  # s without a touch, after which a process of another host is held to be dead


class Lock:
    """Place of one process among the writers of a store; a context manager that gives it up.

    **Raises:** ValueError that names the owner, when another living process has this place or belongs to a run of another
    number of processes.
    """

    def __init__(self, store: Path, process: Process):
        self.directory = store.with_name(store.name + ".lock")
        self.process = process
        self.path = self.directory / f"process-{process.index}.json"
        self.me = _identity() | {"index": process.index, "count": process.count}
        self._stop = threading.Event()
        self._beat = threading.Thread(target=self._touch, name="jaxdyn lock", daemon=True)

    def __enter__(self) -> "Lock":
        self.directory.mkdir(exist_ok=True)
        for path in sorted(self.directory.glob("process-*.json")):
            owner = _read(path)
            if owner is None or not self._lives(owner, path):
                continue
            if path == self.path or owner["count"] != self.process.count:
                raise ValueError(
                    f"out is {str(self._store)!r}, to which process {owner['pid']} of {owner['user']} on {owner['host']} "
                    f"(number {owner['index']} of {owner['count']}, since {owner['since']}) is writing, and this is number "
                    f"{self.process.index} of {self.process.count}; wait for it, end it, or name another store"
                )
        if not self._make(self.path):
            self._replace(self.path)
            time.sleep(0.05)
            if _read(self.path) != self.me:
                raise ValueError(f"out is {str(self._store)!r}, which another process took at the same time; try again")
        self._beat.start()
        return self

    def __exit__(self, *_) -> None:
        self._stop.set()
        self._beat.join()
        for path in self.directory.glob("chunk-*.json"):
            if _read(path) == self.me:
                path.unlink(missing_ok=True)
        self.path.unlink(missing_ok=True)
        # The last of the run leaves nothing behind: what dead processes claimed goes with their places.
        if not list(self.directory.glob("process-*.json")):
            for path in self.directory.glob("*.json"):
                path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                self.directory.rmdir()

    @property
    def _store(self) -> Path:
        return self.directory.with_suffix("")

    def claim(self, chunk: int) -> bool:
        """Whether this process is to compute the chunk: no other living one is at it."""
        if self.process.count == 1:
            return True
        path = self._chunk(chunk)
        if self._make(path):
            return True
        owner = _read(path)
        if owner is None:  # given up between the two looks
            return self._make(path)
        if owner != self.me and self._lives(owner, self.directory / f"process-{owner['index']}.json"):
            return False
        self._replace(path)
        return True

    def release(self, chunk: int) -> None:
        """Give a chunk up, once it is recorded or has failed."""
        if self.process.count > 1:
            self._chunk(chunk).unlink(missing_ok=True)

    def _chunk(self, chunk: int) -> Path:
        return self.directory / f"chunk-{chunk}.json"

    def _make(self, path: Path) -> bool:
        mine = self._written()
        try:
            os.link(mine, path)
        except FileExistsError:
            return False
        finally:
            mine.unlink(missing_ok=True)
        return True

    def _replace(self, path: Path) -> None:
        os.replace(self._written(), path)

    def _written(self) -> Path:
        path = self.directory / f"{uuid.uuid4().hex}.tmp"
        path.write_text(json.dumps(self.me), encoding="utf-8")
        return path

    def _touch(self) -> None:
        while not self._stop.wait(BEAT):
            with contextlib.suppress(OSError):
                os.utime(self.path)

    def _lives(self, owner: dict[str, Any], path: Path) -> bool:
        if owner["host"] == self.me["host"]:
            return _start_of(owner["pid"]) == owner["start"]
        probe = self._written()  # the clock of the file system, which all hosts share
        try:
            return probe.stat().st_mtime - path.stat().st_mtime < SILENT
        except FileNotFoundError:
            return False
        finally:
            probe.unlink(missing_ok=True)


def _identity() -> dict[str, Any]:
    pid = os.getpid()
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # in a container without an entry for the user
        user = str(os.getuid())
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    return {"host": socket.gethostname(), "pid": pid, "start": _start_of(pid), "user": user, "since": since}


def _start_of(pid: int) -> str | None:
    """When a process of this host started, as text, "unknown" where the system does not tell; None when there is none."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:  # it lives, and is somebody else's
        pass
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except OSError:
        return "unknown"
    return None if fields[0] == "Z" else fields[19]


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
