"""Twin of cameras/normalize: photos as cameras are aligned by (method section 9)."""

from __future__ import annotations

import numpy as np

from pagas_cl.method.cameras.normalize import SOFTENING, WINDOW, gaussian


def smooth(pair, sigma: float) -> np.ndarray:
    """(H, W, 2) averaged along rows and columns; what lies outside counts as 0."""
    half = gaussian(sigma)
    taps = np.concatenate([half[:0:-1], half])
    for axis in (0, 1):
        pair = np.apply_along_axis(np.convolve, axis, pair, taps, "same")
    return pair


def normalized(photo, mask, sigma: float) -> np.ndarray:
    """Luminance in grey levels, smoothed, minus its mean over 9x9, over its deviation there; NaN where masked out."""
    valid = np.ones(photo.shape[:2], bool) if mask is None else mask
    grey = photo.astype(np.float64) @ (0.299, 0.587, 0.114)
    smoothed = smooth(np.stack([grey * valid, valid], -1), sigma)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(valid, smoothed[..., 0] / smoothed[..., 1], np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(value, WINDOW, constant_values=np.nan), (2 * WINDOW + 1, 2 * WINDOW + 1))
    out = np.full(valid.shape, np.nan)
    mean, deviation = np.nanmean(windows[valid], axis=(1, 2)), np.nanstd(windows[valid], axis=(1, 2))
    out[valid] = (value[valid] - mean) / (deviation + SOFTENING)
    return out
