"""Exported functions: C programs, CasADi's interface, other processors and calls from NumPy, against JAX's own evaluation."""

import ctypes
import json
import os
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.compile import standalone
from jaxdyn.compile.stored import code_of

X = np.linspace(0.1, 0.7, 7)
V, TAU = 0.3 * np.cos(X), np.sin(3 * X)
STATE = tuple(map(jnp.asarray, (X, V, TAU)))
LIBM = {
    "acos", "asin", "atan", "atan2", "cbrt", "ceil", "cos", "cosh", "exp", "exp2", "expm1", "floor", "fmod", "log", "log1p",
    "pow", "rint", "roundeven", "sin", "sincos", "sinh", "tan", "tanh",
}  # fmt: skip


@pytest.fixture(scope="module")
def arm():
    return jd.robots.iiwa()


@pytest.fixture(scope="module")
def exported(arm):
    def function(q, v, tau):
        return jd.forward_dynamics(arm, q, v, tau)

    return jd.export(function, X, V, TAU, name="arm_fd", derivatives=("jacobian",), batch=True)


def compiler() -> str:
    found = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if found is None:
        pytest.skip("no C compiler on this machine")
    return found


def ran(folder, *command) -> str:
    """What a program prints, which ends without an error."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def run_c(folder, name: str, compile_command: list[str] | None = None, runner: tuple[str, ...] = ()) -> str:
    """Build the test program that `save` wrote, run it, and return what it prints."""
    command = compile_command or [compiler(), "-Wall", "-Werror", "-O1"]
    ran(folder, *command, f"{name}_test.c", f"{name}.o", "-lm", "-o", "program")
    return ran(folder, *runner, "./program")


def status_of(exported, *arrays, batch: bool = True) -> int:
    """Call the function in C, or that of batches, with arguments and arrays for its results; the status."""
    code = code_of(exported.module("c", standalone.resolve_target("host").lanes))
    sizes = [ctypes.c_int64] if batch else []
    kind = ctypes.CFUNCTYPE(ctypes.c_int, *sizes, *[ctypes.c_void_p] * len(arrays))
    function = kind(code.address(f"{exported.name}_batch" if batch else exported.name))
    return function(*([len(arrays[0])] if batch else []), *(x.ctypes.data for x in arrays))


def test_calls_from_numpy_equal_the_library(arm, exported):
    np.testing.assert_allclose(exported(X, V, TAU), jd.forward_dynamics(arm, *STATE), rtol=1e-12)
    # The independent answer: inverse dynamics by another recursion gives the torques back.
    np.testing.assert_allclose(jd.inverse_dynamics(arm, *STATE[:2], jnp.asarray(exported(X, V, TAU))), TAU, atol=1e-12)
    assert isinstance(exported(X, V, TAU), np.ndarray)


@pytest.mark.long
def test_jacobian_equals_that_of_plain_jax(arm, exported):
    with jd.compilation("plain"):
        expected = jax.jacrev(lambda q, v, tau: jd.forward_dynamics(arm, q, v, tau), (0, 1, 2))(*STATE)
    for got, reference in zip(exported.jacobian(X, V, TAU), expected, strict=True):
        np.testing.assert_allclose(got, reference, rtol=1e-10, atol=1e-11 * np.abs(reference).max())


def test_test_program_in_c_passes_and_fails_when_it_should(exported, tmp_path):
    exported.save(tmp_path)
    assert "largest relative difference" in run_c(tmp_path, "arm_fd")
    text = (tmp_path / "arm_fd_test.c").read_text()
    first = float(exported(X, V, TAU)[0]).hex()
    assert first in text
    (tmp_path / "arm_fd_test.c").write_text(text.replace(first, float(exported(X, V, TAU)[0] * (1 + 1e-9)).hex()))
    with pytest.raises(AssertionError, match="largest relative difference"):
        run_c(tmp_path, "arm_fd")


def test_header_compiles_as_cplusplus_and_build_file_builds(exported, tmp_path):
    exported.save(tmp_path)
    if shutil.which("c++") is not None:
        (tmp_path / "use.cpp").write_text(
            '#include "arm_fd.h"\nint main() { double x[ARM_FD_SIZE_Q] = {}, a[ARM_FD_SIZE_OUT]; return arm_fd(x, x, x, a); }\n'
        )
        ran(tmp_path, "c++", "use.cpp", "arm_fd.o", "-lm", "-o", "use")
        ran(tmp_path, "./use")
    if shutil.which("cmake") is None:
        pytest.skip("no cmake on this machine")
    for command in ("cmake -S . -B build", "cmake --build build", "./build/arm_fd_test"):
        ran(tmp_path, *command.split())


def undefined_symbols(path) -> set[str]:
    if shutil.which("nm") is None:
        pytest.skip("no nm on this machine")
    return {line.split()[-1] for line in ran(path.parent, "nm", "-u", path).splitlines()}


def test_object_file_needs_nothing_but_libm(exported, tmp_path):
    exported.save(tmp_path)
    assert undefined_symbols(tmp_path / "arm_fd.o") <= LIBM

    def function(x):
        return jnp.arctan2(x, 2.0) + jnp.exp(x)

    jd.export(function, np.ones(2), name="other").save(tmp_path)
    assert undefined_symbols(tmp_path / "other.o") == {"atan2", "exp"}
    assert "atan2, exp" in (tmp_path / "other.h").read_text()


def test_header_names_joints_units_sizes_and_stack(exported, tmp_path):
    text = (exported.save(tmp_path) / "arm_fd.h").read_text()
    assert "q (7,): iiwa_joint_1 [rad]" in text and "iiwa_joint_7 [N m]" in text
    assert "#define ARM_FD_SIZE_TAU 7" in text
    stack = int(text.partition("ARM_FD_STACK_BYTES ")[2].split()[0])
    assert 100 < stack < 10_000


def test_batch_over_vector_lanes_equals_single_samples(exported):
    for n in (0, 1, 3, 13):
        rng = np.random.default_rng(n)
        q, v, tau = (np.ascontiguousarray(rng.normal(size=(n, 7))) for _ in range(3))
        out = np.full((n, 7), np.nan)
        assert status_of(exported, q, v, tau, out) == 0
        expected = np.array([exported(*row) for row in zip(q, v, tau, strict=True)]).reshape(n, 7)
        np.testing.assert_allclose(out, expected, rtol=1e-11, atol=1e-11)


def test_a_model_as_argument_is_a_structure_with_named_fields(arm, tmp_path):
    exported = jd.export(lambda model, q: jd.gravity_force(model, q), arm, X, name="weight")
    np.testing.assert_allclose(exported(arm, X), jd.gravity_force(arm, STATE[0]), rtol=1e-12, atol=1e-12)
    heavier = arm.replace(inertias=2 * arm.inertias)
    np.testing.assert_allclose(exported(heavier, X), 2 * exported(arm, X), rtol=1e-12)
    text = (exported.save(tmp_path) / "weight.h").read_text()
    assert "} weight_model_t;" in text and "double inertias[" in text
    run_c(tmp_path, "weight")


def test_single_precision(tmp_path):
    x = np.array([0.3, 0.4], np.float32)
    exported = jd.export(lambda x: jnp.sin(x) * x[::-1], x, name="single", derivatives="jacobian")
    got = exported(x)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, np.sin(x.astype(float)) * x[::-1], rtol=1e-6)
    slopes = np.diag(np.cos(x) * x[::-1]) + np.diag(np.sin(x))[:, ::-1]
    np.testing.assert_allclose(exported.jacobian(x)[0], slopes, rtol=1e-6)
    assert "const float x[2]" in (exported.save(tmp_path) / "single.h").read_text()
    run_c(tmp_path, "single")


@pytest.mark.long
def test_constrained_dynamics_and_projections(tmp_path):
    scene = jd.scenes.four_bar()
    q, v = map(np.asarray, jd.scenes.four_bar.start())

    def function(q, v, tau):
        dynamics = jd.constrained_dynamics(scene, q, v, tau)
        return dynamics.acceleration, dynamics.multipliers

    tau = np.array([1.0, 0.0, 0.5])
    exported = jd.export(function, q, v, tau, name="four_bar", derivatives=("jacobian",))
    a, lam = exported(q, v, tau)
    here, moving = jnp.asarray(q), jnp.asarray(v)
    M, h = jd.mass_matrix(scene.system, here), jd.bias_force(scene.system, here, moving)
    A = jd.constraint_jacobian(scene, here)
    np.testing.assert_allclose(M @ a + h, tau + A.T @ lam, atol=1e-11)  # the equations themselves
    exported.save(tmp_path)
    run_c(tmp_path, "four_bar")

    projection = jd.export(lambda q: jd.constraints.projections(scene, q).P_T, q, name="projection")(q)
    np.testing.assert_allclose(projection @ projection, projection, atol=1e-12)


def acceleration_of(scene):
    def function(q, v, tau):
        return jd.constrained_dynamics(scene, q, v, tau).acceleration

    return function


def crossing():
    """q0^2 = q1^2: two lines that cross at the origin, where the row vanishes."""
    return jd.Scene(jd.scenes.planar_arm().system, [jd.Holonomic(lambda q, t: jnp.stack([q[0] ** 2 - q[1] ** 2]))])


@pytest.mark.long
def test_samples_where_rows_lose_rank_are_computed_by_the_pseudo_inverse():
    scene, q = crossing(), np.array([0.5, 0.5])
    function = acceleration_of(scene)
    exported = jd.export(function, q, q * 0, q, name="crossing", batch=True, derivatives="jacobian")
    x, zero = jnp.asarray(q), jnp.zeros(2)
    np.testing.assert_allclose(exported(q, q * 0, q), function(x, zero, x), rtol=1e-12)
    # The origin: there is no row, so that the motion is free.
    at_origin = exported(q * 0, q * 0, q)
    np.testing.assert_allclose(at_origin, jd.forward_dynamics(scene.system, zero, zero, x), rtol=1e-12)
    M = jd.mass_matrix(scene.system, zero)
    np.testing.assert_allclose(exported.jacobian(q * 0, q * 0, q)[2], np.linalg.inv(M), rtol=1e-10)

    rows = np.stack([q, q * 0, q, -q, q * 0]), np.zeros((5, 2)), np.tile(q, (5, 1))
    out = np.full((5, 2), np.nan)
    assert status_of(exported, *rows, out) == 0
    np.testing.assert_allclose(out, [exported(*row) for row in zip(*rows, strict=True)], rtol=1e-11)


def test_rows_that_contradict_each_other_give_a_status(tmp_path):
    # At the origin the velocity asks for 2 v0^2 = 2 v1^2, which no acceleration changes.
    scene, q, v = crossing(), np.zeros(2), np.array([1.0, 0.3])
    exported = jd.export(acceleration_of(scene), q + 0.5, v * 0, q, name="crossing")
    assert jd.constrained_dynamics(scene, *map(jnp.asarray, (q, v, q))).result == jd.RESULTS.contradictory_rows
    with pytest.raises(FloatingPointError, match="no regular solution"):
        exported(q, v, q)
    exported.save(tmp_path)
    assert "1 where the sample has no regular solution" in (tmp_path / "crossing.h").read_text()


def test_results_that_are_not_finite_have_a_status(tmp_path):
    exported = jd.export(lambda x: (jnp.log(x), 1 / x), np.zeros(2), name="f", batch=True)
    assert np.isinf(exported(np.zeros(2))[0]).all()
    x, out = np.ones((5, 2)), np.zeros((2, 5, 2))
    assert status_of(exported, x, *out) == status_of(exported, x, *out, batch=False) == 0
    for bad in (0.0, -1.0, np.nan, np.inf):
        x[3, 1] = bad
        assert status_of(exported, x, *out) == status_of(exported, x[3], *out, batch=False) == 2
    exported.save(tmp_path)
    run_c(tmp_path, "f")  # which expects the status at its examples


@pytest.mark.long
def test_redundant_rows(tmp_path):
    """Bennett's linkage: seven degrees of freedom of its tree, more rows than that, one freedom left."""
    scene = jd.scenes.bennett()
    q, v = map(np.asarray, jd.scenes.bennett.start())
    tau, function = np.linspace(1, 2, scene.nv), acceleration_of(scene)
    exported = jd.export(function, q, v, tau, name="bennett", derivatives="jacobian", batch=True)
    a = exported(q, v, tau)
    np.testing.assert_allclose(a, function(*map(jnp.asarray, (q, v, tau))), rtol=1e-11, atol=1e-12)
    # The equations themselves: rows are met, and what is left of the forces does no work on admissible velocities.
    here, moving = jnp.asarray(q), jnp.asarray(v)
    A = jd.constraint_jacobian(scene, here)
    rate = jax.jvp(lambda t: jd.constraint_jacobian(scene, here + t * moving) @ moving, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(A @ a, -rate, atol=1e-9 * np.abs(rate).max())
    left = jd.mass_matrix(scene.system, here) @ a + jd.bias_force(scene.system, here, moving) - tau
    np.testing.assert_allclose(v @ left, 0, atol=1e-10 * np.linalg.norm(v) * np.linalg.norm(left))
    # The derivative by tau is that of a linear function.
    step = exported(q, v, tau + np.eye(scene.nv)[0]) - a
    np.testing.assert_allclose(exported.jacobian(q, v, tau)[2][:, 0], step, rtol=1e-9, atol=1e-12)
    exported.save(tmp_path)
    run_c(tmp_path, "bennett")
    assert undefined_symbols(tmp_path / "bennett.o") <= LIBM
    exported.save(tmp_path, target="cortex-m7")
    assert all(name in LIBM or name.startswith("__aeabi") for name in undefined_symbols(tmp_path / "bennett.o"))


@pytest.mark.long
def test_a_step_of_an_integrator(tmp_path):
    scene = jd.scenes.four_bar()
    q, v = map(np.asarray, jd.scenes.four_bar.start())
    tau = np.linspace(0.5, 1, scene.nv)
    step = jd.stepper(scene, 0.002, substeps=2)
    exported = jd.export(lambda q, v, tau: step((q, v), tau), q, v, tau, name="step")
    for got, expected in zip(exported(q, v, tau), step((q, v), tau), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)
    state = q, v
    for _ in range(50):
        state = exported(*state, tau)
    # The same motion by `simulate`, which steps in a loop.
    motion = jd.simulate(scene, q, v, jnp.asarray([0.0, 0.1]), control=lambda q, v, t: jnp.asarray(tau), stepsize=0.001)
    np.testing.assert_allclose(state[0], motion.q[-1], atol=1e-10)
    np.testing.assert_allclose(state[1], motion.v[-1], atol=1e-9)
    exported.save(tmp_path)
    run_c(tmp_path, "step")


@pytest.mark.long
def test_a_step_with_contacts(tmp_path):
    """A box on four corners that is thrown on the ground, and its impulses, which a loop in the exported code solves."""
    builder = jd.ModelBuilder("box")
    builder.add_body("box", None, "free", (1.0, (0, 0, 0), (0.1, 0.2, 0.15)))
    corners = [(x, y, -0.1) for x in (-0.2, 0.2) for y in (-0.15, 0.15)]
    feet = [jd.contact.ground_contact("box", at, 0.5, restitution=0.3, name=str(i)) for i, at in enumerate(corners)]
    step = jd.stepper(jd.Scene(builder.build(), forces=feet), 0.01, report=True)

    def advance(q, v, tau):
        state, report = step((q, v), tau)
        return *state, jnp.stack([report.forces[str(i)] for i in range(4)])

    q, v = np.array([0, 0, 0.25, 1, 0.1, 0.2, 0.0]), np.array([1.0, 0.2, 0, 0.3, -0.5, 1.0])
    q[3:] /= np.linalg.norm(q[3:])
    exported, compiled = jd.export(advance, q, v, np.zeros(6), name="thrown"), jax.jit(advance)
    touched = 0
    for _ in range(100):
        wanted = [np.asarray(x) for x in compiled(q, v, np.zeros(6))]
        for got, expected in zip(exported(q, v, np.zeros(6)), wanted, strict=True):
            # Half of the digits of forces are those of dependent rows.
            np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-6 if expected.ndim > 1 else 1e-9)
        q, v, forces = wanted
        touched += forces[:, 2].max() > 1.0
    assert touched > 20
    exported.save(tmp_path)
    run_c(tmp_path, "thrown")


@pytest.mark.long
def test_derivatives_of_a_step_with_smoothed_contacts():
    """A ball above and on the ground: values and derivatives by all arguments, smoothing among them, are those of the library."""
    builder = jd.ModelBuilder("ball", gravity=(0, 0, -9.81))
    builder.add_body("rail", None, "prismatic", (0.2, (0, 0, 0), (0.1, 0.1, 0.1)), axis=(1, 0, 0))
    builder.add_body("ball", "rail", "prismatic", (1.0, (0, 0, 0), (0.1, 0.1, 0.1)), axis=(0, 0, 1))
    scene = jd.Scene(builder.build(), forces=[jd.contact.ground_contact("ball", (0, 0, 0), 0.5)])

    def advance(q, v, tau, smoothing):
        return jd.stepper(scene, 0.01, smoothing=smoothing)((q, v), tau)[1]

    v, tau, kappa = np.array([0.3, -0.2]), np.array([0.1, -0.2]), np.array(1e-3)
    exported = jd.export(advance, v, v, tau, kappa, name="ball", derivatives=("jacobian",))
    derivatives = jax.jit(jax.jacrev(advance, (0, 1, 2, 3)))
    for height in (0.001, 0.05):
        given = (np.array([0.0, height]), v, tau, kappa)
        np.testing.assert_allclose(exported(*given), advance(*given), rtol=1e-12)
        found = exported.jacobian(*given)
        for got, expected in zip(found, derivatives(*given), strict=True):
            np.testing.assert_allclose(got.reshape(expected.shape), expected, rtol=1e-9, atol=1e-12)
        # By smoothing too, also of a contact that stays open: by differences.
        ends = [np.asarray(advance(*given[:3], kappa * (1 + sign * 1e-4))) for sign in (1, -1)]
        np.testing.assert_allclose(found[3][:, 0], (ends[0] - ends[1]) / 2e-7, rtol=1e-6)


@pytest.mark.long
def test_a_step_of_an_arm_behind_drives(tmp_path):
    """Drives of first and second order, their states as an argument and a result; steps that end at kinks are refused."""
    forces = jd.forces.FirstOrderDrive(0.01), jd.forces.SecondOrderDrive(80.0, 0.6)
    scene = jd.Scene(jd.robots.chain(2), forces=forces)
    step = jd.stepper(scene, 0.004, substeps=2)
    q, v, tau = np.array([0.3, -0.2]), np.array([0.1, 0.4]), np.array([1.0, -0.5])
    z = np.linspace(-0.3, 0.9, 6)

    options = {"name": "driven", "derivatives": ("jacobian",)}
    exported = jd.export(lambda q, v, z, tau: step((q, v, z), tau), q, v, z, tau, **options)
    for got, expected in zip(exported(q, v, z, tau), step((q, v, z), tau), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-13)
    with jd.compilation("plain"):
        wanted = jax.jacrev(lambda z: step((q, v, z), tau)[1])(jnp.asarray(z))
    np.testing.assert_allclose(exported.jacobian(q, v, z, tau)[1][2], wanted, rtol=1e-9, atol=1e-12)
    options = {"control": lambda q, v, t: jnp.asarray(tau), "stepsize": 0.002, "outputs": ("drive_state",)}
    motion = jd.simulate(scene, q, v, jnp.asarray([0.0, 0.1]), **options)
    state = (q, v, np.asarray(scene.drive_state(jnp.asarray(q), jnp.asarray(v))))
    for _ in range(25):
        state = exported(*state, tau)
    for got, expected in zip(state, (motion.q, motion.v, motion.drive_state), strict=True):
        np.testing.assert_allclose(got, expected[-1], atol=1e-5)  # RK4 against Dopri8
    exported.save(tmp_path)
    run_c(tmp_path, "driven")
    limited = jd.stepper(jd.Scene(scene.system, forces=(*forces, jd.forces.EffortLimits(0.8))), 0.004)
    with pytest.raises(ValueError, match="leave these forces out"):
        jd.export(lambda q, v, z, tau: limited((q, v, z), tau), q, v, z, tau, name="limited")


@pytest.mark.long
def test_jacobians_by_columns_equal_those_that_are_written_out(arm, exported, monkeypatch, tmp_path):
    assert isinstance(exported.derivative.program, standalone.Directions)
    monkeypatch.setattr(standalone, "MAX_WRITTEN_OUT", 10**9)
    options = {"name": "arm_fd", "derivatives": ("jacobian",)}
    written = jd.export(lambda q, v, tau: jd.forward_dynamics(arm, q, v, tau), X, V, TAU, **options)
    for got, expected in zip(written.jacobian(X, V, TAU), exported.jacobian(X, V, TAU), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-12 * np.abs(expected).max())
    written.save(tmp_path)
    run_c(tmp_path, "arm_fd")
    monkeypatch.setattr(standalone, "MAX_WRITTEN_OUT", 0)
    single = [x.astype(np.float32) for x in (X, V)]
    exported = jd.export(lambda x, y: (x * x @ y, jnp.sin(x)), *single, name="single", derivatives="jacobian")
    by_x, by_y = exported.jacobian(*single)[0]
    np.testing.assert_allclose(by_x[0], 2 * single[0] * single[1], rtol=1e-6)
    np.testing.assert_allclose(by_y[0], single[0] ** 2, rtol=1e-6)
    np.testing.assert_allclose(exported.jacobian(*single)[1][0], np.diag(np.cos(single[0])), atol=1e-6)


def test_jax_export_says_what_to_do(arm):
    function = jax.jit(lambda q: jd.gravity_force(arm, q))
    with pytest.raises(ValueError, match=r"jd.compilation\('plain'\), .*jd.export"):
        jax.export.export(function)(STATE[0])
    with jd.compilation("plain"):
        plain = jax.export.export(function)(STATE[0])
    np.testing.assert_allclose(plain.call(STATE[0]), function(STATE[0]), rtol=1e-12, atol=1e-12)


def test_a_lagrangian_and_a_control_law():
    system = jd.LagrangianSystem(lambda q, v: 0.5 * v @ v - jnp.cos(q[0]) * q[1], 2)
    x = np.array([0.3, -0.2])
    exported = jd.export(lambda q, v, tau: jd.forward_dynamics(system, q, v, tau), x, x, x, name="lagrangian")
    # Euler-Lagrange by hand: qdd = tau - dV/dq with V = cos(q0) q1.
    np.testing.assert_allclose(exported(x, x, x), x - [-np.sin(x[0]) * x[1], np.cos(x[0])], rtol=1e-12)


# --- CasADi ---


def in_casadi(exported, folder):
    """The function as a shared library that CasADi calls."""
    casadi = pytest.importorskip("casadi")
    exported.save(folder, abi="casadi")
    name = exported.name
    ran(folder, compiler(), "-shared", "-o", f"{name}.so", f"{name}.o", "-lm")
    return casadi.external(name, str(folder / f"{name}.so"))


@pytest.mark.parametrize("by_columns", [False, True], ids=["written out", "by columns"])
def test_casadi_has_exact_sparse_derivatives(tmp_path, monkeypatch, by_columns):
    casadi = pytest.importorskip("casadi")
    if by_columns:
        monkeypatch.setattr(standalone, "MAX_WRITTEN_OUT", 0)

    def function(x, y):  # x acts on the first entries alone, so that half of the pattern is empty
        return jnp.stack([x[0] * x[1], jnp.sin(x[1]), y[0, 1] ** 2 + y[1, 0]]), y * 2.0

    x, y = np.array([0.3, 0.7]), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    exported = jd.export(function, x, y, name="fn", derivatives=("jacobian",))
    external = in_casadi(exported, tmp_path)
    first, second = external(x, y)
    np.testing.assert_allclose(first.full().ravel(), function(x, y)[0], rtol=1e-14)
    np.testing.assert_allclose(second.full(), 2 * y)
    a, b = casadi.MX.sym("a", 2), casadi.MX.sym("b", 2, 3)
    out = external(a, b)
    slopes = [casadi.jacobian(*pair) for pair in ((out[0], a), (out[0], b), (out[1], b))]
    by_a, by_b, scaling = casadi.Function("J", [a, b], slopes)(x, y)
    assert by_a.sparsity().nnz() == 3 and by_b.sparsity().nnz() == 2 and scaling.sparsity().nnz() == 6
    by_x, by_y = (np.asarray(J) for J in jax.jacobian(lambda x, y: function(x, y)[0], (0, 1))(x, y))
    np.testing.assert_allclose(by_a.full(), by_x, rtol=1e-13, atol=1e-15)
    by_columns = by_y.transpose(0, 2, 1).reshape(3, 6)  # CasADi stacks the columns of a matrix
    np.testing.assert_allclose(by_b.full(), by_columns, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(scaling.full(), 2 * np.eye(6))
    ran(tmp_path, sys.executable, "fn_test.py")


def test_ipopt_holds_an_arm_with_exact_derivatives(arm, exported, tmp_path):
    casadi = pytest.importorskip("casadi")
    external, tau = in_casadi(exported, tmp_path), casadi.MX.sym("tau", 7)
    problem = {"x": tau, "f": casadi.sumsqr(tau), "g": external(X, V, tau)}
    options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.hessian_approximation": "limited-memory"}
    found = casadi.nlpsol("s", "ipopt", problem, options)(x0=np.zeros(7), lbg=0, ubg=0)
    # No acceleration: the torques of gravity and velocities.
    np.testing.assert_allclose(found["x"].full().ravel(), jd.bias_force(arm, *STATE[:2]), rtol=1e-7)


# --- other processors ---


@pytest.mark.parametrize("target", ["x86_64", "x86_64-v3", "x86_64-v4", "aarch64", "cortex-m7", "riscv64", "wasm32"])
def test_every_target_compiles(exported, tmp_path, target):
    exported.save(tmp_path, target=target)
    binary = (tmp_path / "arm_fd.o").read_bytes()
    machines = {"aarch64": 183, "cortex-m7": 40, "riscv64": 243}  # numbers of the ELF specification
    if target == "wasm32":
        assert binary[:4] == b"\0asm"
    else:
        assert binary[:4] == b"\x7fELF" and int.from_bytes(binary[18:20], "little") == machines.get(target, 62)
    if target == "cortex-m7":  # the runtime has no more
        assert all(name in LIBM or name.startswith("__aeabi") for name in undefined_symbols(tmp_path / "arm_fd.o"))


def test_baseline_of_x86_64_runs_here(exported, tmp_path):
    if not standalone.resolve_target("host").triple.startswith("x86_64"):
        pytest.skip("another processor")
    exported.save(tmp_path, target="x86_64")
    run_c(tmp_path, "arm_fd")


def test_aarch64_runs_under_qemu(exported, tmp_path):
    gcc, qemu = shutil.which("aarch64-linux-gnu-gcc"), shutil.which("qemu-aarch64")
    if gcc is None or qemu is None:
        pytest.skip("needs Debian's qemu-user and gcc-aarch64-linux-gnu")
    exported.save(tmp_path, target="aarch64")
    run_c(tmp_path, "arm_fd", [gcc, "-O1", "-static"], (qemu,))


def test_wasm_runs_in_node(exported, tmp_path):
    linker, node = shutil.which("wasm-ld") or shutil.which("wasm-ld-14"), shutil.which("node")
    if linker is None or node is None:
        pytest.skip("needs node and Debian's lld")
    exported.save(tmp_path, target="wasm32")
    ran(tmp_path, linker, "--no-entry", "--export=arm_fd", "--allow-undefined", "arm_fd.o", "-o", "arm_fd.wasm")
    (tmp_path / "run.js").write_text(
        """
        const bytes = require("fs").readFileSync("arm_fd.wasm");
        WebAssembly.instantiate(bytes, {env: {sin: Math.sin, cos: Math.cos}}).then(({instance}) => {
          const at = 65536 + 1024, numbers = new Float64Array(instance.exports.memory.buffer, at, 28);
          JSON.parse(process.argv[2]).forEach((x, i) => numbers[i] = x);
          const status = instance.exports.arm_fd(at, at + 56, at + 112, at + 168);
          console.log(JSON.stringify([status, ...numbers.slice(21)]));
        });
        """
    )
    status, *values = json.loads(ran(tmp_path, node, "run.js", json.dumps([*X, *V, *TAU])))
    assert status == 0
    np.testing.assert_allclose(values, exported(X, V, TAU), rtol=1e-12, atol=1e-12)


def test_maxima_on_cortex_m(tmp_path):
    """LLVM aborts where it expands its own maximum of doubles there; comparisons stand in its place."""
    exported = jd.export(lambda x: (jnp.maximum(x[0], x[1]), jnp.min(x), jnp.clip(x, 0.2, 0.5)), X, name="largest")
    exported.save(tmp_path, target="cortex-m7")
    assert all(name.startswith("__aeabi") for name in undefined_symbols(tmp_path / "largest.o"))
    text = standalone._without_maximum(exported.module())
    assert "@llvm.maximum" not in text and "@llvm.minimum" not in text
    code = code_of(text)
    function = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4)(code.address("largest"))
    for x in (X, -X, X[::-1].copy(), np.where(X > 0.3, np.nan, X)):
        out = [np.zeros(()), np.zeros(()), np.zeros(7)]
        function(x.ctypes.data, *(y.ctypes.data for y in out))
        for got, expected in zip(out, exported(x), strict=True):
            np.testing.assert_array_equal(got, expected)


# --- refusals ---


SEVEN = jax.ShapeDtypeStruct((7,), float)


@pytest.mark.parametrize(
    ("function", "examples", "options", "message"),
    [
        (lambda x: x, (X,), {"name": "for"}, "name is 'for', which is no identifier"),
        (lambda x: x, (X,), {"name": "a b"}, "name is 'a b'"),
        (lambda x: x, (np.arange(3),), {"name": "f"}, "examples: x has dtype int64"),
        (lambda x: x, (X + 1j,), {"name": "f"}, "examples: x has dtype complex128"),
        (lambda x: x > 0, (X,), {"name": "f"}, "function returns arrays of bool"),
        (lambda x: x, (X,), {"name": "f", "derivatives": ("hessian",)}, "derivatives has 'hessian'"),
        (lambda x: jax.pure_callback(np.sin, SEVEN, x), (X,), {"name": "f"}, "it has pure_callback"),
        (lambda x: x[x > 0], (X,), {"name": "f"}, "it has shapes, branches"),
        (lambda x: x if x[0] > 0 else -x, (X,), {"name": "f"}, "it has shapes, branches"),
        (lambda x: jax.lax.complex(x, x), (X,), {"name": "f"}, "array of complex128"),
        (lambda x: jnp.argsort(x), (X,), {"name": "f"}, "it has sort"),
    ],
)
def test_refusals(function, examples, options, message):
    with pytest.raises(ValueError, match=message):
        jd.export(function, *examples, **options)


def test_jacobians_beyond_the_number_of_operations_name_the_fix(monkeypatch):
    exported = jd.export(lambda x: jnp.cumprod(jnp.sin(x)), X, name="wide")
    monkeypatch.setattr(standalone, "MAX_OPERATIONS", exported.value.program.cost + 10)
    with pytest.raises(ValueError, match=r"Jacobian by all 7 numbers .* more than .* operations; .* close over"):
        jd.export(lambda x: jnp.cumprod(jnp.sin(x)), X, name="wide", derivatives=("jacobian",))


def test_names_that_meet_others(tmp_path):
    """Arguments with the name of the result, and with one of <math.h>."""
    jd.export(lambda out, y0: out + y0, X, X, name="add", derivatives="jacobian").save(tmp_path)
    run_c(tmp_path, "add")
    jd.export(lambda a, A: a + A, X, X, name="add").save(tmp_path)
    run_c(tmp_path, "add")


def test_doubles_without_double_precision_are_refused():
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match="x has dtype float64"):
            jd.export(lambda x: 2 * x, X, name="f")
        assert jd.export(lambda x: 2 * x, X.astype(np.float32), name="f")(X.astype(np.float32)).dtype == np.float32
    finally:
        jax.config.update("jax_enable_x64", True)


def test_refusals_of_saving_and_calling(exported, tmp_path):
    with pytest.raises(ValueError, match="target is 'pdp11'"):
        exported.save(tmp_path / "a", target="pdp11")
    with pytest.raises(ValueError, match="abi is 'fortran'"):
        exported.save(tmp_path / "a", abi="fortran")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot be written"):
        exported.save(tmp_path / "file" / "folder")
    assert not (tmp_path / "a").exists()
    with pytest.raises(ValueError, match=r"shape \(3,\), .*\(7,\)"):
        exported(X[:3], V, TAU)
    os.chmod(tmp_path, 0o500)
    if not os.access(tmp_path, os.W_OK):  # root may write everywhere
        with pytest.raises(ValueError, match="cannot be written"):
            exported.save(tmp_path)
    os.chmod(tmp_path, 0o700)
    assert sorted(x.name for x in tmp_path.iterdir()) == ["file"], "nothing is half written"
    with pytest.raises(ValueError, match=r"takes 3 .*given 2"):
        exported(X, V)
    with pytest.raises(ValueError, match="without its Jacobian"):
        jd.export(lambda x: x, X, name="f").jacobian(X)


def test_solutions_of_equations_and_what_to_write_in_place_of_other_factors():
    """LU with pivots is exported; what is not is refused with the function and the remedy."""

    def solved(x, b):
        return jnp.linalg.solve(jnp.sin(jnp.outer(x, jnp.arange(1.0, 5.0))), b)

    x, b = np.array([0.3, 1.1, -0.7, 2.0]), np.array([1.0, -2.0, 0.5, 3.0])
    code = jd.export(solved, x, b, name="solved")
    np.testing.assert_allclose(code(x, b), np.linalg.solve(np.sin(np.outer(x, np.arange(1.0, 5.0))), b), rtol=1e-11)

    def decomposed(x):
        return jnp.linalg.svd(jnp.outer(x, x) + jnp.eye(4), compute_uv=False)

    with pytest.raises(ValueError, match=r"svd, in .*decomposed \(test_export.py:\d+\); decompose"):
        jd.export(decomposed, x, name="decomposed")


@pytest.mark.long
def test_loops_stay_loops_in_exported_code(arm):
    """A `while_loop` of unknown length, and a scan of 300 steps with its Jacobian, against JAX."""
    going, halve = lambda c: c[0] * c[0] - c[1] > 1e-13, lambda c: ((c[0] + c[1] / c[0]) / 2, c[1])
    exported = jd.export(lambda x: jax.lax.while_loop(going, halve, (x, x)), 2.0, name="root")
    for x in (2.0, 9.0, 1e6):
        np.testing.assert_allclose(exported(x)[0], np.sqrt(x), rtol=1e-14)
    step = jd.stepper(arm, 0.001)

    def end(q, v, tau):
        return jax.lax.scan(lambda state, _: (step(state, tau), None), (q, v), None, length=300)[0][0]

    long = jd.export(end, X, V, TAU, name="rollout", derivatives=("jacobian",))
    np.testing.assert_allclose(long(X, V, TAU), jax.jit(end)(*STATE), rtol=1e-12)
    wanted = jax.jit(jax.jacrev(end, argnums=(0, 1, 2)))(*STATE)
    for got, want in zip(long.jacobian(X, V, TAU), wanted, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-10)


def controller_of_a_cart_pole():
    """Five iterations of iterated LQR of a cart-pole with limits, and what it is given for 20 steps."""
    builder = jd.ModelBuilder("cart-pole")
    builder.add_body("cart", None, "prismatic", jd.inertia.box(1.0, (0.2, 0.2, 0.1)), axis=(1, 0, 0))
    builder.add_body("pole", "cart", "continuous", (0.2, (0, 0, -0.5), (0.01, 0.01, 0.0)), axis=(0, 1, 0))
    robot = builder.build()
    motors, advance = robot.selection_matrix(["cart_joint"]), jd.stepper(robot, dt=0.04)

    def upright(x):
        q, v = x
        return 200 * (1 + jnp.cos(q[1])) + 10 * q[0] ** 2 + 10 * v @ v

    def controller(q, v, us):
        plan = jd.control.ilqr(
            lambda x, u: advance(x, motors @ u),
            lambda x, u, k: 0.01 * u @ u + 0.01 * upright(x),
            upright, (q, v), us, limits=(-15.0, 15.0), iterations=5,
        )  # fmt: skip
        return plan.us, plan.cost

    return controller, (np.array([0.1, 2.5]), np.array([0.1, -0.3]), 0.1 * np.ones((20, 1)))


@pytest.mark.long
def test_a_predictive_controller_is_exported():
    """The numbers of JAX. Of its 800 000 operations 30 000 are written: LLVM takes seconds, 50 microseconds for each."""
    controller, given = controller_of_a_cart_pole()
    exported = jd.export(controller, *given, name="controller")
    program = exported.value.program
    assert program.cost > 500_000 and count_written(program, set()) < 40_000
    for got, want in zip(exported(*given), jax.jit(controller)(*map(jnp.asarray, given)), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12)


def count_written(program, seen: set) -> int:
    """Operations that are written as code, those of a loop or subprogram once, however often they are carried out."""
    if program in seen:
        return 0
    seen.add(program)
    parts = [program, *(getattr(program, name, None) for name in ("body", "condition"))]
    called = [x for part in parts for x in getattr(part, "subprograms", ())]
    return sum(len(getattr(part, "operations", ())) for part in parts) + sum(count_written(x, seen) for x in called)
