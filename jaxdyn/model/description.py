"""Text descriptions of models, scenes and solutions for `print`, without numbers that are traced or batched, and tables."""

from collections.abc import Sequence

import numpy as np

from jaxdyn.compile.known import is_concrete
from jaxdyn.model.arguments import state_dtype
from jaxdyn.model.topology import SCREW_KINDS


def tree_table(model) -> str:
    """Table with a line for each joint, indented by depth in the tree: body, kind, axis, mass, limits."""
    top = model.topology
    rows = [
        [
            "  " * (int(top.depths[i]) - 1) + top.body_names[i],
            top.joint_names[i],
            kind,
            _axis(model.screws, i, kind),
            _entry(model.inertias, (i, 0)),
            _limits(model, top.q_slices[i]),
        ]
        for i, kind in enumerate(top.kinds)
    ]
    head = f"Model {model.name!r}: {model.nb} bodies, nq = {model.nq}, nv = {model.nv}, {model.home.dtype}"
    if not rows:
        return head
    return f"{head}\n{table(['body', 'joint', 'kind', 'axis', 'mass kg', 'limits'], rows)}"


def system_line(system) -> str:
    """One line for a system; for a model, its tree."""
    if hasattr(system, "topology"):
        return tree_table(system)
    return f"{type(system).__name__}: nq = {system.nq}, nv = {system.nv}"


def scene_lines(scene) -> str:
    """Description of a scene: the system, each constraint with its numbers of rows, and the forces."""
    lines = [f"{type(scene).__name__} of {system_line(scene.system)}"]
    lines += [
        f"constraint {getattr(one, 'name', '')!r} ({type(one).__name__}): {_rows(one, scene.system)}"
        for one in scene.constraints
    ]
    return "\n".join([*lines, *(_force_line(force) for force in scene.forces)])


def _force_line(force) -> str:
    kind, name = type(force).__name__, getattr(force, "name", None)
    # A static wrapper shows the name of the function that it holds.
    return (
        f"force {name!r} ({kind})" if name else f"force {getattr(getattr(force, 'function', None), '__name__', kind)}"
    )


def _rows(constraint, system) -> str:
    try:
        holonomic, nonholonomic = constraint.sizes(system, state_dtype(system))
    # print must never fail: a constraint of the user that does not fit the system is reported in words instead.
    except Exception:
        return "does not fit the system"
    return ", ".join(
        f"{n} {kind} row{'s' * (n > 1)}" for n, kind in ((holonomic, "holonomic"), (nonholonomic, "nonholonomic")) if n
    )


def solution_lines(solution) -> str:
    """Outcome of a simulation and the outputs it holds."""
    t, count = solution.ts, solution.stats["num_steps"]
    # Under a batch there are several outcomes; only their count is shown.
    if not is_concrete(solution) or np.ndim(t) > 1 or np.ndim(count) > 0:
        ended = (
            "traced" if not is_concrete(solution) else f"{int(np.sum(solution.success))} of {np.size(count)} successful"
        )
        return f"Solution: {ended}; q {solution.q.shape}, v {solution.v.shape}; {solution.solver}"
    words = solution.result.message
    steps, rejected = int(count), int(solution.stats["num_rejected_steps"])
    given = [name for name in ("energy", "power", "work", "acceleration", "multipliers", "constraint_residual",
                          "torque", "control_state")
             if getattr(solution, name) is not None]  # fmt: skip
    more = [*given, *(f"pose:{name}" for name in solution.poses)]
    dropped, redundant = "", int(solution.stats.get("redundant_rows", 0))
    if redundant:
        rows, gap = f"row{'s' * (redundant > 1)}", short(float(solution.stats["redundant_gap"]))
        dropped = f"\n  dropped {redundant} redundant {rows} of the constraints, open by up to {gap} (m or rad)"
    return (
        f"Solution: {words}, t = {short(float(t[0]))} to {short(float(solution.stats['time_reached']))} s of "
        f"{short(float(t[-1]))} s\n  {solution.solver}: {steps} steps, {rejected} rejected\n"
        f"  {t.shape[0]} rows of q ({solution.q.shape[1]}), v ({solution.v.shape[1]})"
        f"{', ' if more else ''}{', '.join(more)}{dropped}"
    )


def _is_readable(leaf, ndim: int) -> bool:
    return is_concrete(leaf) and np.ndim(leaf) == ndim


def _entry(leaf, place) -> str:
    # A leaf with a batch axis or a tracer has no single number to print.
    return short(float(leaf[place])) if _is_readable(leaf, len(place)) else "?"


def _axis(screws, i: int, kind: str) -> str:
    """Direction of a joint with one degree of freedom in its body frame; the linear part of a prismatic one."""
    if kind not in SCREW_KINDS:
        return ""
    if not _is_readable(screws, 2):
        return "?"
    screw = np.asarray(screws)[i]
    axis = screw[:3] if kind == "prismatic" else screw[3:]
    # Adding 0.0 turns -0.0 into 0.0.
    return " ".join(short(float(x)) for x in np.round(axis, 6) + 0.0)


def _limits(model, place: slice) -> str:
    if not (_is_readable(model.lower, 1) and _is_readable(model.upper, 1)):
        return "?"
    low, high = np.asarray(model.lower)[place], np.asarray(model.upper)[place]
    if not (np.isfinite(low).any() or np.isfinite(high).any()):
        return ""
    return ", ".join(f"{short(float(a))} to {short(float(b))}" for a, b in zip(low, high, strict=True))


def table(header: Sequence[str], rows: Sequence[Sequence[str]], indent: str = "  ") -> str:
    """Columns aligned to the left where they hold words and to the right where they hold numbers."""
    rows = [[str(cell) for cell in row] for row in rows]
    columns = list(zip(header, *rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    numeric = [all(_is_number(cell) for cell in column[1:]) for column in columns]
    lines = []
    for row in ([*header], *rows):
        cells = [
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ]
        # Trailing spaces of a last left-aligned column would show in copied output.
        lines.append((indent + "  ".join(cells)).rstrip())
    return "\n".join(lines)


def short(value: float | None, digits: int = 4) -> str:
    """Format a number for a table; a dash stands for infinity (no limit) and for None."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}g}"


def _is_number(cell: str) -> bool:
    return cell in ("", "-") or cell.replace(".", "").replace("-", "").replace("+", "").replace("e", "").isdecimal()
