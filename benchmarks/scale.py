"""Large batches through `jd.scale.run`: what storing costs, memory, resuming, two cores, clusters.

    python -m benchmarks.scale [store memory resume cores hosts workers tasks kill] [--samples 100000] [--full]

- store: seconds of a run against those of its programs alone, an arm of seven joints, 400 steps of RK4, 11 rows each, in turns.
- memory: peak of processes that run 1, 3 and 10 times as many rolling disks with 100 rows each (1e6 with --full, 9 GB on disk).
- resume: a store of 1e5 (1e6 with --full) rolling disks with 99 % of its chunks: seconds from the start of a new process, imports
  and compilation included, until the first new chunk is stored; and the same with JAX's cache of compiled programs
  (JAX_COMPILATION_CACHE_DIR), which the first process filled.
- cores: the arm in processes that may use one core and two: seconds and efficiency, t1/(2 t2).
- workers: the arm in this process on two cores, and on a local Dask cluster of one and of two worker processes on the same two.
- tasks: chunks of one rollout in this process and on a local cluster of two workers (1e5 chunks with --full, else 1e4):
  milliseconds of a chunk; and of tasks that do nothing, 17 times as many, with the memory of the client, of the scheduler and of
  a worker after each seventeenth of them.
- kill: the arm on two workers, one of which is killed (kill -9) when half of the chunks are stored, against the same undisturbed.
- hosts: what the arm's rollouts compute, write and exchange, measured here, and what that makes on paper for 1, 8 and 64 hosts
  of 64 cores; what an iteration of a fit exchanges.
"""

import argparse
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks.operations import operations
from jaxdyn.scale import study
from jaxdyn.tasks import Cluster

OF_RESOURCES = [one.name for one in fields(jd.scale.Resources)]
COLLECTIVES = "all-reduce|all-gather|all-to-all|reduce-scatter|collective-permute|collective-broadcast"
CACHE = "JAX_COMPILATION_CACHE_DIR"


def grouped(options: dict) -> dict:
    """Options of a run with those of `jd.scale.Resources` among them in one object."""
    own = {"progress": False} | {name: options.pop(name) for name in OF_RESOURCES if name in options}
    return options | {"resources": jd.scale.Resources(**own)}


def arm(samples: int, out, **options):
    """An arm of seven joints that falls from random states."""
    model = jd.robots.iiwa()

    def draw(key):
        one, other = jax.random.split(key)
        return {"q": jax.random.uniform(one, (7,), minval=-1.0, maxval=1.0), "v": jax.random.normal(other, (7,))}

    ts = np.linspace(0.0, 0.4, 11)
    options = {"stepsize": 1e-3, "samples": samples, "out": out} | grouped(options)
    return jd.scale.run(model, lambda p: (p["q"], p["v"]), draw, ts, **options)


def disks(samples: int, out, points: int = 100, **options):
    """Rolling disks of random mass and radius."""

    def draw(key):
        mass, radius = jax.random.uniform(key, (2,), minval=0.3, maxval=0.7)
        return {"mass": mass, "radius": radius}

    def start(p):
        one = jnp.ones_like(p["mass"])
        return jnp.zeros(4), jnp.stack([2.0 * p["radius"], 0.0 * one, one, 2.0 * one])

    ts = np.linspace(0.0, 1.0, points)
    options = {"stepsize": 0.01, "samples": samples, "out": out} | grouped(options)
    return jd.scale.run(lambda p: jd.scenes.rolling_disk(**p), start, draw, ts, **options)


def with_program(run: Callable, *args, **options):
    """A run of `jd.scale` in this process, and the program of its batches."""
    kept, usual = [], study.Study.open

    def note(self):
        kept.append(usual(self))
        return kept[-1]

    study.Study.open = note
    try:
        return run(*args, **options), kept[-1].program
    finally:
        study.Study.open = usual


def store(folder: Path, samples: int) -> None:
    """Storing and the meter against computing alone."""
    whole, alone = [], []
    for k in range(3):
        run, program = with_program(arm, samples, folder / f"store{k}.zarr", progress=True)
        whole.append(run.seconds)
        # The next one finds the memory of its files: a virtual machine takes 9 us for a page that it has never used.
        shutil.rmtree(run.out)
        before = time.perf_counter()
        for first in range(0, samples, run.chunk):
            numbers = np.arange(first, min(first + run.chunk, samples))
            study.compute(program, numbers)
        alone.append(time.perf_counter() - before)
    print(
        f"store: {samples} arms, chunks of {run.chunk}: {min(whole):.3g} s with the store, {min(alone):.3g} s without "
        f"({samples / min(whole):.3g} rollouts/s); cost {100 * (min(whole) / min(alone) - 1):.1f} %"
    )


def child(function: str, *arguments, cores: int | None = None, environment=None) -> tuple[float, int]:
    """Seconds of the loop and peak memory (bytes) of a process that runs `function`."""
    command = [sys.executable, "-m", "benchmarks.scale", "--child", function, *map(str, arguments)]

    command += [] if cores is None else [str(cores)]
    environment = os.environ | (environment or {})
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    seconds, peak = done.stdout.split()[-2:]
    return float(seconds), int(peak)


def memory(folder: Path, samples: int) -> None:
    """Peak memory against the number of rollouts."""
    for count in (samples // 10, 3 * samples // 10, samples):
        seconds, peak = child("disks", count, folder / f"memory{count}.zarr")
        print(f"memory: {count} disks, 100 rows: peak {peak / 2**20:.0f} MiB, {seconds:.3g} s")


def resume(folder: Path, samples: int) -> None:
    """From the start of a process to the first new chunk, with 99 % done."""
    out, cache = folder / "resume.zarr", folder / "programs"
    child("resumed", samples, out, environment={CACHE: str(cache)})
    from jaxdyn.scale.store import Store

    kept = Store(out)
    last = kept.chunks - 1
    command = [sys.executable, "-m", "benchmarks.scale", "--child", "resumed", str(samples), str(out)]
    bare = {name: value for name, value in os.environ.items() if name != CACHE}
    for name, environment in (("", bare), (", with JAX's cache of programs", bare | {CACHE: str(cache)})):
        kept.forget(last)
        before = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
        while not kept.is_done(last):
            if process.poll() not in (None, 0):
                raise RuntimeError("the resumed process failed")
            time.sleep(0.005)
        first = time.perf_counter() - before
        process.communicate()
        whole = time.perf_counter() - before
        print(
            f"resume: {samples} disks, 99 % done{name}: {first:.3g} s to the first new chunk, {whole:.3g} s to the end with "
            "all chunks looked through"
        )


def cores(folder: Path, samples: int) -> None:
    """Strong scaling from one core to two."""
    times = {n: child("arm", samples, folder / f"cores{n}.zarr", cores=n)[0] for n in (1, 2)}
    print(f"cores: {samples} arms: {times[1]:.3g} s on one core, {times[2]:.3g} s on two; ", end="")
    print(f"efficiency {times[1] / (2 * times[2]):.2f}")


@contextmanager
def cluster(workers: int):
    """A client of a local cluster, a process for each worker and one for the scheduler, so that its memory is known."""
    from distributed import Client

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scheduler.json"
        command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--scheduler-file", str(file)]
        processes = [subprocess.Popen([*command, "--dashboard-address", ":0"], stderr=subprocess.DEVNULL)]
        command = [
            sys.executable,
            "-m",
            "distributed.cli.dask_worker",
            "--scheduler-file",
            str(file),
            "--nthreads",
            "2",
        ]
        processes += [subprocess.Popen(command, stderr=subprocess.DEVNULL) for _ in range(workers)]
        try:
            while not (file.exists() and file.read_text()):
                time.sleep(0.1)
            with Client(scheduler_file=str(file)) as client:
                client.wait_for_workers(workers)
                client.scheduler_pid = processes[0].pid
                yield client
        finally:
            for process in reversed(processes):
                process.terminate()
                process.wait()


def resident(pid: int | str = "self") -> float:
    """Memory of a process (MiB)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def workers(folder: Path, samples: int) -> None:
    """One process against worker processes on the same cores; the second run finds compiled kernels and running workers."""
    options = {"chunk": 4096, "batch_size": 2048}
    times = {0: min(arm(samples, folder / f"here{k}.zarr", **options).seconds for k in range(2))}
    for count in (1, 2):
        with cluster(count) as client:
            runs = [arm(samples, folder / f"{count}-{k}.zarr", client=client, **options) for k in range(2)]
            times[count] = min(run.seconds for run in runs)
    print(
        f"workers: {samples} arms: {times[0]:.3g} s in this process, {times[1]:.3g} s on one worker, {times[2]:.3g} s on two; "
        f"two against this process: {times[0] / times[2]:.2f}"
    )


def tasks(folder: Path, samples: int) -> None:
    """What a chunk costs that costs nothing, and what a task does; memory against their number."""
    options = {"chunk": 1, "batch_size": 1, "rows": False}
    small = {"x": np.arange(float(samples))}
    with cluster(2) as client:
        for name, place in (("in this process", None), ("on two workers", client)):
            run = jd.scale.evaluate(
                lambda p: {"y": p["x"] + 1.0},
                small,
                out=folder / f"{name}.zarr",
                **grouped({"client": place, **options}),
            )
            print(f"tasks: {samples} chunks of one rollout {name}: {1e3 * run.seconds / samples:.2f} ms each")
        with Cluster(client) as many:
            many.send(lambda: [])
            start = time.perf_counter()
            for k, _ in many.map("count", range(17 * samples)):
                if k % samples == samples - 1:
                    worker = max(client.run(resident).values())
                    print(
                        f"tasks: {k + 1} that do nothing: {1e3 * (time.perf_counter() - start) / (k + 1):.2f} ms each; client "
                        f"{resident():.0f} MiB, scheduler {resident(client.scheduler_pid):.0f} MiB, worker {worker:.0f} MiB"
                    )


def kill(folder: Path, samples: int) -> None:
    """A worker killed when half of the chunks are stored."""
    options = {"chunk": 2048, "batch_size": 2048}
    with cluster(2) as client:
        arm(samples, folder / "warm.zarr", client=client, **options)
        plain = arm(samples, folder / "plain.zarr", client=client, **options).seconds

        def watch():
            done = folder / "killed.zarr" / "result" / "c"
            while not done.exists() or len(list(done.iterdir())) < samples // 4096:
                time.sleep(0.01)
            os.kill(victim, 9)

        victim = min(client.run(os.getpid).values())
        watcher = threading.Thread(target=watch)
        watcher.start()
        killed = arm(samples, folder / "killed.zarr", client=client, **options).seconds
        watcher.join()
    print(
        f"kill: {samples} arms on two workers: {plain:.3g} s; one killed at half: {killed:.3g} s, {killed / plain:.2f}"
    )


def hosts(folder: Path, samples: int) -> None:
    """To many hosts, on paper, from what is measured here."""
    run, program = with_program(arm, samples, folder / "hosts.zarr")
    files = [path for path in (folder / "hosts.zarr").rglob("*") if path.is_file()]
    chunks = -(-samples // run.chunk)
    bytes_each, files_each = sum(path.stat().st_size for path in files) / samples, len(files) / chunks
    model = jd.robots.iiwa()
    counted = operations(lambda *x: jd.forward_dynamics(model, *x), *[jnp.zeros(7)] * 3)
    evaluations = 4 * round(0.4 / 1e-3)
    flops = evaluations * (counted.all if counted else float("nan"))
    exchanged = len(re.findall(rf" ({COLLECTIVES})(-start)?\(", program.compiled.as_text()))
    cores = len(os.sched_getaffinity(0))
    pace = samples / run.seconds / cores
    print(
        f"hosts: {samples} arms on {cores} cores: {pace:.3g} rollouts/s a core of {flops:.3g} operations each "
        f"({pace * flops / 1e9:.2g} G/s), {bytes_each:.0f} bytes on disk each, {files_each:.1f} files a chunk of {run.chunk}, "
        f"{exchanged} collectives in the program\n"
        "| hosts of 64 cores | rollouts/s | T operations/s | rows, GB/s | reductions alone, MB/s | files/s at 2 s a chunk |\n"
        "|---|---|---|---|---|---|"
    )
    for count in (1, 8, 64):
        total = 64 * count * pace
        print(
            f"| {count} | {total:.2g} | {total * flops / 1e12:.2g} | {total * bytes_each / 1e9:.2g} | {total / 1e6:.2g} | "
            f"{files_each * count / 2:.3g} |"
        )
    print("a fit of 70 numbers: one all-reduce of 568 bytes an iteration (tests/dynamics/test_sharding.py counts it)")


def main() -> None:
    """Print the tables that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["store", "memory", "resume", "cores", "hosts", "workers"])
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if args.child:
        name, samples, out, *limit = args.what
        if limit:  # before jax counts the cores
            os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(limit[0])])
        if name == "resumed":
            run = disks(int(samples), out, points=11, chunk=max(1, int(samples) // 100))
        else:
            run = {"arm": arm, "disks": disks}[name](int(samples), out)
        print(run.seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
        return
    many = 1_000_000 if args.full else args.samples
    sizes = {"store": args.samples, "memory": many, "resume": many, "cores": args.samples}
    sizes |= {
        "hosts": args.samples,
        "workers": args.samples,
        "kill": args.samples,
        "tasks": 100_000 if args.full else 10_000,
    }
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    for name in args.what:
        with tempfile.TemporaryDirectory(dir="out" if Path("out").is_dir() else None) as folder:
            globals()[name](Path(folder), sizes[name])


if __name__ == "__main__":
    main()
