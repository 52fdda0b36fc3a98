"""`jaxdyn calibrate`: joint offsets, axes and link lengths of a robot from poses or markers measured at its tip."""

import argparse
import csv
import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxdyn import identify
from jaxdyn.cli.common import add_model_options, load_model, option, output_path, real, table, whole
from jaxdyn.constraints.codes import name_of
from jaxdyn.identify.geometry_errors import PARTS
from jaxdyn.io import save_urdf
from jaxdyn.model import host_math
from jaxdyn.model.arguments import as_path
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model

HELP = "calibrate joint offsets, axes and link lengths from poses or markers measured at the tip"
DESCRIPTION = """\
Fit joint offsets, axes, link lengths, base and tool of a robot to poses or to positions of a marker that an external device has
measured at its tip, and write the calibrated robot; or choose the poses to measure (--choose).
"""
EPILOG = """\
examples:
  jaxdyn calibrate arm.urdf --frame flange --choose 40 --out poses.csv
  jaxdyn calibrate arm.urdf --frame flange --poses poses.csv --out calibrated.urdf

The CSV file has a header: a column for each joint by its name (rad, m, as the encoders read it), the measured position x, y, z
(m), and for poses the unit quaternion qw, qx, qy, qz of the frame's rotation, all in axes of the measuring device. The device may
stand anywhere: the written robot has its frame, measuring_device, and the measured one at the tip, FRAME_measured, so that the
file gives measured poses by itself. Without a quaternion the position is that of one marker at the frame's origin, or near it.
"""
_POSITION, _QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
_DEVICE = "measuring_device"
# Largest deviation of a quaternion from length one: files have some four digits.
_UNIT = 1e-2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("urdf", help="the robot, where the fit starts")
    add_model_options(parser)
    option(parser, "--frame FRAME", "the link or frame that is measured", required=True)
    option(parser, "--poses FILE", "measured poses, .csv")
    option(parser, "--choose N", "choose N configurations to measure instead", whole)
    option(parser, "--marker", "with --choose: positions alone will be measured")
    option(parser, "--free PART ...", f"some of {', '.join(PARTS)} (default: all)", default=PARTS, choices=PARTS)
    option(parser, "--test SHARE", "share of the poses to hold out", real, 0.0)
    option(parser, "--seed SEED", "seed of the configurations to choose from (default: 0)", whole, 0)
    option(parser, "--out FILE", "write the calibrated robot, .urdf; with --choose the poses, .csv")


def run(args: argparse.Namespace) -> int:
    """Calibrate and write the robot, or choose poses and write these."""
    if (args.poses is None) == (args.choose is None):
        raise ValueError("give --poses FILE to calibrate, or --choose N to choose poses: one of them")
    out = output_path(args.out, (".csv",) if args.choose is not None else (".urdf",), "--out")
    model = load_model(args.urdf, args)
    if args.choose is not None:
        markers = np.zeros((1, 3)) if args.marker else None
        q = identify.choose_poses(model, args.choose, frame=args.frame, markers=markers, free=args.free, seed=args.seed)
        print(table(list(model.joint_names), [[f"{x:.4f}" for x in row] for row in q]))
        if out is not None:
            with open(out, "w", newline="", encoding="utf-8") as file:
                csv.writer(file).writerows([model.joint_names, *(map(repr, row) for row in q.tolist())])
            print(f"Wrote {out}.")
        return 0
    q, seen = read_poses(args.poses, model.joint_names)
    if not 0 <= args.test < 1:
        raise ValueError(f"--test is {args.test}; give a share of the poses from 0 to below 1")
    fitted = len(q) - round(args.test * len(q))
    measured: dict[str, Any] = {"poses" if seen.ndim == 3 else "positions": seen[:fitted]}
    fit = identify.fit_geometry(model, q[:fitted], frame=args.frame, free=tuple(args.free), **measured)
    if fitted < len(q):
        places = seen[:, :3, 3] if seen.ndim == 3 else seen
        error = np.sqrt(np.mean(np.sum((fit.predict(q[fitted:])[:, :3, 3] - places[fitted:]) ** 2, axis=1)))
        print(f"error on the {len(q) - fitted} poses held out: {1e3 * error:.4g} mm (root mean square)")
    print(fit.summary())
    if not bool(fit.success):
        print(f"NOT CONVERGED: {name_of(fit.result)}")
    if fit.expected is not None and fit.rank < fit.expected:
        print(f"{fit.expected - fit.rank} directions stay as in the file; measure poses that differ more (--choose)")
    if out is not None:
        save_urdf(add_measurement_frames(fit), out)
        print(f"Wrote {out}: the pose of {args.frame}_measured in axes of {_DEVICE} is the measured one.")
    return 0


def add_measurement_frames(fit: identify.GeometryFit) -> Model:
    """Calibrated model with two more frames: that of the measuring device in the world, and the measured one at the tool.

    The root stays where it is, because gravity is in its axes.
    """
    model, top = fit.model, fit.model.topology
    tip = frame_index(model, fit.frame)
    added = {
        _DEVICE: (-1, host_math.inverse(fit.base)),
        f"{fit.frame}_measured": (top.frame_bodies[tip], np.asarray(model.frame_poses)[tip] @ fit.tool),
    }
    # A file that was calibrated before has these frames already.
    kept = [k for k, name in enumerate(top.frame_names) if name not in added]
    poses = np.concatenate([np.asarray(model.frame_poses)[kept], [pose for _, pose in added.values()]])
    topology = dataclasses.replace(
        top,
        frame_names=(*(top.frame_names[k] for k in kept), *added),
        frame_bodies=(*(top.frame_bodies[k] for k in kept), *(body for body, _ in added.values())),
    )
    return dataclasses.replace(model, topology=topology, frame_poses=jnp.asarray(poses, model.home.dtype))


def read_poses(path: str, joints) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions (n, nq), and poses (n, 4, 4) or marker positions (n, 3), of a CSV file.

    **Raises:** ValueError for missing columns, entries that are no numbers (their row), and quaternions that are not of length 1.
    """
    file = as_path(path, "--poses")
    if not file.is_file():
        raise ValueError(f"--poses is {path!r}, which is no file; give a CSV file of measured poses")
    with open(file, newline="", encoding="utf-8") as lines:
        rows = [row for row in csv.reader(lines) if row]
    header = [name.strip() for name in rows[0]] if rows else []
    # One column of a quaternion announces all: a file with three is no file of markers.
    turned = any(name in header for name in _QUATERNION)
    wanted = (*joints, *_POSITION, *(_QUATERNION if turned else ()))
    missing = [name for name in wanted if name not in header]
    if missing or len(rows) < 2:
        what = f"has no columns {', '.join(missing)}" if missing else "has no rows"
        raise ValueError(
            f"{file} {what}; give a header with {', '.join((*joints, *_POSITION))}, for poses with "
            f"{', '.join(_QUATERNION)} too, and a row for each pose"
        )
    places = [header.index(name) for name in wanted]
    for i, row in enumerate(rows[1:], 2):
        if len(row) != len(header) or not all(_is_number(row[k]) for k in places):
            raise ValueError(f"{file}, line {i}: {', '.join(row)!r} are not {len(header)} finite numbers")
    numbers = np.array([[float(row[k]) for k in places] for row in rows[1:]])
    q, position = numbers[:, : len(joints)], numbers[:, len(joints) : len(joints) + 3]
    if not turned:
        return q, position
    quaternions = numbers[:, -4:]
    length = np.linalg.norm(quaternions, axis=1)
    off = np.abs(length - 1)
    if not off.max() < _UNIT:
        row = int(np.argmax(np.where(np.isfinite(off), off, np.inf)))
        raise ValueError(
            f"{file}, line {row + 2}: the quaternion has length {length[row]:.4g}; give unit ones, qw first"
        )
    return q, np.stack([host_math.joint_pose("free", np.zeros(6), x) for x in np.hstack([position, quaternions])])


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False
