"""Extreme cases: for each the error, the residual, the result code, the gradient, a verdict, and what a user should do.

    python -m benchmarks.extremes [CASE ...] [--out docs/extremes.md]

A row is "right" where the run succeeded within the error that the case allows, "refused" where a result code says that
there is no answer, and "SILENT" where a wrong answer came with success: none may be. Fixed steps have no tolerance to
keep; where they are off by more than the case allows, and by less than they refuse, the row says "no code". Gradients are
reverse mode, compared with central differences of order 4 in float64; "digits" counts those that agree.
"""

import argparse
import collections
import importlib
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.timing import chosen_names
from jaxdyn.compile.jax_adapter import select_options
from jaxdyn.constraints.codes import CODES, code_of

DTYPES = ("float64", "float32")
MODULES = ("extreme_bodies", "extreme_motions", "extreme_rows")
CASES: dict[str, Callable] = {}
FIXED = 0.1  # fixed steps have no tolerance to keep; from this error on they have to end with a code
HEADER = ("case", "at", "dtype", "error", "allowed", "compared with", "residual", "NaN", "code", "gradient", "verdict")
# Lanes at which a central difference of order 4 is taken, in steps, and their weights.
_LANES = np.array([0.0, -2.0, -1.0, 1.0, 2.0])
_WEIGHTS = np.array([0.0, 1.0, -8.0, 8.0, -1.0]) / 12


class Row(NamedTuple):
    """One line of the table; `digits` of the gradient are None where none was asked for."""

    case: str
    at: str
    dtype: str
    error: float
    allowed: float
    against: str
    residual: float | None
    nan: bool
    code: str
    digits: float | None
    gradient_finite: bool
    advice: str
    excused: float = 0.0

    @property
    def verdict(self) -> str:
        """right, refused, SILENT, or "no code", where there is none for errors below `excused`."""
        if self.code not in ("successful", ""):
            return "refused"
        wrong = self.nan or not self.error <= self.allowed
        lost = self.digits is not None and (not self.gradient_finite or self.digits < 1)
        if not (wrong or lost):
            return "right"
        return "no code" if not self.nan and self.error < self.excused else "SILENT"

    def cells(self) -> tuple[str, ...]:
        """The row as text."""
        gradient = "" if self.digits is None else f"{self.digits:.0f} digits" if self.gradient_finite else "not finite"
        if self.code not in ("successful", ""):
            gradient = "" if self.digits is None else "finite" if self.gradient_finite else "not finite"
        return (
            self.case,
            self.at,
            self.dtype,
            _number(self.error),
            _number(self.allowed),
            self.against,
            "" if self.residual is None else _number(self.residual),
            "yes" if self.nan else "no",
            self.code,
            gradient,
            self.verdict,
        )


class Outcome(NamedTuple):
    """What one run gives: what is compared, the largest residual, the code, and the number that is differentiated."""

    end: Any
    residual: Any
    code: Any
    value: Any


def case(build: Callable) -> Callable:
    """Register a function (dtypes, gradient) -> rows; the first line of its docstring heads its table."""
    CASES[build.__name__] = build
    return build


def outcome(solution, value=None, end=None, residual=None) -> Outcome:
    """Of a `Solution`: its last state, or what else is compared."""
    last = jnp.concatenate([solution.q[-1], solution.v[-1]])
    end = last if end is None else end
    if value is None:
        value = jnp.sum(last * jnp.cos(jnp.arange(last.size, dtype=last.dtype)))
    if residual is None and solution.constraint_residual is not None:
        residual = jnp.max(solution.constraint_residual)
    zero = jnp.zeros((), last.dtype)
    return Outcome(end, zero if residual is None else residual, code_of(solution.result), value)


def name_of(code) -> str:
    """Name of a result code, by its number."""
    return CODES[int(code)]


def quick(function):
    """Compiled fast: no time is measured here."""
    options = select_options({"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False})
    return jax.jit(function, compiler_options=options)


def as_dtype(tree, dtype):
    """The same pytree with floating leaves of another dtype."""
    cast = lambda x: x.astype(dtype) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else x  # noqa: E731
    return jax.tree.map(lambda x: cast(jnp.asarray(x)), tree)


class Study(NamedTuple):
    """Outcomes at the points in float64 and float32, gradients by reverse mode and the difference quotient."""

    outcomes: dict[str, Outcome]
    gradients: dict[str, np.ndarray | None]
    quotient: np.ndarray | None


def study(run: Callable, points, dtypes: Sequence[str] = DTYPES, gradient: bool = True, step: float = 1e-4) -> Study:
    """`run(point, x)` -> Outcome at every point (leaves with a leading axis), x = 0, and d value/dx there.

    One program serves all points of a dtype: the lanes are a `vmap`.
    """
    outcomes, gradients, quotient = {}, {}, None
    for dtype in dtypes:
        at = as_dtype(points, dtype)

        def value(x, point):
            computed = run(point, x)
            return computed.value, computed

        if not gradient:
            outcomes[dtype] = quick(jax.vmap(lambda p, d=dtype: run(p, jnp.zeros((), d))))(at)
            gradients[dtype] = None
            continue
        lanes = jnp.asarray(_LANES * step if dtype == "float64" else _LANES[:1], dtype)
        both = jax.vmap(jax.vmap(jax.value_and_grad(value, has_aux=True), (0, None)), (None, 0))
        (_, computed), slope = quick(both)(lanes, at)
        outcomes[dtype] = jax.tree.map(lambda x: x[:, 0], computed)
        gradients[dtype] = np.asarray(slope[:, 0], float)
        if dtype == "float64":
            quotient = np.asarray(computed.value, float) @ _WEIGHTS / step
    return Study(outcomes, gradients, quotient)


def digits_of(computed: float, want: float) -> float:
    """Correct digits, at most 16."""
    if not (np.isfinite(computed) and np.isfinite(want)):
        return math.nan
    difference = abs(computed - want) / max(abs(want), 1e-12)
    return 16.0 if difference == 0 else min(16.0, -math.log10(difference))


def table(
    name,
    labels,
    studied: Study,
    exact,
    allowed,
    against,
    *,
    size=None,
    advice="",
    residual=True,
    wanted=None,
    excused=0.0,
):
    """Rows of a study. `exact` (points, .) is what the ends are compared with, relative to `size` (default: its largest).

    `allowed`: by dtype a number or one a point. `excused`: errors below it have no code (`FIXED` for fixed steps). `wanted`
    (points,): the gradient in place of the difference quotient.
    """
    rows = []
    exact = np.asarray(exact, float)
    wanted = studied.quotient if wanted is None else wanted
    for dtype, computed in studied.outcomes.items():
        end, count = np.asarray(computed.end, float), len(labels)
        bounds = np.broadcast_to(allowed[dtype], (count,))
        for i, label in enumerate(labels):
            scale = np.abs(exact[i]).max() if size is None else np.broadcast_to(size, (count,))[i]
            slope = studied.gradients[dtype]
            digits = None if slope is None or wanted is None else digits_of(slope[i], wanted[i])
            rows.append(
                Row(
                    name,
                    label,
                    dtype,
                    float(np.abs(end[i] - exact[i]).max() / (scale or 1.0)),
                    float(bounds[i]),
                    against,
                    float(computed.residual[i]) if residual else None,
                    bool(np.isnan(end[i]).any()),
                    name_of(computed.code[i]),
                    digits,
                    slope is None or bool(np.isfinite(slope[i])),
                    advice,
                    excused,
                )
            )
    return rows


def load() -> dict[str, Callable]:
    """All cases by name."""
    for module in MODULES:
        importlib.import_module(f"benchmarks.{module}")
    return CASES


def markdown(name: str, rows: Sequence[Row]) -> str:
    """One table with its heading and its advice; the rows are folded below a count of their verdicts."""
    title = (CASES[name].__doc__ or name).splitlines()[0]
    counts = collections.Counter(row.verdict for row in rows)
    summary = ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())
    lines = [f"### {title}", "", '<details markdown="1">', f"<summary>{len(rows)} rows: {summary}</summary>", ""]
    lines += ["| " + " | ".join(HEADER) + " |", "|" + "---|" * len(HEADER)]
    lines += ["| " + " | ".join(row.cells()) + " |" for row in rows]
    advice = list(dict.fromkeys(row.advice for row in rows if row.advice))
    return "\n".join([*lines, "", "</details>", "", *(f"**What to do.** {text}" for text in advice), ""])


def replace_section(path: Path, name: str, text: str) -> None:
    """Put the table of a case between its marks in a document, at the end where it has none."""
    document = path.read_text() if path.exists() else ""
    begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->\n"
    if begin not in document:
        document += f"\n{begin}{end}"
    before, rest = document.split(begin)
    path.write_text(f"{before}{begin}{text}{end}{rest.split(end)[1]}")


def _number(x: float) -> str:
    return "-" if math.isnan(x) else "0" if x == 0 else f"{x:.1e}"


def main() -> None:
    """Run the cases and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("cases", nargs="*", help="names of cases; default: all")
    parser.add_argument("--out", type=Path, help="also put the tables into this document")
    parser.add_argument("--no-gradient", action="store_true", help="leave gradients out")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    cases, silent = load(), 0
    for name in chosen_names(options.cases, cases):
        begin = time.perf_counter()
        rows = cases[name](DTYPES, not options.no_gradient)
        text = markdown(name, rows)
        print(text, f"({time.perf_counter() - begin:.0f} s)\n", sep="\n", flush=True)
        silent += sum(row.verdict == "SILENT" for row in rows)
        if options.out:
            replace_section(options.out, name, text)
    print(f"{silent} silent failures")


if __name__ == "__main__":
    # As a module of its own name, so that the cases register where `main` looks for them.
    importlib.import_module("benchmarks.extremes").main()
