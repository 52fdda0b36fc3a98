"""Any numbers of any system or scene, fitted by torque error or by trajectory error."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxdyn.identify.chosen import Chosen, choose
from jaxdyn.identify.gauss_newton import Unknowns, gauss_newton, linear, standard_deviation
from jaxdyn.identify.logs import Log, check_log
from jaxdyn.identify.minimise import METHODS, minimise
from jaxdyn.identify.replay import (
    HOLDS,
    INITIAL,
    Segments,
    check_replay,
    motion_errors,
    motion_scale,
    moving_scale,
    replayed,
    simulate_segment,
    simulation_options,
)
from jaxdyn.identify.result import ParameterFit, needed_torque
from jaxdyn.model.arguments import state_dtype
from jaxdyn.systems.scene import Scene

ERRORS = ("trajectory", "torque")
_GAUSS_NEWTON = "gauss-newton"


class _Samples(eqx.Module):
    """Motions and their torques; under `jax.vmap` one of them."""

    t: Float[Array, "*n"]
    q: Float[Array, "*n nq"]
    v: Float[Array, "*n nv"]
    a: Float[Array, "*n nv"]
    tau: Float[Array, "*n nv"]


class _Problem(eqx.Module):
    chosen: Chosen
    pieces: Segments | _Samples
    scale: Array
    hold: str = eqx.field(static=True)
    options: Any


def fit_parameters(
    system: Any,
    log: Log,
    *,
    positive: Any = None,
    free: Any = None,
    error: str = "trajectory",
    horizon: int | None = None,
    initial: str = "measured",
    hold: str = "linear",
    substeps: int | None = None,
    method: Any = "gauss-newton",
    steps: int = 200,
    learning_rate: float = 0.1,
    tolerance: float = 1e-9,
    callback: Callable[[int, float, Any], None] | None = None,
    **simulation,
) -> ParameterFit:
    """Numbers of a Lagrangian, a metric, an immersion, a force, ..., by the error of torques or of simulated motion.

    Minimises mean(((tau_model - tau) / tau_rms)^2), with tau_model = M a + h less the scene's forces, or
    mean(((q_sim - q) / q_rms)^2 + ((v_sim - v) / v_rms)^2) of segments of the log that are simulated with the measured
    torques, as in `fit_trajectory`; means over all samples and coordinates, rms over the log. There is no prior: what the
    log does not determine stays about where it was, and its deviation is infinite.

    **Arguments:**

    - `system`: any system (a `LagrangianSystem`, an immersed one, ...) or a `Scene`, whose forces count; where the fit
      starts.
    - `log` with q, v, tau, and a for error="torque".
    - `positive`, `free`: what is fitted, as functions that pick leaves, or whole parts, of `system`:
      `lambda system: [system.parameters["mass"], system.parameters["length"]]`. Positive numbers stay so at every
      iterate; free ones may have any sign. All else stays as given.
    - `error`: "trajectory" needs no accelerations; "torque" no simulation, and is faster and less precise where
      accelerations are noisy.
    - `horizon`, `initial`, `hold`, `substeps`, `simulation`: of the simulation, as in `fit_trajectory`. A system's time is
      the log's.
    - `method`: "gauss-newton" for up to some tens of numbers: damped Gauss-Newton steps with Jacobians by forward mode,
      until the next one promises to lower the loss by less than `tolerance` of it. For more, those of a network say, "lbfgs",
      "adam" or an optax.GradientTransformation, by reverse mode. `learning_rate`: of adam, a share of each number (of one
      where it starts at zero); `tolerance` of "lbfgs" as in `fit_trajectory`.
      `steps`: the most steps. `callback(step, loss, system)` is called before every step with the system at that point.

    **Returns:** `ParameterFit`. Its `result` is "not_finite" when a simulation failed; the system is then the best before.

    **Raises:** ValueError when log and system do not fit together, for what `positive` and `free` pick that is no
    floating-point leaf, is picked twice, holds inertias of a `Model`, or is not positive at the start, and for arguments
    out of range.

    Source: output error and equation error methods, Ljung (1999), section 7; Bock (1983), multiple shooting; Marquardt (1963),
    damping.

    ```python
    fit = jd.identify.fit_parameters(pendulum, log, positive=lambda system: system.parameters["length"])
    ```
    """
    inner = system.system if isinstance(system, Scene) else system
    if error not in ERRORS:
        raise ValueError(f"error is {error!r}; take one of {ERRORS}")
    check_replay(initial, hold)
    methods = (_GAUSS_NEWTON, *METHODS)
    if isinstance(method, str) and method not in methods:
        raise ValueError(f"method is {method!r}; take one of {methods} or an optax.GradientTransformation")
    check_log(log, inner, needs=("v",) if error == "trajectory" else ("v", "a"))
    chosen, names = choose(system, positive, free, state_dtype(inner))
    if error == "trajectory":
        problem = _trajectory_problem(system, chosen, log, horizon, hold, simulation_options(substeps, simulation))
    else:
        simulated = {"horizon": horizon, "substeps": substeps, **simulation}
        simulated |= {"initial": None if initial == INITIAL[0] else initial, "hold": None if hold == HOLDS[0] else hold}
        given = [name for name, value in simulated.items() if value is not None]
        if given:
            raise ValueError(f"{', '.join(given)} with error='torque', which simulates nothing; leave it out")
        problem = _torque_problem(system, chosen, log)
    y0 = jnp.zeros_like(chosen.origin)
    start = jnp.zeros((len(problem.pieces.q), 2, inner.nv), y0.dtype) if initial == "free" else None
    unknowns = Unknowns(y0, start)
    z0, unflatten = ravel_pytree(unknowns)

    def report(step, value, estimate):
        if callback is not None:
            callback(step, value, chosen.system(estimate.y))

    deviation = None
    if isinstance(method, str) and method == _GAUSS_NEWTON:
        linearise = lambda point: linear(*_slopes(problem, point))  # noqa: E731
        best, end, history, result = gauss_newton(
            linearise, unknowns, steps=steps, tolerance=tolerance, callback=report
        )
        deviation = standard_deviation(end) * np.abs(np.asarray(chosen.slopes(best.y), np.float64))
    else:
        z, history, result = minimise(
            _loss,
            z0,
            (problem, unknowns),
            method=method,
            steps=steps,
            learning_rate=learning_rate,
            tolerance=tolerance,
            # No curvature is known: everything may move as far as it ever may, by about one unit.
            scaling=lambda z: 1e6 * jnp.eye(z.size, dtype=z.dtype),
            callback=lambda step, value, z: report(step, value, unflatten(z)),
        )
        best = unflatten(z)
    return ParameterFit(
        system=chosen.system(best.y),
        nominal=system,
        names=names,
        values=np.asarray(chosen.values(best.y), np.float64),
        nominal_values=np.asarray(chosen.origin, np.float64),
        deviation=deviation,
        history=history,
        result=result,
        method=f"{error} fit by {method if isinstance(method, str) else type(method).__name__}",
    )


def _trajectory_problem(system, chosen: Chosen, log: Log, horizon, hold: str, options: dict) -> _Problem:
    scene, data = replayed(system, log, horizon)
    return _Problem(chosen, data, motion_scale(scene.system, data), hold, options)


def _torque_problem(system, chosen: Chosen, log: Log) -> _Problem:
    if isinstance(system, Scene) and system.constraints:
        raise ValueError(
            f"the scene has {len(system.constraints)} constraints, whose forces the torques do not tell; take "
            "error='trajectory'"
        )
    dtype = chosen.origin.dtype
    samples = _Samples(*(jnp.asarray(np.asarray(x), dtype) for x in (log.t, log.q, log.v, log.a, log.tau)))
    scale = moving_scale(jnp.sqrt(jnp.mean(samples.tau**2, axis=0)))
    return _Problem(chosen, samples, scale, HOLDS[0], {})


def _residual(problem: _Problem, y, start, piece) -> Float[Array, " n"]:
    """Errors of one piece, in shares of the whole: the loss is the sum of all their squares."""
    scene, scale = problem.chosen.scene(y), problem.scale
    if isinstance(piece, _Samples):
        tau = needed_torque(scene, piece.q, piece.v, piece.a, piece.t)
        errors = (tau - piece.tau) / scale
    else:
        change = None if start is None else start * scale
        motion = simulate_segment(scene, piece, change, problem.hold, problem.options)
        errors = jnp.concatenate(motion_errors(scene.system, piece, *motion, scale))
    return errors.reshape(-1) / problem.pieces.tau.size**0.5


def _loss(z, args):
    problem, unknowns = args
    _, unflatten = ravel_pytree(unknowns)
    estimate = unflatten(z)
    errors = jax.vmap(lambda start, piece: _residual(problem, estimate.y, start, piece))(estimate.start, problem.pieces)
    return jnp.sum(errors * errors)


@eqx.filter_jit
def _slopes(problem: _Problem, unknowns: Unknowns):
    """Errors (pieces, n), and their Jacobians by y (pieces, n, p) and by each piece's own start (pieces, n, 2 nv)."""
    if isinstance(problem.pieces, Segments):
        problem = dataclasses.replace(problem, options=problem.options | {"adjoint": "forward"})

    def one(start, piece):
        def twice(y, start):
            errors = _residual(problem, y, start, piece)
            return errors, errors

        return jax.jacfwd(twice, 0 if start is None else (0, 1), has_aux=True)(unknowns.y, start)

    slopes, errors = jax.vmap(one)(unknowns.start, problem.pieces)
    if unknowns.start is None:
        return errors, slopes, None
    return errors, slopes[0], slopes[1].reshape(*errors.shape, -1)
