"""Tables of figures in the documents have a command that measures them."""

import importlib.util

from pages import ROOT

from benchmarks import figures

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))


def test_every_table_of_figures_names_its_command():
    every = [table for page in PAGES for table in figures.tables(page)]
    assert len(every) > 40
    orphans = [
        f"{table.page.name}: {table.page.read_text()[table.start :][:60]}" for table in every if not table.commands
    ]
    assert not orphans, "\n".join(orphans)
    modules = {c.split()[0] for table in every for c in table.commands if c.startswith(("benchmarks.", "jaxdyn."))}
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    assert not missing, missing


def test_printed_tables_replace_those_of_the_page(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# Page\n\n## One\n\nBy `python -m benchmarks.stiff a`.\n\n| case | us |\n|---|---|\n| x | 1 |\n| y | 2 |\n\n"
        "Text.\n\n| case | us |\n|---|---|\n| z | 3 |\n\n| word | meaning |\n|---|---|\n| a | b |\n\n"
        "## Two\n\n| case | ms |\n|---|---|\n| x | 5 |\n"
    )
    first, second, orphan = figures.tables(page)
    assert first.commands == second.commands == ("benchmarks.stiff a",) and not orphan.commands
    printed = "progress\n| case | us |\n|---|---|\n| x | 7 |\n\n|  case | us |\n|---|---|\n| z | 8 |\n"
    for number in (1, 2):  # the note of the first time is replaced and not repeated
        note = f"Measured at commit {number}ab, machine."
        assert figures.replace(page, "benchmarks.stiff a", printed, note) == (2, [])
        text = page.read_text()
        assert text.count("*Measured") == 2 and text.count(note) == 2
    assert (
        "| x | 7 |" in text
        and "| z | 8 |" in text
        and "| y | 2 |" not in text
        and "| x | 5 |" in text
        and "Text." in text
    )
    assert [table.commit for table in figures.tables(page)] == ["2ab", "2ab", None]
    # Commands that write their pages themselves: the note alone is put below their tables.
    assert figures.stamp(page, "benchmarks.stiff a", "Measured at commit 5ab, machine.") == 2
    assert [table.commit for table in figures.tables(page)] == ["5ab", "5ab", None] and "| x | 7 |" in page.read_text()
    written, missing = figures.replace(page, "benchmarks.stiff a", "", "Measured at commit 3, m.")
    assert written == 0 and missing == ["| case | us |", "|  case | us |"]


def test_code_that_a_command_measures_exists():
    folders = {room for rooms in figures._MEASURED.values() for room in rooms}
    assert all((ROOT / "jaxdyn" / room).is_dir() for room in folders)
    modules = {path.stem for path in (ROOT / "benchmarks").glob("*.py")}
    assert all(any(f"benchmarks.{module}".startswith(name) for module in modules) for name in figures._MEASURED)
    assert figures.measured_code(("benchmarks.scale hosts", "benchmarks.rollout_peers panda")) == ("jaxdyn",)
    assert figures.measured_code(("benchmarks.scale hosts", "benchmarks.files loops U")) == (
        "jaxdyn/io",
        "jaxdyn/scale",
    )
