"""Standard errors: delete-a-group jackknife, autocorrelation of residuals, and effective sample sizes.

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

from jaxdyn.identify.logs import Log, log_rate

# Least numbers of blocks and of independent errors in a group, where these leave at least so many groups: squares of Student's t
# have no variance below five degrees of freedom.
_TOGETHER, _INDEPENDENT, _FEWEST = 2, 2, 6
# Level of the test for white residuals: a search asks it for every joint of a robot.
_LEVEL = 1e-3
# Most independent samples that a log counts for where its errors are those of the model.
_STATES = 10
# Eigenvalues of a Hessian of unit diagonal below the first are those of rounding errors; least relative change of a number.
_ROUNDING, _MIN_CHANGE = 1e-13, 1e-4


def block_groups(count: int, size: float) -> list[np.ndarray]:
    """Indices of the blocks of each jackknife group; `size`: effective sample size of all blocks together."""
    # Few groups make the deviation uncertain, short ones make it too small: length first, then at least six groups.
    groups = min(max(_FEWEST, int(min(size / _INDEPENDENT, count))), count // _TOGETHER)
    # Two at least: the scatter of a single replicate is zero.
    return np.array_split(np.arange(count), max(2, groups))


class Jackknife(NamedTuple):
    """Delete-a-group jackknife at a minimum.

    `root` (n, groups): a root of its covariance; `inverse` (n, n): of the Hessian; `factor`: a 95 % interval is plus and minus
    this many standard deviations, by Student's t with groups - 1 degrees of freedom.
    """

    root: np.ndarray
    inverse: np.ndarray
    factor: float


def jackknife(grams, gradients, curvature: np.ndarray, size: float | None = None) -> Jackknife:
    """Delete-a-group jackknife of the blocks of a loss at its minimum.

    `grams` (blocks, n, n) and `gradients` (blocks, n) are the blocks' curvatures and gradients there, `curvature` (n, n) that of
    the prior, which is in every replicate. `size`: effective sample size of the errors, by which blocks form groups; None: each
    is a group. To first order the minimum without group b is off by (H - D_b)^-1 g_b.
    """
    grams, gradients = np.asarray(grams), np.asarray(gradients)
    if size is not None:
        groups = block_groups(len(grams), size)
        # Gradients and curvatures of blocks add up: a group costs no new pass over the samples.
        grams, gradients = (np.stack([x[group].sum(axis=0) for group in groups]) for x in (grams, gradients))
    # One Newton step stands for a refit without the group: exact where the loss is quadratic.
    H = grams.sum(axis=0) + curvature
    # Unit diagonal first: parameters differ by many orders of magnitude in size.
    # The floor is that of columns of zeros: its inverse times 1e12 of `invert` must not overflow.
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-200))
    scale = unit[:, None] * unit[None, :]
    changes = np.stack(
        [
            unit * (invert((H - gram) * scale) @ (unit * gradient))
            for gram, gradient in zip(grams, gradients, strict=True)
        ]
    )
    # Jackknife variance: (g - 1) / g times the squares about the mean of the replicates, not about the estimate (Efron 1982).
    count = len(grams)
    root = (changes - changes.mean(axis=0)).T * np.sqrt((count - 1) / count)
    return Jackknife(root, invert(H * scale) * scale, student(count - 1))


def invert(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric matrix of unit diagonal; directions without curvature get that of rounding errors."""
    # Without a group the matrix may lose rank. The diagonal is of size one, so that 1e-12 is above rounding of the eigenvalues.
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return (vectors / np.maximum(values, 1e-12)) @ vectors.T


def psd_root(matrix: np.ndarray) -> np.ndarray:
    """Root R (n, n) of a positive semidefinite matrix R R^T."""
    # Semidefinite: coordinates without a prior have no curvature, which a Cholesky factorisation would refuse.
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.maximum(values, 0))


def null_space(gram: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Directions (n, k), of length one, without curvature (n, n) of the data, to rounding, or of the prior."""
    # The prior's curvature can be 1e-12 of the data's, and counts: only coordinates without any are compared with rounding.
    free = np.flatnonzero(np.diag(curvature) == 0)
    H = gram[np.ix_(free, free)]
    # Unit diagonal: parameters differ by many orders of magnitude. A column of zeros is a direction of its own.
    size = np.sqrt(np.maximum(np.diag(H), 0))
    unit = np.divide(1.0, size, out=np.ones_like(size), where=size > 1e-150)
    values, vectors = np.linalg.eigh(H * unit * unit[:, None])
    directions = np.zeros((len(gram), int(np.sum(values < _ROUNDING))))
    directions[free] = unit[:, None] * vectors[:, values < _ROUNDING]
    return directions / np.linalg.norm(directions, axis=0)


def depends_on(rows: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Decide for numbers with the derivatives rows (m, n) whether they change along any of the directions (n, k)."""
    return np.any(np.abs(rows @ directions) > _MIN_CHANGE * np.linalg.norm(rows, axis=1, keepdims=True), axis=1)


def student(degrees: int, level: float = 0.05) -> float:
    """Half-width of a 95 % interval in standard deviations by Student's t; `level`: the share outside of another one."""
    from scipy.special import stdtrit

    # Two-sided: half of the level is beyond each end.
    return float(stdtrit(degrees, 1 - level / 2))


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


def model_error_factors(logs: Sequence[Log], residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Factors (k,) of at least 1 of the scatter of the residuals (n, k) of logs, for errors that are those of the model.

    Noise averages out with time. The errors of a wrong model are a function of the state: they recur whenever the motion does,
    and a fit takes part of them for its parameters, alike in every group of samples. Where residuals are not white, a log
    therefore counts as at most ten independent samples, and the scatter of a log that seems worth more is multiplied by the root
    of the ratio.

    Ripple and other terms left out on simulated arms moved parameters by three to five standard deviations of the scatter.
    """
    # Logs are independent and add up.
    sizes = np.sum([len(residual) / _autocorrelation_times(residual) for residual in residuals], axis=0)
    factors = np.sqrt(np.maximum(sizes / (_STATES * len(residuals)), 1.0))
    return np.where(is_white(logs, residuals, 0.2), 1.0, factors)


def is_white(logs: Sequence[Log], residuals: Sequence[np.ndarray], share: float = 0.5) -> np.ndarray:
    """Decide for each column of the residuals (n, k) of logs whether it has no more power at low frequencies than white noise.

    Bartlett's test, one-sided at the level 0.001: the cumulative periodogram of white noise exceeds a straight line by more than
    sqrt(-log(0.001) / 2) / sqrt(m), m its number of frequencies, once in a thousand. Frequencies up to
    `share` times the sampling rate are compared; up to a fifth, the splines of `shift_torques` leave the power of noise within
    two per cent. Of a log that was low-passed these are frequencies up to 0.6 of the cut-off, where the low-pass leaves it
    within a few. Noise of differentiated positions, which grows with the frequency, counts as white.

    Source: Bartlett (1955), "An introduction to stochastic processes"; Priestley (1981), section 6.2.6.
    """
    places, powers = [], []
    for log, residual in zip(logs, residuals, strict=True):
        # A single sample has no rate, and no frequency but zero.
        rate = log_rate(log) or 1.0
        frequency = np.fft.rfftfreq(len(residual), 1 / rate)
        maximum = min(share * rate, np.inf if log.cutoff is None else 0.6 * log.cutoff)
        # Offsets are fitted, so that the mean says nothing.
        band = (frequency > 0) & (frequency <= maximum)
        # As shares of each log's band: logs may differ in sampling, length and cut-off.
        places.append(frequency[band] / maximum)
        powers.append(np.abs(np.fft.rfft(residual - residual.mean(axis=0), axis=0)[band]) ** 2)
    place, power = np.concatenate(places), np.concatenate(powers)
    count = len(place)
    total = power.sum(axis=0)
    # A single frequency cannot contradict white noise.
    if count < 2:
        return np.ones(power.shape[1], bool)
    cumulative = np.cumsum(power[np.argsort(place)], axis=0) / np.where(total > 0, total, 1)
    excess = np.max(cumulative - np.arange(1, count + 1)[:, None] / count, axis=0)
    # One-sided Kolmogorov-Smirnov bound: white noise exceeds x with the probability exp(-2 m x^2).
    return excess <= np.sqrt(-np.log(_LEVEL) / 2 / count)
