"""Launches of measure.cl, every context view sampled under the initial depth; of image_noise.cl, noise and texture of
one photo; and of summary.cl, what rows of numbers come to, so that few leave the device (method section 8)."""

from dataclasses import dataclass
from functools import lru_cache
from math import sqrt

import numpy as np
import pyopencl as cl

from pagas_cl.config import Config
from pagas_cl.method.splat import exposure, project
from pagas_cl.method.splat.buffers import ExposureBuffers, MaybeBuffer, SampleGrid, SurfaceBuffers, dimensions
from pagas_cl.method.splat.constants import MEAN, NUMBER, OFFSETS, QUANTILE, SHARED, SHIFTS, SUMMARY_GROUP, define
from pagas_cl.method.splat.inputs import enqueue_each
from pagas_cl.method.splat.options import Programs
from pagas_cl.runtime.arena import declared, total_bytes
from pagas_cl.runtime.memory import constant, download
from pagas_cl.runtime.program import bind, build, run_once

_MOVES = SHIFTS + OFFSETS
# Rows of a context view: (name, lowest, highest, quantile's share).
_ROWS = [("hidden", 0, 1, 0.5), ("size", 0, 8, 0.5), *[(f"change {c}", -1, 1, 0.5) for c in "rgb"],
         *[(f"epipolar_offset {k}", -2.5, 2.5, 0.5) for k in range(4)], ("specularity", 0, 1, 0.95),
         ("like", 0, 1, 0.5), ("parallax", 0, 1, 0.5), ("explained", 0, 1, 0.5)]
_KINDS = [name.split()[0].upper() for name, *_ in _ROWS]       # as measure.cl has them
_ROW_NUMBERS = define(**{kind: _KINDS.index(kind) for kind in _KINDS}, ROWS=len(_ROWS))   # the first row of each
_SIDE = 256               # samples along each side of the photo
_GREYS = 765              # grey values are sums of three channels
_RULES = [(-0.5, 2047.5, 0.25), (-0.5, 2047.5, 0.5), (-0.5, 2047.5, 0.5)]     # bins of one grey value


class Rows:
    """Rows of `count` float32 on the device, NaN = no value, and what they come to. `rules` has (lowest, highest,
    share) of each: the values that its quantile lies between and the share of the values below it."""

    def __init__(self, device, rules, count: int):
        self.device, self.rows, self.count = device, len(rules), count
        self.values = device.buffer(4 * self.rows * count)
        self.summary = device.buffer(16 * self.rows)
        self._rules = constant(device, np.float32([(*rule, 0) for rule in rules]))

    @staticmethod
    def nbytes(rows: int, count: int) -> int:
        return rows * (4 * count + 16)

    def summarize(self):
        return bind(build(self.device, "summary.cl", SHARED), "summarize", (self.rows * SUMMARY_GROUP,),
                    (SUMMARY_GROUP,), rows=self.values, count=self.count, rules=self._rules, summary=self.summary)

    def read(self) -> np.ndarray:
        """`summary` on the host: (rows, 4) of number, mean, quantile, mean square; NaN in a row without values."""
        return download(self.device, self.summary, (self.rows, 4)).astype(np.float64)


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
            bind(program, "sample_noise", (rows.count,), photo=photo, width=size.width, step_x=steps[0],
                 step_y=steps[1], across=across, count=rows.count, rows=rows.values),
            rows.summarize(),
            bind(program, "keep_smooth", (rows.count,), summary=rows.summary, count=rows.count, rows=rows.values),
            rows.summarize()])

    @staticmethod
    def nbytes(size) -> int:
        _, across, down = _samples(size)
        return Rows.nbytes(len(_RULES), max(0, across * down))

    def read(self) -> tuple[float, float]:
        """Standard deviation of the noise (0 to 1) in the smoothest quarter, share of pixels with little texture."""
        if self.rows is None:
            return 0.0, 1.0
        _, bend, textureless = self.rows.read()
        noise = 1.4826 * max(bend[QUANTILE], 0.0) / sqrt(6) / _GREYS if bend[NUMBER] else 0.0
        return float(noise), float(textureless[MEAN])


@dataclass(frozen=True, eq=False)
class ProbeResult:
    """What was measured; number, mean, quantile and mean square over samples are four numbers, NaN without any."""

    view_samples: dict[str, np.ndarray]     # by row of measure.cl, (contexts, 4)
    seen: np.ndarray                        # (4,) of samples that some view sees (0 or 1)
    far: np.ndarray                         # (4,) of those that match better two or more pixels away
    noise: float                            # of the target's photo, as `textureless`: see ImageNoise
    textureless: float
    stride: int                             # pixels of the target between samples
    local_specularity: np.ndarray           # float32 (down, across): mean over the context views, NaN = unknown


@dataclass(eq=False)
class ProbeBuffers(SurfaceBuffers, ExposureBuffers):
    costs: MaybeBuffer = declared((_MOVES, "samples"), np.float32, "1", "1 - correlation at each sample, by move")
    totals: MaybeBuffer = declared((SHIFTS + 2, "samples"), np.float32, "1", "of the views, as in measure.cl")


@lru_cache(16)
def probe_config(config: Config) -> Config:
    """Of the programs and buffers that measure, whatever the refinement will do."""
    return config.with_settings(splatting__occlusion=True, loss__unseen_mask=False, loss__exposure=True)


def probe_bytes(config: Config, sizes, views: int) -> int:
    """Bytes of the device that a Probe takes for photos of `sizes`, of which `views` are of context views."""
    lengths = dimensions(probe_config(config), sizes[0], sizes[1:], views)
    rows = Rows.nbytes(len(_ROWS) * views + 3, lengths["samples"])
    return total_bytes(ProbeBuffers.plan(lengths)) + rows + ImageNoise.nbytes(sizes[0])


class Probe:
    """The full-size level as far as measuring needs it, and rows of samples. Everything is enqueued; what reads is the
    only wait for the device."""

    def __init__(self, device, config: Config, given, write):
        self.device, config = device, probe_config(config)
        self.target, *views = given.views(config)
        self.views, self.grid = views[:given.contexts], SampleGrid.over(self.target.size)
        self.columns = device.columns(self.target.size.width)
        self.programs = Programs(device, config.with_settings(loss__exposure=False), given.cameras,
                                 {"measure.cl": (*_ROW_NUMBERS, f"SIDE_BY_SIDE={self.columns}")})
        number, count = len(self.views), self.grid.count
        self.view_samples = Rows(device, [rule for _, *rule in _ROWS] * number, count)
        self.samples = Rows(device, [(0, 1, 0.5)] * 3, count)
        self.buffers = ProbeBuffers.allocated(device, given.dimensions(config))
        cl.enqueue_copy(device.queue, self.buffers.cameras, given.camera_table)
        cl.enqueue_copy(device.queue, self.buffers.exposure, constant(device, exposure.neutral(number)))
        write(self.buffers.depth)
        run_once(device.queue, project.before_steps(self.programs, self.buffers, self.target, number))

    def read(self) -> ProbeResult:
        """Measure all context views."""
        image_noise = ImageNoise(self.device, self.target.photo, self.target.size)
        enqueue_each(self.device.queue, self.views, lambda view: [
            *project.nearest(self.programs, self.buffers, view), *self.sample(view),
            exposure.match(self.programs, self.buffers, view)])
        run_once(self.device.queue, self._judge())
        views, samples = self._read_views(), self.samples.read()
        specularity = np.empty((self.grid.down, self.grid.across), np.float32)
        cl.enqueue_copy(self.device.queue, specularity, self.samples.values, src_offset=8 * self.grid.count)
        return ProbeResult(views, samples[0], samples[1], *image_noise.read(), self.grid.stride, specularity)

    def read_explained(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the context views, without the exposure fit: the row "parallax", (contexts, 4); and the share of a patch
        that each photo explains, float32 (contexts, down, across), NaN = unknown."""
        enqueue_each(self.device.queue, self.views, lambda view: [
            *project.nearest(self.programs, self.buffers, view), *self.sample(view)])
        run_once(self.device.queue, [self.view_samples.summarize()])
        explained, row = np.empty((len(self.views), self.grid.down, self.grid.across), np.float32), 4 * self.grid.count
        cl.enqueue_copy(self.device.queue, explained, self.view_samples.values, host_origin=(0, 0),
                        buffer_origin=(row * (len(_ROWS) - 1), 0), region=(row, len(self.views)),
                        buffer_pitches=(row * len(_ROWS),), host_pitches=(row,))
        return self._read_views()["parallax"], explained

    def _read_views(self) -> dict[str, np.ndarray]:
        views = self.view_samples.read().reshape(-1, len(_ROWS), 4)
        return {name: views[:, row] for row, (name, *_) in enumerate(_ROWS)}

    def sample(self, view) -> list:
        """Samples of the context view, by the nearest surfaces that buffers.z_first holds for it."""
        count, given = self.grid.count, {**self.grid.arguments, "values": self.view_samples.values}
        return [self._bind("sample_view", (count,), view, **given),
                self._bind("match_moved", (count, -(-_MOVES // self.columns)), view, **given),
                self._bind("judge_view", (count,), view, **given)]

    def _judge(self) -> list:
        grid, given = self.grid, {"views": len(self.views), "values": self.view_samples.values}
        return [exposure.fit(self.programs, self.buffers, self.views),
                self._bind("compare_colors", (grid.count, len(self.views)), across=grid.across, down=grid.down,
                           **given),
                self._bind("judge_samples", (grid.count,), rows=self.samples.values, **given, **grid.arguments),
                self.view_samples.summarize(), self.samples.summarize()]

    def _bind(self, kernel: str, grid, view=None, **arguments):
        group = (64 if self.columns == 1 else 1, 1) if len(grid) == 2 else None      # no row is added: moves, views
        return self.programs.bind("measure.cl", kernel, grid, self.buffers, view, group, **arguments)

    def release(self):
        self.buffers.release()
