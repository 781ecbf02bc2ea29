"""Whether a refined view is to be trusted as a whole, or is returned unchanged with the reason (method section 7).

`one_view` takes the first of rejection_reason, nothing_reason and target_photo_reason that is not empty. A view that
could not be refined at all, since its photo, device or worker failed, is another matter: jobs/worker.py, jobs/run.py.
"""

from dataclasses import replace

import numpy as np

from pagas_cl.method.cameras.judge import fitted_pose
from pagas_cl.method.splat import ViewInput
from pagas_cl.method.view.prediction import compare_predictions
from pagas_cl.result import REFINED, REJECTED
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.depthmap import resize_depth
from pagas_cl.scene.view import smaller

MOST_REFUSED = 2 / 3     # a view with a larger share of rejected depths is not to be trusted as a whole
LEAST_GAIN = 0.01        # of 1 - correlation in photos that took no part: less may be chance
MISALIGNED = 0.2         # pixels; only photos that are off by more raise the question whether the cameras are right
ENOUGH = 3               # photos that took no part: cameras that are off agree by chance, n of them one time in 2^n
DOUBTED = 0.75           # of what depths moved by: photos that are off by more may be what moved them
SEEN = 1000              # pixels of a view that a photo sees, of which a median says something
LARGEST = 500_000        # pixels of a view whose own photo is doubted: larger ones are judged at a smaller size
_JUDGES = 8              # photos that judge then: the first of those there are,
_TOGETHER = 4            # and so many compared at a time


def nothing_reason(refined) -> str:
    """Why no depth of a view was refined (splat.Refinement); empty where one was."""
    if (refined.status == REFINED).any():
        return ""
    if (refined.status == REJECTED).any():
        return "the photos confirm no refined depth"
    if refined.uninformative:
        return "nothing in the photos moved a depth (are they black, or of one colour?)"
    return "no other photo sees a depth of it, and enough around that, of what masks leave"


def rejection_reason(refined, given: ViewInput, measured) -> str:
    """Why a refinement (splat.Refinement) of what was `given` is not to be trusted as a whole; empty where it is.
    Enough held-out views are a measurement; with fewer, what is likely to make it worse counts too (`measured`:
    Measurements or None)."""
    seen = [(view.name, cost) for view, cost in zip(given.held_out, refined.held_out) if np.isfinite(cost).all()]
    if len(seen) < ENOUGH and (reason := _likely_reason(refined, given.depth, len(given.contexts), measured)):
        return reason
    before, after = np.mean([cost for _, cost in seen], axis=0) if seen else refined.cost
    judges = f"the photos that took no part ({', '.join(name for name, _ in seen)})" if seen else "the context photos"
    through = f"over the refined depth (mismatch {before:.4f} before, {after:.4f} after)"
    if after > before:       # not where nothing was seen: NaN
        return f"{judges} match worse {through}"
    if seen and before - after < LEAST_GAIN * before:
        return f"{judges} do not match clearly better {through}"
    return ""


def target_photo_reason(refined, given: ViewInput, measured) -> str:
    """Why the target's own photo is not to be trusted: motion blur, or a rolling shutter, is in every pair, so that
    photos that took no part gain by it as the others do. Examined where photos are off by so much that it may be what
    moved the depths: those that took no part, or else context photos, are given the poses that fit them best to either
    depth, and must match clearly better through the refined one."""
    if not measured or measured.misaligned <= MISALIGNED:
        return ""
    moved = _moved(refined, given.depth)
    if measured.misaligned < DOUBTED * moved:
        return ""
    scale = min(1.0, float(np.sqrt(LARGEST / given.depth.size)))
    target = _read_at(given.target, scale)
    both = [resize_depth(one, target.camera.width, target.camera.height) for one in (given.depth, refined.depth)]
    judges, costs = "photos that took no part", _costs_with_fitted_poses(target, both, given.held_out, scale, given)
    if not costs:
        judges, costs = "context photos", _costs_with_fitted_poses(target, both, given.contexts, scale, given)
    before, after = np.mean(costs, axis=0) if costs else (np.inf, 0)
    if after < (1 - LEAST_GAIN) * before:
        return ""
    return (f"its photo and the others are off by {measured.misaligned:.1f} pixels that no depth explains, where "
            f"depths moved by {moved:.1f}, and with a pose fitted to each, {len(costs)} {judges} do not match clearly "
            f"better over the refined depth (mismatch {before:.4f} before, {after:.4f} after): is its own photo "
            "blurred, or was its shutter rolling?")


def _costs_with_fitted_poses(target, both, photos, scale: float, given: ViewInput) -> list[list[float]]:
    """1 - median correlation of those `photos` that see enough, through each of two depth maps."""
    views = side_by_side(lambda view: _read_at(view, scale), photos[:_JUDGES])
    fitted = [[fitted_pose(view, target, one, device=given.device, photos=given.photos) for one in both]
              for view in views]
    given.photos.forget([target, *views])
    predictions = side_by_side(lambda pair: compare_predictions(target, both, pair), fitted, _TOGETHER)
    return [[1 - one.median for one in pair] for pair in predictions if pair[0].pixels >= SEEN]


def _read_at(view, scale: float):
    """A view at `scale` of its size, its photo and mask read once."""
    small = smaller(view, scale)
    return replace(small, image=small.load_image(), mask=small.load_mask())


def _likely_reason(refined, depth, contexts: int, measured) -> str:
    """What speaks against it without photos that took no part: cameras that are off, and depths that were rejected."""
    off = measured.misaligned if measured else 0.0
    added = off / np.sqrt(contexts)          # to a depth, by cameras that are off independently of one another
    moved = _moved(refined, depth)
    if off > MISALIGNED and moved < 2 * added:
        return (f"the photos are off by {off:.1f} pixels that no depth explains, so that {contexts} of them add "
                f"errors of about {added:.1f} pixels of parallax to depths that moved by {moved:.1f}: "
                "are the cameras right?")
    refused = int(np.count_nonzero(refined.status == REJECTED))
    judged = refused + int(np.count_nonzero(refined.status == REFINED)) + refined.uninformative
    if refused > MOST_REFUSED * judged:
        return f"the photos do not confirm the refined depth of {refused / judged:.0%} of the pixels"
    return ""


def _moved(refined, depth) -> float:
    """By how many pixels of parallax the refined depths moved, root mean square over some rows and columns."""
    some = np.s_[::4, ::4]
    there = (refined.status[some] == REFINED) & (refined.parallax[some] > 0)
    moved = (refined.depth[some][there] - depth[some][there]) / refined.parallax[some][there]
    return float(np.sqrt(np.mean(moved.astype(np.float64)**2))) if moved.size else 0.0
