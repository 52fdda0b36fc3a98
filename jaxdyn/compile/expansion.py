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
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import array_rules, jax_adapter, mode, rearrange, rolled
from jaxdyn.compile import program as numbers
from jaxdyn.compile.array_rules import bind_known, empty_reduction, evaluate_known
from jaxdyn.compile.derive import replay, without_unread
from jaxdyn.compile.graph import Graph
from jaxdyn.compile.jax_adapter import ClosedJaxpr, Literal, Tracer  # pyright: ignore[reportPrivateImportUsage]
from jaxdyn.compile.program import (
    Array,
    FlaggedIteration,
    NotNumbers,
    Number,
    Program,
    as_kind,
    as_objects,
    is_number,
    kind_or_refuse,
    objects,
)
from jaxdyn.compile.rearrange import AT_PLACES, REARRANGEMENTS

# A function of fewer operations is written out where it is called.
MIN_SUBPROGRAM_OPERATIONS = 300


def expand(
    closed: ClosedJaxpr, maximum: int, name: str = "", calls: bool = False, flags: str = "refuse"
) -> tuple[Program, bool]:
    """The program of a jaxpr, and whether it has functions whose derivatives are given by rules of their own.

    With `calls`, functions under `jax.jit` of at least `MIN_SUBPROGRAM_OPERATIONS` operations become subprograms, and so does the
    first function of a `lax.cond`, which is called where a sample takes it; the second one is computed for all samples.

    `flags`: what to do about numbers that are flagged (see `flags`). "refuse" them; "ignore" them, as a derivative does, whose
    values report them; "report" them by one more output, a bool that is True for valid samples; or "report_always", with
    that output, a constant, where no number is flagged too.

    **Raises:** `NotNumbers`, `TooLong`.
    """
    graph = Graph(maximum)
    inputs = _arrays_of(closed.jaxpr.invars)
    outputs = _arrays_of(closed.jaxpr.outvars)
    for array in (*inputs, *outputs):
        if array.dtype.name not in ("float64", "float32", "bool", "int32", "int64"):
            raise NotNumbers(f"an array of {array.dtype}")
    expansion = _Expansion(graph, calls, calls)
    entries = [graph.inputs(place, array) for place, array in enumerate(inputs)]
    with np.errstate(all="ignore"):  # known numbers may be none, as in branches that are not taken
        results = expansion.evaluate(closed, entries)
    if expansion.flagged is not False and flags == "refuse":
        raise NotNumbers("samples that a program without branches cannot compute")
    reports = flags == "report_always" or (flags == "report" and expansion.flagged is not False)
    if reports:
        outputs.append(_FLAG)
        results.append(objects([graph.invert(expansion.flagged)], ()))
    program = graph.finish(inputs, outputs, [as_objects(x) for x in results], name=name)
    program.reports_validity = reports
    return program, expansion.has_rules


_FLAG = Array((), np.dtype(bool))


class _Expansion:
    def __init__(self, graph: Graph, calls: bool, branches: bool):
        self.graph = graph
        self.has_rules = False
        self.flagged: Any = False  # whether any number is
        self.calls, self.branches = calls, branches
        binary = {"add": graph.add, "add_any": graph.add, "sub": graph.sub, "mul": graph.mul}
        binary |= {"and": graph.both, "or": graph.either}
        binary |= {name: functools.partial(graph.compare, name) for name in numbers.COMPARISONS}
        binary |= {name: functools.partial(graph.function_of_two, name) for name in numbers.FUNCTIONS_OF_TWO}
        binary |= {"lt_to": functools.partial(self._precedes, "lt"), "le_to": functools.partial(self._precedes, "le")}
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

    def evaluate(self, inner, args) -> list:
        """The results of a jaxpr: a closed one, or one without constants."""
        jaxpr, consts = (inner.jaxpr, inner.consts) if isinstance(inner, ClosedJaxpr) else (inner, ())
        values = dict(zip(jaxpr.constvars, (_constant(x) for x in consts), strict=True))
        values.update(zip(jaxpr.invars, args, strict=True))

        def read(atom):
            return np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]

        for eqn in jaxpr.eqns:
            # A side effect would happen while the program is written, once, instead of at every call.
            if eqn.effects:
                raise NotNumbers(f"{eqn.primitive.name} has side effects")
            try:
                results = self.one(eqn, [read(x) for x in eqn.invars])
            except NotNumbers as reason:
                # From the inside out: JAX keeps the jaxprs of its own functions, with the places of their first calls.
                reason.place = jax_adapter.place_of(eqn) or reason.place
                raise
            values.update(zip(eqn.outvars, results, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def evaluate_in(self, graph: Graph, inner: ClosedJaxpr, args) -> list:
        """The results of a jaxpr in another graph, that of an iteration of a loop."""
        inside = _Expansion(graph, self.calls, self.branches)
        results = inside.evaluate(inner, args)
        self.has_rules |= inside.has_rules
        if inside.flagged is not False:
            raise FlaggedIteration("samples that an iteration of a loop cannot compute")
        return results

    def one(self, eqn, args) -> list:
        name, params = eqn.primitive.name, eqn.params
        # A kernel's reverse mode is the transpose of its forward mode, which such a function has not.
        if name.startswith("custom_vjp") and any(x.dtype.kind == "O" for x in args):
            raise NotNumbers(f"{name}, whose derivative is known in reverse alone")
        if name in _INNER:
            inner = params[_INNER[name]]
            self.has_rules |= name.startswith("custom_")
            if self.calls and name == "jit":
                return self._call(inner, args)
            return self.evaluate(inner, args)
        rule = _OTHER.get(name)
        if rule is not None:
            return rule(self, params, args, eqn)
        if name in AT_PLACES:
            if any(x.dtype.kind == "O" for x in args[_ARRAYS[name] :]):
                return rearrange.at_place(AT_PLACES[name], self, params, args, eqn)
            return AT_PLACES[name](params, args, eqn)
        out = eqn.outvars[0].aval
        known = all(x.dtype.kind != "O" for x in args)
        if name == "round" and params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
            return [bind_known(eqn, args) if known else self._round(args[0], out.dtype)]
        if name in REARRANGEMENTS:
            results = REARRANGEMENTS[name](params, args if known else [as_objects(x) for x in args], out)
            return [x if known else as_objects(x) for x in results] if eqn.primitive.multiple_results else [results]
        # After the rearrangements, which need no copy: constants of a model go through thousands of slices.
        if known:
            return [evaluate_known(eqn, args)]
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
            return [self._reduce(name, args[0], params["axes"], out)]
        raise NotNumbers(name)

    def _call(self, inner: ClosedJaxpr, args, again=None) -> list:
        """A function as a subprogram, if it is long; `again` as of `flags.guarded_p`."""
        inner, inner_args, again, args = _innermost(inner, args, again, args)
        program, given = self._subprogram(inner, inner_args)
        # A short one is written in its place, where zeros of its arguments are seen. A call does not know them.
        is_short = program.cost < MIN_SUBPROGRAM_OPERATIONS or not self.calls
        results = replay(self.graph, program, given)[1] if is_short else self.graph.call(program, given)
        return self._repair(results, program, again, args)

    def _subprogram(self, inner: ClosedJaxpr, args) -> tuple[Program, list]:
        """A function as a subprogram, and its arguments without the known ones, which are compiled in."""
        known = tuple(None if x.dtype.kind == "O" else (x.dtype.str, x.tobytes()) for x in args)
        program, has_rules = _subprogram(inner, known, self.graph.maximum)
        self.has_rules |= has_rules
        program, places = without_unread(program)
        given = [x for x in args if x.dtype.kind == "O"]
        return program, [given[i] for i in places]

    def _repair(self, results: list, program: Program, again, args) -> list:
        """The results of a function; those that it flags, if it does, by the function `again` of `args`, if there is one."""
        if not program.flags:
            return results
        *results, flagged = results
        if again is None:
            self.flagged = self.graph.either(self.flagged, flagged.item())
            return results
        # One for each: a subprogram is known by its identity.
        if ("careful", again) not in program.derived:
            program.derived["careful", again] = again.beside(program)
        careful = program.derived["careful", again]
        return self.graph.call_where(flagged.item(), careful, [*map(as_objects, args)], results)

    def _reduce(self, name, array, axes, out):
        # Entries in XLA's order, one after the other: a sum of few numbers, whose order decides the rounding.
        fold, count = self.reductions[name], math.prod(array.shape[i] for i in axes)
        if not count:
            return as_objects(np.full(out.shape, empty_reduction(name, out.dtype), out.dtype))
        rows = np.moveaxis(as_objects(array), axes, range(len(axes))).reshape(count, math.prod(out.shape))
        return objects([fold(column) for column in rows.T.tolist()], out.shape)

    # --- rules that need more than the entries ---

    def _round(self, array, dtype):
        """To the nearest whole number, halves away from zero."""
        g = self.graph

        def round_one(x):
            size = g.function("abs", x)
            whole = g.function("floor", size)
            up = g.compare("ge", g.sub(size, whole), 0.5)  # not floor(|x| + 1/2), whose sum is round_one
            return g.mul(g.function("sign", x), g.select(up, whole, g.add(whole, 1.0), kind_or_refuse(dtype)))

        return objects([round_one(x) for x in array.ravel().tolist()], array.shape)

    def _precedes(self, op, a, b):
        """Decide whether a comes before b in the total order of JAX, in which NaN is the last."""
        g = self.graph
        last = g.both(g.compare("ne", b, b), g.compare("eq", a, a) if op == "lt" else True)
        return g.either(g.compare(op, a, b), last)

    def _one_less(self, x):
        """1 - x^2; the square where its rounding is small, else the product that is exact near one."""
        g = self.graph
        if not is_number(x):  # a known entry of an array with others
            return (1.0 + x) * (1.0 - x)
        # 1 - x x loses half of the digits near one, and (1 + x)(1 - x) is exact there.
        is_small = g.compare("lt", g.function("abs", x), 0.5)
        return g.select(is_small, g.mul(g.add(1.0, x), g.sub(1.0, x)), g.sub(1.0, g.mul(x, x)), x.kind)

    def _high(self, params, args, eqn):
        """A function that JAX keeps whole, such as searchsorted from version 0.12 on."""
        expand_whole, tree, has_rule = jax_adapter.expand_high(params)
        types = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in eqn.invars]
        inner = jax.make_jaxpr(lambda *x: jax.tree.leaves(expand_whole(*jax.tree.unflatten(tree, x))))(*types)
        self.has_rules |= has_rule and any(x.aval.dtype.kind == "f" for x in eqn.outvars)
        return self.evaluate(inner, args)

    def _invalid(self, params, args, eqn):
        flags, entries = (as_objects(x).ravel().tolist() for x in args)
        kind = kind_or_refuse(eqn.outvars[0].aval.dtype)
        for flag in flags:
            self.flagged = self.graph.either(self.flagged, flag)
        # NaN also in the program: a result that a caller takes without asking for validity must not look like a number.
        chosen = [self.graph.select(flag, x, math.nan, kind) for flag, x in zip(flags, entries, strict=True)]
        return [objects(chosen, args[1].shape)]

    def _nan_where(self, params, args, eqn):
        """NaN where a flag is set and the number is not zero, else zero: derivatives of what has failed."""
        g, kind = self.graph, kind_or_refuse(eqn.outvars[0].aval.dtype)
        pairs = zip(*(as_objects(x).ravel().tolist() for x in args), strict=True)
        chosen = [g.select(g.both(flag, g.compare("ne", x, 0.0)), 0.0, math.nan, kind) for flag, x in pairs]
        return [objects(chosen, args[1].shape)]

    def _cond(self, params, args, eqn):
        which, branches = as_objects(args[0]).item(), params["branches"]
        if type(which) is not Number:
            return self.evaluate(branches[min(max(int(which), 0), len(branches) - 1)], args[1:])
        if not self.branches or len(branches) != 2:
            raise NotNumbers("a cond whose branch is not known")
        # The second one is a subprogram, which hardly any sample calls.
        otherwise = [as_objects(x) for x in self.evaluate(branches[0], args[1:])]
        rare, rare_args, again, args = _innermost(branches[1], args[1:], None, args[1:])
        program, given = self._subprogram(rare, rare_args)
        if program.flags:
            otherwise.append(objects([False], ()))
        # JAX makes an integer of the flag.
        flag = which.args[0] if which.op == "convert" else self.graph.compare("ne", which, as_kind(0, which.kind))
        results = self.graph.call_where(flag, program, given, otherwise)
        return self._repair(results, program, again, args)

    def _linear_solve(self, params, args, eqn):
        counts, jaxprs = params["const_lengths"], params["jaxprs"]
        before = counts.matvec + counts.vecmat
        solve_consts = args[before : before + counts.solve]
        right = args[before + counts.solve + counts.transpose_solve :]
        # Derivatives are those of the solved equations (JAX's rule), not those of how they are solved.
        self.has_rules = True
        return self.evaluate(jaxprs.solve, [*solve_consts, *right])

    def _kernel(self, params, args, eqn):
        inner = params["program"]
        if not isinstance(inner, Program):  # loops and pseudo-inverses have branches
            if not (inner.is_called and (mode.is_standalone() or mode.is_careful())):
                raise NotNumbers(inner.name)
            # Code of its own that this program calls. A batch has leading axes.
            self.has_rules = True
            lead = args[0].shape[:-1]
            rows = as_objects(args[0]).reshape(-1, inner.inputs[0].size)
            results = [self.graph.call(inner, [row])[0].ravel() for row in rows]
            return [np.stack(results).reshape(*lead, -1)]
        lead = max((x.shape[:-1] for x in args), key=len)
        if not lead:
            return self._one_call(inner, args)
        # A batch, such as the columns of a Jacobian: inputs that all of it share have no leading axes.
        rows = [self._one_call(inner, [x[i] if x.ndim > 1 else x for x in args]) for i in np.ndindex(lead)]
        return [np.stack(column).reshape(*lead, -1) for column in zip(*rows, strict=True)]

    def _one_call(self, inner: Program, args) -> list:
        """The results of a kernel within this one, for one sample."""
        shaped = [as_objects(x).reshape(array.shape) for x, array in zip(args, inner.inputs, strict=True)]
        self.has_rules |= inner.derivative is not None
        fast = inner if inner.fast is None else inner.fast
        # A kernel within this one: called where it is long, else written out.
        if self.calls and fast.cost >= MIN_SUBPROGRAM_OPERATIONS and not fast.subprograms:
            results = self.graph.call(fast, shaped)
        else:
            results = replay(self.graph, fast, shaped)[1]
        if inner.careful is not None:
            *results, valid = results
            flag = self.graph.invert(valid.item())
            if self.branches:
                results = self.graph.call_where(flag, inner.careful, shaped, results)
            else:
                self.flagged = self.graph.either(self.flagged, flag)
        return [x.ravel() for x in results]


def _innermost(inner: ClosedJaxpr, args: Sequence, again, given: Sequence) -> tuple[ClosedJaxpr, list, Any, list]:
    """The function under `jax.jit` to which a function comes down, with its arguments, or the function itself.

    Also what computes its flagged samples, with the arguments of that. A branch that repeats a call so shares its subprogram.
    """
    jaxpr = inner.jaxpr
    name = jaxpr.eqns[0].primitive.name if len(jaxpr.eqns) == 1 else ""
    if name not in ("jit", "jaxdyn_guarded") or jaxpr.eqns[0].outvars != jaxpr.outvars or (name != "jit" and again):
        return inner, list(args), again, list(given)
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*map(_constant, inner.consts), *args], strict=True))
    params = jaxpr.eqns[0].params
    args = [np.asarray(x.val) if isinstance(x, Literal) else values[x] for x in jaxpr.eqns[0].invars]
    if name == "jit":
        return _innermost(params["jaxpr"], args, again, given)
    return _innermost(params["call"], args, params["again"], args)


def _arrays_of(variables: Any) -> list[Array]:
    """Shapes and dtypes of variables of a jaxpr."""
    return [Array(x.aval.shape, np.dtype(x.aval.dtype)) for x in variables]


@functools.lru_cache(maxsize=256)
def _subprogram(inner: ClosedJaxpr, known: tuple, maximum: int) -> tuple[Program, bool]:
    """The program of a function that others call, and whether it has rules.

    `known`: dtypes and bytes of the arguments that are known, None for others. Where numbers may be flagged, there is one more
    output, which says whether one is.
    """
    # By the identity of the jaxpr, which JAX keeps for a function under `jit`: of all calls of a function one program is made.
    graph = Graph(maximum)
    arrays = _arrays_of(inner.jaxpr.invars)
    # A subprogram makes no calls of its own but branches: only programs that have both call it.
    expansion, inputs, args = _Expansion(graph, False, True), [], []
    for array, x in zip(arrays, known, strict=True):
        if x is None:
            args.append(graph.inputs(len(inputs), array))
            inputs.append(array)
        else:
            args.append(np.frombuffer(x[1], x[0]).reshape(array.shape))
    results = [as_objects(x) for x in expansion.evaluate(inner, args)]
    outputs = _arrays_of(inner.jaxpr.outvars)
    if expansion.flagged is not False:
        outputs.append(_FLAG)
        results.append(objects([expansion.flagged], ()))
    program = graph.finish(inputs, outputs, results)
    program.flags = expansion.flagged is not False
    return program, expansion.has_rules


_INNER = {
    "jit": "jaxpr", "closed_call": "call_jaxpr", "eval_jaxpr": "call_jaxpr", "remat2": "jaxpr",
    "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr",
}  # fmt: skip
_OTHER: dict[str, Callable] = {
    **dict.fromkeys(("copy", "optimization_barrier", "pvary"), lambda self, params, args, eqn: args),
    "convert_element_type": array_rules.convert,
    "integer_pow": array_rules.integer_pow,
    "select_n": array_rules.select,
    "clamp": array_rules.clamp,
    "dot_general": array_rules.dot_general,
    "scatter-add": array_rules.scatter,
    "scatter": array_rules.scatter,
    "gather": rearrange.gather_at,
    "argmax": rearrange.extreme_place,
    "argmin": rearrange.extreme_place,
    "call_hi_primitive": _Expansion._high,
    "polynomial": array_rules.polynomial,
    **dict.fromkeys(("cumsum", "cumprod", "cummax", "cummin"), rearrange.cumulative),
    "scan": rolled.scan,
    "jaxdyn_sweep": rolled.sweep,
    "while": rolled.while_loop,
    "cond": _Expansion._cond,
    "custom_linear_solve": _Expansion._linear_solve,
    "cholesky": array_rules.cholesky,
    "lu": rearrange.lu,
    "triangular_solve": array_rules.triangular_solve,
    "jaxdyn_kernel": _Expansion._kernel,
    "jaxdyn_invalid": _Expansion._invalid,
    "jaxdyn_nan_where": _Expansion._nan_where,
    "jaxdyn_guarded": lambda self, params, args, eqn: self._call(params["call"], args, params["again"]),
}

# The arrays before the places.
_ARRAYS = {"dynamic_slice": 1, "dynamic_update_slice": 2}
# Maxima and minima are of integers too.
_OF_FLOATS = {*numbers.FUNCTIONS, *numbers.FUNCTIONS_OF_TWO, "log2", "one_minus_square"} - {
    "max",
    "min",
    "stop_gradient",
}


def _constant(x) -> np.ndarray:
    if isinstance(x, Tracer):
        raise NotNumbers("a number of an enclosing function")
    if jnp.issubdtype(getattr(x, "dtype", float), jax.dtypes.extended):  # a key, which numpy does not have
        raise NotNumbers(f"an array of {x.dtype}")
    return np.asarray(x)
