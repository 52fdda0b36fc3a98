"""Batches on Dask clusters: the same bits as in this process, whatever dies meanwhile, and checks before anything is computed.

Functions of studies are made by functions, so that cloudpickle sends them by value: workers do not import this file.
"""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_scale
from test_scale import files, recorded

import jaxdyn as jd
from jaxdyn.tasks import Cluster, Failure, map_tasks, package_versions

for package in ("zarr", "xarray", "filelock", "cloudpickle"):
    pytest.importorskip(package, reason=f"{package} is not installed: the extra scale")
distributed = pytest.importorskip("distributed", reason="distributed is not installed: the extra scale")

# Sockets and event loops of Dask that are collected after a cluster was closed, or a machine of it killed.
pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning"),
    pytest.mark.filterwarnings("ignore:.*unclosed:pytest.PytestUnraisableExceptionWarning"),
]
LONG = 120.0  # s, in which what is waited for has to happen


def study(iterations=100):
    """Arguments of `jd.scale.evaluate`: 60 chunks of a logistic map, whose time `iterations` decides."""

    def draw(key):
        return jax.random.uniform(key, (), minval=0.1, maxval=0.9)

    def logistic(x):
        return {"x": jax.lax.fori_loop(0, iterations, lambda _, x: 3.9 * x * (1 - x), x)}

    reductions = {"x": jd.scale.Mean("x"), "worst": jd.scale.Worst("x", 3)}
    return (logistic, draw), {"samples": 240, "reductions": reductions}


SLOW = 300_000


def evaluate(out, client=None, iterations=100, **options):
    args, given = study(iterations)
    resources = jd.scale.Resources(client, batch_size=4, chunk=4, **{"progress": False} | options)
    return jd.scale.evaluate(*args, out=out, resources=resources, **given)


def wait_for(condition, what):
    end = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.005)


@pytest.fixture(scope="module")
def cluster():
    """Two worker processes, two threads each; others below have one."""
    options = {"threads_per_worker": 2, "processes": True, "dashboard_address": ":0", "silence_logs": 50}
    with distributed.LocalCluster(n_workers=2, **options) as local:
        yield local


@pytest.fixture
def client(cluster):
    with distributed.Client(cluster) as one:
        one.wait_for_workers(2, timeout=120)
        yield one


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Files and reductions of the fast and of the slow study in this process, by iterations."""
    computed = {}

    def of(iterations):
        if iterations not in computed:
            computed[iterations] = evaluate(tmp_path_factory.mktemp("whole") / "a.zarr", iterations=iterations)
        return computed[iterations]

    return of


def assert_same(run, other):
    assert files(run.out) == files(other.out)
    assert run.codes == other.codes
    np.testing.assert_equal(run.reductions, other.reductions)


def pids(client):
    return sorted(client.run(os.getpid).values())


class Running:
    """A run in a thread of its own, with its result or error."""

    def __init__(self, out, client, **options):
        self.out, self.result, self.error = out, None, None
        self._thread = threading.Thread(target=self._run, args=(client, options), daemon=True)
        self._thread.start()

    def _run(self, client, options):
        try:
            self.result = evaluate(self.out, client, **options)
        except BaseException as error:
            self.error = error

    def wait_for_chunks(self, count):
        wait_for(lambda: self.error or recorded(self.out) >= count, f"{count} chunks")
        assert self.error is None

    def end(self):
        self._thread.join(LONG)
        assert not self._thread.is_alive()
        if self.error is not None:
            raise self.error
        return self.result


@pytest.mark.long
def test_the_same_bits_as_in_this_process(client, whole, tmp_path, capfd):
    run = evaluate(tmp_path / "a.zarr", client, progress=True)
    assert_same(run, whole(100))
    assert run.computed == 240
    said = capfd.readouterr().err
    assert said.count("dashboard: http://") == 1 and re.search(r"100%.* 240/240 ", said)
    again = evaluate(tmp_path / "a.zarr", client)
    assert again.computed == 0
    assert_same(again, run)
    # A store that was begun on a cluster is finished here, and the other way round, and looked through.
    for chunk, where in ((3, None), (5, client)):
        (run.out / "result" / "c" / str(chunk)).unlink()
        (run.out / "x" / "c" / "9").write_bytes(b"damaged")
        resumed = evaluate(run.out, where)
        assert resumed.repaired == (9,) and resumed.computed == 8
        assert_same(resumed, whole(100))
    assert not list(tmp_path.glob("*.owner"))


@pytest.mark.long
def test_motions_are_the_same(client, tmp_path):
    """Kernels, models and controls travel; so does float64, which the processes of workers do not have."""
    stiffness = np.linspace(1.0, 9.0, 12)
    gain = jnp.asarray(0.3)

    def build(p):
        return jd.Scene(jd.scenes.double_pendulum().system, forces=(jd.forces.JointSpring(p["k"] * jnp.ones(2)),))

    def run(name, client=None, devices=None):
        return jd.scale.run(
            build,
            (np.array([0.3, 0.4]), np.zeros(2)),
            {"k": stiffness},
            np.array([0.0, 0.2]),
            out=tmp_path / name,
            control=lambda q, v, t: -gain * v,
            resources=jd.scale.Resources(client, devices=devices, batch_size=4, chunk=4, progress=False),
        )

    here, there = run("a.zarr", devices=jax.local_devices()[:1]), run("b.zarr", client)
    assert there.dataset().q.dtype == np.float64
    assert files(here.out) == files(there.out)


@pytest.mark.long
def test_a_worker_killed_in_a_chunk(client, whole, tmp_path):
    running = Running(tmp_path / "a.zarr", client, iterations=SLOW // 3)
    running.wait_for_chunks(5)
    os.kill(pids(client)[0], signal.SIGKILL)
    assert_same(running.end(), whole(SLOW // 3))


def start(*command, stdout=subprocess.DEVNULL):
    env = os.environ | {"PYTHONPATH": str(Path(jd.__file__).parents[1]), "JAX_PLATFORMS": "cpu"}
    return subprocess.Popen([sys.executable, *map(str, command)], env=env, stdout=stdout, stderr=subprocess.DEVNULL)


@pytest.mark.slow
def test_the_client_killed_and_started_again(client, whole, tmp_path):
    out, address = tmp_path / "a.zarr", client.scheduler.address
    first = start("-c", test_scale.SLOW, out, address)
    wait_for(lambda: recorded(out) >= 5, "chunks")
    with pytest.raises(ValueError, match=f"process {first.pid} of .* is writing"):
        evaluate(out, client, iterations=SLOW)
    first.kill()
    first.communicate()
    kept = recorded(out)
    second = start("-c", test_scale.SLOW, out, address, stdout=subprocess.PIPE)
    computed = int(second.communicate(timeout=LONG)[0])
    # Workers finish the tasks that they have, sixteen at most, until the scheduler misses the client.
    assert 240 - 4 * (kept + 16) <= computed <= 240 - 4 * kept
    assert files(out) == files(whole(SLOW).out)


@contextlib.contextmanager
def machines():
    """Starts schedulers and workers at one address, and ends what still runs."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address, begun = f"tcp://127.0.0.1:{port}", []

    def begin():
        command = f"-m distributed.cli.dask_scheduler --host 127.0.0.1 --port {port} --no-dashboard"
        scheduler = start(*command.split())
        command = f"-m distributed.cli.dask_worker {address} --nthreads 1 --no-dashboard --no-nanny --death-timeout 60"
        workers = [start(*command.split()) for _ in range(2)]
        begun.extend([scheduler, *workers])
        return scheduler

    try:
        yield address, begin
    finally:
        for process in begun:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_the_scheduler_killed_and_started_again(whole, tmp_path):
    """The run goes on by itself where the scheduler is back in time; else it ends, and the next one goes on."""
    with machines() as (address, begin):
        scheduler = begin()
        with distributed.Client(address, timeout=60) as client:
            running = Running(tmp_path / "a.zarr", client, iterations=SLOW)
            running.wait_for_chunks(5)
            scheduler.kill()
            scheduler.wait()
            time.sleep(1.0)
            kept = recorded(running.out)
            scheduler = begin()
            run = running.end()
            assert_same(run, whole(SLOW))
            assert run.computed == 240 and kept < 60
        with distributed.Client(address, timeout=3) as client:
            running = Running(tmp_path / "b.zarr", client, iterations=SLOW)
            running.wait_for_chunks(5)
            scheduler.kill()
            scheduler.wait()
            with pytest.raises(ConnectionError, match=r"did not come .*is kept"):
                running.end()
        kept = recorded(running.out)
        begin()
        with distributed.Client(address, timeout=60) as client:
            run = evaluate(running.out, client, iterations=SLOW)
        assert run.computed == 240 - 4 * kept
        assert_same(run, whole(SLOW))


# From the shell

# One rollout alone differs in the last bit under JAXDYN_COMPILATION_OPTIONS=least.
STUDY = test_scale.STUDY.replace("[options]", "[options]\nbatch_size = 4")


@pytest.mark.slow
def test_sweep_on_clusters(cluster, tmp_path):
    file = tmp_path / "study.toml"
    file.write_text(STUDY)
    (tmp_path / "study.py").write_text(test_scale.FUNCTIONS)
    sweep = ("-m", "jaxdyn", "sweep", file, "--quiet", "--chunk", 3)
    places = {
        "here": ["--out", tmp_path / "here.zarr"],
        "workers": ["--workers", 2, "--out", tmp_path / "workers.zarr"],
        "client": ["--client", cluster.scheduler_address, "--out", tmp_path / "client.zarr"],
    }
    for options in places.values():
        process = start(*sweep, *options, stdout=subprocess.PIPE)
        assert b"12 rollouts, 12 of them computed" in process.communicate(timeout=LONG)[0]
        assert process.returncode == 0
    here, workers, there = (files(tmp_path / f"{name}.zarr") for name in places)
    assert here == workers == there


def test_sweep_refuses_places_without_a_scheduler(tmp_path, capsys):
    import dask.config

    from jaxdyn.cli import main

    file = tmp_path / "study.toml"
    file.write_text(STUDY)
    (tmp_path / "study.py").write_text(test_scale.FUNCTIONS)
    with dask.config.set({"distributed.comm.timeouts.connect": "300ms"}):
        assert main(["sweep", str(file), "--client", "tcp://127.0.0.1:1"]) == 2
    assert "--client is tcp://127.0.0.1:1, where no scheduler of Dask answers" in capsys.readouterr().err
    assert main(["sweep", str(file), "--workers", "0"]) == 2
    assert "--workers is 0; give at least 1" in capsys.readouterr().err


# Errors


def failing(bad, times, folder):
    """A function that raises for some starts, so many times each."""

    def look(x):
        if float(x) in bad:
            tries = folder / f"{float(x)}.txt"
            count = len(tries.read_text()) if tries.exists() else 0
            tries.write_text("x" * (count + 1))
            if count < times:
                raise ArithmeticError(f"{float(x)} is a bad start")
        return np.asarray(x)

    def function(p):
        x = jax.pure_callback(look, jax.ShapeDtypeStruct((), p.dtype), p, vmap_method="sequential")
        return {"y": x + 1.0}

    return function


@pytest.mark.parametrize("where", ["here", "cluster"])
def test_a_chunk_that_raises_is_tried_again_and_reported(client, tmp_path, where):
    client = client if where == "cluster" else None
    options = {"chunk": 5, "batch_size": 5, "client": client, "progress": False}
    starts = np.arange(40.0)
    function = failing((12.0, 33.0), 2, tmp_path)
    with pytest.raises(RuntimeError, match=r"2 failed .*\(2, 6\)") as caught:
        jd.scale.evaluate(function, starts, out=tmp_path / "a.zarr", resources=jd.scale.Resources(retries=0, **options))
    assert "Chunk 2:\nTraceback" in str(caught.value) and "12.0 is a bad start" in str(caught.value)
    assert recorded(tmp_path / "a.zarr") == 6
    # A second failure each, and a third attempt that succeeds.
    run = jd.scale.evaluate(
        function, starts, out=tmp_path / "a.zarr", resources=jd.scale.Resources(retries=1, **options)
    )
    assert run.success and run.computed == 10
    np.testing.assert_array_equal(run.dataset().y, starts + 1.0)


def test_a_cluster_that_does_not_fit_is_refused(client, tmp_path, monkeypatch):
    out = tmp_path / "a.zarr"
    for other in ("tcp://127.0.0.1:1", object()):
        with pytest.raises(ValueError, match=r"give a dask\.distributed\.Client"):
            evaluate(out, other)
    with pytest.raises(ValueError, match=r"devices .* client"):
        evaluate(out, client, devices=jax.local_devices())
    told = client.get_versions

    def versions(**changes):
        def get(packages):
            found = told(packages=packages)
            for worker in list(found["workers"].values())[1:]:
                worker["packages"] |= changes
            return found

        return get

    for changes, said in (
        ({"jaxdyn": None}, "jaxdyn not at all"),
        ({"jaxdyn": "0.0.1"}, r"jaxdyn 0\.0\.1"),
        ({"python": "3.9.1.final.0"}, r"python 3\.9\.1"),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(client, "get_versions", versions(**changes))
            with pytest.raises(ValueError, match=rf"worker tcp://.* has {said}.*same version"):
                evaluate(out, client)
    assert not out.exists()


def test_a_store_that_workers_do_not_see_is_refused(client, tmp_path):
    """The file that marks the store is moved away for the workers."""
    mark = tmp_path / "a.zarr.owner"
    with Cluster(client, mark=(mark, "a text")) as cluster:
        with pytest.raises(ValueError, match=r"worker tcp://.*a\.zarr\.owner: .*No such"):
            cluster.send(lambda: None)
        mark.write_text("another text")
        with pytest.raises(ValueError, match="another file of"):
            cluster.send(lambda: None)


def test_a_worker_of_another_version_that_joins_gets_no_task(client, monkeypatch):
    """Each worker compares its versions with those of the client, which are changed here."""
    monkeypatch.setattr("jaxdyn.tasks.worker.package_versions", lambda: package_versions() | {"jaxdyn": "0.0.1"})
    with (
        Cluster(client) as cluster,
        pytest.raises(ValueError, match=r"worker tcp://.* 0\.0\.1"),
    ):
        cluster.send(lambda: None)


def test_functions_of_modules_that_workers_lack_are_named(client, tmp_path, monkeypatch):
    (tmp_path / "of_the_client.py").write_text("def square(x):\n    return {'y': x**2}\n")
    monkeypatch.syspath_prepend(tmp_path)
    import of_the_client  # pyright: ignore[reportMissingImports]

    resources = jd.scale.Resources(client, progress=False)

    with pytest.raises(ModuleNotFoundError, match=r"of_the_client.*client\.upload_file"):
        jd.scale.evaluate(of_the_client.square, np.arange(4.0), out=tmp_path / "a.zarr", resources=resources)
    assert not (tmp_path / "a.zarr").exists()
    client.upload_file(str(tmp_path / "of_the_client.py"))
    run = jd.scale.evaluate(of_the_client.square, np.arange(4.0), out=tmp_path / "a.zarr", resources=resources)
    np.testing.assert_array_equal(run.dataset().y, np.arange(4.0) ** 2)


# Tasks


def test_tasks_are_taken_in_a_window(client):
    """Of a million items few are taken before the first results are there, and results come in the order of the items."""
    taken = 0

    def items():
        nonlocal taken
        for k in range(1_000_000):
            taken += 1
            yield k

    def target():
        class Negative:
            def call(self, item):
                time.sleep(0.3 if item == 0 else 0.0)
                return -item

        return Negative()

    with Cluster(client) as cluster:
        cluster.send(target)
        results = cluster.map("call", items())
        for k in range(100):
            assert next(results) == (k, -k)
            assert taken < k + 200
        del results
        assert isinstance(cluster.call("call", 3), int)
    assert taken < 400


def test_a_worker_that_compiles_gets_no_tasks_yet(client):
    """Of a second study too, when workers have the resource of all tasks already."""
    assert map_tasks(lambda x: x, range(4), client) == [0, 1, 2, 3]
    slow, quick = pids(client)

    def target():
        class Process:
            def call(self, item):
                time.sleep(0.01)
                return os.getpid()

        time.sleep(5.0 if os.getpid() == slow else 0.0)
        return Process()

    with Cluster(client) as cluster:
        cluster.send(target)
        begin = time.monotonic()
        assert {result for _, result in cluster.map("call", range(20))} == {quick}
        assert time.monotonic() - begin < 5.0


def test_lists_of_tasks(client):
    assert map_tasks(lambda x: x + 1, range(3)) == [1, 2, 3]
    tripled = map_tasks(lambda x: jnp.asarray(x) * 3.0, range(3), client)
    assert [x.dtype for x in tripled] == [jnp.float64] * 3 and [float(x) for x in tripled] == [0.0, 3.0, 6.0]
    with pytest.raises(ZeroDivisionError):
        map_tasks(lambda x: 1 / x, [1, 0], client)
    with Cluster(client) as cluster:
        cluster.send(lambda: [3, 1, 2])
        (item, failure), *_ = cluster.map("index", [7])
    assert item == 7 and isinstance(failure, Failure) and "ValueError" in failure.traceback


@pytest.mark.long
def test_starts_of_a_fit(client):
    """Two workers share the starts, and the fit from the best one is that of this process."""

    def mass(q, t, p):
        return jnp.eye(1)

    def bias(q, v, t, p):
        return p["size"] * jnp.sin(p["rate"] * q)

    t = np.linspace(0.0, 4.0, 200)
    q = np.sin(t)[:, None]
    log = jd.identify.Log(t, q, np.cos(t)[:, None], -q, -q + np.sin(3.0 * q))
    system = jd.ExplicitSystem(mass, bias, 1, parameters={"size": 0.5, "rate": 5.0})
    options = {
        "free": lambda s: [s.parameters["size"], s.parameters["rate"]],
        "objective": jd.identify.Objective("torque"),
        "solver": jd.identify.Solver(starts=16, spread=1.0),
    }
    here, there = (
        jd.identify.fit_parameters(system, log, execution=jd.identify.Execution(client=one), **options)
        for one in (None, client)
    )
    np.testing.assert_allclose(there.values, here.values, rtol=1e-9)
    np.testing.assert_allclose(np.abs(there.values), [1.0, 3.0], rtol=1e-6)


def robot_and_log():
    model, t = jd.robots.chain(2), np.linspace(0.0, 8.0, 400)
    rates, noise = np.array([1.3, 2.1]), np.random.default_rng(2).normal(size=(400, 2))
    q, v, a = np.sin(rates * t[:, None]), rates * np.cos(rates * t[:, None]), -(rates**2) * np.sin(rates * t[:, None])
    tau = jax.vmap(lambda *x: jd.inverse_dynamics(model, *x))(q, v, a) + 0.3 * v + 0.5 * np.tanh(v / 0.01)
    return model, jd.identify.Log(t, q, v, a, np.asarray(tau) + 0.02 * noise)


@pytest.mark.long
def test_identification_from_the_shell(cluster, tmp_path, capsys):
    """The report of a fit whose cross-validation runs on workers is that of this process."""
    from jaxdyn.cli import main

    model, log = robot_and_log()
    jd.save_urdf(model, tmp_path / "arm.urdf")
    jd.io.write_log(tmp_path / "log.csv", log)
    args = f"identify --urdf {tmp_path / 'arm.urdf'} --log {tmp_path / 'log.csv'} --filtered --weights none".split()
    args += "--terms viscous coulomb --repair".split()
    place = ["--client", cluster.scheduler_address]
    reports = []
    for name, options in (("here.json", []), ("there.json", place)):
        assert main([*args, "--report", str(tmp_path / name), *options]) == 0
        reports.append(json.loads((tmp_path / name).read_text()))
    assert reports[0] == reports[1]
    assert main([*args, "--method", "trajectory", *place]) == 2
    assert "--method trajectory does not have; use --method feasible" in capsys.readouterr().err


@pytest.mark.long
def test_without_a_client_no_dask_is_imported(tmp_path, monkeypatch):
    for name in ("dask", "distributed"):
        monkeypatch.setitem(sys.modules, name, None)
    assert evaluate(tmp_path / "a.zarr").success
    with pytest.raises(ImportError, match=r"distributed: .*jaxdyn\[scale\]"):
        evaluate(tmp_path / "b.zarr", object())
