"""How many operations the kernels of a function carry out for one sample."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr

from jaxdyn.compile.derive import inline

# What is carried out for some samples alone, as a second solution of rows that depend on each other, is left out.
_NOT_ALWAYS = ("cond", "while")
_NOT_COUNTED = ("input", "neg", "call", "part")
_FUNCTIONS = frozenset("sin cos tan asin acos atan atan2 sinh cosh tanh exp exp2 expm1 log log1p pow cbrt sqrt".split())


class Operations(NamedTuple):
    """All operations of a sample's kernels; and those among them that are sines, roots and other functions, and divisions."""

    all: int
    functions: int
    divisions: int


def operations(function: Callable, *args) -> Operations | None:
    """Of the kernels that function(*args) calls outside of branches; None where it calls none, as without llvmlite."""
    computed: dict[str, int] = {}
    for program in _programs(jax.make_jaxpr(function)(*args).jaxpr):
        for op, count in inline(program).counts().items():
            computed[op] = computed.get(op, 0) + count
    if not computed:
        return None
    counted = {op: count for op, count in computed.items() if op not in _NOT_COUNTED}
    functions = sum(count for op, count in counted.items() if op in _FUNCTIONS)
    return Operations(sum(counted.values()), functions, counted.get("div", 0))


def _programs(jaxpr: Jaxpr) -> Iterator:
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name == "jaxdyn_kernel" and hasattr(eqn.params["program"], "counts"):
            yield eqn.params["program"]
        if name in _NOT_ALWAYS:
            continue
        for value in eqn.params.values():
            inner = value.jaxpr if isinstance(value, ClosedJaxpr) else value
            if isinstance(inner, Jaxpr):
                yield from _programs(inner)
