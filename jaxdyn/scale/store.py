"""Store of a batch: a Zarr group with one array for each quantity of a rollout, and the record of the finished chunks.

    runs.zarr/            opened by xarray: rows with names and units, reductions, the description in the attributes
      record/checksum     one row for each chunk, written after all of its arrays: the chunk is finished
      partial/            partial results of reductions, one row for each chunk

Every chunk of every array is a file of its own that ends in a CRC-32C (Zarr's codec crc32c), and the record repeats these
checksums. So a file that is missing, truncated, changed or of another run is recognised. Zarr writes files under another name
and renames them: a process that is killed leaves complete files only.
"""

import contextlib
import errno
import importlib.util
import os
import shutil
import sys
import time
import uuid
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 1  # of the layout above
FULL = (errno.ENOSPC, errno.EDQUOT)


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
    compressed: bool = False


def zarr_package() -> Any:
    """The package zarr, if xarray is installed too, which is imported only when a result is read.

    **Raises:** ImportError that names the extra.
    """
    try:
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
        self.path = path
        self._zarr = zarr
        # Zarr reads its settings when an array is opened.
        with self._writing():
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
            self._arrays: dict[str, Any] = {name: self.group[name] for name in self.names}
            self._record: Any = self.group["record/checksum"]
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
        """Make a store under another name and rename it; if another process was first, open that one's."""
        zarr = zarr_package()
        from zarr.codecs import Crc32cCodec, ZstdCodec

        # In the same folder, because a rename to another file system is a copy; the name is unique to this process.
        beside = path.with_name(f"{path.name}.{uuid.uuid4().hex}.tmp")
        chunks = -(-count // chunk)
        lengths = {"rollout": (count, chunk), "chunk": (chunks, 1)}
        stored = [one.name for one in variables if one.leading is not None]
        attributes = {"jaxdyn_store": FORMAT, "description": dict(description), "rollouts": count, "chunk": chunk}
        attributes |= {"arrays": stored, "created": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
        try:
            with _quiet():
                group = zarr.create_group(beside, attributes=attributes)
                record = Variable("record/checksum", (len(stored),), np.dtype(np.uint32), ("array",), "chunk")
                for one in [*variables, record]:
                    size, part = ((length,) for length in lengths[one.leading]) if one.leading else ((), ())
                    group.create_array(
                        one.name,
                        shape=size + one.shape,
                        chunks=tuple(max(1, n) for n in part + one.shape),
                        dtype=one.dtype,
                        # The checksum is the last codec, so that it ends the file.
                        compressors=[ZstdCodec(), Crc32cCodec()] if one.compressed else [Crc32cCodec()],
                        fill_value=_empty(one.dtype),
                        dimension_names=([one.leading] if one.leading else []) + list(one.dims),
                        attributes=one.attributes,
                    )
                for name, (values, notes) in coordinates.items():
                    array = np.asarray(values)
                    kind = "string" if array.dtype.kind in "UO" else array.dtype
                    axis = {"shape": array.shape, "dtype": kind, "dimension_names": (name,), "attributes": notes}
                    group.create_array(name, **axis)[...] = array
                zarr.consolidate_metadata(beside)
                try:
                    # Atomic: other processes see no store or a complete one, and one process alone is first.
                    beside.rename(path)
                except OSError as error:
                    # Another process was first: its store is opened, and `check` compares the studies.
                    if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                        raise
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

    def rows(self, chunk: int) -> slice:
        """Places of the rollouts of a chunk."""
        return slice(chunk * self.chunk, min((chunk + 1) * self.chunk, self.count))

    def is_done(self, chunk: int) -> bool:
        """True for a finished chunk: its record exists."""
        return self._file("record/checksum", self._record, chunk).exists()

    def record_mask(self) -> np.ndarray:
        """Mask of the finished chunks (chunks,)."""
        mask = np.zeros(self.chunks, bool)
        folder = self._file("record/checksum", self._record, 0).parent.parent
        # One listing, not a question for each of a million chunks. The folder of a chunk exists before its file.
        with contextlib.suppress(FileNotFoundError), os.scandir(folder) as entries:
            done = [int(entry.name) for entry in entries if entry.name.isdigit() and self.is_done(int(entry.name))]
            mask[done] = True
        return mask

    def count_rollouts(self, chunks: np.ndarray) -> int:
        """Number of rollouts in the chunks of a mask (chunks,)."""
        # The last chunk may have fewer rollouts than the others.
        last = self.count - (self.chunks - 1) * self.chunk
        return int(chunks.sum()) * self.chunk - int(chunks[-1]) * (self.chunk - last)

    def write(self, chunk: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write all arrays of a chunk, then its record.

        **Raises:** OSError for a full disk; chunks that were finished before are kept.
        """
        with self._writing():
            for name, array in self._arrays.items():
                array[self._place(array, chunk)] = arrays[name]
            # The record last: a chunk without it is missing, whatever files it has.
            self._record[chunk] = self._sums(chunk)

    def read(self, chunk: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """These arrays of a chunk."""
        return {name: np.asarray(self._arrays[name][self._place(self._arrays[name], chunk)]) for name in names}

    def is_whole(self, chunk: int) -> bool:
        """True where all files of a finished chunk are those that were written, by their checksums."""
        try:
            # The last bytes against the record recognise files of another run; reading them checks all other bytes.
            if not np.array_equal(np.asarray(self._record[chunk]), self._sums(chunk)):
                return False
            for array in self._arrays.values():
                array[self._place(array, chunk)]
        except (ValueError, OSError, RuntimeError):  # the codec's checksum differs; a file is missing or truncated
            return False
        return True

    def forget(self, chunk: int) -> None:
        """Remove the record of a chunk, so that it is computed again."""
        self._file("record/checksum", self._record, chunk).unlink(missing_ok=True)

    def write_results(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Write the arrays without a leading axis: results of reductions."""
        with self._writing():
            for name, value in arrays.items():
                self.group[name][...] = value

    def remove_leftovers(self) -> None:
        """Remove files that killed processes were writing; a task of a dead client that still writes one ends with an error."""
        for path in self.path.rglob("*.partial"):
            path.unlink(missing_ok=True)

    def _place(self, array: Any, chunk: int) -> slice:
        return self.rows(chunk) if array.metadata.dimension_names[0] == "rollout" else slice(chunk, chunk + 1)

    def _file(self, name: str, array: Any, chunk: int) -> Path:
        return self.path / name / array.metadata.encode_chunk_key((chunk, *(0,) * (array.ndim - 1)))

    def _sums(self, chunk: int) -> np.ndarray:
        """The last four bytes of each array's file, which are its CRC-32C."""
        # The codec has put them at the end; the rest of the file is not read.
        checksums = []
        for name, array in self._arrays.items():
            with self._file(name, array, chunk).open("rb") as file:
                file.seek(-4, os.SEEK_END)
                checksums.append(int.from_bytes(file.read(4), "little"))
        return np.asarray(checksums, np.uint32)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        # By default Zarr writes no file for a chunk of fill values; here a missing file has to mean a missing chunk.
        with self._zarr.config.set({"array.write_empty_chunks": True}):
            yield


@contextlib.contextmanager
def full_disk(path: Path) -> Iterator[None]:
    """Replace the error of a full disk by one that names the store.

    **Raises:** OSError with the same number.
    """
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            raise OSError(
                error.errno,
                f"out is {str(path)!r}, and its file system is full ({os.strerror(error.errno)}); chunks that were finished are "
                "kept: make room and run again",
            ) from error
        raise


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Zarr's warning that consolidated metadata is no part of version 3 of its format; xarray reads it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Consolidated metadata")
        yield


def _empty(dtype: Any) -> Any:
    """Fill value of chunks that were not computed yet: one that no result has, where the dtype has one."""
    kind = np.dtype(dtype).kind
    return np.nan if kind == "f" else False if kind == "b" else np.iinfo(dtype).max if kind == "u" else -1


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 200 else f"{text[:100]} ... {text[-90:]}"
