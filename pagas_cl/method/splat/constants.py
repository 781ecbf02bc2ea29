"""Numbers that kernels and host share, each written once; the twins (pagas_cl.method.reference) have their own.

SHARED are the -D defines of every kernel file but agree.cl.
"""

from pagas_cl.scene.depthmap import KEPT, NO_SURFACE, REFINED, REJECTED
from pagas_cl.scene.sampling import FAR, NEAR

# Work-items of the groups that sum up, and whole numbers that stand for 1 in sums of any order.
SUMMARY_GROUP, FIT_GROUP, COST_GROUP, PENALTY_GROUP = 64, 64, 64, 256
COST_ONE, TILE_ONE, LOSS_ONE = 2.0**20, 2.0**32, 2.0**40
COST_BINS = 1024              # of 1 - correlation, from 0 to 2
NUMBER, MEAN, QUANTILE, MEAN_SQUARE = range(4)                      # of a row of summary.cl
RATE, BEST, WAITED, DONE, LOSS = range(5)                           # of the schedule's state (step.cl)
HALO, MARGIN = 10, 16         # pixels of an SSIM window after the first; floats before and behind its partials
SHIFTS, OFFSETS = 7, 4        # moves of a patch along the direction of depth, and across it (measure.cl)

# Noise (standard deviation, 0 to 1) and misalignment (pixels) that the default weight of the smoothness is made for:
# chosen on the scenes of tests/bench/effects.py.
CLEAR_NOISE, MISALIGNED = 0.004, 0.13
MOST_MOVED = 0.5              # pixels of parallax that depths may move by before a z-buffer is made anew (level.py)
NOISY_DETAIL = 0.5            # share of a refined map's detail that is noise, above which that goes (mismatch.py)
# The same of specularity, one residual (what the exposure fit leaves, measure.cl) in two statistics, so that it takes
# two bars: whether a view is specular, by the 95th percentile of its samples (median over the context views), and
# where, by the mean over the context views at a sample (largest around it), which is smaller.
SPECULAR_VIEW, SPECULAR_PLACE = 0.009, 0.007
# Specularity from which on depth errors exceed what the sharpness of a match predicts, in proportion to it: fitted to
# scenes with truth (tests/bench/calibration.py).
SURE_SPECULARITY = 0.0125


def define(**numbers: float) -> tuple[str, ...]:
    """-D defines of `numbers`, floats as floating constants of C in single precision."""
    return tuple(f"{name}={f'{value!r}f' if isinstance(value, float) else value}" for name, value in numbers.items())


SHARED = define(
    NEAR=NEAR, FAR=FAR, NO_SURFACE=NO_SURFACE, REFINED=REFINED, KEPT=KEPT, REJECTED=REJECTED,
    SUMMARY_GROUP=SUMMARY_GROUP, FIT_GROUP=FIT_GROUP, COST_GROUP=COST_GROUP, PENALTY_GROUP=PENALTY_GROUP,
    COST_ONE=COST_ONE, TILE_ONE=TILE_ONE, LOSS_ONE=LOSS_ONE, COST_BINS=COST_BINS, HALO=HALO, MARGIN=MARGIN,
    RATE=RATE, BEST=BEST, WAITED=WAITED, DONE=DONE, LOSS=LOSS, SHIFTS=SHIFTS, OFFSETS=OFFSETS)
