"""Launches of units.cl: depths from scene units to the device's units, and back."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from pagas_cl.method.splat.constants import SHARED
from pagas_cl.runtime.memory import constant, download, release, upload
from pagas_cl.runtime.program import build
from pagas_cl.scene.sampling import scene_scale_of

_NONE_YET = np.array([np.inf, 0], np.float32)
_LEFT = np.float32, np.float32, np.float32, np.uint8      # depth, parallax, deviation, status


def room_for(shape: tuple[int, ...]) -> Future[list[np.ndarray]]:
    """Arrays of `shape` for what NormalizedDepth.denormalize leaves, promised: the system takes longer to give memory
    that nobody has touched than the device to fill it, and does so meanwhile."""
    thread = ThreadPoolExecutor(1)
    arrays = thread.submit(lambda: [np.full(shape, 0, dtype) for dtype in _LEFT])
    thread.shutdown(wait=False)      # it ends with its work
    return arrays


@dataclass(frozen=True)
class Start:
    """Where steps start from in place of the initial depth, on the device in scene units: `depth`; and `agreed`, which
    of depth, parallax, deviation and status, on the device, makes those that are given back, in `nbytes` more; `into()`
    gives arrays for these on the host, in this order."""

    depth: cl.Buffer
    agreed: Callable[..., tuple[cl.Buffer, ...]]
    nbytes: int
    into: Callable[[], Sequence[np.ndarray]]


class NormalizedDepth:
    """The initial depth of a view on the device, in units of its median: made once for measuring and for refining.

    Depths outside NEAR to FAR units, masked out or not finite have no Gaussian. `scene_scale`: scene units per device
    unit; `nearest` and `farthest` valid depth, units, and the `depth_range` between them; `given` and `buffer`: float32
    of shape (H, W), in scene units as given, and in units, 0 = no surface. Where `depth` is on the device already,
    `given` is that buffer, its owner's, and `scene_scale` what a view without a mask has."""

    def __init__(self, target, depth: np.ndarray, device, given: cl.Buffer | None = None, scene_scale: float = 0.0):
        depth = np.ascontiguousarray(depth if depth.dtype in (np.float32, np.float64) else depth.astype(np.float32))
        mask = target.load_mask()
        self.scene_scale = scene_scale if scene_scale and mask is None else scene_scale_of(depth, mask)
        self._device, self._own, self._program = device, given is None, build(device, "units.cl", SHARED)
        self.is_released = False
        with np.errstate(over="ignore"):
            self.given = upload(device, depth.astype(np.float32, copy=False)) if given is None else given
        doubles = depth.dtype == np.float64          # rounded once, after the division
        if doubles:
            with np.errstate(over="ignore", invalid="ignore"):
                self.buffer = upload(device, (depth / self.scene_scale).astype(np.float32))
        else:
            self.buffer = device.buffer(4 * depth.size)
        visible = None if mask is None else upload(device, mask.astype(bool, copy=False))
        bounds = device.buffer(8)
        cl.enqueue_copy(device.queue, bounds, constant(device, _NONE_YET))
        self._program.run("normalize_depth", (depth.size,), given=self.given, visible=visible, count=depth.size,
                          scene_scale=self._device_scale(), scaled=int(doubles), depth=self.buffer, bounds=bounds)
        self.nearest, self.farthest = download(device, bounds, 2)
        self.depth_range = max(0.0, float(self.farthest - self.nearest))
        release(visible, bounds)

    def start_from(self, start: cl.Buffer, depth, count: int):
        """Put into `depth`, a buffer in units, what `start` has in scene units, where both have one."""
        self._program.run("start_from", (count,), start=start, count=count, scene_scale=self._device_scale(),
                          depth=depth)

    def denormalize(self, refined, parallax, status, deviation, into: Sequence[np.ndarray],
                    start: Start | None = None) -> Sequence[np.ndarray]:
        """(depth, parallax, deviation, status) on the host, scene units, from the buffers in units; what `start` makes
        of them where it is given. In the arrays `into`, float32 and uint8 of shape (H, W). Once. A depth that was not
        refined comes back with the bits that it came with; a surface without a Gaussian counts as kept."""
        n = into[0].size
        self._program.run("denormalize_depth", (n,), given=self.given, count=n, scene_scale=self._device_scale(),
                          depth=refined, parallax=parallax, status=status, deviation=deviation)
        found = (refined, parallax, deviation, status)
        for array, buffer in zip(into, start.agreed(*found) if start else found):
            cl.enqueue_copy(self._device.queue, array, buffer)
        return into

    def release(self) -> None:
        if self._own:
            self.given.release()
        self.buffer.release()
        self.is_released = True

    def _device_scale(self) -> float:
        """As the device counts: where it is too large for that, so is every depth."""
        return min(self.scene_scale, float(np.finfo(np.float32).max))


class WhenNeeded:
    """What `make()` gives, called: the same NormalizedDepth until that is released, whose buffers serve others then."""

    def __init__(self, make: Callable[[], NormalizedDepth]):
        self._make, self._made = make, None

    def __call__(self) -> NormalizedDepth:
        if self._made is None or self._made.is_released:
            self._made = self._make()
        return self._made
