"""Where a round's results are kept: in a folder, where a run that was killed goes on, or in the memory of this process.

A round's results are written by workers, and read by the rounds after it and by the caller.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

from pagas_cl.app.jobs import finished
from pagas_cl.app.jobs.store import translate_os_errors
from pagas_cl.app.jobs.task import Record, ViewTask, on_a_line, worker_name
from pagas_cl.errors import log
from pagas_cl.result import DepthResult, RoundInput
from pagas_cl.scene.camera import Camera

_STOP = "stop"              # a file of this name in the work folder has every worker end after its present view


class Results(Protocol):
    """Results of the views of a round."""

    def find(self, task: ViewTask) -> Record | None:
        """The record of `task`, if an earlier attempt or run has finished it."""

    def write(self, task: ViewTask, result: DepthResult, about: dict[str, Any]) -> Record:
        """Keep `result`; `about`: device, worker and seconds, for its report."""

    def result_of(self, record: Record, camera: Camera) -> Any:
        """The result that belongs to `record`: a DepthResult, or what reads its arrays when they are needed."""

    def earlier(self, views: Sequence[tuple[Camera, str, str]]) -> Any:
        """Stands for the depth map of a task in the next round: an object with load() and digest. `views`: camera,
        stem and key of each result, the view's own first."""

    def identity(self, task: ViewTask, result: DepthResult) -> Any:
        """What the device knows the result of `task` by (rounds.RoundInput)."""

    def held(self) -> list[Any]:
        """What the device may hold of them that nobody needs once the next round is done."""

    def note(self, what: str, name: str) -> None:
        """Write down that the view `name` "began", "ended" or "failed"."""

    def is_stopping(self) -> bool:
        """Whether the run has its workers end."""


@dataclass(frozen=True)
class FolderResults:
    """Results in `folder`, which every worker sees; with `extras` status, deviation and parallax too."""

    folder: Path
    extras: bool = True

    def find(self, task: ViewTask) -> Record | None:
        """As of Results; its files are what was written."""
        return finished.find_finished(self.folder, task, self.extras)

    def write(self, task: ViewTask, result: DepthResult, about: dict[str, Any]) -> Record:
        """As of Results; OutputError where it cannot be written."""
        return finished.write_finished(self.folder, task, result, self.extras, about)

    def result_of(self, record: Record, camera: Camera) -> finished.StoredResult:
        """As of Results: the arrays stay on disk."""
        return finished.StoredResult(camera, self.folder, record)

    def earlier(self, views: Sequence[tuple[Camera, str, str]]) -> finished.EarlierResults:
        """As of Results."""
        return finished.EarlierResults(self.folder, tuple(views))

    def identity(self, task: ViewTask, result: DepthResult) -> Any:
        """As of Results."""
        return self.folder, task.key

    def held(self) -> list[Any]:
        """As of Results: they go when the device needs the room."""
        return []

    def note(self, what: str, name: str) -> None:
        """A line in this process's journal: what it was at when it was lost can be read there."""
        path = self._journal / f"{worker_name()}.txt"
        with translate_os_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(path, "a", encoding="utf-8") as file:
                file.write(f"{datetime.now().isoformat(timespec='milliseconds')} {what} {on_a_line(name)}\n")

    def attempts(self) -> Counter[str]:
        """How often each view was begun in this run, by the journals of all workers, names as they stand there."""
        lines = [line.split(" ", 2) for path in self._journal.glob("*.txt")
                 for line in path.read_text(encoding="utf-8").splitlines()]
        return Counter(line[2] for line in lines if line[1:2] == ["began"] and len(line) == 3)    # one may be cut off

    def is_stopping(self) -> bool:
        """As of Results."""
        return self._stop.exists()

    def request_stop(self) -> None:
        """Let every worker end after its present view."""
        try:
            self._stop.touch()
        except OSError as error:
            log.warning("workers cannot be stopped and go on to their end: %s", error)

    @property
    def _journal(self) -> Path:
        return finished.work_folder(self.folder) / "journal"

    @property
    def _stop(self) -> Path:
        return finished.work_folder(self.folder) / _STOP


class MemoryResults:
    """Results in the memory of this process, which alone works on the views."""

    def __init__(self) -> None:
        self._results: dict[str, DepthResult] = {}

    def find(self, task: ViewTask) -> Record | None:
        """As of Results: no earlier run has left any."""
        return None

    def write(self, task: ViewTask, result: DepthResult, about: dict[str, Any]) -> Record:
        """As of Results."""
        result.report.update(about)
        self._results[task.stem] = result
        return Record(task.name, task.stem, task.key, result.reason)

    def result_of(self, record: Record, camera: Camera) -> DepthResult:
        """As of Results."""
        return self._results[record.stem]

    def earlier(self, views: Sequence[tuple[Camera, str, str]]) -> "_InMemory":
        """As of Results."""
        return _InMemory(self, tuple(stem for _, stem, _ in views))

    def identity(self, task: ViewTask, result: DepthResult) -> Any:
        """As of Results."""
        return result

    def at(self, stem: str) -> DepthResult:
        """The result of the view `stem`."""
        return self._results[stem]

    def held(self) -> list[DepthResult]:
        """As of Results."""
        return list(self._results.values())

    def note(self, what: str, name: str) -> None:
        """As of Results: nobody would read it."""

    def is_stopping(self) -> bool:
        """As of Results."""
        return False


@dataclass(frozen=True)
class _InMemory:
    """Results of the round before, of these stems."""

    results: MemoryResults
    stems: tuple[str, ...]
    digest = ""

    def load(self) -> list[RoundInput]:
        """As finished.EarlierResults.load."""
        found = [self.results.at(stem) for stem in self.stems]
        return [RoundInput(result, result) for result in found]


@dataclass(frozen=True, eq=False)
class GivenArray:
    """A depth map in memory, as a task has it."""

    array: Any
    digest = ""

    def load(self) -> Any:
        """The depth map."""
        return self.array
