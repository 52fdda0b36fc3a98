"""What shortens a first call: quick options for XLA, and few programs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

import jaxdyn as jd
from jaxdyn import compile as backend
from jaxdyn.compile import executables, stored

pytestmark = pytest.mark.native


def options(name):
    """A fixture: the environment asks for these options."""

    def in_force(monkeypatch):
        monkeypatch.setenv("JAXDYN_COMPILATION_OPTIONS", name)
        executables.quick_options.cache_clear()
        yield
        executables.quick_options.cache_clear()

    return pytest.fixture(in_force, name=name)


usual = options("usual")  # in which all of this is off
least = options("least")


def native(function):
    return lambda *args: backend.kernel(lambda _, *args: function(*args))((), *args)


# --- code that is made when it is called ---


def test_an_error_of_llvm_is_told_to_who_calls(monkeypatch):
    """It is compiled again at the next call."""
    fails, made = [True], stored.compile_text

    def failing(text, *options):
        if fails[0]:
            raise MemoryError("no room")
        return made(text, *options)

    monkeypatch.setattr(stored, "compile_text", failing)
    monkeypatch.setattr(stored, "find_code", lambda identity: None)
    function = backend.entry_point(native(lambda x: jnp.sin(x) * 1.47474))
    x = jnp.arange(3.0)
    with pytest.raises(jax.errors.JaxRuntimeError, match="not be compiled"):
        jax.block_until_ready(function(x))
    fails[0] = False
    np.testing.assert_allclose(function(x), jnp.sin(x) * 1.47474, rtol=1e-15)


# --- the switch ---


def test_the_environment_turns_the_options_off(usual):
    assert executables.quick_options() is None


def test_both_ways_agree(request):
    """A step of a mechanism with a loop, with all of it and without."""
    scene = jd.scenes.four_bar()

    def function(q, v):
        return jd.constrained_dynamics(scene, q, v, jnp.zeros(scene.nv)).acceleration

    q, v = jnp.asarray([0.4, 0.3, -0.5])[: scene.nv], jnp.zeros(scene.nv)
    quick = backend.entry_point(function)(q, v)
    request.getfixturevalue("usual")
    np.testing.assert_allclose(backend.entry_point(lambda q, v: function(q, v))(q, v), quick, rtol=1e-13, atol=1e-13)


# --- code that compiles fast and runs slowly ---


def test_the_least_optimisation_gives_other_code_and_the_same_numbers(request):
    """Most tests of the package run so, beside references that know nothing of it."""
    model, q = jd.robots.chain(3), jnp.asarray([0.4, 0.3, -0.5])

    def torque(scale):  # of a program of its own for each scale
        scaled = model.replace(gravity=model.gravity * scale)
        return np.asarray(backend.entry_point(native(lambda q: jd.gravity_force(scaled, q)))(q))

    one, key = torque(1.0), stored.name_of_file("a program")
    request.getfixturevalue("least")
    np.testing.assert_allclose(torque(2.0), 2 * one, rtol=1e-14)
    assert stored.name_of_file("a program") != key
    options = executables.quick_options()
    assert options is not None and options["xla_backend_optimization_level"] == 0


def test_long_texts_are_compiled_by_one_pass_to_the_same_numbers(monkeypatch, request):
    """Forward dynamics of an arm, whose text is short, as if it were long."""
    request.getfixturevalue("usual")
    model, q = jd.robots.chain(3), jnp.asarray([0.4, 0.3, -0.5])

    def acceleration():
        function = native(lambda q: jd.forward_dynamics(model, q, 0.1 * q, 0 * q))
        return np.asarray(backend.entry_point(function)(q)), stored.name_of_file("a program")

    usual, key = acceleration()
    monkeypatch.setattr(stored, "LONG_LINES", 0)
    model = model.replace(gravity=model.gravity * (1 + 1e-15))  # a program of its own
    long, other_key = acceleration()
    np.testing.assert_allclose(long, usual, rtol=1e-13)
    assert key != other_key


def test_options_that_do_not_exist_are_refused(monkeypatch):
    monkeypatch.setenv("JAXDYN_COMPILATION_OPTIONS", "fast")
    with pytest.raises(ValueError, match="JAXDYN_COMPILATION_OPTIONS is 'fast'"):
        backend.entry_point(native(lambda x: jnp.sin(x)))(jnp.ones(2))


# --- what is called outside of any trace ---


@pytest.fixture
def programs():
    """Names of what XLA compiles, as it does."""
    names = []

    def seen(event: str, duration_secs: float, **of):
        if event.endswith("backend_compile_duration"):
            names.append(of.get("fun_name"))

    executables.quick_options()
    monitoring.register_event_duration_secs_listener(seen)
    yield names
    monitoring.unregister_event_duration_listener(seen)


def chain(name: str) -> jd.Model:
    """Two bodies and a frame whose numbers are those of no other test."""
    builder = jd.ModelBuilder(name, gravity=(0.0, 0.1, -9.7))
    builder.add_body("one", None, "revolute", (1.3, (0.1, 0.0, 0.2), (0.2, 0.3, 0.25)), pose=(0.0, 0.1, 0.2))
    builder.add_body("two", "one", "revolute", (0.7, (0.3, 0.0, 0.1), (0.1, 0.2, 0.15)), axis=(0.0, 1.0, 0.0))
    return builder.add_frame("hand", "two", (0.1, 0.2, 0.3)).build()


def test_models_are_built_joined_and_repaired_without_a_program(programs):
    model = chain("known")
    both = jd.join(model, model, prefix=("left_", "right_"), pose=(0.0, 1.7, 0.0))
    flat = both.replace(inertias=np.asarray(both.inertias) * np.where(np.arange(10) < 4, 1.0, 0.1))
    assert len(jd.model.inertia_report(flat)) and not jd.model.inertia_report(jd.model.repair_inertias(flat))
    assert programs == []


@pytest.mark.parametrize(
    "of",
    [
        lambda model, q: jd.mass_matrix(model, q),
        lambda model, q: jd.frame_pose(model, q, "hand"),
        lambda model, q: jd.newton_euler_matrices(model, q, q).G,
        lambda model, q: jd.geometry.christoffel_symbols(model, q),
        lambda model, q: jd.geometry.riemann_tensor(model, q),
    ],
)
def test_a_quantity_of_known_numbers_is_one_program(programs, of):
    """Once: a second call compiles nothing."""
    model, q = chain("quantities"), jnp.array([0.31, -0.47])
    programs.clear()
    first = of(model, q)
    assert len(programs) == 1, programs
    programs.clear()
    np.testing.assert_array_equal(of(model, q), first)
    assert programs == []


@pytest.mark.long
def test_degrees_of_freedom_and_rates_are_one_program_each(programs):
    scene, (q, v) = jd.scenes.slider_crank(), jd.scenes.slider_crank.start()
    other = q + 0.01
    programs.clear()
    assert jd.degrees_of_freedom(scene, q) == 1 and jd.degrees_of_freedom(scene, other) == 1
    assert len(programs) <= 2, programs
    programs.clear()
    jd.stiffness(scene, q, v)
    assert len(programs) <= 2, programs
