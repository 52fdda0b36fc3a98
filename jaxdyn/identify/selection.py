"""Smoothing velocity, loss, extra torque terms and prior weight by cross-validation over logs, or over blocks of them.

Every setting is fitted with one part of the blocks left out in turn, and scored by its error there: the mean over the torques of
the logarithm of their squared errors, which asks for the same relative improvement of a wrist as of a shoulder.

The lowest score alone would overfit: among dozens of settings one is best by chance. A setting that adds something to the plain
fit (a term at a joint, a robust loss) is therefore taken only where it lowers the errors by several standard errors of their
paired differences over the blocks; one standard error is the usual rule for a single comparison.

Source: Breiman, Friedman, Olshen & Stone (1984), "Classification and regression trees", section 3.4.3, the one-standard-error
rule; Hastie, Tibshirani & Friedman (2009), "The elements of statistical learning", section 7.10.
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
# A term is kept at a joint where it lowers the squared error of the left-out blocks by this share, and by so many standard
# errors of the paired differences.
_WORTH, _ERRORS = 0.01, 3.0


class Trial(NamedTuple):
    """One setting with the squared errors (blocks, nv) of blocks that the fit did not see, and their sum in per cent."""

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
            squares = np.concatenate([self._fit(setting, part) for part in self._parts])
            trial = Trial(setting, squares, 100 * float(np.sqrt(squares.sum() / self._torque)))
            self.trials[setting] = trial
            if self._callback is not None:
                self._callback(trial)
        return self.trials[setting]

    def best(self, settings: Sequence[Setting]) -> Setting:
        """The best of some settings."""
        return min(settings, key=lambda setting: self(setting).score)

    def simplest(self, plain: Setting, settings: Sequence[Setting]) -> Setting:
        """The best of some settings where it is clearly better than the plain one, else that one."""
        best = self.best(settings)
        return best if is_clear(self.gains(plain, best)) else plain

    def gains(self, plain: Setting, other: Setting) -> np.ndarray:
        """Decrease of the score from one setting to another by block, to first order."""
        before, after = self(plain), self(other)
        # Relative to each torque's own sum, so that one torque counts as much as another.
        return np.mean((before.squares - after.squares) / np.maximum(before.squares.sum(axis=0), 1e-300), axis=1)


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
    setting = choose_velocity(search, start, velocities)
    setting = choose_loss(search, setting, losses)
    remaining = list(extra)
    while remaining:
        before = search(setting)
        trials = []
        for name in remaining:
            tried = search(setting._replace(extra=(*setting.extra, (name, tuple(range(nv))))))
            joints = improving_torques(before.squares, tried.squares)
            if joints:
                trials.append(setting._replace(extra=(*setting.extra, (name, joints))))
        if not trials:
            break
        following = search.best(trials)
        if search(following).score >= before.score:
            break
        setting = following
        remaining.remove(setting.extra[-1][0])
    setting = choose_prior(search, setting, priors)
    setting = choose_velocity(search, setting, velocities)
    return choose_loss(search, setting, losses)

_V, _P = "best", "best"

def choose_velocity(search, setting, velocities):
    settings = [setting._replace(v_s=v_s) for v_s in velocities]
    return search.best(settings) if _V == "best" else search.simplest(setting, settings)

def choose_prior(search, setting, priors):
    settings = [setting._replace(prior=x) for x in priors]
    best = search.best(settings)
    if _P == "best": return best
    if _P == "plain": return search.simplest(setting, settings)
    ok = [s for s in settings if s.prior >= best.prior and not is_clear(search.gains(s, best), worth=0.0)]
    return ok[-1] if ok else best

def choose_loss(search: Search, setting: Setting, losses) -> Setting:
    """The setting with the best loss, squares unless a robust one is clearly better."""
    settings = [setting._replace(robust=threshold) for threshold in losses]
    plain = [one for one in settings if one.robust is None]
    return search.simplest(plain[0], settings) if plain else search.best(settings)


def improving_torques(before: np.ndarray, after: np.ndarray, worth: float | None = None) -> tuple[int, ...]:
    """Indices of the torques whose squared errors (blocks, nv) clearly decrease, and by the share `worth` of their sum."""
    gains = (before - after) / np.maximum(before.sum(axis=0), 1e-300)
    return tuple(int(j) for j in np.flatnonzero(is_clear(gains, worth)))


def is_clear(gains: np.ndarray, worth: float | None = None) -> np.ndarray:
    """Decide whether sums of relative gains (blocks, ...) exceed a share and some of their standard errors, from their scatter."""
    worth = _WORTH if worth is None else worth
    total = gains.sum(axis=0)
    return (total > worth) & (total > _ERRORS * np.sqrt(len(gains)) * gains.std(axis=0, ddof=1))
