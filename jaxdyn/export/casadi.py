"""Functions behind CasADi's interface for external functions, so that `casadi.external` has exact first derivatives.

CasADi stores matrices by columns, and sparse ones as the entries of a pattern. The pattern of a Jacobian leaves out
structural zeros, which no input can make other than zero. A null pointer stands for an argument that is zero, or for a result
that is not asked for.

Source: CasADi's user guide, "Using the generated code", and the signatures that its code generator writes.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.compile import standalone
from jaxdyn.compile.directions import Directions
from jaxdyn.compile.program import Array, Constant
from jaxdyn.compile.standalone import Routine, Text
from jaxdyn.export.arguments import fields_of


class Pattern(NamedTuple):
    """A sparse matrix of CasADi's: its stored places, and for each entry of the program's array the place where it is stored."""

    stored: np.ndarray  # (rows, columns) of bools
    places: np.ndarray  # for each entry, by rows, its place among the stored ones by columns; -1 where it is not stored

    @property
    def count(self) -> int:
        """Number of stored entries."""
        return int(self.stored.sum())

    def description(self) -> list[int]:
        """Rows, columns, where each column begins, and the rows of the stored entries."""
        starts = np.concatenate([[0], np.cumsum(self.stored.sum(axis=0))])
        return [*self.stored.shape, *starts.tolist(), *np.nonzero(self.stored.T)[1].tolist()]


def _by_columns(stored: np.ndarray) -> np.ndarray:
    """For each place of a matrix, the number of stored places before it, by columns; -1 where it is not stored."""
    places = np.full(stored.T.shape, -1)
    places[stored.T] = np.arange(stored.sum())
    return places.T


def _dense(array: Array) -> Pattern:
    """Of a vector a column; leading axes of an array of more than two become rows."""
    columns = array.shape[-1] if len(array.shape) > 1 else 1
    stored = np.ones((array.size // max(columns, 1), columns), bool)
    return Pattern(stored, _by_columns(stored).ravel())


def _block(is_stored: np.ndarray, of: Pattern, by: Pattern) -> Pattern:
    """Of a Jacobian, whose rows and columns are the entries of two dense matrices by columns."""
    where = np.ix_(of.places, by.places)
    stored = np.zeros(is_stored.shape, bool)
    stored[where] = is_stored
    return Pattern(stored, _by_columns(stored)[where].ravel())


def casadi_ir(exported: Any, lanes: int) -> str:
    """The text of `name`, and of `jac_name` where the Jacobian was exported, with all that CasADi asks of them."""
    program, jacobian = exported.value.program, exported.derivative
    inputs, outputs = list(map(_dense, program.inputs)), list(map(_dense, program.outputs[:-1]))
    functions = _functions(exported.name, exported.value, exported, inputs, outputs, [], lanes)
    if jacobian is not None:
        patterns, count = [], len(inputs)
        for i, array in enumerate(jacobian.program.outputs[:-1]):
            rows = [x.results[i] for x in jacobian.programs]
            # An entry is left out where it is zero for regular and for singular samples.
            is_stored = [
                any(type(x) is not Constant or x.value != 0 for x in entries) for entries in zip(*rows, strict=True)
            ]
            patterns.append(_block(np.reshape(is_stored, array.shape), outputs[i // count], inputs[i % count]))
        functions += _functions(f"jac_{exported.name}", jacobian, exported, inputs, patterns, outputs, lanes)
    return standalone.module_ir(*functions)


def _functions(
    name: str,
    routine: Routine,
    exported: Any,
    inputs: Sequence[Pattern],
    outputs: Sequence[Pattern],
    nominal: Sequence[Pattern],
    lanes: int,
) -> list[Text]:
    """The text of one function of CasADi's interface; `nominal` are the results that a Jacobian is given as further arguments."""
    core, given = f"{name}_core", [*inputs, *nominal]
    places = {i: pattern.places for i, pattern in enumerate(inputs)}
    # A Jacobian that is computed by columns is stored dense in the work vector, and copied from there.
    is_dense = any(isinstance(x, Directions) for x in routine.programs)
    results = None if is_dense else [pattern.places for pattern in outputs]
    fields, routine = fields_of(exported.arguments), routine._replace(symbol=core)
    texts = standalone.routine_ir(routine, fields, lanes=lanes, places=places, results=results, internal=True)
    lines = [f"@{name}_zero = internal constant [{max([1, *(x.count for x in inputs)])} x double] zeroinitializer"]
    for kind, patterns in (("in", given), ("out", outputs)):
        for i, pattern in enumerate(patterns):
            numbers = pattern.description()
            entries = ", ".join(f"i64 {x}" for x in numbers)
            lines.append(f"@{name}_{kind}{i} = internal constant [{len(numbers)} x i64] [{entries}]")
        lines += [f"define i64 @{name}_n_{kind}() #0 {{", f"  ret i64 {len(patterns)}", "}"]
        cases = " ".join(f"i64 {i}, label %case{i}" for i in range(len(patterns)))
        lines += [f"define ptr @{name}_sparsity_{kind}(i64 %i) #0 {{", f"  switch i64 %i, label %other [ {cases} ]"]
        for i in range(len(patterns)):
            lines += [f"case{i}:", f"  ret ptr @{name}_{kind}{i}"]
        lines += ["other:", "  ret ptr null", "}"]
    # Results that are not asked for are written to the work vector.
    sizes = [x.stored.size for x in outputs]
    work = sum(sizes) if is_dense else max([0, *(x.count for x in outputs)])
    lines += [f"define i32 @{name}_work(ptr %args, ptr %results, ptr %iw, ptr %w) #0 {{"]
    for pointer, size in (("%args", len(given)), ("%results", len(outputs)), ("%iw", 0), ("%w", work)):
        lines.append(f"  store i64 {size}, ptr {pointer}")
    lines += ["  ret i32 0", "}"]
    lines += [f"define i32 @{name}(ptr %args, ptr %results, ptr %iw, ptr %w, i32 %mem) #0 {{"]
    for i in range(len(inputs)):
        lines += [
            f"  %pa{i} = getelementptr ptr, ptr %args, i64 {i}",
            f"  %la{i} = load ptr, ptr %pa{i}",
            f"  %na{i} = icmp eq ptr %la{i}, null",
            f"  %a{i} = select i1 %na{i}, ptr @{name}_zero, ptr %la{i}",
        ]
    for i in range(len(outputs)):
        lines += [
            f"  %pr{i} = getelementptr ptr, ptr %results, i64 {i}",
            f"  %lr{i} = load ptr, ptr %pr{i}",
            f"  %nr{i} = icmp eq ptr %lr{i}, null",
            f"  %r{i} = select i1 %nr{i}, ptr %w, ptr %lr{i}",
            f"  %d{i} = getelementptr double, ptr %w, i64 {sum(sizes[:i])}",
        ]
    pointers = [f"ptr %a{i}" for i in range(len(inputs))]
    pointers += [f"ptr %{'d' if is_dense else 'r'}{i}" for i in range(len(outputs))]
    lines += [f"  %status = call i32 @{core}({', '.join(pointers)})"]
    declared = {}
    if is_dense:
        declared["copy_entries"] = _COPY_ENTRIES
        for i, pattern in enumerate(outputs):
            places_in_memory = np.argsort(pattern.places, kind="stable")[pattern.places.size - pattern.count :]
            entries = ", ".join(f"i64 {x}" for x in places_in_memory)
            table = f"@{name}_entries{i}"
            declared[table] = f"{table} = internal constant [{pattern.count} x i64] [{entries}]"
            count = f"%n{i}"
            lines += [f"  {count} = select i1 %nr{i}, i64 0, i64 {pattern.count}"]
            lines += [f"  call void @copy_entries(i64 {count}, ptr {table}, ptr %d{i}, ptr %r{i})"]
    lines += ["  ret i32 %status", "}"]
    return [*texts, Text("\n".join(lines), declared)]


# Copies dense[entries[k]] to stored[k] for k = 0 .. n - 1.
_COPY_ENTRIES = """define internal void @copy_entries(i64 %n, ptr %entries, ptr %dense, ptr %stored) #0 {
entry:
  %some = icmp sgt i64 %n, 0
  br i1 %some, label %one, label %done
one:
  %k = phi i64 [ 0, %entry ], [ %next, %one ]
  %at = getelementptr i64, ptr %entries, i64 %k
  %place = load i64, ptr %at
  %from = getelementptr double, ptr %dense, i64 %place
  %x = load double, ptr %from
  %to = getelementptr double, ptr %stored, i64 %k
  store double %x, ptr %to
  %next = add i64 %k, 1
  %more = icmp slt i64 %next, %n
  br i1 %more, label %one, label %done
done:
  ret void
}"""
