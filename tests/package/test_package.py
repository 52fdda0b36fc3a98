"""The package as a whole: what imports what, what importing it costs, and the versions it stands on."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn

PACKAGE = Path(jaxdyn.__file__).parent

# Rooms, from the bottom up. A room may use those on floors below its own.
FLOORS = (
    "trace_context",
    "compile lie",
    "model tasks",
    "systems",
    "dynamics",
    "constraints forces geometry",
    "contact reduction",
    "grasp sensors simulation",
    "control identify scenes",
    "exports io reports scale",
    "pictures",
    "cli demo",
    "__main__",
)
RANK = {name: rank for rank, floor in enumerate(FLOORS) for name in floor.split()}
PROGRAMS = {"cli", "demo", "__main__"}
FROM_SIMULATION = {name for name, rank in RANK.items() if rank >= RANK["simulation"]}
FILES_AND_PLOTS = {"io", "reports", "pictures"} | PROGRAMS

# Two implementations that check each other share nothing above the kinematics.
INDEPENDENT = [
    ("dynamics.world_frame", "dynamics.recursions"),
    ("dynamics.link_frame", "dynamics.world_frame"),
    ("dynamics.link_frame", "dynamics.recursions"),
    ("dynamics.scans", "dynamics.recursions"),
]

# Who may import what from outside. Packages not named here and not needed by all (LIGHT) are for nobody.
USERS = {
    "llvmlite": {"compile"},
    "diffrax": FROM_SIMULATION,
    "optax": {"identify"} | PROGRAMS,
    "optimistix": {"constraints", "reduction", "simulation", "identify"} | PROGRAMS,
    "matplotlib": FILES_AND_PLOTS,
    "scipy": {"contact", "identify"}
    | FILES_AND_PLOTS,  # a dependency of jax, so always there; not when jaxdyn is imported
    "mujoco": FILES_AND_PLOTS,
    "threadpoolctl": {"identify"},
    "robot_descriptions": {"io"},
    "trimesh": {"io", "pictures"},
    "viser": {"pictures"},
    "xarray": {"simulation", "scale"},
    "zarr": {"scale"},
    "filelock": {"scale"},
    "google_crc32c": {"scale"},
    "tqdm": {"scale"},
    "cloudpickle": {"tasks"},
    "distributed": {"tasks", "cli"},
}
LIGHT = {"equinox", "jax", "jaxtyping", "numpy"}
NEEDED = {"llvmlite", "diffrax", "optax", "optimistix", "scipy", "threadpoolctl"}
OPTIONAL = (USERS.keys() - NEEDED) | {"collada", "xacro"}


def sources() -> dict[str, ast.Module]:
    """The syntax tree of each module, by its dotted name below the package; "" is the package itself."""
    trees = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        # The stub of the package lists what it exports; the module beside it imports that on demand.
        path = path.with_suffix(".pyi") if name == "" else path
        trees[name] = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    return trees


SOURCES = sources()


def imported_names(module: str, tree: ast.Module) -> Iterator[str]:
    """Absolute dotted names of all imports, also those inside functions; `from a import b` gives a.b."""
    path = ["jaxdyn", *module.split(".")] if module else ["jaxdyn"]
    is_package = (PACKAGE.joinpath(*path[1:]) / "__init__.py").exists()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            up = node.level - is_package
            base = [] if node.level == 0 else path[: len(path) - up]
            base += [node.module] if node.module else []
            yield from (".".join([*base, alias.name]) for alias in node.names)


def internal(name: str) -> str | None:
    """The module of jaxdyn that a dotted name means, or None if it is from outside."""
    package, _, rest = name.partition(".")
    if package != "jaxdyn":
        return None
    while rest and rest not in SOURCES:
        rest = rest.rpartition(".")[0]
    return rest


IMPORTS = {module: list(imported_names(module, tree)) for module, tree in SOURCES.items()}
USES = {
    module: {used for name in names if (used := internal(name)) is not None and used != module}
    for module, names in IMPORTS.items()
}


def top(module: str) -> str:
    return module.partition(".")[0]


def reachable(module: str) -> dict[str, str]:
    """Every module that `module` imports, directly or through others, each with the module that imports it."""
    computed: dict[str, str] = {}
    stack = [module]
    while stack:
        current = stack.pop()
        for used in USES[current] - computed.keys():
            computed[used] = current
            stack.append(used)
    return computed


def test_package_is_typed():
    assert (PACKAGE / "py.typed").exists()


def test_rooms_use_those_below():
    """Every module is in a room, a room uses rooms on floors below its own alone, and not too many of them."""
    assert {top(module) for module in SOURCES} == {"", *RANK}
    arrows = {
        (top(module), top(used))
        for module, names in USES.items()
        for used in names
        if top(used) not in ("", top(module))
    }
    wrong = [f"{room} uses {used}" for room, used in arrows if room and RANK[used] >= RANK[room]]
    assert not wrong, "\n".join(sorted(wrong))
    assert len([room for room, _ in arrows if room]) < 6 * len(RANK)  # more would make rooms meaningless


def test_imports_have_no_cycle():
    cycles = [f"{module} <- {reachable(module)[module]}" for module in SOURCES if module in reachable(module)]
    assert not cycles, "\n".join(cycles)


def test_only_programs_import_the_package_itself():
    wrong = [module for module, used in USES.items() if "" in used and top(module) not in PROGRAMS]
    assert not wrong, f"import the modules that hold the names, not `jaxdyn`: {wrong}"


@pytest.mark.parametrize(("one", "other"), INDEPENDENT)
def test_implementations_that_check_each_other_are_independent(one, other):
    assert {one, other} <= SOURCES.keys()
    pairs = [(a, b) for a, b in ((one, other), (other, one)) if b in reachable(a)]
    assert not pairs


def test_outside_packages_stay_where_they_belong():
    everybody = LIGHT | set(sys.stdlib_module_names) | {"jaxdyn", "__future__"}
    wrong = [
        f"{module or 'jaxdyn'} imports {name}"
        for module, names in IMPORTS.items()
        for name in names
        if (package := top(name)) not in everybody and top(module) not in USERS.get(package, FILES_AND_PLOTS)
    ]
    assert not wrong, "\n".join(wrong)


# Programs that run in a fresh interpreter, by what they show.
PROGRAMS_ALONE = {
    # No optional or heavy package, and no array made before the user chooses devices and dtype.
    "import is light and leaves jax unconfigured": """
import sys
import jaxdyn
heavy = {"diffrax", "equinox", "lineax", "llvmlite", "matplotlib", "optax", "optimistix", "scipy"} & sys.modules.keys()
assert not heavy, f"importing jaxdyn imports {heavy}"
assert dir(jaxdyn) == sorted(jaxdyn.__all__)
for name in jaxdyn.__all__:
    getattr(jaxdyn, name)
heavy = {"matplotlib", "mujoco", "optax", "scipy", "trimesh", "viser", "xarray", "zarr"} & sys.modules.keys()
assert not heavy, f"names of jaxdyn import {heavy}"
import jax
try:
    jax.config.update("jax_num_cpu_devices", 3)
except RuntimeError:
    raise SystemExit("importing jaxdyn runs jax: a module makes an array or calls a jax function when it is imported")
assert not jax.config.jax_enable_x64
""",
    # Every module but the command and the one that Dask's workers import, as after `pip install jaxdyn`.
    "modules import without optional packages": f"""
import importlib, pkgutil, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted(OPTIONAL)}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
import jaxdyn
for module in pkgutil.walk_packages(jaxdyn.__path__, "jaxdyn."):
    if module.name not in ("jaxdyn.__main__", "jaxdyn.tasks.worker"):
        importlib.import_module(module.name)
""",
    "dynamics, scenes and readers of mechanisms import no integrator": """
import sys
import jax
import numpy as np
import jaxdyn as jd
model = jd.robots.chain(2)
jd.forward_dynamics(model, np.ones(2), np.ones(2), np.ones(2))
jax.jit(jax.grad(lambda q: jd.potential_energy(model, q)))(np.ones(2, np.float32))
jd.scenes.four_bar()
jd.load
names = {"diffrax", "lineax", "matplotlib", "optax", "optimistix", "scipy", "jaxdyn.simulation"}
assert not names & sys.modules.keys(), names & sys.modules.keys()
""",
    # No module makes a context of JAX, for which JAX would trace every function of the process again.
    "functions that were compiled before the first use stay compiled": """
import jax
import jaxdyn
traced = []
function = jax.jit(lambda x: traced.append(x) or 2 * x)
function(1.0)
for name in jaxdyn.__all__:
    getattr(jaxdyn, name)
import diffrax, optax, optimistix
jaxdyn.simulate(jaxdyn.robots.chain(1), [0.1], [0.0], [0.0, 0.1])
function(1.0)
assert len(traced) == 1
""",
    "names are the same in every order of imports": """
import pickle
import jaxdyn.control
assert jaxdyn.control.OperationalSpace.__name__ == "OperationalSpace"
import jaxdyn.exports.exported
from jaxdyn import Scene, export, solvers
import jaxdyn as jd
assert export is jd.export is jaxdyn.exports.exported.export and solvers is jaxdyn.simulation.solvers
assert pickle.loads(pickle.dumps(jd.simulate)) is jd.simulate and pickle.loads(pickle.dumps(Scene)) is jd.Scene
assert jd.lie.so3 is jd.so3
from jaxdyn import *
assert simulate is jd.simulate and "ast" not in dir(jd)
""",
    # Programs of XLA beside the motion's own are only those that ask XLA for its options (`select_options`).
    "the first simulate compiles one program": """
import jax
import jax._src.compiler as compiler
import numpy as np
import jaxdyn as jd
names, compile_and_load = [], compiler.backend_compile_and_load
def record(backend, module, *args, **options):
    names.append(module.operation.attributes["sym_name"].value)
    return compile_and_load(backend, module, *args, **options)
compiler.backend_compile_and_load = record
scene, start = jd.scenes.four_bar(), jd.scenes.four_bar.start()
for _ in range(2):
    jd.simulate(scene, *start[:2], np.linspace(0.0, 0.1, 3))
assert [name for name in names if "lambda" not in name] == ["jit_smooth_motion"], names
""",
    # They were 141: each operation on numbers of the model was one.
    "a first assembly of a rounded mechanism compiles few programs": """
import jax
import numpy as np
import jaxdyn as jd
bar, events = (1.0, (0.1, 0.0, 0.0), (0.1, 0.1, 0.1)), []
builder = jd.ModelBuilder("four-bar")
builder.add_body("crank", None, "revolute", bar, axis=(0, 0, 1))
builder.add_body("coupler", "crank", "revolute", bar, axis=(0, 0, 1), pose=(0.3, 0.0, 0.0))
builder.add_body("rocker", None, "revolute", bar, axis=(0, 0, 1), pose=(1.0, 0.0, 0.0))
loop = jd.loop("coupler", (0.9, 0.0, 0.0), "rocker", (0.6, 0.0, 0.0))
scene = jd.Scene(builder.build().replace(rounding=5e-5), [loop])
jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: events.append(event))
assert jd.assemble(scene, np.array([0.5, 0.8, 1.6])).success
count = sum(event.endswith("backend_compile_duration") for event in events)
assert 0 < count <= 20, count
""",
}


@pytest.mark.long
@pytest.mark.parametrize("name", PROGRAMS_ALONE)
def test_in_a_new_process(name):
    command = [sys.executable, "-c", PROGRAMS_ALONE[name]]
    done = subprocess.run(command, cwd=PACKAGE.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_functions_and_subpackages_share_no_name():
    """Python binds a subpackage to its name when that is imported."""
    modules = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert not [name for name in modules & set(jaxdyn.__all__) if not isinstance(getattr(jaxdyn, name), ModuleType)]


@pytest.mark.parametrize(("dtype", "rtol"), [(jnp.float64, 1e-14), (jnp.float32, 1e-5)])
def test_jitted_batch_of_40000_rows_equals_eager(dtype, rtol):
    """One matrix times many vectors, then a sum over each.

    jit of jax 0.10.2 gets 23 616 of the 40 000 rows wrong in float64 and 7 000 in float32 (jax-ml/jax#39103). All terms
    are positive, so nothing cancels and the two differ by a few roundings at most.
    """

    def kinetic_energy(omega):
        inertia = jnp.asarray([[3.0, 0.2, 0.1], [0.2, 2.0, 0.3], [0.1, 0.3, 1.0]], dtype)
        return 0.5 * jnp.sum((inertia @ omega) ** 2)

    omega = jax.random.uniform(jax.random.key(0), (40_000, 3), dtype, 0.1, 1.0)
    batched = jax.vmap(kinetic_energy)
    np.testing.assert_allclose(jax.jit(batched)(omega), batched(omega), rtol=rtol)


def test_public_namespaces_list_their_names():
    """`dir` shows public names alone."""
    assert dir(jaxdyn) == sorted(jaxdyn.__all__) and len(jaxdyn.__all__) <= 90
    for name in jaxdyn.__all__:
        namespace = getattr(jaxdyn, name)
        if isinstance(namespace, ModuleType):
            assert not [each for each in dir(namespace) if each.startswith("_") or not hasattr(namespace, each)], name
    with pytest.raises(AttributeError, match="nonsense"):
        _ = jaxdyn.nonsense


def test_one_name_for_one_thing_and_one_thing_by_one_name():
    """A name in several namespaces is one object in all of them, but for what the Lie groups have in common."""
    rooms = [jaxdyn, *(room for name in jaxdyn.__all__ if isinstance(room := getattr(jaxdyn, name), ModuleType))]
    groups = (jaxdyn.so3, jaxdyn.se2, jaxdyn.se3)
    named = [(name, getattr(room, name)) for room in rooms if room not in groups for name in dir(room)]
    objects, names = {}, {}
    for name, value in named:
        if isinstance(value, ModuleType):
            continue  # a namespace is no function: `jd.forces`, `jd.plot.forces`
        objects.setdefault(name, set()).add(id(value))
        names.setdefault(id(value), set()).add(name)
    assert not [name for name, values in objects.items() if len(values) > 1]
    # Numbers and texts may be equal; functions and classes have one name.
    assert not [names[id(value)] for _, value in named if callable(value) and len(names[id(value)]) > 1]
