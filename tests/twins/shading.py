"""Twin of splat/shading: a context photo without what its colours differ by from the target's over whole surroundings
(method section 5.3)."""

from __future__ import annotations

import numpy as np

_SPREAD = 2     # cells to each side that a mean is of


def relit(photo, means, own, other, cell: int) -> np.ndarray:
    """The photo, relit.

    Parameters
    ----------
    photo : ndarray of shape (H, W, 3), uint8
    means : ndarray of shape (S, 2)
        Where the samples that are seen land in it, pixels.
    own, other : ndarray of shape (S, 3)
        Their colours in the target's photo and in this one, 0 to 1.
    cell : int
        Pixels along the side of a cell.
    """
    height, width = photo.shape[:2]
    sums = np.zeros((-(-height // cell), -(-width // cell), 4))
    column, row = means.astype(int).T // cell
    np.add.at(sums, (row, column), np.column_stack([other - own, np.ones(len(own))]))
    padded = np.pad(sums, [(_SPREAD, _SPREAD)] * 2 + [(0, 0)])
    around = np.lib.stride_tricks.sliding_window_view(padded, (2 * _SPREAD + 1,) * 2, axis=(0, 1)).sum(axis=(3, 4))
    difference = around[..., :3] / np.maximum(around[..., 3:], 1)
    for axis, size in enumerate((height, width)):
        difference = _between(difference, (np.arange(size) + 0.5) / cell - 0.5, axis)
    return np.clip(np.rint(photo - 255 * difference), 0, 255).astype(np.uint8)


def _between(values, places, axis: int):
    """Linear interpolation along an axis, the first and last value beyond its ends."""
    last = values.shape[axis] - 1
    places = np.clip(places, 0, last)
    low = places.astype(int)
    share = np.expand_dims(places - low, tuple(k for k in range(values.ndim) if k != axis))
    return (1 - share) * values.take(low, axis) + share * values.take(np.minimum(low + 1, last), axis)
