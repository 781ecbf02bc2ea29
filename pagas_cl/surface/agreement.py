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
    from pagas_cl.runtime.program import Program

_BINS, _PER_PIXEL = 4096, 1024.0     # differences up to 4 pixels of parallax
_LEAST = 100                         # differences that tell anything of a view
_SAMPLES = 20000                     # pixels of a view, about, in whole rows, that they are taken at
_NORMAL = 0.6745                     # median of |x| where x has a standard deviation of 1


@dataclass(frozen=True, eq=False)
class DepthEvidence:
    """A refined depth map as the others take it: arrays (H, W), lengths in scene units, as in DepthResult."""

    camera: Camera
    depth: npt.NDArray[np.float32]
    deviation: npt.NDArray[np.float32]
    status: npt.NDArray[np.uint8]
    parallax: npt.NDArray[np.float32]

    def send(self, device: Device) -> list[Any]:
        """Depth, deviation, status and parallax, on the device, and inverse depths that photos confirm, 0 for all
        others: 17 bytes a pixel."""
        from pagas_cl.runtime.memory import upload
        from pagas_cl.runtime.program import bind, run_once

        depth, deviation, status, parallax = sent = [
            upload(device, array) for array in (self.depth, self.deviation, self.status, self.parallax)]
        inverse, count = device.memory.buffer(device.context, 4 * self.depth.size), self.depth.size
        run_once(device.queue, [bind(_program(device), "invert", (count,), count=count, depth=depth,
                                     deviation=deviation, status=status, inverse=inverse)])
        return [*sent, inverse]


def _program(device: Device, columns: int = 1) -> Program:
    from pagas_cl.runtime.program import build

    return build(device, "agreement.cl", (f"NEAR={NEAR!r}f", f"REFINED={REFINED}", f"COLUMNS={columns}"))


class Agreement:
    """Compares `own` with `others`, depth maps of one round, in their order; on `device`, one of them at a time.
    `send(evidence)`: as its method does it, where some are on the device already."""

    def __init__(self, own: DepthEvidence, others: Sequence[DepthEvidence], device: Device,
                 send: Callable[[DepthEvidence], list[Any]] | None = None):
        from pagas_cl.runtime.memory import upload

        self.own, self.others, self.device = own, list(others), device
        self._send = send or (lambda evidence: evidence.send(device))
        self._scale = 1 / scene_scale_of(own.depth, None)
        self._columns = device.lanes if device.lanes <= own.depth.shape[1] else 1     # of a row, side by side
        self._program = _program(device, self._columns)
        self._cameras = upload(device, camera_table(own.camera, [view.camera for view in others], 1 / self._scale))
        self._depth, self._deviation, self._status, self._parallax, self._inverse = self._send(own)
        self._held = [self._cameras]

    def spread(self) -> float:
        """Standard deviation of a depth by how far the maps differ, pixels of parallax: median over pixels (some
        20,000 of a large view) and views, of two depths' difference. NaN where hardly any two are of one surface."""
        from pagas_cl.runtime.memory import download

        counts, stride = self._zeros(4 * _BINS), max(1, self.own.depth.size // _SAMPLES)
        for given in self._each():
            self._run("count_differences", self._rows(stride), inverse=self._inverse, stride=stride, bins=_BINS,
                      per_pixel=_PER_PIXEL, counts=counts, **given)
        found = np.cumsum(download(self.device, counts, _BINS, np.uint32), dtype=np.int64)
        if found[-1] < _LEAST:
            return float("nan")
        return float((np.searchsorted(found, found[-1] / 2) + 0.5) / _PER_PIXEL / _NORMAL / np.sqrt(2))

    def average(self, spread: float, pixels: float, propose: bool = True) -> list[Any]:
        """What follows for `own`, depth, deviation and status on the device: each depth averaged with what the others
        say of it within `pixels` of parallax. `propose`: in place of rejected depths too, which have no weight of their
        own and are REFINED from then on."""
        count = self.own.depth.size
        sums, *found = self._zeros(16 * count), *(self._buffer(size * count) for size in (4, 4, 1))
        for given in self._each():
            self._run("add_view", self._rows(), spread=spread, pixels=pixels, sums=sums, **given)
        self._run("average", (count,), count=count, scale=self._scale, spread=spread, propose=int(propose), sums=sums,
                  depth=self._depth, depth_per_parallax=self._parallax, deviation=self._deviation, status=self._status,
                  **dict(zip(("averaged", "surer", "found"), found)))
        return found

    def read(self, averaged: list[Any]) -> dict[str, np.ndarray]:
        """What `average` left, on the host, as fields of DepthEvidence and DepthResult."""
        from pagas_cl.runtime.memory import download

        return {name: download(self.device, buffer, self.own.depth.shape, dtype) for name, buffer, dtype in zip(
            ("depth", "deviation", "status"), averaged, (np.float32, np.float32, np.uint8))}

    def release(self) -> None:
        """Give back what was made here."""
        for buffer in self._held:
            buffer.release()

    def _each(self) -> Iterator[dict[str, Any]]:
        """Arguments of a comparison with each other view."""
        for number, other in enumerate(self.others, start=1):
            _, deviation, _, _, inverse = self._send(other)
            yield {"view": number, "scale": self._scale, "cameras": self._cameras, "depth": self._depth,
                   "depth_per_parallax": self._parallax, "inverses": inverse, "deviations": deviation}

    def _rows(self, stride: int = 1) -> tuple[int, int]:
        """Work-items over every `stride`-th row: a pixel each, or a row each where vectors are fast."""
        height, width = self.own.depth.shape
        return width if self._columns == 1 else 1, -(-height // stride)

    def _run(self, kernel: str, size: tuple[int, ...], **arguments: Any) -> None:
        from pagas_cl.runtime.program import bind, run_once

        group = (1, 1) if len(size) == 2 and self._columns > 1 else None
        run_once(self.device.queue, [bind(self._program, kernel, size, group, **arguments)])

    def _zeros(self, nbytes: int) -> Any:
        import pyopencl as cl

        buffer = self._buffer(nbytes)
        cl.enqueue_fill_buffer(self.device.queue, buffer, np.uint32(0), 0, nbytes)
        return buffer

    def _buffer(self, nbytes: int) -> Any:
        self._held.append(self.device.memory.buffer(self.device.context, nbytes))
        return self._held[-1]
