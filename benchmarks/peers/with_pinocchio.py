"""Pinocchio's accelerations, integrated from Python: by SciPy's compiled DOP853, and by a Runge-Kutta method for a batch.

A tree takes the articulated-body algorithm, in threads for a batch. Loops are three-dimensional point contacts, their dependent
rows left to `constraintDynamics` and its proximal method; it has no batched call, so loops run one trajectory at a time.
Nothing projects the states.
"""

from collections.abc import Callable

import numpy as np
import pinocchio as pin

import jaxdyn as jd
from benchmarks.constraints import to_pinocchio
from benchmarks.peers.steps import CORES, dop853, rk4
from benchmarks.peers.twins import TWINS, Twin
from jaxdyn.reports.run import Contestant

SOURCE = f"Pinocchio {pin.__version__}"


def _quaternion_rate(q, w):
    s, x, y, z = q
    a, b, c = w
    rate = [-x * a - y * b - z * c, s * a + y * c - z * b, s * b + z * a - x * c, s * c + x * b - y * a]
    return 0.5 * np.array(rate)


def slope(twin: Twin) -> Callable:
    """`slope(t, y)` -> dy/dt for one state of the tree."""
    scene = twin.scene
    if scene.system.topology.kinds[0] == "spherical":
        return _ball(scene)
    source, contacts = to_pinocchio(scene)
    data, nq = source.createData(), source.nq
    zero = np.zeros(source.nv)
    if not scene.constraints:
        return lambda t, y: np.concatenate([y[nq:], pin.aba(source, data, y[:nq], y[nq:], zero)])
    held = pin.StdVec_RigidConstraintData()
    held.extend(contact.createData() for contact in contacts)
    pin.initConstraintDynamics(source, data, contacts, held)
    settings = pin.ProximalSettings(1e-12, 1e-10, 20)

    def rates(t, y):
        q, v = y[:nq], y[nq:]
        tau = zero if twin.push is None else twin.push(q)
        return np.concatenate([v, pin.constraintDynamics(source, data, q, v, tau, contacts, held, settings)])

    return rates


def _ball(scene: jd.Scene) -> Callable:
    source = pin.Model()
    joint = source.addJoint(0, pin.JointModelSpherical(), pin.SE3.Identity(), "ball")
    xx, xy, yy, xz, yz, zz = np.asarray(scene.system.inertias[0][4:], float)
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    source.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), about), pin.SE3.Identity())
    source.gravity.linear = np.zeros(3)
    data, zero = source.createData(), np.zeros(3)

    def rates(t, y):
        q, w = y[:4], y[4:]
        unit = np.roll(q / np.sqrt(q @ q), -1)
        return np.concatenate([_quaternion_rate(q, w), pin.aba(source, data, unit, w, zero)])

    return rates


def contestants(prepared, starts) -> list[Contestant]:
    """Rungs of DOP853 and RK4 for one trajectory, of RK4 in threads for a batch of trees without loops."""
    if prepared.case.name not in TWINS:
        return []
    twin = TWINS[prepared.case.name]()
    model, (q, v) = twin.scene.system, twin.there(*starts[:2])
    states = np.concatenate([q, v], 1)

    def back(y):
        return twin.back(y[:, : model.nq], y[:, model.nq :])

    if len(states) == 1:
        rates = slope(twin)
        options = {"rungs": 2, "method": "joint angles"}
        computed = dop853(prepared, SOURCE, rates, states[0], back, "joint angles")
        return computed + rk4(prepared, SOURCE, rates, states[0], starts[2], back, **options)
    # With one degree of freedom the rows of one number are taken for vectors there, and the call fails.
    if twin.scene.constraints or model.nq != model.nv or model.nv == 1:
        return []
    source, _ = to_pinocchio(twin.scene)
    pool, zero = pin.ModelPool(source, CORES), np.zeros((model.nv, len(states)), order="F")

    def together(t, y):
        q, v, a = (np.asfortranarray(x) for x in (y[: model.nq], y[model.nq :], zero))
        a = np.zeros_like(zero)
        pin.abaInParallel(CORES, pool, q, v, zero, a)
        return np.concatenate([v, a])

    return rk4(prepared, f"{SOURCE}, {CORES} threads", together, states.T, starts[2], back, method="joint angles")
