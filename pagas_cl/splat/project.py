"""Launches of project.cl: what needs only where Gaussians land (method section 3)."""

from __future__ import annotations

import numpy as np

from pagas_cl.runtime.program import Fill, bind, build
from pagas_cl.splat.tile import columns_of, row_grid, row_group

_INFINITY = np.uint32(0x7F800000)


def before_steps(level) -> list:
    """Once a level, under its initial depth: the depth per pixel of parallax and the unseen masks."""
    program, a = build(level.device, "project.cl", level.defines), level.arena
    launches = [bind(program, "find_depth_per_parallax", level.target.grid, None, a["depth"], a["cameras"],
                     len(level.contexts), a["depth_per_parallax"])]
    for k in range(len(level.contexts) if level.config.loss.unseen_mask else 0):
        name = f"seen{k}"
        launches.append(Fill(a[name], np.uint32(0), a.size(name)))
        launches.append(bind(program, "mark_seen", level.target.grid, None, a["depth"], a["cameras"], k + 1, a[name]))
    return launches


def z_first_argument(level):
    """z_first of the context view at hand; None where it is not part of the program."""
    return level.arena["z_first"] if "z_first" in level.arena else None


def nearest(level, view: int, depth=None) -> list:
    """z_first of every pixel of a context view under `depth`, the level's by default; nothing without occlusion."""
    if not level.config.splatting.occlusion:
        return []
    a, columns = level.arena, columns_of(level.device, level.target.width)
    program = build(level.device, "project.cl", (*level.defines, f"COLUMNS={columns}"))
    return [Fill(a["z_first"], _INFINITY, 4 * level.given.sizes[view].pixels),
            bind(program, "nearest", row_grid(level.target, columns), row_group(columns),
                 a["depth"] if depth is None else depth, a["cameras"], view, float(level.config.splatting.low_pass),
                 a["z_first"])]
