"""Patches of views carried to their neighbours by their depths times a factor, and correlated there with the photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.depthmap import depth_down, depth_up
from pagas_cl.scene.images import bilinear, photo_to
from pagas_cl.scene.patches import evenly, grey_of
from pagas_cl.scene.view import View

_PATCHES, _HALF = 200, 3
STEP = 0.5              # pixels of parallax between two values that are tried
LEAST = 30              # patches that say something
_FLAT = 2.0             # grey levels of 255: patches of less texture are not compared
_MOST = 241             # values in a sweep
SOME = 0.3              # least correlation at the best
EACH = 6.0              # pixels searched in both directions for the value of a pair


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of a view: rays (n, p, 3), depths (n, p), grey values (n, p) without mean and of unit length."""

    camera: Camera
    rays: np.ndarray = field(repr=False)
    depth: np.ndarray = field(repr=False)
    grey: np.ndarray = field(repr=False)


def peak(x: np.ndarray, y: np.ndarray) -> float:
    """Where y is largest, by a parabola through three values."""
    k = int(np.nanargmax(y))
    if not 0 < k < len(x) - 1 or not np.isfinite(y[k - 1:k + 2]).all():
        return float(x[k])
    (a, b, c), (p, q, r) = x[k - 1:k + 2], y[k - 1:k + 2]
    below = (b - a) * (q - r) - (b - c) * (q - p)
    if abs(below) < 1e-12:
        return float(b)
    return float(np.clip(b - 0.5 * ((b - a) ** 2 * (q - r) - (b - c) ** 2 * (q - p)) / below, a, c))


class Sweep:
    """Photos and patches at one size."""

    def __init__(self, views: Sequence[View], depths: Sequence[np.ndarray | None], pairs: list[tuple[int, int]],
                 side: int):
        self.pairs, self.patches = pairs, dict[int, Patches]()
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
        step = max(STEP * parallax, 2 * span / (_MOST - 1))
        tried = np.union1d(np.arange(start - span, start + span + step / 2, step), [start])
        scores = np.array([score(float(value)) for value in tried])
        return peak(tried, scores) if np.isfinite(scores).any() else start

    def mean_of_pairs(self, start: float, bent: float) -> float:
        """Mean over the pairs of the value near `start` under which each agrees best, with its photos moved across the
        direction of depth as suits it; weighed by how well they agree, and how far depth moves them."""
        tried = start + self.parallax * np.arange(-EACH, EACH + 0.25, 0.5)
        moves, total, weight = np.arange(-EACH, EACH + 0.5), 0.0, 0.0
        for pair in self.pairs:
            found = [self.scores_across(*pair, moves, value, bent) for value in tried]
            scores, slope = np.array([scores.max() for scores, _ in found]), found[len(found) // 2][1]
            if np.isfinite(scores).all() and scores.max() > SOME:
                own = (scores.max() * slope) ** 2
                total, weight = total + own * peak(tried, scores), weight + own
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
        x, y, z = np.moveaxis(patches.rays * self.depth(patches, log_scale, bent)[..., None] @ rotation.T + tau, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            good = ((z > 0) & (u > 1) & (v > 1) & (u < camera.width - 1) & (v < camera.height - 1)).all(axis=1)
        return u, v, good

    def depth(self, patches: Patches, log_scale: float, bent: float) -> np.ndarray:
        """Depths times the factor, their distance from the middle stretched by 1 + `bent`."""
        moved: np.ndarray = np.exp(log_scale) * (patches.depth + bent * (patches.depth - self.middle))
        return moved

    def score(self, log_scale: float, bent: float = 0.0) -> float:
        """Mean correlation (at least 0) of all patches that stay inside, over all pairs."""
        total, count = 0.0, 0
        for i, j in self.pairs:
            u, v, good = self._place(i, j, log_scale, bent)
            if good.any():
                values = self._correlations(i, j, u, v, good)
                total, count = total + float(values.sum()), count + len(values)
        return total / count if count >= LEAST else float("nan")

    def _correlations(self, i: int, j: int, u: np.ndarray, v: np.ndarray, good: np.ndarray) -> np.ndarray:
        """Correlation, at least 0, of the `good` patches of view i with what view j shows at u, v."""
        other = _unit(bilinear(self.greys[j], u[good], v[good]))[0]
        return np.maximum((other * self.patches[i].grey[good]).sum(axis=1), 0)

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

    def scores_across(self, i: int, j: int, moves: np.ndarray, log_scale: float = 0.0,
                      bent: float = 0.0) -> tuple[np.ndarray, float]:
        """Means over the patches of what `across` gives, NaN where too few are told; median of the pixels."""
        found, lengths = self.across(i, j, moves, log_scale, bent)
        good = np.isfinite(found).all(axis=0)
        if good.sum() < LEAST:
            return np.full(len(moves), np.nan), 0.0
        return np.array([row[good].mean() for row in found]), float(np.median(lengths[good]))


def _patches(camera: Camera, grey: np.ndarray, depth: np.ndarray) -> Patches:
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
    return Patches(camera, camera.rays_at(y, x), near[good], unit[good])


def _unit(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows without mean and of unit length, and their standard deviation."""
    centred = values - values.mean(axis=1, keepdims=True)
    length = np.sqrt((centred * centred).sum(axis=1))
    return centred / np.maximum(length, 1e-6)[:, None], length / np.sqrt(values.shape[1])
