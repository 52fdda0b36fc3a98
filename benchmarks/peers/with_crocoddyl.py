"""Optimal control of an arm by Crocoddyl, in a Python that has it: a line of JSON on the problem, then one for each request.

A request is a number of iterations, or "end"; the answer has seconds of the solution, iterations and the cost.
"""

import json
import sys
import time

import crocoddyl
import numpy as np
import pinocchio


def build(given):
    """The shooting problem: semi-implicit Euler steps, quadratic costs of torque, speed and the angles at the end."""
    model = pinocchio.buildModelFromUrdf(given["urdf"])
    state = crocoddyl.StateMultibody(model)
    actuation = crocoddyl.ActuationModelFull(state)
    x0 = np.concatenate([given["q0"], np.zeros(model.nv)])

    def action(terms, dt):
        costs = crocoddyl.CostModelSum(state, model.nv)
        for name, (residual, weights, weight) in terms.items():
            activation = crocoddyl.ActivationModelWeightedQuad(np.asarray(weights))
            costs.addCost(name, crocoddyl.CostModelResidual(state, activation, residual), weight)
        free = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
        return crocoddyl.IntegratedActionModelEuler(free, dt)

    rest = crocoddyl.ResidualModelState(state, np.zeros(state.nx), model.nv)
    speeds = np.concatenate([np.zeros(model.nv), np.ones(model.nv)])
    torque = crocoddyl.ResidualModelControl(state, np.asarray(given["hold"]))
    place = crocoddyl.ResidualModelState(state, np.concatenate([given["goal"], np.zeros(model.nv)]), model.nv)
    angles = np.concatenate([np.ones(model.nv), np.zeros(model.nv)])
    w = given["weights"]
    running = {"u": (torque, np.ones(model.nv), w["torque"]), "v": (rest, speeds, w["speed"])}
    end = {"place": (place, angles, w["place"]), "v": (rest, speeds, w["last_speed"])}
    count = given["steps"]
    problem = crocoddyl.ShootingProblem(x0, [action(running, given["dt"])] * count, action(end, 0.0))
    # Crocoddyl 3.2.1 from PyPI, built against another Pinocchio than 4.1, computes wrong accelerations with that or crashes.
    first = problem.runningDatas[0]
    problem.runningModels[0].calc(first, x0, np.asarray(given["hold"]))
    wanted = pinocchio.aba(model, model.createData(), x0[: model.nq], x0[model.nq :], np.asarray(given["hold"]))
    if not np.abs(first.differential.xout - wanted).max() < 1e-9:
        raise SystemExit(
            "Crocoddyl was built against another Pinocchio: its accelerations are wrong; install both from one source"
        )
    return problem, [np.asarray(given["hold"])] * count


def main() -> None:
    """Answer requests."""
    problem, us = build(json.loads(sys.stdin.readline()))
    for line in sys.stdin:
        if line.strip() == "end":
            return
        solver = crocoddyl.SolverFDDP(problem)
        solver.th_stop = 1e-30
        xs = problem.rollout(us)
        begin = time.perf_counter()
        solver.solve(xs, us, int(line), True)
        seconds = time.perf_counter() - begin
        print(json.dumps({"seconds": seconds, "iterations": solver.iter, "cost": solver.cost}), flush=True)


if __name__ == "__main__":
    main()
