"""Selection of smoothing velocity, loss, extra torque terms and prior weight, and intervals that include terms left out.

The selection is by cross-validation over logs, or over blocks of them.

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

A term left out moves the parameters that imitate it: half a per cent of the torque can hide ten standard deviations of viscous
friction. The scatter over blocks shows nothing of it, as the errors that remain look the same in each of them. For every term
of `EXTRA` at every joint the fit with it follows from the condensed logs by one Newton step. Where the 95 % interval of its
coefficient excludes zero, the intervals become those that hold both fits' intervals, also for the clearest terms of all joints
together. Only terms that differ from zero at a stricter level are named: with so many tests some exceed the first one by
chance. At the stricter level alone a term that is there and just fails the test leaves intervals that are too narrow (Bancroft
1944).

Source: Breiman, Friedman, Olshen & Stone (1984), "Classification and regression trees", section 3.4.3, the one-standard-error
rule; Hastie, Tibshirani & Friedman (2009), "The elements of statistical learning", section 7.10; Bartlett (1955), the cumulative
periodogram; Bancroft (1944), "On biases in estimation due to the use of preliminary tests of significance"; Leamer (1983), "Let's
take the con out of econometrics", bounds over specifications; Wooldridge (2010), section 4.3, omitted variables.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.condensed_fit import FROM_PRIOR, Data, Estimate, Intervals, Setting, Spread, local_coordinates
from jaxdyn.identify.regression import Blocks
from jaxdyn.identify.uncertainty import block_groups, invert, jackknife, psd_root, student

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
_MINIMUM = 0.01
# The same for a v_s above the default.
_CURVE = 0.2
# Share of the splits in which a term must lower the squared error of a joint: five of six.
_MAXIMUM = 0.8


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
        minimum = _CURVE if other.v_s > plain.v_s else _MINIMUM
        return bool(np.mean(gains > 0) >= _MAXIMUM) and is_clear(self(plain).squares, self(other).squares, minimum)

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
    velocities,
    priors,
    losses,
) -> Setting:
    """Coordinate descent over v_s, the loss, terms joint by joint in order of their gains, the prior, v_s and the loss again.

    `candidates`: from a setting to the indices of the torques that may get another term; `loss_squares`: squared errors (blocks,
    nv) for each of some losses, or None where the errors have no tails for which a robust loss may help.
    """
    setting = _choose_velocity(search, start, velocities)
    setting = _choose_loss(search, setting, losses, loss_squares)
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


def is_clear(before: np.ndarray, after: np.ndarray, minimum: float = _MINIMUM) -> bool:
    """Decide whether squared errors (blocks, nv) decrease by the share `minimum` and beyond the standard error of the decrease.

    By the logarithms of each block: of the sums, a collision in one block is nearly all, with any loss.
    """
    gains = log_errors(before) - log_errors(after)
    # One-standard-error rule: the best of many settings is better by chance, by about the standard error.
    return bool(gains.mean() > max(minimum, standard_error(gains)))


def improving_torques(before: np.ndarray, after: np.ndarray, minimum: float = _MINIMUM) -> tuple[int, ...]:
    """Indices of the torques whose squared errors (folds, nv) decrease by the share `minimum` of their sum, and in most folds.

    The least share excludes gains that are real and useless.
    """
    is_large = after.sum(axis=0) < (1 - minimum) * before.sum(axis=0)
    return tuple(int(joint) for joint in np.flatnonzero(is_large & (np.mean(after < before, axis=0) >= _MAXIMUM)))


def standard_error(gains: np.ndarray) -> float:
    """Standard error of the mean of gains (blocks,), from their scatter."""
    # Of paired differences: blocks that are hard for both settings do not add to the scatter.
    return float(gains.std(ddof=1) / np.sqrt(len(gains)))


# --- terms that the logs support and a fit lacks ---


# Two-sided level at which a term is named: it is asked for every term at every joint.
_LEVEL = 1e-2


class Shift(NamedTuple):
    """Effect of further terms: change of all parameters (p,), and a root (p, groups) of their covariance with them.

    The root has the scatter over groups, and the pull of the prior (n more columns). `terms`: names and indices of torques;
    `factor`: of a 95 % interval; `clearness`: largest coefficient over its standard deviation, of those that the logs determine;
    `minimum`: clearness from which on the terms are named.
    """

    terms: tuple[tuple[str, int], ...]
    change: np.ndarray
    root: np.ndarray
    factor: float
    clearness: float
    minimum: float


def find_shifts(
    data: Data, setting: Setting, estimate: Estimate, weights: np.ndarray, size: float, still: Sequence[int]
) -> list[Shift]:
    """Shifts by the terms of `data` that a setting lacks, where the logs support them; arguments as of `intervals`.

    `data` has the columns of the fit first, and then those of the terms to try.
    """
    blocks, used, variance = data.blocks, dict(setting.extra), estimate.sigma**2
    estimate = estimate._replace(x=np.append(estimate.x, np.zeros(blocks.size - len(estimate.x))))
    jacobian, curvature, _ = local_coordinates(data, setting, estimate)
    own = jacobian.shape[1]
    tried = [
        ((name, joint), places)
        for name in data.counts
        for joint in range(blocks.nv)
        if joint not in used.get(name, ()) and joint not in still
        if len(places := data.places(((name, (joint,)),)))
    ]
    places = np.concatenate([np.zeros(0, int), *(places for _, places in tried)])
    # Coefficients in their units, in which the prior has the curvature of its weight.
    columns = np.zeros((blocks.size, len(places)))
    columns[places, np.arange(len(places))] = data.units.reshape(-1)[places - data.basic]
    T = np.concatenate([jacobian, columns], axis=1)
    prior = np.diag(np.append(np.zeros(own), np.full(len(places), setting.prior)))
    prior[:own, :own] = curvature
    gradients = blocks.scores(estimate.x, weights) @ T / variance
    grams = np.einsum("pi,bpq,qj->bij", T, blocks.grams(weights), T, optimize=True) / variance
    groups = block_groups(len(grams), size)
    G, g = (np.stack([x[group].sum(axis=0) for group in groups]) for x in (grams, gradients))
    H = G.sum(axis=0) + prior
    # Unit diagonal: parameters differ by many orders of magnitude in size.
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    T, g, scale = T * unit, g * unit, unit * unit[:, None]
    # As of `intervals`: at least weight 1 counts.
    root = unit[:, None] * psd_root(prior) * np.sqrt(max(setting.prior, 1.0))
    G, H, prior = G * scale, H * scale, prior * scale

    def extend(terms: tuple[tuple[str, int], ...], new: np.ndarray) -> Shift | None:
        """Shift by the coefficients `new`, None where independent errors alone explain them."""
        kept = np.append(np.arange(own), new)
        inverse = invert(H[np.ix_(kept, kept)])
        # The fit is a minimum: of the gradient of data and prior the part of the new coefficients alone is left.
        step = -inverse[:, own:] @ g[:, new].sum(axis=0)
        # Costs no jackknife, and errs on the side of the term.
        if not np.any(np.abs(step[own:]) > 1.5 * np.sqrt(np.diag(inverse)[own:])):
            return None
        G_kept = G[:, kept][:, :, kept]
        replicates = jackknife(G_kept, g[:, kept] + G_kept @ step, prior[np.ix_(kept, kept)])
        pulled = inverse @ root[kept]
        both = np.concatenate([replicates.root, pulled], axis=1)
        # The first link's weight and a spring at its joint are one torque: only the prior tells them apart, and the logs do not.
        sizes, by_prior = np.linalg.norm(both[own:], axis=1), np.linalg.norm(pulled[own:], axis=1)
        ratios = np.abs(step[own:]) / np.maximum(sizes, 1e-300)
        clearness = float(np.max(ratios, where=by_prior**2 <= FROM_PRIOR * sizes**2, initial=0.0))
        minimum = student(len(G) - 1, _LEVEL)
        return Shift(terms, T[:, kept] @ step, T[:, kept] @ both, replicates.factor, clearness, minimum)

    ends = own + np.cumsum([len(places) for _, places in tried])
    indices = {term: np.arange(end - len(places), end) for end, (term, places) in zip(ends, tried, strict=True)}
    every = [extend((term,), new) for term, new in indices.items()]
    shifts = [shift for shift in every if shift is not None and shift.clearness > shift.factor]
    named = [shift for shift in shifts if shift.clearness > shift.minimum]
    clearest = {shift.terms[0][1]: shift.terms[0] for shift in sorted(named, key=lambda shift: shift.clearness)}
    if len(clearest) > 1:
        # A second joint's term moves the first joint's parameters too.
        both = extend(tuple(clearest.values()), np.concatenate([indices[term] for term in clearest.values()]))
        shifts += [] if both is None else [both]
    return shifts


def include_shifts(found: Intervals, shifts: Sequence[Shift], rows: np.ndarray, columns: np.ndarray) -> Intervals:
    """Intervals that hold those of the fits with one more term each.

    `rows`: indices in x of the parameters of the intervals; `columns`: of those that the base parameters combine.
    """
    matrix, parameters, base = found.combinations.matrix, found.parameters, found.base
    for shift in shifts:
        parameters = _widen(parameters, shift.change[rows], shift.root[rows], shift.factor, found.factor)
        base = _widen(base, matrix @ shift.change[columns], matrix @ shift.root[columns], shift.factor, found.factor)
    # The shares of the variances grow, the correlations stay.
    grown = base.std / np.where(found.base.std > 0, found.base.std, 1.0)
    return found._replace(
        parameters=parameters,
        base=base,
        base_covariance=found.base_covariance * grown * grown[:, None],
        omitted=tuple(
            dict.fromkeys(term for shift in shifts if shift.clearness > shift.minimum for term in shift.terms)
        ),
    )


def _widen(spread: Spread, change: np.ndarray, root: np.ndarray, factor: float, own: float) -> Spread:
    reach = np.abs(change) + factor * np.linalg.norm(root, axis=1)
    # NaN, of terms held at zero, stays.
    std = np.maximum(spread.std, reach / own)
    share = spread.prior_share * (spread.std / np.where(std > 0, std, 1.0)) ** 2
    return spread._replace(std=std, prior_share=np.where(np.isfinite(share), share, spread.prior_share))
