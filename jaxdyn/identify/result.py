"""What a feasible fit returns."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn import dynamics
from jaxdyn.identify.friction import Friction
from jaxdyn.identify.logs import Log, check_log
from jaxdyn.identify.regression import nominal_parameters, parameter_names, torque_error
from jaxdyn.model import Model


class Fit(eqx.Module):
    """A fitted, physically feasible model.

    - `model`: with the fitted inertias, armature, damping and friction. `friction`: the friction law, with its offset;
      a force for `Scene(fit.model, forces=[fit.friction])`.
    - `nominal`: the model the fit started from.
    - `history` (steps,): loss before each step and at the end. `result`: "converged", "max_steps" or "not_finite".
    - `sigma`: torque noise (N m) that weighed the data against the prior, or None.
    """

    model: Model
    friction: Friction
    nominal: Model
    history: np.ndarray
    result: str = eqx.field(static=True)
    method: str = eqx.field(static=True)
    terms: tuple[str, ...] = eqx.field(static=True)
    sigma: float | None = None

    @property
    def vector(self) -> np.ndarray:
        """All parameters x (10 nb + 4 nv,) in the order of `jd.identify.parameter_names(model)`."""
        friction = self.friction
        rotors = np.zeros(self.model.nv) if self.model.armature is None else self.model.armature
        parts = (self.model.inertias, friction.viscous, friction.coulomb, friction.offset, rotors)
        return np.concatenate([np.asarray(part, np.float64).reshape(-1) for part in parts])

    @property
    def parameters(self) -> list[tuple[str, float, float]]:
        """Rows (name, nominal, fitted). Single inertial numbers are known only as far as torques tell them apart
        (`base_parameters`); the prior chose the rest."""
        names = parameter_names(self.model)
        return list(zip(names, nominal_parameters(self.nominal).tolist(), self.vector.tolist(), strict=True))

    def torques(self, log: Log) -> np.ndarray:
        """Joint torques (n, nv) that the fitted model needs along a log, friction included (N m, N)."""
        check_log(log, self.model)
        samples = (jnp.asarray(np.asarray(x, self.model.home.dtype)) for x in (log.q, log.v, log.a))
        return np.asarray(_torques(self.model, self.friction, *samples), np.float64)

    def error(self, log: Log) -> float:
        """Torque error along a log in per cent, 100 |tau_fit - tau| / |tau| over all samples and joints."""
        return torque_error(self.torques(log), log.tau)

    def rms(self, log: Log) -> np.ndarray:
        """Root mean square of the torque error of each joint (nv,)."""
        return np.sqrt(np.mean((self.torques(log) - np.asarray(log.tau)) ** 2, axis=0))

    def summary(self, *logs: Log) -> str:
        """The fit in words: how it ended, the error on each log given, and the parameters."""
        lines = [
            f"{self.method}, {self.model.name}: {self.result} after {len(self.history) - 1} steps, "
            f"loss {self.history[0]:.6g} -> {self.history[-1]:.6g}"
        ]
        for i, log in enumerate(logs):
            per_joint = ", ".join(f"{x:.3g}" for x in self.rms(log))
            lines.append(
                f"log {i + 1}: {len(log)} samples, torque error {self.error(log):.3f} %, rms per joint {per_joint}"
            )
        width = max((len(name) for name, *_ in self.parameters), default=0)
        lines.append(f"{'parameter':{width}}  {'nominal':>12}  {'fitted':>12}")
        lines += [f"{name:{width}}  {x0:12.5g}  {x:12.5g}" for name, x0, x in self.parameters]
        return "\n".join(lines)


@eqx.filter_jit
def _torques(model, friction, q, v, a):
    def one(q, v, a):
        return dynamics.inverse_dynamics(model, q, v, a) + friction.torque(v)

    return jax.vmap(one)(q, v, a)
