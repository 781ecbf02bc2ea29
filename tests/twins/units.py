"""Twin of splat/units: depths back from the device's units, and the scale of a run; the way there ships
(twins.project.normalized_depth)."""

import numpy as np

from pagas_cl.scene.depthmap import KEPT, NO_SURFACE, REFINED, surface_depth
from twins.project import is_valid


def median_depth(depth: np.ndarray) -> float:
    """The `scene_scale` of a run: the median of the valid depths, scene units."""
    return float(np.median(depth[is_valid(depth)]))


def depth_threshold_of(depth: np.ndarray, slices: float) -> float:
    """δ: range of the valid depths / slices, in the depth's own unit (paper section 3; 20 slices)."""
    d = depth[is_valid(depth)]
    return float((d.max() - d.min()) / slices)


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
