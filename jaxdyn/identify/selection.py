"""Smoothing velocity, loss, extra torque terms and prior weight by cross-validation over logs, or over blocks of them.

Every setting is fitted with one part of the blocks left out in turn, and compared by its error there: the mean over the torques of
the logarithm of their squared errors, which asks for the same share of improvement of a wrist as of a shoulder.

Held-out errors are random, so the best of forty settings is better than the simplest one by chance. A simple setting is therefore
left only for an improvement that groups of blocks agree upon:

- v_s and the weight of the prior: by more than one standard error of the difference (Breiman et al. 1984).
- a term at a joint, and Huber's loss: by more than Student's t at 5 % shared among all terms, joints and losses that are tried
  (Bonferroni), and by more than 1 % of the squared error. One standard error would accept one useless term in six.

Source: Breiman, Friedman, Olshen & Stone (1984), "Classification and regression trees", section 3.4.3; Hastie, Tibshirani &
Friedman (2009), "The elements of statistical learning", section 7.10.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.condensed import Blocks
from jaxdyn.identify.jackknife import block_groups
from jaxdyn.identify.one_fit import Setting

VELOCITIES = (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1)
PRIORS = (0.1, 1.0, 10.0, 100.0, 1000.0)
# Thresholds of Huber's loss, in standard deviations: 1.345 is the usual one, 3 leaves all but outliers alone.
ROBUST = (None, 3.0, 1.345)
_FOLDS = 5
# A term stays at a joint where it lowers the squared error on what was left out by this share, and in most of the parts.
_WORTH, _MOST = 0.01, 0.6
# Probability that any useless term or loss is accepted.
_LEVEL = 0.05


class Trial(NamedTuple):
    """One setting that was tried: squared errors (folds, nv) on the parts left out, and the error over all in per cent.

    `groups` (groups, nv): the same squared errors by groups of consecutive blocks, from whose scatter standard errors come.
    """

    setting: Setting
    squares: np.ndarray
    percent: float
    groups: np.ndarray

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
    """Trials of settings, none of them twice.

    `fit(setting, left out)` gives squared errors (blocks, nv) on the blocks left out; `samples`: how many independent errors the
    logs hold (`effective_samples`), which says how many blocks make a group.
    """

    def __init__(
        self, fit: Callable, parts: Sequence[np.ndarray], torque: float, samples: float, callback: Callable | None = None
    ):
        self._fit, self._parts, self._torque, self._callback = fit, parts, torque, callback
        self._groups = block_groups(sum(map(len, parts)), samples)
        self.trials: dict[Setting, Trial] = {}

    def __call__(self, setting: Setting) -> Trial:
        """The trial of a setting."""
        if setting not in self.trials:
            errors = [np.asarray(self._fit(setting, part)) for part in self._parts]
            blocks = np.concatenate(errors)
            squares = np.array([part.sum(axis=0) for part in errors])
            groups = np.array([blocks[group].sum(axis=0) for group in self._groups])
            trial = Trial(setting, squares, 100 * float(np.sqrt(squares.sum() / self._torque)), groups)
            self.trials[setting] = trial
            if self._callback is not None:
                self._callback(trial)
        return self.trials[setting]

    def best(self, settings: Sequence[Setting]) -> Setting:
        """The best of some settings."""
        return min(settings, key=lambda setting: self(setting).score)

    def better(self, simple: Setting, settings: Sequence[Setting], errors: float, worth: float = 0.0) -> Setting:
        """The best of some settings if it is better than the simple one by so many standard errors, else the simple one."""
        best = self.best([simple, *settings])
        before, after = self(simple), self(best)
        gain, error = score_gain(before.groups, after.groups)
        return best if gain > max(errors * error, worth) and after.score < before.score else simple


def score_gain(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Mean relative reduction of squared errors (groups, nv) over the torques, and its standard error.

    To first order the reduction of the score, of which every group of blocks holds a part.
    """
    total = np.maximum(before.sum(axis=0), 1e-300)
    parts = np.mean((before - after) / total, axis=1)
    return float(parts.sum()), float(np.sqrt(len(parts)) * np.std(parts, ddof=1))


def acceptance(candidates: int, groups: int) -> float:
    """Standard errors of an improvement from which on it is accepted, one of so many candidates (Bonferroni, Student's t)."""
    from scipy.special import stdtrit

    return float(stdtrit(max(groups - 1, 1), 1 - _LEVEL / max(candidates, 1)))


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
    candidates = len(extra) * nv + len(losses) - 1
    strict = acceptance(candidates, len(search(start).groups))

    def velocity(setting):
        return search.better(setting, [setting._replace(v_s=v_s) for v_s in velocities], 1.0)

    def loss(setting):
        plain = setting._replace(robust=losses[0])
        return search.better(plain, [setting._replace(robust=threshold) for threshold in losses], strict, _WORTH)

    setting = loss(velocity(start))
    remaining = list(extra)
    while remaining:
        before = search(setting)
        trials = []
        for name in remaining:
            tried = search(setting._replace(extra=(*setting.extra, (name, tuple(range(nv))))))
            joints = helped(before.squares, tried.squares)
            joints = tuple(j for j in joints if is_significant(before.groups[:, j], tried.groups[:, j], strict))
            if joints:
                trials.append(setting._replace(extra=(*setting.extra, (name, joints))))
        if not trials:
            break
        following = search.best(trials)
        if search(following).score >= before.score:
            break
        setting = following
        remaining.remove(setting.extra[-1][0])
    setting = search.better(setting, [setting._replace(prior=prior) for prior in priors], 1.0)
    return loss(velocity(setting))


def is_significant(before: np.ndarray, after: np.ndarray, errors: float) -> bool:
    """Whether squared errors (groups,) fell by more than so many standard errors of their difference."""
    gain, error = score_gain(before[:, None], after[:, None])
    return gain > errors * error


def helped(before: np.ndarray, after: np.ndarray, worth: float = _WORTH) -> tuple[int, ...]:
    """Numbers of the torques whose squared errors (folds, nv) fell by the share `worth`, and in most of the parts."""
    total = after.sum(axis=0) < (1 - worth) * before.sum(axis=0)
    often = np.mean(after < before, axis=0) >= _MOST
    return tuple(int(joint) for joint in np.flatnonzero(total & often))
