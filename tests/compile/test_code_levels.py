"""First calls: quick code and what takes its place, the collector of cycles, and the message on a long call."""

import ctypes
import logging
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdyn.compile import kernel, mode, stored, target

pytestmark = pytest.mark.native


@pytest.fixture
def two_levels(monkeypatch, folder):
    """All code is quick at first, and is not on disk."""
    monkeypatch.delenv("JAXDYN_COMPILATION_OPTIONS", raising=False)
    monkeypatch.setattr(stored, "QUICK_LINES", 0)


def _solve(A, x):
    y = jnp.sin(A @ x)
    for _ in range(4):
        y = jnp.linalg.solve(A @ A.T + jnp.eye(6), jnp.cos(y) * x)
    return y


@pytest.mark.parametrize("batch", [(), (300,)])
def test_optimised_code_takes_the_place_of_quick_code(two_levels, batch):
    """With the same bits; also of a subprogram, whose callers stay as they are, and on disk."""
    rng = np.random.default_rng(3)
    A, x = rng.normal(size=(*batch, 6, 6)), rng.normal(size=(*batch, 6))
    scale = float(rng.normal())  # programs of this test alone
    solve = jax.jit(lambda A, x: scale * _solve(A, x))
    function = kernel(lambda A, x: solve(A, solve(A, x)), derivative=False)
    run = jax.jit(jax.vmap(function) if batch else function)
    before, called_before = set(target._kernels), set(target._called)
    quick = np.asarray(run(A, x))
    (number,) = set(target._kernels) - before
    symbol = next(iter(set(target._called) - called_before))
    made, called = target._kernels[number], target._called[symbol]
    addresses = made.entry.kernel, called.address.value
    # The optimiser waits for a quiet second.
    found = stored.find_code(made.row.identity)
    assert found is not None and found.text
    mode.wait_for_code()
    assert made.entry.kernel != addresses[0] and called.address.value != addresses[1]
    for name in (made.row.identity, symbol):
        better = stored.find_code(name)
        assert better is not None and not better.text
    np.testing.assert_array_equal(np.asarray(run(A, x)), quick)


def test_long_blocks_come_in_parts():
    """Of a branch: what is joined behind it comes from the last part of each side, whose sums differ."""

    def side(name: str, summand: str) -> list[str]:
        lines = [f"{name}:", f"  %{name}0 = fadd double %x, {summand}"]
        lines += [f"  %{name}{i} = fadd double %{name}{i - 1}, {summand}" for i in range(1, 3 * stored.BLOCK_LINES)]
        return [*lines, "  br label %joined"]

    last = 3 * stored.BLOCK_LINES - 1
    text = "\n".join(
        [
            "define double @function(double %x) {",
            "begin:",
            "  %is_large = fcmp ogt double %x, 1.0",
            "  br i1 %is_large, label %large, label %small",
            *side("large", "1.0"),
            *side("small", "2.0"),
            "joined:",
            f"  %sum = phi double [ %large{last}, %large ], [ %small{last}, %small ]",
            "  ret double %sum",
            "}",
        ]
    )
    assert stored._in_short_blocks(text).count("br label") == 2 + 2 * 3
    code = stored.Code(stored.compile_text(text, is_quick=True))
    function = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)(code.address("function"))
    assert [function(2.0), function(0.5)] == [2.0 + last + 1, 0.5 + 2 * (last + 1)]


_SCRIPT = """
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
from jaxdyn.compile import kernel, stored, target
stored.QUICK_LINES = 0
x = jnp.linspace(0.1, 0.9, 5)
print(repr(float(jax.jit(kernel(lambda x, y: jnp.sum(jnp.sin(x) / jnp.cos(y))))(x, x))))
"""
_LOOK = "print([bool(stored.find_code(x.row.identity).text) for x in target._kernels.values()])\n"
_LISTED = "from jaxdyn.compile import code; code.MIN_QUICK_OPERATIONS = 0\n"  # whose text is written after the call


@pytest.mark.long
@pytest.mark.parametrize("tier", ["", _LISTED])
def test_quick_code_on_disk_is_optimised_by_another_process(monkeypatch, tmp_path, tier):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("JAXDYN_COMPILATION_OPTIONS", raising=False)
    # The first process ends before it optimises anything; the second one finds its code, and waits.
    wait = "from jaxdyn.compile import mode; mode.wait_for_code()\n"
    alone = "from jaxdyn.compile import mode; mode._SHORT_SECONDS = 1e6\nstored.make_code = None\n"
    found = _SCRIPT.replace("x = jnp", alone + "x = jnp")
    lines = []
    for script in (tier + _SCRIPT, found + _LOOK + wait + _LOOK):
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
        lines.append(done.stdout.splitlines())
    assert lines[0][0] == lines[1][0]
    assert lines[1][1:] == ["[True]", "[False]"]


@pytest.mark.long
def test_quick_code_of_processes_that_end_soon_is_optimised_at_once(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("JAXDYN_COMPILATION_OPTIONS", raising=False)
    # No first call is ever over: what waits for that is not optimised.
    busy = "from jaxdyn.compile import mode; mode._QUIET_SECONDS = 1e6\n"
    look = "any(stored.find_code(x.row.identity).text for x in target._kernels.values())"
    wait = f"import time; end = time.monotonic() + 60\nwhile {look} and time.monotonic() < end: time.sleep(0.01)\n"
    lines = []
    for script in (_SCRIPT + _LOOK, _SCRIPT + wait + _LOOK):
        done = subprocess.run([sys.executable, "-c", busy + script], capture_output=True, text=True, check=True)
        lines.append(done.stdout.splitlines())
    assert lines[0][0] == lines[1][0]
    assert [x[1] for x in lines] == ["[True]", "[False]"]


def test_a_long_first_call_is_reported_once(monkeypatch, caplog, two_levels):
    mode.wait_for_code()
    monkeypatch.setattr(mode, "REPORTED_SECONDS", 0.0)
    scale = float(np.random.default_rng().normal())
    run = jax.jit(kernel(lambda x: jnp.sin(scale * x) + jnp.cos(x)))
    with caplog.at_level(logging.INFO, "jaxdyn"):
        for _ in range(2):
            run(jnp.arange(3.0)).block_until_ready()
            mode.wait_for_code()
    (message,) = [x.message for x in caplog.records if "first call" in x.message]
    shares = dict(re.findall(r"(\w+) (\d+) %", message))
    assert list(shares) == [*mode.PHASES, "other"]
    assert 97 <= sum(map(int, shares.values())) <= 103 and int(shares["XLA"]) > 0 and int(shares["LLVM"]) > 0
