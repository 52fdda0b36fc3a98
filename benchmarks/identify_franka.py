"""Identification of a recorded Franka Panda log: held-out torque error and run time of fits by torques.

    python benchmarks/identify_franka.py [--data ../shared/data]

Train on the first 70 % of the log, test on the last 30 %; filter, split and error measure are those of the data's
`prepare.py`: 100 |tau_fit - tau| / |tau| in per cent over all joints and samples. Cold times include compilation.
"""

import argparse
import json
import time
from importlib.metadata import distribution
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from jaxdyn import identify  # noqa: E402
from jaxdyn.constraints.codes import name_of  # noqa: E402
from jaxdyn.io import load_model  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent


def samples(folder: Path) -> identify.Log:
    """The raw log."""
    log = folder / "franka_panda/matlab/data/Exciting_Traj/Trajectory_1/rbt_log"
    if not log.is_dir():
        raise SystemExit(f"no Franka log at {log}; name the directory of recorded data with --data")
    t, q, tau = (np.loadtxt(log / f"exciting_traj_{name}.txt") for name in ("time", "positions", "torques"))
    return identify.Log(t, q.reshape(-1, 7), tau=tau.reshape(-1, 7))


def recorded(folder: Path) -> identify.Log:
    """The log, low-passed at 8 Hz."""
    raw = samples(folder)
    return identify.from_raw(raw.t, raw.q, raw.tau)


def panda():
    """The Panda without fingers and without the placeholder friction of its URDF."""
    robots = Path(str(distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots")))
    path = robots / "panda_description/urdf/panda.urdf"
    model = load_model(path, lock=("panda_finger_joint1", "panda_finger_joint2"))
    return model.replace(damping=None, friction=None)


def timed(function):
    """Result, time of the first call and of the second (s)."""
    times = []
    for _ in range(2):
        start = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - start)
    return result, times


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--out", type=Path, help="also write the table as JSON")
    options = parser.parse_args()
    model, log = panda(), recorded(options.data)
    train, test = identify.split(log, 0.7)
    rows = []

    def report(name, fit, times, note):
        row = {"method": name, "train": fit.error(train), "test": fit.error(test), "cold": times[0], "warm": times[1]}
        rows.append(row | {"note": note})
        print(
            f"{name:16}  {row['train']:7.3f} %  {row['test']:7.3f} %  {times[0]:7.2f} s  {times[1]:7.3f} s  {note}",
            flush=True,
        )

    print(f"{len(train)} training and {len(test)} test samples, {model.nv} joints")
    print(f"{'method':16}  {'train':>9}  {'test':>9}  {'cold':>9}  {'warm':>9}")
    fit, times = timed(lambda: identify.least_squares(model, train))
    report("least squares", fit, times, f"{fit.rank} combinations, condition {fit.condition:.1f}, unconstrained")
    fit, times = timed(lambda: identify.fit_torques(model, train))
    note = f"feasible; {name_of(fit.result)}, {len(fit.history) - 1} steps, loss {fit.history[-1]:.2f}"
    report("fit_torques", fit, times, note)
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
