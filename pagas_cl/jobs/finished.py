"""Finished views on disk.

    FOLDER/<stem>.npz               refined depth, one array "depth"
    FOLDER/.work/<stem>.npz         status, deviation, parallax
    FOLDER/.work/<stem>.json        the Record, written last: a view is finished when it is there and fits
    FOLDER/.work/journal/           what each worker began and ended, one file a process
    FOLDER/.work/round_0/, ...      the same of each round before the last one; removed when all views are done
    FOLDER/.work/inputs/            arrays that came from memory; removed when all views are done
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.jobs.store import translate_os_errors, written
from pagas_cl.jobs.task import Record, ViewTask
from pagas_cl.result import DepthResult, confidence_of, normals_of
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import load_depth

log = logging.getLogger("pagas_cl")

_EXTRAS = ("status", "deviation", "parallax")


def work_folder(folder: Path) -> Path:
    """Where a run keeps what only it needs, inside its folder of results."""
    return Path(folder) / ".work"


def round_folder(folder: Path, number: int) -> Path:
    """Where the results of a round (0 is the first) are kept until the last one is done."""
    return work_folder(folder) / f"round_{number}"


def stems(views) -> list[str]:
    """What the files of each view are called: the photo's stem, below its folders where two have the same."""
    short = [view.stem for view in views]
    for view in views:
        if Path(view.name).is_absolute() or ".." in Path(view.name).parts:
            raise InputError(f"view {view.name!r} cannot name files in the output folder: expected a relative name "
                             "without '..'")
    uses = Counter(short)
    return [stem if uses[stem] == 1 else str(Path(view.name).with_suffix("")) for stem, view in zip(short, views)]


def write_finished(folder: Path, task: ViewTask, result: DepthResult, extras: bool, about: dict) -> Record:
    """Write a view's files; the record comes last."""
    sizes = {}
    arrays = {f"{task.stem}.npz": {"depth": result.depth}}
    if extras:
        arrays[f".work/{task.stem}.npz"] = {name: getattr(result, name) for name in _EXTRAS}
    for name, content in arrays.items():
        path = Path(folder) / name
        with written(path) as file:
            np.savez(file, **content)
        with translate_os_errors(path):
            sizes[name] = path.stat().st_size
    record = Record(task.name, task.stem, task.key, result.reason, result.counts, {**result.report, **about}, sizes)
    with written(work_folder(folder) / f"{task.stem}.json") as file:
        file.write(json.dumps(asdict(record), default=float).encode())
    return record


def find_finished(folder: Path, task: ViewTask, extras: bool) -> Record | None:
    """The record of `task`, if an earlier attempt or run has finished it and its files are whole."""
    path = work_folder(folder) / f"{task.stem}.json"
    try:
        record = Record(**json.loads(path.read_bytes()))
        if record.key != task.key or (extras and f".work/{task.stem}.npz" not in record.sizes):
            return None
        torn = [name for name, size in record.sizes.items() if (Path(folder) / name).stat().st_size != size]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, AttributeError) as error:
        log.warning("record %s cannot be used (%s): the view is refined again", path, error)
        return None
    if torn:
        log.warning("%s is cut short: view %s is refined again", torn[0], task.name)
    return None if torn else record


@dataclass(frozen=True)
class EarlierResults:
    """Stands for a depth map in the task of a later round: results of the round before, in `folder`, each by camera,
    stem and key; the view's own comes first."""

    folder: Path
    results: tuple[tuple[Camera, str, str], ...]

    @property
    def digest(self) -> str:
        """What they are is told by the keys of their tasks."""
        return " ".join(key for _, _, key in self.results)

    def load(self) -> list[DepthResult]:
        return [StoredResult.found(camera, self.folder, stem, key).loaded() for camera, stem, key in self.results]


@dataclass(frozen=True, eq=False)
class StoredResult:
    """As a DepthResult, with the arrays read from disk when they are asked for; nothing of it stays in memory."""

    camera: Camera
    folder: Path
    record: Record

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
    def found(cls, camera: Camera, folder: Path, stem: str, key: str) -> StoredResult:
        """The finished view that the round before has left; InputError where it is not there, or of another key."""
        path = work_folder(folder) / f"{stem}.json"
        try:
            record = Record(**json.loads(path.read_bytes()))
        except (OSError, ValueError, TypeError) as error:
            raise InputError(f"record {str(path)!r} of the round before cannot be read ({error}): start the same "
                             "command again") from error
        if record.key != key:
            raise InputError(f"record {str(path)!r} is of another run, expected that of the round before: start the "
                             "same command again, and no other one in its folder")
        return cls(camera, folder, record)

    def _extra(self, name: str) -> np.ndarray:
        path = work_folder(self.folder) / f"{self.record.stem}.npz"
        try:
            with np.load(path, allow_pickle=False) as archive:
                return archive[name]
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise InputError(f"{str(path)!r} cannot be read ({error}): delete it and start the same command "
                             "again") from error
