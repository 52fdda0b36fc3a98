"""Draws docs/hands.svg: three fingers that hold a ball, the friction cones of their contacts and the least forces in them.

python -m benchmarks.hand_figure [file]
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import jaxdyn as jd

SCALE = 0.03  # m of the drawing for a newton


def main(path: str) -> None:
    """Hold the ball, and draw it."""
    mu = 0.8
    grasp = jd.scenes.hand_with_ball(mass=0.2, mu=mu)
    q, _ = jd.scenes.hand_with_ball.start()
    held = jd.grasp.hold(grasp, q, preload=0.5)
    model, forces = grasp.system, held.by_contact()
    figure = matplotlib.figure.Figure(figsize=(7, 6))
    axes = figure.add_subplot(projection="3d")
    ball = np.asarray(jd.frame_pose(model, q, "ball"))
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, 33), np.linspace(0, np.pi, 17))
    sphere = 0.1 * np.stack([np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)]) + ball[:3, 3, None, None]
    axes.plot_surface(*sphere, color="tab:blue", alpha=0.12, linewidth=0)
    angle = np.linspace(0, 2 * np.pi, 41)
    for i, contact in enumerate(grasp.constraints, 1):
        joints = [jd.frame_pose(model, q, name)[:3, 3] for name in (f"finger{i}_2", f"finger{i}_3", f"tip{i}")]
        axes.plot(*np.asarray(joints).T, color="0.2", linewidth=4, marker="o", label="fingers" if i == 1 else None)
        frame = ball @ np.asarray(contact.pose)
        force = frame[:3, :3] @ np.asarray(forces[contact.name])
        height = SCALE * float(forces[contact.name][2]) * 1.3
        # The cone opens into the ball, the way that a finger can push.
        edge = height * np.stack([mu * np.cos(angle), mu * np.sin(angle), np.ones_like(angle)])
        rim = frame[:3, :3] @ edge + frame[:3, 3:]
        both = np.stack([np.broadcast_to(frame[:3, 3:], rim.shape), rim], 1)
        axes.plot_surface(*both, color="tab:orange", alpha=0.3, linewidth=0)
        axes.plot(*rim, color="tab:orange", label="friction cones" if i == 1 else None)
        tip = frame[:3, 3] + SCALE * force
        axes.plot(
            *np.stack([frame[:3, 3], tip]).T, color="tab:red", linewidth=3, label="contact forces" if i == 1 else None
        )
        axes.plot(*tip[:, None], color="tab:red", marker="o", markersize=5)
    axes.set_aspect("equal")
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    axes.view_init(elev=35, azim=-60)
    axes.set_title(f"A ball of 0.2 kg, mu = {mu}: least forces with a margin of 0.5 N ({1 / SCALE:.0f} N per m)")
    axes.legend(loc="upper left")
    figure.savefig(path, bbox_inches="tight", dpi=90)
    margins = jd.grasp.contact_forces(grasp, jnp.asarray(held.contact_forces)).margins
    print(path, {name: round(float(margin), 6) for name, margin in margins.items()})


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    import matplotlib.figure

    main(sys.argv[1] if len(sys.argv) > 1 else str(Path(__file__).resolve().parent.parent / "docs" / "hands.svg"))
