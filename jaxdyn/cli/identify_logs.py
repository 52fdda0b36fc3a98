"""Logs of `jaxdyn identify`: which files, under which names, filtered how."""

import pathlib

import numpy as np

from jaxdyn import identify
from jaxdyn.identify import Log
from jaxdyn.io.logs import read_log
from jaxdyn.model.tree import Model


def log_paths(args) -> tuple[list[str], list[str]]:
    """Files to fit and files to judge by. **Raises:** ValueError for a file that is given twice."""
    seen: dict[pathlib.Path, str] = {}
    for path in [*args.log, *args.test_log]:
        place = pathlib.Path(path).resolve()
        if place in seen:
            where = "--test-log: a log that is fitted tells no error" if path in args.test_log else "--log"
            raise ValueError(f"{where}: {path} is given twice")
        seen[place] = path
    return list(args.log), list(args.test_log)


def log_names(paths: list[str]) -> list[str]:
    """Names of files, with their folders where two would be the same."""
    names = [pathlib.Path(path).name for path in paths]
    return [path if names.count(name) > 1 else name for path, name in zip(paths, names, strict=True)]


def filtered_log(model: Model, path: str, args) -> Log:
    """The log of a file, filtered unless it has been; says so. **Raises:** ValueError for logs that do not fit the model."""
    raw = read_log(path, joint_names=model.joint_names, rename=_renaming(args.rename))
    if raw.q.shape[1] != model.nq or raw.nv != model.nv:
        raise ValueError(
            f"{path}: the log has {raw.q.shape[1]} columns of q and {raw.nv} of tau, the model has {model.nq} and "
            f"{model.nv} (joints {', '.join(model.joint_names)}); hold joints that were not logged with --lock"
        )
    span = f"{path}: {len(raw)} samples, {float(raw.t[-1] - raw.t[0]):.4g} s"
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
    try:
        log = identify.from_raw(
            raw.t, raw.q, raw.tau, cutoff=args.cutoff, trim=trim, every=every, joint_names=raw.joint_names
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    print(f"{span} at {rate:.4g} Hz; low-passed at {args.cutoff:g} Hz, {trim} samples dropped at each end, "
          f"each {every}th kept: {len(log)}")  # fmt: skip
    return log


def _renaming(items: list[str]) -> dict[str, str]:
    pairs = [item.partition("=") for item in items]
    bad = [item for item, (theirs, sign, ours) in zip(items, pairs, strict=True) if not (theirs and sign and ours)]
    if bad:
        raise ValueError(f"--rename {bad[0]}: give the name in the log and the joint's, as motor1=shoulder")
    return {theirs: ours for theirs, _, ours in pairs}
