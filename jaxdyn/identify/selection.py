"""Smoothing velocity, loss, extra torque terms and prior weight by cross-validation over logs, or over blocks of them.

Every setting is fitted with parts of the blocks left out in turn, and scored by its errors there (`log_errors`). Half of one or
two logs is left out, in every combination of quarters: a term that follows the temperature or the path of one log must predict
samples that are far away in time.

The lowest score alone would overfit: among dozens of settings one is best by chance, and logs of some seconds hold few
independent samples. A setting that adds something to the plain fit is therefore taken only where it is clearly better:

- a term, at joints with errors that are not white, as white errors hold nothing that a term could explain, and where it lowers
  the squared errors by one per cent and in most of the splits;
- another v_s than the default, where it lowers the squared errors of blocks by one per cent in the mean (a larger one by 20), by
  more than its standard error, and in most of the splits;
- a robust loss, where errors have heavier tails than normal ones, and it lowers the squared errors of one half of the logs in the
  same way, and their sum, fitted to the other half with weights of samples from there alone.

The weight of the prior is the best one: it adds nothing, and on recorded robots the strongest prior within one standard error
predicts other logs by some per cent worse.

Source: Breiman, Friedman, Olshen & Stone (1984), "Classification and regression trees", section 3.4.3, the one-standard-error
rule; Hastie, Tibshirani & Friedman (2009), "The elements of statistical learning", section 7.10; Bartlett (1955), the cumulative
periodogram.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.condensed_fit import Setting
from jaxdyn.identify.regression import Blocks

VELOCITIES = (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1)
# Factors by which v_s is refined between two of these, in turn.
# Neighbours on the grid differ by about 3; each factor halves the remaining step in logarithms.
_REFINEMENTS = (3**0.5, 3**0.25, 3**0.125)
PRIORS = (0.01, 0.1, 1.0, 10.0, 100.0, 1000.0)
# Thresholds of Huber's loss, in standard deviations: 1.345 is the usual one, 3 leaves all but outliers alone.
ROBUST = (None, 3.0, 1.345)
# Quarters of the logs: half of them predict the other half, in every combination.
_QUARTERS = 4
# Least decrease of the squared error of left-out blocks for which a term, a loss or another v_s is worth its while.
_LEAST = 0.01
# The same for a v_s above the default.
_CURVE = 0.2
# Share of the splits in which a term must lower the squared error of a joint: five of six.
_MOST = 0.8


class Trial(NamedTuple):
    """One setting with the squared errors (blocks, nv) of blocks that the fit did not see, and their sum in per cent.

    `by_split` (splits, nv): the sums over the blocks left out in each split.
    """

    setting: Setting
    squares: np.ndarray
    by_split: np.ndarray
    percent: float

    @property
    def score(self) -> float:
        """`log_errors` of all blocks together; lower is better."""
        return float(log_errors(self.squares.sum(axis=0)))


def log_errors(squares: np.ndarray) -> np.ndarray:
    """Logarithm (...) of squared errors (..., nv): half that of their sum, half the mean over the torques.

    The sum counts newton metres, so that shoulders decide; the mean asks for the same relative improvement of a wrist.
    """
    # The floor keeps the score of a noise-free log finite.
    squares = np.maximum(squares, 1e-300)
    return np.asarray((np.log(squares.sum(axis=-1)) + np.log(squares).mean(axis=-1)) / 2)


class Choice(NamedTuple):
    """The setting chosen, and every one that was tried, in order."""

    setting: Setting
    trials: tuple[Trial, ...]
    by: str


def splits(blocks: Blocks) -> tuple[list[np.ndarray], str]:
    """Blocks left out in turn, as arrays of indices, and their description: the logs if there are three, else halves.

    **Raises:** ValueError for fewer blocks than two.
    """
    count = len(blocks)
    if count < 2:
        raise ValueError("the logs are too short to leave a part of them out; give v_s, terms and prior as numbers")
    # Blocks of one log share its motion and its drift; a log that was left out is an independent test.
    if len(set(blocks.logs.tolist())) >= 3:
        return [np.flatnonzero(blocks.logs == which) for which in np.unique(blocks.logs)], "logs"
    # With one part of five left out, its neighbours on both sides have nearly its temperature and its path: terms that follow
    # these predict it, and fail on another log. Half of the log must predict the half that is far away.
    quarters = np.array_split(np.arange(count), min(_QUARTERS, count))
    chosen = itertools.combinations(range(len(quarters)), len(quarters) // 2)
    parts = [np.concatenate([quarters[k] for k in pair]) for pair in chosen]
    return parts, f"{len(parts)} halves of the samples"


class Search:
    """Trials of settings, each once.

    `fit` maps a list of pairs (setting, blocks) to their squared errors (blocks, nv), of fits to all other blocks.
    """

    def __init__(self, fit: Callable, parts: Sequence[np.ndarray], torque: float, callback: Callable | None = None):
        self._fit, self._parts, self._torque, self._callback = fit, parts, torque, callback
        self._count = 1 + max(int(part.max()) for part in parts)
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
            squares = [next(errors) for _ in self._parts]
            # A block is left out in several splits: the mean over these.
            total, count = np.zeros((self._count, squares[0].shape[1])), np.zeros(self._count)
            for part, own in zip(self._parts, squares, strict=True):
                total[part] += own
                count[part] += 1
            total /= count[:, None]
            percent = 100 * float(np.sqrt(total.sum() / self._torque))
            trial = Trial(setting, total, np.stack([own.sum(axis=0) for own in squares]), percent)
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
        """Decide whether a setting clearly predicts blocks better than another one, and most of the splits too."""
        gains = log_errors(self(plain).by_split) - log_errors(self(other).by_split)
        # A wide v_s is a curve of friction over the speeds of these logs, and is wrong at others, so that it must gain much.
        least = _CURVE if other.v_s > plain.v_s else _LEAST
        return bool(np.mean(gains > 0) >= _MOST) and is_clear(self(plain).squares, self(other).squares, least)

    def improving_torques(self, before: Setting, after: Setting) -> tuple[int, ...]:
        """Indices of the torques that a setting predicts better than another one, as `improving_torques`."""
        return improving_torques(self(before).by_split, self(after).by_split)


def search(
    search: Search,
    start: Setting,
    extra: Sequence[str],
    candidates: Callable[[Setting], Sequence[int]],
    loss_squares: Callable[[Setting, Sequence[Setting]], list[np.ndarray] | None],
    *,
    velocities=VELOCITIES,
    priors=PRIORS,
    losses=ROBUST,
) -> Setting:
    """Coordinate descent over v_s, the loss, the prior, terms joint by joint in order of their gains, and the first three again.

    `candidates`: from a setting to the indices of the torques that may get another term; `loss_squares`: squared errors (blocks,
    nv) for each of some losses, or None where the errors have no tails for which a robust loss may help.
    """
    setting = _choose_velocity(search, start, velocities)
    setting = _choose_loss(search, setting, losses, loss_squares)
    # Terms at a prior that is too strong would explain what it withholds from the bodies.
    setting = search.best([setting._replace(prior=prior) for prior in priors])
    remaining = list(extra)
    while remaining and (joints := tuple(candidates(setting))):
        trials = []
        search.run([setting, *(setting._replace(extra=(*setting.extra, (name, joints))) for name in remaining)])
        for name in remaining:
            improved = search.improving_torques(setting, setting._replace(extra=(*setting.extra, (name, joints))))
            # Errors of other joints decrease too, as they share the bodies: they do not get the term.
            improved = tuple(joint for joint in improved if joint in joints)
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
    return _choose_loss(search, setting, losses, loss_squares)


def _choose_velocity(search: Search, setting: Setting, velocities) -> Setting:
    """The setting with another v_s where one is clearly better, refined between the values of the grid.

    A value that is off by half a step of the grid leaves errors at reversals that Dahl's friction and robust losses would fit.
    """
    best = search.simplest(setting, [setting._replace(v_s=v_s) for v_s in velocities])
    for step in _REFINEMENTS if best.v_s != setting.v_s else ():
        best = search.best([best, *(best._replace(v_s=v_s) for v_s in (best.v_s * step, best.v_s / step))])
    return best


def _choose_loss(search: Search, setting: Setting, losses, loss_squares: Callable) -> Setting:
    """Squares, unless errors have heavy tails and a robust loss is clearly better; the best of losses without squares."""
    settings = [setting._replace(robust=threshold) for threshold in losses]
    if len(settings) == 1:
        return settings[0]
    if all(one.robust is not None for one in settings):
        return search.best(settings)
    squares = loss_squares(setting, settings)
    if squares is None:
        return setting._replace(robust=None)
    plain = next(k for k, one in enumerate(settings) if one.robust is None)
    best = min(range(len(settings)), key=lambda k: np.sum(log_errors(squares[k])))
    # Blocks without the rare large errors can all gain while the sum over all samples, which counts these, grows.
    is_lower = squares[best].sum() < squares[plain].sum()
    return settings[best if is_lower and is_clear(squares[plain], squares[best]) else plain]


def is_clear(before: np.ndarray, after: np.ndarray, least: float = _LEAST) -> bool:
    """Decide whether squared errors (blocks, nv) decrease by the share `least` and beyond the standard error of the decrease.

    By the logarithms of each block: of the sums, a collision in one block is nearly all, with any loss.
    """
    gains = log_errors(before) - log_errors(after)
    # One-standard-error rule: the best of many settings is better by chance, by about the standard error.
    return bool(gains.mean() > max(least, standard_error(gains)))


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
