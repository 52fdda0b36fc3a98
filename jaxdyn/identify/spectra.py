"""Spectra of logs: where the motion is, and whether what a fit leaves over is vibration above it."""

import numpy as np

from jaxdyn.identify.logs import Log

# Share of the velocity's power that lies in the band of the motion, and how far above it the residual may still be friction's.
_MOTION, _ABOVE = 0.999, 10.0


def motion_band(log: Log) -> float:
    """Frequency (Hz) below which 99.9 % of the power of the velocity lies, of the joint where that is highest; 0 at rest."""
    frequency, power = _power(log, np.asarray(log.v, np.float64))
    total = power.sum(axis=0)
    moving = power[:, total > 1e-6 * total.max(initial=0)]
    if not moving.size or not total.max() > 0:
        return 0.0
    share = np.cumsum(moving, axis=0) / moving.sum(axis=0)
    return float(max(frequency[np.argmax(share >= _MOTION, axis=0)]))


def vibration(log: Log, residual: np.ndarray) -> tuple[float, float]:
    """Share of the power of a residual (n, nv) above ten times the band of the motion, and that frequency (Hz).

    Rigid bodies answer at the frequencies of the motion and their first multiples, friction that turns round somewhat higher.
    What is far above is neither: elastic joints, drives, sensors. A low-pass at that frequency leaves it out.
    """
    edge = _ABOVE * motion_band(log)
    frequency, power = _power(log, np.asarray(residual, np.float64))
    total = float(power.sum())
    return (float(power[frequency > edge].sum()) / total if total > 0 and edge > 0 else 0.0), edge


def _power(log: Log, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (Hz) and power (frequencies, columns) of samples without their mean, in a window that is zero at both ends.

    The window keeps a slow motion that does not close on itself from reaching high frequencies.
    """
    step = float(log.t[-1] - log.t[0]) / max(len(log) - 1, 1)
    window = np.hanning(len(x))[:, None]
    return np.fft.rfftfreq(len(x), step), np.abs(np.fft.rfft(window * (x - x.mean(axis=0)), axis=0)) ** 2
