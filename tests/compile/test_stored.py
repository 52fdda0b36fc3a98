"""What is kept on disk between processes: keys, programs and executables."""

import collections
import concurrent.futures
import functools
import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.compile import disk, entry_point, executables, jax_adapter, stored, target, trace
from jaxdyn.compile.careful import Careful
from jaxdyn.compile.disk import NoFingerprint, fingerprint
from jaxdyn.compile.expansion import expand


def law(x):
    """A function of the user."""
    return 2.0 * x


class Law:
    """A class of the user."""


def test_the_hash_tells_values_apart():
    values = [
        0, 0.0, -0.0, False, None, "", b"", (), [], {}, (0,), (1, 2), ((1,), 2), (1, (2,)), np.zeros(1), jnp.zeros(1),
        np.zeros(1, np.float32), np.zeros((1, 1)), float("nan"), {"a": 1}, {"a": 2}, np.float64(0.0), jnp.asarray(0), ...,
    ]  # fmt: skip
    assert len({fingerprint(x) for x in values}) == len(values)
    one, other = (
        {"scene": make()} for make in (jd.scenes.four_bar, lambda: jd.scenes.four_bar(lengths=(1.0, 3.0, 2.5, 3.6)))
    )
    assert fingerprint(one) != fingerprint(other)
    assert fingerprint(jax.tree.structure(one)) == fingerprint(jax.tree.structure(other))


@pytest.mark.parametrize(
    "value",
    [
        law,
        Law,
        Law(),
        [Law()],
        functools.partial(jnp.sum, law),
        jax.jit(law),
        jax.custom_jvp(law),
        functools.wraps(jnp.sin)(law),
        jax.tree.structure({"a": 1}).node_data,
        concurrent.futures.ThreadPoolExecutor(1).submit,
        np.loadtxt,
        np.random.rand,
        open,
        collections.defaultdict(law),
        np.ma.masked_array([1.0], [True]),
        np.array([law]),
        jax.random.key(0),
    ],
)
def test_what_may_reach_more_than_its_contents_is_not_kept(value):
    with pytest.raises(NoFingerprint):
        fingerprint(value)
    assert stored.key_of(jd.constrained_dynamics, value) is None


def test_keys_cover_the_package_the_versions_and_the_options(monkeypatch, tmp_path):
    def key():
        return stored.key_of(jd.constrained_dynamics, jd.scenes.four_bar())

    before = key()
    assert before is not None and key() == before
    with jd.compilation("plain"):
        assert key() != before
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " ")
    assert key() != before
    monkeypatch.undo()
    with jax.enable_x64(False):
        assert key() != before
    environment = stored.environment.__wrapped__
    assert environment() == stored.environment()
    monkeypatch.setattr(stored.metadata, "version", lambda name: "0")
    assert environment() != stored.environment()
    (tmp_path / "module.py").write_text("A = 1")
    first = disk.hash_of_sources.__wrapped__(tmp_path)
    (tmp_path / "module.py").write_text("A = 2")
    assert disk.hash_of_sources.__wrapped__(tmp_path) != first


# --- executables ---


def forget():
    """Forget what this process has compiled, as a new one."""
    executables._find.cache_clear()
    trace._trace_program.cache_clear()


accelerate = entry_point(jd.constrained_dynamics)


@pytest.mark.long
def test_an_entry_point_is_found_again(folder, monkeypatch):
    scene, (q, v) = jd.scenes.four_bar(), jd.scenes.four_bar.start()
    saved, made = [], executables._save_executable
    monkeypatch.setattr(executables, "_save_executable", lambda *args: saved.append(args) or made(*args))
    first = accelerate(scene, q, v)
    (path,) = folder.glob("*.executable")
    forget()
    again = accelerate(scene, q, v)
    assert len(saved) == 1 and again.result == jd.RESULTS.successful
    assert (again.acceleration == first.acceleration).all()  # the same machine code
    good = path.read_bytes()
    for damaged in (good[:-1], good[: len(good) // 2] + b"x" + good[len(good) // 2 + 1 :], b""):
        path.write_bytes(damaged)
        forget()
        assert (accelerate(scene, q, v).acceleration == first.acceleration).all()
    assert len(saved) == 4
    # Another structure, dtype or batch is another executable; other numbers are not.
    forget()
    accelerate(jd.scenes.four_bar(lengths=(1.0, 3.0, 2.5, 3.6)), q, v)
    assert len(saved) == 4
    accelerate(scene, jnp.asarray(q)[None].repeat(2, 0)[0], v)
    assert len(saved) == 4


@pytest.mark.long
def test_code_that_is_missing_is_made_from_the_function_again(folder):
    scene, (q, v) = jd.scenes.four_bar(lengths=(1.0, 3.1, 2.5, 3.5)), jd.scenes.four_bar.start()
    first = accelerate(scene, q, v).acceleration
    script = """
import sys, jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
import jaxdyn as jd
from test_stored import accelerate
scene, (q, v) = jd.scenes.four_bar(lengths=(1.0, 3.1, 2.5, 3.5)), jd.scenes.four_bar.start()
print([float(x).hex() for x in accelerate(scene, q, v).acceleration])
"""
    env = os.environ | {"XDG_CACHE_HOME": str(folder.parent / "other"), "PYTHONPATH": os.pathsep.join(sys.path)}

    def run():
        command = [sys.executable, "-c", script, os.path.dirname(__file__)]
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    kept = folder.parent / "other" / "jaxdyn" / "kernels"
    # Two processes that write at once, one that reads, and one that finds no machine code.
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        results = list(pool.map(lambda _: run(), range(2)))
    assert list(kept.glob("*.executable")) and not list(kept.glob("*.part"))
    results.append(run())
    for path in kept.glob("*.o"):
        path.unlink()
    results.append(run())
    assert set(results) == {results[0]}
    numbers = [float.fromhex(x) for x in json.loads(results[0].replace("'", '"'))]
    np.testing.assert_allclose(numbers, first, rtol=1e-12)


@pytest.mark.native
@pytest.mark.long
def test_a_run_from_disk_does_not_import_what_makes_it(tmp_path):
    script = """
import sys, jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import jaxdyn as jd
motion = jd.simulate(jd.scenes.four_bar(), *jd.scenes.four_bar.start(), jnp.linspace(0.0, 0.1, 3), stepsize=0.05)
print([float(x).hex() for x in motion.q.ravel()])
print(sorted({"diffrax", "optimistix", "lineax"} & sys.modules.keys()))
"""
    env = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    lines = []
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr[-2000:]
        lines.append(done.stdout.splitlines())
    assert lines[0][0] == lines[1][0]
    assert [x[1] for x in lines] == ["['diffrax', 'lineax', 'optimistix']", "[]"]


def test_a_program_that_is_traced_in_another_order_takes_the_place_of_the_stored_one(folder):
    x = np.linspace(0.1, 0.9, 3)

    def tangent_first(x):
        return [jnp.tan(x) * jnp.sin(x), jnp.sin(x)]

    def sine_first(x):
        y = jnp.sin(x)
        return [jnp.tan(x) * y, y]

    one, other = (expand(jax.make_jaxpr(f)(x), 10**4)[0] for f in (tangent_first, sine_first))
    found = stored.Description.of(one).restore(lambda: other)
    assert found.digest == one.digest != other.digest
    for result, wanted in zip(target.call(found, [x]), sine_first(x), strict=True):
        np.testing.assert_allclose(result, wanted, rtol=1e-15)
    another = expand(jax.make_jaxpr(lambda x, y: [x * y, y])(x, x), 10**4)[0]
    with pytest.raises(RuntimeError, match="traced again"):
        _ = stored.Description.of(one).restore(lambda: another).operations


def test_subprograms_that_are_called_in_another_order(folder):
    x = np.linspace(0.1, 0.9, 3)
    one, other, third = (expand(jax.make_jaxpr(f)(x), 10**4)[0] for f in (jnp.sin, jnp.cos, jnp.tan))
    caller, again, fewer = (expand(jax.make_jaxpr(f)(x), 10**4)[0] for f in (jnp.exp, lambda x: 2 * x, jnp.log))
    caller.subprograms, again.subprograms, fewer.subprograms = (one, other), (other, third), ()
    found = stored.Description.of(caller).restore(lambda: again)
    # The one that is there still, and for the other the one in its place.
    assert stored._subprogram_of(found, 1) is other
    assert stored._subprogram_of(found, 0) is other
    with pytest.raises(RuntimeError, match="traced again"):
        stored._subprogram_of(stored.Description.of(caller).restore(lambda: fewer), 0)


def make_careful(name: str, digest: str) -> Careful:
    """A careful program for sines of three numbers."""
    program = expand(jax.make_jaxpr(lambda x: [jnp.sin(x)])(np.zeros(3)), 10**4, name)[0]
    return Careful(
        program.inputs, program.outputs, digest, name, lambda: program, lambda x: [jnp.sin(x)], "within", True
    )


@pytest.mark.native
def test_a_careful_program_is_traced_again(folder):
    x, kept = np.linspace(0.1, 0.9, 3), make_careful("sines", "careful sines")

    def row(digest):
        made = kept if digest == kept.digest else make_careful("sines", digest)
        return target.number_of(made, 1, (False,)), target.Row.of(made, 1, (False,))

    # Its code is missing: the function is traced again, which enters the program.
    number, entry = row(kept.digest)
    target.restore(number, entry, lambda: target.kernel(kept, 1, [False]))
    np.testing.assert_allclose(target.Call(kept, {})([x])[0], np.sin(x), rtol=1e-15)
    # A function that has another program now.
    number, entry = row("careful sines of another process")
    target.restore(number, entry, lambda: None)
    with pytest.raises(RuntimeError, match=f"sines has another program.*{folder}"):
        target._kernels[number].address()
    again = kept.describe().restore(lambda: expand(jax.make_jaxpr(jnp.cos)(x), 10**4)[0])
    with pytest.raises(RuntimeError, match="traced again"):
        again.program()


GAIN = 2.0


def test_functions_of_users_are_found_by_their_program(folder, monkeypatch):
    saved, made = [], executables._save_executable
    monkeypatch.setattr(executables, "_save_executable", lambda *args: saved.append(args) or made(*args))
    scene, (q, v) = jd.scenes.four_bar(), jd.scenes.four_bar.start()

    def energy(scene, q, v, *, offset=None):
        acceleration = jd.constrained_dynamics(scene, q, v).acceleration
        return {"power": GAIN * acceleration @ v + (0.0 if offset is None else offset), "law": Law}

    def run(*args, **kwargs):
        executables._find.cache_clear()
        return jd.jit(energy)(*args, **kwargs)

    first = run(scene, q, v)
    expected = 2.0 * jd.constrained_dynamics(scene, q, v).acceleration @ v
    np.testing.assert_allclose(first["power"], expected, rtol=1e-12)
    assert run(scene, q, v)["power"] == first["power"] and len(saved) == 1
    assert first["law"] is Law
    monkeypatch.setitem(globals(), "GAIN", 3.0)
    np.testing.assert_allclose(run(scene, q, v)["power"], 1.5 * expected, rtol=1e-12)
    assert len(saved) == 2
    np.testing.assert_allclose(run(scene, q, v, offset=jnp.asarray(1.0))["power"], 1.5 * expected + 1.0, rtol=1e-12)
    assert len(saved) == 3
    # Where it cannot be kept, it is what JAX makes of it.
    np.testing.assert_allclose(jax.vmap(lambda v: run(scene, q, v)["power"])(v[None])[0], 1.5 * expected, rtol=1e-12)
    gradient = jax.grad(lambda v: run(scene, q, v)["power"])
    np.testing.assert_allclose(gradient(v), jax.jit(gradient)(v), rtol=1e-12)
    assert len(saved) == 3


def test_callbacks_are_not_kept(folder, monkeypatch):
    seen = []
    monkeypatch.setattr(stored, "key_of", lambda *_: "key")

    @entry_point
    def double(x):
        return jax.pure_callback(lambda y: seen.append(0) or 2 * np.asarray(y), jax.ShapeDtypeStruct((), x.dtype), x)

    assert double(jnp.asarray(1.5)) == 3.0 and seen
    assert not list(folder.glob("*.executable"))


def test_a_folder_that_cannot_be_written(folder, tmp_path, caplog):
    (tmp_path / "file").write_text("no folder")
    disk.set_cache_folder(tmp_path / "file" / "kernels")
    forget()
    assert entry_point(jd.so3.hat)(jnp.arange(3.0))[1, 0] == 2.0
    assert entry_point(jd.so3.exp)(jnp.zeros(3))[0, 0] == 1.0
    assert caplog.text.count("nothing is kept on disk") == 1


def test_values_that_are_equal_and_of_other_types_are_other_constants():
    fill = entry_point(lambda x, value: jnp.full_like(x, 2.0, dtype=type(value)))
    kinds = {type(value): fill(jnp.zeros(2), value).dtype for value in (True, 1.0, 1)}
    assert kinds == {bool: jnp.bool_, float: jnp.float64, int: jnp.int64}


def test_configuration_is_that_of_this_thread():
    before = jax_adapter.configuration()
    with jax.enable_x64(False):
        assert jax_adapter.configuration() != before
    assert jax_adapter.configuration() == before
