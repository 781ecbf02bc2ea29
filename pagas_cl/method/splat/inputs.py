"""What is worked on: a view and photos that constrain it; at one level, as the launchers take them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.method.splat.buffers import dimensions
from pagas_cl.method.splat.photos import PhotoStore
from pagas_cl.method.splat.units import NormalizedDepth, WhenNeeded
from pagas_cl.runtime.device import Device
from pagas_cl.runtime.memory import release
from pagas_cl.runtime.program import Fill, Launch, Upload
from pagas_cl.scene.camera import Camera, Size, camera_table, footprint
from pagas_cl.scene.view import View


@dataclass(frozen=True, eq=False)
class ViewInput:
    """One view to work on, and where: `depth` (H, W), z in scene units, 0 = no surface, of the `target`; `contexts`
    constrain it, views `held_out` judge. `photos` are on the `device`, or StreamedPhotos. `normalized()`: the depth on
    the device, made when first needed, until it is used up."""

    target: View
    contexts: Sequence[View]
    depth: np.ndarray
    device: Device
    photos: PhotoStore
    held_out: Sequence[View] = ()
    normalized: Callable[[], NormalizedDepth] = None

    def __post_init__(self) -> None:
        if self.normalized is None:
            made = WhenNeeded(partial(NormalizedDepth, self.target, self.depth, self.device))
            object.__setattr__(self, "normalized", made)

    @property
    def views(self) -> list[View]:
        """All of them, the target first, those that judge last."""
        return [self.target, *self.contexts, *self.held_out]

    def with_depth(self, depth: np.ndarray) -> "ViewInput":
        return replace(self, depth=depth, normalized=None)


@dataclass(frozen=True, eq=False)
class LevelView:
    """One photo to compare with, a context or held-out view's; or, as number 0, the target's own."""

    number: int                     # of the view, from 1; 0 is the target itself
    size: Size
    photo: cl.Buffer                # uchar4 per pixel
    depth_threshold: float          # of this view, device units (method section 4: δ_c)
    target_size: Size
    target_photo: cl.Buffer
    pixels: np.ndarray | None = None    # uint8 (H, W, 4) to fill `photo` with first, where several photos share it
    z_first: cl.Buffer | None = None    # a z-buffer of its own

    @cached_property
    def arguments(self) -> dict:
        given = {"view": self.number, "photo": self.photo, "target_photo": self.target_photo,
                 "depth_threshold": self.depth_threshold, **self.size.extent}
        if self.z_first:
            given["z_first"] = self.z_first
        return given

    def fetch(self) -> list:
        """What brings the photo to its buffer; nothing where it is there."""
        return [] if self.pixels is None else [Upload(self.photo, self.pixels)]


def enqueue_each(queue: cl.CommandQueue, views: Sequence[LevelView],
                 bind: Callable[[LevelView], list[Launch | Fill]], *given: dict) -> None:
    """For each of `views` its launches, with each of the arguments `given`: bound once a size, then changed."""
    bound: dict[Size, list[Launch | Fill]] = {}
    for view in views:
        for fetched in view.fetch():
            fetched.enqueue(queue)
        if view.size not in bound:
            bound[view.size] = bind(view)
        for one in given or ({},):
            for launch in bound[view.size]:
                launch.change(**one, view=view.number, photo=view.photo, depth_threshold=view.depth_threshold)
                launch.enqueue(queue)
    release(*chain(*bound.values()))


@dataclass(frozen=True)
class LevelInput:
    """The target first, then `contexts` context views, then views that only judge."""

    cameras: list[Camera]           # at the level's size
    photos: list[cl.Buffer]         # uchar4 per pixel, at the level's size
    scene_scale: float              # scene units per device unit
    depth_threshold: float          # of the target, device units (method section 4: δ)
    viewing_distance: float         # median distance of the cameras from the point they look at, device units
    contexts: int
    host: tuple = ()
    """uint8 (H, W, 4) of all views but the target's, where photos[1:] are one buffer that holds one photo at a time."""
    specularity: np.ndarray | None = None       # Measurements.local_specularity

    @cached_property
    def sizes(self) -> list[Size]:
        return [camera.size for camera in self.cameras]

    @property
    def camera_table(self) -> np.ndarray:
        """As the kernels read it: float32, 20 numbers a camera."""
        return camera_table(self.cameras[0], self.cameras[1:], self.scene_scale)

    def views(self, config: Config) -> list[LevelView]:
        """All of them, the target's own first: `number` is the place in the list. The depth threshold of each is at
        least `depth_footprints` of its pixels, or a slope would hide itself."""
        views = []
        for number, (camera, photo) in enumerate(zip(self.cameras, self.photos)):
            floor = config.splatting.depth_footprints * footprint(self.cameras[0], camera, self.scene_scale)
            pixels = self.host[number - 1] if self.host and number else None
            views.append(LevelView(number, self.sizes[number], photo, max(self.depth_threshold, floor), self.sizes[0],
                                   self.photos[0], pixels))
        return views

    def dimensions(self, config: Config) -> dict:
        """Of the buffers of a level, as buffers.py has them."""
        return dimensions(config, self.sizes[0], self.sizes[1:], self.contexts)
