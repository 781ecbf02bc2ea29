"""Records and arrays of finished views in a folder, whose layout work_folder.py describes."""

import json
import shutil
import zipfile
from collections import Counter
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from pagas_cl.errors import InputError, log
from pagas_cl.jobs.task import Record, ViewTask, on_a_line, worker_name
from pagas_cl.jobs.work_folder import is_inside, view_file, work_folder, writing, written
from pagas_cl.method.splat import PhotoStore
from pagas_cl.result import DepthResult, in_short, normals_of
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import confidence_of, load_depth
from pagas_cl.scene.names import OWN
from pagas_cl.scene.npy_files import read_member
from pagas_cl.system.files import DAMAGE, digest_of, opened, read_bytes, sum_of, write_arrays

_EXTRAS = ("status", "deviation", "parallax")


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
    if view_file(folder, record.stem, ".json") != path or not is_inside(folder, record.stem):
        raise ValueError("it is of another file")
    if not set(record.digests).issubset(own):
        raise ValueError("it names files that do not belong to it")
    return record


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
    """How many views have a result of a round before the last one, or of a smaller size, in `folder`."""
    sizes = list(work_folder(folder).glob("size_*"))
    rounds = [place for run in (folder, *sizes) for place in work_folder(run).glob("round_*")]
    return max((len(records_in(place)) for place in (*sizes, *rounds)), default=0)


def users_of(folder: Path) -> dict[str, list[str]]:
    """Name of each photo -> views in `folder` that it took part in: as target, as context view, or as a judge."""
    users: dict[str, list[str]] = {}
    for record in records_in(folder):
        for name in (record.name, *record.report.get("contexts", ()), *record.report.get("held_out", ())):
            users.setdefault(name, []).append(record.name)
    return users


@dataclass(frozen=True, eq=False, repr=False)
class StoredResult:
    """As a DepthResult, with the arrays read from disk when they are used; nothing of it stays in memory."""

    camera: Camera
    folder: Path
    record: Record

    __repr__ = in_short
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

    def _extra(self, name: str) -> np.ndarray:
        if f"{OWN}/views/{self.record.stem}.npz" not in self.record.digests:
            raise InputError(f"view {self.name!r} has no {name}: its run kept depth maps alone (extras=False)")
        path = view_file(self.folder, self.record.stem, ".npz")
        try:
            with opened(path) as file:
                archive = zipfile.ZipFile(file)
                return read_member(archive, archive.getinfo(f"{name}.npy"))
        except DAMAGE as error:
            raise InputError(f"{str(path)!r} cannot be read ({error}): start the same command again, which makes it "
                             "anew") from error


def in_memory(result: DepthResult | StoredResult) -> DepthResult:
    """The same with everything in memory."""
    return result if isinstance(result, DepthResult) else DepthResult(
        result.camera, result.depth, result.status, result.deviation, result.parallax, result.reason, result.report,
        result.name)


@dataclass(frozen=True)
class FolderResults:
    """Results in `folder`, which every worker sees; with `extras` status, deviation and parallax too. Methods that say
    nothing are as those of keeping.MemoryResults."""

    folder: Path
    extras: bool = True

    def find(self, task: ViewTask) -> Record | None:
        """Only if its files are what was written."""
        path = view_file(self.folder, task.stem, ".json")
        try:
            record = _read_record(self.folder, path)
            if record.key != task.key or (self.extras and f"{OWN}/views/{task.stem}.npz" not in record.digests):
                return None
            other = [name for name, digest in record.digests.items() if sum_of(Path(self.folder) / name) != digest]
        except FileNotFoundError:
            return None
        except (*DAMAGE, TypeError, AttributeError) as error:
            log.warning("record %s cannot be used (%s): the view is refined again", path, error)
            return None
        if other:
            log.warning("%s has changed since it was written: view %s is refined again", other[0], task.name)
        return None if other else record

    def write(self, task: ViewTask, result: DepthResult, about: dict[str, Any]) -> Record:
        """OutputError where it cannot be written. The record, with the files' sums, comes last."""
        digests = {}
        arrays = {f"{task.stem}.npz": {"depth": result.depth}}
        if self.extras:
            arrays[f"{OWN}/views/{task.stem}.npz"] = {name: getattr(result, name) for name in _EXTRAS}
        for name, content in arrays.items():
            path = Path(self.folder) / name
            with written(self.folder, path, durable=OWN not in path.parts) as file:
                digests[name] = write_arrays(file, content)
        report = {**result.report, **about}
        record = Record(task.name, task.stem, task.key, result.reason, result.counts, report, digests)
        # as it will be read: tuples are lists then, and NumPy's numbers plain ones
        known = json.loads(json.dumps(asdict(record), default=float))
        with written(self.folder, view_file(self.folder, task.stem, ".json"), durable=False) as file:
            file.write(json.dumps({"seal": _seal(known), **known}).encode())
        return record

    def result_of(self, record: Record, camera: Camera) -> StoredResult:
        return StoredResult(camera, self.folder, record)

    def found(self, camera: Camera, stem: str, key: str) -> StoredResult:
        """InputError where it is not there, or of another key."""
        path = view_file(self.folder, stem, ".json")
        try:
            record = _read_record(self.folder, path)
        except (*DAMAGE, TypeError, AttributeError) as error:
            raise InputError(f"record {str(path)!r} of the round before cannot be read ({error}): start the same "
                             "command again") from error
        if record.key != key:
            raise InputError(f"record {str(path)!r} is of another run, expected that of the round before: start the "
                             "same command again, and no other one in its folder")
        return StoredResult(camera, self.folder, record)

    def of_earlier_runs(self) -> int:
        return len(records_in(self.folder))

    def forget(self, photos: PhotoStore) -> None:
        """Nothing: what the device holds goes when it needs the room."""

    def note(self, what: str, name: str) -> None:
        """A line in this process's journal: what it was at when it was lost can be read there."""
        path = self._journal / f"{worker_name()}.txt"
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(path, "a", encoding="utf-8") as file:
                file.write(f"{datetime.now().isoformat(timespec='milliseconds')} {what} {on_a_line(name)}\n")

    def attempts(self) -> Counter[str]:
        """How often each view was begun in this run, by the journals of all workers, names as they stand there."""
        lines = [line.split(" ", 2) for path in self._journal.glob("*.txt")
                 for line in path.read_text(encoding="utf-8").splitlines()]
        return Counter(line[2] for line in lines if line[1:2] == ["began"] and len(line) == 3)    # one may be cut off

    def make_ready(self) -> None:
        """Remove what killed runs have left."""
        for left in (work_folder(self.folder) / "parts", self._journal):
            shutil.rmtree(left, ignore_errors=True)
        with writing(self.folder):
            self._stop.unlink(missing_ok=True)

    def is_stopping(self) -> bool:
        return self._stop.exists()

    def request_stop(self) -> None:
        """Let every worker end after its present view."""
        try:
            self._stop.parent.mkdir(parents=True, exist_ok=True)       # no worker may have written anything yet
            self._stop.touch()
        except OSError as error:
            log.warning("workers cannot be stopped and go on to their end: %s", error)

    @property
    def _journal(self) -> Path:
        return work_folder(self.folder) / "journal"

    @property
    def _stop(self) -> Path:
        return work_folder(self.folder) / "stop"      # has every worker end after its present view
