"""Logs of measured motion and torque: checks, the low-pass of a log applied to regressor columns, and the travel of joints."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.model.arguments import Checked, Numbers, is_concrete
from jaxdyn.model.configuration import columns_of
from jaxdyn.model.tree import Model

# Columns that jump are evaluated on this many times the samples of a log before they are low-passed.
_REFINEMENT = 8
# Least travel of a joint (rad, m). Friction needs some thousandths of a radian to reverse (`torque_terms.PRESLIDING`): below a
# few times that a joint does not slide, and its torque says nothing about friction in motion.
_TRAVEL_ANGLE, _TRAVEL_LENGTH = 0.02, 0.002


class Log(eqx.Module):
    """Samples of one motion: time, configuration, velocity, acceleration and joint torque, one row per sample.

    - `t` (n,), strictly increasing (s); `q` (n, nq) (rad, m); `v`, `a` (n, nv) (rad/s, rad/s^2; m/s, m/s^2), or None
      when they were not measured; `tau` (n, nv) (N m; N).
    - `joint_names`: names of the columns of tau, when the file gave them.
    - `cutoff`: Hz, of the low-pass that `from_raw` applied; None for other logs.

    NumPy arrays are kept as they are, so that float64 time stamps do not become float32; anything else is converted to
    float64. The arrays are leaves, so a log passes through `jax.vmap` and `jax.jit`.

    **Raises:** ValueError for wrong shapes, unequal lengths, the first NaN or infinity (signal, row and column) and the
    first step back in time (row and both times); for strings and complex numbers.
    """

    t: Float[Array | np.ndarray, " n"]
    q: Float[Array | np.ndarray, "n nq"]
    v: Float[Array | np.ndarray, "n nv"] | None
    a: Float[Array | np.ndarray, "n nv"] | None
    tau: Float[Array | np.ndarray, "n nv"]
    joint_names: tuple[str, ...] | None = eqx.field(static=True)
    cutoff: float | None = eqx.field(static=True)

    def __init__(
        self,
        t: Numbers,
        q: Numbers,
        v: Numbers | None = None,
        a: Numbers | None = None,
        tau: Numbers | None = None,
        *,
        joint_names: Checked[Sequence[str] | None] = None,
        cutoff: Checked[float | None] = None,
    ):
        if tau is None:
            raise ValueError("Log: tau is missing; give the measured joint torques, zeros for a free motion")
        for name, value in (("t", t), ("q", q), ("v", v), ("a", a), ("tau", tau)):
            setattr(self, name, _as_array(value, name))
        self.joint_names = None if joint_names is None else tuple(joint_names)
        self.cutoff = None if cutoff is None else float(cutoff)

    def __check_init__(self):
        _check_signals({name: getattr(self, name) for name in ("t", "q", "v", "a", "tau")})
        if self.joint_names is not None and len(self.joint_names) != np.shape(self.tau)[1]:
            raise ValueError(f"joint_names has {len(self.joint_names)} names, tau has {np.shape(self.tau)[1]} columns")

    @property
    def nv(self) -> int:
        """Number of torque columns."""
        return self.tau.shape[1]

    def __len__(self) -> int:
        return self.t.shape[0]

    def __getitem__(self, rows) -> "Log":
        """Log of the samples of a slice."""
        if not isinstance(rows, slice):
            raise ValueError(f"a log is indexed by slices, got {rows!r}; one sample is log.q[i], log.v[i], ...")
        return map_samples(self, lambda x: x[rows])


def split(log: Log, fraction: float = 0.7) -> tuple[Log, Log]:
    """Split a log into the first `fraction` of the samples and the rest: training and test data without a shared sample.

    **Raises:** ValueError when the fraction is not between 0 and 1, or one part would have no sample.
    """
    cut = int(fraction * len(log)) if 0 < fraction < 1 else 0
    if not 0 < cut < len(log):
        raise ValueError(f"fraction={fraction} of {len(log)} samples leaves one part empty; take one between 0 and 1")
    return log[:cut], log[cut:]


def as_logs(log, system=None, *, needs=("v", "a")) -> tuple[Log, ...]:
    """Tuple of one log or a sequence of logs, each checked against the system unless that is None.

    **Raises:** ValueError for other types, for an empty sequence, and as `check_log`, with the log's place in the sequence.
    """
    logs = (log,) if isinstance(log, Log) else tuple(log) if isinstance(log, Sequence) else ()
    if not logs or not all(isinstance(one, Log) for one in logs):
        raise ValueError(f"log is {type(log).__name__}; give a jd.identify.Log, or a sequence of at least one")
    for place, one in enumerate(logs):
        try:
            if system is not None:
                check_log(one, system, needs=needs)
        except ValueError as error:
            raise ValueError(f"log {place + 1} of {len(logs)}: {error}" if len(logs) > 1 else str(error)) from None
    return logs


def check_log(log: Log, system, *, needs=("v", "a")) -> None:
    """Raise a ValueError unless the log has the system's coordinates in their order, and the signals of `needs`."""
    is_model = isinstance(system, Model)
    for name in ("q", "v", "a", "tau"):
        value = getattr(log, name)
        if value is None:
            if name in needs:
                raise ValueError(f"the log has no {name}; measure it, or make it from q with jd.identify.from_raw")
            continue
        want = system.nq if name == "q" else system.nv
        if value.shape[1] != want:
            known = f"the {type(system).__name__} has {want}; give one column for each of its coordinates"
            if is_model:
                joints = ", ".join(system.joint_names)
                known = f"model {system.name!r} has {want} (joints {joints}); lock the joints that were not logged"
            raise ValueError(f"the log has {value.shape[1]} columns of {name}, {known}")
    if is_model and log.joint_names is not None and system.nv == system.nb and log.joint_names != system.joint_names:
        raise ValueError(
            f"the log's joints are {', '.join(log.joint_names)}, those of model {system.name!r} "
            f"{', '.join(system.joint_names)}; read the log with read_log(path, joint_names=model.joint_names)"
        )


def filter_like_log(log: Log, columns: np.ndarray, factor: int = 1) -> np.ndarray:
    """Columns (n, ...) as the log's low-pass would have left them; unchanged for a log that was not filtered.

    `factor`: samples of the columns per sample of the log; every `factor`-th is returned.
    """
    cutoff = log.cutoff
    if cutoff is None or not _has_filter(log):
        return columns if factor == 1 else columns[::factor]
    if not columns.size:
        return columns[::factor]
    # The refined samples have a higher rate: the cut-off stays the same in Hz.
    return low_pass(columns, factor * log_rate(log), cutoff)[::factor]


def low_pass(x: np.ndarray, rate: float, cutoff: float, order: int = 4) -> np.ndarray:
    """Columns x (n, ...) through a Butterworth filter, forward and backward; sampling rate and half-power frequency in Hz.

    Before, both ends are extended by three periods of the cut-off. SciPy's default of some fifteen samples is much shorter
    than the filter's response. With it, accelerations of a motion that does not begin at rest were wrong by a third of their
    size up to two periods from the ends.
    """
    from scipy.signal import butter, filtfilt

    # scipy's annotations leave open what `output` gives.
    numerator, denominator = butter(order, 2 * cutoff / rate, output="ba")  # pyright: ignore
    return filtfilt(numerator, denominator, x, axis=0, padlen=min(int(3 * rate / cutoff), len(x) - 1))


def samples_for_jumps(log: Log) -> tuple[Log, int]:
    """Log on which columns that jump are evaluated before `filter_like_log`, and its samples per sample of this one.

    The low-pass has smoothed the measured torque, also where friction jumps because a joint reverses. The column of friction must
    be smoothed in the same way, or each jump leaves an error. The column is evaluated on a finer grid first: the log has some
    fifteen samples in a period of the cut-off, which locate a jump too coarsely. The errors that remained there made other terms
    and robust losses seem useful.
    """
    return (refine_log(log, _REFINEMENT), _REFINEMENT) if _has_filter(log) else (log, 1)


def refine_log(log: Log, factor: int) -> Log:
    """A log with `factor` times the samples, by cubic splines, whose every `factor`-th sample is one of the log."""
    return map_samples(log, lambda x: refine_samples(x, factor))


def refine_samples(samples: np.ndarray, factor: int) -> np.ndarray:
    """Samples (n, ...) interpolated to (n - 1) factor + 1 by cubic splines."""
    from scipy.interpolate import CubicSpline

    samples = np.asarray(samples, np.float64)
    places = np.arange(factor * (len(samples) - 1) + 1) / factor
    return CubicSpline(np.arange(len(samples)), samples)(places)


def _has_filter(log: Log) -> bool:
    shortest = 16  # of SciPy's default padding for a filter of fourth order
    # Near the Nyquist frequency, half the sampling rate, there is no band left to remove; above it no filter exists.
    return log.cutoff is not None and log.cutoff < 0.45 * log_rate(log) and len(log) >= shortest


def log_rate(log: Log) -> float:
    """Mean sampling rate (Hz), 0 for a single sample."""
    return (len(log) - 1) / float(log.t[-1] - log.t[0]) if len(log) > 1 else 0.0


def _as_array(value, name: str):
    if value is None or isinstance(value, jax.Array):
        return value
    value = np.asarray(value)
    if value.dtype.kind not in "biuf":  # NumPy parses texts as numbers, "1_0" as ten
        raise ValueError(f"{name} holds {value.dtype.name}; give real numbers")
    return value if value.dtype in (np.float32, np.float64) else value.astype(np.float64)


def _check_signals(signals: dict) -> None:
    signals = {name: value for name, value in signals.items() if value is not None}
    for name, value in signals.items():
        want = 1 if name == "t" else 2
        if value.ndim != want:
            raise ValueError(f"{name} has shape {value.shape}, expected {'(n,)' if name == 't' else '(n, columns)'}")
    lengths = {name: value.shape[0] for name, value in signals.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"unequal lengths: {', '.join(f'{name} has {k} rows' for name, k in lengths.items())}")
    if lengths["t"] == 0:
        raise ValueError("the log has no samples")
    for name in ("v", "a"):
        if name in signals and signals[name].shape[1] != signals["tau"].shape[1]:
            raise ValueError(f"{name} has {signals[name].shape[1]} columns, tau has {signals['tau'].shape[1]}")
    # Values of traced arrays are not known.
    if not is_concrete(signals):
        return
    for name, value in signals.items():
        bad = np.argwhere(~np.isfinite(np.asarray(value)))
        if len(bad):
            row = bad[0][0]
            column = "" if name == "t" else f", column {bad[0][1] + 1}"
            raise ValueError(
                f"{name} is {np.asarray(value)[tuple(bad[0])]} at row {row}{column} ({len(bad)} such values); drop these rows, "
                "or cut the log there"
            )
    t = np.asarray(signals["t"])
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back):
        i = int(back[0])
        raise ValueError(
            f"time does not increase at row {i + 1}: t[{i}]={t[i]:.9g} s, t[{i + 1}]={t[i + 1]:.9g} s "
            f"({len(back)} such rows); sort the log or drop repeated rows"
        )


def map_samples(log: Log, function: Callable[[Any], Any]) -> Log:
    """Log with a function applied to each of its signals."""
    signals = {name: getattr(log, name) for name in ("t", "q", "v", "a", "tau")}
    changed: dict[str, Any] = {name: function(x) for name, x in signals.items() if x is not None}
    return dataclasses.replace(log, **changed)


def root_mean_square(samples) -> np.ndarray:
    """Root mean square of every column of samples (n, columns), whatever their size."""
    samples = np.asarray(samples, np.float64)
    # Squares of large numbers would overflow: the column is divided by its largest value first.
    largest = np.abs(samples).max(axis=0, initial=0)
    return largest * np.sqrt(np.mean((samples / np.where(largest > 0, largest, 1)) ** 2, axis=0))


def signal_sizes(logs: Sequence[Log]) -> list[np.ndarray]:
    """Root mean squares (nv,) of torque, velocity and acceleration over all logs."""
    return [
        root_mean_square(np.concatenate([np.asarray(getattr(log, name), np.float64) for log in logs]))
        for name in ("tau", "v", "a")
    ]


def motion_paths(model: Model, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Paths (n, nv) of each coordinate, rad or m: its positions, and the integral of its velocity.

    The integral is used for both where no coordinate of q belongs to a velocity alone, as for quaternions.
    """
    q, v, t = (np.asarray(x, np.float64) for x in (log.q, log.v, log.t))
    steps = (v[1:] + v[:-1]) / 2 * np.diff(t)[:, None]
    integrals = np.concatenate([np.zeros((1, v.shape[1])), np.cumsum(steps, axis=0)])
    positions = integrals.copy()
    slices = zip(model.topology.q_slices, model.topology.v_slices, strict=True)
    for of_q, of_v in slices:
        if of_q.stop - of_q.start == of_v.stop - of_v.start == 1:
            positions[:, of_v] = q[:, of_q]
    return positions, integrals


def idle_coordinates(model: Model, logs: Sequence[Log]) -> tuple[int, ...]:
    """Indices in v of the coordinates that travel less than 0.02 rad, or 2 mm, in every log."""
    travel = np.max([np.ptp(motion_paths(model, log)[0], axis=0) for log in logs], axis=0)
    return tuple(int(j) for j in np.flatnonzero(travel < np.where(are_angles(model), _TRAVEL_ANGLE, _TRAVEL_LENGTH)))


def are_angles(model: Model) -> np.ndarray:
    """Mask (nv,) of the coordinates that are angles."""
    return np.array([unit == "rad/s" for unit in columns_of(model).v_units])
