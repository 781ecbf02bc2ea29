"""Twin of mismatch.cl: detail that photos do not support is taken back (method section 5.2)."""

from __future__ import annotations

import numpy as np

REFINED = 1
SPACINGS, EDGE, LEAST, FINE, NOISE, WINDOW = (1, 2, 3, 4, 6), 1.0, 4.0, 0.03, 6.0, 7


def _moved(values, dv: int, du: int, empty=0):
    """What lies so many rows and columns away, `empty` beyond the border."""
    height, width = values.shape
    rows, columns = np.arange(height)[:, None] + dv, np.arange(width) + du
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    return np.where(inside, values[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)], empty)


def smoothed(changes, initial, parallax, status):
    """Changes, pixels of parallax, averaged around each pixel on one surface."""
    for far in SPACINGS:
        for dv, du in ((0, far), (far, 0)):
            total = np.zeros_like(changes)
            for side in (-1, 1):
                other, there = _moved(initial, side * dv, side * du, np.nan), _moved(status, side * dv, side * du)
                with np.errstate(invalid="ignore"):
                    linked = (there == REFINED) & (np.abs(other - initial) * initial < EDGE * parallax * other)
                total += np.where(linked, _moved(changes, side * dv, side * du) - changes, 0)
            changes = changes + total / 4
    return changes


def resolved(depth, status, information):
    """By pixel the square of what the surface bends, over the variance that photos leave (1 / `information`); NaN where
    that is not known. All (H, W), device units."""
    ok = status == REFINED
    near = [_moved(depth, dv, du) for dv, du in ((0, -1), (0, 1), (-1, 0), (1, 0))]
    known = ok & np.logical_and.reduce([each > 0 for each in near])
    w, left, right, above, below = (1 / np.where(known, each, np.nan) for each in (depth, *near))
    bends = (np.abs(left + right - 2 * w) + np.abs(above + below - 2 * w)) / w**2
    return information * bends**2


def taken_back(initial, depth, parallax, status, information):
    """The depth without the detail that is noise, and by pixel the share of it that is noise (0 where it
    is fine); all (H, W), device units."""
    ok = status == REFINED
    unit = np.where(ok, parallax, 1)
    changes = np.where(ok, initial * (depth - initial) / (np.where(ok, depth, 1) * unit), 0)
    detail = np.where(ok, changes - smoothed(changes, initial, parallax, status), 0)
    chances = detail**2 * np.maximum(information * unit**2, LEAST)
    side = range(-WINDOW, WINDOW + 1)
    total, number = (sum(_moved(values, dv, du) for dv in side for du in side) for values in (chances, ok * 1.0))
    share = np.minimum(NOISE * number / np.maximum(total, 1e-12), 1)
    kept = changes - share * detail
    nearer = 1 - kept * unit / np.where(ok, initial, 1)
    found = np.where(ok & (nearer > 1e-3), initial / np.where(nearer > 1e-3, nearer, 1), depth)
    return found, np.where(np.abs(detail) < FINE, 0, share)
