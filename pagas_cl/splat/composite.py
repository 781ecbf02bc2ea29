"""Launches of composite.cl and alpha.cl: Gaussians to an image (method section 4)."""

from __future__ import annotations

import numpy as np

from pagas_cl.runtime.program import Fill, bind, build
from pagas_cl.splat import project
from pagas_cl.splat.options import LIST_GROUP
from pagas_cl.splat.tile import columns_of, row_grid, row_group


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
    a, s, columns = level.arena, level.config.splatting, columns_of(level.device, level.target.width)
    program = build(level.device, "composite.cl", (*level.defines, f"COLUMNS={columns}"))
    pixels = level.given.sizes[view].pixels
    channels = 1 if level.config.loss.grey else 3
    return [*project.nearest(level, view),
            Fill(a["rendered"], np.uint32(0), pixels * (channels + 1) * 4),
            bind(program, "splat_order_free", row_grid(level.target, columns), row_group(columns), a["depth"],
                 level.given.photos[0], a["cameras"], view, float(s.low_pass), *threshold_arguments(level, view),
                 project.z_first_argument(level), exposure_argument(level), a["rendered"])]


def _alpha(level, view: int) -> list:
    program, a, s = build(level.device, "alpha.cl", level.defines), level.arena, level.config.splatting
    link = bind(program, "link_bins", level.target.grid, None, a["depth"], a["cameras"], view,
                float(s.low_pass), a["heads"], a["links"], a["alphas"])
    return [link, blend_launch(level, view, "composite_alpha", a["rendered"])]


def blend_launch(level, view: int, name: str, image):
    """The kernel `name` of alpha.cl, composite_alpha or composite_alpha_vjp, with its `image`."""
    a, size = level.arena, level.given.sizes[view]
    return bind(build(level.device, "alpha.cl", level.defines), name, size.grid, LIST_GROUP, level.given.photos[0],
                exposure_argument(level), view, a["heads"], a["links"], a["alphas"], level.target.pixels, size.width,
                size.height, *threshold_arguments(level, view), image)
