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
        if any(cross_each_other(after, faces[i], faces[j]) for j in np.flatnonzero(near) if j != i):
            out[i] |= 4
    return out


def displaced(positions, before, faces, marked, halved) -> np.ndarray:
    """Places of vertices of which those that are `marked` are displaced by half as much or as their neighbours are."""
    after, away = positions.copy(), positions - before
    for i in np.flatnonzero(marked):
        others = [face[(side + k) % 3] for face in faces for side in range(3) if face[side] == i for k in (1, 2)]
        after[i] = before[i] + (away[i] / 2 if halved else away[others].mean(axis=0))
    return after


def cross_each_other(points, one, other) -> bool:
    shared, s, t = set(one) & set(other), points[one], points[other]
    if len(shared) > 1:
        return len(shared) == 3
    return any(pierces(x[k], x[k - 1], y) for x, y in ((s, t), (t, s)) for k in range(3))


def pierces(p, q, triangle) -> bool:
    a, b, c = triangle
    n, along = np.cross(b - a, c - a), q - p
    ends = n @ (p - a), n @ (q - a)
    least = TOUCH * np.linalg.norm(n) * np.linalg.norm(along)
    if not (min(ends) < -least and max(ends) > least):
        return False
    u, v, w = (along @ np.cross(x - p, y - p) for x, y in ((c, b), (a, c), (b, a)))
    return bool((u >= 0 and v >= 0 and w >= 0) or (u <= 0 and v <= 0 and w <= 0))
