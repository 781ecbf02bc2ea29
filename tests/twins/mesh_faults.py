"""Twin of cl_kernels/mesh_faults.cl in float64: every triangle against every other one (method section 10.5)."""

from __future__ import annotations

import numpy as np

NO_AREA, TOUCH = 1e-4, 1e-3


def faults(before, after, faces) -> np.ndarray:
    """As pagas_cl.method.surface.mesh_faults.faults."""
    then, now = (np.cross(p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]]) for p in (before, after))
    sides = np.linalg.norm(after[faces] - after[faces[:, [1, 2, 0]]], axis=2)
    flat = ~(np.linalg.norm(now, axis=1) > NO_AREA * sides.max(axis=1) ** 2)
    out = np.where(flat, 2, (then * now).sum(axis=1) < 0).astype(np.uint8)
    low, high = after[faces].min(axis=1), after[faces].max(axis=1)
    wide = (low < high).any(axis=1)      # points cross nothing
    for i in np.flatnonzero(wide):
        near = wide & (low <= high[i]).all(axis=1) & (high >= low[i]).all(axis=1)
        near[i] = False
        if cross(after, faces[i], faces[near]).any():
            out[i] |= 4
    return out


def displaced(positions, before, faces, marked, halved) -> np.ndarray:
    """Places of vertices of which those that are `marked` are displaced by half as much or as their neighbours are."""
    after, away = positions.copy(), positions - before
    for i in np.flatnonzero(marked):
        others = [face[(side + k) % 3] for face in faces for side in range(3) if face[side] == i for k in (1, 2)]
        after[i] = before[i] + (away[i] / 2 if halved else away[others].mean(axis=0))
    return after


def cross(points, one, others) -> np.ndarray:
    """Whether the triangle `one` (3,) crosses each of the others (n, 3)."""
    shared = (others[:, :, None] == one).any(axis=2).sum(axis=1)
    s, t = np.broadcast_to(points[one], (len(others), 3, 3)), points[others]
    through = np.any([pierces(x[:, k], x[:, k - 1], y) for x, y in ((s, t), (t, s)) for k in range(3)], axis=0)
    return np.where(shared > 1, shared == 3, through)


def pierces(p, q, triangles) -> np.ndarray:
    a, b, c = triangles.swapaxes(0, 1)
    n, along = np.cross(b - a, c - a), q - p
    ends = np.stack([dot(n, p - a), dot(n, q - a)])
    least = TOUCH * np.linalg.norm(n, axis=1) * np.linalg.norm(along, axis=1)
    sides = np.stack([dot(along, np.cross(x - p, y - p)) for x, y in ((c, b), (a, c), (b, a))])
    return ((ends.min(axis=0) < -least) & (ends.max(axis=0) > least)
            & ((sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)))


def dot(a, b) -> np.ndarray:
    return (a * b).sum(axis=1)
