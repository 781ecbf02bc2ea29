"""Photos on the device: all of them, each uploaded once, or one at a time."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import pyopencl as cl

from pagas_cl.runtime.device import working
from pagas_cl.runtime.memory import Held
from pagas_cl.scene.camera import Size

PHOTO_MARGIN = 16         # pixels behind a photo that may be read
_READERS = 8              # photos read at a time
_ON_A_CPU = 256 << 20     # bytes kept of what other views may want, where the device's memory is the host's
_AHEAD = 1 << 30          # most bytes of photos that are read before they are needed


class PhotoStore(Held):
    """Photos on the device, 8-bit RGB with validity in the fourth channel; each one uploaded once. Full-size photos are
    held, and so are depth maps that views are compared with."""

    def __init__(self, device) -> None:
        self.device, self.on_host = device, device.info.kind == "CPU"
        super().__init__(min(device.memory.limit // 4, _ON_A_CPU if self.on_host else device.memory.limit))
        self._ahead: dict[Any, Future[np.ndarray]] = {}                # by view

    def photo(self, view) -> cl.Buffer:
        """Buffer of (height, width) uchar4 of `view`, a pagas_cl.scene.view.View."""
        def send() -> cl.Buffer:
            pixels = self._ahead.pop(view).result() if view in self._ahead else _read(view)
            buffer = photo_buffer(self.device, size)
            cl.enqueue_copy(self.device.queue, buffer, pixels)
            return buffer

        size = view.camera.size.pixels
        return self.held(view, photo_bytes(size), send)

    def read_ahead(self, view, readers: Executor) -> None:
        """Have `readers` read the photo of `view`, for `photo`; not where it is here, or too much waits already."""
        waiting = sum(photo_bytes(other.camera.size.pixels) for other in self._ahead)
        if not (self.has(view) or view in self._ahead or waiting > _AHEAD):
            self._ahead[view] = readers.submit(_read, view)

    def replace(self, views, others) -> None:
        """What is held for each of `views` serves the one of `others` in its place."""
        for view, other in zip(views, others):
            if view in self._held:
                self._held[other] = self._held.pop(view)

    def has(self, view) -> bool:
        return view in self._held

    def forget(self, owners) -> None:
        """Let go of what is held for `owners`, and so of them; what else may serve is given back."""
        for owner in owners:
            self._ahead.pop(owner, None)
            if owner in self._held:
                self._held.pop(owner)[0].release()

    def level(self, views, sizes: list[Size], resampler):
        """Photos of `views` at `sizes` on the device, none on the host; several are read at a time where that idles."""
        new = [] if self.on_host else [view for view in dict.fromkeys(views) if not self.has(view)]
        with ThreadPoolExecutor(_READERS) as readers:
            for k in range(0, len(new), _READERS):
                for view in new[k:k + _READERS]:
                    self.read_ahead(view, readers)
                for view in new[k:k + _READERS]:
                    self.photo(view)
        return [_resized(resampler, self.photo(view), view.camera.size, size)
                for view, size in zip(views, sizes)], ()

    def clear(self) -> None:
        """Forget every photo, and the buffers that wait for another view."""
        self._held.clear()
        self._ahead.clear()
        self.device.memory.clear()

    def renewed(self) -> "PhotoStore":
        """Itself with nothing in it, on its device, opened anew where it has failed; DeviceError where it cannot be."""
        self._held.clear()
        self._ahead.clear()
        self.device = working(self.device)
        return self

    def bytes_of_others(self, views) -> int:
        """Bytes of what is here and is not of `views`."""
        return sum(self._held[owner][1] for owner in self._held.keys() - set(views))

    def trim(self, nbytes: int):
        """Keep no more photos than leave room for `nbytes` of other buffers."""
        self.limit = max(0, min(self.limit, self.device.memory.limit - nbytes))
        self._make_room(0)


@contextmanager
def reading_ahead(views: Sequence[Any], photos: PhotoStore | None) -> Iterator[None]:
    """Context in which the photos of these views are read for `photos`, where the device leaves the host idle."""
    with ThreadPoolExecutor(_READERS) as readers:
        for view in views if photos is not None and not photos.on_host else ():
            photos.read_ahead(view, readers)
        yield


class StreamedPhotos(PhotoStore):
    """Where the device has little memory: photos stay on the host, and are copied to one place on the device."""

    def __init__(self, device) -> None:
        super().__init__(device)
        self._pixels: dict[int, tuple] = {}

    def level(self, views, sizes: list[Size], resampler):
        """Buffers of the photos of `views` at `sizes`, all but the first one the same, and what each is filled with."""
        place = photo_buffer(resampler.device, max((size.pixels for size in sizes[1:]), default=1))
        target = self._at(views[0], sizes[0], resampler)
        host = tuple(self._on_host(view, size, resampler) for view, size in zip(views[1:], sizes[1:]))
        return [target, *[place] * len(host)], host

    def _at(self, view, size: Size, resampler) -> cl.Buffer:
        buffer = photo_buffer(resampler.device, view.camera.size.pixels)
        cl.enqueue_copy(resampler.device.queue, buffer, self._full(view))
        return _resized(resampler, buffer, view.camera.size, size)

    def _on_host(self, view, size: Size, resampler) -> np.ndarray:
        if size == view.camera.size:
            return self._full(view)
        pixels = np.empty((*size.shape, 4), np.uint8)
        cl.enqueue_copy(resampler.device.queue, pixels, self._at(view, size, resampler))
        return pixels

    def _full(self, view) -> np.ndarray:
        if id(view) not in self._pixels:
            self._pixels[id(view)] = view, _read(view)
        return self._pixels[id(view)][1]


def _read(view) -> np.ndarray:
    return rgba(view.load_image(), view.load_mask())


def _resized(resampler, source: cl.Buffer, size: Size, to: Size) -> cl.Buffer:
    """A photo at the size `to`; `source` itself where nothing changes."""
    if size == to:
        return source
    out = photo_buffer(resampler.device, to.pixels)
    resampler.shrink_photo(source, size, out, to)
    return out


def photo_buffer(device, pixels: int) -> cl.Buffer:
    """Room for a photo of `pixels`, and for what vector reads touch behind it."""
    return device.buffer(photo_bytes(pixels))


def photo_bytes(pixels: int) -> int:
    return 4 * (pixels + PHOTO_MARGIN)


def rgba(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """uint8 of shape (height, width, 4): colour and validity (255 or 0)."""
    pixels = np.empty((*image.shape[:2], 4), np.uint8)
    for channel in range(3):        # four times as fast as all three in one
        pixels[..., channel] = image[..., channel]
    pixels[..., 3] = 255 if mask is None else np.where(mask, 255, 0)
    return pixels
