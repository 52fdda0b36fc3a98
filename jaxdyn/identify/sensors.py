"""How a scene's motion was measured: gains, biases and the delay of its sensors and drives, as numbers that a fit may change."""

from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.identify.construction import Construction, built
from jaxdyn.model.arguments import Numbers, as_array, state_dtype
from jaxdyn.systems.scene import as_scene
from jaxdyn.systems.system import SceneLike

if TYPE_CHECKING:
    FitSystem: TypeAlias = "SceneLike | Measured | Construction"  # what fits take
else:
    FitSystem = Any  # `with_sensors` makes a `Measured` of it


class Measured(eqx.Module):
    """A scene with what stands between it and its logs. The robot moves by q and tau; the log says

        q_log = q + position_bias,   tau(t) = torque_gain * tau_log(t - delay) + torque_bias.

    **Arguments:**

    - `scene`: a `Scene`, a system, or a `Construction`.
    - `position_bias` (nv,), rad or m, along the joints (encoders); zero by default.
    - `torque_gain` (nv,): of a drive, N m per unit of the log (per ampere for currents; gears included); ones
      by default. `torque_bias` (nv,), N m; zero.
    - `delay` (), s: the torque acts so much later than its samples say; zero.

    All are leaves: free them with `jd.identify.Parameters`. A gain is told apart from inertias by what is known
    otherwise: a payload, a frozen body, the mass total.

    **Raises:** ValueError for arguments of other shapes.

    ```python
    measured = jd.identify.Measured(scene, torque_gain=[11.0, 8.5])
    parameters = jd.identify.Parameters(measured).positive(lambda m: m.torque_gain).bounded(lambda m: m.delay, -0.02, 0.02)
    fit = jd.identify.fit_parameters(measured, log, parameters, error="torque")
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
        self.scene = scene if isinstance(scene, Construction) else as_scene(scene)
        own = built(scene)
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
        self.delay = jnp.asarray(as_array(delay, "delay", dtype))
        if self.delay.shape != ():
            raise ValueError(f"delay has shape {self.delay.shape}; give one number (s)")


def with_sensors(system: Any) -> Measured:
    """A measured scene as it is, and a scene or system with ideal sensors; what is constructed is built."""
    if not isinstance(system, Measured):
        return Measured(built(system))
    return eqx.tree_at(lambda m: m.scene, system, built(system.scene), is_leaf=lambda x: x is system.scene)
