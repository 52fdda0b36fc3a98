"""Batches of any size into a store: rows, interruptions, reductions, and how they say no; test_scale_dask.py has clusters."""

import dataclasses
import errno
import functools
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.cli import main
from jaxdyn.scale import program
from jaxdyn.scale import store as stores
from jaxdyn.scale.program import members
from jaxdyn.scale.reductions import Reducer, Totals
from jaxdyn.scale.store import lock_store
from jaxdyn.scale.study import Summary

zarr = pytest.importorskip("zarr", reason="zarr is not installed: the extra scale")
xarray = pytest.importorskip("xarray", reason="xarray is not installed: the extra scale")

QUIET = {"resources": jd.scale.Resources(progress=False)}
OF_RESOURCES = [one.name for one in dataclasses.fields(jd.scale.Resources)]


def square(p):
    """What most of these tests compute: next to nothing, so that they test all else."""
    return {"y": jnp.stack([p["x"] ** 2, jnp.sin(p["x"])]), "z": 1.0 / p["x"]}


def drawn(key):
    return {"x": jax.random.uniform(key, (), minval=1.0, maxval=2.0)}


def evaluated(out, samples=23, function=square, parameters=drawn, **options):
    own = {"chunk": 5, "progress": False} | {name: options.pop(name) for name in OF_RESOURCES if name in options}
    options |= {"samples": samples, "out": out, "resources": jd.scale.Resources(**own)}
    return jd.scale.evaluate(function, parameters, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run to its end, which nothing changes."""
    return evaluated(tmp_path_factory.mktemp("scale") / "whole.zarr")


def files(path):
    """All files of a store, but for the time of its making."""
    computed = {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}
    # Nor for what a process was killed in.
    return {name: data for name, data in computed.items() if not name.endswith(("zarr.json", ".partial"))}


def arrays(path):
    with xarray.open_zarr(path, chunks=None) as table:
        return {name: np.asarray(values) for name, values in table.variables.items()}


def assert_equal(one, other):
    """Bit for bit."""
    assert one.keys() == other.keys()
    for name, values in one.items():
        assert values.dtype == other[name].dtype, name
        # Bytes of objects, such as names, are addresses.
        ours, theirs = (x.tolist() if x.dtype == object else x.tobytes() for x in (values, other[name]))
        assert ours == theirs, name


@pytest.fixture(scope="module")
def pendulums(tmp_path_factory):
    """A store of 21 double pendulums from given starts, and those starts."""
    out = tmp_path_factory.mktemp("scale") / "pendulums.zarr"
    starts = np.linspace(0.1, 1.0, 42).reshape(21, 2)
    lengths = np.linspace(0.5, 1.0, 21)
    ts = np.linspace(0.0, 0.2, 3)

    def build(p):
        return jd.Scene(
            jd.scenes.double_pendulum().system, forces=(jd.forces.JointDamping(jnp.stack([p["damping"]] * 2)),)
        )

    def again(out=out, **resources):
        resources = jd.scale.Resources(**{"chunk": 8, "progress": False} | resources)
        options = {"stepsize": 0.01, "outputs": ("energy",), "units": {"damping": "N m s"}, "resources": resources}
        return jd.scale.run(build, (starts, np.zeros(2)), {"damping": lengths}, ts, out=out, **options)

    return again(), build, starts, lengths, ts, again


@pytest.mark.long
def test_rows_are_those_of_simulate_with_names_and_units(pendulums):
    run, build, starts, damping, ts, _ = pendulums
    assert run.success and run.codes == {"successful": 21} and run.computed == 21

    def one(q, c):
        options = {"stepsize": 0.01, "outputs": ("energy",), "throw": False}
        solution = jd.simulate(build({"damping": c}), q, jnp.zeros(2), ts, **options)
        return solution.q, solution.v, solution.energy

    q, v, energy = jax.jit(jax.vmap(one))(starts, damping)
    table = run.dataset()
    assert table.q.dims == ("rollout", "t", "coordinate") and table.energy.dims == ("rollout", "t")
    assert table.energy.attrs["units"] == "J" and table.t.attrs["units"] == "s"
    assert table.parameter_damping.attrs["units"] == "N m s"
    model = jd.scenes.double_pendulum().system
    if isinstance(model, jd.Model):
        assert list(table.coordinate.values) == list(model.joint_names)
    # The same program for another batch: not one bit.
    for name, values in (("q", q), ("v", v), ("energy", energy), ("parameter_damping", damping)):
        assert np.asarray(table[name]).tobytes() == np.asarray(values).tobytes(), name
    assert table.result.attrs["flag_meanings"].split()[0] == "successful"
    assert np.ptp(np.asarray(table.q)) > 0.1


def test_a_store_that_is_whole_is_only_looked_through(pendulums):
    run, *_, again = pendulums
    before = files(run.out)
    same = again()
    assert same.computed == 0 and same.codes == run.codes
    assert files(run.out) == before


def test_arrays_without_entries_and_flags_are_stored(tmp_path):
    def function(p):
        return {"none": jnp.zeros((2, 0)), "flag": p["x"] > 1.5, "count": jnp.int32(7 * p["x"])}

    run = evaluated(tmp_path / "a.zarr", function=function)
    assert evaluated(tmp_path / "a.zarr", function=function).repaired == ()
    table = run.dataset()
    assert table.none.shape == (23, 2, 0) and table.flag.dtype == bool and table["count"].dtype == np.int32
    np.testing.assert_array_equal(table.flag, table.parameter_x > 1.5)
    np.testing.assert_array_equal(table["count"], np.asarray(7 * table.parameter_x).astype(np.int32))


def test_a_member_is_found_again(whole):
    table = whole.dataset()
    assert float(jd.scale.member(drawn, 17)["x"]) == float(table.parameter_x[17])
    assert float(jd.scale.member({"x": np.arange(3.0)}, 2)["x"]) == 2.0
    np.testing.assert_array_equal(table.y[:, 0], table.parameter_x**2)


@pytest.mark.parametrize("options", [{"chunk": 7}, {"batch_size": 2}, {"devices": 1}, {"chunk": None}], ids=str)
def test_rows_do_not_depend_on_how_they_are_computed(whole, tmp_path, options):
    if "devices" in options:
        options = {"devices": jax.local_devices()[: options["devices"]]}
    assert_equal(arrays(evaluated(tmp_path / "b.zarr", **options).out), arrays(whole.out))


def test_motions_do_not_depend_on_devices_and_batches(pendulums, tmp_path):
    run, *_, again = pendulums
    one_device = again(tmp_path / "b.zarr", chunk=None, batch_size=5, devices=jax.local_devices()[:1])
    assert_equal(arrays(one_device.out), arrays(run.out))


def test_a_program_has_no_communication(pendulums):
    """Neither of devices nor of processes: nothing per step, nothing per batch."""
    _, build, starts, damping, ts, _ = pendulums
    batch = members({"q0": starts, "p": damping}, None, None, 0)

    def one(_, row):
        solution = jd.simulate(build({"damping": row["p"]}), row["q0"], jnp.zeros(2), ts, stepsize=0.01, throw=False)
        return {"q": solution.q, "v": solution.v}

    compiled = program.Program(program.Traced(one, batch), jax.local_devices(), 8, np.inf, True)
    text = compiled.compiled.as_text()
    assert "jaxdyn_kernel" in text
    for collective in "all-reduce all-gather all-to-all collective-permute reduce-scatter send recv".split():
        assert f" {collective}(" not in text and f" {collective}-start(" not in text
    assert len(jax.local_devices()) == 2 and compiled.bytes > 0


# Interruptions

# Also on the workers of a scheduler, whose address is the second argument.
SLOW = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
import jaxdyn as jd

def draw(key):
    return jax.random.uniform(key, (), minval=0.1, maxval=0.9)

def logistic(x):
    return {"x": jax.lax.fori_loop(0, 300_000, lambda _, x: 3.9 * x * (1 - x), x)}

if __name__ == "__main__":
    client = None
    if len(sys.argv) > 2:
        from distributed import Client
        client = Client(sys.argv[2])
    reductions = {"x": jd.scale.Mean("x"), "worst": jd.scale.Worst("x", 3)}
    resources = jd.scale.Resources(client, batch_size=4, chunk=4, progress=False)
    run = jd.scale.evaluate(logistic, draw, samples=240, out=sys.argv[1], reductions=reductions, resources=resources)
    print(run.computed)
"""


def started(code, *args, **environment):
    """A process of its own, with the machine code of the session's."""
    env = os.environ | {"PYTHONPATH": str(Path(jd.__file__).parents[1]), "JAX_PLATFORMS": "cpu"} | environment
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, args)]
    return subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def recorded(path):
    """Number of finished chunks."""
    return sum(file.name.isdigit() for file in (Path(path) / "result" / "c").glob("*"))


def killed_at(processes, path, chunks, which):
    """Kill -9 once so many chunks are recorded."""
    end = time.monotonic() + 200
    while recorded(path) < chunks:
        assert time.monotonic() < end, processes[0].stderr
        assert all(process.poll() is None for process in processes), [p.communicate() for p in processes]
        time.sleep(0.002)
    for k in which:
        processes[k].send_signal(signal.SIGKILL)
        processes[k].communicate()


@pytest.mark.long
def test_kill_9_and_resume(tmp_path):
    """One process: what was recorded is kept, the rest is computed, and the whole is that of a run without interruption."""
    out = tmp_path / "killed.zarr"
    process = started(SLOW, out)
    killed_at([process], out, 3, [0])
    kept = recorded(out)
    assert 3 <= kept < 60
    assert f"process {process.pid} of" in (tmp_path / "killed.zarr.owner").read_text()
    before = {name: data for name, data in files(out).items() if name.startswith("result")}
    resumed = slow_here(out)  # the lock of a dead process is free
    assert resumed.computed == 240 - 4 * kept
    assert before.items() <= files(out).items()
    whole = slow_here(tmp_path / "whole.zarr")
    assert files(out) == files(whole.out)
    np.testing.assert_equal(resumed.reductions, whole.reductions)
    assert not list(tmp_path.glob("*.owner"))


def slow_here(out):
    """What `SLOW` computes, in this process."""
    source: dict = {"__name__": "slow"}
    exec(SLOW.replace("jax.config.update(", "(lambda *_: None)("), source)
    reductions = {"x": jd.scale.Mean("x"), "worst": jd.scale.Worst("x", 3)}
    options = {"samples": 240, "batch_size": 4, "chunk": 4, "reductions": reductions}
    return evaluated(out, function=source["logistic"], parameters=source["draw"], **options)


# Stores that are not what they should be


def test_the_second_run_on_a_store_is_refused(whole):
    with lock_store(whole.out):
        with pytest.raises(ValueError, match=f"process {os.getpid()} of .* is writing"):
            evaluated(whole.out)
    assert evaluated(whole.out).computed == 0


@pytest.mark.parametrize(
    "damage", ["bit", "missing", "codes", *(pytest.param(x, marks=pytest.mark.slow) for x in ("cut", "partial"))]
)
def test_a_chunk_that_is_not_whole_is_computed_again(tmp_path, damage):
    out = tmp_path / "a.zarr"
    reductions = {"y": jd.scale.Mean("y")}
    evaluated(out, reductions=reductions)
    before = files(out)
    name = {"partial": "partial/y_mean/c/2/0", "codes": "result/c/2"}.get(damage, "y/c/2/0")
    data = bytearray(before[name])
    if damage == "missing":
        (out / name).unlink()
    else:
        data[5] ^= 1
        (out / name).write_bytes(data[:-9] if damage == "cut" else data)
    assert files(out) != before
    again = evaluated(out, reductions=reductions)
    assert again.repaired == (2,) and again.computed == 5
    assert files(out) == before
    assert evaluated(out, reductions=reductions).repaired == ()


def test_a_store_of_something_else_is_refused_with_what_differs(tmp_path, monkeypatch):
    out = tmp_path / "a.zarr"
    rows = {"x": np.linspace(1.0, 2.0, 23)}
    evaluated(out, seed=3)

    def refused(difference, **options):
        with pytest.raises(ValueError, match=difference):
            evaluated(out, **{"seed": 3} | options)

    refused("of another seed: there it is 3, here 4", seed=4)
    refused("of another samples: there it is 23, here 24", samples=24)
    refused("of another rows stored", rows=["y"])
    refused("of another reductions", reductions={"y": jd.scale.Mean("y")})
    refused("another program of a rollout", function=lambda p: square(p) | {"y": jnp.stack([p["x"] ** 3, p["x"]])})
    refused("of another seed: there it is 3, here None", parameters=rows)
    evaluated(tmp_path / "b.zarr", parameters=rows)
    with pytest.raises(ValueError, match="of another values"):
        evaluated(tmp_path / "b.zarr", parameters={"x": 2.0 * rows["x"]})
    old = json.loads((out / "zarr.json").read_text())
    old["attributes"]["description"]["version of jaxdyn"] = "0.0.9"
    (out / "zarr.json").write_text(json.dumps(old))
    refused("of another version of jaxdyn: there it is 0.0.9, here " + jd.__version__)
    old["attributes"]["jaxdyn_store"] = 0
    (out / "zarr.json").write_text(json.dumps(old))
    refused("whose format is 0 of jaxdyn and not 3")
    (tmp_path / "c.zarr").mkdir()
    with pytest.raises(ValueError, match="no store of"):
        evaluated(tmp_path / "c.zarr")


def test_a_store_of_another_scene_or_other_times_is_refused(pendulums, tmp_path):
    run, build, starts, damping, ts, _ = pendulums
    out = tmp_path / "a.zarr"
    shutil.copytree(run.out, out)
    options = {"stepsize": 0.01, "outputs": ("energy",), "out": out} | QUIET
    for scene, times, difference in (
        (build, 2.0 * ts, "another ts"),
        (lambda p: jd.Scene(build(p).system), ts, r"another program of a rollout \(scene"),
    ):
        with pytest.raises(ValueError, match=difference):
            jd.scale.run(scene, (starts, np.zeros(2)), {"damping": damping}, times, **options)


def heavy(p):
    return {"y": jnp.full(2000, p["x"])}


def test_a_full_disk_loses_nothing(whole, tmp_path, monkeypatch):
    """The run ends with an error that says so, and goes on where there is room again."""
    out, write = tmp_path / "a.zarr", stores.Store.write

    def full(store, chunk, arrays):
        if chunk > 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(store, chunk, arrays)

    monkeypatch.setattr(stores.Store, "write", full)
    with pytest.raises(OSError, match=r"full .*finished are kept") as caught:
        evaluated(out)
    assert caught.value.errno == errno.ENOSPC and recorded(out) == 3
    monkeypatch.undo()
    assert evaluated(out).computed == 23 - 3 * 5
    assert files(out) == files(whole.out)


# Failures and reductions


def test_failures_are_rows_with_codes(tmp_path):
    speeds = np.ones((9, 2))
    speeds[[2, 7]] = np.nan
    options = {"stepsize": 0.05, "reductions": {"q": jd.scale.Mean("q")}, "out": tmp_path / "a.zarr"}
    options |= {"resources": jd.scale.Resources(chunk=4, progress=False)}
    run = jd.scale.run(jd.scenes.double_pendulum(), (np.zeros(2), speeds), None, jnp.linspace(0.0, 0.1, 3), **options)
    assert run.codes == {"successful": 7, "nonfinite_start": 2} and not run.success
    assert list(run.failed) == [2, 7] and "2 nonfinite_start" in str(run)
    table = run.dataset()
    code = int(table.result[2])
    assert table.result.attrs["flag_meanings"].split()[code] == "nonfinite_start"
    assert run.reductions["q"]["count"] == 7
    good = np.asarray(table.q)[np.asarray(table.result) == 0]
    np.testing.assert_allclose(run.reductions["q"]["mean"], good.mean(0), rtol=1e-14)
    assert table.q_mean.dims == ("t", "coordinate")


class Extent(jd.scale.Reduction):
    """A user's own: least and largest."""

    quantity = "z"
    parts = ("least", "most")

    def partial(self, values, numbers):
        return {"least": np.min(values, 0, initial=np.inf), "most": np.max(values, 0, initial=-np.inf)}

    def combine(self, total, partial):
        return {name: f(total[name], partial[name]) for name, f in (("least", np.minimum), ("most", np.maximum))}


def test_reductions_are_those_of_all_rows(tmp_path):
    reductions = {
        "y": jd.scale.Mean("y"),
        "sine": jd.scale.Histogram(lambda row: row["y"][1], 0.85, 0.95, bins=7),
        "z": jd.scale.Quantiles("z", 0.5, 1.0, bins=2000, probabilities=(0.1, 0.5, 0.9)),
        "worst": jd.scale.Worst("z", keep=4),
        "best": jd.scale.Worst(lambda row: row["z"], keep=500, largest=False),
        "own": Extent(),
    }
    run = evaluated(tmp_path / "a.zarr", samples=433, chunk=64, reductions=reductions)
    table, computed = run.dataset(), run.reductions
    y, z = np.asarray(table.y), np.asarray(table.z)
    np.testing.assert_allclose(computed["y"]["mean"], y.mean(0), rtol=1e-14)
    np.testing.assert_allclose(computed["y"]["std"], y.std(0, ddof=1), rtol=1e-13)
    inner = np.histogram(y[:, 1], computed["sine"]["edges"])[0]
    inner[-1] -= (y[:, 1] == 0.95).sum()
    np.testing.assert_array_equal(computed["sine"]["counts"][1:-1], inner)
    assert computed["sine"]["counts"].sum() == 433
    # A bin is 2.5e-4 wide; between neighbours of a sample of 433 lie 3e-3.
    np.testing.assert_allclose(computed["z"]["quantiles"], np.quantile(z, [0.1, 0.5, 0.9]), atol=5e-3)
    order = np.argsort(-z, kind="stable")
    np.testing.assert_array_equal(computed["worst"]["rollout"], order[:4])
    np.testing.assert_array_equal(computed["worst"]["value"], z[order[:4]])
    np.testing.assert_array_equal(computed["best"]["value"][:433], np.sort(z))
    assert (computed["best"]["rollout"][433:] == -1).all() and np.isnan(computed["best"]["value"][433:]).all()
    assert (computed["own"]["least"], computed["own"]["most"]) == (z.min(), z.max())
    for name, parts in computed.items():
        for part, value in parts.items():
            np.testing.assert_array_equal(np.asarray(table[f"{name}_{part}"]), value)
    # Without rows the same, and no rows.
    bare = evaluated(tmp_path / "b.zarr", samples=433, chunk=64, reductions=reductions, rows=False)
    np.testing.assert_equal(bare.reductions, computed)
    assert "y" not in bare.dataset() and bare.codes == run.codes


def test_a_mean_of_large_numbers_does_not_cancel():
    values = 1e8 + np.random.default_rng(0).normal(size=(1000, 2))
    mean = jd.scale.Mean("y")
    parts = [mean.partial(part, np.arange(len(part))) for part in (values[:0], values[:3], values[3:700], values[700:])]
    computed = mean.result(functools.reduce(mean.combine, parts))
    np.testing.assert_allclose(computed["mean"], values.mean(0), rtol=1e-14)
    # The last bit of 1e8 is 1.5e-8, which is that of the deviations too; sums of squares as they are would lose all digits.
    np.testing.assert_allclose(computed["std"], values.std(0, ddof=1), rtol=1.5e-8)
    none = mean.result(parts[0])
    assert none["count"] == 0 and np.isnan(none["mean"]).all() and np.isnan(none["std"]).all()


REDUCTIONS = [jd.scale.Mean("y"), jd.scale.Histogram("y", 0.0, 1.0), jd.scale.Quantiles("y", 0.0, 1.0)]
REDUCTIONS += [jd.scale.Worst("y", 3), Extent()]


@pytest.mark.parametrize("reduction", REDUCTIONS, ids=lambda x: type(x).__name__)
def test_chunks_without_rollouts_change_no_bit_of_a_result(reduction):
    """First, last and in between; and shapes of partial results stay, so that memory does not grow."""
    values = np.random.default_rng(2).random(200)

    def combined(*ends):
        parts = [reduction.partial(values[a:b], np.arange(a, b)) for a, b in itertools.pairwise(ends)]
        total = functools.reduce(reduction.combine, parts)
        assert {name: np.shape(x) for name, x in total.items()} == {name: np.shape(x) for name, x in parts[0].items()}
        return {name: np.asarray(x) for name, x in reduction.result(total).items()}

    assert_equal(combined(0, 0, 3, 40, 41, 41, 120, 200, 200), combined(0, 3, 40, 41, 120, 200))


def test_a_run_of_many_chunks_merges_as_they_come():
    values = np.random.default_rng(3).random(199)
    reductions = {"mean": jd.scale.Mean("y"), "own": Extent()}
    shapes = {f"quantity of {name}": jax.ShapeDtypeStruct((), np.float64) for name in reductions}
    reducer = Reducer(reductions, shapes, {})
    merger = Totals(reducer, 2, 5)
    for k, value in enumerate(values):
        rows = {"result": np.array([k % 2]), **dict.fromkeys(shapes, np.array([value]))}
        counts, failed = np.array([1 - k % 2, k % 2]), np.arange(k, k + k % 2)
        merger.add(Summary(counts, failed, reducer.partials(rows, np.array([k])), False))
    results = merger.results()
    np.testing.assert_allclose(results["mean"]["mean"], values[::2].mean(), rtol=1e-14)
    assert (results["own"]["least"], results["own"]["most"]) == (values[::2].min(), values[::2].max())
    assert list(merger.failed) == [1, 3, 5, 7, 9] and merger.codes.sum() == len(values)


def test_quantiles_outside_of_the_bins_are_not_made_up():
    quantiles = jd.scale.Quantiles("y", 0.0, 1.0, probabilities=(0.0, 0.2, 0.5, 1.0))
    part = quantiles.partial(np.array([-1.0, 0.25, 0.5, 0.75, 3.0]), np.arange(5))
    computed = quantiles.result(part)["quantiles"]
    assert np.isnan(computed[[0, 3]]).all() and abs(computed[2] - 0.5) < 2e-3


# Memory


def test_blocks_fit_the_memory(tmp_path, monkeypatch):
    assert 2**20 < program.available_memory(jax.local_devices()) < 2**50

    def run(name):
        return evaluated(tmp_path / name, function=heavy, samples=400, chunk=400, batch_size=400)

    free = run("a.zarr")
    monkeypatch.setattr("jaxdyn.scale.study.available_memory", lambda _: 2**21)
    tight = run("b.zarr")
    assert free.batch_size == 400 and free.program_bytes > 2**24
    assert tight.batch_size < 30 and tight.program_bytes <= 2**20
    assert_equal(arrays(free.out), arrays(tight.out))
    monkeypatch.setattr("jaxdyn.scale.study.available_memory", lambda _: 2000)
    with pytest.raises(MemoryError, match=r"2 rollouts needs .*allowed"):
        run("c.zarr")
    assert not (tmp_path / "c.zarr").exists()


# Bad input


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"samples": None}, "samples is None; say how many"),
        ({"parameters": {"x": np.ones(3), "w": np.ones(4)}, "samples": None}, r"parameters\['w'\] is of 4"),
        ({"parameters": {"x": np.ones(3)}, "samples": 5}, "is of 3 rollouts and samples of 5"),
        ({"parameters": {"x": 1.0}, "samples": 5}, "is one number"),
        ({"seed": -1}, "seed is -1"),
        ({"samples": 0}, "samples is 0; give a positive integer"),
        ({"samples": 1.5}, "samples is 1.5; give a positive integer"),
        ({"rows": ["w"]}, "name some of parameter_x, y, z"),
        ({"reductions": {"w": jd.scale.Mean("w")}}, "is of 'w', which a rollout does not have"),
        ({"reductions": [jd.scale.Mean("y")]}, "give a dictionary"),
        ({"reductions": {"w": jd.scale.Worst("y")}}, "give a function that returns one number"),
        ({"devices": []}, "give some of this process' own"),
        ({"function": lambda p: p["x"]}, "return a dictionary"),
        ({"function": lambda p: {"result": p["x"]}}, "take another name"),
        ({"out": "/no/such/directory/a.zarr"}, "there is no directory /no/such/directory"),
        ({"chunk": 0}, "chunk is 0"),
        ({"batch_size": -3}, "batch_size is -3"),
    ],
    ids=lambda x: str(x)[:30],
)
def test_bad_input_is_refused(tmp_path, options, error):
    with pytest.raises(ValueError, match=error):
        evaluated(**{"out": tmp_path / "a.zarr"} | options)
    assert not list(tmp_path.glob("a.zarr*"))


def test_reductions_and_states_refuse(tmp_path):
    times, options = np.linspace(0, 1, 3), {"out": tmp_path / "a", "samples": 3}
    for make in (
        lambda: jd.scale.Histogram("y", 1.0, 1.0),
        lambda: jd.scale.Quantiles("y", 0.0, 1.0, probabilities=(2.0,)),
        lambda: jd.scale.Worst("y", keep=0),
        lambda: jd.scale.run(jd.scenes.pendulum(), np.zeros(1), None, times, **options),
    ):
        with pytest.raises(ValueError, match="give"):
            make()


def test_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r"zarr: .*jaxdyn\[scale\]"):
        evaluated(tmp_path / "a.zarr")


def test_progress_has_rate_and_failures_on_standard_error(tmp_path, capsys):
    before = set(threading.enumerate())
    parameters = {"x": np.array([1.0, 2.0, 0.0, 4.0])}
    options = {"parameters": parameters, "samples": None, "chunk": 1, "progress": True}
    run = evaluated(tmp_path / "a.zarr", **options)
    assert run.codes == {"successful": 3, "failed": 1}
    said = capsys.readouterr()
    last = said.err.splitlines()[-1]
    assert re.search(r"100%.* 4/4 \[.*rollouts/s, 1 failed\]", last) and not said.out
    (run.out / "y" / "c" / "1" / "0").write_bytes(b"damaged")
    evaluated(tmp_path / "a.zarr", **options)
    assert "chunk 1 of the store was damaged and was computed again" in capsys.readouterr().err
    left = set(threading.enumerate()) - before
    assert all(thread.name.startswith(("zarr_io", "asyncio_")) for thread in left)  # none of tqdm


# From the shell

STUDY = """
scene = "study.py"
out = "study.zarr"
samples = 12
duration = 0.1
points = 3
outputs = ["energy"]
[parameters]
damping = { log_uniform = [0.1, 1.0], units = "N m s" }
angle = { normal = [0.5, 0.1] }
speed = { uniform = [-1.0, 1.0], size = 2 }
length = 0.7
[options]
stepsize = 0.01
[reductions]
energy = { mean = "energy" }
"""
FUNCTIONS = """
import jax.numpy as jnp
import jaxdyn as jd

def scene(p):
    system = jd.scenes.double_pendulum().system
    return jd.Scene(system, forces=(jd.forces.JointDamping(p["damping"] * jnp.ones(2)),))

def states(p):
    return p["angle"] * jnp.ones(2), p["speed"] * p["length"]
"""


@pytest.mark.long
def test_sweep_runs_a_study_and_goes_on_with_it(tmp_path, capsys):
    study = tmp_path / "study.toml"
    study.write_text(STUDY)
    (tmp_path / "study.py").write_text(FUNCTIONS)
    assert main(["sweep", str(study), "--quiet", "--chunk", "5"]) == 0
    assert "12 rollouts, 12 of them computed" in capsys.readouterr().out
    table = xarray.open_zarr(tmp_path / "study.zarr", chunks=None)
    assert table.parameter_damping.attrs["units"] == "N m s" and table.energy_mean.dims == ("t",)
    damping = np.asarray(table.parameter_damping)
    assert len(np.unique(damping)) == 12 and damping.min() >= 0.1 and damping.max() <= 1.0
    np.testing.assert_array_equal(table.v[:, 0], 0.7 * np.asarray(table.parameter_speed))
    np.testing.assert_array_equal(table.q[:, 0, 1], table.parameter_angle)
    assert main(["sweep", str(study), "--quiet"]) == 0
    assert "12 rollouts, 0 of them computed" in capsys.readouterr().out
    assert main(["sweep", str(study), "--quiet", "--seed", "1"]) == 2
    assert "of another seed: there it is 0, here 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ('"study.py"', '"no_scene"', "name one of .*, four_bar, "),
        ('"study.py"', '"other.py"', "there is no file"),
        ("samples = 12", "", "has no samples"),
        ("samples = 12", "sample = 12", "has sample; a study has"),
        ("log_uniform = [0.1, 1.0]", "log_uniform = [-0.1, 1.0]", "give positive numbers"),
        ("normal = [0.5, 0.1]", "normal = [0.5]", "parameter angle is .*give a finite number, or one of uniform"),
        ('mean = "energy"', 'median = "energy"', "give one of mean"),
        ("duration = 0.1", "duration = ", "is malformed TOML"),
        ('"study.py"', '"rolling_disk"', "rolling_disk has no parameter angle"),
        ("duration = 0.1", "duration = inf", "duration inf s"),
        ("duration = 0.1", "duration = [1]", r"duration is \[1\]"),
        ("points = 3", "points = 1", "points 1;"),
        ("points = 3", "points = 100000000000000", "points 100000000000000: .* GB of results"),
        ("samples = 12", "samples = 1e3", "samples is 1000.0; see"),
        ("points = 3", "seed = 100000000000000000000", "seed is 1000"),
        ('outputs = ["energy"]', "outputs = [1]", r"outputs is \[1\]; give a list of names"),
        (STUDY[STUDY.index("[parameters]") :], "parameters = 3", "parameters is 3; see"),
        ("stepsize = 0.01", "foo = 1", r"\[options\] foo is 1; options are atol, "),
        ("length = 0.7", "length = nan", "parameter length is nan; give a finite number"),
        ("uniform = [-1.0, 1.0]", "uniform = [1.0, inf]", "parameter speed is .*inf.*; give a finite number"),
        ("size = 2", "size = -1", "size is -1; give a whole number"),
        ('units = "N m s"', "units = 3", "units of damping are 3; give a text"),
    ],
)
def test_sweep_refuses(tmp_path, capsys, old, new, error):
    study = tmp_path / "study.toml"
    study.write_text(STUDY.replace(old, new))
    (tmp_path / "study.py").write_text(FUNCTIONS)
    assert main(["sweep", str(study), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert re.search(error, said) and said.count("\n") == 1, said
    assert not (tmp_path / "study.zarr").exists()


@pytest.mark.long
def test_sweep_draws_for_scenes_by_name_and_for_files(tmp_path, capsys):
    builder = jd.ModelBuilder("arm")
    builder.add_body("rod", None, "revolute", (1.0, (0, 0, 0.3), (0.1, 0.1, 0.01)), axis=(0, 1, 0))
    jd.save_urdf(builder.build(), tmp_path / "arm.urdf")
    study = tmp_path / "study.toml"
    head = 'out = "a.zarr"\nsamples = 6\nduration = 0.1\n'
    study.write_text(head + 'scene = "arm.urdf"\n[parameters]\nq0 = { uniform = [0.1, 0.2], size = 1 }\n')
    assert main(["sweep", str(study), "--quiet"]) == 0
    table = xarray.open_zarr(tmp_path / "a.zarr", chunks=None)
    # XLA may draw a number anew where it is used, and contracts products and sums as it likes: the last digit differs.
    np.testing.assert_allclose(table.q[:, 0], table.parameter_q0, rtol=4e-16)
    assert list(table.coordinate.values) == list(jd.load_model(tmp_path / "arm.urdf").joint_names)
    study.write_text(head + 'scene = "chaplygin_sleigh"\n[parameters]\nmass = { uniform = [1.0, 2.0] }\n')
    assert main(["sweep", str(study), "--quiet", "--out", str(tmp_path / "b.zarr")]) == 0
    drawn = xarray.open_zarr(tmp_path / "b.zarr", chunks=None)
    mass = drawn.parameter_mass.values
    assert mass.shape == (6,) and len(set(mass)) == 6 and ((mass >= 1) & (mass <= 2)).all()
    assert len(np.unique(drawn.q[:, -1, 2])) == 6
    study.write_text(head + 'scene = "windows"\n[parameters]\ncount = { uniform = [1.0, 2.0] }\n')
    assert main(["sweep", str(study), "--quiet", "--out", str(tmp_path / "c.zarr")]) == 2
    assert "is built from concrete numbers, so that count cannot be drawn" in capsys.readouterr().err


ROTORS = """<robot name="rotors"><link name="base"/>
  <link name="a"><inertial><mass value="1"/><inertia ixx="0.5" iyy="0.5" izz="0.5" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="b"><inertial><mass value="1"/><inertia ixx="0.5" iyy="0.5" izz="0.5" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/><dynamics damping="0.4"/></joint>
  <joint name="k" type="continuous"><parent link="base"/><child link="b"/><axis xyz="0 0 1"/>
    <mimic joint="j" multiplier="-2"/></joint></robot>"""
SPRING = """<mujoco><compiler angle="radian"/><worldbody><body>
  <joint name="h" axis="0 0 1" ref="0.3" springref="0.3" stiffness="8"/>
  <inertial pos="0 0 0" mass="1" diaginertia="2 2 2"/></body></worldbody></mujoco>"""


def test_sweep_takes_couplings_springs_and_damping_of_a_file(tmp_path):
    """A coupled and damped pair: (J + 4 J) dv/dt = -0.4 v, from the projection of v0; a spring at its reference, w = 2."""
    study, head = tmp_path / "study.toml", 'out = "a.zarr"\nsamples = 2\nduration = 1.0\n'
    (tmp_path / "rotors.urdf").write_text(ROTORS)
    study.write_text(head + 'scene = "rotors.urdf"\n[parameters]\nv0 = { uniform = [1.0, 1.0], size = 2 }\n')
    assert main(["sweep", str(study), "--quiet"]) == 0
    v = xarray.open_zarr(tmp_path / "a.zarr", chunks=None).v.values
    np.testing.assert_allclose(v[:, 0], [[-0.2, 0.4]] * 2, rtol=1e-12)
    np.testing.assert_allclose(v[:, 1], v[:, 0] * np.exp(-0.4 / 2.5), rtol=1e-7)
    (tmp_path / "spring.xml").write_text(SPRING)
    study.write_text(head + 'scene = "spring.xml"\n[parameters]\nq0 = { uniform = [0.1, 0.1], size = 1 }\n')
    assert main(["sweep", str(study), "--quiet", "--out", str(tmp_path / "b.zarr")]) == 0
    q = xarray.open_zarr(tmp_path / "b.zarr", chunks=None).q.values
    np.testing.assert_allclose(q[:, 1], 0.3 + 0.1 * np.cos(2.0), rtol=1e-7)


def test_stores_that_cannot_be_are_refused_with_the_cause(tmp_path, monkeypatch):
    parameters = {"x": np.linspace(1.0, 2.0, 4)}
    (tmp_path / "file").write_text("x")
    for place, words in (
        (tmp_path / "file", "which is a file"),
        (tmp_path / "file" / "a.zarr", "there is no directory"),
    ):
        with pytest.raises(ValueError, match=f"out is '{place}'.*{words}"):
            jd.scale.evaluate(square, parameters, out=place, **QUIET)
    out = tmp_path / "a.zarr"
    jd.scale.evaluate(square, parameters, out=out, **QUIET)
    place = out / "zarr.json"
    text = place.read_text()
    for content in (text[:60], "", "[]", "null", "\x00", text.replace('"rollouts"', '"x"')):
        place.write_text(content)
        with pytest.raises(ValueError, match=r"zarr.json is damaged|format is"):
            jd.scale.evaluate(square, parameters, out=out, **QUIET)
    place.write_text(text)
    with monkeypatch.context() as patched:  # root may write anywhere
        patched.setattr(os, "access", lambda *_: False)
        with pytest.raises(ValueError, match=f"{out} cannot be written"):
            jd.scale.evaluate(square, parameters, out=out, **QUIET)
        with pytest.raises(ValueError, match=f"{tmp_path} cannot be written"):
            jd.scale.evaluate(square, parameters, out=tmp_path / "b.zarr", **QUIET)
    assert jd.scale.evaluate(square, parameters, out=out, **QUIET).success


def test_former_keywords_of_evaluate(tmp_path):
    run = evaluated(tmp_path / "a.zarr", rows=["z"], units={"z": "1/m"})
    table = run.dataset()
    assert "y" not in table and table["z"].attrs["units"] == "1/m"
    options = {"samples": 23, "out": run.out, "rows": ["z"], "units": {"z": "1/m"}}
    with pytest.warns(DeprecationWarning, match=r"chunk, progress .*fields"):
        again = jd.scale.evaluate(square, drawn, chunk=5, progress=False, **options)
    assert again.computed == 0
    with pytest.raises(TypeError, match="no argument lanes"):
        jd.scale.evaluate(square, drawn, lanes=3, **options)


@pytest.mark.long
def test_seed_rows_and_progress_of_runs(tmp_path, capsys):
    """Starts drawn by a seed move freely in a straight line."""
    model = jd.ModelBuilder("free", gravity=None)
    model.add_body("a", None, "prismatic", (1.0, (0, 0, 0), (0.1, 0.1, 0.1)), axis=(1, 0, 0))
    run = jd.scale.run(
        model.build(), lambda p: (jnp.zeros(1), p["v"][None]), lambda key: {"v": jax.random.normal(key, ())},
        np.array([0.0, 2.0]), samples=4, out=tmp_path / "a.zarr", seed=3, rows=["q"],
        resources=jd.scale.Resources(progress=True),
    )  # fmt: skip
    assert "4" in capsys.readouterr().err
    v = np.array([jax.random.normal(jax.random.fold_in(jax.random.key(3), i), ()) for i in range(4)])
    table = run.dataset()
    np.testing.assert_allclose(np.asarray(table["q"]).reshape(4, 2)[:, -1], 2 * v, atol=1e-10)
    assert "v" not in table
