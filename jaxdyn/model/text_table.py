"""Plain-text tables."""

from collections.abc import Sequence

import numpy as np


def table(header: Sequence[str], rows: Sequence[Sequence[str]], indent: str = "  ") -> str:
    """Columns aligned to the left where they hold words and to the right where they hold numbers."""
    rows = [[str(cell) for cell in row] for row in rows]
    columns = list(zip(header, *rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    numeric = [all(_is_number(cell) for cell in column[1:]) for column in columns]
    lines = []
    for row in ([*header], *rows):
        cells = [
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ]
        # Trailing spaces of a last left-aligned column would show in copied output.
        lines.append((indent + "  ".join(cells)).rstrip())
    return "\n".join(lines)


def short(value: float | None, digits: int = 4) -> str:
    """Format a number for a table; a dash stands for infinity (no limit) and for None."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}g}"


def _is_number(cell: str) -> bool:
    return cell in ("", "-") or cell.replace(".", "").replace("-", "").replace("+", "").replace("e", "").isdecimal()
