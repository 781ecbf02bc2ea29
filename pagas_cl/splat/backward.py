"""Launches of backward.cl and alpha.cl: the gradient of the loss by each depth (method sections 3 and 4)."""

from __future__ import annotations

from pagas_cl.runtime.program import bind, build
from pagas_cl.splat.composite import exposure_argument, threshold_arguments
from pagas_cl.splat.options import LIST_GROUP


def launches(level, view: int) -> list:
    """Add what context view `view` says of each depth to arena["gradient"]."""
    a, s, photo = level.arena, level.config.splatting, level.given.photos[0]
    radius, low_pass = float(s.radius), float(s.low_pass)
    if s.blend == "order_free":
        program = build(level.device, "backward.cl", level.defines)
        return [bind(program, "gather_gradient", level.target.grid, None, a["depth"], photo, a["cameras"], view, radius,
                     low_pass, *threshold_arguments(level), a["z_first"], exposure_argument(level),
                     a["upstream"], a["gradient"])]
    program = build(level.device, "alpha.cl", level.defines)
    size = level.given.sizes[view]
    return [bind(program, "composite_alpha_vjp", size.grid, LIST_GROUP, photo, exposure_argument(level), view, a["heads"],
                 a["links"], a["alphas"], level.target.pixels, size.width, size.height, *threshold_arguments(level),
                 a["upstream"]),
            bind(program, "gather_alpha", level.target.grid, None, a["depth"], a["cameras"], view, radius, low_pass,
                 a["alphas"], a["gradient"])]
