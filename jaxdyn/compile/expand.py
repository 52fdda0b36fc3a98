"""From a function of arrays to a program of single numbers: one rule for each primitive of JAX's jaxprs.

Arrays whose entries are all known stay numpy arrays of their dtype; others are arrays of objects (see `graph`). What has
no rule here, or happens elsewhere (callbacks), or chooses its way by numbers that are not known (`cond`, `while_loop`), is
not a program of numbers: `NotNumbers` says why.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jaxdyn.compile import matrices, mode
from jaxdyn.compile import program as numbers
from jaxdyn.compile.constants import bound, computed, converted, of_nothing
from jaxdyn.compile.graph import Graph, Number, as_objects, objects
from jaxdyn.compile.jax_adapter import ClosedJaxpr, Literal, Tracer, scan_counts  # pyright: ignore[reportPrivateImportUsage]
from jaxdyn.compile.program import Array, NotNumbers, Program, as_kind, kind_of
from jaxdyn.compile.rearrange import AT_PLACES, REARRANGEMENTS, written

# A function of fewer operations is written where it is called.
MIN_SUBPROGRAM_OPERATIONS = 300


def expand(
    closed: ClosedJaxpr, most: int, name: str = "", calls: bool = False, served: bool = False, flags: bool = False
) -> tuple[Program, bool]:
    """The program of a jaxpr, and whether it has functions whose derivatives are given by rules of their own.

    With `calls`, functions under `jax.jit` of at least `MIN_SUBPROGRAM_OPERATIONS` operations become subprograms. With `served`,
    there is one more output: whether no number is flagged (see `flags`); without it none may be, unless `flags`.

    **Raises:** `NotNumbers`, `TooLong`.
    """
    graph = Graph(most)
    inputs = [Array(x.aval.shape, np.dtype(x.aval.dtype)) for x in closed.jaxpr.invars]  # pyright: ignore[reportAttributeAccessIssue]
    outputs = [Array(x.aval.shape, np.dtype(x.aval.dtype)) for x in closed.jaxpr.outvars]  # pyright: ignore[reportAttributeAccessIssue]
    for array in (*inputs, *outputs):
        if array.dtype.name not in ("float64", "float32", "bool", "int32", "int64"):
            raise NotNumbers(f"an array of {array.dtype}")
    expansion = _Expansion(graph, calls)
    entries = [graph.inputs(place, array) for place, array in enumerate(inputs)]
    with np.errstate(all="ignore"):  # known numbers may be none, as in branches that are not taken
        results = expansion.evaluate(closed.jaxpr, closed.consts, entries)
    if expansion.flagged is not False and not (served or flags):
        raise NotNumbers("samples that need more care than a program of numbers takes")
    if served:
        outputs.append(_FLAG)
        results.append(objects([graph.invert(expansion.flagged)], ()))
    return graph.finish(inputs, outputs, [as_objects(x) for x in results], name=name), expansion.has_rules


_FLAG = Array((), np.dtype(bool))


class _Expansion:
    def __init__(self, graph: Graph, calls: bool):
        self.graph = graph
        self.has_rules = False
        self.flagged: Any = False  # whether any number is
        self.calls = calls
        binary = {"add": graph.add, "add_any": graph.add, "sub": graph.sub, "mul": graph.mul}
        binary |= {"and": graph.both, "or": graph.either}
        binary |= {name: functools.partial(graph.compare, name) for name in numbers.COMPARISONS}
        binary |= {name: functools.partial(graph.function_of_two, name) for name in numbers.FUNCTIONS_OF_TWO}
        unary = {"neg": graph.neg, "not": graph.invert, "is_finite": graph.is_finite}
        unary |= {name: functools.partial(graph.function, name) for name in numbers.FUNCTIONS}
        unary |= {"square": lambda x: graph.mul(x, x), "rsqrt": lambda x: graph.div(1.0, graph.function("sqrt", x))}
        unary |= {
            "log2": lambda x: graph.div(graph.function("log", x), math.log(2.0)),
            "one_minus_square": self._one_less,
        }
        self.elementwise = {name: np.frompyfunc(f, 2, 1) for name, f in binary.items()}
        self.elementwise |= {name: np.frompyfunc(f, 1, 1) for name, f in unary.items()}
        self.divide = np.frompyfunc(graph.div, 2, 1)
        chains = {"sum": graph.add, "prod": graph.mul, "and": graph.both, "or": graph.either}
        self.reductions = {f"reduce_{name}": functools.partial(functools.reduce, f) for name, f in chains.items()}
        self.reductions |= {name: functools.partial(graph.extreme, name) for name in ("reduce_max", "reduce_min")}

    def evaluate(self, jaxpr, consts, args) -> list:
        values = dict(zip(jaxpr.constvars, (_constant(x) for x in consts), strict=True))
        values.update(zip(jaxpr.invars, args, strict=True))

        def read(atom):
            return np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]

        for eqn in jaxpr.eqns:
            if eqn.effects:
                raise NotNumbers(f"{eqn.primitive.name} has side effects")
            results = self.one(eqn, [read(x) for x in eqn.invars])
            values.update(zip(eqn.outvars, results, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def closed(self, closed: ClosedJaxpr, args) -> list:
        return self.evaluate(closed.jaxpr, closed.consts, args)

    def one(self, eqn, args) -> list:
        name, params = eqn.primitive.name, eqn.params
        if name.startswith("custom_vjp") and any(x.dtype.kind == "O" for x in args):
            raise NotNumbers(f"{name}, whose derivative is known in reverse alone")
        if name in _INNER:
            inner = params[_INNER[name]]
            self.has_rules |= name.startswith("custom_")
            if self.calls and name == "jit":
                return self._called(inner, args)
            return self.closed(inner, args) if isinstance(inner, ClosedJaxpr) else self.evaluate(inner, (), args)
        rule = _OTHER.get(name)
        if rule is not None:
            return rule(self, params, args, eqn)
        if name in AT_PLACES:
            return AT_PLACES[name](params, args, eqn)
        out = eqn.outvars[0].aval
        known = all(x.dtype.kind != "O" for x in args)
        if name == "round" and params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
            return [bound(eqn, args) if known else self._rounded(args[0], out.dtype)]
        if name in REARRANGEMENTS:
            results = REARRANGEMENTS[name](params, args if known else [as_objects(x) for x in args], out)
            return [x if known else as_objects(x) for x in results] if eqn.primitive.multiple_results else [results]
        if known:
            return [computed(eqn, args)]
        if name in self.elementwise:
            if name in _OF_FLOATS and any(x.aval.dtype.kind != "f" for x in eqn.invars):
                raise NotNumbers(f"{name} of integers")
            # numpy would make Python's numbers of entries, which forget their type.
            return [as_objects(self.elementwise[name](*(as_objects(x) for x in args)))]
        if name == "div":
            if out.dtype.kind != "f":
                raise NotNumbers("division of integers")
            return [as_objects(self.divide(*(as_objects(x) for x in args)))]
        if name in self.reductions:
            return [self._reduced(name, args[0], params["axes"], out)]
        raise NotNumbers(name)

    def _called(self, inner: ClosedJaxpr, args) -> list:
        """A function as a subprogram, if it is long; arguments that are known are compiled in."""
        known = tuple(None if x.dtype.kind == "O" else (x.shape, x.dtype.str, x.tobytes()) for x in args)
        program, has_rules = _subprogram(inner, known, self.graph.most)
        self.has_rules |= has_rules
        given = [x for x, y in zip(args, known, strict=True) if y is None]
        is_short = program.cost < MIN_SUBPROGRAM_OPERATIONS
        results = self.graph.replay(program, given)[1] if is_short else self.graph.call(program, given)
        count = len(inner.jaxpr.outvars)
        for flagged in results[count:]:
            self.flagged = self.graph.either(self.flagged, flagged.item())
        return results[:count]

    def _reduced(self, name, array, axes, out):
        fold, count = self.reductions[name], math.prod(array.shape[i] for i in axes)
        if not count:
            return as_objects(np.full(out.shape, of_nothing(name, out.dtype), out.dtype))
        rows = np.moveaxis(as_objects(array), axes, range(len(axes))).reshape(count, math.prod(out.shape))
        return objects([fold(column) for column in rows.T.tolist()], out.shape)

    # --- rules that need more than the entries ---

    def _rounded(self, array, dtype):
        """To the nearest whole number, halves away from zero."""
        g = self.graph

        def rounded(x):
            size = g.function("abs", x)
            whole = g.function("floor", size)
            up = g.compare("ge", g.sub(size, whole), 0.5)  # not floor(|x| + 1/2), whose sum is rounded
            return g.mul(g.function("sign", x), g.select(up, whole, g.add(whole, 1.0), _kind(dtype)))

        return objects([rounded(x) for x in array.ravel().tolist()], array.shape)

    def _one_less(self, x):
        """1 - x^2; the square where its rounding is small, else the product that is exact near one."""
        g = self.graph
        is_small = g.compare("lt", g.function("abs", x), 0.5)
        return g.select(is_small, g.mul(g.add(1.0, x), g.sub(1.0, x)), g.sub(1.0, g.mul(x, x)), x.kind)

    def _polynomial(self, params, args, eqn):
        """Horner's rule; the coefficients follow x, that of the highest power last."""
        shape = eqn.outvars[0].aval.shape
        x, *coefficients = (np.broadcast_to(as_objects(y), shape) for y in args)
        add, mul = self.elementwise["add"], self.elementwise["mul"]
        return [as_objects(functools.reduce(lambda value, c: add(mul(value, x), c), reversed(coefficients)))]

    def _same(self, params, args, eqn):
        return args

    def _unless(self, params, args, eqn):
        flags, entries = (as_objects(x).ravel().tolist() for x in args)
        kind = _kind(eqn.outvars[0].aval.dtype)
        for flag in flags:
            self.flagged = self.graph.either(self.flagged, flag)
        chosen = [self.graph.select(flag, x, math.nan, kind) for flag, x in zip(flags, entries, strict=True)]
        return [objects(chosen, args[1].shape)]

    def _convert(self, params, args, eqn):
        return [self._as_dtype(args[0], params["new_dtype"])]

    def _integer_pow(self, params, args, eqn):
        if args[0].dtype.kind != "O":
            return [
                np.asarray(args[0] ** params["y"] if params["y"] >= 0 else 1 / args[0] ** -params["y"], args[0].dtype)
            ]
        one = as_kind(1, _kind(eqn.outvars[0].aval.dtype))
        return [objects([self.graph.power(x, params["y"], one) for x in args[0].ravel().tolist()], args[0].shape)]  # pyright: ignore[reportArgumentType]

    def _select(self, params, args, eqn):
        which, *cases = args
        out = eqn.outvars[0].aval
        if which.dtype.kind != "O":
            which = np.broadcast_to(which.astype(np.int32), out.shape)
            if all(x.dtype.kind != "O" for x in cases):
                return [np.choose(which, cases)]
            cases = [as_objects(x) for x in cases]
            chosen = np.where(which == 0, cases[0], cases[1])
            for i in range(2, len(cases)):
                chosen = np.where(which == i, cases[i], chosen)
            return [as_objects(chosen)]
        if len(cases) != 2 or eqn.invars[0].aval.dtype != bool:
            raise NotNumbers("a choice between more than two")
        kind = _kind(out.dtype)
        columns = (np.broadcast_to(as_objects(x), out.shape).ravel().tolist() for x in args)
        return [objects([self.graph.select(a, b, c, kind) for a, b, c in zip(*columns, strict=True)], out.shape)]

    def _clamp(self, params, args, eqn):
        low, x, high = (np.broadcast_to(as_objects(x), eqn.outvars[0].aval.shape).ravel().tolist() for x in args)
        clamped = [self.graph.clamp(a, b, c) for a, b, c in zip(low, x, high, strict=True)]
        return [objects(clamped, eqn.outvars[0].aval.shape)]

    def _dot_general(self, params, args, eqn):
        a, b = args
        (sum_a, sum_b), (batch_a, batch_b) = params["dimension_numbers"]
        out = eqn.outvars[0].aval
        length, count = math.prod(a.shape[i] for i in sum_a), math.prod(a.shape[i] for i in batch_a)
        rows = math.prod(n for i, n in enumerate(a.shape) if i not in (*batch_a, *sum_a))
        columns = math.prod(n for i, n in enumerate(b.shape) if i not in (*batch_b, *sum_b))
        a = np.moveaxis(a, (*batch_a, *sum_a), (*range(len(batch_a)), *range(-len(sum_a), 0))).reshape(
            count, rows, length
        )
        b = np.moveaxis(b, (*batch_b, *sum_b), (*range(len(batch_b)), *range(-len(sum_b), 0))).reshape(
            count, columns, length
        )
        # The result may be asked for in a wider type than that of the operands, and is summed in it.
        a, b = (self._as_dtype(x, out.dtype) for x in (a, b))
        if out.dtype == bool:
            raise NotNumbers("a product of bools")
        if a.dtype.kind != "O" and b.dtype.kind != "O":
            return [np.asarray(a @ b.transpose(0, 2, 1), out.dtype).reshape(out.shape)]
        zero = as_kind(0, _kind(out.dtype))
        return [objects(matrices.product(self.graph, as_objects(a), as_objects(b), zero), out.shape)]

    def _as_dtype(self, x: np.ndarray, dtype) -> np.ndarray:
        """An array, known or not, as one of a dtype."""
        if x.dtype.kind != "O":
            return converted(x, dtype)
        kind = _kind(dtype)
        return objects([self.graph.convert(y, kind) for y in x.ravel().tolist()], x.shape)

    def _scatter(self, params, args, eqn):
        operand, indices, updates = args
        entries, adds = as_objects(operand).ravel().tolist(), eqn.primitive.name != "scatter"
        places = written(eqn, operand, indices, updates)
        for value, i in zip(as_objects(updates).ravel().tolist(), places, strict=True):
            if i is not None:
                entries[i] = self.graph.add(entries[i], value) if adds else value
        return [objects(entries, operand.shape)]

    def _cumsum(self, params, args, eqn):
        x = np.moveaxis(as_objects(args[0]), params["axis"], 0)
        order = range(x.shape[0])
        order = reversed(order) if params["reverse"] else order
        sums, total = np.empty(x.shape, object), None
        for i in order:
            total = x[i] if total is None else self.elementwise["add"](total, x[i])
            sums[i] = total
        return [np.moveaxis(sums, 0, params["axis"])]

    def _scan(self, params, args, eqn):
        count, carried = scan_counts(params)
        consts, carry, rows = args[:count], args[count : count + carried], args[count + carried :]
        saved: list[list] = []
        length = params["length"]
        for i in reversed(range(length)) if params["reverse"] else range(length):
            results = self.closed(params["jaxpr"], [*consts, *carry, *(x[i, ...] for x in rows)])
            carry = results[:carried]
            saved.append(results[carried:])
        if params["reverse"]:
            saved.reverse()
        outs = [x.aval for x in eqn.outvars[carried:]]
        if not length:
            return [*carry, *(np.zeros(x.shape, x.dtype) for x in outs)]
        return [*carry, *(_stacked(column) for column in zip(*saved, strict=True))]

    def _while(self, params, args, eqn):
        count, more = params["cond_nconsts"], params["body_nconsts"]
        of_cond, of_body, carry = args[:count], args[count : count + more], args[count + more :]
        while True:
            (going,) = self.closed(params["cond_jaxpr"], [*of_cond, *carry])
            going = as_objects(going).item()
            if type(going) is Number:
                raise NotNumbers("a while_loop whose end is not known")
            if not going:
                return carry
            carry = self.closed(params["body_jaxpr"], [*of_body, *carry])

    def _cond(self, params, args, eqn):
        which = as_objects(args[0]).item()
        if type(which) is Number:
            raise NotNumbers("a cond whose branch is not known")
        branches = params["branches"]
        return self.closed(branches[min(max(int(which), 0), len(branches) - 1)], args[1:])

    def _linear_solve(self, params, args, eqn):
        counts, jaxprs = params["const_lengths"], params["jaxprs"]
        before = counts.matvec + counts.vecmat
        solve_consts = args[before : before + counts.solve]
        right = args[before + counts.solve + counts.transpose_solve :]
        self.has_rules = True
        return self.closed(jaxprs.solve, [*solve_consts, *right])

    def _kernel(self, params, args, eqn):
        inner = params["program"]
        if not isinstance(inner, Program):
            if not mode.is_standalone():
                raise NotNumbers(inner.name)
            # Rotations until columns are orthogonal: loops, which are called. A batch has leading axes.
            self.has_rules = True
            lead = args[0].shape[:-1]
            rows = as_objects(args[0]).reshape(-1, inner.inputs[0].size)
            results = [self.graph.call(inner, [row])[0].ravel() for row in rows]
            return [np.stack(results).reshape(*lead, -1)]
        shaped = [as_objects(x).reshape(array.shape) for x, array in zip(args, inner.inputs, strict=True)]
        self.has_rules |= inner.derivative is not None
        if self.calls and inner.cost >= MIN_SUBPROGRAM_OPERATIONS and not inner.subprograms:
            return [x.ravel() for x in self.graph.call(inner, shaped)]
        return [x.ravel() for x in self.graph.replay(inner, shaped)[1]]

    def _cholesky(self, params, args, eqn):
        given = as_objects(args[0]).reshape(-1, *args[0].shape[-2:])
        return [np.stack([matrices.cholesky(self.graph, x) for x in given]).reshape(args[0].shape)]

    def _triangular_solve(self, params, args, eqn):
        a, b = (as_objects(x) for x in args)
        if params["transpose_a"]:
            a = np.swapaxes(a, -1, -2)
        lower = params["lower"] != params["transpose_a"]
        if not params["left_side"]:  # x a = b is a^T x^T = b^T
            a, b, lower = np.swapaxes(a, -1, -2), np.swapaxes(b, -1, -2), not lower
        pairs = zip(a.reshape(-1, *a.shape[-2:]), b.reshape(-1, *b.shape[-2:]), strict=True)
        solutions = [matrices.triangular_solve(self.graph, x, y, lower, params["unit_diagonal"]) for x, y in pairs]
        solutions = np.stack(solutions).reshape(b.shape)
        return [solutions if params["left_side"] else np.swapaxes(solutions, -1, -2)]


@functools.lru_cache(maxsize=256)
def _subprogram(inner: ClosedJaxpr, known: tuple, most: int) -> tuple[Program, bool]:
    """The program of a function that others call, and whether it has rules.

    `known`: shape, dtype and bytes of the arguments that are compiled in; None for the others. Where numbers may be
    flagged, there is one more output, which says whether one is.
    """
    graph = Graph(most)
    arrays = [Array(x.aval.shape, np.dtype(x.aval.dtype)) for x in inner.jaxpr.invars]  # pyright: ignore[reportAttributeAccessIssue]
    inputs = [array for array, x in zip(arrays, known, strict=True) if x is None]
    entries = iter([graph.inputs(place, array) for place, array in enumerate(inputs)])
    expansion = _Expansion(graph, False)
    args = [next(entries) if x is None else np.frombuffer(x[2], x[1]).reshape(x[0]) for x in known]
    results = [as_objects(x) for x in expansion.closed(inner, args)]
    outputs = [Array(x.aval.shape, np.dtype(x.aval.dtype)) for x in inner.jaxpr.outvars]  # pyright: ignore[reportAttributeAccessIssue]
    if expansion.flagged is not False:
        outputs.append(_FLAG)
        results.append(objects([expansion.flagged], ()))
    return graph.finish(inputs, outputs, results), expansion.has_rules


_INNER = {
    "jit": "jaxpr", "closed_call": "call_jaxpr", "eval_jaxpr": "call_jaxpr", "remat2": "jaxpr",
    "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr",
}  # fmt: skip
_OTHER: dict[str, Callable] = {
    "copy": _Expansion._same,
    "optimization_barrier": _Expansion._same,
    "pvary": _Expansion._same,
    "convert_element_type": _Expansion._convert,
    "integer_pow": _Expansion._integer_pow,
    "select_n": _Expansion._select,
    "clamp": _Expansion._clamp,
    "dot_general": _Expansion._dot_general,
    "scatter-add": _Expansion._scatter,
    "scatter": _Expansion._scatter,
    "cumsum": _Expansion._cumsum,
    "polynomial": _Expansion._polynomial,
    "scan": _Expansion._scan,
    "while": _Expansion._while,
    "cond": _Expansion._cond,
    "custom_linear_solve": _Expansion._linear_solve,
    "cholesky": _Expansion._cholesky,
    "triangular_solve": _Expansion._triangular_solve,
    "jaxdyn_kernel": _Expansion._kernel,
    "jaxdyn_unless": _Expansion._unless,
}

# Maxima and minima are of integers too.
_OF_FLOATS = {*numbers.FUNCTIONS, *numbers.FUNCTIONS_OF_TWO, "log2", "one_minus_square"} - {
    "max",
    "min",
    "stop_gradient",
}


def _constant(x) -> np.ndarray:
    if isinstance(x, Tracer):
        raise NotNumbers("a number of an enclosing function")
    return np.asarray(x)


def _kind(dtype) -> str:
    try:
        return kind_of(dtype)
    except KeyError:
        raise NotNumbers(f"numbers of {dtype}") from None


def _stacked(rows: Sequence) -> np.ndarray:
    if any(x.dtype.kind == "O" for x in rows):
        return np.stack([as_objects(x) for x in rows])
    return np.stack(rows)
