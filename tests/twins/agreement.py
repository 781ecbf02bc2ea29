"""Twin of agreement.cl: refined depth maps of other views as evidence for one another (method section 8.1)."""

import numpy as np

EDGE, MOST_UNSURE, LENIENCE, IN_COMMON, AROUND = 3.0, 0.5, 2.0, 0.3, 2
REFINED = 1


def difference(target, d, u, other, surface, deviations):
    """By how much each depth d (H, W) of the camera `target` would have to change to lie on the surface of the camera
    `other`, its depth map (H', W') with 0 where it is not refined; and that view's deviation there. NaN where it says
    nothing. `u`: one pixel of parallax, (H, W)."""
    rotation, tau = other.relative_to(target)
    q = target.rays() @ rotation.T
    point = d[..., None] * q + tau
    z = np.where(point[..., 2] > 1e-3 * np.median(d[d > 0]), point[..., 2], np.nan)
    focal = np.array([other.fx, other.fy])
    at = point[..., :2] / z[..., None] * focal + (other.cx, other.cy) - 0.5
    inside = ((at >= 0) & (at < (other.width - 1, other.height - 1))).all(axis=-1) & (d > 0) & (u > 0)
    left, top = np.moveaxis(np.where(inside[..., None], at, 0).astype(int), -1, 0)
    corners = [(top + j, left + i) for j in (0, 1) for i in (0, 1)]
    depths = np.array([surface[corner] for corner in corners], float)
    known = inside & (depths > 0).all(axis=0) & (np.ptp(depths, axis=0) < EDGE * u)
    w00, w10, w01, w11 = 1 / np.where(depths > 0, depths, np.nan)
    a, b = at[..., 0] - left, at[..., 1] - top
    slope = np.stack([(1 - b) * (w10 - w00) + b * (w11 - w01), (1 - a) * (w01 - w00) + a * (w11 - w10)], axis=-1)
    ends = depths.min(axis=0), depths.max(axis=0)
    bent = [sum_of_bends(surface, row, column, step, EDGE * u / np.where(known, np.prod(ends, axis=0), 1))
            for row, column, step in ((top, left, (0, 1)), (top + 1, left, (0, 1)), (top, left, (1, 0)),
                                      (top, left + 1, (1, 0)))]
    w = (1 - b) * ((1 - a) * w00 + a * w10) + b * ((1 - a) * w01 + a * w11) - 0.25 * (
        a * (1 - a) * ((1 - b) * bent[0] + b * bent[1]) + b * (1 - b) * ((1 - a) * bent[2] + a * bent[3]))
    moved = focal * (q[..., :2] * tau[2] - q[..., 2:] * tau[:2])       # d mean / d depth, times z^2
    d_zw = q[..., 2] * w + (slope * moved).sum(axis=-1) / z
    known &= d_zw > 0
    unsure = np.array([deviations[corner] for corner in corners]).max(axis=0)
    return np.where(known, (1 - z * w) / d_zw, np.nan), np.where(known, unsure, np.nan)


def sum_of_bends(surface, row, column, step, limit):
    """Of four inverse depths in a row, from that before (row, column) on, the sum of the second differences at the
    middle ones; 0 where one is missing or another surface."""
    places = [(row + k * step[0], column + k * step[1]) for k in (-1, 0, 1, 2)]
    inside = np.all([(0 <= r) & (r < surface.shape[0]) & (0 <= c) & (c < surface.shape[1]) for r, c in places], axis=0)
    depths = np.array([surface[np.where(inside, r, 0), np.where(inside, c, 0)] for r, c in places], float)
    before, first, second, after = 1 / np.where(depths > 0, depths, np.inf)
    same = inside & (depths > 0).all(axis=0) & (abs(before - first) < limit) & (abs(after - second) < limit)
    return np.where(same, before - first - second + after, 0)


def variance(deviation, u, floor):
    """That a depth counts with."""
    return np.minimum(deviation, MOST_UNSURE * u) ** 2 + (floor * u) ** 2


def average(depth, deviation, u, status, differences, spread, pixels, first_spread=None):
    """Depth, deviation and status of a view (H, W) with `differences`, one (change, deviation) a view."""
    total, weight, squares, reported, apart = (np.zeros(depth.shape) for _ in range(5))
    for change, unsure in differences:
        with np.errstate(invalid="ignore", divide="ignore"):
            off = np.abs(change) / (pixels * u)
            w = np.where(off < 1, (1 - off**8) ** 2 / variance(unsure, u, LENIENCE * spread), 0)
            change, v = (np.where(w > 0, x, 0) for x in (change, variance(unsure, u, 0)))
        total, apart = total + w * change, apart + w * change**2
        weight, squares, reported = weight + w, squares + w**2, reported + w * v
    others, views = weight > 0, len(differences)
    wider = (1 if first_spread is None else first_spread / spread) ** 2 / 2 / (1 - 1 / views) if views > 1 else 0
    own = (status == REFINED) & np.isfinite(deviation) & others
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = wider * summed_around(apart) / summed_around(weight)
        w = np.where(own, 1 / variance(deviation, u, LENIENCE * spread), 0)
        reported = (reported + w * np.where(own, variance(deviation, u, 0), 0)) / (weight + w)
        on_average = 2 * wider * (spread * u) ** 2
        one = np.minimum(reported, np.maximum(apart, on_average) if wider else np.inf) + apart
        left = IN_COMMON + (1 - IN_COMMON) * np.minimum(1, 2 * (squares + w**2) / (weight + w) ** 2)
        most = np.where(own, np.maximum(deviation**2, on_average * left), np.inf)
        surer = np.sqrt(np.minimum(one * left, most))
        return (np.where(others, depth + total / (weight + w), depth),
                np.where(others, surer, deviation),
                np.where(others, REFINED, status))


def summed_around(values):
    """Over AROUND pixels to each side."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, AROUND), (2 * AROUND + 1,) * 2)
    return windows.sum(axis=(-1, -2))
