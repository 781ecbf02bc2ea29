"""Which depths of a refined view evidence has moved; whether it is to be trusted as a whole, or returned as it came."""

import numpy as np

from pagas_cl.result import KEPT, REFINED, REJECTED

MOST_REFUSED = 2 / 3     # a view with a larger share of rejected depths is not to be trusted as a whole
LEAST_GAIN = 0.01        # of 1 - correlation in photos that took no part: less may be chance
MISALIGNED = 0.2         # pixels; only photos that are off by more raise the question whether the cameras are right
ENOUGH = 3               # photos that took no part: cameras that are off agree by chance, n of them one time in 2^n

AROUND = 7               # pixels to each side of a depth in which photos must show something, as far as they move it
ENOUGH_AROUND = 60       # pixels there that photos speak for; with fewer a depth moves less, without any it stays


def moved_by_evidence(refined, depth) -> tuple[np.ndarray, np.ndarray]:
    """Depth and status of a view in which REFINED is only what moved from `depth`, with photos that speak for it or for
    depths around it. What smoothness alone moved, where photos show nothing far and wide, is KEPT, as it came."""
    silent = np.isinf(refined.deviation) & (refined.status == REFINED)
    if not _has_blocks(silent):
        return refined.depth, refined.status
    around = _number_around((refined.status == REFINED) & ~silent)
    less = np.flatnonzero(silent & (around < ENOUGH_AROUND))
    moved, status = refined.depth.copy(), refined.status.copy()
    given, share = np.asarray(depth, np.float32).take(less), around.take(less) / np.float32(ENOUGH_AROUND)
    to = given + share * (moved.take(less) - given)
    moved.put(less, to)
    status.put(less[to == given], KEPT)
    return moved, status


def _has_blocks(silent: np.ndarray) -> bool:
    """Whether any aligned block of 8 x 8 pixels is silent throughout, as any 15 x 15 pixels hold one."""
    rows, columns = (n // 8 * 8 for n in silent.shape)
    eights = np.ascontiguousarray(silent[:rows, :columns]).view(np.uint64) == 0x0101010101010101
    return bool(eights.reshape(rows // 8, 8, columns // 8).all(axis=1).any()) or bool(silent.all())


def _number_around(which: np.ndarray) -> np.ndarray:
    """How many are true within 7 pixels (AROUND) of each: uint8 (H, W), at most 15 * 15."""
    sums = np.pad(which.view(np.uint8), AROUND)
    for axis in (0, 1):
        one = sums.swapaxes(0, axis)
        two = one[:-1] + one[1:]
        four = two[:-2] + two[2:]
        eight = four[:-4] + four[4:]
        sums = (eight[:-7] + four[8:-3] + two[12:-1] + one[14:]).swapaxes(0, axis)
    return sums


def nothing_reason(refined, status) -> str:
    """Why no depth of a view was refined, by the `status` of `moved_by_evidence`; empty where one was."""
    if (status == REFINED).any():
        return ""
    if (status == REJECTED).any():
        return "the photos confirm no refined depth"
    if (refined.status == REFINED).any():
        return "no depth moved by what the photos show (are they black, or of one colour?)"
    return "no other photo sees a depth of it that its mask leaves"


def rejection_reason(refined, depth, contexts: int, held_out, measured) -> str:
    """Why a refinement (splat.Refinement) is not to be trusted as a whole; empty where it is.

    It started from `depth` (H, W) with `contexts` context views; the views `held_out` took no part. Enough of these are
    a measurement; with fewer, what is likely to make it worse counts too (`measured`: Measurements or None).
    """
    seen = [(view.name, cost) for view, cost in zip(held_out, refined.held_out) if np.isfinite(cost).all()]
    if len(seen) < ENOUGH and (reason := _likely_reason(refined, depth, contexts, measured)):
        return reason
    before, after = np.mean([cost for _, cost in seen], axis=0) if seen else refined.cost
    judges = f"the photos that took no part ({', '.join(name for name, _ in seen)})" if seen else "the context photos"
    through = f"through the refined depth (1 - correlation {before:.4f} before, {after:.4f} after)"
    if after > before:       # not where nothing was seen: NaN
        return f"{judges} match worse {through}"
    if seen and before - after < LEAST_GAIN * before:
        return f"{judges} do not match clearly better {through}"
    return ""


def _likely_reason(refined, depth, contexts: int, measured) -> str:
    """What speaks against it without photos that took no part: cameras that are off, and depths that were rejected."""
    off = measured.misaligned if measured else 0.0
    added = off / np.sqrt(contexts)          # to a depth, by cameras that are off independently of one another
    if off > MISALIGNED and (moved := _moved(refined, depth)) < 2 * added:
        return (f"the photos are off by {off:.1f} pixels across the direction of depth, so that {contexts} of them add "
                f"errors of about {added:.1f} pixels of parallax to depths that moved by {moved:.1f}: "
                "are the cameras right?")
    refused, accepted = (int(np.count_nonzero(refined.status == status)) for status in (REJECTED, REFINED))
    if refused > MOST_REFUSED * (refused + accepted):
        return f"the photos do not confirm the refined depth of {refused / (refused + accepted):.0%} of the pixels"
    return ""


def _moved(refined, depth) -> float:
    """By how many pixels of parallax the refined depths moved, root mean square over some rows and columns."""
    some = np.s_[::4, ::4]
    there = (refined.status[some] == REFINED) & (refined.parallax[some] > 0)
    moved = (refined.depth[some][there] - depth[some][there]) / refined.parallax[some][there]
    return float(np.sqrt(np.mean(moved.astype(np.float64)**2))) if moved.size else 0.0
