"""False choices of `jd.identify.fit_robot` on simulated logs, none of which needs an extra term or a robust loss.

    python -m benchmarks.identify_selection [--logs 100] [--jump] [--out out/identify_selection.json]

Arms of two joints with the exact nominal model, viscous and Coulomb friction (smooth over 0.003 to 0.05 rad/s; --jump: over
0.0001, which samples do not resolve), rotors and 0.01 N m of white noise on the torques.
Motions, their length and size, and friction are random, and two of five are cut into two logs. A quarter of the logs each:

- exact velocities and accelerations at 50 Hz;
- samples at 500 Hz, low-passed and differentiated by `from_raw`;
- the same with 1e-5 rad of noise on the positions;
- the same of an arm of a tenth of the mass, with an encoder of 1e-4 rad.
"""

import argparse
import json
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxdyn as jd  # noqa: E402
from jaxdyn import identify  # noqa: E402

KINDS = ("exact", "low-passed", "noisy positions", "light arm")


def arm(scale: float = 1.0) -> jd.Model:
    """Two links that move in a vertical plane, of 1 and 0.8 kg times `scale`."""
    builder, moments = jd.ModelBuilder("arm"), scale * np.array([0.1, 0.09, 0.02])
    builder.add_body("a", axis=(0, 1, 0), inertia=(scale, (0.02, 0.01, -0.5), moments))
    builder.add_body("b", "a", pose=(0, 0, -1), axis=(0, 1, 0), inertia=(0.8 * scale, (0.01, 0, -0.4), 0.8 * moments))
    return builder.build()


def simulated(seed: int, v_s: float | None = None) -> tuple[jd.Model, list[identify.Log], np.ndarray]:
    """Exact model, logs and parameters x of a seed, of the kind `seed % 4`."""
    rng, kind = np.random.default_rng(seed), KINDS[seed % 4]
    size = 0.1 if kind == "light arm" else 1.0
    model = arm(size)
    x = identify.nominal_parameters(model).copy()
    viscous, coulomb, rotor = size * rng.uniform(0.05, 0.5, (3, 2)) * np.array([1.0, 1.0, 0.1])[:, None]
    x[20:] = np.concatenate([viscous, coulomb, [0, 0], rotor])
    v_s = 10 ** rng.uniform(-2.5, -1.3) if v_s is None else v_s
    duration = rng.uniform(5, 20)
    t = np.linspace(0, duration, int(duration * (50 if kind == "exact" else 500)))
    q, v, a = motion(rng, t)
    tau = identify.regressor(model, q, v, a, v_s=v_s) @ x
    tau = tau + 0.01 * rng.normal(size=tau.shape)
    if kind == "exact":
        log = identify.Log(t, q, v, a, tau)
    else:
        if kind == "noisy positions":
            q = q + 1e-5 * rng.normal(size=q.shape)
        if kind == "light arm":
            q = np.round(q / 1e-4) * 1e-4
        cutoff = identify.choose_cutoff(identify.Log(t, q, tau=tau)).frequency
        every = max(1, int(500 / (15 * cutoff)))
        log = identify.from_raw(t, q, tau, cutoff=cutoff, every=every, trim=38 * every)
    return model, [log] if rng.uniform() < 0.6 else list(identify.split(log, 0.5)), x


def motion(rng, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and accelerations (n, 2) of a random sum of four harmonics."""
    amplitude, phase = rng.uniform(0.2, 1.2) * rng.uniform(0.1, 0.5, (4, 2)), rng.uniform(0, 2 * np.pi, (4, 2))
    w = np.arange(1, 5)[:, None] * 2 * np.pi / rng.uniform(3, 12)
    angle = w * t[:, None, None] + phase
    signals = amplitude * np.sin(angle), amplitude * w * np.cos(angle), -amplitude * w**2 * np.sin(angle)
    q, v, a = (x.sum(axis=1) for x in signals)
    return q, v, a


def false_choices(seeds, v_s: float | None = None) -> list[dict]:
    """Extra terms and robust losses that were chosen, for each seed."""
    rows = []
    for seed in seeds:
        model, logs, _ = simulated(seed, v_s)
        setting = identify.fit_robot(model, logs).choice.setting
        rows.append({"seed": seed, "kind": KINDS[seed % 4], "extra": dict(setting.extra), "robust": setting.robust})
    return rows


def write_rows(path: Path | None, rows: list[dict]) -> None:
    """Write rows as JSON, where there is a path."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(rows, indent=1))


def main() -> None:
    """Print a row for each false choice, and the count of each kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=100)
    parser.add_argument("--jump", action="store_true", help="Coulomb friction that jumps")
    parser.add_argument("--out", type=Path, help="also write the table as JSON")
    options = parser.parse_args()
    rows = false_choices(range(options.logs), 1e-4 if options.jump else None)
    wrong = [row for row in rows if row["extra"] or row["robust"] is not None]
    for row in wrong:
        print(row)
    for kind in KINDS:
        own = [row for row in wrong if row["kind"] == kind]
        terms, losses = sum(bool(row["extra"]) for row in own), sum(row["robust"] is not None for row in own)
        count = sum(row["kind"] == kind for row in rows)
        print(
            f"{kind:16} {count} logs: {terms} with an extra term, {losses} with a robust loss, {len(own)} with either"
        )
    write_rows(options.out, rows)


if __name__ == "__main__":
    main()
