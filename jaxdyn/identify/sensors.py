"""Systems that a fit accepts in addition to scenes: scenes with sensors and drives, and scenes built from numbers."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxdyn.model.arguments import Function, Numbers, as_array, state_dtype
from jaxdyn.model.numbers import as_float
from jaxdyn.systems.scene import Scene, as_pytree, as_scene
from jaxdyn.systems.system import SceneLike


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
