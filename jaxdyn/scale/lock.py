"""One writer for each store: a lock by filelock, and a file that says who holds it."""

import contextlib
import getpass
import os
import socket
import time
import uuid
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def lock_store(path: Path) -> Iterator[tuple[Path, str]]:
    """Hold the lock of a store; the file beside it that names its owner, and its text. The lock of a dead process is free.

    **Raises:** ValueError that names the owner where another process holds it. ImportError that names the extra.
    """
    try:
        from filelock import FileLock, Timeout
    except ImportError as error:
        raise ImportError(f"jd.scale needs {error.name}: pip install 'jaxdyn[scale]'") from error
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
        text = f"{_identity()}\n{uuid.uuid4().hex}\n"
        owner.write_text(text, encoding="utf-8")
        yield owner, text
    finally:
        owner.unlink(missing_ok=True)
        lock.release()


def _identity() -> str:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # in a container without an entry for the user
        user = str(os.getuid())
    return f"process {os.getpid()} of {user} on {socket.gethostname()}, since {time.strftime('%Y-%m-%d %H:%M:%S')},"
