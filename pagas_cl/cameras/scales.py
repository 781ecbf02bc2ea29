"""First scales of depth maps that disagree by a factor a view: from where they overlap, before the photos are asked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.sampling import sample_pixels

_POINTS, _ROUNDS, _FEWEST = 500, 8, 20


def first_scales(cameras: Sequence[Camera], depths: Sequence[np.ndarray], used: Sequence[Sequence[int]]) -> np.ndarray:
    """Factors (N,) that bring the depth maps (H, W) of views nearest to those of their context views (`used`), whose
    median logarithm is 0.

    A point of one map, scaled by e^a, is looked up in another, whose depth there is e^m times the point's: that one's
    factor e^b has a - b = m + a, with the a at hand on the right. Least squares; points then lie elsewhere: again.
    """
    logs, samples = np.zeros(len(cameras)), []
    for camera, depth in zip(cameras, depths):
        rows, columns = sample_pixels(depth, _POINTS) if (depth > 0).any() else (np.zeros(0, int),) * 2
        samples.append(camera.rays_at(rows, columns) * depth[rows, columns, None])
    for _ in range(_ROUNDS):
        equations, sides, weights = [], [], []
        for one, others in enumerate(used):
            for other in others:
                ratio = _ratios(cameras[one], cameras[other], samples[one] * np.exp(logs[one]), depths[other])
                if len(ratio) >= _FEWEST:
                    row = np.zeros(len(cameras))
                    row[one], row[other] = 1.0, -1.0
                    equations.append(row)
                    sides.append(np.median(ratio) + logs[one])
                    weights.append(1 / (0.02 + np.median(np.abs(ratio - np.median(ratio)))))
        if not equations:
            break
        A, w = np.array(equations), np.array(weights)
        logs = np.linalg.lstsq(A * w[:, None], np.array(sides) * w, rcond=1e-6)[0]
        logs -= np.median(logs)
    return np.exp(logs)


def _ratios(camera: Camera, other: Camera, points: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Logarithms of `depth` over what the `points` (n, 3), in `camera`'s frame, have there in `other`."""
    rotation, tau = other.relative_to(camera)
    x, y, z = (points @ rotation.T + tau).T
    front = z > 0
    x, y, z = x[front], y[front], z[front]
    u, v = np.floor(other.fx * x / z + other.cx), np.floor(other.fy * y / z + other.cy)
    inside = (u >= 0) & (v >= 0) & (u < other.width) & (v < other.height)
    own = depth[v[inside].astype(int), u[inside].astype(int)]
    return np.log(own[own > 0].astype(np.float64) / z[inside][own > 0])
