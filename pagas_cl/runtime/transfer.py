"""Arrays from the host to a device and back, one at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pyopencl as cl

if TYPE_CHECKING:
    from pagas_cl.runtime.device import Device


def upload(device: Device, array: np.ndarray) -> cl.Buffer:
    """A buffer that holds `array`, by rows, as the kernels read it."""
    buffer = device.memory.buffer(device.context, array.nbytes)
    cl.enqueue_copy(device.queue, buffer, np.ascontiguousarray(array))
    return buffer


def download(device: Device, buffer: cl.Buffer, shape: int | tuple[int, ...],
             dtype: npt.DTypeLike = np.float32) -> np.ndarray:
    """A copy of `buffer` as an array of `shape`; waits for what is enqueued before it."""
    out = np.empty(shape, dtype)
    cl.enqueue_copy(device.queue, out, buffer)
    return out
