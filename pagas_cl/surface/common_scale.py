"""The factor (and shift) that all depth maps share, which maps alone hardly show: under which photos agree best.

Patches of a view are carried to its neighbours by their depths times s and correlated there; s is swept around 1, first
on small photos and widely, then on larger ones around the best. Where depths differ enough for a shift to show, they
are stretched about their median likewise, which is another factor and a shift.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

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
_ACROSS, _SOME = 10.0, 0.3      # pixels of the small photos searched to each side; least correlation at the best
_EACH = 6.0             # and in both directions for the s of a pair
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
                      known: bool = True) -> CommonScale:
    """The factor by which all depth maps (None where a view has none) are to be multiplied, and the shift added then;
    1 and 0 where photos do not clearly ask for others, or at all where their scale is not `known`. `cameras` are the
    views', of the depth maps' size."""
    pairs = _pairs(cameras, depths)
    if not pairs:
        return CommonScale(1.0, 0.0, float("nan"), float("nan"))
    best, span, bent = 0.0, RANGE, 0.0
    sweeps = [_Sweep(views, depths, pairs, side) for side in _SIDES]
    for sweep in sweeps:
        best = sweep.best(best, span, sweep.parallax, partial(sweep.score, bent=bent))
        span, range_ = _FINER * _STEP * sweep.parallax, sweep.range
        if sweep.parallax / range_ < _BENDABLE:      # else depths that bend look as they did
            trial = sweep.best(bent, _BENDABLE, sweep.parallax / range_, partial(sweep.score, best))
            bent = trial if sweep.score(best, trial) > sweep.score(best, 0.0) + CLEAR else 0.0
            best = sweep.best(best, span, sweep.parallax, partial(sweep.score, bent=bent))
    given = sweeps[-1].score(0.0, 0.0)
    if not sweeps[-1].score(best, bent) > given + (CLEAR if known else 0.0) or abs(best) > 0.98 * RANGE:
        return CommonScale(1.0, 0.0, given, given)
    best = sweeps[0].mean_of_pairs(best, bent)
    factor = float(np.exp(best))
    return CommonScale(factor * (1 + bent), -factor * bent * sweeps[-1].middle, sweeps[-1].score(best, bent), given)


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
    sweep = _Sweep(views, scaled, pairs, _SIDES[0])
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
    sweep = _Sweep(views, depths, pairs, _SIDES[0])
    tried, found, gains = np.arange(-_ACROSS, _ACROSS + 0.25, 0.5), [], []
    for pair in pairs:
        scores, _ = sweep.scores_across(*pair, tried)
        if np.isfinite(scores).all() and scores.max() > _SOME:
            found.append(_peak(tried, scores) * views[pair[0]].camera.width / sweep.cameras[pair[0]].width)
            gains.append(scores.max() - scores[len(tried) // 2])
    if not found:
        return float("nan")
    return float(np.sqrt(np.mean(np.square(found)))) if np.mean(gains) > _GAIN else 0.0


class _Sweep:
    """Photos and patches at one size."""

    def __init__(self, views: Sequence[View], depths: Sequence[np.ndarray | None], pairs: list[tuple[int, int]],
                 side: int):
        self.pairs, self.patches = pairs, dict[int, _Patches]()
        self.greys, self.cameras = dict[int, np.ndarray](), dict[int, Camera]()
        for k in sorted({k for pair in pairs for k in pair}):
            camera = views[k].camera
            scale = min(1.0, side / max(camera.width, camera.height))
            self.cameras[k] = camera.resized(max(8, round(camera.width * scale)), max(8, round(camera.height * scale)))
            size = self.cameras[k].width, self.cameras[k].height
            self.greys[k] = grey_of(photo_to(views[k].load_image(), *size))
            depth = depths[k]
            if depth is not None and any(k == i for i, _ in pairs):
                resized = depth_down if depth.shape[1] >= size[0] else depth_up
                self.patches[k] = _patches(self.cameras[k], self.greys[k], resized(depth, *size))
        every = np.concatenate([patches.depth.ravel() for patches in self.patches.values()])
        self.middle = float(np.median(every)) if len(every) else 1.0
        self.range = float(np.median(np.abs(every / self.middle - 1))) if len(every) else 0.0
        self.range = max(self.range, 1e-9)
        self.parallax = self._parallax()

    def best(self, start: float, span: float, parallax: float, score: Callable[[float], float]) -> float:
        """Where `score` is largest within `span` of `start`, which stays where nothing can be compared."""
        step = max(_STEP * parallax, 2 * span / (_MOST - 1))
        tried = np.union1d(np.arange(start - span, start + span + step / 2, step), [start])
        scores = np.array([score(float(value)) for value in tried])
        return _peak(tried, scores) if np.isfinite(scores).any() else start

    def mean_of_pairs(self, start: float, bent: float) -> float:
        """Mean over the pairs of the value near `start` under which each agrees best, with its photos moved across the
        direction of depth as suits it; weighed by how well they agree, and how far depth moves them."""
        tried = start + self.parallax * np.arange(-_EACH, _EACH + 0.25, 0.5)
        moves, total, weight = np.arange(-_EACH, _EACH + 0.5), 0.0, 0.0
        for pair in self.pairs:
            found = [self.scores_across(*pair, moves, value, bent) for value in tried]
            scores, slope = np.array([scores.max() for scores, _ in found]), found[len(found) // 2][1]
            if np.isfinite(scores).all() and scores.max() > _SOME:
                own = (scores.max() * slope) ** 2
                total, weight = total + own * _peak(tried, scores), weight + own
        return total / weight if weight else start

    def _parallax(self) -> float:
        """Relative change of depth that moves a patch by a pixel, median over the pairs."""
        changes = []
        for i, j in self.pairs:
            near, far = (self._place(i, j, value)[:2] for value in (0.0, 1e-3))
            moved = np.hypot(far[0] - near[0], far[1] - near[1])
            changes.append(1e-3 / max(float(np.nanmedian(moved)) if moved.size else 0.0, 1e-6))
        return float(np.median(changes))

    def _place(self, i: int, j: int, log_scale: float, bent: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        patches, camera = self.patches[i], self.cameras[j]
        rotation, tau = camera.relative_to(patches.camera)
        x, y, z = np.moveaxis(patches.rays * self._depth(patches, log_scale, bent)[..., None] @ rotation.T + tau, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            good = ((z > 0) & (u > 1) & (v > 1) & (u < camera.width - 1) & (v < camera.height - 1)).all(axis=1)
        return u, v, good

    def _depth(self, patches: _Patches, log_scale: float, bent: float) -> np.ndarray:
        """Depths times the factor, their distance from the middle stretched by 1 + `bent`."""
        moved: np.ndarray = np.exp(log_scale) * (patches.depth + bent * (patches.depth - self.middle))
        return moved

    def score(self, log_scale: float, bent: float = 0.0) -> float:
        """Mean correlation (at least 0) of all patches that stay inside, over all pairs."""
        total, count = 0.0, 0
        for i, j in self.pairs:
            u, v, good = self._place(i, j, log_scale, bent)
            if good.any():
                other = _unit(bilinear(self.greys[j], u[good], v[good]))[0]
                values = np.maximum((other * self.patches[i].grey[good]).sum(axis=1), 0)
                total, count = total + float(values.sum()), count + len(values)
        return total / count if count >= _LEAST else float("nan")

    def scores_across(self, i: int, j: int, moves: np.ndarray, log_scale: float = 0.0,
                      bent: float = 0.0) -> tuple[np.ndarray, float]:
        """Mean correlation of the pair's patches where those of j are moved by each of `moves` pixels across the
        direction of depth; and pixels by which they move along it for a unit of log s."""
        (u, v, good), (u2, v2, _) = (self._place(i, j, value, bent) for value in (log_scale, log_scale + 1e-3))
        if good.sum() < _LEAST:
            return np.full(len(moves), np.nan), 0.0
        along = np.stack([(u2 - u)[good].mean(axis=1), (v2 - v)[good].mean(axis=1)])
        lengths = np.hypot(*along)
        along /= np.maximum(lengths, 1e-12)
        found = []
        for move in moves:
            moved = bilinear(self.greys[j], u[good] - move * along[1][:, None], v[good] + move * along[0][:, None])
            found.append(np.maximum((_unit(moved)[0] * self.patches[i].grey[good]).sum(axis=1), 0).mean())
        return np.array(found), float(np.median(lengths)) * 1e3


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
