"""Scenes that a fit accepts: with sensors and drives, built from numbers, and mechanisms of which some joints are measured."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from jaxdyn.constraints.assembly import Assembly, assemble
from jaxdyn.constraints.base import layout, position_residual, rows
from jaxdyn.constraints.codes import CODES, RESULTS, code_of
from jaxdyn.constraints.selection import degrees_of_freedom, independent_rows
from jaxdyn.dynamics import quantities as dynamics
from jaxdyn.identify.logs import Log
from jaxdyn.identify.torque_terms import friction_regressor
from jaxdyn.model.arguments import Function, Numbers, as_array, as_float, deprecated, state_dtype
from jaxdyn.model.topology import velocity_indices
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import solve_positive
from jaxdyn.systems.scene import Scene, as_pytree, as_scene
from jaxdyn.systems.system import SceneLike, displace, displacement


class Construction(eqx.Module):
    """Scene that is built from numbers at every point of a fit: a length changes a joint, an inertia and a loop together.

    **Arguments:**

    - `build`: a function of the numbers that returns a `Scene`, a `Model` or another system, for example by `jd.ModelBuilder`
      or a named scene; it is called with traced numbers. The leaves of an equinox Module are leaves of the construction.
    - `numbers`: a pytree of floating-point numbers or arrays; `jd.identify.Parameters` frees some of them.

    Pass it where `fit_parameters`, `Parameters` and `Measured` accept a scene; `scene` is that of the present numbers.

    **Raises:** ValueError for a `build` that cannot be called, and numbers that are none.

    ```python
    links = jd.identify.Construction(
        lambda numbers: jd.scenes.four_bar(lengths=(1.0, *numbers["lengths"], 3.5)), {"lengths": [3.0, 2.5]}
    )
    parameters = jd.identify.Parameters(links).positive(lambda links: links.numbers["lengths"])
    ```
    """

    build: Callable[[Any], Any]
    numbers: Any

    def __init__(self, build: Function, numbers: PyTree):
        if not callable(build):
            raise ValueError(f"build is {build!r}; give a function of the numbers that returns a scene")
        self.build = as_pytree(build, "build")
        self.numbers = jax.tree.map(_number, numbers)

    @property
    def scene(self) -> Scene:
        """Scene of the present numbers."""
        return as_scene(self.build(self.numbers))


def _number(value) -> Float[Array, "..."]:
    if eqx.is_inexact_array(value):  # traced ones too
        return jnp.asarray(value)
    if isinstance(value, bool) or not (isinstance(value, int) or eqx.is_inexact_array_like(value)):
        raise ValueError(f"numbers has {value!r}; give floating-point numbers or arrays")
    return jnp.asarray(value, float)


def build_scene(system: Any) -> Scene:
    """Scene of a construction or of a system, or a scene as it is; of one with sensors without these."""
    system = system.scene if isinstance(system, Measured) else system
    return system.scene if isinstance(system, Construction) else as_scene(system)


if TYPE_CHECKING:
    FitSystem: TypeAlias = "SceneLike | Measured | Construction"  # systems that fits accept
else:
    FitSystem = Any  # `with_sensors` makes a `Measured` of it


class Measured(eqx.Module):
    r"""Scene with its sensors and drives.

    The robot moves by q and tau; the log holds

    $$q_\mathrm{log} = q + \mathrm{position\_bias}, \quad
        \tau(t) = \mathrm{torque\_gain} \cdot \tau_\mathrm{log}(t - \mathrm{delay}) + \mathrm{torque\_bias}$$

    **Arguments:**

    - `scene`: a `Scene`, a system, or a `Construction`.
    - `position_bias` (nv,), rad or m, along the joints (encoders); zero by default.
    - `torque_gain` (nv,): of a drive, N m per unit of the log (per ampere for currents; gears included); ones
      by default. `torque_bias` (nv,), N m; zero.
    - `delay` (), s, of the torque behind its samples; zero.

    All are leaves: free them with `jd.identify.Parameters`. Gains and inertias are identifiable together only with other
    knowledge: a payload, a frozen body, the total mass.

    **Raises:** ValueError for arguments of other shapes.

    ```python
    measured = jd.identify.Measured(scene, torque_gain=[11.0, 8.5])
    parameters = jd.identify.Parameters(measured).positive(lambda m: m.torque_gain).bound(lambda m: m.delay, -0.02, 0.02)
    fit = jd.identify.fit_parameters(measured, log, parameters, jd.identify.Objective("torque"))
    ```
    """

    scene: Any
    position_bias: Float[Array, " nv"]
    torque_gain: Float[Array, " nv"]
    torque_bias: Float[Array, " nv"]
    delay: Float[Array, ""]

    def __init__(
        self,
        scene: FitSystem,
        *,
        position_bias: Numbers | None = None,
        torque_gain: Numbers | None = None,
        torque_bias: Numbers | None = None,
        delay: Numbers = 0.0,
    ):
        # A construction is kept: once it is built, its numbers can no longer be freed.
        self.scene = scene if isinstance(scene, Construction) else as_scene(scene)
        own = build_scene(scene)
        dtype, nv = state_dtype(own.system), own.nv
        given = {
            "position_bias": (position_bias, 0.0),
            "torque_gain": (torque_gain, 1.0),
            "torque_bias": (torque_bias, 0.0),
        }
        for name, (value, default) in given.items():
            array = jnp.full((nv,), default, dtype) if value is None else jnp.asarray(as_array(value, name, dtype))
            if array.shape != (nv,):
                raise ValueError(f"{name} has shape {array.shape}, expected {(nv,)} = (nv,)")
            setattr(self, name, array)
        self.delay = as_float(delay, "delay", (), dtype)


def with_sensors(system: Any) -> Measured:
    """Scene with sensors: a `Measured` one as it is, others with ideal sensors; a `Construction` is built."""
    if not isinstance(system, Measured):
        return Measured(build_scene(system))
    return eqx.tree_at(lambda m: m.scene, system, build_scene(system.scene), is_leaf=lambda x: x is system.scene)


# Gauss-Newton steps of a search, and the power of eps, of the size of the state, that the last one must not exceed: 5e-7 in
# float64. `on_constraints` then closes the constraints by `assemble`, so that it decides only how near the state is.
_ITERATIONS, _CONVERGED = 10, 0.4
# Weight of the residual of a constraint, where that of a measured coordinate has 1. A contradiction between both is divided by
# the squares of the weights: for rows of unit size all but 1e-4 of it stays in the measured coordinates. A larger weight would
# cost digits in the normal equations.
_CONSTRAINT_WEIGHT = 1e2
# Weight of the squared change of every coordinate: so small that it determines only the coordinates that neither constraints nor
# measurements do.
_REGULARISATION = 1e-8
# Newton steps from one sample of a motion to the next.
_CLOSING = 4


def observation_columns(system: Any, observed: Sequence[Any]) -> tuple[int, ...]:
    """Indices in v of the observed joints, given by name, or of the coordinates of a system without bodies, given by index.

    **Raises:** ValueError for those that do not exist.
    """
    if isinstance(system, Model):
        return tuple(int(i) for i in velocity_indices(system, observed))
    columns = tuple(observed)
    if not all(isinstance(i, int) and 0 <= i < system.nv for i in columns) or len(set(columns)) < len(columns):
        raise ValueError(
            f"{list(columns)} are no coordinates of a {type(system).__name__}; give indices below {system.nv}"
        )
    return columns


def on_constraints(scene: Scene, q, v, t, columns: tuple[int, ...] | None) -> Assembly:
    """State on a scene's constraints that is nearest to (q, v).

    Without `columns` the distance is that of the mass metric. `columns` are the indices in v of the measured coordinates: the
    state then fits these by least squares, and the other coordinates change as little as the constraints allow. The result is
    `not_nearest` where the search for it has not converged.
    """
    if columns is None:
        return assemble(scene, q, v, t, throw=False)

    counted = independent_rows(scene, q, t)

    def improve(at, _):
        # Nonholonomic rows restrict velocities alone: they have no residual of positions.
        jacobian = rows(counted, at, jnp.zeros_like(v), t).A[holonomic]
        misfit = displacement(scene.system, at, q)[measured]
        targets = jnp.concatenate([-_CONSTRAINT_WEIGHT * position_residual(counted, at, t), misfit])
        change = _least_squares(jacobian, selector, targets)
        return displace(scene.system, at, change), change

    measured = np.array(columns)
    selector = jnp.eye(scene.nv, dtype=q.dtype)[measured]
    holonomic = np.concatenate([np.arange(place.start, place.nonholonomic) for place in layout(scene)])
    near, is_nearest = q, jnp.asarray(True)
    if len(holonomic):
        near, changes = lax.scan(improve, q, None, length=_ITERATIONS)
        is_nearest = _is_small(changes[-1], q)
    velocity, has_velocity = nearest_velocity(scene, near, v, t, columns)
    state = assemble(scene, near, velocity, t, throw=False)
    missed = state.success & ~(is_nearest & has_velocity)
    result = RESULTS.where(missed, RESULTS.not_nearest, state.result)
    return eqx.tree_at(lambda state: state.result, state, result)


def nearest_velocity(scene: Scene, q, v, t, columns: tuple[int, ...]) -> tuple[Float[Array, " nv"], Bool[Array, ""]]:
    """Velocity (nv,) whose `columns` and rows A v = b fit those of v and the constraints by least squares.

    Rows that the measured ones contradict stay open (`_CONSTRAINT_WEIGHT`).

    **Returns:** the velocity, and whether the search has converged.
    """
    selector, counted = jnp.eye(scene.nv, dtype=q.dtype)[np.array(columns)], independent_rows(scene, q, t)

    # The rows are affine in v. Repetition removes the effect of the regularisation, which pulls each change towards zero.
    def improve(estimate, _):
        at = rows(counted, q, estimate, t)
        targets = jnp.concatenate([-_CONSTRAINT_WEIGHT * at.velocity, (v - estimate)[np.array(columns)]])
        change = _least_squares(at.A, selector, targets)
        return estimate + change, change

    velocity, changes = lax.scan(improve, v, None, length=_ITERATIONS)
    return velocity, _is_small(changes[-1], velocity)


def motor_basis(scene: Scene, q, v, t, columns: tuple[int, ...]) -> tuple[Float[Array, "nv m"], Float[Array, " nv"]]:
    """Tangent basis N (nv, m) and drift (nv,) of a mechanism: a = N a_m + drift for the accelerations a_m of its motors.

    `columns`: indices in v of the motors, as many as there are degrees of freedom. Rows of N at the motors are those of the
    identity, so that N^T takes the torques at all joints to those of the motors with the same power: the forces of ideal
    constraints do no work, and cancel.
    """
    # Rows that repeat others but for the rounding of a file contradict these by it.
    row, motors = rows(independent_rows(scene, q, t), q, v, t), np.array(columns)
    passive = np.setdiff1d(np.arange(scene.nv), motors)
    # Redundant rows are consistent: least squares solves them exactly, where the motors determine the passive joints.
    own = row.A[:, passive]
    known = jnp.concatenate([-row.A[:, motors], row.gamma[:, None]], axis=1)
    solved = jax.vmap(partial(solve_positive, own.T @ own), 1, 1)(own.T @ known)
    N = jnp.zeros((scene.nv, len(motors)), q.dtype).at[motors].set(jnp.eye(len(motors), dtype=q.dtype))
    return N.at[passive].set(solved[:, :-1]), jnp.zeros((scene.nv,), q.dtype).at[passive].set(solved[:, -1])


def follow_motors(scene: Scene, columns: tuple[int, ...], start, positions):
    """Configurations (n, nq) of a mechanism whose motors pass through positions (n, m), from a closed one, and their gaps (n,).

    Newton's method from each sample to the next, with a few steps, for motions of some hundredths of a radian or metre between
    samples. The gap is the largest residual of a row (m, rad): far from zero where the loops cannot be closed. Joints have one
    coordinate each. Differentiable in the positions.
    """
    motors = np.array(columns)
    passive = np.setdiff1d(np.arange(scene.nv), motors)
    holonomic = np.concatenate([np.arange(place.start, place.nonholonomic) for place in layout(scene)])

    def follow(q, position):
        q = q.at[motors].set(position)
        for _ in range(_CLOSING):
            jacobian = rows(scene, q, jnp.zeros_like(q), 0.0).A[holonomic][:, passive]
            normal = jacobian.T @ jacobian + _REGULARISATION * jnp.eye(len(passive), dtype=q.dtype)
            q = q.at[passive].add(-solve_positive(normal, jacobian.T @ position_residual(scene, q)))
        return q, (q, jnp.max(jnp.abs(position_residual(scene, q))))

    return lax.scan(follow, start, positions)[1]


def motor_regressor(scene: Scene, log: Log, motors: Sequence[Any], terms: Sequence[str], v_s: float) -> np.ndarray:
    """Regressor (n, m, 10 nb + terms m) of the torques of a mechanism's motors along a log: N^T Y of the tree, then friction.

    Columns are the inertias of all bodies, then `terms` of the motors. The passive joints have no friction.

    **Raises:** ValueError unless there are as many motors as degrees of freedom.
    """
    columns = check_motors(scene, np.asarray(log.q)[0], motors)
    signals = [jnp.asarray(x, state_dtype(scene.system)) for x in (log.q, log.v, log.a, log.t)]
    return np.asarray(_motor_regressor(scene, columns, tuple(terms), v_s, *signals), np.float64)


@eqx.filter_jit
def _motor_regressor(scene, columns, terms, v_s, *signals):
    def one(q, v, a, t):
        N, _ = motor_basis(scene, q, v, t, columns)
        own = np.array(columns)
        Y = dynamics.torque_regressor(scene.system, q, v, a)
        return jnp.concatenate([N.T @ Y, friction_regressor(v[own], a[own], terms, v_s)], axis=1)

    return jax.vmap(one)(*signals)


def check_motors(scene: Scene, q, motors: Sequence[Any]) -> tuple[int, ...]:
    """Indices in v of a mechanism's motors. **Raises:** ValueError unless there are as many as degrees of freedom at q."""
    columns = observation_columns(scene.system, motors)
    count = degrees_of_freedom(scene, jnp.asarray(q, state_dtype(scene.system)))
    if len(columns) != count:
        raise ValueError(
            f"observed has {len(columns)} joints, and the mechanism has {count} degrees of freedom; name as many motors, whose "
            "torques determine its motion"
        )
    return columns


def _is_small(change, value) -> Bool[Array, ""]:
    """True for the last step of a search that has converged; false for NaN."""
    change, value = lax.stop_gradient((change, value))
    return jnp.max(jnp.abs(change)) <= float(jnp.finfo(change.dtype).eps) ** _CONVERGED * (1 + jnp.max(jnp.abs(value)))


def _least_squares(A, selector, targets):
    """Change x (nv,) of least squares for A x and x[measured] = `targets`, whose first rows have the constraints' weight."""
    stacked = jnp.concatenate([_CONSTRAINT_WEIGHT * A, selector])
    normal = stacked.T @ stacked + _REGULARISATION * jnp.eye(stacked.shape[1], dtype=stacked.dtype)
    # Normal equations: they are positive definite by the regularisation, also where constraints are redundant.
    return solve_positive(normal, stacked.T @ targets)


def complete_log(scene: SceneLike, t: Numbers, measured: dict[Any, Any], tau: Numbers, guess: Numbers) -> Log:
    """Log of all joints of a mechanism, from the measured joints and the constraints.

    Positions of the other joints satisfy the constraints and are nearest to those of the previous sample, for the first sample to
    `guess`. Velocities fit $A v = b$ and the measured ones by least squares. At least as many joints must be measured as the
    mechanism has degrees of freedom; with more, positions on the constraints fit the measured ones by least squares.

    **Arguments:**

    - `scene`: a scene with constraints. `t` (n,): times of the samples, s.
    - `measured`: {joint: (q (n,), v (n,))}, rad and rad/s or m and m/s, of joints with one degree of freedom, or (q, v, a) with
      accelerations. Keys are names, or indices for a system without bodies.
    - `tau` (n, nv): N m or N, zero where there are no motors. `guess` (nq,): a configuration near the first sample.

    **Returns:** `Log` in which measured joints keep their measured values, without accelerations unless these are measured of as
    many joints as there are degrees of freedom. Pass the joints as `observed=` to `Objective`, which then compares them alone.

    **Raises:** ValueError for joints that do not exist or have several degrees of freedom, wrong shapes, and for a sample at
    which the mechanism cannot be assembled, no nearest state is found, or no velocity on the constraints has the measured ones,
    as at a dead point of the measured joint (its number and time).

    Source: EQUATIONS section 6 (constraints as rows).
    """
    scene = as_scene(scene)
    system = scene.system
    if not scene.constraints:
        raise ValueError("scene has no constraints, from which the other joints could follow; pass a mechanism")
    dtype, names = state_dtype(system), list(measured)
    columns = observation_columns(system, names)
    q_indices = [system.q_index(name) for name in names] if isinstance(system, Model) else list(columns)
    if not all(isinstance(index, int) for index in q_indices) or len(columns) != len(names):
        raise ValueError(f"measured names {names}; name joints with one degree of freedom each")
    t = np.asarray(as_array(t, "t"), np.float64)
    motion = {name: [jnp.asarray(as_array(x, f"measured[{name!r}]", dtype)) for x in measured[name]] for name in names}
    for name, signals in motion.items():
        if len(signals) not in (2, 3) or any(x.shape != t.shape for x in signals):
            shapes = ", ".join(str(x.shape) for x in signals)
            raise ValueError(f"measured[{name!r}] has shapes {shapes}; give q and v, or q, v and a, {t.shape} each")
    if len({len(signals) for signals in motion.values()}) > 1:
        raise ValueError("measured has accelerations of some joints only; give those of all, or none")
    positions, velocities, *accelerations = (jnp.stack(x, axis=1) for x in zip(*motion.values(), strict=True))
    guess = jnp.asarray(as_array(guess, "guess", dtype))
    if guess.shape != (system.nq,):
        raise ValueError(f"guess has shape {guess.shape}, expected {(system.nq,)} = (nq,)")
    # No more measured joints than degrees of freedom contradict no row, unless they do not determine the state.
    is_exact = isinstance(system, Model) and len(names) <= degrees_of_freedom(scene, guess)

    def complete_sample(previous, sample):
        position, velocity, time = sample
        start = previous.at[np.array(q_indices)].set(position)
        v = jnp.zeros((system.nv,), dtype).at[np.array(columns)].set(velocity)
        found = on_constraints(scene, start, v, time, columns)
        holds = _is_small(found.q[np.array(q_indices)] - position, position)
        holds &= _is_small(found.v[np.array(columns)] - velocity, velocity)
        missed = found.success & is_exact & ~holds
        return found.q, (found.q, found.v, RESULTS.where(missed, RESULTS.not_nearest, found.result))

    # In sequence: every sample starts from the one before, which keeps the mechanism on one branch of its assembly.
    _, (q, v, result) = jax.jit(lambda *samples: lax.scan(complete_sample, guess, samples))(
        positions, velocities, jnp.asarray(t, dtype)
    )
    codes = np.asarray(code_of(result))
    if codes.any():
        i = int(np.argmax(codes != 0))
        is_open = CODES[codes[i]] != "not_nearest"
        what = "mechanism cannot be assembled" if is_open else "measured joints do not determine the mechanism's state"
        raise ValueError(f"the {what} at sample {i} (t = {t[i]:.6g} s); check measured, lengths and guess")
    q, v = np.array(q), np.array(v)
    q[:, np.array(q_indices)], v[:, np.array(columns)] = positions, velocities
    log, a = Log(t, q, v, None, np.asarray(tau, np.float64)), None
    if accelerations:
        check_motors(scene, np.asarray(log.q)[0], names)
        a = _complete_accelerations(scene, columns, *(jnp.asarray(x, dtype) for x in (q, v, t)), *accelerations)
    return log if a is None else Log(t, q, v, np.asarray(a), log.tau)


@eqx.filter_jit
def _complete_accelerations(scene, columns, q, v, t, a):
    def one(q, v, t, a):
        N, drift = motor_basis(scene, q, v, t, columns)
        return N @ a + drift

    return jax.vmap(one)(q, v, t, a)


completed = deprecated("jd.identify.completed", complete_log)
