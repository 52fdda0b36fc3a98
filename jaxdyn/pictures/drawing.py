"""Drawings and animations with matplotlib, without browser, display or meshes."""

import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence

import numpy as np

from jaxdyn.constraints.base import layout
from jaxdyn.model.arguments import Checked, Numbers, as_array, as_path
from jaxdyn.model.tree import Model
from jaxdyn.pictures.default_solids import frame_poses
from jaxdyn.pictures.motion import Cone, Force, Motion, cones, forces, joint_axes, marks, motion_of
from jaxdyn.pictures.solids import Shapes, refine, simplify
from jaxdyn.pictures.stage import (
    AXIS,
    COLORS,
    LOOP,
    all_solids,
    color_of,
    fit_axes,
    new_axes,
    paint_sectors,
    rgb,
    set_stage,
    stage_of,
)
from jaxdyn.reports.plotting import Axes
from jaxdyn.simulation.solution import Solution
from jaxdyn.systems.system import SceneLike

_MAX_VERTICES = 400  # of one mesh; matplotlib draws triangles one by one
_SIDES = 24  # of a round cone
CONE_HEIGHT = 0.095  # of a friction cone, as a fraction of the mechanism's size
# Longest side of a triangle, as a fraction of the mechanism's size: matplotlib sorts triangles by the depth of their
# centres, so that large ones would hide others wrongly.
_LONGEST = 0.1
_LIGHT = np.array([0.4, -0.5, 0.77])
# Faces turned away by more than this (sine of the angle to the line of sight) are behind others of their solid.
_TURNED_AWAY = 0.12
_DPI = 80  # of animations


def draw(
    scene: SceneLike,
    q: Numbers | Checked[Solution],
    ax: Checked[Axes | None] = None,
    *,
    shapes: Checked[Shapes | None] = None,
    multipliers: Numbers | None = None,
    frames: Checked[Sequence[str]] = (),
    points: Checked[Mapping[str, tuple] | None] = None,
) -> Axes:
    """Draw a mechanism at a configuration: its bodies, joints with their axes, loops and contacts with their friction cones.

    **Arguments:**

    - `scene`: a `Scene` or `Model`.
    - `q` (nq,): the configuration; or what `jd.simulate` returned, whose last state is drawn, with the paths of `points`
      and the forces of its `multipliers`.
    - `ax`: matplotlib axes of projection "3d" to draw into; None creates a figure that fits the mechanism.
    - `shapes`: solids to show, of `jd.pictures.shapes(path)`; None draws rods between joints and solids of the bodies' inertias.
    - `multipliers` (nc,): of the scene's rows, N and N m, as the contact forces of `jd.grasp.hold`, to be drawn as arrows.
    - `frames`: names of frames to draw with their axes x (red), y (green) and z (blue), and their name.
    - `points`: points to name, `{"P": ("coupler", (0.3, 0.1, 0.0))}` with coordinates (m) in a frame.

    **Returns:** the axes, in m, axes of the world; `ax.figure.savefig(path)` writes the picture. Blue lines are axes
    of joints, orange circles loops and contacts, dashed lines distances. Orange cones are the friction cones of the scene,
    around the admissible contact forces. Arrows are forces, each kind (normal, friction, bearing, contact) with a colour
    and a scale of its own, which the legend gives: the longest of a kind is a quarter of the mechanism, or as long as the
    cones are high. Forces of contacts with cones are those on the object.

    **Raises:** ValueError for a system without bodies, a q or multipliers that do not fit, frames that the model does not
    have, and axes that are not 3D. ImportError without matplotlib.

    ```python
    jd.draw(jd.scenes.four_bar(), jd.scenes.four_bar.start()[0]).figure.savefig("four_bar.png")
    ```
    """
    motion = motion_of(scene, q)
    if multipliers is not None:
        count = places[-1].end if (places := layout(motion.scene)) else 0
        lam = np.asarray(as_array(multipliers, "multipliers"), float)
        if lam.shape != (count,):
            raise ValueError(f"multipliers has shape {lam.shape}, expected ({count},), one per row of the scene")
        # One motion with one row, as `forces` expects.
        motion = motion._replace(multipliers=np.broadcast_to(lam, (*motion.q.shape[:2], count)))
    picture = _Picture(motion, shapes, ax, _name_frames(motion.scene.system, frames, points))
    picture.show(-1)
    return picture.ax


def animate(
    scene: SceneLike,
    solution: Checked[Solution],
    path: str | os.PathLike,
    *,
    fps: int = 25,
    speed: float = 1.0,
    shapes: Checked[Shapes | None] = None,
    frames: Checked[Sequence[str]] = (),
    points: Checked[Mapping[str, tuple] | None] = None,
) -> None:
    """Write a motion as an animation: GIF (by pillow, a dependency of matplotlib) or MP4 (by ffmpeg, where installed).

    **Arguments:** `scene`; `solution`, a result of `jd.simulate`, batched or not (at most four motions are drawn); `path`, a
    file .gif or .mp4; `fps`, frames per second; `speed`, seconds of motion per second; `shapes`, `frames` and `points` as
    in `draw`.

    **Raises:** ValueError for another kind of file, MP4 without ffmpeg, numbers that are not positive, systems
    without bodies. ImportError without matplotlib.

    ```python
    scene = jd.scenes.four_bar()
    turn = jd.simulate(scene, *jd.scenes.four_bar.start(), jnp.linspace(0.0, 2.0, 51))
    jd.animate(scene, turn, "four_bar.gif")
    ```
    """
    path = as_path(path)
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise ValueError(f"path is {str(path)!r}; write to a file .gif or .mp4")
    if path.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
        raise ValueError(f"path is {str(path)!r}, but ffmpeg is not installed; install it, or write a .gif")
    if not (fps > 0 and speed > 0):
        raise ValueError(f"fps is {fps}, speed is {speed}; give positive numbers")
    if not path.parent.is_dir():
        raise ValueError(f"path is {str(path)!r}: there is no directory {path.parent}")
    _matplotlib()
    duration = float(np.ptp(np.asarray(solution.ts))) if hasattr(solution, "ts") else 0.0
    motion = motion_of(scene, solution, rows=max(2, round(duration / speed * fps) + 1), maximum=4)
    picture = _Picture(motion, shapes, None, _name_frames(motion.scene.system, frames, points))
    images = picture.images()
    if path.suffix.lower() == ".gif":
        _write_gif(path, images, fps)
    else:
        _write_mp4(path, images, fps)


def _write_gif(path, images: list[np.ndarray], fps: int) -> None:
    # Imported on use: pillow comes with matplotlib.
    from PIL import Image

    # One palette for all frames: it is found once, and colours do not flicker.
    palette = Image.fromarray(images[len(images) // 2]).quantize(200)
    first, *others = [Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0)


def _write_mp4(path, images: list[np.ndarray], fps: int) -> None:
    height, width, _ = images[0].shape
    size = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
    # Players expect colours of half the resolution, and so an even number of pixels.
    even = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]
    command = ["ffmpeg", "-y", "-loglevel", "error", *size, *even, str(path)]
    subprocess.run(command, input=b"".join(image.tobytes() for image in images), check=True)


def _matplotlib() -> None:
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError("drawings need matplotlib: pip install jaxdyn[plot]") from error


def _name_frames(model: Model, frames, points) -> list[tuple[str, str | None, np.ndarray, bool]]:
    """Name, frame, point (3,) in it, and whether its axes are drawn, of what a picture names."""
    named = [(str(name), name, np.zeros(3), True) for name in ([frames] if isinstance(frames, str) else frames)]
    for name, place in (points or {}).items():
        if not (isinstance(place, tuple | list) and len(place) == 2 and np.shape(place[1]) == (3,)):
            raise ValueError(f"points[{name!r}] is {place!r}; give (frame, (x, y, z)), in m in the frame")
        named.append((str(name), place[0], np.asarray(place[1], float), False))
    for name, frame, _, _ in named:
        if frame is not None and frame not in model.frame_names:
            raise ValueError(
                f"{name!r} is on the frame {frame!r}, which the model lacks: {', '.join(model.frame_names)}"
            )
    return named


class _Picture:
    """Mechanism in 3D axes, to be shown at each row of its motion."""

    def __init__(self, motion: Motion, shapes, ax, named):
        _matplotlib()
        self.motion = motion
        parts = all_solids(motion, shapes)
        self.stage = stage_of(motion, parts)
        self.ax, fits = new_axes(ax), ax is None
        model = motion.scene.system
        self.solids = []
        for shape in paint_sectors(parts, model):
            vertices, faces = simplify(*shape.triangles(), _MAX_VERTICES)
            vertices, faces = refine(vertices, faces, _LONGEST * self.stage.size)
            # Faces of files may have any orientation, and of a translucent solid both sides show.
            closed = shape.source != "file" and shape.opacity >= 1
            self.solids.append((shape.frame, vertices, faces, np.array(color_of(shape, model)), shape.opacity, closed))
        self.axes, self.marks, self.forces = joint_axes(motion), marks(motion), forces(motion)
        self.cones = cones(motion)
        self.scales = list(scale_forces(self.forces, arrow_length(self.cones, self.stage.size)))
        self.named = [
            (name, axes, (frame_poses(model, motion.poses, frame), point)) for name, frame, point, axes in named
        ]
        self.drawn: list = []
        set_stage(self.ax, self.stage)
        if self.scales:
            # In a figure of the user's every drawing has a legend of its own.
            place, loc = (self.ax.figure, "lower center") if fits else (self.ax, "upper left")
            place.legend(handles=_legend(self.scales), loc=loc, ncols=2, fontsize=8, frameon=False)
        if fits:
            fit_axes(self.ax)

    def images(self) -> list[np.ndarray]:
        """Pixels (height, width, 3) of all rows."""
        ax, images = self.ax, []
        figure, canvas = ax.figure, ax.figure.canvas
        figure.set_dpi(_DPI)
        canvas.draw()
        # Axes and ground do not move: drawn once, they are the background of every row.
        background = canvas.copy_from_bbox(figure.bbox)
        clock = figure.text(0.02, 0.97, "", va="top", fontsize=9, color="0.3")
        for k, t in enumerate(self.motion.ts):
            self.show(k)
            clock.set_text(f"{t:.2f} s")
            canvas.restore_region(background)
            for artist in sorted([*self.drawn, clock], key=lambda artist: artist.get_zorder()):
                if hasattr(artist, "do_3d_projection"):
                    artist.do_3d_projection()
                artist.draw(canvas.get_renderer())
            images.append(np.array(canvas.buffer_rgba())[..., :3].copy())
        return images

    def show(self, row: int) -> None:
        """Draw one row and remove the previous one."""
        for artist in self.drawn:
            # Removed one by one: clearing the axes would reset the view and the limits.
            artist.remove()
        self.drawn = []
        self._faces(row)
        self._lines(row, 0.06 * self.stage.size)
        for force, scale in self.scales:
            at, vector = force.places[0, row], force.vectors[0, row] * scale
            # Lines, unlike matplotlib's arrows, are drawn above the faces in front of them.
            self._plot(arrow(at, vector), color=COLORS[force.kind], linewidth=1.8, zorder=20)

    def _plot(self, points: np.ndarray, **style) -> None:
        self.drawn += self.ax.plot(*points.T, **style)

    def _faces(self, row: int) -> None:
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

        corners, colors, model = [], [], self.motion.scene.system
        for n in range(len(self.motion.q)):
            ghost = 0.3 if n else 1.0
            for frame, vertices, faces, color, opacity, closed in self.solids:
                pose = frame_poses(model, self.motion.poses[n, row], frame)
                sides = (vertices @ pose[:3, :3].T + pose[:3, 3])[faces]
                # Lambert shading: matplotlib's own light source ignores the world axes.
                normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
                lengths = np.linalg.norm(normals, axis=1, keepdims=True)
                normals = normals / np.where(lengths > 0, lengths, 1.0)
                if closed:
                    seen = normals @ self.stage.eye > -_TURNED_AWAY
                    sides, normals = sides[seen], normals[seen]
                corners.append(sides)
                shaded = np.clip((0.78 + 0.24 * normals @ _LIGHT)[:, None] * color, 0, 1)
                colors.append(np.concatenate([shaded, np.full((len(sides), 1), opacity * ghost)], axis=1))
        for cone in self.cones:
            sides = cone_sides(cone, row, CONE_HEIGHT * self.stage.size)
            corners.append(sides)
            colors.append(np.tile([*rgb(LOOP), 0.2], (len(sides), 1)))
            self._plot(np.concatenate([sides[:, 1], sides[-1:, 2]]), color=LOOP, linewidth=1.0, zorder=15)
        if corners:
            # One collection for all: depth is then sorted by triangles and not by bodies.
            shades = np.concatenate(colors)
            # Edges in the colour of their face close the seams that smoothing leaves between faces.
            # Those of a translucent face would show twice.
            seams = np.concatenate([shades[:, :3], shades[:, 3:] >= 1], axis=1)
            faces = Poly3DCollection(np.concatenate(corners), facecolors=shades, edgecolors=seams, linewidths=0.3)
            faces.set_zorder(5)
            # The limits are those of the stage; finding them again takes as long as drawing.
            self.drawn.append(self.ax.add_collection3d(faces, autolim=False))

    def _lines(self, row: int, length: float) -> None:
        from matplotlib.patheffects import withStroke

        halo = [withStroke(linewidth=3, foreground="white", alpha=0.8)]
        for place, axis in self.axes:
            ends = np.stack([place[0, row] - length * axis[0, row], place[0, row] + length * axis[0, row]])
            self._plot(ends, color=AXIS, linewidth=1.1, alpha=0.8)
        for mark in self.marks:
            ends = np.stack([mark.a[0, row], mark.b[0, row]])
            style: dict = dict(linestyle="--", linewidth=1.2) if mark.kind == "distance" else dict(linestyle="none")
            self._plot(ends, color=LOOP, marker="o", markersize=6, markerfacecolor="none", zorder=10, **style)
        for name, has_axes, (poses, point) in self.named:
            path = (poses @ np.append(point, 1.0))[0, : row % len(self.motion.ts) + 1, :3]
            at = path[-1]
            if has_axes:
                for column, color in enumerate(("#c8201e", "#2e8b57", "#2459a8")):
                    ends = np.stack([at, at + 1.5 * length * poses[0, row, :3, column]])
                    self._plot(ends, color=color, linewidth=1.6, zorder=25)
            else:
                self._plot(path, color="0.25", linewidth=1.0, zorder=12)
                self._plot(at[None], color="0.1", marker="o", markersize=4 if name else 0, zorder=25)
            # A name is read in front of bodies and lines that it crosses.
            self.drawn.append(self.ax.text(*(at + 0.3 * length), name, fontsize=9, zorder=30, path_effects=halo))


def cone_sides(cone: Cone, row: int, height: float) -> np.ndarray:
    """Triangles (k, 3, 3) of a friction cone of the first motion at one row, with a given height (m)."""
    apex, axis = cone.apex[0, row], cone.axis[0, row]
    if cone.across is not None:
        rim = np.stack([axis + sign * cone.slope * cone.across[0, row] for sign in (-1.0, 1.0)])
    else:
        # The unit vector least parallel to the axis keeps the cross product well conditioned.
        first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        first = first / np.linalg.norm(first)
        angles = np.linspace(0.0, 2 * np.pi, _SIDES + 1)[:, None]
        rim = axis + cone.slope * (np.cos(angles) * first + np.sin(angles) * np.cross(axis, first))
    rim = apex + height * rim
    return np.stack([np.broadcast_to(apex, rim[1:].shape), rim[:-1], rim[1:]], 1)


def arrow(at: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Points (9, 3) of a polyline that draws an arrow: the shaft, then a head of four lines."""
    tip, length = at + vector, np.linalg.norm(vector)
    if not length > 0:
        # A zero vector has no direction for a head.
        return np.broadcast_to(at, (2, 3))
    # The unit vector least parallel to the arrow, as for cones.
    first = np.cross(vector, np.eye(3)[np.argmin(np.abs(vector))])
    first = 0.06 * length * first / np.linalg.norm(first)
    second, back = np.cross(vector, first) / length, at + 0.8 * vector
    return np.array([at, tip, back + first, tip, back - first, tip, back + second, tip, back - second])


def arrow_length(shown: list[Cone], size: float) -> float:
    """Length (m) of the longest arrow: a quarter of the mechanism, or that of its friction cones."""
    return size * (CONE_HEIGHT if shown else 0.25)


def scale_forces(forces: list[Force], length: float):
    """Yield each force with the factor (m/N or m/(N m)) that gives the largest of its kind the length (m)."""
    # Kinds have scales of their own: friction would be invisible at the scale of a large normal force.
    for kind in COLORS:
        members = [force for force in forces if force.kind == kind]
        # One scale for the whole motion, so that lengths of different rows compare.
        largest = max((float(np.linalg.norm(force.vectors, axis=-1).max()) for force in members), default=0.0)
        yield from ((force, length / largest) for force in members)


def _legend(scales) -> list:
    """Lines that name the kinds of arrows, each with what its longest arrow stands for."""
    from matplotlib.lines import Line2D

    longest: dict[str, float] = {}
    for force, _ in scales:
        size = float(np.linalg.norm(force.vectors, axis=-1).max())
        longest[force.kind] = max(longest.get(force.kind, 0.0), size)
    return [
        Line2D([], [], color=COLORS[kind], label=f"{kind}, longest {size:.3g} N{' m' if kind == 'torque' else ''}")
        for kind, size in longest.items()
    ]
