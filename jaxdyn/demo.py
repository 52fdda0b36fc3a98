"""Rollouts of a real arm, a thousand rolling coins, and inertias from a noisy log: `python -m jaxdyn.demo`, or `make demo`.

No file is needed: the arm is the KUKA iiwa of `jaxdyn.robots`. A drawing of it and three figures are written into out/.
"""

import argparse
import importlib.util
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from jaxdyn.identify.excitation import Tracking, random_motion, random_torque
from jaxdyn.identify.result import segments
from jaxdyn.reports.plotting import BLUE, GREY, ORANGE, RED, bands, new_figure

# Standard deviation of the random torques of each joint (N m), about a tenth of what the arm's weight asks for.
TORQUES = (3.0, 3.0, 1.0, 1.0, 0.1, 0.1, 0.02)
# Viscous damping of the joints in the rollouts (N m s/rad), so that no joint winds up.
DAMPING = (4.0, 4.0, 2.0, 2.0, 0.4, 0.4, 0.1)
HOME = (0.0, 0.6, 0.0, -1.2, 0.0, 0.8, 0.0)
# Noise of the simulated log: encoders, velocities and torque sensors of a good arm.
NOISE_Q, NOISE_V, NOISE_TAU = 1e-4, 2e-3, 0.005


def rollouts(model, count: int, duration: float, progress: bool):
    """`count` motions under random torques added to gravity compensation; returns the solution and its seconds."""
    scene = jd.Scene(model, forces=(jd.forces.JointDamping(jnp.asarray(DAMPING)),))
    torques = jax.vmap(lambda key: random_torque(key, jnp.asarray(TORQUES), carry=model))(
        jax.random.split(jax.random.key(0), count)
    )
    ts = jnp.linspace(0.0, duration, 41)

    def one(control):
        return jd.simulate(
            scene, jnp.asarray(HOME), jnp.zeros(model.nv), ts, control=control, outputs=("energy", "work"), stepsize=0.004,
            events=[jd.events.Progress()] if progress else (), throw=False,
        )  # fmt: skip

    start = time.perf_counter()
    solution = jax.block_until_ready(jax.jit(jax.vmap(one))(torques))
    return solution, time.perf_counter() - start


def rolling_coins(count: int, duration: float):
    """`count` coins that roll without slipping from one place, each with a lean of its own; the solution and its seconds."""
    scene, ts = jd.scenes.rolling_coin(), jnp.linspace(0.0, duration, 101)
    leans = jnp.linspace(0.02, 0.5, count)

    def one(lean):
        q, v = jd.scenes.rolling_coin.start(lean=lean)
        # Steady rolling on a circle, at the same point of the ground, with a fifth more spin: the coins nod.
        q, v = q.at[1].add(-0.5), v * 1.2
        return jd.simulate(scene, q, v, ts, stepsize=0.004, outputs=("constraint_residual", "energy"), throw=False)

    start = time.perf_counter()
    solution = jax.block_until_ready(jax.jit(jax.vmap(one))(leans))
    return leans, solution, time.perf_counter() - start


def coin_figure(leans, solution) -> Any:
    """Paths of the coins' centres, coloured by the lean at the start, and how exactly they roll."""
    from matplotlib import colormaps

    figure, axes = new_figure(9.0, 4.0, 1, 2)
    left, right = axes[0]
    shades = (leans - leans[0]) / (leans[-1] - leans[0])
    for path, shade in zip(np.asarray(solution.q), np.asarray(shades), strict=True):
        left.plot(path[:, 0], path[:, 1], color=colormaps["viridis"](shade), linewidth=0.4, alpha=0.5)
    left.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    left.set_title(f"{len(leans)} rolling coins: centres; bright: large lean at the start", fontsize=9)
    ts, energy = np.asarray(solution.ts)[0], np.asarray(solution.energy)
    drift = np.abs(energy - energy[:, :1]) / np.abs(energy[:, :1])
    right.semilogy(ts[1:], drift.max(0)[1:] + 1e-17, color=ORANGE, label="energy, relative")
    right.semilogy(
        ts, np.asarray(solution.constraint_residual).max((0, -1)) + 1e-17, color=BLUE, label="constraints (m, m/s)"
    )
    right.set(xlabel="time (s)", ylabel="worst of all coins")
    right.legend(fontsize=8, frameon=False)
    return figure


def experiment(model, nominal, samples: int):
    """Two noisy logs of 10 s, for training and for testing.

    The arm follows random motions under a controller with the nominal model.
    """
    ts = np.linspace(0.0, 10.0, samples + 1)
    motions = [random_motion(jax.random.key(seed), jnp.asarray(HOME), jnp.full(7, 0.5), period=5.0) for seed in (1, 2)]
    gains = jnp.asarray(100.0), jnp.asarray(20.0)

    @jax.jit
    @jax.vmap
    def run(motion):
        control = Tracking(nominal, motion, *gains)
        q, v, _ = motion(0.0)
        solution = jd.simulate(
            model, q, v, ts, control=control, stepsize=jd.simulation.Steps(0.005, max_steps=4096), throw=False
        )
        return solution.q, solution.v, jax.vmap(control)(solution.q, solution.v, jnp.asarray(ts))

    rng = np.random.default_rng(0)
    logs = []
    for q, v, tau in zip(*map(np.asarray, run(jax.tree.map(lambda *x: jnp.stack(x), *motions))), strict=True):
        noise = [rng.normal(size=x.shape) for x in (q, v, tau)]
        tau_noise = NOISE_TAU * tau.std(0) * noise[2]
        logs.append(jd.identify.Log(ts, q + NOISE_Q * noise[0], v + NOISE_V * noise[1], tau=tau + tau_noise))
    return logs


def wrong_model(model):
    """The arm as a designer might guess it: masses off by up to 30 %, centres of mass by about a fifth of their distance."""
    rng = np.random.default_rng(1)
    guess = []
    for row in np.asarray(model.inertias):
        center = row[1:4] / row[0]
        guess.append(jd.inertia.displaced(row * rng.uniform(0.7, 1.3), 0.2 * rng.normal(size=3) * center))
    return model.replace(inertias=jnp.asarray(np.array(guess)))


def rollout_figure(model, solution) -> Any:
    """Joint angles of all motions, and the energy balance."""
    ts = np.asarray(solution.ts)[0]
    figure, axes = new_figure(11.0, 5.0, 2, 4)
    for j in range(model.nv):
        ax = axes.flat[j]
        bands(ax, ts, np.asarray(solution.q)[:, :, j], BLUE)
        ax.set_title(f"joint {j + 1}", fontsize=9)
        ax.set_xlabel("time (s)", fontsize=9)
        ax.set_ylabel("angle (rad)", fontsize=9)
    balance = np.abs(_balance(solution))
    ax = axes.flat[-1]
    ax.semilogy(ts[1:], np.median(balance, 0)[1:] + 1e-17, color=GREY, label="median")
    ax.semilogy(ts[1:], balance.max(0)[1:] + 1e-17, color=RED, label="worst")
    ax.set_title("energy minus work", fontsize=9)
    ax.set_xlabel("time (s)", fontsize=9)
    ax.set_ylabel("|E - E(0) - W| (J)", fontsize=9)
    ax.legend(fontsize=8, frameon=False)
    count = len(solution.q)
    figure.suptitle(f"{count} motions under random torques: median, 25 to 75 % and 5 to 95 % bands", fontsize=10)
    return figure


def _balance(solution):
    energy = np.asarray(solution.energy)
    return energy - energy[:, :1] - np.asarray(solution.work)


def torque_shares(model, base, log) -> np.ndarray:
    """Effect of a unit of each base parameter on the joint torques of a log: root mean square, in per cent of the torque."""
    a = np.gradient(log.v, log.t, axis=0)
    columns = jd.identify.regressor(model, log.q, log.v, a)[:, :, base.independent]
    return 100 * np.sqrt(np.mean((columns / np.asarray(log.tau).std(0)[None, :, None]) ** 2, axis=(0, 1)))


def fit_figure(shares, truth, start, fitted, history, test, before, after) -> Any:
    """Base parameters before and after, the course of the fit, and a held-out motion."""
    figure, axes = new_figure(11.5, 7.0, 2, 2)
    ax = axes[0, 0]
    for values, colour, label in ((start, ORANGE, "nominal"), (fitted, BLUE, "fitted")):
        ax.semilogy(
            1 + np.arange(len(truth)), shares * np.abs(values - truth), "o", color=colour, markersize=4, label=label
        )
    ax.set_xlabel(f"base parameter, 1 to {len(truth)}", fontsize=9)
    ax.set_ylabel("error, in % of the joint torques", fontsize=9)
    ax.set_ylim(bottom=1e-3)
    ax.legend(fontsize=8, frameon=False)
    ax.set_title("identifiable combinations of the inertias", fontsize=9)
    ax = axes[0, 1]
    ax.semilogy(np.asarray(history), color=BLUE)
    ax.set_xlabel("iteration", fontsize=9)
    ax.set_ylabel("mean squared motion error (relative)", fontsize=9)
    ax.set_title("descent through the simulator", fontsize=9)
    times = np.asarray(test.t) + np.arange(len(test.t))[:, None] * np.asarray(test.t)[:, -1:]
    for ax, joint in zip(axes[1], (1, 5), strict=True):
        for values, colour, label in ((before, ORANGE, "nominal"), (after, BLUE, "fitted")):
            error = (np.asarray(values[1]) - np.asarray(test.v))[:, :, joint]
            # Segments start anew from the measurement, so lines break between them.
            t, error = (np.pad(x, ((0, 0), (0, 1)), constant_values=np.nan).ravel() for x in (times, error))
            ax.plot(t, error, color=colour, linewidth=0.8, label=label)
        ax.set_xlabel("time (s)", fontsize=9)
        ax.set_ylabel("velocity error (rad/s)", fontsize=9)
        ax.set_title(f"held-out motion, joint {joint + 1}: simulated minus measured", fontsize=9)
        ax.legend(fontsize=8, frameon=False)
    return figure


def main(argv=None) -> dict[str, float]:
    """Run the demo; returns the numbers it prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rollouts", type=int, default=1024)
    parser.add_argument("--duration", type=float, default=2.0, help="length of the rollouts (s)")
    parser.add_argument("--samples", type=int, default=1000, help="samples of the 10 s log")
    parser.add_argument("--steps", type=int, default=120, help="iterations of the fit")
    parser.add_argument("--out", type=Path, default=Path("out"))
    options = parser.parse_args(argv)
    if importlib.util.find_spec("matplotlib") is None:
        parser.error("the demo draws figures, which need matplotlib: pip install jaxdyn[plot]")
    jax.config.update("jax_enable_x64", True)
    began = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    model = jd.robots.iiwa()
    mass = float(np.sum(model.inertias[:, 0]))
    print(f"Arm: {model.name}, {model.nb} bodies, {model.nv} joints, {mass:.2f} kg", flush=True)
    jd.draw(model, np.array(HOME)).figure.savefig(options.out / "arm.png")  # pyright: ignore[reportAttributeAccessIssue]
    print(f"   drawn after {time.perf_counter() - began:.1f} s: {options.out / 'arm.png'}", flush=True)

    print(
        f"\n1. {options.rollouts} motions of {options.duration:g} s under random torques on top of gravity compensation",
        flush=True,
    )
    solution, seconds = rollouts(model, options.rollouts, options.duration, progress=True)
    worst = float(np.abs(_balance(solution)).max())
    reach = float(np.abs(np.asarray(solution.energy) - np.asarray(solution.energy)[:, :1]).max())
    print(f"   {seconds:.1f} s, compiling included; the energy changes by up to {reach:.1f} J")
    print(f"   energy minus work: at most {worst:.1e} J")
    rollout_figure(model, solution).savefig(options.out / "rollouts.png")
    print(f"   drawn: {options.out / 'rollouts.png'}", flush=True)

    print(f"\n2. {options.rollouts} coins roll without slipping for {options.duration:g} s", flush=True)
    leans, coins, seconds = rolling_coins(options.rollouts, options.duration)
    gap = float(np.asarray(coins.constraint_residual).max())
    print(f"   {seconds:.1f} s, compiling included; constraints hold to {gap:.1e}")
    coin_figure(leans, coins).savefig(options.out / "coins.png")
    print(f"   drawn: {options.out / 'coins.png'}", flush=True)

    nominal = wrong_model(model)
    base = jd.identify.base_parameters(model)
    print(f"\n3. Inertias from a noisy 10 s log: 70 numbers, of which motion shows {len(base.names)} combinations")
    print(f"   noise: {NOISE_Q:g} rad, {NOISE_V:g} rad/s, {100 * NOISE_TAU:g} % of each joint's torque", flush=True)
    train, test = experiment(model, nominal, options.samples)
    settings: dict[str, Any] = {"horizon": 10, "substeps": 1}

    def report(step, loss, _):
        if step % 10 == 0:
            print(f"   iteration {step:4d}: motion error {loss:.3e}", flush=True)

    fit = jd.identify.fit_parameters(
        nominal,
        train,
        jd.identify.Parameters(nominal).inertias(),
        jd.identify.Objective("trajectory", **settings),
        jd.identify.Solver(steps=options.steps, tolerance=1e-3),
        jd.identify.Execution(callback=report),
    )
    print(f"   {len(fit.history) - 1} iterations, {jd.RESULTS[fit.result]}")
    errors = {}
    for name, candidate in (("nominal", nominal), ("fitted", fit.system), ("true", model)):
        errors[name] = jd.identify.trajectory_error(candidate, test, **settings)
        print(
            f"   {name:8s} held-out motion: position error {errors[name][0]:.3f} %, velocity error {errors[name][1]:.3f} %"
        )
    truth, start, fitted = (base.values(m.inertias.reshape(-1)) for m in (model, nominal, fit.system))
    print(f"\n   {'base parameter':32s} {'true':>10s} {'nominal':>10s} {'fitted':>10s}")
    for name, *values in zip(base.names, truth, start, fitted, strict=True):
        print(f"   {name:32s} " + " ".join(f"{value:10.5f}" for value in values))
    sizes = [100 * np.linalg.norm(x - truth) / np.linalg.norm(truth) for x in (start, fitted)]
    print(f"   error of all base parameters together: nominal {sizes[0]:.1f} %, fitted {sizes[1]:.2f} %")
    shares = torque_shares(model, base, test)
    torques = [np.sqrt(np.sum((shares * (x - truth)) ** 2)) for x in (start, fitted)]
    print(
        f"   the same, each weighted by its share of the torques: nominal {torques[0]:.1f} %, fitted {torques[1]:.2f} %"
    )
    motions = [jd.identify.rollout(m, test, **settings) for m in (nominal, fit.system)]
    pieces = segments(test, settings["horizon"], np.dtype(float))
    figure = fit_figure(shares, truth, start, fitted, fit.history, pieces, *motions)
    figure.savefig(options.out / "fit.png")
    names = ", ".join(str(options.out / f"{name}.png") for name in ("arm", "rollouts", "coins", "fit"))
    print(f"\nFigures: {names}; {time.perf_counter() - began:.0f} s in all")
    return {
        "energy minus work": worst,
        "gap of the coins": gap,
        "nominal": float(errors["nominal"][1]),
        "fitted": float(errors["fitted"][1]),
        "parameters before": float(sizes[0]),
        "parameters after": float(sizes[1]),
    }


if __name__ == "__main__":
    main()
