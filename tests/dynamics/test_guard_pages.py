"""A kernel touches nothing but its buffers: each of them ends, then begins, at a page of memory that may not be touched."""

import ctypes
import mmap
import os
import subprocess
import sys

import numpy as np
import pytest
from xla_options import flags

from jaxdyn.compile.code import varying_first

pytestmark = pytest.mark.native

PAGE = mmap.PAGESIZE

# In a process of its own, which a kernel that goes beyond its buffers would end.
PROGRAM = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import jaxdyn as jd
from jaxdyn.compile import target
sys.path[:0] = {tests!r}
from test_guard_pages import called_between_guards

prepare, called = target._Kernel.address, []
target._Kernel.address = lambda self: called.append((self, self.program)) or prepare(self)
model = jd.robots.iiwa()
q = jnp.full((5, model.nq), 0.3)
v, tau = jnp.zeros((5, model.nv)), jnp.ones((5, model.nv))
jax.vmap(lambda *x: jd.forward_dynamics(model, *x))(q, v, tau)
jd.forward_kinematics(model, q[0])
scene, start = jd.scenes.four_bar(), jd.scenes.four_bar.start()
ts = jnp.linspace(0.0, 0.2, 6)
jd.simulate(scene, *start, ts)
jnp.asarray(jd.constrained_dynamics(scene, *start, rank_tol=0.5).acceleration)
if {derivatives}:
    jax.grad(lambda m: jnp.sum(jax.vmap(lambda *x: jd.forward_dynamics(m, *x))(q, v, tau)), allow_int=True)(model)
    many = jnp.stack([start[1]] * 3) * jnp.asarray([0.5, 1.0, 2.0])[:, None]
    jax.grad(lambda vs: jnp.sum(jax.vmap(lambda v: jd.simulate(scene, start[0], v, ts, stepsize=0.02).q)(vs)))(many)
widths, loops = set(), 0
for kernel, program in called:
    if program is None:
        continue
    loops += hasattr(program, "turn")
    for samples in (1,) if kernel.row.width == 1 else (1, kernel.row.width - 1, kernel.row.width, 2 * kernel.row.width + 1):
        called_between_guards(kernel.address(), program, kernel.uniform, samples)
    widths.add(kernel.row.width)
print(len(called), sorted(widths), loops)
"""


def _guarded(size: int, at_end: bool):
    """Memory of so many bytes beside a page that may not be touched, and what holds it."""
    pages = max(1, -(-size // PAGE))
    memory = mmap.mmap(-1, (pages + 2) * PAGE)
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    libc = ctypes.CDLL(None, use_errno=True)
    for page in (address, address + (pages + 1) * PAGE):
        assert libc.mprotect(ctypes.c_void_p(page), PAGE, 0) == 0
    return (address + (pages + 1) * PAGE - size if at_end else address + PAGE), memory


def called_between_guards(address: int, program, uniform, samples: int) -> None:
    """Call a kernel with random numbers, its buffers at the end of their pages and then at the beginning."""
    kernel = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)(address)
    rng = np.random.default_rng(0)
    inputs = [(program.inputs[i], uniform[i]) for i in varying_first(uniform)]
    for at_end in (True, False):
        pointers, held = [], []
        for array, is_same in (*inputs, *((output, False) for output in program.outputs)):
            count = array.size * (1 if is_same else samples)
            size = count * array.dtype.itemsize
            place, memory = _guarded(size, at_end)
            numbers = rng.uniform(0.1, 1.0, count).astype(array.dtype)
            ctypes.memmove(place, numbers.ctypes.data, size)
            pointers.append(place)
            held.append(memory)
        kernel((ctypes.c_void_p * len(pointers))(*pointers), samples, 0, samples)


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="protects pages by mprotect")
@pytest.mark.parametrize("derivatives", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_kernels_stay_within_their_buffers(request, derivatives):
    """Straight programs, those with subprograms, pseudo-inverses and loops; one lane and several, whole blocks and rests."""
    code = PROGRAM.format(tests=[str(folder) for folder in request.path.parents[:2]], derivatives=derivatives)
    # Kernels are not XLA's, so its optimiser may be left out.
    options = {"XLA_FLAGS": flags()}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=os.environ | options, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    count, *widths, loops = done.stdout.replace("[", "").replace("]", "").replace(",", "").split()
    # Loops of steps without their derivatives are a single program.
    assert int(count) > 10 and int(loops) > (2 if derivatives else 0) and len(widths) > 1
