"""Scenes as functions of the numbers that they are built from: lengths, radii, densities, which go into many leaves at once."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxdyn.model.arguments import Function
from jaxdyn.systems.scene import Scene, as_pytree, as_scene


class Construction(eqx.Module):
    """A scene that is built anew from numbers at every point of a fit: a length moves a joint, an inertia and a loop together.

    **Arguments:**

    - `build`: a function of the numbers that returns a `Scene`, a `Model` or another system, through `jd.ModelBuilder` or a named
      scene say; it is called with traced numbers. An equinox Module counts with its leaves.
    - `numbers`: a pytree of floating-point numbers or arrays, of which `jd.identify.Parameters` frees some.

    Pass it where `fit_parameters`, `Parameters` and `Measured` take a scene; `scene` is the one of the numbers as they are.

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
        """The scene of the numbers."""
        return as_scene(self.build(self.numbers))


def _number(value) -> Float[Array, "..."]:
    if eqx.is_inexact_array(value):  # traced ones too
        return jnp.asarray(value)
    if isinstance(value, bool) or not (isinstance(value, int) or eqx.is_inexact_array_like(value)):
        raise ValueError(f"numbers has {value!r}; give floating-point numbers or arrays")
    return jnp.asarray(value, float)


def built(system: Any) -> Scene:
    """The scene of a construction, of a system, or a scene as it is."""
    return system.scene if isinstance(system, Construction) else as_scene(system)
