"""Finished views on disk.

    FOLDER/<stem>.npz                    refined depth, one array "depth"
    FOLDER/.pagas_cl/views/<stem>.npz    status, deviation, parallax
    FOLDER/.pagas_cl/views/<stem>.json   the Record, written last: a view is finished when it is there and fits
    FOLDER/.pagas_cl/names.json          stems that a run has meant to write: these files are written by pagas_cl
    FOLDER/.pagas_cl/lock                held by the run that is at work
    FOLDER/.pagas_cl/journal/            what each worker began and ended, one file a process
    FOLDER/.pagas_cl/inputs/             arrays that came from memory; removed when all views are done
    FOLDER/.pagas_cl/round_0/, ...       a folder like this one of each round before the last; removed as inputs/ is
    FOLDER/.pagas_cl/size_0/, ...        a folder like this one of each smaller size that came first (effects.pyramid)
    FOLDER/.pagas_cl/parts/              files that are being written

Nothing else in FOLDER is written, replaced or removed."""

import json
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pagas_cl.errors import InputError, OutputError
from pagas_cl.scene.names import OWN
from pagas_cl.scene.npy_files import read_npy
from pagas_cl.system import files
from pagas_cl.system.files import DAMAGE, digest_array, read_bytes, replaced
from pagas_cl.system.locks import locked

_KEPT = "finished views are kept, make room or choose another folder, and start the same command again"


@contextmanager
def written(folder: Path, path: Path, durable: bool = True) -> Iterator[BinaryIO]:
    """Context of a binary file that gets the name `path` when all of it is on disk: system.files.replaced."""
    with (replaced(path, parts=work_folder(folder) / "parts", advice=_KEPT, durable=durable) as temporary,
          open(temporary, "wb") as file):
        yield file


def writing(path: str | Path) -> AbstractContextManager[None]:
    """As system.files.writing, with what becomes of the run."""
    return files.writing(path, _KEPT)


def work_folder(folder: str | Path) -> Path:
    """Where a run keeps what only it needs, inside its folder of results."""
    return Path(folder) / OWN


def size_folder(folder: str | Path | None, number: int) -> Path | None:
    """Where the results of a smaller size (0 is the first) are kept; None without a folder."""
    return None if folder is None else work_folder(Path(folder)) / f"size_{number}"


@contextmanager
def one_run(folder: str | Path | None) -> Iterator[None]:
    """Context: `folder`, if any, is made and is this run's alone; OutputError where another one is at work in it."""
    if folder is None:
        yield
        return
    work = work_folder(folder).absolute()
    _refuse_links(work)
    new = [path for path in (work, *work.parents) if not path.exists()]
    with writing(folder):
        work.mkdir(parents=True, exist_ok=True)
    try:
        with locked(work / "lock") as mine:
            if not mine:
                raise OutputError(f"another run is at work in {str(folder)!r}: wait until it has ended, or choose "
                                  "another output")
            try:
                yield
            finally:
                for inner in sorted(filter(Path.is_dir, work.rglob("*")), reverse=True):      # deepest first
                    _remove_empty([inner])
    finally:
        _remove_empty([path for path in new or [work] if path.exists()])     # remove_run may have removed some


def check_names(folder: Path, stems: list[str], overwrite: bool = False) -> None:
    """InputError where `<stem>.npz` would be written outside of `folder`, through a link, or (unless `overwrite`)
    would replace a file that no run of pagas_cl has written."""
    known = _names(folder)
    for stem in stems:
        file = Path(folder) / f"{stem}.npz"
        if not is_inside(folder, stem):
            raise InputError(f"{str(file)!r} lies outside of {str(folder)!r}, through a link: choose another folder "
                             "for the refined depth maps")
        records = view_file(folder, stem, ".json"), Path(folder) / ".work" / f"{stem}.json"      # the latter of 0.1.0
        if not overwrite and stem not in known and file.exists() and not any(record.exists() for record in records):
            raise InputError(f"{str(file)!r} is there and was not written by pagas_cl: move it away, choose another "
                             "folder for the refined depth maps, or replace it (--overwrite at the command line)")


def claim_names(folder: Path, stems: list[str], overwrite: bool = False) -> None:
    """Before the first view: note down that `<stem>.npz` are this run's to write; errors as check_names."""
    check_names(folder, stems, overwrite)
    known = _names(folder)
    if not known.issuperset(stems):
        with written(folder, work_folder(folder) / "names.json") as file:
            file.write(json.dumps(sorted(known.union(stems))).encode())


@dataclass(frozen=True)
class StoredArray:
    """An array on disk. May stand for a view's image or mask, or for a depth map."""

    file: Path
    digest: str

    def load(self) -> np.ndarray:
        """The array; InputError where the file is gone or is not what was stored."""
        try:
            array = read_npy(self.file)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"stored array {str(self.file)!r} cannot be read ({error}): start the same command again, "
                             "which writes it anew") from error
        if digest_array(array) != self.digest:
            raise InputError(f"stored array {str(self.file)!r} is damaged: delete it and start the same command again")
        return array


def kept_input(folder: Path, array: np.ndarray) -> StoredArray:
    """`array` in the work folder, by the hash of its content, where any process finds it; written once."""
    digest = digest_array(array)
    stored = StoredArray(work_folder(folder) / "inputs" / f"{digest}.npy", digest)
    try:
        stored.load()
    except InputError:
        with written(folder, stored.file, durable=False) as file:      # where a crash has lost it, it is made anew
            np.save(file, np.ascontiguousarray(array))
    return stored


def forget_inputs(folder: Path | None) -> None:
    """Remove the arrays that came from memory; the next run makes them anew."""
    if folder is not None:
        shutil.rmtree(work_folder(folder) / "inputs", ignore_errors=True)


def remove_run(folder: Path) -> None:
    """Remove what runs have written in `folder`, and the folder where nothing else is in it."""
    folder = Path(folder)
    for stem in _names(folder):
        file = folder / f"{stem}.npz"
        file.unlink(missing_ok=True)
        _remove_empty([parent for parent in file.parents if folder in parent.parents])
    shutil.rmtree(work_folder(folder), ignore_errors=True)
    _remove_empty([folder])


def is_inside(folder: Path, stem: str) -> bool:
    """Whether the files of `stem` lie below `folder`, links on the way followed, and not in its work folder."""
    folder, places = Path(folder).resolve(), (Path(folder) / stem, work_folder(folder) / "views" / stem)
    return bool(stem) and all(folder in place.parent.resolve().joinpath(place.name).parents
                              for place in places) and ".." not in Path(stem).parts and OWN not in Path(stem).parts


def _refuse_links(work: Path) -> None:
    """InputError where the work folder, or a part of it, is a link: what a run writes and removes would lie in
    another place."""
    for path in (work, *(work.iterdir() if work.is_dir() else ())):
        if path.is_symlink():
            raise InputError(f"{str(path)!r} is a link, and runs of pagas_cl make none there: remove it, or choose "
                              "another folder")


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        try:
            folder.rmdir()
        except OSError:  # something else is in it
            return


def _names(folder: Path) -> set[str]:
    """Stems that runs have meant to write, without what leads out of the folder: its maker may have written it."""
    try:
        stems = json.loads(read_bytes(work_folder(folder) / "names.json"))
    except DAMAGE:
        return set()
    if not isinstance(stems, list):
        return set()
    return {stem for stem in stems if isinstance(stem, str) and "\0" not in stem and is_inside(folder, stem)}


def view_file(folder: Path, stem: str, suffix: str) -> Path:
    return work_folder(folder) / "views" / f"{stem}{suffix}"
