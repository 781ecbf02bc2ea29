"""Launches of evidence.cl and deviation.cl: which depths the photos confirm, how sure each is (method section 7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from pagas_cl.runtime.program import Fill, bind, build, run_once
from pagas_cl.runtime.transfer import download
from pagas_cl.splat import project

_SUM_GROUP, _SUM_GROUPS, _ONE = 64, 256, 2**20      # as in evidence.cl

_BINS = 1024        # of 1 - correlation, as in evidence.cl
HISTOGRAM = 8 * _BINS       # bytes that count them, before and after


@dataclass(frozen=True, eq=False)
class EvidenceDecision:
    """On the device, per pixel: status uint8, as in scene/depthmap.py; standard deviation of the depth, float32, device
    units, infinite where nothing is known. Before and after, over the pixels that are seen: mean 1 - correlation with
    the views' photos, of all refined depth, and median with each held-out view's photo, of what is accepted."""

    status: cl.Buffer
    deviation: cl.Buffer
    cost: tuple[float, float]
    held_out: tuple[tuple[float, float], ...]

    def release(self):
        """Give the buffers back."""
        self.status.release()
        self.deviation.release()


@dataclass(frozen=True)
class EvidencePrior:
    """What was measured of a view beforehand (Measurements), as far as its evidence depends on it: by how much errors
    exceed what a match tells, pixels that photos are off, noise of a photo (0 to 1)."""

    error_factor: float = 1.0
    misaligned: float = 0.0
    noise: float = 0.0

    @classmethod
    def of(cls, measured) -> EvidencePrior:
        """From Measurements, or None."""
        if not measured:
            return NO_PRIOR
        return cls(float(measured.error_factor), float(measured.misaligned), float(measured.noise))

    @property
    def noise_variance(self) -> float:
        """Variance of the noise of luma, which is 4/3 of that of the mean of the channels, beyond one grey level."""
        return max(0.0, 4 / 3 * self.noise**2 - 1 / 255**2)

    @property
    def slack(self) -> float:
        """By how much a correlation may fall by chance, in that of a clear photo."""
        return max(1.0, (self.noise / 0.004) ** 2)


NO_PRIOR = EvidencePrior()


def _median(counts: np.ndarray) -> float:
    """Median of costs that were counted in bins of 0 to 2, linear within a bin."""
    total = int(counts.sum())
    if not total:
        return float("nan")
    upto = np.cumsum(counts)
    k = int(np.searchsorted(upto, total / 2))
    return 2 / len(counts) * (k + (total / 2 - (upto[k] - counts[k])) / max(1, counts[k]))


class Evidence:
    """Weighs the initial and the refined depth of one level by the photos of `view_numbers` (numbers from 1).

    `initial` is a buffer that holds the initial depth for as long as this lives.
    """

    def __init__(self, level, view_numbers, initial: cl.Buffer, prior: EvidencePrior = NO_PRIOR):
        self.level, self.view_numbers, self._initial = level, list(view_numbers), initial
        self.program, self.prior = build(level.device, "evidence.cl", level.defines), prior
        self._before = self._after = None

    def weigh(self):
        """Weigh the initial depth, and the depth as it is now."""
        self.release()
        pixels, queue = self.level.target.pixels, self.level.device.queue
        self._before, self._after = (self._buffer(12 * pixels) for _ in range(2))
        run_once(queue, [Fill(evidence, np.uint32(0), 12 * pixels) for evidence in (self._before, self._after)])
        for view in self.view_numbers:
            run_once(queue, [*self.level.given.fetch(view), *self._add(view, self._initial, self._before),
                             *self._add(view, self.level.arena["depth"], self._after)])

    def _add(self, view: int, depth: cl.Buffer, evidence: cl.Buffer) -> list:
        """What the photo of `view` says of `depth`, added to `evidence`."""
        level, size, warped = self.level, self.level.target, self._scratch()[0]
        return [*project.nearest(level, view, depth),
                bind(self.program, "warp_photo", size.grid, None, depth, level.arena["cameras"], view,
                     float(level.threshold(view)), project.z_first_argument(level), level.given.photos[view], warped),
                bind(self.program, "weigh", size.grid, None, warped, level.given.photos[0], size.width, size.height,
                     self.prior.noise_variance, evidence)]

    def release(self):
        """Give back what was weighed."""
        for buffer in filter(None, (self._before, self._after)):
            buffer.release()
        self._before = self._after = None

    def costs(self) -> tuple[float, float]:
        """Mean 1 - correlation before and after, over the pixels that are seen both times."""
        sums = self._buffer(24 * _SUM_GROUPS)
        run_once(self.level.device.queue, [
            bind(self.program, "sum_costs", (_SUM_GROUPS * _SUM_GROUP,), (_SUM_GROUP,), self._before, self._after,
                 self.level.target.pixels, sums)])
        before, after, pixels = download(self.level.device, sums, (_SUM_GROUPS, 3), np.int64).sum(axis=0).tolist()
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
        before, after = download(self.level.device, counts, (2, _BINS), np.uint32)
        counts.release()
        return _median(before), _median(after)

    def _refuse(self, evidence: Evidence, status: cl.Buffer):
        """Reject too what matches worse in the held-out view's photo, seen over its surroundings."""
        evidence.weigh()
        size, (one, other) = self.level.target, self._scratch()
        launches = [bind(self.program, "worse_costs", (size.pixels,), None, evidence._before, evidence._after,
                         size.pixels, one)]
        for _ in range(2):       # twice: nearer pixels count for more
            launches += self._sum_around(one, 2, other, one)
        launches.append(bind(self.program, "refuse", (size.pixels,), None, size.pixels, one, status))
        run_once(self.level.device.queue, launches)
        evidence.release()

    def decide(self, held_out: Sequence[Evidence] = ()) -> EvidenceDecision:
        """Send back what the photos do not confirm; arena["depth"] holds what is accepted.

        `held_out`, each of a photo that took no part, are weighed here.
        """
        self.weigh()
        level, n = self.level, self.level.target.pixels
        solver, a = level.config.solver, level.arena
        status, deviation, size = self._buffer(n), self._buffer(4 * n), level.target
        around, bent = self._surroundings(), self._scratch()[0]
        deviation_program = build(level.device, "deviation.cl", level.defines)
        run_once(level.device.queue, [
            bind(self.program, "decide", (n,), None, self._initial, a["depth"], a["depth_per_parallax"], n,
                 self._before,
                 self._after, around, float(solver.max_move), solver.tolerance * self.prior.slack,
                 float(solver.mismatch), status)])
        for evidence in held_out:       # each by itself: in a mean, one that errs as the context views do
                                        # hides another
            self._refuse(evidence, status)
        run_once(level.device.queue, [
            bind(self.program, "feather", size.grid, None, self._initial, a["depth"], status, *size.grid),
            bind(deviation_program, "bends", size.grid, None, a["depth"], a["depth_per_parallax"], *size.grid, bent),
            bind(deviation_program, "deviate", size.grid, None, status, a["depth_per_parallax"], *size.grid,
                 self._before, self._after, bent, self.prior.error_factor, self.prior.misaligned, deviation)])
        return EvidenceDecision(status, deviation, self.costs(), tuple(evidence.judge() for evidence in held_out))

    def judge(self) -> tuple[float, float]:
        """Medians under the depth as it is now."""
        self.weigh()
        medians = self.medians()
        self.release()
        return medians

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
        return [self.level.arena[name] for name in ("v_rendered", "rendered")]

    def _buffer(self, nbytes: int) -> cl.Buffer:
        return self.level.device.memory.buffer(self.level.device.context, nbytes)
