"""Drawings and animations with matplotlib, without browser, display or meshes."""

import os
import shutil
from typing import Any

import numpy as np

from jaxdyn.constraints.base import layout
from jaxdyn.model.arguments import Checked, Numbers, as_array, as_path
from jaxdyn.pictures.default_solids import frame_poses
from jaxdyn.pictures.motion import Cone, Motion, cones, forces, joint_axes, marks, motion_of
from jaxdyn.pictures.solids import Shapes, refine, simplify
from jaxdyn.pictures.stage import AXIS, FORCE, LOOP, TORQUE, Stage, all_solids, color_of, rgb, stage_of
from jaxdyn.reports.plotting import Axes
from jaxdyn.simulation.solution import Solution
from jaxdyn.systems.system import SceneLike

_MOST_VERTICES = 400  # of one mesh; matplotlib draws triangles one by one
_SIDES = 24  # of a round cone
CONE_HEIGHT = 0.095  # of a friction cone, as a fraction of the mechanism's size
# Longest side of a triangle, as a fraction of the mechanism's size: matplotlib sorts triangles by the depth of their
# centres, so that large ones would hide others wrongly.
_LONGEST = 0.1
_LIGHT = np.array([0.4, -0.5, 0.77])


def draw(
    scene: SceneLike,
    q: Numbers,
    ax: Checked[Axes | None] = None,
    *,
    shapes: Checked[Shapes | None] = None,
    multipliers: Numbers | None = None,
) -> Axes:
    """Draw a mechanism at a configuration: its bodies, joints with their axes, loops and contacts with their friction cones.

    **Arguments:**

    - `scene`: a `Scene` or `Model`.
    - `q` (nq,): the configuration.
    - `ax`: matplotlib axes of projection "3d" to draw into; None creates a figure.
    - `shapes`: solids to show, of `jd.pictures.shapes(path)`; None draws rods between joints and solids of the bodies' inertias.
    - `multipliers` (nc,): of the scene's rows, N and N m, as the contact forces of `jd.grasp.hold`, to be drawn as arrows.

    **Returns:** the axes, in m, axes of the world; `ax.figure.savefig(path)` writes the picture. Blue lines are axes
    of joints, orange circles loops and contacts, dashed lines distances. Orange cones are the friction cones of the scene,
    around the admissible contact forces; red arrows are forces, those of contacts on the object; the longest is as
    long as the cones are high, or a quarter of the mechanism.

    **Raises:** ValueError for a system without bodies, a q or multipliers that do not fit, and axes that are not 3D.
    ImportError without matplotlib.

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
        motion = motion._replace(multipliers=lam[None, None])
    picture = _Picture(motion, shapes, ax)
    picture.show(0)
    return picture.ax


def animate(
    scene: SceneLike,
    solution: Checked[Solution],
    path: str | os.PathLike,
    *,
    fps: int = 25,
    speed: float = 1.0,
    shapes: Checked[Shapes | None] = None,
) -> None:
    """Write a motion as an animation: GIF (by pillow, a dependency of matplotlib) or MP4 (by ffmpeg, where installed).

    **Arguments:** `scene`; `solution`, a result of `jd.simulate`, batched or not (at most four motions are drawn); `path`, a
    file .gif or .mp4; `fps`, frames per second; `speed`, seconds of motion per second; `shapes` as in `draw`.

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
    # Imported after the check, whose message names the package to install.
    from matplotlib.animation import FFMpegWriter, PillowWriter

    duration = float(np.ptp(np.asarray(solution.ts))) if hasattr(solution, "ts") else 0.0
    motion = motion_of(scene, solution, rows=max(2, round(duration / speed * fps) + 1), most=4)
    picture = _Picture(motion, shapes, None)
    writer = (PillowWriter if path.suffix.lower() == ".gif" else FFMpegWriter)(fps=fps)
    figure = picture.ax.figure
    # Fixed margins: a layout computed anew for each frame would make the picture jump.
    figure.set_layout_engine("none")
    with writer.saving(figure, str(path), dpi=80):
        for k in range(len(motion.ts)):
            picture.show(k)
            picture.ax.set_title(f"{motion.ts[k]:.2f} s", fontsize=9, color="0.3")
            writer.grab_frame()


def _matplotlib() -> None:
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError("drawings need matplotlib: pip install jaxdyn[plot]") from error


class _Picture:
    """Mechanism in 3D axes, to be shown at each row of its motion."""

    def __init__(self, motion: Motion, shapes, ax):
        _matplotlib()
        self.motion = motion
        parts = all_solids(motion, shapes)
        self.stage = stage_of(motion, parts)
        self.ax = _axes(ax)
        model = motion.scene.system
        self.solids = []
        for shape in parts:
            vertices, faces = simplify(*shape.triangles(), _MOST_VERTICES)
            vertices, faces = refine(vertices, faces, _LONGEST * self.stage.size)
            self.solids.append((shape.frame, vertices, faces, np.array(color_of(shape, model)), shape.opacity))
        self.axes, self.marks, self.forces = joint_axes(motion), marks(motion), forces(motion)
        self.cones = cones(motion)
        self.drawn: list = []
        _set_stage(self.ax, self.stage)

    def show(self, row: int) -> None:
        """Draw one row and remove the previous one."""
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

        for artist in self.drawn:
            # Removed one by one: clearing the axes would reset the view and the limits.
            artist.remove()
        self.drawn = []
        ax, size, model = self.ax, self.stage.size, self.motion.scene.system
        corners, colors = [], []
        for n in range(len(self.motion.q)):
            ghost = 0.3 if n else 1.0
            for frame, vertices, faces, color, opacity in self.solids:
                pose = frame_poses(model, self.motion.poses[n, row], frame)
                sides = (vertices @ pose[:3, :3].T + pose[:3, 3])[faces]
                # Lambert shading: matplotlib's own light source ignores the world axes.
                normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
                lengths = np.linalg.norm(normals, axis=1, keepdims=True)
                light = 0.78 + 0.24 * (normals / np.where(lengths > 0, lengths, 1.0)) @ _LIGHT
                corners.append(sides)
                shaded = np.clip(light[:, None] * color, 0, 1)
                colors.append(np.concatenate([shaded, np.full((len(faces), 1), opacity * ghost)], axis=1))
        for cone in self.cones:
            sides = cone_sides(cone, row, CONE_HEIGHT * self.stage.size)
            corners.append(sides)
            colors.append(np.tile([*rgb(LOOP), 0.2], (len(sides), 1)))
            rim = np.concatenate([sides[:, 1], sides[-1:, 2]])
            self.drawn += self.ax.plot(*rim.T, color=LOOP, linewidth=1.0, zorder=15)
        if corners:
            # One collection for all: depth is then sorted by triangles and not by bodies.
            shades = np.concatenate(colors)
            # Edges in the colour of their face close the seams that smoothing leaves between faces.
            # Those of a translucent face would show twice.
            seams = np.concatenate([shades[:, :3], shades[:, 3:] >= 1], axis=1)
            faces = Poly3DCollection(np.concatenate(corners), facecolors=shades, edgecolors=seams, linewidths=0.3)
            self.drawn.append(ax.add_collection3d(faces))
        self._lines(row, 0.06 * size)
        self._arrows(row, arrow_length(self.cones, self.stage.size))

    def _lines(self, row: int, length: float) -> None:
        for _, _, place, axis in self.axes:
            if axis is not None:
                ends = np.stack([place[0, row] - length * axis[0, row], place[0, row] + length * axis[0, row]])
                self.drawn += self.ax.plot(*ends.T, color=AXIS, linewidth=1.1, alpha=0.8)
        for mark in self.marks:
            ends = np.stack([mark.a[0, row], mark.b[0, row]])
            style: dict = dict(linestyle="--", linewidth=1.2) if mark.kind == "distance" else dict(linestyle="none")
            self.drawn += self.ax.plot(
                *ends.T, color=LOOP, marker="o", markersize=6, markerfacecolor="none", zorder=10, **style
            )

    def _arrows(self, row: int, length: float) -> None:
        for force, scale in scale_forces(self.forces, length):
            at, vector = force.places[0, row], force.vectors[0, row] * scale
            color = FORCE if force.kind == "force" else TORQUE
            # Lines, unlike matplotlib's arrows, are drawn above the faces in front of them.
            self.drawn += self.ax.plot(*arrow(at, vector).T, color=color, linewidth=1.8, zorder=20)


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


def scale_forces(forces, length: float):
    """Yield each force with the factor (m/N or m/(N m)) that gives the largest of its kind the length (m)."""
    # Forces and torques have different units and so a scale each.
    for kind in ("force", "torque"):
        members = [force for force in forces if force.kind == kind]
        # One scale for the whole motion, so that lengths of different rows compare.
        largest = max((float(np.linalg.norm(force.vectors, axis=-1).max()) for force in members), default=0.0)
        yield from ((force, length / largest) for force in members)


def _axes(ax) -> Any:
    if ax is None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(5.2, 4.6), dpi=110, layout="constrained")
        # A canvas without a display; `savefig` and the writers of animations need one.
        FigureCanvasAgg(figure)
        return figure.add_subplot(projection="3d")
    if getattr(ax, "name", "") != "3d":
        raise ValueError(
            f"ax is {type(ax).__name__}; give axes of projection '3d': figure.add_subplot(projection='3d')"
        )
    return ax


def _set_stage(ax, stage: Stage) -> None:
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
    for pane in (ax.xaxis, ax.yaxis, ax.zaxis):
        pane.set_pane_color((1.0, 1.0, 1.0, 0.0))
    for name, length in zip("xyz", high - low, strict=True):
        if length < 0.25 * (high - low).max():  # tick labels along a short axis would overlap
            getattr(ax, f"set_{name}ticks")([])
            continue
        getattr(ax, f"set_{name}label")(f"{name} (m)", fontsize=8)
        ax.tick_params(axis=name, labelsize=7)
        ax.locator_params(axis=name, nbins=5)
