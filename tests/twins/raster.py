"""Twin of cl_kernels/raster.cl in float64: every triangle at every pixel (method section 10.1)."""

from __future__ import annotations

import numpy as np


def depth_of(surface, camera) -> np.ndarray:
    """Depth (H, W), 0 = no surface."""
    rays, depth = camera.rays().reshape(-1, 3), np.full(camera.height * camera.width, np.inf)
    points = (surface.vertices - camera.center) @ camera.world_to_camera[:3, :3].T
    for corners in points[surface.faces]:
        flat = corners[None, :, :2] - rays[:, None, :2] * corners[None, :, 2:]
        ahead, after = flat[:, [1, 2, 0]], flat[:, [2, 0, 1]]
        area = ahead[..., 0] * after[..., 1] - ahead[..., 1] * after[..., 0]
        whole = area.sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = area @ corners[:, 2] / whole
            hit = (area * whole[:, None] >= 0).all(axis=1) & (z > 0)
        depth = np.where(hit, np.minimum(depth, z), depth)
    return np.where(np.isfinite(depth), depth, 0).reshape(camera.height, camera.width)
