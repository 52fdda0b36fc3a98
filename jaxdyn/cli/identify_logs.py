"""Logs of `jaxdyn identify`: files, names and filtering."""

import pathlib
import re
import warnings

import numpy as np

from jaxdyn import identify
from jaxdyn.cli.common import number
from jaxdyn.identify import Log
from jaxdyn.identify.log_repair import repair_log
from jaxdyn.io.logs import read_log
from jaxdyn.model.tree import Model

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
        print(f"{span}, used as filtered; missing v and a are computed by differences")
        # A filtered signal is smooth enough for central differences.
        v = np.gradient(np.asarray(raw.q), np.asarray(raw.t), axis=0) if raw.v is None else raw.v
        a = np.gradient(np.asarray(v), np.asarray(raw.t), axis=0)
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
