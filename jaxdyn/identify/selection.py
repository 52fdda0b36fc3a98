"""Smoothing velocity, loss, extra torque terms and prior weight by cross-validation over logs, or over blocks of them.

Every setting is fitted with one part of the blocks left out in turn, and scored by its error there: the mean over the torques of
the logarithm of their squared errors, which asks for the same relative improvement of a wrist as of a shoulder.

The lowest score alone would overfit: among dozens of settings one is best by chance, and logs of some seconds hold few
independent samples. A setting that adds something to the plain fit is therefore taken only where it is clearly better:

- a term, at joints with errors that are not white, as white errors hold nothing that a term could explain, and where it lowers
  the squared errors by one per cent and in most of the folds;
- a robust loss, where errors have heavier tails than normal ones, and it lowers the squared errors of blocks by one per cent in
  the mean and by more than its standard error; another v_s than the default in the same way.

The weight of the prior is the best one: it adds nothing, and on recorded robots the strongest prior within one standard error
predicts other logs by some per cent worse.

Source: Breiman, Friedman, Olshen & Stone (1984), "Classification and regression trees", section 3.4.3, the one-standard-error
rule; Hastie, Tibshirani & Friedman (2009), "The elements of statistical learning", section 7.10; Bartlett (1955), the cumulative
periodogram.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.condensed import Blocks
from jaxdyn.identify.condensed_fit import Setting

VELOCITIES = (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1)
# Factors by which v_s is refined between two of these, in turn.
# Neighbours on the grid differ by about 3; each factor halves the remaining step in logarithms.
_REFINEMENTS = (3**0.5, 3**0.25, 3**0.125)
PRIORS = (0.1, 1.0, 10.0, 100.0, 1000.0)
# Thresholds of Huber's loss, in standard deviations: 1.345 is the usual one, 3 leaves all but outliers alone.
ROBUST = (None, 3.0, 1.345)
# Hastie et al. (section 7.10) recommend five or ten: a compromise between bias and variance of the estimated error.
_FOLDS = 5
# Least decrease of the squared error of left-out blocks for which a term, a loss or another v_s is worth its while.
_LEAST = 0.01
# Share of the folds in which a term must lower the squared error of a joint.
_MOST = 0.6


class Trial(NamedTuple):
    """One setting with the squared errors (blocks, nv) of blocks that the fit did not see, and their sum in per cent."""

    setting: Setting
    squares: np.ndarray
    percent: float

    @property
    def score(self) -> float:
        """Mean logarithm of the squared errors of the torques; lower is better."""
        # The floor keeps the score of a noise-free log finite.
        return float(np.mean(np.log(np.maximum(self.squares.sum(axis=0), 1e-300))))


class Choice(NamedTuple):
    """The setting chosen, and every one that was tried, in order."""

    setting: Setting
    trials: tuple[Trial, ...]
    by: str


def folds(blocks: Blocks) -> tuple[list[np.ndarray], str]:
    """Cross-validation folds, as arrays of block indices, and their description: the logs if there are three, else parts of them.

    **Raises:** ValueError for fewer blocks than two.
    """
    count = len(blocks)
    if count < 2:
        raise ValueError("the logs are too short to leave a part of them out; give v_s, terms and prior as numbers")
    # Blocks of one log share its motion and its drift; a log that was left out is an independent test.
    if len(set(blocks.logs.tolist())) >= 3:
        return [np.flatnonzero(blocks.logs == which) for which in np.unique(blocks.logs)], "logs"
    # Consecutive, not random: errors of neighbouring blocks are correlated, and neighbours would give left-out blocks away.
    parts = np.array_split(np.arange(count), min(_FOLDS, count))
    return parts, f"{len(parts)} parts of consecutive samples"


class Search:
    """Trials of settings, each once.

    `fit` maps a list of pairs (setting, blocks) to their squared errors (blocks, nv), of fits to all other blocks.
    """

    def __init__(self, fit: Callable, parts: Sequence[np.ndarray], torque: float, callback: Callable | None = None):
        self._fit, self._parts, self._torque, self._callback = fit, parts, torque, callback
        self.trials: dict[Setting, Trial] = {}

    def __call__(self, setting: Setting) -> Trial:
        """Trial of a setting, from memory if there was one."""
        self.run([setting])
        return self.trials[setting]

    def run(self, settings: Sequence[Setting]) -> None:
        """Run the trials of these settings that are missing, as one list of independent fits."""
        # dict.fromkeys removes repeated settings and keeps their order, which a set would not.
        missing = [setting for setting in dict.fromkeys(settings) if setting not in self.trials]
        errors = iter(self._fit([(setting, part) for setting in missing for part in self._parts]))
        for setting in missing:
            squares = np.concatenate([next(errors) for _ in self._parts])
            trial = Trial(setting, squares, 100 * float(np.sqrt(squares.sum() / self._torque)))
            self.trials[setting] = trial
            if self._callback is not None:
                self._callback(trial)

    def best(self, settings: Sequence[Setting]) -> Setting:
        """The best of some settings."""
        self.run(settings)
        return min(settings, key=lambda setting: self(setting).score)

    def simplest(self, plain: Setting, settings: Sequence[Setting]) -> Setting:
        """The best of some settings where it is clearly better than the plain one, else that one."""
        best = self.best(settings)
        return best if self.is_better(plain, best) else plain

    def is_better(self, plain: Setting, other: Setting) -> bool:
        """Decide whether a setting clearly predicts blocks better than another one.

        By the logarithms of each block's squared errors: of the sums, a collision in one block is nearly all, with any loss.
        """
        before, after = (np.maximum(self(one).squares, 1e-300) for one in (plain, other))
        gains = np.mean(np.log(before / after), axis=1)
        # One-standard-error rule: the best of many settings is better by chance, by about the standard error.
        return bool(gains.mean() > max(_LEAST, standard_error(gains)))

    def improving_torques(self, before: Setting, after: Setting) -> tuple[int, ...]:
        """Indices of the torques that a setting predicts better than another one, as `improving_torques`."""
        # A trial holds its blocks fold after fold, so that reduceat sums each fold.
        edges = np.cumsum([0, *map(len, self._parts)])[:-1]
        sums = [np.add.reduceat(self(one).squares, edges, axis=0) for one in (before, after)]
        return improving_torques(sums[0], sums[1])


def search(
    search: Search,
    start: Setting,
    extra: Sequence[str],
    candidates: Callable[[Setting], Sequence[int]],
    has_outliers: Callable[[Setting], bool],
    *,
    velocities=VELOCITIES,
    priors=PRIORS,
    losses=ROBUST,
) -> Setting:
    """Coordinate descent over v_s, the loss, terms joint by joint in order of their gains, the prior, v_s and the loss again.

    `candidates`: from a setting to the indices of the torques that may get another term; `has_outliers`: whether its errors
    have tails for which a robust loss may help.
    """
    setting = _choose_velocity(search, start, velocities)
    setting = _choose_loss(search, setting, losses, has_outliers)
    remaining = list(extra)
    while remaining and (joints := tuple(candidates(setting))):
        trials = []
        search.run([setting, *(setting._replace(extra=(*setting.extra, (name, joints))) for name in remaining)])
        for name in remaining:
            improved = search.improving_torques(setting, setting._replace(extra=(*setting.extra, (name, joints))))
            if improved:
                trials.append(setting._replace(extra=(*setting.extra, (name, improved))))
        if not trials:
            break
        following = search.best(trials)
        # Joints were chosen by their own errors; the score over all torques must decrease too.
        if search(following).score >= search(setting).score:
            break
        setting = following
        remaining.remove(setting.extra[-1][0])
    setting = search.best([setting._replace(prior=prior) for prior in priors])
    setting = _choose_velocity(search, setting, velocities)
    return _choose_loss(search, setting, losses, has_outliers)


def _choose_velocity(search: Search, setting: Setting, velocities) -> Setting:
    """The setting with another v_s where one is clearly better, refined between the values of the grid.

    A value that is off by half a step of the grid leaves errors at reversals that Dahl's friction and robust losses would fit.
    """
    best = search.simplest(setting, [setting._replace(v_s=v_s) for v_s in velocities])
    for step in _REFINEMENTS if best.v_s != setting.v_s else ():
        best = search.best([best, *(best._replace(v_s=v_s) for v_s in (best.v_s * step, best.v_s / step))])
    return best


def _choose_loss(search: Search, setting: Setting, losses, has_outliers: Callable[[Setting], bool]) -> Setting:
    """Squares, unless errors have heavy tails and a robust loss is clearly better; the best of losses without squares."""
    settings = [setting._replace(robust=threshold) for threshold in losses]
    plain = [one for one in settings if one.robust is None]
    if not plain:
        return search.best(settings)
    return search.simplest(plain[0], settings) if len(settings) > 1 and has_outliers(setting) else plain[0]


def improving_torques(before: np.ndarray, after: np.ndarray, least: float = _LEAST) -> tuple[int, ...]:
    """Indices of the torques whose squared errors (folds, nv) decrease by the share `least` of their sum, and in most folds.

    The least share excludes gains that are real and useless.
    """
    is_large = after.sum(axis=0) < (1 - least) * before.sum(axis=0)
    return tuple(int(joint) for joint in np.flatnonzero(is_large & (np.mean(after < before, axis=0) >= _MOST)))


def standard_error(gains: np.ndarray) -> float:
    """Standard error of the mean of gains (blocks,), from their scatter."""
    # Of paired differences: blocks that are hard for both settings do not add to the scatter.
    return float(gains.std(ddof=1) / np.sqrt(len(gains)))
