"""Error against run time beside other tools, all timed in turn within one loop, and who lies below our front.

    python -m benchmarks.work_precision [SCENE ...] [--batch 1 1024] [--integrator projected:Dopri8] [--rounds 20] [--all]
        [--out out/work_precision] [--figures DIRECTORY]

The page is that of `jaxdyn report`, for cases whose motions are known, with the peers of `benchmarks.peers` as dashed lines
on scenes that they can do. Finished scenes stay in `OUT/scenes`, from which an interrupted run resumes. Then, for each
plot: the peers' points that lie below jaxdyn's front, and the time at equal error relative to the best of them. A peer
without a batched call counts in a batch with its time for one trajectory over the number of cores, as if it made perfect
use of them.
"""

import argparse
import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path

import jax

from benchmarks import peers, timing
from benchmarks.fronts import TARGETS, beaten_by, cost_at
from benchmarks.report_cases import PUBLISHED, cases
from jaxdyn.model.description import table
from jaxdyn.reports import Record, Report, report, write
from jaxdyn.reports.plotting import figure

SCENES = ("andrews", "car_axis", "windows_40", "free_body", "rolling_disk")


def plots(computed: Report) -> list[tuple[Record, ...]]:
    """Records by scene, dtype and batch, with peers that have no batched call brought over from one trajectory."""
    cores, made = computed.head["machine"]["cores"], []
    for scene in computed.scenes:
        records = computed.of(scene)
        for dtype, batch in dict.fromkeys((r.dtype, r.batch) for r in records):
            group = [r for r in records if (r.dtype, r.batch) == (dtype, batch)]
            if batch > 1:
                there = {(family(r), r.solver) for r in group}
                group += [
                    dataclasses.replace(r, batch=batch, seconds_best=r.seconds_best / cores)
                    for r in records
                    if (r.dtype, r.batch) == (dtype, 1) and (family(r), r.solver) not in there and r.source != "jaxdyn"
                ]
            made.append(tuple(group))
    return made


def family(record: Record) -> str:
    """The tool of a record, whether in threads or not."""
    return record.source.split()[0].rstrip(",")


def verdict(records: Iterable[Record]) -> tuple[list[list[str]], list[str]]:
    """Rows of the table of verdicts for one plot, and lines for the points that lie below our front.

    One row against tools that take equations, by those in compiled code alone, one against tools that take mechanisms.
    """
    records = [r for r in records if r.error_path is not None]
    ours, below, rows = [r for r in records if r.source == "jaxdyn"], beaten_by(records), []
    for kind, theirs in (
        ("equations, compiled", [r for r in records if r.source.startswith(peers.COMPILED)]),
        ("mechanisms", [r for r in records if r.source != "jaxdyn" and r.method != "by hand"]),
    ):
        if not theirs:
            continue
        points = f"{sum(r in theirs for r, _ in below)} of {len(theirs)}"
        rows.append([theirs[0].scene, str(theirs[0].batch), kind, points])
        for target in TARGETS:
            labels = {r.label for r in theirs}
            best, who = min((cost_at([r for r in theirs if r.label == label], target), label) for label in labels)
            factor = cost_at(ours, target) / best
            rows[-1].append(f"{factor:.2g} ({who})" if 0 < factor < math.inf else "-")
    lines = [
        f"  {r.scene}, batch {r.batch}: {r.label} at {r.setting:.0e}: error {r.error_path:.1e}, {1e6 * r.seconds_best:.4g} us; "
        + (f"jaxdyn takes {factor:.2g} times as long" if math.isfinite(factor) else "jaxdyn has no run as exact")
        for r, factor in below
    ]
    return rows, lines


def draw(computed: Report, directory: Path) -> None:
    """An image of each plot, `SCENE_BATCH.png`."""
    directory.mkdir(parents=True, exist_ok=True)
    for group in plots(computed):
        scene, batch = group[0].scene, group[0].batch
        drawn = figure(f"{computed.scenes[scene].text}: {batch} at once", computed.scenes[scene], group)
        if drawn is not None:
            _draw_published(drawn.axes[0], PUBLISHED.get(scene, ()))
            drawn.savefig(directory / f"{scene}_{batch}.png", dpi=110)


def _draw_published(ax, runs) -> None:
    """Stars of published errors and times; dotted lines of times without an error."""
    for label, seconds, error, energy_error in runs:
        if error is not None:
            ax.plot([error], [seconds], "*", color="black", markersize=9, label=label)
        elif energy_error is None:
            ax.axhline(seconds, color="black", linestyle=":", linewidth=1, label=f"{label}, no error given")
    if runs:
        ax.legend(fontsize=6, frameon=False)


def main(argv=None) -> None:
    """Measure, print the tables, write the page, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=[], metavar="SCENE")
    parser.add_argument("--batch", nargs="+", type=int, default=(1,))
    parser.add_argument("--integrator", nargs="+", help="method:solver in place of the usual ones")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--all", action="store_true", help="all cases instead of five")
    parser.add_argument("--out", default=str(timing.OUT / "work_precision"))
    parser.add_argument("--figures", type=Path, help="directory for an image of each plot")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    def say(line):
        print(line, flush=True)

    known, out, parts = cases(), Path(options.out), []
    integrators = None if options.integrator is None else [tuple(pair.split(":")) for pair in options.integrator]
    for name in options.scenes or (known if options.all else SCENES):
        done = out / "scenes" / f"{name}.json"
        if done.exists():
            say(f"{name} as in {done}; remove the file to measure it anew")
        else:
            one = report(
                known[name],
                batches=options.batch,
                integrators=integrators,
                rounds=options.rounds,
                peers=peers.Peers(say),
                echo=say,
            )
            done.parent.mkdir(parents=True, exist_ok=True)
            done.write_text(one.to_json(), encoding="utf-8")
        parts.append(Report.from_json(done.read_text(encoding="utf-8")))
    measured = Report(
        parts[0].head,
        {name: known for part in parts for name, known in part.scenes.items()},
        tuple(record for part in parts for record in part.records),
    )
    write(measured, out)
    print(f"\n{measured.table()}\n\nWritten to {options.out}/report.html\n")
    if options.figures:
        draw(measured, options.figures)
    judged = [verdict(group) for group in plots(measured)]
    print("Time relative to the best peer, at an error of")
    header = ["scene", "batch", "peers that take", "points below", *(f"{x:.0e}" for x in TARGETS)]
    print(table(header, [row for rows, _ in judged for row in rows]))
    print("\nPeers' points below jaxdyn's front:")
    print("\n".join(line for _, lines in judged for line in lines) or "  none")


if __name__ == "__main__":
    main()
