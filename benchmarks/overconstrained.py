"""Overconstrained mechanisms against the same motions in minimal coordinates: the table of docs/constraints.md.

    python -m benchmarks.overconstrained [MECHANISM ...]

For each mechanism: the rows of its loops and their rank; steps of `jd.simulate` and the error of its coordinates at the end
(rad or m) at rtol = atol = 1e-6, 1e-8 and 1e-10; these steps over those of SciPy's DOP853 on Lagrange's equation in minimal
coordinates, with the same tolerances; and the order at which the error falls when fixed steps are halved. The equations in
minimal coordinates know nothing of constraints: closed forms give the places of all bars. Nothing here measures time.
"""

import argparse
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxdyn as jd
from jaxdyn.constraints.selection import select_rows

TOLERANCES = (1e-6, 1e-8, 1e-10)
GRAVITY = 9.81
# Errors below this part of the motion are rounding and tell no order.
_ROUNDING = 1e-12


class Mechanism(NamedTuple):
    """A scene, and its motion in minimal coordinates x.

    `scene`; `start(x, rate)` -> (q, v); `energies(x, rate)` -> kinetic and potential energy (J) in JAX; `x`, `rate` (n,) at
    the start; `span`, s; `steps`, fixed steps (RK4, Dopri8) of the coarser of two runs.
    """

    scene: jd.Scene
    start: Callable
    energies: Callable
    x: tuple[float, ...]
    rate: tuple[float, ...]
    span: float
    steps: tuple[int, int] = (20, 4)

    def acceleration(self) -> Callable:
        """x'' of (x, rate) by Lagrange's equations, (n,)."""

        def lagrangian(x, rate):
            kinetic, potential = self.energies(x, rate)
            return kinetic - potential

        @jax.jit
        def solve(x, rate):
            momentum = jax.grad(lagrangian, 1)
            mass = jax.jacfwd(momentum, 1)(x, rate)
            change = jax.jvp(lambda x: momentum(x, rate), (x,), (rate,))[1]
            return jnp.linalg.solve(mass, jax.grad(lagrangian)(x, rate) - change)

        return solve

    def minimal(self, times, rtol: float, start=None):
        """The motion in minimal coordinates by DOP853: x and rate (nt, 2 n), and the number of steps."""
        solve, n = self.acceleration(), len(self.x)
        y0 = np.concatenate([self.x, self.rate]) if start is None else np.concatenate(start)

        def equation(t, y):
            return np.concatenate([y[n:], np.asarray(solve(y[:n], y[n:]))])

        solved = solve_ivp(equation, (0.0, times[-1]), y0, "DOP853", dense_output=True, rtol=rtol, atol=rtol)
        return np.stack([solved.sol(t) for t in times]), len(solved.t) - 1

    def states(self, rows) -> tuple[np.ndarray, np.ndarray]:
        """q and v of rows of x and rate."""
        n = len(self.x)
        states = [self.start(row[:n], row[n:]) for row in rows]
        return np.stack([np.asarray(q) for q, _ in states]), np.stack([np.asarray(v) for _, v in states])


def _bars(masses, ends, speeds):
    """Kinetic energy of uniform bars with `ends` (n, 2, 3) that move at `speeds`, and their mean heights (n,)."""
    one, two = speeds[:, 0], speeds[:, 1]
    squares = jnp.sum(one * one + one * two + two * two, 1)
    return jnp.sum(masses * squares) / 6, jnp.sum(masses * ends.mean(1)[:, 2])


def _of_bars(masses, ends: Callable) -> Callable:
    """Energies of bars whose `ends(x)` (n, 2, 3) are known, under gravity along -z."""

    def energies(x, rate):
        kinetic, moment = _bars(jnp.asarray(masses), *jax.jvp(ends, (x,), (rate,)))
        return kinetic, GRAVITY * moment

    return energies


def _chain(angles, lengths, twists):
    """Ends (n, 2, 3) of links in a chain, by the parameters of Denavit and Hartenberg."""
    pose, places = jnp.eye(4), [jnp.zeros(3)]
    for angle, length, twist in zip(angles, lengths, twists, strict=True):
        c, s, ct, st = jnp.cos(angle), jnp.sin(angle), jnp.cos(twist), jnp.sin(twist)
        turn = jnp.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        pose = pose @ turn @ jnp.array([[1, 0, 0, length], [0, ct, -st, 0], [0, st, ct, 0], [0, 0, 0, 1]])
        places.append(pose[:3, 3])
    return jnp.stack([jnp.stack(places[:-1]), jnp.stack(places[1:])], 1)


def _turning(name: str, lengths, twists, masses, angle: float, steps=(20, 4)) -> Mechanism:
    """A linkage of one freedom whose links stand in a chain; the coordinate is its first angle."""
    make = getattr(jd.scenes, name)
    ends = lambda x: _chain(make.start(angle=x[0])[0], lengths, twists)  # noqa: E731
    start = lambda x, rate: make.start(angle=x[0], rate=rate[0])  # noqa: E731
    return Mechanism(make(), start, _of_bars(masses, ends), (angle,), (1.0,), 1.0, steps)


def bennett() -> Mechanism:
    """Bennett's linkage."""
    other = np.arcsin(0.7 * np.sin(1.1))
    return _turning("bennett", (1.0, 0.7, 1.0), (1.1, other, 1.1), np.ones(3), 0.8)


def goldberg() -> Mechanism:
    """Goldberg's five-bar linkage."""
    lengths = np.array([1.5, 0.7, 1.0, 0.5])
    shared, other = np.arcsin(np.array([0.7, 0.5]) * np.sin(1.1))
    return _turning("goldberg", lengths, (1.1 + other, shared, 1.1, other), lengths, 1.2)


def bricard() -> Mechanism:
    """Bricard's linkage with threefold symmetry."""
    return _turning("bricard", np.ones(5), 1.2 * np.array([1, -1, 1, -1, 1]), np.ones(5), 0.8, (20, 8))


def sarrus() -> Mechanism:
    """Sarrus's linkage; the coordinate is its height."""
    make, lengths, (bar, platform) = jd.scenes.sarrus, np.array([1.0, 0.8]), (1.0, 2.0)

    def energies(z, rate):
        cosines = 1 - z[0] ** 2 / (4 * lengths**2)
        moved = platform + bar * jnp.sum(1 / 2 + 1 / (6 * cosines))
        return moved * rate[0] ** 2 / 2, (platform + 2 * bar) * GRAVITY * z[0]

    start = lambda z, rate: make.start(height=z[0], rate=rate[0])  # noqa: E731
    return Mechanism(make(), start, energies, (0.9,), (2.5,), 0.6)


def _elbow(base, hinge, length):
    """The corner of an isosceles triangle over the way from `base` to `hinge`, to its left, (2,)."""
    way = hinge - base
    square = jnp.sum(way * way)
    return base + way / 2 + jnp.sqrt(length**2 / square - 0.25) * jnp.stack([-way[1], way[0]])


def _legs(count: int) -> Mechanism:
    """A platform on legs of hinges; the coordinates are its centre and its angle in the inclined plane."""
    make, tilt, length, radii, (bar, disk) = jd.scenes.hinge_platform, 0.5, 0.8, (1.2, 0.4), (0.5, 2.0)
    angles = 2 * np.pi * np.arange(count) / count
    corners = np.stack([np.cos(angles), np.sin(angles)], 1)

    def ends(x):
        c, s = jnp.cos(x[2]), jnp.sin(x[2])
        hinges = x[None, :2] + radii[1] * corners @ jnp.array([[c, s], [-s, c]])
        places = []
        for base, hinge in zip(radii[0] * corners, hinges, strict=True):
            elbow = _elbow(base, hinge, length)
            places += [jnp.stack([base, elbow]), jnp.stack([elbow, hinge])]
        return _inclined(jnp.stack(places), tilt)

    def energies(x, rate):
        kinetic, potential = _of_bars(np.full(2 * count, bar), ends)(x, rate)
        turning = radii[1] ** 2 / 2 * rate[2] ** 2
        kinetic += disk / 2 * (rate[0] ** 2 + rate[1] ** 2 + turning)
        return kinetic, potential + disk * GRAVITY * np.sin(tilt) * x[1]

    def start(x, rate):
        return make.start(count=count, point=x[:2], angle=x[2], velocity=rate[:2], rate=rate[2])

    return Mechanism(make(count=count), start, energies, (0.1, 0.2, 0.3), (0.3, 0.4, 0.5), 0.5)


def _inclined(places, tilt: float):
    """Points (..., 2) of a plane that is turned about x, in space."""
    x, y = places[..., 0], places[..., 1]
    return jnp.stack([x, np.cos(tilt) * y, np.sin(tilt) * y], -1)


def tilted_four_bar() -> Mechanism:
    """A planar four-bar linkage whose base is inclined, closed by a joint with all five rows."""
    lengths, masses, tilt, planar = (1.0, 3.0, 2.5, 3.5), (1.0, 3.0, 2.5), 0.7, jd.scenes.four_bar
    crank, coupler, rocker, ground = lengths
    bars = [
        (m, (size / 2, 0.0, 0.0), (0.0, m * size**2 / 12, m * size**2 / 12))
        for m, size in zip(masses, lengths, strict=False)
    ]
    pose = lambda x: ((x, 0.0, 0.0), (tilt, 0.0, 0.0))  # noqa: E731
    builder = jd.ModelBuilder("inclined four-bar", gravity=(0.0, 0.0, -GRAVITY))
    builder.add_body("crank", None, "continuous", bars[0], joint_name="1", pose=pose(0.0))
    builder.add_body("coupler", "crank", "continuous", bars[1], joint_name="2", pose=(crank, 0.0, 0.0))
    builder.add_body("rocker", None, "continuous", bars[2], joint_name="3", pose=pose(ground))
    knee = jd.loop("coupler", (coupler, 0.0, 0.0), "rocker", (rocker, 0.0, 0.0), name="knee")

    def ends(x):
        first, second, third = planar.start(angle=x[0])[0]
        elbow = crank * jnp.stack([jnp.cos(first), jnp.sin(first)])
        tip = elbow + coupler * jnp.stack([jnp.cos(first + second), jnp.sin(first + second)])
        foot = jnp.array([ground, 0.0])
        knee = foot + rocker * jnp.stack([jnp.cos(third), jnp.sin(third)])
        return _inclined(
            jnp.stack([jnp.stack([0 * elbow, elbow]), jnp.stack([elbow, tip]), jnp.stack([foot, knee])]), tilt
        )

    start = lambda x, rate: planar.start(angle=x[0], rate=rate[0])  # noqa: E731
    energies = _of_bars(np.array(masses), ends)
    return Mechanism(jd.Scene(builder.build(), (knee,)), start, energies, (1.0,), (1.0,), 1.0)


MECHANISMS: dict[str, tuple[str, Callable[[], Mechanism]]] = {
    "bennett": ("Bennett", bennett),
    "goldberg": ("Goldberg, five bars", goldberg),
    "bricard": ("Bricard, threefold symmetric", bricard),
    "sarrus": ("Sarrus", sarrus),
    "tilted_four_bar": ("four-bar, inclined base, 5-row joint", tilted_four_bar),
    "three_legs": ("platform on three legs of hinges", lambda: _legs(3)),
    "six_legs": ("platform on six legs of hinges", lambda: _legs(6)),
}


def distance(q, exact) -> float:
    """Largest difference of coordinates, angles up to turns."""
    off = np.asarray(q) - np.asarray(exact)
    return float(np.abs((off + np.pi) % (2 * np.pi) - np.pi).max())


def row(title: str, mechanism: Mechanism) -> list[str]:
    """Of the table."""
    scene, (q, v) = mechanism.scene, mechanism.start(np.asarray(mechanism.x), np.asarray(mechanism.rate))
    kept = select_rows(scene, np.asarray(q), 0.0).kept
    times = np.array([0.0, mechanism.span])
    exact = mechanism.states(mechanism.minimal(times, 1e-13)[0])[0][-1]

    def end(**options):
        return jd.simulate(scene, q, v, times, throw=False, **options)

    steps, errors, ratios = [], [], []
    for tolerance in TOLERANCES:
        motion, (_, least) = end(stepsize=jd.Steps(rtol=tolerance, atol=tolerance)), mechanism.minimal(times, tolerance)
        taken = int(motion.stats["num_accepted_steps"])
        steps.append(str(taken) if bool(motion.success) else "failed")
        errors.append(f"{distance(motion.q[-1], exact):.0e}")
        ratios.append(f"{taken / least:.2f}")
    orders = []
    for solver, count in zip((jd.solvers.RK4(), diffrax.Dopri8()), mechanism.steps, strict=True):
        coarse, fine = (
            distance(end(solver=solver, stepsize=mechanism.span / n).q[-1], exact) for n in (count, 2 * count)
        )
        orders.append("rounding" if fine < _ROUNDING else f"{np.log2(coarse / fine):.1f}")
    counts = [str(len(kept)), str(int(kept.sum()))]
    return [title, *counts, *(" / ".join(column) for column in (steps, errors, ratios)), *orders]


def main(argv=None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mechanisms", nargs="*", help=f"of {', '.join(MECHANISMS)}; by default all")
    chosen = parser.parse_args(argv).mechanisms or list(MECHANISMS)
    if unknown := [name for name in chosen if name not in MECHANISMS]:
        raise ValueError(f"no mechanisms: {', '.join(unknown)}; they are {', '.join(MECHANISMS)}")
    jax.config.update("jax_enable_x64", True)
    heads = [
        "mechanism",
        "rows",
        "rank",
        "steps at 1e-6 / 1e-8 / 1e-10",
        "error",
        "steps over DOP853's",
        "RK4",
        "Dopri8",
    ]
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}", flush=True)
    for name in chosen:
        title, build = MECHANISMS[name]
        print(f"| {' | '.join(row(title, build()))} |", flush=True)


if __name__ == "__main__":
    main()
