"""Recorded robots identified by jaxdyn and by others: the error on held-out samples, as a Markdown table.

    python -m benchmarks.identify_rivals [--figaroh VENV/bin/python] [--limit 300] [--data ../shared/data]

Cases are those of `benchmarks.identify_robots`: the last 30 % of a Franka's log from the first 70 %, and the KUKA's log C from
A and B. All programs get the same filtered samples and the same bodies to start from, and fit bodies, viscous and Coulomb
friction, rotor inertia and offset; `fit_robot` chooses further terms. `least_squares` smooths Coulomb friction over 0.01 rad/s,
and once more over the v_s that `fit_robot` chose. The error is 100 |tau_fit - tau| / |tau|; the time is that of the processor
in one fit.

figaroh needs an environment of its own (`pip install figaroh`), mujoco.sysid `pip install "mujoco[sysid]"`.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from benchmarks.identify_franka import panda, recorded  # noqa: E402
from benchmarks.identify_robots import ROOT, kuka, kuka_log  # noqa: E402
from jaxdyn import identify  # noqa: E402
from jaxdyn.io import save_urdf  # noqa: E402

KEYS = ("q", "v", "a", "tau")


def cases(data: Path):
    """Names, models, samples to fit and to predict."""
    train, test = identify.split(recorded(data), 0.7)
    yield "Franka", panda(), [train], test
    a, b, c = (kuka_log(data, name) for name in "ABC")
    yield "KUKA", kuka(), [a, b], c


def ours(model, train, test) -> list[list[str]]:
    """Rows of jaxdyn."""

    def run(name: str, function: Callable, bodies: str, intervals: str) -> list[str]:
        start = time.process_time()
        fit = function()
        seconds = time.process_time() - start
        return [
            name,
            f"{identify.torque_error(fit.torques(test), test.tau):.2f} %",
            f"{seconds:.1f} s",
            bodies,
            intervals,
        ]

    chosen = identify.fit_robot(model, train)
    v_s = chosen.choice.setting.v_s
    return [
        run("jaxdyn `least_squares`", lambda: identify.least_squares(model, train), "not ensured", "jackknife"),
        run(
            f"the same, v_s {v_s:.1g}",
            lambda: identify.least_squares(model, train, v_s=v_s),
            "not ensured",
            "jackknife",
        ),
        run("jaxdyn `fit_torques`", lambda: identify.fit_torques(model, train), "physical", "none"),
        run("jaxdyn `fit_robot`", lambda: identify.fit_robot(model, train).fit, "physical", "jackknife, other terms"),
    ]


def figaroh(python: Path, model, train, test) -> list[list[str]]:
    """Rows of figaroh, from a process of another environment."""
    with tempfile.TemporaryDirectory() as folder:
        save_urdf(model, Path(folder) / "arm.urdf")
        joined = {key: np.concatenate([np.asarray(getattr(log, key)) for log in train]) for key in KEYS}
        samples = {f"train_{key}": joined[key] for key in KEYS}
        np.savez(
            Path(folder) / "logs.npz", **samples, **{f"test_{key}": np.asarray(getattr(test, key)) for key in KEYS}
        )
        script = Path(__file__).parent / "peers/with_figaroh.py"
        single = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | single
        command = [str(python), str(script), folder]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        return [[f"figaroh failed: {done.stderr.strip().splitlines()[-1]}", "", "", "", ""]]
    rows = []
    for name, row in json.loads(done.stdout).items():
        error = (
            "none" if row["torques"] is None else f"{identify.torque_error(np.array(row['torques']), test.tau):.2f} %"
        )
        verdict, is_physical = row["verdict"], name.startswith("physical")
        bodies = ("physical" if verdict.startswith("accepted") else verdict) if is_physical else "not ensured"
        rows.append(
            [
                f"figaroh {name}",
                error,
                f"{row['seconds']:.1f} s",
                bodies,
                "none" if is_physical else "independent errors",
            ]
        )
    return rows


def sysid(limit: float, model, train, test) -> list[list[str]]:
    """Row of mujoco.sysid."""
    from benchmarks.peers import with_sysid

    tau, v = (np.concatenate([np.asarray(getattr(log, key)) for log in train]) for key in ("tau", "v"))
    sizes = np.sqrt(np.mean(tau**2, axis=0))
    # One log after the other: torques by inverse dynamics have no memory, but times must increase evenly.
    step = float(np.median(np.diff(train[0].t)))
    parts = [np.concatenate([np.asarray(getattr(log, key)) for log in train]) for key in KEYS]
    log = identify.Log(step * np.arange(len(tau)), *parts)
    spec = with_sysid.specification(model, step)
    free = with_sysid.parameters(spec, model.body_names)
    for parameter in with_sysid.joint_parameters(
        spec, model.joint_names, np.stack([np.sqrt(np.mean(v**2, axis=0)), sizes])
    ):
        free.add(parameter)
    residual = with_sysid.torque_residual(spec, log, sizes)
    _, ended = with_sysid.fitted(residual, free, limit, time.process_time)
    torques = with_sysid.predicted(spec, free, test)
    error = f"{identify.torque_error(torques, test.tau):.2f} %"
    return [["mujoco.sysid, joints weighted", error, ended, "physical, bounded", "independent errors"]]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figaroh", type=Path, help="the Python of an environment with figaroh")
    parser.add_argument("--limit", type=float, default=300.0, help="processor time (s) of mujoco.sysid for a fit")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    options = parser.parse_args()
    print("| log | program | error | processor time | bodies | intervals |\n|" + "---|" * 6)
    for name, model, train, test in cases(options.data):
        programs = [ours, lambda *case: sysid(options.limit, *case)]
        programs += [lambda *case: figaroh(options.figaroh, *case)] if options.figaroh else []
        for program in programs:
            try:
                rows = program(model, train, test)
            except ImportError as error:
                print(error, file=sys.stderr)
                continue
            for row in rows:
                print("| " + " | ".join([name, *row]) + " |", flush=True)


if __name__ == "__main__":
    main()
