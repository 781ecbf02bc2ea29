"""Other processes that tasks run in: one a device of this machine, an executor of the caller's, or a Dask cluster."""

import multiprocessing
import re
import signal
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from typing import Any

from pagas_cl.errors import DeviceError, InputError, need
from pagas_cl.jobs.task import results_version
from pagas_cl.jobs.worker import Worker, close_workers, follow_parent, run_task
from pagas_cl.runtime.claim import known_devices
from pagas_cl.runtime.device import shares
from pagas_cl.runtime.host import keep_freed

PATIENCE = 20  # seconds to wait for a scheduler's answer


class Workers:
    """Workers in other processes, and the device that their tasks are to take; arguments as in whole.refine_all."""

    def __init__(self, executor, device):
        self._is_pool = executor is None
        self._is_own = self._is_pool or isinstance(executor, str)      # made here, and closed here
        self._device = tuple(device) if isinstance(device, list) else device
        self._sent = 0
        if self._is_pool:
            self.executor = local_pool(device)
        else:
            self.executor = dask_executor(executor) if isinstance(executor, str) else executor

    def submit(self, work: Callable[[Any, Worker], Any], part: Any) -> Future:
        """Have work(part, worker) done by a worker; where the executor is broken its error is what comes of it."""
        self._sent += 1
        try:
            return self.executor.submit(run_task, work, part, self._device, results_version(), self._sent)
        except BrokenExecutor as error:
            broken: Future[Any] = Future()
            broken.set_exception(error)
            return broken

    def count(self) -> int:
        """How many tasks run at a time; 4 where the executor does not say."""
        client = getattr(self.executor, "_client", None)  # Dask
        if client is not None and hasattr(client, "ncores"):
            return max(1, sum(client.ncores().values()))
        return max(1, int(getattr(self.executor, "_max_workers", 0) or 4))

    def renew(self, error: Exception) -> None:
        """A new pool for one that has lost a process, which ends all of it; DeviceError where it is the caller's."""
        if not self._is_pool:
            raise DeviceError(f"a worker of the executor has ended and it takes no more tasks ({error}); finished "
                              "views are kept: start the same command again") from error
        self.executor.shutdown(wait=True)
        self.executor = local_pool(self._device)

    def close(self) -> None:
        """End the executor, where it was made here, and let go of what threads of this process keep."""
        if self._is_own:
            self.executor.shutdown(wait=True)
        close_workers()


def local_pool(devices) -> ProcessPoolExecutor:
    """One spawned process for each device that `devices` means: an OpenCL context does not survive a fork."""
    from pagas_cl.runtime.allocations import limit_of

    limit_of(1)      # what the environment says of memory is refused here, once, and not by each worker
    usable = known_devices(devices)
    on_host = any(info.kind == "CPU" for info, *_ in usable)
    return ProcessPoolExecutor(len(usable) * shares(), multiprocessing.get_context("spawn"), initializer=_begin,
                               initargs=(on_host,))


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
    return client.get_executor(pure=False)
