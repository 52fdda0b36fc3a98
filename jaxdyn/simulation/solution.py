"""Result of a simulation: the motion, its code, advice where it ended early, and the motion as a file or table.

Files are CSV and NPZ that `jd.identify` reads as logs; tables are xarray datasets.
"""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import invalidate_derivatives
from jaxdyn.constraints.codes import RESULTS as RESULTS
from jaxdyn.constraints.codes import Outcome, first_of, name_of
from jaxdyn.contact.forces import contacts_with_cones
from jaxdyn.forces.drives import SlidingFriction
from jaxdyn.model.arguments import FilePath
from jaxdyn.model.description import solution_lines
from jaxdyn.model.tree import Model
from jaxdyn.simulation.controls import at_start
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import SceneLike

if TYPE_CHECKING:
    import xarray
import csv
import json
import os
from typing import NamedTuple

from jaxdyn.constraints.base import layout
from jaxdyn.model.arguments import as_path
from jaxdyn.model.configuration import columns_of
from jaxdyn.systems.scene import as_scene

# Names of the codes of diffrax, each also one of ours.
OF_DIFFRAX = (
    "successful", "max_steps_reached", "singular", "breakdown", "stagnation", "conlim", "nonfinite_input",
    "nonlinear_max_steps_reached", "nonlinear_divergence", "nonfinite", "dt_min_reached", "event_occurred", "max_steps_rejected",
    "internal_error",
)  # fmt: skip


def rows_where(mask, rows, otherwise):
    """Rows (nt, ...) where the mask (nt,) holds, elsewhere `otherwise`, which is broadcast."""
    return jnp.where(mask.reshape(-1, *[1] * (rows.ndim - 1)), rows, jnp.asarray(otherwise, rows.dtype))


def from_diffrax(result) -> Any:
    """Code of diffrax as one of `RESULTS`, by its name."""
    import diffrax

    # By name, because the numbers of codes differ between the two enumerations and between versions of diffrax.
    cases = [(result == getattr(diffrax.RESULTS, name), getattr(RESULTS, name)) for name in OF_DIFFRAX]
    return first_of(cases, RESULTS.internal_error)


# Codes of runs whose rows, as far as they come, are a motion, with its derivatives.
_OF_MOTIONS = (
    "successful", "coarse_steps", "contact_lost", "joint_limit_passed", "control_singular", "no_single_contact", "singular_basis",
    "event_occurred",
)  # fmt: skip


def invalidate_failures(rows, times, result, reached, inputs):
    """Rows (nt, ...) and times (...) of a run, with NaN in rows that were not reached and for the derivatives of what failed."""
    has_failed = ~jnp.stack([result == getattr(RESULTS, name) for name in _OF_MOTIONS]).any(0)
    rows = jax.tree.map(lambda x: rows_where(reached, x, jnp.nan), rows)
    return invalidate_derivatives(rows, has_failed | ~reached, inputs), invalidate_derivatives(
        times, has_failed, inputs
    )


ADVICE = {
    "max_steps_reached": "raise max_steps (now {max_steps}), loosen rtol and atol, or take an implicit solver if stiff",
    "dt_min_reached": "the acceleration is NaN or grows without bound: look for a singular mass matrix (a joint that "
    "moves no inertia) or a force or control that is not finite there; or constraints whose rows lose rank on the way, "
    "which fixed steps pass (stepsize=0.01); or rtol and atol are below the rounding error",
    "nonfinite_start": "give finite q0 and v0 and unit quaternions",
    "unnormalized_start": "start from jd.normalize(model, q0); quaternions are in the order w, x, y, z",
    "unordered_times": "give times ts that increase from each to the next",
    "bad_stepsize": "give a positive stepsize (s); for a sampled control, a whole part of its period",
    "bad_tolerance": "give finite rtol and atol that are not negative",
    "nonfinite_state": "take a smaller stepsize, lower the gains of a sampled control or its period, or look for a singular mass "
    "matrix or a force that is not finite",
    "coarse_steps": "take a smaller stepsize, or None for steps that keep a tolerance; if stiff, solver=jd.solvers.Rodas5P(); "
    "beyond some 1e5 steps, float64",
    "coarse_start": "subtract whole turns from q0, use float64, or take fixed steps",
    "singular_mass_matrix": "give massless bodies an inertia or their joints an armature, or start where every "
    "joint moves some inertia",
    "no_freedom": "leave a constraint out, or free a joint; rows that repeat others but for more than 1e-3 need a rank_tol, "
    "as in method=jd.Projected(rank_tol=1e-2)",
    "inconsistent_start": "start from jd.assemble(scene, q0, v0)",
    "bad_event": "give jd.events.Terminal a function that is above zero at the start",
    "singular_basis": "choose another basis: jd.Reduced() continues one automatically where the rank of the rows is constant; "
    "method='projected' needs none",
    "nonlinear_divergence": "take a smaller stepsize, or look for a singular mass matrix or a force that is not finite; where "
    "constraints lose rank on the way, as in a flat linkage, method='projected'",
    "contradictory_rows": "remove a constraint, or change one that moves with time, so that some motion satisfies all of them",
    "open_constraints": "take smaller steps (stepsize, or rtol and atol), or look for constraints that contradict each other "
    "on the way",
    "no_single_contact": "take surfaces that are more convex where they come to touch, or other starts",
    "contact_lost": "grip harder (jd.contact.optimal_forces finds forces within the cones, jd.grasp.internal_forces what "
    "squeezes), or pass events=[jd.events.ContactLost(stop=False)] to continue with two-sided contacts",
    "control_singular": "choose another task or target, or leave out the control's least_regularity to continue, with the task "
    "followed as closely as possible",
    "joint_limit_passed": "change the start or the control, or pass jd.events.JointLimit(stop=False) to continue",
    "too_many_events": "raise max_events of jd.events.ModeSwitches (now {max_events}); where events accumulate (a body that "
    "rocks to rest, friction that chatters) rigid bodies have no motion after that time: smooth the friction, or end before",
    "painleve_paradox": "rigid bodies have no answer here: lower the friction, or give the contact some compliance",
    "no_contact_mode": "lower the friction, or look for contacts that press against each other",
}


class Solution(Outcome):
    """A simulated motion; every row belongs to one save point. Rows not reached are NaN.

    - `ts` (nt,) in s, as given; `q` (nt, nq); `v` (nt, nv), body-fixed.
    - `result`, a `RESULTS` code; `success`, true if the motion was computed to its end or to a terminal event, by steps short
      enough; `solver`, the name of the method that was used.
    - `stats`: arrays `num_steps`, `num_accepted_steps`, `num_rejected_steps`, and `time_reached` (s).
    - The requested `outputs`, others None: `energy` (nt,), kinetic plus gravitational, J; `power` (nt,), of tau and the
      scene's forces, W; `work` (nt,), its integral from the start, J; `acceleration` (nt, nv); `multipliers`
      (nt, nc); `constraint_residual` (nt, 2), the largest |phi| and |A v - b|; `torque` (nt, nv), of the control, N m or N;
      `control_state`, rows of the controller's state, a pytree; `drive_state` (nt, n), of the scene's drives; `poses`,
      one array (nt, 4, 4) by name for each `jd.simulation.Pose` asked for; `contact_forces` (nt, m) and `contact_margins`
      (nt,), by the names of the contacts that have a cone, along the columns of `jd.contact.wrench_basis`, N and N m.
    - `events`, of a scene with friction that sticks or contacts that open: an `Events` with `time`, `index` and `name`, else
      None. Its `contact_forces` (nt, 3) are the two components of friction and the normal force, N.
    - If the rows of the constraints were not all found independent before the run, `stats["redundant_rows"]` is the number of
      rows that were dropped as redundant, and `stats["redundant_gap"]` the largest of their residuals, m or rad.
    - With `jd.events.JointLimit`, `stats["passed_limit"]` is the entry of q that was the first to pass one of its limits, or -1.
    - With cones, `stats["lost_contact"]` is the contact that ended the run, an index among those with a cone, or -1.
    - With `jd.events.Terminal`, `stats["terminal_event"]` is the index of the one that ended the run, or -1.
    """

    ts: Float[Array, " nt"]
    q: Float[Array, "nt nq"]
    v: Float[Array, "nt nv"]
    result: Any
    stats: dict[str, Array]
    energy: Float[Array, " nt"] | None = None
    power: Float[Array, " nt"] | None = None
    work: Float[Array, " nt"] | None = None
    acceleration: Float[Array, "nt nv"] | None = None
    multipliers: Float[Array, "nt nc"] | None = None
    constraint_residual: Float[Array, "nt 2"] | None = None
    torque: Float[Array, "nt nv"] | None = None
    control_state: Any = None
    drive_state: Float[Array, "nt n"] | None = None
    poses: dict[str, Float[Array, "nt 4 4"]] = eqx.field(default_factory=dict)
    contact_forces: dict[str, Float[Array, "nt m"]] = eqx.field(default_factory=dict)
    contact_margins: dict[str, Float[Array, " nt"]] = eqx.field(default_factory=dict)
    events: Any = None
    solver: str = eqx.field(static=True, default="")

    @property
    def success(self) -> Bool[Array, "..."]:
        """True where the motion was computed to its end, or to a `jd.events.Terminal`."""
        return (self.result == RESULTS.successful) | (self.result == RESULTS.event_occurred)

    def __str__(self) -> str:
        return solution_lines(self)

    def to_csv(self, path: FilePath, scene: SceneLike) -> None:
        """Write the motion as CSV: one row a save point, columns with names and units, every number at full precision.

        Columns are `t [s]`, then of each signal that there is: `q_JOINT [rad]`, `v_...`, `a_...` (acceleration), `tau_...`
        (torque), `multipliers_CONSTRAINT.1`, `energy [J]`, ... Where a joint has several numbers, all are counted, and the
        brackets name them too: `q1 [base.x; m]`. A batch has a first column `rollout`. Poses are left out.
        A motion with `torque` (`outputs=("torque",)`) is a log that `jaxdyn identify` and `jaxdyn simulate --torque` read.

        **Arguments:** `path`, a file .csv; `scene`: the scene or model that was simulated, which has the names.

        **Raises:** ValueError for another kind of file and for a scene that is not that of the solution.
        """
        write_csv(self, path, scene)

    def to_npz(self, path: FilePath, scene: SceneLike) -> None:
        """Write the motion as an archive of NumPy: arrays `t`, `q`, `v`, `a`, `tau`, `multipliers`, `energy`, `pose_FRAME`, ...

        Shapes are those of the solution, batched or not. `names` and `units` are JSON texts, by array: `json.loads(str(file
        ["names"]))["q"]`. With `torque` it is a log (see `to_csv`).

        **Arguments:** `path`, a file .npz; `scene` as in `to_csv`.

        **Raises:** ValueError for another kind of file and for a scene that is not that of the solution.
        """
        write_npz(self, path, scene)

    def to_xarray(self, scene: SceneLike) -> "xarray.Dataset":
        """Motion as an `xarray.Dataset` over `t` (s), with names as coordinates and units as attributes.

        **Arguments:** `scene` as in `to_csv`.

        **Raises:** ValueError for a scene that is not that of the solution. ImportError without xarray.
        """
        return as_xarray(self, scene)


def joint_of(model: Model, entry: int) -> str:
    """Name of the joint that an entry of q belongs to."""
    places = zip(model.topology.q_slices, model.joint_names, strict=True)
    return next(name for place, name in places if place.start <= entry < place.stop)


def raise_failure(solution: Solution, scene: Scene, control, options) -> None:
    """Raise RuntimeError with the time reached, the cause and the fix, if a concrete run failed."""
    name = name_of(solution.result)
    if name in ("successful", "event_occurred"):
        return
    reached, end = float(solution.stats["time_reached"]), float(solution.ts[-1])
    raise RuntimeError(
        f"simulate stopped at t = {reached:.6g} s of {end:.6g} s. {RESULTS[solution.result]} Fix: "
        f"{_advice(name, solution, scene, control, options)}. With throw=False, what was reached is returned."
    )


def _advice(name: str, solution: Solution, scene: Scene, control, options) -> str:
    advice = ADVICE.get(name, "try smaller steps, other tolerances, or another solver").format(**options._asdict())
    # The scene may have become stiff on the way, so that the choice of the solver at the start has not seen it. Fixed steps that
    # are too long leave the motion, so that only its start tells.
    if name in ("max_steps_reached", "nonfinite_state", "coarse_steps"):
        import diffrax

        from jaxdyn.simulation.solvers.choice import innermost, stiff_rates

        row = int(np.flatnonzero(np.isfinite(solution.q).all(1))[-1]) if name == "max_steps_reached" else 0
        state = solution.q[row], solution.v[row], solution.ts[row]
        span = float(solution.ts[-1]) - float(solution.ts[0])
        # Solvers by default are explicit.
        is_explicit = options.solver is None or isinstance(innermost(options.solver), diffrax.AbstractERK)
        rates = stiff_rates(scene, *state, at_start(control, *state), span) if is_explicit else None
        if rates is not None:
            advice = (
                f"the scene is stiff: the fastest decay is {float(rates.decay):.3g} 1/s, so explicit steps are unstable above "
                f"about {float(rates.explicit_step):.3g} s; pass solver=jd.solvers.Rodas5P(), else {advice}"
            )
    slides = any(isinstance(force, SlidingFriction) for force in scene.forces)
    if name in ("max_steps_reached", "too_many_events") and slides:
        dry = "where a contact with jd.forces.SlidingFriction comes to rest, take jd.contact.DryFriction, which sticks"
        return f"{dry}; else {advice}"
    if name == "contact_lost":
        contact = contacts_with_cones(scene)[int(solution.stats["lost_contact"])].name
        return f"the contact is {contact!r}; {advice}"
    if name == "joint_limit_passed":
        model: Any = scene.system
        return f"the joint is {joint_of(model, int(solution.stats['passed_limit']))!r}; {advice}"
    return advice


# --- solutions as files and tables: CSV and NPZ that `jd.identify` reads as logs, and xarray datasets ---


class Signal(NamedTuple):
    """One array of a solution: values (..., nt, columns) or (..., nt), the names of its columns (none of a single one), units."""

    key: str
    values: Any
    names: tuple[str, ...]
    units: tuple[str, ...]


def signals(solution: Solution, scene: SceneLike) -> list[Signal]:
    """Arrays of a solution that have one row for each save point, with names and units.

    **Raises:** ValueError when the scene is not that of the solution.
    """
    return [one._replace(values=np.asarray(one.values)) for one in signals_as_given(solution, scene)]


def signals_as_given(solution: Solution, scene: SceneLike) -> list[Signal]:
    """Signals with the values of the solution unconverted, so that it may be traced (see `signals`)."""
    scene = as_scene(scene)
    if np.shape(solution.q)[-1:] != (scene.nq,) or np.shape(solution.v)[-1:] != (scene.nv,):
        raise ValueError(
            f"solution has q {np.shape(solution.q)} and v {np.shape(solution.v)}, the scene nq = {scene.nq} and nv = "
            f"{scene.nv}; pass the scene that was simulated"
        )
    names = columns_of(scene.system)
    rows = tuple(f"{x.name}.{k - x.start + 1}" for x in layout(scene) for k in range(x.start, x.end))
    both = ("position", "velocity")
    columns = [
        ("q", solution.q, names.q, names.q_units),
        ("v", solution.v, names.v, names.v_units),
        ("a", solution.acceleration, names.v, names.a_units),
        ("tau", solution.torque, names.v, names.force_units),
        ("multipliers", solution.multipliers, rows, ("",) * len(rows)),
        ("constraint_residual", solution.constraint_residual, both, ("", "")),
        ("energy", solution.energy, (), ("J",)),
        ("power", solution.power, (), ("W",)),
        ("work", solution.work, (), ("J",)),
    ]
    for name, values in solution.contact_forces.items():
        parts = tuple(str(k + 1) for k in range(np.shape(values)[-1]))
        columns.append((f"contact_force_{name}", values, parts, ("",) * len(parts)))
    columns += [(f"contact_margin_{name}", values, (), ("",)) for name, values in solution.contact_margins.items()]
    return [Signal(key, x, tuple(n), tuple(u)) for key, x, n, u in columns if x is not None]


def times(solution: Solution) -> np.ndarray:
    """Save points (nt,). **Raises:** ValueError where those of a batch differ."""
    ts = np.asarray(solution.ts)
    ts = ts.reshape(-1, ts.shape[-1])
    if (ts != ts[0]).any():
        raise ValueError("solution.ts differs between the motions of the batch; write each of them separately")
    return ts[0]


def write_csv(solution: Solution, path: str | os.PathLike, scene: SceneLike) -> None:
    """Write a solution as CSV; see `Solution.to_csv`."""
    path = _check_path(path, ".csv")
    columns, ts = signals(solution, scene), times(solution)
    # Readers of logs expect joint names where each joint has one number, else the number of the column.
    named = columns[0].names == columns[1].names
    header, arrays = ["t [s]"], []
    for signal in columns:
        parts = signal.names or ("",)
        arrays.append(signal.values.reshape(-1, len(ts), len(parts)))
        for k, (name, unit) in enumerate(zip(parts, signal.units, strict=True)):
            if signal.key in ("q", "v", "a", "tau"):
                label, note = (f"{signal.key}_{name}", unit) if named else (f"{signal.key}{k + 1}", f"{name}; {unit}")
            else:
                label, note = f"{signal.key}_{name}" if name else signal.key, unit
            header.append(f"{label} [{note}]" if note else label)
    table = np.concatenate(arrays, axis=2)
    batched = np.ndim(solution.q) > 2
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow((["rollout"] if batched else []) + header)
        # `repr` gives the shortest text that reads back to the same number.
        for n, motion in enumerate(table):
            first = [str(n + 1)] if batched else []
            writer.writerows(first + [repr(float(x)) for x in (t, *row)] for t, row in zip(ts, motion, strict=True))


def write_npz(solution: Solution, path: str | os.PathLike, scene: SceneLike) -> None:
    """Write a solution as an archive of NumPy; see `Solution.to_npz`."""
    path = _check_path(path, ".npz")
    arrays: dict[str, Any] = {"t": times(solution)}
    units: dict[str, Any] = {"t": "s"}
    names: dict[str, list] = {}
    for signal in signals(solution, scene):
        arrays[signal.key] = signal.values
        units[signal.key] = list(signal.units) if signal.names else signal.units[0]
        names[signal.key] = list(signal.names)
    arrays |= {f"pose_{name}": np.asarray(pose) for name, pose in solution.poses.items()}
    texts: dict[str, Any] = {"names": np.array(json.dumps(names)), "units": np.array(json.dumps(units))}
    np.savez_compressed(path, **arrays, **texts)


def dimensions(signal: Signal) -> tuple[str, ...]:
    """Names of the axes of a signal behind those of a batch: time, and the kind of its columns."""
    axes = {"q": "coordinate", "v": "velocity", "a": "velocity", "tau": "velocity", "multipliers": "row"}
    return ("t", axes.get(signal.key, f"{signal.key}_part")) if signal.names else ("t",)


def as_xarray(solution: Solution, scene: SceneLike) -> Any:
    """Convert a solution to a dataset of xarray; see `Solution.to_xarray`."""
    try:
        import xarray
    except ImportError as error:
        raise ImportError("Solution.to_xarray needs xarray: pip install xarray") from error
    batch = tuple(f"batch{k}" for k in range(np.ndim(solution.q) - 2)) if np.ndim(solution.q) > 3 else ("rollout",)
    batch = batch if np.ndim(solution.q) > 2 else ()
    variables: dict[str, tuple] = {}
    coordinates: dict[str, tuple] = {"t": ("t", times(solution), {"units": "s"})}
    for signal in signals(solution, scene):
        if not signal.names:
            variables[signal.key] = ((*batch, "t"), signal.values, {"units": signal.units[0]})
            continue
        axes = dimensions(signal)
        coordinates[axes[-1]] = (axes[-1], list(signal.names))
        variables[signal.key] = ((*batch, *axes), signal.values, {"units": list(signal.units)})
    for name, pose in solution.poses.items():
        variables[f"pose_{name}"] = ((*batch, "t", "pose_row", "pose_column"), np.asarray(pose), {"units": "m"})
    return xarray.Dataset(variables, coordinates)


def _check_path(path, suffix: str):
    path = as_path(path)
    if path.suffix.lower() != suffix:
        raise ValueError(f"path is {str(path)!r}; write to a file {suffix}")
    if not path.parent.is_dir():
        raise ValueError(f"path is {str(path)!r}: there is no directory {path.parent}")
    return path
