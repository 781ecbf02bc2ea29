"""Launches of patches.cl, evidence.cl, deviation.cl: which depths photos confirm, how sure each is
(method section 7)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl

from pagas_cl.method.splat import mismatch, project
from pagas_cl.method.splat.buffers import EvidenceBuffers
from pagas_cl.method.splat.constants import CLEAR_NOISE, COST_BINS, COST_GROUP, COST_ONE
from pagas_cl.method.splat.inputs import enqueue_each
from pagas_cl.runtime.memory import download, release
from pagas_cl.runtime.program import Fill, run_once

_SUM_GROUPS = 256                    # groups that share the pixels of a sum
_SUMS = 24 * _SUM_GROUPS             # bytes that add costs up, before and after
_HISTOGRAM = 8 * COST_BINS           # bytes that count them
_UNKNOWN = (float("nan"), float("nan"))


def sums_bytes(held_out: int) -> int:
    """Bytes of the device that sums take which are read in the end."""
    return _SUMS + held_out * _HISTOGRAM


@dataclass(frozen=True, eq=False)
class EvidenceDecision:
    """On the device, per pixel: status uint8, as in scene/depthmap.py; standard deviation of the depth, float32, device
    units, infinite where nothing is known. Before and after, over the pixels that are seen: mean 1 - correlation with
    the views' photos, of all refined depth, and median with each held-out view's photo, of what is accepted.
    `uninformative`: number of depths that would count as refined, but around which photos show nothing."""

    status: cl.Buffer
    deviation: cl.Buffer
    cost: tuple[float, float]
    held_out: tuple[tuple[float, float], ...]
    uninformative: int
    mismatch: float                     # share of its detail that is noise; and square of what it bends over the
    resolved: float                     # variance that photos leave (mismatch.py); NaN where not measured

    def release(self):
        release(self.status, self.deviation)


@dataclass(frozen=True)
class EvidencePrior:
    """What was measured of a view beforehand (Measurements), as far as its evidence depends on it: by how much errors
    exceed what the match predicts, pixels that photos are off, noise of a photo (0 to 1)."""

    error_factor: float = 1.0
    misaligned: float = 0.0
    noise: float = 0.0

    @classmethod
    def of(cls, measured) -> "EvidencePrior":
        if not measured:
            return cls()
        return cls(float(measured.error_factor), float(measured.misaligned), float(measured.noise))

    @property
    def noise_variance(self) -> float:
        """Variance of the noise of luma, which is 4/3 of that of the mean of the channels, beyond one grey level."""
        return max(0.0, 4 / 3 * self.noise**2 - 1 / 255**2)

    @property
    def slack(self) -> float:
        """By how much a correlation may fall by chance, in that of a clear photo."""
        return max(1.0, (self.noise / CLEAR_NOISE) ** 2)


def _median(counts: np.ndarray) -> float:
    """Median of costs that were counted in bins of 0 to 2, linear within a bin."""
    total = int(counts.sum())
    if not total:
        return float("nan")
    upto = np.cumsum(counts)
    k = int(np.searchsorted(upto, total / 2))
    return 2 / len(counts) * (k + (total / 2 - (upto[k] - counts[k])) / max(1, counts[k]))


class Evidence:
    """Weighs the initial and the refined depth of one level, buffers.depth, by the photos of `views`, of which there is
    at least one. `initial` is a buffer that holds the initial depth for as long as this lives; `buffers` of the class
    EvidenceBuffers: what is rendered in them is scratch here. `before` and `after`: what was weighed of both depths,
    (cost, views, information) a pixel."""

    def __init__(self, programs, buffers: EvidenceBuffers, views, initial: cl.Buffer,
                 prior: EvidencePrior = EvidencePrior()):
        self.programs, self.buffers, self.views, self.prior = programs, buffers, list(views), prior
        self.device, self.size = programs.device, self.views[0].target_size
        self._initial, self.scratch = initial, (buffers.v_rendered, buffers.rendered)     # two floats a pixel each
        self.before = self.after = None

    def weigh(self):
        """Weigh the initial depth, and the depth as it is now."""
        self.release()
        self.before, self.after = (self.device.buffer(12 * self.size.pixels) for _ in range(2))
        self._run([Fill(evidence, np.uint32(0), evidence.size) for evidence in (self.before, self.after)])
        self._add(self.views, {"depth": self._initial, "evidence": self.before},
                  {"depth": self.buffers.depth, "evidence": self.after})

    def _add(self, views, *given: dict, floor_share: float = 1.0):
        """What the photos of `views` say of depth maps, added to the evidence of each."""
        depth, (warped, grey) = given[0]["depth"], self.scratch
        enqueue_each(self.device.queue, views, lambda view: [
            *project.nearest(self.programs, self.buffers, view, depth=depth),
            self.programs.bind_rows("patches.cl", "warp_photo", self.buffers, view, depth=depth, warped=warped,
                                    grey=grey),
            self.programs.bind_rows("patches.cl", "weigh", self.buffers, view, warped=warped, grey=grey,
                                    noise_variance=self.prior.noise_variance, floor_share=floor_share,
                                    evidence=given[0]["evidence"], **self.size.extent)], *given)

    def release(self):
        release(self.before, self.after)
        self.before = self.after = None

    # What is summed up is promised, by what waits for it, so that the device goes on with what is enqueued next.

    def costs(self) -> Callable[[], tuple[float, float]]:
        """Mean 1 - correlation before and after, over the pixels that are seen both times; NaN where there are none."""
        sums = self.device.buffer(_SUMS)
        self._run([self.bind("sum_costs", grid=(_SUM_GROUPS * COST_GROUP,), group=(COST_GROUP,), sums=sums,
                             **self._both)])

        def means(found: np.ndarray) -> tuple[float, float]:
            before, after, pixels = found.sum(axis=0).tolist()
            return (before / pixels / COST_ONE, after / pixels / COST_ONE) if pixels else _UNKNOWN

        return self._promised(sums, (_SUM_GROUPS, 3), np.int64, means)

    def medians(self) -> Callable[[], tuple[float, float]]:
        """The same of medians."""
        counts = self.device.buffer(_HISTOGRAM)
        self._run([Fill(counts, np.uint32(0), _HISTOGRAM),
                   self.bind("count_costs", grid=(self.size.pixels,), counts=counts, **self._both)])
        return self._promised(counts, (2, COST_BINS), np.uint32, lambda found: (_median(found[0]), _median(found[1])))

    def _promised(self, sums: cl.Buffer, shape, dtype, finish: Callable[[np.ndarray], Any]) -> Callable[[], Any]:
        """A function that reads `sums`, gives them back, and returns what `finish` makes of them."""
        def read() -> Any:
            found = download(self.device, sums, shape, dtype)
            sums.release()
            return finish(found)

        return read

    def _refuse(self, evidence: "Evidence", status: cl.Buffer):
        """Reject too what matches worse in the held-out view's photo, seen over its surroundings."""
        evidence.weigh()
        pixels = self.size.pixels
        one, other = self.scratch
        launches = [self.bind("worse_costs", grid=(pixels,), worse=one, **evidence._both)]
        for _ in range(2):       # twice: nearer pixels count for more
            launches += self.sum_around(one, 2, other, one)
        self._run([*launches, self.bind("refuse", grid=(pixels,), count=pixels, worse=one, status=status)])
        evidence.release()

    def decide(self, held_out: "Sequence[Evidence]" = (), with_costs: bool = True) -> EvidenceDecision:
        """Send back what the photos do not confirm; buffers.depth holds what is accepted. `held_out`, each of a photo
        that took no part, are weighed here. `with_costs`: whether the decision has cost and held_out."""
        self.weigh()
        n = self.size.pixels
        bent, around = self.scratch
        solver = self.programs.config.solver
        status, deviation = self.device.buffer(n), self.device.buffer(4 * n)
        self._run([*self.sum_around(self.after, 3, bent, around),
                   self.bind("decide", grid=(n,), initial=self._initial, around=around, max_move=solver.max_move,
                             tolerance=solver.tolerance * self.prior.slack, mismatch=solver.mismatch, status=status,
                             **self._both)])
        for evidence in held_out:       # each by itself: in a mean, one that errs as the context views do hides another
            self._refuse(evidence, status)
        extent, config = self.size.extent, self.programs.config
        self._run([self.bind("feather", initial=self._initial, status=status, **extent)])
        read_mismatch = mismatch.take_back(self, status, self._initial, config.effects.mismatch == "on") if (
            mismatch.is_enabled(config)) else (lambda: _UNKNOWN)
        self._run([self.bind("bends", file="deviation.cl", bent=bent, **extent),
                   self.bind("deviate", file="deviation.cl", status=status, before=self.before, after=self.after,
                             bent=bent, error_factor=self.prior.error_factor, misaligned=self.prior.misaligned,
                             mismatch=solver.mismatch, deviation=deviation, **extent)])
        if not with_costs:
            return EvidenceDecision(status, deviation, _UNKNOWN, (), 0, *read_mismatch())
        costs, judged = self.costs(), [evidence.judge() for evidence in held_out]
        uninformative = self._hold_uninformative(status, deviation)
        medians = tuple(read() for read in judged)
        return EvidenceDecision(status, deviation, costs(), medians, uninformative(), *read_mismatch())

    def _hold_uninformative(self, status: cl.Buffer, deviation: cl.Buffer) -> Callable[[], int]:
        """Take back what smoothness alone moved; the number of depths that are where they were, then."""
        counts, grid = self.device.buffer(4), (self.size.pixels,)
        one, other = self.scratch
        known = {"count": self.size.pixels, "status": status, "deviation": deviation}
        self._run([Fill(counts, np.uint32(0), 4), self.bind("mark_informative", grid=grid, informative=one, **known),
                   *self.sum_around(one, 2, other, one),
                   self.bind("hold_uninformative", grid=grid, initial=self._initial, around=one, uninformative=counts,
                             **known)])
        return self._promised(counts, 1, np.uint32, lambda found: int(found[0]))

    def of_accepted(self, views, floor_share: float) -> cl.Buffer:
        """What the photos of `views` say of the depth as it is now."""
        evidence = self.device.buffer(12 * self.size.pixels)
        self._run([Fill(evidence, np.uint32(0), evidence.size)])
        self._add(views, {"depth": self.buffers.depth, "evidence": evidence}, floor_share=floor_share)
        return evidence

    def judge(self) -> Callable[[], tuple[float, float]]:
        """Medians under the depth as it is now."""
        self.weigh()
        medians = self.medians()
        self.release()
        return medians

    @property
    def _both(self) -> dict:
        return {"before": self.before, "after": self.after, "count": self.size.pixels}

    def sum_around(self, values: cl.Buffer, stride: int, rows: cl.Buffer, sums: cl.Buffer) -> list:
        """Two floats of each pixel, `stride` apart in `values`, summed over the surroundings: by rows, then columns."""
        return [self.bind("sum_window", values=source, stride=step, dx=dx, dy=dy, sums=out, **self.size.extent)
                for source, step, dx, dy, out in ((values, stride, 1, 0, rows), (rows, 2, 0, 1, sums))]

    def bind(self, kernel: str, *, file="evidence.cl", grid=None, group=None, **arguments):
        return self.programs.bind(file, kernel, grid or self.size, self.buffers, None, group, **arguments)

    def _run(self, launches):
        run_once(self.device.queue, launches)
