"""Depths from scene units to the device's units and back.

These passes over whole maps are all that the host does for a view: no branch per pixel, and few new pages of memory.
"""

from __future__ import annotations

import numpy as np

from pagas_cl.scene.depthmap import surface_depth
from pagas_cl.scene.status import REFINED

NEAR = 1e-3               # units, as in constants.clh
FAR = 1e6
MEDIAN_SAMPLES = 65536


def normalized_depth(depth: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Depth in units of its median, float32, 0 where there is none, and that unit.

    Depths outside NEAR to FAR units, masked out or not finite have no Gaussian.
    """
    depth = depth if depth.dtype in (np.float32, np.float64) else depth.astype(np.float32)
    valid = (depth > 0) & (depth < np.inf)
    if mask is not None:
        valid &= mask
    unit = _unit(depth, valid)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = (depth / np.asarray(unit, depth.dtype)).astype(np.float32, copy=False)
        valid &= (scaled >= NEAR) & (scaled <= FAR)
    # NumPy keeps the order of what came in, by columns too, and the device reads rows
    return np.ascontiguousarray(_only(valid, scaled)), unit


def scene_depth(refined: np.ndarray, unit: float, status: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Scene units again, in place of `refined`; a depth that was not refined comes back with the bits that it came
    with, 0 = no surface."""
    new = status == REFINED
    refined *= np.float32(unit)
    kept = _only(~new, surface_depth(given))
    _bits(_only(new, refined))[...] |= _bits(kept)
    return refined


def depth_range(normalized: np.ndarray) -> float:
    """From the nearest to the farthest surface, units; 0 without any."""
    # positive floats have the order of their bits; that of no surface, 0 - 1, is the last
    nearest = (_bits(normalized) - np.uint32(1)).min(keepdims=True) + np.uint32(1)
    return (normalized.max() - nearest.view(np.float32)).item()


def _only(mask: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """0 outside `mask`, in place: the bits of a float32 times 0 or 1, so that NaN and infinity end too."""
    bits = _bits(depth)
    bits *= mask
    return depth


def _bits(depth: np.ndarray) -> np.ndarray:
    return depth.view(np.uint32)


def _unit(depth: np.ndarray, valid: np.ndarray) -> float:
    """The unit of length: the median of the valid depths, of a regular sample of a large map; 1 without any."""
    every = max(1, depth.size // MEDIAN_SAMPLES)
    sample = depth.ravel()[::every][valid.ravel()[::every]]
    if every > 1 and sample.size < MEDIAN_SAMPLES // 16:        # a small object in a large photo
        sample = depth[valid]
    return float(np.median(sample.astype(np.float64))) if sample.size else 1.0
