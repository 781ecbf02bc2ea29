"""Fewer triangles for looking at: the vertices of each cell of a grid become one, placed where the planes of its
triangles meet best (quadric clustering), so that creases stay."""

import numpy as np

from pagas_cl.scene.mesh import triangle_normals

_ROUNDS = 8                 # of finding the cell's size
_MOST_CELLS = 1 << 20      # along an axis, so that a cell's number fits into 64 bits
_PART = 1 << 18             # triangles at a time
_STAY = 0.02                # weight of staying at the mean of a cell's vertices, as a share of that of the planes


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
    for _ in range(_ROUNDS):
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
    wide = index.max(axis=0) + 1
    _, cells = np.unique((index[:, 0] * wide[1] + index[:, 1]) * wide[2] + index[:, 2], return_inverse=True)
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
