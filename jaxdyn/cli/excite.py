"""`jaxdyn excite`: an exciting motion that identifies the parameters of a robot best, for `jaxdyn identify`."""

import argparse

import jax.numpy as jnp
import numpy as np

from jaxdyn import identify
from jaxdyn.cli.common import (
    add_model_options,
    check_memory,
    check_minimum,
    load_mechanism,
    load_model,
    option,
    output_path,
    per_coordinate,
    plot_motion,
    real,
    table,
    whole,
)
from jaxdyn.constraints.codes import RESULTS
from jaxdyn.identify import TERMS
from jaxdyn.identify.excitation_search import OBJECTIVES
from jaxdyn.io import write_log
from jaxdyn.model.configuration import columns_of
from jaxdyn.simulation.solution import Solution

HELP = "optimise an exciting motion within limits for the identification of inertias and friction"
DESCRIPTION = """\
Find a periodic motion of all joints, or of the motors of a robot with loops (a finite Fourier series that starts at rest),
within limits of position, velocity and torque, whose measured torques identify the robot's inertias and friction best, and
write it for a controller.
"""
EPILOG = """\
examples:
  jaxdyn excite panda.urdf --lock panda_finger_joint1 panda_finger_joint2 --out motion.csv --plot motion.png
  jaxdyn excite five_bar.xml --motors left right --velocity 2 --torque 20 --out motion.csv
  jaxdyn excite arm.urdf --period 20 --harmonics 8 --velocity 1.0 --torque 50 --objective condition --out motion.csv

The CSV file has columns t, q_.., v_.., a_.. and tau_.., the torques of the file's bodies (N m). Run it, log q and
tau, and pass the log to `jaxdyn identify`. Contacts with the ground and self-collisions are not checked: inspect
the motion before you run it.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("urdf", help="the robot; its limits of position, velocity and effort are respected")
    add_model_options(parser)
    option(parser, "--motors JOINT ...", "driven joints of a robot with loops, as many as degrees of freedom")
    option(parser, "--out FILE", "write the motion, .csv or .npz")
    option(parser, "--plot FILE", "plot the motion to FILE.png, .pdf or .svg")
    option(parser, "--period S", "period of the motion, s (default: 10)", real, 10.0)
    option(parser, "--periods N", "number of periods to write (default: 1)", whole, 1)
    option(parser, "--harmonics N", "harmonics of the series (default: 5)", whole, 5)
    option(parser, "--rate HZ", "samples per second (default: 100)", real, 100.0)
    parser.add_argument(
        "--terms", nargs="*", choices=TERMS, default=TERMS, help="terms to identify in addition to the bodies"
    )
    parser.add_argument(
        "--objective", choices=OBJECTIVES, default="logdet", help="measure of excitation (default: logdet)"
    )
    option(parser, "--margin MARGIN", "fraction of all limits to use (default: 0.9)", real, 0.9)
    option(parser, "--velocity V ...", "velocity limits instead of the file's, rad/s, m/s", real)
    option(parser, "--torque T ...", "torque limits instead of the file's, N m, N", real)
    option(parser, "--seed SEED", "seed of the random initial motions (default: 0)", whole, 0)
    option(parser, "--steps N", "steps of the optimisation (default: 300)", whole, 300)


def run(args: argparse.Namespace) -> None:
    """Optimise, print the gain, write the motion."""
    # Paths are checked before the optimisation, which takes minutes.
    out, plot = (
        output_path(args.out, (".csv", ".npz"), "--out"),
        output_path(args.plot, (".png", ".pdf", ".svg"), "--plot"),
    )
    if not args.rate > 0 or args.periods < 1:
        raise ValueError(f"--rate is {args.rate}, --periods is {args.periods}; give positive numbers")
    # Negated, so that NaN is refused.
    if not args.period > 0:
        raise ValueError(f"--period is {args.period} s; give a positive time")
    check_minimum(args, harmonics=1, steps=0, seed=0)
    # Nyquist: rows must resolve the highest harmonic, or the log cannot represent the motion.
    if args.rate * args.period <= 2 * args.harmonics:
        raise ValueError(
            f"--rate {args.rate:g} --period {args.period:g}: {args.rate * args.period:.3g} rows a period do not hold "
            f"{args.harmonics} harmonics; give more than {2 * args.harmonics}"
        )
    mechanism = load_mechanism(args.urdf, args)
    model = load_model(args.urdf, args) if mechanism is None else mechanism.system
    if args.motors and mechanism is None:
        raise ValueError("--motors: the robot has no loops, and all of its joints are driven; omit it")
    rows = args.rate * args.period * args.periods
    check_memory(
        rows * (1 + model.nq + 3 * model.nv), f"--rate {args.rate:g} --period {args.period:g} --periods {args.periods}"
    )
    # 14 parameters for each joint: ten of its body, four of friction and rotor.
    check_memory(100.0 * args.harmonics * (model.nv * 14) ** 2, f"--harmonics {args.harmonics}")
    velocity, torque = args.velocity, args.torque
    if mechanism is None:
        velocity, torque = (
            None if value is None else per_coordinate(model, value, f"--{name}")
            for name, value in (("velocity", velocity), ("torque", torque))
        )
    elif not args.motors:
        joints = ", ".join(model.joint_names)
        raise ValueError(f"{args.urdf} has loops; name the joints that are driven in --motors, of {joints}")
    motion = identify.exciting_motion(
        model if mechanism is None else mechanism,
        args.terms,
        motors=args.motors,
        guess=None if mechanism is None else mechanism.starts["reference"].q,
        period=args.period,
        harmonics=args.harmonics,
        objective=args.objective,
        margin=args.margin,
        seed=args.seed,
        steps=args.steps,
        velocity=velocity,
        torque=torque,
    )
    log = motion.log(args.rate, args.periods)
    names, driven = columns_of(model), motion.robot.joints.tolist()
    print(
        f"condition of the regressor {motion.condition:.4g}, of a random motion within the same limits "
        f"{motion.start_condition:.4g}; log det of the information matrix larger by {motion.logdet:.3g}"
    )
    print("limits used: " + ", ".join(f"{name} {100 * share:.0f} %" for name, share in motion.used.items()))
    q, v, tau = (np.asarray(x) for x in (log.q, log.v, log.tau))
    # For a check by eye against the limits before the motion is run.
    extremes = [q.min(axis=0), q.max(axis=0), abs(v).max(axis=0), abs(tau).max(axis=0)]
    rows = [[names.v[i], *(f"{float(x[j]):.3g}" for x in extremes), names.force_units[i]] for j, i in enumerate(driven)]
    print(table(["joint", "lowest", "highest", "fastest", "torque", "unit"], rows))
    if out is not None:
        write_log(out, log)
        print(f"Wrote {out}.")
    if plot is not None:
        log = motion.log(args.rate, args.periods, whole=True)
        ts, q, v, torque = (jnp.asarray(x) for x in (log.t, log.q, log.v, log.tau))
        plot_motion(plot, model, Solution(ts, q, v, RESULTS.successful, {}, torque=torque))
