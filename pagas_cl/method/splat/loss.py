"""Launches of ssim.cl and loss.cl: how alike a rendered view and its photo are, and what is passed back (method
section 5)."""

from math import prod

from pagas_cl.method.splat.buffers import channels_of
from pagas_cl.method.splat.constants import HALO, LOSS_ONE, TILE_ONE
from pagas_cl.method.splat.options import pitch

_TO_LOSS = LOSS_ONE / TILE_ONE     # from the sums of a tile


def windows(size) -> tuple[int, int]:
    """SSIM windows inside an image of `size`, across and down."""
    return max(size.width - HALO, 0), max(size.height - HALO, 0)


def launches(programs, buffers, view, views: int) -> list:
    """From buffers.rendered of `view` to buffers.v_rendered, its loss to buffers.loss; means of `views` views."""
    size, n = view.size, view.target_size.pixels
    share, across = programs.config.loss.ssim, windows(size)
    l1_scale = (1 - share) * n / size.pixels / views
    ssim_scale = share * n / (prod(across) * channels_of(programs.config)) / views if prod(across) else 0.0
    shared = {"pitch": pitch(size.width), "total": buffers.loss}
    ssim = [programs.bind("ssim.cl", "ssim_forward", across, buffers, view, loss_scale=_TO_LOSS * ssim_scale / n,
                          **shared)] if share > 0 and prod(across) else []
    seen = buffers.seen[view.number - 1] if buffers.seen and view.number else None
    # the target's own view has no gradient: nothing of SSIM is passed back
    return [*ssim, programs.bind("loss.cl", "loss_backward", size, buffers, view, seen=seen, l1_scale=l1_scale,
                                 ssim_scale=ssim_scale if view.number else 0.0,
                                 loss_scale=_TO_LOSS * l1_scale / n, **shared)]
