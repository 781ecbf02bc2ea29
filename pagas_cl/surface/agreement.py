"""Launches of agreement.cl: refined depth maps of other views as evidence for one another (method section 8.1)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pagas_cl.scene.camera import Camera, camera_table
from pagas_cl.scene.depthmap import REFINED
from pagas_cl.scene.sampling import NEAR, scene_scale_of

if TYPE_CHECKING:
    from pagas_cl.runtime.device import Device

_BINS, _PER_PIXEL = 4096, 1024.0     # differences up to 4 pixels of parallax
_LEAST = 100                         # differences that tell anything of a view
_NORMAL = 0.6745                     # median of |x| where x has a standard deviation of 1


@dataclass(frozen=True, eq=False)
class DepthEvidence:
    """A refined depth map as the others take it: arrays (H, W), lengths in scene units, as in DepthResult."""

    camera: Camera
    depth: npt.NDArray[np.float32]
    deviation: npt.NDArray[np.float32]
    status: npt.NDArray[np.uint8]
    parallax: npt.NDArray[np.float32]

    @property
    def trusted(self) -> npt.NDArray[np.float32]:
        """Its depths that photos confirm, with 0 for all others."""
        known = (self.status == REFINED) & (self.depth > 0) & np.isfinite(self.deviation)
        return np.where(known, self.depth, np.float32(0))

    def send(self, device: Device) -> tuple[Any, Any]:
        """`trusted` and `deviation`, on the device."""
        from pagas_cl.runtime.memory import upload

        return upload(device, self.trusted), upload(device, self.deviation)


class Agreement:
    """Compares `own` with `others`, depth maps of one round with what a DepthEvidence has, in their order; on `device`,
    one of them at a time. `send(other)`: as its method does it, where some are on the device already; it alone then
    looks at their arrays."""

    def __init__(self, own: Any, others: Sequence[Any], device: Device,
                 send: Callable[[Any], tuple[Any, Any]] | None = None):
        from pagas_cl.runtime.memory import upload
        from pagas_cl.runtime.program import build

        self.own, self.others, self.device = own, list(others), device
        self._send = send or (lambda evidence: evidence.send(device))
        self.scale = 1 / scene_scale_of(own.depth, None)
        self._program = build(device, "agreement.cl", (f"NEAR={NEAR!r}f", f"REFINED={REFINED}"))
        self._cameras = upload(device, camera_table(own.camera, [view.camera for view in others], 1 / self.scale))
        self._parallax = upload(device, own.parallax)

    def spread(self) -> float:
        """Standard deviation of a depth by how far the maps differ, pixels of parallax: median over all pixels and
        views, of two depths' difference. NaN where hardly any two are of one surface."""
        from pagas_cl.runtime.memory import download

        counts, (trusted, _) = self._zeros(4 * _BINS), self._send(self.own)
        for given in self._each():
            self._run("count_differences", depth=trusted, bins=_BINS, per_pixel=_PER_PIXEL, counts=counts, **given)
        found = np.cumsum(download(self.device, counts, _BINS, np.uint32), dtype=np.int64)
        if found[-1] < _LEAST:
            return float("nan")
        return float((np.searchsorted(found, found[-1] / 2) + 0.5) / _PER_PIXEL / _NORMAL / np.sqrt(2))

    def average(self, spread: float, pixels: float, propose: bool = True) -> DepthEvidence:
        """What follows for `own`: each depth averaged with what the others say of it within `pixels` of parallax.
        `propose`: in place of rejected depths too, which have no weight of their own and are REFINED from then on."""
        from pagas_cl.runtime.memory import download, upload

        own, count = self.own, self.own.depth.size
        sums, depth, averaged = self._zeros(16 * count), upload(self.device, own.depth), self._zeros(4 * count)
        for given in self._each():
            self._run("add_view", depth=depth, spread=spread, pixels=pixels, sums=sums, **given)
        deviation, status = upload(self.device, own.deviation), upload(self.device, own.status)
        self._run("average", size=(count,), count=count, scale=self.scale, spread=spread, propose=int(propose),
                  sums=sums, depth=depth, depth_per_parallax=self._parallax, deviation=deviation, status=status,
                  averaged=averaged)
        shape = own.depth.shape
        return DepthEvidence(own.camera, download(self.device, averaged, shape),
                             download(self.device, deviation, shape), download(self.device, status, shape, np.uint8),
                             own.parallax)

    def _each(self) -> Iterator[dict[str, Any]]:
        """Arguments of a comparison with each other view."""
        for number, other in enumerate(self.others, start=1):
            depth, deviations = self._send(other)
            yield {"view": number, "scale": self.scale, "cameras": self._cameras, "depth_per_parallax": self._parallax,
                   "map": depth, "deviations": deviations}

    def _run(self, kernel: str, size: tuple[int, ...] | None = None, **arguments: Any) -> None:
        from pagas_cl.runtime.program import bind, run_once

        camera = self.own.camera
        run_once(self.device.queue, [bind(self._program, kernel, size or (camera.width, camera.height), **arguments)])

    def _zeros(self, nbytes: int) -> Any:
        import pyopencl as cl

        buffer = self.device.memory.buffer(self.device.context, nbytes)
        cl.enqueue_fill_buffer(self.device.queue, buffer, np.uint32(0), 0, nbytes)
        return buffer
