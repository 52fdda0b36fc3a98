"""Atomic writes of files: a temporary file in the same folder, then a rename."""

import contextlib
import os
import pathlib
from collections.abc import Iterator


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[pathlib.Path]:
    """Temporary path with the folder and suffix of `path`; at the end of the block it replaces `path`.

    When the block raises, the temporary file is removed and an existing file stays.
    """
    path = pathlib.Path(path)
    # The process id keeps two processes that write the same file apart.
    # The same folder, since a rename is atomic within one file system only; the same suffix, since writers infer the format.
    part = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield part
        # os.rename fails on Windows where the target exists.
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a UTF-8 text atomically."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
