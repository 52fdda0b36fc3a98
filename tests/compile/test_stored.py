"""What is kept on disk between processes: keys, programs and executables."""

import concurrent.futures
import json
import os
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.compile import disk, entry_point, executables, jax_adapter, stored, trace
from jaxdyn.compile.fingerprint import NoFingerprint, fingerprint

GAIN = 2.0


@pytest.fixture(autouse=True)
def user_code(monkeypatch):
    """Functions of these tests are hashed as those of the package."""
    monkeypatch.setattr(sys.modules["jaxdyn.compile.fingerprint"], "hashes_user_code", True)


def by_global(x):
    return GAIN * x


def with_default(x, gain=2.0):
    return gain * x


def closure(gain):
    return lambda x: gain * x


class Law:
    """A callable with a state, as users write them."""

    def __init__(self, gain):
        self.gain = gain

    def __call__(self, x):
        return self.gain * x


def module_of(gain):
    """A module of the user's own, in a file beside the script."""
    module = types.ModuleType("my_gains")
    module.__file__ = "/home/user/my_gains.py"
    module.__dict__["gain"] = gain
    return module


def reading(module):
    """A function that reads a module by its global name."""
    scope = {"gains": module, "__name__": "__main__"}
    exec("def law(x):\n    return gains.gain * x", scope)
    return scope["law"]


def test_the_hash_follows_what_a_function_reads(monkeypatch):
    before = fingerprint(by_global)
    assert fingerprint(by_global) == before
    monkeypatch.setitem(globals(), "GAIN", 3.0)
    assert fingerprint(by_global) != before
    before = fingerprint(with_default)
    monkeypatch.setattr(with_default, "__defaults__", (3.0,))
    assert fingerprint(with_default) != before
    for make in (closure, Law, lambda gain: reading(module_of(gain)), lambda gain: jax.jit(closure(gain))):
        assert fingerprint(make(2.0)) == fingerprint(make(2.0)) != fingerprint(make(3.0))
    assert fingerprint(lambda x: x + 1) != fingerprint(lambda x: x - 1)


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
    "law",
    [
        lambda x: x * float(os.environ.get("GAIN", "1")),
        lambda x: x * float(open("gain").read()),
        lambda x: x * np.loadtxt("gain"),
        lambda x: x * np.random.rand(),  # noqa: NPY002
        lambda x: x * json.loads("1"),
        concurrent.futures.ThreadPoolExecutor(1).submit,
    ],
)
def test_what_may_read_more_than_its_arguments_is_not_kept(law):
    with pytest.raises(NoFingerprint):
        fingerprint(law)
    assert stored.key_of(law) is None


def test_keys_cover_the_package_the_versions_and_the_options(monkeypatch, tmp_path):
    before = stored.key_of(by_global)
    assert stored.key_of(by_global) == before
    with jd.compilation("plain"):
        assert stored.key_of(by_global) != before
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " ")
    assert stored.key_of(by_global) != before
    monkeypatch.undo()
    with jax.enable_x64(False):
        assert stored.key_of(by_global) != before
    environment = stored.environment.__wrapped__
    assert environment() == stored.environment()
    monkeypatch.setattr(disk, "version_of", lambda name: "0" if name == "jax" else "")
    assert environment() != stored.environment()
    (tmp_path / "module.py").write_text("A = 1")
    first = disk.hash_of_sources.__wrapped__(tmp_path)
    (tmp_path / "module.py").write_text("A = 2")
    assert disk.hash_of_sources.__wrapped__(tmp_path) != first


# --- executables ---


@pytest.fixture
def folder(tmp_path):
    """A folder of its own for what is kept."""
    before = disk._folder, disk._is_off
    disk.set_cache_folder(tmp_path / "kernels")
    yield tmp_path / "kernels"
    disk._folder, disk._is_off = before


def forget():
    """Forget what this process has compiled, as a new one."""
    executables._find.cache_clear()
    trace._trace_program.cache_clear()


@entry_point
def accelerate(scene, q, v):
    return {"acceleration": jd.constrained_dynamics(scene, q, v).acceleration, "name": "four-bar"}


@pytest.mark.long
def test_an_entry_point_is_found_again(folder, monkeypatch):
    scene, (q, v) = jd.scenes.four_bar(), jd.scenes.four_bar.start()
    saved, made = [], executables._save
    monkeypatch.setattr(executables, "_save", lambda *args: saved.append(args) or made(*args))
    first = accelerate(scene, q, v)
    (path,) = folder.glob("*.executable")
    forget()
    again = accelerate(scene, q, v)
    assert len(saved) == 1 and again["name"] == "four-bar"
    assert (again["acceleration"] == first["acceleration"]).all()  # the same machine code
    good = path.read_bytes()
    for damaged in (good[:-1], good[: len(good) // 2] + b"x" + good[len(good) // 2 + 1 :], b""):
        path.write_bytes(damaged)
        forget()
        assert (accelerate(scene, q, v)["acceleration"] == first["acceleration"]).all()
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
    first = accelerate(scene, q, v)["acceleration"]
    script = """
import sys, jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
import jaxdyn as jd
import jaxdyn.compile
from test_stored import accelerate
sys.modules["jaxdyn.compile.fingerprint"].hashes_user_code = True
scene, (q, v) = jd.scenes.four_bar(lengths=(1.0, 3.1, 2.5, 3.5)), jd.scenes.four_bar.start()
print([float(x).hex() for x in accelerate(scene, q, v)["acceleration"]])
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


def test_code_of_users_is_not_kept_by_default(monkeypatch):
    monkeypatch.setattr(sys.modules["jaxdyn.compile.fingerprint"], "hashes_user_code", False)
    assert stored.key_of(jd.constrained_dynamics, jd.scenes.four_bar()) is not None
    assert stored.key_of(by_global) is stored.key_of(Law(2.0)) is None


def test_callbacks_are_not_kept(folder):
    seen = []

    @entry_point
    def double(x):
        return jax.pure_callback(lambda y: seen.append(0) or 2 * np.asarray(y), jax.ShapeDtypeStruct((), x.dtype), x)

    assert double(jnp.asarray(1.5)) == 3.0 and seen
    assert not list(folder.glob("*.executable"))


def test_a_folder_that_cannot_be_written(tmp_path, caplog):
    before = disk._folder, disk._is_off
    (tmp_path / "file").write_text("no folder")
    try:
        disk.set_cache_folder(tmp_path / "file" / "kernels")
        forget()
        assert entry_point(lambda x: 2 * x)(jnp.asarray(1.5)) == 3.0
        assert entry_point(lambda x: 3 * x)(jnp.asarray(1.5)) == 4.5
    finally:
        disk._folder, disk._is_off = before
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
