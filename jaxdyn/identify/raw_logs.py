"""Logs from raw samples: cut-off by their spectra, uniform in time, low-passed without delay, differentiated.

Rigid bodies respond at the frequencies of the motion and their first multiples, and friction at reversals somewhat higher.
Power far above is neither: elastic joints, drives, sensors.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.log_repair import LogWarning, check_saturation, repair_log
from jaxdyn.identify.logs import (
    Log,
    are_angles,
    idle_coordinates,
    log_rate,
    low_pass,
    motion_paths,
    root_mean_square,
)
from jaxdyn.identify.regression import log_regressor, nominal_parameters
from jaxdyn.model.arguments import Checked, Numbers, check_known, warn
from jaxdyn.model.configuration import columns_of
from jaxdyn.model.tree import Model

# Bend of a line, as a share of the root mean square, below which it counts as straight, and least number of corners of lines.
_BEND, _CORNERS = 0.01, 8


def from_raw(
    t: Numbers,
    q: Numbers,
    tau: Numbers,
    *,
    cutoff: float | str = 8.0,
    order: Checked[int] = 4,
    trim: Checked[int] = 200,
    every: Checked[int] = 8,
    joint_names: Checked[Sequence[str] | None] = None,
    unwrap: bool | str = "auto",
    outliers: str = "refuse",
    model: Checked[Model | None] = None,
) -> Log:
    """Make a log for torque fits from raw positions and torques: uniform time, low-pass without delay, numerical rates.

    Columns that a recorder has interpolated linearly between rarer samples become splines through these (`spline_lines`). The
    samples are interpolated linearly to a uniform grid of as many samples. q is low-passed forward and backward
    (Butterworth, zero phase); v is the derivative of its spline, low-passed again; a that of v's, low-passed again; tau
    is low-passed the same way, so that both sides of the equation of motion have the same filter. The filter's
    transients at both ends are dropped, and as the signals have no power above the cut-off, only every few samples are
    kept.

    **Arguments:**

    - `t` (n,) s, strictly increasing, jitter allowed; `q`, `tau` (n, nv): one coordinate per joint.
    - `cutoff`: Hz, half-power frequency of one pass; or "auto", from this log's spectra by `choose_cutoff`. Several logs of
      a fit should have one low-pass: choose it once for all of them, and give the number.
    - `order`: of the filter. `trim`: samples dropped at each end. `every`: keep every so-many-th sample.
    - `unwrap`: "auto" makes angles continuous that jump by whole turns, as the neighbouring velocities show; True, all
      differences beyond pi, as `numpy.unwrap`; False, none. A `LogWarning` names joints and counts.
    - `outliers`: samples of q and tau that contradict their neighbours are an error, "refuse"; are interpolated, with a
      `LogWarning` that counts them, "drop"; or stay, "keep".
    - `joint_names`: of the columns, for messages; by default those of `model`.
    - `model`: defines the columns that are angles, their joints' names and velocity limits. Without it any column of q may be
      one.

    **Returns:** `Log` with t, q, v, a, tau.

    **Warns:** `LogWarning` for torques that stay at their largest value, and what was unwrapped, interpolated or left out.

    **Raises:** ValueError for all that `Log` refuses; an `order`, `trim` or `every` that is no whole number or too small; too few
    samples for the filter and the trimming; a cut-off above half the sampling rate; a gap in time longer than half a period of
    the cut-off, which interpolation would invent; outliers, with row and joint; positions that jump and do not come back,
    also with `outliers="drop"`.

    Source: the off-line preparation usual in robot identification (Gautier 1997; Khalil & Dombre 2002, section 12.4).
    """
    check_known("from_raw", t=t, q=q, tau=tau)
    for name, value, minimum in (("order", order, 1), ("trim", trim, 0), ("every", every, 1)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < minimum:
            raise ValueError(f"{name} is {value!r}; give a whole number of at least {minimum}")
    if isinstance(cutoff, str) and cutoff != "auto":
        raise ValueError(f'cutoff is {cutoff!r}; give a frequency in Hz, or "auto"')
    # Before the filter, whose response would spread a corrupted sample over its neighbours.
    raw = repair_log(Log(t, q, tau=tau, joint_names=joint_names), model, unwrap=unwrap, outliers=outliers)
    for line in check_saturation(raw, model):
        warn(line, LogWarning)
    cutoff = choose_cutoff(raw).frequency if isinstance(cutoff, str) else cutoff
    t, q, tau = (np.asarray(x, np.float64) for x in (raw.t, raw.q, raw.tau))
    if q.shape[1] != tau.shape[1]:
        raise ValueError(
            f"q has {q.shape[1]} columns and tau {tau.shape[1]}: rates by differences need one coordinate per joint; "
            "give v and a of quaternion joints to Log directly"
        )
    n = len(t)
    # The first bound leaves two samples after trimming, the second is that of SciPy's default padding.
    need = max(2 * trim + every + 1, 3 * (order + 1) + 1)
    if n < need:
        raise ValueError(
            f"{n} samples are too few for the filter: at least {need} (order={order}, trim={trim}, every={every})"
        )
    rate = (n - 1) / (t[-1] - t[0])
    if not 0 < cutoff < rate / 2:
        raise ValueError(f"cutoff={cutoff} Hz must lie between 0 and half the sampling rate, {rate / 2:.4g} Hz")
    widest = int(np.argmax(np.diff(t)))
    # Nyquist: samples farther apart than half a period do not determine that frequency.
    if t[widest + 1] - t[widest] > 0.5 / cutoff:
        raise ValueError(
            f"gap of {t[widest + 1] - t[widest]:.4g} s after row {widest} (t={t[widest]:.6g} s), longer than half a "
            f"period of cutoff={cutoff} Hz; cut the log there or lower the cut-off"
        )

    def low(x):
        return low_pass(x, rate, cutoff, order)

    grid, q, tau = _uniform(t, spline_lines(t, q, "positions"), spline_lines(t, tau, "torques"))
    positions, torques = low(q), low(tau)
    # A difference amplifies noise in proportion to its frequency: each result goes through the low-pass again.
    v = low(differentiate(grid, positions))
    a = low(differentiate(grid, v))
    # Decimated after the low-pass: before it, frequencies above half of the new rate would alias.
    keep = slice(trim, n - trim, every)
    return Log(grid[keep], positions[keep], v[keep], a[keep], torques[keep], joint_names=raw.joint_names, cutoff=cutoff)


def _uniform(t: np.ndarray, *signals: np.ndarray) -> list[np.ndarray]:
    """Even times, as many as t, and signals (n, k) interpolated linearly to them."""
    grid = np.linspace(t[0], t[-1], len(t))
    return [grid, *(np.stack([np.interp(grid, t, column) for column in x.T], axis=1) for x in signals)]


# Share of the velocity's power that defines the band of the motion, and the factor above it up to which a residual may be
# friction's. With 99.9 % instead, noise of the encoders of two recorded arms doubled the band.
_MOTION, _ABOVE = 0.99, 10.0
# A low-pass closer to the motion than this factor removes rigid-body torque.
_MINIMUM = 5.0
# A joint with less than this share of the fastest one's velocity power does not define the band of the motion.
_SLOW = 1e-4
# Vibration is a torque whose power rises this many times from one band to a higher one, to this share of the joint's power.
_RISE, _SHARE = 10.0, 1e-4
# Least number of frequencies in a band, for a meaningful mean.
_LINES = 6
# Highest cut-off as a share of the sampling rate.
_SAMPLING = 0.4


def differentiate(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Rates (n, k) of columns x (n, k), sampled at t (n,): those of the cubic splines through the samples.

    They lower the rate of a sine of angular frequency w, sampled every h, by the share (w h)^4 / 180. Central differences lower
    it by (w h)^2 / 6, in v and in a of each joint alike, which a fit takes for evidence: of logs without noise at 100 Hz, 70 %
    of the intervals of 95 % held the truth.
    """
    from scipy.interpolate import CubicSpline

    return CubicSpline(t, x)(t, 1)


def spline_lines(t: np.ndarray, x: np.ndarray, what: str) -> np.ndarray:
    """Columns (n, k), those that are lines between every second or rarer sample replaced by cubic splines through their corners.

    Lines between samples of the rate f lower a sine of the frequency s by the factor sinc(s / f)^2, 3 % at a tenth of f. The
    columns of a fit are not lowered so, and friction and rotors were off by several of their standard deviations. A spline
    through the corners lowers the sine by 2e-4.

    **Warns:** `LogWarning` with the number of columns.
    """
    from scipy.interpolate import CubicSpline

    result, count = x, 0
    bends = np.abs(np.diff(np.diff(x, axis=0) / np.diff(t)[:, None], axis=0))
    is_corner = bends > _BEND * root_mean_square(bends)
    for column in np.flatnonzero(np.mean(is_corner, axis=0) <= 0.5):
        corners = np.concatenate([[0], 1 + np.flatnonzero(is_corner[:, column]), [len(t) - 1]])
        gaps = np.diff(corners)[1:-1]
        typical = np.median(gaps) if len(gaps) >= _CORNERS else 0.0
        # Corners at irregular places are those of a signal that rests at times, or is held, where a spline would overshoot.
        if typical < 2 or gaps.min() < 0.5 * typical or gaps.max() > 4 * typical:
            continue
        result = x.copy() if result is x else result
        result[:, column] = CubicSpline(t[corners], x[corners, column])(t)
        count += 1
    if count:
        warn(f"{count} columns of {what} are lines between rarer samples; they were replaced by splines", LogWarning)
    return result


class Cutoff(NamedTuple):
    """Cut-off of the low-pass of logs, all in Hz.

    - `frequency`: of the low-pass.
    - `motion`: the band of the motion: 99 % of the power of the velocity lies below.
    - `vibration`: frequency at which the torque's power rises again, between five and ten times the motion's band, or None.
    """

    frequency: float
    motion: float
    vibration: float | None


def choose_cutoff(logs: Log | Sequence[Log]) -> Cutoff:
    """Choose the cut-off frequency of raw logs from the spectra of positions and torques.

    Ten times the highest band of the motion, up to which rigid bodies and friction respond. Less, down to five times, where a
    joint's torque vibrates below that: then the band of least power below the vibration. Errors of fits are not used.
    All logs of a fit should go through the same low-pass.

    **Arguments:** `logs`: one raw log or several, with t, q, tau.

    **Returns:** `Cutoff`.

    **Raises:** ValueError for joints with more than one coordinate, for fewer than 32 samples, and for logs that do not
    move or whose noise hides the motion.
    """
    logs = (logs,) if isinstance(logs, Log) else tuple(logs)
    spectra = [_Spectra.of(log) for log in logs]
    motion = max(one.motion for one in spectra)
    if not motion > 0:
        raise ValueError("the positions do not move, so their spectrum determines no cut-off; give one in Hz")
    if not np.isfinite(motion):
        raise ValueError(
            "the noise of the positions is as strong as their motion, so no cut-off is chosen; give one in Hz"
        )
    frequency = _ABOVE * motion
    valleys = [valley for one in spectra if (valley := one.valley(motion)) is not None]
    vibration = None
    if valleys:
        frequency, vibration = min(valleys)
    # The slowest log limits all of them, since one low-pass is used for all.
    return Cutoff(min(frequency, _SAMPLING * min(one.rate for one in spectra)), motion, vibration)


class _Spectra(NamedTuple):
    """Spectra of one raw log: frequencies, power of torques (frequencies, nv), sampling rate and band of the motion, in Hz."""

    frequency: np.ndarray
    torque: np.ndarray
    rate: float
    motion: float

    @classmethod
    def of(cls, log: Log) -> "_Spectra":
        """Spectra on a uniform grid of as many samples."""
        t, q, tau = (np.asarray(x, np.float64) for x in (log.t, log.q, log.tau))
        if q.shape[1] != tau.shape[1]:
            raise ValueError(
                f"the log has {q.shape[1]} columns of q and {tau.shape[1]} of tau; a cut-off is chosen for joints with one "
                "coordinate each, give one in Hz"
            )
        if len(t) < 32:
            raise ValueError(f"{len(t)} samples are too few to choose a cut-off by their spectrum; give one in Hz")
        # The transform assumes uniform samples; time stamps of raw logs have jitter.
        grid, q, tau = _uniform(t, q, tau)
        rate = (len(t) - 1) / float(t[-1] - t[0])
        # Differentiate before windowing: a path that does not end at its start would be a jump in the spectrum.
        frequency, velocity = power(differentiate(grid, q), rate)
        return cls(frequency, power(tau, rate)[1], rate, _motion(frequency, power(q, rate)[1], velocity))

    def valley(self, motion: float) -> tuple[float, float] | None:
        """Band of least torque below a vibration between five and ten times the motion's band, and that of the vibration."""
        edges = motion * np.arange(_MINIMUM, _ABOVE + 1)
        inside = [(self.frequency >= a) & (self.frequency < b) for a, b in itertools.pairwise(edges)]
        if min(mask.sum() for mask in inside) < _LINES:
            return None
        # Means compare bands with different numbers of lines; sums give a share of the whole power.
        bands = np.stack([self.torque[mask].mean(axis=0) for mask in inside])
        sums = np.stack([self.torque[mask].sum(axis=0) for mask in inside])
        total = self.torque.sum(axis=0)
        valleys = []
        for joint in range(bands.shape[1]):
            for high in range(1, len(bands)):
                low = int(np.argmin(bands[:high, joint]))
                rises = bands[high, joint] > _RISE * bands[low, joint]
                if rises and sums[high, joint] > _SHARE * total[joint]:
                    valleys.append((float(edges[low : low + 2].mean()), float(edges[high : high + 2].mean())))
                    break
        return min(valleys) if valleys else None


def motion_band(log: Log) -> float:
    """Frequency (Hz) below which 99 % of the power of the velocity lies, of the joint where that is highest; 0 at rest."""
    frequency, velocity = power(np.asarray(log.v, np.float64), log_rate(log))
    return _band(frequency, velocity, 1e-6)


def vibration(log: Log, residual: np.ndarray) -> tuple[float, float]:
    """Share of the power of a residual (n, nv) above ten times the band of the motion, and that frequency (Hz).

    A low-pass at that frequency removes it.
    """
    edge = _ABOVE * motion_band(log)
    frequency, errors = power(np.asarray(residual, np.float64), log_rate(log))
    total = float(errors.sum())
    return (float(errors[frequency > edge].sum()) / total if total > 0 and edge > 0 else 0.0), edge


def power(x: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (Hz) and power (frequencies, columns) of samples without their mean, in a window that is zero at both ends.

    The window keeps a slow motion that does not close on itself from reaching high frequencies.
    """
    window = np.hanning(len(x))[:, None]
    return np.fft.rfftfreq(len(x), 1 / rate), np.abs(np.fft.rfft(window * (x - x.mean(axis=0)), axis=0)) ** 2


def _band(frequency: np.ndarray, velocity: np.ndarray, slow: float) -> float:
    """Highest frequency, over the columns that move, below which 99 % of the power lies."""
    total = velocity.sum(axis=0)
    moving = velocity[:, total > slow * total.max(initial=0)]
    if not moving.size or not total.max() > 0:
        return 0.0
    share = np.cumsum(moving, axis=0) / moving.sum(axis=0)
    return float(max(frequency[np.argmax(share >= _MOTION, axis=0)]))


def _motion(frequency: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> float:
    """Band of the motion from raw positions, whose noise dominates the velocity's power at high frequencies.

    A fixed-point iteration from the band of the positions: the band of the velocity below ten times the present one. Infinite
    where it reaches ten times the band of the positions, which is noise.
    """
    # Two lines are the resolution of the window.
    band = max(_band(frequency, position, _SLOW), float(frequency[2])) if position.any() else 0.0
    maximum = _ABOVE * band
    while band > 0:
        below = frequency <= _ABOVE * band
        higher = max(_band(frequency[below], velocity[below], _SLOW), float(frequency[2]))
        # The iteration comes from below, to the lowest fixed point; higher ones would count more of the noise.
        if higher <= band:
            return band
        if higher > maximum:
            return np.inf
        band = higher
    return 0.0


# Angles beyond this many turns, and torques this many times off what the nominal bodies need, are worth a question.
_TURNS, _OFF = 3.0, 20.0
# So many samples tell the size of a torque.
_COMPARED = 500
# Below this share of its own largest velocity a joint has not begun to move; from this share of the error on it is worth a word,
# and so is an error of this share of the torque, or of the path.
_REST, _MUCH = 0.01, 0.5
# Steps in time beyond so many usual ones are gaps, over which velocities do not tell the path.
_GAP = 5.0


def log_warnings(model: Model, log: Log, residual: np.ndarray) -> list[str]:
    """Warnings about a log of a fit with the errors `residual` (n, nv): what looks wrong in it, and in its errors."""
    labels = columns_of(model).v
    return [
        *check_log_content(model, log, labels),
        *check_rest(log, residual, labels),
        *check_residual_power(model, log, residual, labels),
    ]


def check_log_content(model: Model, log: Log, labels: Sequence[str]) -> list[str]:
    """Warnings about a log with v and a, none where it looks as expected; `labels` of each number of v.

    - Angles of revolute joints beyond three turns: degrees. Joints that turn without end ("continuous") may go there.
    - Torques that are less than a twentieth, or more than twenty times, of what the nominal bodies need, at most joints where
      these need a tenth of the largest: motor torques in front of the gears, or other units.
    - Joints that hardly move, whose friction and rotor inertia are not identifiable.
    - Positions that do not follow the velocities, and torques that stay at their largest value.
    """
    lines = []
    q = np.abs(np.asarray(log.q, np.float64))
    if model.nq == model.nv:
        is_revolute = np.array([kind == "revolute" for kind in model.topology.kinds])
        far = np.flatnonzero(is_revolute & (q.max(axis=0) > _TURNS * 2 * np.pi))
        if len(far):
            names = ", ".join(labels[int(i)] for i in far)
            lines.append(
                f"positions of {names} reach {q[:, far].max():.0f} rad, beyond three turns: are they in degrees?"
            )
    some = log[:: max(1, len(log) // _COMPARED)]
    needed = root_mean_square(log_regressor(model, some) @ nominal_parameters(model))
    measured = root_mean_square(np.asarray(some.tau, np.float64))
    # Where the bodies need little torque, friction may be most of what is measured, and the ratio says nothing about units.
    compared = (needed > 0.1 * needed.max(initial=0)) & (measured > 0)
    ratio = measured[compared] / needed[compared]
    names = ", ".join(label for label, is_compared in zip(labels, compared, strict=True) if is_compared)
    # At most joints: a single one is a faulty sensor or body rather than a unit.
    if len(ratio) and np.mean(ratio < 1 / _OFF) > 0.5:
        lines.append(
            f"torques of {names} are about 1/{1 / np.median(ratio):.0f} of what the file's bodies need: are they motor torques, "
            "in front of the gears, or in another unit? Joint torques in N m are expected; multiply by the gear ratios"
        )
    elif len(ratio) and np.mean(ratio > _OFF) > 0.5:
        lines.append(
            f"torques of {names} are about {np.median(ratio):.0f} times what the file's bodies need: are they in N mm or in per "
            "cent? N m are expected"
        )
    positions, integrals = motion_paths(model, log)
    travel, idle = np.ptp(positions, axis=0), idle_coordinates(model, [log])
    slow = [
        f"{labels[j]} ({travel[j]:.2g} {'rad' if angle else 'm'})"
        for j, angle in enumerate(are_angles(model))
        if j in idle
    ]
    if slow:
        lines.append(
            f"{', '.join(slow)} hardly moved: friction and rotor inertia there are not identifiable from this log; move these "
            "joints farther"
        )
    off = _path_errors(np.asarray(log.t, np.float64), positions, integrals, are_angles(model))
    wrong = [labels[j] for j in np.flatnonzero(off > _MUCH * positions.std(axis=0)).tolist() if j not in idle]
    if wrong:
        lines.append(
            f"positions of {', '.join(wrong)} do not follow the velocities: check units, signs, the order of columns and the "
            "unit of time"
        )
    return lines if log.cutoff is not None else [*lines, *check_saturation(log, model)]


def _path_errors(t: np.ndarray, positions: np.ndarray, integrals: np.ndarray, is_angle: np.ndarray) -> np.ndarray:
    """Deviations (nv,) of positions from integrals of velocities, without constant errors of these and without gaps."""
    if len(t) < 3:
        return np.zeros(len(is_angle))
    steps, changes = np.diff(t), np.diff(positions, axis=0)
    # Logs of joints that turn without end may jump by a turn.
    is_usable = (steps <= _GAP * np.median(steps))[:, None] & ~(is_angle & (np.abs(changes) > np.pi))
    off = np.cumsum(np.where(is_usable, changes - np.diff(integrals, axis=0), 0.0), axis=0)
    line = np.stack([np.ones(len(off)), t[1:] - t[0]], axis=1)
    return np.sqrt(np.mean((off - line @ np.linalg.lstsq(line, off, rcond=None)[0]) ** 2, axis=0))


def check_residual_power(model: Model, log: Log, residual: np.ndarray, labels: Sequence[str]) -> list[str]:
    """Warning about joints that move and whose errors (n, nv) have most of the power of the torque."""
    idle = idle_coordinates(model, [log])
    power, lost = (np.sum(np.asarray(x, np.float64) ** 2, axis=0) for x in (log.tau, residual))
    wrong = [labels[j] for j in np.flatnonzero(lost > _MUCH * power).tolist() if j not in idle]
    advice = "check signs, units and the order of columns, or noise is as large as the torque"
    return [f"the fit leaves most of the power of the torques of {', '.join(wrong)}: {advice}"] if wrong else []


def check_rest(log: Log, residual: np.ndarray, labels: Sequence[str]) -> list[str]:
    """Warnings about joints whose errors (n, nv) are mostly those of a start at rest.

    A joint at rest is held by friction, whose torque is then anything within its level and depends on how the joint came to rest,
    which happened before the log. No term predicts it.
    """
    lines = []
    v, t = np.abs(np.asarray(log.v, np.float64)), np.asarray(log.t, np.float64)
    for j, label in enumerate(labels):
        moving = v[:, j] > _REST * v[:, j].max(initial=0)
        start = int(np.argmax(moving)) if moving.any() else 0
        total = float(np.sum(residual[:, j] ** 2))
        share = float(np.sum(residual[:start, j] ** 2)) / total if total > 0 else 0.0
        if start > 1 and share > _MUCH:
            lines.append(
                f"{label} stands still for the first {t[start] - t[0]:.2g} s, where {100 * share:.0f} % of the power of its "
                "error is: no term predicts friction at rest; cut the log there, or move before you record"
            )
    return lines
