"""What a run works on, and what takes its records as they come: the rules of what is tried again and when to end.

Only a view whose worker or device was lost is tried again, three times at most: any other failure would come again. Of
such a view the run says so once, and goes on with the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pagas_cl.errors import DeviceLostError, DeviceMemoryError, log
from pagas_cl.jobs.keeping import Results
from pagas_cl.jobs.task import Record
from pagas_cl.progress import NONE, Stage, within_view
from pagas_cl.result import DepthResult
from pagas_cl.scene.inputs import depth_array
from pagas_cl.scene.view import View

if TYPE_CHECKING:
    from pagas_cl.progress import OnStep

TRIES = 3
HOPELESS = 8        # views that fail before one is done: the run ends


@dataclass(frozen=True)
class Scene:
    """What a run works on: `requested` are places of the views to refine; a depth map (or what loads it, or None)
    a view; `on_view` gets (view, initial depth, result) when a view is finished, in the order of `requested`."""

    views: Sequence[View]
    depths: Sequence[Any]
    requested: list[int]
    on_view: Callable[[View, Any, Any], Any] | None = None


class CallerError(BaseException):
    """What the caller's own function has raised, on its way past those who take errors for a view's."""

    def __init__(self, error: Exception):
        super().__init__(str(error))
        self.error = error


class Collect:
    """Takes a round's records as they come, and hands results to the caller in the order of the views."""

    def __init__(self, requested: list[int], stems: list[str], scene: Scene, results: Results, shown: Stage):
        self.requested, self._stems, self._scene, self._results, self._shown = requested, stems, scene, results, shown
        self.records: dict[str, Record] = {}
        self._handed_over = self._before_batch = 0
        self._failures: dict[str, int] = {}
        self._is_hopeful = False        # a view is done
        self._given_up = 0

    def take(self, record: Record) -> bool:
        """Take the record of an attempt; false where its view is to be tried again."""
        if not record.error:
            self._is_hopeful = True
            self(record)
            return True
        failures = self._failures[record.stem] = self._failures.get(record.stem, 0) + 1
        if record.fault is DeviceLostError and failures < TRIES:
            log.warning("view %s is tried again: %s", record.name, record.error)
            return False
        self.give_up(record, failures)
        return True

    def give_up(self, record: Record, failures: int) -> None:
        """Take the record of a view that has failed so often; its error where the others would fail alike."""
        sizes = {(view.camera.width, view.camera.height) for view in self._scene.views}
        if record.fault is DeviceMemoryError and len(sizes) == 1 and not self._is_hopeful:
            raise record.failure(record.error)
        log.error("view %s has failed%s and is left out: %s", record.name,
                  f" {failures} times" if failures > 1 else "", record.error)
        self._given_up += 1
        if self._given_up >= HOPELESS and not self._is_hopeful:
            raise record.failure(f"the first {HOPELESS} views have all failed, the last one, {record.name}: "
                                 f"{record.error}")
        self(record)

    def __call__(self, record: Record) -> None:
        self.records[record.stem] = record
        self._shown.advance(len(self.records))
        while self._scene.on_view and self._handed_over < len(self.requested):
            index = self.requested[self._handed_over]
            next_one = self.records.get(self._stems[index])
            if next_one is None:
                break
            self._handed_over += 1
            if next_one.key:  # it could be planned
                self._scene.on_view(self._scene.views[index], depth_array(self._scene.depths[index]),
                                    self.result(index))

    def begin_batch(self) -> None:
        """The views that are counted from here on are those of another batch."""
        self._before_batch = len(self.records)

    def on_step(self, number: int) -> OnStep | None:
        """Progress within the view after the first `number` of the batch at hand, if it is shown. What the caller's
        function raises ends the run."""
        if self._shown is NONE:
            return None
        advance = within_view(self._shown, self._before_batch + number)

        def on_step(done: int, total: int) -> None:
            try:
                advance(done, total)
            except Exception as error:
                raise CallerError(error) from error

        on_step(0, 1)       # those before it are done
        return on_step

    def failed(self) -> list[Record]:
        """Records of views that have failed."""
        return [record for record in self.records.values() if record.error]

    def raise_if_all_failed(self) -> None:
        """An error where no view is left."""
        failed = self.failed()
        if failed and len(failed) == len(self.requested):
            raise failed[0].failure(f"every view has failed; {failed[0].name}: {failed[0].error}")

    def result(self, index: int) -> Any:
        """The result of the view `index`."""
        record, camera = self.records[self._stems[index]], self._scene.views[index].camera
        if record.error:
            return DepthResult.missing(camera, record.error, record.name)
        return self._results.result_of(record, camera)
