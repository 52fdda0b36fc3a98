"""The field's language in names, docstrings and the command line: what a room has won, later changes keep."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import jaxdyn

PACKAGE = Path(jaxdyn.__file__).parent
# Rooms that are not done yet; the list is to be emptied.
NOT_YET: set[str] = set()
OPENINGS = set("What Which Whether How Where Of That Who Whoever As So".split())
PARTICIPLE = re.compile(
    r"(\w*ed|told|built|made|drawn|shown|begun|taken|given|kept|held|written|cut|found|chosen|driven|known|said|seen|met|put"
    r"|left|thrown|sent)(_\w+)?"
)
# Terms of the field, and names that are deprecated in this release.
TERMS = """generalized_force applied_force reduced_dynamics constrained_dynamics constrained_inverse_dynamics
    underactuated_inverse_dynamics closed_form
    articulated_bodies
    coordinated_lifting closed_ring quadruped left_jacobian left_jacobian_inverse unconstrained constrained named_frame
    signed_distance displaced converged_reference published_state time_interleaved embed check_seed""".split()
DEPRECATED = """called completed bounded tied aligned
    named scaled
    told""".split()
# Left column of the glossary, as far as a help text could have it.
OURS = re.compile(
    r"\b(slopes?|(?<!egrees of )(?<!egree of )freedoms?|lanes?|foretell\w*|told|suspicions?|served?|whoever|goes on|gone on"
    r"|left out in turn|hang together|come together|errors last|independent samples|way without|numbers of a model|1th)\b"
)


def _modules() -> Iterator[tuple[Path, ast.Module]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.relative_to(PACKAGE).parts[0] not in NOT_YET:
            yield path, ast.parse(path.read_text())


def _public(tree: ast.AST) -> Iterator[ast.Module | ast.ClassDef | ast.FunctionDef]:
    """The module, and the public classes, functions and methods in it, without functions within functions."""
    if isinstance(tree, ast.Module):
        yield tree
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
            yield node
            if isinstance(node, ast.ClassDef):
                yield from _public(node)


def test_public_names_are_no_participles():
    found = [
        f"{path.relative_to(PACKAGE)}:{node.lineno} {node.name}"
        for path, tree in _modules()
        for node in _public(tree)
        if isinstance(node, ast.FunctionDef)
        and PARTICIPLE.fullmatch(node.name)
        and node.name not in {*TERMS, *DEPRECATED}
    ]
    assert not found, found


def test_docstrings_open_with_a_noun_phrase_or_an_imperative_and_end_their_first_line():
    found = []
    for path, tree in _modules():
        for node in _public(tree):
            first = (ast.get_docstring(node) or "None.").splitlines()[0]
            if first.split()[0] in OPENINGS or not first.endswith("."):
                found.append(f"{path.relative_to(PACKAGE)}:{getattr(node, 'lineno', 1)} {first}")
    assert not found, found


@pytest.mark.parametrize("path", sorted((PACKAGE / "cli").glob("*.py")), ids=lambda path: path.stem)
def test_help_texts_are_in_the_fields_words(path):
    nodes = ast.walk(ast.parse(path.read_text()))
    texts = [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    found = [text for text in texts if " " in text and OURS.search(text)]
    assert not found, found
