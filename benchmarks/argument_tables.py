"""Tables of arguments in the reference: an extension of griffe, which mkdocs.yml names.

A docstring describes arguments in prose or as a list, after the mark "**Arguments:**". Here that part becomes a table: names and
shapes, types and defaults as in the signature, and the description. What a docstring leaves to another one, "as of `NAME`", is
taken from there.
"""

import ast
import re
from collections.abc import Mapping, Sequence
from functools import cache
from html import escape
from pathlib import Path
from typing import NamedTuple

try:
    from griffe import Extension  # pyright: ignore[reportMissingImports]
except ImportError:  # an extra of the site; the tables themselves need nothing
    Extension = object

ROOT = Path(__file__).resolve().parent.parent
MARK = "**Arguments:**"
# Plain words for annotations that say little to a reader.
_WORDS = {"Numbers": "array", "Number": "float", "Row": "array", "Function": "Callable", "ArrayLike": "array"}
# What these names mean wherever a docstring says no more of them.
_COMMON = {
    "model": "the bodies and joints.",
    "scene": "the mechanism, with its constraints and forces.",
    "name": "for errors and reports; by default made of the others.",
    "dtype": "of the arrays; by default JAX's, as `jax_enable_x64` says.",
    "old": "arguments by their names of earlier releases, which are deprecated.",
    "surface_body": "name of the body or frame that carries the surface; None: the world.",
    "plane_body": "name of the body or frame that carries the plane; None: the world.",
    "q": "configuration: rad or m, unit quaternions of free and spherical joints.",
    "v": "velocity: rad/s or m/s, body twists of free joints.",
    "a": "acceleration, the rate of `v`.",
    "tau": "generalised force, N m or N.",
    "t": "time, s.",
    "grasp": "the hand, the object and their contacts.",
    "system": "a `Model`, another system, or a `Scene`.",
    "log": "one log or several.",
    "v_s": "velocity over which Coulomb friction is smoothed, rad/s or m/s.",
    "gravity": "m/s^2.",
}
# A name, perhaps with its own arguments, its symbol and its shape or unit.
_NAME = re.compile(
    r"`\*{0,2}(\w+)(?:\([^`]*)?`(?: (?:[A-Za-z]|\$[^$]+\$)(?![\w']))?(?:\s\([^()]*(?:\([^()]*\)[^()]*)*\))?"
)


class Argument(NamedTuple):
    """An argument of a signature."""

    name: str
    annotation: str
    default: str | None


class Row(NamedTuple):
    """Arguments that a docstring describes together: their names with symbols and shapes, and the description."""

    arguments: list[tuple[Argument, str]]
    text: str


@cache
def aliases() -> dict[str, str]:
    """Annotations that are names for others, of all modules: name and what it stands for."""
    found = {}
    for path in (ROOT / "jaxdyn").rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
                for line in (line for line in node.body if isinstance(line, ast.Assign)):
                    found[ast.unparse(line.targets[0])] = ast.unparse(line.value)
    return found | _WORDS


def readable(annotation: str) -> str:
    """An annotation in the words of a reader: aliases replaced, arrays with their shapes."""
    text = re.sub(r"\bChecked\[(.*)\]$", r"\1", annotation)
    text = re.sub(r"Float\[Array, ['\"]?\s*([^'\"\]]*)['\"]?\]", lambda m: _shaped(m[1].split()), text)
    for _ in range(2):  # aliases of aliases
        text = re.sub(r"\b\w+\b", lambda m: aliases().get(m[0], m[0]), text)
    text = re.sub(r"\b[a-z]+\.(?=[A-Z])", "", text)  # classes without their packages
    parts = dict.fromkeys(re.split(r" \| (?![^\[]*\])", text))
    return " | ".join(part for part in parts if part != "Sequence[Any]" or "array" not in parts)


def _shaped(sizes: Sequence[str]) -> str:
    if sizes == ["..."]:
        return "array"
    return f"array ({', '.join(sizes)}{',' if len(sizes) == 1 else ''})" if sizes else "float"


def split(docstring: str) -> tuple[str, str, str]:
    """A docstring before its arguments, their part without the mark, and the rest; the last two are empty without the mark."""
    before, mark, rest = docstring.partition(MARK)
    # Paragraphs belong to the arguments as long as they are items of the list, which may follow a sentence.
    sentence = re.match(r"(?:.+\n)*?.*\n\n(?=- )", rest)
    end = re.compile(r"(?m)\*\*[A-Z]\w*:\*\*|^```" + (r"|^(?![-\s])" if sentence else r"|\n\n"))
    end = end.search(rest, sentence.end() if sentence else 0)
    place = end.start() if mark and end else len(rest)
    return before, rest[:place].strip(), rest[place:]


# Descriptions of arguments by the full name of the function or class, and by the argument's.
Known = Mapping[str, Mapping[str, str]]


def rows(text: str, arguments: Sequence[Argument], known: Known | None = None) -> tuple[str, list[Row]]:
    """What the text says of all arguments, and the rows of a table: each argument once, in the order of the signature.

    Arguments that the text does not describe have the description of the first function that it names and that has them.
    """
    left = {argument.name.lstrip("*"): argument for argument in arguments}
    items = [re.sub(r"(?m)^  ", "", item) for item in re.split(r"(?m)^- ", text) if item.strip()]
    # A name that an item begins with is described there, even if an earlier one mentions it.
    heads = [match[1] if (match := _NAME.match(item)) else None for item in items]
    general, found = [], []
    for item, head in zip(items, heads, strict=True):
        groups: list[tuple[list[tuple[Argument, str]], int]] = []  # arguments, and where their description begins
        starts = []
        for match in _NAME.finditer(item):
            before = item[: match.start()].replace("\n", " ")
            chained = groups and re.fullmatch(r",? ?(?:and |or )?", before[groups[-1][1] :])
            begins = not before or re.search(r"([;.]|, and) $", before)
            if match[1] not in left or (match[1] in heads and match[1] != head) or not (chained or begins):
                continue
            pair = (left.pop(match[1]), match[0])
            if chained:
                groups[-1] = ([*groups[-1][0], pair], match.end())
            else:
                groups.append(([pair], match.end()))
                starts.append(match.start())
        general.append(item[: starts[0]] if starts else item)
        found += [
            Row(group, re.sub(r"^s\.?$", _COMMON["t"], _tidy(item[start:end])))
            for (group, start), end in zip(groups, [*starts[1:], None], strict=False)
        ]
    # Arguments without a description of their own have rows of their own.
    found = [
        each
        for row in found
        for each in ([row] if row.text else [Row([pair], _common(pair[0])) for pair in row.arguments])
    ]
    described = {row.arguments[0][0].name: row for row in found}
    others = {argument.name for row in found for argument, _ in row.arguments[1:]}
    table = [
        described.get(argument.name) or Row([(argument, f"`{argument.name}`")], _common(argument))
        for argument in arguments
        if argument.name not in others
    ]
    if known and not all(row.text for row in table):
        named = re.findall(r"`(?:jd\.)?([\w.]+)(?:\([^`]*\))?`", text)
        others = {k: v for name in reversed(named) for k, v in known.get(_resolve(name, known), {}).items()}
        table = [row if row.text else Row(row.arguments, others.get(row.arguments[0][0].name, "")) for row in table]
    return " ".join(text.strip() for text in general if text.strip()), table


def _resolve(name: str, known: Known) -> str:
    """Full name of the first entry that ends like a name and has its other parts."""
    *rooms, last = name.split(".")
    fits = (key for key in known if key.rpartition(".")[2] == last and {*rooms} <= {*key.split(".")})
    return next(fits, "")


def descriptions(things: Mapping[str, tuple[str, Sequence[Argument]]]) -> Known:
    """Descriptions of the arguments of functions and classes, of which each has a docstring and arguments."""
    known: dict[str, dict[str, str]] = {}
    for _ in range(2):  # descriptions that refer to one that refers to another
        for name, (docstring, arguments) in things.items():
            described = rows(split(docstring)[1], arguments, known)[1]
            known[name] = {pair[0].name: row.text for row in described if row.text for pair in row.arguments}
    return known


def _common(argument: Argument) -> str:
    return _COMMON.get(argument.name.lstrip("*"), "")


def _tidy(text: str) -> str:
    return re.sub(r"^[,:;.]?\s+|^[.:;,]$|;?\s+$", "", text)


def table(text: str, arguments: Sequence[Argument], known: Known | None = None) -> str:
    """Arguments as a table in HTML whose names and descriptions are Markdown."""
    general, described = rows(text, arguments, known)
    lines = [general, "", '<div class="arguments" markdown="1">', '<table markdown="1">']
    lines += ["<thead><tr><th>Argument</th><th>Type and default</th><th>Description</th></tr></thead>"]
    lines += ['<tbody markdown="1">']
    for row in described:
        for k, (argument, name) in enumerate(row.arguments):
            kind = readable(argument.annotation)
            shape = re.search(r" (\(.*\))$", kind)
            kind = kind.removesuffix(f" {shape[1]}") if shape and shape[1] in name else kind
            kind = [kind] if kind else []
            default = [f"= {argument.default}".replace("'", '"')] if argument.default is not None else []
            cell = "<br>".join(f"<code>{escape(part, quote=False)}</code>" for part in (*kind, *default))
            lines += ['<tr markdown="1">', f'<td markdown="span">{name}</td>', f"<td>{cell}</td>"]
            if not k:
                span = f' rowspan="{len(row.arguments)}"' if len(row.arguments) > 1 else ""
                lines += [f'<td markdown="block"{span}>', "", row.text, "", "</td>"]
            lines.append("</tr>")
    return "\n".join([*lines, "</tbody>", "</table>", "</div>"])


def with_table(docstring: str, arguments: Sequence[Argument], known: Known | None = None) -> str:
    """A docstring whose arguments are a table."""
    before, text, after = split(docstring)
    if not text or not arguments:
        return docstring
    return f"{before}{MARK} {table(text, arguments, known)}\n\n{after}"


class ArgumentTables(Extension):  # pyright: ignore[reportGeneralTypeIssues]
    """Replace the descriptions of arguments by tables in all docstrings of a package."""

    def on_package(self, *, pkg, **_) -> None:
        """Called once all modules are read."""
        things = []
        for module in _members(pkg, "module"):
            for thing in (*_members(module, "function"), *_members(module, "class")):
                things += [thing, *(_members(thing, "function") if thing.kind.value == "class" else ())]
        things = [(thing, _arguments(thing)) for thing in things if thing.docstring and MARK in thing.docstring.value]
        known = descriptions({thing.path: (thing.docstring.value, arguments) for thing, arguments in things})
        for thing, arguments in things:
            thing.docstring.value = with_table(thing.docstring.value, arguments, known)


def _members(of, kind: str) -> list:
    own = [member for member in of.members.values() if not member.is_alias and member.kind.value == kind]
    return [of, *(inner for module in own for inner in _members(module, kind))] if kind == "module" else own


def _arguments(thing) -> list[Argument]:
    maker = thing.members.get("__init__") if thing.kind.value == "class" else thing
    if maker is not None:
        return [
            Argument(
                {"variadic positional": "*", "variadic keyword": "**"}.get(p.kind.value if p.kind else "", "") + p.name,
                "" if p.annotation is None else str(p.annotation),
                None if p.default is None or (p.kind and p.kind.value.startswith("variadic")) else str(p.default),
            )
            for p in maker.parameters
            if p.name not in ("self", "cls")
        ]
    # The fields of a module of equinox, as `field: annotation = default`, and those of its bases.
    fields = {}
    for base in (*reversed(thing.mro()), thing):
        for name, member in base.members.items():
            if not member.is_alias and member.kind.value == "attribute" and member.annotation is not None:
                fields[name] = Argument(name, str(member.annotation), _default(member.value))
    return [field for field in fields.values() if f"`{field.name}" in thing.docstring.value]


def _default(value) -> str | None:
    """Default of a field, `eqx.field(default=...)` included."""
    text = None if value is None else str(value)
    if text is None or "field(" not in text:
        return text
    given = re.search(r"\bdefault=(.*?)(?:, \w+=|\)$)", text)
    return given[1] if given else None
