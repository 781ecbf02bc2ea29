"""Launches of mismatch.cl: detail that photos do not support is taken back (method section 5.2)."""

from collections.abc import Callable

import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.method.splat.buffers import SampleGrid
from pagas_cl.method.splat.constants import NOISY_DETAIL, QUANTILE
from pagas_cl.method.splat.measure import Rows
from pagas_cl.runtime.memory import release
from pagas_cl.runtime.program import run_once

SPACINGS = (1, 2, 3, 4, 6)       # pixels between those that are averaged, one after the other: 5.7 pixels in all
VIEWS = 3                        # context views whose photos count
MOST = 16.0                      # square of bends over variance: beyond that no better
ROUNDING = 0.054                 # share of a grey level's square: variance of two photos' luma, rounded to 8 bit


def take_back(evidence, status: cl.Buffer, initial: cl.Buffer, always: bool) -> Callable[[], tuple[float, float]]:
    """Smooth evidence.buffers.depth as far as its detail is noise, where most of it is or `always`. Returns what waits
    for it and gives two numbers of the refined pixels, NaN without any: median share of the detail that is noise; and,
    before, the upper quartile of squared bends from pixel to pixel over the variance that photos leave."""
    device, size = evidence.device, evidence.size
    sums, rows = evidence.scratch
    views = evidence.views[:VIEWS]
    grid = SampleGrid.over(size)
    changes, smooth = (device.buffer(4 * size.pixels) for _ in range(2))
    accepted = evidence.of_accepted(views, ROUNDING)
    samples = Rows(device, [(0, 1, 0.5), (0, MOST, 0.75)], grid.count)

    def bind(kernel, over=(size.pixels,), **arguments):
        return evidence.bind(kernel, file="mismatch.cl", grid=over, status=status, initial=initial, **arguments)

    of_views = {"evidence": accepted, "every": len(evidence.views) / len(views)}
    launches = [bind("find_changes", count=size.pixels, changes=changes)]
    for far in SPACINGS:
        launches += [bind("smooth_changes", size, changes=one, smooth=other, dx=dx, dy=dy, **size.extent)
                     for one, other, dx, dy in ((changes, smooth, far, 0), (smooth, changes, 0, far))]
    run_once(device.queue, [
        *launches, bind("weigh_detail", smooth=changes, count=size.pixels, values=sums, **of_views),
        *evidence.sum_around(sums, 2, rows, sums),
        bind("sample_detail", (grid.count,), sums=sums, smooth=changes, rows=samples.values,
             of_all=evidence.after, **of_views, **grid.arguments),
        samples.summarize(),
        bind("take_back", sums=sums, smooth=changes, count=size.pixels, measured=samples.summary, always=int(always),
             enough=NOISY_DETAIL)])
    release(changes, smooth, accepted, samples.values)
    return lambda: tuple(samples.read()[:, QUANTILE].tolist())


def is_enabled(config: Config) -> bool:
    """Whether it is measured, and taken back where the measurement says so."""
    return config.effects.mismatch in ("auto", "on") and config.smoothness.kind == "planar"


def nbytes(pixels: int, samples: int) -> int:
    return 20 * pixels + Rows.nbytes(2, samples)
