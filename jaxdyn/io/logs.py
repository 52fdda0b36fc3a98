"""Log files: CSV or NPZ with named columns t, q1.., v1.., a1.., tau1.. (or q_<joint name> ...)."""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxdyn.identify.log_repair import repair_log
from jaxdyn.identify.logs import Log
from jaxdyn.model.arguments import Checked, FilePath, as_path, check_known, parse_number
from jaxdyn.model.tree import Model

_SIGNALS = ("q", "v", "a", "tau")
_NOTE = re.compile(r"\s+\[([^\]]*)\]$")  # a unit after a column's name
# Parts of units that are none of SI, or are multiples: numbers in them would be read as rad, s, m, N or N m.
_OTHER_UNITS = frozenset(
    "° º deg degs degree degrees grad gon rev revs turn turns rpm ms msec us usec µs μs ns min mm cm km in inch inches ft "
    "mnm knm ncm nmm mn kn gf kgf lbf lb oz".split()
)


def read_log(
    path: FilePath,
    *,
    joint_names: Checked[Sequence[str] | None] = None,
    rename: Checked[Mapping[str, str] | None] = None,
    rollout: int | None = None,
    unwrap: bool | str = "auto",
    outliers: str = "refuse",
    model: Checked[Model | None] = None,
) -> Log:
    """Read a log from a CSV file with one header line, or from an NPZ archive.

    Columns: `t` (s); `q1, q2, ...` positions; `v1, ...` velocities and `a1, ...` accelerations (both optional); `tau1,
    ...` torques. The numbers may be replaced by joint names: `q_shoulder, tau_shoulder`. In an NPZ archive each column
    is an array (n,), or a signal is one array (n, columns) named `q`, `v`, `a`, `tau`. Columns of other names are
    ignored. A name in a CSV file may be followed by its unit in brackets, `q_shoulder [rad]`; numbers are taken in SI units, and
    other units, such as [deg] and [ms], are refused.
    Columns of a CSV file may be separated by commas, semicolons or tabs; numbers have a decimal point.

    **Arguments:** `path`: of the file; `joint_names`: order of the joints in the result for columns with joint names (a model's
    `joint_names`); columns of other joints are ignored. Without it the order of the file's tau columns. `rename`: from
    names of joints in the file to those of the model, {"motor1": "shoulder"}. `rollout`: which motion of a file that holds
    several, as `Solution.to_csv` and `to_npz` write them of a batch; the first is 1. `unwrap`, `outliers`, `model`: what becomes
    of angles that jump by whole turns and of corrupted samples, as for `jd.identify.from_raw`; `outliers="keep"` reads torques
    that were prescribed, not measured.

    **Returns:** `jd.identify.Log`; v and a are None when the file has none. Make them with `jd.identify.from_raw`.

    **Raises:** FileNotFoundError; ValueError, with the path, for another file type, a cell that is no number (line and
    column), a first line that is no header, units that are not of SI, columns numbered from 0, missing or repeated columns
    (with a `rename` that gives the joints their names, where there are as many), everything that `Log` refuses (NaN, unequal
    lengths, time running backwards), and outliers, with row and joint.
    """
    path = as_path(path)
    readers = {".csv": _read_csv, ".npz": _read_npz}
    if path.suffix.lower() not in readers:
        raise ValueError(f"{path}: log files are .csv or .npz, not {path.suffix!r}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such log file")
    # The motion is chosen before anything else: samples of several motions are not monotonic in time.
    columns = _one_motion(readers[path.suffix.lower()](path), rollout, path)
    try:
        columns = _rename(columns, rename or {})
        log = _assemble(columns, None if joint_names is None else tuple(joint_names))
        return repair_log(log, model, unwrap=unwrap, outliers=outliers)
    except ValueError as error:
        # The inner error is repeated in the text with the path; a chained traceback would show it twice.
        raise ValueError(f"{path}: {error}") from None


def _one_motion(columns: dict[str, np.ndarray], rollout: int | None, path) -> dict[str, np.ndarray]:
    """Columns of one motion of a file with a column `rollout`, or with signals (rollouts, n, columns)."""
    numbers = columns.pop("rollout", None)
    stacked = {name: len(columns[name]) for name in _SIGNALS if name in columns}
    known = sorted(set(np.asarray(numbers, int).tolist())) if numbers is not None else []
    # `Solution.to_npz` stacks a batch on the first axis and has no column of numbers.
    known = known or list(range(1, 1 + max(stacked.values(), default=1)))
    if rollout is None and len(known) > 1:
        raise ValueError(f"{path}: the file holds {len(known)} motions; choose one, as rollout={known[0]}")
    chosen = known[0] if rollout is None else rollout
    if chosen not in known:
        raise ValueError(f"{path}: rollout is {rollout!r}; the motions of the file are {known[0]} to {known[-1]}")
    if numbers is not None:
        return {name: values[numbers == chosen] for name, values in columns.items()}
    for name in stacked:
        value = columns.pop(name)[chosen - 1]
        columns.update({f"{name}{i + 1}": value[:, i] for i in range(value.shape[1])})
    return columns


def write_log(path: FilePath, log: Log) -> None:
    """Write a log as CSV (every number at full precision) or NPZ, with columns in the format of `read_log`.

    Columns carry joint names when the log knows them and has one coordinate per joint, else numbers.

    **Raises:** ValueError for another file type.
    """
    check_known("write_log", log=log)
    path = as_path(path)
    columns: dict[str, Any] = {"t": np.asarray(log.t)}
    # A quaternion has four coordinates for three velocities, so a name for each column of q does not exist.
    named = log.joint_names if log.q.shape[1] == log.nv else None
    for signal in _SIGNALS:
        value = getattr(log, signal)
        if value is None:
            continue
        for i in range(value.shape[1]):
            columns[f"{signal}_{named[i]}" if named else f"{signal}{i + 1}"] = np.asarray(value[:, i])
    if path.suffix.lower() == ".npz":
        np.savez_compressed(path, **columns)
    elif path.suffix.lower() == ".csv":
        # newline="" is required by `csv`: on Windows the line ends would otherwise be doubled.
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            # repr is the shortest text that reads back as the same double.
            writer.writerows([repr(float(x)) for x in row] for row in zip(*columns.values(), strict=True))
    else:
        raise ValueError(f"{path}: log files are .csv or .npz, not {path.suffix!r}")


def _read_csv(path) -> dict[str, np.ndarray]:
    # Bytes, because the position of an invalid one gives its line for the message.
    data = path.read_bytes()
    try:
        # Spreadsheet programs put a byte order mark in front.
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}: line {line} is not UTF-8 ({error.reason}); save the file as UTF-8") from error
    with io.StringIO(text, newline="") as file:
        first = file.readline()
        # The header is read again by `csv`, which handles quoted names.
        file.seek(0)
        names = re.sub(r"\[[^\]]*\]", "", first)  # units may contain separators
        # Semicolons win over commas: locales with decimal commas separate by semicolons.
        separator = next((sign for sign in ";,\t" if sign in names), ",")
        reader = csv.reader(file, delimiter=separator)
        titles = [name.strip() for name in next(reader, [])]
        header = [_NOTE.sub("", title) for title in titles]
        if not header:
            raise ValueError(f"{path}: the file is empty; the first line names the columns t, q1, ..., tau1, ...")
        if all(_is_number(name) for name in header):
            raise ValueError(
                f"{path}: line 1 is {', '.join(header[:3])}, ...: numbers, no header; the first line names the columns: t, q1, "
                f"q2, ..., tau1, tau2, ... ({len(header)} columns)"
            )
        for title, name in zip(titles, header, strict=True):
            _check_unit(title, name, path)
        repeated = sorted({name for name in header if header.count(name) > 1})
        if repeated:
            raise ValueError(f"{path}: repeated columns {', '.join(repeated)}")
        rows = []
        for cells in reader:
            # csv gives an empty list for a blank line; editors leave one at the end.
            if not cells:
                continue
            if len(cells) != len(header):
                raise ValueError(f"{path}: line {reader.line_num} has {len(cells)} cells, the header {len(header)}")
            try:
                rows.append([parse_number(cell) for cell in cells])
            except ValueError:
                name, cell = next((n, c) for n, c in zip(header, cells, strict=True) if not _is_number(c))
                # A decimal comma is the usual cause in files that are separated by semicolons.
                point = "; write decimal points" if _is_number(cell.replace(",", ".", 1)) else ""
                raise ValueError(
                    f"{path}: line {reader.line_num}, column {name}: {cell!r} is no number{point}"
                ) from None
    table = np.array(rows).reshape(len(rows), len(header))
    return {name: table[:, i] for i, name in enumerate(header)}


def _check_unit(title: str, name: str, path) -> None:
    """Refuse a unit that is not of SI behind the name of a column that is read."""
    note = _NOTE.search(title)
    if note is None or re.fullmatch(rf"t|({'|'.join(_SIGNALS)})(\d+|_.+)", name) is None:
        return
    # `Solution.to_csv` writes the coordinate before the unit: q1 [base.x; m].
    unit = note[1].split(";")[-1].strip()
    if _OTHER_UNITS.intersection(re.split(r"[\s/*·.^²\d]+", unit.lower())):
        raise ValueError(
            f"{path}: column {name} is in {unit}; numbers are taken in s, rad, m, N and N m: convert the column and its unit"
        )


def _is_number(cell: str) -> bool:
    try:
        parse_number(cell)
    except ValueError:
        return False
    return True


def _read_npz(path) -> dict[str, np.ndarray]:
    columns = {}
    # A pickle in an archive could run code.
    with np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            value = archive[name]
            if name in _SIGNALS:
                if value.ndim not in (2, 3):
                    raise ValueError(f"{path}: {name} has shape {value.shape}, expected (n, columns)")
                # One motion is a batch of one, so that both layouts share the selection in `_one_motion`.
                columns[name] = value if value.ndim == 3 else value[None]
            else:
                columns[name] = value
    return columns


def _assemble(columns: dict[str, np.ndarray], joint_names) -> Log:
    if "t" not in columns:
        raise ValueError(f"missing column t; the file has {', '.join(columns) or 'none'}")
    columns_of = {signal: _signal_columns(columns, signal) for signal in _SIGNALS}
    if zero := [f"{signal}0" for signal in _SIGNALS if columns_of[signal].get("0") == f"{signal}0"]:
        # They would be ignored, and the columns of the second joint taken for those of the first.
        raise ValueError(f"columns are numbered from 0 ({', '.join(zero)}); number them from 1")
    for signal in ("q", "tau"):
        if not columns_of[signal]:
            hint = "" if signal == "q" else ' (of simulate: outputs=("torque",))'
            raise ValueError(f"missing columns {signal}1, {signal}2, ...{hint}; the file has {', '.join(columns)}")
    labels = list(columns_of["tau"])
    # The torques decide, since every log has them and their columns are never quaternions. tau_1 is of a joint named "1".
    by_number = all(columns_of["tau"][label] == f"tau{label}" for label in labels)
    for signal in _SIGNALS if by_number else ():
        if named := [column for label, column in columns_of[signal].items() if column != f"{signal}{label}"]:
            raise ValueError(f"columns of {signal} are named ({', '.join(named)}), those of tau numbered; use one kind")
    if not by_number:
        labels = list(joint_names) if joint_names is not None else labels
    missing = []
    arrays = {}
    for signal in _SIGNALS:
        if not columns_of[signal]:
            arrays[signal] = None
            continue
        # Numbered configurations may be longer than the torques (quaternions); their count is the largest number.
        wanted = [str(i + 1) for i in range(max(map(int, columns_of[signal])))] if by_number else labels
        missing += [f"{signal}{'' if by_number else '_'}{label}" for label in wanted if label not in columns_of[signal]]
        arrays[signal] = [columns[columns_of[signal][label]] for label in wanted if label in columns_of[signal]]
    if missing:
        raise ValueError(
            f"missing columns {', '.join(missing)}; the file has {', '.join(columns)}{_mapping(columns_of['tau'], labels)}"
        )
    lengths = {len(column) for group in arrays.values() if group for column in group}
    if len(lengths) > 1:
        sizes = {name: len(column) for name, column in columns.items()}
        raise ValueError(f"unequal lengths: {', '.join(f'{name} has {n} rows' for name, n in sizes.items())}")
    stacked: dict[str, Any] = {
        signal: None if group is None else np.stack(group, axis=1) for signal, group in arrays.items()
    }
    return Log(columns["t"], **stacked, joint_names=None if by_number else labels)


def _rename(columns: dict[str, np.ndarray], names) -> dict[str, np.ndarray]:
    """Rename the joints of columns. **Raises:** ValueError for a name that no column has."""
    result, used = {}, set()
    for column, values in columns.items():
        # The first underscore only: names of joints contain underscores.
        signal, _, joint = column.partition("_")
        if signal in _SIGNALS and joint in names:
            used.add(joint)
            column = f"{signal}_{names[joint]}"
        result[column] = values
    # A misspelt key would leave its column under the old name, which is then ignored.
    if unused := sorted(set(names) - used):
        raise ValueError(f"rename: no column is of joint {', '.join(unused)}; the file has {', '.join(columns)}")
    return result


def _mapping(columns: dict[str, str], labels) -> str:
    """Suggest a mapping where the file has as many joints under other names."""
    others = [label for label in columns if label not in labels]
    wanted = [label for label in labels if label not in columns]
    # A mapping by order is a guess and is suggested only where the counts agree.
    if not others or len(others) != len(wanted) or others[0].isdecimal():
        return ""
    pairs = " ".join(f"{theirs}={ours}" for theirs, ours in zip(others, wanted, strict=True))
    return f". If the joints are the same in this order, rename them: {pairs}"


def _signal_columns(columns, signal: str) -> dict[str, str]:
    """Map labels (number or joint name) to column names of one signal; mixing both kinds is refused."""
    numbered = {
        name[len(signal) :]: name for name in columns if name.startswith(signal) and name[len(signal) :].isdecimal()
    }
    named = {name[len(signal) + 1 :]: name for name in columns if name.startswith(signal + "_")}
    if numbered and named:
        raise ValueError(f"columns of {signal} are both numbered ({', '.join(numbered.values())}) and named "
                         f"({', '.join(named.values())}); use one kind")  # fmt: skip
    return numbered or named
