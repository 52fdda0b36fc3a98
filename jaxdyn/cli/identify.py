"""`jaxdyn identify`: inertias and friction of a URDF robot from recorded logs."""

import argparse
import json
import pathlib
from typing import Any, NamedTuple

import numpy as np

from jaxdyn import __version__, identify
from jaxdyn.cli.common import (
    Stopwatch,
    add_cluster_options,
    add_model_options,
    check_minimum,
    connect,
    load_for_repair,
    load_mechanism,
    load_model,
    option,
    output_path,
    real,
    whole,
)
from jaxdyn.cli.identify_options import (
    filter_log,
    find_gains,
    log_cutoff,
    log_names,
    log_paths,
    make_fit,
    parse_options,
    raw_log,
    resolve_options,
)
from jaxdyn.cli.identify_tables import error_table, gains_text, mechanism_text, payload_text, tables
from jaxdyn.constraints.codes import name_of
from jaxdyn.identify import EXTRA, TERMS, Fit, LeastSquares, Log, RobotFit
from jaxdyn.identify.descent import on_one_thread
from jaxdyn.identify.linear_fit import base_terms, fit_mechanism
from jaxdyn.identify.raw_logs import log_warnings, vibration
from jaxdyn.identify.regression import log_regressor
from jaxdyn.io import save_urdf
from jaxdyn.io.loaded import LoadedScene
from jaxdyn.io.urdf_write import write_text
from jaxdyn.model.configuration import columns_of
from jaxdyn.model.tree import Model, inertia_report, repair_inertias
from jaxdyn.reports.identification import Evaluation, Findings, content, gains_content, page, payload_content

# Fraction of the residual's power far above the motion's band that triggers a warning.
_VIBRATES = 0.3
HELP = "identify inertias, friction and rotor inertias from logs of positions and torques"
DESCRIPTION = """\
Identify link inertias, joint friction and rotor inertias from recorded logs of joint positions and torques.
The error is measured on separate logs (--test-log); without them the last part of every log is held out first, and the
written robot is then fitted to all samples.
"""
EPILOG = """\
examples:
  jaxdyn identify --urdf panda.urdf --log log.csv --out fitted.urdf
  jaxdyn identify --urdf arm.urdf --log A.csv B.csv --test-log C.csv --out fitted.urdf --html fit.html
  jaxdyn identify --urdf arm.urdf --log empty.csv --payload-log holding.csv --report fit.json
  jaxdyn identify @fit.txt          a file with lines of options: --urdf arm.urdf, --log A.csv B.csv, ...

logs (.csv with one header line, or .npz), in SI units:
  t                time, s, increasing; jitter is allowed
  q1, q2, ...      joint positions, rad or m, in the order of `jaxdyn info`
  tau1, tau2, ...  joint torques, N m or N: motor torques at the joint, friction not compensated
  v1.., a1..       velocities and accelerations, only of logs that are filtered already
  Names may replace numbers, in any order: q_panda_joint1, tau_panda_joint1, ...

The error is 100 |predicted - measured| / |measured| of the torques. Filtering, friction terms, drive gains,
methods and output files are described in docs/identification.md, section "The command line".
"""
METHODS = ("feasible", "least-squares", "trajectory")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command: those of daily use first, the rest as "advanced"."""
    # The generated usage would list all options, and a user needs two of them.
    parser.usage = "%(prog)s --urdf ROBOT.urdf --log FILE ... [options]"
    option(parser, "--urdf FILE", "robot; its geometry is fixed, its inertias are the prior")
    option(parser, "--log FILE ...", "training logs, .csv or .npz", action="extend")
    option(parser, "--test-log FILE ...", "test logs (default: the end of every log)", action="extend")
    option(parser, "--out FILE", "write the fitted robot, .urdf; also the report")
    option(parser, "--report FILE", "write parameters and errors, .json (default: next to --out)")
    option(parser, "--html FILE", "write a page with tables and plots, .html")
    option(parser, "--progress", "print trials and the loss while fitting")
    data, fit = (parser.add_argument_group(f"advanced: {part}") for part in ("data", "fit"))
    option(data, "--payload-log FILE ...", "logs of the same robot with a payload", action="extend")
    option(data, "--payload-body LINK", "link with the payload (default: the last)")
    option(data, "--payload-mass KG", "known payload mass: also fit drive gains", real)
    option(data, "--payload-centre X Y Z", "known centre of mass in LINK, m", real)
    option(data, "--rename NAME=JOINT ...", "names of joints in the logs", action="extend")
    option(data, "--train SHARE", "training share (default: 0.7)", real, 0.7)
    option(data, "--cutoff HZ", "low-pass frequency (default: auto, by spectra)", default="auto")
    option(data, "--every N", "keep one of N samples (default: 15 per period of --cutoff)", whole)
    option(data, "--trim N", "samples to drop at each end (default: 38 * --every)", whole)
    option(data, "--filtered", "the logs are filtered already")
    option(data, "--unwrap {auto,yes,no}", "angles that jump by turns (default: auto)", default="auto")
    option(data, "--outliers {refuse,drop,keep}", "corrupted samples (default: refuse)", default="refuse")
    option(fit, "--method M", f"{', '.join(METHODS)}", default="feasible", choices=METHODS)
    fit.add_argument(
        "--terms",
        nargs="*",
        choices=("auto", *TERMS, *EXTRA),
        metavar="TERM",
        help=f"auto, {', '.join((*TERMS, *EXTRA))}",
    )
    option(fit, "--v-s V", "smoothing of Coulomb friction, rad/s (default: auto)", default="auto")
    option(fit, "--prior W", "weight of the prior (default: auto)", default="auto")
    option(fit, "--weights {auto,none}", "of joints: auto, by residuals (default); none", default="auto")
    option(fit, "--robust K", "Huber threshold, or none (default: auto)", default="auto")
    option(fit, "--delay S ...", "torque delay: seconds, auto, none (default: none)", default=["none"])
    option(fit, "--horizon S", "of trajectory segments (default: 0.25)", real, 0.25)
    option(fit, "--steps N", "of the trajectory fit (default: 100)", whole, 100)
    add_cluster_options(fit)
    option(fit, "--repair", "replace unphysical and missing inertias first")
    add_model_options(parser, "advanced: model")


@on_one_thread
def run(args: argparse.Namespace) -> None:
    """Fit, print errors and parameters, write the files."""
    missing = [name for name, value in (("--urdf", args.urdf), ("--log", args.log)) if not value]
    if missing:
        raise ValueError(f"{' and '.join(missing)}: missing; give the robot's URDF file and at least one log")
    check_minimum(args, every=1, trim=0, steps=0)
    for name in ("payload_mass", "horizon"):
        # Negated, so that NaN is refused.
        if (value := getattr(args, name)) is not None and not value > 0:
            raise ValueError(f"--{name.replace('_', '-')} is {value}; give a positive number")
    # A file that needs repair cannot be loaded before it; the repair is for trees.
    mechanism = None if args.repair else load_mechanism(args.urdf, args)
    if mechanism is None:
        run_tree(args)
    else:
        run_mechanism(mechanism, args)


def run_tree(args: argparse.Namespace) -> None:
    """Fit, print errors and parameters, write the files, of a robot without loops."""
    # Paths and options are checked before logs are read, and before the fit, which takes minutes.
    out = output_path(args.out, (".urdf",), "--out")
    json_path = output_path(args.report, (".json",), "--report")
    html = output_path(args.html, (".html",), "--html")
    options = parse_options(args)
    _check_method(args)
    model = _load_tree(args)
    logs = _read_logs(model, options, args)
    watch = Stopwatch()
    findings = _fit_and_judge(model, logs, options, args)
    seconds, final = str(watch), findings.result
    # Least squares and the trajectory fit have no choice of settings around the fit.
    fit = final.fit if isinstance(final, RobotFit) else final
    labels, units = columns_of(model).v, columns_of(model).force_units
    # Gains first: every later number refers to scaled torques.
    lines = [] if logs.gains is None else [gains_text(logs.gains, labels)]
    lines += [error_table(findings)]
    lines += [f"{args.method} fit of {model.name!r}, {model.nv} joints: {findings.outcome}, in {seconds}"]
    lines += [*(f"warning: {line}" for line in findings.warnings), tables(findings)]
    text = "\n".join(lines)
    print(text)
    if out is not None and not isinstance(fit, LeastSquares):
        save_urdf(fit.model, out, torques=_extra_torques(fit))
        print(f"Wrote {out}.")
        # The report belongs to the robot that is written: it states the errors.
        json_path = json_path or out.with_suffix(".json")
    report = content(findings, _settings(args, logs.cutoff))
    if isinstance(final, RobotFit) and logs.loaded:
        # The robot's own parameters are those of the fit, so that only the payload is unknown.
        payload = identify.fit_payload(model, logs.train, logs.loaded, args.payload_body, robot=final)
        print(payload_text(payload))
        report["payload"] = payload_content(payload)
    if logs.gains is not None:
        report["drive_gains"] = gains_content(logs.gains)
    if json_path is not None:
        # Written atomically, as other programs may be reading the file.
        write_text(json_path, json.dumps(report, indent=2) + "\n")
        print(f"Wrote {json_path}.")
    if html is not None:
        # Needs matplotlib, an extra.
        write_text(html, page(findings, labels, units, f"jaxdyn identify: {model.name}", text))
        print(f"Wrote {html}.")


def _check_method(args) -> None:
    """Check that the method supports the other options."""
    if args.out is not None and args.method == "least-squares":
        raise ValueError("--out: least squares gives combinations of parameters and no bodies, so there is no URDF to "
                         "write; use --method feasible, or --report FILE.json")  # fmt: skip
    if args.method != "feasible" and (args.client, args.workers) != (None, None):
        raise ValueError(
            f"--client, --workers: workers share the fits of a cross-validation, which --method {args.method} does not have; "
            "use --method feasible"
        )
    if args.method == "trajectory" and len(args.log) > 1:
        raise ValueError("--log: --method trajectory fits one log; use --method feasible for several")
    if args.payload_log and args.method != "feasible":
        raise ValueError(f"--payload-log: --method {args.method} does not support payloads; use --method feasible")


def _load_tree(args) -> Model:
    """The robot, with its inertias repaired if that is wanted."""
    model, given = load_for_repair(args.urdf, args) if args.repair else (load_model(args.urdf, args), [])
    # Links that were merged into a body are frames, and a payload is identified for a body.
    if args.payload_body is not None and args.payload_body not in model.body_names:
        raise ValueError(f"--payload-body {args.payload_body}: the bodies are {', '.join(model.body_names)}")
    if args.repair:
        repaired = dict.fromkeys((*given, *dict(inertia_report(model))))
        print(f"repaired inertias: {', '.join(repaired) or 'none needed'}")
        model = repair_inertias(model)
    return model


class _Logs(NamedTuple):
    """Filtered logs in true torques: for training, for tests (none: the end of every log), and with a payload.

    `names`: of the training logs and the tests; `cutoff` (Hz) and `gains` of the drives, None where they were not needed.
    """

    train: list[Log]
    test: list[Log]
    loaded: list[Log]
    names: list[str]
    cutoff: float | None
    gains: identify.DriveGains | None


def _read_logs(model: Model, options, args) -> _Logs:
    train_paths, test_paths = log_paths(args)
    raws = [raw_log(model, path, args) for path in train_paths]

    def share(logs):
        # Held-out samples must not influence the choice of the cut-off, nor the gains.
        return logs if test_paths else [identify.split(log, args.train)[0] for log in logs]

    cutoff = log_cutoff(share(raws), args)
    train = [filter_log(raw, path, args, cutoff) for raw, path in zip(raws, train_paths, strict=True)]
    test, loaded = (
        [filter_log(raw_log(model, path, args), path, args, cutoff) for path in paths]
        for paths in (test_paths, args.payload_log)
    )
    gains = None
    if args.payload_mass is not None:
        gains = find_gains(model, share(train), loaded, options, args)
        train, test, loaded = ([gains.scale(log) for log in group] for group in (train, test, loaded))
    return _Logs(train, test, loaded, log_names(train_paths + test_paths), cutoff, gains)


def _fit_and_judge(model: Model, logs: _Logs, options, args) -> Findings:
    """Fit, and errors on samples that the fit which is judged has not seen."""
    names = logs.names[: len(logs.train)]
    if logs.test:
        # Separate test logs: one fit is both reported and written.
        trained, tests, test_names = logs.train, logs.test, logs.names[len(logs.train) :]
        with connect(args) as client:
            final = judge = make_fit(model, trained, options, args, client)
    else:
        trained, tests = (
            list(part) for part in zip(*(identify.split(log, args.train) for log in logs.train), strict=True)
        )
        test_names = [f"{name} (last {100 * (1 - args.train):.3g} %)" for name in names]
        # The errors that are reported come from this fit, which has not seen the held-out samples.
        with connect(args) as client:
            judge = make_fit(model, trained, options, args, client)
        # The settings chosen on the training part stay; the parameters are refitted to all samples.
        final = make_fit(model, logs.train, resolve_options(options, judge), args)
    fit = final.fit if isinstance(final, RobotFit) else final
    v_s = float(fit.v_s if isinstance(fit, LeastSquares) else fit.friction.v_s)
    findings = Findings(
        model=model,
        result=final,
        # Errors on held-out samples are of the fit without them; `final` has seen all.
        tests=_evaluate(model, judge, test_names, tests),
        train=_evaluate(model, judge, names, trained),
        final=_evaluate(model, final, names, logs.train),
        outcome=_outcome(fit),
        is_refit=not logs.test,
        warnings=[],
        identifiability=identify.identifiability(model, logs.train, base_terms(fit.terms), v_s=v_s),
        choice=judge.choice if isinstance(judge, RobotFit) else None,
    )
    # The warnings are derived from the other fields, so the list is filled afterwards.
    findings.warnings.extend(_warnings(findings))
    return findings


def _extra_torques(fit: Fit) -> dict[str, dict[str, float]]:
    """Torque parameters that URDF lacks, of joints with one coordinate: offsets, smoothing velocity, extra terms."""
    model = fit.model
    named: dict[str, Any] = {"offset": fit.friction.offset, "v_s": np.full(model.nv, float(fit.friction.v_s))}
    if fit.extra is not None:
        for name, values in fit.extra.by_term.items():
            # A term may have several numbers for each joint, stored one after the other.
            group = np.array(values).reshape(-1, model.nv)
            named |= {f"{name}{k + 1 if len(group) > 1 else ''}": row for k, row in enumerate(group)}
    places = {
        name: where.start
        for name, where in zip(model.joint_names, model.topology.v_slices, strict=True)
        # URDF joints of several coordinates have no place for a number of each.
        if where.stop - where.start == 1
    }
    return {
        # Zero terms are left out; offset and v_s are always needed to reproduce the torques.
        joint: {name: float(row[place]) for name, row in named.items() if name in ("offset", "v_s") or row[place]}
        for joint, place in places.items()
    }


def _settings(args, cutoff: float | None) -> dict[str, Any]:
    return {
        "jaxdyn": __version__,
        "urdf": str(pathlib.Path(args.urdf)),
        "logs": [str(pathlib.Path(path)) for path in args.log],
        "method": args.method,
        "cutoff_hz": cutoff,
    }


def _outcome(fit: Fit | LeastSquares) -> str:
    if isinstance(fit, LeastSquares):
        return f"{len(fit.values)} base parameters, {fit.rank} excited, condition {fit.condition:.4g}"
    return f"{name_of(fit.result).replace('_', ' ')} after {len(fit.history) - 1} steps"


def _evaluate(model: Model, result, names: list[str], logs: list[Log]) -> list[Evaluation]:
    nominal = identify.nominal_parameters(model)
    fit = result.fit if isinstance(result, RobotFit) else result
    # Delays are removed from the torques, as they were for the fit.
    logs = [result.align(log) for log in logs] if isinstance(result, RobotFit) else logs
    return [
        Evaluation(name, log, fit.torques(log), log_regressor(model, log) @ nominal)
        for name, log in zip(names, logs, strict=True)
    ]


def _warnings(findings: Findings) -> list[str]:
    lines = []
    # After a refit the held-out parts are among the training logs already.
    for one in (*findings.final, *(findings.tests if not findings.is_refit else ())):
        residual = one.predicted - np.asarray(one.log.tau)
        lines += [f"{one.name}: {line}" for line in log_warnings(findings.model, one.log, residual)]
        # Vibration above the cut-off has been filtered out and needs no advice.
        share, edge = vibration(one.log, residual)
        if share > _VIBRATES and (one.log.cutoff is None or edge < one.log.cutoff):
            fix = f"low-pass it at {edge:.2g} Hz" if one.log.cutoff is None else f"try --cutoff {edge:.2g}"
            lines.append(
                f"{one.name}: {100 * share:.0f} % of the residual's power is above {edge:.2g} Hz, ten times "
                f"the band of the motion, beyond rigid-body dynamics: vibration; {fix}"
            )
    return lines


# --- mechanisms with loops, from logs of their motors alone ---


# Configurations between the one of the file and the first sample, so that the loops stay on their branch.
_APPROACH = 50


def run_mechanism(scene: LoadedScene, args) -> None:
    """Fit, print errors and combinations of parameters, write the report."""
    unsupported = {
        "--out": args.out,
        "--html": args.html,
        "--payload-log": args.payload_log,
        "--repair": args.repair,
        "--method": args.method if args.method != "feasible" else None,
        "--delay": args.delay if args.delay != ["none"] else None,
        "--robust": args.robust if args.robust != "auto" else None,
    }
    if given := [name for name, value in unsupported.items() if value]:
        raise ValueError(f"{', '.join(given)}: not for a mechanism with loops, {pathlib.Path(args.urdf).name}; omit it")
    json_path = output_path(args.report, (".json",), "--report")
    terms = TERMS if args.terms in (None, ["auto"]) else tuple(args.terms)
    v_s, prior = (x if value == "auto" else float(value) for value, x in ((args.v_s, 0.01), (args.prior, 1.0)))
    train_paths, test_paths = log_paths(args)
    names = log_names(train_paths + test_paths)
    raws = [raw_log(scene.system, path, args, motors=True) for path in train_paths + test_paths]
    motors = raws[0].joint_names or ()
    cutoff = log_cutoff(raws[: len(train_paths)], args)
    logs = [
        _complete(scene, filter_log(raw, path, args, cutoff), motors, path)
        for raw, path in zip(raws, train_paths + test_paths, strict=True)
    ]
    train, test = logs[: len(train_paths)], logs[len(train_paths) :]
    if not test:
        train, test = (list(part) for part in zip(*(identify.split(log, args.train) for log in logs), strict=True))
    judge = fit_mechanism(scene, train, motors, terms, v_s=v_s, prior=prior)
    final = judge if test_paths else fit_mechanism(scene, logs, motors, terms, v_s=v_s, prior=prior)
    tested = names[len(train_paths) :] or [f"{name} (last {100 * (1 - args.train):.3g} %)" for name in names]
    print(
        mechanism_text(scene, judge, final, dict(zip(tested, test, strict=True)), dict(zip(names, train, strict=False)))
    )
    if json_path is not None:
        report = {
            "file": str(args.urdf),
            "motors": list(motors),
            "outcome": name_of(final.fit.result),
            "test_percent": {name: judge.fit.error(log) for name, log in zip(tested, test, strict=True)},
            "condition": final.condition,
            "weakest": [direction._asdict() for direction in final.weakest],
            "interval_factor": final.factor,
            "base_parameters": {
                "expressions": list(final.base.expressions),
                "nominal": final.nominal.tolist(),
                "fitted": final.values.tolist(),
                "std": [float(x) if np.isfinite(x) else None for x in final.std],
            },
            "parameters": dict(zip(final.fit.names, final.fit.values.tolist(), strict=True)),
        }
        write_text(json_path, json.dumps(report, indent=2) + "\n")
        print(f"Wrote {json_path}.")


def _complete(scene: LoadedScene, log: Log, motors: tuple[str, ...], path: str) -> Log:
    """Log of all joints, from those of the motors and the loops, on the branch of the file's placement."""
    model, start = scene.system, scene.starts["reference"].q
    places = [model.q_index(name) for name in motors]
    t, q, v, a = (np.asarray(x, np.float64) for x in (log.t, log.q, log.v, log.a))
    approach = np.linspace(np.asarray(start)[places], q[0], _APPROACH, endpoint=False)
    # The approach is a motion without velocity before the log, by whole seconds.
    before = np.arange(-_APPROACH, 0) + t[0]
    rest, tau = np.zeros_like(approach), np.zeros((_APPROACH + len(log), model.nv))
    tau[_APPROACH:, [model.v_index(name) for name in motors]] = log.tau
    joined = [np.concatenate(pair) for pair in ((approach, q), (rest, v), (rest, a))]
    measured = {name: tuple(x[:, i] for x in joined) for i, name in enumerate(motors)}
    try:
        whole = identify.complete_log(scene, np.concatenate([before, t]), measured, tau, start)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return whole[_APPROACH:]
