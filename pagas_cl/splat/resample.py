"""Launches of resample.cl: photos and depth maps at the size of a pyramid level (method section 6)."""

from __future__ import annotations

import pyopencl as cl

from pagas_cl.runtime.program import bind, build
from pagas_cl.splat.options import defines
from pagas_cl.splat.state import Size, photo_buffer


class Resampler:
    """Device to device: every result is a buffer of its own or goes into the one given."""

    def __init__(self, device, config):
        self.device, self.program = device, build(device, "resample.cl", defines(config, device, 1.0))

    def photo(self, source: cl.Buffer, size: Size, to: Size) -> cl.Buffer:
        """`source` at the size `to`, by area averaging; `source` itself where nothing changes."""
        if size == to:
            return source
        out = photo_buffer(self.device, to.pixels)
        bind(self.program, "shrink_photo", to.grid, None, source, size.width, size.height, out, to.width,
             to.height).enqueue(self.device.queue)
        return out

    def shrink_depth(self, source: cl.Buffer, size: Size, out: cl.Buffer, to: Size):
        """Mean of the valid depths that a coarser pixel covers."""
        if size == to:
            cl.enqueue_copy(self.device.queue, out, source, byte_count=4 * to.pixels)
        else:
            bind(self.program, "shrink_depth", to.grid, None, source, size.width, size.height, out, to.width,
                 to.height).enqueue(self.device.queue)

    def enlarge_depth(self, source: cl.Buffer, size: Size, initial: cl.Buffer, out: cl.Buffer, to: Size):
        """Bilinear over valid neighbours; valid where `initial`, the initial depth at this size, is."""
        bind(self.program, "enlarge_depth", to.grid, None, source, size.width, size.height, initial, out, to.width,
             to.height).enqueue(self.device.queue)
