"""Functions behind CasADi's interface for external functions, so that `casadi.external` has exact first derivatives.

CasADi stores matrices by columns, and of sparse ones only the entries of a pattern. The pattern of a Jacobian leaves out
structural zeros: entries that are zero for every input. A null pointer stands for an argument that is zero, or for a result that
CasADi does not need.

Source: CasADi's user guide, "Using the generated code", and the signatures that its code generator writes.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.compile import standalone
from jaxdyn.compile.directions import Directions
from jaxdyn.compile.program import Array, Constant
from jaxdyn.compile.standalone import Routine, Text
from jaxdyn.exports.arguments import fields_of


class Pattern(NamedTuple):
    """Sparsity pattern of a matrix of CasADi, and the place of each entry of the program's array in it."""

    stored: np.ndarray  # (rows, columns) of bools
    places: np.ndarray  # for each entry, by rows, its place among the stored ones by columns; -1 where it is not stored

    @property
    def count(self) -> int:
        """Number of stored entries."""
        return int(self.stored.sum())

    def order(self) -> np.ndarray:
        """For each stored entry, by columns, its index in the program's array."""
        # Entries that are not stored have the place -1 and come first: they are cut off.
        return np.argsort(self.places, kind="stable")[self.places.size - self.count :]

    def description(self) -> list[int]:
        """Rows, columns, the start of each column, and the rows of the stored entries: CasADi's compressed columns."""
        starts = np.concatenate([[0], np.cumsum(self.stored.sum(axis=0))])
        return [*self.stored.shape, *starts.tolist(), *np.nonzero(self.stored.T)[1].tolist()]


def _by_columns(stored: np.ndarray) -> np.ndarray:
    """Number of stored entries before each entry of a matrix, by columns; -1 for entries that are not stored."""
    places = np.full(stored.T.shape, -1)
    places[stored.T] = np.arange(stored.sum())
    return places.T


def _dense(array: Array) -> Pattern:
    """Pattern of an array: a vector is a column, and leading axes of more than two become rows."""
    columns = array.shape[-1] if len(array.shape) > 1 else 1
    # An axis may have length zero; `max` avoids a division by it.
    stored = np.ones((array.size // max(columns, 1), columns), bool)
    return Pattern(stored, _by_columns(stored).ravel())


def _block(is_stored: np.ndarray, result: Pattern, argument: Pattern) -> Pattern:
    """Pattern of a Jacobian: rows and columns are the entries of a result and of an argument, each by columns as in CasADi."""
    where = np.ix_(result.places, argument.places)
    stored = np.zeros(is_stored.shape, bool)
    stored[where] = is_stored
    return Pattern(stored, _by_columns(stored)[where].ravel())


def casadi_ir(exported: Any, lanes: int) -> str:
    """Text of `name`, and of `jac_name` where the Jacobian was exported, with the functions that describe them to CasADi."""
    # CasADi finds the Jacobian of `name` by the name of its function, `jac_name`, and asks it for all blocks at once.
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
    """One function of CasADi's interface; `nominal` are the results, which CasADi passes to a Jacobian after the arguments."""
    core = f"{name}_core"
    places = {i: pattern.places for i, pattern in enumerate(inputs)}
    # A Jacobian by columns stores whole rows of vector registers, so it is stored dense in the work vector and copied from there.
    is_dense = any(isinstance(x, Directions) for x in routine.programs)
    results = None if is_dense else [pattern.places for pattern in outputs]
    fields, routine = fields_of(exported.arguments), routine._replace(symbol=core)
    texts = standalone.routine_ir(routine, fields, lanes=lanes, places=places, results=results, internal=True)
    sizes = [x.stored.size for x in outputs]
    # Results whose pointer is null are written to the work vector.
    work = sum(sizes) if is_dense else max([0, *(x.count for x in outputs)])
    # The results at the point are arguments of a Jacobian, which does not read them.
    lines = _descriptions(name, [*inputs, *nominal], outputs, work)
    lines.append(f"define i32 @{name}(ptr %args, ptr %results, ptr %iw, ptr %w, i32 %mem) #0 {{")
    lines += _pointers("a", "%args", len(inputs), f"@{name}_zero") + _pointers("r", "%results", len(outputs), "%w")
    passed, declared = [f"ptr %a{i}" for i in range(len(inputs))], {}
    for i in range(len(outputs)):
        lines.append(f"  %d{i} = getelementptr double, ptr %w, i64 {sum(sizes[:i])}")
        passed.append(f"ptr %d{i}" if is_dense else f"ptr %r{i}")
    lines.append(f"  %status = call i32 @{core}({', '.join(passed)})")
    if is_dense:
        declared["copy_entries"] = _COPY_ENTRIES
        for i, pattern in enumerate(outputs):
            table = f"@{name}_entries{i}"
            entries = ", ".join(f"i64 {x}" for x in pattern.order())
            declared[table] = f"{table} = internal constant [{pattern.count} x i64] [{entries}]"
            lines.append(f"  %n{i} = select i1 %is_null_r{i}, i64 0, i64 {pattern.count}")
            lines.append(f"  call void @copy_entries(i64 %n{i}, ptr {table}, ptr %d{i}, ptr %r{i})")
    lines += ["  ret i32 %status", "}"]
    return [*texts, Text("\n".join(lines), declared)]


def _descriptions(name: str, inputs: Sequence[Pattern], outputs: Sequence[Pattern], work: int) -> list[str]:
    """Lines of the functions by which CasADi asks for numbers of arguments, patterns and sizes of the work vectors."""
    # One array of zeros stands for every argument that is null: it is as long as the longest, and never empty.
    lines = [f"@{name}_zero = internal constant [{max([1, *(x.count for x in inputs)])} x double] zeroinitializer"]
    for kind, patterns in (("in", inputs), ("out", outputs)):
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
    lines.append(f"define i32 @{name}_work(ptr %args, ptr %results, ptr %iw, ptr %w) #0 {{")
    for pointer, size in (("%args", len(inputs)), ("%results", len(outputs)), ("%iw", 0), ("%w", work)):
        lines.append(f"  store i64 {size}, ptr {pointer}")
    return [*lines, "  ret i32 0", "}"]


def _pointers(letter: str, array: str, count: int, default: str) -> list[str]:
    """Lines that load the pointers %a0, %a1, ... of an array, with a default for null pointers."""
    lines = []
    for i in (f"{letter}{k}" for k in range(count)):
        lines += [
            f"  %at_{i} = getelementptr ptr, ptr {array}, i64 {i[1:]}",
            f"  %given_{i} = load ptr, ptr %at_{i}",
            f"  %is_null_{i} = icmp eq ptr %given_{i}, null",
            f"  %{i} = select i1 %is_null_{i}, ptr {default}, ptr %given_{i}",
        ]
    return lines


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
