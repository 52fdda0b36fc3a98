"""Batches that are divided between devices (`divided.py`): the same numbers, and what devices exchange, which is counted."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from xla_options import flags

pytestmark = pytest.mark.native


def _run(*what: str, **environment: str) -> list:
    command = [sys.executable, str(Path(__file__).parents[1] / "divided.py"), *what]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


# Devices exchange the same without LLVM's optimiser, which is most of these compiles.
QUICK = {"XLA_FLAGS": flags()}


@pytest.fixture(scope="module")
def compared(all_robots) -> dict:
    """What each function does on eight devices, by its name; with XLA's own options where every test runs."""
    return {row["name"]: row for row in _run("compare", **({} if all_robots else QUICK))}


# Samples exchange nothing. Only a mean over all of them does, once: the value and the derivative of a fit go together.
ONCE = {"all-reduce": 1}
EXCHANGED = {
    "dynamics": {},
    "gradient": {},
    "rollout": {},
    "shared torque": {},
    "one of three": {},
    "two axes": {},
    "four-bar in shard_map": {},
    "dynamics explicit": {},
    "gradient explicit": {},
    "fit": ONCE,
    "fit explicit": ONCE,
    "fit in shard_map": ONCE,
}


@pytest.mark.parametrize("name", EXCHANGED)
def test_samples_exchange_nothing_and_a_fit_once(compared, name):
    computed = compared[name]
    assert computed["calls"] == EXCHANGED[name]
    assert computed["shards"] == (1 if name.startswith("fit") else 8)
    assert computed["kernels"] > 0


def test_results_are_those_of_one_device(compared):
    assert len(compared) == len(EXCHANGED) + 1
    assert max(computed["apart"] for computed in compared.values()) < 1e-12


def test_devices_do_not_ask_each_other_for_singular_samples(compared):
    """Each computes its own, within the kernel."""
    computed = compared["four-bar"]
    assert computed["shards"] == 8 and computed["calls"] == {}


@pytest.mark.slow
def test_a_divided_program_is_found_in_the_compilation_cache(tmp_path):
    """Nothing of a process, an address or the number of a callback, is in the text of a program."""
    options = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "programs"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        "TF_CPP_MIN_LOG_LEVEL": "3",
    }
    for hits in (0, 1):
        computed, compared = _run("cached", **options)
        assert computed == hits
        assert compared["calls"] == {} and compared["apart"] < 1e-12


def _check_fits(*names: str) -> None:
    for computed, name in zip(_run("fits", *names), names, strict=True):
        one, many = computed["history"]
        assert many[-1] < 0.9 * many[0], name
        np.testing.assert_allclose(many, one, rtol=1e-9)
        # Gauss-Newton steps are taken by the host, which reads the slopes of all devices.
        assert computed["calls"] == ({} if name == "slopes" else ONCE), name


@pytest.mark.slow
def test_a_fit_to_samples_of_two_logs_is_shared_among_devices():
    _check_fits("torque")


@pytest.mark.slow
def test_fits_to_segments_of_two_logs_are_shared_among_devices():
    _check_fits("trajectory", "slopes")
