"""Launches of composite.cl and alpha.cl: Gaussians to an image (method section 4)."""

from __future__ import annotations

import numpy as np

from pagas_cl.runtime.program import Fill, bind, build
from pagas_cl.splat import project
from pagas_cl.splat.options import FEW_GROUP, LIST_GROUP, reach

MOST_CROWDED = 65536      # work-items over the pixels of crowded.cl, each of which takes several in turn


def launches(level, view: int) -> list:
    """Render context view `view` into arena["rendered"]."""
    return _order_free(level, view) if level.config.splatting.blend == "order_free" else _alpha(level, view)


def threshold_arguments(level, view: int) -> tuple[float, float]:
    """Depth threshold in units of the median depth, and as a share of the local depth."""
    return float(level.threshold(view)), float(level.config.splatting.depth_relative)


def exposure_argument(level):
    """Gains and offsets of every context view; None where they are not part of the program."""
    return level.arena["exposure"] if level.config.loss.exposure else None


def _order_free(level, view: int) -> list:
    program, a, s = build(level.device, "composite.cl", level.defines), level.arena, level.config.splatting
    pixels = level.given.sizes[view].pixels
    channels = 1 if level.config.loss.grey else 3
    return [*project.nearest(level, view),
            Fill(a["rendered"], np.uint32(0), pixels * (channels + 1) * 4),
            bind(program, "splat_order_free", level.target.grid, None, a["depth"], level.given.photos[0], a["cameras"],
                 view, float(s.radius), float(s.low_pass), *threshold_arguments(level, view), a["z_first"],
                 exposure_argument(level), a["rendered"])]


def _alpha(level, view: int) -> list:
    program, a, s = build(level.device, "alpha.cl", level.defines), level.arena, level.config.splatting
    size = level.given.sizes[view]
    border = 2 * reach(s.radius) + 1
    bins = (size.width + border) * (size.height + border)
    clear = Fill(a["heads"], np.int32(-1), 4 * (bins + 1))
    link = bind(program, "link_bins", level.target.grid, None, a["depth"], a["cameras"], view, float(s.radius),
                float(s.low_pass), a["heads"], a["links"], a["alphas"])
    return [clear, link, *blend_launches(level, view, "", a["rendered"])]


def blend_launches(level, view: int, suffix: str, image) -> list:
    """The kernels of alpha.cl and crowded.cl named composite_alpha`suffix` and composite_crowded`suffix` on `image`."""
    a, size, reached = level.arena, level.given.sizes[view], reach(level.config.splatting.radius)
    shared = (level.given.photos[0], exposure_argument(level), view, a["heads"], a["links"], a["alphas"])
    rest = (level.target.pixels, size.width, size.height, *threshold_arguments(level, view), image)
    crowded = bind(build(level.device, "crowded.cl", level.defines), f"composite_crowded{suffix}",
                   (min(size.pixels, MOST_CROWDED),), (LIST_GROUP,), *shared, a["crowded"], *rest)
    if reached != 1:
        return [crowded]
    found = () if suffix else (a["crowded"],)
    return [bind(build(level.device, "alpha.cl", level.defines), f"composite_alpha{suffix}", size.grid, FEW_GROUP, *shared,
                 *found, *rest), crowded]
