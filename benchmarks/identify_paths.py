"""Seconds of `fit_torques` and `fit_parameters` (error "torque") on a log of four joints, and the difference of their numbers.

    python -m benchmarks.identify_paths [--samples 1500] [--rounds 20]

The bodies start 10 % too heavy; free are their inertias, and viscous and Coulomb friction, offset and rotor of each joint. Both
priors are the entropic distance with the same weight, so that both losses have the same minimum. "cold" is the first fit of the
process, compilation and all; "warm" the best of the rounds, in which both take turns.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from jaxdyn import identify


def arm(joints: int) -> jd.Model:
    """Arm with joints about changing axes, with friction and rotors."""
    builder, parent = jd.ModelBuilder("arm"), None
    for i in range(joints):
        body = (2.0 - 0.3 * i, (0.02, 0.01, 0.15), (0.02, 0.018, 0.006))
        axis, pose = np.eye(3)[(2, 1, 1, 0)[i % 4]], (0, 0, 0.3 if i else 0.0)
        builder.add_body(f"link{i}", parent, pose=pose, axis=axis, inertia=body)
        parent = f"link{i}"
    ones = jnp.ones(joints)
    return builder.build().replace(damping=0.5 * ones, friction=0.3 * ones, armature=0.02 * ones)


def recorded(model: jd.Model, samples: int) -> identify.Log:
    """Log of a smooth motion with torque noise of 1 %."""
    rng, t = np.random.default_rng(0), np.linspace(0, 15, samples)
    w, size, phase = (rng.uniform(a, b, (4, model.nv)) for a, b in ((0.6, 5.0), (0.1, 0.5), (0.0, 6.0)))
    angle = w * t[:, None, None] + phase
    waves = (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle))
    q, v, a = (np.sum(size * x, axis=1) for x in waves)
    tau = identify.regressor(model, q, v, a) @ identify.nominal_parameters(model)
    return identify.Log(t, q, v, a, tau + 0.01 * np.sqrt(np.mean(tau**2, axis=0)) * rng.normal(size=tau.shape))


def fits(model: jd.Model, log: identify.Log):
    """Both fits as functions: by all parameters of a robot, and by a tree of the same numbers, with the noise of the first."""
    start = model.replace(inertias=1.1 * model.inertias)
    weights = 1 / np.sqrt(np.mean(np.asarray(log.tau) ** 2, axis=0))

    def robot():
        return identify.fit_torques(start, log, weights=weights)

    friction = identify.Friction(model.damping, model.friction, jnp.zeros(model.nv), jnp.asarray(0.01))
    scene = jd.Scene(start.replace(damping=None, friction=None), forces=[friction])
    tree = identify.Parameters(scene).inertias().positive(lambda s: [s.forces[0].viscous, s.forces[0].coulomb])
    tree = tree.free(lambda s: s.forces[0].offset).positive(lambda s: s.system.armature)
    # N / (4 noise^2) times the loss of one is that of the other.
    objective = identify.Objective("torque", noise=2**0.5 * float(robot().sigma))
    return robot, lambda: identify.fit_parameters(scene, log, tree, objective)


def main() -> None:
    """Print a line for each fit, and the difference of their base parameters."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=1500)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    model = arm(4)
    log = recorded(model, options.samples)
    begun = time.perf_counter()
    both = fits(model, log)
    cold, warm = [time.perf_counter() - begun], [[], []]
    begun = time.perf_counter()
    both[1]()
    cold.append(time.perf_counter() - begun)
    for _ in range(options.rounds):
        for seconds, fit in zip(warm, both, strict=True):
            begun = time.perf_counter()
            fit()
            seconds.append(time.perf_counter() - begun)
    for name, first, seconds in zip(("fit_torques", "fit_parameters"), cold, warm, strict=True):
        print(f"{name}: cold {first:.2f} s, warm {1e3 * min(seconds):.1f} ms")
    base = identify.base_parameters(model, identify.TERMS)
    values = [base.values(fit().vector) for fit in both]
    print(
        f"ratio {min(warm[1]) / min(warm[0]):.2f}; base parameters differ by {np.abs(values[0] - values[1]).max():.2g}"
    )


if __name__ == "__main__":
    main()
