"""Cases of the report: a scene with its reference solution, measured quantities, and published results."""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxdyn import scenes
from jaxdyn.reports.references import Reference
from jaxdyn.systems.scene import Scene


class Published(NamedTuple):
    """Published run of the same motion: CPU `seconds`, and the largest `error` or `energy_error` (J) if stated."""

    label: str
    seconds: float
    error: float | None = None
    energy_error: float | None = None


class Case(NamedTuple):
    """Scene of the report with its measurements.

      - `name`, `text`: name and description; `kind`: the class of scenes for comparing defaults.
      - `build()` -> (scene, (q0, v0)); `reference(start)` -> `Reference`, or None where a
    converged solution at `ts` is the reference.
      - `steps`: fixed steps of the coarsest run; `conserves`: whether the energy is constant; `stiff`.
      - `reduces`: whether the method "reduced" finds the scene's degrees of freedom.
      - `largest`: largest measured batch unless `integrators` are chosen; None for no limit.
    """

    name: str
    text: str
    kind: str
    build: Callable[[], tuple[Scene, tuple]]
    reference: Callable[[Any], Reference] | None
    ts: np.ndarray
    steps: int
    conserves: bool = True
    stiff: bool = False
    reduces: bool = True
    largest: int | None = None
    published: tuple[Published, ...] = ()


def scene_builder(name: str, **parameters) -> Callable[[], tuple[Scene, tuple]]:
    """Function `build` for a scene of `jaxdyn.scenes`; scene and start get the parameters that they accept."""

    def call_with_known(function):
        # A parameter may belong to the scene, to its start, or to both.
        known = inspect.signature(function).parameters
        return function(**{key: value for key, value in parameters.items() if key in known})

    def build():
        scene = getattr(scenes, name)
        q, v = call_with_known(scene.start_function)
        return call_with_known(scene), (np.asarray(q), np.asarray(v))

    return build
