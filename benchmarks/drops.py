"""Random drops with contact by events: failures, penetration, energy, and processor time beside C MuJoCo.

    python -m benchmarks.drops [box corners rod quadruped hand] [--drops 1000] [--batch 250] [--seconds 1.0] [--mujoco]

- box: on four corners of one side, which it falls on; below, the other four pass through the ground.
- corners: the box on all eight. rod: a slender rod with its two ends. quadruped: a free trunk on four legs of three joints, held
  by springs and dampers. hand: a ball that falls between the tips of three fingers of three joints, which springs hold.

Starts are random: heights, directions, velocities and coefficients of friction, with restitution in half of the scenes.
A drop fails by its result code, by a penetration of more than 1e-7 m, or by a gain of more than 1e-6 of its energy between two
save points. Processor time is that of the process, per simulated second and drop, after its code is compiled and optimised.
"""

import argparse
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import timing
from jaxdyn.compile import wait_for_code
from jaxdyn.constraints.codes import CODES, code_of

G = 9.81
SIZE, MASS = np.array([0.2, 0.15, 0.1]), 1.0  # of the box
PENETRATION, GAIN = 1e-7, 1e-6
TOLERANCE = 1e-9  # of the motions: energy of their dense output holds to a thousand times that
SPRING, DAMPER = 40.0, 1.0  # N m/rad, N m s/rad, of joints
RATES = 25  # save points a second


class Drop(NamedTuple):
    """A scene by the friction and restitution of its contacts, its random starts, and the rest position of its joints."""

    scene: Callable
    starts: Callable
    rest: np.ndarray | None = None


def _random_pose(rng, count: int, height):
    """Positions and unit quaternions of free bodies, and velocities."""
    turn = rng.normal(size=(count, 4))
    turn /= np.linalg.norm(turn, axis=1)[:, None]
    place = np.c_[rng.uniform(-0.1, 0.1, (count, 2)), height]
    return np.c_[place, turn], rng.normal(size=(count, 6)) * np.array([1, 1, 1, 2, 2, 2])


def box(corners: int) -> Drop:
    """A box on the corners of its lower side, or on all of them."""
    moments = MASS / 12 * (np.sum(SIZE**2) - SIZE**2)
    points = [SIZE / 2 * (x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)][:corners]

    def scene(mu, e):
        builder = jd.ModelBuilder("box", gravity=(0.0, 0.0, -G))
        builder.add_body("box", None, "free", (MASS, (0, 0, 0), moments))
        feet = [
            jd.contact.ground_contact("box", at, mu, restitution=e, name=f"corner {i}") for i, at in enumerate(points)
        ]
        return jd.Scene(builder.build(), forces=feet)

    def starts(rng, count):
        q, v = _random_pose(rng, count, rng.uniform(0.2, 0.4, count))
        if corners == 4:  # within 0.5 rad of upright, as it has no other corners
            turn = rng.normal(size=(count, 3))
            turn *= (rng.uniform(0, 0.5, count) / np.linalg.norm(turn, axis=1))[:, None]
            q[:, 3:] = np.asarray(jax.vmap(jd.so3.matrix_to_quat)(jax.vmap(jd.so3.exp)(turn)))
            v[:, 3:] *= 0.25
        return q, v

    return Drop(scene, starts)


def rod() -> Drop:
    """A slender rod that tumbles on its two ends, which are small spheres."""

    def scene(mu, e):
        builder = jd.ModelBuilder("rod", gravity=(0.0, 0.0, -G))
        builder.add_body("rod", None, "free", (0.5, (0, 0, 0), (1e-4, 0.5 / 12 * 0.25, 0.5 / 12 * 0.25)))
        ends = [
            jd.contact.ground_contact("rod", (x, 0, 0), mu, restitution=e, radius=0.02, name=name)
            for name, x in (("left", -0.25), ("right", 0.25))
        ]
        return jd.Scene(builder.build(), forces=ends)

    return Drop(scene, lambda rng, count: _random_pose(rng, count, rng.uniform(0.3, 0.6, count)))


def quadruped() -> Drop:
    """A trunk on four legs: hip about x, hip about y, knee about y; point feet."""
    rest = np.tile([0.0, 0.6, -1.2], 4)

    def scene(mu, e):
        builder = jd.ModelBuilder("quadruped", gravity=(0.0, 0.0, -G))
        builder.add_body("trunk", None, "free", (6.0, (0, 0, 0), (0.03, 0.09, 0.1)))
        feet = []
        for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            leg = f"{'front' if x > 0 else 'hind'} {'left' if y > 0 else 'right'}"
            builder.add_body(f"{leg} hip", "trunk", "revolute", (0.3, (0, 0.02 * y, 0), (4e-4, 4e-4, 4e-4)),
                             axis=(1, 0, 0), pose=(0.2 * x, 0.08 * y, 0))  # fmt: skip
            builder.add_body(f"{leg} thigh", f"{leg} hip", "revolute", (0.4, (0, 0, -0.08), (1e-3, 1e-3, 2e-4)),
                             axis=(0, 1, 0), pose=(0, 0.05 * y, 0))  # fmt: skip
            builder.add_body(f"{leg} shank", f"{leg} thigh", "revolute", (0.15, (0, 0, -0.08), (5e-4, 5e-4, 1e-4)),
                             axis=(0, 1, 0), pose=(0, 0, -0.16))  # fmt: skip
            feet.append(jd.contact.ground_contact(f"{leg} shank", (0, 0, -0.16), mu, restitution=e, name=leg))
        return jd.Scene(builder.build(), forces=feet)

    def starts(rng, count):
        q, v = _random_pose(rng, count, rng.uniform(0.35, 0.5, count))
        turn = rng.uniform(-0.3, 0.3, (count, 3))
        q[:, 3:] = np.asarray(jax.vmap(jd.so3.matrix_to_quat)(jax.vmap(jd.so3.exp)(turn)))
        joints = rest + rng.uniform(-0.2, 0.2, (count, 12))
        return np.c_[q, joints], np.c_[0.3 * v, rng.normal(size=(count, 12))]

    return Drop(scene, starts, rest)


def hand() -> Drop:
    """A hand of three fingers of three joints (swing, proximal, distal), and a ball of 4 cm that falls between their tips.

    The fingers point up, about a circle, and springs close them on the ball; it may roll, slip out, and fall below the hand.
    """
    rest = np.tile([0.0, -0.1, -0.4], 3)

    def scene(mu, e):
        builder = jd.ModelBuilder("hand", gravity=(0.0, 0.0, -G))
        builder.add_body("ball", None, "free", jd.inertia.sphere(0.1, 0.04))
        tips = []
        for i in range(3):
            angle = 2 * np.pi * i / 3
            finger, place = f"finger {i}", 0.07 * np.array([np.cos(angle), np.sin(angle), 0.0])
            pose = (tuple(place), (0.0, 0.0, angle))
            links = (("swing", "world", 0.01, (1, 0, 0)), ("proximal", "swing", 0.06, (0, 1, 0)),
                     ("distal", "proximal", 0.05, (0, 1, 0)))  # fmt: skip
            height = 0.0
            for name, parent, length, axis in links:
                builder.add_body(f"{finger} {name}", None if parent == "world" else f"{finger} {parent}", "revolute",
                                 (0.8 * length, (0, 0, length / 2), (2e-5, 2e-5, 4e-6)), axis=axis, armature=1e-5,
                                 pose=pose if parent == "world" else (0, 0, height))  # fmt: skip
                height = length
            touching = jd.rolling_sphere(f"{finger} distal", (0, 0, 0.05), 0.01, on="sphere", surface_body="ball",
                                         surface_radius=0.04, name=finger)  # fmt: skip
            tips.append(jd.contact.UnilateralContact(touching, mu, restitution=e))
        return jd.Scene(builder.build(), forces=tips)

    def starts(rng, count):
        q, v = _random_pose(rng, count, rng.uniform(0.17, 0.21, count))
        q[:, :2] *= 0.1
        joints = rest + rng.uniform(-0.1, 0.1, (count, 9))
        return np.c_[q, joints], np.c_[0.1 * v, 0.3 * rng.normal(size=(count, 9))]

    return Drop(scene, starts, rest)


DROPS = {"box": lambda: box(4), "corners": lambda: box(8), "rod": rod, "quadruped": quadruped, "hand": hand}
# Of hands the springs are softer, by the size of a finger.
SOFTNESS = {"hand": 0.005}


class Held(NamedTuple):
    """The torque of springs and dampers at the last joints."""

    rest: Any
    spring: float
    damper: float

    def __call__(self, q, v, t):
        n = self.rest.size
        torque = -self.spring * (q[-n:] - self.rest) - self.damper * v[-n:]
        return jnp.concatenate([jnp.zeros(v.size - n, v.dtype), torque])


class Outcome(NamedTuple):
    """Results of drops: codes, time reached, number of events, largest penetration (m), gain of energy, relative."""

    code: Any
    reached: Any
    events: Any
    steps: Any
    depth: Any
    gain: Any


def run(name: str, seconds: float = 1.0, most: int = 4000, **options) -> tuple[Callable, Callable]:
    """A function of one drop (q0, v0, mu, e) -> `Outcome`, and starts(rng, count)."""
    drop = DROPS[name]()
    control, softness = None, SOFTNESS.get(name, 1.0)
    if drop.rest is not None:
        control = Held(jnp.asarray(drop.rest), SPRING * softness, DAMPER * softness)
    ts = jnp.linspace(0.0, seconds, max(2, round(RATES * seconds) + 1))

    def once(q0, v0, mu, e):
        scene = drop.scene(mu, e)
        law = None if control is None else jax.tree_util.Partial(control)
        how = {
            "stepsize": jd.Steps(rtol=TOLERANCE, atol=TOLERANCE),
            "events": [jd.events.ModeSwitches(most)],
            "throw": False,
            **options,
        }
        motion = jd.simulate(scene, q0, v0, ts, control=law, outputs=("energy",), **how)
        energy: Any = motion.energy
        if drop.rest is not None:
            bent = motion.q[:, -drop.rest.size :] - drop.rest[None]
            energy = energy + SPRING * softness / 2 * jnp.sum(bent**2, 1)
        gaps = jax.vmap(
            lambda q: jnp.stack([force.contact.position(scene.system, q, 0.0)[0] for force in scene.forces])
        )
        depth = -jnp.min(jnp.where(jnp.isfinite(motion.q[:, :1]), gaps(motion.q), jnp.inf))
        gain = jnp.max(jnp.nan_to_num(jnp.diff(energy), nan=0.0)) / jnp.max(jnp.abs(energy[:1]))
        return Outcome(
            code_of(motion.result),
            motion.stats["time_reached"],
            motion.events.count,
            motion.stats["num_steps"],
            depth,
            gain,
        )

    return once, drop.starts


def samples(starts, count: int, seed: int = 0):
    """Random starts, coefficients of friction, and of restitution: none in half of the drops."""
    rng = np.random.default_rng(seed)
    q0, v0 = starts(rng, count)
    mu, e = rng.uniform(0.1, 1.0, count), np.where(rng.random(count) < 0.5, 0.0, rng.uniform(0.0, 0.8, count))
    return tuple(jnp.asarray(x) for x in (q0, v0, mu, e))


def failures(outcome: Outcome) -> Counter:
    """Numbers of the drops that failed, by the reason."""
    codes = [CODES[int(code)] for code in np.asarray(outcome.code)]
    deep, gains = np.asarray(outcome.depth) > PENETRATION, np.asarray(outcome.gain) > GAIN
    reasons = [
        code if code != "successful" else "penetration" if a else "energy" if b else None
        for code, a, b in zip(codes, deep, gains, strict=True)
    ]
    return Counter(reason for reason in reasons if reason)


def with_mujoco(q0, v0, mu, seconds: float) -> float:
    """Processor time of C MuJoCo per second and drop of the box, in one thread with its default step."""
    import mujoco as _mujoco

    mujoco: Any = _mujoco  # without types
    x, y, z = SIZE / 2
    source = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option gravity="0 0 {-G}"/><worldbody><geom type="plane" size="9 9 1"/>
        <body><freejoint/><geom type="box" size="{x} {y} {z}" mass="{MASS}"/></body></worldbody></mujoco>"""
    )
    data, steps = mujoco.MjData(source), round(seconds / source.opt.timestep)
    start = time.process_time()
    for q, v, friction in zip(np.asarray(q0), np.asarray(v0), np.asarray(mu), strict=True):
        mujoco.mj_resetData(source, data)
        source.geom_friction[:, 0] = friction
        data.qpos[:], data.qvel[:] = q, v
        for _ in range(steps):
            mujoco.mj_step(source, data)
    return (time.process_time() - start) / len(q0) / seconds


def main():
    """Print a table of the failures, and of the time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--drops", type=int, default=1000, help="a multiple of the batch")
    parser.add_argument("--batch", type=int, default=250)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mujoco", action="store_true")
    options = parser.parse_args()
    if options.drops % options.batch:
        parser.error(f"--drops {options.drops} is no multiple of --batch {options.batch}")
    jax.config.update("jax_enable_x64", True)
    for name in timing.chosen_names(options.names, DROPS):
        once, starts = run(name, options.seconds)
        given = samples(starts, options.drops, options.seed)
        first = time.process_time()
        call = jax.jit(jax.vmap(once)).lower(*(x[: options.batch] for x in given)).compile()
        wait_for_code()
        first = time.process_time() - first
        parts, spent = [], time.process_time()
        for at in range(0, options.drops, options.batch):
            parts.append(jax.device_get(call(*(x[at : at + options.batch] for x in given))))
        spent = (time.process_time() - spent) / options.drops / options.seconds
        whole = jax.tree.map(lambda *x: np.concatenate(x), *parts)
        bad = failures(whole)
        print(
            f"{name}: {options.drops} drops, {sum(bad.values())} failures {dict(bad)}; events {whole.events.mean():.1f} (at most "
            f"{whole.events.max()}), steps {whole.steps.mean():.0f}; penetration {np.nanmax(whole.depth):.1e} m, gain of energy "
            f"{np.nanmax(whole.gain):.1e}; {1e3 * spent:.2f} ms of processor a second; compiled in {first:.0f} s",
            flush=True,
        )
        if options.mujoco and name in ("box", "corners"):
            q0, v0, mu, _ = (x[: min(64, options.drops)] for x in given)
            print(f"  MuJoCo: {1e3 * with_mujoco(q0, v0, mu, options.seconds):.2f} ms", flush=True)


if __name__ == "__main__":
    main()
