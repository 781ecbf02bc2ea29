"""Batches to an executor, records back; a view that fails is asked for again, three times at most."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Iterable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, wait
from pathlib import Path

from pagas_cl.errors import DeviceError, InputError, OutputError, PagasError
from pagas_cl.jobs.executors import SerialExecutor
from pagas_cl.jobs.finished import find_finished, work_folder
from pagas_cl.jobs.task import Batch, Record
from pagas_cl.jobs.worker import STOP, attempts, run_batch

log = logging.getLogger("pagas_cl")

TRIES = 3
STALLED = 1800.0  # seconds without a view done, while workers tell that they have no device, until the run ends
HOPELESS = 8  # so many views given up before one is done: something is wrong that no other view will escape


class Run:
    """One run's batches on their way.

    Parameters
    ----------
    executor : Executor
    folder : Path
        Where results go.
    renew : callable returning an Executor, or None
        Makes a new one when the present one has broken (a process of a pool was killed).
    on_record : callable(Record)
        Called for each view, done or given up.
    inside : callable of a number, optional
        Progress of that view of the present batch, where it is refined in this process.
    """

    def __init__(self, executor: Executor, folder: Path, renew, on_record, inside=None):
        self.executor, self.folder, self.renew, self.on_record = executor, folder, renew, on_record
        self._inside = (inside,) if isinstance(executor, SerialExecutor) else ()
        self._queue: deque[Batch] = deque()
        self._waiting: dict = {}
        self._errors: dict[str, list[Record]] = {}
        self._done, self._given_up = 0, 0
        self._refused, self._last = 0, time.monotonic()       # workers without a device, since a view was last done

    def finish(self, batches: Iterable[Batch]) -> None:
        """Work through `batches`, which may be planned while others are at work."""
        source, most = iter(batches), 1 if isinstance(self.executor, SerialExecutor) else math.inf
        try:
            while True:
                while len(self._waiting) < most:
                    batch = self._queue.popleft() if self._queue else next(source, None)
                    if batch is None:
                        break
                    self._send(batch)
                    self._receive_done(0)
                if not self._waiting and not self._queue:
                    break
                self._receive_done(None)
        except BaseException:
            self._ask_to_stop()
            raise

    def _receive_done(self, timeout) -> None:
        for future in wait(self._waiting, timeout, FIRST_COMPLETED).done:
            if future in self._waiting:
                self._receive(future, self._waiting.pop(future))

    def close(self) -> None:
        """End the executor, without the batches that have not begun."""
        for future in self._waiting:
            future.cancel()
        self.executor.shutdown(wait=True)

    def _send(self, batch: Batch) -> None:
        try:
            self._waiting[self.executor.submit(run_batch, batch, *self._inside)] = batch
        except BrokenExecutor as error:
            self._queue.appendleft(batch)
            self._broken(error)

    def _receive(self, future, batch: Batch) -> None:
        try:
            records = future.result()
        except OutputError:
            raise
        except BrokenExecutor as error:
            self._queue.appendleft(batch)
            self._broken(error)
            return
        except Exception as error:  # a lost worker, as the executor tells it; a worker without a device
            self._lost(batch, error)
            return
        for record in records:
            self._take(record, batch)

    def _take(self, record: Record, batch: Batch) -> None:
        if not record.error:
            self._done += 1
            self._refused, self._last = 0, time.monotonic()
            self.on_record(record)
            return
        failures = self._errors.setdefault(record.name, [])
        failures.append(record)
        # read by the same process again a bad file is as bad; another worker may reach what this one does not
        if len(failures) >= TRIES or record.bad_input and isinstance(self.executor, SerialExecutor):
            self._give_up(record)
            return
        log.warning("view %s has failed, it is tried again: %s", record.name, record.error)
        self._queue.append(batch.only([task for task in batch.tasks if task.name == record.name]))

    def _lost(self, batch: Batch, error: Exception) -> None:
        """What a lost worker had finished is kept; the rest goes to others, a view at a time."""
        if isinstance(error, DeviceError):  # the worker's fault and not the views': to another one
            self._refused += 1
            stalled = not self._done or time.monotonic() - self._last > STALLED
            if isinstance(self.executor, SerialExecutor) or self._refused >= HOPELESS and stalled:
                raise error
            log.warning("a worker cannot work: %s", error)
            self._queue.append(batch)
            return
        for task in batch.tasks:
            record = find_finished(batch.folder, task, batch.extras)
            message = f"{type(error).__name__}: {error}"
            self._take(record or Record(task.name, task.stem, task.key, error=message), batch)

    def _broken(self, error: BrokenExecutor) -> None:
        """A process of a pool was killed, which ends the whole pool: views that were begun three times are given up."""
        if self.renew is None:
            raise DeviceError(f"the executor has lost a worker and takes no more tasks ({error}); finished views are "
                              "kept: start the same command again") from error
        unfinished = [*self._queue, *self._waiting.values()]
        self._queue.clear(), self._waiting.clear()
        log.warning("a worker process was lost; its views are given to a new one")
        self.executor.shutdown(wait=True)
        self.executor = self.renew()
        begun = attempts(self.folder)
        for batch in unfinished:
            self._again(batch, begun)

    def _again(self, batch: Batch, begun: dict[str, int]) -> None:
        left = []
        for task in batch.tasks:
            record = find_finished(batch.folder, task, batch.extras)
            if record is None and begun.get(task.name, 0) >= TRIES:
                self._give_up(Record(task.name, task.stem, task.key, error="its worker process was lost each time"))
            elif record is not None:
                self._done += 1
                self.on_record(record)
            else:
                left.append(task)
        for task in left:
            self._queue.append(batch.only([task]))

    def _give_up(self, record: Record) -> None:
        times = len(self._errors.get(record.name, ())) or TRIES
        log.error("view %s has failed%s and is left out: %s", record.name, f" {times} times" if times > 1 else "",
                  record.error)
        self._given_up += 1
        if self._given_up >= HOPELESS and not self._done:
            kind = InputError if record.bad_input else PagasError
            raise kind(f"the first {HOPELESS} views have all failed, the last one, {record.name}: {record.error}")
        self.on_record(record)

    def _ask_to_stop(self) -> None:
        """Let every worker end after its present view."""
        for future in self._waiting:
            future.cancel()
        try:
            (work_folder(self.folder) / STOP).touch()
        except OSError as error:
            log.warning("workers cannot be asked to stop: %s", error)
