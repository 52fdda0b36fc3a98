"""Kernels of mechanics: their operations, exported programs, other devices, and who imports the compiler's names."""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compile.kernel_helpers import root, root_derivatives
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from benchmarks.operations import operations
from jaxdyn.compile import target

pytestmark = pytest.mark.native

PACKAGE = Path(jd.__file__).parent
MODULES = "known", "batch", "kernels"
RNG = np.random.default_rng(0)


def normal(*shape):
    return jnp.asarray(RNG.normal(size=shape))


def test_models_known_and_given_move_alike():
    """A mechanism compiled in, and as an argument: kernels of fewer and of more operations, the same accelerations."""
    model = jd.robots.chain(3)
    q, v, tau = normal(3), normal(3), normal(3)
    acceleration = jax.jit(lambda q, v, tau: jd.forward_dynamics(model, q, v, tau))(q, v, tau)
    given = jax.jit(jd.forward_dynamics)(model, q, v, tau)
    assert_close(given, acceleration, 1e-12)
    with jd.compilation("plain"):
        plain = quick(lambda q, v, tau: jd.forward_dynamics(model, q, v, tau))(q, v, tau)
    assert_close(acceleration, plain, 1e-11)

    def program_of(function, *args):
        return next(e for e in jax.make_jaxpr(function)(*args).eqns if "kernel" in e.primitive.name).params["program"]

    model, q, v, tau = jd.robots.iiwa(), *[jnp.zeros(7)] * 3
    known = program_of(lambda q, v, tau: jd.forward_dynamics(model, q, v, tau), q, v, tau)
    assert known.cost < 0.8 * program_of(jd.forward_dynamics, model, q, v, tau).cost
    text = jax.jit(lambda *x: jd.forward_dynamics(model, *x)).lower(q, v, tau).as_text()
    assert text.count("custom_call") == 1 and "dot_general" not in text


def test_operations_of_the_kernels_of_a_function_are_counted():
    model = jd.robots.iiwa()
    counted = operations(lambda *x: jd.forward_dynamics(model, *x), *[jnp.zeros(7)] * 3)
    # Nothing depends on the first joint's angle, about the direction of gravity.
    assert counted and 800 < counted.all < 1200 and counted.functions == 2 * 6
    assert operations(lambda q: q + 1, jnp.zeros(7)) is None


def test_another_device_gets_operations():
    model = jd.robots.iiwa()
    traced = jax.jit(lambda *x: jd.forward_dynamics(model, *x)).trace(*[jnp.zeros(7)] * 3)
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert "jaxdyn_kernel" not in text and "stablehlo.multiply" in text


def test_exported_programs_of_a_batch_of_any_size():
    """Without kernels and with them, and where samples are solved again one by one (`kernel`'s fallback)."""
    model = jd.robots.chain(2)
    scene = jd.Scene(model, (jd.constraints.gear(model.joint_names[1], model.joint_names[0], 2.0),))

    def both(q, v):
        return jd.forward_dynamics(model, q, v, v), jd.constrained_dynamics(scene, q, v).acceleration

    (size,) = jax.export.symbolic_shape("n")
    batch = jax.ShapeDtypeStruct((size, 2), jnp.float64)
    allowed = [jax.export.DisabledSafetyCheck.custom_call(target.TARGET)]
    run = jax.jit(jax.vmap(both))
    exported = jax.export.export(run, disabled_checks=allowed)(batch, batch)
    q = np.linspace(0.1, 0.9, 6).reshape(3, 2)
    wanted = run(q, q[::-1])
    for n in (1, 3):
        for computed, known in zip(exported.call(q[:n], q[::-1][:n]), wanted, strict=True):
            np.testing.assert_allclose(computed, known[:n], rtol=1e-13, atol=1e-13)


@pytest.mark.long
def test_without_jit_kernels_are_still_compiled():
    model, state = jd.robots.chain(2), (jnp.ones(2), jnp.zeros(2))

    def results():
        motion = jd.simulate(model, *state, [0.0, 0.05], stepsize=0.05)
        return jd.forward_dynamics(model, *state, jnp.zeros(2)), motion.q

    known = results()
    with jax.disable_jit():
        computed = results()
    for x, y in zip(computed, known, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-13)


def test_others_import_the_names_of_the_package_alone():
    """Modules of `jaxdyn.compile` are its own affair, and so are those of JAX that it needs, which others do not need.

    Those for others are `MODULES`. `jaxdyn.exports`, which writes code of its own, and `jaxdyn.scale` are the exceptions.
    """
    names = {alias.asname or alias.name for node in ast.parse((PACKAGE / "compile/__init__.py").read_text()).body
             for alias in getattr(node, "names", ())}  # fmt: skip
    wrong = []
    for path in PACKAGE.rglob("*.py"):
        inside, exports = PACKAGE / "compile" in path.parents, path.parent in (PACKAGE / "exports", PACKAGE / "scale")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                used = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                used = [f"{node.module}.{alias.name}" for alias in node.names]
            else:
                continue
            for name in used:
                if inside:
                    fine = not name.startswith("jaxdyn") or name.startswith(("jaxdyn.compile.", "jaxdyn.trace_context"))
                elif name.startswith("jaxdyn.compile."):
                    fine = exports or name.split(".")[2] in {*names, *MODULES}
                else:
                    fine = not name.startswith(("llvmlite", "jax.ffi"))
                if not fine:
                    wrong.append(f"{path.relative_to(PACKAGE)}: {name}")
    assert not wrong, wrong


@pytest.mark.long
def test_energies_of_lagrangian_systems():
    """Kinetic energy with a metric sinc q: half of the metric's second derivative. Acceleration along a rail given by a root."""
    system = jd.LagrangianSystem(lambda q, v: 0.5 * v @ v * jnp.sinc(q[0]), 1)

    def energy(x):
        return jd.kinetic_energy(system, jnp.stack([x]), jnp.ones(1))

    for second in (jax.grad(jax.grad(energy)), jax.jacfwd(jax.jacfwd(energy)), jax.hessian(energy)):
        assert_close(second(0.0), -(np.pi**2) / 6, 1e-12)
    # With L = v^2/2 - 9.81 h(q) the acceleration is -9.81 h', whose two derivatives are those of the height.
    rail = jd.LagrangianSystem(lambda q, v: 0.5 * v @ v - 9.81 * root(q)[0], 1)

    def accelerate(x):
        return jd.forward_dynamics(rail, jnp.stack([x]), jnp.ones(1), jnp.zeros(1))[0]

    _, first, second, third = root_derivatives(0.8)
    assert_close(accelerate(0.8), -9.81 * first, 1e-12)
    assert_close(quick(jax.grad(accelerate))(0.8), -9.81 * second, 1e-11)
    assert_close(quick(jax.jacfwd(jax.grad(accelerate)))(0.8), -9.81 * third, 1e-10)
