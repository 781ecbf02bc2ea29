"""Launches of backward.cl and alpha.cl: the gradient of the loss by each depth (method sections 3 and 4)."""

from __future__ import annotations

from pagas_cl.runtime.program import bind, build
from pagas_cl.splat.composite import exposure_argument, threshold_arguments


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
    return [bind(program, "composite_alpha_vjp", level.given.sizes[view].grid, None, a["depth"], a["records"], photo,
                 a["cameras"], view, a["heads"], a["next"], radius, low_pass, *threshold_arguments(level), a["upstream"],
                 a["fixed"]),
            bind(program, "collect_gradient", (level.target.pixels,), None, a["fixed"], level.target.pixels, a["gradient"])]
