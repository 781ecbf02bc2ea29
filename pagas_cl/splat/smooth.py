"""Launches of smooth.cl: what holds a depth map together where photos say little (method section 5)."""

from __future__ import annotations

from pagas_cl.runtime.program import bind, build


def before_steps(level) -> list:
    """Once a level: pixels of parallax per inverse depth, and the weight of each pixel by its texture."""
    s = level.config.smoothness
    if s.kind == "none":
        return []
    a, size = level.arena, level.target
    texture = 1.0 if s.kind == "normal" else float(s.texture)
    return [bind(build(level.device, "smooth.cl", level.defines), "smoothness_scale", size.grid, None, a["depth"], a["unit"],
                 level.given.photos[0], size.width, size.height, texture, a["kappa"], a["weights"])]


def launches(level) -> list:
    """Add N dL_s/dd to arena["gradient"]; once a step."""
    s, a, size = level.config.smoothness, level.arena, level.target
    if s.kind == "none" or s.weight == 0:
        return []
    program = build(level.device, "smooth.cl", level.defines)
    if s.kind == "planar":
        return [bind(program, "smoothness_planar", size.grid, None, a["depth"], a["kappa"], a["weights"], size.width,
                     size.height, float(s.weight), float(s.huber), float(s.cut), a["gradient"])]
    return [bind(program, "normal_map", size.grid, None, a["depth"], a["cameras"], a["normals"]),
            bind(program, "normal_slope", size.grid, None, a["normals"], a["weights"], size.width, size.height,
                 float(s.weight), a["slopes"]),
            bind(program, "normal_vjp", size.grid, None, a["depth"], a["cameras"], a["slopes"], a["gradient"])]
