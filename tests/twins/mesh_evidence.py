"""Twin of cl_kernels/mesh_evidence.cl in float64 NumPy (method section 10.2)."""

from __future__ import annotations

import numpy as np

FACING, ON_SURFACE, NO_EDGE, LEAST_SIGMA, OUTLIER, DOUBT = 0.15, 1.0, 3.0, 0.1, 1.0, 0.3
REACH, MOST_REACH, ALONE, STEEP, NEAR = 0.5, 12, 3, 0.87, 0.3
MOST_WEIGHT, WEIGHT_SHARE = 4.0, 0.01


def vertex_normals(vertices, faces) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the normals around each vertex by angle, unit length (V, 3), and the length that it had (V,)."""
    normals, angles = np.zeros_like(vertices), np.zeros(len(vertices))
    for k in range(3):
        p, q, r = (vertices[faces[:, (k + turn) % 3]] for turn in range(3))
        across = np.cross(q - p, r - p)
        area = np.linalg.norm(across, axis=1)
        angle = np.arctan2(area, ((q - p) * (r - p)).sum(axis=1))
        np.add.at(normals, faces[:, k], across * (angle / np.maximum(area, 1e-300))[:, None])
        np.add.at(angles, faces[:, k], angle)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return normals, length[:, 0] / np.maximum(angles, 1e-300)


def mean_edges(vertices, faces) -> np.ndarray:
    """Mean length of the edges around each vertex, by triangle (V,)."""
    total, number = np.zeros(len(vertices)), np.zeros(len(vertices))
    for k in range(3):
        for other in (1, 2):
            ends = faces[:, k], faces[:, (k + other) % 3]
            np.add.at(total, ends[0], np.linalg.norm(vertices[ends[1]] - vertices[ends[0]], axis=1))
            np.add.at(number, ends[0], 1)
    return total / np.maximum(number, 1)


def gather(vertices, normals, reach, view, drawn, orientation=1.0):
    """Way along the normal and weight (0: no word) that a view gives each vertex, its footprint there (infinite where
    it does not see it), scene units, and whether its word may stand alone: (V,) each."""
    camera, depth, deviation = view.camera, view.depth.astype(np.float64), view.deviation
    turn = camera.world_to_camera[:3, :3]
    way, weight, unit = np.zeros(len(vertices)), np.zeros(len(vertices)), np.full(len(vertices), np.inf)
    alone, wide_depth = np.zeros(len(vertices), bool), np.pad(depth, ALONE)
    wide_rays = np.pad(camera.rays(), ((ALONE, ALONE), (ALONE, ALONE), (0, 0)))
    for i, (place, normal) in enumerate(zip(vertices, normals)):
        p, n = turn @ (place - camera.center), turn @ normal
        facing = -orientation * (p @ n) / np.linalg.norm(p)
        if not (p[2] > 0 and facing > FACING):
            continue
        u, v = camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy
        if not (1.5 < u < camera.width - 1.5 and 1.5 < v < camera.height - 1.5):
            continue
        size, column, row = p[2] / np.sqrt(camera.fx * camera.fy), int(u), int(v)
        lean = 1 + np.sqrt(1 / facing**2 - 1)
        if not (drawn[row, column] > 0 and abs(drawn[row, column] - p[2]) < ON_SURFACE * size * lean):
            continue
        unit[i] = size
        slope = p @ n / p[2]
        sigma = deviation[row, column] * abs(slope)
        part = slice(row, row + 2 * ALONE + 1), slice(column, column + 2 * ALONE + 1)
        apart = wide_rays[part] * wide_depth[part][..., None]
        apart -= apart[ALONE, ALONE]
        least = np.minimum(NO_EDGE * size, STEEP * np.linalg.norm(apart, axis=2))
        one = (wide_depth[part] > 0) & (abs(apart @ n) <= least)
        alone[i] = np.isfinite(sigma) and one.all()
        if not (np.isfinite(sigma) and one[ALONE - 1:ALONE + 2, ALONE - 1:ALONE + 2].all()):
            continue
        wide, far = REACH * reach[i], min(int(np.ceil(REACH * reach[i] / size)), MOST_REACH)
        part = (slice(max(row - far, 0), row + far + 1), slice(max(column - far, 0), column + far + 1))
        rays, d, z = camera.rays()[part], depth[part], drawn[part].astype(np.float64)
        off = (d - z) * (rays @ n)
        apart = z[..., None] * rays - p
        away = np.linalg.norm(apart, axis=-1)
        share = np.where(abs(apart @ n) < STEEP * away + NEAR * size, 1 - away / wide, 0)
        share[(z <= 0) | (d <= 0) | ~np.isfinite(deviation[part]) | (share < 0) | (abs(off) >= NO_EDGE * size)] = 0
        with np.errstate(invalid="ignore"):
            sure = np.where(share > 0, share / np.maximum(deviation[part] * abs(rays @ n), LEAST_SIGMA * size) ** 2, 0)
        if share.any():
            way[i], weight[i] = (sure * off).sum() / sure.sum(), sure.sum() / share.sum()
        else:
            left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
            a, b = u - 0.5 - left, v - 0.5 - top
            four = np.outer([1 - b, b], [1 - a, a])
            way[i] = (1 / (four / depth[top:top + 2, left:left + 2]).sum() - p[2]) * slope
            weight[i] = 1 / max(sigma, LEAST_SIGMA * size) ** 2
        weight[i] *= facing**4
    return way, weight, unit, alone


def resolve(shifts, weights, units, alone, least_views):
    """Robust mean of shifts (views, V): target, weight, views that agree, standard deviation, footprint; (V,) each."""
    unit, looks = units.min(axis=0), np.isfinite(units).sum(axis=0)
    count = shifts.shape[1]
    target, weight, seen, sigma = np.zeros(count), np.zeros(count), np.zeros(count, int), np.full(count, np.inf)
    for i in range(count):
        order = np.argsort(shifts[:, i], kind="stable")
        order = order[weights[order, i] > 0]
        if not len(order):
            continue
        t, w = shifts[order, i], weights[order, i]
        apart = abs(t - t[np.searchsorted(np.cumsum(w), 0.5 * w.sum())]) / unit[i]
        share = np.where(apart <= OUTLIER, w / np.maximum(1, apart / DOUBT), 0)
        seen[i] = (apart <= OUTLIER).sum()
        if seen[i] >= least_views or seen[i] == len(t) == alone[:, i].sum() and looks[i] >= least_views:
            target[i], sigma[i] = (share @ t) / share.sum(), share.sum() ** -0.5
            weight[i] = MOST_WEIGHT * min(share.sum() / seen[i] * unit[i] ** 2 * WEIGHT_SHARE, 1)
    return target, weight, seen, sigma, unit
