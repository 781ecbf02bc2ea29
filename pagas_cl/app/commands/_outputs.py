"""Places that a command writes to: none is an input, another output, or a file that pagas_cl has not written."""

from collections.abc import Sequence
from itertools import repeat
from pathlib import Path

from pagas_cl.errors import InputError
from pagas_cl.scene.meshes.files import written_by_pagas_cl
from pagas_cl.scene.meshes.formats import SUFFIXES
from pagas_cl.scene.names import OWN
from pagas_cl.scene.own_files import is_own_json, is_own_text
from pagas_cl.scene.view import Scene
from pagas_cl.system.files import is_file

PAGE_FILES = ("index.html", "report.json", "tradeoff.json", "analysis.json")    # of --report
_OWN_FOLDER = (OWN, "cameras_report.json", *PAGE_FILES)       # one of these is in a folder that pagas_cl has written


def check_outputs(outputs: dict[str, Path | None], inputs: dict[str, Path | None], overwrite: bool) -> None:
    """Raise InputError unless each of `outputs` (None: not wanted) may be written.

    Keys are what messages call a place: "--output", "the mesh of SCENE". To be called when the scene has been read, so
    that its own files are among `inputs` (`scene_inputs`), and before anything is opened for writing.

    Refused in any case: an output that is one of the inputs (also through a link), or the same place as another output;
    a file that is there, below a folder of the inputs, and was not written by pagas_cl; a folder there, likewise.
    Refused without `overwrite`: a file that is there and was not written by pagas_cl. Files inside a folder of outputs
    are compared by who knows their names: `check_report`, `check_names`, `check_place`.
    """
    read = [(path, what) for what, path in reversed(inputs.items()) if path is not None]     # the first name counts
    given = {_identity(path): what for path, what in read}
    folders = {path.resolve(): what for path, what in read if path.is_dir()}
    seen: dict[object, str] = {}
    for option, path in outputs.items():
        if path is None:
            continue
        place, named = _identity(path), f"{option} {str(path)!r}"
        if place in given:
            raise InputError(f"{named} is {given[place]}, which is read: choose another name")
        if place in seen:
            raise InputError(f"{named} is what {seen[place]} writes, too: choose another name")
        seen[place] = option
        around = next((folders[folder] for folder in path.resolve().parents if folder in folders), None)
        if path.is_dir():
            if around is not None and any(path.iterdir()) and not any((path / name).exists() for name in _OWN_FOLDER):
                raise InputError(f"{named} is a folder of {around}, which is read: choose another one")
        elif path.exists() and option in ("--report", "--save-depth"):
            raise InputError(f"{named} is a file, expected a folder")
        elif path.exists():
            _check_file(named, path, around, overwrite)
    page, json_file = outputs.get("--report"), outputs.get("--json")
    if page is not None and json_file is not None and _identity(json_file) in {_identity(page / n) for n in PAGE_FILES}:
        raise InputError(f"--json {str(json_file)!r} is what --report writes, too: choose another name")


def _check_file(named: str, path: Path, around: str | None, overwrite: bool) -> None:
    if not path.is_file():
        raise InputError(f"{named} is no regular file (a pipe, a device or the like): choose another name")
    if is_own_file(path):
        return
    if around is not None:
        raise InputError(f"{named} is a file of {around}, which is read: choose another name")
    if not overwrite:
        raise InputError(f"{named} is there and was not written by pagas_cl: choose another name, or replace it with "
                         "--overwrite")


def is_own_file(path: Path) -> bool:
    """Whether the file has the mark that pagas_cl writes into files of its kind."""
    if path.suffix.lower() in SUFFIXES:
        return written_by_pagas_cl(path)
    return is_own_json(path) or is_own_text(path)


def scene_inputs(scene: Scene, depths: Sequence | None = None) -> dict[str, Path | None]:
    """What a scene reads, for `check_outputs`: photos, masks and depth maps of its views, the folders that they are in,
    and the file with its cameras, where it is one."""
    source = Path(scene.source)
    found: dict[str, Path | None] = {"the file of the cameras": source if is_file(source) else None}
    depths = scene.depths if depths is None else depths
    for view, depth in zip(scene.views, depths or repeat(None)):
        sources = {"photo": view.image, "mask": view.mask, "depth map": getattr(depth, "file", None)}
        for what, source in sources.items():
            path = getattr(source, "path", source)
            if isinstance(path, Path):
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
