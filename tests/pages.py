"""Pages of the documents: their examples, and their links."""

import re
from pathlib import Path

import jax

ROOT = Path(__file__).resolve().parent.parent


def run(page: str, section: str = "", head: bool = False) -> dict:
    """All blocks of a page or section in one namespace, as a reader pastes them one after another; the names they leave.

    With `head` the blocks above the page's first section come first.
    """
    text = (ROOT / page).read_text()
    before, heading, rest = text.partition(f"\n## {section}\n")
    assert heading or not section, f"{page} has no section {section}"
    text = (re.split(r"\n## ", before)[0] if head else "") + re.split(r"\n## ", rest)[0] if section else text
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert blocks, f"{page} has no examples"
    names: dict = {}
    # A reader has jax's own settings, not the strict ones of the tests.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for block in blocks:
            exec(compile(block, page, "exec"), names)
    return names


def pages() -> list[Path]:
    """All pages: those of the folder docs, and those beside the README."""
    return sorted([*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md"), *(ROOT / "benchmarks").glob("*.md")])


def links(text: str) -> list[str]:
    """Targets of the links and pictures of a page, outside of code."""
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    text = re.sub(r"`[^`\n]*`", "", text)
    return re.findall(r"(?:\]\(|^\[[^]]+\]: )([^)\s]+)(?:\)|$)", text, flags=re.MULTILINE)


def anchors(text: str) -> set[str]:
    """What a link may name behind # on a page: its headings, as GitHub and the site make anchors of them, and its names."""
    names = set(re.findall(r"^::: (\S+)$", text, flags=re.MULTILINE))
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    matches: set[str] = names | set(re.findall(r"<a (?:id|name)=\"([^\"]+)\"", text))
    for heading in re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)|[`*]", r"\1", heading).strip().lower()
        matches.add(re.sub(r" ", "-", re.sub(r"[^\w\- ]", "", plain)))
    return matches
