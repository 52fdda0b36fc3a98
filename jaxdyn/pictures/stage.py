"""Stage of a picture: vertical direction, ground, view and colours, and matplotlib's axes that show it."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.constraints.loops import Distance, Loop
from jaxdyn.model.tree import Model
from jaxdyn.pictures.default_solids import complete_solids, frame_poses, pairs
from jaxdyn.pictures.motion import Motion
from jaxdyn.pictures.solids import Shape, Shapes
from jaxdyn.reports.plotting import BLUE, GREEN, ORANGE

# Colours of bodies without one, cycled: muted, so that arrows and marks stand out.
_BODIES = ("#8fa9c4", "#d9b382", "#93b8a1", "#c79c94", "#a9a3c2", "#b9b8a0")
LOOP, AXIS = ORANGE, BLUE
# Kinds of arrows, in the order of a legend.
COLORS = {
    "normal": "#c8201e",
    "friction": "#8e44ad",
    "bearing": "#d2691e",
    "contact": "#c8201e",
    "force": "#1b7f79",
    "torque": GREEN,
}
# Normals (columns) of three of the six great circles of sides that a subdivided icosahedron has.
_CIRCLES = np.array(
    [[1.0, 0.0, np.sqrt(5) / 2 + 0.5], [np.sqrt(5) / 2 + 0.5, 1.0, 0.0], [0.0, np.sqrt(5) / 2 + 0.5, 1.0]]
)


class Stage(NamedTuple):
    """Surroundings of the mechanism, in world axes and m.

    - `low`, `high` (3,): corners of the box around the motion; `centre` (3,), `size`, its middle and diagonal.
    - `up` (3,): against gravity; `ground`: height of the ground along it; `has_ground`: whether something is in contact with it.
    - `eye` (3,): unit vector from the centre towards the viewer.
    """

    low: np.ndarray
    high: np.ndarray
    centre: np.ndarray
    size: float
    up: np.ndarray
    ground: float
    has_ground: bool
    eye: np.ndarray


def all_solids(motion: Motion, shapes) -> Shapes:
    """Combine the given solids with default ones.

    **Raises:** ValueError for an argument without shapes, and for shapes on frames that the model does not have.
    """
    if shapes is None:
        shapes = Shapes()
    elif not isinstance(shapes, tuple | list) or not all(isinstance(item, Shape) for item in shapes):
        raise ValueError(
            f"shapes is {shapes!r}; give jd.pictures.shapes(path), a list of jaxdyn.pictures.Shape, or None"
        )
    shapes = shapes if isinstance(shapes, Shapes) else Shapes(shapes)
    model = motion.scene.system
    unknown = sorted(shapes.frames() - set(model.frame_names))
    if unknown:
        raise ValueError(
            f"shapes are on frames {', '.join(unknown[:5])}, which model {model.name!r} lacks; are they from another file?"
        )
    return complete_solids(motion.scene, shapes)


def stage_of(motion: Motion, shapes: Shapes) -> Stage:
    """Stage for a motion and its solids."""
    model = motion.scene.system
    points = [motion.poses[:, ::, :, :3, 3].reshape(-1, 3)]
    # Forty rows are enough for the bounds, and the vertices of all solids are placed in each.
    rows = motion._replace(poses=motion.poses[:, :: max(1, motion.poses.shape[1] // 40)])
    for shape in shapes:
        vertices, _ = shape.triangles()
        low, high = vertices.min(0), vertices.max(0)
        # Corners of the box and not all vertices: meshes have many thousands.
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        if shape.kind == "ellipsoid" and len(set(shape.size)) == 1:
            # The corners of a ball's box turn with it and reach below the ground on which it rolls.
            here = frame_poses(model, rows.poses, shape.frame)
            centre = (here @ shape.pose)[..., :3, 3].reshape(-1, 3)
            points += [centre + sign * shape.size[0] for sign in (-1.0, 1.0)]
            continue
        # A rolling cylinder would reach below the ground by the corners of its box.
        if shape.kind == "cylinder":
            corners = vertices
        here = frame_poses(model, rows.poses, shape.frame)
        points.append((corners @ np.swapaxes(here[..., :3, :3], -1, -2) + here[..., None, :3, 3]).reshape(-1, 3))
    every = np.concatenate(points)
    low, high = every.min(0), every.max(0)
    size = max(float(np.linalg.norm(high - low)), 1e-3)
    up = _up(model)
    ground, has_ground = _ground(motion, float((every @ up).min()), up, size)
    return Stage(low, high, (low + high) / 2, size, up, ground, has_ground, _eye(motion, high - low, up, has_ground))


def _up(model) -> np.ndarray:
    gravity = None if model.gravity is None else np.asarray(model.gravity, float)
    if gravity is None or not gravity.any():
        return np.array([0.0, 0.0, 1.0])
    # The nearest axis is vertical: an inclined plane is drawn inclined.
    axis = int(np.argmax(np.abs(gravity)))
    return -np.sign(gravity[axis]) * np.eye(3)[axis]


def _ground(motion: Motion, lowest: float, up: np.ndarray, size: float) -> tuple[float, bool]:
    """Height of the ground, and whether a contact of the scene is with it."""
    heights = []
    for constraint in pairs(motion.scene):
        if isinstance(constraint, Loop | Distance):
            continue
        (surface, pose), _ = constraint.ends()
        # A contact with a fixed, nearly level plane shows where the ground is.
        if surface is None and np.asarray(pose, float)[:3, 2] @ up > 0.9:
            heights.append(float(np.asarray(pose, float)[:3, 3] @ up))
    if heights and min(heights) <= lowest + 0.05 * size:
        return min(heights), True
    # The plane z = 0 is the ground where the mechanism is on it or just above.
    return (0.0 if -0.02 * size <= lowest <= 0.15 * size else lowest), False


def _eye(motion: Motion, extent: np.ndarray, up: np.ndarray, has_ground: bool) -> np.ndarray:
    joints = motion.poses[:, :, :, :3, 3].reshape(-1, 3)
    spread = np.ptp(joints, axis=0)
    flat = int(np.argmin(spread))
    widest = max(spread.max(), 1e-9)
    across = np.eye(3)[flat]
    if len(joints) > 2 and spread[flat] < 0.02 * widest and np.sort(spread)[1] > 0.1 * widest:
        if abs(across @ up) < 0.5:
            # A mechanism in a vertical plane is seen from the front, slightly from above.
            side = np.cross(up, across)
            return _unit(-across * (1.0 if flat == 1 else -1.0) + 0.35 * side + 0.3 * up)
        if not has_ground and not (motion.scene.constraints and extent @ np.abs(up) > 0.2 * widest):
            return _unit(0.35 * _sideways(up)[1] + 1.1 * up)
    one, other = _sideways(up)
    return _unit(one + 0.75 * other + 0.55 * up)


def _sideways(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal directions: x and -y where z is up."""
    axis = int(np.argmax(np.abs(up)))
    one = np.eye(3)[(axis + 1) % 3]
    return one, -np.cross(up, one)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def paint_sectors(shapes: Shapes, model: Model) -> Shapes:
    """Paint alternate sectors of round default solids darker, so that their turning is seen.

    A painted solid becomes two meshes. Wheels and balls of constraints are painted, and round bodies that turn freely.
    """
    parts = []
    for shape in shapes:
        body = -1 if shape.frame is None else model.topology.frame_bodies[model.frame_names.index(shape.frame)]
        free = ("free", "spherical", "planar", *(["continuous"] if shape.kind == "cylinder" else []))
        turns_freely = shape.source == "inertia" and body >= 0 and model.topology.kinds[body] in free
        turns = shape.source == "constraint" or turns_freely
        if not turns or shape.frame is None or shape.kind not in ("ellipsoid", "cylinder"):
            parts.append(shape)
            continue
        vertices, faces = shape.triangles()
        middle = (vertices[faces].mean(1) - shape.pose[:3, 3]) @ shape.pose[:3, :3]
        # Quarters of a wheel; parts of a ball between three great circles along the sides of its triangles.
        across = middle[:, :2] if shape.kind == "cylinder" else middle / shape.size @ _CIRCLES
        dark = np.prod(across, axis=1) > 0
        color = np.array(color_of(shape, model))
        for chosen, factor in ((dark, 0.62), (~dark, 1.0)):
            parts.append(
                dataclasses.replace(
                    shape, kind="mesh", size=(1.0,) * 3, pose=np.eye(4), vertices=vertices, faces=faces[chosen],
                    color=tuple(factor * color),
                )
            )  # fmt: skip
    return Shapes(parts, shapes.missing)


def color_of(shape: Shape, model) -> tuple[float, float, float]:
    """Colour (3,) from 0 to 1 of a solid: its own, or that of its body."""
    if shape.color is not None:
        red, green, blue = map(float, shape.color[:3])
        return red, green, blue
    index = -1 if shape.frame is None else model.topology.frame_bodies[model.frame_names.index(shape.frame)]
    return (0.7, 0.7, 0.7) if index < 0 else rgb(_BODIES[index % len(_BODIES)])


def rgb(code: str) -> tuple[float, float, float]:
    """Colour (3,) from 0 to 1 of a code #rrggbb."""
    red, green, blue = (int(code[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue


def new_axes(ax) -> Any:
    """Check 3D axes of matplotlib, or create them in a figure of their own for None."""
    if ax is None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(5.2, 4.6), dpi=110)
        # A canvas without a display; `savefig` and animations need one.
        FigureCanvasAgg(figure)
        return figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d")
    if getattr(ax, "name", "") != "3d":
        raise ValueError(
            f"ax is {type(ax).__name__}; give axes of projection '3d': figure.add_subplot(projection='3d')"
        )
    return ax


def fit_axes(ax) -> None:
    """Choose the height of the figure and the place of the axes, so that the box and its labels fill it."""
    from mpl_toolkits.mplot3d import proj3d

    figure, width = ax.figure, ax.figure.get_figwidth()
    # Kept free (inches): of the legend below, of the time of animations above.
    below = 0.08 + (0.2 * -(-len(figure.legends[0].get_texts()) // 2) if figure.legends else 0.0)
    margin, above = 0.16, 0.22
    limits = [ax.get_xlim(), ax.get_ylim(), ax.get_zlim()]
    corners = np.stack(np.meshgrid(*limits, indexing="ij"), -1).reshape(-1, 3)
    height = figure.get_figheight()
    side, centre = height, np.array([width, height]) / 2
    # Labels keep their size while the box is scaled, so that the scale is found by repetition.
    for _ in range(4):
        ax.set_position(((centre[0] - side / 2) / width, (centre[1] - side / 2) / height, side / width, side / height))
        figure.canvas.draw()
        x, y, z = corners.T
        flat = np.stack(proj3d.proj_transform(x, y, z, ax.get_proj())[:2], -1)
        boxes = [axis.get_tightbbox(figure.canvas.get_renderer()) for axis in (ax.xaxis, ax.yaxis, ax.zaxis)]
        edges = [ax.transData.transform(flat), *(box.get_points() for box in boxes if box is not None)]
        low, high = np.concatenate(edges).min(0) / figure.dpi, np.concatenate(edges).max(0) / figure.dpi
        room = np.array([width - margin, np.clip((high - low)[1] / (high - low)[0], 0.4, 1.0) * (width - margin)])
        scale = float((room / (high - low)).min())
        height = room[1] + below + above
        middle = np.array([width / 2, below + room[1] / 2])
        centre, side = middle - scale * ((low + high) / 2 - centre), scale * side
        figure.set_figheight(height)
    ax.set_position(((centre[0] - side / 2) / width, (centre[1] - side / 2) / height, side / width, side / height))


def set_stage(ax, stage: Stage) -> None:
    """Set equal scales, limits down to the ground, and the view."""
    # A flat mechanism would have limits of zero width, which matplotlib widens with a warning.
    extent = np.maximum(stage.high - stage.low, 0.12 * stage.size)
    low, high = stage.centre - 0.53 * extent, stage.centre + 0.53 * extent
    axis = int(np.argmax(np.abs(stage.up)))
    if stage.up[axis] > 0:
        low[axis] = min(low[axis], stage.ground)
    else:
        high[axis] = max(high[axis], -stage.ground)
    # matplotlib's angles are about the axis that it calls vertical, the other two in cyclic order.
    vertical = "xyz"[axis]
    a, b = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
    elevation = np.rad2deg(np.arcsin(np.clip(stage.eye @ np.eye(3)[axis], -1, 1)))
    azimuth = np.rad2deg(np.arctan2(stage.eye @ b, stage.eye @ a))
    # matplotlib draws its vertical axis upwards; gravity along the positive axis turns the picture over.
    roll = 0.0 if stage.up[axis] > 0 else 180.0
    ax.view_init(elevation, azimuth, roll, vertical_axis=vertical)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(high - low, zoom=1.1)  # after the vertical axis is set, by which matplotlib turns the numbers
    if stage.has_ground:
        lines = _grid(low, high, axis, np.sign(stage.up[axis]) * stage.ground)
        # Below all solids. One line with gaps is drawn faster than many.
        ax.plot(*lines.T, color="0.82", linewidth=0.8, zorder=0)
        ax.grid(False)
    for pane in (ax.xaxis, ax.yaxis, ax.zaxis):
        pane.set_pane_color((1.0, 1.0, 1.0, 0.0))
    for name, length in zip("xyz", high - low, strict=True):
        if length < 0.25 * (high - low).max():  # tick labels along a short axis would overlap
            getattr(ax, f"set_{name}ticks")([])
            continue
        getattr(ax, f"set_{name}label")(f"{name} (m)", fontsize=8)
        ax.tick_params(axis=name, labelsize=7)
        ax.locator_params(axis=name, nbins=5)


def _grid(low: np.ndarray, high: np.ndarray, axis: int, height: float) -> np.ndarray:
    """Points (k, 3) of the lines of a ground with square cells, with a gap (NaN) after each line."""
    across = [k for k in range(3) if k != axis]
    # A cell of 1, 2 or 5 times a power of ten can be read as a scale.
    wanted = (high - low)[across].max() / 12
    power = 10.0 ** np.floor(np.log10(wanted))
    cell = power * min(k for k in (1, 2, 5, 10) if k * power >= wanted)
    first, last = np.floor(low / cell) * cell, np.ceil(high / cell) * cell
    lines = []
    for along, other in (across, across[::-1]):
        for place in np.arange(first[other], last[other] + cell / 2, cell):
            line = np.full((3, 3), np.nan)
            line[:2, axis], line[:2, other] = height, place
            line[:2, along] = first[along], last[along]
            lines.append(line)
    return np.concatenate(lines)
