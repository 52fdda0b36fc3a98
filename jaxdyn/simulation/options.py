"""Options of a run as users give them, without diffrax, whose import takes longer than a run from stored programs."""

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike

from jaxdyn.compile.known import is_concrete
from jaxdyn.model.arguments import Numbers, batch_hint

if TYPE_CHECKING:
    import diffrax

    from jaxdyn.simulation.solvers.diffrax_methods import Stepper

    Solver = diffrax.AbstractSolver | Stepper | None
    Stepsize = ArrayLike | diffrax.AbstractStepSizeController | None
    Adjoint = str | diffrax.AbstractAdjoint | None
else:
    Solver = Stepsize = Adjoint = Any  # `choose_solver` and `choose_adjoint` check them


class Steps(eqx.Module):
    """Steps of a run: their length, or the tolerances that adaptive ones keep, and how many there may be.

    - `size`: None for adaptive steps, a number (s) for fixed ones, or a diffrax step-size controller.
    - `rtol`, `atol`: local error of a step, relative to the size of each entry of (q, v), and absolute; by default 1e-8. Values
      below ten times the rounding error of the dtype are raised to that. With fixed steps, tolerances of an implicit solver.
    - `max_steps`: most steps to take, rejected ones included. Default: what fixed steps need; 65536 for adaptive ones,
      4096 with `adjoint="direct"`, and where derivatives go through adaptive steps: the end of each one is recorded, 8 bytes a
      step and trajectory.

    ```python
    jd.simulate(scene, q, v, ts, stepsize=jd.simulation.Steps(rtol=1e-10, atol=1e-12))
    jd.simulate(scene, q, v, ts, stepsize=jd.simulation.Steps(0.01, max_steps=1000))
    ```
    """

    size: Stepsize = None
    rtol: Numbers | None = eqx.field(default=None, kw_only=True)
    atol: Numbers | None = eqx.field(default=None, kw_only=True)
    max_steps: int | None = eqx.field(static=True, default=None, kw_only=True)


class Pose(NamedTuple):
    """Output of `simulate`: the pose (nt, 4, 4) of a frame of the model, in `Solution.poses` by its name."""

    frame: str

    def __str__(self) -> str:
        return POSE + self.frame


POSE = "pose:"  # prefix of names of poses, in descriptions and in files
# Names of what `Steps` holds, which were arguments of `simulate`.
FORMER_STEPS = {"rtol", "atol", "max_steps"}


def pack_steps(options: dict[str, Any]) -> dict[str, Any]:
    """Options of `simulate` by their names, with those of `Steps` in one."""
    given = {name: value for name, value in options.items() if name in FORMER_STEPS}
    if not given:
        return options
    rest = {name: value for name, value in options.items() if name not in given}
    steps = rest.get("stepsize")
    steps = steps if isinstance(steps, Steps) else Steps(steps)
    return rest | {"stepsize": dataclasses.replace(steps, **given)}


def as_output(name: str | Pose) -> str | Pose:
    """Output by its name, "pose:<frame>" as a `Pose`."""
    return Pose(name.removeprefix(POSE)) if isinstance(name, str) and name.startswith(POSE) else name


ADJOINTS = ("reverse", "direct", "forward", "backsolve")


class Options(NamedTuple):
    """Options of a run, checked. `solver` None and an adjoint's name are replaced by diffrax's objects in the program of the run.

    `stops`: whether lost contacts and joint limits end the run; `limit_is_given`: whether `max_steps` is the user's;
    `selects_rows`: whether the independent rows are chosen in the program, because the start is traced; `checks_mass`: whether
    the mass matrix may be singular.
    """

    solver: Any
    adjoint: Any
    outputs: tuple[str | Pose, ...]
    stops: tuple[bool, bool]
    max_events: int
    progress: bool
    checks_mass: bool
    terminals: tuple[Any, ...] = ()
    max_steps: int = 0
    limit_is_given: bool = False
    selects_rows: bool = False


def is_step_length(stepsize) -> bool:
    """True if `stepsize` is a number: fixed steps."""
    if stepsize is None or isinstance(stepsize, (int, float, np.ndarray, np.generic, jax.Array)):
        return stepsize is not None
    import diffrax

    return not isinstance(stepsize, diffrax.AbstractStepSizeController)


def is_backsolve(adjoint) -> bool:
    """True for the continuous adjoint, by its name or of diffrax."""
    if adjoint is None or isinstance(adjoint, str):
        return adjoint == "backsolve"
    import diffrax

    return isinstance(adjoint, diffrax.BacksolveAdjoint)


def check_step_length(stepsize) -> None:
    """Refuse a length of steps that is not one positive number. **Raises:** ValueError."""
    if np.shape(stepsize) != ():
        raise ValueError(f"stepsize has shape {np.shape(stepsize)}; pass one number (s){batch_hint(stepsize, ())}")
    if is_concrete(stepsize) and not (np.isfinite(stepsize) and stepsize > 0):
        raise ValueError(f"stepsize is {stepsize}; pass a positive number (s), or None for adaptive steps")


def check_tolerance(name: str, value) -> None:
    """Refuse tolerances that are not one finite number, or negative."""
    if value.shape != ():
        raise ValueError(f"{name} has shape {value.shape}; pass one number{batch_hint(value, ())}")
    if is_concrete(value) and not (np.isfinite(value) and value >= 0):
        raise ValueError(f"{name} is {value}; pass a finite number that is not negative, such as 1e-8")


def step_limit(max_steps, ts, stepsize, adjoint) -> int:
    """Limit on the number of steps: as given, else what fixed steps need, else 65536 (4096 where each allowed step costs).

    **Raises:** ValueError for anything but a positive integer or None.
    """
    if max_steps is not None:
        if isinstance(max_steps, bool) or not isinstance(max_steps, (int, np.integer)) or max_steps < 1:
            raise ValueError(f"max_steps is {max_steps!r}; pass a positive integer, or None for the default")
        return int(max_steps)
    if is_step_length(stepsize) and is_concrete((ts, stepsize)):
        # Rounded up to a power of two, so that other times seldom mean another program. In numpy: inside a jit, jax would trace
        # the difference of known times too.
        first, last = np.asarray(ts)[[0, -1]]
        needed = 1.001 * float(last - first) / float(stepsize) + 2
        return 2 ** int(np.ceil(np.log2(max(needed, 16))))
    return 4096 if _is_direct(adjoint) else 65536


def _is_direct(adjoint) -> bool:
    if isinstance(adjoint, str):
        return adjoint == "direct"
    import diffrax

    return isinstance(adjoint, diffrax.DirectAdjoint)
