"""Twin of splat/units: depths from scene units to the device's units and back."""

from __future__ import annotations

import numpy as np

from pagas_cl.scene.depthmap import surface_depth
from pagas_cl.scene.status import KEPT, NO_SURFACE, REFINED
from pagas_cl.scene.unit import FAR, NEAR, unit_of


def normalized_depth(depth: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Depth in units of its median, float32, 0 where there is none, and that unit.

    Depths outside NEAR to FAR units, masked out or not finite have no Gaussian.
    """
    depth = depth if depth.dtype in (np.float32, np.float64) else depth.astype(np.float32)
    unit = unit_of(depth, mask)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = (depth / np.asarray(unit, depth.dtype)).astype(np.float32)
        valid = (depth > 0) & (depth < np.inf) & (scaled >= NEAR) & (scaled <= FAR)
    return np.where(valid if mask is None else valid & mask, scaled, np.float32(0)), unit


def depth_range(normalized: np.ndarray) -> float:
    """From the nearest to the farthest surface, units; 0 without any."""
    surface = normalized[normalized > 0]
    return float(surface.max() - surface.min()) if surface.size else 0.0


def in_scene_units(refined, parallax, deviation, status, unit: float, given: np.ndarray):
    """(depth, parallax, deviation, status) as a view gives them back.

    A depth that was not refined comes back with the bits that it came with; a surface without a Gaussian (masked out,
    or too near or far) counts as kept.
    """
    depth = np.where(status == REFINED, refined * np.float32(unit), surface_depth(given))
    aside = (status == NO_SURFACE) & (depth > 0)
    return (depth, parallax * np.float32(unit), np.where(aside, np.float32(np.inf), deviation * np.float32(unit)),
            np.where(aside, np.uint8(KEPT), status))
