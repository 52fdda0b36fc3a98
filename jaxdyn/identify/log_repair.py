"""Repair of wrapped angles and corrupted samples of logs, before a low-pass and differences spread them over the log."""

import dataclasses
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.logs import Log
from jaxdyn.model.arguments import warn
from jaxdyn.model.configuration import columns_of
from jaxdyn.model.tree import Model

# Samples at each side that define the local motion of a joint around a sample or a jump.
_WINDOW = 8
# Longest sequences of corrupted samples: more positions could be a motion; a torque of two samples may be the friction of a
# reversal in a log of few samples a second.
_LONGEST = {"q": 3, "tau": 1}
# A deviation counts from this multiple of the deviations around it and of those in nine tenths of the column. The upper
# quartile of the absolute values of normal noise is 1.15 of its standard deviation, so noise alone never comes near.
_UNUSUAL = 15.0
# The samples next to a corrupted one must predict each other better than it by this factor, or it is a step of the signal.
_ISOLATED = 5.0
# Least deviation in ranges of the column: smaller ones do not change a fit. Torques are not differentiated, and friction of a
# recorded KUKA peaks by three ranges for one sample at a reversal, when one of ten samples is kept.
_MINIMUM = {"q": 3e-3, "tau": 5.0}
# A constant column has no range: also a share of the widest column of the signal, and a multiple of the encoder's resolution.
_MIN_OF_WIDEST, _RESOLUTIONS = 1e-3, 10.0
# A jump is faster than its neighbours by the first factor, and than 99 % of the log by the second. Files have limits that are
# too low, so one beyond the velocity limit must stand out too, though by less: both factors are halved.
_FASTER, _FASTER_THAN_ALL, _BEYOND_LIMIT = 10.0, 5.0, 1.5
# Least tolerance (rad) of the turn that a wrapped angle jumps by: resolution and noise of encoders.
_TURN_TOLERANCE = 0.02
# Share of the samples at a limit of a saturated sensor.
_SATURATED = 0.02
_OUTLIERS = ("refuse", "drop", "keep")


class LogWarning(UserWarning):
    """Warning of a log that was changed when it was read, with joints and counts, or that looks wrong in a fit (`fit_robot`)."""


class Outlier(NamedTuple):
    """Corrupted samples of one column: `rows` of `signal` ("q" or "tau"), `size` of the largest deviation.

    - `is_jump`: whether the position does not come back; the rows are then those before and after the jump.
    """

    signal: str
    column: int
    rows: range
    size: float
    is_jump: bool


def repair_log(log: Log, model: Model | None = None, *, unwrap: bool | str = "auto", outliers: str = "refuse") -> Log:
    """A log with unwrapped angles and without corrupted samples; the same object where there is nothing to change.

    **Arguments:**

    - `unwrap`: "auto", jumps of q near a multiple of 2 pi (`unwrap_angles`); True, all beyond pi; False, none.
    - `outliers`: what `find_outliers` finds is an error, "refuse"; is replaced by linear interpolation between the samples
      around it, "drop"; or stays, "keep". Positions that jump and do not come back are an error with "drop" too.

    **Raises:** ValueError for other options, and for outliers, with row and joint.
    """
    if not (isinstance(unwrap, bool) or unwrap == "auto"):
        raise ValueError(f'unwrap is {unwrap!r}; give "auto", True or False')
    if outliers not in _OUTLIERS:
        raise ValueError(f'outliers is {outliers!r}; give "refuse", "drop" or "keep"')
    if unwrap is not False:
        log = unwrap_angles(log, model, near=unwrap == "auto")
    if outliers == "keep":
        return log
    found = find_outliers(log, model)
    refused = [one for one in found if one.is_jump or outliers == "refuse"]
    if refused:
        raise ValueError(_describe(log, model, refused[0], len(refused)))
    return _fill(log, model, found) if found else log


def unwrap_angles(log: Log, model: Model | None = None, *, near: bool = True) -> Log:
    """Make angles continuous that jump by multiples of 2 pi, with a `LogWarning` that names joints and counts.

    A difference of two samples beyond pi is a wrap when, without a whole number of turns, it is what the velocities on both
    sides predict: within their difference over the sample, three times their usual scatter, or 0.02 rad, and at most a quarter
    turn. `near=False` brings every difference within half a turn instead, as `numpy.unwrap` does. Columns are those of
    revolute and continuous joints; without a model all, where q and tau have as many. The first sample stays.
    """
    t, q = np.asarray(log.t, np.float64), np.asarray(log.q, np.float64)
    counts = {}
    for column in _angles(log, model):
        turns = _turns(t, q[:, column], near)
        if turns.any():
            # Copied before the first change only: the caller's array stays as it is.
            q = q if counts else q.copy()
            q[1:, column] -= 2 * np.pi * np.cumsum(turns)
            counts[_label(log, model, "q", column)] = int(np.count_nonzero(turns))
    if not counts:
        return log
    names = ", ".join(f"{name} ({count} {'jump' if count == 1 else 'jumps'})" for name, count in counts.items())
    warn(f"angles that jump by whole turns were unwrapped: {names}", LogWarning)
    return dataclasses.replace(log, q=q)


def find_outliers(log: Log, model: Model | None = None) -> list[Outlier]:
    """Samples of q and tau that the samples around them contradict, by signal, column and row.

    - One to three positions, or one torque, far from the line between the samples on both sides, which predict each other:
      fifteen times farther than usual there and in nine tenths of the column, and by 0.3 % of the range of the position, or
      five ranges of the torque (ranges without the lowest and the highest hundredth).
    - Positions that jump within three samples and do not come back: ten times faster than around, and five times faster than
      99 % of the log; half of that beyond one and a half of the model's velocity limit.

    Coordinates of joints with several are not checked, nor positions without a model where q and tau differ in their number. A
    torque at either end may be a step of the torque, and is not found.
    """
    t = np.asarray(log.t, np.float64)
    found: list[Outlier] = []
    for signal, columns in (("q", _coordinates(log, model)), ("tau", range(log.nv))):
        values = np.asarray(getattr(log, signal), np.float64)
        if len(t) < 9 or not len(columns):
            continue
        # Without the extreme hundredths: corrupted samples must not set the range that they are compared with.
        low, high = np.quantile(values[:, list(columns)], (0.01, 0.99), axis=0)
        for place, column in enumerate(columns):
            minimum = max(_MINIMUM[signal] * (high - low)[place], _MIN_OF_WIDEST * float((high - low).max()))
            x = values[:, column]
            own = [
                Outlier(signal, column, rows, size, False)
                for rows, size in _find_spikes(t, x, minimum, _LONGEST[signal])
            ]
            if signal == "q":
                limit = _velocity_limit(model, column)
                own += _find_jumps(t, x, column, minimum, limit, own)
            found += sorted(own, key=lambda one: one.rows.start)
    return found


def check_saturation(log: Log, model: Model | None = None) -> list[str]:
    """Warning about torques that stay at their highest or lowest value, as those of a saturated sensor do.

    Two of a hundred samples are there for three samples or longer, and ten times as many as at the value next to it, which steps
    of a coarse sensor are not. Zero is no limit.
    """

    def is_saturated(x: np.ndarray) -> bool:
        """Decide for the highest value."""
        top = x == x.max()
        others, counts = np.unique(x[~top], return_counts=True)
        # A torque of a few levels is one that is switched.
        if len(others) < 10 or x.max() == 0:
            return False
        return bool(np.sum(top[:-2] & top[1:-1] & top[2:]) >= max(_SATURATED * len(x), 10 * counts[-1]))

    columns = [j for j, x in enumerate(np.asarray(log.tau, np.float64).T) if is_saturated(x) or is_saturated(-x)]
    names = ", ".join(_label(log, model, "tau", column).removeprefix("joint ") for column in columns)
    return (
        [f"torques of {names} stay at their largest value: is the sensor saturated? Leave such samples out"]
        if names
        else []
    )


def _turns(t: np.ndarray, x: np.ndarray, near: bool) -> np.ndarray:
    """Whole turns (n - 1,) by which the differences of x jump."""
    steps, change = np.diff(t), np.diff(x)
    if not near:
        return np.where(np.abs(change) > np.pi, np.round(change / (2 * np.pi)), 0.0)
    turns = np.zeros(len(change))
    wide = np.abs(change) > np.pi
    rate = change / steps
    for i in np.flatnonzero(wide):
        # Nearest first, without differences that may be wraps themselves.
        before, after = slice(max(0, i - _WINDOW), i), slice(i + 1, i + 1 + _WINDOW)
        sides = [rate[before][~wide[before]][::-1], rate[after][~wide[after]]]
        ends = [side[0] for side in sides if len(side)]
        if not ends:
            continue
        # The median, so that another corrupted sample nearby does not widen the tolerance.
        scatter = max(float(np.median(np.abs(np.diff(side)))) if len(side) > 1 else 0.0 for side in sides)
        tolerance = max(_TURN_TOLERANCE, steps[i] * max(abs(ends[0] - ends[-1]), 3 * scatter))
        whole = np.round((change[i] - steps[i] * np.mean(ends)) / (2 * np.pi))
        rest = change[i] - steps[i] * np.mean(ends) - 2 * np.pi * whole
        # With velocities uncertain by more than a quarter turn, a wrap is not distinguishable from a motion or noise.
        turns[i] = whole if abs(rest) <= tolerance <= 0.5 * np.pi else 0.0
    return turns


def _find_spikes(t: np.ndarray, x: np.ndarray, minimum: float, longest: int) -> list[tuple[range, float]]:
    """Find one to `longest` samples, rows and deviation, that deviate from the line between their neighbours."""
    n = len(x)
    curvature = np.abs(x[1:-1] - _line(t[1:-1], t[:-2], x[:-2], t[2:], x[2:]))
    # A quantile instead of the maximum: up to a tenth of the samples may be corrupted without raising the floor.
    floor = max(minimum, _UNUSUAL * float(np.quantile(curvature, 0.9)))
    found, taken = [], np.zeros(n, bool)
    for length in range(1, longest + 1):
        first = np.arange(2, n - length - 1)  # two samples on both sides
        last, left, right = first + length - 1, first - 1, first + length
        # The smaller deviation of the first and the last sample: both must be off.
        size = np.minimum(
            *(np.abs(x[k] - _line(t[k], t[left], x[left], t[right], x[right])) for k in (first, last)),
        )
        # Prediction of the inner neighbours by the outer ones, without the samples between.
        inner = np.maximum(
            np.abs(x[left] - _line(t[left], t[left - 1], x[left - 1], t[right], x[right])),
            np.abs(x[right] - _line(t[right], t[left], x[left], t[right + 1], x[right + 1])),
        )
        for k in np.flatnonzero((size > floor) & (size > _ISOLATED * inner)):
            a, b = int(first[k]), int(right[k])
            # curvature[j] is of row j + 1; rows next to the samples have a curvature that is due to them.
            around = np.concatenate([curvature[max(0, a - 2 - _WINDOW) : a - 2], curvature[b : b + _WINDOW]])
            usual = float(np.quantile(around, 0.75)) if len(around) else 0.0
            quantum = _resolution(x, a - 1, b)
            if size[k] > max(_UNUSUAL * usual, _RESOLUTIONS * quantum) and not taken[a:b].any():
                taken[a:b] = True
                found.append((range(a, b), float(size[k])))
    return found


def _find_jumps(t, x, column: int, minimum: float, limit: float, known: list[Outlier]) -> list[Outlier]:
    """Find jumps of a position that stay, outside of known outliers; one to three samples at an end count as isolated."""
    # Spikes are bridged first, or both of their flanks would count as jumps.
    if known:
        x = x.copy()
        bad = np.concatenate([np.array(one.rows) for one in known])
        x[bad] = np.interp(t[bad], np.delete(t, bad), np.delete(x, bad))
    n, steps = len(x), np.diff(t)
    # Jitter of time stamps must not make a small difference fast.
    usual_step = float(np.median(steps))
    rate = np.abs(np.diff(x)) / np.maximum(steps, usual_step)
    fastest = float(np.quantile(rate, 0.99))
    found: list[Outlier] = []
    taken = np.zeros(n, bool)
    longest = _LONGEST["q"]
    for length in range(1, longest + 1):
        change = np.abs(x[length:] - x[:-length])
        speed = change / np.maximum(t[length:] - t[:-length], usual_step)
        factor = np.where(speed > _BEYOND_LIMIT * limit, 0.5, 1.0)
        for i in map(int, np.flatnonzero((change > minimum) & (speed > factor * _FASTER_THAN_ALL * fastest))):
            sides = [rate[max(0, i - _WINDOW) : i], rate[i + length : i + length + _WINDOW]]
            near = max(float(np.quantile(side, 0.75)) if len(side) else 0.0 for side in sides)
            rows = range(i, i + length + 1)
            if speed[i] <= factor[i] * _FASTER * near or taken[rows.start : rows.stop].any():
                continue
            if change[i] <= _RESOLUTIONS * _resolution(x, i, i + length):
                continue
            taken[rows.start : rows.stop] = True
            if rows[-1] <= longest:
                found.append(Outlier("q", column, range(rows[-1]), float(change[i]), False))
            elif rows[0] >= n - 1 - longest:
                found.append(Outlier("q", column, range(rows[0] + 1, n), float(change[i]), False))
            else:
                found.append(Outlier("q", column, rows, float(change[i]), True))
    return found


def _resolution(x: np.ndarray, first: int, last: int) -> float:
    """Smallest difference that is not zero, outside of rows first to last; 0 where there is none."""
    # The smallest step that occurs is the quantum of the encoder.
    change = np.abs(np.diff(x))
    change = np.concatenate([change[:first], change[last:]])
    return float(change[change > 0].min(initial=np.inf)) if (change > 0).any() else 0.0


def _line(t, t0, x0, t1, x1):
    return x0 + (x1 - x0) * ((t - t0) / (t1 - t0))


def _fill(log: Log, model: Model | None, found: list[Outlier]) -> Log:
    """Replace outliers by linear interpolation, at the ends by the line through the next two samples."""
    t = np.asarray(log.t, np.float64)
    signals = {name: np.array(getattr(log, name), np.float64) for name in ("q", "tau")}
    counts: dict[str, int] = {}
    for signal, column in dict.fromkeys((one.signal, one.column) for one in found):
        x = signals[signal][:, column]
        bad = np.zeros(len(t), bool)
        for one in found:
            if (one.signal, one.column) == (signal, column):
                bad[list(one.rows)] = True
        good = np.flatnonzero(~bad)
        x[bad] = np.interp(t[bad], t[good], x[good])
        # np.interp repeats the last good value beyond the ends, which would be a stop of the joint.
        for a, b in ((good[0], good[1]), (good[-1], good[-2])):
            outer = bad & (np.arange(len(t)) < a if a < b else np.arange(len(t)) > a)
            x[outer] = _line(t[outer], t[a], x[a], t[b], x[b])
        counts[f"{signal} of {_label(log, model, signal, column)}"] = int(bad.sum())
    total = sum(counts.values())
    names = ", ".join(f"{name} ({count})" for name, count in counts.items())
    warn(f"{total} corrupted {'sample' if total == 1 else 'samples'} left out and interpolated: {names}", LogWarning)
    return dataclasses.replace(log, **signals)


def _describe(log: Log, model: Model | None, one: Outlier, count: int) -> str:
    value, t = np.asarray(getattr(log, one.signal)), np.asarray(log.t)
    row, joint = one.rows[0], _label(log, model, one.signal, one.column)
    more = f" (and {count - 1} more)" if count > 1 else ""
    if one.is_jump:
        end = one.rows[-1]
        limit = _velocity_limit(model, one.column)
        known = f", velocity limit {limit:.4g}" if np.isfinite(limit) else ""
        return (
            f"q of {joint} jumps from {value[row, one.column]:.6g} at row {row} to {value[end, one.column]:.6g} at row {end} "
            f"(t={t[end]:.6g} s, {one.size / (t[end] - t[row]):.4g} per second{known}), faster than the joint moves around{more}"
            '; cut the log there, or correct it; a jump by whole turns needs unwrap="auto", and outliers="keep" accepts it'
        )
    rows = f"row {row}" if len(one.rows) == 1 else f"rows {row} to {one.rows[-1]}"
    return (
        f"{one.signal} of {joint} is {value[row, one.column]:.6g} at {rows} (t={t[row]:.6g} s), {one.size:.4g} from what the "
        f'samples around predict{more}: corrupted; correct the log, leave such samples out with outliers="drop", or accept '
        'them with outliers="keep"'
    )


def _coordinates(log: Log, model: Model | None) -> list[int]:
    """Columns of q that are the only coordinate of a joint."""
    if model is None:
        return list(range(log.q.shape[1])) if log.q.shape[1] == log.nv else []
    if log.q.shape[1] != model.nq:
        return []
    return [where.start for where in model.topology.q_slices if where.stop - where.start == 1]


def _angles(log: Log, model: Model | None) -> list[int]:
    if model is None or log.q.shape[1] != model.nq:
        return _coordinates(log, model)
    turning = zip(model.topology.kinds, model.topology.q_slices, strict=True)
    return [where.start for kind, where in turning if kind in ("revolute", "continuous")]


def _label(log: Log, model: Model | None, signal: str, column: int) -> str:
    sets = [] if model is None else [getattr(columns_of(model), "q" if signal == "q" else "v")]
    sets += [] if log.joint_names is None else [log.joint_names]
    count = getattr(log, signal).shape[1]
    return f"joint {next((names[column] for names in sets if len(names) == count), column + 1)}"


def _velocity_limit(model: Model | None, column: int) -> float:
    """Velocity limit of a column of q, infinite where it is unknown; files write 0 for none."""
    if model is None:
        return np.inf
    slices = zip(model.topology.q_slices, model.topology.v_slices, strict=True)
    limit = float(np.asarray(model.velocity_limit)[next(v.start for q, v in slices if q.start == column)])
    return limit if limit > 0 else np.inf
