"""Launches of exposure.cl: gains and offsets of the context photos, fitted to the depth as it is (method section 7)."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np

from pagas_cl.runtime.arena import BufferSpec
from pagas_cl.runtime.program import bind, build
from pagas_cl.splat import project
from pagas_cl.splat.constants import FIT_GROUP

MOST_SAMPLES = 4096       # about; rows and columns are whole


@dataclass(frozen=True)
class Grid:
    """Samples of an image: `across` x `down` of them, `stride` pixels apart."""

    stride: int
    across: int
    down: int

    @classmethod
    def over(cls, size) -> Grid:
        """At most about MOST_SAMPLES, never more than twice as many, however narrow the image."""
        stride = max(ceil(sqrt(size.pixels / MOST_SAMPLES)), ceil(max(size.width, size.height) / (2 * MOST_SAMPLES)), 1)
        return cls(stride, -(-size.width // stride), -(-size.height // stride))

    @property
    def count(self) -> int:
        return self.across * self.down


def buffers(target, contexts: int) -> list[BufferSpec]:
    """What the fit needs: gains and offsets of the target and each context view, (gain, offset) x channels as photo.clh
    reads them, and matched colours."""
    return [BufferSpec("exposure", (1 + contexts, 2, 3), np.float32),
            BufferSpec("matches", (contexts, Grid.over(target).count, 8), np.float32)]


def neutral(contexts: int) -> np.ndarray:
    """The table before anything is fitted: gain 1, offset 0."""
    table = np.zeros((1 + contexts, 2, 3), np.float32)
    table[:, 0] = 1
    return table


def launches(level) -> list:
    """Fit all context views to arena["depth"], each after its nearest surfaces."""
    return [launch for view in range(1, 1 + len(level.contexts))
            for launch in (*level.given.fetch(view), *project.nearest(level, view), match(level, view))] + [fit(level)]


def match(level, view: int):
    """Colours of both photos at the samples, by the nearest surfaces that arena["z_first"] holds for this view."""
    a, grid, given = level.arena, Grid.over(level.target), level.given
    return bind(build(level.device, "exposure.cl", level.defines), "match_colors", (grid.count,), None, a["depth"],
                a["cameras"], view, float(level.threshold(view)), project.z_first_argument(level),
                given.photos[0], given.photos[view], grid.stride, grid.across, grid.count, a["matches"])


def fit(level):
    """From arena["matches"] to arena["exposure"]."""
    views = len(level.contexts)
    return bind(build(level.device, "exposure.cl", level.defines), "fit_exposure", (3 * FIT_GROUP, views),
                (FIT_GROUP, 1), level.arena["matches"], Grid.over(level.target).count, level.arena["exposure"])


def fitted_before(steps: int) -> set[int]:
    """Before which steps of a level the fit is made: the better the depth, the better the match of the colours."""
    return {0, steps // 8, steps // 2} if steps else set()
