"""What a viewer needs of meshes, NumPy alone: fewer triangles, and how far one mesh lies from another.

Of a mesh with too many triangles the vertices of each cell of a grid become one, placed where the planes of its
triangles meet best (quadric clustering), so that creases stay. Distances have a sign, and are near enough for colours.
"""

import numpy as np

from pagas_cl.scene.check.patches import area_of, spread_over
from pagas_cl.scene.mesh import triangle_normals

_MOST_CELLS = 1 << 19      # along an axis, so that a cell's number fits into 64 bits
_SIZES = 8                 # that are tried of a cell
_PART = 1 << 18            # triangles at a time
_STAY = 0.02               # weight of staying at the mean of a cell's vertices, as a share of that of the planes
_SAMPLES = 300_000         # points on the surface that distances are taken to
_SEARCHES = 4              # each four times as wide as the one before, for what was not found yet


def simplify(vertices, faces, most: int):
    """At most `most` triangles of a mesh (V, 3), (F, 3): vertices float64 (W, 3), faces int32 (G, 3).

    Of a mesh that has no more the vertices that no triangle has are left out alone.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    vertices, faces = vertices[used], (np.cumsum(used) - 1).astype(np.int32)[faces]
    if len(faces) <= most:
        return vertices, faces
    corner = vertices.min(axis=0)
    local = vertices - corner
    area = sum(np.linalg.norm(triangle_normals(local, faces[part]), axis=1).sum() for part in _parts(len(faces)))
    cell = max(np.sqrt(area / most), local.max() / _MOST_CELLS, 1e-300)
    for _ in range(_SIZES):
        cells, fewer = _clustered(local, faces, cell)
        if len(fewer) <= most:
            break
        cell *= max(1.02, 1.01 * np.sqrt(len(fewer) / most))
    return _placed(local, faces, cells, cell) + corner, fewer


def _parts(number: int):
    """Slices of so many triangles, so that what is computed of each stays small."""
    return (slice(start, start + _PART) for start in range(0, number, _PART))


def _clustered(local, faces, cell):
    """Number of each vertex's cell, and the triangles that still have three corners, each of them once."""
    index = np.floor(local / cell).astype(np.int64)
    _, cells = np.unique(_key(index, index.max(axis=0) + 1), return_inverse=True)
    cells = cells.reshape(-1).astype(np.int32)
    corners = cells[faces]
    corners = corners[(corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])
                      & (corners[:, 2] != corners[:, 0])]
    first = np.sort(np.unique(np.sort(corners, axis=1), axis=0, return_index=True)[1])
    return cells, corners[first]


def _placed(local, faces, cells, cell):
    """Of each cell the point nearest to the planes of its triangles, by area, and to the mean of its vertices."""
    count = int(cells.max()) + 1
    number = np.bincount(cells, minlength=count)
    mean = np.stack([np.bincount(cells, local[:, k], count) / number for k in range(3)], axis=1)
    planes, pull = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for part in _parts(len(faces)):
        normal = triangle_normals(local, faces[part])
        area = np.linalg.norm(normal, axis=1)
        normal /= np.where(area > 0, area, 1)[:, None]
        for corner in faces[part].T:
            at = cells[corner]
            away = ((local[corner] - mean[at]) * normal).sum(axis=1) * area
            for i in range(3):
                pull[:, i] += np.bincount(at, away * normal[:, i], count)
                for j in range(i, 3):
                    planes[:, i, j] += np.bincount(at, area * normal[:, i] * normal[:, j], count)
    for i, j in ((1, 0), (2, 0), (2, 1)):
        planes[:, i, j] = planes[:, j, i]
    trace = np.trace(planes, axis1=1, axis2=2)
    stay = _STAY * trace + 1e-9 * max(trace.max(), 1e-300)
    move = np.linalg.solve(planes + stay[:, None, None] * np.eye(3), pull[..., None])[..., 0]
    return mean + np.clip(move, -cell, cell)


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
    for k in range(_SEARCHES):
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
