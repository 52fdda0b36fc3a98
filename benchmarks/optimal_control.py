"""Optimal control of an arm's reach: `jd.control.ilqr` against Crocoddyl, where it is installed.

python -m benchmarks.optimal_control [--crocoddyl PYTHON] [--rounds 20]

The same problem for both, to rounding: a Panda from rest, 100 semi-implicit Euler steps of 10 ms, quadratic costs of torques
about those that hold the start, of speeds, and of the angles at the end, from that torque as the guess. Each solves it
with as many iterations as it needs to come within 1e-6 of the best cost; one after the other, the median counts.
"""

import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks.first_calls import PANDA, robot
from benchmarks.inverse_kinematics import HERE, bare_urdf
from benchmarks.timing import machine, write

STEPS, DT, CLOSE = 100, 0.01, 1e-6
WEIGHTS = {"torque": 1e-3, "speed": 1e-1, "place": 1e3, "last_speed": 1.0}
MOST = 60


def problem():
    """The model, its start, the torques that hold it, and the angles to reach."""
    model = robot(PANDA[0], False, PANDA[2])[0]
    q0 = jnp.asarray([0.0, -0.4, 0.0, -1.9, 0.0, 1.6, 0.7])
    goal = q0 + jnp.asarray([0.9, 0.7, -0.5, 0.6, 0.4, -0.8, 0.5])
    return model, q0, jd.gravity_force(model, q0), goal


def solver(model, q0, hold, goal, iterations: int):
    """A compiled function of the goal: cost after each iteration, and the end."""

    def step(x, u):
        q, v = x
        v = v + DT * jd.forward_dynamics(model, q, v, u)
        return jd.integrate(model, q, v, DT), v

    def cost(x, u, k):
        rest = u - hold
        return DT * 0.5 * (WEIGHTS["torque"] * rest @ rest + WEIGHTS["speed"] * x[1] @ x[1])

    def solve(goal):
        def final(x):
            miss = x[0] - goal
            return 0.5 * (WEIGHTS["place"] * miss @ miss + WEIGHTS["last_speed"] * x[1] @ x[1])

        us = jnp.broadcast_to(hold, (STEPS, model.nv))
        return jd.control.ilqr(step, cost, final, (q0, jnp.zeros(model.nv)), us, iterations=iterations, tol=1e-15)

    return solve


class Crocoddyl:
    """A process that solves on request."""

    def __init__(self, python: str, given: dict):
        command = [python, str(HERE / "peers" / "with_crocoddyl.py")]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._send(json.dumps(given))

    def _send(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def solve(self, iterations: int) -> dict:
        """Seconds, iterations and cost."""
        self._send(str(iterations))
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("Crocoddyl's process ended; its message is above")
        return json.loads(line)

    def end(self) -> None:
        """End the process."""
        self._send("end")
        self.process.wait()


def _needed(costs, best: float) -> int:
    """Iterations until the cost is within CLOSE of the best one."""
    return 1 + int(np.argmax(np.asarray(costs) <= best * (1 + CLOSE)))


def main(argv=None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--crocoddyl", metavar="PYTHON")
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    model, q0, hold, goal = problem()
    # Costs are those before each iteration; the last one is the end's.
    whole = jax.jit(solver(model, q0, hold, goal, MOST))(goal)
    costs = [*np.asarray(whole.costs)[: int(whole.iterations)], float(whole.cost)]
    peer, theirs = None, []
    if options.crocoddyl:
        with tempfile.TemporaryDirectory() as folder:
            given = {"urdf": str(bare_urdf(PANDA[0], PANDA[2], Path(folder))), "steps": STEPS, "dt": DT}
            given |= {"weights": WEIGHTS} | {
                k: np.asarray(x).tolist() for k, x in (("q0", q0), ("hold", hold), ("goal", goal))
            }
            peer = Crocoddyl(options.crocoddyl, given)
            theirs = [peer.solve(n)["cost"] for n in range(1, MOST)]
    best = min([*costs, *theirs])
    count = _needed(costs, best)
    run = jax.jit(solver(model, q0, hold, goal, count))
    begin = time.perf_counter()
    jax.block_until_ready(run(goal))
    first = time.perf_counter() - begin
    batch = jax.jit(jax.vmap(solver(model, q0, hold, goal, count)))
    goals = goal[None] + 0.02 * jnp.asarray(np.random.default_rng(0).normal(size=(64, model.nv)))
    jax.block_until_ready(batch(goals))
    times: dict[str, list[float]] = {"jaxdyn": [], "jaxdyn, 64 at once, each": [], "crocoddyl": []}
    needed = _needed(theirs, best) if theirs else 0
    for _ in range(options.rounds):
        for name, function, given in (("jaxdyn", run, goal), ("jaxdyn, 64 at once, each", batch, goals)):
            begin = time.perf_counter()
            jax.block_until_ready(function(given))
            times[name].append((time.perf_counter() - begin) / (64 if function is batch else 1))
        if peer is not None:
            times["crocoddyl"].append(peer.solve(needed)["seconds"])
    if peer is not None:
        peer.end()
    report = {
        "machine": machine(),
        "first call": first,
        "cost": {"jaxdyn": min(costs), "crocoddyl": min(theirs, default=None)},
    }
    report |= {"iterations": {"jaxdyn": count, "crocoddyl": needed}}
    report |= {"milliseconds": {name: float(np.median(x)) * 1e3 for name, x in times.items() if x}}
    print(json.dumps(report, indent=1, default=str))
    print(write("optimal_control", report))


if __name__ == "__main__":
    main()
