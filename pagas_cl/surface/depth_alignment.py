"""Depth maps that disagree are brought together: a factor and a shift a view, estimated for all views at once.

Networks give each depth map a scale (and a shift) of its own. Where two views see the same surface, the depth that one
carries to the other must be the other's:

    r = log z(a_i d_i + b_i m_i, carried from i to j) - log(a_j d_j + b_j m_j at that place)          m = median depth

The sum of robust squares of r over samples of all overlapping pairs, with priors on log a and b, is solved by
Gauss-Newton with iterated weights. The priors also hold what such pairs hardly see, the factor that all views share:
the mean of the given depths stays, but for what photos say (see surface.common_scale).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pagas_cl.config import Context
from pagas_cl.runtime.host import side_by_side
from pagas_cl.scene.camera import Camera
from pagas_cl.scene.choice import ContextChooser
from pagas_cl.scene.depthmap import depth_down
from pagas_cl.scene.images import bilinear
from pagas_cl.scene.sampling import sample_pixels

SIDE = 160              # pixels of the reduced maps' longer side: noise is averaged, depth edges are few
_NEIGHBOURS, _SAMPLES = 6, 400
_PRIOR = 0.25, 0.05     # standard deviations of log a and of b
BOUNDS = 0.5, 0.25      # the largest |log a| and |b| that are believed
_WORTH = 40.0           # independent samples that a pair counts as
_ROUNDS, _STEP = 25, 0.01
_GATE, _FLOOR = 0.6, 2e-3       # largest |r| that is looked at; least scale of the weights


@dataclass(frozen=True, eq=False)
class Reduced:
    """A view's depth map at a small size: `camera` of that size, `depth` (h, w) float32, its median, and samples of it:
    rays (n, 3) and depths (n,), float64."""

    camera: Camera
    depth: np.ndarray = field(repr=False)
    middle: float
    rays: np.ndarray = field(repr=False)
    samples: np.ndarray = field(repr=False)

    @cached_property
    def surface(self) -> np.ndarray:
        """Where there is one, 1, and its depth: float64 (h, w, 2)."""
        return np.stack([self.depth > 0, self.depth], axis=-1).astype(np.float64, order="C")


def reduced(camera: Camera, depth: np.ndarray) -> Reduced:
    """Cut a depth map (H, W) down."""
    scale = min(1.0, SIDE / max(depth.shape))
    small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    depth = depth_down(depth, small.width, small.height)
    rows, columns = sample_pixels(depth, _SAMPLES)
    rays = small.rays_at(rows, columns)
    values = depth[rows, columns].astype(np.float64)
    return Reduced(small, depth, float(np.median(values)) if len(values) else 1.0, rays, values)


def pairs_of(views: Sequence[Reduced]) -> list[tuple[int, int]]:
    """(i, j): views j that see much of what view i sees."""
    settings = Context(number=_NEIGHBOURS, min_angle=0.0)
    chooser = ContextChooser([view.camera for view in views], [view.depth for view in views], settings, _SAMPLES)
    seen = [i for i, view in enumerate(views) if len(view.samples)]
    return [(i, j) for i, choice in zip(seen, side_by_side(chooser.choose, seen)) for j in choice.indices]


def carried(view: Reduced, other: Reduced, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples of `view` at `depth` in the other view: x, y in its map, and z; NaN where behind it or outside."""
    rotation, tau = other.camera.relative_to(view.camera)
    x, y, z = (view.rays * depth[:, None] @ rotation.T + tau).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = other.camera.fx * x / z + other.camera.cx, other.camera.fy * y / z + other.camera.cy
        good = (z > 0) & (u >= 1) & (v >= 1) & (u < other.camera.width - 1) & (v < other.camera.height - 1)
    return np.where(good, u, np.nan), np.where(good, v, np.nan), np.where(good, z, np.nan)


def looked_up(surface: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Depth of Reduced.surface at positions, NaN where any of the four neighbours is no surface or the position is
    NaN."""
    there, found = bilinear(surface, u, v).T
    return np.where((there > 1 - 1e-9) & np.isfinite(u), found, np.nan)


def solve(views: Sequence[Reduced], pairs: Sequence[tuple[int, int]]) -> np.ndarray:
    """log a and b of every view, float64 (views, 2)."""
    x = np.zeros((len(views), 2))
    for _ in range(_ROUNDS):
        step = _step(views, pairs, x)
        x = np.clip(x + step, -np.array(BOUNDS), BOUNDS)
        if np.abs(step).max(initial=0) < 1e-5:
            break
    return x


def residuals(view: Reduced, other: Reduced, xi: np.ndarray, xj: np.ndarray,
              nearer: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """r of the samples of `view` (NaN where it says nothing) and the other's given depth there."""
    depth = (np.exp(xi[0]) * view.samples + xi[1] * view.middle) * (1 + nearer)
    u, v, z = carried(view, other, depth)
    given = looked_up(other.surface, u, v)
    with np.errstate(invalid="ignore", divide="ignore"):
        r = np.log(z) - np.log(np.exp(xj[0]) * given + xj[1] * other.middle)
    return np.where(np.abs(r) < _GATE, r, np.nan), given


def _step(views: Sequence[Reduced], pairs: Sequence[tuple[int, int]], x: np.ndarray) -> np.ndarray:
    """One step of Gauss-Newton from x, weights as of its residuals."""
    prior = 1 / np.array(_PRIOR) ** 2
    H, g = np.diag(np.tile(prior, len(views))), (x * prior).ravel()
    found = [(i, j, *residuals(views[i], views[j], x[i], x[j])) for i, j in pairs]
    sizes = np.concatenate([np.abs(r) for *_, r, _ in found] or [np.zeros(0)])
    sizes = sizes[np.isfinite(sizes)]
    scale = max(1.4826 * float(np.median(sizes)) if len(sizes) else 1.0, _FLOOR)
    for i, j, r, given in found:
        moved, _ = residuals(views[i], views[j], x[i], x[j], _STEP)
        use = np.isfinite(r) & np.isfinite(moved)
        if use.sum() < 10:
            continue
        r, given, a, b = r[use], given[use], np.exp(x[:, 0]), x[:, 1]
        own = a[i] * views[i].samples[use] + b[i] * views[i].middle
        theirs = a[j] * given + b[j] * views[j].middle
        slope = np.clip((moved[use] - r) / np.log1p(_STEP), -3, 3)        # dr / d log depth of i
        J = np.stack([slope * a[i] * views[i].samples[use] / own, slope * views[i].middle / own,
                      -a[j] * given / theirs, -views[j].middle / theirs], -1)
        w = _WORTH / len(r) / scale**2 / (1 + (r / (2 * scale)) ** 2) ** 2
        place = np.array([2 * i, 2 * i + 1, 2 * j, 2 * j + 1])
        H[np.ix_(place, place)] += (J * w[:, None]).T @ J
        g[place] += (J * w[:, None]).T @ r
    return -np.linalg.solve(H, g).reshape(-1, 2)
