"""Launches of measure.cl: samples of every context view under the initial depth (method section 8)."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np
import pyopencl as cl

from pagas_cl.runtime.arena import Arena, BufferSpec
from pagas_cl.runtime.program import bind, build, run_once
from pagas_cl.splat import project
from pagas_cl.splat.level import threshold_in
from pagas_cl.splat.options import defines
from pagas_cl.splat.state import camera_table

SHIFTS = np.array([-4, -2, -1, 0, 1, 2, 4], np.float32)      # pixels of parallax, as in measure.cl
_RECORD = 8 + len(SHIFTS)
_MOST_SAMPLES = 4096


@dataclass(frozen=True, eq=False)
class Samples:
    """What one context view shows at S samples of the target.

    Attributes
    ----------
    state : ndarray of shape (S,)
        1 seen, 2 hidden behind a nearer surface, 0 outside the photo or masked.
    size : ndarray of shape (S,)
        Standard deviation of the projected Gaussian, pixels.
    own, other : ndarray of shape (S, 3)
        Colours of target and context photo, 0 to 1.
    cost : ndarray of shape (S, 7)
        1 - correlation of patches with the depth moved by SHIFTS pixels of parallax; 2 where it is not defined.
    """

    state: np.ndarray
    size: np.ndarray
    own: np.ndarray
    other: np.ndarray
    cost: np.ndarray


class Probe:
    """The full-size level as far as measuring needs it: what `project` asks of a Level, and the records."""

    def __init__(self, device, config, given, write):
        config = config.with_settings(splatting__occlusion=True, loss__unseen_mask=False)
        target, *contexts = given.sizes
        self.device, self.config, self.given = device, config, given
        self.target, self.contexts = target, contexts[:given.contexts]
        self.defines = defines(config, device, max(target.grid))
        self.stride = max(1, ceil(sqrt(target.pixels / _MOST_SAMPLES)))
        self.across, self.down = -(-target.width // self.stride), -(-target.height // self.stride)
        most = max(size.pixels for size in given.sizes)
        self.arena = Arena(device, [
            BufferSpec("depth", (target.pixels,), np.float32), BufferSpec("unit", (target.pixels,), np.float32),
            BufferSpec("cameras", (len(given.cameras), 20), np.float32), BufferSpec("z_first", (most,), np.uint32),
            BufferSpec("records", (self.across * self.down, _RECORD), np.float32)])
        cl.enqueue_copy(device.queue, self.arena["cameras"], camera_table(given.cameras[0], given.cameras[1:], given.unit))
        write(self.arena["depth"])
        run_once(device.queue, project.before_steps(self))

    def threshold(self, view: int) -> float:
        return threshold_in(self.given, self.config, view)

    def samples(self, view: int) -> Samples:
        """Samples of context view `view` (from 1)."""
        a, s, given = self.arena, self.config.splatting, self.given
        launches = [*given.fetch(view), *project.nearest(self, view),
                    bind(build(self.device, "measure.cl", self.defines), "sample_view", (self.across * self.down,), None,
                         a["depth"], a["unit"], a["cameras"], view, float(s.low_pass), float(self.threshold(view)), a["z_first"],
                         given.photos[0], given.photos[view], self.stride, self.across, self.down, a["records"])]
        run_once(self.device.queue, launches)
        r = np.empty((self.across * self.down, _RECORD), np.float32)
        cl.enqueue_copy(self.device.queue, r, a["records"])
        return Samples(r[:, 0], r[:, 1], r[:, 2:5], r[:, 5:8], r[:, 8:])

    def release(self):
        self.arena.release()
