"""Options of `jaxdyn identify`, and its logs: files, names and filtering."""

import dataclasses
import math
import pathlib
import re
import warnings
from typing import Any, NamedTuple

import numpy as np

from jaxdyn import identify
from jaxdyn.cli.common import number
from jaxdyn.identify import EXTRA, TERMS, Fit, LeastSquares, Log, RobotFit
from jaxdyn.identify.log_repair import repair_log
from jaxdyn.identify.raw_logs import differentiate
from jaxdyn.identify.torque_terms import LEAVES
from jaxdyn.io.logs import read_log
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene

_UNWRAP = {"auto": "auto", "yes": True, "no": False}


def log_paths(args) -> tuple[list[str], list[str]]:
    """Training and test files. **Raises:** ValueError for a file that is given twice."""
    seen: dict[pathlib.Path, str] = {}
    for path in [*args.log, *args.test_log]:
        # Two spellings of one file are still one file.
        place = pathlib.Path(path).resolve()
        if place in seen:
            where = "--test-log: a training log is no test of the fit" if path in args.test_log else "--log"
            raise ValueError(f"{where}: {path} is given twice")
        seen[place] = path
    return list(args.log), list(args.test_log)


def log_names(paths: list[str]) -> list[str]:
    """Names of files, with their folders where two would be the same."""
    names = [pathlib.Path(path).name for path in paths]
    # Names are keys of the report, and two logs of one name would overwrite each other.
    return [path if names.count(name) > 1 else name for path, name in zip(paths, names, strict=True)]


def raw_log(model: Model, path: str, args, motors: bool = False) -> Log:
    """Read the log of a file as recorded, but for wraps and outliers, which are printed.

    `motors`: the columns are those of some joints, in the model's order.

    **Raises:** ValueError for logs that do not fit the model, and for outliers.
    """
    # Repairs follow below with the model, whose continuous joints may turn without limit.
    options = {"rename": _renaming(args.rename), "unwrap": False, "outliers": "keep"}
    names = model.joint_names
    if motors:
        own = read_log(path, **options).joint_names or ()
        names = tuple(name for name in model.joint_names if name in own)
        if not names:
            raise ValueError(
                f"{path}: name the columns by the motors' joints, q_JOINT and tau_JOINT, of {', '.join(model.joint_names)}"
            )
    raw = read_log(path, joint_names=names, **options)
    if motors:
        # The repair looks at limits and kinds of the joints, and has the model of a tree.
        return repair_log(raw, None, unwrap=_UNWRAP[args.unwrap], outliers=args.outliers)
    if raw.q.shape[1] != model.nq or raw.nv != model.nv:
        raise ValueError(
            f"{path}: the log has {raw.q.shape[1]} columns of q and {raw.nv} of tau, the model has {model.nq} and "
            f"{model.nv} (joints {', '.join(model.joint_names)}); lock joints that were not logged with --lock"
        )
    if len(raw) < 2:
        raise ValueError(f"{_span(path, raw)}; a log needs more than one sample")
    try:
        with warnings.catch_warnings(record=True) as caught:
            # Python shows a repeated warning once, and each log has its own.
            warnings.simplefilter("always")
            raw = repair_log(raw, model, unwrap=_UNWRAP[args.unwrap], outliers=args.outliers)
    except ValueError as error:
        # The options as the command line spells them.
        text = re.sub(r'(unwrap|outliers)="(\w+)"', r"--\1 \2", str(error))
        raise ValueError(f"{path}: {text}") from None
    for one in caught:
        print(f"{path}: {one.message}")
    return raw


def log_cutoff(logs: list[Log], args) -> float | None:
    """Cut-off frequency (Hz) of all logs, None where none is filtered here; print the choice of "auto" and its reason.

    **Raises:** ValueError for an invalid cut-off, and for logs that do not determine one.
    """
    # Logs with v and a are used as they are, so they must not influence the choice.
    logs = [log for log in logs if not (args.filtered or _has_derivatives(log))]
    if args.cutoff != "auto":
        cutoff = number(args.cutoff, "--cutoff")
        if not cutoff > 0:
            raise ValueError(f"--cutoff is {cutoff} Hz; give a positive frequency, or auto")
        return cutoff if logs else None
    if not logs:
        return None
    try:
        choice = identify.choose_cutoff(logs)
    except ValueError as error:
        raise ValueError(f"--cutoff auto: {error}") from None
    # A spectrum determines no more than three digits.
    cutoff = float(f"{choice.frequency:.3g}")
    how = f"ten times the band of the motion, {choice.motion:.3g} Hz"
    if choice.vibration is not None:
        how = f"below a vibration at {choice.vibration:.3g} Hz; the motion is below {choice.motion:.3g} Hz"
    elif cutoff < 9.9 * choice.motion:
        how = f"limited by the sampling rate; the motion is below {choice.motion:.3g} Hz"
    print(f"--cutoff auto: {cutoff:g} Hz, {how}")
    return cutoff


def filter_log(raw: Log, path: str, args, cutoff: float | None) -> Log:
    """Filter a log unless it has v and a, and print how.

    **Raises:** ValueError for logs that are too short for the filter.
    """
    span = _span(path, raw)
    # Filtering twice would attenuate the signals near the cut-off once more.
    if _has_derivatives(raw):
        print(f"{span}, with v and a: used as filtered")
        return raw
    if args.filtered:
        print(f"{span}, used as filtered; missing v and a are those of splines")
        t = np.asarray(raw.t, np.float64)
        v = differentiate(t, np.asarray(raw.q, np.float64)) if raw.v is None else raw.v
        a = differentiate(t, np.asarray(v, np.float64))
        return Log(raw.t, raw.q, v, a, raw.tau, joint_names=raw.joint_names)
    # The mean rate, because sampling may jitter.
    rate = (len(raw) - 1) / float(raw.t[-1] - raw.t[0])
    if cutoff is None:  # all training logs are filtered already, this one is raw
        cutoff = log_cutoff([raw], args)
        assert cutoff is not None
    # 15 samples per cut-off period: more would be correlated by the filter and add no information.
    every = max(1, int(rate / (15 * cutoff))) if args.every is None else args.every
    # Accelerations are within half a per cent of their size from two and a half periods of the cut-off away from the ends.
    trim = 38 * every if args.trim is None else args.trim
    if every < 1 or trim < 0:
        raise ValueError(f"--every is {every}, --trim is {trim}; give --every of at least 1 and --trim of at least 0")
    try:
        log = identify.from_raw(
            raw.t,
            raw.q,
            raw.tau,
            cutoff=cutoff,
            trim=trim,
            every=every,
            joint_names=raw.joint_names,
            unwrap=False,
            outliers="keep",  # done by raw_log, with the model
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    print(f"{span} at {rate:.4g} Hz; low-passed at {cutoff:g} Hz, {trim} samples dropped at each end, "
          f"{'every sample' if every == 1 else f'one of {every}'} kept: {len(log)}")  # fmt: skip
    return log


def _span(path: str, raw: Log) -> str:
    return f"{path}: {len(raw)} samples, {float(raw.t[-1] - raw.t[0]):.4g} s"


def _has_derivatives(raw: Log) -> bool:
    return raw.a is not None and raw.v is not None


def _renaming(items: list[str]) -> dict[str, str]:
    pairs = [item.partition("=") for item in items]
    bad = [item for item, (theirs, sign, ours) in zip(items, pairs, strict=True) if not (theirs and sign and ours)]
    if bad:
        raise ValueError(f"--rename {bad[0]}: give the name in the log and the joint's, as motor1=shoulder")
    return {theirs: ours for theirs, _, ours in pairs}


# Longest step of the simulation in a trajectory fit, s.
_LONGEST_STEP = 0.0025


class Options(NamedTuple):
    """Options of a fit; values of "auto" are chosen by the fit."""

    method: str
    terms: str | tuple[str, ...]
    v_s: float | str
    prior: float | str
    robust: float | str | None
    weights: str | None
    delay: str | float | tuple[float, ...] = 0.0


def parse_options(args) -> Options:
    """Parse options of the command line.

    **Raises:** ValueError for options that the method does not support, and invalid numbers.
    """
    # The other two methods choose nothing by cross-validation, so "auto" becomes a fixed value for them.
    simple = args.method != "feasible"
    terms = args.terms
    if terms is None or terms == ["auto"]:
        terms = TERMS if simple else "auto"
    elif "auto" in terms:
        raise ValueError(f"--terms {' '.join(terms)}: auto excludes other terms")
    elif simple and set(terms) & set(EXTRA):
        raise ValueError(f"--terms {' '.join(terms)}: --method {args.method} supports {', '.join(TERMS)}; the others need "
                         "--method feasible")  # fmt: skip
    v_s = args.v_s if args.v_s == "auto" else number(args.v_s, "--v-s")
    prior = args.prior if args.prior == "auto" else number(args.prior, "--prior")
    if simple:
        # The constants of `fit_torques` by default; only "feasible" chooses them.
        v_s, prior = 0.01 if v_s == "auto" else v_s, 1.0 if prior == "auto" else prior
    robust = {"auto": "auto", "none": None}.get(args.robust, args.robust)
    robust = number(robust, "--robust") if robust not in ("auto", None) else robust
    if args.payload_centre is not None and args.payload_mass is None:
        raise ValueError("--payload-centre: without --payload-mass; give both, or neither to identify the payload")
    weights = "auto" if args.weights == "auto" else None
    delay = parse_delay(args.delay)
    if simple and delay != 0.0:
        raise ValueError(
            f"--delay {' '.join(args.delay)}: --method {args.method} does not support delays; use --method feasible"
        )
    return Options(args.method, terms if isinstance(terms, str) else tuple(terms), v_s, prior, robust, weights, delay)


def find_gains(model: Model, unloaded: list[Log], loaded: list[Log], options: Options, args) -> identify.DriveGains:
    """Fit the gains of the drives by a known payload. **Raises:** ValueError where a required option is missing."""
    if args.payload_centre is None or not loaded:
        raise ValueError(
            f"--payload-mass {args.payload_mass:g}: gains need --payload-log, logs with the payload, and --payload-centre X Y Z, "
            "its centre of mass in the frame of the link that holds it"
        )
    # `fit_gains` supports the terms of `TERMS` alone.
    terms = TERMS if options.terms == "auto" else tuple(term for term in TERMS if term in options.terms)
    return identify.fit_gains(
        model,
        unloaded,
        loaded,
        args.payload_mass,
        args.payload_centre,
        body=args.payload_body,
        terms=terms,
        v_s=options.v_s,
    )


def parse_delay(words: list[str]) -> str | float | tuple[float, ...]:
    """Parse a delay: "auto", zero for none, seconds, or those of each torque. **Raises:** ValueError for anything else."""
    if words in (["auto"], ["none"]):
        return "auto" if words == ["auto"] else 0.0
    if {"auto", "none"} & set(words):
        raise ValueError(f"--delay {' '.join(words)}: auto and none exclude other values")
    seconds = tuple(number(word, "--delay") for word in words)
    return seconds[0] if len(seconds) == 1 else seconds


def resolve_options(options: Options, result) -> Options:
    """Replace "auto" in the options by the choices of a fit."""
    if not isinstance(result, RobotFit):
        return options
    setting = result.choice.setting
    delay = options.delay
    if delay == "auto" and (result.delays is None or not np.any(result.delays.seconds)):
        delay = 0.0  # no delay lowers the error
    # Another choice on all samples would make the reported error that of other settings.
    return options._replace(
        terms=result.terms, v_s=setting.v_s, prior=setting.prior, robust=setting.robust, delay=delay
    )


def make_fit(
    model: Model, logs: list[Log], options: Options, args, client: Any = None
) -> RobotFit | Fit | LeastSquares:
    """Fit logs by the requested method; workers of a Dask client share the fits of its cross-validation."""

    def show(step, loss, _):
        if args.progress:
            print(f"  step {step}: loss {loss:.8g}", flush=True)

    def tell(trial):
        if args.progress:
            extra = ", ".join(f"{name} {list(joints)}" for name, joints in trial.setting.extra)
            print(f"  held out: {trial.percent:.3f} % with v_s {trial.setting.v_s:g}, prior {trial.setting.prior:g}, "
                  f"robust {trial.setting.robust}, terms {extra or 'none more'}", flush=True)  # fmt: skip

    if options.method == "least-squares":
        return identify.least_squares(model, logs, options.terms, v_s=float(options.v_s))
    if options.method == "feasible":
        chosen = options._asdict()
        del chosen["method"]
        with warnings.catch_warnings():
            # The command prints these lines itself, with the names of the files, and of the test logs too.
            warnings.simplefilter("ignore", identify.LogWarning)
            return identify.fit_robot(model, logs, **chosen, client=client, callback=tell)
    # One log alone, as the command has checked.
    (log,) = logs
    v_s = float(options.v_s)
    # The trajectory fit starts from the parameters of the torque fit.
    fit = identify.fit_torques(model, log, options.terms, v_s=v_s, prior=float(options.prior))
    # The median, so that a gap in the log does not lengthen the horizon.
    dt = float(np.median(np.diff(np.asarray(log.t))))
    objective = identify.Objective(
        # At least one step and not longer than the log.
        horizon=min(max(1, round(args.horizon / dt)), len(log) - 1),
        # Fixed steps: in a batch of segments, adaptive ones cost every segment as many steps as the stiffest needs.
        substeps=max(1, math.ceil(dt / _LONGEST_STEP)),
    )
    return refine_by_motion(fit, log, objective, identify.Solver(steps=args.steps), identify.Execution(callback=show))


def refine_by_motion(
    fit: Fit, log: Log, objective: identify.Objective, solver: identify.Solver, execution: identify.Execution
) -> Fit:
    """Refine a fit by the error of the simulated motion, over all bodies and the terms of the fit.

    Terms that the fit holds at zero stay there.
    """
    scene = fit.scene
    tree = identify.Parameters(scene).inertias()
    for term in fit.terms:
        where = LEAVES[term]
        rows = np.flatnonzero(np.asarray(where(scene)) > 0).tolist()
        if term == "offset":
            tree = tree.free(where)
        elif rows:
            tree = tree.positive(where, rows=rows)
    refined = identify.fit_parameters(scene, log, tree, objective, solver, execution)
    friction, model = refined.friction, refined.model
    # A term that the model lacks stays absent.
    model = model.replace(
        damping=None if model.damping is None else friction.viscous,
        friction=None if model.friction is None else friction.coulomb,
    )
    return dataclasses.replace(refined, system=Scene(model, forces=(friction,)), nominal=fit.nominal, terms=fit.terms)
