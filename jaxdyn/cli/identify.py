"""`jaxdyn identify`: inertias and friction of a URDF robot from recorded logs."""

import argparse
import json
import pathlib
from typing import Any

import numpy as np

from jaxdyn import __version__, identify
from jaxdyn.cli.common import (
    Stopwatch,
    add_model_options,
    check_least,
    coordinate_labels,
    load_model,
    output_path,
    real,
    whole,
)
from jaxdyn.cli.identify_file import with_file
from jaxdyn.cli.identify_logs import filtered_log, log_cutoff, log_names, log_paths, raw_log
from jaxdyn.cli.identify_options import find_gains, make_fit, parse_options, settled
from jaxdyn.cli.identify_tables import gains_text, judged_table, payload_text, tables
from jaxdyn.cli.repair import load_for_repair
from jaxdyn.identify import EXTRA, TERMS, Fit, LeastSquares, Log, RobotFit
from jaxdyn.identify.identifiability import base_terms
from jaxdyn.identify.regression import log_regressor
from jaxdyn.identify.spectra import vibration
from jaxdyn.identify.suspicions import at_rest, suspicions
from jaxdyn.identify.threads import on_one_thread
from jaxdyn.io import save_urdf
from jaxdyn.io.files import write_text
from jaxdyn.model.builder import inertia_report, repair_inertias
from jaxdyn.model.tree import Model
from jaxdyn.reports.identification import Findings, Judged, content, gains_content, payload_content

# Share of the residual's power far above the motion from which on it is worth a warning.
_VIBRATES = 0.3
HELP = "identify inertias, friction and rotor inertias from logs of positions and torques"
DESCRIPTION = """\
Identify link inertias, joint friction and rotor inertias from recorded logs of joint positions and torques.
How good the fit is, is told on logs kept apart (--test-log); without them the last part of every log is held out first, and the
robot that is written is fitted to everything.
"""
EPILOG = """\
examples:
  jaxdyn identify fit.toml          urdf = "arm.urdf", log = ["A.csv", "B.csv"], test-log = ["C.csv"], out = "fitted.urdf", ...
  jaxdyn identify --urdf panda.urdf --log log.csv --out fitted.urdf
  jaxdyn identify --urdf arm.urdf --log A.csv B.csv --test-log C.csv --out fitted.urdf --report fit.json --html fit.html
  jaxdyn identify --urdf panda.urdf --log log.csv --lock panda_finger_joint1 panda_finger_joint2 --plot fit.png
  jaxdyn identify --urdf arm.urdf --log empty.csv --payload-log holding.csv --report fit.json
  jaxdyn identify --urdf arm.urdf --log empty.csv --payload-log holding.csv --payload-mass 2.8 --payload-centre 0 0 0.05
  jaxdyn identify --urdf panda.urdf --log log.csv --method least-squares --report base_parameters.json

logs (--log FILE.csv ..., --test-log FILE.csv ..., one header line, or FILE.npz):
  t                time, s, increasing; jitter is allowed
  q1, q2, ...      joint positions, rad or m, in the order that `jaxdyn info` lists
  tau1, tau2, ...  joint torques, N m or N: motor torques seen at the joint, friction not compensated
  v1.., a1..       velocities and accelerations; only used if the log is filtered already (below)
  Joint names may stand for numbers, in any order: q_panda_joint1, tau_panda_joint1, ...
  Logs may differ in sampling and length; each is filtered and differentiated by itself.

filtering:
  A raw log (no columns a1..) is put on a uniform grid, low-passed without delay at --cutoff, and differentiated:
  v and a are made from q. --cutoff auto takes ten times the band that holds 99 % of the velocity's power, or less where
  a joint's torque vibrates below that, down to five times; all logs get the same. A warning says when what a fit leaves
  over lies far above the motion. A log with columns a1.. is taken as filtered and used as it is. With --filtered so is
  one without them, and v and a that are missing are made by differences.

terms (--terms), beside the links:
  viscous v + coulomb tanh(v / v_s) + offset + armature a (rotor inertia), and
  load |tau_rigid| tanh(v / v_s); dahl, pre-sliding; asymmetric |v|; quadratic v |v|; spring sin q, cos q.
  "auto" takes the first four, and of the others what lowers the error on parts of the training logs that are left out in
  turn, joint by joint. --v-s, --prior and --robust auto are chosen the same way. The test logs are never looked at.

drives (--payload-mass, --payload-centre):
  With a payload that is known, columns tau1.. may be currents, or torques under gains that are not sure. The gain of each
  drive, torque = gain * column, comes from the torque that the payload adds; all else is then fitted to scaled logs.

methods (--method):
  feasible         convex fit of the torques over all physically possible bodies; the URDF written is sound (default)
  least-squares    the classical fit of base parameters with standard deviations; no URDF, as no body may have them
  trajectory       the feasible fit, then refined by simulating pieces of the log and comparing the motion; slow

output:
  --out            URDF with the fitted inertias, damping, friction and armature (rotor inertia, an attribute of
                   <dynamics>), fitted to all of the training logs. Base parameters are what the logs tell; where they leave a
                   choice between links, the URDF stays close to the file given. Offsets and the other terms, which URDF has
                   no place for, stand in an element <jaxdyn> that other readers pass over, and in the report.
  --report         everything in numbers as JSON (default: beside --out, with the ending .json)
  --html           the same as a page with plots, in one file
  The error is 100 |predicted - measured| / |measured| of the torques, over all samples, and all joints or each.
"""
METHODS = ("feasible", "least-squares", "trajectory")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "file", nargs="?", metavar="FIT.toml", help="options in a file, under their names without dashes"
    )
    parser.add_argument("--urdf", help="the robot; its geometry is taken as right, its inertias as a guess")
    parser.add_argument(
        "--log", default=[], nargs="+", action="extend", metavar="FILE", help="recorded logs to fit, .csv or .npz"
    )
    parser.add_argument(
        "--test-log", nargs="+", action="extend", default=[], metavar="FILE", help="logs that only tell the error"
    )
    parser.add_argument(
        "--payload-log",
        nargs="+",
        action="extend",
        default=[],
        metavar="FILE",
        help="logs of the same robot with something in its hand, which is then told apart from it",
    )
    parser.add_argument("--payload-body", metavar="LINK", help="the link that holds it (default: the last one)")
    parser.add_argument(
        "--payload-mass",
        type=real,
        metavar="KG",
        help="its mass, where known: the gains of the drives are then found too",
    )
    parser.add_argument(
        "--payload-centre",
        nargs=3,
        type=real,
        metavar=("X", "Y", "Z"),
        help="its centre of mass in the link's frame, m",
    )
    parser.add_argument(
        "--rename",
        nargs="+",
        action="extend",
        default=[],
        metavar="FILE_NAME=JOINT",
        help="joints whose columns have other names in the logs",
    )
    add_model_options(parser)
    parser.add_argument(
        "--repair", action="store_true", help="replace inertias that no body can have, or none at all, before fitting"
    )
    data = parser.add_argument_group("data")
    data.add_argument(
        "--train",
        type=real,
        default=0.7,
        metavar="SHARE",
        help="without --test-log: share of every log that is fitted to tell the error on the rest (default: 0.7)",
    )
    data.add_argument(
        "--cutoff",
        default="auto",
        metavar="HZ",
        help="of the low-pass filter; auto, from the spectra of --log (default)",
    )
    data.add_argument(
        "--every", type=whole, metavar="N", help="keep one of N filtered samples (default: 15 per cut-off period)"
    )
    data.add_argument("--trim", type=whole, metavar="N", help="samples to drop at each end (default: 25 times --every)")
    data.add_argument("--filtered", action="store_true", help="the logs are filtered already")
    fit = parser.add_argument_group("fit")
    fit.add_argument("--method", choices=METHODS, default="feasible", help="see below (default: feasible)")
    fit.add_argument(
        "--terms",
        nargs="*",
        choices=("auto", *TERMS, *EXTRA),
        help="see below (default: auto; the first four with other methods than feasible)",
    )
    fit.add_argument(
        "--v-s",
        default="auto",
        metavar="V",
        help="v_s of Coulomb friction, rad/s, or auto (default: auto; 0.01 with other methods than feasible)",
    )
    fit.add_argument(
        "--prior", default="auto", metavar="W", help="weight of staying close to the URDF's bodies, or auto (default)"
    )
    fit.add_argument(
        "--weights",
        choices=("auto", "none"),
        default="auto",
        help="of the joints: auto, one over the error each is left with; none, all the same (default: auto)",
    )
    fit.add_argument(
        "--robust",
        default="auto",
        metavar="K",
        help="errors beyond K standard deviations count by their size, not its square: a number, none, or auto (default)",
    )
    fit.add_argument(
        "--delay",
        nargs="+",
        default=["none"],
        metavar="S",
        help="how late torques were recorded against positions: auto, found with the fit; seconds, one number or one for each "
        "torque; or none (default)",
    )
    fit.add_argument(
        "--horizon", type=real, default=0.25, metavar="S", help="length of the simulated pieces, s (default: 0.25)"
    )
    fit.add_argument(
        "--steps", type=whole, default=100, metavar="N", help="most steps of the trajectory fit (default: 100)"
    )
    files = parser.add_argument_group("output")
    files.add_argument("--out", metavar="FILE.urdf", help="write the fitted robot")
    files.add_argument("--report", metavar="FILE.json", help="write parameters and errors")
    files.add_argument("--html", metavar="FILE.html", help="write a page with tables and plots")
    files.add_argument("--plot", metavar="FILE", help="draw measured and predicted torques to FILE.png, .pdf or .svg")
    files.add_argument("--progress", action="store_true", help="print what is tried, and the loss, while fitting")


@on_one_thread
def run(args: argparse.Namespace) -> None:
    """Fit, print the errors and the parameters, write the files."""
    args = with_file(args, add_arguments)
    missing = [name for name, value in (("--urdf", args.urdf), ("--log", args.log)) if not value]
    if missing:
        raise ValueError(
            f"{' and '.join(missing)}: missing; give the robot's URDF file and at least one log, or a file fit.toml"
        )
    check_least(args, every=1, trim=0, steps=0)
    for name in ("payload_mass", "horizon"):
        if (value := getattr(args, name)) is not None and not value > 0:
            raise ValueError(f"--{name.replace('_', '-')} is {value}; give a positive number")
    out = output_path(args.out, (".urdf",), "--out")
    json_path = output_path(args.report, (".json",), "--report")
    html = output_path(args.html, (".html",), "--html")
    plot = output_path(args.plot, (".png", ".pdf", ".svg"), "--plot")
    options = parse_options(args)
    if out is not None and args.method == "least-squares":
        raise ValueError("--out: least squares gives combinations of parameters and no bodies, so there is no URDF to "
                         "write; take --method feasible, or --report FILE.json")  # fmt: skip
    json_path = out.with_suffix(".json") if json_path is None and out is not None else json_path
    train_paths, test_paths = log_paths(args)
    if args.method == "trajectory" and len(train_paths) > 1:
        raise ValueError("--log: --method trajectory fits one log; take --method feasible for several")
    if args.payload_log and args.method != "feasible":
        raise ValueError(f"--payload-log: --method {args.method} knows no payload; take --method feasible")
    model, given = load_for_repair(args.urdf, args) if args.repair else (load_model(args.urdf, args), [])
    if args.payload_body is not None and args.payload_body not in model.body_names:
        raise ValueError(f"--payload-body {args.payload_body}: the bodies are {', '.join(model.body_names)}")
    if args.repair:
        repaired = dict.fromkeys((*given, *dict(inertia_report(model))))
        print(f"repaired inertias: {', '.join(repaired) or 'none needed it'}")
        model = repair_inertias(model)
    raws = [raw_log(model, path, args) for path in train_paths]
    # What is held out has no say.
    cutoff = log_cutoff(raws if test_paths else [identify.split(raw, args.train)[0] for raw in raws], args)
    logs = [filtered_log(raw, path, args, cutoff) for raw, path in zip(raws, train_paths, strict=True)]
    names = log_names(train_paths + test_paths)

    gains, loaded = None, [filtered_log(raw_log(model, path, args), path, args, cutoff) for path in args.payload_log]
    if args.payload_mass is not None:
        empty = logs if test_paths else [identify.split(log, args.train)[0] for log in logs]
        gains = find_gains(model, empty, loaded, options, args)
        logs, loaded = ([gains.scaled(log) for log in group] for group in (logs, loaded))

    watch = Stopwatch()
    if test_paths:
        final = judge = make_fit(model, logs, options, args)
        tests = [filtered_log(raw_log(model, path, args), path, args, cutoff) for path in test_paths]
        tests = tests if gains is None else [gains.scaled(log) for log in tests]
        test_names, trained = names[len(logs) :], logs
    else:
        trained, tests = (list(part) for part in zip(*(identify.split(log, args.train) for log in logs), strict=True))
        test_names = [f"{name} (last {100 * (1 - args.train):.3g} %)" for name in names]
        judge = make_fit(model, trained, options, args)
        # What was chosen on the training part stays; the numbers are those of everything.
        final = make_fit(model, logs, settled(options, judge), args)
    seconds = str(watch)
    fit = final.fit if isinstance(final, RobotFit) else final
    v_s = float(fit.v_s if isinstance(fit, LeastSquares) else fit.friction.v_s)
    findings = Findings(
        model=model,
        result=final,
        tests=_judged(model, judge, test_names, tests),
        train=_judged(model, judge, names[: len(logs)], trained),
        final=_judged(model, final, names[: len(logs)], logs),
        outcome=_outcome(final),
        is_refit=not test_paths,
        warnings=[],
        told=identify.identifiability(model, logs, base_terms(fit.terms), v_s=v_s),
        choice=judge.choice if isinstance(judge, RobotFit) else None,
    )
    findings.warnings.extend(_warnings(findings))
    if gains is not None:
        print(gains_text(gains, coordinate_labels(model)[0]))
    print(judged_table(findings))
    print(f"{args.method} fit of {model.name!r}, {model.nv} joints: {findings.outcome}, in {seconds}")
    for line in findings.warnings:
        print(f"warning: {line}")
    print(tables(findings))
    if out is not None and not isinstance(final, LeastSquares):
        save_urdf((final.fit if isinstance(final, RobotFit) else final).model, out, torques=_torques_beside(final))
        print(f"Wrote {out}.")
    payload = None
    if isinstance(final, RobotFit) and args.payload_log:
        payload = identify.fit_payload(model, logs, loaded, args.payload_body, robot=final)
        print(payload_text(payload))
    if json_path is not None:
        report = content(findings, _asked(args, cutoff)) | (
            {} if payload is None else {"payload": payload_content(payload)}
        )
        report |= {} if gains is None else {"drive_gains": gains_content(gains)}
        write_text(json_path, json.dumps(report, indent=2) + "\n")
        print(f"Wrote {json_path}.")
    if html is not None:
        from jaxdyn.reports.identification_page import page

        labels, units = coordinate_labels(model)
        lines = [] if gains is None else gains_text(gains, labels).split("\n")
        write_text(html, page(findings, labels, units, f"jaxdyn identify: {model.name}", lines))
        print(f"Wrote {html}.")
    if plot is not None:
        from jaxdyn.reports.plotting import torque_figure

        labels, units = coordinate_labels(model)
        first = findings.tests[0]
        torque_figure(first.log, first.predicted, labels, units, title=first.name).savefig(plot)
        print(f"Wrote {plot}.")


def _torques_beside(result: RobotFit | Fit) -> dict[str, dict[str, float]]:
    """Of joints with one coordinate: offsets, the smoothing velocity, coefficients of extra terms."""
    fit = result.fit if isinstance(result, RobotFit) else result
    model = fit.model
    named: dict[str, Any] = {"offset": fit.friction.offset, "v_s": np.full(model.nv, float(fit.friction.v_s))}
    if fit.extra is not None:
        for name, values in fit.extra.named.items():
            group = np.array(values).reshape(-1, model.nv)
            named |= {f"{name}{k + 1 if len(group) > 1 else ''}": row for k, row in enumerate(group)}
    places = {
        name: where.start
        for name, where in zip(model.joint_names, model.topology.v_slices, strict=True)
        if where.stop - where.start == 1
    }
    return {
        joint: {name: float(row[place]) for name, row in named.items() if name in ("offset", "v_s") or row[place]}
        for joint, place in places.items()
    }


def _asked(args, cutoff: float | None) -> dict[str, Any]:
    return {
        "jaxdyn": __version__,
        "urdf": str(pathlib.Path(args.urdf)),
        "logs": [str(pathlib.Path(path)) for path in args.log],
        "method": args.method,
        "cutoff_hz": cutoff,
    }


def _outcome(result: RobotFit | Fit | LeastSquares) -> str:
    if isinstance(result, LeastSquares):
        return f"{len(result.values)} base parameters, {result.rank} excited, condition {result.condition:.4g}"
    fit = result.fit if isinstance(result, RobotFit) else result
    return f"{fit.result.replace('_', ' ')} after {len(fit.history) - 1} steps"


def _judged(model: Model, result, names: list[str], logs: list[Log]) -> list[Judged]:
    nominal = identify.nominal_parameters(model)
    fit = result.fit if isinstance(result, RobotFit) else result
    logs = [result.aligned(log) for log in logs] if isinstance(result, RobotFit) else logs
    return [
        Judged(name, log, fit.torques(log), log_regressor(model, log) @ nominal)
        for name, log in zip(names, logs, strict=True)
    ]


def _warnings(findings: Findings) -> list[str]:
    lines = []
    labels, _ = coordinate_labels(findings.model)
    for one in (*findings.final, *(findings.tests if not findings.is_refit else ())):
        lines += [f"{one.name}: {line}" for line in suspicions(findings.model, one.log, labels)]
        lines += [f"{one.name}: {line}" for line in at_rest(one.log, one.predicted - np.asarray(one.log.tau), labels)]
        share, edge = vibration(one.log, one.predicted - np.asarray(one.log.tau))
        if share > _VIBRATES and (one.log.cutoff is None or edge < one.log.cutoff):
            mend = f"low-pass it at {edge:.2g} Hz" if one.log.cutoff is None else f"try --cutoff {edge:.2g}"
            lines.append(
                f"{one.name}: {100 * share:.0f} % of the power of what the fit leaves over is above {edge:.2g} Hz, ten times "
                f"the fastest motion, where no rigid body is: vibration; {mend}"
            )
    return lines
