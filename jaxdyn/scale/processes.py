"""Which process of a run this one is: by the environment that a launcher sets, by `jax.distributed`, or as said."""

import os
import socket
import time
from collections.abc import Mapping
from typing import NamedTuple

import jax

# What launchers set: the number of a process, and how many there are. Kubernetes numbers the pods of an indexed job and says
# nothing about how many there are, so that the job's description has to.
LAUNCHERS = (
    ("JAXDYN_PROCESS", "JAXDYN_PROCESSES"),
    ("SLURM_PROCID", "SLURM_NTASKS"),
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
    ("JOB_COMPLETION_INDEX", "JAXDYN_PROCESSES"),
)


class Process(NamedTuple):
    """Number `index` of the `count` processes of a run."""

    index: int
    count: int


def process_of(given: object = None, environment: Mapping[str, str] | None = None) -> Process:
    """The process as given, (index, count); else as `jax.distributed` or the environment says; else the only one.

    **Raises:** ValueError for an index that is not in 0 ... count - 1, and for variables that are no whole numbers.
    """
    environment = os.environ if environment is None else environment
    if given is not None:
        return _checked(given, "process")
    if jax.distributed.is_initialized():
        return Process(jax.process_index(), jax.process_count())
    for index, count in LAUNCHERS:
        if index in environment and count in environment:
            return _checked((environment[index], environment[count]), f"{index}, {count} of the environment")
    return Process(0, 1)


def _checked(value, what: str) -> Process:
    try:
        index, count = (int(x) for x in value)
    except (TypeError, ValueError):
        raise ValueError(f"{what} is {value!r}; give two whole numbers, (index, count)") from None
    if not 0 <= index < count:
        raise ValueError(f"{what} is {value!r}; give an index from 0 to count - 1")
    return Process(index, count)


def initialize(
    coordinator: str | None = None, processes: int | None = None, process: int | None = None, *, timeout: float = 60.0
) -> Process:
    """Start `jax.distributed` between the processes of a program; call it before anything else of jax.

    `jd.scale.run` and `jd.scale.evaluate` do without: their processes share a store and exchange no numbers. A program whose
    arrays live on several hosts (a fit whose sums go over all of them) needs it.

    **Arguments:** `coordinator`, "host:port" of process 0; `processes`, how many; `process`, the number of this one. What is
    left out is taken from the variables named in `jaxdyn.scale.processes.LAUNCHERS`, else from what jax finds (Slurm, Open
    MPI, Kubernetes, cloud TPUs). `timeout` (s) is for each of: reaching the coordinator, and all processes being there.

    **Returns:** the process, (index, count).

    **Raises:** ValueError where only part of the arguments is known. TimeoutError that names the coordinator where nobody
    answers there. Where the coordinator waits in vain for another process, jax itself ends this one after `timeout`, with
    "DEADLINE_EXCEEDED ... RegisterTask" and the status of an abort; the same where the coordinator dies later.
    """
    if process is None and processes is None and coordinator is not None:
        for index, count in LAUNCHERS:
            if index in os.environ and count in os.environ:
                process, processes = process_of()
                break
    known = [x is not None for x in (coordinator, processes, process)]
    if any(known) and not all(known):
        raise ValueError(
            f"coordinator is {coordinator!r}, processes {processes}, process {process}; give all three, or none where jax finds "
            "them by itself (Slurm, Open MPI, Kubernetes)"
        )
    if coordinator is not None:
        if process is not None and processes is not None:
            _checked((process, processes), "process, processes")
        if process != 0:
            _await(coordinator, timeout)
    jax.distributed.initialize(coordinator, processes, process, initialization_timeout=max(1, round(timeout)))
    return Process(jax.process_index(), jax.process_count())


def _await(coordinator: str, timeout: float) -> None:
    """Wait until somebody listens at "host:port"."""
    host, _, port = coordinator.rpartition(":")
    if not (host and port.isdigit()):
        raise ValueError(f"coordinator is {coordinator!r}; give host:port, as 10.0.0.1:1234")
    end = time.monotonic() + timeout
    while True:
        try:
            with socket.create_connection((host.strip("[]"), int(port)), timeout=max(0.1, end - time.monotonic())):
                return
        except OSError as error:
            if time.monotonic() > end:
                raise TimeoutError(
                    f"coordinator is {coordinator!r}, and nobody answered there within {timeout:g} s ({error}); start "
                    "process 0, or see whether its host and port are right"
                ) from error
        time.sleep(0.1)
