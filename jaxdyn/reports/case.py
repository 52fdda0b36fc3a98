"""What a case of the report is: a scene with its reference, what is measured of it, and points that others have published."""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxdyn import scenes
from jaxdyn.reports.references import Reference
from jaxdyn.systems.scene import Scene


class Published(NamedTuple):
    """Somebody else's run of the same motion: CPU `seconds`, and the largest `error` or `energy_error` (J) if stated."""

    label: str
    seconds: float
    error: float | None = None
    energy_error: float | None = None


class Case(NamedTuple):
    """A scene of the report.

      - `name`, `text`: what it is called and what it is; `kind`: the class of scenes for which defaults are compared.
      - `build()` -> (scene, (q0, v0)); `reference(start)` -> `Reference`, or None where a
    converged solution at `ts` serves.
      - `steps`: fixed steps of the coarsest run; `conserves`: whether the energy is constant; `stiff`.
      - `reduces`: whether the method "reduced" takes the scene without being told its number of freedoms.
      - `largest`: the most trajectories at once that are measured unless `integrators` are chosen; None for any number.
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


def named(name: str, **parameters) -> Callable[[], tuple[Scene, tuple]]:
    """`build` of a scene of `jaxdyn.scenes`, its start in numpy; the scene and its start take the parameters that they have."""

    def taken(function):
        known = inspect.signature(function).parameters
        return function(**{key: value for key, value in parameters.items() if key in known})

    def build():
        scene = getattr(scenes, name)
        q, v = taken(scene.start_function)
        return taken(scene), (np.asarray(q), np.asarray(v))

    return build
