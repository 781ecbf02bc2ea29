"""What speaks for refined cameras: pairs of photos that took no part, and views that agree with others (method section
9)."""

from collections.abc import Callable

import numpy as np

from pagas_cl.method.cameras.rounds import Rounds, Stage, State

LEAST_GAIN = 0.03         # of the held-back pairs' cost: less may be chance
LEAST_FALL = 1e-4         # of that cost itself: photos that show nothing cost next to nothing
WRONG = 2.0               # a view whose pairs agree so many times worse than the others' has a wrong camera
UNLIKE = 0.1              # and so badly: photos of different things have a cost of 0.18
STRAY, ODD = 1.3, 8.0     # so many times worse it may be elsewhere, if that is so many times what views differ by
REACH = 0.125             # of a photo's width: farther off cameras were rarely brought back
WIDE_LOSS = 0.01          # of the wide pairs' cost: less may be chance
LOST = 0.6                # of the cost beside its place: a photo that costs more is not in its place
MOST_LOST = 0.25          # share of the pairs, and of the views, for which cameras are not to blame


def lost(rounds: Rounds, state: State) -> bool:
    """Whether photos are still so far from one another that they might lie anywhere."""
    found = rounds.judged(state.cameras, state.maps, rounds.pairs.held, Stage(0.5, 0.7, 0))
    return bool(_lost(found[:, 0], found[:, 2]) > MOST_LOST)


def beyond(costs: np.ndarray, beside: np.ndarray, wrong: float, pixels: float, width: float) -> str:
    """Why cameras are refused as farther off than can be mended: costs of pairs that took no part, (n,), in their place
    and beside it; the share of views whose cameras are wrong; pixels that whole photos lie beside one another, and of
    their width."""
    share = max(_lost(costs, beside), wrong)
    if share <= MOST_LOST and not (pixels and wrong):      # where all were far off, one that is left out still is
        return ""
    told = f"about {pixels:.0f} pixels" if np.isfinite(pixels) else "more than can be measured"
    return (f"photos are {told} off, and {share:.0%} of those looked at still show other things than "
            f"the surface has there after the cameras were moved; at best {REACH * width:.0f} pixels can be brought "
            "back: run a bundle adjustment of features first (colmap bundle_adjuster, or that of the program that the "
            "cameras are of)")


def _lost(costs: np.ndarray, beside: np.ndarray) -> float:
    """Share of pairs of photos that agree hardly better in their place than beside it."""
    known = np.isfinite(costs) & (beside > 10 * LEAST_FALL)
    return float((costs[known] > LOST * beside[known]).mean()) if known.any() else 0.0


def no_gain(costs: np.ndarray, seen_before: float, seen_after: float) -> str:
    """Why pairs that took no part do not speak for refined cameras, by their costs (n, 2), before and after."""
    if not len(costs):
        return "no pair of photos that took no part sees the same surface"
    before, after = costs.mean(axis=0)
    better = int((costs[:, 1] < costs[:, 0]).sum())
    told = f"(mean mismatch {before:.4f} before, {after:.4f} after; {better} of {len(costs)} pairs better)"
    if before - after < max(LEAST_GAIN * before, LEAST_FALL) or 2 * better < len(costs):
        return f"the pairs of photos that took no part do not agree clearly better {told}"
    if seen_after < 0.8 * seen_before:
        return f"pairs that took no part see less of the same surface {told}"
    return ""


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


def wrong_views(rounds: Rounds, state: State, stage: Stage) -> set[int]:
    """Views that agree with none of the others, which agree among themselves."""
    return _dear(rounds, state, stage, lambda usual, _: max(WRONG * usual, UNLIKE))


def strays(rounds: Rounds, state: State) -> set[int]:
    """Views that agree with others clearly worse than these do among themselves: they may be elsewhere still."""
    return _dear(rounds, state, Stage(0.5, 0.7, 0), lambda usual, spread: max(STRAY * usual, usual + ODD * spread))


def _dear(rounds: Rounds, state: State, stage: Stage, most: Callable[[float, float], float]) -> set[int]:
    """Views of which pairs cost more than `most(usual cost, median difference from it)`."""
    costs = rounds.agreement(state.cameras, state.maps, stage)
    known = np.isfinite(costs)
    if known.sum() < 4:
        return set()
    usual = float(np.median(costs[known]))
    return {int(k) for k in np.flatnonzero(known & (costs > most(usual, float(np.median(abs(costs[known] - usual))))))}
