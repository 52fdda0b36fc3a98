"""One writer for each store: a lock by filelock, and a file that names its owner."""

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
