"""Depth maps that disagree are aligned in scale: a factor and a shift a view, estimated for all views at once (method
section 7), by Gauss-Newton on robust squares of

    r = log z(a_i d_i + b_i m_i, carried from i to j) - log(a_j d_j + b_j m_j at that place)          m = median depth

with priors on log a and b. These hold the factor that all views share, which surface.common_scale finds."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pagas_cl.config import Context
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.depthmap import depth_down
from pagas_cl.scene.images import bilinear
from pagas_cl.scene.sampling import sample_pixels

# Constants of section 7; r, log a and b are shares of the depth.
SIDE = 160              # pixels of the reduced maps' longer side: noise is averaged, depth edges are few
_NEIGHBOURS = 6         # views that each one is compared with
_SAMPLES = 400          # of a view
_PRIOR = 0.25, 0.05     # standard deviations of log a and of b: less holds what pairs hardly see more firmly
BOUNDS = 0.5, 0.25      # the largest |log a| and |b| that are believed
_WORTH = 40.0           # independent samples that a pair counts as, against the priors
_ROUNDS = 25            # of Gauss-Newton, at most
_STEP = 0.01            # of the depth, for the numerical derivative of r
_GATE = 0.6             # largest |r| that is looked at
_FLOOR = 2e-3           # least scale of the weights
_MEET = 5               # samples of a pair that a median is taken of
_PAIRS = 512            # that are compared at a time, which bounds memory
_OF_PAIRS = "pairs", "rotation", "tau", "lens", "row"


@dataclass(frozen=True, eq=False)
class Reduced:
    """A view's depth map at a small size: `camera` of that size, `depth` (h, w) float32, its median, and samples of it:
    rays (n, 3) and depths (n,), float64."""

    camera: Camera
    depth: np.ndarray = field(repr=False)
    middle: float
    rays: np.ndarray = field(repr=False)
    samples: np.ndarray = field(repr=False)


def reduced(camera: Camera, depth: np.ndarray) -> Reduced:
    """Cut a depth map (H, W) down."""
    scale = min(1.0, SIDE / max(depth.shape))
    small = camera.scaled(scale)
    depth = depth_down(depth, *small.size)
    rows, columns = sample_pixels(depth, _SAMPLES)
    rays = small.rays_at(rows, columns)
    values = depth[rows, columns].astype(np.float64)
    return Reduced(small, depth, float(np.median(values)) if len(values) else 1.0, rays, values)


@dataclass(frozen=True, eq=False)
class Overlaps:
    """Where views see the same: `pairs` (P, 2) of (i, j), view j sees much of what view i sees; float64.

    Of each view (V): `samples` (V, n), NaN where it has fewer, their `rays` (V, n, 3), its `middle` (V,). Of each pair:
    the pose from i to j, `rotation` (P, 3, 3) and `tau` (P, 3); `lens` of j, (P, 6, 1), fx, fy, cx, cy, width, height.
    All maps one below the other: `surface` (h, w, 2), float32, 1 where there is one, and its depth; `row` (P, 1), the
    first of j."""

    pairs: np.ndarray
    samples: np.ndarray
    rays: np.ndarray
    middle: np.ndarray
    rotation: np.ndarray
    tau: np.ndarray
    lens: np.ndarray
    surface: np.ndarray
    row: np.ndarray

    @classmethod
    def of(cls, views: Sequence[Reduced]) -> "Overlaps":
        pairs, cameras = _pairs(views), [view.camera for view in views]
        samples = np.full((len(views), max(2, *(len(view.samples) for view in views))), np.nan)
        rays, top = np.zeros((*samples.shape, 3)), np.cumsum([0, *(camera.height for camera in cameras)])
        surface = np.zeros((top[-1], max(camera.width for camera in cameras), 2), np.float32)
        for k, view in enumerate(views):
            samples[k, :len(view.samples)], rays[k, :len(view.samples)] = view.samples, view.rays
            surface[top[k]:top[k + 1], :view.camera.width] = np.stack([view.depth > 0, view.depth], axis=-1)
        poses = [cameras[j].relative_to(cameras[i]) for i, j in pairs]
        lens = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in cameras])[pairs[:, 1]]
        return cls(pairs, samples, rays, np.array([view.middle for view in views]),
                   np.reshape([rotation for rotation, _ in poses], (-1, 3, 3)),
                   np.reshape([tau for _, tau in poses], (-1, 3)), lens[..., None], surface, top[pairs[:, 1], None])

    def some(self, which: slice) -> "Overlaps":
        return replace(self, samples=self.samples[:, which], rays=self.rays[:, which])

    @property
    def parts(self) -> list["Overlaps"]:
        """The same, with so many pairs each that they take little memory."""
        return [replace(self, **{name: getattr(self, name)[start:start + _PAIRS] for name in _OF_PAIRS})
                for start in range(0, len(self.pairs), _PAIRS)]

    def residuals(self, x: np.ndarray, nearer: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """r of each pair's samples (P, n), NaN: nothing said, and the other's depth there; `x` (V, 2): log a and b."""
        i, j = self.pairs.T
        depth = (np.exp(x[i, :1]) * self.samples[i] + (x[i, 1] * self.middle[i])[:, None]) * (1 + nearer)
        place = self.rays[i] * depth[..., None] @ np.swapaxes(self.rotation, 1, 2) + self.tau[:, None]
        (right, down, z), (fx, fy, cx, cy, width, height) = np.moveaxis(place, 2, 0), np.moveaxis(self.lens, 1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = fx * right / z + cx, fy * down / z + cy
            good = (z > 0) & (u >= 1) & (v >= 1) & (u < width - 1) & (v < height - 1)
        there, found = np.moveaxis(bilinear(self.surface, np.where(good, u, 1), np.where(good, v, 1) + self.row), 2, 0)
        given = np.where(good & (there > 1 - 1e-9), found, np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):
            r = np.log(z) - np.log(np.exp(x[j, :1]) * given + (x[j, 1] * self.middle[j])[:, None])
        return np.where(np.abs(r) < _GATE, r, np.nan), given

    def disagreement(self, x: np.ndarray) -> np.ndarray:
        """Median |r| of each pair, NaN where they hardly meet."""
        medians = [np.zeros(0)]
        for part in self.parts:
            sizes = np.sort(np.abs(part.residuals(x)[0]), axis=1)       # NaN last
            number, rows = np.isfinite(sizes).sum(axis=1), np.arange(len(sizes))
            below, above = np.maximum(number - 1, 0) // 2, np.minimum(number, len(sizes.T) - 1) // 2
            medians.append(np.where(number >= _MEET, (sizes[rows, below] + sizes[rows, above]) / 2, np.nan))
        return np.concatenate(medians)


def _pairs(views: Sequence[Reduced]) -> np.ndarray:
    settings = Context(number=_NEIGHBOURS, min_angle=0.0)
    chooser = ContextChooser([view.camera for view in views], [view.depth for view in views], settings, _SAMPLES)
    seen = [i for i, view in enumerate(views) if len(view.samples)]
    return np.array([(i, j) for i in seen for j in chooser.choose(i).indices], np.intp).reshape(-1, 2)


def solve(maps: Overlaps) -> np.ndarray:
    """log a and b of every view, float64 (views, 2)."""
    x = np.zeros((len(maps.samples), 2))
    for _ in range(_ROUNDS):
        step = _step(maps, x)
        x = np.clip(x + step, -np.array(BOUNDS), BOUNDS)
        if np.abs(step).max(initial=0) < 1e-5:
            break
    return x


def _step(maps: Overlaps, x: np.ndarray) -> np.ndarray:
    """One step of Gauss-Newton from x, weights as of its residuals."""
    prior = 1 / np.array(_PRIOR) ** 2
    H, g = np.diag(np.tile(prior, len(x))), (x * prior).ravel()
    found = [(part, *part.residuals(x)) for part in maps.parts]
    sizes = np.abs(np.concatenate([np.zeros(0), *(r[np.isfinite(r)] for _, r, _ in found)]))
    scale = max(1.4826 * float(np.median(sizes)) if len(sizes) else 1.0, _FLOOR)
    for part, r, given in found:
        _add(part, x, r, given, scale, H, g)
    return -np.linalg.solve(H, g).reshape(-1, 2)


def _add(maps: Overlaps, x: np.ndarray, r: np.ndarray, given: np.ndarray, scale: float, H: np.ndarray,
         g: np.ndarray) -> None:
    """The normal equations of residuals r, whose weights follow from their `scale`, to H and g."""
    moved, _ = maps.residuals(x, _STEP)
    use = np.isfinite(r) & np.isfinite(moved)
    number = use.sum(axis=1, keepdims=True)
    use &= number >= 10
    (i, j), a, b = maps.pairs.T, np.exp(x[:, :1]), x[:, 1:] * maps.middle[:, None]
    own, theirs = a[i] * maps.samples[i] + b[i], a[j] * given + b[j]
    slope = np.clip((moved - r) / np.log1p(_STEP), -3, 3)        # dr / d log depth of i
    J = np.stack([slope * a[i] * maps.samples[i] / own, slope * maps.middle[i, None] / own,
                  -a[j] * given / theirs, -maps.middle[j, None] / theirs], -1)
    w = _WORTH / np.maximum(number, 1) / scale**2 / (1 + (r / (2 * scale)) ** 2) ** 2
    J, r, w = np.where(use[..., None], J, 0), np.where(use, r, 0), np.where(use, w, 0)
    weighted, place = np.swapaxes(J * w[..., None], 1, 2), np.stack([2 * i, 2 * i + 1, 2 * j, 2 * j + 1], -1)
    np.add.at(H, (place[:, :, None], place[:, None, :]), weighted @ J)
    np.add.at(g, place, (weighted @ r[..., None])[..., 0])
