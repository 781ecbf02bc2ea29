"""Launches of resample.cl: photos and depth maps at the size of a pyramid level (method section 6)."""

import pyopencl as cl

from pagas_cl.method.splat.options import defines
from pagas_cl.runtime.program import build
from pagas_cl.scene.camera import Size


class Resampler:
    """Device to device: every result goes into the buffer given."""

    def __init__(self, device, config):
        self.device, self.program = device, build(device, "resample.cl", defines(config, device, 1.0))

    def shrink_photo(self, source: cl.Buffer, size: Size, out: cl.Buffer, to: Size):
        self._run("shrink_photo", source, size, to, photo=out)

    def shrink_depth(self, source: cl.Buffer, size: Size, out: cl.Buffer, to: Size):
        """Mean of the valid depths that a coarser pixel covers."""
        if size == to:
            cl.enqueue_copy(self.device.queue, out, source, byte_count=4 * to.pixels)
        else:
            self._run("shrink_depth", source, size, to, depth=out)

    def enlarge_depth(self, source: cl.Buffer, size: Size, initial: cl.Buffer, out: cl.Buffer, to: Size):
        """Bilinear over valid neighbours; valid where `initial`, the initial depth at this size, is."""
        self._run("enlarge_depth", source, size, to, full=initial, depth=out)

    def _run(self, kernel: str, source: cl.Buffer, size: Size, to: Size, **buffers):
        self.program.run(kernel, to, source=source, source_width=size.width, source_height=size.height, **to.extent,
                         **buffers)
