"""By what offset and scale would a mesh agree with the photos? Patches of it are moved along their rays to where two
photos match best; the offset and scale that do this for most of them are fitted. NumPy alone.

A depth that moves a patch along its ray moves the surface along its normal: sliding along itself shows nowhere, and is
left out of the fit where that is all that an offset does (a plane).
"""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.check import patches
from pagas_cl.scene.images import photo_to

_LEVELS = ((0.25, 8, 1), (0.25, 6, 1), (0.5, 4, 1), (1.0, 2, 2))    # size of the photos, pixels to search, steps each
_LEAST_SIDE = 48     # pixels of a photo made smaller
_MOST = 100          # patches of a pair of photos
_VIEWS = 6           # that are compared with two others each
_MATCHED = 0.7       # correlation of a patch that is believed to be found
_LEAST_SHOWN = 0.1   # how much an offset must show, of the one that shows most, to be fitted
_EXPLAINED = 0.8     # of what an offset alone leaves: a scale that leaves more is none


@dataclass(frozen=True)
class Alignment:
    """x -> scale x + offset, of a mesh in scene units; `pixels`: median way of its patches as other photos see it."""

    scale: float = 1.0
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    pixels: float = 0.0

    def __call__(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        moved: npt.NDArray[np.float64] = self.scale * points + self.offset
        return moved

    def of(self, samples: patches.Samples) -> patches.Samples:
        """The samples of the mesh as it lies then."""
        return replace(samples, points=self(samples.points))

    def then(self, scale: float, offset: np.ndarray) -> "Alignment":
        """This one and another one after it."""
        return Alignment(scale * self.scale, scale * self.offset + offset)


def align(cameras: list[Camera], greys: list[np.ndarray], samples: patches.Samples,
          start: Alignment | None = None) -> Alignment | None:
    """The Alignment that the photos show, found from `start` on; None where too little of the mesh is matched."""
    start = start or Alignment()
    found = start
    rows = None
    for scale, reach, fine in _LEVELS:
        scale = max(scale, min(1.0, _LEAST_SIDE / min(min(grey.shape) for grey in greys)))
        sizes = [(round(c.width * scale), round(c.height * scale)) for c in cameras]
        small = [camera.resized(*size) for camera, size in zip(cameras, sizes)]
        photos = [photo_to(grey, *size) for grey, size in zip(greys, sizes)]
        rows = _matches(small, photos, found.of(samples), reach, fine)
        if rows is None:
            return None
        step = _fitted(rows[0], rows[1])
        found = found.then(1 + step[3], step[:3])
    if rows is None:
        return None
    factors, _, which = rows
    moved = found(samples.points[which]) - start(samples.points[which])
    return replace(found, pixels=float(np.median(np.abs((factors[:, :3] * moved).sum(axis=1)))))


def _matches(cameras: list[Camera], greys: list[np.ndarray], samples: patches.Samples, reach: int,
             fine: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Rows of the fit: pixels a unit of offset along x, y, z, and of scale (n, 4); pixels that the patch was found away
    (n,); the patches (n,)."""
    seen, pairs = patches.overlaps(cameras, samples, _VIEWS)
    factors, away, which = [], [], []
    for a, b in pairs:
        index = np.flatnonzero(seen[a] & seen[b])
        index = index[patches.evenly(len(index), _MOST)] if len(index) else index
        points = samples.points[index]
        normals = samples.normals[index]
        center = cameras[a].center
        ray = points - center
        near, _ = cameras[b].project(center + ray * (1 - 1e-4))
        far, _ = cameras[b].project(center + ray * (1 + 1e-4))
        speed = np.linalg.norm(far - near, axis=1) / 2e-4          # pixels of b a share of the depth
        steps = np.arange(-reach * fine, reach * fine + 1) / fine
        grid = patches.patch_grids(points, normals, cameras[a])
        own = patches.look_up(greys[a], cameras[a], grid)
        scores = np.empty((len(index), len(steps)))
        for column, step in enumerate(steps):
            stretch = (1 + step / np.maximum(speed, 1e-9))[:, None, None]
            other = patches.look_up(greys[b], cameras[b], center + (grid - center) * stretch)
            scores[:, column] = patches.correlation(own, other)
        best = np.argmax(np.nan_to_num(scores, nan=-2), axis=1)
        top = scores[np.arange(len(best)), best]
        good = (top > _MATCHED) & (best > 0) & (best < len(steps) - 1)
        toward = (normals * ray).sum(axis=1)
        good &= np.abs(toward) > 1e-9 * np.linalg.norm(ray, axis=1)
        unit = normals[good] * (speed[good] / toward[good])[:, None]
        factors.append(np.column_stack([unit, (unit * points[good]).sum(axis=1)]))
        away.append(steps[best[good]])
        which.append(index[good])
    if sum(map(len, away)) < patches.LEAST:
        return None
    return np.concatenate(factors), np.concatenate(away), np.concatenate(which)


def _fitted(factors: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Offset (3) and change of scale about the origin (1), scene units, by robust least squares in what shows."""
    # about the middle, in units of what each does on the average, so that one threshold does for all
    solved = np.linalg.lstsq(factors[:, :3], factors[:, 3], rcond=None)[0]
    about = factors.copy()
    about[:, 3] -= factors[:, :3] @ solved
    norm = np.maximum(np.sqrt((about**2).mean(axis=0)), 1e-300)
    norm[:3] = norm[:3].max()
    alone, left_alone = _robust(about[:, :3] / norm[:3], away)
    both, left = _robust(about / norm, away)
    x = (both if left < _EXPLAINED * left_alone else np.append(alone, 0.0)) / norm
    return np.append(x[:3] - x[3] * solved, x[3])


def _robust(factors: np.ndarray, away: np.ndarray) -> tuple[np.ndarray, float]:
    """The solution, without what hardly shows, and the median of what it leaves, pixels."""
    weight, x, left = np.ones(len(away)), np.zeros(factors.shape[1]), np.abs(away)
    for _round in range(15):
        root = np.sqrt(weight)[:, None]
        u, s, vt = np.linalg.svd(factors * root, full_matrices=False)
        keep = s > _LEAST_SHOWN * s[0]
        x = vt[keep].T @ ((u[:, keep].T @ (away * root[:, 0])) / s[keep])
        left = np.abs(away - factors @ x)
        weight = 1 / (1 + (left / max(0.3, 1.5 * float(np.median(left))))**2)**2
    return x, float(np.median(left))
