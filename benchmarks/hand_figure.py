"""A hand turns a ball: three fingers, their contact forces and margins printed, and drawn with their friction cones.

    python -m benchmarks.hand_figure [--out docs/figures] [--gif]

The ball is turned about the vertical and swayed sideways by `jd.control.GraspForce`, which also grips it. Writes hand.png: the
hand at the start and turned, and the margins over the time; with --gif also hand.gif, the moving picture.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.figure
import numpy as np

import jaxdyn as jd
from jaxdyn.reports.plotting import SERIES, style

MU, PRELOAD = 0.5, 2.5
TURN, SWAY = 0.7, 0.05  # rad, m
TS = np.linspace(0.0, 2.0, 41)


def target(t):
    """Where the ball is to be: turned by 0 to `TURN` and back in 2 s, and swayed by `SWAY` to either side, once a second."""
    half = TURN * (1 - jnp.cos(jnp.pi * t)) / 4
    zero = jnp.zeros_like(half)
    return jnp.stack([-SWAY * jnp.cos(2 * jnp.pi * t), zero, zero + 0.3, jnp.cos(half), zero, zero, jnp.sin(half)])


def turned_ball():
    """The grasp, and its motion with the outputs "multipliers", "contact_forces" and "contact_margins"."""
    grasp = jd.scenes.hand_with_ball(mass=0.2, mu=MU)
    q, v = jd.scenes.hand_with_ball.start(position=(-SWAY, 0.0, 0.3), turned=(0.0, 0.0, 0.0), twist=(0.0,) * 6)
    law = jd.control.GraspForce(grasp, target, kp=100.0, kd=20.0, preload=PRELOAD)
    outputs = ("multipliers", "contact_forces", "contact_margins")
    return grasp, jd.simulate(
        grasp, q, v, TS, control=law, stepsize=0.01, events=[jd.events.ContactLost(stop=False)], outputs=outputs
    )


def figure(grasp, motion) -> matplotlib.figure.Figure:
    """The hand at rest and turned, and the margins."""
    made = matplotlib.figure.Figure(figsize=(11.5, 4.2), dpi=110, layout="constrained")
    grid = made.add_gridspec(1, 3, width_ratios=(1, 1, 0.9))
    for column, row in enumerate((0, 11)):
        axes = made.add_subplot(grid[column], projection="3d")
        jd.draw(grasp, motion.q[row], axes, multipliers=motion.multipliers[row])
        axes.set_title(f"{TS[row]:.2f} s", fontsize=10)
        axes.set_zlabel("")
    axes = made.add_subplot(grid[2])
    style(axes)
    for color, (name, margin) in zip(SERIES, motion.contact_margins.items(), strict=False):
        axes.plot(TS, margin, color=color, label=f"{name}: margin")
        axes.plot(TS, motion.contact_forces[name][:, 2], color=color, linestyle=":", label=f"{name}: normal force")
    axes.set(
        xlabel="time (s)",
        ylabel="force (N)",
        ylim=(0, None),
        title=f"margin: {MU} normal - tangential",
    )
    axes.legend(fontsize=8, frameon=False)
    made.suptitle(
        "Red: force of a fingertip on the ball. Orange: its friction cone, within which it neither slips nor pulls",
        fontsize=10,
    )
    return made


def main(argv=None) -> None:
    """Simulate, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/figures"))
    parser.add_argument("--gif", action="store_true")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    grasp, motion = turned_ball()
    print(f"{'time':>5}  {'contact':8}  {'normal N':>9}  {'tangential N':>12}  {'margin N':>9}")
    for row in range(0, len(TS), 5):
        for name, force in motion.contact_forces.items():
            normal, slip = float(force[row, 2]), float(np.hypot(force[row, 0], force[row, 1]))
            print(
                f"{TS[row]:5.2f}  {name:8}  {normal:9.4f}  {slip:12.4f}  {float(motion.contact_margins[name][row]):9.4f}"
            )
    least = min(float(margin.min()) for margin in motion.contact_margins.values())
    print(f"{motion.result}; the least margin on the way is {least:.4f} N")
    options.out.mkdir(parents=True, exist_ok=True)
    figure(grasp, motion).savefig(options.out / "hand.png")
    if options.gif:
        jd.animate(grasp, motion, options.out / "hand.gif", fps=15)
    print("written to", options.out / "hand.png")


if __name__ == "__main__":
    main()
