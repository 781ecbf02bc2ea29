"""Writing a file so that its final name never holds half of it."""

from __future__ import annotations

import os
import socket
from contextlib import contextmanager
from pathlib import Path

from pagas_cl.errors import OutputError

PART = ".part"


@contextmanager
def written(path: Path):
    """Context of a binary file that gets the name `path` when all of it is on disk.

    Raises
    ------
    OutputError
        The folder cannot be made, the disk is full, or writing is not permitted.
    """
    path = Path(path)
    beside = path.with_name(f".{path.name}.{socket.gethostname()}-{os.getpid()}{PART}")
    with translate_os_errors(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(beside, "wb") as file:
                yield file
            os.replace(beside, path)
        finally:
            if beside.exists():
                beside.unlink()


@contextmanager
def translate_os_errors(path: Path):
    """Context: what goes wrong while writing to `path`, as an OutputError of one sentence."""
    try:
        yield
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"cannot write {str(path)!r}: {error.strerror or error}; finished views are kept, make room "
                          "or choose another folder, and start the same command again") from error


def clear_parts(folder: Path) -> None:
    """Remove what killed runs have left beside final names."""
    for left in list(folder.rglob(f".*{PART}")) if folder.is_dir() else ():
        left.unlink(missing_ok=True)
