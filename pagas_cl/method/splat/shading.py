"""Launches of shading.cl: context photos without what light does otherwise there (method section 5.3)."""

from dataclasses import dataclass, replace

import numpy as np
import pyopencl as cl

from pagas_cl.method.splat import exposure, project
from pagas_cl.method.splat.buffers import SampleGrid
from pagas_cl.method.splat.photos import StreamedPhotos, photo_buffer, photo_bytes
from pagas_cl.runtime.memory import download, release
from pagas_cl.runtime.program import Fill, run_once
from pagas_cl.scene.camera import Size


@dataclass(frozen=True, eq=False)
class RelitPhoto:
    """Stands for a photo that is on the device."""

    device: object
    pixels: cl.Buffer           # uchar4
    size: Size

    def load(self) -> np.ndarray:
        return np.ascontiguousarray(download(self.device, self.pixels, (*self.size.shape, 4), np.uint8)[..., :3])


def relit(probe, contexts, photos) -> list:
    """`contexts` with photos relit by the depth of `probe` (measure.Probe), on the device where `photos` are."""
    found, streamed = [], isinstance(photos, StreamedPhotos)
    for view, level_view in zip(contexts, probe.views):
        photo = RelitPhoto(probe.device, _relight(probe, level_view), level_view.size)
        found.append(replace(view, image=photo.load() if streamed else photo))
        if not streamed:
            photos.held(found[-1], photo_bytes(photo.size.pixels), lambda photo=photo: photo.pixels)
    return found


def _relight(probe, view) -> cl.Buffer:
    device, programs, buffers = probe.device, probe.programs, probe.buffers
    cells, out = SampleGrid.over(view.size), photo_buffer(device, view.size.pixels)
    sums, differences = (device.buffer(16 * cells.count) for _ in range(2))
    given = {"cells_across": cells.across, "cells_down": cells.down}
    run_once(device.queue, [
        *view.fetch(), *project.nearest(programs, buffers, view), exposure.match(programs, buffers, view),
        Fill(sums, np.uint32(0), sums.size),
        programs.bind("shading.cl", "add_differences", (probe.grid.count,), buffers, view, sums=sums,
                      cell=cells.stride, cells_across=cells.across, **probe.grid.arguments),
        programs.bind("shading.cl", "average_differences", (cells.count,), buffers, None, sums=sums,
                      differences=differences, **given),
        programs.bind("shading.cl", "relight", view.size, buffers, view, differences=differences,
                      cell=cells.stride, relit=out, **given)])
    release(sums, differences)
    return out
