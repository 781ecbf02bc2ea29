"""The factor (and shift) that all depth maps share, which maps alone hardly show: under which photos agree best.

Patches of a view are carried to its neighbours by their depths times s and correlated there; s is swept around 1, first
on small photos and widely, then on larger ones around the best. Where depths differ enough for a shift to show, they
are stretched about their median likewise, which is another factor and a shift. Both are made exact by where each patch
by itself agrees best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.patches import evenly
from pagas_cl.scene.view import View
from pagas_cl.surface.sweep import EACH, LEAST, SOME, STEP, Sweep, peak

RANGE = 0.35            # largest |log s|
_SIDES = 160, 400       # pixels of the longer side of the photos compared, coarse and fine
_VIEWS, _OTHERS = 8, 3
_FINER = 3.0            # steps of a sweep to each side that the finer one covers
_BENDABLE = 0.3         # largest stretch of depths about their middle
CLEAR = 0.02            # by so much patches must correlate better than under the depths as given
_ACROSS = 10.0          # pixels of the small photos searched to each side
_MATCHED, _SURE = 0.7, 4.0       # correlation of a patch that is believed to be found; standard errors of a stretch
_GAIN = 0.04            # of correlation, without which photos are not said to be off
AGREE = 0.5             # mean correlation from which on photos are said to agree over the depth
UNITS = (1e3, 1e-3, 1e2, 1e-2, 1e1, 1e-1, 1e4, 1e-4, 5e3)      # numbers for one scene unit that are tried


@dataclass(frozen=True)
class CommonScale:
    """The factor, the shift (scene units), and the mean correlation of patches with both and without."""

    factor: float
    shift: float
    agreement: float
    given: float


def find_common_scale(views: Sequence[View], cameras: Sequence[Camera], depths: Sequence[np.ndarray | None],
                      known: bool = True) -> CommonScale:
    """The factor by which all depth maps (None where a view has none) are to be multiplied, and the shift added then;
    1 and 0 where photos do not clearly ask for others, or at all where their scale is not `known`. `cameras` are the
    views', of the depth maps' size."""
    pairs = _pairs(cameras, depths)
    if not pairs:
        return CommonScale(1.0, 0.0, float("nan"), float("nan"))
    best, span, bent = 0.0, RANGE, 0.0
    sweeps = [Sweep(views, depths, pairs, side) for side in _SIDES]
    for sweep in sweeps:
        best = sweep.best(best, span, sweep.parallax, partial(sweep.score, bent=bent))
        span, range_ = _FINER * STEP * sweep.parallax, sweep.range
        if sweep.parallax / range_ < _BENDABLE:      # else depths that bend look as they did
            trial = sweep.best(bent, _BENDABLE, sweep.parallax / range_, partial(sweep.score, best))
            bent = trial if sweep.score(best, trial) > sweep.score(best, 0.0) + CLEAR else 0.0
            best = sweep.best(best, span, sweep.parallax, partial(sweep.score, bent=bent))
    given = sweeps[-1].score(0.0, 0.0)
    if not sweeps[-1].score(best, bent) > given + (CLEAR if known else 0.0) or abs(best) > 0.98 * RANGE:
        return CommonScale(1.0, 0.0, given, given)
    best = sweeps[0].mean_of_pairs(best, bent)
    moved, more = _by_patches(sweeps[-1], best, bent)
    best, bent = best + moved, bent + more * (1 + bent)
    factor = float(np.exp(best))
    return CommonScale(factor * (1 + bent), -factor * bent * sweeps[-1].middle, sweeps[-1].score(best, bent), given)


def _by_patches(sweep: Sweep, start: float, bent: float) -> tuple[float, float]:
    """What to add to the log factor `start`, and how much more to stretch, by where each patch by itself agrees best; 0
    for what lies within its error. The mean of all patches hardly shows a stretch: in most of them it is small."""
    tried, moves, told = start + sweep.parallax * np.arange(-EACH, EACH + 0.25, STEP), np.arange(-EACH, EACH + 0.5), []
    for i, j in sweep.pairs:
        across, _ = sweep.scores_across(i, j, moves, start, bent)
        if np.isfinite(across).all():
            rows = [sweep.across(i, j, moves[[across.argmax()]], value, bent) for value in tried]
            scores, pixels = np.concatenate([row for row, _ in rows]).T, rows[len(rows) // 2][1]
            top = np.where(np.isfinite(scores).all(axis=1)[:, None], scores, 0.0)
            good = (top.max(axis=1) > _MATCHED) & (top.argmax(axis=1) % (len(tried) - 1) > 0)
            best = np.array([peak(tried, row) for row in scores[good]]) - start
            middle = sweep.middle / sweep.depth(sweep.patches[i], 0.0, bent)[good].mean(axis=1)
            told += [(np.stack([np.ones(len(best)), 1 - middle], -1), best, pixels[good])] * (len(best) >= LEAST)
    for unknowns in (2, 1) if told else ():
        each = [_fitted(rows[:, :unknowns], best, pixels) for rows, best, pixels in told]
        values, errors = np.array(each).swapaxes(0, 1)
        weights = errors**-2 / (errors**-2).sum(axis=0)
        mean = (weights * values).sum(axis=0)
        error = np.sqrt((weights**2 * np.maximum(errors**2, (values - mean) ** 2)).sum(axis=0))
        if abs(mean[-1]) > _SURE * error[-1]:
            return float(mean[0]), float(mean[1]) if unknowns == 2 else 0.0
    return 0.0, 0.0


def _fitted(rows: np.ndarray, y: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x of y = rows x, and its standard errors; y times `pixels` has errors alike, some of them large."""
    rows, y, weights = rows * pixels[:, None], y * pixels, np.ones(len(y))
    for _ in range(20):
        weighted = rows * weights[:, None]
        inverse = np.linalg.inv(weighted.T @ rows + 1e-9 * np.eye(rows.shape[1]))
        x = inverse @ weighted.T @ y
        left = y - rows @ x
        weights = 1 / (1 + (left / max(3 * float(np.median(np.abs(left))), 0.1)) ** 2) ** 2
    return x, np.sqrt(((inverse @ (weighted * left[:, None]).T) ** 2).sum(axis=1)) + 1e-12


def _pairs(cameras: Sequence[Camera], depths: Sequence[np.ndarray | None]) -> list[tuple[int, int]]:
    """Some views, and others that see much of them at an angle."""
    usable = [k for k, depth in enumerate(depths) if depth is not None]
    asked = [usable[k] for k in evenly(len(usable), _VIEWS)] if usable else []
    chooser = ContextChooser(cameras, depths)
    return [(i, j) for i in asked for j in chooser.choose(i).indices[:_OTHERS]]


def find_unit(views: Sequence[View], cameras: Sequence[Camera],
              depths: Sequence[np.ndarray | None]) -> tuple[float, float, float]:
    """The power of ten by which depths are to be divided so that photos agree over them, the agreement then, and as
    given: 1000 for millimetres where cameras are in metres. 1 where no other is clear; agreements are the mean over
    views of each one's best correlation within RANGE."""
    given = _best_agreement(views, cameras, depths, 1.0)
    if given >= AGREE:
        return 1.0, given, given
    found = {unit: _best_agreement(views, cameras, depths, unit) for unit in UNITS}
    best = max(found, key=lambda unit: found[unit])
    clear = found[best] >= AGREE and found[best] > max(given, 0) + 0.2
    return (best, found[best], given) if clear else (1.0, given, given)


def _best_agreement(views: Sequence[View], cameras: Sequence[Camera], depths: Sequence[np.ndarray | None],
                    unit: float) -> float:
    scaled = [None if depth is None else depth / np.float32(unit) for depth in depths]
    pairs = _pairs(cameras, scaled)
    if not pairs:
        return 0.0
    sweep = Sweep(views, scaled, pairs, _SIDES[0])
    step, best = max(sweep.parallax, 2 * RANGE / 80), []
    for i in sorted({i for i, _ in pairs}):
        sweep.pairs = [pair for pair in pairs if pair[0] == i]
        scores = [sweep.score(value) for value in np.arange(-RANGE, RANGE, step)]
        best.append(np.nanmax(scores) if np.isfinite(scores).any() else 0.0)
    return float(np.mean(best))


def cameras_off(views: Sequence[View], cameras: Sequence[Camera], depths: Sequence[np.ndarray | None]) -> float:
    """How far photos are off across the direction in which depth moves them, which no depth explains: the root mean
    square over pairs of views, pixels of the photos; 0 where moving them gains nothing, NaN where no pair can be
    compared. Up to some 6 % of a side."""
    pairs = _pairs(cameras, depths)
    if not pairs:
        return float("nan")
    sweep = Sweep(views, depths, pairs, _SIDES[0])
    tried, found, gains = np.arange(-_ACROSS, _ACROSS + 0.25, 0.5), [], []
    for pair in pairs:
        scores, _ = sweep.scores_across(*pair, tried)
        if np.isfinite(scores).all() and scores.max() > SOME:
            found.append(peak(tried, scores) * views[pair[0]].camera.width / sweep.cameras[pair[0]].width)
            gains.append(scores.max() - scores[len(tried) // 2])
    if not found:
        return float("nan")
    return float(np.sqrt(np.mean(np.square(found)))) if np.mean(gains) > _GAIN else 0.0
