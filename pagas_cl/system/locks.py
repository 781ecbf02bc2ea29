"""Locks between processes: whoever holds one holds it until it lets go or ends, however that comes about."""

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_held: dict[Path, int] = {}      # folders that this process has locked: by which thread


def take(path: Path) -> int | None:
    """Lock the file `path`: its descriptor, or None where another process holds it.

    The file is made where there is none, for its owner alone; never emptied, and not looked for behind a link. OSError
    where it cannot be opened. Where the file system has no such locks, everybody gets them.
    """
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
        try:
            if sys.platform == "win32":
                import msvcrt

                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
                return descriptor      # nobody has removed it meanwhile: Windows removes no file that is open
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):      # the latter of Windows
            os.close(descriptor)
            return None
        except OSError:
            return descriptor
        try:
            same = os.path.samestat(os.stat(path), os.fstat(descriptor))
        except FileNotFoundError:
            same = False
        if same:
            return descriptor
        os.close(descriptor)     # who held it has removed it meanwhile


@contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Context: whether the lock `path` is held; the thread that holds it may enter again. The file goes with it."""
    path = Path(path).resolve()
    if _held.get(path) == threading.get_ident():
        yield True
        return
    descriptor = take(path)
    if descriptor is None:
        yield False
        return
    _held[path] = threading.get_ident()
    try:
        yield True
    finally:
        del _held[path]
        try:
            path.unlink(missing_ok=True)      # while it is held: afterwards it may be another one's
        except OSError:      # Windows removes no file that is open, here or in another process
            os.close(descriptor)
            with suppress(OSError):
                path.unlink(missing_ok=True)
        else:
            os.close(descriptor)
