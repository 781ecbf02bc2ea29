"""How far depth maps contradict each other, pixel by pixel: what tells whether a refinement serves a fusion."""

from __future__ import annotations

import numpy as np

from pagas_cl.reference.agree import OCCLUDED, difference
from pagas_cl.scene.camera import Camera

_WINDOW = 4       # pixels to each side over which differences are averaged


def disagreement(target: Camera, depth: np.ndarray, cameras: list[Camera], depths: list[np.ndarray]) -> np.ndarray:
    """Mean difference between a depth map and the others where they see the same surface, as a share of depth.

    Parameters
    ----------
    target, depth : Camera, ndarray of shape (H, W)
    cameras, depths : the other views

    Returns
    -------
    ndarray of shape (H, W), float64
        Averaged over a window of 9 x 9 pixels; NaN where no other view sees the surface.
    """
    total, count = np.zeros(depth.shape), np.zeros(depth.shape)
    rows, columns = np.nonzero(depth > 0)
    d = depth[rows, columns].astype(np.float64)
    rho = np.stack([(columns + 0.5 - target.cx) / target.fx, (rows + 0.5 - target.cy) / target.fy, np.ones(len(d))])
    for camera, other in zip(cameras, depths):
        rotation, tau = camera.relative_to(target)
        x, y, z = rotation @ (rho * d) + tau[:, None]
        front = z > 1e-6 * d
        z = np.where(front, z, 1)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = np.flatnonzero(front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height))
        error = difference(other, u[inside], v[inside], z[inside]) / z[inside]
        same = error < OCCLUDED
        place = rows[inside[same]], columns[inside[same]]
        total[place] += error[same]
        count[place] += 1
    with np.errstate(invalid="ignore"):
        return _box(total) / np.where(_box(count) > 0.5, _box(count), np.nan)


def _box(values: np.ndarray) -> np.ndarray:
    """Sums over windows of 2 _WINDOW + 1 pixels."""
    for axis in (0, 1):
        padded = np.pad(values, [(_WINDOW + 1, _WINDOW) if a == axis else (0, 0) for a in (0, 1)])
        sums = np.cumsum(padded, axis=axis)
        span = 2 * _WINDOW + 1
        values = np.take(sums, np.arange(span, sums.shape[axis]), axis) - np.take(
            sums, np.arange(sums.shape[axis] - span), axis)
    return values
