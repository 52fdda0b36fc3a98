"""A meter of progress, with rate and time left, on standard error."""

import sys
import time
from typing import TextIO


class Progress:
    """Progress meter: one line that is rewritten on a terminal, a line every `every` seconds elsewhere.

    `before`: number of the `total` rollouts that were stored before; the rate is that of this call.
    """

    def __init__(self, total: int, before: int, *, shown: bool = True, every: float = 10.0, file: TextIO | None = None):
        self.total, self.before, self.computed, self.failed = total, before, 0, 0
        self._file = sys.stderr if file is None else file
        self._shown, self._terminal = shown, self._file.isatty()
        # A log file gets few lines, a terminal a meter that moves.
        self._every = 0.2 if self._terminal else every
        self._start = self._last = time.monotonic()

    def add(self, computed: int, failed: int) -> None:
        """Count stored rollouts."""
        self.computed += computed
        self.failed += failed
        if time.monotonic() - self._last >= self._every:
            self._write("" if self._terminal else "\n")

    def note(self, text: str) -> None:
        """Print a line."""
        if self._shown:
            print(f"{chr(13) if self._terminal else ''}{text}", file=self._file, flush=True)

    def end(self) -> None:
        """Print the last line."""
        self._write("\n")

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._start

    def __str__(self) -> str:
        # Damaged chunks that are computed again were counted in `before`.
        done = min(self.before + self.computed, self.total)
        text = f"{100 * done / self.total:5.1f} %, {done} of {self.total} rollouts"
        if self.computed:
            rate = self.computed / max(self.seconds, 1e-9)
            text += f", {rate:.3g}/s"
            if done < self.total:
                text += f", {_duration((self.total - done) / rate)} left"
        return text + (f", {self.failed} failed" if self.failed else "")

    def _write(self, end: str) -> None:
        self._last = time.monotonic()
        if self._shown:
            print(f"{chr(13) if self._terminal else ''}{self!s:<78}", end=end, file=self._file, flush=True)


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
