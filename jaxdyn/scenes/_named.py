"""Named scenes: builders of scenes, each with the initial state of its reference motion."""

import functools
from collections.abc import Callable
from typing import Generic, ParamSpec, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdyn.compile.known import is_concrete
from jaxdyn.model.arguments import store_leaf
from jaxdyn.systems.mass_factor import solve_positive
from jaxdyn.systems.scene import Scene

REGISTRY: dict[str, "NamedScene"] = {}

_P = ParamSpec("_P")
_S = ParamSpec("_S")
_SceneT = TypeVar("_SceneT", bound=Scene, covariant=True)


class NamedScene(Generic[_P, _S, _SceneT]):
    """Named scene: `jd.scenes.pendulum(length=2.0)` builds it, `jd.scenes.pendulum.start(...)` gives (q0, v0)."""

    def __init__(self, build: Callable[_P, _SceneT], start: Callable[_S, tuple[Array, Array]]):
        self.__name__: str
        # `help` and documentation tools read name and docstring of the builder from the wrapper.
        functools.update_wrapper(self, build)
        self._build = build
        self.start_function = start  # its signature names the parameters of the initial state

    def __call__(self, *args: _P.args, **parameters: _P.kwargs) -> _SceneT:
        """Build the scene; parameters as in its documentation."""
        return self._build(*args, **parameters)

    def start(self, *args: _S.args, **parameters: _S.kwargs) -> tuple[Array, Array]:
        """Initial configuration (nq,) and velocity (nv,) of the reference motion, on the constraints."""
        return self.start_function(*args, **parameters)

    def __repr__(self):
        return f"jaxdyn.scenes.{self.__name__}"


def register_scene(
    start: Callable[_S, tuple[Array, Array]],
) -> Callable[[Callable[_P, _SceneT]], NamedScene[_P, _S, _SceneT]]:
    """Register the builder of a scene, with the function of its initial state."""

    def register(build: Callable[_P, _SceneT]) -> NamedScene[_P, _S, _SceneT]:
        scene = NamedScene(build, start)
        REGISTRY[scene.__name__] = scene
        return scene

    return register


def solve_gram(rows, right):
    """(X X^T)^-1 right for independent rows X, by NumPy where all is known."""
    solve = np.linalg.solve if is_concrete(rows, right) else solve_positive
    return solve(rows @ rows.T, right)


def flat_moments(moment):
    """Moments (3,) of a plate about its centre, of which a motion in the plane sees the last."""
    return 0.5 * moment, 0.5 * moment, moment


def as_leaf(value):
    """Convert a number to a leaf, which can be differentiated and batched."""
    return store_leaf(value, float)


def as_state(values):
    """Convert numbers of an initial state to an array, of jax's default dtype for concrete ones."""
    # Traced states keep their dtype, and with it the caller's precision.
    return store_leaf(values, float) if is_concrete(values) else jnp.asarray(values)
