"""Gain and offset between two photos, in closed form (method section 7, exposure model)."""

from __future__ import annotations

import numpy as np

DARKEST, BRIGHTEST = 4 / 255, 251 / 255     # beyond these a channel may be clipped and tells nothing of the gain
_LEAST = 50                                 # samples for a fit
_PRIOR = 1e-3                               # variance of colour below which the gain is drawn to the ratio of means
_ROUNDS = 4


def fit(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Gain a and offset b so that other = a own + b, per channel, robust against what does not match.

    Parameters
    ----------
    own, other : ndarray of shape (S, 3)
        Matched colours from 0 to 1.

    Returns
    -------
    ndarray of shape (3, 2), float64
        (a, b) of each channel; (1, 0) where nothing can be said (too few samples, a black or a saturated photo).
    """
    usable = ((own > DARKEST) & (own < BRIGHTEST) & (other > DARKEST) & (other < BRIGHTEST)).all(axis=1)
    result = np.tile([1.0, 0.0], (3, 1))
    if usable.sum() < _LEAST:
        return result
    for channel in range(3):
        result[channel] = _fit_channel(own[usable, channel].astype(np.float64), other[usable, channel].astype(np.float64))
    return result


def _fit_channel(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Gain from the ratio of the deviations, so that neither photo's noise nor a depth error draws it to zero, as it
    would in a least squares fit; reweighted with Huber weights at 1.5 robust standard deviations."""
    weight = np.ones_like(x)
    gain, offset = 1.0, 0.0
    for _ in range(_ROUNDS):
        total = weight.sum()
        mx, my = (weight * x).sum() / total, (weight * y).sum() / total
        ratio = my / mx
        vx, vy = (weight * (x - mx) ** 2).sum() / total, (weight * (y - my) ** 2).sum() / total
        gain = np.sqrt((vy + _PRIOR * ratio**2) / (vx + _PRIOR))
        offset = my - gain * mx
        residual = np.abs(y - gain * x - offset)
        scale = 1.5 * 1.4826 * np.median(residual) + 1e-4
        weight = np.minimum(1.0, scale / np.maximum(residual, 1e-12))
    return (gain, offset) if 0.05 < gain < 20 else (1.0, 0.0)
