"""JAX of several versions, those of the future included: what jaxdyn uses of it, and what it does where that has changed."""

import ast
import functools
import importlib.util
import logging
import pkgutil
import re
import warnings
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import Primitive

import jaxdyn as jd
from jaxdyn import compile as backend
from jaxdyn.compile import expansion, jax_adapter, kernels, mode, target
from jaxdyn.compile.executables import run_trial

ADAPTER = Path(jax_adapter.__file__)


def names_of_jax(tree: ast.Module) -> set[str]:
    """Dotted names of JAX in a module: what it imports and the attributes of that."""
    local, names = {}, set()
    for node in ast.walk(tree):
        for alias in node.names if isinstance(node, ast.Import | ast.ImportFrom) else ():
            name = f"{node.module}.{alias.name}" if isinstance(node, ast.ImportFrom) else alias.name
            names.add(name)
            whole = alias.asname or isinstance(node, ast.ImportFrom)
            local[alias.asname or alias.name.partition(".")[0]] = name if whole else name.partition(".")[0]
    inner = {node.value for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node not in inner:
            head, _, rest = ast.unparse(node).partition(".")
            names |= {f"{local[head]}.{rest}"} if head in local else set()
    return {name for name in names if name.startswith(("jax.", "jaxlib"))}


# --- names ---

# Names of JAX that the adapter uses, by the page below https://docs.jax.dev/en/latest/ that documents them.
DOCUMENTED = {
    "changelog.html": "jax.__version__",
    "config_options.html": "jax.config",
    "jax-primitives.html": """
        jax.core.ShapedArray jax.interpreters.ad jax.interpreters.ad.Zero
        jax.interpreters.ad.is_undefined_primal jax.interpreters.ad.primitive_jvps
        jax.interpreters.ad.primitive_transposes jax.interpreters.batching
        jax.interpreters.batching.primitive_batchers jax.interpreters.mlir
        jax.interpreters.mlir.register_lowering""",
    "key-concepts.html": "jax.core.Tracer",
    "jaxpr.html": "jax.core.eval_jaxpr",
    "_autosummary/jax.devices.html": "jax.devices",
    "_autosummary/jax.dtypes.float0.html": "jax.dtypes.float0",
    "errors.html": "jax.errors.JaxRuntimeError",
    "jax.experimental.serialize_executable.html": """
        jax.experimental.serialize_executable jax.experimental.serialize_executable.deserialize_and_load
        jax.experimental.serialize_executable.serialize""",
    "jax.extend.core.html": "jax.extend.core.ClosedJaxpr jax.extend.core.Literal jax.extend.core.Primitive",
    "jax.extend.mlir.html": "jax.extend.mlir.dialects.sdy",
    "jax.ffi.html": "jax.ffi.ffi_lowering jax.ffi.pycapsule jax.ffi.register_ffi_target",
    "ffi.html": "jax.ffi.include_dir",
    "_autosummary/jax.jit.html": "jax.jit",
    "jax.lax.html": "jax.lax",
    "_autosummary/jax.lax.pcast.html": "jax.lax.pcast",
    "jax.sharding.html": """
        jax.sharding.AxisType jax.sharding.AxisType.Manual jax.sharding.NamedSharding
        jax.sharding.PartitionSpec""",
    "_autosummary/jax.typeof.html": "jax.typeof",
}
# Those that no page documents, with the reason to use them.
UNDOCUMENTED = {
    "jax.__version_info__": "numbers of __version__; equinox and flax read it too",
    "jax.config.values": "all options; those in force are read as attributes, as the page says",
    "jax.extend.mlir.dialects.sdy.DimMappingAttr.get": "Shardy's own Python bindings: openxla.org/shardy",
    "jax.extend.mlir.dialects.sdy.OpShardingRuleAttr.get": "Shardy's own Python bindings: openxla.org/shardy",
    "jax.extend.mlir.dialects.sdy.TensorMappingAttr.get": "Shardy's own Python bindings: openxla.org/shardy",
    "jax.ffi.register_ffi_target_as_batch_partitionable": "its docstring: without it XLA gathers the batch around a call",
    "jax.interpreters.mlir.ir_attribute": "attributes of a call; jax.ffi has no other way to hand over one of ours",
    "jax.interpreters.mlir.lower_fun": "lowers by operations of JAX; in all extension libraries",
}


def test_each_name_that_the_adapter_uses_is_listed_with_its_documentation():
    listed = {*" ".join(DOCUMENTED.values()).split(), *UNDOCUMENTED}
    used = names_of_jax(ast.parse(ADAPTER.read_text(encoding="utf-8")))
    assert used == listed, f"not listed: {used - listed}; not used: {listed - used}"
    for name in listed:
        pkgutil.resolve_name(name)


# --- XLA's foreign function interface ---

HEADER = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text()


def changed(*pairs) -> str:
    text = HEADER
    for pattern, replacement in pairs:
        text, count = re.subn(pattern, replacement, text)
        assert count, pattern
    return text


@pytest.mark.parametrize("minor", [0, 3, 4, 5, 17])
def test_every_minor_version_serves_while_fields_keep_their_places(minor):
    version = r"API_MINOR \d+", f"API_MINOR {minor}"
    assert jax_adapter.ffi_version(changed(version)) == (0, minor)
    # What minor versions may do: new fields and functions at the end, other names of types.
    grown = changed(
        version,
        (r"(struct XLA_FFI_CallFrame \{[^}]*)\}", r"\1  struct XLA_FFI_New* more; }"),
        (r"(struct XLA_FFI_Api \{[^}]*)\}", r"\1  _XLA_FFI_API_STRUCT_FIELD(XLA_FFI_New_Get); }"),
        (r"XLA_FFI_\w*Extension\w*\* extension_start", "XLA_FFI_OtherName* extension_start"),
    )
    assert jax_adapter.ffi_version(grown) == (0, minor)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ((r"API_MAJOR \d+", "API_MAJOR 1"), r"version 1\.\d+ .* kernels are written for 0\.x"),
        ((r"(struct XLA_FFI_CallFrame \{)", r"\1 void* first;"), "another XLA_FFI_CallFrame: {'first': 0"),
        ((r"(struct XLA_FFI_Buffer \{[^}]*)(int64_t rank;)", r"\1 int64_t layout; \2"), "another XLA_FFI_Buffer"),
        ((r"(struct XLA_FFI_Attrs \{)", r"\1 Unknown first;"), "another XLA_FFI_CallFrame"),
        ((r"(struct XLA_FFI_Error_Create_Args \{[^}]*)\}", r"\1 int64_t place; }"), "XLA_FFI_Error_Create_Args"),
        ((r"(_XLA_FFI_API_STRUCT_FIELD\(XLA_FFI_Stream_Get\);)", r"\1 void* more;"), "another XLA_FFI_Api"),
        ((r"struct XLA_FFI_Args \{", "struct XLA_FFI_Operands {"), "another XLA_FFI_CallFrame"),
        ((r"XLA_FFI_API_MAJOR", "XLA_FFI_OTHER"), r"version -1\."),
    ],
    ids=["major", "first field", "moved", "unknown type", "passed", "function", "gone", "no version"],
)
def test_what_is_incompatible_is_refused(change, reason):
    with pytest.raises(jax_adapter.Unsupported, match=reason):
        jax_adapter.ffi_version(changed(change))


def test_a_jaxlib_without_the_header_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: str(tmp_path))
    with pytest.raises(jax_adapter.Unsupported, match="without the header"):
        jax_adapter.ffi_version()


# --- compiler options ---


def test_options_that_xla_does_not_have_are_left_out_and_said_once(caplog):
    options = {"xla_backend_optimization_level": 1, "xla_cpu_no_such_option": True}
    with caplog.at_level(logging.DEBUG, "jaxdyn"):
        for _ in range(2):
            assert jax_adapter.select_options(options) == {"xla_backend_optimization_level": 1}
    assert [(x.levelno, x.getMessage()) for x in caplog.records if x.name == "jaxdyn"] == [
        (logging.DEBUG, "jaxdyn: XLA has no compiler option xla_cpu_no_such_option, which is left out")
    ]


# --- versions of the future ---


def test_the_installed_version_is_tested():
    assert jax_adapter.is_version_known() and jax_adapter.reason_against_kernels() is None


@pytest.fixture
def future(monkeypatch) -> None:
    """JAX calls itself 0.99, and nothing has been tried with it. Warnings are errors, so one that is not expected is seen."""
    monkeypatch.setattr(jax, "__version_info__", (0, 99, 0))
    monkeypatch.setattr(jax, "__version__", "0.99.0")
    for name, value in {"_is_warned": False, "_against_kernels": None, "_trial": run_trial}.items():
        monkeypatch.setattr(jax_adapter, name, value)


def one_warning(reason: str):
    return pytest.warns(UserWarning, match=rf"this is jax 0\.99\.0.*{reason}.*'jax<0\.13'")


def sums(known, x):
    del known
    return lax.scan(lambda total, y: (total + jnp.sin(y), total * y), 0.0, x)


def results(function, x):
    """Values and derivatives, of one sample and of a batch."""
    value, slope = functools.partial(backend.kernel(function), ()), lambda x: jax.grad(lambda x: value(x)[0])(x)
    return [value(x), slope(x), jax.jit(jax.vmap(value))(jnp.stack([x, 2 * x])), jax.jit(jax.vmap(slope))(x[None])]


def assert_right(function, x, computed):
    with jd.compilation("plain"):
        wanted = results(function, x)
    for mine, theirs in zip(jax.tree.leaves(computed), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12)


def fresh(function):
    """The same as a function that no cache knows."""
    return lambda known, x: function(known, x)


X = jnp.asarray([0.3, -0.4, 0.9])


def uses_kernels(function) -> bool:
    return "jaxdyn_kernel" in str(jax.make_jaxpr(functools.partial(backend.kernel(function), ()))(X))


def test_a_new_version_in_which_nothing_has_changed_has_kernels(future):
    function = fresh(sums)
    assert_right(function, X, results(function, X))
    assert uses_kernels(function) and mode.current() == "auto"


@pytest.fixture
def renamed(monkeypatch) -> None:
    """`scan` has its parameters under other names."""
    one = expansion._Expansion.one

    def with_other_names(self, eqn, args):
        if eqn.primitive.name == "scan":
            params = {f"new_{name}": value for name, value in eqn.params.items()}
            eqn = SimpleNamespace(primitive=eqn.primitive, params=params, invars=eqn.invars, outvars=eqn.outvars)
        return one(self, eqn, args)

    monkeypatch.setattr(expansion._Expansion, "one", with_other_names)


@pytest.mark.long
def test_a_renamed_parameter_leaves_a_function_to_jax(future, renamed):
    function = fresh(sums)
    with one_warning("KeyError: 'num_consts'"):
        computed = results(function, X)
    assert_right(function, X, computed)
    assert not uses_kernels(function)
    other = fresh(sums)  # there is no second warning
    assert_right(other, X, results(other, X))
    assert uses_kernels(lambda known, x: jnp.sin(x))  # what has no scan has kernels


def test_a_renamed_parameter_is_an_error_on_a_tested_version(renamed):
    with pytest.raises(KeyError, match="num_consts"):
        backend.kernel(fresh(sums))((), X)


def test_an_error_of_the_users_function_stays_what_it_is(future):
    def wrong(known, x):
        raise ZeroDivisionError("of the user")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ZeroDivisionError, match="of the user"):
            backend.kernel(wrong)((), X)


NEW = Primitive("quite_new")
NEW.def_impl(lambda x: x + 1)
NEW.def_abstract_eval(lambda x: x)
jax.interpreters.mlir.register_lowering(NEW, jax.interpreters.mlir.lower_fun(lambda x: x + 1, multiple_results=False))


def test_a_new_primitive_leaves_a_function_to_jax(future):
    def function(known, x):
        return NEW.bind(jnp.sin(x))

    np.testing.assert_allclose(backend.kernel(function)((), X), jnp.sin(X) + 1, rtol=1e-15)
    assert not uses_kernels(function)


@jax.custom_jvp
def _sorted_slope(x):
    return jnp.sin(x)


_sorted_slope.defjvp(lambda primals, steps: (jnp.sin(primals[0]), jnp.sort(jnp.cos(primals[0])) * steps[0]))


def test_a_derivative_that_cannot_be_numbers_is_left_to_jax():
    """On every version: the value has a kernel, its derivative, whose rule sorts, has none."""

    def function(known, x):
        return jnp.sum(_sorted_slope(x)), x

    assert_right(function, X, results(function, X))
    assert uses_kernels(function)


def test_another_interface_of_xla_leaves_everything_to_jax(future, monkeypatch, tmp_path):
    folder = tmp_path / "xla/ffi/api"
    folder.mkdir(parents=True)
    (folder / "c_api.h").write_text(changed((r"API_MAJOR \d+", "API_MAJOR 1")))
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: str(tmp_path))
    monkeypatch.setattr(target, "_register", target._register.__wrapped__)
    function = fresh(sums)
    with one_warning(r"Unsupported: jaxlib has version 1\.\d+ of XLA's FFI"):
        computed = results(function, X)
    assert mode.current() == "plain" and not uses_kernels(function)
    assert_right(function, X, computed)


@pytest.mark.parametrize(("module", "name"), [("ad", "Zero"), ("mlir", "ir_attribute")])
def test_a_missing_name_leaves_everything_or_nothing_to_jax(future, monkeypatch, module, name):
    """Rules and lowerings that JAX calls meet it."""
    names = {key: value for key, value in vars(getattr(jax_adapter, module)).items() if key != name}
    monkeypatch.setattr(jax_adapter, module, SimpleNamespace(**names))
    function = fresh(sums)
    with one_warning(f"AttributeError: .*{name}"):
        computed = results(function, X)
    assert_right(function, X, computed)


def test_a_call_that_cannot_be_lowered_is_left_to_jax(future, monkeypatch):
    monkeypatch.setattr(jax_adapter, "_trial", None)

    def broken(*args, **static):
        raise TypeError("ffi_lowering got an unexpected argument")

    monkeypatch.setattr(jax_adapter, "lower_call", broken)
    function = fresh(sums)
    with one_warning("TypeError: ffi_lowering got an unexpected argument"):
        computed = results(function, X)
    assert_right(function, X, computed)
    monkeypatch.setattr(jax, "__version_info__", (0, 12, 0))
    with pytest.raises(TypeError, match="unexpected argument"):
        jax.jit(functools.partial(backend.kernel(lambda known, x: jnp.cos(x)), ()))(X)


def test_wrong_numbers_leave_everything_to_jax(future, monkeypatch):
    """As those of jax 0.10.2 were."""
    rule = kernels.call_program
    monkeypatch.setattr("jaxdyn.compile.executables.call_program", lambda *args: [2 * x for x in rule(*args)])
    with one_warning("a kernel gives other numbers than JAX"):
        assert mode.current() == "plain"


@pytest.mark.parametrize("name", ["Literal", "Primitive"])
def test_the_adapter_can_be_imported_where_a_name_is_missing(future, monkeypatch, name):
    monkeypatch.delattr(jax.extend.core, name)
    spec = importlib.util.spec_from_file_location("another_adapter", ADAPTER)
    with one_warning(f"ImportError: .*{name}"):
        adapter = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(adapter)
    assert name in adapter.reason_against_kernels()
    assert adapter.define_primitive("one", lambda x: x) is None
    monkeypatch.setattr(jax, "__version_info__", (0, 12, 0))
    with pytest.raises(ImportError, match=name):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
