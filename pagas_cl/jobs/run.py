"""Batches of views to workers, records back; and parts of any other work.

Only a view whose worker or device was lost is tried again, three times at most: any other failure would come again. Of
such a view the run says so once, and goes on with the others.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pagas_cl.errors import DeviceError, DeviceMemoryError, InputError, OutputError, PagasError, log
from pagas_cl.jobs.executors import Workers
from pagas_cl.jobs.finished import FolderResults
from pagas_cl.jobs.keeping import Results
from pagas_cl.jobs.plan import Batch
from pagas_cl.jobs.task import Fault, Record, on_a_line
from pagas_cl.jobs.worker import Worker, run_batch, run_part

if TYPE_CHECKING:
    from pagas_cl.progress import OnStep

TRIES = 3
HOPELESS = 8        # views that fail before one is done, or batches that no worker has a device for: the run ends
_STALLED = 1800.0   # seconds without a view begun, while workers have no device, until the run ends
_PAUSE = 0.5        # seconds before a batch that was refused is sent again
_ERRORS = {Fault.INPUT: InputError, Fault.MEMORY: DeviceMemoryError}


def error_of(record: Record, message: str) -> PagasError:
    """The exception of the kind that a record's fault is."""
    return _ERRORS.get(record.fault, PagasError)(message)


class _Run:
    """A round: `on_record(Record)` is called with each view, done or given up; `is_uniform`: photos are of one size, so
    that what the device cannot hold for one of them it can hold for none."""

    def __init__(self, results: Results, on_record: Callable[[Record], Any], is_uniform: bool):
        self.results, self._on_record, self._is_uniform = results, on_record, is_uniform
        self._queue: deque[Batch] = deque()
        self._failures: dict[str, int] = {}
        self._is_hopeful = False        # a view is done
        self._given_up = 0

    def _take(self, record: Record, batch: Batch) -> None:
        if not record.error:
            self._is_hopeful = True
            self._on_record(record)
            return
        failures = self._failures[record.stem] = self._failures.get(record.stem, 0) + 1
        if record.fault is Fault.LOST and failures < TRIES:
            log.warning("view %s is tried again: %s", record.name, record.error)
            self._queue.append(replace(batch, tasks=tuple(task for task in batch.tasks if task.stem == record.stem)))
        else:
            self._give_up(record, failures)

    def _give_up(self, record: Record, failures: int) -> None:
        if record.fault is Fault.MEMORY and self._is_uniform and not self._is_hopeful:
            raise error_of(record, record.error)
        log.error("view %s has failed%s and is left out: %s", record.name,
                  f" {failures} times" if failures > 1 else "", record.error)
        self._given_up += 1
        if self._given_up >= HOPELESS and not self._is_hopeful:
            raise error_of(record, f"the first {HOPELESS} views have all failed, the last one, {record.name}: "
                           f"{record.error}")
        self._on_record(record)


class RunHere(_Run):
    """A round that `worker` works on, in this process; `on_step` as of Worker.records."""

    def __init__(self, results: Results, on_record: Callable[[Record], Any], is_uniform: bool, worker: Worker,
                 on_step: Callable[[int], OnStep | None]):
        super().__init__(results, on_record, is_uniform)
        self._worker, self._on_step = worker, on_step

    def finish(self, batches: Iterable[Batch]) -> None:
        """Work through `batches`."""
        for batch in batches:
            self._queue.append(batch)
            while self._queue:
                part = self._queue.popleft()
                for record in self._worker.records(part, self._on_step):
                    self._take(record, part)


class RunByWorkers(_Run):
    """A round whose batches other processes work on."""

    results: FolderResults

    def __init__(self, results: FolderResults, on_record: Callable[[Record], Any], is_uniform: bool, workers: Workers):
        super().__init__(results, on_record, is_uniform)
        self._workers = workers
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
                    self._send(batch)
                    self._receive_done(0)
                elif self._waiting:
                    self._receive_done(None)
                else:
                    break
        except BaseException:
            for future in self._waiting:
                future.cancel()
            self.results.request_stop()
            raise

    def _send(self, batch: Batch) -> None:
        try:
            self._waiting[self._workers.submit(run_batch, batch)] = batch
        except BrokenExecutor as error:
            self._replace_workers(error, batch)

    def _receive_done(self, timeout: float | None) -> None:
        for future in wait(self._waiting, timeout, FIRST_COMPLETED).done:
            if future in self._waiting:
                self._receive(future, self._waiting.pop(future))

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
            message = f"{type(error).__name__}: {error}"
            records = [self.results.find(task) or task.failed(message, Fault.LOST) for task in batch.tasks]
        for record in records:
            self._take(record, batch)

    def _refuse(self, error: DeviceError, batch: Batch) -> None:
        """A worker has no device, which is not its views' fault: another one may have. The run ends where no worker
        is seen at work."""
        signs, now = sum(self.results.attempts().values()), time.monotonic()
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
        begun = self.results.attempts()
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
                record = self.results.find(task)
                times = begun[on_a_line(task.name)]
                if record is not None:
                    self._take(record, batch)
                elif times >= TRIES:
                    self._give_up(task.failed("its worker process ended unexpectedly each time", Fault.LOST), times)
                else:
                    self._queue.append(replace(batch, tasks=(task,)))


def results_of(workers: Workers, work: Callable[[Any, Worker], Any], parts: Sequence[Any]) -> list[Any]:
    """What `work(part, worker)` gives of each part. One whose worker or device was lost is sent again, three times at
    most: its last error is raised then."""
    found: dict[int, Any] = {}
    for left in reversed(range(TRIES)):
        todo, errors = [k for k in range(len(parts)) if k not in found], list[Exception]()
        futures: dict[int, Future[Any]] = {}
        try:
            for k in todo:
                try:
                    futures[k] = workers.submit(run_part, work, parts[k], workers.device)
                except BrokenExecutor as error:
                    errors.append(error)
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
        log.warning("%d of %d parts of the work are given to workers again: %s", len(errors), len(todo), errors[-1])
        broken = [error for error in errors if isinstance(error, BrokenExecutor)]
        if broken:
            workers.renew(broken[0])
    return [found[k] for k in range(len(parts))]
