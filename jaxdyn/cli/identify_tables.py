"""Tables printed by `jaxdyn identify`."""

from collections.abc import Sequence

import numpy as np

from jaxdyn.cli.common import short, table
from jaxdyn.constraints.codes import is_successful, name_of
from jaxdyn.identify import TERMS, Delays, DriveGains, LeastSquares, Log, Payload, RobotFit, nominal_parameters
from jaxdyn.identify.linear_fit import MechanismFit
from jaxdyn.identify.regression import free_columns
from jaxdyn.identify.selection import Choice
from jaxdyn.model.configuration import columns_of
from jaxdyn.model.tree import Model
from jaxdyn.reports.identification import Findings, model_joint, total_percent
from jaxdyn.systems.scene import Scene

# Sources of numbers (`Spread.sources`), as the tables explain them.
_SOURCES = {
    "data": "mostly the logs",
    "prior": "mostly the URDF's bodies, as the logs do not determine it",
    "bound": "held at zero, its least value",
    "confounded": "an extra term explains the same torque",
    "hardly moved": "the joint stood nearly still",
    "undetermined": "neither the logs nor the URDF determine it",
}
# Rows of base parameters on the screen, so that the output of an arm stays below sixty lines.
_BASE_ROWS = 16


def error_table(findings: Findings) -> str:
    """Torque errors in per cent: test data first, all joints together and each."""
    labels = columns_of(findings.model).v
    rows = []
    for kind, group in (("test", findings.tests), ("fitted", findings.train)):
        for one in group:
            each = [f"{x:.1f}" if np.isfinite(x) else "-" for x in one.percent_by_joint]
            rows.append([one.name, kind, f"{one.percent:.2f}", *each])
    text = (
        f"torque error: {total_percent(findings.tests):.2f} % on test data, {total_percent(findings.train):.2f} % on "
        f"training data; {total_percent(findings.tests, 'nominal'):.1f} % with the URDF's parameters\n"
    )
    text += "Torque error in per cent of the measured torque\n" + table(["log", "", "all", *labels], rows)
    if findings.is_refit:
        text += (
            f"\nThe written robot was then fitted to all samples: {total_percent(findings.final):.2f} % on them; the tables "
            "below are of that fit."
        )
    return text


def tables(findings: Findings) -> str:
    """Tables of joints and bodies, or of base parameters, and the chosen settings."""
    parts = [_joint_table(findings)]
    result, model = findings.result, findings.model
    parts.append(_identifiability_text(findings))
    if isinstance(result, LeastSquares):
        rows = [[name, short(x0), short(x), short(s, 2)] for name, x0, x, s in result.table()]
        header = ["combination", "URDF", "fitted", "std"]
        parts.append("Base parameters: URDF, fitted, standard deviation by blocks of samples\n" + table(header, rows))
        return "\n".join(parts)
    if isinstance(result, RobotFit):
        parts += [_choice_text(findings.choice or result.choice, model)]
        parts += [] if result.delays is None else [delays_text(result.delays, columns_of(model).v)]
        parts += _widening_text(result, columns_of(model).v)
        parts += [_robot_base_table(result, model)]
    parts.append(_mass_table(findings))
    return "\n".join(parts)


def _joint_table(findings: Findings) -> str:
    """Errors of each joint, and its friction and rotor inertia, with half-widths of the 95 % intervals where they are known."""
    labels, units = columns_of(findings.model).v, columns_of(findings.model).force_units
    first, result = findings.tests[0], findings.result
    measured = np.sqrt(np.mean(np.asarray(first.log.tau) ** 2, axis=0))
    columns = {("rotor inertia" if term == "armature" else term): (term, findings.friction[term]) for term in TERMS}
    half: dict[str, str] = {}
    if isinstance(result, RobotFit):
        for name, values in result.fit.extra.by_term.items() if result.fit.extra is not None else ():
            group = np.array(values).reshape(-1, findings.model.nv)
            # Parameters are named JOINT.termK without a space, columns of the table with one.
            columns |= {
                name if len(group) == 1 else f"{name} {k + 1}": (name if len(group) == 1 else f"{name}{k + 1}", row)
                for k, row in enumerate(group)
            }
        known, factor = result.intervals.parameters, result.intervals.factor
        for name, std, source in zip(known.names, known.std, known.sources, strict=True):
            half[name] = f" +- {factor * std:.2g}{' (prior)' * (source == 'prior')}" if np.isfinite(std) else ""
    rows = [
        [label, unit, short(float(measured[j]), 3), short(float(first.rms[j]), 3)]
        + [
            short(float(values[j]), 3) + half.get(f"{model_joint(findings.model, j)}.{term}", "")
            for term, values in columns.values()
        ]
        for j, (label, unit) in enumerate(zip(labels, units, strict=True))
    ]
    text = f"Joints: errors on {first.name}, friction and rotor inertia, with half-widths of 95 % intervals\n"
    return text + table(["joint", "unit", "torque rms", "error rms", *columns], rows)


def _identifiability_text(findings: Findings) -> str:
    """Identifiability of the parameters, and autocorrelation of the errors on the first test log."""
    labels = columns_of(findings.model).v
    first = findings.tests[0]
    lasting = ", ".join(
        f"{label} {short(float(x), 2)}" for label, x in zip(labels, first.whiteness.correlation_time, strict=True)
    )
    # The worst joint, because intervals depend on the number of independent errors.
    worst = round(float(first.whiteness.effective_samples.min()))
    return (
        f"Identifiability: {findings.identifiability.summary()}\n"
        f"Autocorrelation time of the errors on {first.name} (s): {lasting}\n"
        f"Effective sample size of {first.name}: at least {worst} of {len(first.log)}"
    )


def _choice_text(choice: Choice, model: Model) -> str:
    setting, labels = choice.setting, columns_of(model).v
    extra = "; ".join(f"{name} at {', '.join(labels[j] for j in joints)}" for name, joints in setting.extra) or "none"
    how = f", chosen over {len(choice.trials)} settings by cross-validation over {choice.by}"
    loss = "squares" if setting.robust is None else f"Huber's beyond {setting.robust:g}"
    return (
        f"v_s {setting.v_s:g}, prior {setting.prior:g}, loss {loss}, extra terms: {extra}{how if choice.trials else ''}"
    )


def _widening_text(result: RobotFit, labels) -> list[str]:
    """Lines on joints whose errors recur with the motion, and on the terms that these support."""
    cells = [f"{label} {x:.2g}" for label, x in zip(labels, result.intervals.widening, strict=True) if x > 1]
    # Noise in the regressor lowers the parameters (errors in variables), which leaves errors like those of a wrong model.
    lines = [
        f"Errors recur with the motion; intervals are wider by the factors {', '.join(cells)}. The model lacks something, or "
        "noise of the positions changes the fit: errors that are white at a lower --cutoff are such noise"
    ] if cells else []  # fmt: skip
    if omitted := result.intervals.omitted:
        terms = ", ".join(f"{name} at {labels[joint]}" for name, joint in omitted)
        lines.append(
            f"The logs support terms that the fit lacks: {terms}. The intervals include the fits with them (--terms)"
        )
    return lines


def delays_text(delays: Delays, labels) -> str:
    """Delays of the torques, in ms, with half-widths of the 95 % intervals of fitted ones."""
    half = 1e3 * delays.factor * delays.std
    cells = [
        f"{label} {1e3 * d:.1f}" + (f" +- {h:.1f}" if np.isfinite(h) and d else "")
        for label, d, h in zip(labels, delays.seconds, half, strict=True)
    ]
    none = "; zero where a delay lowers no error on held-out parts" if delays.squares is not None else ", as given"
    return f"Delays of the torques against the positions (ms): {', '.join(cells)}{none}"


def _robot_base_table(result: RobotFit, model: Model) -> str:
    base, combinations = result.intervals.base, result.intervals.combinations
    basic = tuple(term for term in result.fit.terms if term in TERMS)
    # The file's parameters in the same combinations, so that the columns compare.
    start = combinations.values(nominal_parameters(model)[free_columns(model.nb, model.nv, basic)])
    rows = [
        [name, short(x0), short(x), short(result.intervals.factor * s, 2), source]
        for name, x0, x, s, source in zip(base.names, start, base.values, base.std, base.sources, strict=True)
    ]
    text = "Base parameters: URDF, fitted, half-width of the 95 % interval, and source"
    if len(rows) > _BASE_ROWS:
        # The least certain ones, in their order; those at a bound have no interval.
        share = np.nan_to_num(base.std / np.maximum(np.abs(base.values), 1e-300), nan=0.0, posinf=1e300)
        rows = [rows[i] for i in sorted(np.argsort(-share, kind="stable")[:_BASE_ROWS])]
        text += f"; the {_BASE_ROWS} of {len(base.names)} with the widest interval for their size, all in the report"
    return "\n".join(
        [text, table(["combination", "URDF", "fitted", "+-", "from"], rows), _explain([row[-1] for row in rows])]
    )


def _explain(sources: Sequence[str]) -> str:
    """Line below a table on the sources in it."""
    return "  from " + "; ".join(f"{name}: {text}" for name, text in _SOURCES.items() if name in sources)


def _mass_table(findings: Findings) -> str:
    model = findings.model
    # Only fits of a robot know whether a mass comes from the data or from the prior.
    sources = {}
    if isinstance(findings.result, RobotFit):
        spread = findings.result.intervals.parameters
        sources = dict(zip(spread.names, spread.sources, strict=True))
    rows = []
    fitted = findings.parameters[: 10 * model.nb].reshape(-1, 10)
    for name, old, new in zip(model.body_names, np.asarray(model.inertias), fitted, strict=True):
        # Least-squares parameters may have a mass of zero or below.
        centre = [short(x, 3) for x in new[1:4] / new[0]] if new[0] > 0 else ["-"] * 3
        rows.append([name, short(old[0]), short(new[0]), sources.get(f"{name}.m", "-"), *centre])
    text = "Bodies: mass (kg) in the URDF and fitted, source, fitted centre of mass (m)"
    lines = [text, table(["body", "URDF", "fitted", "from", "x", "y", "z"], rows)]
    return "\n".join([*lines, _explain([row[3] for row in rows])] if sources else lines)


def gains_text(gains: DriveGains, labels) -> str:
    """Gains of the drives with half-widths of their 95 % intervals, and joints whose gain is not identifiable."""
    half = gains.factor * gains.std
    cells = ", ".join(
        f"{label} {short(float(g))} +- {short(float(h), 2)}"
        for label, g, h in zip(labels, gains.gains, half, strict=True)
    )
    rest = [label for label in labels if label not in gains.identifiable]
    line = f"Drive gains, torque = gain * logged value, from the known payload: {cells}" + _failure(gains.result)
    if rest:
        line += f"\nHardly identifiable from the payload, near the others' median: gains of {', '.join(rest)}"
    return line


def _failure(result) -> str:
    """Words about a fit that has not converged; empty for one that has."""
    return "" if is_successful(result) else f"\n  NOT CONVERGED: {name_of(result).replace('_', ' ')}"


def payload_text(payload: Payload) -> str:
    """Mass, centre of mass and inertia of the payload, with half-widths of the 95 % intervals."""
    half = payload.factor * payload.std
    numbers = [
        f"{name} {short(float(x))} +- {short(float(h), 2)}"
        for name, x, h in zip(("m", "mx", "my", "mz"), payload.inertia[:4], half[:4], strict=True)
    ]
    moments = ", ".join(short(float(x), 3) for x in np.linalg.eigvalsh(payload.rotational))
    centre = ", ".join(short(float(x), 3) for x in payload.centre)
    return (
        f"Payload on {payload.body}: torque error {payload.error:.2f} % with it, {payload.without:.2f} % without"
        f"{_failure(payload.result)}\n"
        f"  mass {short(payload.mass)} kg, centre ({centre}) m, principal moments {moments} kg m^2\n"
        f"  {', '.join(numbers)} (kg, kg m)"
    )


def mechanism_text(
    scene: Scene, judge: MechanismFit, final: MechanismFit, tests: dict[str, Log], train: dict[str, Log]
) -> str:
    """Errors, identifiability and base parameters of a mechanism with loops."""
    errors = [[name, "test", f"{judge.fit.error(log):.2f}"] for name, log in tests.items()]
    errors += [[name, "fitted", f"{judge.fit.error(log):.2f}"] for name, log in train.items()]
    rows = [
        [name, short(x0), short(x), short(final.factor * std, 2)]
        for name, x0, x, std in zip(final.base.names, final.nominal, final.values, final.std, strict=True)
    ]
    unseen = sorted({name.split(".")[0] for name in final.base.unidentifiable})
    lines = [
        "Torque error in per cent of the measured torque of the motors",
        table(["log", "", "all"], errors),
        f"feasible fit of {scene.system.name!r}, {len(final.fit.motors or ())} motors, {scene.nv} joints: "
        f"{name_of(final.fit.result).replace('_', ' ')}",
        f"Identifiability: the motors' torques determine {len(final.base)} combinations of "
        f"{len(final.base.parameter_names)} parameters, condition {final.condition:.4g}",
        *(f"least identifiable direction, relative singular value {d.strength:.2g}: {d.words}" for d in final.weakest),
    ]
    if unseen:
        lines.append(f"some numbers of {', '.join(unseen)} are in no combination; they stay near the file's")
    lines += [
        "Base parameters of the mechanism: first parameter of each combination, the file's, fitted, and half-width of the 95 % "
        "interval",
        table(["combination", "file", "fitted", "+-"], rows),
        "Every interval holds for itself, in 95 % of logs. Errors lie mostly along the least identifiable directions, which the "
        "combinations share: where one interval misses, most may",
    ]
    return "\n".join(lines)
