"""Twin of splat/starts: of two depth maps to start from, the better one around each pixel (method section 8.3)."""

from __future__ import annotations

import numpy as np

STEP, SAME_SURFACE, LEAST_SAME = 2, 0.5, 2


def better_of(one: np.ndarray, other: np.ndarray, one_cost: np.ndarray, other_cost: np.ndarray) -> np.ndarray:
    """Of two depth maps (H, W) the first where it costs less at most of those of the nine places around that are of the
    same surface there, of all nine where fewer than two are, else the second; costs are those of every STEP-th pixel
    along both sides."""
    first, second = one[::STEP, ::STEP], other[::STEP, ::STEP]
    better = (first != second) & (first > 0) & (second > 0) & (one_cost < other_cost).reshape(first.shape)
    (rows, columns), (height, width) = better.shape, one.shape
    place = np.ix_(np.arange(height) // STEP, np.arange(width) // STEP)
    within = np.float32(SAME_SURFACE) * np.abs(one - other)
    count, says = np.zeros((2, 2, height, width), int)        # of those of the same surface, and of all
    for down in range(3):
        for right in range(3):
            there, depth, votes = (np.pad(values, 1)[down:down + rows, right:right + columns][place] for values in (
                np.ones_like(better), first, better))
            counts = np.stack([there & (np.abs(depth - one) < within), there])
            count += counts
            says += counts & votes
    same, around = 2 * says > count
    return np.where(np.where(count[0] >= LEAST_SAME, same, around) & (one > 0), one, other)
