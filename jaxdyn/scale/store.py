"""Store of a batch: a Zarr group with one array for each quantity of a rollout.

    runs.zarr/            opened by xarray: rows with names and units, reductions, the description in the attributes
      result/             codes of the rollouts. Those of a chunk are written last: the chunk is finished
      partial/            partial results of reductions, one row for each chunk

Every chunk of every array is a file of its own that ends in a CRC-32C (Zarr's codec crc32c), by which a file that is damaged is
recognised. One process at a time writes to a store, by a lock of filelock and a file that names its owner.
"""

import contextlib
import getpass
import importlib.util
import os
import shutil
import socket
import sys
import time
import uuid
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 3  # of the layout above
RESULT = "result"  # name of the array of codes


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
        import filelock  # noqa: F401 (these two are reported here if they are missing)
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
        self.path = path
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
            # Zarr does not write a chunk that has its fill value alone, such as codes of rollouts that all failed.
            self._arrays: dict[str, Any] = {
                name: self.group[name].with_config({"write_empty_chunks": True}) for name in self.names
            }
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
        # The codes are the last array that is written.
        stored = sorted((one.name for one in variables if one.leading is not None), key=RESULT.__eq__)
        attributes = {"jaxdyn_store": FORMAT, "description": dict(description), "rollouts": count, "chunk": chunk}
        attributes |= {"arrays": stored, "created": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
        try:
            with warnings.catch_warnings():
                group = zarr.create_group(beside, attributes=attributes)
                for one in variables:
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
        """True for a finished chunk: its codes exist."""
        return self._file(RESULT, chunk).exists()

    def done_mask(self) -> np.ndarray:
        """Mask of the finished chunks (chunks,)."""
        mask = np.zeros(self.chunks, bool)
        folder = self._file(RESULT, 0).parent
        # One listing, not a question for each of a million chunks.
        mask[[int(name) for name in (os.listdir(folder) if folder.exists() else ()) if name.isdigit()]] = True
        return mask

    def write(self, chunk: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write all arrays of a chunk, its codes the last.

        **Raises:** OSError for a full disk; chunks that were finished before are kept.
        """
        for name in self.names:
            self._arrays[name][self._rows(name, chunk)] = arrays[name]

    def read(self, chunk: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """These arrays of a chunk. **Raises:** ValueError for a file that does not fit its checksum."""
        return {name: self._arrays[name][self._rows(name, chunk)] for name in names}

    def is_whole(self, chunk: int) -> bool:
        """True where all files of a finished chunk are there and fit their checksums."""
        # Zarr fills up for a file that is missing; it writes none for arrays without entries.
        if not all(self._file(name, chunk).exists() for name in self.names if self._arrays[name].size):
            return False
        try:
            self.read(chunk, self.names)
        except (ValueError, OSError):
            return False
        return True

    def forget(self, chunk: int) -> None:
        """Remove the files of a chunk, so that it is computed again."""
        for name in reversed(self.names):
            self._file(name, chunk).unlink(missing_ok=True)

    def write_results(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Write the arrays without a leading axis: results of reductions."""
        for name, value in arrays.items():
            self.group[name][...] = value

    def _file(self, name: str, chunk: int) -> Path:
        array = self._arrays[name]
        return self.path / name / array.metadata.encode_chunk_key((chunk, *(0,) * (array.ndim - 1)))

    def _rows(self, name: str, chunk: int) -> slice:
        # Arrays with an axis of chunks have one row for each.
        size = self._arrays[name].chunks[0]
        return slice(chunk * size, (chunk + 1) * size)


def _empty(dtype: Any) -> Any:
    """Fill value of chunks that were not computed yet: one that no result has, where the dtype has one."""
    kind = np.dtype(dtype).kind
    return np.nan if kind == "f" else False if kind == "b" else np.iinfo(dtype).max if kind == "u" else -1


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 200 else f"{text[:100]} ... {text[-90:]}"


@contextlib.contextmanager
def lock_store(path: Path) -> Iterator[tuple[Path, str]]:
    """Hold the lock of a store; gives the file that names its owner, and its text. The lock of a dead process is free.

    **Raises:** ValueError that names the owner where another process holds it.
    """
    from filelock import FileLock, Timeout

    # The owner stands in a file of its own: filelock truncates the lock's file when it tries to acquire it.
    lock, owner = FileLock(f"{path}.lock"), path.with_name(f"{path.name}.owner")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        # The file is written just after the lock is taken.
        name = owner.read_text(encoding="utf-8").splitlines()[0] if owner.exists() else "another process"
        raise ValueError(
            f"out is {str(path)!r}, to which {name} is writing; wait for it, end it, or name another store"
        ) from error
    try:
        user = str(os.getuid())
        with contextlib.suppress(KeyError, OSError):  # in a container without an entry for the user
            user = getpass.getuser()
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        # The random line lets workers tell this file from one of the same name on a disk of their own.
        text = f"process {os.getpid()} of {user} on {socket.gethostname()}, since {since},\n{uuid.uuid4().hex}\n"
        owner.write_text(text, encoding="utf-8")
        yield owner, text
    finally:
        owner.unlink(missing_ok=True)
        lock.release()
