"""What a worker does: a batch in, records out; its device, kernels and photos stay for the next batch."""

from __future__ import annotations

import multiprocessing
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from threading import Lock, Thread
from typing import Any

from pagas_cl.errors import DeviceError, DeviceLostError, InputError, OutputError
from pagas_cl.jobs.plan import Batch
from pagas_cl.jobs.task import Record, ViewTask, results_version, worker_name
from pagas_cl.method.splat import PhotoStore
from pagas_cl.progress import OnStep
from pagas_cl.runtime.claim import claim_device, give_back
from pagas_cl.runtime.device import Device, translate_cl_errors
from pagas_cl.scene.images import Loads

_READERS = min(6, os.cpu_count() or 6)      # photos that are decoded at a time
_WRITERS = 4               # results that are written, and views that are read, at a time, for a device with memory


class Worker:
    """A device with its compiled kernels and photos, for one batch of views after another. `names`: what the device is
    chosen from (runtime.claim.claim_device), or an open Device; `photos`: a PhotoStore of that Device, whose photos
    stay there."""

    def __init__(self, names: Any, photos: PhotoStore | None = None):
        self._names, self._photos, self._given = names, photos, photos
        self._views: dict[str, Any] = {}
        self._was_lost = False      # the device failed at the last view

    @property
    def device(self) -> Device:
        """The device; opened anew where it has failed."""
        return self.photos.device

    @property
    def photos(self) -> PhotoStore:
        if self._photos is None or self._photos.device.is_lost:
            self._photos = self._given.renewed() if self._given else PhotoStore(claim_device(self._names))
        return self._photos

    def records(self, batch: Batch, on_step: Callable[[int], OnStep | None] = lambda number: None) -> Iterator[Record]:
        """Refine the views of `batch` that are not finished; one record each, which also has the view's error. The
        device refines one view while files of the next are read and those of the one before are written.
        `on_step(number)` is the on_step (one_view.refine_one) of the view after the first `number`. OutputError
        (nothing can be written) and DeviceError (no device to work with) are raised: they are not the view's fault."""
        waiting = 1 if self.photos.on_host else _WRITERS
        # those of earlier batches as the same objects, so that their photos are found again
        views = {k: self._views.setdefault(batch.digests[k], view) for k, view in batch.views.items()}
        ahead: dict[str, Future[Any]] = {}
        ended: deque[Future[Record]] = deque()
        with ThreadPoolExecutor(_READERS) as readers, ThreadPoolExecutor(_WRITERS) as writers:
            for number, task in enumerate(batch.tasks):
                if batch.results.is_stopping():
                    break
                record = batch.results.find(task)
                if record is None:
                    for one in batch.tasks[number:number + 1 + waiting]:
                        if one.stem not in ahead:
                            ahead[one.stem] = self._read_ahead(batch, one, views, readers)
                    ended.append(self._attempt(batch, task, views, ahead.pop(task.stem), writers, on_step(number)))
                else:
                    ended.append(_done(record))
                while len(ended) > waiting or (ended and ended[0].done()):
                    yield ended.popleft().result()
            while ended:
                yield ended.popleft().result()

    def part(self, work: Callable[[Any, Worker], Any], part: Any) -> Any:
        """`work(part, worker)`; the device is opened anew where that has failed."""
        try:
            with translate_cl_errors(self.device, "a part of the work"):
                return work(part, self)
        except DeviceError:
            self._photos = None
            raise

    def close(self) -> None:
        """Let go of everything but the photos that it was given."""
        if self._photos is not None and self._photos is not self._given:
            self._photos.clear()
        self._views.clear()

    def _read_ahead(self, batch: Batch, task: ViewTask, views: dict[int, Any], readers: ThreadPoolExecutor) -> Future:
        """Have the photos of `task` read, and its depth map, which is what comes."""
        depth = readers.submit(task.depth.load) if isinstance(task.depth, Loads) else _done(task.depth)
        for k in task.partners.all:
            self.photos.read_ahead(views[k], readers)
        return depth

    def _attempt(self, batch: Batch, task: ViewTask, views: dict[int, Any], depth: Future, writers: ThreadPoolExecutor,
                 on_step: OnStep | None) -> Future[Record]:
        """What will be the record of `task`: `writers` are to write the result."""
        start = time.perf_counter()
        batch.results.note("began", task.name)
        try:
            result = batch.work(views, task.partners, depth.result(), batch.config, self.device, self.photos, on_step)
        except OutputError:
            raise
        except Exception as error:  # whatever it is, the other views must not suffer
            batch.results.note("failed", task.name)
            return _done(self._failed(task, error))
        self._was_lost = False
        if batch.keep:
            batch.keep((batch.results, task.key), result, self.device, self.photos)      # see EarlierResults
        about = {"device": self.device.info.title, "worker": worker_name(), "task_seconds": time.perf_counter() - start}
        return writers.submit(_write, batch, task, result, about)

    def _failed(self, task: ViewTask, error: Exception) -> Record:
        record = task.failed(error)
        if record.fault is not InputError:
            self._photos = None         # the device may be in any state: opened anew for the next view
        if record.fault is DeviceLostError:
            if self._was_lost:      # twice in a row: this worker has no device
                self._was_lost = False
                raise error
            self._was_lost = True
        return record


def refine_batch(batch: Batch, worker: Worker) -> list[Record]:
    """Worker.records, as a task."""
    return list(worker.records(batch))


def _done(value: Any) -> Future[Any]:
    """What nothing has to be waited for."""
    future: Future[Any] = Future()
    future.set_result(value)
    return future


def _write(batch: Batch, task: ViewTask, result: Any, about: dict[str, Any]) -> Record:
    try:
        record = batch.results.write(task, result, about)
    except OutputError:
        raise
    except Exception as error:
        record = task.failed(error)
    batch.results.note("failed" if record.error else "ended", task.name)
    return record


# What processes of pools and clusters keep between tasks, which they are given as functions of a module: a worker each.
_workers: dict[Any, Worker] = {}
_one_at_a_time = Lock()    # tasks of one process share a device's queue


def run_task(work: Callable[[Any, Worker], Any], part: Any, names: Any, version: str, attempt: int) -> Any:
    """Worker.part, in a process of the same `version` (task.results_version), on one of the devices `names`. `attempt`:
    how many tasks were sent before, since some executors keep what equal arguments gave."""
    follow_parent()
    if version != results_version():
        raise DeviceError(f"the worker on {socket.gethostname()} runs another version of pagas_cl than the one that "
                          "planned the run: install the same version everywhere")
    with _one_at_a_time:
        return _workers.setdefault(names, Worker(names)).part(work, part)


def close_workers() -> None:
    """Let go of everything that this process keeps between tasks, its devices too."""
    with _one_at_a_time:
        for worker in _workers.values():
            worker.close()
        _workers.clear()
        give_back()


def follow_parent() -> None:
    """In a process of a pool: end when the one that started it has, however that came about. Its queue would wait for
    ever, and it would keep the device from the run that goes on."""
    _follow_parent(os.getpid())


@cache
def _follow_parent(_: int) -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
