"""Refine the depth map of one view: a pure function of target, contexts, depth and settings (method section 7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.scene.rig import distance_unit
from pagas_cl.splat.level import Level, LevelInput
from pagas_cl.splat.resample import Resampler
from pagas_cl.splat.state import PhotoStore, Size, level_size, normalized_depth


@dataclass(frozen=True, eq=False)
class Refinement:
    """What the levels leave, arrays of the target's full size.

    Attributes
    ----------
    depth : ndarray of shape (H, W), float32
        Refined depth in scene units, 0 = no surface.
    parallax : ndarray of shape (H, W), float32
        Depth change that moves a pixel by one pixel in the context views, scene units; 0 where none sees it.
    steps : tuple of int
        Steps done at each level.
    losses : list of float
        Loss of each step, where the schedule follows it.
    device_bytes : int
        Most memory taken on the device by one level, photos included.
    """

    depth: np.ndarray
    parallax: np.ndarray
    steps: tuple[int, ...]
    losses: list[float]
    device_bytes: int


def refine_levels(target, contexts, depth: np.ndarray, config: Config, device, photos: PhotoStore | None = None,
                  progress=None) -> Refinement:
    """Run the pyramid on one view.

    Parameters
    ----------
    target : View
    contexts : list of View
        At least one.
    depth : ndarray of shape (H, W)
        Initial z-depth in scene units, 0 = no surface.
    photos : PhotoStore
        Photos already on the device; a new store by default.
    """
    photos = photos or PhotoStore(device)
    resampler, queue = Resampler(device, config), device.queue
    initial, unit = normalized_depth(depth, target.load_mask())
    full = Size(target.camera.width, target.camera.height)
    entered = cl.Buffer(device.context, cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=initial)
    inputs = _Inputs(target, contexts, config, unit, initial, photos, resampler)

    level, done, losses, most = None, [], [], 0
    for scale, steps in zip(config.pyramid.scales, config.pyramid.steps):
        before, given = level, inputs.at(scale)
        size = given.sizes[0]

        def write_initial(out, size=size):
            resampler.shrink_depth(entered, full, out, size)

        def write_start(out, size=size, before=before):
            if before is not None:
                at_size = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 4 * size.pixels)
                resampler.shrink_depth(entered, full, at_size, size)
                resampler.enlarge_depth(before.arena["depth"], before.target, at_size, out, size)

        level = Level(device, config, given, write_initial, write_start)
        if before is not None:
            before.release()
        done.append(level.run(steps, progress))
        most = max(most, level.arena.nbytes + sum(photo.size for photo in given.photos))
        if "history" in level.arena:
            losses += level.read("history", level.arena.specs["history"].shape)[:done[-1]].tolist()
    refined = level.read("depth", depth.shape).astype(np.float64) * unit
    parallax = level.read("unit", depth.shape) * np.float32(unit)
    level.release()
    queue.finish()
    return Refinement(_untouched_exact(refined, depth, initial), parallax, tuple(done), losses, most)


def _untouched_exact(refined, depth, initial) -> np.ndarray:
    """Back to scene units; a depth without a Gaussian comes back with the bits that it came with."""
    valid = initial > 0
    return np.where(valid, refined, np.where(np.isfinite(depth), depth, 0)).astype(np.float32)


class _Inputs:
    """Cameras and photos of a view at any level."""

    def __init__(self, target, contexts, config, unit, initial, photos, resampler):
        self.views, self.unit, self.photos, self.resampler = [target, *contexts], unit, photos, resampler
        valid = initial[initial > 0]
        spread = float(valid.max() - valid.min()) if valid.size else 0.0
        self.threshold = spread / config.splatting.depth_slices
        distance = distance_unit([view.camera for view in self.views]) / unit
        self.distance = distance if np.isfinite(distance) else 1.0

    def at(self, scale: float) -> LevelInput:
        cameras, photos = [], []
        for view in self.views:
            full, size = Size(view.camera.width, view.camera.height), level_size(view.camera, scale)
            cameras.append(view.camera.resized(size.width, size.height))
            photos.append(self.resampler.photo(self.photos.photo(view), full, size))
        return LevelInput(cameras, photos, self.unit, self.threshold, self.distance)
