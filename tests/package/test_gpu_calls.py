"""Calls of kernels for GPUs through XLA's interface, on the CPU: a library of ours stands in for CUDA's driver."""

import logging
import threading
from types import SimpleNamespace

import gpu_stand_in
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.interpreters import mlir
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import jaxdyn as jd
from benchmarks import gpu as benchmark
from jaxdyn import compile as backend
from jaxdyn.compile import gpu as device
from jaxdyn.compile import jax_adapter, mode, primitive
from jaxdyn.compile.gpu import ptx

pytestmark = pytest.mark.native

ARM = jd.robots.ur5()
RNG = np.random.default_rng(0)


FIND_DRIVER = device.driver.__wrapped__  # the fixture puts a stand-in in its place


@pytest.fixture(scope="module")
def of_process():
    """XLA calls kernels for GPUs on the CPU, by a driver that is none."""
    patch, stand_in = pytest.MonkeyPatch(), gpu_stand_in.StandInDriver()
    of_gpus = device.Driver(stand_in)
    usual = jax_adapter.register_handler

    def register_handler(name, address, platform):
        assert platform == "CUDA"
        usual(name, gpu_stand_in.on_cpu(address), "cpu")

    patch.setattr(device, "register_handler", register_handler)
    patch.setattr(device, "driver", lambda: of_gpus)
    patch.setattr(device, "ptx_of", lambda module, architecture: module)
    device.register.cache_clear()
    mlir.register_lowering(primitive.kernel_p, primitive._lower_on_gpu, platform="cpu")
    jax.clear_caches()
    yield stand_in
    mlir.register_lowering(primitive.kernel_p, primitive._lower_to_call, platform="cpu")
    jax.clear_caches()
    device.register.cache_clear()
    device._kernels.clear()
    patch.undo()


@pytest.fixture
def gpu(of_process):
    with jd.compilation("native"):
        of_process.launches.clear()
        of_process.fails = None
        vars(gpu_stand_in.XLA).update(stream=0, device=None, fails=None)
        yield of_process


def dynamics(q, v, tau):
    return jd.forward_dynamics(ARM, q, v, tau)


def states(*batch):
    return [jnp.asarray(RNG.normal(size=(*batch, 6))) for _ in range(3)]


def by_jax(function, *args):
    with jd.compilation("plain"):
        return jax.jit(function)(*args)


def assert_same(computed, wanted, bound=1e-10):
    for x, y in zip(jax.tree.leaves(computed), jax.tree.leaves(wanted), strict=True):
        assert x.shape == y.shape and x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=0, atol=bound * max(1.0, np.abs(y).max(initial=0.0)))


@pytest.mark.parametrize("batch", [(), (1,), (37,), (2, 5), (0,)])
def test_a_batch_is_one_launch(gpu, batch):
    function = dynamics
    for _ in batch:
        function = jax.vmap(function)
    args = states(*batch)
    assert_same(jax.jit(function)(*args), by_jax(function, *args))
    count = int(np.prod(batch))
    assert [launch[1:] for launch in gpu.launches] == ([(-(-count // 32), 32, 1001)] if count else [])


def test_calls_outside_of_jit(gpu):
    args = states()
    assert_same(jd.forward_dynamics(ARM, *args), by_jax(dynamics, *args))
    assert len(gpu.launches) == 1


def test_large_batches_have_large_blocks(gpu):
    x = jnp.asarray(RNG.normal(size=(4096, 2)))
    gpu.registers = 200
    call = jax.jit(jax.vmap(lambda x: backend.kernel(lambda _, x: 2 * x)((), x)))
    np.testing.assert_array_equal(call(x), 2 * x)
    gpu.registers = 80
    assert gpu.launches[-1][1:3] == (64, 64)


def test_shared_arguments_gradients_and_loops_around_kernels(gpu):
    q, v, tau = states(3)
    shared = jax.vmap(dynamics, (0, 0, None))
    assert_same(jax.jit(shared)(q, v, tau[0]), by_jax(shared, q, v, tau[0]))
    gradient = jax.vmap(jax.grad(lambda *x: jnp.sum(dynamics(*x) ** 2), (0, 1, 2)))
    assert_same(jax.jit(gradient)(q, v, tau), by_jax(gradient, q, v, tau))

    def steps(q, v):
        def step(carry, _):
            q, v = carry
            a = jax.vmap(dynamics)(q, v, jnp.zeros_like(q))
            return (q + 1e-3 * v, v + 1e-3 * a), q

        return lax.scan(step, (q, v), length=5)

    gpu.launches.clear()
    assert_same(jax.jit(steps)(q, v), by_jax(steps, q, v))
    assert len(gpu.launches) == 5


def test_a_whole_motion_is_one_launch(gpu):
    ts = np.linspace(0.0, 0.02, 3)

    def end(q, v):
        return jd.simulate(ARM, q, v, ts, stepsize=1e-2, throw=False).q

    q, v, _ = states(3)
    computed = jax.jit(jax.vmap(end))(q, v)
    with jd.compilation("plain"):
        wanted = jax.jit(jax.vmap(end))(q, v)
    assert_same(computed, wanted)
    names = [x.name for launch in gpu.launches for x in device._kernels.values() if x.functions[0] == launch[0]]
    assert names == ["_begin", "loop of _iterate"]  # however many steps there are


def test_a_model_that_is_an_argument(gpu):
    """Shared by all samples, and one for each of them."""
    q, v, tau = states(4)
    models = jax.tree.map(lambda x: jnp.stack([x] * 4) * 1.0, ARM)

    def of_model(model, *state):
        return jd.forward_dynamics(model, *state)

    for model, axis in ((ARM, None), (models, 0)):
        mapped = jax.vmap(of_model, (axis, 0, 0, 0))
        assert_same(jax.jit(mapped)(model, q, v, tau), by_jax(mapped, model, q, v, tau))
    assert gpu.launches


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"stepsize": 5e-3}])
def test_motions_of_a_mechanism_with_a_loop(gpu, options):
    """Projections, pseudo-inverses and rows of one sample among those of the batch; reverse mode of fixed steps."""
    scene, ts = jd.scenes.four_bar(), np.linspace(0.0, 0.02, 3)
    q, v = (np.repeat(np.asarray(x)[None], 3, 0) for x in jd.scenes.four_bar.start())
    v = np.array([[0.5], [1.0], [2.0]]) * v

    def end(q, v):
        return jd.simulate(scene, q, v, ts, throw=False, **options).q

    functions = [end] if not options else [end, jax.grad(lambda q, v: jnp.sum(end(q, v)[-1] ** 2), 1)]
    for function in functions:
        computed = jax.jit(jax.vmap(function))(q, v)
        with jd.compilation("plain"):
            wanted = jax.jit(jax.vmap(function))(q, v)
        # Two implementations choose steps of their own at the tolerance of the default.
        assert_same(computed, wanted, 1e-9 if options else 1e-6)
    assert gpu.launches


def test_two_devices_load_a_module_each(gpu):
    mesh = Mesh(np.array(jax.devices()[:2]), ("batch",))
    split = PartitionSpec("batch")
    x = jax.device_put(states(8)[0], NamedSharding(mesh, split))
    function = jax.vmap(lambda x: backend.kernel(lambda _, x: x**3 - x)((), x))  # one that no device has loaded
    gpu.loaded.clear()
    over = jax.shard_map(function, mesh=mesh, in_specs=split, out_specs=split)
    assert_same(jax.jit(over)(x), np.asarray(x) ** 3 - np.asarray(x))
    assert sorted(gpu.loaded) == [2001, 2002]
    assert sorted(launch[1:] for launch in gpu.launches) == [(1, 32, 1001), (1, 32, 1002)]
    # Automatic partitioning: each device computes its part, and loads nothing again.
    compiled = jax.jit(function).lower(x).compile()
    assert_same(compiled(x), np.asarray(x) ** 3 - np.asarray(x))
    assert "all-gather" not in compiled.as_text()
    assert len(gpu.loaded) == 2 and len(gpu.launches) == 4


def doubled(factor):
    """A kernel that no other test calls, and that is loaded at its first call."""
    return jax.jit(jax.vmap(lambda x: backend.kernel(lambda _, x: factor * x)((), x)))


def test_streams_of_a_device_share_a_module(gpu):
    call, x = doubled(41.0), jnp.ones((3, 2))
    gpu.loaded.clear()
    for stream in (0, 2, 1):
        gpu_stand_in.XLA.stream = stream
        np.testing.assert_array_equal(call(x), 41.0 * x)
    assert gpu.loaded == [2001]
    assert [launch[3] for launch in gpu.launches] == [1001, 1201, 1101]


def test_threads_that_call_a_new_kernel_load_it_once(gpu):
    call, x, found = doubled(42.0), jnp.ones((3, 2)), []
    compiled = call.lower(x).compile()
    gpu.loaded.clear()
    threads = [threading.Thread(target=lambda: found.append(np.asarray(compiled(x)))) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 6 and all((y == 42.0).all() for y in found)
    assert gpu.loaded == [2001] and len(gpu.launches) == 6


def test_a_kernel_is_loaded_while_another_one_is_made(gpu):
    """Who makes one may wait for results of the thread that loads."""
    compiled, x, found = doubled(43.0).lower(jnp.ones((3, 2))).compile(), jnp.ones((3, 2)), []
    with device._lock:
        thread = threading.Thread(target=lambda: found.append(np.asarray(compiled(x))))
        thread.start()
        thread.join(timeout=60)
        assert found and (found[0] == 43.0).all()
    thread.join()


def test_donated_buffers(gpu):
    q, v, tau = states(9)
    wanted = by_jax(jax.vmap(dynamics), q, v, tau)
    donating = jax.jit(jax.vmap(dynamics), donate_argnums=0)
    assert_same(donating(jnp.copy(q), v, tau), wanted)


STARTING = "cuInit", "cuDriverGetVersion", "cuDeviceGetCount", "cuDeviceGet", "cuDeviceGetAttribute"
LOADING = (
    "cuStreamGetCtx", "cuCtxPushCurrent_v2", "cuModuleLoadDataEx", "cuModuleGetFunction", "cuFuncGetAttribute",
    "cuCtxGetDevice", "cuDeviceGetAttribute", "cuCtxPopCurrent_v2", "cuLaunchKernel",
)  # fmt: skip


@pytest.mark.parametrize("name", LOADING)
def test_errors_of_the_driver_are_errors_of_xla(gpu, name):
    factor = 20.0 + LOADING.index(name)  # a kernel that is not loaded yet
    call, x = doubled(factor), jnp.ones((3, 2))
    gpu.fails = name
    with pytest.raises(jax.errors.JaxRuntimeError, match=f"{name} of .*CUDA_ERROR_OUT_OF_MEMORY"):
        call(x)
    gpu.fails = None
    gpu.contexts.clear()
    np.testing.assert_array_equal(call(x), factor * x)


def test_an_error_without_a_name_has_its_number(gpu, monkeypatch):
    of_gpus = device.driver()
    monkeypatch.setattr(gpu, "fails", "cuGetErrorName")
    assert of_gpus.explain("cuLaunchKernel", 999) == "jaxdyn: cuLaunchKernel of CUDA's driver failed with 999"


def test_the_assembler_says_what_it_refuses(gpu, monkeypatch):
    monkeypatch.setattr(gpu, "refusal", b"ptxas error : line 3")
    with pytest.raises(jax.errors.JaxRuntimeError, match="ptxas error : line"):
        doubled(46.0)(jnp.ones((3, 2)))


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ({"fails": "device"}, "XLA has no answer"),
        ({"fails": "stream"}, "XLA has no answer"),
        ({"device": device.MAX_DEVICES}, "kernels know 64 devices of a process"),
    ],
)
def test_errors_of_xla_and_of_its_devices_are_handed_on(gpu, state, words):
    call, x = doubled(44.0), jnp.ones((3, 2))
    vars(gpu_stand_in.XLA).update(state)
    with pytest.raises(jax.errors.JaxRuntimeError, match=words):
        call(x)
    assert not gpu.launches


def test_a_kernel_of_another_process_is_an_error(gpu):
    call = jax.jit(jax.vmap(lambda x: backend.kernel(lambda _, x: 7.5 * x)((), x)))
    call(x := jnp.ones((3, 2)))
    entries = {number: kernel.entry for number, kernel in device._kernels.items()}
    for entry in entries.values():
        entry.hash = 0
    with pytest.raises(ValueError, match="by another process"):
        call(x)
    for number, entry in entries.items():
        entry.hash, entry.buffers = number, entry.buffers + 1
    with pytest.raises(ValueError, match="another size than"):
        call(x)
    for entry in entries.values():
        entry.buffers -= 1
    np.testing.assert_array_equal(call(x), 7.5 * x)


def test_what_takes_too_much_memory_runs_on_jax_after_a_warning(gpu, caplog):
    def large(_, x):
        def step(y, _):
            y = 0.5 * y + jnp.flip(y)
            return y, y

        rows = lax.scan(step, x, length=500)[1]  # half a megabyte, which the next loop reads
        return lax.scan(lambda total, row: (jnp.maximum(total, row), None), x, rows)[0]

    x = jnp.asarray(RNG.normal(size=(2, 120)))
    with caplog.at_level(logging.WARNING, "jaxdyn"):
        computed = jax.jit(jax.vmap(lambda x: backend.kernel(large)((), x)))(x)
    assert_same(computed, jax.vmap(lambda x: large((), x))(x))
    assert not gpu.launches
    (message,) = [r.message for r in caplog.records]
    assert "bytes of memory for each sample, and a GPU's threads have 65536" in message


def test_a_build_of_llvm_without_the_target_is_unsupported(monkeypatch):
    monkeypatch.setattr(ptx, "_TRIPLE", "nvptx128-nobody-here")
    monkeypatch.setattr(ptx, "_target", ptx._target.__wrapped__)
    with pytest.raises(jax_adapter.Unsupported, match="LLVM has no target"):
        ptx.ptx_of("", 90)


@pytest.mark.parametrize(
    ("options", "fails", "message"),
    [
        *(({}, name, f"^{name} of CUDA's driver failed") for name in STARTING),
        ({"version": 11080}, None, "version 11.8, and kernels need 12.0"),
        ({"capability": (6, 1)}, None, "compute capability 6.1"),
        ({"devices": 0}, None, "sees no device"),
    ],
)
def test_drivers_and_devices_that_do_not_serve_are_unsupported_by_name(options, fails, message, monkeypatch):
    stand_in = gpu_stand_in.StandInDriver(**options)
    stand_in.fails = fails
    monkeypatch.setattr(device, "open_library", lambda: stand_in)
    with pytest.raises(jax_adapter.Unsupported, match=message):
        FIND_DRIVER()


def test_a_driver_without_a_function_is_unsupported():
    missing = "cuModuleLoadDataEx"
    names = {name: getattr(gpu_stand_in.StandInDriver(), name) for name in device._FUNCTIONS if name != missing}
    with pytest.raises(jax_adapter.Unsupported, match=f"no function {missing}"):
        device.Driver(SimpleNamespace(**names))


def test_the_driver_is_found_under_its_names(monkeypatch):
    asked = []

    def find(name, found=()):
        asked.append(name)
        if name not in found:
            raise OSError(name)
        return name

    monkeypatch.setattr(device.ctypes, "CDLL", lambda name: find(name, ["libcuda.so"]))
    monkeypatch.setattr(device.sys, "platform", "linux")
    assert device.open_library() == "libcuda.so" and asked == ["libcuda.so.1", "libcuda.so"]
    monkeypatch.setattr(device.ctypes, "CDLL", find)
    with pytest.raises(jax_adapter.Unsupported, match=r"not installed \(libcuda\.so\.1\)"):
        device.open_library()
    monkeypatch.setattr(device.sys, "platform", "win32")
    with pytest.raises(jax_adapter.Unsupported, match=r"nvcuda\.dll"):
        device.open_library()


def test_without_a_driver_functions_run_on_jax_after_one_warning(caplog, monkeypatch):
    monkeypatch.setattr(device, "driver", FIND_DRIVER)
    monkeypatch.setattr(device, "open_library", refuse)
    monkeypatch.setattr(device, "register", device.register.__wrapped__)
    monkeypatch.setattr(mode, "_said", set())
    with jd.compilation("native"), caplog.at_level(logging.WARNING, "jaxdyn"):
        for n in (2, 3):
            args = [jax.ShapeDtypeStruct((n, 6), jnp.float64)] * 3
            text = jax.jit(jax.vmap(dynamics)).trace(*args).lower(lowering_platforms=("cuda",)).as_text()
            assert "custom_call @jaxdyn" not in text
    assert [r.message for r in caplog.records] == [
        "jaxdyn: functions run on JAX's own operations on GPUs: there is no driver here"
    ]


def refuse():
    raise jax_adapter.Unsupported("there is no driver here")


def test_the_same_jaxpr_runs_on_cpus_and_gpus(gpu):
    traced = jax.jit(jax.vmap(dynamics)).trace(*states(2))
    assert "jaxdyn_cuda_kernel" in traced.lower(lowering_platforms=("cuda",)).as_text()
    with jd.compilation("auto"):
        text = jax.jit(jax.vmap(dynamics)).trace(*states(2)).lower(lowering_platforms=("cuda",)).as_text()
    assert "jaxdyn_cuda_kernel" not in text


@pytest.mark.parametrize("fails", [None, "cuLaunchKernel"])
def test_the_benchmark_compares_and_decides(gpu, monkeypatch, capsys, fails):
    """Also after an error of the driver."""
    functions = {"multiplied": (lambda x: backend.kernel(lambda _, x: 47.0 * x)((), x), (2,))}
    monkeypatch.setattr(benchmark, "functions", lambda *_: functions)
    monkeypatch.setattr(benchmark, "on_gpu", lambda: True)
    gpu.fails = fails
    with jd.compilation("auto"):
        benchmark.measure(["arm"], [64], 1, 2**10, ("auto", "native"))
    printed = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("|")] for line in printed.splitlines() if line.startswith("| arm")]
    assert [row[4] for row in rows] == ["auto", "native"]
    assert rows[1][7] == ("inf" if fails else "0.0e+00")
    assert bool(gpu.launches) != bool(fails)
    if fails:
        assert "arm, multiplied, batch 64, native: JaxRuntimeError" in printed
        assert "not to be the default on this GPU:\narm, multiplied, batch 64: error inf" in printed


def test_export_is_refused_by_name(gpu):
    with pytest.raises(ValueError, match="jaxdyn_cuda_kernel"):
        jax.export.export(jax.jit(jax.vmap(dynamics)), platforms=["cuda"])(*states(2))
