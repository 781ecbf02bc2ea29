"""Numbers to colours. Colour maps are a few anchors with straight lines between them, so that nothing but NumPy is
needed; each rises evenly in lightness, the signed one from both ends to white at zero."""

from __future__ import annotations

import numpy as np

NOTHING = (34, 34, 34)  # colour of a pixel without a value

_MAPS = {
    "sequential": ((48, 18, 84), (49, 75, 140), (33, 128, 141), (62, 180, 112), (170, 216, 60), (253, 236, 80)),
    "signed": ((20, 60, 140), (90, 150, 215), (200, 222, 240), (255, 255, 255), (250, 214, 190), (225, 120, 85),
               (140, 20, 40)),
}


def colored(values, low: float, high: float, valid, map_name: str = "sequential") -> np.ndarray:
    """Colours of `values`, clipped to `low` .. `high`; NOTHING where not `valid`.

    Parameters
    ----------
    values : ndarray of shape (H, W)
    valid : ndarray of shape (H, W), bool
    map_name : str
        "sequential" or "signed".

    Returns
    -------
    ndarray of shape (H, W, 3), uint8
    """
    anchors = np.array(_MAPS[map_name], np.float64)
    places = np.linspace(0, 1, len(anchors))
    share = np.clip((np.where(valid, values, low) - low) / max(high - low, 1e-30), 0, 1)
    rgb = np.stack([np.interp(share, places, anchors[:, channel]) for channel in range(3)], axis=-1)
    return np.where(valid[..., None], np.rint(rgb), NOTHING).astype(np.uint8)


def normal_colors(normals, valid) -> np.ndarray:
    """Colours of unit normals: red to the right, green up, blue towards the camera.

    Convention: camera axes x right, y down, z forward; a normal may point to or from the camera, it is turned to it.

    Parameters
    ----------
    normals : ndarray of shape (H, W, 3)
    valid : ndarray of shape (H, W), bool
    """
    facing = np.where(normals[..., 2:] > 0, -normals, normals) * (1, -1, -1)
    return np.where(valid[..., None], np.rint((facing + 1) * 127.5), NOTHING).astype(np.uint8)


def css_gradient(map_name: str) -> str:
    """The colour map as a CSS background, for the legend of the page."""
    return f"linear-gradient(90deg, {', '.join(f'rgb({r},{g},{b})' for r, g, b in _MAPS[map_name])})"
