"""Twin of splat/measure: how well patches match when the depth is moved (method section 8, evidence for coarser levels)."""

from __future__ import annotations

import numpy as np

from pagas_cl.reference.evidence import luma
from pagas_cl.reference.project import project

HALF, LEAST_PIXELS, NOISE, UNDEFINED = 2, 15, 1.5e-5, 2.0


def shifted_cost(depth, parallax, target, context, shift: float, unit: float) -> np.ndarray:
    """1 - correlation of 5x5 patches of the target with the context photo, depths moved by `shift` pixels of parallax.

    Parameters
    ----------
    depth, parallax : ndarray of shape (H, W)
        d and u in units.
    target, context : Photo
    shift, unit : float
        Pixels of parallax; scene units per unit.

    Returns
    -------
    ndarray of shape (H, W); 2 where fewer than 15 pixels of the patch are seen or the target's has no texture
    """
    moved = np.where(depth > 0, depth + shift * parallax, 0.0)
    value, seen = _look_up(project(moved, target.camera, context.camera, 0.0, unit), context, depth.shape)
    own = luma(target.image)
    n = _patch_sum(seen.astype(float))
    mean = [_patch_sum(np.where(seen, x, 0.0)) / np.maximum(n, 1)
            for x in (value, own, value * value, own * own, value * own)]
    var_w, var_t = mean[2] - mean[0] ** 2, mean[3] - mean[1] ** 2
    correlation = (mean[4] - mean[0] * mean[1]) / np.sqrt((np.maximum(var_w, 0) + NOISE) * (np.maximum(var_t, 0) + NOISE))
    return np.where((n >= LEAST_PIXELS) & (var_t >= 4 * NOISE), 1 - correlation, UNDEFINED)


def _look_up(projected, context, shape):
    """Bilinear grey of the context photo at the projected means, and where all four pixels are inside and valid."""
    photo, (height, width) = luma(context.image), context.image.shape[:2]
    u, v = (projected.m - 0.5).T
    inside = projected.valid & (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    x, y = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    if context.mask is not None:
        inside &= context.mask[y, x] & context.mask[y, right] & context.mask[below, x] & context.mask[below, right]
    a, b = np.where(inside, u, 0) - x, np.where(inside, v, 0) - y
    value = (1 - b) * ((1 - a) * photo[y, x] + a * photo[y, right]) + b * ((1 - a) * photo[below, x] + a * photo[below, right])
    return value.reshape(shape), inside.reshape(shape)


def _patch_sum(image: np.ndarray) -> np.ndarray:
    padded = np.pad(image, HALF)
    size = 2 * HALF + 1
    return sum(padded[y:y + image.shape[0], x:x + image.shape[1]] for y in range(size) for x in range(size))
