"""`jaxdyn identify`: inertias and friction of a URDF robot from a recorded log."""

import argparse
import json
import math
import pathlib
from typing import Any

import numpy as np

from jaxdyn import __version__, identify
from jaxdyn.cli.common import (
    Stopwatch,
    add_model_options,
    coordinate_labels,
    load_model,
    output_path,
    short,
    table,
)
from jaxdyn.identify import Fit, LeastSquares, Log
from jaxdyn.io import save_urdf
from jaxdyn.io.logs import read_log
from jaxdyn.model.builder import inertia_report, repair_inertias
from jaxdyn.model.tree import Model

# Of the simulation in a trajectory fit (s).
_LONGEST_STEP = 0.0025
HELP = "identify inertias, friction and rotor inertias from a log of positions and torques"
DESCRIPTION = """\
Identify link inertias, joint friction and rotor inertias from a recorded log of joint positions and torques.
The first part of the log is fitted, the rest is held out to tell how good the fit is.
"""
EPILOG = """\
examples:
  jaxdyn identify --urdf panda.urdf --log log.csv --out fitted.urdf
  jaxdyn identify --urdf panda.urdf --log log.csv --lock panda_finger_joint1 panda_finger_joint2 --plot fit.png
  jaxdyn identify --urdf panda.urdf --log log.csv --method least-squares --report base_parameters.json

log (--log FILE.csv, one header line, or FILE.npz):
  t                time, s, increasing; jitter is allowed
  q1, q2, ...      joint positions, rad or m, in the order that `jaxdyn info` lists
  tau1, tau2, ...  joint torques, N m or N: motor torques seen at the joint, friction not compensated
  v1.., a1..       velocities and accelerations; only used if the log is filtered already (below)
  Joint names may stand for numbers, in any order: q_panda_joint1, tau_panda_joint1, ...

filtering:
  A raw log (no columns a1..) is put on a uniform grid, low-passed without delay at --cutoff, and differentiated:
  v and a are made from q. Choose the cut-off some 5 to 10 times above the fastest motion; 8 Hz suits exciting
  motions of arms. A log with columns a1.. is taken as filtered and used as it is. With --filtered so is one
  without them, and v and a that are missing are made by differences.

methods (--method):
  feasible         convex fit of the torques over all physically possible bodies; the URDF written is sound (default)
  least-squares    the classical fit of base parameters with standard deviations; no URDF, as no body may have them
  trajectory       the feasible fit, then refined by simulating pieces of the log and comparing the motion; slow

output:
  --out            URDF with the fitted inertias, damping, friction and armature (rotor inertia, an attribute of
                   <dynamics>). Base parameters are what the log tells; where it leaves a choice between links, the
                   URDF stays close to the file given.
  --report         everything in numbers as JSON (default: beside --out, with the ending .json)
  The error is 100 |predicted - measured| / |measured| of the torques, over all joints and samples.
"""
METHODS = ("feasible", "least-squares", "trajectory")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "--urdf", required=True, help="the robot; its geometry is taken as right, its inertias as a guess"
    )
    parser.add_argument("--log", required=True, help="the recorded log, FILE.csv or FILE.npz")
    add_model_options(parser)
    parser.add_argument("--repair", action="store_true", help="replace inertias no body can have before fitting")
    data = parser.add_argument_group("data")
    data.add_argument(
        "--train", type=float, default=0.7, metavar="SHARE", help="share of the log to fit (default: 0.7)"
    )
    data.add_argument("--cutoff", type=float, default=8.0, metavar="HZ", help="of the low-pass filter (default: 8 Hz)")
    data.add_argument(
        "--every", type=int, metavar="N", help="keep each Nth filtered sample (default: 15 per cut-off period)"
    )
    data.add_argument("--trim", type=int, metavar="N", help="samples to drop at each end (default: 25 times --every)")
    data.add_argument("--filtered", action="store_true", help="the log is filtered already")
    fit = parser.add_argument_group("fit")
    fit.add_argument("--method", choices=METHODS, default="feasible", help="see below (default: feasible)")
    fit.add_argument(
        "--terms",
        nargs="*",
        choices=identify.TERMS,
        default=identify.TERMS,
        help="fitted beside the inertias: viscous v + coulomb tanh(v / v_s) + offset + armature a (default: all four)",
    )
    fit.add_argument(
        "--v-s", type=float, default=0.01, metavar="V", help="v_s of Coulomb friction, rad/s (default: 0.01)"
    )
    fit.add_argument(
        "--prior", type=float, default=1.0, help="weight of staying close to the URDF's bodies (default: 1)"
    )
    fit.add_argument(
        "--horizon", type=float, default=0.25, metavar="S", help="length of the simulated pieces, s (default: 0.25)"
    )
    fit.add_argument(
        "--steps", type=int, default=100, metavar="N", help="most steps of the trajectory fit (default: 100)"
    )
    files = parser.add_argument_group("output")
    files.add_argument("--out", metavar="FILE.urdf", help="write the fitted robot")
    files.add_argument("--report", metavar="FILE.json", help="write parameters and errors")
    files.add_argument("--plot", metavar="FILE", help="draw measured and predicted torques to FILE.png, .pdf or .svg")
    files.add_argument("--progress", action="store_true", help="print the loss while fitting")


def run(args: argparse.Namespace) -> None:
    """Fit, print the errors and the parameters, write the files."""
    out = output_path(args.out, (".urdf",), "--out")
    report = output_path(args.report, (".json",), "--report")
    plot = output_path(args.plot, (".png", ".pdf", ".svg"), "--plot")
    if out is not None and args.method == "least-squares":
        raise ValueError("--out: least squares gives combinations of parameters and no bodies, so there is no URDF to "
                         "write; take --method feasible, or --report FILE.json")  # fmt: skip
    report = out.with_suffix(".json") if report is None and out is not None else report
    model = load_model(args.urdf, args)
    if args.repair:
        print(f"repaired inertias: {', '.join(dict(inertia_report(model))) or 'none needed it'}")
        model = repair_inertias(model)
    log = _log(model, args)
    train, test = identify.split(log, args.train)

    watch = Stopwatch()
    result = _fit(model, train, args)
    seconds = str(watch)
    print(f"{args.method} fit of {model.name!r}, {model.nv} joints: {_outcome(result)}, in {seconds}")
    errors = _errors(model, result, train, test)
    print(_error_text(errors, train, test))
    print(_joint_table(model, result, test))
    print(_mass_table(model, result) if isinstance(result, Fit) else _base_table(result))
    if out is not None and isinstance(result, Fit):
        save_urdf(result.model, out)
        print(f"Wrote {out}.")
    if report is not None:
        report.write_text(json.dumps(_report(model, result, errors, train, test, args), indent=2) + "\n")
        print(f"Wrote {report}.")
    if plot is not None:
        from jaxdyn.reports.plotting import torque_figure

        labels, units = coordinate_labels(model)
        torque_figure(test, result.torques(test), labels, units).savefig(plot)
        print(f"Wrote {plot}.")


def _log(model: Model, args) -> Log:
    """The log of the file, filtered unless it has been."""
    raw = read_log(args.log, joint_names=model.joint_names)
    if raw.q.shape[1] != model.nq or raw.nv != model.nv:
        raise ValueError(
            f"{args.log}: the log has {raw.q.shape[1]} columns of q and {raw.nv} of tau, the model has {model.nq} and "
            f"{model.nv} (joints {', '.join(model.joint_names)}); hold joints that were not logged with --lock"
        )
    span = f"{args.log}: {len(raw)} samples, {float(raw.t[-1] - raw.t[0]):.4g} s"
    if len(raw) < 2:
        raise ValueError(f"{span}; a log needs more than one sample")
    if raw.a is not None and raw.v is not None:
        print(f"{span}, with v and a: taken as filtered")
        return raw
    if args.filtered:
        print(f"{span}, taken as filtered; what is missing of v and a is made by differences")
        v = np.gradient(np.asarray(raw.q), np.asarray(raw.t), axis=0) if raw.v is None else raw.v
        a = np.gradient(np.asarray(v), np.asarray(raw.t), axis=0)
        return Log(raw.t, raw.q, v, a, raw.tau, joint_names=raw.joint_names)
    rate = (len(raw) - 1) / float(raw.t[-1] - raw.t[0])
    if not args.cutoff > 0:
        raise ValueError(f"--cutoff is {args.cutoff} Hz; give a positive frequency")
    every = max(1, int(rate / (15 * args.cutoff))) if args.every is None else args.every
    trim = 25 * every if args.trim is None else args.trim
    if every < 1 or trim < 0:
        raise ValueError(f"--every is {every}, --trim is {trim}; give --every of at least 1 and --trim of at least 0")
    log = identify.from_raw(
        raw.t, raw.q, raw.tau, cutoff=args.cutoff, trim=trim, every=every, joint_names=raw.joint_names
    )
    print(f"{span} at {rate:.4g} Hz; low-passed at {args.cutoff:g} Hz, {trim} samples dropped at each end, "
          f"each {every}th kept: {len(log)}")  # fmt: skip
    return log


def _fit(model: Model, train: Log, args) -> Fit | LeastSquares:
    if args.method == "least-squares":
        return identify.least_squares(model, train, args.terms, v_s=args.v_s)

    def show(step, loss, _):
        if args.progress:
            print(f"  step {step}: loss {loss:.8g}", flush=True)

    fit = identify.fit_torques(model, train, args.terms, v_s=args.v_s, prior=args.prior, callback=show)
    if args.method == "feasible":
        return fit
    dt = float(np.median(np.diff(np.asarray(train.t))))
    horizon = min(max(1, round(args.horizon / dt)), len(train) - 1)
    return identify.fit_trajectory(
        fit.model,
        train,
        args.terms,
        v_s=args.v_s,
        horizon=horizon,
        steps=args.steps,
        callback=show,
        # Fixed steps: in a batch of segments, adaptive ones cost every segment what the stiffest needs.
        substeps=max(1, math.ceil(dt / _LONGEST_STEP)),
    )


def _outcome(result: Fit | LeastSquares) -> str:
    if isinstance(result, Fit):
        return f"{result.result.replace('_', ' ')} after {len(result.history) - 1} steps"
    return f"{len(result.values)} base parameters, {result.rank} excited, condition {result.condition:.4g}"


def _errors(model: Model, result: Fit | LeastSquares, train: Log, test: Log) -> dict[str, float]:
    from jaxdyn.identify import nominal_parameters, regressor, torque_error

    nominal = regressor(model, test.q, test.v, test.a) @ nominal_parameters(model)
    return {
        "train_percent": result.error(train),
        "test_percent": result.error(test),
        "nominal_test_percent": torque_error(nominal, test.tau),
    }


def _error_text(errors: dict[str, float], train: Log, test: Log) -> str:
    return (
        f"torque error: {errors['test_percent']:.2f} % on the {len(test)} samples held out, "
        f"{errors['train_percent']:.2f} % on the {len(train)} fitted; "
        f"{errors['nominal_test_percent']:.1f} % with the URDF's own numbers"
    )


def _joint_rms(result: Fit | LeastSquares, log: Log) -> np.ndarray:
    return np.sqrt(np.mean((result.torques(log) - np.asarray(log.tau)) ** 2, axis=0))


def _vector(result: Fit | LeastSquares) -> np.ndarray:
    return result.vector if isinstance(result, Fit) else result.parameters


def _terms(model: Model, result: Fit | LeastSquares) -> dict[str, np.ndarray]:
    blocks = _vector(result)[10 * model.nb :].reshape(len(identify.TERMS), model.nv)
    return dict(zip(identify.TERMS, blocks, strict=True))


def _joint_table(model: Model, result: Fit | LeastSquares, test: Log) -> str:
    labels, units = coordinate_labels(model)
    measured = np.sqrt(np.mean(np.asarray(test.tau) ** 2, axis=0))
    columns = [measured, _joint_rms(result, test), *(_terms(model, result)[term] for term in identify.TERMS)]
    rows = [
        [label, unit, *(short(float(x), 3) for x in row)]
        for label, unit, row in zip(labels, units, np.stack(columns, 1), strict=True)
    ]
    header = ["joint", "unit", "torque rms", "error rms", "viscous", "coulomb", "offset", "rotor inertia"]
    return "Joints on the held-out samples, and their friction and rotor inertia\n" + table(header, rows)


def _mass_table(model: Model, fit: Fit) -> str:
    rows = []
    for name, old, new in zip(
        model.body_names, np.asarray(model.inertias), np.asarray(fit.model.inertias), strict=True
    ):
        centre = [short(x, 3) for x in new[1:4] / new[0]] if new[0] > 0 else ["-"] * 3
        rows.append([name, short(old[0]), short(new[0]), *centre])
    text = "Bodies: mass (kg) in the URDF and fitted, fitted centre of mass (m); single masses are partly the prior's choice"
    return text + "\n" + table(["body", "URDF", "fitted", "x", "y", "z"], rows)


def _base_table(result: LeastSquares) -> str:
    rows = [[name, short(x0), short(x), short(s, 2)] for name, x0, x, s in result.table()]
    return "Base parameters: URDF, fitted, standard deviation\n" + table(["combination", "URDF", "fitted", "std"], rows)


def _report(model: Model, result: Fit | LeastSquares, errors, train: Log, test: Log, args) -> dict[str, Any]:
    base = identify.base_parameters(model, args.terms, v_s=args.v_s)
    columns = [i for i, name in enumerate(identify.parameter_names(model)) if name in set(base.parameter_names)]
    nominal, fitted = identify.nominal_parameters(model), _vector(result)
    std = [None if np.isinf(s) else float(s) for s in result.std] if isinstance(result, LeastSquares) else None
    content = {
        "jaxdyn": __version__,
        "urdf": str(pathlib.Path(args.urdf)),
        "log": str(pathlib.Path(args.log)),
        "method": args.method,
        "terms": list(args.terms),
        "v_s": args.v_s,
        "cutoff_hz": None if args.filtered else args.cutoff,
        "outcome": _outcome(result),
        "samples": {"train": len(train), "test": len(test)},
        "torque_error": errors,
        "joint_names": list(model.joint_names),
        "test_rms": _joint_rms(result, test).tolist(),
        "friction": {term: values.tolist() for term, values in _terms(model, result).items()},
        "base_parameters": {
            "expressions": list(base.expressions),
            "nominal": base.values(nominal[columns]).tolist(),
            "fitted": base.values(fitted[columns]).tolist(),
        },
    }
    if std is not None:
        content["base_parameters"]["std"] = std
    if isinstance(result, Fit):
        names = identify.parameter_names(model)
        rows = zip(names, nominal.tolist(), fitted.tolist(), strict=True)
        content["parameters"] = {name: {"nominal": x0, "fitted": x} for name, x0, x in rows}
    return content
