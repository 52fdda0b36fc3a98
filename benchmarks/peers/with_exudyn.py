"""Steps of a mechanism by Exudyn, in a process of its own: reads a mechanism as JSON, prints seconds and positions as JSON.

Bodies are rigid bodies in redundant coordinates; joints and loops are constraints with Lagrange multipliers, and the implicit
trapezoidal rule of index 2 makes the steps, with sparse factors. It needs exudyn and NumPy alone.
"""

import json
import sys
import time

import numpy as np


def build(exu, mechanism: dict):
    """A system with the bodies at their start, and their numbers."""
    container = exu.SystemContainer()
    system = container.AddSystem()
    ground, bodies = system.CreateGround(), []
    for body in mechanism["bodies"]:
        # Moments about axes in the plane have no effect, and those of thin bars are zero, which Exudyn cannot factor.
        tensor = np.array(body["inertia"]) + body["mass"] * np.diag([1.0, 1.0, 0.0])
        inertia = exu.utilities.RigidBodyInertia(body["mass"], tensor, inertiaTensorAtCOM=True)
        inertia = inertia.Translated(body["com"])
        bodies.append(
            system.CreateRigidBody(
                inertia=inertia,
                referencePosition=body["position"],
                referenceRotationMatrix=np.array(body["rotation"]),
                initialVelocity=body["velocity"],
                initialAngularVelocity=body["omega"],
                gravity=mechanism["gravity"],
            )
        )
    for joint in mechanism["joints"]:
        ends = [bodies[joint["body"]], ground if joint["parent"] < 0 else bodies[joint["parent"]]]
        system.CreateGenericJoint(
            itemNumbers=ends,
            position=joint["position"],
            rotationMatrixAxes=np.array(joint["rotation"]),
            constrainedAxes=joint["axes"],
            useGlobalFrame=True,
            show=False,
        )
    system.Assemble()
    return system, bodies


def main() -> None:
    """Run as often as asked, and print the best time and where the bodies end."""
    import exudyn as exu  # pyright: ignore[reportMissingImports]
    import exudyn.utilities  # pyright: ignore[reportMissingImports]

    mechanism = json.load(sys.stdin)
    best, positions = float("inf"), []
    for _ in range(mechanism["rounds"]):
        system, bodies = build(exu, mechanism)
        settings = exu.SimulationSettings()
        settings.timeIntegration.numberOfSteps = mechanism["steps"]
        settings.timeIntegration.endTime = mechanism["time"]
        settings.timeIntegration.verboseMode = 0
        settings.solutionSettings.writeSolutionToFile = False
        settings.solution.file.write = False
        settings.linearSolver.solverType = exu.LinearSolverType.EigenSparse
        began = time.perf_counter()
        system.SolveDynamic(settings, solverType=exu.DynamicSolverType.TrapezoidalIndex2)
        best = min(best, time.perf_counter() - began)
        variable = exu.OutputVariableType.Position
        positions = [list(map(float, system.GetObjectOutputBody(x, variable, [0, 0, 0]))) for x in bodies]
    print(json.dumps({"seconds": best, "positions": positions}))


if __name__ == "__main__":
    main()
