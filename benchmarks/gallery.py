"""Moving pictures of scenes for the page docs/gallery.md: `python -m benchmarks.gallery [--out docs/gallery] [SCENE ...]`.

Each scene of the page is simulated from its start and written as a GIF. The files are not kept in the repository: `make docs`
makes those that are missing, and those whose scene, settings or drawing have changed since.
"""

import argparse
import ast
import hashlib
import inspect
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks.hand_figure import turned_ball
from jaxdyn.model import host_math
from jaxdyn.pictures.solids import Shape, Shapes, rod

# Length of the motion, s.
SCENES = {
    "four_bar": 3.0,
    "slider_crank": 3.0,
    "bennett": 4.0,
    "goldberg": 4.0,
    "bricard": 2.0,
    "sarrus": 0.6,
    "hinge_platform": 0.5,
    "windows": 3.0,
    "closed_ring": 2.0,
    "parallel_manipulator": 2.0,
    "rolling_coin": 1.0,
    "ball_on_turntable": 4.0,
    "chaplygin_sleigh": 3.0,
    "snakeboard": 2.0,
    "differential_drive": 3.0,
    "bicycle": 0.4,
    "hand_rolling_ball": 0.3,
    "coordinated_lifting": 0.5,
    "sphere_arm": 2.0,
    "hand_with_ball": 2.0,
    "hand_with_bar": 0.3,
    "hand_with_disk": 0.3,
    "hand_rolling_egg": 0.3,
    "allegro_with_cube": 0.1,
    "box_on_table": 4.0,
}
# Points whose paths are drawn.
POINTS = {
    "four_bar": {"middle of the coupler": ("coupler", (1.0, 0.0, 0.0))},
    "rolling_coin": {"": ("coin", (0.0, 0.0, 0.0))},
    "ball_on_turntable": {"": ("ball", (0.0, 0.0, 0.0))},
    "chaplygin_sleigh": {"blade": ("sleigh", (0.0, 0.0, 0.0))},
    "snakeboard": {"": ("board", (0.0, 0.0, 0.0))},
    "differential_drive": {"": ("chassis", (0.0, 0.0, 0.0))},
}


def axle(place=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Pose (4, 4) at a place with z along y."""
    pose = host_math.rotation_from_z(np.array([0.0, 1.0, 0.0]))
    pose[:3, 3] = place
    return pose


def solids(name: str) -> Shapes | None:
    """Solids of vehicles, whose inertia alone does not show what they are; None for the default ones."""
    parts = _vehicle(name)
    return Shapes(parts) if parts else None


def _vehicle(name: str) -> list[Shape] | None:

    def at(x, y, z):
        pose = np.eye(4)
        pose[:3, 3] = x, y, z
        return pose

    if name == "bicycle":
        # Origins: the rear frame in the rear hub, 0.3 m above the ground, the front frame on the steer axis above the axle.
        tilt = np.pi / 10
        front = (
            np.array([1.02, 0.0, 0.35])
            - (1.1, 0.0, 0.0)
            + 0.35 / np.cos(tilt) * np.array([np.sin(tilt), 0, -np.cos(tilt)])
        )
        steer, side = np.array([-np.sin(tilt), 0.0, np.cos(tilt)]), np.array([0.0, 0.28, 0.0])
        crank, seat, head, hub = (0.42, 0, -0.02), (0.22, 0, 0.6), (0.8, 0, 0.57), (0.0, 0.0, 0.0)
        frame = [
            rod("rear frame", a, b, 0.018)
            for a, b in ((hub, crank), (hub, seat), (crank, seat), (seat, head), (crank, head))
        ]
        fork = [
            rod("front frame", front, 0.75 * steer, 0.016),
            rod("front frame", 0.75 * steer - side, 0.75 * steer + side, 0.014),
        ]
        wheels = [
            Shape(f"{end} wheel", "cylinder", (radius, 0.035), axle(), source="constraint")
            for end, radius in (("rear", 0.3), ("front", 0.35))
        ]
        return [*frame, Shape("rear frame", "box", (0.25, 0.14, 0.05), at(0.2, 0, 0.64)), *fork, *wheels]
    if name == "snakeboard":
        board = Shape("board", "box", (0.5, 0.08, 0.02), at(0, 0, 0.09))
        rider = Shape("rotor", "box", (0.07, 0.4, 0.02), at(0, 0, 0.35))
        trucks = [Shape(f"{end} truck", "box", (0.14, 0.26, 0.02), at(0, 0, 0.09)) for end in ("front", "back")]
        wheels = [
            Shape(
                f"{end} truck",
                "cylinder",
                (0.04, 0.03),
                axle((0, y, 0.04)),
                source="constraint",
                color=(0.3,) * 3,
            )
            for end in ("front", "back")
            for y in (-0.1, 0.1)
        ]
        return [board, rod("rotor", (0, 0, 0.1), (0, 0, 0.34), 0.025), rider, *trucks, *wheels]
    if name == "chaplygin_sleigh":
        return [
            Shape("sleigh", "box", (0.9, 0.5, 0.06), at(0.3, 0, 0.12)),
            Shape("sleigh", "box", (0.3, 0.02, 0.12), at(0, 0, 0.06)),
            Shape("sleigh", "ellipsoid", (0.05,) * 3, at(0.3, 0, 0.17)),
            *(Shape("sleigh", "ellipsoid", (0.04,) * 3, at(0.65, y, 0.05)) for y in (-0.2, 0.2)),
        ]
    if name == "differential_drive":
        wheels = [
            Shape(f"{side} wheel", "cylinder", (0.1, 0.04), axle(), source="constraint") for side in ("left", "right")
        ]
        return [
            Shape("chassis", "cylinder", (0.24, 0.1), at(0.02, 0, 0.03)),
            Shape("chassis", "box", (0.08, 0.12, 0.08), at(0.2, 0, 0.1)),
            *wheels,
        ]
    return None


# Scenes whose pictures show the forces of their contacts.
_FORCES = ("hand_with_ball", "box_on_table")
_FRAMES = 40


def write(name: str, folder: Path) -> float:
    """Write FOLDER/NAME.gif; returns its seconds."""
    began = time.perf_counter()
    make, duration = getattr(jd.scenes, name), SCENES[name]
    if name == "hand_with_ball":
        scene, motion = turned_ball()
    else:
        scene, start = make(), make.start()
        ts = jnp.linspace(0.0, duration, _FRAMES)
        # Fingers under no torques would soon pull: the picture shows the motion that the rows allow.
        outputs = ("multipliers",) if name in _FORCES else ()
        events = [] if scene.cones is None else [jd.events.ContactLost(stop=False)]
        motion = jd.simulate(scene, start[0], start[1], ts, events=events, outputs=outputs)
    partial = folder / f"{name}.part.gif"
    speed, points = duration * 15 / _FRAMES, POINTS.get(name)
    jd.animate(scene, motion, partial, fps=15, speed=speed, shapes=solids(name), points=points)
    partial.replace(folder / f"{name}.gif")
    return time.perf_counter() - began


def digest(name: str) -> str:
    """SHA-256 of the code that a picture shows, without docstrings and comments: its settings and what writes it, here, the
    scene's module, and the package that draws.
    """
    scene = Path(inspect.getfile(inspect.unwrap(getattr(jd.scenes, name))))
    drawing = sorted(Path(inspect.getfile(jd.animate)).parent.glob("*.py"))
    here = [inspect.getsource(function) for function in (write, _vehicle)]
    settings = repr((SCENES[name], POINTS.get(name), name in _FORCES, _FRAMES))
    code = [settings, *map(_code, [*here, *(path.read_text(encoding="utf-8") for path in (scene, *drawing))])]
    return hashlib.sha256("\n".join(code).encode()).hexdigest()


def _code(source: str) -> str:
    """A program without its docstrings, comments and line breaks."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            del node.body[0]
    return ast.dump(tree)


def main(argv=None) -> None:
    """Write the pictures of the scenes named, or of all that are missing or were made by other code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", help="by default all that are missing or were made by other code")
    parser.add_argument("--out", type=Path, default=Path("docs/gallery"))
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    options.out.mkdir(parents=True, exist_ok=True)
    key = {name: options.out / f"{name}.sha256" for name in SCENES}
    chosen = options.scenes or [
        name
        for name in SCENES
        if not ((options.out / f"{name}.gif").exists() and key[name].exists() and key[name].read_text() == digest(name))
    ]
    if unknown := [name for name in chosen if name not in SCENES]:
        raise ValueError(f"no scenes of the gallery: {', '.join(unknown)}; they are {', '.join(SCENES)}")
    for name in chosen:
        print(f"{name}: {write(name, options.out):.0f} s", flush=True)
        key[name].write_text(digest(name))


if __name__ == "__main__":
    main()
