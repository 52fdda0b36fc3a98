"""Settings and fixtures of every test.

Machine code of kernels is kept in a folder of the session, which workers and processes that tests start share.

There is no persistent compilation cache. It was tried: programs with host callbacks (`eqx.error_if`, hence diffrax) are
never stored, what is stored logs machine-feature errors when loaded, and its files are not written atomically.
"""

import gc
import os
import shutil
import tempfile
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any

if os.environ.get("JAXDYN_COMPILATION_OPTIONS") == "least" and "XLA_FLAGS" not in os.environ:
    # As little work for XLA as for LLVM. A flag that XLA does not know ends the process, as that of the emitters does since 0.11.
    flags = ["--xla_backend_optimization_level=0", "--xla_cpu_parallel_codegen_split_count=1"]
    if version("jax") < "0.11":
        flags.append("--xla_cpu_use_fusion_emitters=false")
    os.environ["XLA_FLAGS"] = " ".join(flags)

# A worker for each core: threads of OpenBLAS, which wait in loops, take the time of the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jaxtyping
import pytest

ROOT = Path(__file__).resolve().parent.parent

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# Nobody reads where in the source an operation of a compiled program comes from, and to write it down takes 4 % of the time.
jax.config.update("jax_traceback_in_locations_limit", 0)

# From here on annotations are checked, so this precedes the first import of jaxdyn. Those of `compile/`, whose functions are
# called a million times a test, are left to pyright: checked here they would double the time of many tests.
ROOMS = sorted(
    path.name for path in (ROOT / "jaxdyn").iterdir() if (path / "__init__.py").exists() and path.name != "compile"
)
jaxtyping.install_import_hook([f"jaxdyn.{room}" for room in ROOMS], "beartype.beartype")

# Traces are large graphs of objects that live as long as the process: the collector would walk through them again and again.
gc.set_threshold(200_000, 20, 50)


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("jaxdyn")
    group.addoption("--data", type=Path, default=ROOT.parent / "shared" / "data", help="directory of recorded data")
    group.addoption("--all-robots", action="store_true", help="run the robot tests on every robot, not on a few")
    group.addoption(
        "--cpu-times", type=Path, metavar="FILE", help="append the processor time (s) of each test to this file"
    )
    group.addoption("--compilation", choices=("auto", "plain"), help="run all tests in this mode of jaxdyn.compilation")


def pytest_configure(config: pytest.Config) -> None:
    # Files of others, and what tests make of the kind, hold such inertias.
    config.addinivalue_line("filterwarnings", "ignore:(?s).*No body has such an inertia")
    mode = config.getoption("--compilation")
    if mode is not None:
        os.environ["JAXDYN_COMPILATION"] = mode
    if not hasattr(config, "workerinput"):  # workers of pytest-xdist inherit the environment
        # Matplotlib looks for its list of fonts, which takes seconds to make, in the same place.
        usual = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        os.environ.setdefault("MPLCONFIGDIR", os.path.join(usual, "matplotlib"))
        config.stash[_CACHE] = os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="jaxdyn-tests-")


def pytest_unconfigure(config: pytest.Config) -> None:
    # pytest collects garbage ten times at its end, and Python once more: what a first collection leaves stays to the end.
    gc.collect()
    gc.freeze()
    folder = config.stash.get(_CACHE, None)
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)


_CACHE = pytest.StashKey[str]()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Processor time of a test, its fixtures and the processes that it starts: on a busy machine wall time says little."""
    path, start = item.config.getoption("--cpu-times"), os.times()
    yield
    if path is not None:
        seconds = sum(os.times()[:4]) - sum(start[:4])
        with path.open("a") as file:  # one short line at a time, from each worker
            file.write(f"{seconds:.2f} {item.nodeid}\n")


@pytest.fixture(scope="module", autouse=True)
def few_mappings() -> Iterator[None]:
    """Drop the programs of earlier files before XLA runs out of mappings, of which Linux allows 65530 to a process.

    Each program takes some 27 of them, and XLA ends the process when there are none left.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > 20_000:
        jax.clear_caches()


@pytest.fixture(params=["auto", "plain"])
def mode(request: pytest.FixtureRequest) -> Iterator[str]:
    """Both modes of `jaxdyn.compilation`."""
    import jaxdyn

    with jaxdyn.compilation(request.param):
        yield request.param


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """A folder of its own for what the compiler keeps on disk."""
    from jaxdyn.compile import disk

    before = disk._folder, disk._is_off
    disk.set_cache_folder(tmp_path / "kernels")
    yield tmp_path / "kernels"
    disk._folder, disk._is_off = before


@pytest.fixture
def as_users_have_it() -> Iterator[None]:
    """Without the checks of annotations that the tests put before all functions."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def data_dir(pytestconfig: pytest.Config) -> Path:
    """The directory of recorded data; tests that ask for it carry the marker `data`."""
    directory: Any = pytestconfig.getoption("data")
    if not directory.is_dir():
        pytest.skip(f"no recorded data at {directory}; name its directory with --data")
    return directory


@pytest.fixture(scope="session")
def all_robots(pytestconfig: pytest.Config) -> bool:
    """Whether robot tests run on every robot."""
    return bool(pytestconfig.getoption("all_robots"))


@pytest.fixture(scope="session")
def robots_dir() -> Path:
    """The directory `robots` of example-robot-data, with one directory per robot family."""
    try:
        package = distribution("example-robot-data")
    except PackageNotFoundError:
        pytest.skip("the package example-robot-data is not installed")
    directory = Path(str(package.locate_file("cmeel.prefix/share/example-robot-data/robots")))
    if not directory.is_dir():
        pytest.skip(f"example-robot-data has no directory {directory}")
    return directory
