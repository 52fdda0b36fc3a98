"""Named scenes: a function that builds the scene, with the start that its reference uses."""

import functools
from collections.abc import Callable

import jax.numpy as jnp

from jaxdyn.compile import is_concrete
from jaxdyn.model.arguments import stored
from jaxdyn.systems.scene import Scene

REGISTRY: dict[str, "NamedScene"] = {}


class NamedScene:
    """A scene by name: `jd.scenes.pendulum(length=2.0)` builds it, `jd.scenes.pendulum.start(...)` gives (q0, v0)."""

    def __init__(self, build: Callable, start: Callable):
        functools.update_wrapper(self, build)
        self._build = build
        self.start_function = start  # whose signature says what a start depends on

    def __call__(self, **parameters) -> Scene:
        """The scene; parameters as in its documentation."""
        return self._build(**parameters)

    def start(self, **parameters):
        """Configuration (nq,) and velocity (nv,) of the reference motion, on the constraints."""
        return self.start_function(**parameters)

    def __repr__(self):
        return f"jaxdyn.scenes.{self.__name__}"  # pyright: ignore[reportAttributeAccessIssue]


def named(start: Callable) -> Callable[[Callable], NamedScene]:
    """Register a function that builds a scene, with the function that gives its start."""

    def register(build: Callable) -> NamedScene:
        scene = REGISTRY[build.__name__] = NamedScene(build, start)
        return scene

    return register


def as_leaf(value):
    """A number as a leaf, which can be differentiated and batched."""
    return stored(value, float)


def as_state(values):
    """Numbers of a start as an array: of jax's default type where they are known."""
    return stored(values, float) if is_concrete(values) else jnp.asarray(values)
