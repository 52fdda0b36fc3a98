"""Result of a fit, and the torques that a scene needs along a log."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.codes import Outcome, name_of
from jaxdyn.dynamics import quantities as dynamics
from jaxdyn.identify.logs import Log, check_log
from jaxdyn.identify.mechanisms import Measured, build_scene, motor_basis
from jaxdyn.identify.regression import torque_error
from jaxdyn.identify.torque_terms import ExtraTorque, Friction, friction_of, smoothing_by_filter
from jaxdyn.model.arguments import state_dtype
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene


class Fit(Outcome):
    """Result of a fit: of a robot by its torques (`fit_torques`, `fit_robot`), or of any numbers (`fit_parameters`).

    - `system`: the system or the scene with the fitted numbers, of a robot by its torques the scene of `model` and `friction`;
      `nominal`: as given, where the fit started. `scene`: of the system, with its forces.
    - `names` (p,): of the fitted numbers, of a robot as of `parameter_names`, else their paths within the system, as in
      "parameters['mass']". `values`, `nominal_values` (p,).
    - `deviation` (p,): standard deviation of each, infinite for numbers that the log does not determine, None where the method
      computes none (`RobotFit.intervals` has those of a robot): the larger of that for independent errors of one size, and of a
      delete-a-group jackknife, whose groups are consecutive samples twice as long as the autocorrelation time, or whole logs
      where there are twenty or more. `factor`: a 95 % interval is plus and minus this many of them (Student's t).
    - `history` (steps,): loss before each step and at the end. `result`: one of `RESULTS`, `successful` where it has
      converged, else `max_steps_reached`, `stopped`, `no_descent` where no step lowers the loss at a point that is no minimum, or
      `nonfinite`; `cause` then names the log, the sample and the parameters.
    - `motors`: indices in v of the observed coordinates, where the fit named them; `torques` of a mechanism are theirs.
    - `terms`: names of the fitted torque terms. `sigma`: torque noise (N m) that weighed the data against the prior, or None.
    - `extra`: fitted torque terms beyond `friction`, or None. They belong to logs, and are no force of the scene.
    - `as_measured`: whether friction was fitted, and is predicted, as the low-pass of a log leaves it (`from_raw`).
    """

    system: Any
    nominal: Any
    names: tuple[str, ...] = eqx.field(static=True)
    values: np.ndarray
    nominal_values: np.ndarray
    history: np.ndarray
    result: Any
    method: str = eqx.field(static=True)
    deviation: np.ndarray | None = None
    factor: float = np.nan
    cause: str | None = eqx.field(static=True, default=None)
    motors: tuple[int, ...] | None = eqx.field(static=True, default=None)
    terms: tuple[str, ...] = eqx.field(static=True, default=())
    sigma: float | None = None
    extra: ExtraTorque | None = None
    as_measured: bool = eqx.field(static=True, default=False)

    @property
    def scene(self) -> Scene:
        """Fitted scene; of a system, its scene without constraints and forces."""
        return build_scene(self.system)

    @property
    def model(self) -> Model:
        """Fitted model, with its inertias, armature, damping and friction."""
        return self.scene.system  # pyright: ignore[reportReturnType]

    @property
    def friction(self) -> Friction:
        """Fitted friction law, with its offset: a force for `Scene(fit.model, forces=[fit.friction])`."""
        return friction_of(self.scene)

    def torques(self, log: Log) -> np.ndarray:
        """Torques (n, nv) that the fitted system needs along a log, in the log's units: as its sensors would measure them.

        With its friction and all extra terms (N m, N), over and above the other forces of the scene.
        """
        torque = torques_along(self.scene, log, self.motors)
        if self.as_measured:
            torque = torque + np.asarray(self.friction.coulomb) * smoothing_by_filter(self.scene, log)
        if isinstance(self.system, Measured):
            bias, gain = (np.asarray(x, np.float64) for x in (self.system.torque_bias, self.system.torque_gain))
            torque = (torque - bias) / gain
        if self.extra is None:
            return torque
        # Without friction: the load of the gears is the torque of bodies and rotors, as in the fit.
        load = torques_along(Scene(self.model), log) if self.extra.needs_load else np.zeros_like(torque)
        return torque + self.extra.torque(log, load)

    def error(self, log: Log) -> float:
        """Torque error along a log in per cent, 100 |tau_fit - tau| / |tau| over all samples and joints."""
        return torque_error(self.torques(log), log.tau)

    def rms(self, log: Log) -> np.ndarray:
        """Root mean square of the torque error of each coordinate (nv,)."""
        return np.sqrt(np.mean((self.torques(log) - np.asarray(log.tau)) ** 2, axis=0))

    @property
    def vector(self) -> np.ndarray:
        """All parameters x (10 nb + 4 nv,) of a robot in the order of `jd.identify.parameter_names(model)`."""
        model, friction = self.model, self.friction
        rotors = np.zeros(model.nv) if model.armature is None else model.armature
        parts = (model.inertias, friction.viscous, friction.coulomb, friction.offset, rotors)
        return np.concatenate([np.asarray(part, np.float64).reshape(-1) for part in parts])

    @property
    def parameters(self) -> list[tuple[str, float, float, float]]:
        """Rows (name, nominal, fitted, standard deviation), the last NaN where the method computes none.

        Of single inertial numbers only combinations are identifiable (`base_parameters`); the prior determines the rest.
        """
        deviation = np.full_like(self.values, np.nan) if self.deviation is None else self.deviation
        columns = (self.nominal_values, self.values, deviation)
        return list(zip(self.names, *(column.tolist() for column in columns), strict=True))

    def summary(self, *logs: Log) -> str:
        """Summary of the fit: how it ended, the error on each log given, and the parameters."""
        system = self.scene.system
        lines = [
            f"{self.method}, {system.name if isinstance(system, Model) else type(system).__name__}: {name_of(self.result)} after "
            f"{len(self.history) - 1} steps, loss {self.history[0]:.6g} -> {self.history[-1]:.6g}"
        ]
        for i, log in enumerate(logs):
            per_joint = ", ".join(f"{x:.3g}" for x in self.rms(log))
            lines.append(
                f"log {i + 1}: {len(log)} samples, torque error {self.error(log):.3f} %, rms per joint {per_joint}"
            )
        columns = ("nominal", "fitted") if self.deviation is None else ("nominal", "fitted", "std")
        width = max(map(len, self.names), default=0)
        lines.append(f"{'parameter':{width}}" + "".join(f"  {column:>12}" for column in columns))
        for name, *numbers in self.parameters:
            lines.append(f"{name:{width}}" + "".join(f"  {x:12.5g}" for x in numbers[: len(columns)]))
        return "\n".join(lines)


def torques_along(scene: Scene, log: Log, motors: tuple[int, ...] | None = None) -> np.ndarray:
    """Torques (n, nv) that a scene needs along a log; of a mechanism those of its `motors`, zero elsewhere.

    **Raises:** ValueError for a log that does not fit, and for a mechanism without `motors`.
    """
    check_log(log, scene.system)
    if scene.constraints and motors is None:
        raise ValueError("the torques of a mechanism are those of its motors; name them as observed= in the fit")
    dtype = state_dtype(scene.system)
    signals = (jnp.asarray(x, dtype) for x in (log.t, log.q, log.v, log.a))
    return np.asarray(_torques(scene, motors if scene.constraints else None, *signals), np.float64)


def inverse_torque(scene: Scene, q, v, a, t):
    """Torque tau (nv,) of a motion of a scene without constraints: inverse dynamics less the scene's forces."""
    tau = dynamics.inverse_dynamics(scene.system, q, v, a, t)
    force = scene.applied_force(q, v, t)
    return tau if force is None else tau - force


def project_to_motors(scene: Scene, columns, q, v, t, tau):
    """Torques (nv,) of the motors that have the power of torques (nv,) at all joints of a mechanism; zero elsewhere."""
    N, _ = motor_basis(scene, q, v, t, columns)
    return jnp.zeros_like(tau).at[np.array(columns)].set(N.T @ tau)


def regressor_torque(scene: Scene, q, v, a, t):
    """`inverse_torque` of a model by its regressor, whose derivative by the inertias is the regressor itself."""
    model: Any = scene.system
    tau = dynamics.torque_regressor(model, q, v, a) @ model.inertias.reshape(-1)
    tau = tau if model.armature is None else tau + model.armature * a
    force = scene.applied_force(q, v, t)
    return tau if force is None else tau - force


@eqx.filter_jit
def _torques(scene: Scene, motors, t, q, v, a):
    def one(t, q, v, a):
        tau = inverse_torque(scene, q, v, a, t)
        return tau if motors is None else project_to_motors(scene, motors, q, v, t, tau)

    return jax.vmap(one)(t, q, v, a)
