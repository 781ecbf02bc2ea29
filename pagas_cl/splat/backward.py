"""Launches of backward.cl and alpha.cl: the gradient of the loss by each depth (method sections 3 and 4)."""

from __future__ import annotations

from pagas_cl.runtime.program import Fill, bind, build
from pagas_cl.splat.composite import blend_launch, exposure_argument, threshold_arguments
from pagas_cl.splat.project import z_first_argument
from pagas_cl.splat.state import NO_HEAD
from pagas_cl.splat.tile import columns_of, row_grid, row_group


def launches(level, view: int) -> list:
    """Add what context view `view` says of each depth to arena["gradient"]; the target's own (0) says nothing."""
    a, s, photo = level.arena, level.config.splatting, level.given.photos[0]
    if view == 0:
        return [Fill(a["heads"], NO_HEAD, a.size("heads"))] if s.blend == "alpha" else []
    if s.blend == "order_free":
        columns = columns_of(level.device, level.target.width)
        program = build(level.device, "backward.cl", (*level.defines, f"COLUMNS={columns}"))
        return [bind(program, "gather_gradient", row_grid(level.target, columns), row_group(columns), a["depth"], photo,
                     a["cameras"], view, float(s.low_pass), *threshold_arguments(level, view), z_first_argument(level),
                     exposure_argument(level), a["v_rendered"], a["gradient"])]
    return [blend_launch(level, view, "composite_alpha_vjp", a["v_rendered"]),
            bind(build(level.device, "alpha.cl", level.defines), "gather_alpha", level.target.grid, None, a["depth"],
                 a["cameras"], view, float(s.low_pass), a["alphas"], a["gradient"], a["heads"],
                 a.specs["heads"].shape[0])]
