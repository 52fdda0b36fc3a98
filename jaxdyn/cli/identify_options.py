"""Options of `jaxdyn identify`, and the fit that they describe."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from jaxdyn import identify
from jaxdyn.cli.common import number
from jaxdyn.identify import EXTRA, TERMS, Fit, LeastSquares, Log, RobotFit
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene

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
        return identify.fit_robot(
            model,
            logs,
            options.terms,
            v_s=options.v_s,
            prior=options.prior,
            robust=options.robust,
            weights=options.weights,
            delay=options.delay,
            client=client,
            callback=tell,
        )
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
    places: dict[str, Any] = {
        "viscous": lambda scene: scene.forces[0].viscous,
        "coulomb": lambda scene: scene.forces[0].coulomb,
        "offset": lambda scene: scene.forces[0].offset,
        "armature": lambda scene: scene.system.armature,
    }
    tree = identify.Parameters(scene).inertias()
    for term in fit.terms:
        where = places[term]
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
