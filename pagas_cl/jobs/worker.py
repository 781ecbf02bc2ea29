"""What a worker does: a batch in, records out; its device, kernels and photos stay for the next batch. And processes
for workers: one a device of this machine, those of the caller's executor, or of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from concurrent import futures
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from threading import Lock, Thread
from typing import Any

from pagas_cl.errors import DeviceError, DeviceLostError, InputError, OutputError, log, need
from pagas_cl.jobs.plan import Batch
from pagas_cl.jobs.task import Record, ViewTask, results_version, worker_name
from pagas_cl.method.splat import PhotoStore
from pagas_cl.progress import OnStep
from pagas_cl.runtime.allocations import limit_of
from pagas_cl.runtime.claim import claim_device, give_back, known_devices
from pagas_cl.runtime.device import Device, shares, translate_cl_errors
from pagas_cl.runtime.host import keep_freed
from pagas_cl.scene.images import Loads

_READERS = min(6, os.cpu_count() or 6)      # photos that are decoded at a time
_WRITERS = 4               # results that are written, and views that are read, at a time, for a device with memory
PATIENCE = 20              # seconds to wait for a scheduler's answer


class Worker:
    """A device with its compiled kernels and photos, for one batch of views after another.

    `names`: what the device is chosen from (runtime.claim.claim_device), or an open Device; `photos`: a PhotoStore of
    that Device, whose photos stay there.
    """

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
        """Photos on the device."""
        if self._photos is None or self._photos.device.is_lost:
            self._photos = self._given.renewed() if self._given else PhotoStore(claim_device(self._names))
        return self._photos

    def records(self, batch: Batch, on_step: Callable[[int], OnStep | None] = lambda number: None) -> Iterator[Record]:
        """Refine the views of `batch` that are not finished; one record each, which also has the view's error.

        The device refines one view while files of the next are read and those of the one before are written.
        `on_step(number)` is the on_step (one_view.refine_one) of the view after the first `number`. OutputError
        (nothing can be written) and DeviceError (no device to work with) are raised: they are not the view's fault.
        """
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
        """Have the photos of `task` read, where the work looks at them, and its depth map, which is what comes."""
        depth = readers.submit(task.depth.load) if isinstance(task.depth, Loads) else _done(task.depth)
        for k in task.partners.all if batch.photos else ():
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
    """Worker.part, in a process of a pool or cluster of the same `version` (task.results_version), on one of the
    devices `names`. `attempt`: how many tasks were sent before this one, since some executors keep what equal
    arguments gave."""
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


class Workers:
    """Workers in other processes, and the device that their tasks are to take; arguments as in whole.refine_all. Those
    of this machine start at once, and open their devices while this process does something else."""

    def __init__(self, executor, device):
        self._is_pool = executor is None
        self._is_own = self._is_pool or isinstance(executor, str)      # made here, and closed here
        self._device = tuple(device) if isinstance(device, list) else device
        self._sent = 0
        if self._is_pool:
            self._start()
        else:
            self.executor = dask_executor(executor) if isinstance(executor, str) else executor

    def _start(self) -> None:
        self.executor = local_pool(self._device)
        with _interrupted_later():
            self._opening = [self.submit(_open, None) for _ in range(self.count())]

    def submit(self, work: Callable[[Any, Worker], Any], part: Any) -> Future:
        """Have work(part, worker) done by a worker; where the executor is broken its error is what comes of it."""
        self._sent += 1
        try:
            if getattr(self._client, "status", "running") != "running":     # what is sent then would never come back
                raise BrokenExecutor("the Dask scheduler has ended or cannot be reached")
            return self.executor.submit(run_task, work, part, self._device, results_version(), self._sent)
        except BrokenExecutor as error:
            broken: Future[Any] = Future()
            broken.set_exception(error)
            return broken

    @property
    def _client(self) -> Any:
        """The client that Dask's executors have; None of any other."""
        return getattr(self.executor, "_client", None)

    def count(self) -> int:
        """How many tasks run at a time; 4 where the executor does not say."""
        if hasattr(self._client, "ncores"):
            return max(1, sum(self._client.ncores().values()))
        return max(1, int(getattr(self.executor, "_max_workers", 0) or 4))

    def renew(self, error: Exception) -> None:
        """A new pool for one that has lost a process, which ends all of it; DeviceError where it is the caller's."""
        if not self._is_pool:
            raise DeviceError(f"the executor takes no more tasks ({error}); finished views are kept: start the same "
                              "command again") from error
        self.executor.shutdown(wait=True)
        self._start()

    def wait_for(self, running: Collection[Future]) -> None:
        """Wait until these have ended."""
        with self._killed_if_interrupted():
            futures.wait(running)

    def close(self) -> None:
        """End the executor, where it was made here, and let go of what threads of this process keep."""
        if self._is_pool and not all(future.done() for future in self._opening):
            self._kill()        # they wait for a device, and have no work
        elif self._is_pool:
            with self._killed_if_interrupted():
                self.executor.shutdown(cancel_futures=True)
        elif self._is_own:
            self.executor.shutdown()
        close_workers()

    @contextmanager
    def _killed_if_interrupted(self) -> Iterator[None]:
        """Context in which workers are waited for. Where that is interrupted, as by a second Ctrl-C, those that were
        started here are killed: a pool whose end is not waited for has them wait for ever, and this process with
        them."""
        try:
            yield
        except BaseException:
            if self._is_pool:
                self._kill()
            raise

    def _kill(self) -> None:
        processes = list((getattr(self.executor, "_processes", None) or {}).values())
        self.executor.shutdown(wait=False, cancel_futures=True)      # it stumbles over those that we cancelled
        for process in processes:
            process.kill()


@contextmanager
def workers_of(executor, device) -> Iterator[Workers]:
    """Context of Workers(executor, device); those that `executor` is itself stay at work."""
    if isinstance(executor, Workers):
        yield executor
        return
    workers = Workers(executor, device)
    try:
        yield workers
    finally:
        workers.close()


def _open(_: None, worker: Worker) -> None:
    """In a worker: have its device open."""
    _ = worker.device


def local_pool(devices) -> Executor:
    """One spawned process for each device that `devices` means: an OpenCL context does not survive a fork."""
    limit_of(1)      # what the environment says of memory is refused here, once, and not by each worker
    usable = known_devices(devices)
    on_host = any(info.kind == "CPU" for info, *_ in usable)
    return futures.ProcessPoolExecutor(len(usable) * shares(), multiprocessing.get_context("spawn"), initializer=_begin,
                                       initargs=(on_host,))


@contextmanager
def _interrupted_later() -> Iterator[None]:
    """Context in which Ctrl-C waits, and which processes that are started in it never hear of: until they have begun
    (_begin), it would end them with a traceback."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(on_host: bool) -> None:
    """What a worker process sets for itself; `on_host`: a device's memory is the host's.

    Ctrl-C reaches every process of a terminal: the first one has the workers end after their present view.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    keep_freed(not on_host)
    follow_parent()


def check_address(address: str) -> None:
    """InputError for what can be no address of a Dask scheduler."""
    if not re.fullmatch(r".+:\d+", address):
        raise InputError(f"{address!r} is no address of a Dask scheduler, expected for instance 'tcp://HOST:8786'")


def dask_executor(address: str) -> Executor:
    """The executor of a running Dask cluster, such as "tcp://host:8786"."""
    distributed = need("distributed", "cluster", "running on a Dask cluster")
    check_address(address)
    try:
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise DeviceError(f"no Dask scheduler answers at {address!r} ({str(error).splitlines()[0]}): start one with "
                          "'dask scheduler' and workers with 'dask worker --nthreads 1 ADDRESS'") from error
    if not client.ncores():
        log.warning("no worker is connected to the Dask scheduler at %s: waiting for one (dask worker --nthreads 1 %s)",
                    address, address)
    return client.get_executor(pure=False)
