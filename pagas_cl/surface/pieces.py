"""Connected pieces of a mesh, and the rule that drops small ones."""

from __future__ import annotations

import numpy as np


def pieces(faces: np.ndarray, count: int) -> np.ndarray:
    """Piece of each of `count` vertices: int64 of shape (count,), the least vertex index of its piece.

    Edges hook the larger root under the smaller one and chains are shortened until nothing moves: a few passes over
    the edges, whatever the mesh's shape.
    """
    label = np.arange(count, dtype=np.int64)
    edges = np.concatenate([faces[:, (0, 1)], faces[:, (1, 2)]]).astype(np.int64)
    while len(edges):
        ends = label[edges]
        edges = edges[ends[:, 0] != ends[:, 1]]
        if len(edges) == 0:
            break
        ends = label[edges]
        np.minimum.at(label, ends.max(axis=1), ends.min(axis=1))
        while True:
            shorter = label[label]
            if np.array_equal(shorter, label):
                break
            label = shorter
    return label


def without_small_pieces(faces: np.ndarray, count: int, share: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Drop pieces with fewer triangles than `share` of the largest one's, and vertices of no triangle.

    Returns
    -------
    keep : ndarray of shape (V',), intp
        Old indices of the vertices that stay.
    faces : ndarray of shape (F', 3), int32
        With new indices.
    dropped : int
        How many pieces went.
    """
    piece = pieces(faces, count)[faces[:, 0]]
    size = np.bincount(piece, minlength=count)
    stays = size >= share * size.max()
    kept = faces[stays[piece]]
    used = np.zeros(count, bool)
    used[kept] = True
    keep = np.flatnonzero(used)
    new = np.cumsum(used) - 1
    return keep, new[kept].astype(np.int32), int(np.count_nonzero((size > 0) & ~stays))
