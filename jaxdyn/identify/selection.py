"""Smoothing velocity, loss, extra torque terms and prior weight by cross-validation over logs, or over blocks of them.

Every setting is fitted with one part of the blocks left out in turn, and judged by its error there: the mean over the torques of
the logarithm of their squared errors, which asks for the same share of improvement of a wrist as of a shoulder.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.condensed import Blocks
from jaxdyn.identify.one_fit import Setting

VELOCITIES = (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1)
PRIORS = (0.1, 1.0, 10.0, 100.0, 1000.0)
# Thresholds of Huber's loss, in standard deviations: 1.345 is the usual one, 3 leaves all but outliers alone.
ROBUST = (None, 3.0, 1.345)
_FOLDS = 5
# A term stays at a joint where it lowers the squared error on what was left out by this share, and in most of the parts.
_WORTH, _MOST = 0.01, 0.6


class Trial(NamedTuple):
    """One setting that was tried: squared errors (folds, nv) on the parts left out, and the error over all in per cent."""

    setting: Setting
    squares: np.ndarray
    percent: float

    @property
    def score(self) -> float:
        """Mean logarithm of the squared errors of the torques; lower is better."""
        return float(np.mean(np.log(np.maximum(self.squares.sum(axis=0), 1e-300))))


class Choice(NamedTuple):
    """The setting chosen, and every one that was tried, in order."""

    setting: Setting
    trials: tuple[Trial, ...]
    by: str


def folds(blocks: Blocks) -> tuple[list[np.ndarray], str]:
    """Parts to leave out, as arrays of numbers of blocks, and in words: the logs if there are three, else pieces of them.

    **Raises:** ValueError for fewer blocks than two.
    """
    count = len(blocks)
    if count < 2:
        raise ValueError("the logs are too short to leave a part of them out; give v_s, terms and prior as numbers")
    if len(set(blocks.logs.tolist())) >= 3:
        return [np.flatnonzero(blocks.logs == which) for which in np.unique(blocks.logs)], "logs"
    parts = np.array_split(np.arange(count), min(_FOLDS, count))
    return parts, f"{len(parts)} parts of consecutive samples"


class Search:
    """Trials of settings, none of them twice. `fit(setting, left out)` gives squared errors (nv,) on the blocks left out."""

    def __init__(self, fit: Callable, parts: Sequence[np.ndarray], torque: float, callback: Callable | None = None):
        self._fit, self._parts, self._torque, self._callback = fit, parts, torque, callback
        self.trials: dict[Setting, Trial] = {}

    def __call__(self, setting: Setting) -> Trial:
        """The trial of a setting."""
        if setting not in self.trials:
            squares = np.array([self._fit(setting, part) for part in self._parts])
            trial = Trial(setting, squares, 100 * float(np.sqrt(squares.sum() / self._torque)))
            self.trials[setting] = trial
            if self._callback is not None:
                self._callback(trial)
        return self.trials[setting]

    def best(self, settings: Sequence[Setting]) -> Setting:
        """The best of some settings."""
        return min(settings, key=lambda setting: self(setting).score)


def search(
    search: Search,
    start: Setting,
    extra: Sequence[str],
    nv: int,
    *,
    velocities=VELOCITIES,
    priors=PRIORS,
    losses=ROBUST,
) -> Setting:
    """Coordinate descent: v_s, the loss, terms joint by joint in order of what they gain, the prior, v_s and the loss again."""
    setting = search.best([start._replace(v_s=v_s) for v_s in velocities])
    setting = search.best([setting._replace(robust=threshold) for threshold in losses])
    remaining = list(extra)
    while remaining:
        before = search(setting)
        trials = []
        for name in remaining:
            tried = search(setting._replace(extra=(*setting.extra, (name, tuple(range(nv))))))
            joints = helped(before.squares, tried.squares)
            if joints:
                trials.append(setting._replace(extra=(*setting.extra, (name, joints))))
        if not trials:
            break
        following = search.best(trials)
        if search(following).score >= before.score:
            break
        setting = following
        remaining.remove(setting.extra[-1][0])
    setting = search.best([setting._replace(prior=prior) for prior in priors])
    setting = search.best([setting._replace(v_s=v_s) for v_s in velocities])
    return search.best([setting._replace(robust=threshold) for threshold in losses])


def helped(before: np.ndarray, after: np.ndarray, worth: float = _WORTH) -> tuple[int, ...]:
    """Numbers of the torques whose squared errors (folds, nv) fell by the share `worth`, and in most of the parts."""
    total = after.sum(axis=0) < (1 - worth) * before.sum(axis=0)
    often = np.mean(after < before, axis=0) >= _MOST
    return tuple(int(joint) for joint in np.flatnonzero(total & often))
