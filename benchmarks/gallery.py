"""Moving pictures of scenes for the page docs/gallery.md: `python -m benchmarks.gallery [--out docs/gallery] [SCENE ...]`.

Each scene of the page is simulated from its start and written as a GIF. The files are not kept in the repository: `make docs`
makes those that are missing.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxdyn as jd
from benchmarks.hand_figure import turned_ball

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
    "rolling_coin": 1.5,
    "ball_on_turntable": 4.0,
    "chaplygin_sleigh": 4.0,
    "snakeboard": 4.0,
    "differential_drive": 4.0,
    "bicycle": 0.8,
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
    jd.animate(scene, motion, partial, fps=15, speed=duration * 15 / _FRAMES)
    partial.replace(folder / f"{name}.gif")
    return time.perf_counter() - began


def main(argv=None) -> None:
    """Write the pictures of the scenes named, or of all that are missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", help="by default all whose file is missing")
    parser.add_argument("--out", type=Path, default=Path("docs/gallery"))
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    options.out.mkdir(parents=True, exist_ok=True)
    chosen = options.scenes or [name for name in SCENES if not (options.out / f"{name}.gif").exists()]
    if unknown := [name for name in chosen if name not in SCENES]:
        raise ValueError(f"no scenes of the gallery: {', '.join(unknown)}; they are {', '.join(SCENES)}")
    for name in chosen:
        print(f"{name}: {write(name, options.out):.0f} s", flush=True)


if __name__ == "__main__":
    main()
