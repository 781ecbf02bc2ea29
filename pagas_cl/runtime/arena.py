"""Device buffers declared as data: named, summed and compared with the device before anything is allocated."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl

from pagas_cl.errors import DeviceError, DeviceMemoryError

if TYPE_CHECKING:
    from pagas_cl.runtime.device import Device

MOST_ELEMENTS = 2**31 - 1         # kernels count in 32 bits


@dataclass(frozen=True)
class BufferSpec:
    """One buffer: what it is called and what it holds."""

    name: str
    shape: tuple[int, ...]
    dtype: type

    @property
    def nbytes(self) -> int:
        return max(1, prod(self.shape)) * np.dtype(self.dtype).itemsize


def total_bytes(specs: Iterable[BufferSpec]) -> int:
    """Bytes that `specs` take together."""
    return sum(spec.nbytes for spec in specs)


class Arena:
    """The buffers of one level. One owner, released together.

    Raises
    ------
    DeviceError
        Before anything is allocated, where a buffer is larger than the device or the kernels can handle.
    DeviceMemoryError
        They are more than may be held, or the device refuses one; none is kept then.
    """

    def __init__(self, device: Device, specs: Sequence[BufferSpec]):
        self.specs = {spec.name: spec for spec in specs}
        largest = max(specs, key=lambda spec: spec.nbytes)
        limit = device.info.max_alloc
        if max(prod(spec.shape) for spec in specs) > MOST_ELEMENTS:
            raise DeviceError("a buffer needs more than 2^31 elements, which the kernels cannot count: refine smaller "
                              "images, or with a smaller splatting.radius")
        if largest.nbytes > limit:
            raise DeviceError(f"buffer {largest.name!r} needs {largest.nbytes / 2**20:.0f} MiB, {device.info.title} "
                              f"allocates at most {limit / 2**20:.0f} MiB at once; refine smaller images")
        self._buffers: dict[str, cl.Buffer] = {}
        try:
            for spec in specs:
                self._buffers[spec.name] = device.memory.buffer(device.context, spec.nbytes, spec.name)
        except DeviceMemoryError:
            self.release()
            raise

    @property
    def nbytes(self) -> int:
        return total_bytes(self.specs.values())

    def __getitem__(self, name: str) -> cl.Buffer:
        return self._buffers[name]

    def __contains__(self, name: str) -> bool:
        return name in self._buffers

    def size(self, name: str) -> int:
        """Bytes of the buffer `name`."""
        return self.specs[name].nbytes

    def take(self, name: str) -> cl.Buffer:
        """The buffer `name`, the caller's from now on."""
        return self._buffers.pop(name)

    def release(self, keep: Collection[str] = ()) -> None:
        """Give all buffers but those named in `keep` back now instead of when Python gets to it."""
        for name in [name for name in self._buffers if name not in keep]:
            self._buffers.pop(name).release()
