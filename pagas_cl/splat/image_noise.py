"""Launches of image_noise.cl: noise and texture of one photo (method section 8)."""

from __future__ import annotations

from math import sqrt

from pagas_cl.runtime.program import bind, build, run_once
from pagas_cl.splat.constants import MEAN, NUMBER, QUANTILE, SHARED
from pagas_cl.splat.summary import Rows

_SIDE = 256               # samples along each side of the photo
_GREYS = 765              # grey values are sums of three channels
_RULES = [(-0.5, 2047.5, 0.25), (-0.5, 2047.5, 0.5), (-0.5, 2047.5, 0.5)]     # bins of one grey value


def _samples(size):
    """Pixels between samples, along x and y, and how many there are along each."""
    steps = max(1, (size.width - 2) // _SIDE), max(1, size.height // _SIDE)
    return steps, -(-(size.width - 2) // steps[0]), -(-size.height // steps[1])


class ImageNoise:
    """Measures a photo, a buffer of uchar4; nothing waits for the device until `read`."""

    def __init__(self, device, photo, size):
        self.rows = None
        if size.width < 8:
            return
        program, (steps, across, down) = build(device, "image_noise.cl", SHARED), _samples(size)
        self.rows = rows = Rows(device, _RULES, across * down)
        run_once(device.queue, [
            bind(program, "sample_noise", (rows.count,), None, photo, size.width, *steps, across, rows.count,
                 rows.values),
            rows.summarize(),
            bind(program, "keep_smooth", (rows.count,), None, rows.summary, rows.count, rows.values),
            rows.summarize()])

    @staticmethod
    def nbytes(size) -> int:
        """Bytes of the device that it takes."""
        _, across, down = _samples(size)
        return Rows.nbytes(len(_RULES), max(0, across * down))

    def read(self) -> tuple[float, float]:
        """Standard deviation of the noise (0 to 1), from the second differences of the smoothest quarter of the pixels,
        and the share of pixels with little texture."""
        if self.rows is None:
            return 0.0, 1.0
        _, bend, textureless = self.rows.read()
        noise = 1.4826 * max(bend[QUANTILE], 0.0) / sqrt(6) / _GREYS if bend[NUMBER] else 0.0
        return float(noise), float(textureless[MEAN])
