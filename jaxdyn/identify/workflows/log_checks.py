"""Checks of logs before and after a fit: units, motor torques, joints that hardly move, errors at rest."""

from collections.abc import Sequence

import numpy as np

from jaxdyn.identify.logs import Log, are_angles, idle_coordinates, root_mean_square, travel_ranges
from jaxdyn.identify.regression import log_regressor, nominal_parameters
from jaxdyn.model.tree import Model

# Angles beyond this many turns, and torques this many times off what the nominal bodies need, are worth a question.
_TURNS, _OFF = 3.0, 20.0
# Below this share of its own largest velocity a joint has not begun to move; from this share of the error on it is worth a word.
_REST, _MUCH = 0.01, 0.5


def check_log_content(model: Model, log: Log, labels: Sequence[str]) -> list[str]:
    """Warnings about a log with v and a, none where it looks as expected; `labels` of each number of v.

    - Angles of revolute joints beyond three turns: degrees. Joints that turn without end ("continuous") may go there.
    - Torques that are less than a twentieth, or more than twenty times, of what the nominal bodies need, at most joints where
      these need a tenth of the largest: motor torques in front of the gears, or other units.
    - Joints that hardly move, whose friction and rotor inertia are not identifiable.
    """
    lines = []
    q = np.abs(np.asarray(log.q, np.float64))
    if model.nq == model.nv:
        is_revolute = np.array([kind == "revolute" for kind in model.topology.kinds])
        far = np.flatnonzero(is_revolute & (q.max(axis=0) > _TURNS * 2 * np.pi))
        if len(far):
            names = ", ".join(labels[int(i)] for i in far)
            lines.append(
                f"positions of {names} reach {q[:, far].max():.0f} rad, beyond three turns: are they in degrees?"
            )
    needed = root_mean_square(log_regressor(model, log) @ nominal_parameters(model))
    measured = root_mean_square(np.asarray(log.tau, np.float64))
    # Where the bodies need little torque, friction may be most of what is measured, and the ratio says nothing about units.
    compared = (needed > 0.1 * needed.max(initial=0)) & (measured > 0)
    ratio = measured[compared] / needed[compared]
    names = ", ".join(label for label, is_compared in zip(labels, compared, strict=True) if is_compared)
    # At most joints: a single one is a faulty sensor or body rather than a unit.
    if len(ratio) and np.mean(ratio < 1 / _OFF) > 0.5:
        lines.append(
            f"torques of {names} are about 1/{1 / np.median(ratio):.0f} of what the file's bodies need: are they motor torques, "
            "in front of the gears, or in another unit? Joint torques in N m are expected; multiply by the gear ratios"
        )
    elif len(ratio) and np.mean(ratio > _OFF) > 0.5:
        lines.append(
            f"torques of {names} are about {np.median(ratio):.0f} times what the file's bodies need: are they in N mm or in per "
            "cent? N m are expected"
        )
    travel = travel_ranges(model, log)
    slow = [
        f"{labels[j]} ({travel[j]:.2g} {'rad' if angle else 'm'})"
        for j, angle in enumerate(are_angles(model))
        if j in idle_coordinates(model, [log])
    ]
    if slow:
        lines.append(
            f"{', '.join(slow)} hardly moved: friction and rotor inertia there are not identifiable from this log; move these "
            "joints farther"
        )
    return lines


def check_rest(log: Log, residual: np.ndarray, labels: Sequence[str]) -> list[str]:
    """Warnings about joints whose errors (n, nv) are mostly those of a start at rest.

    A joint at rest is held by friction, whose torque is then anything within its level and depends on how the joint came to rest,
    which happened before the log. No term predicts it.
    """
    lines = []
    v, t = np.abs(np.asarray(log.v, np.float64)), np.asarray(log.t, np.float64)
    for j, label in enumerate(labels):
        moving = v[:, j] > _REST * v[:, j].max(initial=0)
        start = int(np.argmax(moving)) if moving.any() else 0
        total = float(np.sum(residual[:, j] ** 2))
        share = float(np.sum(residual[:start, j] ** 2)) / total if total > 0 else 0.0
        if start > 1 and share > _MUCH:
            lines.append(
                f"{label} stands still for the first {t[start] - t[0]:.2g} s, where {100 * share:.0f} % of the power of its "
                "error is: no term predicts friction at rest; cut the log there, or move before you record"
            )
    return lines
