"""Where tasks run: in this process, in one process a device, or on somebody's cluster."""

from __future__ import annotations

import multiprocessing
import signal
from concurrent.futures import Executor, Future, ProcessPoolExecutor

from pagas_cl.errors import DeviceError, need

PATIENCE = 20  # seconds to wait for a scheduler's answer


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
    """One process for each device of this machine that `devices` means ("all", or part of names); each takes its own.

    Processes are spawned: an OpenCL context does not survive a fork.
    """
    from pagas_cl.runtime.claim import known_devices
    from pagas_cl.runtime.device import shares

    number = len(known_devices(devices)) * shares()
    return ProcessPoolExecutor(number, multiprocessing.get_context("spawn"), initializer=_ignore_interrupts)


def dask_executor(address: str) -> Executor:
    """The executor of a running Dask cluster, such as "tcp://host:8786"."""
    distributed = need("distributed", "cluster", "running on a Dask cluster")
    try:
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise DeviceError(f"no Dask scheduler answers at {address!r} ({str(error).splitlines()[0]}): start one with "
                          "'dask scheduler' and workers with 'dask worker --nthreads 1 ADDRESS'") from error
    return client.get_executor(pure=False)


def worker_count(executor) -> int:
    """How many tasks the executor runs at a time, as far as it tells; 4 where it does not."""
    client = getattr(executor, "_client", None)  # Dask
    if client is not None and hasattr(client, "ncores"):
        return max(1, sum(client.ncores().values()))
    return max(1, int(getattr(executor, "_max_workers", 0) or 4))


def _ignore_interrupts() -> None:
    """Ctrl-C reaches every process of a terminal; the first one asks the workers to end after their present view."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
