"""What the device holds for one level: cameras, photos and every buffer, planned before it is allocated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.runtime.arena import Arena, BufferSpec
from pagas_cl.scene.camera import Camera
from pagas_cl.splat import exposure
from pagas_cl.splat import tile as tiles
from pagas_cl.splat.options import reach
from pagas_cl.splat.smooth import SUM_GROUPS

NO_HEAD = np.int32(-1)    # of an empty bin (alpha.cl)
PHOTO_MARGIN = 16         # pixels behind a photo that may be read


@dataclass(frozen=True)
class Size:
    """Width and height of an image in pixels."""

    width: int
    height: int

    @property
    def pixels(self) -> int:
        return self.width * self.height

    @property
    def grid(self) -> tuple[int, int]:
        return self.width, self.height


def level_size(camera: Camera, scale: float) -> Size:
    """Image size of `camera` at the pyramid level `scale`."""
    return Size(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def level_buffers(config: Config, target: Size, contexts: list[Size], masked: int) -> list[BufferSpec]:
    """Every buffer of a level except photos: per target pixel, one view's scratch, `masked` unseen masks."""
    n, m = target.pixels, max(size.pixels for size in (*contexts, target))
    channels = 1 if config.loss.grey else 3
    specs = [BufferSpec(name, (n,), np.float32)
             for name in ("depth", "depth_per_parallax", "gradient", "first", "second")]
    specs += [BufferSpec("cameras", (1 + len(contexts), 20), np.float32), BufferSpec("state", (8,), np.float32)]
    specs += [BufferSpec(name, (m, channels + 1), np.float32) for name in ("rendered", "v_rendered")]
    if config.loss.ssim > 0:
        rows = max(tiles.pitch(size.width) * size.height for size in (*contexts, target))
        specs.append(BufferSpec("partials", (3 * channels * rows + 2 * tiles.MARGIN,), np.float32))
    if config.solver.gradient_filter > 0:
        specs.append(BufferSpec("sums", (n,), np.float32))
    if config.splatting.occlusion:
        specs.append(BufferSpec("z_first", (m,), np.uint32))
    if config.splatting.blend == "alpha":
        specs += _list_buffers(config, n, (*contexts, target))
    if config.smoothness.kind != "none":
        specs += [BufferSpec(name, (n,), np.float32) for name in ("kappa", "weights")]
    if config.smoothness.kind != "none" and config.smoothness.specularity > 0:
        specs.append(BufferSpec("raised", (2 * exposure.MOST_SAMPLES,), np.float32))
    if config.smoothness.kind == "normal":
        specs += [BufferSpec(name, (n, 4), np.float32) for name in ("normals", "slopes")]
    if config.loss.exposure:
        specs += exposure.buffers(target, masked)
    if config.loss.unseen_mask:
        specs += [BufferSpec(f"seen{k}", (size.pixels // 32 + 2,), np.uint32)
                  for k, size in enumerate(contexts[:masked])]
    if config.solver.patience > 0:
        specs.append(BufferSpec("loss", (1,), np.int64))
        if config.smoothness.kind != "none":
            specs.append(BufferSpec("smooth_losses", (SUM_GROUPS,), np.float32))
        specs += [BufferSpec("history", (max(config.pyramid.steps) + 1,), np.float32)]
    return specs


def _list_buffers(config: Config, n: int, sizes) -> list[BufferSpec]:
    border = 2 * reach(config.splatting.radius) + 1
    bins = max((s.width + border) * (s.height + border) for s in sizes)
    return [BufferSpec("heads", (bins,), np.int32), BufferSpec("links", (n, 2), np.int32),
            BufferSpec("alphas", (border**2, n), np.float32)]


class PhotoStore:
    """Photos on the device, 8-bit RGB with validity in the fourth channel; each one uploaded once.

    Full-size photos stay until `limit_bytes` is reached, then the one unused for longest goes.
    """

    def __init__(self, device, limit_bytes: int | None = None):
        self.device, self.limit = device, limit_bytes or device.memory.limit // 4
        self._photos: dict[object, cl.Buffer] = {}

    def photo(self, view) -> cl.Buffer:
        """Buffer of (height, width) uchar4 of `view`, a pagas_cl.scene.view.View."""
        key = id(view)
        held = self._photos.pop(key, None)
        if held is None:
            pixels = rgba(view.load_image(), view.load_mask())
            self._make_room(pixels.nbytes)
            held = (view, photo_buffer(self.device, view.camera.width * view.camera.height))
            cl.enqueue_copy(self.device.queue, held[1], pixels)
        self._photos[key] = held       # last in the order of use; the view is held so that its id stays its own
        return held[1]

    def level(self, views, sizes: list[Size], resampler):
        """Photos of `views` at `sizes`, all on the device; none on the host (see streamed.StreamedPhotos)."""
        return [resampler.photo(self.photo(view), Size(view.camera.width, view.camera.height), size)
                for view, size in zip(views, sizes)], ()

    def clear(self) -> None:
        """Forget every photo, and the buffers that wait for another view."""
        self._photos.clear()
        self.device.memory.clear()

    def beside(self, views) -> int:
        """Bytes of the photos that are here and are not of `views`."""
        own = {id(view) for view in views}
        return sum(buffer.size for view, buffer in self._photos.values() if id(view) not in own)

    def trim(self, nbytes: int):
        """Keep no more photos than leave room for `nbytes` of other buffers."""
        self.limit = max(0, min(self.limit, self.device.memory.limit - nbytes))
        self._make_room(0)

    def _make_room(self, nbytes: int):
        while self._photos and sum(buffer.size for _, buffer in self._photos.values()) + nbytes > self.limit:
            self._photos.pop(next(iter(self._photos)))


def photo_buffer(device, pixels: int) -> cl.Buffer:
    """Room for a photo of `pixels`, and for what vector reads touch behind it."""
    return device.memory.buffer(device.context, photo_bytes(pixels))


def photo_bytes(pixels: int) -> int:
    """Bytes of `photo_buffer`."""
    return 4 * (pixels + PHOTO_MARGIN)


def rgba(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """uint8 of shape (height, width, 4): colour and validity (255 or 0)."""
    pixels = np.empty((*image.shape[:2], 4), np.uint8)
    pixels[..., :3] = image
    pixels[..., 3] = 255 if mask is None else np.where(mask, 255, 0)
    return pixels


def allocate(device, config: Config, target: Size, contexts: list[Size], masked: int) -> Arena:
    """The level's arena, every buffer zeroed where the kernels add to it, bins empty."""
    arena = Arena(device, level_buffers(config, target, contexts, masked))
    empty = dict.fromkeys(("gradient", "first", "second", "state", "loss"), np.uint32(0)) | {"heads": NO_HEAD}
    for name in empty:
        if name in arena:
            cl.enqueue_fill_buffer(device.queue, arena[name], empty[name], 0, arena.size(name))
    return arena
