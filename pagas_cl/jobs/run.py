"""What takes a round's records as they come; batches of views to workers, records back; and parts of any other work.

Only a view whose worker or device was lost is tried again, three times at most: any other failure would come again. Of
such a view the run says so once, and goes on with the others."""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass, replace
from typing import Any

from pagas_cl.errors import DeviceError, DeviceLostError, DeviceMemoryError, OutputError, PagasError, log
from pagas_cl.jobs.finished import FolderResults
from pagas_cl.jobs.keeping import Results
from pagas_cl.jobs.plan import Batch
from pagas_cl.jobs.pools import Workers
from pagas_cl.jobs.task import Record, on_a_line
from pagas_cl.jobs.worker import Worker, refine_batch
from pagas_cl.progress import NONE, OnStep, Stage, within_view
from pagas_cl.result import DepthResult
from pagas_cl.scene.inputs import depth_array
from pagas_cl.scene.view import View

TRIES = 3
HOPELESS = 8        # views that fail before one is done, or batches that no worker has a device for: the run ends
_STALLED = 1800.0   # seconds without a view begun, while workers have no device, until the run ends
_PAUSE = 0.5        # seconds before a batch that was refused is sent again


@dataclass(frozen=True)
class Scene:
    """What a run works on: `requested` are places of the views to refine; a depth map (or what loads it, or None)
    a view; `on_view` gets (view, initial depth, result) when a view is finished, in the order of `requested`."""

    views: Sequence[View]
    depths: Sequence[Any]
    requested: list[int]
    on_view: Callable[[View, Any, Any], Any] | None = None


class CallerError(BaseException):
    """Carries what the caller's own function has raised, its cause, past those who take errors for a view's."""


class Collect:
    """Takes a round's records as they come, and hands results to the caller in the order of the views."""

    def __init__(self, requested: list[int], stems: list[str], scene: Scene, results: Results, shown: Stage):
        self.requested, self._stems, self._scene, self._results, self._shown = requested, stems, scene, results, shown
        self.records: dict[str, Record] = {}
        self._handed_over = 0
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

    def on_step(self, number: int) -> OnStep | None:
        """Progress within the view after the first `number`, if shown; what the caller's function raises ends all."""
        if self._shown is NONE:
            return None
        advance = within_view(self._shown, number)

        def on_step(done: int, total: int) -> None:
            try:
                advance(done, total)
            except Exception as error:
                raise CallerError from error

        on_step(0, 1)       # those before it are done
        return on_step

    def failed(self) -> list[Record]:
        return [record for record in self.records.values() if record.error]

    def result(self, index: int) -> Any:
        record, camera = self.records[self._stems[index]], self._scene.views[index].camera
        if record.error:
            return DepthResult.missing(camera, record.error, record.name)
        return self._results.result_of(record, camera)


def run_here(batches: Iterable[Batch], worker: Worker, collect: Collect) -> None:
    for batch in batches:
        queue = deque([batch])
        while queue:
            part, before = queue.popleft(), len(collect.records)
            try:
                for record in worker.records(part, lambda number, before=before: collect.on_step(before + number)):
                    if not collect.take(record):
                        queue.append(_again(part, record))
            except CallerError as carrier:
                raise carrier.__cause__ from None


def _again(batch: Batch, record: Record) -> Batch:
    """The view of `record` alone."""
    return replace(batch, tasks=tuple(task for task in batch.tasks if task.stem == record.stem))


class RunByWorkers:
    """A round whose batches other processes work on."""

    def __init__(self, results: FolderResults, collect: Collect, workers: Workers):
        self._results, self._collect, self._workers = results, collect, workers
        self._queue: deque[Batch] = deque()
        self._waiting: dict[Future[list[Record]], Batch] = {}
        self._has_warned = False
        self._begun, self._seen = 0, time.monotonic()       # views begun, and when there was a new one; since then:
        self._refused = self._broken = 0        # batches that workers had no device for, and pools that were lost

    def finish(self, batches: Iterable[Batch]) -> None:
        """Work through `batches`, which may be planned while others are at work."""
        source = iter(batches)
        try:
            while True:
                batch = self._queue.popleft() if self._queue else next(source, None)
                if batch is not None:
                    self._waiting[self._workers.submit(refine_batch, batch)] = batch
                elif not self._waiting:
                    break
                # at most a second at a time: Windows hears of Ctrl-C in between
                for future in wait(self._waiting, 1 if batch is None else 0, FIRST_COMPLETED).done:
                    if future in self._waiting:      # a pool that was lost takes all of them along
                        self._receive(future, self._waiting.pop(future))
        except BaseException:
            running = [future for future in self._waiting if not future.cancel()]
            self._results.request_stop()
            self._workers.wait_for(running)      # their folder may be removed then
            raise

    def _receive(self, future: Future[list[Record]], batch: Batch) -> None:
        try:
            records = future.result()
        except OutputError:
            raise
        except BrokenExecutor as error:
            self._replace_workers(error, batch)
            return
        except DeviceError as error:
            self._refuse(error, batch)
            return
        except Exception as error:  # a lost worker, as the executor reports it: what it had finished is kept
            lost = DeviceLostError(f"{type(error).__name__}: {error}")
            records = [self._results.find(task) or task.failed(lost) for task in batch.tasks]
        for record in records:
            if not self._collect.take(record):
                self._queue.append(_again(batch, record))

    def _attempts(self) -> Counter[str]:
        """How often each view was begun; what has failed before there was a new one is forgotten."""
        begun = self._results.attempts()
        if begun.total() != self._begun:
            self._begun, self._seen, self._refused, self._broken = begun.total(), time.monotonic(), 0, 0
        return begun

    def _refuse(self, error: DeviceError, batch: Batch) -> None:
        """A worker has no device: another one may have. The run ends where no worker is seen at work."""
        self._attempts()
        self._refused += 1
        if self._refused >= HOPELESS and (not self._begun or time.monotonic() - self._seen > _STALLED):
            raise error
        if not self._has_warned:
            log.warning("a worker cannot work: %s", error)
            self._has_warned = True
        time.sleep(_PAUSE)
        if self._begun:     # or Dask would give the batch to this worker again, which is idle, and never to the others
            self._workers.open_devices(self._refused)
        self._queue.append(batch)

    def _replace_workers(self, error: BrokenExecutor, lost: Batch) -> None:
        """A process of a pool was killed, which ends the whole pool and does not say at which view: those begun three
        times are given up, others sent one at a time. The run ends where no view is begun."""
        begun = self._attempts()
        self._broken += 1
        if self._broken >= TRIES:
            raise PagasError(f"worker processes end before they have begun a view ({error}): a script that starts them "
                             "needs 'if __name__ == \"__main__\":' around what it does") from error
        self._workers.renew(error)
        unfinished = [lost, *self._queue, *self._waiting.values()]
        self._queue.clear()
        self._waiting.clear()
        log.warning("a worker process has ended unexpectedly; its views are given to a new one")
        for batch in unfinished:
            for task in batch.tasks:
                record = self._results.find(task)
                times = begun[on_a_line(task.name)]
                if record is not None:
                    self._collect.take(record)
                elif times >= TRIES:
                    lost_each_time = DeviceLostError("its worker process ended unexpectedly each time")
                    self._collect.give_up(task.failed(lost_each_time), times)
                else:
                    self._queue.append(replace(batch, tasks=(task,)))


def results_of(workers: Workers, work: Callable[[Any, Worker], Any], parts: Sequence[Any]) -> list[Any]:
    """What `work(part, worker)` gives of each part, sent up to three times where its worker fails; or the error."""
    found: dict[int, Any] = {}
    for left in reversed(range(TRIES)):
        futures = {k: workers.submit(work, part) for k, part in enumerate(parts) if k not in found}
        errors: list[Exception] = []
        try:
            for k, future in futures.items():
                try:
                    found[k] = future.result()
                except Exception as error:      # whatever it is, another worker may not meet it
                    errors.append(error)
        except BaseException:
            for future in futures.values():
                future.cancel()
            raise
        if not errors:
            break
        if not left:
            raise errors[-1] if isinstance(errors[-1], PagasError) else PagasError(f"a worker failed: {errors[-1]!r}")
        log.warning("%d of %d parts of the work are given to workers again: %s", len(errors), len(futures), errors[-1])
        broken = [error for error in errors if isinstance(error, BrokenExecutor)]
        if broken:
            workers.renew(broken[0])
    return [found[k] for k in range(len(parts))]
