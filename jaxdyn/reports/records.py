"""Records of a report: one per run, and the machine; as JSON and as text."""

import dataclasses
import json
from collections.abc import Iterable
from typing import Any

from jaxdyn.model.description import short, table


@dataclasses.dataclass(frozen=True)
class Record:
    """Record of one run of a ladder: scene, integrator, errors and times. None means unknown.

    - `source`: "jaxdyn", or the name of a peer; `method`, `solver`, `dtype`; `batch`: trajectories at once.
    - `setting`: rtol = atol, or the step (s) when `fixed`.
    - `result`: "successful", or the name of the result code; then there are no errors.
    - `error_end`, `error_path`: error at the last save point and the largest of all (`cases.errors`).
    - `residual_position`, `residual_velocity`: largest |phi| and |A v - b|; `energy_error`: largest |E - E(0)|, J.
    - `seconds_best`, `seconds_median`: wall time per trajectory, of `rounds`; `compile_seconds`, separate, of the ladder.
    - `steps`, rejected ones included, and `rejected`; `evaluations` of the vector field.
      Of the first trajectory of a batch, whose start is the reference's.
    """

    scene: str
    source: str
    method: str
    solver: str
    dtype: str
    batch: int
    setting: float
    fixed: bool
    result: str
    error_end: float | None
    error_path: float | None
    residual_position: float | None
    residual_velocity: float | None
    energy_error: float | None
    seconds_best: float
    seconds_median: float
    rounds: int
    compile_seconds: float | None
    steps: int | None
    rejected: int | None
    evaluations: int | None

    @property
    def label(self) -> str:
        """Label of the record's ladder within its scene."""
        ours = self.source == "jaxdyn"
        return f"{self.method}, {self.solver}" if ours else f"{self.source}, {self.solver}"


@dataclasses.dataclass(frozen=True)
class SceneReference:
    """Reference of a scene."""

    text: str
    kind: str
    source: str
    error: float


@dataclasses.dataclass(frozen=True)
class Report:
    """Records of a report with their context: `head` (machine, versions, date) and each scene's reference."""

    head: dict[str, Any]
    scenes: dict[str, SceneReference]
    records: tuple[Record, ...]

    def of(self, scene: str) -> tuple[Record, ...]:
        """Records of one scene."""
        return tuple(record for record in self.records if record.scene == scene)

    def to_json(self) -> str:
        """Convert the report to JSON; `from_json` reads it."""
        return json.dumps(dataclasses.asdict(self), indent=1)

    @staticmethod
    def from_json(text: str) -> "Report":
        """Read a report that `to_json` wrote."""
        data = json.loads(text)
        scenes = {name: SceneReference(**known) for name, known in data["scenes"].items()}
        return Report(data["head"], scenes, tuple(Record(**record) for record in data["records"]))

    def table(self, scene: str | None = None) -> str:
        """Table of records as text, of one scene or of all."""
        names = [scene] if scene else list(self.scenes)
        return "\n\n".join(self._section(name) for name in names)

    def _section(self, name: str) -> str:
        known, records = self.scenes[name], self.of(name)
        head = f"{known.text}\nReference: {known.kind}, {known.source}; its own error about {short(known.error, 1)}"
        return f"{head}\n{table(COLUMNS, rows(records))}" if records else head


def pareto_front(records: Iterable[Record], *, error: str = "error_path", cost: str = "seconds_best") -> list[Record]:
    """Pareto-optimal records in `error` and `cost`, from cheap to accurate, without failed runs."""
    # After sorting by cost, a record is on the front if its error is below that of all cheaper ones.
    # Failed runs have no error.
    usable = [r for r in records if getattr(r, error) is not None and getattr(r, cost) is not None]
    # At equal cost the more accurate record comes first and hides the other.
    usable.sort(key=lambda r: (getattr(r, cost), getattr(r, error)))
    front: list[Record] = []
    for record in usable:
        # Strictly: of two equally accurate runs only the cheaper one is on the front.
        if not front or getattr(record, error) < getattr(front[-1], error):
            front.append(record)
    return front


COLUMNS = (
    "method", "dtype", "batch", "setting", "error", "at end", "residual", "energy", "us", "median", "rounds", "steps", "evals",
    "compile s", "result",
)  # fmt: skip


def rows(records: Iterable[Record]) -> list[list[str]]:
    """Cells of a table with COLUMNS, one row per record."""
    table = []
    for r in records:
        # Scenes without constraints have neither.
        residuals = [x for x in (r.residual_position, r.residual_velocity) if x is not None]
        table.append(
            [
                r.label,
                r.dtype,
                str(r.batch),
                f"{'h ' if r.fixed else ''}{r.setting:.1e}",
                *(short(x, 2) for x in (r.error_path, r.error_end, max(residuals, default=None), r.energy_error)),
                # Microseconds: most runs of one trajectory take less than a millisecond.
                *(f"{1e6 * x:.4g}" for x in (r.seconds_best, r.seconds_median)),
                *("-" if x is None else str(x) for x in (r.rounds, r.steps, r.evaluations)),
                short(r.compile_seconds, 2),
                # An empty cell, so that failures stand out.
                "" if r.result == "successful" else r.result,
            ]
        )
    return table
