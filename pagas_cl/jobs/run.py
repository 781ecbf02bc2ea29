"""Work to an executor: batches of views, records back; and parts of any other work. What fails is asked for again,
three times at most."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from pathlib import Path
from typing import Any

from pagas_cl.errors import DeviceError, InputError, OutputError, PagasError, log
from pagas_cl.jobs.executors import Workers
from pagas_cl.jobs.finished import find_finished, work_folder
from pagas_cl.jobs.task import Batch, Record, code_version
from pagas_cl.jobs.worker import STOP, WorkerContext, attempts, on_a_line, run_batch, run_part

TRIES = 3
STALLED = 1800.0  # seconds without a view done, while workers tell that they have no device, until the run ends
HOPELESS = 8  # so many views given up before one is done: something is wrong that no other view will escape


class Run:
    """One run's batches on their way; results go to `folder`. `on_record(Record)` is called for each view, done or
    given up; `inside(k)` is the progress of view `k` of the present batch, where it is refined in this process."""

    def __init__(self, workers: Workers, folder: Path, on_record, inside=None):
        self.workers, self.folder, self.on_record = workers, folder, on_record
        self._inside = (inside,) if workers.local else ()
        self._queue: deque[Batch] = deque()
        self._waiting: dict[Future, Batch] = {}
        self._errors: dict[str, list[Record]] = {}
        self._done, self._given_up = 0, 0
        self._refused, self._last = 0, time.monotonic()       # workers without a device, since a view was last done

    def finish(self, batches: Iterable[Batch]) -> None:
        """Work through `batches`, which may be planned while others are at work."""
        source, most = iter(batches), 1 if self.workers.local else math.inf
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

    def close(self) -> None:
        """End the executor, without the batches that have not begun."""
        for future in self._waiting:
            future.cancel()
        self.workers.executor.shutdown(wait=True)

    def _send(self, batch: Batch) -> None:
        try:
            self._waiting[self.workers.executor.submit(run_batch, batch, *self._inside)] = batch
        except BrokenExecutor as error:
            self._broken(error, batch)

    def _receive_done(self, timeout) -> None:
        for future in wait(self._waiting, timeout, FIRST_COMPLETED).done:
            if future in self._waiting:
                self._receive(future, self._waiting.pop(future))

    def _receive(self, future: Future, batch: Batch) -> None:
        try:
            records = future.result()
        except OutputError:
            raise
        except BrokenExecutor as error:
            self._broken(error, batch)
            return
        except DeviceError as error:
            self._refuse(error, batch)
            return
        except Exception as error:  # a lost worker, as the executor tells it: what it had finished is kept
            message = f"{type(error).__name__}: {error}"
            records = [find_finished(batch.folder, task, batch.extras) or task.failed(message) for task in batch.tasks]
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
        if len(failures) >= TRIES or record.bad_input and self.workers.local:
            self._give_up(record)
            return
        log.warning("view %s has failed, it is tried again: %s", record.name, record.error)
        self._queue.append(batch.only([task for task in batch.tasks if task.name == record.name]))

    def _refuse(self, error: DeviceError, batch: Batch) -> None:
        """A worker has no device, which is not its views' fault: to another one."""
        self._refused += 1
        stalled = not self._done or time.monotonic() - self._last > STALLED
        if self.workers.local or self._refused >= HOPELESS and stalled:
            raise error
        log.warning("a worker cannot work: %s", error)
        self._queue.append(batch)

    def _broken(self, error: BrokenExecutor, lost: Batch) -> None:
        """A process of a pool was killed, which ends the whole pool and does not tell at which view: those that were
        begun three times are given up, the others are asked for one at a time."""
        self.workers.renew(error)
        unfinished = [lost, *self._queue, *self._waiting.values()]
        self._queue.clear(), self._waiting.clear()
        log.warning("a worker process has ended unexpectedly; its views are given to a new one")
        begun = attempts(self.folder)
        for batch in unfinished:
            for task in batch.tasks:
                record = find_finished(batch.folder, task, batch.extras)
                if record is not None:
                    self._take(record, batch)
                elif begun[on_a_line(task.name)] >= TRIES:
                    self._give_up(task.failed("its worker process ended unexpectedly each time"))
                else:
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
            log.warning("workers cannot be stopped and go on to their end: %s", error)


def results_of(workers: Workers, work: Callable[[Any, WorkerContext], Any], parts: Sequence[Any]) -> list[Any]:
    """What `work(part, context)` gives of each part. One whose worker or device was lost is asked for again, three
    times at most: its last error is raised then."""
    found: dict[int, Any] = {}
    for left in reversed(range(TRIES)):
        todo, futures, errors = [k for k in range(len(parts)) if k not in found], [], []
        try:
            for k in todo:
                futures.append(_sent(workers, work, parts[k]))
            for k, future in zip(todo, futures):
                try:
                    found[k] = future.result()
                except Exception as error:      # whatever it is, another worker may not meet it
                    errors.append(error)
        except BaseException:
            for future in futures:
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


def _sent(workers: Workers, work, part) -> Future:
    try:
        return workers.executor.submit(run_part, work, part, workers.device, code_version())
    except BrokenExecutor as error:
        future: Future = Future()
        future.set_exception(error)
        return future
