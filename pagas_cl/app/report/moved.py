"""How far a mesh lies from another one, with a sign: NumPy alone, near enough for colours."""

import numpy as np

from pagas_cl.scene.check.patches import area_of, spread_over

_SAMPLES = 300_000         # points on the surface that distances are taken to
_ROUNDS = 4                # searches, each four times as wide as the one before, for what was not found yet
_MOST_CELLS = 1 << 19      # along an axis, so that a cell's number fits into 64 bits


def moved_by(points, vertices, faces) -> np.ndarray:
    """Distance of `points` (n, 3) from the surface (V, 3), (F, 3): float64 (n,), scene units.

    Above 0 on the side to which the faces' normals point; NaN where no surface is near.
    """
    points, vertices, faces = np.asarray(points, np.float64), np.asarray(vertices, np.float64), np.asarray(faces)
    samples, normals = spread_over(vertices, faces, _SAMPLES)
    away = np.full(len(points), np.nan)
    if not len(samples):
        return away
    spacing = max(np.sqrt(area_of(vertices, faces) / _SAMPLES), np.ptp(samples, axis=0).max() / _MOST_CELLS)
    left = np.arange(len(points))
    for k in range(_ROUNDS):
        each, wide = 16**k, 3 * spacing * 4**k
        near, distance = _nearest(points[left], samples[::each], wide)
        found = distance <= wide
        index, near, distance = left[found], near[found] * each, distance[found]
        along = ((points[index] - samples[near]) * normals[near]).sum(axis=1)
        if k:  # samples are far apart: is the surface where the point's foot is, or does it end before?
            below, gap = _nearest(points[index] - along[:, None] * normals[near], samples, 3 * spacing)
            there = gap <= 3 * spacing
            under = ((points[index] - samples[below]) * normals[below]).sum(axis=1)
            along = np.where(there, under, np.copysign(distance, along))
        away[index] = along
        left = left[~found]
        if not len(left):
            break
    return away


def _nearest(points, samples, wide):
    """Index of the nearest of the samples in the cells of size `wide` around each point, and its distance."""
    low = samples.min(axis=0) - 2 * wide
    cells = np.floor((samples - low) / wide).astype(np.int64)
    size = cells.max(axis=0) + 3
    keys = _key(cells, size)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    home = np.floor((points - low) / wide)
    inside = ((home >= 1) & (home < size - 1)).all(axis=1)
    near, best = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    who = np.flatnonzero(inside)
    home = home[who].astype(np.int64)
    for shift in np.ndindex(3, 3, 3):
        key = _key(home + np.array(shift) - 1, size)
        start, stop = np.searchsorted(keys, key), np.searchsorted(keys, key, side="right")
        place = np.flatnonzero(start < stop)
        while len(place):
            candidate, at = order[start[place]], who[place]
            distance = np.linalg.norm(points[at] - samples[candidate], axis=1)
            closer = distance < best[at]
            near[at[closer]], best[at[closer]] = candidate[closer], distance[closer]
            start[place] += 1
            place = place[start[place] < stop[place]]
    return near, best


def _key(cells, size):
    return (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
