"""Twin of edges.cl: which of the surfaces next to an edge of depth a pixel shows (method section 8.4)."""

from __future__ import annotations

import numpy as np

from twins.hypotheses import UNDEFINED, better_half, planes_of

NEIGHBOURS = ((-1, 0), (1, 0), (0, -1), (0, 1), (-5, 0), (5, 0), (0, -5), (0, 5))      # x, y
ANOTHER, CONFIRMS, BETTER, BETTER_GREY, MOST_VIEWS, REFINED = 0.5, 0.5, 0.6, 0.2, 6, 1


def candidates(depth: np.ndarray, own_depth: np.ndarray, parallax: np.ndarray, status: np.ndarray) -> np.ndarray:
    """Inverse depths that each pixel of a depth map (H, W) may have, first its own one, that before the average:
    (9, H, W), 0 = none, in the first where there is no other."""
    planes, (height, width) = planes_of(depth), depth.shape
    found = np.zeros((1 + len(NEIGHBOURS), height, width))
    for y, x in np.ndindex(height, width):
        if not (depth[y, x] > 0 and parallax[y, x] > 0):
            continue
        own = 1 / own_depth[y, x]
        for j, (right, down) in enumerate(NEIGHBOURS, start=1):
            column, row = x + right, y + down
            if not (0 <= column < width and 0 <= row < height and status[row, column] == REFINED):
                continue
            inverse, along_x, along_y = planes[row, column]
            inverse -= right * along_x + down * along_y
            if inverse > 0 and abs(inverse - own) > ANOTHER * parallax[y, x] * own**2:
                found[j, y, x] = inverse
        found[0, y, x] = own if found[1:, y, x].any() else 0
    return found


def support(inverses: np.ndarray, parallax: np.ndarray, target, camera, depth: np.ndarray) -> np.ndarray:
    """What another camera's depth map, 0 where it is not refined, says of each of `inverses` (9, H, W): 1, 0, -1."""
    said, (rotation, tau) = np.zeros(inverses.shape, int), camera.relative_to(target)
    for j, y, x in zip(*np.nonzero(inverses)):
        ray = np.array([(x + 0.5 - target.cx) / target.fx, (y + 0.5 - target.cy) / target.fy, 1.0])
        q, d = rotation @ ray, 1 / inverses[j, y, x]
        u, v, z = projected(camera, d * q + tau)
        if not (z > 0 and 0 <= u < camera.width - 1 and 0 <= v < camera.height - 1):
            continue
        around = depth[int(v):int(v) + 2, int(u):int(u) + 2].astype(float)
        within = CONFIRMS * parallax[y, x] * inverses[0, y, x] ** 2 * abs(q[2]) * (d / z) ** 2
        there = 1 / around[around > 0]
        is_behind = len(there) == 4 and 1 / z > there.max() + within
        said[j, y, x] = int((abs(there - 1 / z) < within).any()) - int(is_behind)
    return said


def color_difference(place: tuple[int, int], inverse: float, target, view) -> float:
    """Mean difference of the colours, 0 to 1, of a pixel (x, y) and of the place in another view's photo where it lies
    under an inverse depth; 2 outside."""
    camera = view.camera
    rotation, tau = camera.relative_to(target.camera)
    x, y = place
    ray = np.array([(x + 0.5 - target.camera.cx) / target.camera.fx, (y + 0.5 - target.camera.cy) / target.camera.fy,
                    1.0])
    u, v, z = projected(camera, rotation @ ray / inverse + tau)
    if not (z > 0 and 0 <= u < camera.width - 1 and 0 <= v < camera.height - 1):
        return UNDEFINED
    i, j, a, b = int(v), int(u), u - int(u), v - int(v)
    around = view.image[i:i + 2, j:j + 2].astype(float) / 255
    color = (1 - b) * ((1 - a) * around[0, 0] + a * around[0, 1]) + b * ((1 - a) * around[1, 0] + a * around[1, 1])
    return float(abs(color - target.image[y, x] / 255.0).mean())


def projected(camera, point: np.ndarray) -> tuple[float, float, float]:
    """Where a point of a camera's frame lies, from the middle of its first pixel, and its depth."""
    x, y, z = point
    return camera.fx * x / z + camera.cx - 0.5, camera.fy * y / z + camera.cy - 0.5, z


def chosen(inverses: np.ndarray, supported: np.ndarray, target, contexts) -> np.ndarray:
    """Number of the candidate that each pixel takes, 0 its own: (H, W)."""
    out = np.zeros(inverses.shape[1:], int)
    for y, x in zip(*np.nonzero(inverses[0])):
        better = (inverses[:, y, x] > 0) & (supported[:, y, x] > supported[0, y, x])
        others = np.flatnonzero(better).tolist()
        costs = {j: better_half([color_difference((x, y), inverses[j, y, x], target, view)
                                 for view in contexts[:MOST_VIEWS]]) for j in [0, *others] if others}
        if not others or costs[0] == UNDEFINED:
            continue
        share = BETTER_GREY if np.ptp(target.image[y, x]) == 0 else BETTER
        best = min(others, key=lambda j: costs[j])
        out[y, x] = best if costs[best] < share * costs[0] else 0
    return out
