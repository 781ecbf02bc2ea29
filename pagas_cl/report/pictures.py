"""The pictures of one refined view, as arrays: what the photo shows, depth and normals before and after, and what
changed by how much."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pagas_cl.report.colors import colored, normal_colors
from pagas_cl.result import normals_of
from pagas_cl.scene.camera import Camera

_SMALLEST_CHANGE = 0.1  # pixels: where nothing moved the scale does not blow rounding up to full colour


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture and its legend.

    Attributes
    ----------
    key, title : str
        Part of the file's name; heading on the page.
    pixels : ndarray of shape (H, W, 3), uint8
    legend : str
        What the colours mean, in words and numbers.
    map_name : str
        Colour map of the legend's strip; empty where there is none.
    """

    key: str
    title: str
    pixels: np.ndarray
    legend: str = ""
    map_name: str = ""


def view_pictures(photo, camera: Camera, before, after, *, change=None, confidence=None) -> list[Picture]:
    """Every picture of one view.

    Parameters
    ----------
    photo : ndarray of shape (H, W, 3), uint8
    camera : Camera
    before, after : ndarray of shape (H, W)
        z-depth, 0 = no surface.
    change : ndarray of shape (H, W), optional
        Signed move in pixels of parallax (`parallax_change`), NaN = unknown.
    confidence : ndarray of shape (H, W), optional
        0 to 1.
    """
    pictures = [Picture("photo", "photo", np.asarray(photo, np.uint8))]
    low, high = depth_range(before, after)
    legend = f"z-depth from {low:.4g} to {high:.4g} scene units"
    pictures += [Picture(f"depth_{when}", f"depth {when}", colored(depth, low, high, depth > 0), legend, "sequential")
                 for when, depth in (("before", before), ("after", after))]
    pictures += [Picture(f"normals_{when}", f"normals {when}", _normals(depth, camera),
                         "red: to the right, green: up, blue: towards the camera")
                 for when, depth in (("before", before), ("after", after))]
    if change is not None:
        known = np.isfinite(change)
        most = max(float(np.percentile(np.abs(change[known]), 99)) if known.any() else 0.0, _SMALLEST_CHANGE)
        pictures.append(Picture("change", "change", colored(change, -most, most, known, "signed"),
                                f"pixels of parallax, from {-most:.2g} (nearer) to {most:.2g} (farther)", "signed"))
    if confidence is not None:
        pictures.append(Picture("confidence", "confidence", colored(confidence, 0, 1, after > 0),
                                "from 0 (the photos say nothing) to 1 (they fix the depth)",
                                "sequential"))
    return pictures


def depth_range(*depths) -> tuple[float, float]:
    """First and last percentile of all valid depths, (0, 1) where there is none."""
    values = np.concatenate([depth[depth > 0].ravel()[::7] if depth.size > 10_000 else depth[depth > 0].ravel()
                             for depth in map(np.asarray, depths)])
    if not values.size:
        return 0.0, 1.0
    low, high = np.percentile(values, (1, 99))
    return float(low), float(max(high, low * (1 + 1e-9)))


def parallax_change(target: Camera, contexts: list[Camera], before, after) -> np.ndarray:
    """How far each pixel's point moved, seen from the context views.

    Root mean square over the context views that have the old point inside their image, in pixels; negative where the
    surface came nearer. NaN where there is no depth before or after, or no context view sees the point.

    Returns
    -------
    ndarray of shape (H, W), float64
    """
    both = (np.asarray(before) > 0) & (np.asarray(after) > 0)
    change = np.full(both.shape, np.nan)
    rays = target.rays()[both]
    old, new = np.asarray(before, np.float64)[both], np.asarray(after, np.float64)[both]
    total, count = np.zeros(len(rays)), np.zeros(len(rays))
    for camera in contexts:
        rotation, tau = camera.relative_to(target)
        q = rays @ rotation.T
        (m_old, inside), (m_new, _) = (_projected(camera, q * depth[:, None] + tau) for depth in (old, new))
        square = ((m_new - m_old) ** 2).sum(axis=1)
        use = inside & np.isfinite(square)
        total[use] += square[use]
        count += use
    with np.errstate(invalid="ignore"):
        change[both] = np.where(count > 0, np.sign(new - old) * np.sqrt(total / count), np.nan)
    return change


def change_in_units(before, after, parallax) -> np.ndarray:
    """(after - before) / parallax where all three are above 0, NaN elsewhere."""
    known = (np.asarray(before) > 0) & (np.asarray(after) > 0) & (np.asarray(parallax) > 0)
    return np.where(known, (np.asarray(after, np.float64) - before) / np.where(known, parallax, 1), np.nan)


def _projected(camera: Camera, points):
    """Pixel positions of camera-frame points, and whether each lies in front and inside the image."""
    z = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        m = points[:, :2] / z[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        inside = (z > 0) & ((m >= 0) & (m < (camera.width, camera.height))).all(axis=1)
    m[z <= 0] = np.nan
    return m, inside


def _normals(depth, camera: Camera) -> np.ndarray:
    normals = normals_of(np.asarray(depth), camera)
    return normal_colors(normals, (normals != 0).any(axis=-1))
