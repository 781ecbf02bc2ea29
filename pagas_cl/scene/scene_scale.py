"""The scale of a view's scene, its unit of length while it is refined: the median of its depths."""

from __future__ import annotations

import numpy as np

NEAR, FAR = 1e-3, 1e6     # units: nearer and farther depths have no Gaussian
MEDIAN_SAMPLES = 65536


def scene_scale_of(depth: np.ndarray, mask: np.ndarray | None) -> float:
    """The scale: the median of the valid depths, of a regular sample of a large map; 1 without any."""
    every = max(1, depth.size // MEDIAN_SAMPLES)
    sample = _valid(depth, mask, every)
    if every > 1 and sample.size < MEDIAN_SAMPLES // 16:        # a small object in a large photo
        sample = _valid(depth, mask, 1)
    return float(np.median(sample.astype(np.float64))) if sample.size else 1.0


def _valid(depth: np.ndarray, mask: np.ndarray | None, every: int) -> np.ndarray:
    some = depth.ravel()[::every]
    valid = (some > 0) & (some < np.inf)
    return some[valid if mask is None else valid & mask.ravel()[::every]]
