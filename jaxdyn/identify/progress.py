"""What a running fit says and when it is told to stop: every method calls one `Watch` at each of its points."""

import sys
import time
from collections.abc import Callable
from typing import Any

from jaxdyn.identify.checkpoint import Checkpoint


class Watch:
    """Calls the user's function, shows progress, keeps checkpoints, and says whether to go on.

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
        self.begun, self.first, self.said = time.monotonic(), None, 0.0
        self.failed: Any = None  # the point whose errors were not finite, where that ended the fit

    def load(self) -> dict | None:
        """The state to go on from."""
        return None if self.checkpoint is None else self.checkpoint.load()

    def goes_on(self, step: int, loss: float, point: Any, state: Callable[[], dict]) -> bool:
        """Report a point; False when the fit is to stop there. `state()` is what a checkpoint holds."""
        stopped = self.callback is not None and self.callback(step, loss, point) is True
        now = time.monotonic()
        stopped = stopped or (self.seconds is not None and now - self.begun > self.seconds)
        if self.first is None:
            self.first = (step, now)
        if self.show and (now - self.said > 0.5 or stopped):
            self.said = now
            print(self.line(step, loss, now), file=sys.stderr, flush=True)
        if self.checkpoint is not None:
            self.checkpoint.save(step, state(), last=stopped)
        return not stopped

    def line(self, step: int, loss: float, now: float) -> str:
        """The point in words."""
        begin, at = self.first or (step, now)
        left = ""
        if step > begin:
            left = f", at most {(now - at) / (step - begin) * (self.steps - step):.0f} s left"
        return f"step {step} of at most {self.steps}: loss {loss:.6g}, {now - self.begun:.1f} s{left}"
