"""Store of a batch: a Zarr group with one array for each quantity of a rollout, and the record of the finished chunks.

    runs.zarr/            opened by xarray: rows with names and units, reductions, the description in the attributes
      record/checksum     one row for each chunk, written after all of its arrays: the chunk is finished
      partial/            partial results of reductions, one row for each chunk

Every chunk of every array is a file of its own that ends in a CRC-32C (Zarr's codec crc32c), and the record repeats these
checksums. So a file that is missing, truncated, changed or of another run is recognised. Files are written under another name
and renamed: a process that is killed leaves complete files only. Zarr makes the store and its metadata. The files of chunks are
written and read here: they are bytes and a checksum, for which Zarr takes 4 ms each, ten times as long.
"""

import contextlib
import importlib.util
import os
import shutil
import sys
import time
import uuid
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 2  # of the layout above
RECORD = "record/checksum"


@dataclass(frozen=True)
class Variable:
    """An array of the store: name, axes, shape and dtype of one entry along its leading axis.

    `leading` is "rollout", "chunk" (one entry for each chunk) or None (an array of the whole).
    """

    name: str
    shape: tuple[int, ...]
    dtype: Any
    dims: tuple[str, ...]
    leading: str | None = "rollout"
    attributes: dict[str, Any] = field(default_factory=dict)


def zarr_package() -> Any:
    """The package zarr, if all others of the extra are installed too; xarray is imported only when a result is read.

    **Raises:** ImportError that names the extra.
    """
    try:
        import filelock  # noqa: F401 (these three are reported here if they are missing)
        import google_crc32c  # noqa: F401
        import tqdm  # noqa: F401
        import zarr
    except ImportError as error:
        raise ImportError(f"jd.scale needs {error.name}: pip install 'jaxdyn[scale]'") from error
    if "xarray" not in sys.modules and importlib.util.find_spec("xarray") is None:
        raise ImportError("jd.scale needs xarray: pip install 'jaxdyn[scale]'")
    return zarr


def check_place(path: Path) -> None:
    """Check that a store can be at this place.

    **Raises:** ValueError that names `out`, for a file, a folder that is not there, and one that cannot be written.
    """
    if path.exists() and not path.is_dir():
        raise ValueError(f"out is {str(path)!r}, which is a file; name a directory")
    if not path.parent.is_dir():
        raise ValueError(f"out is {str(path)!r}: there is no directory {path.parent}")
    # Asked before anything is computed: the first write comes after the compilation.
    place = path if path.exists() else path.parent
    if not os.access(place, os.W_OK | os.X_OK):
        raise ValueError(
            f"out is {str(path)!r}: {place} cannot be written; change its permissions, or name another place"
        )


class Store:
    """An existing store, open for writing.

    **Raises:** ValueError for a directory that is no store of this format, and for a damaged one.
    """

    def __init__(self, path: Path):
        zarr = zarr_package()
        from google_crc32c import value

        self.path, self._checksum = path, value
        try:
            self.group = zarr.open_group(path, mode="r+")
            attributes = dict(self.group.attrs)
        except (FileNotFoundError, NotADirectoryError):  # the path exists, but is no group of Zarr
            attributes = {}
        # No damage: the system's own message names the cause.
        except PermissionError:
            raise
        except Exception as error:  # zarr checks little of its file: bad JSON, keys and types raise anything
            raise self._damage_error(error) from error
        if attributes.get("jaxdyn_store") != FORMAT:
            version = attributes.get("jaxdyn_store", "nothing")
            raise ValueError(
                f"out is {str(path)!r}, whose format is {version} of jaxdyn and not {FORMAT}: it is of another version, or no "
                "store of jd.scale; name another one"
            )
        try:
            self.description = dict(attributes["description"])
            self.count, self.chunk = int(attributes["rollouts"]), int(attributes["chunk"])
            self.chunks = -(-self.count // self.chunk)
            self.names = tuple(attributes["arrays"])
            self._arrays: dict[str, Any] = {name: self.group[name] for name in (*self.names, RECORD)}
        except (KeyError, TypeError, ValueError, ArithmeticError, OSError) as error:
            raise self._damage_error(error) from error

    def _damage_error(self, error: Exception) -> ValueError:
        reason = " ".join(str(error).split()) or type(error).__name__
        return ValueError(
            f"out is {str(self.path)!r}, whose zarr.json is damaged ({type(error).__name__}: {reason}); put it back from a "
            "copy, or name another store"
        )

    @classmethod
    def create(
        cls,
        path: Path,
        variables: Sequence[Variable],
        coordinates: Mapping[str, tuple[Sequence[Any] | np.ndarray, dict[str, Any]]],
        description: Mapping[str, Any],
        count: int,
        chunk: int,
    ) -> "Store":
        """Make a store under another name and rename it: there is none, or a complete one."""
        zarr = zarr_package()
        from zarr.codecs import Crc32cCodec

        # In the same folder, because a rename to another file system is a copy; the name is unique to this process.
        beside = path.with_name(f"{path.name}.{uuid.uuid4().hex}.tmp")
        chunks = -(-count // chunk)
        lengths = {"rollout": (count, chunk), "chunk": (chunks, 1)}
        stored = [one.name for one in variables if one.leading is not None]
        attributes = {"jaxdyn_store": FORMAT, "description": dict(description), "rollouts": count, "chunk": chunk}
        attributes |= {"arrays": stored, "created": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
        try:
            with warnings.catch_warnings():
                group = zarr.create_group(beside, attributes=attributes)
                record = Variable(RECORD, (len(stored),), np.dtype(np.uint32), ("array",), "chunk")
                for one in [*variables, record]:
                    size, part = ((length,) for length in lengths[one.leading]) if one.leading else ((), ())
                    group.create_array(
                        one.name,
                        shape=size + one.shape,
                        chunks=tuple(max(1, n) for n in part + one.shape),
                        dtype=one.dtype,
                        compressors=[Crc32cCodec()],
                        fill_value=_empty(one.dtype),
                        dimension_names=([one.leading] if one.leading else []) + list(one.dims),
                        attributes=one.attributes,
                    )
                for name, (values, notes) in coordinates.items():
                    array = np.asarray(values)
                    kind = "string" if array.dtype.kind in "UO" else array.dtype
                    axis = {"shape": array.shape, "dtype": kind, "dimension_names": (name,), "attributes": notes}
                    group.create_array(name, **axis)[...] = array
                # xarray reads it. Zarr warns that it is no part of version 3 of the format.
                warnings.filterwarnings("ignore", message="Consolidated metadata")
                zarr.consolidate_metadata(beside)
            beside.rename(path)
        finally:
            # Behind a successful rename nothing has this name any more.
            shutil.rmtree(beside, ignore_errors=True)
        return cls(path)

    def check(self, description: Mapping[str, Any]) -> None:
        """Check that the store is of the same study, before it is resumed.

        **Raises:** ValueError that names the first part of the description that differs, with both values.
        """
        for name, value in description.items():
            before = self.description.get(name)
            if before != value:
                raise ValueError(
                    f"out is {str(self.path)!r}, a store of another {name}: there it is {_short(before)}, here {_short(value)}; "
                    f"name another store, or give the {name} of that one"
                )

    def numbers(self, chunk: int) -> np.ndarray:
        """Numbers of the rollouts of a chunk."""
        return np.arange(chunk * self.chunk, min((chunk + 1) * self.chunk, self.count))

    def is_done(self, chunk: int) -> bool:
        """True for a finished chunk: its record exists."""
        return self._file(RECORD, chunk).exists()

    def record_mask(self) -> np.ndarray:
        """Mask of the finished chunks (chunks,)."""
        mask = np.zeros(self.chunks, bool)
        # One listing, not a question for each of a million chunks. The folder of a chunk exists before its file.
        with contextlib.suppress(FileNotFoundError), os.scandir(self._file(RECORD, 0).parent.parent) as entries:
            done = [int(entry.name) for entry in entries if entry.name.isdigit() and self.is_done(int(entry.name))]
            mask[done] = True
        return mask

    def write(self, chunk: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write all arrays of a chunk, then its record.

        **Raises:** OSError for a full disk; chunks that were finished before are kept.
        """
        checksums = [self._write_file(name, chunk, arrays[name]) for name in self.names]
        # The record last: a chunk without it is missing, whatever files it has.
        self._write_file(RECORD, chunk, np.asarray([checksums], np.uint32))

    def read(self, chunk: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """These arrays of a chunk. **Raises:** ValueError for a file that does not fit its checksum, OSError for none."""
        # The file of the last chunk is filled up. Arrays with an axis of chunks have one entry, which this keeps too.
        size = len(self.numbers(chunk))
        return {name: self._read_file(name, chunk)[0][:size] for name in names}

    def is_whole(self, chunk: int) -> bool:
        """True where all files of a finished chunk are those that were written, by their checksums."""
        try:
            # The record recognises files of another run, too.
            checksums, _ = self._read_file(RECORD, chunk)
            return checksums[0].tolist() == [self._read_file(name, chunk)[1] for name in self.names]
        except (ValueError, OSError):
            return False

    def forget(self, chunk: int) -> None:
        """Remove the record of a chunk, so that it is computed again."""
        self._file(RECORD, chunk).unlink(missing_ok=True)

    def write_results(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Write the arrays without a leading axis: results of reductions."""
        for name, value in arrays.items():
            self.group[name][...] = value

    def remove_leftovers(self) -> None:
        """Remove files that killed processes were writing; a task of a dead client that still writes one ends with an error."""
        for path in self.path.rglob("*.partial"):
            path.unlink(missing_ok=True)

    def _file(self, name: str, chunk: int) -> Path:
        array = self._arrays[name]
        return self.path / name / array.metadata.encode_chunk_key((chunk, *(0,) * (array.ndim - 1)))

    def _write_file(self, name: str, chunk: int, values: np.ndarray) -> int:
        """Write the file of an array's chunk, and return its checksum."""
        array = self._arrays[name]
        # Zarr's chunks are full: the last one is filled up.
        if len(values) < array.chunks[0]:
            short, values = values, np.full((array.chunks[0], *array.shape[1:]), array.fill_value, array.dtype)
            values[: len(short)] = short
        # The codec bytes is little-endian.
        data = np.ascontiguousarray(values, array.dtype.newbyteorder("<"))
        checksum = self._checksum(data)
        path = self._file(name, chunk)
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(f"{path.name}.{uuid.uuid4().hex}.partial")
        try:
            with beside.open("wb") as file:
                file.write(data.data)
                file.write(checksum.to_bytes(4, "little"))
            beside.replace(path)
        except BaseException:
            beside.unlink(missing_ok=True)
            raise
        return checksum

    def _read_file(self, name: str, chunk: int) -> tuple[np.ndarray, int]:
        """Values and checksum of an array's chunk. **Raises:** ValueError where they do not fit."""
        array, data = self._arrays[name], np.fromfile(self._file(name, chunk), np.uint8)
        checksum = self._checksum(data[:-4])
        if data[-4:].tobytes() != checksum.to_bytes(4, "little"):
            raise ValueError(f"{self._file(name, chunk)} is damaged")
        values = data[:-4].view(array.dtype.newbyteorder("<"))
        return values.reshape(array.chunks[0], *array.shape[1:]), checksum


def _empty(dtype: Any) -> Any:
    """Fill value of chunks that were not computed yet: one that no result has, where the dtype has one."""
    kind = np.dtype(dtype).kind
    return np.nan if kind == "f" else False if kind == "b" else np.iinfo(dtype).max if kind == "u" else -1


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 200 else f"{text[:100]} ... {text[-90:]}"
