"""Twin of splat/units: depths from scene units to the device's units and back."""

import numpy as np

from pagas_cl.scene.depthmap import KEPT, NO_SURFACE, REFINED, surface_depth
from pagas_cl.scene.sampling import FAR, NEAR, scene_scale_of


def normalized_depth(depth: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Depth in units of its median, float32, 0 where there is none, and that median, the scene's scale.

    Depths outside NEAR to FAR units, masked out or not finite have no Gaussian.
    """
    depth = depth if depth.dtype in (np.float32, np.float64) else depth.astype(np.float32)
    scene_scale = scene_scale_of(depth, mask)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = (depth / np.asarray(scene_scale, depth.dtype)).astype(np.float32)
        valid = (depth > 0) & (depth < np.inf) & (scaled >= NEAR) & (scaled <= FAR)
    return np.where(valid if mask is None else valid & mask, scaled, np.float32(0)), scene_scale


def depth_range(normalized: np.ndarray) -> float:
    """From the nearest to the farthest surface, units; 0 without any."""
    surface = normalized[normalized > 0]
    return float(surface.max() - surface.min()) if surface.size else 0.0


def in_scene_units(refined, parallax, deviation, status, scene_scale: float, given: np.ndarray):
    """(depth, parallax, deviation, status) as a view gives them back.

    A depth that was not refined comes back with the bits that it came with; a surface without a Gaussian (masked out,
    or too near or far) counts as kept.
    """
    depth = np.where(status == REFINED, refined * np.float32(scene_scale), surface_depth(given))
    without_gaussian = (status == NO_SURFACE) & (depth > 0)
    scaled = np.where(without_gaussian, np.float32(np.inf), deviation * np.float32(scene_scale))
    return depth, parallax * np.float32(scene_scale), scaled, np.where(without_gaussian, np.uint8(KEPT), status)
