"""Twin of splat/starts: of two depth maps to start from, the better one around each pixel (method section 8.3)."""

from __future__ import annotations

import numpy as np

STEP, MOST_OF = 2, 4


def better_of(one: np.ndarray, other: np.ndarray, one_cost: np.ndarray, other_cost: np.ndarray) -> np.ndarray:
    """Of two depth maps (H, W) the first where it costs less at most of the nine places around, else the second; costs
    are those of every STEP-th pixel along both sides."""
    first, second = one[::STEP, ::STEP], other[::STEP, ::STEP]
    better = (first != second) & (first > 0) & (second > 0) & (one_cost < other_cost).reshape(first.shape)
    padded, (rows, columns) = np.pad(better.astype(int), 1), better.shape
    around = sum(padded[i:i + rows, j:j + columns] for i in range(3) for j in range(3))
    mostly = (around > MOST_OF).repeat(STEP, axis=0).repeat(STEP, axis=1)[:one.shape[0], :one.shape[1]]
    return np.where(mostly & (one > 0), one, other)
