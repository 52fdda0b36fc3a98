"""Steps of explicit methods on one flat state: against diffrax's own steps, and how they compile."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn import _one_call, scenes
from jaxdyn._one_kernel import kernel_of
from jaxdyn.constraints.base import velocity_residual
from jaxdyn.scene import Scene
from jaxdyn.solvers import explicit
from jaxdyn.solvers.explicit import _SMALL, ExplicitSteps

SIZES = {"f64": 8, "s64": 8, "u64": 8, "f32": 4, "s32": 4, "u32": 4, "s8": 1, "u8": 1, "pred": 1}


def field(t, y, args):
    """Coupled pendulums in a state of two parts, of which the angles may be a matrix."""
    angles = y["angles"].ravel()
    pull = -jnp.sin(angles) + 0.3 * (jnp.roll(angles, 1) - angles) + 0.1 * jnp.cos(t)
    return {"angles": y["rates"].reshape(y["angles"].shape), "rates": pull - 0.05 * y["rates"]}


@pytest.mark.parametrize("shape", [(1,), (5,), (7,), (3, 4), (40,)], ids=str)
@pytest.mark.parametrize("solver", [diffrax.Dopri8(), diffrax.Tsit5(), diffrax.Heun()], ids=lambda s: type(s).__name__)
def test_steps_are_those_of_diffrax(solver, shape):
    """States of one piece, of several, and of one that is too large to be cut."""
    keys = jax.random.split(jax.random.key(3), 2)
    size = int(np.prod(shape))
    y0 = {"angles": jax.random.normal(keys[0], shape), "rates": jax.random.normal(keys[1], (size,))}
    term, times = diffrax.ODETerm(field), jnp.asarray([0.2, 0.5, 0.7])

    def two_steps(method):
        state, found, y = method.init(term, times[0], times[1], y0, None), [], y0
        for t0, t1 in ((times[0], times[1]), (times[1], times[2])):
            y, error, dense, state, _ = method.step(term, t0, t1, y, None, state, made_jump=False)
            output = method.interpolation_cls(t0=t0, t1=t1, **dense)
            found.append((y, error, output.evaluate(t0 + 0.3 * (t1 - t0)), output.evaluate(t1)))
        return found

    ours, theirs = jax.jit(lambda: two_steps(ExplicitSteps(solver)))(), jax.jit(lambda: two_steps(solver))()
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=1e-13), ours, theirs)


def loops(text: str):
    """Lines of the bodies of all loops in a compiled program."""
    bodies, parts, name = set(re.findall(r"body=%([\w.\-]+)", text)), {}, None
    for line in text.splitlines():
        start = re.match(r"(?:ENTRY )?%([\w.\-]+) \(.*\{$", line)
        name = start.group(1) if start else name
        parts.setdefault(name, []).append(line)
    return [parts[name] for name in bodies]


def largest(lines) -> int:
    """Bytes of the largest array that an operation makes or takes from outside."""
    shapes = [shape for line in lines[1:] for shape in re.findall(r"\b(\w+)\[([\d,]+)\]", line.split(", metadata")[0])]
    return max(SIZES[kind] * int(np.prod([int(x) for x in size.split(",")])) for kind, size in shapes if kind in SIZES)


@pytest.fixture
def ordinary(monkeypatch):
    """Programs of operations, as those of what is too long for one call, instead of one call for few samples."""
    monkeypatch.setattr(_one_call, "IN_CALLS", False)


def test_loops_of_one_motion_have_small_arrays(ordinary):
    """XLA runs the operations of such a loop one after the other, without its scheduler."""
    scene, (q, v) = scenes.andrews(), scenes.andrews.start()
    ts = jnp.linspace(0.0, 0.01, 8)

    def run(q, v):
        return jd.simulate(scene, q, v, ts, solver=diffrax.Dopri8(), throw=False).q

    text = jax.jit(run).lower(q, v).compile().as_text() or ""
    steps = [lines for lines in loops(text) if any("diffeqsolve" in line for line in lines)]
    assert len(steps) > 3  # over the steps, the stages and the save points among them
    assert max(map(largest, steps)) <= _SMALL


@pytest.fixture
def kernels(monkeypatch, ordinary):
    """Batches of any size take all stages in one kernel; the list says for each program whether there was one."""
    made = []

    def noted(*args, **options):
        made.append(kernel_of(*args, **options))
        return made[-1]

    monkeypatch.setattr(explicit, "LEAST_BATCH", 1)
    monkeypatch.setattr(explicit, "kernel_of", noted)
    return made


def batch(scene, start, size=3):
    """States close to a start, and programs of their motions: both ways, without a cache between them."""
    q, v = (jnp.asarray(x, float) for x in start)
    # Of constraints that move with time, only the velocity as it is satisfies them.
    moving = bool(scene.constraints) and bool(jnp.any(velocity_residual(scene, q, jnp.zeros_like(v)) != 0))
    spread = 0.0 if moving else 0.01
    vs = v[None] * (1 + spread * jnp.arange(float(size))[:, None])
    ts = jnp.linspace(0.0, 0.4, 5)

    def one(v):
        return jd.simulate(scene, q, v, ts, solver=diffrax.Dopri5(), stepsize=0.02, throw=False)

    return one, vs


CASES = {
    "free body": lambda: (scenes.free_body(), scenes.free_body.start()),
    "disk": lambda: (scenes.rolling_disk(), scenes.rolling_disk.start()),
    "car axis": lambda: (scenes.car_axis(), scenes.car_axis.start()),
    "four-bar": lambda: (scenes.four_bar(), scenes.four_bar.start()),
    "dependent rows": lambda: (twice(scenes.rolling_disk()), scenes.rolling_disk.start()),
}


def twice(scene):
    """A disk whose rows are written down a second time."""
    (rolling,) = scene.constraints
    return Scene(scene.system, (rolling, jd.Pfaffian(rolling.A, name="again")))


@pytest.mark.parametrize(
    "case", [pytest.param(name, marks=[pytest.mark.slow] * (name not in ("free body", "disk"))) for name in CASES]
)
def test_stages_at_once_are_those_in_turn(case, kernels):
    one, vs = batch(*CASES[case]())
    found = jax.jit(jax.vmap(one))(vs)
    assert any(kernel is not None for kernel in kernels)
    explicit.LEAST_BATCH = 1 << 30
    wanted = jax.jit(jax.vmap(one))(vs)
    assert bool(found.success.all()) and bool(wanted.success.all())
    np.testing.assert_allclose(found.q, wanted.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.v, wanted.v, rtol=0, atol=1e-12)


def test_derivatives_are_those_of_stages_in_turn(kernels):
    one, vs = batch(*CASES["free body"]())

    def end(v):
        return jnp.sum(one(v).q[-1, :2] ** 2)

    found = jax.jit(jax.vmap(jax.grad(end)))(vs)
    explicit.LEAST_BATCH = 1 << 30
    wanted = jax.jit(jax.vmap(jax.grad(end)))(vs)
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)
    assert np.abs(wanted).max() > 0.01
