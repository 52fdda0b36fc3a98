"""Browser pages by viser: from a local server (`view`), or as one offline file (`save_html`)."""

import contextlib
import html
import io
import itertools
import logging
import os
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxdyn.model.arguments import Checked, Numbers, as_path
from jaxdyn.model.host_math import quaternion
from jaxdyn.pictures.default_solids import frame_poses
from jaxdyn.pictures.drawing import CONE_HEIGHT, arrow_length, cone_sides, scale_forces
from jaxdyn.pictures.motion import Cone, Motion, cones, forces, marks, motion_of, select_rows
from jaxdyn.pictures.solids import Shapes, merge_meshes, sharpen, simplify
from jaxdyn.pictures.stage import COLORS, LOOP, Stage, all_solids, color_of, paint_sectors, rgb, stage_of
from jaxdyn.simulation.solution import Solution
from jaxdyn.systems.system import SceneLike

MAX_BYTES = 2_000_000  # of a file
_FIELD_OF_VIEW = np.deg2rad(40.0)
_GHOSTS = 7  # motions of a batch in addition to the first
_GHOST_OPACITY = 0.25
# Numbers of vertices and rows of a served page, and of a file: coarser until it is small enough.
_SERVED = (60_000, 2_000)
_FILED = ((24_000, 300), (12_000, 200), (5_000, 120), (2_000, 60), (500, 30))
_PICTURES = 30  # frames per second


def view(
    scene: SceneLike,
    solution: Checked[Solution | Numbers],
    *,
    shapes: Checked[Shapes | None] = None,
    port: int | None = None,
    browser: bool = True,
    block: bool | None = None,
) -> "Viewer":
    """Show a motion in the browser: a local page with a time slider and a play button.

    The first motion of a batch is solid; up to seven more, evenly from the batch, are shown translucent. Red arrows are
    forces of constraints and contacts, where the solution has `multipliers` (`outputs=("multipliers",)`), green ones
    joint torques, where it has `torque`; the largest of each kind is a quarter of the mechanism long. Orange cones are the
    friction cones of the scene, those of the first motion.

    **Arguments:**

    - `scene`: a `Scene` or `Model`; `solution`: a result of `jd.simulate` for it, batched or not, or one configuration (nq,).
    - `shapes`: solids to show, of `jd.pictures.shapes(path)`; None draws rods between joints and solids of the bodies' inertias.
    - `port`: port of the page; None selects a free one. The server listens on 127.0.0.1 only.
    - `browser`: whether to open a browser; without a display only the address is printed.
    - `block`: whether to wait until Ctrl-C; by default in scripts, and not in a notebook or a prompt.

    **Returns:** `Viewer`, with `.url`, `.stop()` and, in a notebook, the motion in the cell.

    **Raises:** ValueError for a port in use, systems without bodies, arrays that do not fit the scene. ImportError
    without viser.
    """
    motion = motion_of(scene, solution, rows=_SERVED[1], maximum=1 + _GHOSTS)
    parts = all_solids(motion, shapes)
    viewer = Viewer(motion, parts, free_port(port))
    print(f"Showing the motion at {viewer.url}")
    if browser and not open_browser(viewer.url):
        print(
            "No browser could be opened; open that address in one, or write a file: jd.pictures.save_html(path, scene, solution)"
        )
    # sys.ps1 exists at a prompt only.
    is_interactive = hasattr(sys, "ps1") or "ipykernel" in sys.modules
    if (not is_interactive) if block is None else block:
        # Ctrl-C closes the page, and the script continues.
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                # The server runs in threads of its own.
                time.sleep(3600)
        viewer.stop()
    return viewer


def save_html(
    path: str | os.PathLike,
    scene: SceneLike,
    solution: Checked[Solution | Numbers],
    *,
    shapes: Checked[Shapes | None] = None,
) -> None:
    """Write a motion as one HTML file under 2 MB that plays without network and Python.

    It plays in the browser like the page of `view`. Meshes are simplified, and rows and trajectories dropped, until it is
    small enough: at most 300 rows, 30 a second, and eight motions of a batch.

    **Arguments:** `path`, a file .html; `scene`, `solution`, `shapes` as in `view`.

    **Raises:** ValueError as `view` does, and for a path that does not end in .html. ImportError without viser.

    ```python
    scene = jd.scenes.four_bar()
    turn = jd.simulate(scene, *jd.scenes.four_bar.start(), jnp.linspace(0.0, 2.0, 51), outputs=("multipliers",))
    jd.pictures.save_html("four_bar.html", scene, turn)
    ```
    """
    path = as_path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"path is {str(path)!r}; write to a file .html")
    if not path.parent.is_dir():
        raise ValueError(f"path is {str(path)!r}: there is no directory {path.parent}")
    # All rows: `_document` chooses them anew for each size.
    motion = motion_of(scene, solution, maximum=1 + _GHOSTS)
    path.write_text(_document(motion, all_solids(motion, shapes)), encoding="utf-8")


class Viewer:
    """Page of `jd.view`, served until `.stop()`. In a notebook it shows the motion in its cell.

    - `url`: its address.
    """

    def __init__(self, motion: Motion, parts: Shapes, port: int):
        self._motion, self._parts = motion, parts
        self._server = start_server(port)
        self._content = _Content(self._server, motion, parts, _SERVED[0])
        self._stopped = threading.Event()
        self.url = f"http://{HOST}:{self._server.get_port()}"
        if len(motion.ts) > 1:
            self._add_controls()

    def stop(self) -> None:
        """Close the page."""
        # Users may call `stop` after Ctrl-C has stopped the server already.
        if not self._stopped.is_set():
            self._stopped.set()
            stop_server(self._server)

    def _repr_html_(self) -> str:
        page = html.escape(_document(self._motion, self._parts))
        return f'<iframe srcdoc="{page}" width="100%" height="480" style="border:0"></iframe>'

    def _add_controls(self) -> None:
        gui, ts = self._server.gui, self._motion.ts
        # A slider needs a positive step, also for a motion of no length.
        step = max(float(np.ptp(ts)) / 1000, 1e-6)
        slider = gui.add_slider("time (s)", float(ts[0]), float(ts[-1]), step, float(ts[0]))
        play = gui.add_button("Play / pause")
        speed = gui.add_slider("speed", 0.1, 4.0, 0.1, 1.0)
        playing = threading.Event()

        @slider.on_update
        def _(_event) -> None:
            # The nearest row, because save points need not be evenly spaced.
            self._content.show(int(np.abs(ts - slider.value).argmin()))

        @play.on_click
        def _(_event) -> None:
            playing.clear() if playing.is_set() else playing.set()

        # A daemon thread, so that a forgotten viewer does not keep Python alive.
        def run() -> None:
            while not self._stopped.wait(1.0 / _PICTURES):
                if playing.is_set():
                    now = slider.value + speed.value / _PICTURES
                    slider.value = float(ts[0]) if now > ts[-1] else float(now)

        threading.Thread(target=run, daemon=True).start()


def _document(motion: Motion, parts: Shapes) -> str:
    """Build the page as one file, coarser until it is small enough."""
    text = ""
    for vertices, rows in _FILED:
        # Each try records anew, on a server of its own.
        with recording_server() as server:
            kept = select_rows(motion.ts, min(rows, 1 + int(np.ptp(motion.ts) * _PICTURES)))
            content = _Content(server, motion, parts, vertices)
            serializer = server.get_scene_serializer()
            for before, row in itertools.pairwise(kept):
                serializer.insert_sleep(float(motion.ts[row] - motion.ts[before]))
                content.show(int(row))
            text = serializer.as_html()
        if len(text) <= MAX_BYTES:
            return text
    raise ValueError(
        f"the page has {len(text) / 1e6:.1f} MB, more than {MAX_BYTES / 1e6:g} MB; show fewer motions: jax.tree.map(lambda x: "
        "x[:2], solution)"
    )


class _Content:
    """Content of a page: the stage and the mechanism, to be shown at each row of its motion."""

    def __init__(self, server, motion: Motion, parts: Shapes, vertices: int):
        self.motion, self.scene = motion, server.scene
        stage = stage_of(motion, parts)
        self.size = stage.size
        _set_stage(server, stage)
        self.bodies: list[tuple[int, str | None, Any]] = []
        meshes = list(_meshes(motion, paint_sectors(parts, motion.scene.system), vertices))
        for n in range(len(motion.q)):
            self._add_bodies(n, meshes)
        self.marks = [(mark, self._ball(k)) for k, mark in enumerate(marks(motion))]
        self.cones = [(cone, self._cone(k, cone)) for k, cone in enumerate(cones(motion))]
        self.forces = list(scale_forces(forces(motion), arrow_length([cone for cone, _ in self.cones], self.size)))
        self.arrows = None
        if self.forces:
            colors = np.array([rgb(COLORS[force.kind]) for force, _ in self.forces])
            self.arrows = self.scene.add_arrows(
                "/forces",
                self._arrows(0),
                (255 * colors).astype(np.uint8),
                shaft_radius=0.006 * self.size,
                head_radius=0.014 * self.size,
                head_length=0.035 * self.size,
            )
        self.show(0)

    def _add_bodies(self, n: int, meshes) -> None:
        groups = {}
        for k, (frame, color, opacity, vertices, faces) in enumerate(meshes):
            if n and frame is None:
                continue  # solids fixed to the world appear once
            if frame not in groups:
                # Solids are children of their body's frame; this frame alone moves in each row.
                groups[frame] = "/world" if frame is None else f"/motion{n}/{_escape(frame)}"
                self.bodies.append((n, frame, self.scene.add_frame(groups[frame], show_axes=False)))
            opacity = opacity * (_GHOST_OPACITY if n else 1.0)
            self.scene.add_mesh_simple(
                f"{groups[frame]}/solid{k}",
                vertices,
                faces,
                color=tuple(round(255 * x) for x in color),
                opacity=None if opacity == 1.0 else opacity,
                side="double",
                cast_shadow=not n,
            )

    def _ball(self, k: int) -> Any:
        color = tuple(round(255 * x) for x in rgb(LOOP))
        return self.scene.add_icosphere(f"/constraints/{k}", 0.012 * self.size, color, subdivisions=2)

    def _cone(self, k: int, cone: Cone) -> tuple[Any, np.ndarray]:
        """Cone mesh at the first row, and the inverse of its attitude there, because pages move rigid meshes only."""
        sides = cone_sides(cone, 0, CONE_HEIGHT * self.size) - cone.apex[0, 0]
        color = tuple(round(255 * x) for x in rgb(LOOP))
        faces = np.arange(3 * len(sides), dtype=np.uint32).reshape(-1, 3)
        handle = self.scene.add_mesh_simple(
            f"/cones/{k}", sides.reshape(-1, 3).astype(np.float32), faces, color=color, opacity=0.3, side="double"
        )
        return handle, _attitude(cone, 0).T

    def _arrows(self, row: int) -> np.ndarray:
        ends = [(f.places[0, row], f.places[0, row] + scale * f.vectors[0, row]) for f, scale in self.forces]
        return np.array(ends, np.float32)

    def show(self, row: int) -> None:
        """Move everything to a row of the motion."""
        model = self.motion.scene.system
        for n, frame, handle in self.bodies:
            pose = frame_poses(model, self.motion.poses[n, row], frame)
            handle.wxyz, handle.position = quaternion(pose[:3, :3]), pose[:3, 3]
        for mark, handle in self.marks:
            handle.position = mark.a[0, row]
        for cone, (handle, back) in self.cones:
            handle.wxyz, handle.position = quaternion(_attitude(cone, row) @ back), cone.apex[0, row]
        if self.arrows is not None:
            self.arrows.points = self._arrows(row)


def _escape(name: str) -> str:
    """Escape a name for viser's scene tree, where a slash separates parents from children."""
    return name.replace("%", "%25").replace("/", "%2F")


def _attitude(cone: Cone, row: int) -> np.ndarray:
    """Rotation that maps z to the cone's axis and, for a wedge, x to the direction across it."""
    axis = cone.axis[0, row]
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]) if cone.across is None else cone.across[0, row]
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis], 1)


def _meshes(motion: Motion, parts: Shapes, maximum: int) -> Iterator[tuple]:
    """Yield frame, colour, opacity, vertices and faces, one mesh for each frame and colour."""
    alike: dict[tuple, list] = {}
    for shape in parts:
        alike.setdefault((shape.frame, color_of(shape, motion.scene.system), shape.opacity), []).append(shape)
    groups = [(*key, [shape.triangles() for shape in members]) for key, members in alike.items()]
    total = sum(len(vertices) for *_, meshes in groups for vertices, _ in meshes)
    # Each mesh keeps the same fraction of its vertices, so that large ones do not use up the budget.
    share = min(1.0, maximum / max(total, 1))
    for frame, color, opacity, meshes in groups:
        # A lower bound keeps small parts recognisable.
        small = [simplify(v, f, max(24, int(share * len(v)))) if share < 1 else (v, f) for v, f in meshes]
        vertices, faces = sharpen(*merge_meshes(mesh for mesh in small if len(mesh[1])))
        yield frame, color, opacity, vertices.astype(np.float32), faces.astype(np.uint32)


def _set_stage(server, stage: Stage) -> None:
    scene = server.scene
    scene.set_up_direction(tuple(stage.up.tolist()))
    axis = int(np.argmax(np.abs(stage.up)))
    # Cells of 1 or 5 times a power of ten can be read as a scale.
    cell = 10.0 ** np.floor(np.log10(stage.size / 2))
    cell = cell / 2 if stage.size / cell < 5 else cell
    centre = np.where(np.abs(stage.up) > 0, stage.ground * stage.up, np.round(stage.centre / cell) * cell)
    width = 2 * cell * np.ceil(2.5 * stage.size / cell)
    scene.add_grid(
        "/ground",
        width,
        width,
        plane=("yz", "xz", "xy")[axis],
        cell_size=cell,
        section_size=5 * cell,
        cell_color=(214, 218, 224),
        section_color=(176, 184, 194),
        plane_color=(246, 247, 249),
        plane_opacity=1.0,
        shadow_opacity=0.25,
        fade_distance=8 * stage.size,
        # Slightly below the ground, so that bodies resting on it do not flicker with it.
        position=tuple((centre - 1e-4 * stage.size * stage.up).tolist()),
    )
    camera = server.initial_camera
    distance = 0.54 * stage.size / np.tan(_FIELD_OF_VIEW / 2)
    camera.fov = float(_FIELD_OF_VIEW)
    camera.near, camera.far = float(0.01 * stage.size), float(100 * stage.size)
    camera.look_at = stage.centre
    camera.position = stage.centre + distance * stage.eye


# --- local servers of viser for browser pages: their ports, log records and browsers ---


HOST = "127.0.0.1"


def start_server(port: int) -> Any:
    """Start a server of viser on this machine."""
    try:
        import viser
    except ImportError as error:
        raise ImportError("the viewer needs viser: pip install jaxdyn[view]") from error
    # Before the server starts, since browsers may connect at once.
    _port_filter.ports.add(port)
    logging.getLogger("websockets.server").addFilter(_port_filter)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        return viser.ViserServer(host=HOST, port=port, label="jaxdyn", verbose=False)


def stop_server(server) -> None:
    """Stop a server without its messages, and forget its port."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
    _port_filter.ports.discard(server.get_port())
    if not _port_filter.ports:
        logging.getLogger("websockets.server").removeFilter(_port_filter)


class _PortFilter(logging.Filter):
    """Log filter for our own ports, to which probes connect without a request (a browser's, a test's).

    Records of other servers in the process pass.
    """

    def __init__(self):
        super().__init__()
        self.ports: set[int] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        address = getattr(getattr(record, "websocket", None), "local_address", None)
        return not (isinstance(address, tuple) and len(address) > 1 and address[1] in self.ports)


_port_filter = _PortFilter()


@contextlib.contextmanager
def recording_server() -> Iterator[Any]:
    """Temporary server for recording a page; viser records only from a server."""
    server = start_server(free_port(None))
    try:
        yield server
    finally:
        stop_server(server)


def free_port(port: int | None) -> int:
    """Check that a port is free, or find a free one. **Raises:** ValueError for one in use or out of range."""
    if port is not None and not (isinstance(port, int) and 0 < port < 65536):
        raise ValueError(f"port is {port!r}; give a number from 1 to 65535, or None for a free one")
    with socket.socket() as probe:
        # A port in TIME_WAIT, of a viewer just closed, counts as free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port or 0))
        except OSError as error:
            raise ValueError(
                f"port {port} cannot be used ({error.strerror}); give another one, or None for a free one"
            ) from error
        return probe.getsockname()[1]


def open_browser(url: str) -> bool:
    """Open a graphical browser; return False where there is none."""
    if sys.platform.startswith("linux") and not any(
        os.environ.get(x) for x in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    ):
        return False
    return webbrowser.open(url)
