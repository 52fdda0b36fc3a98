"""The command line: what it prints and writes, and how it says no."""

import csv
import json
import re

import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio
import pytest

import jaxdyn as jd
from benchmarks.linkages import bennett
from jaxdyn.cli import main
from jaxdyn.identify.torque_terms import coulomb_through_filter
from jaxdyn.io import read_torque_terms
from jaxdyn.io.logs import read_log, write_log

GIVEN = "--v-s 0.01 --prior 1 --robust none"
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A URDF of three joints: one with friction, one that slides, and one whose link breaks the triangle inequality."""
    builder = jd.ModelBuilder("arm")
    body = (2.0, (0, 0, 0.2), (0.02, 0.03, 0.02))
    builder.add_body("base", None, "fixed", body)
    builder.add_body(
        "upper", "base", "revolute", body, joint_name="shoulder", axis=(0, 1, 0), damping=0.3, friction=0.1
    )
    slide = {"axis": (0, 0, 1), "lower": -0.3, "upper": 0.3, "effort_limit": 50.0, "velocity_limit": 1.0}
    builder.add_body("slide", "upper", "prismatic", body, joint_name="lift", pose=(0, 0, 0.4), **slide)
    flat = (0.5, (0.1, 0, 0), (0.1, 0.001, 0.001))
    builder.add_body("hand", "slide", "continuous", flat, joint_name="wrist", pose=(0, 0, 0.1))
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    jd.save_urdf(builder.build(), path)
    return path


@pytest.fixture(scope="module")
def panda(robots_dir):
    return robots_dir / "panda_description" / "urdf" / "panda.urdf"


@pytest.fixture(scope="module")
def franka(data_dir):
    """Raw samples of the recorded Franka Panda: t (n,), q and tau (n, 7)."""
    directory = data_dir / "franka_panda" / "matlab" / "data" / "Exciting_Traj" / "Trajectory_1" / "rbt_log"
    t, q, tau = (np.loadtxt(directory / f"exciting_traj_{name}.txt") for name in ("time", "positions", "torques"))
    return t, q.reshape(-1, 7), tau.reshape(-1, 7)


def columns_of(path):
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    return dict(zip(rows[0], np.array(rows[1:], float).T, strict=True))


def arrays_of(path):
    with np.load(path) as archive:
        return dict(archive)


def test_info_shows_the_robot_and_its_faults(arm, capsys):
    assert main(["info", str(arm)]) == 0
    text = capsys.readouterr().out
    assert "3 moving bodies, 3 degrees of freedom" in text
    assert "moving mass 4.5 kg" in text
    for words in (("shoulder", "revolute", "rad", "0 1 0"), ("lift", "prismatic", "m", "0 0 1", "-0.3", "50")):
        line = next(line for line in text.splitlines() if words[0] in line)
        assert all(word in line for word in words)
    assert any("hand" in line and "triangle inequality" in line for line in text.splitlines())


def test_info_locks_floats_and_repairs(arm, tmp_path, capsys):
    out = tmp_path / "repaired.urdf"
    assert main(["info", str(arm), "--lock", "lift=0.1", "--repair", str(out)]) == 0
    assert "2 degrees of freedom" in capsys.readouterr().out
    repaired = jd.load_model(out)
    assert jd.model.inertia_report(repaired) == []
    np.testing.assert_allclose(repaired.inertias[:, 0].sum(), 4.5, rtol=1e-12)
    # The inertia of a base that is fixed to the world is not in the model, nor in the file: such a base cannot float.
    assert main(["info", str(arm), "--floating-base"]) == 2
    assert "root_joint" in capsys.readouterr().err


@pytest.mark.long
def test_info_of_a_real_robot_says_what_is_not_used(panda, capsys):
    assert main(["info", str(panda)]) == 0
    text = capsys.readouterr().out
    assert "panda_hand_tcp" in text
    assert "<mimic>" in text


@pytest.mark.long
def test_simulate_writes_the_motion_that_the_library_computes(arm, tmp_path, capsys):
    out = tmp_path / "motion.csv"
    args = ["--duration", "0.2", "--sample", "0.05", "--q0", "shoulder=0.5", "--friction", "0", "--torque", "gravity"]
    assert main(["simulate", str(arm), *args, "--v0", "0.1", "0", "-0.2", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    drift = float(text.split("at most ")[1].split(" J")[0])
    assert drift < 1e-7
    columns = columns_of(out)
    model = jd.load_model(arm)
    names = [f"{signal}_{joint}" for signal in ("q", "v", "tau") for joint in model.joint_names]
    assert [name.partition(" [")[0] for name in columns] == ["t", *names, "energy", "work"]
    log = read_log(out, joint_names=model.joint_names)
    q0, v0 = np.array([0.5, 0.0, 0.0]), np.array([0.1, 0.0, -0.2])
    motion = jd.simulate(
        jd.Scene(model, forces=[jd.forces.JointDamping()]),
        q0,
        v0,
        np.linspace(0, 0.2, 5),
        control=lambda q, v, t: jd.gravity_force(model, q),
        stepsize=jd.simulation.Steps(rtol=1e-10, atol=1e-10),
    )
    # Both integrations have a tolerance of 1e-8 or less per step.
    np.testing.assert_allclose(log.q, motion.q, atol=1e-7)
    np.testing.assert_allclose(log.v, motion.v, atol=1e-7)
    np.testing.assert_allclose(log.tau[0], jd.gravity_force(model, jnp.asarray(q0)), rtol=1e-12, atol=1e-12)

    # The file is a log: replayed, it gives the motion again, up to the torque between two rows.
    again = tmp_path / "again.npz"
    assert (
        main(["simulate", str(arm), "--sample", "0.05", "--friction", "0", "--torque", str(out), "--out", str(again)])
        == 0
    )
    # Between rows of 0.05 s the torque is a line where it was a curve: 1e-5 rad here.
    np.testing.assert_allclose(read_log(again).q, motion.q, atol=2e-5)


@pytest.mark.long
def test_simulate_a_batch_with_seed_and_plot(arm, tmp_path, capsys):
    args = ["simulate", str(arm), "--duration", "0.1", "--dt", "0.01", "--batch", "3", "--torque", "gravity+random"]
    for name, seed in (("a.npz", 1), ("b.npz", 1), ("c.npz", 2)):
        plot = ["--plot", str(tmp_path / "motion.png")] if name == "a.npz" else []
        assert main([*args, "--seed", str(seed), "--out", str(tmp_path / name), *plot]) == 0
    a, b, c = (arrays_of(tmp_path / name) for name in ("a.npz", "b.npz", "c.npz"))
    assert a["q"].shape == (3, 11, 3)
    assert a["energy"].shape == (3, 11)
    np.testing.assert_array_equal(a["tau"], b["tau"])
    assert np.abs(a["tau"] - c["tau"]).max() > 1e-3
    assert np.ptp(a["q"][:, -1], axis=0).max() > 1e-6
    assert (tmp_path / "motion.png").stat().st_size > 10_000
    capsys.readouterr()


def test_a_simulation_that_stops_early_is_exit_status_1(arm, capsys):
    assert main(["simulate", str(arm), "--duration", "1", "--max-steps", "3", "--q0", "shoulder=0.5"]) == 1
    assert "1 of 1 motions stopped early" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.data
def test_identify_the_recorded_panda_from_raw_samples(panda, franka, tmp_path, capsys):
    """Held-out torque error at most 1.45 %; unconstrained least squares with the same filter and split has 1.36 %."""
    t, q, tau = franka
    raw, out = tmp_path / "log.csv", tmp_path / "fitted.urdf"
    write_log(raw, jd.identify.Log(t, q, tau=tau))
    args = ["--urdf", str(panda), "--log", str(raw), "--lock", *FINGERS, "--cutoff", "8"]
    given = ["--terms", *jd.identify.TERMS, "--v-s", "0.01", "--prior", "1", "--weights", "none"]
    assert main(["identify", *args, *given, "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "low-passed at 8 Hz" in text
    report = json.loads(out.with_suffix(".json").read_text())
    assert report["torque_error"]["test_percent"] <= 1.45
    assert report["test_logs"]["log.csv (last 30 %)"]["percent"] == report["torque_error"]["test_percent"]
    assert report["torque_error"]["nominal_test_percent"] > 10
    assert report["samples"] == {"train": 1744, "test": 748, "final": 2492}

    # What was written is what was fitted to all samples: bodies that exist, and with the offsets of the report the same torques.
    fitted = jd.load_model(out)
    assert jd.model.inertia_report(fitted) == []
    log = jd.identify.from_raw(t, q, tau, trim=38 * 8)  # as the command does
    x = jd.identify.nominal_parameters(fitted)
    offset = 10 * fitted.nb + fitted.nv * jd.identify.TERMS.index("offset")
    x[offset : offset + fitted.nv] = report["friction"]["offset"]
    rows = jd.identify.regressor(fitted, log.q, log.v, log.a)
    # Friction counts as the log's low-pass leaves it.
    place = 10 * fitted.nb + fitted.nv * jd.identify.TERMS.index("coulomb") + np.arange(7)
    rows[:, np.arange(7), place] = coulomb_through_filter(log, 0.01)
    # A URDF holds the inertia about the centre of mass, so some digits of small moments are lost on the way.
    np.testing.assert_allclose(
        jd.identify.torque_error(rows @ x, log.tau), report["torque_error"]["final_percent"], rtol=1e-6
    )
    assert report["torque_error"]["final_percent"] < report["torque_error"]["test_percent"]

    # The same samples, filtered beforehand and so marked by their accelerations, give the same answer.
    filtered = tmp_path / "filtered.npz"
    write_log(filtered, jd.identify.from_raw(t, q, tau))
    args[3] = str(filtered)
    assert main(["identify", *args, "--method", "least-squares", "--report", str(tmp_path / "ls.json")]) == 0
    assert "used as filtered" in capsys.readouterr().out
    report = json.loads((tmp_path / "ls.json").read_text())
    assert abs(report["torque_error"]["test_percent"] - 1.36) < 0.01
    assert len(report["base_parameters"]["fitted"]) == len(report["base_parameters"]["std"])


@pytest.mark.slow
@pytest.mark.data
def test_identify_the_recorded_panda_with_terms_chosen(panda, franka, tmp_path, capsys):
    """By default terms, prior and smoothing are chosen on the training part alone: below 1.30 % on the rest."""
    t, q, tau = franka
    raw, out = tmp_path / "log.csv", tmp_path / "fitted.urdf"
    write_log(raw, jd.identify.Log(t, q, tau=tau))
    args = ["identify", "--urdf", str(panda), "--log", str(raw), "--lock", *FINGERS, "--cutoff", "8", "--out", str(out)]
    assert main(args) == 0
    assert "dahl at panda_joint1" in capsys.readouterr().out
    report = json.loads(out.with_suffix(".json").read_text())
    (errors,) = report["test_logs"].values()
    assert errors["percent"] < 1.30
    unconstrained = np.array([0.149, 0.214, 0.135, 0.184, 0.070, 0.070, 0.054])
    assert np.all(np.array(errors["rms_by_joint"]) <= 1.1 * unconstrained)
    assert report["chosen"]["extra_terms"]["dahl"]


def simulated_logs(model, folder, seeds, noise=0.0, delay=0.0, gains=1.0):
    """Filtered logs of sums of sines with exact rates, as files A.csv, B.csv, ..., of different lengths and sampling.

    Torques are those of `delay` before (s), over the gains of drives.
    """
    paths = []
    for k, seed in enumerate(seeds):
        rng = np.random.default_rng(seed)
        t = np.linspace(0, 4 + k, 401 - 50 * k)
        size, rate, phase = rng.uniform(0.2, 0.5, (3, 3)), rng.uniform(1, 4, (3, 3)), rng.uniform(0, 6, (3, 3))

        def at(t, size=size, rate=rate, phase=phase):
            angle = rate * t[:, None, None] + phase
            signs = (np.sin(angle), rate * np.cos(angle), -(rate**2) * np.sin(angle))
            return [np.sum(size * x, 1) for x in signs]

        q, v, a = at(t)
        tau = jd.identify.regressor(model, *at(t - delay)) @ jd.identify.nominal_parameters(model)
        paths.append(str(folder / f"{chr(65 + k)}.csv"))
        write_log(paths[-1], jd.identify.Log(t, q, v, a, tau / gains + noise * rng.normal(size=tau.shape)))
    return paths


@pytest.mark.long
def test_identify_chooses_the_cutoff_and_warns_of_vibration(arm, tmp_path, capsys):
    """Raw logs of a motion up to 0.5 Hz, torques that vibrate at 9 Hz."""
    model = jd.model.repair_inertias(jd.load_model(arm))
    paths = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        t = np.linspace(0, 12, 2401)
        w = 2 * np.pi * 0.1 * np.arange(1, 6)[:, None]
        angle = w * t[:, None, None] + rng.uniform(0, 6, (5, 3))
        size = rng.uniform(0.3, 0.6, (5, 3)) / w
        q, v, a = (np.sum(size * x, 1) for x in (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle)))
        tau = jd.identify.regressor(model, q, v, a) @ jd.identify.nominal_parameters(model)
        tau += 0.05 * np.abs(tau).max(axis=0) * np.sin(2 * np.pi * 9 * t)[:, None]
        paths.append(str(tmp_path / f"{seed}.csv"))
        write_log(paths[-1], jd.identify.Log(t, q, tau=tau))
    report = tmp_path / "fit.json"
    args = f"identify --urdf {arm} --log {paths[0]} --test-log {paths[1]} --report {report}".split()
    args += f"--repair --terms viscous {GIVEN}".split()
    assert main(args) == 0
    text = capsys.readouterr().out
    assert re.search(r"--cutoff auto: 5(\.\d+)? Hz, ten times the band of the motion, 0.5", text)
    assert "beyond rigid-body dynamics" not in text
    chosen = json.loads(report.read_text())
    # Ten times a band that is read from lines 0.08 Hz apart.
    assert chosen["cutoff_hz"] == pytest.approx(5, abs=0.9) and chosen["torque_error"]["test_percent"] < 0.5
    assert main([*args, "--cutoff", "14"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"1.csv: (9\d|100) % .* beyond rigid-body dynamics: vibration; try --cutoff [456]", text)
    given = json.loads(report.read_text())
    assert given["cutoff_hz"] == 14 and given["torque_error"]["test_percent"] > 2
    assert main([*args, "--cutoff", "low"]) == 2


@pytest.mark.long
def test_identify_from_several_logs_judged_on_another(arm, tmp_path, capsys):
    """Two logs fitted, one only predicted; JSON, page and URDF; what is not asked for is not tried."""
    truth = jd.model.repair_inertias(jd.load_model(arm))
    a, b, c = simulated_logs(truth, tmp_path, (0, 1, 2), noise=0.01)
    out, page, report = (tmp_path / name for name in ("fitted.urdf", "fit.html", "fit.json"))
    wrong = tmp_path / "wrong.urdf"
    jd.save_urdf(truth.replace(inertias=1.2 * truth.inertias), wrong)
    args = f"identify --urdf {wrong} --log {a} {b} --test-log {c} --terms viscous coulomb quadratic {GIVEN}".split()
    args += ["--out", str(out), "--report", str(report), "--html", str(page)]
    assert main(args) == 0
    text = capsys.readouterr().out
    assert text.index("torque error:") < text.index("feasible fit of")
    assert "quadratic" in text and "chosen over" not in text
    computed = json.loads(report.read_text())
    assert set(computed["test_logs"]) == {"C.csv"} and set(computed["train_logs"]) == {"A.csv", "B.csv"}
    errors = computed["test_logs"]["C.csv"]
    assert len(errors["percent_by_joint"]) == truth.nv and errors["percent"] < 2 < 10 < errors["nominal_percent"]
    assert computed["samples"] == {"train": 752, "test": 301, "final": 752}
    sources = {name: row["from"] for name, row in computed["parameters"].items() if "from" in row}
    # Quadratic and viscous friction explain the same torque in part.
    assert set(sources.values()) <= {"data", "prior", "bound", "confounded"}
    assert all(name.endswith(("viscous", "coulomb", "quadratic")) for name, x in sources.items() if x == "confounded")
    assert jd.model.inertia_report(jd.load_model(out)) == []
    # Nothing outside of the page: names of XML are the only addresses.
    text = page.read_text()
    assert "<svg" in text and text.count("http") == text.count("http://www.w3.org/")
    assert text.strip().endswith("</html>") and not list(tmp_path.glob(".*"))


def test_identify_from_one_file_and_the_robot_it_writes(arm, tmp_path, capsys, monkeypatch):
    """Options of a file, overruled by the command line; Pinocchio and MuJoCo read the URDF, we its offsets and terms too."""
    truth = jd.model.repair_inertias(jd.load_model(arm))
    simulated_logs(truth, tmp_path, (0, 1, 2), noise=0.01)
    jd.save_urdf(truth, tmp_path / "true.urdf")
    monkeypatch.chdir(tmp_path)
    options = """\
--urdf true.urdf
--log A.csv B.csv
--test-log C.csv
--out fitted.urdf --robust none   # squares
--terms viscous coulomb offset quadratic
--v-s 0.02
--prior 5
--gravity 0 0 -9.81
"""
    (tmp_path / "fit.txt").write_text(options)
    assert main(["identify", "@fit.txt", "--prior", "1"]) == 0
    assert "v_s 0.02, prior 1, loss squares" in capsys.readouterr().out
    computed = json.loads((tmp_path / "fitted.json").read_text())
    torques = read_torque_terms(tmp_path / "fitted.urdf")
    assert [torques[name]["offset"] for name in truth.joint_names] == computed["friction"]["offset"]
    assert {torques[name]["v_s"] for name in truth.joint_names} == {0.02}
    assert [torques[name]["quadratic"] for name in truth.joint_names] == computed["extra_terms"]["quadratic"]
    read = pinocchio.buildModelFromUrdf(str(tmp_path / "fitted.urdf"))
    fitted = jd.load_model(tmp_path / "fitted.urdf")
    np.testing.assert_allclose(read.friction, fitted.friction, rtol=1e-12)
    np.testing.assert_allclose(read.damping, fitted.damping, rtol=1e-12)
    body = mujoco.MjModel.from_xml_path(str(tmp_path / "fitted.urdf"))
    np.testing.assert_allclose(body.dof_frictionloss, fitted.friction, rtol=1e-6)
    np.testing.assert_allclose(body.body_mass[1:], fitted.inertias[:, 0], rtol=1e-6)
    (tmp_path / "fit.txt").write_text("--train 0.5\n")
    assert main(["identify", "@fit.txt"]) == 2
    assert "--urdf and --log: missing" in capsys.readouterr().err
    for argument, words in (("@missing.txt", "missing.txt"), ("--logs", "unrecognized arguments: --logs")):
        with pytest.raises(SystemExit) as stop:
            main(["identify", argument])
        assert stop.value.code == 2
        assert words in capsys.readouterr().err
    with pytest.raises(ValueError, match="elbow are no joints"):
        jd.save_urdf(truth, tmp_path / "x.urdf", torques={"elbow": {"offset": 1.0}})


@pytest.mark.parametrize("name", ["fit.toml", "fit.txt"])
def test_file_of_options_without_its_mark_is_named_with_it(name, capsys):
    with pytest.raises(SystemExit):
        main(["identify", name])
    words = f"unrecognized arguments: {name}; a file of options is given as @fit.txt, with lines such as --urdf"
    assert words in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("text", "error"),
    [('--train "0.6\n', r"a line in a file of options is '--train \"0\.6'; close"), ("@fit.txt\n", "names itself")],
)
def test_files_of_options_are_refused(text, error, tmp_path, monkeypatch, capsys):
    """An open quotation mark, and a file that includes itself: one line and status 2."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fit.txt").write_text(text)
    with pytest.raises(SystemExit) as stop:
        main(["identify", "@fit.txt"])
    assert stop.value.code == 2
    assert re.search(error, capsys.readouterr().err)


@pytest.mark.long
def test_identify_finds_delays(arm, tmp_path, capsys, monkeypatch):
    """20 ms: found, printed, in both reports, judged on shifted logs, counted in a payload; given as a number, the same fit."""
    truth = jd.model.repair_inertias(jd.load_model(arm))
    jd.save_urdf(truth, tmp_path / "true.urdf")
    simulated_logs(truth, tmp_path, (0, 1), noise=0.005, delay=0.02)
    held = truth.replace(inertias=truth.inertias.at[-1].add(jd.inertia.sphere(0.7, 0.05)))
    (tmp_path / "held").mkdir()
    simulated_logs(held, tmp_path / "held", (2,), noise=0.005, delay=0.02)
    monkeypatch.chdir(tmp_path)
    command = "identify --urdf true.urdf --log A.csv --test-log B.csv --report fit.json --html fit.html"
    command += " --terms viscous coulomb --v-s 0.1 --prior 1 --robust none --payload-log held/A.csv"
    assert main([*command.split(), "--delay", "auto"]) == 0
    assert "Delays of the torques against the positions (ms)" in capsys.readouterr().out
    report = json.loads((tmp_path / "fit.json").read_text())
    delays = report["delays"]
    off, half = np.abs(np.array(delays["seconds"]) - 0.02), delays["interval_factor"] * np.array(delays["std"])
    assert delays["by"] == "auto" and np.all(off <= half) and np.all(half < 0.005)
    name = f"{truth.joint_names[0]}.delay"
    assert report["parameters"][name]["fitted"] == delays["seconds"][0]
    assert report["test_logs"]["B.csv"]["percent"] < 1 and abs(report["payload"]["mass"] - 0.7) < 0.02
    assert "Delays of the torques against the positions" in (tmp_path / "fit.html").read_text()
    given = [str(x) for x in delays["seconds"]]
    assert main([*command.split(), "--delay", *given]) == 0
    again = json.loads((tmp_path / "fit.json").read_text())
    assert again["delays"]["by"] == "given" and again["delays"]["std"] == [None] * 3
    np.testing.assert_allclose(
        again["test_logs"]["B.csv"]["percent"], report["test_logs"]["B.csv"]["percent"], rtol=1e-6
    )
    for option, words in (
        (["auto", "0.1"], "exclude other values"),
        (["late"], "--delay: 'late'"),
        (["0.1", "0.1"], "each of 3 torques"),
        (["0.1", "--method", "least-squares"], "does not support delays"),
    ):
        parts = ["--urdf", str(tmp_path / "true.urdf"), "--log", str(tmp_path / "A.csv")]
        assert main(["identify", *parts, "--delay", *option]) == 2
        assert words in capsys.readouterr().err


def test_identify_repairs_a_link_of_zero_inertia(arm, tmp_path, capsys):
    truth = jd.model.repair_inertias(jd.load_model(arm))
    a, b = simulated_logs(truth, tmp_path, (0, 1), noise=0.01)
    path = tmp_path / "zero.urdf"
    jd.save_urdf(truth.replace(inertias=truth.inertias.at[1, 4:].set(0.0).at[2].set(0.0)), path)
    args = f"identify --urdf {path} --log {a} --test-log {b} --terms viscous coulomb {GIVEN}".split()
    assert main(args) == 2
    assert "moves no inertia" in capsys.readouterr().err
    assert main([*args, "--repair"]) == 0
    assert "repaired inertias: hand, slide" in capsys.readouterr().out


def test_identify_a_payload(arm, tmp_path, capsys):
    truth = jd.model.repair_inertias(jd.load_model(arm))
    path, report = tmp_path / "true.urdf", tmp_path / "fit.json"
    jd.save_urdf(truth, path)
    held = jd.inertia.displaced(jd.inertia.sphere(0.7, 0.05), (0.05, 0, 0.1))
    (tmp_path / "loaded").mkdir()
    empty = simulated_logs(truth, tmp_path, (0, 1), noise=0.01)
    loaded = simulated_logs(
        truth.replace(inertias=truth.inertias.at[-1].add(held)), tmp_path / "loaded", (2,), noise=0.01
    )
    args = f"identify --urdf {path} --report {report} --terms viscous coulomb {GIVEN}".split()
    args += ["--log", *empty, "--payload-log", *loaded]
    assert main(args) == 0
    assert f"Payload on {truth.body_names[-1]}" in capsys.readouterr().out
    computed = json.loads(report.read_text())["payload"]
    # A slider carries it: the mass is told.
    assert abs(computed["mass"] - 0.7) < 0.01 and computed["percent"] < 0.2 * computed["percent_without"]
    assert main([*args, "--payload-body", "foot"]) == 2
    assert "the bodies are" in capsys.readouterr().err


@pytest.mark.long
def test_identify_the_gains_of_drives_from_a_known_payload(arm, tmp_path, capsys):
    """Currents of three drives; what is written is then the robot in newton metres."""
    truth = jd.model.repair_inertias(jd.load_model(arm))
    jd.save_urdf(truth, tmp_path / "true.urdf")
    held = jd.inertia.displaced(jd.inertia.sphere(0.7, 0.05), (0.05, 0, 0.1))
    (tmp_path / "held").mkdir()
    gains = np.array([0.8, 1.2, 1.1])
    empty = simulated_logs(truth, tmp_path, (0, 1), noise=0.002, gains=gains)
    loaded = simulated_logs(
        truth.replace(inertias=truth.inertias.at[-1].add(held)), tmp_path / "held", (2, 3), noise=0.002, gains=gains
    )
    args = ["identify", "--urdf", str(tmp_path / "true.urdf"), "--log", *empty, "--payload-log", *loaded]
    args += ["--terms", "viscous", "coulomb", "--v-s", "0.1", "--prior", "1", "--robust", "none"]
    files = ["--report", str(tmp_path / "fit.json"), "--html", str(tmp_path / "fit.html")]
    known = ["--payload-mass", "0.7", "--payload-centre", "0.05", "0", "0.1"]
    assert main([*args, *files, *known]) == 0
    assert "Drive gains, torque = gain * logged value" in capsys.readouterr().out
    assert "Drive gains, torque = gain" in (tmp_path / "fit.html").read_text()
    report = json.loads((tmp_path / "fit.json").read_text())
    drives = report["drive_gains"]
    told = np.array([name in drives["identifiable"] for name in truth.joint_names])
    off = np.abs(np.array(drives["gains"]) - gains)
    assert told.any() and np.all(off <= 4 * np.array(drives["std"]))
    assert np.all(off[told] < 0.05) and abs(report["payload"]["mass"] - 0.7) < 0.03
    assert report["torque_error"]["test_percent"] < 2
    for option, words in ((known[:2], "gains need --payload-log"), (known[2:], "without --payload-mass")):
        assert main([*args, *option]) == 2
        assert words in capsys.readouterr().err


@pytest.mark.long
def test_identify_chooses_for_several_logs(arm, tmp_path, capsys):
    truth = jd.model.repair_inertias(jd.load_model(arm))
    a, b = simulated_logs(truth, tmp_path, (0, 1), noise=0.01)
    path = tmp_path / "true.urdf"
    jd.save_urdf(truth, path)
    command = f"identify --urdf {path} --log {a} {b} --prior 1 --progress --html {tmp_path / 'x.html'}"
    assert main(command.split()) == 0
    text = capsys.readouterr().out
    assert "chosen over" in text and "held out:" in text and "The written robot was then fitted to all" in text
    assert "A.csv (last 30 %)" in text and "B.csv (last 30 %)" in text


def test_identify_recovers_a_simulated_arm(arm, tmp_path, capsys):
    """Noise-free samples at 100 Hz, filtered beforehand: the true base parameters come back."""
    truth = jd.load_model(arm)
    (path,) = simulated_logs(truth, tmp_path, (0,))
    wrong = tmp_path / "wrong.urdf"
    inertias = np.array(truth.inertias)
    inertias[:, :4] *= 1.2
    jd.save_urdf(truth.replace(inertias=inertias), wrong)
    args = ["identify", "--urdf", str(wrong), "--log", path, "--method", "least-squares"]
    assert main([*args, "--report", str(tmp_path / "report.json")]) == 0
    capsys.readouterr()
    report = json.loads((tmp_path / "report.json").read_text())
    base = jd.identify.base_parameters(truth, jd.identify.TERMS)
    x = jd.identify.nominal_parameters(truth)
    np.testing.assert_allclose(report["base_parameters"]["fitted"], base.values(x), rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_identify_by_trajectory_from_a_log_taken_as_filtered(arm, tmp_path, capsys):
    """A log that the command line itself simulated, accelerations left out: the mass error of a fifth is found."""
    log, wrong, out = tmp_path / "log.csv", tmp_path / "wrong.urdf", tmp_path / "fitted.urdf"
    model = jd.model.repair_inertias(jd.load_model(arm))
    jd.save_urdf(model, tmp_path / "true.urdf")
    jd.save_urdf(model.replace(inertias=1.2 * model.inertias), wrong)
    motion = ["--torque", "gravity+random", "--duration", "3", "--sample", "0.01", "--friction", "0", "--seed", "2"]
    assert main(["simulate", str(tmp_path / "true.urdf"), *motion, "--out", str(log)]) == 0
    args = ["identify", "--urdf", str(wrong), "--log", str(log), "--filtered", "--method", "trajectory"]
    assert main([*args, "--terms", "viscous", "--horizon", "0.1", "--out", str(out)]) == 0
    assert "trajectory fit" in capsys.readouterr().out
    report = json.loads(out.with_suffix(".json").read_text())
    # The torque between two rows of the log is not what the simulation had; that error of interpolation stays.
    errors = report["torque_error"]
    assert errors["test_percent"] < 1 < 10 < errors["nominal_test_percent"]


BAD_INPUT = """
info nowhere.urdf | nowhere.urdf
info ARM --lock elbow | elbow
info ARM --lock lift=high | no finite number
info ARM --repair out.txt | --repair
simulate ARM --q0 1 2 | --q0 has 2 numbers
simulate ARM --v0 elbow=1 | elbow
simulate ARM --torque full | --torque
simulate ARM --batch 4 | all motions would be the same
simulate ARM --damping -1 | --damping
simulate ARM --dt 0 | --dt
simulate ARM --duration -1 | --duration
simulate ARM --out motion.txt | --out
simulate ARM --html motion.txt | --html
simulate ARM --torque nowhere.csv | nowhere.csv
identify --urdf ARM --log nowhere.csv | nowhere.csv
identify --urdf ARM --log SHORT | lock
identify --urdf ARM --log NAN | nan
identify --urdf ARM --log BACK | time does not increase
identify --urdf ARM --log LONG --train 1 | fraction
identify --urdf ARM --log GOOD --method least-squares --out x.urdf | least squares
identify --urdf ARM --log GOOD | too few
identify --urdf ARM --log GOOD GOOD | given twice
identify --urdf ARM --log GOOD --rename m1 | as motor1=shoulder
identify --urdf ARM --log GOOD --test-log GOOD | a training log is no test of the fit
identify --urdf ARM --log GOOD --terms auto dahl | auto excludes other terms
identify --urdf ARM --log GOOD --v-s fast | --v-s: 'fast' is no finite number
identify --urdf ARM --log GOOD --method trajectory --terms dahl | need --method feasible
identify --urdf ARM --log GOOD LONG --method trajectory | fits one log
"""


@pytest.mark.parametrize("line", BAD_INPUT.strip().splitlines())
def test_bad_input_is_one_line_and_exit_status_2(line, arm, tmp_path, capsys):
    arguments, words = line.split(" | ")
    header, zeros = "t,q1,q2,q3,tau1,tau2,tau3\n", ",0,0,0,0,0,0\n"
    files = {
        "SHORT": "t,q1,tau1\n0,0,0\n1,0,0\n",
        "NAN": f"{header}0,0,nan,0,0,0,0\n1{zeros}",
        "BACK": f"{header}0{zeros}0{zeros}",
        "LONG": header + "".join(f"{0.01 * i}{zeros}" for i in range(400)),
        "GOOD": header + "".join(f"{0.01 * i}{zeros}" for i in range(20)),
    }
    places = {"ARM": str(arm)} | {name: str(tmp_path / f"{name.lower()}.csv") for name in files}
    for name, text in files.items():
        (tmp_path / f"{name.lower()}.csv").write_text(text)
    assert main([places.get(argument, argument) for argument in arguments.split()]) == 2
    shown = capsys.readouterr().err
    assert shown.startswith("jaxdyn: ") and shown.count("\n") == 1 and words in shown


def test_debug_shows_where_an_error_arose():
    with pytest.raises(ValueError, match=r"nowhere\.urdf"):
        main(["info", "nowhere.urdf", "--debug"])


@pytest.mark.slow
def test_simulate_writes_a_page_that_plays(arm, tmp_path, capsys):
    pytest.importorskip("viser")
    page = tmp_path / "motion.html"
    args = ["simulate", str(arm), "--duration", "0.1", "--dt", "0.01", "--torque", "gravity", "--html", str(page)]
    assert main(args) == 0
    assert f"Wrote {page}." in capsys.readouterr().out
    assert 300_000 < page.stat().st_size <= 2_000_000


LOOP = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="crank"><joint name="drive" axis="0 0 1" damping="0.01"/><inertial pos=".1 0 0" mass="1" diaginertia=".01 .01 .01"/>
    <body name="coupler" pos=".2 0 0"><joint name="knee" axis="0 0 1"/><inertial pos=".2 0 0" mass="1" diaginertia=".01 .01 .01"/>
  </body></body>
  <body name="rocker" pos=".5 0 0"><joint name="swing" axis="0 0 1"/><inertial pos=".2 0 0" mass="1" diaginertia=".01 .01 .01"/>
  <geom type="sphere" size=".01"/></body>
</worldbody>
<equality><connect body1="coupler" body2="rocker" anchor="{anchor} 0 0"/></equality>
<actuator><motor name="motor" joint="drive"/></actuator>
<keyframe><key name="open" qpos="0.3 0.6 1.4"/></keyframe></mujoco>"""


@pytest.fixture
def four_bar(tmp_path):
    path = tmp_path / "four_bar.xml"
    path.write_text(LOOP.replace("{anchor}", "0.5"))
    return path


@pytest.mark.long
def test_info_of_a_file_with_a_loop(four_bar, capsys):
    assert main(["info", str(four_bar)]) == 0
    text = capsys.readouterr().out
    assert "3 moving bodies, 3 degrees of freedom" in text
    assert "The constraints can be assembled: jd.assemble finds a configuration from the reference." in text
    assert "Degrees of freedom after constraints: 1 of 3 (2 in the singular position of the reference)" in text
    assert "Actuators: motor" in text and "Named states: reference, open" in text
    with pytest.warns(jd.io.NotTakenWarning):
        scene = jd.load(four_bar)
    line = next(line for line in text.splitlines() if scene.constraints[0].name in line)
    gap = np.abs(scene.constraints[0].position(scene.system, scene.starts["open"].q, 0.0)).max()
    assert f"{gap:.2g}" in line.split()
    assert "Unsupported elements of the file:" in text and "contact" in text
    assert main(["info", str(four_bar), "--repair", "x.urdf"]) == 2
    assert "only URDF files can be repaired" in capsys.readouterr().err
    assert main(["info", str(four_bar), "--lock", "knee"]) == 2
    assert "it applies to URDF files; leave it out" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize(
    "digits", [5, pytest.param(8, marks=pytest.mark.slow), pytest.param(17, marks=pytest.mark.slow)]
)
def test_info_says_which_rows_repeat_others(digits, tmp_path, capsys):
    """Bennett's linkage as a file of so many digits: by which its dependent rows are open where it moves."""
    path, number = tmp_path / "bennett.sdf", re.compile(r"(?<=[ >'])-?\d+\.\d+(e-?\d+)?(?=[ <])")
    path.write_text(number.sub(lambda x: f"{float(x[0]):.{digits}g}", bennett()))
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert "Degrees of freedom after constraints: 1 of 3\nRedundant rows, which jd.simulate leaves out" in text
    gap = float(re.search(r"hinge_\d: 3 of 5, which stay open by up to (\S+) m or rad", text)[1])
    assert 10.0 ** -(digits + 3) <= gap + 1e-16 and gap <= 10.0**-digits + 1e-14


def test_info_counts_couplings(panda, capsys):
    assert main(["info", str(panda)]) == 0
    text = capsys.readouterr().out
    assert "Degrees of freedom after constraints: 8 of 9" in text and "gear" in text


@pytest.mark.long
def test_simulate_a_file_with_a_loop(four_bar, tmp_path, capsys):
    """From its keyframe, closed at the start, and closed to its end; a start that the file does not name is refused."""
    out = tmp_path / "motion.npz"
    args = ["simulate", str(four_bar), "--duration", "0.2", "--sample", "0.05", "--out", str(out)]
    with pytest.warns(jd.io.NotTakenWarning):
        assert main([*args, "--start", "open"]) == 0
    text = capsys.readouterr().out
    assert "loops assembled at the start by joint displacements of up to" in text
    assert float(text.split("at most ")[1].split(" J")[0]) < 1e-7
    with pytest.warns(jd.io.NotTakenWarning):
        scene = jd.load(four_bar)
    gaps = [np.abs(scene.constraints[0].position(scene.system, jnp.asarray(q), 0.0)).max() for q in arrays_of(out)["q"]]
    assert max(gaps) < 1e-10
    with pytest.warns(jd.io.NotTakenWarning):
        assert main([*args, "--start", "home"]) == 2
    assert "--start is 'home'; the named states are reference, open" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("simulate ARM --duration inf", "--duration: 'inf' is no finite number"),
        ("simulate ARM --rtol nan", "--rtol: 'nan' is no finite number"),
        ("simulate ARM --damping 1_0", "--damping: '1_0' is no finite number"),
        ("simulate ARM --gravity 0 0 １", "--gravity: '１' is no finite number"),
        ("simulate ARM --batch 1_0", "--batch: '1_0' is no whole number"),
        ("simulate ARM --seed 99999999999999999999", "--seed: '99999999999999999999' is no whole number"),
        ("simulate ARM --duration 1e9 --sample 1e-3", "--duration 1e.09 --sample 0.001: .* GB of results"),
        ("simulate ARM --sample 1e-300", "--sample 1e-300: .* GB of results"),
        ("simulate ARM --batch 999999999999999999 --spread 1", "--batch 999999999999999999: .* GB of results"),
        ("simulate ARM --max-steps 0", "--max-steps is 0; give at least 1"),
        ("simulate ARM --spread -1", "--spread is -1.0; give at least 0"),
        ("simulate ARM --torque-size -1", "--torque-size is -1.0; give at least 0"),
        ("simulate ARM --lock lift=1_0", "--lock lift=1_0: '1_0' is no finite number"),
        ("simulate ARM --arguments a=1", "arguments is .* no .xacro file"),
        ("simulate ARM --arguments a", "--arguments a: give NAME=VALUE"),
        ("excite ARM --rate 1e300", "--rate 1e.300 .*GB of results"),
        ("excite ARM --period 1e-300", "rows a period do not hold 5 harmonics; give more than 10"),
        ("report four_bar --batch 999999999999999999", "--batch 999999999999999999: .* GB of results"),
        ("excite ARM --harmonics 0", "--harmonics is 0; give at least 1"),
        ("excite ARM --period -1", "--period is -1.0 s; give a positive time"),
        ("identify --urdf ARM --log x.csv --every 0", "--every is 0; give at least 1"),
        ("identify --urdf ARM --log x.csv --payload-mass 0", "--payload-mass is 0.0; give a positive number"),
        ("report four_bar --batch 0", "--batch is 0; give at least 1"),
        ("report four_bar --rounds 0", "--rounds is 0; give at least 1"),
        ("sweep x.toml --samples 0", "--samples is 0; give at least 1"),
        ("sweep x.toml --workers 0", "--workers is 0; give at least 1"),
    ],
)
def test_numbers_of_options_end_in_a_line(arguments, words, arm, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.toml").write_text('scene = "pendulum"\nout = "o.zarr"\nsamples = 2\nduration = 0.1\n')
    try:
        status = main([str(arm) if part == "ARM" else part for part in arguments.split()])
    except SystemExit as error:  # of argparse, which prints the usage first
        status = error.code
    assert status == 2
    assert re.search(words, capsys.readouterr().err.splitlines()[-1])


STUDY = {"scene": '"pendulum"', "out": '"o.zarr"', "samples": "2", "duration": "0.1"}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("duration = inf", "duration inf s"),
        ("duration = [1]", r"duration is \[1\]"),
        ("points = 1", "points 1;"),
        ("points = 100000000000000", "points 100000000000000: .* GB of results"),
        ("samples = 1e3", "samples is 1000.0; see"),
        ("seed = 100000000000000000000", "seed is 1000"),
        ("outputs = [1]", r"outputs is \[1\]; give a list of names"),
        ("parameters = 3", "parameters is 3; see"),
        ("[options]\nfoo = 1", r"\[options\] foo is 1; options are atol, "),
        ("[parameters]\nmass = nan", "parameter mass is nan; give a finite number"),
        ("[parameters]\nmass = { uniform = [1.0, inf] }", "parameter mass is .*inf.*; give a finite number"),
        ("[parameters]\nmass = { uniform = [1.0, 2.0], size = -1 }", "size is -1; give a whole number"),
        ("[parameters]\nmass = { uniform = [1.0, 2.0], units = 3 }", "units of mass are 3; give a text"),
    ],
)
def test_numbers_of_a_study_end_in_a_line(line, words, tmp_path, capsys):
    pytest.importorskip("zarr")
    lines = [f"{key} = {value}" for key, value in STUDY.items() if not line.startswith(f"{key} ")]
    (tmp_path / "study.toml").write_text("\n".join([*lines, line]))
    assert main(["sweep", str(tmp_path / "study.toml"), "--quiet"]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1 and re.search(words, text), text


MJCF = """<mujoco><worldbody>{}<body name="arm" pos="0 0 1"><joint name="j1" axis="0 1 0" pos="0 0 .1"/>
<joint name="j2" axis="1 0 0"/><geom size="0.1" pos="0 0 -1"/></body></worldbody>{}</mujoco>"""
BALL = '<body name="aa"><freejoint/><geom size="0.1"/></body>'


@pytest.mark.parametrize(
    ("bodies", "rest", "base"),
    [
        ("", "", "fixed base, 2 moving bodies"),
        (BALL, "", "fixed base and free bodies aa, 3"),
        (BALL, '<equality><weld body1="aa"/></equality>', r"fixed base \(by constraints\), 3"),
    ],
)
def test_info_says_what_stands_on_the_world(bodies, rest, base, tmp_path, capsys):
    """The bodies that a loader puts between two joints of one body are no fault of the file."""
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(MJCF.format(bodies, rest))
    assert main(["info", str(tmp_path / "arm.xml")]) == 0
    text = capsys.readouterr().out
    assert re.search(base, text.splitlines()[0])
    assert "arm_j1" in text and "Inertias: every moving body has a physical inertia." in text


def test_info_and_simulate_expand_xacro(tmp_path, capsys):
    pytest.importorskip("xacro")
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(
        '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arg name="mass" default="1.0"/><link name="a"/>'
        '<link name="b"><inertial><mass value="$(arg mass)"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        '</inertial></link><joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>'
    )
    for extra, mass in (([], "1 kg"), (["--arguments", "mass=2.5"], "2.5 kg")):
        assert main(["info", str(path), *extra]) == 0
        assert f"moving mass {mass}" in capsys.readouterr().out


@pytest.mark.long
def test_calibrate(tmp_path, capsys):
    """Poses are chosen, measured on an arm with other lengths, and give these back; held-out poses show the noise."""
    arm = """<robot name="arm"><link name="base"/>{links}</robot>"""
    link = """<link name="l{i}"><inertial><mass value="1"/>
      <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="l{i}"/>
      <origin xyz="{x} 0.1 0.3" rpy="0.3 0 0"/>
      <axis xyz="{axis}"/><limit lower="-2" upper="2" effort="9" velocity="9"/></joint>"""

    def write(name, stretch):
        links = [
            link.format(
                i=i, parent=f"l{i - 1}" if i else "base", x=0.1 + stretch * i, axis=("0 0 1", "0 1 0", "1 0 0")[i]
            )
            for i in range(3)
        ]
        (tmp_path / name).write_text(arm.format(links="".join(links)))
        return str(tmp_path / name)

    nominal, true = write("nominal.urdf", 0.0), jd.load_model(write("true.urdf", 0.004))
    poses = tmp_path / "poses.csv"
    assert main(["calibrate", nominal, "--frame", "l2", "--choose", "30", "--marker", "--out", str(poses)]) == 0
    header, *rows = poses.read_text().splitlines()
    assert header == "j0,j1,j2" and len(rows) == 30
    q = np.array([[float(x) for x in row.split(",")] for row in rows])
    places = np.stack([np.asarray(jd.frame_pose(true, jnp.asarray(x), "l2"))[:3, 3] for x in q])
    places = places + 1e-5 * np.random.default_rng(0).normal(size=places.shape)
    lines = [
        "j0,j1,j2,x,y,z",
        *(",".join(map(repr, [*a, *b])) for a, b in zip(q.tolist(), places.tolist(), strict=True)),
    ]
    poses.write_text("\n".join(lines))
    out = str(tmp_path / "calibrated.urdf")
    capsys.readouterr()
    assert main(["calibrate", nominal, "--frame", "l2", "--poses", str(poses), "--test", "0.2", "--out", out]) == 0
    text = capsys.readouterr().out
    # A marker on the frame of the last joint: its own turn moves it nowhere, so that fewer directions are found than any poses
    # of a marker beside it would determine.
    assert "error on the 6 poses held out" in text and "24 poses determine" in text
    assert float(text.split("held out: ")[1].split(" mm")[0]) < 0.1
    fitted = jd.load_model(out)
    assert fitted.joint_names == ("j0", "j1", "j2")
    seen = np.stack(
        [
            np.linalg.inv(jd.frame_pose(fitted, jnp.asarray(x), "measuring_device"))
            @ jd.frame_pose(fitted, jnp.asarray(x), "l2_measured")
            for x in q
        ]
    )
    # The file alone gives the measured places, to five deviations of the noise, 0.01 mm.
    np.testing.assert_allclose(seen[:, :3, 3], places, atol=5e-5)
    for bad, words in (
        (["--choose", "5", "--poses", str(poses)], "one of them"),
        (["--poses", str(poses), "--test", "2"], "--test is 2.0"),
    ):
        assert main(["calibrate", nominal, "--frame", "l2", *bad]) == 2 and words in capsys.readouterr().err
    for content, words in (
        ("j0,j1,j2,x,y\n1,2,3,4,5\n", "has no columns z"),
        ("j0,j1,j2,x,y,z\n1,2,3,4,5,six\n", "line 2"),
        ("j0,j1,j2,x,y,z\n1,2,3,4,5,6\n1,2,3,4,5,6,7\n", "line 3"),
        ("j0,j1,j2,x,y,z\n1,2,3,4,5,nan\n", "line 2"),
        ("j0,j1,j2,x,y,z,qw,qx,qy\n1,2,3,4,5,6,1,0,0\n", "has no columns qz"),
    ):
        poses.write_text(content)
        assert main(["calibrate", nominal, "--frame", "l2", "--poses", str(poses)]) == 2
        assert words in capsys.readouterr().err
