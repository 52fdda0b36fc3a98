"""Delete-a-group jackknife, autocorrelation of residuals, and effective sample sizes.

Errors of neighbouring groups are correlated, which a jackknife does not see: of the variance of a mean of errors whose
correlation decays exponentially it finds the share 1 - T / (2 L), with L the length of a group and T the integrated
autocorrelation time. Groups are therefore at least twice as long as that time, where this leaves six of them; an eighth of a
standard deviation then remains unseen. Leaving out groups with much information errs to the other side.

Source: Efron (1982), "The jackknife, the bootstrap and other resampling plans"; Kunsch (1989), "The jackknife and the bootstrap
for general stationary observations"; Bell & McCaffrey (2002), "Bias reduction in standard errors for linear regression with
multi-stage samples", for the factor of the group left out; Priestley (1981), "Spectral analysis and time series", section 5.3.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.logs import Log

# Least numbers of blocks and of independent errors in a group, where these leave at least so many groups: squares of Student's t
# have no variance below five degrees of freedom.
_TOGETHER, _INDEPENDENT, _FEWEST = 2, 2, 6
# Level of the test for white residuals: a search asks it for every joint of a robot.
_LEVEL = 1e-3


def block_groups(count: int, size: float) -> list[np.ndarray]:
    """Indices of the blocks of each jackknife group; `size`: effective sample size of all blocks together."""
    # Few groups make the deviation uncertain, short ones make it too small: length first, then at least six groups.
    groups = min(max(_FEWEST, int(min(size / _INDEPENDENT, count))), count // _TOGETHER)
    # Two at least: the scatter of a single replicate is zero.
    return np.array_split(np.arange(count), max(2, groups))


def jackknife(grams: np.ndarray, gradients: np.ndarray, curvature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Delete-a-group jackknife at a minimum: a root (n, groups) of its covariance, and the inverse Hessian (n, n).

    `grams` (groups, n, n) and `gradients` (groups, n) are the groups' curvatures and gradients there, `curvature` (n, n) that of
    the prior, which is in every replicate. To first order the minimum without group b is off by (H - D_b)^-1 g_b.
    """
    # One Newton step stands for a refit without the group: exact where the loss is quadratic.
    H = grams.sum(axis=0) + curvature
    # Unit diagonal first: parameters differ by many orders of magnitude in size.
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    scale = unit[:, None] * unit[None, :]
    changes = np.stack(
        [
            unit * (_inverse((H - gram) * scale) @ (unit * gradient))
            for gram, gradient in zip(grams, gradients, strict=True)
        ]
    )
    # Jackknife variance: (g - 1) / g times the squares about the mean of the replicates, not about the estimate (Efron 1982).
    count = len(grams)
    return (changes - changes.mean(axis=0)).T * np.sqrt((count - 1) / count), _inverse(H * scale) * scale


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric matrix of unit diagonal; directions without curvature get that of rounding errors."""
    # Without a group the matrix may lose rank. The diagonal is of size one, so that 1e-12 is above rounding of the eigenvalues.
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return (vectors / np.maximum(values, 1e-12)) @ vectors.T


def student(degrees: int) -> float:
    """Half-width of a 95 % interval in standard deviations, by Student's t with so many degrees of freedom."""
    from scipy.special import stdtrit

    # Two-sided: 2.5 % beyond each end.
    return float(stdtrit(degrees, 0.975))


class Whiteness(NamedTuple):
    """Integrated autocorrelation time (s) and effective sample size of each column of a residual, both (nv,)."""

    correlation_time: np.ndarray
    effective_samples: np.ndarray


def whiteness(log: Log, residual: np.ndarray) -> Whiteness:
    """Autocorrelation of the residual (n, nv) of a fit along a log.

    The integrated autocorrelation time, dt (1 + 2 sum of the autocorrelation up to its first zero), is dt for white noise. The
    effective sample size is the duration of the log over it. The low-pass of `from_raw` alone leaves some 1 / (2 cutoff).

    An error that is constant through the log is one sample, and lasts as long as the log; of zeros alone each counts.

    **Raises:** ValueError for a residual that is no table of finite numbers with the rows of the log.

    Source: Priestley (1981), "Spectral analysis and time series", section 5.3.
    """
    residual = np.asarray(residual, np.float64)
    n = len(log)
    if residual.ndim != 2 or len(residual) != n:
        raise ValueError(f"residual has shape {residual.shape}, expected ({n}, nv), a row for each sample of the log")
    if len(rows := np.argwhere(~np.isfinite(residual))):
        row, column = rows[0]
        raise ValueError(f"residual is {residual[row, column]} in row {row}, column {column}; leave such samples out")
    step = float(log.t[-1] - log.t[0]) / max(n - 1, 1)
    mean = np.abs(residual.mean(axis=0))
    spread = np.abs(residual - residual.mean(axis=0)).max(axis=0, initial=0.0)
    # What rounding of the mean leaves of a constant is no noise.
    is_constant = (mean > 0) & (spread <= 64 * np.finfo(np.float64).eps * mean)
    times = np.where(is_constant, float(n), _autocorrelation_times(residual))
    return Whiteness(step * times, n / times)


def _autocorrelation_times(residual: np.ndarray) -> np.ndarray:
    """Integrated autocorrelation times (k,) of the columns of a residual (n, k), in samples."""
    n, columns = residual.shape
    times = np.ones(columns)
    for j, x in enumerate((residual - residual.mean(axis=0)).T):
        # Padded to twice the length, so that the circular correlation of the transform does not wrap around.
        # The scale cancels in the correlation; dividing by the largest value keeps squares from overflow and underflow.
        spectrum = np.abs(np.fft.rfft(x / (np.abs(x).max(initial=0) or 1.0), 2 * n)) ** 2
        correlation = np.fft.irfft(spectrum)[:n]
        # A residual of zeros has no correlation, and counts as white.
        if not correlation[0] > 0:
            continue
        correlation = correlation / correlation[0]
        # Beyond its first zero the estimate is noise, of which the sum over all lags would be minus one half.
        end = int(np.argmax(correlation < 0)) or n
        # At least one sample: anticorrelated errors must not give more effective samples than there are.
        times[j] = max(1.0, 1 + 2 * float(correlation[1:end].sum()))
    return times


def effective_sample_size(residuals: Sequence[np.ndarray]) -> float:
    """Effective sample size of the residuals (n, k) of all logs, by the column with the longest autocorrelation."""
    # Logs are independent and add up. Within a log all torques share the parameters, so that the slowest errors decide.
    return sum(float((len(residual) / _autocorrelation_times(residual)).min()) for residual in residuals)


def is_white(logs: Sequence[Log], residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Decide for each column of the residuals (n, k) of logs whether it has no more power at low frequencies than white noise.

    Bartlett's test, one-sided at the level 0.001: the cumulative periodogram of white noise exceeds a straight line by more than
    sqrt(-log(0.001) / 2) / sqrt(m), m its number of frequencies, once in a thousand. Of a log that was low-passed,
    frequencies up to 0.6 of the cut-off are compared, where the low-pass leaves the power within a few per cent. Noise of
    differentiated positions, which grows with the frequency, counts as white.

    Source: Bartlett (1955), "An introduction to stochastic processes"; Priestley (1981), section 6.2.6.
    """
    places, powers = [], []
    for log, residual in zip(logs, residuals, strict=True):
        rate = max(len(log) - 1, 1) / float(log.t[-1] - log.t[0])
        frequency = np.fft.rfftfreq(len(residual), 1 / rate)
        most = rate / 2 if log.cutoff is None else min(0.6 * log.cutoff, rate / 2)
        # Offsets are fitted, so that the mean says nothing.
        band = (frequency > 0) & (frequency <= most)
        # As shares of each log's band: logs may differ in sampling, length and cut-off.
        places.append(frequency[band] / most)
        powers.append(np.abs(np.fft.rfft(residual - residual.mean(axis=0), axis=0)[band]) ** 2)
    place, power = np.concatenate(places), np.concatenate(powers)
    count = len(place)
    total = power.sum(axis=0)
    # A single frequency cannot contradict white noise.
    if count < 2:
        return np.ones(power.shape[1], bool)
    share = np.cumsum(power[np.argsort(place)], axis=0) / np.where(total > 0, total, 1)
    excess = np.max(share - np.arange(1, count + 1)[:, None] / count, axis=0)
    # One-sided Kolmogorov-Smirnov bound: white noise exceeds x with the probability exp(-2 m x^2).
    return excess <= np.sqrt(-np.log(_LEVEL) / 2 / count)
