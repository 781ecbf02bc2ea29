"""What a run keeps, and where: in a folder that a later run goes on from (finished.py), or in memory until its end.

A round's results are written by workers, and read by the rounds after it and by the caller."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from pagas_cl.errors import InputError
from pagas_cl.jobs.finished import FolderResults, in_memory
from pagas_cl.jobs.task import Record, ViewTask
from pagas_cl.jobs.work_folder import claim_names, forget_inputs, kept_input, work_folder
from pagas_cl.method.splat import PhotoStore
from pagas_cl.result import DepthResult, RoundInput
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depth.source import DepthSource
from pagas_cl.scene.view import View


class MemoryResults:
    """Results of the views of a round in the memory of this process, which alone works on them."""

    def __init__(self) -> None:
        self._results: dict[str, DepthResult] = {}

    def find(self, task: ViewTask) -> Record | None:
        """The record of `task`, if an earlier attempt or run has finished it: none is kept here."""

    def write(self, task: ViewTask, result: DepthResult, about: dict[str, Any]) -> Record:
        """Keep `result`; `about`: device, worker and seconds, for its report."""
        result.report.update(about)
        self._results[task.stem] = result
        return Record(task.name, task.stem, task.key, result.reason)

    def result_of(self, record: Record, camera: Camera) -> DepthResult:
        """The result that belongs to `record`: a DepthResult, or what reads its arrays when they are needed."""
        return self._results[record.stem]

    def found(self, camera: Camera, stem: str, key: str) -> DepthResult:
        """The result of the view `stem`, of a task of that key."""
        return self._results[stem]

    def of_earlier_runs(self) -> int:
        """How many results an earlier run has left."""
        return 0

    def forget(self, photos: PhotoStore) -> None:
        """The next round is done: nobody needs them any more, nor what the device holds of them."""
        photos.forget([(self, key) for key in self._results])       # their stems are the keys of their tasks
        self._results.clear()

    def note(self, what: str, name: str) -> None:
        """Write down that the view `name` "began", "ended" or "failed": nobody would read it here."""

    def is_stopping(self) -> bool:
        """Whether the run has its workers end."""
        return False


Results: TypeAlias = MemoryResults | FolderResults


@dataclass(frozen=True, eq=False)
class EarlierResults:
    """What a later round starts from: `results` of the round before, `views` by camera, stem and key, its own first."""

    results: Results
    views: tuple[tuple[Camera, str, str], ...]

    @property
    def digest(self) -> str:
        return " ".join(key for *_, key in self.views)

    def load(self) -> list[RoundInput]:
        """The view's own is read; the others are read by the round, one at a time."""
        own, *others = (RoundInput((self.results, view[-1]), self.results.found(*view)) for view in self.views)
        return [replace(own, result=in_memory(own.result)), *others]


class Keeping:
    """What a run keeps of its inputs and of the results of a `number` of rounds: all of it in `folder`, with `extras`
    status, deviation and parallax too; nothing beyond the run where that is None."""

    rounds: list[MemoryResults] | list[FolderResults]
    """The results of each, the first to the last."""

    def __init__(self, folder: str | Path | None, number: int, extras: bool = True):
        self.folder = None if folder is None else Path(folder).resolve()
        if self.folder is None:
            self.rounds = [MemoryResults() for _ in range(number)]
        else:
            self.rounds = [*(FolderResults(work_folder(self.folder) / f"round_{k}") for k in range(number - 1)),
                           FolderResults(self.folder, extras)]

    def inputs(self, views: Sequence[View], depths: Sequence[Any]) -> tuple[list[View], list[Any]]:
        """Views and depth maps as tasks have them, on disk in a folder; InputError where results would replace them."""
        if self.folder is None:
            return list(views), list(depths)
        for depth in depths:
            file = depth.file if isinstance(depth, DepthSource) else None
            if isinstance(file, Path) and file.resolve().parent == self.folder:
                raise InputError(f"the depth maps to start from are in {str(self.folder)!r}, where the refined ones "
                                 "would go; the next run would refine those: choose another folder")
        return [self._view_on_disk(view) for view in views], [self._on_disk(depth) for depth in depths]

    def begin(self, stems: list[str]) -> None:
        """The run will write results of these stems; what killed runs have left is removed."""
        if self.folder is not None:
            claim_names(self.folder, stems)
            for results in self.rounds:
                results.make_ready()

    def end(self, complete: bool) -> None:
        """All rounds are done; `complete`: no view has failed."""
        if self.folder is not None and complete:
            side_by_side(partial(shutil.rmtree, ignore_errors=True),
                         work_folder(self.folder).glob("round_*"))      # of killed runs, too
        forget_inputs(self.folder)

    def _on_disk(self, value: Any) -> Any:
        """An array as a file; what is none (a file, None) as it is."""
        return kept_input(self.folder, value) if isinstance(value, np.ndarray) else value

    def _view_on_disk(self, view: View) -> View:
        """With photo and mask on disk: itself where they are, so that its photo is found again on the device."""
        if not isinstance(view.image, np.ndarray) and not isinstance(view.mask, np.ndarray):
            return view
        return View(view.camera, self._on_disk(view.image), self._on_disk(view.mask), view.name)
