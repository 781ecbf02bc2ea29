"""Twin of splat/hypotheses: planes of a depth map, and what photos say of one at a pixel (method section 8.2)."""

from __future__ import annotations

import numpy as np

from twins.loss import luma

HALF, LEAST_SAMPLES, LEAST_SAME, SAME, UNDEFINED, NEAR = 3, 15, 7, 1.5, 2.0, 1e-3


def planes_of(depth: np.ndarray) -> np.ndarray:
    """Inverse depth at each pixel, and its change to the next one along x and y to the side where the surface goes on:
    (H, W, 3), 0 without a surface."""
    inverse = np.full(np.add(depth.shape, 2), np.nan)
    inverse[1:-1, 1:-1][depth > 0] = 1 / depth[depth > 0]
    here, slopes = inverse[1:-1, 1:-1], []
    for before, after in ((inverse[1:-1, :-2], inverse[1:-1, 2:]), (inverse[:-2, 1:-1], inverse[2:, 1:-1])):
        sides = np.stack([here - before, after - here])
        size = np.where(np.isnan(sides), np.inf, np.abs(sides))
        chosen = np.where(size[0] < size[1], sides[0], np.where(np.isnan(sides[1]), sides[0], sides[1]))
        slopes.append(np.nan_to_num(chosen))
    return np.where((depth > 0)[..., None], np.stack([np.nan_to_num(here), *slopes], axis=-1), 0.0)


def on_plane(planes: np.ndarray, place: tuple[int, int], within: float) -> np.ndarray:
    """Where `planes` (H, W, 3) are within so much inverse depth of the plane at `place` (x, y)."""
    y, x = np.mgrid[:planes.shape[0], :planes.shape[1]]
    inverse, along_x, along_y = planes[place[1], place[0]]
    off = planes[..., 0] - inverse - (x - place[0]) * along_x - (y - place[1]) * along_y
    return (planes[..., 0] > 0) & (np.abs(off) < within)


def cost(plane, place: tuple[int, int], target, context, scene_scale: float, contrast: float, noise: float,
         counts=None) -> float:
    """1 - correlation of every other pixel of 7 x 7 around `place` (x, y) with the context photo under `plane`, pixels
    weighted by how alike they are to the middle one, of those where `counts` (H, W) is true; 2 where the photos,
    without masks, say nothing."""
    rotation, tau = context.camera.relative_to(target.camera)
    own, other, camera = luma(target.image), luma(context.image), context.camera
    height, width = own.shape
    found = []
    for y in range(-HALF, HALF + 1):
        for x in range(-HALF + (y + HALF) % 2, HALF + 1, 2):
            column, row, inverse = place[0] + x, place[1] + y, plane[0] + x * plane[1] + y * plane[2]
            if not (0 <= column < width and 0 <= row < height and inverse > 0
                    and (counts is None or counts[row, column])):
                continue
            ray = np.array([(column + 0.5 - target.camera.cx) / target.camera.fx,
                            (row + 0.5 - target.camera.cy) / target.camera.fy, 1.0])
            point = rotation @ ray + inverse * tau / scene_scale
            if point[2] <= NEAR * inverse:
                continue
            u, v = camera.fx * point[0] / point[2] + camera.cx - 0.5, camera.fy * point[1] / point[2] + camera.cy - 0.5
            if not (0 <= u < other.shape[1] - 1 and 0 <= v < other.shape[0] - 1):
                continue
            i, j, a, b = int(v), int(u), u - int(u), v - int(v)
            value = ((1 - b) * ((1 - a) * other[i, j] + a * other[i, j + 1])
                     + b * ((1 - a) * other[i + 1, j] + a * other[i + 1, j + 1]))
            weight = 1 / (1 + ((own[row, column] - own[place[1], place[0]]) / contrast) ** 2)
            found.append((weight, own[row, column], value))
    if len(found) < (LEAST_SAMPLES if counts is None else LEAST_SAME):
        return UNDEFINED
    weight, a, b = np.array(found).T
    mean = [np.average(value, weights=weight) for value in (a, b, a * a, b * b, a * b)]
    of_target, of_context = mean[2] - mean[0] ** 2, mean[3] - mean[1] ** 2
    if of_target <= 4 * noise:
        return UNDEFINED
    return 1 - (mean[4] - mean[0] * mean[1]) / np.sqrt((max(of_context, 0) + noise) * (of_target + noise))


def better_half(costs) -> float:
    """Mean of the better half of those that are defined, two at least; 2 where there are fewer."""
    defined = sorted(cost for cost in costs if cost < UNDEFINED)
    return UNDEFINED if len(defined) < 2 else float(np.mean(defined[:max(2, (len(defined) + 1) // 2)]))
