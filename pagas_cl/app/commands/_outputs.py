"""Places that a command writes to: none is an input, another output, or a file that pagas_cl has not written."""

import tempfile
from collections.abc import Collection, Mapping, Sequence
from itertools import repeat
from os.path import isfile
from pathlib import Path

from pagas_cl.errors import InputError
from pagas_cl.scene.meshes.files import SUFFIXES
from pagas_cl.scene.names import OWN
from pagas_cl.scene.own_files import is_own_json, is_own_mesh, is_own_text
from pagas_cl.scene.view import Scene, file_behind

_PAGE, _DATA_OF_PAGES = "index.html", ("report.json", "tradeoff.json")    # of --report, one a command
_OWN_FOLDER = (OWN, "cameras_report.json", _PAGE, *_DATA_OF_PAGES)    # one is in a folder that pagas_cl has written
Places = Sequence[tuple[str, Path | None]]
"""What messages call a place ("--output"), and where it is; None: not wanted."""


def check_outputs(files: Places, folders: Places, inputs: Mapping[str, Path | None], overwrite: bool) -> None:
    """Raise InputError unless each of `files` and `folders` may, and can, be written.

    Called when the scene has been read, whose files are among `inputs` (`scene_inputs`), before anything is written.

    Refused in any case: an output that is one of the inputs (also through a link), or the same place as another output;
    a file that is there, below a folder of the inputs, and was not written by pagas_cl; a folder there, likewise.
    Refused without `overwrite`: a file that is there and was not written by pagas_cl. Files inside a folder of depth
    maps or of cameras are compared by who knows their names: `check_names`, `check_place`.
    """
    read = [(path, what) for what, path in reversed(inputs.items()) if path is not None]     # the first name counts
    given = {_identity(path): what for path, what in read}
    read_folders = {path.resolve(): what for path, what in read if path.is_dir()}
    seen: dict[object, str] = {}
    for option, path in (*folders, *files):
        if path is None:
            continue
        place, named = _identity(path), f"{option} {str(path)!r}"
        if place in given:
            raise InputError(f"{named} is {given[place]}, which is read: choose another name")
        if place in seen:
            raise InputError(f"{named} is what {seen[place]} writes, too: choose another name")
        seen[place] = option
        around = next((read_folders[folder] for folder in path.resolve().parents if folder in read_folders), None)
        if path.is_dir():
            if (option, path) not in folders:
                raise InputError(f"{named} is a folder, expected the name of a file")
            if around is not None and any(path.iterdir()) and not any((path / name).exists() for name in _OWN_FOLDER):
                raise InputError(f"{named} is a folder of {around}, which is read: choose another one")
        elif path.exists() and (option, path) in folders:
            raise InputError(f"{named} is a file, expected a folder")
        elif path.exists():
            _check_file(named, path, around, overwrite)
    written = {path.parent: option for option, path in files if path is not None}
    for folder, option in {**written, **{path: option for option, path in folders if path is not None}}.items():
        check_writable(option, folder)


def _check_file(named: str, path: Path, around: str | None, overwrite: bool) -> None:
    if not path.is_file():
        raise InputError(f"{named} is no regular file (a pipe, a device or the like): choose another name")
    if is_own_mesh(path) if path.suffix.lower() in SUFFIXES else is_own_text(path) or is_own_json(path):
        return
    if around is not None:
        raise InputError(f"{named} is a file of {around}, which is read: choose another name")
    if not overwrite:
        raise InputError(f"{named} is there and was not written by pagas_cl: choose another name, or replace it with "
                         "--overwrite")


def check_writable(option: str, folder: Path) -> None:
    """Raise InputError where no file can be made in `folder`, which need not exist: it is not made by this."""
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


def page_files(report: Path | None, data: str, pictures: Collection[str] = (), overwrite: bool = False) -> Places:
    """Files of a page in the folder `report`, with its `data` and `pictures`, for `check_outputs`; InputError where
    there is the page of another command, unless that may be replaced."""
    if report is None:
        return []
    page = report / _PAGE
    if not overwrite and page.exists() and any((report / name).exists() for name in _DATA_OF_PAGES if name != data):
        raise InputError(f"--report: {str(page)!r} is the page of another command: choose another folder, or replace "
                         "it with --overwrite")
    return [("--report", report / name) for name in (_PAGE, data, *pictures)]


def scene_inputs(scene: Scene, depths: Sequence | None = None) -> dict[str, Path | None]:
    """What a scene reads, for `check_outputs`: photos, masks, depth maps, their folders, its cameras' file."""
    source = Path(scene.source)
    found: dict[str, Path | None] = {"the file of the cameras": source if isfile(source) else None}
    depths = scene.depths if depths is None else depths
    for view, depth in zip(scene.views, depths or repeat(None)):
        sources = {"photo": view.image, "mask": view.mask, "depth map": getattr(depth, "file", None)}
        for what, source in sources.items():
            if (path := file_behind(source)) is not None:
                found[f"the {what} of view {view.name!r}"] = path
                found[f"the folder of the {what}s ({str(path.parent)!r})"] = path.parent
    return found


def _identity(path: Path) -> object:
    """Equal for two names of one place, through links and where nothing is there yet."""
    try:
        found = path.stat()
    except OSError:
        return str(path.resolve())
    return found.st_dev, found.st_ino
