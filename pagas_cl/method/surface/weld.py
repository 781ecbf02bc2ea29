"""Vertices at one place as one, and what is around them: arrays that the solve and the search for faults work on."""

import numpy as np


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


def around(wrong: np.ndarray, faces: np.ndarray, count: int, rings: int) -> np.ndarray:
    """Which of `count` vertices are corners of the faces that are `wrong` (F,) bool, or lie so many rings around them:
    bool (V,)."""
    marked = np.zeros(count, bool)
    marked[faces[wrong]] = True
    for _ in range(rings):
        marked[faces[at_a_corner(marked, faces)]] = True
    return marked


def with_area(faces: np.ndarray) -> np.ndarray:
    """The faces whose three corners are at three places."""
    a, b, c = faces.T
    there = (a != b) & (b != c) & (c != a)
    return faces if there.all() else faces[there]


def rings_of(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Where each vertex' corners begin, int32 (V + 1,), and of each the two other corners of its triangle, (3 F, 2)."""
    others = np.empty((*faces.shape, 2), np.int32)
    for side in range(3):
        others[:, side, 0], others[:, side, 1] = faces[:, side - 2], faces[:, side - 1]
    first, order = grouped(faces.reshape(-1), count)
    return first, others.view(np.int64).reshape(-1)[order].view(np.int32).reshape(-1, 2)


def grouped(numbers: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Where each of `count` numbers begins in their order, int32 (count + 1,), and that order (N,) int32: what is equal
    keeps its order."""
    first = np.concatenate([[0], np.cumsum(np.bincount(numbers, minlength=count))])
    return first.astype(np.int32), np.argsort(numbers, kind="stable").astype(np.int32)
