"""Cases of a report: a scene with its reference motion and measured quantities."""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxdyn import scenes
from jaxdyn.contact.unilateral import has_modes
from jaxdyn.reports.references import CLOSED_FORMS
from jaxdyn.reports.references import Reference as Reference
from jaxdyn.systems.scene import Scene


class Case(NamedTuple):
    """Scene of the report with its measurements.

      - `name`, `text`: name and description.
      - `build()` -> (scene, (q0, v0)); `reference(start)` -> `Reference`, or None where a
    converged solution at `ts` is the reference.
      - `steps`: fixed steps of the coarsest run; `conserves`: whether the energy is constant; `stiff`.
      - `reduces`: whether the method "reduced" finds the scene's degrees of freedom.
    """

    name: str
    text: str
    build: Callable[[], tuple[Scene, tuple]]
    reference: Callable[[Any], Reference] | None
    ts: np.ndarray
    steps: int
    conserves: bool = True
    stiff: bool = False
    reduces: bool = True


def case_of_scene(name: str) -> Case:
    """Case of a scene of `jd.scenes`: its default start, one second, and its closed form, or else a converged solution.

    **Raises:** ValueError for other names, and for scenes with forces that have modes, whose steps end at events.
    """
    if name not in scenes.names():
        raise ValueError(f"scenes has {name!r}; give a jaxdyn.reports.Case, or choose from {', '.join(scenes.names())}")
    if has_modes(getattr(scenes, name)()):
        raise ValueError(f"scenes has {name!r}, whose steps end at events; a report compares steps of given lengths")
    scene = getattr(scenes, name)
    # The first line of a scene's docstring describes it.
    text = (inspect.getdoc(scene) or name).partition("\n")[0]
    # The energy of an arbitrary scene need not be constant, so its error is not reported.
    build = lambda: (scene(), tuple(np.asarray(x) for x in scene.start()))  # noqa: E731
    ts, known = np.linspace(0.0, 1.0, 11), CLOSED_FORMS.get(name)
    reference = None if known is None else lambda start: known(ts)
    return Case(name, text, build, reference, ts, 250, conserves=False)
