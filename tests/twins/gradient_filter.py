"""Twin of splat/gradient_filter: the gradient averaged over neighbouring pixels (method section 6)."""

from __future__ import annotations

import numpy as np


def filter_gradient(gradient, length, radius: int) -> np.ndarray:
    """The gradient by d / length, (H, W), averaged along rows and columns by a tent of `radius` pixels to each side.

    What lies outside the image counts as 0, and so do pixels where length is 0.
    """
    if radius == 0:
        return gradient
    share = (radius + 1 - np.abs(np.arange(-radius, radius + 1))) / (radius + 1) ** 2
    height, width = gradient.shape
    rows = np.pad(gradient * length, radius)
    across = sum(share[k] * rows[:, k:k + width] for k in range(2 * radius + 1))
    down = sum(share[k] * across[k:k + height] for k in range(2 * radius + 1))
    return np.where(length > 0, down / np.where(length > 0, length, 1.0), 0.0)
