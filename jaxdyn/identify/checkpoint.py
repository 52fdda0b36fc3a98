"""Checkpoints of long fits: what a fit needs to go on to the same numbers, written so that no half of one is ever read.

A checkpoint is a line of JSON (the problem, the arrays, the checksum of what follows), then the arrays, as
`equinox.tree_serialise_leaves` writes them. It is written beside its final name, flushed to the disk, and renamed: a
process that is killed at any time leaves the checkpoint before, or the new one.
"""

import dataclasses
import hashlib
import io
import json
import os
import pathlib
import re
import time
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxdyn.model.arguments import as_path

_FORMAT = 1


def fingerprint(*trees: Any) -> str:
    """A hash of all numbers and of the structure of trees: the same in every process that builds them alike."""
    leaves, structure = jax.tree.flatten(trees)
    # Functions are known by their names; where they stand in memory differs from process to process.
    digest = hashlib.sha256(re.sub(r" at 0x[0-9a-f]+", "", str(structure)).encode())
    for leaf in leaves:
        if isinstance(leaf, (jax.Array, np.ndarray, float, int)):
            array = np.asarray(leaf)
            digest.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
        else:
            digest.update(re.sub(r" at 0x[0-9a-f]+", "", repr(leaf)).encode())
    return digest.hexdigest()


@dataclasses.dataclass
class Checkpoint:
    """Where a fit keeps its state: `path`, the fingerprint of its `problem`, and how often, in steps or seconds."""

    path: pathlib.Path
    problem: str
    steps: int = 0
    seconds: float = 30.0
    resume: bool = True
    _last: float = dataclasses.field(default_factory=time.monotonic)

    def load(self) -> dict[str, np.ndarray] | None:
        """The arrays of the last state; None where there is none to resume from.

        **Raises:** ValueError for a checkpoint of another problem, and for a file that is no whole checkpoint.
        """
        if not (self.resume and self.path.exists()):
            return None
        header, payload = read(self.path)
        if header["problem"] != self.problem:
            raise ValueError(
                f"checkpoint {self.path} is of another problem (other log, model, parameters or options); name another file, or "
                "pass resume=False to overwrite it"
            )
        like = {name: np.zeros(shape, dtype) for name, (shape, dtype) in header["arrays"].items()}
        return eqx.tree_deserialise_leaves(io.BytesIO(payload), like)

    def save(self, step: int, state: dict[str, Any], *, last: bool = False) -> None:
        """Write the state, if it is time to."""
        due = self.steps > 0 and step % self.steps == 0
        if not (last or due or time.monotonic() - self._last >= self.seconds):
            return
        write(self.path, self.problem, {name: np.asarray(value) for name, value in sorted(state.items())})
        self._last = time.monotonic()


def checkpoint_at(path: Any, problem: Any, every: Any, resume: bool) -> Checkpoint | None:
    """The checkpoint of a fit, or None without a path. `every`: steps (an integer), or seconds (a float).

    **Raises:** ValueError for what is no path or no positive number.
    """
    if path is None:
        return None
    if isinstance(every, bool) or not isinstance(every, (int, float)) or not every > 0:
        raise ValueError(f"every is {every!r}; give a number of steps, such as 10, or of seconds, such as 30.0")
    often: Any = {"steps": every, "seconds": float("inf")} if isinstance(every, int) else {"seconds": every}
    return Checkpoint(as_path(path, "checkpoint"), fingerprint(problem), resume=resume, **often)


def write(path: pathlib.Path, problem: str, arrays: dict[str, np.ndarray]) -> None:
    """Write a checkpoint so that `path` holds the one before or this one, whenever the process ends."""
    buffer = io.BytesIO()
    eqx.tree_serialise_leaves(buffer, arrays)
    payload = buffer.getvalue()
    header = {
        "format": _FORMAT,
        "problem": problem,
        "arrays": {name: (array.shape, array.dtype.name) for name, array in arrays.items()},
        "sha256": hashlib.sha256(payload).hexdigest(),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(beside, "wb") as file:
            file.write(json.dumps(header).encode() + b"\n" + payload)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def read(path: pathlib.Path) -> tuple[dict, bytes]:
    """Header and arrays of a checkpoint.

    **Raises:** ValueError for a file that is none, or not whole.
    """
    line, _, payload = path.read_bytes().partition(b"\n")
    try:
        header = json.loads(line)
        whole = header["format"] == _FORMAT and header["sha256"] == hashlib.sha256(payload).hexdigest()
    except (ValueError, KeyError, TypeError):
        whole, header = False, {}
    if not whole:
        raise ValueError(f"{path} is no whole checkpoint of a fit; remove it, or name another file")
    return header, payload
