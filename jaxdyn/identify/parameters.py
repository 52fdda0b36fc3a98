"""Any numbers of any system or scene, fitted by torque error or by trajectory error.

What is searched are coordinates y (p,), zero at the start: x = x0 exp(y) for numbers that are positive, so that no
iterate has another sign, and x = x0 + unit y for the others.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxdyn.constraints.base import state_dtype
from jaxdyn.identify.logs import Log, check_log
from jaxdyn.identify.minimise import METHODS, minimise
from jaxdyn.identify.regression import truncated
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
from jaxdyn.model import Model
from jaxdyn.scene import Scene

ERRORS = ("trajectory", "torque")
# Directions with less than this share of the largest effect count as not determined by the log.
_RANK_TOLERANCE = 1e-6


class Chosen(eqx.Module):
    """Map from the coordinates y (p,) to a system, or a scene, with the chosen leaves at x(y)."""

    given: Any
    origin: Float[Array, " p"]
    unit: Float[Array, " p"]
    positive: Float[Array, " p"]
    places: tuple[int, ...] = eqx.field(static=True)

    def values(self, y: Float[Array, " p"]) -> Float[Array, " p"]:
        """x (p,): x0 exp(y) where positive, x0 + unit y elsewhere."""
        factor = jnp.exp(jnp.where(self.positive > 0, y, jnp.zeros_like(y)))
        return jnp.where(self.positive > 0, self.origin * factor, self.origin + self.unit * y)

    def system(self, y: Float[Array, " p"]) -> Any:
        """What was given, with the numbers of y."""
        leaves, structure = jax.tree.flatten(self.given)
        x, begin = self.values(y), 0
        for place in self.places:
            leaf = leaves[place]
            leaves[place] = x[begin : begin + leaf.size].reshape(leaf.shape).astype(leaf.dtype)
            begin += leaf.size
        return jax.tree.unflatten(structure, leaves)

    def scene(self, y: Float[Array, " p"]) -> Scene:
        """The scene with the numbers of y."""
        found = self.system(y)
        return found if isinstance(found, Scene) else Scene(found)


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


class _Unknowns(eqx.Module):
    """What is searched: y, and corrections of the initial states in units of the scale, or None."""

    y: Float[Array, " p"]
    start: Float[Array, "segments 2 nv"] | None


def fit_parameters(
    system: Any,
    log: Log,
    *,
    positive: Callable[[Any], Any] | None = None,
    free: Callable[[Any], Any] | None = None,
    error: str = "trajectory",
    horizon: int | None = None,
    initial: str = "measured",
    hold: str = "linear",
    substeps: int | None = None,
    method: Any = "lbfgs",
    steps: int = 200,
    learning_rate: float = 0.1,
    tolerance: float = 1e-9,
    callback: Callable[[int, float, Any], None] | None = None,
    **simulation,
) -> ParameterFit:
    """Numbers of a Lagrangian, a metric, an immersion, a force, ..., by the error of torques or of simulated motion.

    Minimises mean(((tau_model - tau) / tau_rms)^2), with tau_model = M a + h less the scene's forces, or
    mean(((q_sim - q) / q_rms)^2 + ((v_sim - v) / v_rms)^2) of segments of the log that are simulated with the measured
    torques, as in `fit_trajectory`; means over all samples and coordinates, rms over the log. Both descend in the
    Gauss-Newton metric of where each round starts. There is no prior: what the log does not determine stays about where
    it was, and its deviation is infinite.

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
    - `method`, `steps`, `learning_rate`, `tolerance`: as in `fit_trajectory`. `callback(step, loss, system)` is called
      before every step with the system at that point.

    **Returns:** `ParameterFit`. Its `result` is "not_finite" when a simulation failed; the system is then the best before.

    **Raises:** ValueError when log and system do not fit together, for what `positive` and `free` pick that is no
    floating-point leaf, is picked twice, holds inertias of a `Model`, or is not positive at the start, and for arguments
    out of range.

    Source: output error and equation error methods, Ljung (1999), section 7; Bock (1983), multiple shooting.

    ```python
    fit = jd.identify.fit_parameters(pendulum, log, positive=lambda system: system.parameters["length"])
    ```
    """
    inner = system.system if isinstance(system, Scene) else system
    if error not in ERRORS:
        raise ValueError(f"error is {error!r}; take one of {ERRORS}")
    check_replay(initial, hold)
    if isinstance(method, str) and method not in METHODS:
        raise ValueError(f"method is {method!r}; take one of {METHODS} or an optax.GradientTransformation")
    check_log(log, inner, needs=("v",) if error == "trajectory" else ("v", "a"))
    chosen, names = _choose(system, positive, free, state_dtype(inner))
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
    unknowns = _Unknowns(y0, start)
    z0, unflatten = ravel_pytree(unknowns)

    def report(step, value, z):
        if callback is not None:
            callback(step, value, chosen.system(unflatten(z).y))

    z, history, result = minimise(
        _loss,
        z0,
        (problem, unknowns),
        method=method,
        steps=steps,
        learning_rate=learning_rate,
        tolerance=tolerance,
        scaling=lambda z: _scaling(problem, unflatten(z)),
        callback=report,
    )
    found = unflatten(z)
    return ParameterFit(
        system=chosen.system(found.y),
        nominal=system,
        names=names,
        values=np.asarray(chosen.values(found.y), np.float64),
        nominal_values=np.asarray(chosen.origin, np.float64),
        deviation=_deviation(problem, found),
        history=history,
        result=result,
        method=f"{error} fit by {method if isinstance(method, str) else type(method).__name__}",
    )


class _Leaf:
    """Stands for a leaf while a user's function picks it."""

    def __init__(self, place: int, name: str):
        self.place, self.name = place, name


def _choose(system, positive, free, dtype) -> tuple[Chosen, tuple[str, ...]]:
    """The chosen leaves, and the name of every number in them."""
    paths, structure = jax.tree_util.tree_flatten_with_path(system)
    leaves = [leaf for _, leaf in paths]
    names = [jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths]
    marked = jax.tree.unflatten(structure, [_Leaf(i, name) for i, name in enumerate(names)])
    bodies = [x for x in jax.tree.leaves(system, is_leaf=lambda x: isinstance(x, Model)) if isinstance(x, Model)]
    picked: list[tuple[int, bool]] = []
    for argument, where in (("positive", positive), ("free", free)):
        for leaf in [] if where is None else _picked(where, marked, argument, type(system).__name__):
            value = leaves[leaf.place]
            if not eqx.is_inexact_array_like(value):
                raise ValueError(f"{argument} picks {leaf.name}, which is {value!r} and no floating-point number")
            if any(value is model.inertias for model in bodies):
                raise ValueError(
                    f"{argument} picks {leaf.name}, the inertias of bodies, of which few choices are physical; fit them "
                    "with jd.identify.fit_torques or fit_trajectory"
                )
            if any(leaf.place == other for other, _ in picked):
                raise ValueError(f"{argument} picks {leaf.name} a second time; pick every leaf once")
            if argument == "positive" and not (np.asarray(value) > 0).all():
                raise ValueError(
                    f"positive picks {leaf.name}, which is {np.asarray(value).tolist()}; start above zero, or pick it in free"
                )
            picked.append((leaf.place, argument == "positive"))
    if not picked:
        raise ValueError("nothing to fit; pick leaves, e.g. positive=lambda system: system.parameters['mass']")
    values = [np.asarray(leaves[place], np.float64) for place, _ in picked]
    origin = np.concatenate([value.reshape(-1) for value in values])
    signs = np.concatenate([np.full(value.size, float(sign)) for value, (_, sign) in zip(values, picked, strict=True)])
    numbered = [
        names[place] + "".join(f"[{i}]" for i in index)
        for value, (place, _) in zip(values, picked, strict=True)
        for index in np.ndindex(value.shape)
    ]
    unit = np.where(origin == 0, 1, np.abs(origin))
    places = tuple(place for place, _ in picked)
    held = [jnp.asarray(leaf) if place in places else leaf for place, leaf in enumerate(leaves)]
    chosen = Chosen(
        given=jax.tree.unflatten(structure, held),
        origin=jnp.asarray(origin, dtype),
        unit=jnp.asarray(unit, dtype),
        positive=jnp.asarray(signs, dtype),
        places=places,
    )
    return chosen, tuple(numbered)


def _picked(where, marked, argument: str, kind: str) -> list[_Leaf]:
    """The leaves that a user's function picks.

    **Raises:** ValueError for a function that fails, or gives anything else.
    """
    example = f"write e.g. {argument}=lambda system: system.parameters['mass']"
    if not callable(where):
        raise ValueError(f"{argument} is {where!r}; pass a function that picks leaves, {example}")
    try:
        found = jax.tree.leaves(where(marked))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(
            f"{argument} picks nothing of this {kind} ({type(error).__name__}: {error}); {example}, of whole leaves"
        ) from error
    strange = [leaf for leaf in found if not isinstance(leaf, _Leaf)]
    if strange or not found:
        raise ValueError(
            f"{argument} picks {strange[0] if strange else 'nothing'!r}, which is no leaf of this {kind}; {example}"
        )
    return found


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
    return errors.reshape(-1) / np.sqrt(problem.pieces.tau.size)


def _loss(z, args):
    problem, unknowns = args
    _, unflatten = ravel_pytree(unknowns)
    found = unflatten(z)
    errors = jax.vmap(lambda start, piece: _residual(problem, found.y, start, piece))(found.start, problem.pieces)
    return jnp.sum(errors * errors)


@eqx.filter_jit
def _slopes(problem: _Problem, found: _Unknowns):
    """Errors (pieces, n) and their Jacobians by y, (pieces, n, p), and by each piece's own start, (pieces, n, 2 nv)."""

    def one(start, piece):
        function = lambda y, start: _residual(problem, y, start, piece)  # noqa: E731
        by_y = jax.jacfwd(function)(found.y, start)
        return function(found.y, start), by_y, None if start is None else jax.jacfwd(function, 1)(found.y, start)

    errors, by_y, by_start = jax.vmap(one)(found.start, problem.pieces)
    return errors, by_y, None if by_start is None else by_start.reshape(*errors.shape, -1)


def _linearised(problem: _Problem, found: _Unknowns) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, Any]:
    """`_slopes` in numpy, with each piece's start where it fits best, dstart = -gain dy.

    **Returns:** errors (pieces, n); their slopes by y (pieces, n, p); gain (pieces, 2 nv, p) and the inverse root (pieces,
    2 nv, 2 nv) of the starts' own Gauss-Newton Hessians, or None.
    """
    if isinstance(problem.pieces, Segments):
        problem = dataclasses.replace(problem, options=problem.options | {"adjoint": "forward"})
    errors, by_y, by_start = _slopes(problem, found)
    errors, by_y = np.asarray(errors, np.float64), np.asarray(by_y, np.float64)
    if by_start is None:
        return errors, by_y, None, None
    basis, triangular = np.linalg.qr(np.asarray(by_start, np.float64))
    shares = np.swapaxes(basis, 1, 2) @ by_y
    return errors, by_y - basis @ shares, np.linalg.solve(triangular, shares), np.linalg.inv(triangular)


def _scaling(problem: _Problem, found: _Unknowns) -> Float[Array, "n n"]:
    """S with S S^T the inverse of the Gauss-Newton Hessian, directions without effect stretched a million times at most."""
    dtype = found.y.dtype
    _, rows, gain, own = _linearised(problem, found)
    p = rows.shape[-1]
    rows = rows.reshape(-1, p)
    if not np.isfinite(rows).all():
        rows = np.eye(p)  # the loss is not finite either, which ends the fit
    values, vectors = np.linalg.eigh(2 * rows.T @ rows)
    least = max(_RANK_TOLERANCE**2, 100 * float(jnp.finfo(dtype).eps))
    outer = vectors / np.sqrt(np.maximum(values, least * max(values[-1], 1e-300)))
    if gain is None:
        return jnp.asarray(outer, dtype)
    count, size = gain.shape[:2]
    whole = np.zeros((p + count * size, p + count * size))
    whole[:p, :p] = outer
    whole[p:, :p] = -gain.reshape(-1, p) @ outer
    for i in range(count):
        at = slice(p + i * size, p + (i + 1) * size)
        whole[at, at] = own[i] / np.sqrt(2)
    return jnp.asarray(whole, dtype)


def _deviation(problem: _Problem, found: _Unknowns) -> np.ndarray:
    """Standard deviations (p,) of x from the size of the errors and the Jacobian at the end."""
    errors, rows, gain, _ = _linearised(problem, found)
    if not np.isfinite(rows).all():
        return np.full(rows.shape[-1], np.nan)
    fit = truncated(rows.reshape(-1, rows.shape[-1]), errors.reshape(-1), _RANK_TOLERANCE)
    spare = errors.size - fit.rank - (0 if gain is None else gain.shape[0] * gain.shape[1])
    sigma = np.sqrt(np.sum(errors**2) / spare) if spare > 0 else np.nan
    stretch = np.asarray(jax.grad(lambda y: jnp.sum(problem.chosen.values(y)))(found.y), np.float64)  # x_i of y_i alone
    own = np.sqrt(np.sum(fit.half**2, axis=1))
    return np.where(fit.unknown, np.inf, sigma * own * np.abs(stretch))
