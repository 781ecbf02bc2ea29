"""What speaks for refined cameras: pairs of photos that took no part, and views that agree with others (method section
9). Where a refinement of cameras fails is decided here."""

from collections.abc import Callable

import numpy as np

from pagas_cl.method.cameras.rounds import FINE, Rounds, State

# Shares of a mean robust cost, unless said otherwise; figures: tests/bench.
LEAST_GAIN = 0.03         # by which held-back pairs must cost less: less may be chance
LEAST_PROMISE = 0.005     # the same at half of the size: full size gains four to ten times as much (DTU at 0.2 to 0.6)
LEAST_FALL = 1e-4         # the same as a cost itself: photos that show nothing cost next to nothing
WRONG = 2.0               # times the usual cost from which the camera of a view is wrong,
UNLIKE = 0.1              # and the least cost then: photos of different things have a cost of 0.18
OUTLIER = 1.3             # times the usual cost from which a view is an outlier,
OUTLIER_SPREADS = 8.0     # and times the median difference between views
REACH = 0.125             # of a photo's width: cameras that are farther off were rarely brought back
WIDE_LOSS = 0.01          # by which wide pairs may cost more: less may be chance
FAILED = 0.6              # of the cost at an offset: a pair that costs more does not show the same where it should
MOST_FAILED = 0.25        # share of the pairs, and of the views, for which cameras are not to blame
_HALF = 0.5               # of the finest size: the one at which views are judged


def pairs_failed(rounds: Rounds, state: State) -> bool:
    """Whether photos are still so far from one another that they might lie anywhere."""
    found = rounds.judged(state.cameras, state.maps, rounds.pairs.held, _HALF)
    return _failed(found[:, 0], found[:, 2]) > MOST_FAILED


def too_far(costs: np.ndarray, offset_costs: np.ndarray, wrong: float, pixels: float, width: float) -> str:
    """Why cameras are refused as farther off than can be mended; empty where they are not. `costs` and `offset_costs`
    (n,): of pairs that took no part, in their place and with one photo offset; `wrong`: share of views whose cameras
    are wrong; `pixels` that whole photos are offset by; `width` of a photo, pixels."""
    share = max(_failed(costs, offset_costs), wrong)
    if share <= MOST_FAILED and not (pixels and wrong):      # where all were far off, one that is left out still is
        return ""
    others = (f"{share:.0%} of those looked at still show other things than the surface has there after the cameras "
              "were moved")
    mend = ("run a bundle adjustment of features first (colmap bundle_adjuster, or that of the program that the "
            "cameras are of)")
    if pixels < 1:
        return (f"no offset of whole photos was found, but {others}: is the surface far off, or of another scene? "
                f"Where it is not, {mend}")
    distance = f"about {pixels:.0f} pixels" if np.isfinite(pixels) else "more than can be measured"
    return f"photos are {distance} off, and {others}; at best {REACH * width:.0f} pixels can be brought back: {mend}"


def _failed(costs: np.ndarray, offset_costs: np.ndarray) -> float:
    """Share of pairs of photos that agree hardly better in their place than with one of them offset."""
    known = np.isfinite(costs) & (offset_costs > 10 * LEAST_FALL)
    return float((costs[known] > FAILED * offset_costs[known]).mean()) if known.any() else 0.0


def no_gain(costs: np.ndarray, seen_before: float, seen_after: float) -> str:
    """Why pairs that took no part do not speak for refined cameras, by their costs (n, 2), before and after."""
    if not len(costs):
        return "no pair of photos that took no part sees the same surface"
    before, after = costs.mean(axis=0)
    better = int((costs[:, 1] < costs[:, 0]).sum())
    figures = f"(mean mismatch {before:.4f} before, {after:.4f} after; {better} of {len(costs)} pairs better)"
    if before - after < max(LEAST_GAIN * before, LEAST_FALL) or 2 * better < len(costs):
        return f"the pairs of photos that took no part do not agree clearly better {figures}"
    if seen_after < 0.8 * seen_before:
        return f"pairs that took no part see less of the same surface {figures}"
    return ""


def no_promise(rounds: Rounds, state: State) -> str:
    """Why half of the size says that nothing is to be gained; empty where something is. `state` is used up."""
    before = rounds.judged(state.cameras, state.maps, rounds.pairs.held, _HALF)[:, 0]
    rounds.run(FINE[:1], state)
    after = rounds.judged(state.cameras, state.maps, rounds.pairs.held, _HALF)[:, 0]
    known = np.isfinite(before) & np.isfinite(after)
    better = int((after < before)[known].sum())
    if known.any() and (1 - LEAST_PROMISE) * before[known].mean() > after[known].mean() and 2 * better >= known.sum():
        return ""
    return (f"at half of the size {better} of {known.sum()} pairs of photos that took no part agree better, and all "
            f"together by less than {LEAST_PROMISE:.1%}")


def bent(costs: np.ndarray, seen_before: float, seen_after: float) -> str:
    """Why cameras of which neighbours agree better are refused all the same: views far apart agree worse."""
    if not len(costs):
        return ""
    before, after = costs.mean(axis=0)
    better = int((costs[:, 1] < costs[:, 0]).sum())
    worse = after > (1 + WIDE_LOSS) * before and 2 * better <= len(costs)      # most pairs: one that is off is no bend
    if not worse and seen_after >= 0.8 * seen_before:
        return ""
    return (f"neighbouring photos agree better, those of views far apart do not: a chain of views bends (mean "
            f"mismatch {before:.4f} before, {after:.4f} after; {better} of {len(costs)} wide pairs better)")


def wrong_views(rounds: Rounds, state: State, share: float = _HALF) -> set[int]:
    """Views that agree with none of the others, which agree among themselves."""
    return _costly(rounds, state, share, lambda usual, _: max(WRONG * usual, UNLIKE))


def outlier_views(rounds: Rounds, state: State) -> set[int]:
    """Views that agree with others clearly worse than these do among themselves: they may still be out of place."""
    return _costly(rounds, state, _HALF, lambda usual, spread: max(OUTLIER * usual, usual + OUTLIER_SPREADS * spread))


def _costly(rounds: Rounds, state: State, share: float, most: Callable[[float, float], float]) -> set[int]:
    """Views of which pairs cost more than `most(usual cost, median difference from it)`."""
    costs = rounds.agreement(state, share)
    known = np.isfinite(costs)
    if known.sum() < 4:
        return set()
    usual = float(np.median(costs[known]))
    spread = float(np.median(abs(costs[known] - usual)))
    return {int(k) for k in np.flatnonzero(known & (costs > most(usual, spread)))}
