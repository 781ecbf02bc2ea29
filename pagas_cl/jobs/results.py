"""Where a round's results are kept: in a folder (finished.py), or in the memory of this process.

A round's results are written by workers, and read by the rounds after it and by the caller.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from pagas_cl.jobs.finished import FolderResults
from pagas_cl.jobs.task import Record, ViewTask
from pagas_cl.result import DepthResult, RoundInput
from pagas_cl.scene.camera import Camera


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

    def earlier(self, views: Sequence[tuple[Camera, str, str]]) -> "_InMemory":
        """Stands for the depth map of a task in the next round: an object with load() and digest. `views`: camera,
        stem and key of each result, the view's own first."""
        return _InMemory(self._results, tuple(stem for _, stem, _ in views))

    def identity(self, task: ViewTask, result: DepthResult) -> Any:
        """What the device knows the result of `task` by (rounds.RoundInput)."""
        return result

    def held(self) -> list[DepthResult]:
        """What the device may hold of them that nobody needs once the next round is done."""
        return list(self._results.values())

    def note(self, what: str, name: str) -> None:
        """Write down that the view `name` "began", "ended" or "failed": nobody would read it here."""

    def is_stopping(self) -> bool:
        """Whether the run has its workers end."""
        return False


Results: TypeAlias = MemoryResults | FolderResults


@dataclass(frozen=True, eq=False)
class _InMemory:
    """Results of the round before, of these stems."""

    results: dict[str, DepthResult]
    stems: tuple[str, ...]
    digest = ""

    def load(self) -> list[RoundInput]:
        """As finished.EarlierResults.load."""
        return [RoundInput(self.results[stem], self.results[stem]) for stem in self.stems]


@dataclass(frozen=True, eq=False)
class GivenArray:
    """A depth map in memory, as a task has it."""

    array: Any
    digest = ""

    def load(self) -> Any:
        """The depth map."""
        return self.array
