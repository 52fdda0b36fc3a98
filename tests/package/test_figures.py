"""The command that measures the tables of figures in the documents writes them in place."""

from benchmarks import figures


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
    assert all(words in text for words in ("| x | 7 |", "| z | 8 |", "| x | 5 |", "Text.")) and "| y | 2 |" not in text
    assert [table.commit for table in figures.tables(page)] == ["2ab", "2ab", None]
    # Commands that write their pages themselves: the note alone is put below their tables.
    assert figures.stamp(page, "benchmarks.stiff a", "Measured at commit 5ab, machine.") == 2
    assert [table.commit for table in figures.tables(page)] == ["5ab", "5ab", None] and "| x | 7 |" in page.read_text()
    written, missing = figures.replace(page, "benchmarks.stiff a", "", "Measured at commit 3, m.")
    assert written == 0 and missing == ["| case | us |", "|  case | us |"]
