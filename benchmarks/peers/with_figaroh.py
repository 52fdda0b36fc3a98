"""Fits of a robot by figaroh in an environment of its own, without jaxdyn: `python with_figaroh.py FOLDER`.

The folder holds `arm.urdf` and `logs.npz` with q, v, a, tau of the samples to fit ("train_*") and to predict ("test_*").
Printed is JSON: for each of four fits the predicted torques of the test, the processor time and the verdict of figaroh. Terms
are those of jaxdyn's plain fit: viscous and Coulomb friction (sign v), rotor inertia and offset.
"""

import contextlib
import json
import sys
import time
from pathlib import Path

import numpy as np
from figaroh.identification.base_identification import BaseIdentification
from figaroh.tools.regressor import build_regressor_basic
from figaroh.tools.robot import Robot

TERMS = {"has_friction": True, "has_actuator_inertia": True, "has_joint_offset": True}


class Arm(BaseIdentification):
    """All joints of an arm, by samples that are already filtered."""

    def load_param(self, config_file, setting_type="identification"):
        """Options of the fit; `config_file` is a dictionary of further ones."""
        names = list(self.model.names[1:])
        self.identif_config = {"act_idxv": list(range(self.model.nv)), "active_joints": names, **TERMS, **config_file}
        self.identif_config |= {key: [0.0] * self.model.nv for key in ("fv", "fs", "Ia", "off")}

    def load_trajectory_data(self, data_source=None):
        """Unused: samples are given."""
        return None

    def process_data(self, truncate=None):
        """Take the samples of the log."""
        self.processed_data = self.samples
        self.num_samples = len(self.samples["positions"])


def fit(robot: Robot, logs, options: dict, wls: bool) -> dict:
    """One fit with its prediction of the test."""
    arm = Arm(robot, options)
    names = ("positions", "velocities", "accelerations", "torques")
    arm.samples = {name: logs[f"train_{key}"] for name, key in zip(names, ("q", "v", "a", "tau"), strict=True)}
    start = time.process_time()
    with contextlib.redirect_stdout(sys.stderr):
        arm.initialize()
        arm.solve(decimate=False, plotting=False, wls=wls)
    seconds = time.process_time() - start
    W = build_regressor_basic(robot, logs["test_q"], logs["test_v"], logs["test_a"], arm.identif_config)
    verdict = "least squares"
    if arm.selected is not None:
        verdict = f"{arm.selected.status}: {arm.selected.reason}"
        torques = None if arm.selected.values is None else arm.selected.predict(W)
    else:
        reduced = np.delete(W, arm._idx_eliminated, axis=1)
        torques = reduced[:, list(arm._base_indices)] @ arm.phi_base
    torques = None if torques is None else torques.reshape(robot.model.nv, -1).T.tolist()
    return {"seconds": seconds, "verdict": verdict, "torques": torques, "base": len(arm.phi_base)}


def main() -> None:
    """Fit the logs of a folder in three ways."""
    folder = Path(sys.argv[1])
    robot, logs = Robot(str(folder / "arm.urdf"), str(folder)), dict(np.load(folder / "logs.npz"))
    physical = {"select_stage": "physical_fit"}
    print(
        json.dumps(
            {
                "least squares": fit(robot, logs, {}, wls=False),
                "weighted least squares": fit(robot, logs, {}, wls=True),
                "physical_fit": fit(robot, logs, physical, wls=False),
                "physical_fit, weighted": fit(robot, logs, physical, wls=True),
            }
        )
    )


if __name__ == "__main__":
    main()
