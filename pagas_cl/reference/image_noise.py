"""Twin of splat/image_noise: noise and texture of one photo."""

from __future__ import annotations

import numpy as np

_ROWS = 256          # rows that are looked at, spread over the photo


def noise_and_texture(image: np.ndarray) -> tuple[float, float]:
    """Standard deviation of the noise, and the share of pixels with little texture.

    Parameters
    ----------
    image : ndarray of shape (H, W, 3), uint8

    Returns
    -------
    noise : float
        In units of the full range. From the second differences of the smoothest quarter of the pixels, taken along
        rows, whose median deviation is sqrt(6) times that of the noise.
    textureless : float
        Share of pixels where the photo changes by less than 0.02 to its right-hand neighbour (paper eq. 6).
    """
    step = max(1, image.shape[0] // _ROWS)
    grey = image[::step].astype(np.float32).mean(axis=2) / 255
    if grey.shape[1] < 8:
        return 0.0, 1.0
    bend = np.abs(grey[:, :-2] - 2 * grey[:, 1:-1] + grey[:, 2:])
    slope = np.abs(grey[:, 2:] - grey[:, :-2])
    flat = bend[slope <= np.quantile(slope, 0.25)]
    return float(1.4826 * np.median(flat) / np.sqrt(6)), float((np.abs(np.diff(grey, axis=1)) < 0.02).mean())
