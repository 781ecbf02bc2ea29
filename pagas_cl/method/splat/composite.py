"""Launches of composite.cl, alpha.cl: Gaussians to an image (method section 4); backward.cl, alpha.cl: the gradient."""

from pagas_cl.method.splat import project
from pagas_cl.method.splat.buffers import NO_HEAD
from pagas_cl.method.splat.options import LIST_GROUP
from pagas_cl.runtime.program import Fill


def launches(programs, buffers, view) -> list:
    """Render `view` into buffers.rendered."""
    if programs.config.splatting.blend == "alpha":
        return [programs.bind("alpha.cl", "link_bins", view.target_size, buffers, view),
                _blend(programs, buffers, view, "composite_alpha")]
    return [*project.nearest(programs, buffers, view),
            programs.bind_scatter("composite.cl", "splat_order_free", buffers, view, sums=buffers.rendered)]


def backward(programs, buffers, view) -> list:
    """Add what buffers.v_rendered of `view` says of each depth to buffers.gradient; of the target's, nothing."""
    alpha = programs.config.splatting.blend == "alpha"
    if view.number == 0:
        return [Fill(buffers.heads, NO_HEAD, buffers.heads.size)] if alpha else []
    if not alpha:
        return [programs.bind_rows("backward.cl", "gather_gradient", buffers, view)]
    return [_blend(programs, buffers, view, "composite_alpha_vjp"),
            programs.bind("alpha.cl", "gather_alpha", view.target_size, buffers, view,
                          bins=buffers.heads.size // 4)]


def _blend(programs, buffers, view, name: str):
    return programs.bind("alpha.cl", name, view.size, buffers, view, LIST_GROUP, count=view.target_size.pixels)
