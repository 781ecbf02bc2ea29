"""The buffers of this process on a device: each is counted while it lives, and none is made beyond what is allowed.

Buffers that are given back wait for the next of their size and role: a driver takes half a millisecond for each that it
frees, and views of one size need the same ones again.
"""

import os

import pyopencl as cl

from pagas_cl.errors import DeviceMemoryError
from pagas_cl.runtime.info import number_in

ENVIRONMENT = "PAGAS_CL_MEMORY"      # most MB (1e6 bytes) of device memory that a process may take


class Memory:
    """Buffers of one device.

    `title` is the device's name, for messages. Bytes: `limit` allowed, `held` now, `peak` at most since `begin`, and
    `waiting` in buffers that were given back and are kept, as long as all together are no more than what is planned, or
    than the share `spare` of the limit.
    """

    def __init__(self, title: str, limit: int, spare: float = 0.0):
        self.title = title
        self.limit = limit
        self.spare = spare
        self.held = self.peak = self.waiting = self._planned = 0
        self._kept: list[_Counted] = []         # buffers that wait, the one that has waited longest first

    def buffer(self, context: cl.Context, nbytes: int, role: str = "") -> "_Counted":
        """A buffer for reading and writing; what is in it is left over from whatever it served before.

        One that has served in the `role` is taken again, so that kernels find it where it was. DeviceMemoryError where
        it would exceed the limit, or the driver refuses it.
        """
        if self.held + nbytes > self.limit:
            raise DeviceMemoryError(f"{self.title} may hold {_mb(self.limit)} MB, {_mb(self.held)} MB are taken and "
                                    f"{_mb(nbytes)} MB more are needed")
        place = next((k for k, kept in enumerate(self._kept) if (kept.role, kept.nbytes) == (role, nbytes)), None)
        if place is not None:
            buffer = self._taken(place)
            buffer.count()
            return buffer
        self._free(self._most - nbytes)
        try:
            return _Counted(self, context, nbytes, role)
        except cl.Error as error:
            if self.waiting:
                self.clear()
                return self.buffer(context, nbytes, role)
            raise DeviceMemoryError(f"{self.title} refused {_mb(nbytes)} MB ({error}) next to the {_mb(self.held)} MB "
                                    "that it holds") from error

    def begin(self, planned: int) -> None:
        """Count the peak from here on; `planned` bytes in all will do, what waits included."""
        self.peak = self.held
        self._planned = min(self.limit, planned)
        self._free(self._most)

    @property
    def _most(self) -> int:
        return max(self._planned, int(self.spare * self.limit))

    def count(self, nbytes: int) -> None:
        self.held += nbytes
        self.peak = max(self.peak, self.held)

    def keep(self, buffer: "_Counted") -> None:
        """Take back a buffer that nothing enqueued later will use."""
        self._kept.append(buffer)
        self.waiting += buffer.nbytes

    def _taken(self, place: int) -> "_Counted":
        buffer = self._kept.pop(place)
        self.waiting -= buffer.nbytes
        return buffer

    def clear(self) -> None:
        """Let the driver have every buffer that waits."""
        self._free(0)

    def _free(self, most: int) -> None:
        """Let the driver have kept buffers, until no more than `most` bytes are held and kept."""
        while self._kept and self.held + self.waiting > most:
            self._taken(0)


class _Counted(cl.Buffer):
    """A buffer that is counted from its making until it is released or dropped."""

    _counted = 0     # also of one in whose making Ctrl-C was pressed

    def __init__(self, memory: Memory, context: cl.Context, nbytes: int, role: str):
        self._memory, self.role, self.nbytes = memory, role, nbytes
        super().__init__(context, cl.mem_flags.READ_WRITE, nbytes)
        self.count()

    def count(self) -> None:
        self._counted = self.nbytes
        self._memory.count(self._counted)

    def release(self) -> None:
        """Give it back; once, however often this is called."""
        if self._counted:
            self._forget()
            self._memory.keep(self)

    def __del__(self) -> None:
        if self._counted:
            self._forget()

    def _forget(self) -> None:
        self._memory.count(-self._counted)
        self._counted = 0


def limit_of(total: int, processes: int = 1) -> int:
    """Bytes that this process may take of a device with `total`: its share, or what PAGAS_CL_MEMORY allows."""
    if not os.environ.get(ENVIRONMENT):
        return total // processes
    allowed = number_in(ENVIRONMENT, "", "megabytes above 0", lambda megabytes: 0 < megabytes < float("inf"))
    return min(int(allowed * 1e6), total)


def _mb(nbytes: int) -> str:
    return f"{nbytes / 1e6:.2g}" if 1e5 <= nbytes < 10e6 else f"{nbytes / 1e6:,.0f}"
