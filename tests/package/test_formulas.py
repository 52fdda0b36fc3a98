"""Formulas in docstrings: LaTeX that the pages can render, after a first line in words."""

import ast
import re
from pathlib import Path

import pytest

import jaxdyn

PACKAGE = Path(jaxdyn.__file__).parent
FORMULA = re.compile(r"\$\$(.+?)\$\$|\$(.+?)\$", re.S)
# Commands that docstrings use; KaTeX has all of them.
COMMANDS = set(
    r"""alpha beta gamma delta epsilon varepsilon zeta eta theta lambda mu nu xi pi rho sigma tau phi psi omega Gamma Delta Lambda
    Sigma bar hat widehat tilde dot ddot frac tfrac sqrt sum prod int log exp sin cos tan cot tanh det ker min max operatorname
    mathrm text begin end left right big Big quad qquad cdot cdots ldots times ge le ne in pm langle rangle partial nabla , \
    """.split()
)
PAIRS = [("{", "}"), (r"\left", r"\right"), (r"\begin", r"\end")]


@pytest.mark.long
def test_formulas_in_docstrings_are_latex():
    wrong, count = [], 0
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            text = (ast.get_docstring(node) or "") if documented else ""
            text = re.sub(r"```.*?```|`[^`]*`", "", text, flags=re.S)
            where = f"{path.relative_to(PACKAGE)}:{getattr(node, 'lineno', 1)}"
            if (
                "$" in FORMULA.sub("", text)
                or "$" in text.partition("\n")[0]
                or re.search(r"[\x00-\x09\x0b-\x1f]", text)
            ):
                wrong.append(f"{where}: a $ on the first line or without its partner, or a docstring that is not raw")
            for formula in ("".join(pair) for pair in FORMULA.findall(text)):
                count += 1
                unknown = set(re.findall(r"\\([A-Za-z]+|[^A-Za-z\s{}_])", formula)) - COMMANDS
                if unknown or any(formula.count(a) != formula.count(b) for a, b in PAIRS) or formula != formula.strip():
                    wrong.append(f"{where}: {formula!r} {unknown or 'is not balanced'}")
    assert count > 400 and not wrong, "\n".join(wrong)
