"""Finished views on disk.

    FOLDER/<stem>.npz                    refined depth, one array "depth"
    FOLDER/.pagas_cl/views/<stem>.npz    status, deviation, parallax
    FOLDER/.pagas_cl/views/<stem>.json   the Record, written last: a view is finished when it is there and fits
    FOLDER/.pagas_cl/names.json          stems that a run has meant to write: these files are written by pagas_cl
    FOLDER/.pagas_cl/lock                held by the run that is at work
    FOLDER/.pagas_cl/journal/            what each worker began and ended, one file a process
    FOLDER/.pagas_cl/inputs/             arrays that came from memory; removed when all views are done
    FOLDER/.pagas_cl/round_0/, ...       a folder like this one of each round before the last; removed as inputs/ is
    FOLDER/.pagas_cl/parts/              files that are being written

Nothing else in FOLDER is written, replaced or removed.
"""

import json
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pagas_cl.app.jobs.store import translate_os_errors, written
from pagas_cl.app.jobs.task import Record, ViewTask
from pagas_cl.errors import InputError, OutputError, log
from pagas_cl.result import DepthResult, RoundInput, in_short, normals_of
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import confidence_of, load_depth
from pagas_cl.scene.names import OWN
from pagas_cl.scene.npy_files import read_member
from pagas_cl.system.files import DAMAGE, digest_of, opened, read_bytes, sum_of, write_arrays
from pagas_cl.system.locks import locked

_EXTRAS = ("status", "deviation", "parallax")


def work_folder(folder: Path) -> Path:
    """Where a run keeps what only it needs, inside its folder of results."""
    return Path(folder) / OWN


def round_folder(folder: Path, number: int) -> Path:
    """Where the results of a round (0 is the first) are kept until the last one is done."""
    return work_folder(folder) / f"round_{number}"


@contextmanager
def one_run(folder: Path) -> Iterator[None]:
    """Context: `folder`, which is made, is this run's alone; OutputError where another one is at work in it."""
    work = work_folder(folder).absolute()
    _refuse_links(work)
    new = [path for path in (work, *work.parents) if not path.exists()]
    with translate_os_errors(folder):
        work.mkdir(parents=True, exist_ok=True)
    with locked(work / "lock") as mine:
        if not mine:
            raise OutputError(f"another run is at work in {str(folder)!r}: wait until it has ended, or choose another "
                              "output")
        try:
            yield
        finally:
            _remove_empty_below(work)
            if {path.name for path in work.glob("*")} <= {"lock"}:      # nothing of it is wanted any more
                (work / "lock").unlink(missing_ok=True)
                _remove_empty([path for path in new or [work] if path.exists()])     # a run inside this one may have


def check_names(folder: Path, stems: list[str], overwrite: bool = False) -> None:
    """InputError where `<stem>.npz` would be written outside of `folder`, through a link, or (unless `overwrite`)
    would replace a file that no run of pagas_cl has written."""
    known = _names(folder)
    for stem in stems:
        file = Path(folder) / f"{stem}.npz"
        if not _is_inside(folder, stem):
            raise InputError(f"{str(file)!r} lies outside of {str(folder)!r}, through a link: choose another folder "
                             "for the refined depth maps")
        records = _view_file(folder, stem, ".json"), Path(folder) / ".work" / f"{stem}.json"      # the latter of 0.1.0
        if not overwrite and stem not in known and file.exists() and not any(record.exists() for record in records):
            raise InputError(f"{str(file)!r} is there and was not written by pagas_cl: move it away, choose another "
                             "folder for the refined depth maps, or replace it (--overwrite at the command line)")


def claim_names(folder: Path, stems: list[str], overwrite: bool = False) -> None:
    """Before the first view: note down that `<stem>.npz` are this run's to write; errors as check_names."""
    check_names(folder, stems, overwrite)
    known = _names(folder)
    if not known.issuperset(stems):
        with written(_names_file(folder), _parts(folder)) as file:
            file.write(json.dumps(sorted(known.union(stems))).encode())


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


def _is_inside(folder: Path, stem: str) -> bool:
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


def _remove_empty_below(work: Path) -> None:
    """Remove the folders in `work` that hold nothing, deepest first."""
    for folder in sorted((path for path in work.rglob("*") if path.is_dir()), reverse=True):
        _remove_empty([folder])


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        try:
            folder.rmdir()
        except OSError:  # something else is in it
            return


def _names(folder: Path) -> set[str]:
    """Stems that runs have meant to write. Whoever made the folder may have written the file: what leads out of the
    folder is left out."""
    try:
        stems = json.loads(read_bytes(_names_file(folder)))
    except DAMAGE:
        return set()
    if not isinstance(stems, list):
        return set()
    return {stem for stem in stems if isinstance(stem, str) and "\0" not in stem and _is_inside(folder, stem)}


def _names_file(folder: Path) -> Path:
    return work_folder(folder) / "names.json"


def _view_file(folder: Path, stem: str, suffix: str) -> Path:
    return work_folder(folder) / "views" / f"{stem}{suffix}"


def _parts(folder: Path) -> Path:
    return work_folder(folder) / "parts"


def write_finished(folder: Path, task: ViewTask, result: DepthResult, extras: bool, about: dict) -> Record:
    """Write a view's files; the record comes last. It has the sums of them: only what the user wants has to be on the
    disk before it."""
    digests = {}
    arrays = {f"{task.stem}.npz": {"depth": result.depth}}
    if extras:
        arrays[f"{OWN}/views/{task.stem}.npz"] = {name: getattr(result, name) for name in _EXTRAS}
    for name, content in arrays.items():
        path = Path(folder) / name
        with written(path, _parts(folder), durable=OWN not in path.parts) as file:
            digests[name] = write_arrays(file, content)
    record = Record(task.name, task.stem, task.key, result.reason, result.counts, {**result.report, **about}, digests)
    # as it will be read: tuples are lists then, and NumPy's numbers plain ones
    known = json.loads(json.dumps(asdict(record), default=float))
    with written(_view_file(folder, task.stem, ".json"), _parts(folder), durable=False) as file:
        file.write(json.dumps({"seal": _seal(known), **known}).encode())
    return record


def _seal(known: dict) -> str:
    return digest_of([json.dumps(known, sort_keys=True).encode()])


def _read_record(folder: Path, path: Path) -> Record:
    """The record of a view in `folder`; one of DAMAGE, TypeError or AttributeError where it is none, or names other
    files than those that go with its own name: whoever made the folder may have written it."""
    known = json.loads(read_bytes(path))
    if known.pop("seal", "") != _seal(known):
        raise ValueError("it is not as it was written")
    record = Record(**known)
    own = f"{record.stem}.npz", f"{OWN}/views/{record.stem}.npz"
    if _view_file(folder, record.stem, ".json") != path or not _is_inside(folder, record.stem):
        raise ValueError("it is of another file")
    if not set(record.digests).issubset(own):
        raise ValueError("it names files that do not belong to it")
    return record


def find_finished(folder: Path, task: ViewTask, extras: bool) -> Record | None:
    """The record of `task`, if an earlier attempt or run has finished it and its files are what was written."""
    path = _view_file(folder, task.stem, ".json")
    try:
        record = _read_record(folder, path)
        if record.key != task.key or (extras and f"{OWN}/views/{task.stem}.npz" not in record.digests):
            return None
        other = [name for name, digest in record.digests.items() if sum_of(Path(folder) / name) != digest]
    except FileNotFoundError:
        return None
    except (*DAMAGE, TypeError, AttributeError) as error:
        log.warning("record %s cannot be used (%s): the view is refined again", path, error)
        return None
    if other:
        log.warning("%s has changed since it was written: view %s is refined again", other[0], task.name)
    return None if other else record


def records_in(folder: Path) -> list[Record]:
    """Records of views that runs have finished in `folder`; those that cannot be read are left out."""
    found = []
    for path in sorted((work_folder(folder) / "views").rglob("*.json")):
        try:
            found.append(_read_record(folder, path))
        except (*DAMAGE, TypeError, AttributeError):
            log.debug("%s is no record", path)
    return found


def begun_in(folder: Path) -> int:
    """How many views have a result of a round before the last one in `folder`."""
    return max((len(records_in(place)) for place in work_folder(folder).glob("round_*")), default=0)


def users_of(folder: Path) -> dict[str, list[str]]:
    """Name of each photo -> views in `folder` that it took part in: as target, as context view, or as a judge."""
    users: dict[str, list[str]] = {}
    for record in records_in(folder):
        for name in (record.name, *record.report.get("contexts", ()), *record.report.get("held_out", ())):
            users.setdefault(name, []).append(record.name)
    return users


@dataclass(frozen=True)
class EarlierResults:
    """Stands for a depth map in the task of a later round: results of the round before, in `folder`, each by camera,
    stem and key; the view's own comes first."""

    folder: Path
    results: tuple[tuple[Camera, str, str], ...]

    @property
    def digest(self) -> str:
        """The keys of their tasks, which identify them."""
        return " ".join(key for _, _, key in self.results)

    def load(self) -> list[RoundInput]:
        """The view's own is read; the others are read by the round, one at a time."""
        own, *others = (StoredResult.found(camera, self.folder, stem, key) for camera, stem, key in self.results)
        return [RoundInput(own.identity, own.loaded()), *(RoundInput(other.identity, other) for other in others)]


@dataclass(frozen=True, eq=False, repr=False)
class StoredResult:
    """As a DepthResult, with the arrays read from disk when they are used; nothing of it stays in memory."""

    camera: Camera
    folder: Path
    record: Record

    __repr__ = in_short
    identity = property(lambda self: (self.folder, self.record.key))
    file = property(lambda self: self.folder / f"{self.record.stem}.npz")
    name = property(lambda self: self.record.name)
    reason = property(lambda self: self.record.reason)
    counts = property(lambda self: self.record.counts)
    report = property(lambda self: self.record.report)
    depth = property(lambda self: load_depth(self.file))
    status = property(lambda self: self._extra("status"))
    deviation = property(lambda self: self._extra("deviation"))
    parallax = property(lambda self: self._extra("parallax"))
    confidence = property(lambda self: confidence_of(self.depth, self.deviation, self.parallax))
    normals = property(lambda self: normals_of(self.depth, self.camera))

    def loaded(self) -> DepthResult:
        """Everything in memory."""
        return DepthResult(self.camera, self.depth, self.status, self.deviation, self.parallax, self.reason,
                           self.report, self.name)

    @classmethod
    def found(cls, camera: Camera, folder: Path, stem: str, key: str) -> "StoredResult":
        """The finished view that the round before has left; InputError where it is not there, or of another key."""
        path = _view_file(folder, stem, ".json")
        try:
            record = _read_record(folder, path)
        except (*DAMAGE, TypeError, AttributeError) as error:
            raise InputError(f"record {str(path)!r} of the round before cannot be read ({error}): start the same "
                             "command again") from error
        if record.key != key:
            raise InputError(f"record {str(path)!r} is of another run, expected that of the round before: start the "
                             "same command again, and no other one in its folder")
        return cls(camera, folder, record)

    def _extra(self, name: str) -> np.ndarray:
        path = _view_file(self.folder, self.record.stem, ".npz")
        try:
            with opened(path) as file:
                archive = zipfile.ZipFile(file)
                return read_member(archive, archive.getinfo(f"{name}.npy"))
        except DAMAGE as error:
            raise InputError(f"{str(path)!r} cannot be read ({error}): start the same command again, which makes it "
                             "anew") from error
