"""Twin of the pyramid's resampling: area averages down, bilinear up, valid depths only (method section 6)."""

from __future__ import annotations

import numpy as np


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Image size (width, height) of a pyramid level, rounded half up, at least 1."""
    return max(1, int(np.floor(width * scale + 0.5))), max(1, int(np.floor(height * scale + 0.5)))


def cover(old: int, new: int) -> np.ndarray:
    """Share of each old pixel that each new one covers along one axis, in old pixels: shape (new, old)."""
    edges = np.arange(new + 1) * (old / new)
    cells = np.arange(old)
    share = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
    return np.where(share > 1e-9, share, 0.0)


def _box(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area-weighted sums of (H, W, ...) over the boxes of `width` x `height` new pixels."""
    rows = np.tensordot(cover(image.shape[0], height), image, axes=1)
    return np.moveaxis(np.tensordot(cover(image.shape[1], width), rows, axes=(1, 1)), 0, 1)


def shrink_image(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average of a photo, rounded to 8 bit (ties to even) as the device keeps it."""
    if image.shape[:2] == (height, width):
        return image
    area = (image.shape[0] / height) * (image.shape[1] / width)
    return np.rint(_box(np.rint(image * 255), width, height) / area) / 255  # whole numbers, so that ties are ties


def shrink_mask(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    """True where every covered pixel is true."""
    return _box(np.where(mask, 0.0, 1.0), width, height) == 0


def shrink_depth(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Mean of the valid among the covered pixels; 0 where there is none."""
    if depth.shape == (height, width):
        return depth
    area = _box((depth > 0).astype(np.float64), width, height)
    return np.where(area > 0, _box(depth, width, height) / np.where(area > 0, area, 1.0), 0.0)


def enlarge_depth(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Bilinear at pixel centres, averaging valid neighbours only; 0 where no neighbour with weight is valid."""
    if depth.shape == (height, width):
        return depth
    down, across = _hat(depth.shape[0], height), _hat(depth.shape[1], width)
    weight = down @ (depth > 0).astype(np.float64) @ across.T
    return np.where(weight > 0, down @ depth @ across.T / np.where(weight > 0, weight, 1.0), 0.0)


def _hat(old: int, new: int) -> np.ndarray:
    """Linear interpolation at pixel centres along one axis, held at the ends: shape (new, old)."""
    at = np.clip((np.arange(new) + 0.5) * (old / new) - 0.5, 0, old - 1)
    return np.maximum(0.0, 1 - np.abs(at[:, None] - np.arange(old)))
