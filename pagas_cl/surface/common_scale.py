"""The factor (and shift) that all depth maps share, which maps alone hardly show: under which photos agree best.

Patches of a view are carried to its neighbours by their depths times s and correlated there; s is swept around 1, first
on small photos and widely, then on larger ones around the best. Where depths differ enough for a shift to show, they
are stretched about their median likewise, which is another factor and a shift. Both are made exact by where each patch
by itself agrees best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.depthmap import depth_down, depth_up
from pagas_cl.scene.images import bilinear, photo_to
from pagas_cl.scene.patches import evenly, grey_of
from pagas_cl.scene.view import View

RANGE = 0.35            # largest |log s|
_SIDES = 160, 400       # pixels of the longer side of the photos compared, coarse and fine
_VIEWS, _OTHERS, _PATCHES, _HALF = 8, 3, 200, 3
_STEP, _FINER = 0.5, 3.0        # pixels of parallax between two s; steps to each side that the finer sweep covers
_LEAST = 30             # patches that say something
_FLAT = 2.0             # grey levels of 255: patches of less texture are not compared
_BENDABLE = 0.3         # largest stretch of depths about their middle
CLEAR = 0.02            # by so much patches must correlate better than under the depths as given
_MOST = 241             # values of s in a sweep
_SPARSE, _ENOUGH, _AROUND = 4, 600, 4   # each so many-th patch is asked first, where so many are; values asked of all
_THREADS = 8
_ACROSS, _SOME = 10.0, 0.3      # pixels of the small photos searched to each side; least correlation at the best
_EACH = 6.0             # and in both directions for the s of a patch
_MATCHED, _SURE = 0.7, 4.0      # correlation of a patch that is believed to be found; standard errors of a stretch
_GAIN = 0.04            # of correlation, without which photos are not said to be off
AGREE = 0.5             # mean correlation from which on photos are said to agree over the depth
UNITS = (1e3, 1e-3, 1e2, 1e-2, 1e1, 1e-1, 1e4, 1e-4, 5e3)      # numbers for one scene unit that are tried


@dataclass(frozen=True, eq=False)
class _Patches:
    """Patches of a view: rays (n, p, 3), depths (n, p), grey values (n, p) without mean and of unit length."""

    camera: Camera
    rays: np.ndarray = field(repr=False)
    depth: np.ndarray = field(repr=False)
    grey: np.ndarray = field(repr=False)


@dataclass(frozen=True)
class CommonScale:
    """The factor, the shift (scene units), and the mean correlation of patches with both and without."""

    factor: float
    shift: float
    agreement: float
    given: float


def find_common_scale(views: Sequence[View], cameras: Sequence[Camera], depths: Sequence[np.ndarray | None],
                      known: bool = True, greys: Greys | None = None) -> CommonScale:
    """The factor by which all depth maps (None where a view has none) are to be multiplied, and the shift added then;
    1 and 0 where photos do not clearly ask for others, or at all where their scale is not `known`. `cameras` are the
    views', of the depth maps' size."""
    pairs, greys = _pairs(cameras, depths), Greys(views) if greys is None else greys
    if not pairs:
        return CommonScale(1.0, 0.0, float("nan"), float("nan"))
    best, bent, span = 0.0, 0.0, RANGE
    for side in _SIDES:
        sweep = _Sweep(views, depths, pairs, side, greys)
        best = sweep.best(best, span, bent)
        best, bent = _by_patches(sweep, best, bent)
        span = _FINER * _STEP * sweep.parallax
    given, found = (float(sweep.scores(np.array([s]), b)[0]) for s, b in ((0.0, 0.0), (best, bent)))
    if not found > given + (CLEAR if known else 0.0) or abs(best) > 0.98 * RANGE or abs(bent) > _BENDABLE:
        return CommonScale(1.0, 0.0, given, given)
    factor = float(np.exp(best))
    return CommonScale(factor * (1 + bent), -factor * bent * sweep.middle, found, given)


def _by_patches(sweep: _Sweep, start: float, bent: float) -> tuple[float, float]:
    """The log factor `start` and `bent` made exact by where each patch by itself agrees best; a stretch within its
    error stays. The mean of all patches hardly shows a stretch: in most of them it is small."""
    tried = start + sweep.parallax * np.arange(-_EACH, _EACH + 0.25, _STEP)
    moves = np.arange(-_EACH, _EACH + 0.5)

    def of_pair(pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        across = sweep.scores_across(*pair, moves, start, bent)
        if not np.isfinite(across).all():
            return None
        rows = [sweep.across(*pair, moves[[across.argmax()]], value, bent) for value in tried]
        scores, pixels = np.concatenate([row for row, _ in rows]).T, rows[len(rows) // 2][1]
        top = np.where(np.isfinite(scores).all(axis=1)[:, None], scores, 0.0)
        good = (top.max(axis=1) > _MATCHED) & (top.argmax(axis=1) % (len(tried) - 1) > 0)
        best = np.array([_peak(tried, row) for row in scores[good]]) - start
        middle = sweep.middle / sweep.depth(sweep.patches[pair[0]], 0.0, bent)[good].mean(axis=1)
        return (np.stack([np.ones(len(best)), 1 - middle], -1), best, pixels[good]) if len(best) >= _LEAST else None

    told = [found for found in side_by_side(of_pair, sweep.pairs, _THREADS) if found]
    for unknowns in (2, 1) if told else ():
        each = [_fitted(rows[:, :unknowns], best, pixels) for rows, best, pixels in told]
        values, errors = np.array(each).swapaxes(0, 1)
        weights = np.array([[np.median(pixels) ** 2] for *_, pixels in told])   # cameras that are off move whole pairs
        weights /= weights.sum()
        mean = (weights * values).sum(axis=0)
        error = np.sqrt((weights**2 * np.maximum(errors**2, (values - mean) ** 2)).sum(axis=0))
        if unknowns == 1 or abs(mean[1]) > _SURE * error[1]:
            return start + float(mean[0]), bent + float(mean[1]) * (1 + bent) if unknowns == 2 else bent
    return start, bent


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


def _peak(x: np.ndarray, y: np.ndarray) -> float:
    """Where y is largest, by a parabola through three values."""
    k = int(np.nanargmax(y))
    if not 0 < k < len(x) - 1 or not np.isfinite(y[k - 1:k + 2]).all():
        return float(x[k])
    (a, b, c), (p, q, r) = x[k - 1:k + 2], y[k - 1:k + 2]
    below = (b - a) * (q - r) - (b - c) * (q - p)
    if abs(below) < 1e-12:
        return float(b)
    return float(np.clip(b - 0.5 * ((b - a) ** 2 * (q - r) - (b - c) ** 2 * (q - p)) / below, a, c))


def _pairs(cameras: Sequence[Camera], depths: Sequence[np.ndarray | None]) -> list[tuple[int, int]]:
    """Some views, and others that see much of them at an angle."""
    usable = [k for k, depth in enumerate(depths) if depth is not None]
    asked = [usable[k] for k in evenly(len(usable), _VIEWS)] if usable else []
    chooser = ContextChooser(cameras, depths)
    return [(i, j) for i, choice in zip(asked, side_by_side(chooser.choose, asked, _THREADS))
            for j in choice.indices[:_OTHERS]]


def find_unit(views: Sequence[View], cameras: Sequence[Camera], depths: Sequence[np.ndarray | None],
              greys: Greys) -> tuple[float, float, float]:
    """The power of ten by which depths are to be divided so that photos agree over them, the agreement then, and as
    given: 1000 for millimetres where cameras are in metres. 1 where no other is clear; agreements are the mean over
    views of each one's best correlation within RANGE, or less where that is enough."""
    given = _best_agreement(views, cameras, depths, 1.0, greys)
    if given >= AGREE:
        return 1.0, given, given
    found = {unit: _best_agreement(views, cameras, depths, unit, greys) for unit in UNITS}
    best = max(found, key=lambda unit: found[unit])
    clear = found[best] >= AGREE and found[best] > max(given, 0) + 0.2
    return (best, found[best], given) if clear else (1.0, given, given)


def _best_agreement(views: Sequence[View], cameras: Sequence[Camera], depths: Sequence[np.ndarray | None],
                    unit: float, greys: Greys) -> float:
    scaled = [None if depth is None else depth / np.float32(unit) for depth in depths]
    pairs = _pairs(cameras, scaled)
    if not pairs:
        return 0.0
    sweep = _Sweep(views, scaled, pairs, _SIDES[0], greys)
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


def cameras_off(views: Sequence[View], cameras: Sequence[Camera], depths: Sequence[np.ndarray | None],
                greys: Greys) -> float:
    """How far photos are off across the direction in which depth moves them, which no depth explains: the root mean
    square over pairs of views, pixels of the photos; 0 where moving them gains nothing, NaN where no pair can be
    compared. Up to some 6 % of a side."""
    pairs = _pairs(cameras, depths)
    if not pairs:
        return float("nan")
    sweep = _Sweep(views, depths, pairs, _SIDES[0], greys)
    tried, found, gains = np.arange(-_ACROSS, _ACROSS + 0.25, 0.5), [], []
    for pair, scores in zip(pairs, side_by_side(lambda pair: sweep.scores_across(*pair, tried), pairs, _THREADS)):
        if np.isfinite(scores).all() and scores.max() > _SOME:
            found.append(_peak(tried, scores) * views[pair[0]].camera.width / sweep.cameras[pair[0]].width)
            gains.append(scores.max() - scores[len(tried) // 2])
    if not found:
        return float("nan")
    return float(np.sqrt(np.mean(np.square(found)))) if np.mean(gains) > _GAIN else 0.0


class Greys:
    """Grey levels of small photos of `views` at all the sizes asked for; each photo is read once."""

    def __init__(self, views: Sequence[View]):
        self.views = views
        self._small = dict[int, dict[int, np.ndarray]]()        # by view and side

    def at(self, side: int, chosen: Sequence[int]) -> list[np.ndarray]:
        """float32 (h, w) of the views `chosen`, each of the longer side `side`."""
        new = [k for k in chosen if k not in self._small]
        self._small.update(zip(new, side_by_side(self._read, new, _THREADS)))
        return [self._small[k][side] for k in chosen]

    def _read(self, k: int) -> dict[int, np.ndarray]:
        photo = self.views[k].load_image()
        return {side: np.ascontiguousarray(grey_of(photo_to(photo, *_within(side, self.views[k].camera))))
                for side in _SIDES}


class _Sweep:
    """Photos and patches at one size."""

    def __init__(self, views: Sequence[View], depths: Sequence[np.ndarray | None], pairs: list[tuple[int, int]],
                 side: int, greys: Greys):
        self.pairs, self.patches = pairs, dict[int, _Patches]()
        self._turned = dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]()      # rays of i as j has them, and tau
        chosen = sorted({k for pair in pairs for k in pair})
        sizes = {k: _within(side, views[k].camera) for k in chosen}
        self.cameras = {k: views[k].camera.resized(*size) for k, size in sizes.items()}
        self.greys = dict(zip(chosen, greys.at(side, chosen)))
        for k in sorted({i for i, _ in pairs}):
            if (depth := depths[k]) is not None:
                resized = depth_down if depth.shape[1] >= sizes[k][0] else depth_up
                self.patches[k] = _patches(self.cameras[k], self.greys[k], resized(depth, *sizes[k]))
        every = np.concatenate([patches.depth.ravel() for patches in self.patches.values()])
        self.middle = float(np.median(every)) if len(every) else 1.0
        self.parallax = self._parallax()

    def best(self, start: float, span: float, bent: float) -> float:
        """Where photos agree best within `span` of `start`, which stays where nothing can be compared. Where patches are
        many, and some of them agree somewhere, all are asked around there alone."""
        step = max(_STEP * self.parallax, 2 * span / (_MOST - 1))
        tried = np.union1d(np.arange(start - span, start + span + step / 2, step), [start])
        every = min(_SPARSE, sum(len(self.patches[i].depth) for i, _ in self.pairs) // _ENOUGH)
        if every > 1 and len(tried) > 2 * _AROUND:
            rough = self.scores(tried, bent, every)
            if (rough >= AGREE).any():
                top = int(np.nanargmax(rough))
                tried = tried[max(0, top - _AROUND):top + _AROUND + 1]
        scores = self.scores(tried, bent)
        return _peak(tried, scores) if np.isfinite(scores).any() else start

    def _parallax(self) -> float:
        """Relative change of depth that moves a patch by a pixel, median over the pairs."""
        changes = []
        for i, j in self.pairs:
            near, far = (self._place(i, j, value)[:2] for value in (0.0, 1e-3))
            moved = np.hypot(far[0] - near[0], far[1] - near[1])
            changes.append(1e-3 / max(float(np.nanmedian(moved)) if moved.size else 0.0, 1e-6))
        return float(np.median(changes))

    def _place(self, i: int, j: int, log_scale: float, bent: float = 0.0,
               every: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        patches, camera = self.patches[i], self.cameras[j]
        if (i, j) not in self._turned:
            rotation, tau = camera.relative_to(patches.camera)
            self._turned[i, j] = np.ascontiguousarray(np.moveaxis(patches.rays @ rotation.T, -1, 0)), tau
        rays, tau = self._turned[i, j]
        x, y, z = rays[:, ::every] * self.depth(patches, log_scale, bent)[::every] + tau[:, None, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            good = ((z > 0) & (u > 1) & (v > 1) & (u < camera.width - 1) & (v < camera.height - 1)).all(axis=1)
        return u, v, good

    def depth(self, patches: _Patches, log_scale: float, bent: float) -> np.ndarray:
        """Depths times the factor, their distance from the middle stretched by 1 + `bent`."""
        moved: np.ndarray = np.exp(log_scale) * (patches.depth + bent * (patches.depth - self.middle))
        return moved

    def scores(self, tried: np.ndarray, bent: float = 0.0, every: int = 1) -> np.ndarray:
        """Mean correlation (at least 0) of all patches (each `every`-th) that stay inside, over all pairs, for each log
        factor; NaN where hardly any do."""
        def of_pair(pair: tuple[int, int]) -> list[tuple[float, int]]:
            found = [self._correlations(*pair, *self._place(*pair, float(value), bent, every), every)
                     for value in tried]
            return [(float(values.sum()), len(values)) for values in found]

        total, count = np.sum(side_by_side(of_pair, self.pairs, _THREADS), axis=0).T
        return np.where(count >= _LEAST, total / np.maximum(count, 1), np.nan)

    def _correlations(self, i: int, j: int, u: np.ndarray, v: np.ndarray, good: np.ndarray,
                      every: int = 1) -> np.ndarray:
        """Correlation, at least 0, of the `good` patches of view i (of each `every`-th) with what view j shows at u,
        v."""
        u, v = u[good].astype(np.float32), v[good].astype(np.float32)
        return np.maximum((_unit(bilinear(self.greys[j], u, v))[0] * self.patches[i].grey[::every][good]).sum(axis=1), 0)

    def across(self, i: int, j: int, moves: np.ndarray, log_scale: float = 0.0,
               bent: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Correlations of the pair's patches (moves, patches; NaN for those that leave the photo) where those of j are
        moved by each of `moves` pixels across the direction of depth; and pixels by which each moves along it for a
        unit of log s."""
        (u, v, good), (u2, v2, _) = (self._place(i, j, value, bent) for value in (log_scale, log_scale + 1e-3))
        along = np.stack([(u2 - u).mean(axis=1), (v2 - v).mean(axis=1)])
        lengths = np.hypot(*along)
        along /= np.maximum(lengths, 1e-12)
        found = np.full((len(moves), len(good)), np.nan)
        for row, move in zip(found, moves):
            row[good] = self._correlations(i, j, u - move * along[1][:, None], v + move * along[0][:, None], good)
        return found, lengths * 1e3

    def scores_across(self, i: int, j: int, moves: np.ndarray, log_scale: float = 0.0, bent: float = 0.0) -> np.ndarray:
        """Means over the patches of what `across` gives; NaN where too few are told."""
        found, _ = self.across(i, j, moves, log_scale, bent)
        good = np.isfinite(found).all(axis=0)
        return np.array([row[good].mean() for row in found]) if good.sum() >= _LEAST else np.full(len(moves), np.nan)


def _within(side: int, camera: Camera) -> tuple[int, int]:
    scale = min(1.0, side / max(camera.width, camera.height))
    return max(8, round(camera.width * scale)), max(8, round(camera.height * scale))


def _patches(camera: Camera, grey: np.ndarray, depth: np.ndarray) -> _Patches:
    """Patches with texture, spread over the depth map, none over its edge or a hole."""
    k, (height, width) = _HALF, depth.shape
    inner = np.zeros(depth.shape, bool)
    inner[k:height - k, k:width - k] = True
    rows, columns = np.nonzero(inner & (depth > 0))
    steps = np.arange(-k, k + 1)
    dy, dx = (part.ravel() for part in np.meshgrid(steps, steps, indexing="ij"))
    keep = evenly(len(rows), 4 * _PATCHES) if len(rows) else np.zeros(0, np.intp)
    y, x = rows[keep, None] + dy, columns[keep, None] + dx
    values, near = grey[y, x], depth[y, x].astype(np.float64)
    unit, deviation = _unit(values)
    good = np.flatnonzero((near > 0).all(axis=1) & (deviation > _FLAT))
    good = good[evenly(len(good), _PATCHES)] if len(good) else good
    x, y = x[good], y[good]
    return _Patches(camera, camera.rays_at(y, x), near[good], unit[good])


def _unit(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows without mean and of unit length, and their standard deviation."""
    centred = values - values.mean(axis=1, keepdims=True)
    length = np.sqrt((centred * centred).sum(axis=1))
    return centred / np.maximum(length, 1e-6)[:, None], length / np.sqrt(values.shape[1])
