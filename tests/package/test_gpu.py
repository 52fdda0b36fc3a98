"""What programs would launch on a GPU, counted by compiling for one: none is needed, but the CUDA plugin is."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from benchmarks import gpu
from jaxdyn.compile.operations import cosine, sine


def test_forward_dynamics_calls_no_library_and_no_host():
    """One kernel of the dynamics, and one or two that put its columns together."""
    reason = gpu.why_not()
    if reason:
        pytest.skip(f"nothing can be compiled for a GPU: {reason}")
    options = "--count --robots iiwa --batches 1 4096 --modes auto --only".split()
    command, root = [sys.executable, "-m", "benchmarks.gpu", *options, "forward dynamics"], Path(jd.__file__).parents[1]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=900)
    rows = [[cell.strip() for cell in line.split("|")[2:8]] for line in done.stdout.splitlines()[2:]]
    counted = {(label, batch): counts for label, batch, *counts in rows}
    # Kernels once and each turn of a loop, calls of libraries, callbacks.
    assert counted["forward dynamics", "4096"] == ["2", "0", "0", "0"], done.stderr[-2000:]
    assert counted["forward dynamics", "1"] == ["3", "0", "0", "0"]


def test_launches_are_counted_in_the_text_of_a_program():
    text = """
%fused (p: f32[4]) -> f32[4] {
  %p = f32[4]{0} parameter(0)
  ROOT %s = f32[4]{0} sine(%p)
}
%body (c: (s32[], f32[4])) -> (s32[], f32[4]) {
  %c = (s32[], f32[4]{0}) parameter(0)
  %x = f32[4]{0} get-tuple-element(%c), index=1
  %f = f32[4]{0} fusion(%x), kind=kLoop, calls=%fused
  %g = f32[4]{0} custom-call(%f), custom_call_target="__cublas$gemm"
  ROOT %t = (s32[], f32[4]{0}) tuple(%i, %g)
}
%condition (c.1: (s32[], f32[4])) -> pred[] {
  %c.1 = (s32[], f32[4]{0}) parameter(0)
  ROOT %less = pred[] fusion(%c.1), kind=kLoop, calls=%fused
}
ENTRY %main (q: f32[4]) -> f32[4] {
  %q = f32[4]{0} parameter(0)
  %h = f32[4]{0} custom-call(%q), custom_call_target="xla_ffi_python_gpu_callback"
  %w = (s32[], f32[4]{0}) while(%tuple), condition=%condition, body=%body
  ROOT %o = f32[4]{0} get-tuple-element(%w), index=1
}
"""
    assert gpu.launches(text) == {"once": 1, "each turn": 3, "libraries": 1, "callbacks": 1}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_sines_of_polynomials(dtype):
    """To a unit and a half in the last place of one, within ten turns and at numbers that are none."""
    x = np.concatenate([np.linspace(-63.0, 63.0, 4001), np.arange(-40, 41) * np.pi / 4]).astype(dtype)
    exact, both = x.astype(np.longdouble), jax.jit(lambda x: (sine(x), cosine(x)))
    for computed, want in zip(both(x), (np.sin(exact), np.cos(exact)), strict=True):
        assert computed.dtype == dtype
        assert np.abs(np.asarray(computed) - want).max() < 1.5 * np.finfo(dtype).eps
    sines, cosines = map(np.asarray, both(np.asarray([0.0, np.inf, -np.inf, np.nan], dtype)))
    assert sines[0] == 0.0 and cosines[0] == 1.0
    assert np.isnan(sines[1:]).all() and np.isnan(cosines[1:]).all()
