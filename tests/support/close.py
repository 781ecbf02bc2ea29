"""How far a gradient is from the one it should be: one vocabulary and one tolerance table for kernels against twins."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from twins.pairs import ALPHA_MAX, ALPHA_SEEN, candidates, nearest_surface
from twins.project import Projected

from pagas_cl.config import Splatting

# float64 twin against central differences; float32 kernels against the twin
TWIN_RELATIVE, TWIN_FLOOR = 1e-6, 0.05
KERNEL_COSINE, KERNEL_RELATIVE_L2, KERNEL_BIAS = 0.9999, 1e-3, 1e-3


@dataclass(frozen=True)
class Closeness:
    """Measures of a gradient `got` against `want`.

    Attributes
    ----------
    cosine : float
        Of the angle between both; 1 is parallel. 1 where both are 0, 0 where only one is.
    relative_l2 : float
        |got - want| / |want|.
    bias : float
        sum(got - want) / sum|want|, signed: what a one-sided error (a dropped term, a truncation) shows as.
    worst : float
        max|got - want| / max|want|.
    """

    cosine: float
    relative_l2: float
    bias: float
    worst: float


def closeness(got, want, where=None) -> Closeness:
    """Compare two arrays of one shape, only `where` it is true if given (pixels far from all thresholds)."""
    got, want = np.asarray(got, np.float64), np.asarray(want, np.float64)
    if got.shape != want.shape:
        raise ValueError(f"got has shape {got.shape}, want {want.shape}")
    if where is not None:
        got, want = got[where], want[where]
    error, size, other = got - want, np.linalg.norm(want), np.linalg.norm(got)
    if size == 0:
        same = float(other == 0)
        return Closeness(same, 0.0 if same else np.inf, 0.0 if same else np.inf, 0.0 if same else np.inf)
    cosine = float((got * want).sum() / (size * other)) if other > 0 else 0.0
    return Closeness(cosine, float(np.linalg.norm(error) / size), float(error.sum() / np.abs(want).sum()),
                     float(np.abs(error).max() / np.abs(want).max()))


def assert_kernel_close(got, want, where=None) -> Closeness:
    """The bars of a float32 kernel gradient against its float64 twin."""
    found = closeness(got, want, where)
    assert found.cosine >= KERNEL_COSINE, found
    assert found.relative_l2 <= KERNEL_RELATIVE_L2, found
    assert abs(found.bias) <= KERNEL_BIAS, found
    return found


def relative_errors(got, want, floor: float = TWIN_FLOOR) -> np.ndarray:
    """|got - want| / max(|want|, floor * max|want|), entry by entry.

    Entries that cancel to nearly 0 are not judged by their own size: what is left of them is rounding, which is another
    one on every processor and as large as that of the largest entry.
    """
    got, want = np.asarray(got, np.float64), np.asarray(want, np.float64)
    largest = np.abs(want).max(initial=0.0)
    return np.abs(got - want) / np.maximum(np.abs(want), max(floor * largest, 1e-300))


def near_thresholds(projected: Projected, width: int, height: int, splatting: Splatting, depth_threshold: float,
                    pixels: float = 1e-4, relative: float = 1e-5) -> np.ndarray:
    """Context pixels, bool (height, width), where rounding in float32 may decide otherwise than the twin; of the alpha
    blend, whose weights end with a step.

    A pixel is near a threshold when one of its pairs is within `pixels` of the radius, or within `relative` (of z, of
    the weight) of the depth threshold, of 1/255 or of the clamp, or its total weight is that near to 1 or 1/255.
    """
    pairs = candidates(projected, width, height, replace(splatting, radius=splatting.radius + pixels))
    size = width * height
    doubtful = np.abs(np.hypot(*pairs.Delta.T) - splatting.radius) < pixels
    doubtful |= np.abs(pairs.raw - ALPHA_MAX) < relative
    doubtful |= np.abs(pairs.alpha - ALPHA_SEEN) < relative * ALPHA_SEEN
    if splatting.occlusion:
        z_first = nearest_surface(pairs, size)
        thresholds = np.full(size, float(depth_threshold))
        if splatting.depth_relative > 0:
            thresholds = np.minimum(thresholds, splatting.depth_relative * z_first)
        doubtful |= np.abs(pairs.z - (z_first + thresholds)[pairs.pixel]) < relative * np.abs(pairs.z)
    near = np.zeros(size, bool)
    near[pairs.pixel[doubtful]] = True
    total = np.bincount(pairs.pixel, pairs.alpha, size)
    near |= (np.abs(total - 1) < relative) | (np.abs(total - ALPHA_SEEN) < relative)
    return near.reshape(height, width)
