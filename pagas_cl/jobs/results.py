"""Where a round's results are kept: in a folder (finished.py), or in the memory of this process.

A round's results are written by workers, and read by the rounds after it and by the caller.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from pagas_cl.jobs.task import Record, ViewTask
from pagas_cl.result import DepthResult, RoundInput
from pagas_cl.scene.camera import Camera


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
