"""Where the rows of loops have entries: on which joints, and in the Cholesky factor of the rows' matrix."""

from collections.abc import Sequence

from jaxdyn.model import Model

MOST_PRODUCTS = 6000  # of the rows' matrix and its factor; the program grows with them


def path(model: Model, body: int, common: int = -1) -> list[int]:
    """Bodies from the one after `common` to `body`, outward."""
    found = []
    while body != common:
        found.append(body)
        body = model.topology.parents[body]
    return found[::-1]


def supports(model: Model, bodies: Sequence[tuple[int, int]], counts: Sequence[int]) -> list[frozenset]:
    """For each row the bodies on whose joints it has entries, from the bodies of each loop and its number of rows."""
    found = []
    for ends, count in zip(bodies, counts, strict=True):
        joints = frozenset(i for body in ends for i in path(model, body))
        found += [joints] * count
    return found


def pattern(rows: Sequence[frozenset]) -> list[list[int]]:
    """Columns of each row of the Cholesky factor of the rows' matrix, the diagonal left out; fill included."""
    below = [{s for s in range(r) if rows[r] & rows[s]} for r in range(len(rows))]
    for r, columns in enumerate(below):
        # What is eliminated with s couples the rows after it that s is coupled with.
        for s in range(r):
            if s in columns:
                columns |= {k for k in range(s + 1, r) if s in below[k]}
    return [sorted(columns) for columns in below]


def products(model: Model, bodies: Sequence[tuple[int, int]], counts: Sequence[int]) -> int:
    """About how many products make the rows' matrix and its factor."""
    rows = supports(model, bodies, counts)
    columns = [set(row) for row in pattern(rows)]
    return sum(
        len(rows[r]) + sum(len(rows[r] & rows[s]) + 1 + len(here & columns[s]) for s in here)
        for r, here in enumerate(columns)
    )
