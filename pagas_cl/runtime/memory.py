"""Arrays to a device and back."""

from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl

from pagas_cl.runtime.device import Device


class Held:
    """What is kept on a device, by its owner, until `limit`, in bytes, is reached: what is unused for longest goes."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._held: dict[Hashable, tuple[Any, int]] = {}        # by owner: what is on the device, bytes

    def held(self, owner: Hashable, nbytes: int, send: Callable[[], Any]) -> Any:
        """What `send()` brings to the device for `owner`, `nbytes` of it, when it is not there."""
        found = self._held.pop(owner, None)
        if found is None:
            self._make_room(nbytes)
            found = send(), nbytes
        self._held[owner] = found            # last in the order of use
        return found[0]

    def _make_room(self, nbytes: int) -> None:
        while self._held and sum(size for _, size in self._held.values()) + nbytes > self.limit:
            self._held.pop(next(iter(self._held)))


def upload(device: Device, array: np.ndarray) -> cl.Buffer:
    """A buffer that holds `array`, by rows, as the kernels read it."""
    buffer = device.buffer(array.nbytes)
    cl.enqueue_copy(device.queue, buffer, np.ascontiguousarray(array))
    return buffer


def release(*held: Any) -> None:
    """Give back buffers, launches, or what holds such, those that are not None."""
    for one in held:
        if one is not None:
            one.release()


def constant(device: Device, array: np.ndarray) -> cl.Buffer:
    """A buffer of the few numbers of `array`, to be read, made once a device: an upload waits for all before it."""
    key = array.tobytes()
    if key not in device.constants:
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
        device.constants[key] = cl.Buffer(device.context, flags, hostbuf=np.ascontiguousarray(array))
    made: cl.Buffer = device.constants[key]
    return made


def download(device: Device, buffer: cl.Buffer, shape: int | tuple[int, ...],
             dtype: npt.DTypeLike = np.float32) -> np.ndarray:
    """A copy of `buffer` as an array of `shape`; waits for what is enqueued before it."""
    out = np.empty(shape, dtype)
    cl.enqueue_copy(device.queue, out, buffer)
    return out
