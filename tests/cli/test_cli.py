"""The command line: what it prints and writes, and how it says no."""

import csv
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio
import pytest
from motion_helpers import within

import jaxdyn as jd
from benchmarks.linkages import bennett
from jaxdyn.cli import main
from jaxdyn.identify.torque_terms import coulomb_through_filter

GIVEN = "--v-s 0.01 --prior 1 --robust none"
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A URDF of three joints: one with friction, one that slides, and one whose link breaks the triangle inequality."""
    builder = jd.ModelBuilder("arm")
    body = (2.0, (0, 0, 0.2), (0.02, 0.03, 0.02))
    builder.add_body("base", None, "fixed", body)
    turn = {"axis": (0, 1, 0), "damping": 0.3, "friction": 0.1}
    builder.add_body("upper", "base", "revolute", body, joint_name="shoulder", **turn)
    slide = {"axis": (0, 0, 1), "lower": -0.3, "upper": 0.3, "effort_limit": 50.0, "velocity_limit": 1.0}
    builder.add_body("slide", "upper", "prismatic", body, joint_name="lift", pose=(0, 0, 0.4), **slide)
    flat = (0.5, (0.1, 0, 0), (0.1, 0.001, 0.001))
    builder.add_body("hand", "slide", "continuous", flat, joint_name="wrist", pose=(0, 0, 0.1))
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    jd.save_urdf(builder.build(), path)
    return path


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The current folder, of each test its own."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(capsys):
    """Run a command; return what it prints, or what it says when it ends with another status."""

    def call(command, *arguments, status=0) -> str:
        assert main([*command.split(), *map(str, arguments)]) == status
        shown = capsys.readouterr()
        return shown.err if status == 2 else shown.out

    return call


@pytest.fixture
def truth(arm, folder):
    """The arm with inertias of bodies, which is also written to true.urdf."""
    model = jd.model.repair_inertias(jd.load_model(arm))
    jd.save_urdf(model, folder / "true.urdf")
    return model


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


def report_of(path):
    return json.loads(Path(path).read_text())


def test_info_shows_the_robot_and_its_faults(arm, run):
    text = run("info", arm)
    assert "3 moving bodies, 3 degrees of freedom" in text
    assert "moving mass 4.5 kg" in text
    for words in (("shoulder", "revolute", "rad", "0 1 0"), ("lift", "prismatic", "m", "0 0 1", "-0.3", "50")):
        line = next(line for line in text.splitlines() if words[0] in line)
        assert all(word in line for word in words)
    assert any("hand" in line and "triangle inequality" in line for line in text.splitlines())


def test_info_locks_floats_and_repairs(arm, run):
    assert "2 degrees of freedom" in run(f"info {arm} --lock lift=0.1 --repair repaired.urdf")
    repaired = jd.load_model("repaired.urdf")
    assert jd.model.inertia_report(repaired) == []
    np.testing.assert_allclose(repaired.inertias[:, 0].sum(), 4.5, rtol=1e-12)
    # The inertia of a base that is fixed to the world is not in the model, nor in the file: such a base cannot float.
    assert "root_joint" in run("info --floating-base", arm, status=2)


@pytest.mark.long
def test_info_of_a_real_robot_says_what_is_not_used(panda, run):
    text = run("info", panda)
    assert "panda_hand_tcp" in text and "<mimic>" in text
    assert "Degrees of freedom after constraints: 8 of 9" in text and "gear" in text


@pytest.mark.long
def test_simulate_writes_the_motion_that_the_library_computes(arm, folder, run):
    options = "--duration 0.2 --sample 0.05 --q0 shoulder=0.5 --friction 0 --torque gravity --v0 0.1 0 -0.2"
    text = run(f"simulate {arm} {options} --out motion.csv")
    assert float(text.split("at most ")[1].split(" J")[0]) < 1e-7
    columns = columns_of(folder / "motion.csv")
    model = jd.load_model(arm)
    names = [f"{signal}_{joint}" for signal in ("q", "v", "tau") for joint in model.joint_names]
    assert [name.partition(" [")[0] for name in columns] == ["t", *names, "energy", "work"]
    log = jd.read_log("motion.csv", joint_names=model.joint_names)
    q0, v0 = np.array([0.5, 0.0, 0.0]), np.array([0.1, 0.0, -0.2])
    options = {"control": lambda q, v, t: jd.gravity_force(model, q), "stepsize": within(1e-10)}
    scene = jd.Scene(model, forces=[jd.forces.JointDamping()])
    motion = jd.simulate(scene, q0, v0, np.linspace(0, 0.2, 5), **options)
    # Both integrations have a tolerance of 1e-8 or less per step.
    np.testing.assert_allclose(log.q, motion.q, atol=1e-7)
    np.testing.assert_allclose(log.v, motion.v, atol=1e-7)
    np.testing.assert_allclose(log.tau[0], jd.gravity_force(model, jnp.asarray(q0)), rtol=1e-12, atol=1e-12)

    # The file is a log: replayed, it gives the motion again, up to the torque between two rows.
    run(f"simulate {arm} --sample 0.05 --friction 0 --torque motion.csv --out again.npz")
    # Between rows of 0.05 s the torque is a line where it was a curve: 1e-5 rad here.
    np.testing.assert_allclose(jd.read_log("again.npz").q, motion.q, atol=2e-5)


@pytest.mark.long
def test_simulate_takes_implicit_steps_where_the_file_is_stiff(folder, run):
    """Friction of a file on a link of 1e-4 kg m² decays at 3e5 1/s: explicit steps would be some 30 000."""
    builder = jd.ModelBuilder("wrist")
    builder.add_body("hand", None, "revolute", (0.1, (0.0, 0.0, 0.1), (1e-4, 1e-4, 1e-4)), axis=(1, 0, 0))
    jd.save_urdf(builder.build().replace(friction=jnp.array([0.3])), "wrist.urdf")
    text = run("simulate wrist.urdf --duration 0.5 --q0 0.1 --out motion.csv")
    assert "steps of Rodas5P" in text and int(re.search(r"steps: (\d+)", text)[1]) < 1000


@pytest.mark.long
def test_simulate_a_batch_with_seed_and_plot(arm, folder, run):
    command = f"simulate {arm} --duration 0.1 --dt 0.01 --batch 3 --torque gravity+random"
    run(f"{command} --seed 1 --out a.npz --plot motion.png")
    run(f"{command} --seed 1 --out b.npz")
    run(f"{command} --seed 2 --out c.npz")
    a, b, c = (arrays_of(folder / name) for name in ("a.npz", "b.npz", "c.npz"))
    assert a["q"].shape == (3, 11, 3)
    assert a["energy"].shape == (3, 11)
    np.testing.assert_array_equal(a["tau"], b["tau"])
    assert np.abs(a["tau"] - c["tau"]).max() > 1e-3
    assert np.ptp(a["q"][:, -1], axis=0).max() > 1e-6
    assert (folder / "motion.png").stat().st_size > 10_000


def test_a_simulation_that_stops_early_is_exit_status_1(arm, run):
    command = f"simulate {arm} --duration 1 --max-steps 3 --q0 shoulder=0.5"
    assert "1 of 1 motions stopped early" in run(command, status=1)


@pytest.mark.long
@pytest.mark.data
def test_identify_the_recorded_panda_from_raw_samples(panda, franka, run):
    """Held-out torque error at most 1.45 %; unconstrained least squares with the same filter and split has 1.36 %."""
    t, q, tau = franka
    jd.io.write_log("log.csv", jd.identify.Log(t, q, tau=tau))
    command = f"identify --urdf {panda} --lock {' '.join(FINGERS)} --cutoff 8"
    terms = f"--terms {' '.join(jd.identify.TERMS)} --v-s 0.01 --prior 1 --weights none"
    assert "low-passed at 8 Hz" in run(f"{command} {terms} --log log.csv --out fitted.urdf")
    report = report_of("fitted.json")
    assert report["torque_error"]["test_percent"] <= 1.45
    assert report["test_logs"]["log.csv (last 30 %)"]["percent"] == report["torque_error"]["test_percent"]
    assert report["torque_error"]["nominal_test_percent"] > 10
    assert report["samples"] == {"train": 1744, "test": 748, "final": 2492}

    # What was written is what was fitted to all samples: bodies that exist, and with the offsets of the report the same torques.
    fitted = jd.load_model("fitted.urdf")
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
    error = jd.identify.torque_error(rows @ x, log.tau)
    np.testing.assert_allclose(error, report["torque_error"]["final_percent"], rtol=1e-6)
    assert report["torque_error"]["final_percent"] < report["torque_error"]["test_percent"]

    # The same samples, filtered beforehand and so marked by their accelerations, give the same answer.
    jd.io.write_log("filtered.npz", jd.identify.from_raw(t, q, tau))
    assert "used as filtered" in run(f"{command} --log filtered.npz --method least-squares --report ls.json")
    report = report_of("ls.json")
    assert abs(report["torque_error"]["test_percent"] - 1.36) < 0.01
    assert len(report["base_parameters"]["fitted"]) == len(report["base_parameters"]["std"])


@pytest.mark.slow
@pytest.mark.data
def test_identify_the_recorded_panda_with_terms_chosen(panda, franka, run):
    """By default terms, prior and smoothing are chosen on the training part alone: below 1.30 % on the rest."""
    t, q, tau = franka
    jd.io.write_log("log.csv", jd.identify.Log(t, q, tau=tau))
    command = f"identify --urdf {panda} --log log.csv --lock {' '.join(FINGERS)} --cutoff 8 --out fitted.urdf"
    assert "dahl at panda_joint1" in run(command)
    report = report_of("fitted.json")
    (errors,) = report["test_logs"].values()
    assert errors["percent"] < 1.30
    unconstrained = np.array([0.149, 0.214, 0.135, 0.184, 0.070, 0.070, 0.054])
    assert np.all(np.array(errors["rms_by_joint"]) <= 1.1 * unconstrained)
    assert report["chosen"]["extra_terms"]["dahl"]


def simulate_logs(model, names, noise=0.0, delay=0.0, gains=1.0):
    """Write filtered logs of sums of sines with exact rates, A.csv, B.csv, ..., of different lengths and sampling.

    Torques are those of `delay` before (s), over the gains of drives.
    """
    for name in names:
        k = seed = ord(name) - ord("A")
        rng = np.random.default_rng(seed)
        t = np.linspace(0, 4 + k, 401 - 50 * k)
        size, rate, phase = rng.uniform(0.2, 0.5, (3, 3)), rng.uniform(1, 4, (3, 3)), rng.uniform(0, 6, (3, 3))

        def at(t, size=size, rate=rate, phase=phase):
            angle = rate * t[:, None, None] + phase
            signs = (np.sin(angle), rate * np.cos(angle), -(rate**2) * np.sin(angle))
            return [np.sum(size * x, 1) for x in signs]

        q, v, a = at(t)
        tau = jd.identify.regressor(model, *at(t - delay)) @ jd.identify.nominal_parameters(model)
        jd.io.write_log(f"{name}.csv", jd.identify.Log(t, q, v, a, tau / gains + noise * rng.normal(size=tau.shape)))


@pytest.mark.long
def test_identify_chooses_the_cutoff_and_warns_of_vibration(arm, truth, run):
    """Raw logs of a motion up to 0.5 Hz, torques that vibrate at 9 Hz."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        t = np.linspace(0, 12, 2401)
        w = 2 * np.pi * 0.1 * np.arange(1, 6)[:, None]
        angle = w * t[:, None, None] + rng.uniform(0, 6, (5, 3))
        size = rng.uniform(0.3, 0.6, (5, 3)) / w
        q, v, a = (np.sum(size * x, 1) for x in (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle)))
        tau = jd.identify.regressor(truth, q, v, a) @ jd.identify.nominal_parameters(truth)
        tau += 0.05 * np.abs(tau).max(axis=0) * np.sin(2 * np.pi * 9 * t)[:, None]
        jd.io.write_log(f"{seed}.csv", jd.identify.Log(t, q, tau=tau))
    command = f"identify --urdf {arm} --log 0.csv --test-log 1.csv --report fit.json --repair --terms viscous {GIVEN}"
    text = run(command)
    assert re.search(r"--cutoff auto: 5(\.\d+)? Hz, ten times the band of the motion, 0.5", text)
    assert "beyond rigid-body dynamics" not in text
    chosen = report_of("fit.json")
    # Ten times a band that is read from lines 0.08 Hz apart.
    assert chosen["cutoff_hz"] == pytest.approx(5, abs=0.9) and chosen["torque_error"]["test_percent"] < 0.5
    text = run(f"{command} --cutoff 14")
    assert re.search(r"1.csv: (9\d|100) % .* beyond rigid-body dynamics: vibration; try --cutoff [456]", text)
    given = report_of("fit.json")
    assert given["cutoff_hz"] == 14 and given["torque_error"]["test_percent"] > 2
    run(f"{command} --cutoff low", status=2)


@pytest.mark.long
def test_identify_from_several_logs_judged_on_another(truth, folder, run):
    """Two logs fitted, one only predicted; JSON, page and URDF; what is not asked for is not tried."""
    simulate_logs(truth, "ABC", noise=0.01)
    jd.save_urdf(truth.replace(inertias=1.2 * truth.inertias), "wrong.urdf")
    text = run(
        f"identify --urdf wrong.urdf --log A.csv B.csv --test-log C.csv --terms viscous coulomb quadratic {GIVEN}"
        " --out fitted.urdf --report fit.json --html fit.html"
    )
    assert text.index("torque error:") < text.index("feasible fit of")
    assert "quadratic" in text and "chosen over" not in text
    computed = report_of("fit.json")
    assert set(computed["test_logs"]) == {"C.csv"} and set(computed["train_logs"]) == {"A.csv", "B.csv"}
    errors = computed["test_logs"]["C.csv"]
    assert len(errors["percent_by_joint"]) == truth.nv and errors["percent"] < 2 < 10 < errors["nominal_percent"]
    assert computed["samples"] == {"train": 752, "test": 301, "final": 752}
    sources = {name: row["from"] for name, row in computed["parameters"].items() if "from" in row}
    # Quadratic and viscous friction explain the same torque in part.
    assert set(sources.values()) <= {"data", "prior", "bound", "confounded"}
    assert all(name.endswith(("viscous", "coulomb", "quadratic")) for name, x in sources.items() if x == "confounded")
    assert jd.model.inertia_report(jd.load_model("fitted.urdf")) == []
    # Nothing outside of the page: names of XML are the only addresses.
    text = (folder / "fit.html").read_text()
    assert "<svg" in text and text.count("http") == text.count("http://www.w3.org/")
    assert text.strip().endswith("</html>") and not list(folder.glob(".*"))


def test_identify_from_one_file_and_the_robot_it_writes(truth, folder, run):
    """Options of a file, overruled by the command line; Pinocchio and MuJoCo read the URDF, we its offsets and terms too."""
    simulate_logs(truth, "ABC", noise=0.01)
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
    (folder / "fit.txt").write_text(options)
    assert "v_s 0.02, prior 1, loss squares" in run("identify @fit.txt --prior 1")
    computed = report_of("fitted.json")
    torques = jd.io.read_torque_terms("fitted.urdf")
    assert [torques[name]["offset"] for name in truth.joint_names] == computed["friction"]["offset"]
    assert {torques[name]["v_s"] for name in truth.joint_names} == {0.02}
    assert [torques[name]["quadratic"] for name in truth.joint_names] == computed["extra_terms"]["quadratic"]
    read, fitted = pinocchio.buildModelFromUrdf("fitted.urdf"), jd.load_model("fitted.urdf")
    np.testing.assert_allclose(read.friction, fitted.friction, rtol=1e-12)
    np.testing.assert_allclose(read.damping, fitted.damping, rtol=1e-12)
    body = mujoco.MjModel.from_xml_path("fitted.urdf")
    np.testing.assert_allclose(body.dof_frictionloss, fitted.friction, rtol=1e-6)
    np.testing.assert_allclose(body.body_mass[1:], fitted.inertias[:, 0], rtol=1e-6)
    with pytest.raises(ValueError, match="elbow are no joints"):
        jd.save_urdf(truth, "x.urdf", torques={"elbow": {"offset": 1.0}})


@pytest.mark.long
def test_identify_finds_delays(truth, folder, run):
    """20 ms: found, printed, in both reports, judged on shifted logs, counted in a payload; given as a number, the same fit."""
    simulate_logs(truth, "AB", noise=0.005, delay=0.02)
    held = truth.replace(inertias=truth.inertias.at[-1].add(jd.inertia.sphere(0.7, 0.05)))
    simulate_logs(held, "C", noise=0.005, delay=0.02)
    command = "identify --urdf true.urdf --log A.csv --test-log B.csv --report fit.json --html fit.html"
    command += " --terms viscous coulomb --v-s 0.1 --prior 1 --robust none --payload-log C.csv"
    text = run(f"{command} --delay auto")
    assert "Delays of the torques against the positions (ms)" in text and f"Payload on {truth.body_names[-1]}" in text
    assert "the bodies are" in run(f"{command} --payload-body foot", status=2)
    report = report_of("fit.json")
    delays = report["delays"]
    off, half = np.abs(np.array(delays["seconds"]) - 0.02), delays["interval_factor"] * np.array(delays["std"])
    assert delays["by"] == "auto" and np.all(off <= half) and np.all(half < 0.005)
    name = f"{truth.joint_names[0]}.delay"
    assert report["parameters"][name]["fitted"] == delays["seconds"][0]
    assert report["test_logs"]["B.csv"]["percent"] < 1 and abs(report["payload"]["mass"] - 0.7) < 0.02
    assert "Delays of the torques against the positions" in (folder / "fit.html").read_text()
    run(f"{command} --delay", *delays["seconds"])
    again = report_of("fit.json")
    assert again["delays"]["by"] == "given" and again["delays"]["std"] == [None] * 3
    percents = [x["test_logs"]["B.csv"]["percent"] for x in (again, report)]
    np.testing.assert_allclose(*percents, rtol=1e-6)
    for option, words in {
        "auto 0.1": "exclude other values",
        "late": "--delay: 'late'",
        "0.1 0.1": "each of 3 torques",
        "0.1 --method least-squares": "does not support delays",
    }.items():
        assert words in run(f"identify --urdf true.urdf --log A.csv --delay {option}", status=2)


def test_identify_repairs_a_link_of_zero_inertia(truth, run):
    simulate_logs(truth, "AB", noise=0.01)
    jd.save_urdf(truth.replace(inertias=truth.inertias.at[1, 4:].set(0.0).at[2].set(0.0)), "zero.urdf")
    command = f"identify --urdf zero.urdf --log A.csv --test-log B.csv --terms viscous coulomb {GIVEN}"
    assert "moves no inertia" in run(command, status=2)
    assert "repaired inertias: hand, slide" in run(f"{command} --repair")


def held_payload(truth):
    """The arm with a ball of 0.7 kg in its hand."""
    ball = jd.inertia.displaced(jd.inertia.sphere(0.7, 0.05), (0.05, 0, 0.1))
    return truth.replace(inertias=truth.inertias.at[-1].add(ball))


@pytest.mark.long
def test_identify_the_gains_of_drives_from_a_known_payload(truth, folder, run):
    """Currents of three drives; what is written is then the robot in newton metres."""
    gains = np.array([0.8, 1.2, 1.1])
    simulate_logs(truth, "AB", noise=0.002, gains=gains)
    simulate_logs(held_payload(truth), "CD", noise=0.002, gains=gains)
    command = "identify --urdf true.urdf --log A.csv B.csv --payload-log C.csv D.csv"
    command += " --terms viscous coulomb --v-s 0.1 --prior 1 --robust none"
    files, mass, centre = "--report fit.json --html fit.html", "--payload-mass 0.7", "--payload-centre 0.05 0 0.1"
    assert "Drive gains, torque = gain * logged value" in run(f"{command} {files} {mass} {centre}")
    assert "Drive gains, torque = gain" in (folder / "fit.html").read_text()
    report = report_of("fit.json")
    drives = report["drive_gains"]
    told = np.array([name in drives["identifiable"] for name in truth.joint_names])
    off = np.abs(np.array(drives["gains"]) - gains)
    assert told.any() and np.all(off <= 4 * np.array(drives["std"]))
    assert np.all(off[told] < 0.05) and abs(report["payload"]["mass"] - 0.7) < 0.03
    assert report["torque_error"]["test_percent"] < 2
    assert "without --payload-mass" in run(f"{command} {centre}", status=2)
    assert "gains need --payload-log" in run(f"{command} {mass}", status=2)


@pytest.mark.long
def test_identify_chooses_for_several_logs(truth, run):
    simulate_logs(truth, "AB", noise=0.01)
    text = run("identify --urdf true.urdf --log A.csv B.csv --prior 1 --progress --html x.html")
    assert "chosen over" in text and "held out:" in text and "The written robot was then fitted to all" in text
    assert "A.csv (last 30 %)" in text and "B.csv (last 30 %)" in text


def test_identify_recovers_a_simulated_arm(arm, run):
    """Noise-free samples at 100 Hz, filtered beforehand: the true base parameters come back."""
    truth = jd.load_model(arm)
    simulate_logs(truth, "A")
    jd.save_urdf(truth.replace(inertias=truth.inertias.at[:, :4].multiply(1.2)), "wrong.urdf")
    run("identify --urdf wrong.urdf --log A.csv --method least-squares --report report.json")
    base = jd.identify.base_parameters(truth, jd.identify.TERMS)
    x = jd.identify.nominal_parameters(truth)
    found = report_of("report.json")["base_parameters"]["fitted"]
    np.testing.assert_allclose(found, base.values(x), rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_identify_by_trajectory_from_a_log_taken_as_filtered(truth, run):
    """A log that the command line itself simulated, accelerations left out: the mass error of a fifth is found."""
    jd.save_urdf(truth.replace(inertias=1.2 * truth.inertias), "wrong.urdf")
    run("simulate true.urdf --torque gravity+random --duration 3 --sample 0.01 --friction 0 --seed 2 --out log.csv")
    command = "identify --urdf wrong.urdf --log log.csv --filtered --method trajectory"
    assert "trajectory fit" in run(f"{command} --terms viscous --horizon 0.1 --out fitted.urdf")
    # The torque between two rows of the log is not what the simulation had; that error of interpolation stays.
    errors = report_of("fitted.json")["torque_error"]
    assert errors["test_percent"] < 1 < 10 < errors["nominal_test_percent"]


BAD_INPUT = r"""
info nowhere.urdf | nowhere\.urdf
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
simulate ARM --torque nowhere.csv | nowhere\.csv
identify --urdf ARM --log nowhere.csv | nowhere\.csv
identify --urdf ARM --log short.csv | lock
identify --urdf ARM --log nan.csv | nan
identify --urdf ARM --log back.csv | time does not increase
identify --urdf ARM --log long.csv --train 1 | fraction
identify --urdf ARM --log good.csv --method least-squares --out x.urdf | least squares
identify --urdf ARM --log good.csv | too few
identify --urdf ARM --log good.csv good.csv | given twice
identify --urdf ARM --log good.csv --rename m1 | as motor1=shoulder
identify --urdf ARM --log good.csv --test-log good.csv | a training log is no test of the fit
identify --urdf ARM --log good.csv --terms auto dahl | auto excludes other terms
identify --urdf ARM --log good.csv --v-s fast | --v-s: 'fast' is no finite number
identify --urdf ARM --log good.csv --method trajectory --terms dahl | need --method feasible
identify --urdf ARM --log good.csv long.csv --method trajectory | fits one log
simulate ARM --duration inf | --duration: 'inf' is no finite number
simulate ARM --rtol nan | --rtol: 'nan' is no finite number
simulate ARM --damping 1_0 | --damping: '1_0' is no finite number
simulate ARM --gravity 0 0 １ | --gravity: '１' is no finite number
simulate ARM --batch 1_0 | --batch: '1_0' is no whole number
simulate ARM --seed 99999999999999999999 | --seed: '99999999999999999999' is no whole number
simulate ARM --duration 1e9 --sample 1e-3 | --duration 1e.09 --sample 0.001: .* GB of results
simulate ARM --sample 1e-300 | --sample 1e-300: .* GB of results
simulate ARM --batch 999999999999999999 --spread 1 | --batch 999999999999999999: .* GB of results
simulate ARM --max-steps 0 | --max-steps is 0; give at least 1
simulate ARM --spread -1 | --spread is -1.0; give at least 0
simulate ARM --torque-size -1 | --torque-size is -1.0; give at least 0
simulate ARM --lock lift=1_0 | --lock lift=1_0: '1_0' is no finite number
simulate ARM --arguments a=1 | arguments is .* no .xacro file
simulate ARM --arguments a | --arguments a: give NAME=VALUE
excite ARM --rate 1e300 | --rate 1e.300 .*GB of results
excite ARM --period 1e-300 | rows a period do not hold 5 harmonics; give more than 10
report four_bar --batch 999999999999999999 | --batch 999999999999999999: .* GB of results
excite ARM --harmonics 0 | --harmonics is 0; give at least 1
excite ARM --period -1 | --period is -1.0 s; give a positive time
identify --urdf ARM --log x.csv --every 0 | --every is 0; give at least 1
identify --urdf ARM --log x.csv --payload-mass 0 | --payload-mass is 0.0; give a positive number
report four_bar --batch 0 | --batch is 0; give at least 1
report four_bar --rounds 0 | --rounds is 0; give at least 1
report | free_body
report pendulums | pendulums
report free_body --dtype float16 | float16
report free_body --integrator Dopri8 | integrators
report free_body --integrator free:Euler | Euler
report four_bar free_body --integrator projected:Dopri8 | free_body does not support
report free_body --integrator fre:Dopri8 | integrators
sweep x.toml --samples 0 | --samples is 0; give at least 1
sweep x.toml --workers 0 | --workers is 0; give at least 1
identify @incomplete.txt | --urdf and --log: missing
identify @missing.txt | missing.txt
identify --logs | unrecognized arguments: --logs
identify fit.toml | fit.toml; a file of options is given as @fit.txt, with lines such as --urdf
identify fit.txt | fit.txt; a file of options is given as @fit.txt, with lines such as --urdf
identify @open.txt | a line in a file of options is '--train "0.6'; close
identify @itself.txt | names itself
"""


@pytest.mark.parametrize("line", BAD_INPUT.strip().splitlines())
def test_bad_input_is_one_line_and_exit_status_2(line, arm, folder, capsys):
    """Behind the usage, where argparse refuses an option."""
    arguments, words = line.split(" | ")
    header, zeros = "t,q1,q2,q3,tau1,tau2,tau3\n", ",0,0,0,0,0,0\n"
    files = {
        "short.csv": "t,q1,tau1\n0,0,0\n1,0,0\n",
        "nan.csv": f"{header}0,0,nan,0,0,0,0\n1{zeros}",
        "back.csv": f"{header}0{zeros}0{zeros}",
        "long.csv": header + "".join(f"{0.01 * i}{zeros}" for i in range(400)),
        "good.csv": header + "".join(f"{0.01 * i}{zeros}" for i in range(20)),
        "x.toml": 'scene = "pendulum"\nout = "o.zarr"\nsamples = 2\nduration = 0.1\n',
        "incomplete.txt": "--train 0.5\n",
        "open.txt": '--train "0.6\n',
        "itself.txt": "@itself.txt\n",
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    try:
        status, usage = main([str(arm) if part == "ARM" else part for part in arguments.split()]), False
    except SystemExit as error:
        status, usage = error.code, True
    shown = capsys.readouterr().err
    assert status == 2 and (usage or (shown.startswith("jaxdyn: ") and shown.count("\n") == 1))
    assert re.search(words, " ".join(shown.split()) if usage else shown)


@pytest.mark.parametrize("name", ["forward_dynamics", "forward_kinematics"])
def test_export_writes_the_function(name, arm, folder, run):
    """Numbers in the test program are those of the library at the neutral configuration, without velocities and torques."""
    assert f"in out: {name}.h, {name}.o, {name}_test.c" in run(f"export {arm} --function {name} --out out")
    model, inputs = jd.load_model(arm), 3 if name == "forward_dynamics" else 1
    wanted = getattr(jd, name)(model, *[jnp.zeros(3)] * inputs)
    numbers = re.search(r"expected_out\[\] = {(.*?)}", (folder / "out" / f"{name}_test.c").read_text())[1]
    np.testing.assert_allclose([float.fromhex(x) for x in numbers.split(", ")], wanted.ravel(), rtol=1e-12, atol=1e-12)


def test_export_names_what_a_function_of_the_tree_leaves_out(folder, run):
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    joint = '<joint name="{0}" type="continuous"><parent link="base"/><child link="{1}"/><axis xyz="0 0 1"/>{2}</joint>'
    joints = joint.format("j", "a", '<dynamics damping="0.4"/>') + joint.format("k", "b", '<mimic joint="j"/>')
    (folder / "rotors.urdf").write_text(
        f'<robot name="r"><link name="base"/><link name="a">{inertial}</link><link name="b">{inertial}</link>{joints}</robot>'
    )
    assert "without gear k-j, JointDamping; --function constrained_dynamics" in run("export rotors.urdf --out out")
    assert "without" not in run("export rotors.urdf --function constrained_dynamics --out out")
    assert "without" not in run("export rotors.urdf --function mass_matrix --out out")


def test_debug_shows_where_an_error_arose():
    with pytest.raises(ValueError, match=r"nowhere\.urdf"):
        main(["info", "nowhere.urdf", "--debug"])


@pytest.mark.slow
def test_simulate_writes_a_page_that_plays(arm, folder, run):
    pytest.importorskip("viser")
    text = run(f"simulate {arm} --duration 0.1 --dt 0.01 --torque gravity --html motion.html")
    assert "Wrote motion.html." in text and 300_000 < (folder / "motion.html").stat().st_size <= 2_000_000


LOOP = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="crank"><joint name="drive" axis="0 0 1" damping="0.01"/><inertial pos=".1 0 0" mass="1" diaginertia=".01 .01 .01"/>
    <body name="coupler" pos=".2 0 0"><joint name="knee" axis="0 0 1"/><inertial pos=".2 0 0" mass="1" diaginertia=".01 .01 .01"/>
  </body></body>
  <body name="rocker" pos=".5 0 0"><joint name="swing" axis="0 0 1"/><inertial pos=".2 0 0" mass="1" diaginertia=".01 .01 .01"/>
  <geom type="sphere" size=".01"/></body>
</worldbody>
<equality><connect body1="coupler" body2="rocker" anchor="0.5 0 0"/></equality>
<actuator><motor name="motor" joint="drive"/></actuator>
<keyframe><key name="open" qpos="0.3 0.6 1.4"/></keyframe></mujoco>"""


@pytest.fixture
def four_bar(folder):
    (folder / "four_bar.xml").write_text(LOOP)
    return "four_bar.xml"


@pytest.mark.long
def test_info_of_a_file_with_a_loop(four_bar, run):
    text = run("info", four_bar)
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
    assert "only URDF files can be repaired" in run("info --repair x.urdf", four_bar, status=2)
    assert "it applies to URDF files; leave it out" in run(f"info {four_bar} --lock knee", status=2)


@pytest.mark.long
def test_info_says_which_rows_repeat_others(folder, run):
    """Bennett's linkage as a file of five digits: by which its dependent rows are open where it moves."""
    path, number = folder / "bennett.sdf", re.compile(r"(?<=[ >'])-?\d+\.\d+(e-?\d+)?(?=[ <])")
    path.write_text(number.sub(lambda x: f"{float(x[0]):.5g}", bennett()))
    text = run("info", path)
    assert "Degrees of freedom after constraints: 1 of 3\nRedundant rows, which jd.simulate leaves out" in text
    gap = float(re.search(r"hinge_\d: 3 of 5, which stay open by up to (\S+) m or rad", text)[1])
    assert 1e-8 <= gap + 1e-16 and gap <= 1e-5 + 1e-14


@pytest.mark.long
def test_simulate_a_file_with_a_loop(four_bar, folder, run):
    """From its keyframe, closed at the start, and closed to its end; a start that the file does not name is refused."""
    command = f"simulate {four_bar} --duration 0.2 --sample 0.05 --out motion.npz"
    with pytest.warns(jd.io.NotTakenWarning):
        text = run(f"{command} --start open")
    assert "loops assembled at the start by joint displacements of up to" in text
    assert float(text.split("at most ")[1].split(" J")[0]) < 1e-7
    with pytest.warns(jd.io.NotTakenWarning):
        scene = jd.load(four_bar)
    (loop,), qs = scene.constraints, jnp.asarray(arrays_of("motion.npz")["q"])
    assert max(np.abs(loop.position(scene.system, q, 0.0)).max() for q in qs) < 1e-10
    with pytest.warns(jd.io.NotTakenWarning):
        assert "--start is 'home'; the named states are reference, open" in run(f"{command} --start home", status=2)


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
def test_info_says_what_stands_on_the_world(bodies, rest, base, folder, run):
    """The bodies that a loader puts between two joints of one body are no fault of the file."""
    pytest.importorskip("mujoco")
    (folder / "arm.xml").write_text(MJCF.format(bodies, rest))
    text = run("info arm.xml")
    assert re.search(base, text.splitlines()[0])
    assert "arm_j1" in text and "Inertias: every moving body has a physical inertia." in text


def test_info_expands_xacro(folder, run):
    pytest.importorskip("xacro")
    path = folder / "arm.urdf.xacro"
    path.write_text(
        '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arg name="mass" default="1.0"/><link name="a"/>'
        '<link name="b"><inertial><mass value="$(arg mass)"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        '</inertial></link><joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>'
    )
    assert "moving mass 1 kg" in run("info", path)
    assert "moving mass 2.5 kg" in run(f"info {path} --arguments mass=2.5")


@pytest.mark.long
def test_calibrate(folder, run):
    """Poses are chosen, measured on an arm with other lengths, and give these back; held-out poses show the noise."""

    def write(name, stretch):
        builder = jd.ModelBuilder("arm").add_body("base", joint="fixed")
        limits = {"lower": -2.0, "upper": 2.0, "effort_limit": 9.0, "velocity_limit": 9.0}
        for i, axis in enumerate(((0, 0, 1), (0, 1, 0), (1, 0, 0))):
            pose, parent = ((0.1 + stretch * i, 0.1, 0.3), (0.3, 0, 0)), f"l{i - 1}" if i else "base"
            options = {"axis": axis, "pose": pose, "joint_name": f"j{i}", "inertia": jd.inertia.sphere(1.0, 0.5)}
            builder.add_body(f"l{i}", parent, **options, **limits)
        jd.save_urdf(builder.build(), folder / name)

    write("nominal.urdf", 0.0)
    write("true.urdf", 0.004)
    command, true, poses = "calibrate nominal.urdf --frame l2", jd.load_model("true.urdf"), folder / "poses.csv"
    run(f"{command} --choose 30 --marker --out poses.csv")
    header, *rows = poses.read_text().splitlines()
    assert header == "j0,j1,j2" and len(rows) == 30
    q = np.array([[float(x) for x in row.split(",")] for row in rows])
    places = jax.vmap(lambda q: jd.frame_pose(true, q, "l2")[:3, 3])(q)
    places = places + 1e-5 * np.random.default_rng(0).normal(size=places.shape)
    lines = [",".join(map(repr, row)) for row in np.concatenate([q, places], axis=1).tolist()]
    poses.write_text("\n".join(["j0,j1,j2,x,y,z", *lines]))
    text = run(f"{command} --poses poses.csv --test 0.2 --out calibrated.urdf")
    # A marker on the frame of the last joint: its own turn moves it nowhere, so that fewer directions are found than any poses
    # of a marker beside it would determine.
    assert "error on the 6 poses held out" in text and "24 poses determine" in text
    assert float(text.split("held out: ")[1].split(" mm")[0]) < 0.1
    fitted = jd.load_model("calibrated.urdf")
    assert fitted.joint_names == ("j0", "j1", "j2")
    device, marker = (
        jax.vmap(lambda q, f=f: jd.frame_pose(fitted, q, f))(q) for f in ("measuring_device", "l2_measured")
    )
    seen = np.linalg.inv(device) @ marker
    # The file alone gives the measured places, to five deviations of the noise, 0.01 mm.
    np.testing.assert_allclose(seen[:, :3, 3], places, atol=5e-5)
    assert "one of them" in run(f"{command} --choose 5 --poses poses.csv", status=2)
    assert "--test is 2.0" in run(f"{command} --poses poses.csv --test 2", status=2)
    for content, words in (
        ("j0,j1,j2,x,y\n1,2,3,4,5\n", "has no columns z"),
        ("j0,j1,j2,x,y,z\n1,2,3,4,5,six\n", "line 2"),
        ("j0,j1,j2,x,y,z\n1,2,3,4,5,6\n1,2,3,4,5,6,7\n", "line 3"),
        ("j0,j1,j2,x,y,z\n1,2,3,4,5,nan\n", "line 2"),
        ("j0,j1,j2,x,y,z,qw,qx,qy\n1,2,3,4,5,6,1,0,0\n", "has no columns qz"),
    ):
        poses.write_text(content)
        assert words in run(f"{command} --poses poses.csv", status=2)
