"""Logs from raw samples: uniform in time, low-passed without delay, differentiated."""

from collections.abc import Sequence

import numpy as np

from jaxdyn.identify.logs import Log, pad_length
from jaxdyn.identify.workflows.log_repair import repair_log
from jaxdyn.identify.workflows.spectra import choose_cutoff
from jaxdyn.model.arguments import Checked, Numbers
from jaxdyn.model.tree import Model


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

    The samples are interpolated linearly to a uniform grid of as many samples. q is low-passed forward and backward
    (Butterworth, zero phase); v is its numerical gradient, low-passed again; a the gradient of v, low-passed again; tau
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
    - `model`: defines the columns that are angles, their joints' names and velocity limits. Without it any column of q may be
      one.

    **Returns:** `Log` with t, q, v, a, tau.

    **Raises:** ValueError for all that `Log` refuses; an `order`, `trim` or `every` that is no whole number or too small; too few
    samples for the filter and the trimming; a cut-off above half the sampling rate; a gap in time longer than half a period of
    the cut-off, which interpolation would invent; outliers, with row and joint; positions that jump and do not come back,
    also with `outliers="drop"`.

    Source: the off-line preparation usual in robot identification (Gautier 1997; Khalil & Dombre 2002, section 12.4).
    """
    from scipy.signal import butter, filtfilt

    for name, value, least in (("order", order, 1), ("trim", trim, 0), ("every", every, 1)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            raise ValueError(f"{name} is {value!r}; give a whole number of at least {least}")
    if isinstance(cutoff, str) and cutoff != "auto":
        raise ValueError(f'cutoff is {cutoff!r}; give a frequency in Hz, or "auto"')
    # Before the filter, whose response would spread a corrupted sample over its neighbours.
    raw = repair_log(Log(t, q, tau=tau, joint_names=joint_names), model, unwrap=unwrap, outliers=outliers)
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
    grid = np.linspace(t[0], t[-1], n)
    # scipy's annotations leave open what `output` gives.
    numerator, denominator = butter(order, 2 * cutoff / rate, output="ba")  # pyright: ignore

    def uniform(x):
        return np.stack([np.interp(grid, t, column) for column in x.T], axis=1)

    def low(x):
        return filtfilt(numerator, denominator, x, axis=0, padlen=pad_length(rate, cutoff, n))

    positions, torques = low(uniform(q)), low(uniform(tau))
    # A difference amplifies noise in proportion to its frequency: each result goes through the low-pass again.
    v = low(np.gradient(positions, grid, axis=0))
    a = low(np.gradient(v, grid, axis=0))
    # Decimated after the low-pass: before it, frequencies above half of the new rate would alias.
    keep = slice(trim, n - trim, every)
    return Log(grid[keep], positions[keep], v[keep], a[keep], torques[keep], joint_names=raw.joint_names, cutoff=cutoff)
