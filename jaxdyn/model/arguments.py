"""What users pass to functions of a system: numbers become arrays of its dtype, and what does not fit is refused."""

import os
import pathlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float

from jaxdyn.compile import is_concrete as is_concrete
from jaxdyn.model import float64 as f64

_T = TypeVar("_T")
_OPTIONAL = ("a", "external")

if TYPE_CHECKING:
    Numbers = ArrayLike | Sequence[Any]  # what `as_array` takes
    Given = Array  # what it returns, which may be an array of numpy
    Number = float | Array  # one number, which may be traced
    Row = Sequence[Any] | np.ndarray | Array  # several numbers, or rows of them, that are taken one by one
    FilePath = str | os.PathLike[str]
    DType = DTypeLike
    Function = Callable[..., Any]

    class SystemLike(Protocol):
        """What is taken as a system: a `Model`, a `System`, or anything else of which `check_system` finds the sizes."""

        @property
        def nq(self) -> int: ...

        @property
        def nv(self) -> int: ...

    Checked = Annotated[_T, "looked at by the function, whose ValueError names the argument"]
else:
    # `as_array` and others look at them, and their errors name the argument
    Numbers = Given = Number = Row = FilePath = DType = Function = SystemLike = Any

    class Checked:
        """`Checked[T]` is T to a type checker and anything at run time: the function looks at it, and its error names it."""

        def __class_getitem__(cls, _) -> Any:
            return Any


def as_array(value: Any, name: str, dtype=None) -> Given:
    """Real numbers as an array of `dtype`, by JAX.

    Without a dtype arrays stay as they are, and lists and numbers become arrays of numpy, which stay known inside a trace,
    unless they hold tracers.

    **Raises:** ValueError that names the argument, for complex numbers and for what is no array of numbers.
    """
    if not isinstance(value, (np.ndarray, jax.Array)):
        try:
            value = np.asarray(value) if is_concrete(value) else jnp.asarray(value)
        except (TypeError, ValueError):
            raise ValueError(f"{name} is {value!r}; pass an array of numbers, or a list of equal rows") from None
    if jnp.issubdtype(value.dtype, jnp.complexfloating):
        raise ValueError(f"{name} is complex ({value.dtype}); pass real numbers, such as {name}.real")
    if not (jnp.issubdtype(value.dtype, jnp.number) or value.dtype == bool):
        raise ValueError(f"{name} is {value!r}; pass an array of numbers")
    if dtype is None or (isinstance(value, jax.Array) and value.dtype == dtype):
        return value  # pyright: ignore[reportReturnType]
    return jnp.asarray(_cast(value, dtype) if isinstance(value, np.ndarray) else value, dtype)


def _cast(value: Any, dtype) -> np.ndarray:
    # By numpy, as JAX compiles a program for each shape; what is too large becomes infinite without a warning there too.
    with np.errstate(over="ignore"):
        return np.asarray(value).astype(jax.dtypes.canonicalize_dtype(dtype), copy=False)


def or_zeros(value: Any, size: int) -> Any:
    """A vector that was left out as one of zeros (size,)."""
    return np.zeros(size) if value is None else value


def as_path(path: Any, name: str = "path") -> pathlib.Path:
    """A path that a user gave, `~` expanded.

    **Raises:** ValueError for what is no path.
    """
    if not isinstance(path, (str, os.PathLike)) or isinstance(path, bytes):
        raise ValueError(f"{name} is {path!r}; pass the path of a file, a string or a pathlib.Path")
    return pathlib.Path(path).expanduser()


def state_dtype(system, q=None):
    """Floating-point type of a system's states: that of a Model's leaves, else of its numbers, else of q or jax's default."""
    home = getattr(system, "home", None)
    if home is not None:
        return home.dtype
    numbers = [leaf for leaf in jax.tree.leaves(system) if eqx.is_inexact_array(leaf)] or [q]
    kinds = [leaf.dtype for leaf in numbers if eqx.is_inexact_array(leaf) and not jnp.iscomplexobj(leaf)]
    return jnp.result_type(*kinds) if kinds else jnp.zeros(()).dtype


def check_state(system, **arguments) -> tuple[Any, ...]:
    """The arguments of a function of any system, in their order, as arrays of its dtype.

    Names starting with q are to have shape (nq,), `t` (), `external` (nb, 6), all others (nv,). `a` and `external` may be
    None.

    **Raises:** ValueError that names the argument: a shape that does not fit, complex numbers, wrenches on the bodies of a
    system that has none; for a Scene in the place of its system, and for what is no system.
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
    """What to do about a value that has one axis more than the shape that is wanted, else an empty string."""
    return "; functions take one sample, use jax.vmap for a batch" if np.ndim(value) == len(want) + 1 else ""


def check_system(system: Any, name: str = "model") -> None:
    """Refuse what is no system, and a Scene, of which the system is to be passed.

    **Raises:** ValueError that says what to pass.
    """
    if hasattr(system, "system") and hasattr(system, "constraints"):
        raise ValueError(
            f"{name} is a {type(system).__name__}; pass scene.system, as no constraints and forces are taken here"
        )
    if not (hasattr(system, "nq") and hasattr(system, "nv")):
        raise ValueError(f"{name} is a {type(system).__name__}, which has no nq and nv; pass a Model or another system")


def check_shapes(model, **arguments) -> tuple[Any, ...]:
    """`check_state` for a function of a tree of bodies.

    **Raises:** ValueError as there, and for a system that is no `Model`.
    """
    check_system(model)
    if not hasattr(model, "topology"):
        raise ValueError(f"model is a {type(model).__name__}, which has no bodies; pass a Model")
    return check_state(model, **arguments)


def pose_leaf(pose, what: str) -> Float[Array, "4 4"]:
    """A pose as an array leaf; its numbers may be traced, and arrays (4, 4) of jax are taken as they are."""
    if isinstance(pose, jax.Array) and pose.shape == (4, 4):
        return pose
    if isinstance(pose, jax.Array) and pose.shape == (3,):
        return stored(f64.pose_of(np.eye(3), pose), pose.dtype)
    return stored(f64.pose_matrix(pose, what), float)


def stored(value, dtype) -> jax.Array:
    """Numbers as a leaf of this dtype. Within a trace, too, what is known stays known, and nothing is compiled for it."""
    if not is_concrete(value):
        return jnp.asarray(value, dtype)
    with jax.ensure_compile_time_eval():
        return jnp.asarray(_cast(value, dtype), dtype)
