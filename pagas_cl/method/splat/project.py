"""Launches of means.cl and project.cl: what needs only where Gaussians land (method section 3)."""

import numpy as np

from pagas_cl.runtime.program import Fill

_INFINITY = np.uint32(0x7F800000)


def before_steps(programs, buffers, target, contexts: int) -> list:
    """Once a level, under its initial depth: buffers.depth_per_parallax, and the unseen masks buffers.seen."""
    grid = target.size
    launches = [programs.bind("means.cl", "find_depth_per_parallax", grid, buffers, views=contexts)]
    for view, seen in enumerate(buffers.seen if programs.config.loss.unseen_mask else (), start=1):
        launches += [Fill(seen, np.uint32(0), seen.size),
                     programs.bind("means.cl", "mark_seen", grid, buffers, view=view, seen=seen)]
    return launches


def nearest(programs, buffers, view, **depth) -> list:
    """buffers.row_ranges, and the z-buffer of `view` (buffers.z_first where it has none of its own), stage "nearest",
    under buffers.depth, or the `depth` given; without occlusion only the former."""
    launches = programs.bind_row_ranges(buffers, view, **depth)
    if programs.config.splatting.occlusion:
        launches += [Fill(view.z_first or buffers.z_first, _INFINITY, 4 * view.size.pixels, "nearest"),
                     programs.bind_scatter("project.cl", "nearest", buffers, view, **depth)]
    return launches
