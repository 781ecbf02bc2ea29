"""Places that a command writes to: tried before the work, written whole after it."""

from __future__ import annotations

import tempfile
from pathlib import Path

from pagas_cl.errors import InputError


def check_writable(option: str, folder: Path | None) -> None:
    """Raise InputError where no file can be made in `folder`, which need not exist: it is not made by this."""
    if folder is None:
        return
    made = _made(option, folder)
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _refusal(option, folder, error) from error
    finally:
        for path in made:
            path.rmdir()


def write_file(path: Path, text: str) -> None:
    """Write text beside its name and rename it; its folder is made."""
    from pagas_cl.report.page import write_text

    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text)


def _made(option: str, folder: Path) -> list[Path]:
    """Make `folder`; the folders that were new, the innermost first."""
    folder = folder.absolute()
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        for path in new:
            if path.is_dir():
                path.rmdir()
        raise _refusal(option, folder, error) from error
    return new


def _refusal(option: str, folder: Path, error: OSError) -> InputError:
    file = next((path for path in (folder, *folder.parents) if path.is_file()), None)
    why = f"{str(file)!r} is a file" if file else error.strerror or str(error)
    return InputError(f"{option}: cannot write in the folder {str(folder)!r} ({why}): choose another one"
                      + ("" if file else ", or see to its permissions"))
