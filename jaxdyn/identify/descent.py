"""Minimisation: the protocol of all methods, the loop that reports and ends a fit, and its checkpoints.

A checkpoint is its checksum and an archive of NumPy arrays, with the hash of the problem. It is written next to its
final name, flushed to the disk, and renamed: a process that is killed at any time leaves the previous checkpoint, or the new one,
and never half of one.

Linear algebra on small matrices keeps to one thread: OpenBLAS shares products and factorisations of a hundred rows among all
processors, whose threads then wait for each other: on two busy ones a search for terms took 61 s of their time instead of 4.
"""

import abc
import contextlib
import dataclasses
import hashlib
import io
import os
import pathlib
import re
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from jaxdyn.constraints.codes import RESULTS
from jaxdyn.model.arguments import as_path


def fingerprint(*trees: Any) -> str:
    """Hash of all numbers and of the structure of trees: the same in every process that builds them alike."""
    leaves, structure = jax.tree.flatten(trees)
    # Functions count by their names; their addresses differ from process to process.
    digest = hashlib.sha256(re.sub(r" at 0x[0-9a-f]+", "", str(structure)).encode())
    for leaf in leaves:
        if isinstance(leaf, (jax.Array, np.ndarray, float, int)):
            array = np.asarray(leaf)
            # Type and shape count too: the same bytes may be other numbers.
            digest.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
        else:
            digest.update(re.sub(r" at 0x[0-9a-f]+", "", repr(leaf)).encode())
    return digest.hexdigest()


@dataclasses.dataclass
class Checkpoint:
    """File with the state of a fit: its `path`, the fingerprint of the `problem`, and the interval in steps or seconds."""

    path: pathlib.Path
    problem: str
    steps: int = 0
    seconds: float = 30.0
    resume: bool = True
    # The wall clock may be set while a fit runs; a monotonic one is not.
    _last: float = dataclasses.field(default_factory=time.monotonic)

    def load(self) -> dict[str, np.ndarray] | None:
        """Read the arrays of the last state; None where there is none to resume from.

        **Raises:** ValueError for a checkpoint of another problem, and for a file that is no complete checkpoint.
        """
        if not (self.resume and self.path.exists()):
            return None
        arrays = read(self.path)
        if str(arrays.pop("problem")) != self.problem:
            raise ValueError(
                f"checkpoint {self.path} is of another problem (other log, model, parameters or options); name another file, or "
                "pass resume=False to overwrite it"
            )
        return arrays

    def save(self, step: int, state: dict[str, Any], *, last: bool = False) -> None:
        """Write the state where the interval has passed, or `last`."""
        due = self.steps > 0 and step % self.steps == 0
        if not (last or due or time.monotonic() - self._last >= self.seconds):
            return
        write(self.path, self.problem, {name: np.asarray(value) for name, value in sorted(state.items())})
        self._last = time.monotonic()


def checkpoint_at(path: Any, problem: Any, every: Any, resume: bool) -> Checkpoint:
    """Checkpoint of a fit. `every`: steps (an integer), or seconds (a float).

    **Raises:** ValueError for a path that is none, or an interval that is no positive number.
    """
    if isinstance(every, bool) or not isinstance(every, (int, float)) or not every > 0:
        raise ValueError(f"every is {every!r}; give a number of steps, such as 10, or of seconds, such as 30.0")
    often: Any = {"steps": every, "seconds": float("inf")} if isinstance(every, int) else {"seconds": every}
    return Checkpoint(as_path(path, "checkpoint"), fingerprint(problem), resume=resume, **often)


def write(path: pathlib.Path, problem: str, arrays: dict[str, Any]) -> None:
    """Write a checkpoint atomically: `path` holds the previous one or this one whenever the process ends."""
    buffer = io.BytesIO()
    np.savez(buffer, problem=np.array(problem), **arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    # In the same folder, as a rename is atomic within one file system only; by process, so that two fits do not share it.
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(partial, "wb") as file:
            file.write(hashlib.sha256(buffer.getvalue()).digest() + buffer.getvalue())
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def read(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Read the arrays of a checkpoint, and the hash of its "problem".

    **Raises:** ValueError for a file that is no complete checkpoint.
    """
    content, size = path.read_bytes(), hashlib.sha256().digest_size
    if hashlib.sha256(content[size:]).digest() != content[:size]:
        raise ValueError(f"{path} is no complete checkpoint of a fit; remove it, or name another file")
    with np.load(io.BytesIO(content[size:]), allow_pickle=False) as archive:
        return dict(archive)


class Watch:
    """Progress of a fit: calls the user's function, prints, writes checkpoints, and decides whether the fit continues.

    `steps`: the most steps. `callback(step, loss, point)` returns True to stop. `seconds`: of the whole fit.
    """

    def __init__(
        self,
        steps: int,
        callback: Callable | None = None,
        *,
        checkpoint: Checkpoint | None = None,
        show: bool = False,
        seconds: float | None = None,
    ):
        self.steps, self.callback, self.checkpoint = steps, callback, checkpoint
        self.show, self.seconds = show, seconds
        self.started, self.first, self.printed = time.monotonic(), None, 0.0
        self.failed: Any = None  # the point with errors that are not finite, where these ended the fit

    def load(self) -> dict | None:
        """State to resume from, if any."""
        return None if self.checkpoint is None else self.checkpoint.load()

    def continues(self, step: int, loss: float, point: Any, state: Callable[[], dict]) -> bool:
        """Report a point; False when the fit is to stop there. `state()` gives the arrays of a checkpoint."""
        # Only True itself: a callback that happens to return something else does not stop the fit.
        stopped = self.callback is not None and self.callback(step, loss, point) is True
        now = time.monotonic()
        stopped = stopped or (self.seconds is not None and now - self.started > self.seconds)
        # A resumed fit does not start at step 0: the rate counts the steps of this process alone.
        if self.first is None:
            self.first = (step, now)
        if self.show and (now - self.printed > 0.5 or stopped):
            self.printed = now
            print(self.line(step, loss, now), file=sys.stderr, flush=True)
        if self.checkpoint is not None:
            self.checkpoint.save(step, state(), last=stopped)
        return not stopped

    def line(self, step: int, loss: float, now: float) -> str:
        """Line of progress for a point."""
        begin, at = self.first or (step, now)
        left = ""
        if step > begin:
            left = f", at most {(now - at) / (step - begin) * (self.steps - step):.0f} s left"
        return f"step {step} of at most {self.steps}: loss {loss:.6g}, {now - self.started:.1f} s{left}"


class Iterate(NamedTuple):
    """A point of a minimisation, its loss, and the method's own state there.

    `is_finite`: whether a step can start there; losses and derivatives that are not finite end a fit.
    """

    point: Any
    loss: float
    state: Any = None
    is_finite: bool = True


class Method(abc.ABC):
    """A minimisation method. Its state passes through `init` and `step`, and never through `self`.

    `floor`: a loss that rounding cannot lower, at which a fit has converged; logarithms have none.
    """

    floor: float = -np.inf

    @abc.abstractmethod
    def init(self, start: Any, kept: dict[str, np.ndarray] | None) -> Iterate:
        """Evaluate the start, or the point of a checkpoint whose `arrays` are `kept`."""

    @abc.abstractmethod
    def step(self, iterate: Iterate, history: list[float], best: Iterate) -> tuple[Iterate, Any]:
        """Make one step.

        **Returns:** the next iterate and None; or the last one and the code of `RESULTS` that ends the fit,
        `successful`, `no_descent` or `nonfinite`.
        """

    def arrays(self, iterate: Iterate) -> dict[str, Any]:
        """Arrays of the state that a checkpoint needs besides the point."""
        return {}


class Descent(NamedTuple):
    """End of a minimisation: the iterate of lowest loss, the last one, all losses, and how it ended."""

    best: Iterate
    last: Iterate
    history: np.ndarray
    result: Any


def descend(method: Method, start: Any, watch: Watch) -> Descent:
    """Minimise by a method from `start`, a pytree of arrays, or from the watch's checkpoint, to the same numbers bit for bit.

    `watch` receives every point, the start included, and holds the largest number of steps.

    **Returns:** `Descent`, whose result is `successful`, `max_steps_reached`, `stopped`, or `nonfinite` where the loss or its
    derivatives are not finite; `watch.failed` is then that point.

    **Raises:** ValueError for a number of steps that is not positive.
    """
    if not watch.steps > 0:
        raise ValueError(f"steps is {watch.steps}; give a positive number")
    kept = watch.load()
    # The last loss of a checkpoint is evaluated again, with the same bits, and appended again.
    history: list[float] = [] if kept is None else kept["history"][:-1].tolist()
    iterate = method.init(start if kept is None else restore_leaves(kept, "point", start), kept)
    best = iterate if kept is None else Iterate(restore_leaves(kept, "best", start), float(kept["lowest"]))

    def state() -> dict[str, Any]:
        own = {"history": np.array(history), "lowest": np.float64(best.loss)}
        return own | array_leaves("point", iterate.point) | array_leaves("best", best.point) | method.arrays(iterate)

    # NaN compares false below: a point that failed never becomes the best one.
    while True:
        history.append(iterate.loss)
        best = iterate if iterate.loss <= best.loss else best
        # Before all tests for the end, so that callback and checkpoint see the last point too.
        continues = watch.continues(len(history) - 1, iterate.loss, iterate.point, state)
        if not iterate.is_finite:
            watch.failed = iterate.point
            return Descent(best, iterate, np.array(history), RESULTS.nonfinite)
        if iterate.loss <= method.floor:
            return Descent(best, iterate, np.array(history), RESULTS.successful)
        if not continues:
            return Descent(best, iterate, np.array(history), RESULTS.stopped)
        if len(history) > watch.steps:
            return Descent(best, iterate, np.array(history), RESULTS.max_steps_reached)
        following, result = method.step(iterate, history, best)
        if result is RESULTS.nonfinite:
            watch.failed = following.point
            return Descent(best, iterate, np.array(history), result)
        if result is not None:
            # A method that ends without a step returns the same iterate, whose loss is in the history already.
            if following is not iterate:
                history.append(following.loss)
                best = following if following.loss <= best.loss else best
            return Descent(best, following, np.array(history), result)
        iterate = following


def array_leaves(name: str, tree: Any) -> dict[str, Any]:
    """Arrays of a pytree by names for a checkpoint."""
    # Three digits make the alphabetical order of the names that of the leaves.
    return {f"{name}_{i:03d}": leaf for i, leaf in enumerate(jax.tree.leaves(eqx.filter(tree, eqx.is_array)))}


def restore_leaves(kept: dict[str, np.ndarray], name: str, like: Any) -> Any:
    """A pytree with the arrays of a checkpoint; structure and other leaves are those of `like`."""
    arrays, rest = eqx.partition(like, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    restored = [jnp.asarray(kept[f"{name}_{i:03d}"], leaf.dtype) for i, leaf in enumerate(leaves)]
    return eqx.combine(jax.tree.unflatten(structure, restored), rest)


class _OneThread(contextlib.ContextDecorator):
    """Decorator of functions while which numpy's and scipy's linear algebra keeps to one thread."""

    # The limit is one of the process. Of calls that overlap, in several threads, the first one sets it and the last one lifts it:
    # each for itself would take the limit of another one for the user's.
    lock, running = threading.Lock(), 0
    limit: Any = None

    def __enter__(self):
        with self.lock:
            if not self.running:
                self.limit = threadpool_limits(limits=1, user_api="blas")
            self.running += 1

    def __exit__(self, *_):
        with self.lock:
            self.running -= 1
            if not self.running:
                self.limit.restore_original_limits()


on_one_thread = _OneThread()
