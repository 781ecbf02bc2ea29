"""Photos for a device with little memory: kept on the host, on the device one at a time."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from pagas_cl.splat.state import Size, photo_buffer, rgba


class StreamedPhotos:
    """Stands in for a PhotoStore: the kernels read the same bytes, from one place that each photo is copied to."""

    def __init__(self, device):
        self.device = device
        self._pixels: dict[int, tuple] = {}

    def level(self, views, sizes: list[Size], resampler):
        """Buffers of the photos of `views` at `sizes`, all but the first one the same, and what each is filled with."""
        place = photo_buffer(self.device, max((size.pixels for size in sizes[1:]), default=1))
        target = self._at(views[0], sizes[0], resampler)
        host = tuple(self._on_host(view, size, resampler) for view, size in zip(views[1:], sizes[1:]))
        return [target, *[place] * len(host)], host

    def beside(self, views) -> int:
        """No photos are kept."""
        return 0

    def trim(self, nbytes: int):
        """No photos are kept."""

    def _at(self, view, size: Size, resampler) -> cl.Buffer:
        full = Size(view.camera.width, view.camera.height)
        buffer = photo_buffer(self.device, full.pixels)
        cl.enqueue_copy(self.device.queue, buffer, self._full(view))
        return resampler.photo(buffer, full, size)

    def _on_host(self, view, size: Size, resampler) -> np.ndarray:
        if size == Size(view.camera.width, view.camera.height):
            return self._full(view)
        pixels = np.empty((size.height, size.width, 4), np.uint8)
        cl.enqueue_copy(self.device.queue, pixels, self._at(view, size, resampler))
        return pixels

    def _full(self, view) -> np.ndarray:
        if id(view) not in self._pixels:
            self._pixels[id(view)] = view, rgba(view.load_image(), view.load_mask())
        return self._pixels[id(view)][1]
