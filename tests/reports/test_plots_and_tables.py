"""Plots of solutions, and solutions as files: names, units, and what comes back."""

import csv
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.model.configuration import columns_of

TS = np.linspace(0.0, 1.0, 6)


def solution_of(scene, seed: int = 0, **outputs) -> jd.Solution:
    """A solution of random numbers: what is drawn and written does not ask how it was found."""
    rng = np.random.default_rng(seed)
    random = lambda *shape: jnp.asarray(rng.normal(size=(6, *shape)))  # noqa: E731
    arrays = {key: random(*shape) for key, shape in outputs.items()}
    return jd.Solution(jnp.asarray(TS), random(scene.nq), random(scene.nv), jd.RESULTS.successful, {}, **arrays)


def batch_of(*solutions) -> jd.Solution:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *solutions)


def table_of(path) -> list[list[str]]:
    with path.open(newline="") as file:
        return list(csv.reader(file))


@pytest.fixture(scope="module")
def arm() -> jd.Model:
    body = (1.0, (0.0, 0.0, 0.1), (0.1, 0.1, 0.1))
    builder = jd.ModelBuilder("arm")
    builder.add_body("upper", joint_name="shoulder", axis=(0, 1, 0), inertia=body)
    builder.add_body("slide", "upper", "prismatic", body, joint_name="lift")
    return builder.build()


@pytest.fixture(scope="module")
def floating() -> jd.Model:
    body = (1.0, (0.0, 0.0, 0.1), (0.1, 0.1, 0.1))
    builder = jd.ModelBuilder("floating")
    builder.add_body("base", None, "free", body, joint_name="root")
    return builder.add_body("leg", "base", joint_name="hip", axis=(0, 1, 0), inertia=body).build()


ALL = dict(energy=(), power=(), work=(), acceleration=(2,), torque=(2,), constraint_residual=(2,))


def test_names_and_units_of_coordinates(arm, floating):
    computed = columns_of(arm)
    assert computed.q == computed.v == ("shoulder", "lift")
    assert (computed.q_units, computed.force_units) == (("rad", "m"), ("N m", "N"))
    computed = columns_of(floating)
    assert computed.q == ("root.x", "root.y", "root.z", "root.qw", "root.qx", "root.qy", "root.qz", "hip")
    assert computed.v == ("root.vx", "root.vy", "root.vz", "root.wx", "root.wy", "root.wz", "hip")
    assert computed.v_units == ("m/s",) * 3 + ("rad/s",) * 4 and computed.a_units[0] == "m/s^2"
    assert columns_of(jd.scenes.pendulum().system).q == ("q1",)


def test_csv_with_names_and_units_is_a_log(arm, tmp_path):
    solution = solution_of(arm, **ALL)
    solution.to_csv(tmp_path / "motion.csv", arm)
    header = table_of(tmp_path / "motion.csv")[0]
    assert header[:5] == ["t [s]", "q_shoulder [rad]", "q_lift [m]", "v_shoulder [rad/s]", "v_lift [m/s]"]
    assert {"a_lift [m/s^2]", "tau_shoulder [N m]", "tau_lift [N]", "energy [J]", "power [W]"} <= set(header)
    log = jd.read_log(tmp_path / "motion.csv", joint_names=arm.joint_names)
    for ours, theirs in (
        (solution.q, log.q),
        (solution.v, log.v),
        (solution.acceleration, log.a),
        (solution.torque, log.tau),
    ):
        np.testing.assert_array_equal(theirs, ours)  # every digit
    assert tuple(log.joint_names) == arm.joint_names


def test_csv_of_joints_with_several_numbers_counts_them(floating, tmp_path):
    solution = solution_of(floating, torque=(7,))
    solution.to_csv(tmp_path / "motion.csv", floating)
    header = table_of(tmp_path / "motion.csv")[0]
    assert header[1] == "q1 [root.x; m]" and header[8] == "q8 [hip; rad]" and header[9] == "v1 [root.vx; m/s]"
    log = jd.read_log(tmp_path / "motion.csv")
    np.testing.assert_array_equal(log.q, solution.q)
    np.testing.assert_array_equal(log.tau, solution.torque)


def test_csv_of_a_batch_and_of_multipliers(tmp_path):
    scene = jd.scenes.four_bar()
    both = batch_of(*(solution_of(scene, k, multipliers=(2,)) for k in range(2)))
    both.to_csv(tmp_path / "motions.csv", scene)
    rows = table_of(tmp_path / "motions.csv")
    assert rows[0][:2] == ["rollout", "t [s]"] and rows[0][-2:] == [
        f"multipliers_{scene.constraints[0].name}.{k}" for k in (1, 2)
    ]
    assert [row[0] for row in rows[1:]] == ["1"] * 6 + ["2"] * 6
    np.testing.assert_array_equal(np.array(rows[8][-2:], float), both.multipliers[1, 1])


def test_npz_keeps_shapes_names_and_units(arm, tmp_path):
    solution = solution_of(arm, **ALL)
    solution.to_npz(tmp_path / "motion.npz", arm)
    with np.load(tmp_path / "motion.npz") as file:
        np.testing.assert_array_equal(file["q"], solution.q)
        assert json.loads(str(file["names"]))["tau"] == ["shoulder", "lift"]
        assert json.loads(str(file["units"]))["v"] == ["rad/s", "m/s"]
        assert json.loads(str(file["units"]))["energy"] == "J"
    np.testing.assert_array_equal(jd.read_log(tmp_path / "motion.npz").tau, solution.torque)
    both = batch_of(solution, solution)
    both.to_npz(tmp_path / "motions.npz", arm)
    with np.load(tmp_path / "motions.npz") as file:
        assert file["q"].shape == (2, 6, 2) and file["t"].shape == (6,)


def test_xarray_has_names_as_coordinates(arm):
    pytest.importorskip("xarray", reason="xarray is not installed")
    table = solution_of(arm, **ALL).to_xarray(arm)
    assert table.q.dims == ("t", "coordinate") and list(table.coordinate.values) == ["shoulder", "lift"]
    assert table.tau.attrs["units"] == ["N m", "N"] and table.t.attrs["units"] == "s"
    assert batch_of(*(solution_of(arm, k) for k in range(3))).to_xarray(arm).q.dims == ("rollout", "t", "coordinate")


def test_files_refuse(arm, floating, tmp_path):
    solution = solution_of(arm)
    with pytest.raises(ValueError, match=r"write to a file \.csv"):
        solution.to_csv(tmp_path / "motion.txt", arm)
    with pytest.raises(ValueError, match="there is no directory"):
        solution.to_npz(tmp_path / "no" / "motion.npz", arm)
    with pytest.raises(ValueError, match="pass the scene"):
        solution.to_csv(tmp_path / "motion.csv", floating)


def lines(ax) -> dict[str, np.ndarray]:
    return {line.get_label(): line.get_ydata() for line in ax.get_lines()}


def test_plots_have_names_units_and_the_numbers(arm):
    pytest.importorskip("matplotlib")
    solution = solution_of(arm, **ALL)
    positions, velocities = jd.plot.states(arm, solution)
    assert positions.get_ylabel() == "position (rad, m)" and velocities.get_ylabel() == "velocity (rad/s, m/s)"
    assert velocities.get_xlabel() == "time (s)"
    np.testing.assert_array_equal(lines(positions)["lift"], solution.q[:, 1])
    ax = jd.plot.energy(arm, solution)
    change = np.asarray(solution.energy - solution.energy[0])
    np.testing.assert_allclose(lines(ax)["E - E(0)"], change, atol=1e-15)
    np.testing.assert_allclose(lines(ax)["E - E(0) - work"], change - np.asarray(solution.work), atol=1e-15)
    ax = jd.plot.residuals(arm, solution)
    assert ax.get_yscale() == "log" and "m/s" in ax.get_ylabel()
    ax = jd.plot.forces(arm, solution)
    np.testing.assert_array_equal(lines(ax)["shoulder"], solution.torque[:, 0])
    assert ax.get_ylabel() == "force (N m, N)"
    scene = jd.scenes.four_bar()
    ax = jd.plot.forces(scene, solution_of(scene, multipliers=(2,)))
    assert list(lines(ax)) == [f"{scene.constraints[0].name}.{k}" for k in (1, 2)]


def test_plots_of_batches_of_systems_without_joints_and_into_given_axes(arm, tmp_path):
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    both = batch_of(*(solution_of(arm, k, energy=()) for k in range(5)))
    axes = jd.plot.states(arm, both, Figure().subplots(2))
    assert "5 motions" in axes[0].get_title()
    np.testing.assert_allclose(lines(axes[0])["lift"], np.median(both.q[:, :, 1], axis=0))
    axes[0].figure.savefig(tmp_path / "states.png")
    given = Figure().subplots()
    ax = jd.plot.energy(arm, both, ax=given)
    assert ax is given and ax.get_ylabel() == "energy (J)"
    given = Figure().subplots()
    assert jd.plot.forces(arm, solution_of(arm, torque=(arm.nv,)), ax=given) is given and given.get_lines()
    scene = jd.scenes.pendulum()
    assert list(lines(jd.plot.states(scene, solution_of(scene))[0])) == ["q1"]


def test_work_precision_draws_each_ladder():
    pytest.importorskip("matplotlib")
    from jaxdyn.reports import Record

    def record(solver, error, seconds, scene="pendulum"):
        rest = dict.fromkeys(
            ("residual_position", "residual_velocity", "energy_error", "compile_seconds", "rejected", "evaluations")
        )
        return Record(
            scene=scene, source="jaxdyn", method="free", solver=solver, dtype="float64", batch=1, setting=error,
            fixed=False, result="successful", error_end=error, error_path=error, seconds_best=seconds,
            seconds_median=seconds, rounds=1, steps=10, **rest,
        )  # fmt: skip

    runs = [record(solver, 10.0**-k, 1e-4 * k) for solver in ("Dopri5", "Dopri8") for k in (3, 6, 9)]
    from matplotlib.figure import Figure

    given = Figure().subplots()
    ax = jd.plot.work_precision(runs, ax=given)
    assert ax is given and ax.get_xscale() == ax.get_yscale() == "log" and ax.get_xlabel() == "error"
    np.testing.assert_allclose(lines(ax)["free, Dopri8"], [3e-4, 6e-4, 9e-4])
    with pytest.raises(ValueError, match="2 plots"):
        jd.plot.work_precision([*runs, record("Dopri5", 1e-3, 1e-3, "arm")])
    with pytest.raises(ValueError, match="cost is 'money'"):
        jd.plot.work_precision(runs, cost="money")
    with pytest.raises(ValueError, match="both energy_error"):
        jd.plot.work_precision(runs, error="energy_error")


def test_plots_refuse(arm):
    pytest.importorskip("matplotlib")
    solution = solution_of(arm)
    with pytest.raises(ValueError, match=r'simulate with outputs=\("energy",\)'):
        jd.plot.energy(arm, solution)
    with pytest.raises(ValueError, match="no constraint_residual"):
        jd.plot.residuals(arm, solution)
    with pytest.raises(ValueError, match="no forces"):
        jd.plot.forces(arm, solution)
    with pytest.raises(ValueError, match="pass its own scene"):
        jd.plot.states(jd.scenes.four_bar(), solution)
    with pytest.raises(ValueError, match="give two"):
        jd.plot.states(arm, solution, jd.plot.energy(arm, solution_of(arm, energy=())))
