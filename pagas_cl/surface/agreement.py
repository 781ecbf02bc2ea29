"""Launches of agreement.cl: refined depth maps of other views as evidence for one another (method section 8.1)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pagas_cl.scene.camera import camera_table
from pagas_cl.scene.depthmap import REFINED
from pagas_cl.scene.sampling import NEAR, scene_scale_of

if TYPE_CHECKING:
    from pagas_cl.runtime.device import Device
    from pagas_cl.runtime.program import Program

_BINS, _PER_PIXEL = 4096, 1024.0     # differences up to 4 pixels of parallax
_LEAST = 100                         # differences that tell anything of a view
_SAMPLES = 20000                     # pixels of a view, about, in whole rows, that they are taken at
_LEAST_ROWS = 32                     # of a large view, that are spread over it
_NORMAL = 0.6745                     # median of |x| where x has a standard deviation of 1


def send(result: Any, device: Device) -> tuple[Any, Any]:
    """What others are told of a DepthResult, on the device: inverse depths that photos confirm, 0 for all others, and
    deviations; 8 bytes a pixel."""
    from pagas_cl.runtime.memory import upload
    from pagas_cl.runtime.program import bind, run_once

    depth, deviation, status = (upload(device, array) for array in (result.depth, result.deviation, result.status))
    inverse, count = device.memory.buffer(device.context, 4 * result.depth.size), result.depth.size
    run_once(device.queue, [bind(_program(device), "invert", (count,), count=count, depth=depth, deviation=deviation,
                                 status=status, inverse=inverse)])
    for buffer in (depth, status):
        buffer.release()
    return inverse, deviation


def _program(device: Device, columns: int = 1) -> Program:
    from pagas_cl.runtime.program import build

    return build(device, "agreement.cl", (f"NEAR={NEAR!r}f", f"REFINED={REFINED}", f"COLUMNS={columns}"))


class Agreement:
    """Compares `own`, a DepthResult, with `others` of the same round, in memory or on disk (StoredResult), in their
    order; on `device`, one of them at a time. `sent(result)`: as `send` does it, where some are on the device already;
    it alone looks at the arrays of the others."""

    def __init__(self, own: Any, others: Sequence[Any], device: Device,
                 sent: Callable[[Any], tuple[Any, Any]] | None = None):
        from pagas_cl.runtime.memory import upload

        self.own, self.others, self.device = own, list(others), device
        self._sent = sent or (lambda result: send(result, device))
        self._scale = 1 / scene_scale_of(own.depth, None)
        self._columns = device.lanes if device.lanes <= own.depth.shape[1] else 1     # of a row, side by side
        self._program = _program(device, self._columns)
        self._cameras = upload(device, camera_table(own.camera, [view.camera for view in others], 1 / self._scale))
        self._inverse, self._deviation = self._sent(own)
        self._depth, self._status, self._parallax = (
            upload(device, array) for array in (own.depth, own.status, own.parallax))
        self._held = [self._cameras, self._depth, self._status, self._parallax]

    def spread(self) -> float:
        """Standard deviation of a depth by how far the maps differ, pixels of parallax: median over pixels (of 32
        rows or more of a large view) and views, of two depths' difference. NaN where hardly any are of one surface."""
        from pagas_cl.runtime.memory import download

        counts, size = self._zeros(4 * _BINS), self.own.depth.size
        stride = max(1, min(size // _SAMPLES, self.own.depth.shape[0] // _LEAST_ROWS))
        for given in self._each():
            self._run("count_differences", self._rows(stride), inverse=self._inverse, stride=stride, bins=_BINS,
                      per_pixel=_PER_PIXEL, counts=counts, **given)
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
        wider = grown**2 / 2 * views / (views - 1) if views > 1 else 0.0    # two that share their photos tell nothing
        sums, depth, deviation, status = self._zeros(20 * count), *(self._buffer(size * count) for size in (4, 4, 1))
        for given in self._each():
            self._run("add_view", self._rows(), spread=spread, pixels=pixels, sums=sums, **given)
        self._run("average", (width, height), width=width, height=height, scale=self._scale, spread=spread, wider=wider,
                  propose=int(propose), sums=sums, depth=self._depth, depth_per_parallax=self._parallax,
                  deviation=self._deviation, status=self._status, averaged=depth, surer=deviation, found=status)
        return {"depth": depth, "deviation": deviation, "status": status}

    def read(self, averaged: dict[str, Any], *names: str) -> dict[str, np.ndarray]:
        """Some of what `average` left, on the host, float32 and uint8 of shape (H, W)."""
        from pagas_cl.runtime.memory import download

        return {name: download(self.device, averaged[name], self.own.depth.shape,
                               np.uint8 if name == "status" else np.float32) for name in names}

    def release(self) -> None:
        """Give back what was made here."""
        for buffer in self._held:
            buffer.release()

    def _each(self) -> Iterator[dict[str, Any]]:
        """Arguments of a comparison with each other view."""
        for number, other in enumerate(self.others, start=1):
            inverse, deviation = self._sent(other)
            yield {"view": number, "scale": self._scale, "cameras": self._cameras, "depth": self._depth,
                   "depth_per_parallax": self._parallax, "inverses": inverse, "deviations": deviation}

    def _rows(self, stride: int = 1) -> tuple[int, int]:
        """Work-items over every `stride`-th row: a pixel each, or a row each where vectors are fast."""
        height, width = self.own.depth.shape
        return width if self._columns == 1 else 1, -(-height // stride)

    def _run(self, kernel: str, size: tuple[int, ...], **arguments: Any) -> None:
        from pagas_cl.runtime.program import bind, run_once

        group = (1, 1) if size[0] == 1 and self._columns > 1 else None
        run_once(self.device.queue, [bind(self._program, kernel, size, group, **arguments)])

    def _zeros(self, nbytes: int) -> Any:
        import pyopencl as cl

        buffer = self._buffer(nbytes)
        cl.enqueue_fill_buffer(self.device.queue, buffer, np.uint32(0), 0, nbytes)
        return buffer

    def _buffer(self, nbytes: int) -> Any:
        self._held.append(self.device.memory.buffer(self.device.context, nbytes))
        return self._held[-1]
