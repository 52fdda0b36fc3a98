"""How long the errors of a fit last, and how many independent ones they are worth."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.logs import Log


class Whiteness(NamedTuple):
    """Of a residual (n, nv): correlation time (s) of each torque, and how many independent samples it is worth (nv,)."""

    correlation_time: np.ndarray
    effective_samples: np.ndarray


def whiteness(log: Log, residual: np.ndarray) -> Whiteness:
    """How far what a fit leaves over is from independent errors.

    The integrated correlation time, dt (1 + 2 sum of the autocorrelation up to its first zero), is dt for white noise; the
    residual is worth the length of the log over it. The low-pass of `from_raw` alone leaves some 1 / (2 cutoff).

    Source: Priestley (1981), "Spectral analysis and time series", section 5.3.
    """
    n = len(residual)
    step = float(log.t[-1] - log.t[0]) / max(n - 1, 1)
    lasting = _lasting(residual)
    return Whiteness(step * lasting, n / lasting)


def _lasting(residual: np.ndarray) -> np.ndarray:
    """Integrated correlation times (k,) of the columns of a residual (n, k), in samples."""
    n, columns = residual.shape
    lasting = np.ones(columns)
    for j, x in enumerate((residual - residual.mean(axis=0)).T):
        spectrum = np.abs(np.fft.rfft(x / (np.abs(x).max(initial=0) or 1.0), 2 * n)) ** 2
        correlation = np.fft.irfft(spectrum)[:n]
        if not correlation[0] > 0:
            continue
        correlation = correlation / correlation[0]
        end = int(np.argmax(correlation < 0)) or n
        lasting[j] = max(1.0, 1 + 2 * float(correlation[1:end].sum()))
    return lasting


def stretches(residuals: Sequence[np.ndarray]) -> float:
    """How many independent samples the residuals (n, k) of all logs are worth, by the column whose errors last longest."""
    return sum(float((len(residual) / _lasting(residual)).min()) for residual in residuals)
