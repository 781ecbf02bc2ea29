"""Vertices at one place as one, connected components of a mesh, and an order that does not depend on threads."""

import numpy as np

_CELLS = 1 << 21  # per axis, so that three fit in an int64
_PART = 1 << 17   # faces rotated at a time


def welded(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of vertices, each once (W, 3), and which of them each vertex has, int32 (V,)."""
    alone = vertices, np.arange(len(vertices), dtype=np.int32)
    mixed = np.sort((vertices + 0.0).view(np.uint64) @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 1], np.uint64))
    if (mixed[1:] != mixed[:-1]).all():     # no need to sort by place, which takes twenty times as long
        return alone
    points, place = np.unique(vertices, axis=0, return_inverse=True)
    if len(points) == len(vertices):
        return alone
    return points, place.reshape(-1).astype(np.int32)


def unlike(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Which vertices (V, 3) are not where they were: bool (V,)."""
    x, y, z = (before != after).T       # any(axis=1) takes six times as long
    return x | y | z


def at_a_corner(marked: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which faces (F, 3) have a corner that is `marked` (V,): bool (F,)."""
    a, b, c = faces.T                   # as in unlike
    there: np.ndarray = marked[a] | marked[b] | marked[c]
    return there


def with_area(faces: np.ndarray) -> np.ndarray:
    """The faces whose three corners are at three places."""
    a, b, c = faces.T
    there = (a != b) & (b != c) & (c != a)
    return faces if there.all() else np.compress(there, faces, axis=0)


def compact(count: int, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of `count` vertices the `faces` have, and the faces by their numbers among these, int32."""
    used = np.zeros(count, bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32)
    number -= 1
    return np.flatnonzero(used), number[faces]


def share_cancelled(points: np.ndarray, faces: np.ndarray) -> float:
    """Share of the `points` (V, 3) around which half or more of the normals of the faces (F, 3) cancels."""
    a, b, c = (np.take(points, faces[:, k], axis=0) for k in range(3))
    across = np.cross(b - a, c - a)
    *total, whole = (np.bincount(faces.ravel(), np.repeat(values, 3), len(points))
                     for values in (*across.T, np.linalg.norm(across, axis=1)))
    return float(np.mean(np.linalg.norm(total, axis=0) < 0.5 * whole))


def connected_components(faces: np.ndarray, count: int) -> np.ndarray:
    """Component of each of `count` vertices: int64 of shape (count,), the least vertex index of its component. Edges
    hook the larger root under the smaller one, chains are shortened: a few passes whatever the mesh's shape."""
    label = np.arange(count, dtype=np.int64)
    edges = np.concatenate([faces[:, (0, 1)], faces[:, (1, 2)]]).astype(np.int64)
    while len(edges):
        ends = label[edges]
        edges = edges[ends[:, 0] != ends[:, 1]]
        ends = label[edges]
        np.minimum.at(label, ends.max(axis=1), ends.min(axis=1))
        while True:
            shorter = label[label]
            if np.array_equal(shorter, label):
                break
            label = shorter
    return label


def component_of(place: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Component of each vertex, by numbers below their count, int32 (V,); those with the same `place` (V,) are one."""
    return connected_components(place[faces], len(place)).astype(np.int32)[place]


def without_small_components(faces: np.ndarray, count: int, share: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Drop components with fewer triangles than `share` of the largest one's, and vertices of no triangle. Gives the
    old indices of the vertices that stay (V',), faces (F', 3) int32 with new ones, and how many components went."""
    component = connected_components(faces, count)[faces[:, 0]]
    size = np.bincount(component, minlength=count)
    stays = size >= share * size.max()
    kept = faces[stays[component]]
    return *compact(count, kept), int(np.count_nonzero((size > 0) & ~stays))


def in_order(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same mesh in an order that its geometry alone decides; vertices at the very same place become one. Open3D's
    threads number vertices and faces as they come; sorted, two runs give the same bytes. Gives the old index of each
    new vertex (V',), and faces (F', 3) int32 with new ones; faces that lost a corner are gone."""
    low, span = vertices.min(axis=0), max(float(np.ptp(vertices, axis=0).max()), 1e-300)
    cell = ((vertices - low) * ((_CELLS - 1) / span)).astype(np.int64)
    order = _ordered((cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2], np.hstack([vertices, normals]))
    place = vertices[order]
    fresh = np.ones(len(order), bool)
    fresh[1:] = (place[1:] != place[:-1]).any(axis=1)
    new = np.empty(len(order), np.int32)
    new[order] = np.cumsum(fresh, dtype=np.int32) - 1
    faces = with_area(new[faces])
    for start in range(0, len(faces), _PART):
        part = faces[start:start + _PART]
        corner = (part.argmin(axis=1)[:, None] + np.arange(3)) % 3  # rotated, not mirrored: the least corner first
        part[:] = np.take_along_axis(part, corner, axis=1)
    return order[fresh], faces[_ordered((faces[:, 0].astype(np.int64) << 32) | faces[:, 1], faces)]


def _ordered(key: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Order by `key`, equal keys by `rows` (N, K): several times faster than sorting by all columns."""
    order = np.argsort(key)
    key = key[order]
    same = np.zeros(len(key), bool)
    same[1:] = key[1:] == key[:-1]
    same[:-1] |= same[1:]
    at = np.flatnonzero(same)
    among = order[at]
    order[at] = among[np.lexsort((*rows[among].T, key[at]))]
    return order
