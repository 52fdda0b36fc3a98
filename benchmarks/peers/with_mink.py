"""Inverse kinematics by mink, as a program of its own Python: reads targets from a JSON file, prints what it reached."""

import json
import sys
import time

import mink
import mujoco
import numpy as np


def main() -> None:
    """Solve all targets of the file."""
    with open(sys.argv[1]) as file:
        given = json.load(file)
    model = mujoco.MjModel.from_xml_path(given["urdf"])
    places = [model.jnt_qposadr[model.joint(name).id] for name in given["joints"]]
    tasks = [
        mink.FrameTask(frame, "body", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-6)
        for frame in given["frames"]
    ]
    limits = [mink.ConfigurationLimit(model)]
    configuration = mink.Configuration(model)
    reached, times = 0, []
    for poses, start in zip(given["poses"], given["starts"], strict=True):
        q = np.zeros(model.nq)
        q[places] = start
        begin = time.perf_counter()
        configuration.update(q)
        for task, pose in zip(tasks, poses, strict=True):
            task.set_target(mink.SE3.from_matrix(np.asarray(pose)))
        for _ in range(200):
            errors = np.concatenate([task.compute_error(configuration) for task in tasks])
            if np.abs(errors).max() < given["atol"]:
                reached += 1
                break
            velocity = mink.solve_ik(configuration, tasks, 1.0, "daqp", damping=1e-12, limits=limits)
            configuration.integrate_inplace(velocity, 1.0)
        times.append(time.perf_counter() - begin)
    count = len(times)
    print(
        json.dumps(
            {
                "reached": reached / count,
                "milliseconds alone": 1e3 * float(np.median(times)),
                "mean ms": 1e3 * float(np.mean(times)),
            }
        )
    )


if __name__ == "__main__":
    main()
