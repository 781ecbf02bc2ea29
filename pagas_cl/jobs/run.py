"""Batches of views to workers, records back; and parts of any other work."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import replace
from typing import Any

from pagas_cl.errors import DeviceError, DeviceLostError, OutputError, PagasError, log
from pagas_cl.jobs.collect import HOPELESS, TRIES, CallerError, Collect
from pagas_cl.jobs.executors import Workers
from pagas_cl.jobs.finished import FolderResults
from pagas_cl.jobs.plan import Batch
from pagas_cl.jobs.task import Record, on_a_line
from pagas_cl.jobs.worker import Worker, refine_batch

_STALLED = 1800.0   # seconds without a view begun, while workers have no device, until the run ends
_PAUSE = 0.5        # seconds before a batch that was refused is sent again


def run_here(batches: Iterable[Batch], worker: Worker, collect: Collect) -> None:
    """Have `worker`, in this process, work through `batches`."""
    for batch in batches:
        queue = deque([batch])
        while queue:
            part = queue.popleft()
            try:
                for record in worker.records(part, collect.on_step):
                    if not collect.take(record):
                        queue.append(_again(part, record))
            except CallerError as error:
                raise error.error from None


def _again(batch: Batch, record: Record) -> Batch:
    """The view of `record` alone."""
    return replace(batch, tasks=tuple(task for task in batch.tasks if task.stem == record.stem))


class RunByWorkers:
    """A round whose batches other processes work on."""

    def __init__(self, results: FolderResults, collect: Collect, workers: Workers):
        self._results, self._collect, self._workers = results, collect, workers
        self._queue: deque[Batch] = deque()
        self._waiting: dict[Future[list[Record]], Batch] = {}
        self._refused = 0       # batches that workers had no device for, since one of them was last seen at work
        self._has_warned = False
        self._broken, self._begun = 0, -1       # pools in a row that were lost with as many views begun
        self._signs, self._seen = 0, time.monotonic()       # views begun, and when there was a new one

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
                for future in wait(self._waiting, None if batch is None else 0, FIRST_COMPLETED).done:
                    if future in self._waiting:      # a pool that was lost takes all of them along
                        self._receive(future, self._waiting.pop(future))
        except BaseException:
            for future in self._waiting:
                future.cancel()
            self._results.request_stop()
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

    def _refuse(self, error: DeviceError, batch: Batch) -> None:
        """A worker has no device, which is not its views' fault: another one may have. The run ends where no worker
        is seen at work."""
        signs, now = sum(self._results.attempts().values()), time.monotonic()
        if signs != self._signs:
            self._signs, self._seen, self._refused = signs, now, 0
        self._refused += 1
        if self._refused >= HOPELESS and (not signs or now - self._seen > _STALLED):
            raise error
        if not self._has_warned:
            log.warning("a worker cannot work: %s", error)
            self._has_warned = True
        time.sleep(_PAUSE)
        self._queue.append(batch)

    def _replace_workers(self, error: BrokenExecutor, lost: Batch) -> None:
        """A process of a pool was killed, which ends the whole pool and does not say at which view: those that were
        begun three times are given up, the others are sent one at a time. The run ends where processes end before they
        have begun a view."""
        begun = self._results.attempts()
        self._broken = 1 if sum(begun.values()) != self._begun else self._broken + 1
        self._begun = sum(begun.values())
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
    """What `work(part, worker)` gives of each part. One whose worker or device was lost is sent again, three times at
    most: its last error is raised then."""
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
