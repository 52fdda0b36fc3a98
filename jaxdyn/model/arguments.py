"""Arguments: numbers become arrays of the system's dtype, and values that do not fit are refused, with a fix."""

import functools
import os
import pathlib
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete as is_concrete
from jaxdyn.compile.known import is_known

_T = TypeVar("_T")
_F = TypeVar("_F", bound=Callable[..., Any])
_OPTIONAL = ("a", "external")

if TYPE_CHECKING:
    Numbers = ArrayLike | Sequence[Any]  # accepted by `as_array`
    Given = Array  # its result, which may be an array of numpy
    Number = float | Array  # one number, which may be traced
    Row = Sequence[Any] | np.ndarray | Array  # several numbers, or rows of them, that are taken one by one
    FilePath = str | os.PathLike[str]
    DType = DTypeLike
    Function = Callable[..., Any]

    class SystemLike(Protocol):
        """Interface of a system: a `Model`, a `System`, or any other object with sizes nq and nv (`check_system`)."""

        @property
        def nq(self) -> int: ...

        @property
        def nv(self) -> int: ...

    Checked = Annotated[_T, "checked by the function, whose ValueError names the argument"]
else:
    # Run-time type checkers would refuse lists and numbers before `as_array` can name the argument in its error
    Numbers = Given = Number = Row = FilePath = DType = Function = SystemLike = Any

    class Checked:
        """Annotation T for type checkers, anything at run time: the function itself checks the value."""

        def __class_getitem__(cls, _) -> Any:
            return Any


def as_array(value: Any, name: str, dtype=None) -> Given:
    """Real numbers as an array of `dtype`, by JAX.

    Without a dtype arrays are returned unchanged, and lists and numbers become arrays of numpy, which stay known inside a trace,
    unless they hold tracers.

    **Raises:** ValueError that names the argument, for complex numbers and for a value that is no array of numbers.
    """
    if not isinstance(value, (np.ndarray, jax.Array)):
        try:
            # np.asarray of a tracer raises; jnp.asarray of a known list would turn it into a tracer inside a trace.
            value = np.asarray(value) if is_concrete(value) else jnp.asarray(value)
        except (TypeError, ValueError):
            raise ValueError(f"{name} is {value!r}; pass an array of numbers, or a list of equal rows") from None
    # A silent cast to real numbers would drop the imaginary part.
    if value.dtype.kind == "c":
        raise ValueError(f"{name} is complex ({value.dtype}); pass real numbers, such as {name}.real")
    # Short floats are of no kind that numpy knows.
    if value.dtype.kind not in "fiub" and not jnp.issubdtype(value.dtype, jnp.number):
        raise ValueError(f"{name} is {value!r}; pass an array of numbers")
    if dtype is None or (isinstance(value, jax.Array) and value.dtype == dtype):
        return value  # pyright: ignore[reportReturnType]
    return jnp.asarray(_cast(value, dtype) if isinstance(value, np.ndarray) else value, dtype)


def as_shape(value: Any, name: str, dtype, *shapes: tuple[int, ...], of: str = "") -> Given:
    """`as_array` of one of some shapes. **Raises:** ValueError for another one, with what the numbers are `of`."""
    value = as_array(value, name, dtype)
    if value.shape not in shapes:
        wanted = " or ".join(map(str, shapes))
        raise ValueError(f"{name} has shape {value.shape}, expected {wanted}{of}{batch_hint(value, shapes[0])}")
    return value


def as_operand(value: Any, name: str, dtype) -> Given:
    """`as_array`; of numpy outside of a trace, where each operation of JAX is a program of its own."""
    value = as_array(value, name)
    return _cast(value, dtype) if is_known(value) else as_array(value, name, dtype)  # pyright: ignore[reportReturnType]


def _cast(value: Any, dtype) -> np.ndarray:
    # Cast by numpy: JAX would compile a program for each shape. Overflow becomes infinity without a warning, as in JAX.
    with np.errstate(over="ignore"):
        return np.asarray(value).astype(jax.dtypes.canonicalize_dtype(dtype), copy=False)


def zeros_if_none(value: Any, size: int) -> Any:
    """The vector, or zeros (size,) where it was omitted."""
    # Numpy zeros stay known inside a trace.
    return np.zeros(size) if value is None else value


def as_path(path: object, name: str = "path") -> pathlib.Path:
    """Convert a path argument, `~` expanded.

    **Raises:** ValueError for a value that is no path.
    """
    # os.PathLike has bytes among its text types, but pathlib refuses them with an error that does not name the
    # argument.
    if not isinstance(path, (str, os.PathLike)) or isinstance(path, bytes):
        raise ValueError(f"{name} is {path!r}; pass the path of a file, a string or a pathlib.Path")
    return pathlib.Path(path).expanduser()


def check_name(name: object, what: str) -> str:
    """Check that something is named by a string. **Raises:** ValueError."""
    if not isinstance(name, str):
        raise ValueError(f"{what} is {name!r}; give its name, a string")
    return str(name)  # equinox takes strings of NumPy for arrays


def check_names(names: object, what: str) -> tuple[str, ...]:
    """Tuple of names, of one name or several. **Raises:** ValueError for anything else."""
    if isinstance(names, str):
        return (names,)
    if not isinstance(names, (tuple, list)):
        raise ValueError(f"{what} is {names!r}; give a name, or several in a list")
    return tuple(check_name(name, what) for name in names)


def check_body(name: object, what: str) -> str | None:
    """Check that a body or frame is named by a string, or is the world, None. **Raises:** ValueError."""
    return None if name is None else check_name(name, what)


def check_new_name(name: object, default: str, what: str = "name") -> str:
    """Check the name that a user gives to something, or take the default for None. **Raises:** ValueError."""
    if name is None:
        return default
    if not isinstance(name, str) or not name:
        raise ValueError(f"{what} is {name!r}; give a non-empty string, or None for {default!r}")
    return str(name)


def check_flag(value: object, what: str) -> bool:
    """Check a choice of yes or no on which a program depends.

    **Raises:** ValueError for anything but True and False: to Python any object is true, "no" and NaN included.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{what} is {value!r}; give True or False, not traced")
    return bool(value)


def check_mapping(value: object, what: str, example: str) -> dict[str, Any]:
    """Check a mapping from names, None for an empty one. **Raises:** ValueError that shows the example."""
    if value is not None and not isinstance(value, Mapping):
        raise ValueError(f"{what} is {value!r}; give a mapping from names, such as {example}")
    return {check_name(name, f"a key of {what}"): item for name, item in (value or {}).items()}


def parse_number(text: str) -> float:
    """Parse a decimal number as file formats write it.

    **Raises:** ValueError for other texts, for underscores ("1_0" is ten to Python) and for digits of other scripts.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"{text!r} is no number")
    return float(text)


# Modules that may stand between the caller and the package: run-time type checkers wrap public functions.
_WRAPPERS = ("jaxdyn", "jaxtyping", "beartype", "equinox", "contextlib", "jax")


def warn(text: str, category: type[Warning]) -> None:
    """Warn at the line of the caller outside the package, at whatever depth the warning arises."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _WRAPPERS:
        frame, level = frame.f_back, level + 1
    warnings.warn(text, category, stacklevel=level)


def deprecated(old: str, function: _F) -> _F:
    """The function under its old name, which warns when it is called."""
    name = getattr(function, "__name__", "")

    @functools.wraps(function)
    def call(*args, **kwargs):
        warn(f"{old} is deprecated; call {name}", DeprecationWarning)
        return function(*args, **kwargs)

    call.__doc__ = f"Deprecated name of `{name}`."
    return call  # pyright: ignore[reportReturnType]


def state_dtype(system, q=None):
    """Floating-point type of a system's states: that of its leaves, else of q, else jax's default."""
    # A Model has one dtype for all leaves; its home poses show it without a walk over the tree.
    home = getattr(system, "home", None)
    if home is not None:
        return home.dtype
    # Parameters of other systems decide before q: a float32 system stays so when q is a list of Python floats.
    numbers = [leaf for leaf in jax.tree.leaves(system) if eqx.is_inexact_array(leaf)] or [q]
    kinds = [leaf.dtype for leaf in numbers if eqx.is_inexact_array(leaf) and not jnp.iscomplexobj(leaf)]
    return jnp.result_type(*kinds) if kinds else jnp.zeros(()).dtype


def check_state(system, **arguments) -> tuple[Any, ...]:
    """Convert the arguments of a function of any system to arrays of its dtype, in their order.

    Names starting with q have shape (nq,), `t` (), `external` (nb, 6), all others (nv,). `a` and `external` may be
    None.

    **Raises:** ValueError that names the argument: a shape that does not fit, complex numbers, wrenches on the bodies of a
    system that has none; for a Scene instead of its system, and for an object that is no system.
    """
    check_system(system)
    dtype, arrays = state_dtype(system, arguments.get("q")), []
    for name, value in arguments.items():
        if value is None and name in _OPTIONAL:
            arrays.append(None)
            continue
        if name == "external" and not hasattr(system, "topology"):
            raise ValueError(
                f"external holds wrenches on bodies, and a {type(system).__name__} has none; add them to tau"
            )
        value = as_array(value, name, dtype)
        check_shape(system, name, value)
        arrays.append(value)
    return tuple(arrays)


def check_shape(system, name: str, value: Array | np.ndarray) -> None:
    """Refuse an array whose shape does not fit the system, by the rules of `check_state`."""
    if name == "t":
        want, label = (), "()"
    elif name == "external":
        want, label = (system.nb, 6), "(nb, 6)"
    elif name.startswith("q"):
        want, label = (system.nq,), "(nq,)"
    else:
        want, label = (system.nv,), "(nv,)"
    if value.shape != want:
        whose = f"model {system.name!r}" if hasattr(system, "topology") else f"the {type(system).__name__}"
        raise ValueError(
            f"{name} has shape {value.shape}, expected {want} = {label} of {whose}{batch_hint(value, want)}"
        )


def batch_hint(value, want: tuple) -> str:
    """Advice for a value with one axis more than the expected shape, else an empty string."""
    return "; functions take one sample, use jax.vmap for a batch" if np.ndim(value) == len(want) + 1 else ""


def check_system(system: Any, name: str = "model") -> None:
    """Refuse an object that is no system, or a Scene instead of its system.

    **Raises:** ValueError that states the remedy.
    """
    # A scene has nq and nv too, so that its constraints and forces would silently be ignored.
    if hasattr(system, "system") and hasattr(system, "constraints"):
        raise ValueError(
            f"{name} is a {type(system).__name__}; pass scene.system: this function accepts no constraints and forces. With "
            "these, jd.constrained_dynamics gives accelerations, jd.constrained_inverse_dynamics torques, and "
            "jd.reduced_dynamics the equations and the mass matrix in minimal velocities"
        )
    if not (hasattr(system, "nq") and hasattr(system, "nv")):
        raise ValueError(f"{name} is a {type(system).__name__}, which has no nq and nv; pass a Model or another system")


def check_shapes(model, **arguments) -> tuple[Any, ...]:
    """Apply `check_state` for a function of a tree of bodies.

    **Raises:** ValueError as there, and for a system that is no `Model`.
    """
    check_system(model)
    if not hasattr(model, "topology"):
        raise ValueError(f"model is a {type(model).__name__}, which has no bodies; pass a Model")
    return check_state(model, **arguments)


def store_leaf(value, dtype) -> jax.Array:
    """Convert numbers to a leaf of this dtype; known numbers stay concrete inside a trace too, and nothing is compiled."""
    if not is_concrete(value):
        return jnp.asarray(value, dtype)
    # Without this a known constant would become a tracer under jit, and later checks of its value would be skipped.
    with jax.ensure_compile_time_eval():
        return jnp.asarray(_cast(value, dtype), dtype)


def as_float(value: Any, what: str, shape: tuple | None = None, like=None) -> Float[Array, "..."]:
    """Convert `value` to a floating-point array, of the dtype `like` if that is given, else of its own or the default one.

    **Raises:** ValueError for no real numbers, another shape (None in it means any size), and known numbers that are NaN.
    """
    given = as_array(value, what)
    if like is None:
        # Integers become floating-point leaves: `jax.grad` refuses integers.
        like = jax.dtypes.canonicalize_dtype(given.dtype) if jnp.issubdtype(given.dtype, jnp.floating) else float
    array = jnp.asarray(given, like) if isinstance(given, jax.Array) else store_leaf(given, like)
    if shape is not None and (
        array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True))
    ):
        shown = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{what} has shape {array.shape}, expected ({shown}); batch with jax.vmap")
    # Infinite entries are valid: an infinite h is no bound.
    if is_concrete(given) and np.isnan(np.asarray(given)).any():
        raise ValueError(f"{what} is {given}, with entries that are not a number; give numbers")
    return array


def as_number(value: object, what: str, unit: str = "", *, zero: bool = False, like=None) -> Float[Array, ""]:
    """Convert `value` to one positive number, or zero where that is allowed.

    **Raises:** ValueError for other shapes, and for known numbers below that or not finite.
    """
    array = as_float(value, what, (), like)
    if is_concrete(value):
        number = float(np.asarray(value))
        if not (number >= 0 if zero else number > 0) or number == float("inf"):
            sign = "zero or a positive number" if zero else "one positive number"
            raise ValueError(f"{what} is {number}; give {sign}{unit and f' ({unit})'}")
    return array


def as_static(value: Any, what: str, low: Number, high: Number, fix: str) -> float:
    """Check a number from `low` to below `high` on which a program depends, so that it cannot be traced.

    **Raises:** ValueError for anything else, with what to give: `fix`.
    """
    is_number = isinstance(value, (int, float, np.ndarray, np.generic, jax.Array)) and is_concrete(value)
    if not is_number or np.shape(value) != () or not low <= float(value) < high:
        raise ValueError(f"{what} is {value!r}; give {fix}, not traced")
    return float(value)


def check_known(function: str, **arguments: Any) -> None:
    """Refuse traced arguments of a function that computes with NumPy. **Raises:** ValueError with their names."""
    traced = [name for name, value in arguments.items() if not is_concrete(value)]
    if traced:
        raise ValueError(
            f"{' and '.join(traced)} of {function} {'is' if len(traced) == 1 else 'are'} traced; it needs known numbers: call it "
            "outside of jax.jit, jax.vmap and jax.grad"
        )


def check_seed(value: object) -> int:
    """Check the seed of random numbers. **Raises:** ValueError for anything but an integer of 32 bits that is not negative."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value < 2**32:
        raise ValueError(f"seed is {value!r}; give a whole number from 0 to 2^32 - 1")
    return int(value)


def check_count(value: object, what: str) -> int:
    """Check a number of steps, samples or bodies. **Raises:** ValueError for anything but a positive integer."""
    # True is an int to Python.
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{what} is {value!r}; give a positive integer")
    return int(value)
