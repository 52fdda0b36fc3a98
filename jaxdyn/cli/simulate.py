"""`jaxdyn simulate`: motions of a robot under chosen torques, written, plotted or shown."""

import argparse
import pathlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.cli.common import (
    FILE,
    Stopwatch,
    add_model_options,
    check_memory,
    check_minimum,
    load_scene,
    option,
    output_path,
    per_coordinate,
    plot_motion,
    real,
    vector,
    whole,
    xacro_arguments,
)
from jaxdyn.constraints.assembly import assemble
from jaxdyn.constraints.codes import RESULTS
from jaxdyn.forces.elements import CoulombFriction, JointDamping
from jaxdyn.identify import SampledTorque
from jaxdyn.identify.excitation import FourierTorque, random_torque
from jaxdyn.io import LoadedScene
from jaxdyn.io.logs import read_log
from jaxdyn.model.configuration import integrate
from jaxdyn.model.tree import Model
from jaxdyn.pictures import save_html, shapes, view
from jaxdyn.simulation.events import events_of
from jaxdyn.simulation.methods import Projected
from jaxdyn.simulation.options import Steps
from jaxdyn.simulation.run import Solution, simulate
from jaxdyn.simulation.solvers.choice import Rodas5P, stiff_rates
from jaxdyn.systems.scene import Scene

HELP = "simulate a robot of a URDF, MJCF or SDF file, one motion or a batch, and write, plot or show the motions"
DESCRIPTION = """\
Simulate the robot from a given state under chosen joint torques. Loops and couplings of the file are closed at the
start and stay closed; its springs, damping and friction act. Energy minus work is printed as a check of the
integration: it must be close to zero.
"""
EPILOG = """\
examples:
  jaxdyn simulate panda.urdf --duration 2 --q0 0 -0.5 0 -2 0 1.5 0.7 0 0 --out motion.csv --plot motion.png
  jaxdyn simulate panda.urdf --q0 panda_joint4=-2 panda_joint6=1.5 --torque gravity --damping 1
  jaxdyn simulate panda.urdf --batch 256 --torque gravity+random --torque-size 2 --seed 1 --out motions.npz
  jaxdyn simulate panda.urdf --torque log.csv --out replay.csv
  jaxdyn simulate panda.urdf --torque gravity+random --view
  jaxdyn simulate robot.xml --start home --duration 1 --html motion.html

torques (--torque):
  zero             no torques: the robot falls
  gravity          compensates gravity, N(q)
  random           smooth random torques (three harmonics of 0.5 Hz), another one for each motion
  gravity+random   both
  FILE.csv, .npz   replays the columns tau_JOINT, or tau1, tau2, ... (N m, N), of a log with t (s) and q_JOINT, or q1,
                   q2, ..., as --out writes them; it starts at the log's first state unless --q0 and --v0 say otherwise,
                   and lasts as long as the log

output (--out):
  .csv             columns t, q_.., v_.., tau_.. with the joints' names (numbers where a joint has several coordinates),
                   energy, work, each with its unit; with --batch also rollout, the number of the motion
  .npz             arrays t (nt), q (nt, nq), v and tau (nt, nv), energy and work (nt), and JSON texts of their names and
                   units; with --batch a leading axis of motions
  v is the velocity in the body's frame: of a free base, linear (m/s) then angular (rad/s).
  Quaternions in q are (w, x, y, z); a free base is (x, y, z, qw, qx, qy, qz).
"""
_KINDS = ("zero", "gravity", "random", "gravity+random")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", help=FILE)
    add_model_options(parser)
    motion = parser.add_argument_group("motion")
    option(motion, "--duration S", "length of the motion, s (default: 2, or the log's)", real)
    option(
        motion, "--sample S", "time between output rows, s (default: 0.01), rounded to fill the duration", real, 0.01
    )
    option(motion, "--start NAME", "a named state of the file (a keyframe)", default="reference")
    option(motion, "--q0 Q ...", "initial q: all of it, or JOINT=VALUE to change some of it (rad, m)")
    option(motion, "--v0 V ...", "initial v, in the same form (default: that of --start; rad/s, m/s)")
    option(motion, "--batch N", "number of motions (default: 1)", whole, 1)
    option(motion, "--spread D", "standard deviation of the initial state around q0", real, 0.0)
    option(motion, "--seed SEED", "seed of random torques and starts (default: 0)", whole, 0)
    forces = parser.add_argument_group("forces")
    option(forces, "--torque KIND", "zero, gravity, random, gravity+random or a log", default="zero")
    option(
        forces,
        "--torque-size T ...",
        "standard deviation of random torques, N m or N, one number or one per coordinate "
        "(default: 1 %% of the effort limit, 1 where there is none)",
        real,
    )
    option(
        forces,
        "--damping D ...",
        "joint damping, N m s or N s, one number or one per coordinate (default: as the file states)",
        real,
    )
    option(
        forces,
        "--friction F ...",
        "Coulomb friction, N m or N, smoothed below 0.01 rad/s (default: as the file states)",
        real,
    )
    solver = parser.add_argument_group("integration")
    option(solver, "--dt S", "fixed steps (Runge-Kutta of order 4) of this length, s", real)
    option(
        solver,
        "--rtol RTOL",
        "tolerance of adaptive steps (order 8, of Rodas5P if the start is stiff), the default: 1e-8",
        real,
        1e-8,
    )
    option(solver, "--max-steps N", "stop after this number of steps", whole)
    option(
        solver,
        "--rank-tol R",
        "rows of loops whose distance from the span of the others is below this part of their length are left out "
        "(default: those that stay dependent a finite distance from the start, as `jaxdyn info` lists them)",
        real,
    )
    option(solver, "--progress", "show the progress of the motion")
    files = parser.add_argument_group("output")
    option(files, "--out FILE", "write the motions to FILE.csv or FILE.npz")
    option(files, "--plot FILE", "plot positions, velocities and torques to FILE.png, .pdf or .svg")
    option(files, "--html FILE", "write the motion as a page FILE.html that plays in a browser, offline too")
    option(files, "--view", "show the motion in the browser, until Ctrl-C")


def run(args: argparse.Namespace) -> int:
    """Simulate, print a summary, write the files; return 1 if a motion stopped early."""
    out = output_path(args.out, (".csv", ".npz"), "--out")
    plot = output_path(args.plot, (".png", ".pdf", ".svg"), "--plot")
    page = output_path(args.html, (".html",), "--html")
    if args.batch < 1:
        raise ValueError(f"--batch is {args.batch}; give at least 1")
    if args.dt is not None and not args.dt > 0:
        raise ValueError(f"--dt is {args.dt}; give a positive step, s")
    check_minimum(args, spread=0, max_steps=1, torque_size=0, damping=0, friction=0, rank_tol=0)
    loaded, file = load_scene(args.file, args)
    model = loaded.system
    # Before the starts and the torques of the batch are allocated, which happens ahead of the rows.
    check_memory(8.0 * args.batch * (model.nq + 2 * model.nv + 3), f"--batch {args.batch}")
    control, q0, v0, duration = _excitation(loaded, args)
    if args.duration is not None:
        duration = args.duration
    if not (duration > 0 and 0 < args.sample <= duration):
        raise ValueError(f"--duration is {duration} s, --sample {args.sample} s; give 0 < sample <= duration")
    size = f"--duration {duration:g} --sample {args.sample:g}" + f" --batch {args.batch}" * (args.batch > 1)
    rows = float(duration) / args.sample
    # Rows of q, v, torques, energy and work, and as much again while they are computed and written.
    check_memory(2 * args.batch * (rows + 1) * (model.nq + 2 * model.nv + 3), size)
    # The end is met exactly; rows may be a little closer or farther than --sample.
    ts = np.linspace(0.0, duration, round(rows) + 1)
    scene = Scene(model, loaded.constraints, _forces(loaded, args))
    starts, speeds = _starts(scene, q0, v0, args)
    # A fixed step has no tolerance, so only one of the two is passed.
    rtol = args.rtol if args.dt is None else None
    steps: dict[str, Any] = {"stepsize": Steps(args.dt, rtol=rtol, atol=rtol, max_steps=args.max_steps)}
    if args.rank_tol is not None:
        steps["method"] = Projected(rank_tol=args.rank_tol)
    # The program of a batch has traced states, by which `simulate` cannot choose its solver.
    if args.dt is None and scene.forces and stiff_rates(scene, starts[0], speeds[0], 0.0, None, duration) is not None:
        steps["solver"] = Rodas5P()
        print("the forces are stiff at the start: steps of Rodas5P")

    watch = Stopwatch()
    carry = model if args.torque.startswith("gravity") else None
    steps["events"] = events_of(progress=args.progress)
    solution, tau = _simulate(scene, control, carry, starts, speeds, ts, steps)
    done = np.asarray(solution.success)
    print(f"{args.file}: {args.batch} motion{'s' * (args.batch > 1)} of {duration:g} s, {len(ts)} rows each, in {watch} "
          "(compilation included)")  # fmt: skip
    _summarise(model, solution, done)
    # Files, plots and viewers have torques of the solution, and `simulate` was not asked to store them.
    moving = eqx.tree_at(lambda s: s.torque, solution, tau, is_leaf=lambda x: x is None)
    # A single motion has no axis of motions, so that scripts need not index it.
    moving = moving if args.batch > 1 else jax.tree.map(lambda x: x[0], moving)
    if out is not None:
        (moving.to_csv if out.suffix.lower() == ".csv" else moving.to_npz)(out, scene)
        print(f"Wrote {out}.")
    if plot is not None:
        plot_motion(plot, scene, moving)
    if page is not None or args.view:
        # A model holds no geometry, so the file is read again.
        solids = shapes(file, arguments=xacro_arguments(args))
        if page is not None:
            save_html(page, scene, moving, shapes=solids)
            print(f"Wrote {page}.")
        if args.view:
            view(scene, moving, shapes=solids, block=True)
    if not done.all():
        reached = np.asarray(solution.stats["time_reached"])[~done]
        # The earliest failure is shown: later ones often have the same cause.
        first = int(np.flatnonzero(~done)[np.argmin(reached)])
        reason = str(RESULTS[jax.tree.map(lambda x: x[first], solution.result)])
        print(
            f"{np.sum(~done)} of {args.batch} motions stopped early, the first at t = {reached.min():.6g} s: {reason}"
        )
        print("Try a smaller --dt or --rtol, or a larger --max-steps.")
    return int(not done.all())


def _excitation(scene: LoadedScene, args):
    """Control, with a leading axis of motions in its leaves, initial state and duration."""
    if args.start not in scene.starts:
        raise ValueError(f"--start is {args.start!r}; the named states are {', '.join(scene.starts)}")
    model, start = scene.system, scene.starts[args.start]
    q0, v0, duration = np.asarray(start.q), np.asarray(start.v), 2.0
    limit = np.asarray(model.effort_limit)
    # Files without limits have infinity or 0 there.
    size = jnp.asarray(np.where(np.isfinite(limit) & (limit > 0), 0.01 * limit, 1.0))
    if args.torque_size is not None:
        size = jnp.asarray(per_coordinate(model, args.torque_size, "--torque-size"))
    if args.torque in _KINDS:
        # Zeros and not another control: every kind of torque shares one code path.
        random = size if "random" in args.torque else 0 * size
        keys = jax.random.split(jax.random.key(args.seed), args.batch)
        control = jax.vmap(lambda key: random_torque(key, random))(keys)
    elif pathlib.Path(args.torque).suffix.lower() in (".csv", ".npz"):
        # Replayed torques were prescribed: a jump in them is no corrupted sample.
        log = read_log(args.torque, joint_names=model.joint_names, unwrap=False, outliers="keep")
        if (log.q.shape[1], log.nv) != (model.nq, model.nv):
            raise ValueError(f"--torque {args.torque}: the log has {log.q.shape[1]} columns of q and {log.nv} of tau, the "
                             f"model needs {model.nq} and {model.nv}; use --lock for joints that were not logged")  # fmt: skip
        # Replays start from the recorded state; without it the open-loop torques would diverge at once.
        q0, v0 = np.asarray(log.q)[0], v0 if log.v is None else np.asarray(log.v)[0]
        t = np.asarray(log.t) - float(log.t[0])
        duration = float(t[-1])
        replay = SampledTorque(jnp.asarray(t), jnp.asarray(log.tau))
        # The batch is over all leaves of the control, so a replay is repeated for each motion.
        control = jax.tree.map(lambda x: jnp.broadcast_to(x, (args.batch, *x.shape)), replay)
    else:
        raise ValueError(f"--torque is {args.torque!r}; give {', '.join(_KINDS)}, or a log FILE.csv or FILE.npz")
    if args.batch > 1 and args.spread == 0 and "random" not in args.torque:
        raise ValueError(f"--batch {args.batch}: all motions would be the same; add --torque random or --spread")
    q0 = q0 if args.q0 is None else vector(model, args.q0, q0, "--q0")
    v0 = v0 if args.v0 is None else vector(model, args.v0, v0, "--v0")
    return control, q0, v0, duration


def _starts(scene: Scene, q0, v0, args) -> tuple[jax.Array, jax.Array]:
    """Initial positions (n, nq) and velocities (n, nv) of the motions, on the constraints."""
    # Another seed than that of the torques, which would be correlated with the starts otherwise.
    away = args.spread * jax.random.normal(jax.random.key(args.seed + 1), (args.batch, scene.nv))
    # Displacements on the manifold keep quaternions of unit length.
    starts = jax.vmap(lambda step: integrate(scene.system, jnp.asarray(q0), step))(away)
    speeds = jnp.broadcast_to(jnp.asarray(v0), (args.batch, scene.nv))
    if not scene.constraints:
        return starts, speeds
    # One by one: assembly checks concrete numbers and raises for a start that cannot close.
    closed = [assemble(scene, q, v) for q, v in zip(starts, speeds, strict=True)]
    moved = max(float(jnp.abs(x.q - q).max()) for x, q in zip(closed, starts, strict=True))
    if moved > 1e-9:
        print(f"loops assembled at the start by joint displacements of up to {moved:.3g} (rad, m)")
    return jnp.stack([x.q for x in closed]), jnp.stack([x.v for x in closed])


def _forces(scene: LoadedScene, args) -> list:
    """Forces of the file, with joint damping and friction replaced by options."""
    forces = list(scene.forces)
    for name, force in (("damping", JointDamping), ("friction", CoulombFriction)):
        if (given := getattr(args, name)) is None:
            continue
        values = per_coordinate(scene.system, given, f"--{name}")
        if np.any(values < 0):
            raise ValueError(f"--{name} is {values.tolist()}; it must not be negative")
        # A given value replaces that of the file; adding both would count friction twice.
        forces = [one for one in forces if not isinstance(one, force)] + ([force(values)] if values.any() else [])
    return forces


def _simulate(scene: Scene, control, carry: Model | None, starts, speeds, ts, options) -> tuple[Solution, jax.Array]:
    """Simulate all motions; return them with the torques at their rows, with a leading axis of motions."""

    # Model and options are captured as constants, which makes a faster program.
    @eqx.filter_jit
    def batch(control, starts, speeds):
        def one(control, q0, v0):
            if carry is not None:
                control = FourierTorque(control.cosine, control.sine, control.period, carry)
            solution = simulate(scene, q0, v0, ts, control=control, outputs=("energy", "work"), throw=False, **options)
            return solution, jax.vmap(control)(solution.q, solution.v, solution.ts)

        return jax.vmap(one)(control, starts, speeds)

    return batch(control, starts, speeds)


def _summarise(model: Model, solution: Solution, done: np.ndarray) -> None:
    steps = np.asarray(solution.stats["num_steps"])
    print(f"steps: {steps.min()} to {steps.max()}" if steps.min() < steps.max() else f"steps: {steps.max()}")
    if not done.any():
        return
    energy, work = np.asarray(solution.energy)[done], np.asarray(solution.work)[done]
    # Rows of motions that stopped early are NaN and are left out by `done`.
    drift = np.abs(energy - energy[:, :1] - work).max()
    # The drift means little without the scale of the energy that was exchanged.
    exchanged = max(np.ptp(energy, axis=1).max(), np.abs(work).max())
    print(
        f"energy minus work of torques and friction: at most {drift:.2e} J from its initial value, "
        f"for {exchanged:.4g} J exchanged"
    )
    q = np.asarray(solution.q)[done]
    far = np.any((q < np.asarray(model.lower)) | (q > np.asarray(model.upper)), axis=(0, 1))
    names = zip(model.joint_names, model.topology.q_slices, strict=True)
    if outside := [name for name, place in names if far[place].any()]:
        print(f"joints beyond their limits during the motion (limits are not enforced): {', '.join(outside)}")
