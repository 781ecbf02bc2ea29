"""Twin of carry_over.cl in NumPy, float64: what a smaller size has found, carried over (method sections 6, 8.3)."""

import numpy as np

LEFT, TAKEN = 0.5, 1.0
AROUND, SUREST, UNSURE, OWN = 3, 0.1, 1e-3, 100.0


def carry_over(depth, given, found, parallax, deviation, scale):
    """Depths (H, W) moved along with what was `found` from the depths `given`, (h, w), at `scale` of the full size (0:
    however far)."""
    given, found, parallax, deviation = (np.asarray(one, np.float64) for one in (given, found, parallax, deviation))
    there = (given > 0) & (found > 0) & (parallax > 0)
    unit, own = np.where(there, parallax, 1.0), np.where(there, given, 1.0)
    near, share = np.where(there, unit, 0.0), np.where(there, found - given, 0.0) / own
    sure = np.where(there, np.maximum(np.maximum(deviation / unit, SUREST)**-2, UNSURE), 0.0)
    share = follow_sure(given, near, share, sure)
    pixels = np.abs(share) * own / (scale * unit) if scale > 0 else np.full(given.shape, np.inf)
    return along(np.asarray(depth, np.float64), given, near, share * np.clip((pixels - LEFT) / (TAKEN - LEFT), 0, 1))


def around(values, reach):
    """The values (H, W) of each pixel's neighbours, one after the other, NaN outside."""
    height, width = values.shape
    padded = np.pad(values, reach, constant_values=np.nan)
    for row in range(2 * reach + 1):
        for column in range(2 * reach + 1):
            yield padded[row:row + height, column:column + width]


def follow_sure(given, parallax, share, sure):
    """Mean of `share` over 7 x 7 pixels of the same surface, weighted by how `sure` each is, itself 100 times."""
    total, weight = OWN * share * sure, OWN * sure
    for near, value, counts in zip(*(around(one, AROUND) for one in (given, share * sure, sure))):
        same = np.abs(near - given) < parallax
        total, weight = total + np.where(same, value, 0), weight + np.where(same, counts, 0)
    return np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)


def along(depth, given, near, share):
    """Bilinear mean of the shares of the four pixels around each depth, without those of another surface."""
    (height, width), (small_height, small_width) = depth.shape, given.shape
    (left, u), (top, v) = (place(width, small_width), place(height, small_height))
    total, weight = np.zeros(depth.shape), np.zeros(depth.shape)
    for down in (0, 1):
        for right in (0, 1):
            at = np.ix_(np.minimum(top + down, small_height - 1), np.minimum(left + right, small_width - 1))
            part = np.outer(v if down else 1 - v, u if right else 1 - u) * (np.abs(given[at] - depth) < near[at])
            total, weight = total + part * share[at], weight + part
    return depth * (1 + total / np.where(weight > 0, weight, 1.0))


def place(number, small):
    """The lower of the two pixels of a smaller side that each pixel lies between, and how far it is from there."""
    at = np.clip((np.arange(number) + 0.5) * small / number - 0.5, 0, small - 1)
    return at.astype(int), at - at.astype(int)
