"""Fit of a mechanism with loops by the torques of its motors: the combinations of its parameters that these determine."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxdyn.forces.elements import CoulombFriction, JointDamping
from jaxdyn.identify.devices import on_one_thread
from jaxdyn.identify.linear_fit import Direction, scatter, weakest_directions
from jaxdyn.identify.logs import Log, as_logs, signal_sizes
from jaxdyn.identify.mechanisms import check_motors, motor_regressor
from jaxdyn.identify.options import Objective
from jaxdyn.identify.parameter_tree import Parameters
from jaxdyn.identify.parameters import fit_parameters
from jaxdyn.identify.regression import BaseParameters, group_columns, least_squares_by_svd, parameter_names
from jaxdyn.identify.result import Fit, torques_along
from jaxdyn.identify.torque_terms import TERMS, Friction, Terms, check_terms
from jaxdyn.identify.uncertainty import effective_sample_size
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene

_BLOCKS = 20


class MechanismFit(NamedTuple):
    """Result of `fit_mechanism`.

    - `fit`: the feasible bodies and the motors' friction, `fit.torques(log)` their torques.
    - `base`: combinations of the parameters that the logs determine; `nominal`, `values`, `std` (nbase,): of the scene given,
      fitted, and the jackknife standard deviation; `factor`: a 95 % interval is plus and minus this many, for each by itself.
    - `condition`: of the regressor in these combinations, columns of unit length; `weakest`: the least identifiable directions.
    """

    fit: Fit
    base: BaseParameters
    nominal: np.ndarray
    values: np.ndarray
    std: np.ndarray
    factor: float
    condition: float
    weakest: list[Direction]


@on_one_thread
def fit_mechanism(
    scene: Scene,
    log: Log | Sequence[Log],
    motors: Sequence[str],
    terms: Terms = TERMS,
    *,
    v_s: float = 0.01,
    prior: float = 1.0,
) -> MechanismFit:
    """Fit the bodies of a mechanism with loops, and the friction and rotors of its motors, by the torques of these alone.

    Joints without a motor have no friction but that of the file. The feasible fit is that of `fit_parameters` with the error
    "torque"; the combinations are those of the regressor of the motors' torques along the logs, N^T Y (`motor_basis`).

    **Arguments:** `scene`: the mechanism, with the geometry and the nominal parameters; `log`: one or several, with q, v and a of
    all joints (`complete_log`); `motors`: names of joints, as many as degrees of freedom; `terms`, `v_s`, `prior` as of
    `fit_torques`.

    **Raises:** ValueError for another number of motors, and as `fit_parameters`.

    Source: Khalil & Dombre (2002), chapters 9 and 10, base parameters of closed chains.
    """
    terms = check_terms(terms, v_s)
    logs = as_logs(log, scene.system)
    columns = np.array(check_motors(scene, np.asarray(logs[0].q)[0], motors))
    start = _with_friction(scene, columns, terms, v_s, signal_sizes(logs))
    model: Model = start.system
    every = parameter_names(model, terms)
    names = every[: 10 * model.nb] + tuple(f"{motor}.{term}" for term in terms for motor in motors)
    regressors = [motor_regressor(start, one, motors, terms, v_s) for one in logs]
    W, tau = np.concatenate(regressors), np.concatenate([np.asarray(one.tau)[:, columns] for one in logs])
    weights = 1 / np.sqrt(np.mean(tau**2, axis=0))
    base, _ = group_columns((W * weights[:, None]).reshape(-1, len(names)), names, model.nb, np.dtype(model.home.dtype))
    x0 = _numbers(start, columns, terms)
    # Springs and the friction of passive joints stay those of the file.
    places = tuple(columns.tolist())
    rest = tau - np.concatenate([torques_along(start, one, places)[:, columns] for one in logs])
    rows, errors = (W[:, :, base.independent] * weights[:, None]), rest * weights
    flat = rows.reshape(-1, len(base))
    if len(flat) <= len(base):
        raise ValueError(f"the logs have {len(flat)} torques of motors for {len(base)} combinations; log more")
    linear = least_squares_by_svd(flat, errors.reshape(-1), 1e-9)
    residual = errors - rows @ linear.change
    # Relative to the torque, as `Objective.noise`; noise-free logs stay well posed.
    noise = max(float(np.sqrt(linear.rest / (len(flat) - linear.rank))), 1e-6)
    tree = Parameters(start).inertias(weight=prior)
    for term in terms:
        where = _PLACES[term]
        tree = (tree.free if term == "offset" else tree.positive)(where, rows=columns.tolist())
    fit = fit_parameters(start, logs, tree, Objective("torque", observed=tuple(motors), noise=2**0.5 * noise))
    edges = np.cumsum([len(one) for one in logs])[:-1]
    size = effective_sample_size(np.split(residual, edges))
    half = linear.half
    whitened = [np.einsum("ijp,pk->ijk", part, half) for part in np.array_split(rows, _BLOCKS)]
    scores = [np.einsum("ijk,ij->k", X, e) for X, e in zip(whitened, np.array_split(residual, _BLOCKS), strict=True)]
    std, factor = scatter([np.einsum("ijk,ijl->kl", X, X) for X in whitened], scores, half, size)
    return MechanismFit(
        fit,
        base,
        base.values(x0),
        base.values(_numbers(fit.system, columns, terms)),
        std,
        factor,
        linear.condition,
        weakest_directions(flat, base.names),
    )


_PLACES = {
    "viscous": lambda scene: scene.forces[-1].viscous,
    "coulomb": lambda scene: scene.forces[-1].coulomb,
    "offset": lambda scene: scene.forces[-1].offset,
    "armature": lambda scene: scene.system.armature,
}


def _with_friction(scene: Scene, motors: np.ndarray, terms, v_s: float, sizes) -> Scene:
    """Scene with one force for the friction of all joints, of which that of the motors is positive, as a fit's start must be."""
    model, zero = scene.system, np.zeros(scene.nv)
    torque, velocity, acceleration = sizes
    # A hundredth of the torque where the file has none: a logarithm needs a start above zero.
    unit = 0.01 * torque
    start = {"viscous": model.damping, "coulomb": model.friction, "armature": model.armature}
    per = {"viscous": velocity, "coulomb": np.ones(scene.nv), "armature": acceleration}
    for term, own in start.items():
        own = zero.copy() if own is None else np.array(own, np.float64)
        if term in terms:
            least = unit / np.where(per[term] > 0, per[term], 1.0)
            own[motors] = np.where(own[motors] > 0, own[motors], least[motors])
        start[term] = own
    dtype = model.home.dtype
    viscous, coulomb, armature = (jnp.asarray(start[term], dtype) for term in ("viscous", "coulomb", "armature"))
    friction = Friction(viscous, coulomb, jnp.asarray(zero, dtype), jnp.asarray(v_s, dtype))
    others = [force for force in scene.forces if not isinstance(force, (JointDamping, CoulombFriction))]
    rotors = armature if model.armature is not None or "armature" in terms else None
    return Scene(model.replace(armature=rotors), scene.constraints, [*others, friction])


def _numbers(scene: Scene, motors: np.ndarray, terms) -> np.ndarray:
    """Parameters x (10 nb + terms m,) in the order of the regressor's columns."""
    friction = [np.asarray(_PLACES[term](scene), np.float64)[motors] for term in terms]
    return np.concatenate([np.asarray(scene.system.inertias, np.float64).reshape(-1), *friction])
