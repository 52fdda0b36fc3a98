"""The automatic choice of `jd.identify.fit_robot` against its simplest members, on logs that the fits have not seen.

    python -m benchmarks.identify_drift [--seeds 12] [--recorded] [--data ../shared/data] [--out out/identify_drift.json]

Held-out torque error in per cent of least squares, of feasible least squares (`fit_torques`), of the feasible fit of the four
plain terms with and without weights of joints (v_s, prior and loss chosen), and of the automatic choice; then the latter over
the best of the others.

Simulated arms have the geometry of a Panda, a KUKA KR300 and a UR5, bodies that differ from the nominal ones, an encoder with
noise, white and slow noise of the torques, and friction that falls by up to 40 % while the arm warms up. Some have a term that no
fit knows, Stribeck's friction or the ripple of a gear, or one of `EXTRA`. The test is a later, warmer log of another motion,
or the last 30 % of a single one. --recorded: the recorded robots of `benchmarks.identify_robots` instead.
"""

import argparse
import functools
from collections.abc import Iterator
from importlib.metadata import distribution
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.signal import lfilter  # noqa: E402

import jaxdyn as jd  # noqa: E402
from benchmarks.identify_franka import panda, recorded  # noqa: E402
from benchmarks.identify_robots import ROOT, kuka, kuka_log  # noqa: E402
from benchmarks.identify_selection import write_rows  # noqa: E402
from jaxdyn import identify, inertia  # noqa: E402
from jaxdyn.io import load_model  # noqa: E402

RATE = 250.0
LEFT_OUT = {"drift": 0.8, "stribeck": 0.5, "load": 0.4, "spring": 0.4, "ripple": 0.5, "asymmetric": 0.3, "dahl": 0.4}

Case = tuple[str, jd.Model, list[identify.Log], identify.Log]


@functools.cache
def arm(number: int) -> jd.Model:
    """Panda, KUKA or UR5."""
    if number < 2:
        return (panda, kuka)[number]()
    robots = Path(str(distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots")))
    return load_model(robots / "ur_description/urdf/ur5_robot.urdf").replace(damping=None, friction=None)


def motion(rng, t: np.ndarray, nv: int, base: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and accelerations (n, nv) of a random series of five harmonics of `base` (Hz)."""
    k = np.arange(1, 6)[:, None]
    amplitude, phase, w = rng.normal(size=(5, nv)) / k**0.5, rng.uniform(0, 2 * np.pi, (5, nv)), 2 * np.pi * base * k
    amplitude *= rng.uniform(0.5, 1.1, nv) / np.sqrt(np.sum(amplitude**2, axis=0))
    angle = w * t[:, None, None] + phase
    signals = amplitude * np.sin(angle), amplitude * w * np.cos(angle), -amplitude * w**2 * np.sin(angle)
    q, v, a = (x.sum(axis=1) for x in signals)
    return q + rng.uniform(-0.5, 0.5, nv), v, a


def friction(rng, kind: dict[str, bool], nv: int, size: np.ndarray, speed: np.ndarray):
    """Random torque of friction and of what else is in `kind`, a function of time (s), motion and rigid torque."""
    viscous, coulomb = rng.uniform(0.02, 0.15, nv), rng.uniform(0.03, 0.2, nv)
    fall, lasts = rng.uniform(0.05, 0.4), rng.uniform(8, 60)
    load, ripple, slow = rng.uniform(0, 0.1, nv), rng.uniform(0, 0.03, nv), rng.uniform(0.2, 0.8, nv)
    spring, skew, teeth = 0.05 * rng.normal(size=(2, nv)), 0.03 * rng.normal(size=nv), rng.integers(5, 60, nv)
    v_s, edge, offset = 10 ** rng.uniform(-3, -1.5), rng.uniform(0.05, 0.3), 0.03 * rng.normal(size=nv)

    def torque(t, q, v, rigid):
        heat = 1 + fall * np.exp(-t / lasts)[:, None] if kind["drift"] else 1.0
        sign = np.tanh(v / v_s)
        if kind["dahl"]:
            log = identify.Log(t, q, v, v, rigid)
            sign = identify.EXTRA["dahl"](log, rigid, v_s)[:, :, 0]
        rise = 1 + slow * np.exp(-((v / edge) ** 2)) if kind["stribeck"] else 1.0
        result = heat * size * (viscous * v / speed + coulomb * sign * rise) + offset * size
        result += heat * load * np.abs(rigid) * sign if kind["load"] else 0.0
        result += size * (spring[0] * np.sin(q) + spring[1] * np.cos(q)) if kind["spring"] else 0.0
        result += size * ripple * np.sin(teeth * q) if kind["ripple"] else 0.0
        return result + (size * skew * np.abs(v) / speed if kind["asymmetric"] else 0.0)

    return torque


def simulated(seed: int) -> Case:
    """Name, nominal model, logs to fit and test log of a seed."""
    rng, nominal = np.random.default_rng(seed), arm(seed % 3)
    nv, spread = nominal.nv, rng.uniform(0.1, 0.35)
    steps = jnp.asarray(spread * rng.normal(size=(nominal.nb, 10)))
    move = jax.vmap(lambda x, step: inertia.from_log_cholesky(inertia.to_log_cholesky(x) + step))
    true = nominal.replace(inertias=move(nominal.inertias, steps))
    kind = {name: bool(rng.random() < share) for name, share in LEFT_OUT.items()}
    is_one, duration, base = bool(rng.random() < 0.35), rng.uniform(10, 25), rng.uniform(0.05, 0.12)
    noise, encoder = rng.uniform(0.003, 0.02), 10 ** rng.uniform(-6, -4.5)
    logs, law, size, start = [], None, np.ones(nv), 0.0
    for _ in range(1 if is_one else 2):
        t = np.arange(int(duration * (2 if is_one else 1) * RATE)) / RATE
        q, v, a = motion(rng, t, nv, base)
        rigid = identify.regressor(true, q, v, a) @ identify.nominal_parameters(true)
        if law is None:
            rms = np.sqrt(np.mean(rigid**2, axis=0))
            size = np.maximum(rms, 0.02 * rms.max())
            law = friction(rng, kind, nv, size, np.sqrt(np.mean(v**2, axis=0)))
        slow = lfilter([0.07], [1, -0.98], rng.normal(size=q.shape), axis=0)
        tau = rigid + law(start + t, q, v, rigid) + noise * size * (rng.normal(size=q.shape) + slow)
        q = q + encoder * rng.normal(size=q.shape)
        cutoff = identify.choose_cutoff(identify.Log(t, q, tau=tau)).frequency
        every = max(1, int(RATE / (15 * cutoff)))
        logs.append(identify.from_raw(t, q, tau, cutoff=cutoff, every=every, trim=int(2.5 * RATE / cutoff)))
        start += t[-1] + rng.uniform(0, 60)
    train, test = identify.split(logs[0], 0.7) if is_one else logs
    return f"{seed} {nominal.name}: {', '.join(name for name in kind if kind[name])}", nominal, [train], test


def recorded_cases(folder: Path) -> Iterator[Case]:
    """Recorded logs of two robots, each left out in turn."""
    model, logs = kuka(), {name: kuka_log(folder, name) for name in "ABC"}
    for train, test in (("AB", "C"), ("BC", "A"), ("AC", "B"), ("A", "B"), ("A", "C"), ("B", "C"), ("C", "A")):
        yield f"KUKA {train} -> {test}", model, [logs[name] for name in train], logs[test]
    model, log = panda(), recorded(folder)
    n = len(log)
    for name, train, test in (
        ("first 70 %", [log[: int(0.7 * n)]], log[int(0.7 * n) :]),
        ("last 70 %", [log[int(0.3 * n) :]], log[: int(0.3 * n)]),
        ("first half", [log[: n // 2]], log[n // 2 :]),
        ("last half", [log[n // 2 :]], log[: n // 2]),
        ("both ends", [log[: int(0.35 * n)], log[int(0.65 * n) :]], log[int(0.35 * n) : int(0.65 * n)]),
    ):
        yield f"Franka {name}", model, train, test


def compare(model: jd.Model, train: list[identify.Log], test: identify.Log) -> tuple[list[float], str]:
    """Errors of the five fits, and the setting that was chosen."""
    chosen = identify.fit_robot(model, train)
    fits = [
        identify.least_squares(model, train),
        identify.fit_torques(model, train),
        identify.fit_robot(model, train, identify.TERMS).fit,
        identify.fit_robot(model, train, identify.TERMS, weights=None).fit,
        chosen.fit,
    ]
    setting, names = chosen.choice.setting, model.joint_names
    extra = "; ".join(f"{term} {' '.join(names[j] for j in joints)}" for term, joints in setting.extra)
    note = f"v_s {setting.v_s:.2g}, prior {setting.prior:g}, loss {setting.robust}, {extra or 'no extra term'}"
    return [identify.torque_error(fit.torques(test), test.tau) for fit in fits], note


def main() -> None:
    """Print a row for each case, and the worst ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--recorded", action="store_true")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--out", type=Path, help="also write the table as JSON")
    options = parser.parse_args()
    cases = recorded_cases(options.data) if options.recorded else map(simulated, range(options.seeds))
    rows = []
    for name, model, train, test in cases:
        errors, note = compare(model, train, test)
        ratio = errors[-1] / min(errors[:-1])
        rows.append({"case": name, "errors": errors, "ratio": ratio, "choice": note})
        print(f"{name:60} {' '.join(f'{x:6.2f}' for x in errors)}  {ratio:.3f}  {note}", flush=True)
    ratios = np.array([row["ratio"] for row in rows])
    print(
        f"worst {ratios.max():.3f}, mean {np.exp(np.mean(np.log(ratios))):.3f}, {np.mean(ratios > 1.02):.0%} above 1.02"
    )
    write_rows(options.out, rows)


if __name__ == "__main__":
    main()
