"""Uncertainty from blocks of consecutive samples, each left out in turn (delete-a-group jackknife).

Errors of neighbouring groups hang together, which a jackknife does not see: of the variance of a mean of errors whose correlation
decays exponentially it finds the share 1 - T / (2 L), with L the length of a group and T the integrated correlation time. Groups
are therefore twice as long as errors last at least, where that leaves six of them, which leaves an eighth of a standard deviation
unseen; leaving out groups that tell much errs to the other side.

Source: Efron (1982), "The jackknife, the bootstrap and other resampling plans"; Kunsch (1989), "The jackknife and the bootstrap
for general stationary observations"; Bell & McCaffrey (2002), "Bias reduction in standard errors for linear regression with
multi-stage samples", for what leaving out corrects.
"""

import numpy as np

# Blocks left out together, and independent errors in them: no fewer than these where that leaves so many groups at least. Of
# Student's t with less than five degrees of freedom, a number over its deviation has squares without a variance.
_TOGETHER, _INDEPENDENT, _FEWEST = 2, 2, 6


def block_groups(count: int, worth: float) -> list[np.ndarray]:
    """Numbers of the blocks that are left out together; `worth`: how many independent errors all of them hold."""
    groups = min(max(_FEWEST, int(min(worth / _INDEPENDENT, count))), count // _TOGETHER)
    return np.array_split(np.arange(count), max(2, groups))


def jackknife(grams: np.ndarray, slopes: np.ndarray, curvature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A root (n, groups) of the covariance of a minimum, each group of samples left out in turn, and the inverse Hessian (n, n).

    `grams` (groups, n, n) and `slopes` (groups, n) are the groups' curvatures and slopes there, `curvature` (n, n) what stays.
    """
    H = grams.sum(axis=0) + curvature
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    scale = unit[:, None] * unit[None, :]
    changes = np.stack(
        [unit * (_inverse((H - gram) * scale) @ (unit * slope)) for gram, slope in zip(grams, slopes, strict=True)]
    )
    count = len(grams)
    return (changes - changes.mean(axis=0)).T * np.sqrt((count - 1) / count), _inverse(H * scale) * scale


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric matrix of unit diagonal; directions without curvature are taken as having that of rounding."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return (vectors / np.maximum(values, 1e-12)) @ vectors.T


def student(freedoms: int) -> float:
    """Half of a 95 % interval in standard deviations, by Student's t with so many degrees of freedom."""
    from scipy.special import stdtrit

    return float(stdtrit(freedoms, 0.975))
