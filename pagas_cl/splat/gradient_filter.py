"""Launches of gradient_filter.cl: the gradient of the photos averaged over neighbouring pixels (method section 6)."""

from __future__ import annotations

from pagas_cl.runtime.program import bind, build


def launches(level) -> list:
    """Average arena["gradient"] in place; once a step, before the smoothness adds to it."""
    if level.config.solver.gradient_filter == 0:
        return []
    a, size = level.arena, level.target
    program = build(level.device, "gradient_filter.cl", level.defines)
    return [bind(program, "filter_across", size.grid, None, a["gradient"], a["depth_per_parallax"], size.width,
                 size.height, a["sums"]),
            bind(program, "filter_down", size.grid, None, a["sums"], a["depth_per_parallax"], size.width,
                 size.height, a["gradient"])]
