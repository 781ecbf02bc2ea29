"""The factor (and shift) that all depth maps share, under which photos agree best: swept, then finer (method section
7)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pagas_cl.method.surface.photo_sweep import AGREE, LEAST, SIDES, STEP, Greys, Sweep, peaks
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.sampling import evenly

# Constants of section 7.
RANGE = 0.35            # largest |log s|
_VIEWS, _OTHERS = 8, 3  # views whose patches are compared, and others that each is compared with
_POINTS = 400           # samples by which these are chosen
_FIRST, _MANY = 4, 20   # each so many-th pair is compared first, where they are so many
WELL = 0.8              # correlation of photos that are not off by much
_FINER = 3.0            # steps to each side that the finer sweep covers
_BENDABLE = 0.3         # largest stretch of depths about their middle
CLEAR = 0.02            # by so much patches must correlate better than under the depths as given
_ACROSS, _SOME = 10.0, 0.3      # pixels of the small photos searched to each side; least correlation at the best
_EACH = 6.0             # and in both directions for the s of a patch
_MATCHED, _SURE = 0.7, 4.0      # correlation of a patch that is believed to be found; standard errors of a stretch
_GAIN = 0.04            # of correlation, without which photos are not said to be off
UNITS = (1e3, 1e-3, 1e2, 1e-2, 1e1, 1e-1, 1e4, 1e-4, 5e3)      # numbers for one scene unit that are tried


@dataclass(frozen=True)
class CommonScale:
    """The factor, the shift (scene units), and the mean correlation of patches with both and without."""

    factor: float
    shift: float
    agreement: float
    given: float


def find_common_scale(greys: Greys, depths: Sequence[np.ndarray | None], known: bool = True) -> CommonScale:
    """The factor by which all depth maps (None where a view has none) are to be multiplied, and the shift added then;
    1 and 0 where photos do not clearly fit others, or at all where their scale is not `known`."""
    pairs = _pairs(greys, depths)
    if not pairs:
        return CommonScale(1.0, 0.0, float("nan"), float("nan"))
    few = pairs[::_FIRST] if known and len(pairs) >= _MANY else []
    for some in (few, pairs) if few else (pairs,):
        best, bent, span = 0.0, 0.0, RANGE
        for side in SIDES:
            sweep = Sweep(greys, depths, some, side)
            best = sweep.best(best, span, bent)
            best, bent = _by_patches(sweep, best, bent)
            span = _FINER * STEP * sweep.parallax
        given, found = (float(sweep.scores(np.array([s]), b)[0]) for s, b in ((0.0, 0.0), (best, bent)))
        if given > WELL and found < given + CLEAR / 2:       # nothing to mend: a few pairs say as much as all
            break
    if not found > given + (CLEAR if known else 0.0) or abs(best) > 0.98 * RANGE or abs(bent) > _BENDABLE:
        return CommonScale(1.0, 0.0, given, given)
    factor = float(np.exp(best))
    return CommonScale(factor * (1 + bent), -factor * bent * sweep.middle, found, given)


def _by_patches(sweep: Sweep, start: float, bent: float) -> tuple[float, float]:
    """The log factor `start` and `bent` made exact by where each patch by itself agrees best; a stretch within its
    error stays. The mean of all patches hardly shows a stretch: in most of them it is small."""
    tried = start + sweep.parallax * np.arange(-_EACH, _EACH + 0.25, STEP)
    moves = np.arange(-_EACH, _EACH + 0.5)

    def of_pair(pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        across = sweep.scores_across(*pair, moves, start, bent)
        if not np.isfinite(across).all():
            return None
        best_move = moves[[across.argmax()]]
        found, pixels = map(np.concatenate, zip(*(sweep.across(*pair, best_move, some, bent)
                                                  for some in sweep.parts(pair[0], tried))))
        scores, pixels = found.T, pixels[len(tried) // 2]
        top = np.where(np.isfinite(scores).all(axis=1)[:, None], scores, 0.0)
        good = (top.max(axis=1) > _MATCHED) & (top.argmax(axis=1) % (len(tried) - 1) > 0)
        best = peaks(tried, scores[good]) - start
        middle = sweep.middle / sweep.bent(sweep.patches[pair[0]], bent)[good].mean(axis=1)
        return (np.stack([np.ones(len(best)), 1 - middle], -1), best, pixels[good]) if len(best) >= LEAST else None

    of_pairs = [found for found in side_by_side(of_pair, sweep.pairs) if found]
    for unknowns in (2, 1) if of_pairs else ():
        each = [_fitted(rows[:, :unknowns], best, pixels) for rows, best, pixels in of_pairs]
        values, errors = np.array(each).swapaxes(0, 1)
        # cameras that are off move whole pairs
        weights = np.array([[np.median(pixels) ** 2] for *_, pixels in of_pairs])
        weights /= weights.sum()
        mean = (weights * values).sum(axis=0)
        error = np.sqrt((weights**2 * np.maximum(errors**2, (values - mean) ** 2)).sum(axis=0))
        if unknowns == 1 or abs(mean[1]) > _SURE * error[1]:
            return start + float(mean[0]), bent + float(mean[1]) * (1 + bent) if unknowns == 2 else bent
    return start, bent


def _fitted(rows: np.ndarray, y: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x of y = rows x, and its standard errors; y times `pixels` has errors alike, some of them large."""
    rows, y, weights, x = rows * pixels[:, None], y * pixels, np.ones(len(y)), np.zeros(rows.shape[1])
    for _ in range(20):
        weighted, before = rows * weights[:, None], x
        inverse = np.linalg.inv(weighted.T @ rows + 1e-9 * np.eye(rows.shape[1]))
        x = inverse @ weighted.T @ y
        left = y - rows @ x
        weights = 1 / (1 + (left / max(3 * float(np.median(np.abs(left))), 0.1)) ** 2) ** 2
        if np.abs(x - before).max() < 1e-7:
            break
    return x, np.sqrt(((inverse @ (weighted * left[:, None]).T) ** 2).sum(axis=1)) + 1e-12


def _pairs(greys: Greys, depths: Sequence[np.ndarray | None]) -> list[tuple[int, int]]:
    """Some views, and others that see much of them at an angle."""
    cameras = [view.camera if depth is None else view.camera.resized(*depth.shape[::-1])
               for view, depth in zip(greys.views, depths)]
    usable = [k for k, depth in enumerate(depths) if depth is not None]
    targets = [usable[k] for k in evenly(len(usable), _VIEWS)]
    chooser = ContextChooser(cameras, depths, samples=_POINTS)
    return [(i, j) for i in targets for j in chooser.choose(i).indices[:_OTHERS]]


def find_unit(greys: Greys, depths: Sequence[np.ndarray | None]) -> tuple[float, float, float]:
    """The power of ten by which depths are to be divided so that photos agree over them, the agreement then, and as
    given: 1000 for millimetres where cameras are in metres. 1 where no other is clear; agreements are the mean over
    views of each one's best correlation within RANGE, or less where that is enough."""
    given = _best_agreement(greys, depths, 1.0)
    if given >= AGREE:
        return 1.0, given, given
    found = {unit: _best_agreement(greys, depths, unit) for unit in UNITS}
    best = max(found, key=lambda unit: found[unit])
    clear = found[best] >= AGREE and found[best] > max(given, 0) + 0.2
    return (best, found[best], given) if clear else (1.0, given, given)


def _best_agreement(greys: Greys, depths: Sequence[np.ndarray | None], unit: float) -> float:
    scaled = [None if depth is None else depth / np.float32(unit) for depth in depths]
    pairs = _pairs(greys, scaled)
    if not pairs:
        return 0.0
    sweep = Sweep(greys, scaled, pairs, SIDES[0])
    step, found = max(sweep.parallax, 2 * RANGE / 80), 0.0
    for tried in (np.zeros(1), np.arange(-RANGE, RANGE, step)):
        best = []
        for i in sorted({i for i, _ in pairs}):
            sweep.pairs = [pair for pair in pairs if pair[0] == i]
            scores = sweep.scores(tried)
            best.append(np.nanmax(scores) if np.isfinite(scores).any() else 0.0)
        found = float(np.mean(best))
        if unit == 1 and found >= AGREE:
            break
    return found


def agreement_over(greys: Greys, depths: Sequence[np.ndarray | None]) -> float:
    """Mean correlation of patches over the depths as they are; NaN where none can be compared."""
    pairs = _pairs(greys, depths)
    return float(Sweep(greys, depths, pairs, SIDES[-1]).scores(np.zeros(1))[0]) if pairs else float("nan")


def cameras_off(greys: Greys, depths: Sequence[np.ndarray | None]) -> float:
    """Epipolar residual of the photos, which no depth explains: root mean square over pairs of views, pixels of the
    photos; 0 where moving them gains nothing, NaN where no pair can be compared. Up to some 6 % of a side."""
    pairs = _pairs(greys, depths)
    if not pairs:
        return float("nan")
    sweep = Sweep(greys, depths, pairs, SIDES[0])
    tried, found, gains = np.arange(-_ACROSS, _ACROSS + 0.25, 0.5), [], []
    for pair, scores in zip(pairs, side_by_side(lambda pair: sweep.scores_across(*pair, tried), pairs)):
        if np.isfinite(scores).all() and scores.max() > _SOME:
            wider = greys.views[pair[0]].camera.width / sweep.cameras[pair[0]].width
            found.append(float(peaks(tried, scores[None])[0]) * wider)
            gains.append(scores.max() - scores[len(tried) // 2])
    if not found:
        return float("nan")
    return float(np.sqrt(np.mean(np.square(found)))) if np.mean(gains) > _GAIN else 0.0
