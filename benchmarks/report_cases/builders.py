"""Builders of the scenes of cases."""

import inspect
from collections.abc import Callable

import numpy as np

from jaxdyn import scenes
from jaxdyn.systems.scene import Scene


def scene_builder(scene: str | scenes.NamedScene, **parameters) -> Callable[[], tuple[Scene, tuple]]:
    """Function `build` for a scene of `jaxdyn.scenes` or a `NamedScene`; scene and start get the parameters that they accept."""

    def call_with_known(function):
        # A parameter may belong to the scene, to its start, or to both.
        known = inspect.signature(function).parameters
        return function(**{key: value for key, value in parameters.items() if key in known})

    def build():
        named = getattr(scenes, scene) if isinstance(scene, str) else scene
        # Start and scene get the same parameters, so that the start satisfies the constraints.
        q, v = call_with_known(named.start_function)
        return call_with_known(named), (np.asarray(q), np.asarray(v))

    return build
