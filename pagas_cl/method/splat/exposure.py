"""Launches of exposure.cl: gains and offsets of the context photos, fitted to the depth as it is (method section 7)."""

import numpy as np

from pagas_cl.method.splat import project
from pagas_cl.method.splat.buffers import SampleGrid
from pagas_cl.method.splat.constants import FIT_GROUP


def neutral(contexts: int) -> np.ndarray:
    """The table before anything is fitted, (gain, offset) x channels as photo.clh reads them: gain 1, offset 0."""
    return np.tile(np.float32([[1], [0]]), (1 + contexts, 1, 3))


def launches(programs, buffers, views) -> list:
    """Fit all context `views` to buffers.depth, each after its nearest surfaces."""
    found = []
    for view in views:
        found += [*view.fetch(), *project.nearest(programs, buffers, view), match(programs, buffers, view)]
    return [*found, fit(programs, buffers, views)]


def match(programs, buffers, view):
    """Colours of both photos at the samples, by the nearest surfaces in buffers.z_first, to buffers.matches."""
    grid = SampleGrid.over(view.target_size)
    return programs.bind("exposure.cl", "match_colors", (grid.count,), buffers, view, **grid.arguments)


def fit(programs, buffers, views):
    """From buffers.matches to buffers.exposure."""
    return programs.bind("exposure.cl", "fit_exposure", (3 * FIT_GROUP, len(views)), buffers, None, (FIT_GROUP, 1),
                         all_matches=buffers.matches, count=SampleGrid.over(views[0].target_size).count)


def fitted_before(steps: int) -> set[int]:
    """Before which steps of a level the fit is made: the better the depth, the better the match of the colours."""
    return {0, steps // 8, steps // 2} if steps else set()
