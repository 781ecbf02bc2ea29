"""Launches of agreement.cl: refined depth maps of other views as evidence for one another (method section 8.1)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl

from pagas_cl.runtime.device import Device
from pagas_cl.runtime.memory import download, release, upload
from pagas_cl.runtime.program import Program, build
from pagas_cl.scene.camera import camera_table
from pagas_cl.scene.depthmap import REFINED
from pagas_cl.scene.sampling import NEAR

IN_COMMON = 0.3                      # share of their variance that views have in common and no average takes out
OWN_DEFINES = (f"IN_COMMON={IN_COMMON!r}f",)
_BINS, _PER_PIXEL = 4096, 1024.0     # differences up to 4 pixels of parallax
_LEAST = 100                         # differences from which the spread of a view is known
_SAMPLES = 20000                     # pixels of a view, about, in whole rows, that they are taken at
_LEAST_ROWS = 32                     # of a large view, that are spread over it
_AVERAGED = {"depth": 4, "deviation": 4, "status": 1}      # bytes of a pixel
_NORMAL = 0.6745                     # median of |x| where x has a standard deviation of 1


@dataclass(frozen=True, eq=False)
class DeviceMaps:
    """A DepthResult on the device, in scene units. What others compare with: `inverse` depths that photos confirm, 0
    for all others, and `deviation`; the rest for the view itself, where it is sent `whole`."""

    inverse: Any
    deviation: Any
    depth: Any = None
    parallax: Any = None
    status: Any = None

    @staticmethod
    def nbytes(pixels: int, whole: bool) -> int:
        return (17 if whole else 8) * pixels

    def release(self) -> None:
        release(*vars(self).values())


def send(result: Any, device: Device, whole: bool = False) -> DeviceMaps:
    """A DepthResult to the device, `whole` or what others compare with."""
    depth, deviation, status = (upload(device, array) for array in (result.depth, result.deviation, result.status))
    inverse, count = device.buffer(4 * result.depth.size), result.depth.size
    program = _program(device, device.columns(result.depth.shape[1]))       # which compares, too: no other one is built
    program.run("invert", (count,), count=count, depth=depth, deviation=deviation, status=status, inverse=inverse)
    if whole:
        return DeviceMaps(inverse, deviation, depth, upload(device, result.parallax), status)
    release(depth, status)
    return DeviceMaps(inverse, deviation)


def _program(device: Device, columns: int) -> Program:
    return build(device, "agreement.cl", (f"NEAR={NEAR!r}f", f"REFINED={REFINED}", f"COLUMNS={columns}", *OWN_DEFINES))


class Agreement:
    """Compares `own`, a DepthResult, with `others` of the same round, in memory or on disk (StoredResult), in their
    order; on `device`, one of them at a time. `sent(result, whole)`: as `send` does it, where some are on the device
    already; it alone looks at the arrays of the others. `maps`: `own`, whole."""

    def __init__(self, own: Any, others: Sequence[Any], device: Device,
                 sent: Callable[[Any, bool], DeviceMaps] | None = None):
        self.own, self.others, self.device = own, list(others), device
        self._sent = sent or (lambda result, whole: send(result, device, whole))
        self._scale = 1 / own.scene_scale
        self._columns = device.columns(own.depth.shape[1])
        self._program = _program(device, self._columns)
        self._cameras = upload(device, camera_table(own.camera, [view.camera for view in others], 1 / self._scale))
        self.maps, self._held = self._sent(own, True), [self._cameras]

    def spread(self) -> float:
        """Standard deviation of a depth by how far the maps differ, pixels of parallax: median over pixels (of 32
        rows or more of a large view) and views, of two depths' difference. NaN where hardly any are of one surface."""
        counts, size = self._zeros(4 * _BINS), self.own.depth.size
        stride = max(1, min(size // _SAMPLES, self.own.depth.shape[0] // _LEAST_ROWS))
        self._compare("count_differences", -(-self.own.depth.shape[0] // stride), inverse=self.maps.inverse,
                      stride=stride, bins=_BINS, per_pixel=_PER_PIXEL, counts=counts)
        found = np.cumsum(download(self.device, counts, _BINS, np.uint32), dtype=np.int64)
        if found[-1] < _LEAST:
            return float("nan")
        return float((np.searchsorted(found, found[-1] / 2) + 0.5) / _PER_PIXEL / _NORMAL / np.sqrt(2))

    def average(self, spread: float, pixels: float, propose: bool = True,
                first_spread: float | None = None) -> dict[str, Any]:
        """What follows for `own`, depth, deviation and status by name, on the device: each depth averaged with what the
        others say of it within `pixels` of parallax. `propose`: in place of rejected depths too, which have no weight
        of their own and are REFINED from then on. `first_spread`: before anything was averaged, where it was."""
        (height, width), views = self.own.depth.shape, len(self.others)
        count, grown = width * height, 1.0 if first_spread is None else first_spread / spread
        wider = grown**2 / 2 * views / (views - 1) if views > 1 else 0.0    # two that share their photos say nothing
        sums = self._zeros(20 * count)
        found = {name: self._buffer(size * count) for name, size in _AVERAGED.items()}
        self._compare("add_view", height, spread=spread, pixels=pixels, sums=sums)
        self._program.run("average", (width, height), width=width, height=height, scale=self._scale, spread=spread,
                          wider=wider, propose=int(propose), sums=sums, depth=self.maps.depth,
                          depth_per_parallax=self.maps.parallax, deviation=self.maps.deviation,
                          status=self.maps.status, averaged=found["depth"], surer=found["deviation"],
                          found=found["status"])
        return found

    def count_support(self, candidates: Any, number: int, support: Any) -> None:
        """Add to `support`, int8 [number, H, W], what the others' depths say of each of the `candidates`, float32 of
        the same shape, inverse depths in units, 0 = none: 1 where one confirms it, -1 where it would have to be seen
        through."""
        height, width = self.own.depth.shape
        for view, other in enumerate(self.others, start=1):
            self._program.run("count_support", (width, height), candidates=candidates, number=number, view=view,
                              depth_per_parallax=self.maps.parallax, cameras=self._cameras, scale=self._scale,
                              inverses=self._sent(other, False).inverse, support=support)

    def agreed(self, proposed: Any, depth: Any, parallax: Any, deviation: Any, status: Any) -> DeviceMaps:
        """What holds of depths, as refine_levels leaves them, that started from `average` and its status `proposed`."""
        count = self.own.depth.size
        found = DeviceMaps(*(self.device.buffer(size * count) for size in (4, 4, 4, 4, 1)))
        self._program.run("keep_agreed", (count,), count=count, proposed=proposed, own_depth=self.maps.depth,
                          own_deviation=self.maps.deviation, own_status=self.maps.status, depth=depth,
                          depth_per_parallax=parallax, deviation=deviation, status=status, agreed=found.depth,
                          parallax=found.parallax, surer=found.deviation, found=found.status, inverse=found.inverse)
        return found

    def read(self, averaged: Mapping[str, Any], into: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What `average` left, on the host, float32 and uint8 of shape (H, W), in arrays of `into` by its names."""
        for name, buffer in averaged.items():
            cl.enqueue_copy(self.device.queue, into[name], buffer)
        return {name: into[name] for name in averaged}

    def release(self) -> None:
        release(*self._held)

    def _compare(self, kernel: str, rows: int, **arguments: Any) -> None:
        """Run `kernel` with each other view, over so many rows: a pixel each, or a row each where vectors are fast."""
        grid, group = ((self.own.depth.shape[1], rows), None) if self._columns == 1 else ((1, rows), (1, 1))
        for number, other in enumerate(self.others, start=1):
            maps = self._sent(other, False)
            self._program.run(kernel, grid, group, view=number, inverses=maps.inverse, deviations=maps.deviation,
                              scale=self._scale, cameras=self._cameras, depth=self.maps.depth,
                              depth_per_parallax=self.maps.parallax, **arguments)

    def _zeros(self, nbytes: int) -> Any:
        buffer = self._buffer(nbytes)
        cl.enqueue_fill_buffer(self.device.queue, buffer, np.uint32(0), 0, nbytes)
        return buffer

    def _buffer(self, nbytes: int) -> Any:
        self._held.append(self.device.buffer(nbytes))
        return self._held[-1]
