"""Numbers that kernels and host share, each written once; the twins (tests/twins) have their own.

SHARED are the -D defines of every kernel file but agree.cl."""

from pagas_cl.scene.depthmap import KEPT, NO_SURFACE, REFINED, REJECTED
from pagas_cl.scene.sampling import FAR, NEAR

# Layout: what host and kernels agree on. A change changes no result beyond rounding, but for COST_BINS, SHIFTS,
# OFFSETS and HALO (11 pixels: the window of SSIM).
#
# name and value         unit            what it is
SUMMARY_GROUP = 64       # work-items      that sum up a row (summary.cl)
FIT_GROUP = 64           # work-items      that fit a channel's exposure (exposure.cl)
COST_GROUP = 64          # work-items      that add up costs (evidence.cl)
PENALTY_GROUP = 256      # work-items      that add up the loss of smoothness (smooth.cl)
COST_ONE = 2.0**20       # integer         that stands for 1 in sums of costs of any order
TILE_ONE = 2.0**32       # integer         the same in the loss of a tile (window.clh)
LOSS_ONE = 2.0**40       # integer         the same in the loss of a step
COST_BINS = 1024         # bins            of 1 - correlation, from 0 to 2: resolution of a median
HALO = 10                # pixels          of an SSIM window after the first
MARGIN = 16              # floats          before and behind the partials of SSIM
SHIFTS = 7               # positions       of a patch along the direction of depth, one pixel apart (measure.cl)
OFFSETS = 4              # positions       of a patch across it
NUMBER, MEAN, QUANTILE, MEAN_SQUARE = range(4)      # columns of a row of summary.cl
RATE, BEST, WAITED, DONE, LOSS = range(5)           # places in the schedule's state (step.cl)

# Constants of the method. Those that come from the paper are settings (pagas_cl.config); these were added.
#
# name and value             unit                  what it is; origin; what a larger value does
CLEAR_NOISE = 0.004          # colour, 0 to 1        standard deviation of a photo's noise that the default smoothness
                             #                       is made for; scenes of tests/bench/effects.py; noisy photos are
                             #                       smoothed less
MISALIGNED = 0.13            # pixels                epipolar residual that it is made for; the same scenes; photos that
                             #                       do not fit one another are smoothed less
MOST_MOVED = 0.5             # pixels of parallax    that depths may move by before a z-buffer is made anew (level.py);
                             #                       section 4; faster, first surfaces lag behind
NOISY_DETAIL = 0.5           # share                 of a refined map's detail that is noise, above which it goes
                             #                       (mismatch.py); section 5.2; more maps keep their detail
SPECULAR_VIEW = 0.009        # colour, 0 to 1        residual of the exposure fit (measure.cl) of a specular view: 95th
                             #                       percentile of its samples, median over the context views; section
                             #                       8; fewer views count as specular
SPECULAR_PLACE = 0.007       # colour, 0 to 1        the same residual at a specular place: mean over the context views,
                             #                       largest around it, a smaller statistic; section 8; fewer places
                             #                       are smoothed more
SURE_SPECULARITY = 0.0125    # colour, 0 to 1        from which on depth errors exceed what the sharpness of a match
                             #                       predicts, in proportion; fitted to scenes with truth
                             #                       (tests/bench/calibration.py); deviations of shiny surfaces shrink


def define(**numbers: float) -> tuple[str, ...]:
    """-D defines of `numbers`, floats as floating constants of C in single precision."""
    return tuple(f"{name}={f'{value!r}f' if isinstance(value, float) else value}" for name, value in numbers.items())


SHARED = define(
    NEAR=NEAR, FAR=FAR, NO_SURFACE=NO_SURFACE, REFINED=REFINED, KEPT=KEPT, REJECTED=REJECTED,
    SUMMARY_GROUP=SUMMARY_GROUP, FIT_GROUP=FIT_GROUP, COST_GROUP=COST_GROUP, PENALTY_GROUP=PENALTY_GROUP,
    COST_ONE=COST_ONE, TILE_ONE=TILE_ONE, LOSS_ONE=LOSS_ONE, COST_BINS=COST_BINS, HALO=HALO, MARGIN=MARGIN,
    RATE=RATE, BEST=BEST, WAITED=WAITED, DONE=DONE, LOSS=LOSS, SHIFTS=SHIFTS, OFFSETS=OFFSETS)
