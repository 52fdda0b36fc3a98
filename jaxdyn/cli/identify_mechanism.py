"""`jaxdyn identify` for mechanisms with loops, from logs of their motors alone."""

import json
import pathlib

import numpy as np

from jaxdyn import identify
from jaxdyn.cli.common import load_scene, output_path, short, table
from jaxdyn.cli.identify_logs import filter_log, log_cutoff, log_names, log_paths, raw_log
from jaxdyn.constraints.codes import name_of
from jaxdyn.constraints.loops import Loop
from jaxdyn.identify import TERMS, Log
from jaxdyn.identify.applied_fits import MechanismFit, fit_mechanism
from jaxdyn.io.loaded import LoadedScene
from jaxdyn.io.urdf_write import write_text
from jaxdyn.systems.scene import Scene

# Configurations between the one of the file and the first sample, so that the loops stay on their branch.
_APPROACH = 50


def load_mechanism(path: str, args) -> LoadedScene | None:
    """Scene of a file that has loops; None for a tree."""
    scene, _ = load_scene(path, args)
    return scene if any(isinstance(constraint, Loop) for constraint in scene.constraints) else None


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
    print(_text(scene, judge, final, dict(zip(tested, test, strict=True)), dict(zip(names, train, strict=False))))
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


def _text(scene: Scene, judge: MechanismFit, final: MechanismFit, tests: dict[str, Log], train: dict[str, Log]) -> str:
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
