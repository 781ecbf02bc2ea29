"""Launches of evidence.cl and deviation.cl: which depths the photos confirm, how sure each is (method section 9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from pagas_cl.runtime.program import Fill, bind, build, run_once
from pagas_cl.splat import project

_SUM_GROUP, _SUM_GROUPS, _ONE = 64, 256, 2**20      # as in evidence.cl

_BINS = 1024        # of 1 - correlation, as in evidence.cl
HISTOGRAM = 8 * _BINS       # bytes that count them, before and after


@dataclass(frozen=True)
class Doubt:
    """What was measured of a view beforehand (Measurements), as far as its evidence depends on it: by how much errors
    exceed what a match tells, pixels that photos are off, noise of a photo (0 to 1)."""

    spread: float = 1.0
    misaligned: float = 0.0
    noise: float = 0.0

    @classmethod
    def of(cls, measured) -> Doubt:
        """From Measurements, or None."""
        return cls(float(measured.spread), float(measured.misaligned), float(measured.noise)) if measured else NO_DOUBT

    @property
    def grain(self) -> float:
        """Variance of the noise of luma, which is 4/3 of that of the mean of the channels, beyond one grey level."""
        return max(0.0, 4 / 3 * self.noise**2 - 1 / 255**2)

    @property
    def slack(self) -> float:
        """By how much a correlation may fall by chance, in that of a clear photo."""
        return max(1.0, (self.noise / 0.004) ** 2)


NO_DOUBT = Doubt()


def _median(counts: np.ndarray) -> float:
    """Median of costs that were counted in bins of 0 to 2, linear within a bin."""
    total = int(counts.sum())
    if not total:
        return float("nan")
    upto = np.cumsum(counts)
    k = int(np.searchsorted(upto, total / 2))
    return 2 / len(counts) * (k + (total / 2 - (upto[k] - counts[k])) / max(1, counts[k]))


class Evidence:
    """Weighs the initial and the refined depth of one level by the photos of `views` (numbers from 1).

    `initial` is a buffer that holds the initial depth for as long as this lives. While the steps run, what was found
    of it waits on the host where the photos do.
    """

    def __init__(self, level, views, initial: cl.Buffer, doubt: Doubt = NO_DOUBT):
        self.level, self.views, self._initial = level, list(views), initial
        self.program, self.doubt = build(level.device, "evidence.cl", level.defines), doubt
        self._before = self._after = self._waiting = None

    def weigh_before(self):
        """Weigh the depth that is in the level now, the initial one."""
        self._before = self._weigh()
        if self.level.given.host:
            self._waiting = self._read(self._before)
            self._before.release()

    def weigh_after(self):
        """Weigh the depth as it is now."""
        if self._waiting is not None:
            self._before = self._buffer(self._waiting.nbytes)
            cl.enqueue_copy(self.level.device.queue, self._before, self._waiting)
        self._after = self._weigh()

    def costs(self) -> tuple[float, float]:
        """Mean 1 - correlation before and after, over the pixels that are seen both times."""
        sums = self._buffer(24 * _SUM_GROUPS)
        run_once(self.level.device.queue, [
            bind(self.program, "sum_costs", (_SUM_GROUPS * _SUM_GROUP,), (_SUM_GROUP,), self._before, self._after,
                 self.level.target.pixels, sums)])
        before, after, pixels = self._read(sums, np.int64).reshape(-1, 3).sum(axis=0).tolist()
        sums.release()
        return (before / pixels / _ONE, after / pixels / _ONE) if pixels else (float("nan"), float("nan"))

    def medians(self) -> tuple[float, float]:
        """Median 1 - correlation before and after, over the pixels that are seen both times;
        NaN where there are none."""
        counts = self._buffer(HISTOGRAM)
        run_once(self.level.device.queue, [
            Fill(counts, np.uint32(0), HISTOGRAM),
            bind(self.program, "count_costs", (self.level.target.pixels,), None, self._before, self._after,
                 self.level.target.pixels, counts)])
        before, after = self._read(counts, np.uint32).reshape(2, _BINS)
        counts.release()
        return _median(before), _median(after)

    def release(self):
        """Give back what was found."""
        for buffer in filter(None, (self._before, self._after)):
            buffer.release()

    def _refuse(self, witnesses: Evidence, status: cl.Buffer):
        """Send back too what matches worse in the witnesses' photos, seen over its surroundings."""
        witnesses.weigh_after()
        level, size = self.level, self.level.target
        one, other = self._scratch()
        launches = [bind(self.program, "worse_costs", (size.pixels,), None, witnesses._before, witnesses._after,
                         size.pixels, one)]
        for _ in range(2):       # twice: nearer pixels count for more
            launches += self._sum_around(one, 2, other, one)
        launches.append(bind(self.program, "refuse", (size.pixels,), None, self._initial, level.arena["depth"],
                             size.pixels, one, status))
        run_once(level.device.queue, launches)

    def decide(self, witnesses: Evidence | None = None) -> tuple[cl.Buffer, cl.Buffer]:
        """Send back what the photos do not confirm; arena["depth"] holds what is accepted.

        `witnesses`, of photos that took no part, is weighed here.

        Returns
        -------
        status : uint8 a pixel, as in scene/status.py
        deviation : float32 a pixel
            Standard deviation of the depth, device units; infinite where nothing is known.
        """
        level, n = self.level, self.level.target.pixels
        solver, a = level.config.solver, level.arena
        status, deviation, size = self._buffer(n), self._buffer(4 * n), level.target
        around, bent = self._surroundings(), self._scratch()[0]
        deviation_program = build(level.device, "deviation.cl", level.defines)
        run_once(level.device.queue, [
            bind(self.program, "decide", (n,), None, self._initial, a["depth"], a["unit"], n, self._before, self._after,
                 around, float(solver.max_move), solver.tolerance * self.doubt.slack, float(solver.mismatch), status)])
        if witnesses:
            self._refuse(witnesses, status)
        run_once(level.device.queue, [
            bind(self.program, "feather", size.grid, None, self._initial, a["depth"], status, *size.grid),
            bind(deviation_program, "bends", size.grid, None, a["depth"], a["unit"], *size.grid, bent),
            bind(deviation_program, "deviate", size.grid, None, status, a["unit"], *size.grid, self._before,
                 self._after, bent, self.doubt.spread, self.doubt.misaligned, deviation)])
        return status, deviation

    def _surroundings(self) -> cl.Buffer:
        """1 - correlation and views under the refined depth, summed over the surroundings of each pixel."""
        rows, around = self._scratch()
        run_once(self.level.device.queue, self._sum_around(self._after, 3, rows, around))
        return around

    def _sum_around(self, values: cl.Buffer, stride: int, rows: cl.Buffer, sums: cl.Buffer) -> list:
        """Two floats of each pixel, `stride` apart in `values`, summed over the surroundings: by rows, then columns."""
        grid = self.level.target.grid
        return [bind(self.program, "sum_window", grid, None, source, step, *grid, dx, dy, out)
                for source, step, dx, dy, out in ((values, stride, 1, 0, rows), (rows, 2, 0, 1, sums))]

    def _scratch(self) -> list[cl.Buffer]:
        """Two buffers of two floats a pixel, of those that serve the steps."""
        return [self.level.arena[name] for name in ("upstream", "rendered")]

    def _weigh(self) -> cl.Buffer:
        level, size, warped = self.level, self.level.target, self._scratch()[0]
        evidence = self._buffer(12 * size.pixels)
        launches = [Fill(evidence, np.uint32(0), 12 * size.pixels)]
        for view in self.views:
            launches += [*level.given.fetch(view), *project.nearest(level, view)]
            launches += [bind(self.program, "warp_photo", size.grid, None, level.arena["depth"], level.arena["cameras"],
                              view, float(level.threshold(view)), project.z_first_argument(level),
                              level.given.photos[view], warped),
                         bind(self.program, "weigh", size.grid, None, warped, level.given.photos[0], size.width,
                              size.height, self.doubt.grain, evidence)]
        run_once(level.device.queue, launches)
        return evidence

    def _buffer(self, nbytes: int) -> cl.Buffer:
        return self.level.device.memory.buffer(self.level.device.context, nbytes)

    def _read(self, buffer: cl.Buffer, dtype=np.float32) -> np.ndarray:
        out = np.empty(buffer.size // np.dtype(dtype).itemsize, dtype)
        cl.enqueue_copy(self.level.device.queue, out, buffer)
        return out
