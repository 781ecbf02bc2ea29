"""Patches of some views, and how well they correlate with what other views show where depths take them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.check.patches import grey_of
from pagas_cl.scene.depthmap import depth_down, depth_up
from pagas_cl.scene.images import bilinear
from pagas_cl.scene.sampling import evenly
from pagas_cl.scene.view import View

SIDES = 160, 400        # pixels of the longer side of the photos compared, coarse and fine
AGREE = 0.5             # mean correlation from which on photos are said to agree over the depth
STEP = 0.5              # pixels of parallax between two factors that are tried
LEAST = 30              # patches that say something
_PATCHES = 200          # of a view, at most
_HALF = 3               # pixels of a patch to each side of its middle
_FLAT = 2.0             # grey levels of 255: patches of less texture are not compared
_MOST = 241             # values of s in a sweep
_AT_ONCE = 1 << 18     # samples looked up at a time: between two looks threads hold one another up


@dataclass(frozen=True, eq=False)
class _Patches:
    """Patches of a view: rays (n, p, 3), depths (n, p), grey values (n, p) without mean and of unit length."""

    camera: Camera
    rays: np.ndarray = field(repr=False)
    depth: np.ndarray = field(repr=False)
    grey: np.ndarray = field(repr=False)


class Greys:
    """Grey levels of small photos of `views` at all SIDES; each photo is read once."""

    def __init__(self, views: Sequence[View]):
        self.views = views
        self._small = dict[int, dict[int, np.ndarray]]()        # by view and side

    def at(self, side: int, chosen: Sequence[int]) -> list[np.ndarray]:
        """float32 (h, w) of the views `chosen`, each of the longer side `side`."""
        new = [k for k in chosen if k not in self._small]
        self._small.update(zip(new, side_by_side(self._read, new)))
        return [self._small[k][side] for k in chosen]

    def _read(self, k: int) -> dict[int, np.ndarray]:
        sides = sorted(SIDES, reverse=True)
        small = self.views[k].load_small([_within(side, self.views[k].camera) for side in sides])
        return {side: np.ascontiguousarray(grey_of(photo)) for side, photo in zip(sides, small)}


class Sweep:
    """Photos and patches at one size."""

    def __init__(self, greys: Greys, depths: Sequence[np.ndarray | None], pairs: list[tuple[int, int]], side: int):
        self.pairs, self.patches = pairs, dict[int, _Patches]()
        self._turned = dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]()      # rays of i as j has them, and tau
        chosen = sorted({k for pair in pairs for k in pair})
        sizes = {k: _within(side, greys.views[k].camera) for k in chosen}
        self.cameras = {k: greys.views[k].camera.resized(*size) for k, size in sizes.items()}
        self.greys = dict(zip(chosen, greys.at(side, chosen)))
        for k in sorted({i for i, _ in pairs}):
            if (depth := depths[k]) is not None:
                resized = depth_down if depth.shape[1] >= sizes[k][0] else depth_up
                self.patches[k] = _patches(self.cameras[k], self.greys[k], resized(depth, *sizes[k]))
        every = np.concatenate([patches.depth.ravel() for patches in self.patches.values()])
        self.middle = float(np.median(every)) if len(every) else 1.0
        self.parallax = self._parallax()

    def best(self, start: float, span: float, bent: float) -> float:
        """Where photos agree best within `span` of `start`, which stays where nothing can be compared."""
        step = max(STEP * self.parallax, 2 * span / (_MOST - 1))
        tried = np.union1d(np.arange(start - span, start + span + step / 2, step), [start])
        scores = self.scores(tried, bent)
        return float(peaks(tried, scores[None])[0]) if np.isfinite(scores).any() else start

    def _parallax(self) -> float:
        """Relative change of depth that moves a patch by a pixel, median over the pairs."""
        changes = []
        for i, j in self.pairs:
            u, v, _ = self._place(i, j, np.array([0.0, 1e-3]))
            moved = np.hypot(u[1] - u[0], v[1] - v[0])
            changes.append(1e-3 / max(float(np.nanmedian(moved)) if moved.size else 0.0, 1e-6))
        return float(np.median(changes))

    def _place(self, i: int, j: int, tried: np.ndarray,
               bent: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where view j has the patches of view i, for each log factor (k,): u and v (k, n, p), and whether all of a
        patch is inside (k, n)."""
        patches, camera = self.patches[i], self.cameras[j]
        if (i, j) not in self._turned:
            rotation, tau = camera.relative_to(patches.camera)
            self._turned[i, j] = np.ascontiguousarray(np.moveaxis(patches.rays @ rotation.T, -1, 0)), tau
        rays, tau = self._turned[i, j]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            depth = np.exp(tried)[:, None, None] * self.bent(patches, bent)
            x, y, z = (ray * depth + t for ray, t in zip(rays, tau))
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            good = ((z > 0) & (u > 1) & (v > 1) & (u < camera.width - 1) & (v < camera.height - 1)).all(axis=2)
        return u, v, good

    def bent(self, patches: _Patches, bent: float) -> np.ndarray:
        """Depths whose distance from the middle is stretched by 1 + `bent`."""
        return patches.depth + bent * (patches.depth - self.middle) if bent else patches.depth

    def scores(self, tried: np.ndarray, bent: float = 0.0) -> np.ndarray:
        """Mean correlation (at least 0) of patches that stay inside, all pairs, for each log factor; NaN: too few."""
        def of_pair(pair: tuple[int, int]) -> np.ndarray:
            found = np.concatenate([self._correlations(*pair, *self._place(*pair, some, bent))
                                    for some in self.parts(pair[0], tried)])
            return np.stack([np.nansum(found, axis=1), np.isfinite(found).sum(axis=1)])

        total, count = np.sum(side_by_side(of_pair, self.pairs), axis=0)
        return np.where(count >= LEAST, total / np.maximum(count, 1), np.nan)

    def parts(self, i: int, tried: np.ndarray) -> list[np.ndarray]:
        """`tried` in parts of as many as are looked up at a time."""
        size = max(1, _AT_ONCE // max(1, self.patches[i].depth.size))
        return [tried[k:k + size] for k in range(0, len(tried), size)]

    def _correlations(self, i: int, j: int, u: np.ndarray, v: np.ndarray, good: np.ndarray) -> np.ndarray:
        """Correlation (k, n), at least 0, of patches of view i with what j shows at u, v; NaN where not `good`."""
        found, which = np.full(good.shape, np.nan), np.nonzero(good)[1]
        other = _unit(bilinear(self.greys[j], u[good].astype(np.float32), v[good].astype(np.float32)))[0]
        found[good] = np.maximum((other * self.patches[i].grey[which]).sum(axis=1), 0)
        return found

    def across(self, i: int, j: int, moves: np.ndarray, tried: np.ndarray,
               bent: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Correlations of the pair's patches (k, n; NaN for those that leave the photo) where those of j are moved by
        `moves` pixels across the direction of depth, under the log factors `tried`, one of them for all or as many as
        `moves`; and pixels by which each moves along it for a unit of log s, for each factor."""
        (u, v, good), (u2, v2, _) = (self._place(i, j, some, bent) for some in (tried, tried + 1e-3))
        along = np.stack([(u2 - u).mean(axis=2), (v2 - v).mean(axis=2)])
        lengths = np.hypot(*along)
        across = moves[:, None] * along / np.maximum(lengths, 1e-12)
        u, v = u - across[1][..., None], v + across[0][..., None]
        return self._correlations(i, j, u, v, np.broadcast_to(good, u.shape[:2])), lengths * 1e3

    def scores_across(self, i: int, j: int, moves: np.ndarray, log_scale: float = 0.0, bent: float = 0.0) -> np.ndarray:
        """Means over the patches of what `across` gives for each of `moves`; NaN where too few are known."""
        found = np.concatenate([self.across(i, j, some, np.array([log_scale]), bent)[0]
                                for some in self.parts(i, moves)])
        good = np.isfinite(found).all(axis=0)
        return found[:, good].mean(axis=1) if good.sum() >= LEAST else np.full(len(moves), np.nan)


def peaks(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Where each row of y (n, k), which is not all NaN, is largest over x (k,), by a parabola through three values."""
    rows, best = np.arange(len(y)), np.nanargmax(y, axis=1)
    at = np.clip(best, 1, len(x) - 2)
    a, b, c = x[at - 1], x[at], x[at + 1]
    p, q, r = y[rows, at - 1], y[rows, at], y[rows, at + 1]
    below = (b - a) * (q - r) - (b - c) * (q - p)
    with np.errstate(divide="ignore", invalid="ignore"):
        top = np.clip(b - 0.5 * ((b - a) ** 2 * (q - r) - (b - c) ** 2 * (q - p)) / below, a, c)
    return np.where((at == best) & np.isfinite(p + q + r) & (np.abs(below) >= 1e-12), top, x[best])


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
    keep = evenly(len(rows), 4 * _PATCHES)
    y, x = rows[keep, None] + dy, columns[keep, None] + dx
    values, near = grey[y, x], depth[y, x].astype(np.float64)
    unit, deviation = _unit(values)
    good = np.flatnonzero((near > 0).all(axis=1) & (deviation > _FLAT))
    good = good[evenly(len(good), _PATCHES)]
    x, y = x[good], y[good]
    return _Patches(camera, camera.rays_at(y, x), near[good], unit[good])


def _unit(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows without mean and of unit length, and their standard deviation."""
    centred = values - values.mean(axis=1, keepdims=True)
    length = np.sqrt((centred * centred).sum(axis=1))
    return centred / np.maximum(length, 1e-6)[:, None], length / np.sqrt(values.shape[1])
