"""Launches of mismatch.cl: the variance that photos which do not match leave in a depth, against how much the surface
bends (method section 5.2)."""

from pagas_cl.config import MOST_RAISED, Config
from pagas_cl.runtime.program import run_once
from pagas_cl.splat.buffers import SampleGrid
from pagas_cl.splat.constants import NUMBER, QUANTILE
from pagas_cl.splat.measure import Rows

VIEWS = 3            # context views that are asked
_BENDS = 4           # rows before those of the views
_LEAST = 100         # samples that tell anything
_NORMAL = 0.6745     # median of |x| where x has a standard deviation of 1
# Growth of the mean square of second differences when their pixels lie twice as far apart: of a surface, the least, for
# one that is rough at every size (a smooth one bends more with distance: 9.6), and of errors, which have nothing to do
# with one another over 4 pixels. Fitted, as the two below, to made scenes with and without mismatch and to real pairs
# with truth (tests/bench/AGREEMENT.md).
_SURFACE, _ERRORS = 5.0, 2.0
_MATCH = 1.5         # variance of a depth, of that which one patch of one photo leaves
_BALANCED = 3.0      # variance of a surface's bends over that of errors for which the default weight is right


def measured(level) -> float:
    """By how much the smoothness of `level` is too weak for errors that its depth has by now: 1 where it is right, less
    where the surface bends more than errors do. 0 where too little is seen to tell. Waits for the device."""
    views, grid = level.views[:VIEWS], SampleGrid.over(level.target.size)
    rows = Rows(level.device, [(-20, 5, 0.5)] * _BENDS + [(-30, 10, 0.5)] * len(views), grid.count)

    def sample(kernel, view, **arguments):
        return level.programs.bind("mismatch.cl", kernel, (grid.count,), level.buffers, view, rows=rows.values,
                                   **grid.arguments, **arguments)

    run_once(level.device.queue, [sample("sample_bends", level.target)])
    for number, view in enumerate(views):
        run_once(level.device.queue, [*view.fetch(), sample("sample_match", view, row=_BENDS + number)])
    run_once(level.device.queue, [rows.summarize()])
    found = rows.read()
    if min(found[:_BENDS, NUMBER].min(), found[_BENDS:, NUMBER].max()) < _LEAST:
        return 0.0
    across, down, across_far, down_far = (2 ** found[:_BENDS, QUANTILE] / _NORMAL) ** 2
    return balance((across + down) / 2, (across_far + down_far) / 2,
                   2 ** float(max(row[QUANTILE] for row in found[_BENDS:] if row[NUMBER] >= _LEAST)))


def balance(near: float, far: float, match: float) -> float:
    """Variance of what errors bend over that of what the surface does, as a multiple of what the default weight is made
    for. `near`, `far`: mean squares of second differences over some pixels and over twice as many; `match`: variance
    of a depth by one patch of one photo. All in squared pixels of parallax."""
    by_growth = near * (_SURFACE - far / near) / (_SURFACE - _ERRORS)
    errors = max(0.0, min(by_growth, 6 * _MATCH * match))           # of three errors, weighted 1, -2, 1
    return min(MOST_RAISED, _BALANCED * errors / max(near - errors, 1e-3 * near))


def is_asked(config: Config) -> bool:
    """Whether it is measured, and the smoothness raised by it."""
    return config.effects.mismatch in ("auto", "on") and config.smoothness.kind == "planar"


def nbytes(samples: int, contexts: int) -> int:
    """Bytes of the device that measuring takes."""
    return Rows.nbytes(_BENDS + min(VIEWS, contexts), samples)
