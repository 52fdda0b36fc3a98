"""The Butterworth low-pass that logs go through, forward and backward so that nothing is delayed.

It does what `scipy.signal.butter` and `filtfilt` do, whose package takes half a second to import.
"""

import numpy as np


def low_pass(x: np.ndarray, cutoff: float, rate: float, order: int = 4) -> np.ndarray:
    """Samples x (n, ...) at `rate` (Hz), low-passed at `cutoff` (Hz, half power of one pass) forward, then backward.

    The samples go on beyond both ends by 3 (order + 1) of their own, turned about the end points, and the filter starts as if
    the first of them had always been there.

    **Raises:** ValueError for fewer samples than that.

    Source: Oppenheim & Schafer (2010), section 7.2, bilinear transform; Gustafsson (1996), forward-backward filtering.
    """
    x = np.asarray(x, np.float64)
    pad = 3 * (order + 1)
    if len(x) <= pad:
        raise ValueError(f"{len(x)} samples are too few for a low-pass of order {order}: at least {pad + 1}")
    numerator, denominator = coefficients(cutoff, rate, order)
    before, after = 2 * x[:1] - x[pad:0:-1], 2 * x[-1:] - x[-2 : -pad - 2 : -1]
    y = np.concatenate([before, x, after]).reshape(len(x) + 2 * pad, -1)
    for _ in range(2):
        y = _forward(numerator, denominator, y)[::-1]
    return y[pad:-pad].reshape(x.shape)


def coefficients(cutoff: float, rate: float, order: int) -> tuple[np.ndarray, np.ndarray]:
    """b and a (order + 1,) of a y = b x, both by powers of the delay."""
    corner = 2 * rate * np.tan(np.pi * cutoff / rate)
    poles = corner * np.exp(1j * np.pi * (2 * np.arange(order) + order + 1) / (2 * order))
    denominator = np.real(np.poly((2 * rate + poles) / (2 * rate - poles)))
    numerator = np.poly(-np.ones(order))
    return numerator * denominator.sum() / numerator.sum(), denominator


def _forward(numerator: np.ndarray, denominator: np.ndarray, x: np.ndarray) -> np.ndarray:
    """One pass over samples (n, columns), whose first has always been there: constants pass unchanged."""
    from scipy.linalg.blas import dtbsv  # pyright: ignore[reportAttributeAccessIssue]

    change = x - x[:1]
    driven = sum(b * np.concatenate([np.zeros((k, x.shape[1])), change[: len(x) - k]]) for k, b in enumerate(numerator))
    bands = np.repeat(denominator[:, None], len(x), axis=1)
    columns = [dtbsv(len(denominator) - 1, bands, column, lower=1, diag=1) for column in np.asarray(driven).T]
    return x[:1] + np.stack(columns, axis=1)
