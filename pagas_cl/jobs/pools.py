"""Processes for workers: one a device of this machine, those of the caller's executor, or of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import re
import signal
import sys
from collections.abc import Callable, Collection, Iterator
from concurrent import futures
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager
from typing import Any

from pagas_cl.errors import DeviceError, InputError, log, need
from pagas_cl.jobs.task import results_version
from pagas_cl.jobs.worker import Worker, close_workers, follow_parent, run_task
from pagas_cl.runtime.allocations import limit_of
from pagas_cl.runtime.claim import known_devices
from pagas_cl.runtime.device import shares
from pagas_cl.runtime.host import keep_freed

PATIENCE = 20              # seconds to wait for a scheduler's answer


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
            self.open_devices(self.count())

    def open_devices(self, number: int) -> None:
        """Have so many workers that are idle open a device, or wait for one to be free."""
        self._opening = [self.submit(_open, None) for _ in range(number)]

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
        """Context in which workers are waited for: interrupted, as by a second Ctrl-C, those started here are killed,
        since a pool whose end is not waited for never ends."""
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
    """Context in which Ctrl-C waits; processes started in it never hear of it before they have begun (_begin)."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(on_host: bool) -> None:
    """What a worker process sets for itself; `on_host`: a device's memory is the host's. Ctrl-C reaches every process
    of a terminal: the first one has the workers end after their present view."""
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
