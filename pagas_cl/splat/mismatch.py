"""Launches of mismatch.cl: detail that photos do not support is taken back (method section 5.2)."""

import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.runtime.program import run_once
from pagas_cl.splat.buffers import SampleGrid
from pagas_cl.splat.constants import NOISY_DETAIL, QUANTILE
from pagas_cl.splat.measure import Rows

SPACINGS = (1, 2, 3, 4, 6)       # pixels between those that are averaged, one after the other: 5.7 pixels in all


def take_back(evidence, status: cl.Buffer, initial: cl.Buffer, after: cl.Buffer, always: bool) -> float:
    """Smooth evidence.buffers.depth as far as its detail is noise, where most of it is or `always`; `after` is what
    `evidence` says of it. Returns the share of the detail that is noise, median over the refined pixels, NaN without
    any. Waits for the device."""
    device, size, (sums, rows) = evidence.device, evidence.size, evidence.scratch
    changes, smooth = (device.memory.buffer(device.context, 4 * size.pixels) for _ in range(2))

    def bind(kernel, grid=None, **arguments):
        given = {"count": size.pixels, "initial": initial} if grid is None else {}
        return evidence.bind(kernel, file="mismatch.cl", grid=grid or (size.pixels,), status=status, **given,
                             **arguments)

    launches = [bind("find_changes", changes=changes)]
    for far in SPACINGS:
        launches += [bind("smooth_changes", size.grid, initial=initial, changes=one, smooth=other, dx=dx, dy=dy,
                          **size.extent)
                     for one, other, dx, dy in ((changes, smooth, far, 0), (smooth, changes, 0, far))]
    grid, samples = SampleGrid.over(size), Rows(device, [(0, 1, 0.5)], SampleGrid.over(size).count)
    run_once(device.queue, [*launches, bind("weigh_detail", after=after, smooth=changes, values=sums),
                            *evidence.sum_around(sums, 2, rows, sums),
                            bind("sample_detail", (grid.count,), sums=sums, rows=samples.values, **grid.arguments),
                            samples.summarize()])
    share = float(samples.read()[0, QUANTILE])
    if always or share > NOISY_DETAIL:
        run_once(device.queue, [bind("take_back", sums=sums, smooth=changes)])
    for buffer in (changes, smooth):
        buffer.release()
    return share


def is_asked(config: Config) -> bool:
    """Whether it is measured, and taken back where that is called for."""
    return config.effects.mismatch in ("auto", "on") and config.smoothness.kind == "planar"


def nbytes(pixels: int, samples: int) -> int:
    """Bytes of the device that it takes."""
    return 8 * pixels + Rows.nbytes(1, samples)
