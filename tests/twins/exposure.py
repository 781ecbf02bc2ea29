"""Twin of splat/exposure: gain and offset between two photos, in closed form (method section 7, exposure model)."""

from __future__ import annotations

import numpy as np

from twins.measure import look_up
from twins.project import project

DARKEST, BRIGHTEST = 4 / 255, 251 / 255     # beyond these a channel may be clipped and says nothing of the gain
_LEAST = 50                                 # samples for a fit
_PRIOR = 2e-5                               # variance of colour below which the gain is drawn to the ratio of means
_ROUNDS = 6

_HALF = 2                                   # half the width of a patch
_BLURRED = np.array([1, 11, 12, 12, 12, 11, 1]) / 12    # of a patch with its rim: blurred as looking up blurs


def match(depth, target, context, z_first, depth_threshold, scene_scale: float):
    """Colours of both photos, means over 5x5 patches around each target pixel.

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        Units.
    target, context : Photo
    z_first : ndarray of shape (H', W'), or None
        Nearest depth of each context pixel; None where occlusion is not simulated.
    depth_threshold, scene_scale : float
        Depth threshold in units; scene units per device unit.

    Returns
    -------
    own, other : ndarray of shape (H, W, 3)
    state : ndarray of shape (H, W)
        0 not seen, 1 seen, 2 seen and nowhere near black or saturated.
    """
    p = project(depth, target.camera, context.camera, 0.0, scene_scale)
    there, seen = look_up(context.image, p, context, depth.shape)
    if z_first is not None:
        height, width = z_first.shape
        column, row = (np.clip(p.m[:, k].astype(int), 0, n - 1) for k, n in ((0, width), (1, height)))
        seen &= (p.z <= z_first[row, column] + depth_threshold).reshape(depth.shape)
    unclipped = [((c > DARKEST) & (c < BRIGHTEST)).all(axis=2) for c in (target.image, there)]
    whole = _windows(depth > 0, _HALF + 1).all(axis=(2, 3)) & _windows(seen, _HALF).all(axis=(2, 3))
    usable = _windows(unclipped[0] & unclipped[1], _HALF).all(axis=(2, 3))
    own = np.einsum("hwcyx,y,x->hwc", _windows(target.image, _HALF + 1), _BLURRED, _BLURRED) / (2 * _HALF + 1) ** 2
    return own, _windows(there, _HALF).mean(axis=(3, 4)), np.where(whole, 1 + usable, 0)


def _windows(image, half: int):
    """Around every pixel (H, W), with zeros beyond the border: shape (H, W[, C], 2 half + 1, 2 half + 1)."""
    padded = np.pad(image, [(half, half)] * 2 + [(0, 0)] * (image.ndim - 2))
    return np.lib.stride_tricks.sliding_window_view(padded, (2 * half + 1,) * 2, axis=(0, 1))


def fit(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Gain a and offset b so that other = a own + b, per channel, robust against what does not match.

    Parameters
    ----------
    own, other : ndarray of shape (S, 3)
        Matched colours from 0 to 1, none clipped.

    Returns
    -------
    ndarray of shape (3, 2), float64
        (a, b) of each channel; (1, 0) where nothing can be said (too few samples, a black or a saturated photo).
    """
    result = np.tile([1.0, 0.0], (3, 1))
    if len(own) < _LEAST:
        return result
    for channel in range(3):
        result[channel] = _fit_channel(own[:, channel].astype(np.float64), other[:, channel].astype(np.float64))
    return result


def _fit_channel(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Gain from the ratio of the deviations, so that neither photo's noise nor a depth error draws it to zero, as it
    would in a least squares fit; reweighted beyond 1.5 robust standard deviations, so that
    what does not match counts no more than what does."""
    weight = np.ones_like(x)
    gain, offset = 1.0, 0.0
    for _ in range(_ROUNDS):
        total = weight.sum()
        mx, my = (weight * x).sum() / total, (weight * y).sum() / total
        ratio = my / mx
        var_x, var_y = (weight * (x - mx) ** 2).sum() / total, (weight * (y - my) ** 2).sum() / total
        gain = np.sqrt((var_y + _PRIOR * ratio**2) / (var_x + _PRIOR))
        offset = my - gain * mx
        residual = np.abs(y - gain * x - offset)
        scale = 1.5 * 1.4826 * np.median(residual) + 1e-4
        weight = np.minimum(1.0, scale / np.maximum(residual, 1e-12)) ** 2
    return (gain, offset) if 0.05 < gain < 20 else (1.0, 0.0)
