"""Studies of recorded robots behind docs/identification.md.

    python -m benchmarks.identify_studies cutoff|delay [--data ../shared/data]

cutoff: the logs of `benchmarks.identify_robots`, low-passed at several frequencies and fitted with the first four terms at
settings given; 0.2 s are dropped at each end. The error on what was not fitted, in per cent of the torque: of the log as
filtered ("own"), and of both sides low-passed once more at 2.5 Hz ("< 2.5 Hz"), which compares the fits with each other; and the
share of the residual's power above ten times the band of the motion, which is vibration.

delay: the Franka's log at 8 Hz, first four terms, with and without `delay="auto"`: error on the last 30 %, and delays (ms)
with half of their 95 % intervals.
"""

import argparse
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from benchmarks.identify_franka import panda, recorded, samples  # noqa: E402
from benchmarks.identify_robots import ROOT, kuka, kuka_samples  # noqa: E402
from jaxdyn import identify  # noqa: E402
from jaxdyn.identify.logs import as_measured  # noqa: E402
from jaxdyn.identify.spectra import vibration  # noqa: E402

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
                * np.linalg.norm(as_measured(low, residual))
                / np.linalg.norm(as_measured(low, np.asarray(test.tau)))
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
        print(f"delay {delay}: {fit.fit.error(fit.aligned(test)):.2f} %")
        if fit.delays is not None:
            half = fit.delays.factor * fit.delays.std
            print(", ".join(f"{1e3 * d:.1f} +- {1e3 * h:.1f}" for d, h in zip(fit.delays.seconds, half, strict=True)))


STUDIES = {"cutoff": cutoffs, "delay": delays}


def main() -> None:
    """Run one study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    options = parser.parse_args()
    STUDIES[options.study](options.data)


if __name__ == "__main__":
    main()
