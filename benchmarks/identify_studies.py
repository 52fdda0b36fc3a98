"""Studies of recorded robots behind docs/identification.md.

    python -m benchmarks.identify_studies cutoff|delay|a2 [--data ../shared/data]

cutoff: the logs of `benchmarks.identify_robots`, low-passed at several frequencies and fitted with the first four terms at
settings given; 0.2 s are dropped at each end. The error on what was not fitted, in per cent of the torque: of the log as
filtered ("own"), and of both sides low-passed once more at 2.5 Hz ("< 2.5 Hz"), which compares the fits with each other; and the
share of the residual's power above ten times the band of the motion, which is vibration.

delay: the Franka's log at 8 Hz, first four terms, with and without `delay="auto"`: error on the last 30 %, and delays (ms)
with half of their 95 % intervals.

a2: what a fit leaves over at the KUKA's second joint: how long it stands still, how far off the torque is there, the share of the
residual's power there, the band that holds 90 % of it with and without that start, and which columns would explain it.
"""

import argparse
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from benchmarks.identify_franka import panda, recorded, samples  # noqa: E402
from benchmarks.identify_robots import ROOT, kuka, kuka_log, kuka_samples  # noqa: E402
from jaxdyn import identify  # noqa: E402
from jaxdyn.identify.logs import filter_like_log  # noqa: E402
from jaxdyn.identify.raw_logs import vibration  # noqa: E402

CUTOFFS = (3.5, 5.0, 6.5, 8.0, 10.0, 15.0, 20.0)
COMMON = 2.5


def cutoffs(data: Path) -> None:
    """One row for each robot and cut-off."""
    arm, hand = kuka(), panda()
    raws = {"KUKA A + B -> C": [kuka_samples(data, name) for name in "ABC"], "Franka 70 % -> 30 %": [samples(data)]}
    print(f"{'':20} {'Hz':>6} {'own':>8} {'< 2.5 Hz':>9} {'vibration':>10}")
    for name, logs in raws.items():
        training = logs[:2] if len(logs) == 3 else [identify.split(logs[0], 0.7)[0]]
        chosen = identify.choose_cutoff(training).frequency
        for cutoff in sorted({*CUTOFFS, round(chosen, 2)}):
            found = [filtered(log, cutoff) for log in logs]
            train, test = (found[:2], found[2]) if len(found) == 3 else ([x] for x in identify.split(found[0], 0.7))
            test = test[0] if isinstance(test, list) else test
            model, v_s = (arm, 0.0003) if len(found) == 3 else (hand, 0.01)
            fit = identify.fit_robot(model, train, identify.TERMS, v_s=v_s, prior=1.0, robust=1.345).fit
            low = identify.Log(test.t, test.q, test.v, test.a, test.tau, cutoff=COMMON)
            residual = fit.torques(test) - test.tau
            below = (
                100
                * np.linalg.norm(filter_like_log(low, residual))
                / np.linalg.norm(filter_like_log(low, np.asarray(test.tau)))
            )
            mark = " auto" if cutoff == round(chosen, 2) else ""
            share = 100 * vibration(test, residual)[0]
            print(f"{name:20} {cutoff:6.2f} {fit.error(test):7.2f} % {below:7.2f} % {share:8.0f} %{mark}", flush=True)


def filtered(raw: identify.Log, cutoff: float) -> identify.Log:
    """A raw log, low-passed; 15 samples of a period of the cut-off are kept."""
    rate = (len(raw) - 1) / (raw.t[-1] - raw.t[0])
    every = max(1, int(rate / (15 * cutoff)))
    return identify.from_raw(raw.t, raw.q, raw.tau, cutoff=cutoff, every=every, trim=int(0.2 * rate))


def delays(data: Path) -> None:
    """One row without delays, one with them, and the delays."""
    model, (train, test) = panda(), identify.split(recorded(data), 0.7)
    for delay in (0.0, "auto"):
        fit = identify.fit_robot(model, train, identify.TERMS, v_s=0.01, prior=1.0, robust=None, delay=delay)
        print(f"delay {delay}: {fit.fit.error(fit.align(test)):.2f} %")
        if fit.delays is not None:
            half = fit.delays.factor * fit.delays.std
            print(", ".join(f"{1e3 * d:.1f} +- {1e3 * h:.1f}" for d, h in zip(fit.delays.seconds, half, strict=True)))


def slow_joint(data: Path) -> None:
    """Where the KUKA's second joint goes wrong: when, how slowly, and which columns would explain it."""
    model, joint = kuka(), 1
    logs = {name: kuka_log(data, name) for name in "ABC"}
    fit = identify.fit_robot(model, [logs["A"], logs["B"]], identify.TERMS, v_s=0.0003, prior=1.0, robust=1.345).fit
    residuals = {name: np.asarray(log.tau)[:, joint] - fit.torques(log)[:, joint] for name, log in logs.items()}
    moving = {name: first_move(log, joint) for name, log in logs.items()}
    print(
        f"{'':4} {'rest':>8} {'off there':>12} {'power there':>12} {'90 % below':>11} {'after it':>9} {'rms':>8} {'moving':>8}"
    )
    for name, log in logs.items():
        r, start = residuals[name], moving[name]
        rest, share = float(log.t[start] - log.t[0]), 100 * np.sum(r[:start] ** 2) / np.sum(r**2)
        bands = [f"{band(x, log.t):.2f} Hz" for x in (r, r[start:])]
        sizes = [f"{np.sqrt(np.mean(x**2)):.0f}" for x in (r, r[start:])]
        print(
            f"{name:4} {rest:6.2f} s {np.mean(r[:start]):+8.0f} N m {share:10.0f} % {bands[0]:>11} {bands[1]:>9} "
            f"{sizes[0]:>8} {sizes[1]:>8}"
        )
    print(f"Coulomb friction fitted at a2: {float(fit.friction.coulomb[joint]):.0f} N m")
    print("share of a2's residual explained, fitted to each log itself; and rms on C fitted to A and B (N m)")
    for label, column in CAUSES.items():
        columns = {name: column(log) for name, log in logs.items()}
        shares = []
        for name in logs:
            rest = residuals[name] - columns[name] @ solved(columns[name], residuals[name])
            shares.append(1 - np.sum(rest**2) / np.sum(residuals[name] ** 2))
        both = [np.concatenate([x["A"], x["B"]]) for x in (columns, residuals)]
        rms = np.sqrt(np.mean((residuals["C"] - columns["C"] @ solved(*both)) ** 2))
        print(f"{label:36} " + " ".join(f"{share:5.2f}" for share in shares) + f" {rms:8.0f}")


def first_move(log: identify.Log, joint: int) -> int:
    """The first sample at which a joint has moved by a hundredth of its way."""
    q = np.asarray(log.q)[:, joint]
    return int(np.argmax(np.abs(q - q[0]) > 1e-2 * np.ptp(q)))


def band(x: np.ndarray, t) -> float:
    """The frequency (Hz) below which 90 % of a signal's power lies."""
    power = np.cumsum(np.abs(np.fft.rfft(x)) ** 2)
    return float(np.fft.rfftfreq(len(x), float(t[1] - t[0]))[np.searchsorted(power, 0.9 * power[-1])])


def solved(columns: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Coefficients of least squares."""
    return np.linalg.lstsq(columns, residual, rcond=None)[0]


def lagged(signal: np.ndarray, t, seconds) -> np.ndarray:
    """A signal behind first-order lags of some seconds, side by side."""
    dt, result = float(t[1] - t[0]), np.zeros((len(signal), len(seconds)))
    for k, lag in enumerate(seconds):
        keep = np.exp(-dt / lag)
        for i in range(1, len(signal)):
            result[i, k] = keep * result[i - 1, k] + (1 - keep) * signal[i]
    return result


def _of(*signals) -> np.ndarray:
    return np.stack([np.asarray(x, np.float64) for x in signals], axis=1)


LAGS = (0.1, 0.3, 1.0, 3.0)
CAUSES = {
    "exp(-t / 0.5 s)": lambda log: _of(np.exp(-(np.asarray(log.t) - log.t[0]) / 0.5)),
    "sin, cos of q2 and of 2 q2": lambda log: _of(*(f(k * log.q[:, 1]) for k in (1, 2) for f in (np.sin, np.cos))),
    "sin, cos of q2, 2 q2, q3 and 2 q3": lambda log: _of(
        *(f(k * log.q[:, j]) for j in (1, 2) for k in (1, 2) for f in (np.sin, np.cos))
    ),
    "low-passes of sign v2 (0.1 to 3 s)": lambda log: lagged(np.sign(log.v[:, 1]), log.t, LAGS),
    "low-passes of v2 (0.1 to 3 s)": lambda log: lagged(np.asarray(log.v[:, 1]), log.t, LAGS),
    "v2, a2, sign v2": lambda log: _of(log.v[:, 1], log.a[:, 1], np.sign(log.v[:, 1])),
}
STUDIES = {"cutoff": cutoffs, "delay": delays, "a2": slow_joint}


def main() -> None:
    """Run one study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    options = parser.parse_args()
    STUDIES[options.study](options.data)


if __name__ == "__main__":
    main()
