"""Launches of measure.cl: every context view sampled under the initial depth (method section 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from pagas_cl.runtime.arena import Arena, BufferSpec, total_bytes
from pagas_cl.runtime.program import bind, build, run_once
from pagas_cl.runtime.transfer import download
from pagas_cl.scene.rig import camera_table
from pagas_cl.splat import exposure, project
from pagas_cl.splat.constants import OFFSETS, SHIFTS, define
from pagas_cl.splat.image_noise import ImageNoise
from pagas_cl.splat.level import threshold_in
from pagas_cl.splat.options import defines, heaviest_pixel
from pagas_cl.splat.summary import Rows

_MOVES = SHIFTS + OFFSETS
# Rows of a context view: (name, lowest, highest, quantile's share).
_ROWS = [("hidden", 0, 1, 0.5), ("size", 0, 8, 0.5), *[(f"change {c}", -1, 1, 0.5) for c in "rgb"],
         *[(f"epipolar_offset {k}", -2.5, 2.5, 0.5) for k in range(4)], ("specularity", 0, 1, 0.95),
         ("like", 0, 1, 0.5)]
# The first row of each name, as measure.cl has it in capitals.
_ROW_NUMBERS = define(**{name.split()[0].upper(): k for k, (name, *_) in reversed(list(enumerate(_ROWS)))},
                      ROWS=len(_ROWS))


@dataclass(frozen=True, eq=False)
class ProbeResult:
    """What was measured.

    Attributes
    ----------
    view_samples : dict of str to ndarray of shape (contexts, 4)
        By row of measure.cl: number, mean, quantile and mean square over the samples; NaN without samples.
    seen, far : ndarray of shape (4,)
        The same of samples that some view sees (0 or 1), and of those that match better two or more pixels away.
    gains : ndarray of shape (contexts, 3, 2)
        Gain and offset of each channel from the target's photo to each context photo.
    noise, textureless : float
        Of the target's photo; see image_noise.py.
    stride : int
        Pixels of the target between samples.
    local_specularity : ndarray of shape (down, across), float32
        Mean specularity over the context views at each sample, NaN = unknown.
    """

    view_samples: dict[str, np.ndarray]
    seen: np.ndarray
    far: np.ndarray
    gains: np.ndarray
    noise: float
    textureless: float
    stride: int
    local_specularity: np.ndarray


def _buffers(sizes, views: int) -> list[BufferSpec]:
    """For the photos of the target and of `views` context views."""
    target, count = sizes[0], exposure.Grid.over(sizes[0]).count
    return [BufferSpec("depth", (target.pixels,), np.float32),
            BufferSpec("depth_per_parallax", (target.pixels,), np.float32),
            BufferSpec("cameras", (len(sizes), 20), np.float32),
            BufferSpec("z_first", (max(size.pixels for size in sizes),), np.uint32), *exposure.buffers(target, views),
            BufferSpec("costs", (_MOVES, count), np.float32),
            BufferSpec("totals", (SHIFTS + 2, count), np.float32)]


def probe_bytes(sizes, views: int) -> int:
    """Bytes of the device that a Probe takes."""
    rows = Rows.nbytes(len(_ROWS) * views + 3, exposure.Grid.over(sizes[0]).count)
    return total_bytes(_buffers(sizes, views)) + rows + ImageNoise.nbytes(sizes[0])


class Probe:
    """The full-size level as far as measuring needs it: what `project` and `exposure` ask of a Level,
    and rows of samples.

    Everything is enqueued; `read` is the only wait for the device.
    """

    def __init__(self, device, config, given, write):
        config = config.with_settings(splatting__occlusion=True, loss__unseen_mask=False)
        target, *contexts = given.sizes
        self.device, self.config, self.given = device, config, given
        self.target, self.contexts = target, contexts[:given.contexts]
        self.defines, self.grid = defines(config, device, heaviest_pixel(given.cameras[0])), exposure.Grid.over(target)
        views, count = len(self.contexts), self.grid.count
        self.view_samples = Rows(device, [rule for _, *rule in _ROWS] * views, count)
        self.samples = Rows(device, [(0, 1, 0.5)] * 3, count)
        self.arena = Arena(device, _buffers(given.sizes, views))
        cl.enqueue_copy(device.queue, self.arena["cameras"],
                        camera_table(given.cameras[0], given.cameras[1:], given.scene_scale))
        cl.enqueue_copy(device.queue, self.arena["exposure"], exposure.neutral(views))
        write(self.arena["depth"])
        run_once(device.queue, project.before_steps(self))

    def threshold(self, view: int) -> float:
        """Depth threshold in context view `view`."""
        return threshold_in(self.given, self.config, view)

    def read(self) -> ProbeResult:
        """Measure all context views."""
        for view in range(1, 1 + len(self.contexts)):
            run_once(self.device.queue, [*self.given.fetch(view), *project.nearest(self, view), *self.sample(view),
                                         exposure.match(self, view)])
        run_once(self.device.queue, self._judge())
        image_noise = ImageNoise(self.device, self.given.photos[0], self.target)
        views, samples = self.view_samples.read().reshape(-1, len(_ROWS), 4), self.samples.read()
        specularity = np.empty((self.grid.down, self.grid.across), np.float32)
        cl.enqueue_copy(self.device.queue, specularity, self.samples.values, src_offset=8 * self.grid.count)
        table = download(self.device, self.arena["exposure"], (1 + len(self.contexts), 2, 3))
        return ProbeResult({name: views[:, row] for row, (name, *_) in enumerate(_ROWS)}, samples[0], samples[1],
                           table[1:].transpose(0, 2, 1).astype(np.float64), *image_noise.read(), self.grid.stride,
                           specularity)

    def sample(self, view: int) -> list:
        """Samples of context view `view`, by the nearest surfaces that arena["z_first"] holds for it."""
        a, grid, given, low_pass = self.arena, self.grid, self.given, float(self.config.splatting.low_pass)
        place = grid.stride, grid.across, grid.count
        return [self._bind("sample_view", (grid.count,), a["depth"], a["cameras"], view, low_pass,
                           float(self.threshold(view)), a["z_first"], given.photos[view], *place,
                           self.view_samples.values),
                self._bind("match_moved", (grid.count, _MOVES), a["depth"], a["depth_per_parallax"], a["cameras"], view,
                           given.photos[0], given.photos[view], *place, self.view_samples.values, a["costs"]),
                self._bind("judge_view", (grid.count,), a["costs"], a["cameras"], view, *place,
                           self.view_samples.values, a["totals"])]

    def _judge(self) -> list:
        a, grid = self.arena, self.grid
        return [exposure.fit(self),
                self._bind("compare_colors", (grid.count, len(self.contexts)), a["matches"], a["exposure"], grid.across,
                           grid.down, len(self.contexts), self.view_samples.values),
                self._bind("judge_samples", (grid.count,), a["depth"], a["cameras"], a["totals"],
                           self.view_samples.values, len(self.contexts), grid.stride, grid.across, grid.count,
                           self.samples.values),
                self.view_samples.summarize(), self.samples.summarize()]

    def _bind(self, name: str, size, *arguments):
        group = (64, 1) if len(size) == 2 else None          # rows are moves or views: none is added
        return bind(build(self.device, "measure.cl", (*self.defines, *_ROW_NUMBERS)), name, size, group, *arguments)

    def release(self):
        """Give the buffers back."""
        self.arena.release()
