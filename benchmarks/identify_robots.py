"""Identification of two recorded robots on logs, or parts of one, that are kept apart.

    python -m benchmarks.identify_robots [--data ../shared/data] [--out out/identify_robots.json]

KUKA KR300 R2500 ultra (Weigand, Ulmen, Janot & Ruskowski 2021): logs A + B tell C, and A alone tells C. Franka Emika
Panda (Gaz et al. 2019): the first 70 % of its log tell the last 30 %. `jd.identify.fit_robot` chooses terms, prior
and smoothing on what it fits and never sees the rest. Errors are 100 |tau_fit - tau| / |tau| over all samples, and of
each joint; "plain" is `fit_torques`, "unconstrained" least squares. rms z: how far fits to two
parts (A and B, or halves) lie apart, in standard deviations.
"""

import argparse
import json
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxdyn as jd  # noqa: E402
from benchmarks.identify_franka import panda, recorded  # noqa: E402
from jaxdyn import identify  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
# Denavit-Hartenberg numbers (d, a, alpha) of the arm and the angles of its home pose, in which the logs start at zero.
FRAMES = ((-0.675, 0.35, 90), (-0.189, 1.15, 0), (0.189, 0.041, -90), (-1.0, 0, 90), (0, 0, -90), (-0.24, 0, 180))
HOME = (0, -90, 180, 0, 0, 0)
# Rough bodies to start from, after the figures published with the logs: mass, centre of mass, principal moments, in frame i.
BODIES = (
    (395.0, (-0.353, 0.174, -0.004), (16.7, 29.8, 32.8)),
    (339.0, (-0.709, -0.001, 0.023), (7.5, 88.9, 88.7)),
    (105.0, (-0.018, -0.018, -0.076), (10.8, 10.2, 1.9)),
    (36.0, (0, 0.236, 0.001), (0.43, 0.22, 0.43)),
    (31.0, (0, -0.080, -0.009), (0.28, 0.23, 0.26)),
    (168.0, (0, 0, 0.084), (2.5, 2.5, 2.5)),
)
GEARS = (1798 / 7, 1872 / 7, 757 / 3, 221, 5032 / 21, 206793 / 1340)


def displacement(angle=0.0, d=0.0, a=0.0, twist=0.0):
    """Rotation about z, ways along z and x, rotation about x, in this order; degrees and metres."""
    (c, s), (ct, st) = ((np.cos(x), np.sin(x)) for x in np.deg2rad([angle, twist]))
    return np.array([[c, -s * ct, s * st, a * c], [s, c * ct, -c * st, a * s], [0, st, ct, d], [0, 0, 0, 1.0]])


def kuka():
    """The arm; its base frame is turned by 180 degrees about x."""
    builder, pose, parent = jd.ModelBuilder("kr300"), displacement(twist=180), None
    for i, ((d, a, twist), home, (mass, centre, moments)) in enumerate(zip(FRAMES, HOME, BODIES, strict=True)):
        frame = displacement(0, d, a, twist)
        body = jd.inertia.inertial_parameters(mass, np.array(centre), np.diag(moments))
        body = np.asarray(jd.inertia.transform_inertia(jax.numpy.asarray(frame), body))
        name = f"link{i + 1}"
        builder.add_body(name, parent, inertia=body, joint_name=f"a{i + 1}", pose=pose @ displacement(home))
        pose, parent = frame, name
    return builder.build()


def kuka_samples(folder: Path, name: str) -> identify.Log:
    """One of its raw logs: motor angles, and motor torques times the gear ratios."""
    from scipy.io import loadmat

    file = folder / f"kuka_kr300/data/recorded_trajectories/2020-10-21 10s FF {name} 08ms/data.mat"
    if not file.is_file():
        raise SystemExit(f"no KUKA log at {file}; name the directory of recorded data with --data")
    rec = loadmat(file, squeeze_me=True, struct_as_record=False)["rec"]
    q, tau = np.deg2rad(rec.act_pos_mot_deg.T), rec.act_torque_abs_nm.T * np.array(GEARS)
    return identify.Log(np.asarray(rec.time_cont, float), q, tau=tau)


def kuka_log(folder: Path, name: str, cutoff: float = 10.0):
    """One of its logs, low-passed."""
    raw = kuka_samples(folder, name)
    return identify.from_raw(raw.t, raw.q, raw.tau, cutoff=cutoff, trim=50, every=1)


def z_scores(model, fit, logs) -> np.ndarray:
    """Differences of the base parameters of fits to each of two logs, over their standard deviations."""
    setting = fit.choice.setting
    first, second = (
        identify.fit_robot(
            model, log, fit.terms, v_s=setting.v_s, prior=setting.prior, robust=setting.robust
        ).intervals.base
        for log in logs
    )
    z = (first.values - second.values) / np.hypot(first.std, second.std)
    return z[np.isfinite(z)]


def case(name, model, train, test, halves=None) -> dict:
    """Fit, print a row for each way, return the numbers."""
    names = model.joint_names

    def row(kind, torques, note=""):
        error = identify.torque_error(torques, test.tau)
        by_joint = np.sqrt(np.mean((torques - test.tau) ** 2, axis=0) / np.mean(test.tau**2, axis=0)) * 100
        cells = " ".join(f"{x:5.1f}" for x in by_joint)
        print(f"{name:22} {kind:14} {error:7.2f} %   {cells}   {note}", flush=True)
        return {"percent": error, "percent_by_joint": dict(zip(names, by_joint.tolist(), strict=True)), "note": note}

    computed = {"unconstrained": row("unconstrained", identify.least_squares(model, train).torques(test))}
    computed["plain"] = row("plain", identify.fit_torques(model, train).torques(test))
    start, cpu = time.perf_counter(), time.process_time()
    fit = identify.fit_robot(model, train)
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    setting = fit.choice.setting
    extra = "; ".join(f"{term} {','.join(names[j][-1] for j in joints)}" for term, joints in setting.extra)
    note = f"v_s {setting.v_s:g}, prior {setting.prior:g}, loss {setting.robust}, {extra}; "
    note += f"{len(fit.choice.trials)} settings, {seconds:.0f} s"
    computed["chosen"] = row("chosen", fit.fit.torques(test), note) | {"seconds": seconds, "cpu": cpu}
    if halves is not None:
        z = z_scores(model, fit, halves)
        computed["rms_z"], computed["beyond_2"] = float(np.sqrt(np.mean(z**2))), float(np.mean(np.abs(z) > 2))
        share = 100 * computed["beyond_2"]
        print(f"{name:22} {len(z)} base parameters of two parts: rms z {computed['rms_z']:.2f}, {share:.0f} % beyond 2")
    return computed


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--cutoff", type=float, default=10.0, help="of the KUKA's logs, Hz")
    parser.add_argument("--out", type=Path, help="also write the table as JSON")
    options = parser.parse_args()
    arm, (a, b, c) = kuka(), (kuka_log(options.data, name, options.cutoff) for name in "ABC")
    model, log = panda(), recorded(options.data)
    train, test = identify.split(log, 0.7)
    computed = {
        "KUKA A + B -> C": case("KUKA A + B -> C", arm, [a, b], c, (a, b)),
        "KUKA A -> C": case("KUKA A -> C", arm, [a], c, identify.split(a, 0.5)),
        "Franka 70 % -> 30 %": case("Franka 70 % -> 30 %", model, [train], test, identify.split(train, 0.5)),
    }
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(computed, indent=1))


if __name__ == "__main__":
    main()
