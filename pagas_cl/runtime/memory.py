"""What a device holds of ours: every buffer is counted while it lives, and none is made beyond what is allowed."""

from __future__ import annotations

import os

import pyopencl as cl

from pagas_cl.errors import DeviceMemoryError, InputError

ENVIRONMENT = "PAGAS_CL_MEMORY"      # most MB of device memory that a process may take


class Memory:
    """Buffers of one device.

    Attributes
    ----------
    title : str
        The device's name, for messages.
    limit, held, peak : int
        Bytes allowed, held now, and held at most since `begin`.
    """

    def __init__(self, title: str, limit: int):
        self.title, self.limit, self.held, self.peak = title, limit, 0, 0

    def buffer(self, context, nbytes: int) -> cl.Buffer:
        """A buffer for reading and writing.

        Raises
        ------
        DeviceMemoryError
            It would exceed the limit, or the driver refuses it.
        """
        if self.held + nbytes > self.limit:
            raise DeviceMemoryError(f"{self.title} may hold {_mb(self.limit)} MB, {_mb(self.held)} MB are taken and "
                                    f"{_mb(nbytes)} MB more are needed")
        try:
            return _Counted(self, context, nbytes)
        except cl.Error as error:
            raise DeviceMemoryError(f"{self.title} refused {_mb(nbytes)} MB ({error}) beside the {_mb(self.held)} MB "
                                    "that it holds") from error

    def begin(self) -> None:
        """Count the peak from here on."""
        self.peak = self.held

    def count(self, nbytes: int) -> None:
        self.held += nbytes
        self.peak = max(self.peak, self.held)


class _Counted(cl.Buffer):
    """A buffer that is counted from its making until it is released or dropped."""

    def __init__(self, memory: Memory, context, nbytes: int):
        self._memory, self._counted = memory, 0
        super().__init__(context, cl.mem_flags.READ_WRITE, nbytes)
        self._counted = nbytes
        memory.count(nbytes)

    def release(self):
        self._forget()
        super().release()

    def __del__(self):
        self._forget()

    def _forget(self):
        self._memory.count(-self._counted)
        self._counted = 0


def limit_of(total: int, processes: int = 1) -> int:
    """Bytes that this process may take of a device with `total`: its share, or what PAGAS_CL_MEMORY allows."""
    text = os.environ.get(ENVIRONMENT, "")
    if not text:
        return total // processes
    try:
        asked = float(text)
    except ValueError:
        asked = 0.0
    if not 0 < asked < float("inf"):
        raise InputError(f"environment variable {ENVIRONMENT} is {text!r}, expected megabytes above 0")
    return min(int(asked * 1e6), total)


def _mb(nbytes: int) -> str:
    return f"{nbytes / 1e6:,.0f}"
