"""Photos and depth maps of all views on the device, at one size after another."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pagas_cl.config import Config
from pagas_cl.method.cameras.adjust import Adjuster, Frame
from pagas_cl.method.cameras.normalize import normalize_photo
from pagas_cl.method.splat.photos import PhotoStore
from pagas_cl.method.splat.resample import Resampler
from pagas_cl.method.surface.raster import each_depth
from pagas_cl.runtime.host import side_by_side
from pagas_cl.runtime.memory import upload
from pagas_cl.scene.camera import Camera, Size
from pagas_cl.scene.inputs import depth_array
from pagas_cl.scene.mesh import Surface
from pagas_cl.scene.meshes.kinds import to_surface
from pagas_cl.scene.view import View

Depths = Callable[[Sequence[Camera]], "list[np.ndarray]"]
SIGMA = 0.7               # pixels of a size by which photos are smoothed


def depths_of(given, device=None) -> tuple[Depths, bool]:
    """How to get depth maps for cameras, and whether they change with these: a mesh is drawn on `device`."""
    stack = isinstance(given, np.ndarray) and given.ndim == 3
    if isinstance(given, list) or stack or (isinstance(given, tuple) and not _is_pair(given)):
        def stay(cameras: Sequence[Camera]) -> list[np.ndarray]:
            return side_by_side(lambda k: np.zeros((cameras[k].height, cameras[k].width), np.float32)
                                if given[k] is None else depth_array(given[k]), range(len(given)))
        return stay, False
    surface: Surface = to_surface(given)

    def render(cameras: Sequence[Camera]) -> list[np.ndarray]:
        return list(each_depth(surface, cameras, device))
    return render, True


def _is_pair(given: tuple) -> bool:
    """Whether it is a mesh, (vertices, faces), and no depth maps."""
    return len(given) == 2 and all(np.ndim(part) == 2 and np.shape(part)[1] == 3 for part in given)


class Frames:
    """Makes frames of `views` at a share of the `finest` size, itself a share of theirs, and from coarser ones."""

    def __init__(self, adjuster: Adjuster, views: Sequence[View], depths: Depths, moves: bool, photos: PhotoStore,
                 finest: float = 1.0):
        self.adjuster, self.views, self.moves, self.photos = adjuster, views, moves, photos
        self.device, self.depths, self._finest = adjuster.device, depths, finest
        self._resampler = Resampler(self.device, Config())
        self._kept: list[np.ndarray] | None = None

    def at(self, cameras: Sequence[Camera], share: float, maps: np.ndarray | None = None) -> list[Frame]:
        """The views through full-size `cameras` at `share` of the finest size; `maps`: scales, shifts, (N, 2)."""
        small = [camera.scaled(self._finest * share) for camera in cameras]
        if self.moves:
            depths = self.depths(small)
        else:
            depths = self._kept = self._kept or self.depths(cameras)
        frames = []
        for k, (view, camera, depth) in enumerate(zip(self.views, small, depths)):
            full, size, photo = view.camera.size, camera.size, self.photos.photo(view)
            if full != size:
                photo, source = self.device.buffer(4 * size.pixels, "small"), photo
                self._resampler.shrink_photo(source, full, photo, size)
            normal, own = (self.device.buffer(4 * size.pixels, role) for role in ("normal", "depth"))
            normalize_photo(self.device, photo, size, SIGMA, normal)
            scaled = np.ascontiguousarray(depth / np.float32(self.adjuster.scene_scale), np.float32)
            scaled[~(np.isfinite(scaled) & (scaled > 0))] = 0
            whole = upload(self.device, scaled)
            self._resampler.shrink_depth(whole, Size(depth.shape[1], depth.shape[0]), own, size)
            whole.release()
            frames.append(Frame(camera, normal, own))
            if maps is not None:
                self.adjuster.rescale(frames[-1], *maps[k])
        return frames

    def carried(self, coarse: Sequence[Frame], initial: Sequence[Frame], fine: Sequence[Frame]) -> None:
        """Change the depths of `fine` as those of `coarse` were, from `initial` on; not where they come of a mesh."""
        if not self.moves:
            for frame, before, to in zip(coarse, initial, fine):
                self.adjuster.carry(frame, before.depth, to)


def through(frames: Sequence[Frame], cameras: Sequence[Camera]) -> list[Frame]:
    """The frames with other cameras, given at full size."""
    return [replace(frame, camera=camera.resized(*frame.size)) for frame, camera in zip(frames, cameras)]
