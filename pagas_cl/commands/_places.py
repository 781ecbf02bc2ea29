"""Places that a command writes to: tried before the work, written whole after it."""

from __future__ import annotations

import tempfile
from pathlib import Path

from pagas_cl.errors import InputError


def check_writable(option: str, folder: Path | None) -> None:
    """Raise InputError where no file can be made in `folder`, which need not exist: it is not made by this."""
    if folder is None:
        return
    folder = folder.absolute()
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        file = next((path for path in (folder, *folder.parents) if path.is_file()), None)
        why = f"{str(file)!r} is a file" if file else error.strerror or str(error)
        raise InputError(f"{option}: cannot write in the folder {str(folder)!r} ({why}): choose another one"
                         + ("" if file else ", or see to its permissions")) from error
    finally:
        for path in new:
            if path.is_dir():
                path.rmdir()


def write_file(path: Path, text: str) -> None:
    """Write text beside its name and rename it; its folder is made."""
    from pagas_cl.report.page import write_text

    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text)
