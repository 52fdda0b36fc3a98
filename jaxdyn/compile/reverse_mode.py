"""A mark of values whose derivatives exist in reverse mode alone, with a message of ours for forward mode.

JAX refuses forward mode through a function with a rule for reverse mode without saying what to do instead. A marked value passes
reverse mode as it is. Its tangent is a primitive that reverse mode transposes away, and that cannot be computed.
"""

from typing import NoReturn

import jax

from jaxdyn.compile.flags import is_float
from jaxdyn.compile.jax_adapter import define_primitive, is_zero


def reverse_only(tree, message: str):
    """The same values; forward mode through them raises ValueError with a message."""
    if _mark_p is None:
        return tree
    return jax.tree.map(lambda x: _mark_p.bind(x, message=message) if hasattr(x, "dtype") and is_float(x) else x, tree)


def _refuse(*_, message: str) -> NoReturn:
    raise ValueError(message)


def _mark_jvp(primals, tangents, *, message: str):
    (x,), (tangent,) = primals, tangents
    moved = tangent if is_zero(tangent) or _tangent_p is None else _tangent_p.bind(tangent, message=message)
    # Not marked again: forward mode over reverse mode differentiates the rule for reverse mode, which has derivatives of its own.
    return x, moved


def _tangent_jvp(primals, tangents, *, message: str):
    (x,), (tangent,) = primals, tangents
    bind = _tangent_p.bind  # pyright: ignore[reportOptionalMemberAccess]
    return bind(x, message=message), tangent if is_zero(tangent) else bind(tangent, message=message)


_mark_p = define_primitive(
    "jaxdyn_reverse_only",
    lambda x, message: x,
    implement=lambda x, message: x,
    lower=lambda x, message: x,
    batch=lambda arrays, axes, message: (_mark_p.bind(*arrays, message=message), axes[0]),
    jvp=_mark_jvp,
)
_tangent_p = define_primitive(
    "jaxdyn_reverse_only_tangent",
    lambda x, message: x,
    implement=_refuse,
    lower=_refuse,
    batch=lambda arrays, axes, message: _refuse(message=message),
    jvp=_tangent_jvp,
    transpose=lambda cotangent, x, message: [cotangent],
)
