"""Named scenes: a function that builds the scene, with the start that its reference uses."""

import functools
from collections.abc import Callable
from typing import Generic, ParamSpec, TypeVar

import jax.numpy as jnp
from jaxtyping import Array

from jaxdyn.compile import is_concrete
from jaxdyn.model.arguments import store_leaf
from jaxdyn.systems.scene import Scene

REGISTRY: dict[str, "NamedScene"] = {}

_P = ParamSpec("_P")
_S = ParamSpec("_S")
_Made = TypeVar("_Made", bound=Scene, covariant=True)


class NamedScene(Generic[_P, _S, _Made]):
    """A scene by name: `jd.scenes.pendulum(length=2.0)` builds it, `jd.scenes.pendulum.start(...)` gives (q0, v0)."""

    def __init__(self, build: Callable[_P, _Made], start: Callable[_S, tuple[Array, Array]]):
        self.__name__: str
        functools.update_wrapper(self, build)
        self._build = build
        self.start_function = start  # whose signature says what a start depends on

    def __call__(self, *args: _P.args, **parameters: _P.kwargs) -> _Made:
        """The scene; parameters as in its documentation."""
        return self._build(*args, **parameters)

    def start(self, *args: _S.args, **parameters: _S.kwargs) -> tuple[Array, Array]:
        """Configuration (nq,) and velocity (nv,) of the reference motion, on the constraints."""
        return self.start_function(*args, **parameters)

    def __repr__(self):
        return f"jaxdyn.scenes.{self.__name__}"


def named(
    start: Callable[_S, tuple[Array, Array]],
) -> Callable[[Callable[_P, _Made]], NamedScene[_P, _S, _Made]]:
    """Register a function that builds a scene, with the function that gives its start."""

    def register(build: Callable[_P, _Made]) -> NamedScene[_P, _S, _Made]:
        scene = NamedScene(build, start)
        REGISTRY[scene.__name__] = scene
        return scene

    return register


def as_leaf(value):
    """A number as a leaf, which can be differentiated and batched."""
    return store_leaf(value, float)


def as_state(values):
    """Numbers of a start as an array: of jax's default type where they are known."""
    return store_leaf(values, float) if is_concrete(values) else jnp.asarray(values)
