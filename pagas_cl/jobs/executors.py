"""Where tasks run: in this process, in one process a device, or on somebody's cluster."""

import multiprocessing
import re
import signal
from concurrent.futures import Executor, Future, ProcessPoolExecutor

from pagas_cl.errors import DeviceError, InputError, need
from pagas_cl.jobs.worker import follow_parent
from pagas_cl.runtime.claim import known_devices
from pagas_cl.runtime.device import elsewhere, open_device, shares

PATIENCE = 20  # seconds to wait for a scheduler's answer


class Workers:
    """An executor and the device that its tasks are to take; arguments as in whole.refine_all. `device` is what the
    workers are told: this process opens its device here, others choose from what is named. `own`: the executor is ours
    to close; `local`: tasks run in this process, one after another."""

    def __init__(self, executor, device):
        self._pooled = executor is None and elsewhere(executor, device)
        self.own, self.local = executor is None or isinstance(executor, str), executor is None and not self._pooled
        self.device = tuple(device) if isinstance(device, list) else device
        if self.local:
            self.executor, self.device = SerialExecutor(), open_device(device)
        elif self._pooled:
            self.executor = local_pool(device)
        else:
            self.executor = dask_executor(executor) if isinstance(executor, str) else executor

    def count(self) -> int:
        """How many tasks run at a time elsewhere, 0 where they run here; 4 where the executor does not tell."""
        if self.local:
            return 0
        client = getattr(self.executor, "_client", None)  # Dask
        if client is not None and hasattr(client, "ncores"):
            return max(1, sum(client.ncores().values()))
        return max(1, int(getattr(self.executor, "_max_workers", 0) or 4))

    def renew(self, error: Exception) -> None:
        """A new pool for one that has lost a process, which ends all of it; DeviceError where it was not ours."""
        if not self._pooled:
            raise DeviceError(f"a worker of the executor has ended and it takes no more tasks ({error}); finished "
                              "views are kept: start the same command again") from error
        self.executor.shutdown(wait=True)
        self.executor = local_pool(self.device)


class SerialExecutor(Executor):
    """Runs each task at once, in this process."""

    _max_workers = 1

    def submit(self, work, /, *arguments, **keywords) -> Future:
        future = Future()
        try:
            future.set_result(work(*arguments, **keywords))
        except Exception as error:
            future.set_exception(error)
        return future


def local_pool(devices) -> ProcessPoolExecutor:
    """One spawned process for each device that `devices` means: an OpenCL context does not survive a fork."""
    from pagas_cl.runtime.memory import limit_of

    limit_of(1)      # what the environment says of memory is refused here, once, and not by each worker
    number = len(known_devices(devices)) * shares()
    return ProcessPoolExecutor(number, multiprocessing.get_context("spawn"), initializer=_begin)


def _begin() -> None:
    """Ctrl-C reaches every process of a terminal: the first one asks the workers to end after their present view."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
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
