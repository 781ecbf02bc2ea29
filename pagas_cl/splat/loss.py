"""Launches of ssim.cl and loss.cl: a rendered view against its photo, what its pixels pass back (method section 5)."""

from __future__ import annotations

from math import prod

from pagas_cl.runtime.program import bind, build
from pagas_cl.splat import ssim
from pagas_cl.splat.constants import LOSS_ONE, TILE_ONE
from pagas_cl.splat.step import loss_argument
from pagas_cl.splat.tile import pitch

_TO_LOSS = LOSS_ONE / TILE_ONE     # from the sums of a tile


def launches(level, view: int) -> list:
    """From arena["rendered"] to arena["v_rendered"] for context view `view` (0: the target's own)."""
    a, tile, share = level.arena, level.loss_tile, level.config.loss.ssim
    size, photo = level.given.sizes[view], level.given.photos[view]
    windows = ssim.windows(size)
    channels = 1 if level.config.loss.grey else 3
    n, views = level.target.pixels, level.views_in_loss
    l1_scale = (1 - share) * n / size.pixels / views
    ssim_scale = share * n / (prod(windows) * channels) / views if prod(windows) else 0.0
    seen = a[f"seen{view - 1}"] if level.config.loss.unseen_mask and view else None
    program = build(level.device, "loss.cl", (*level.defines, *tile.defines))
    # the target's own view has no gradient: nothing of SSIM is passed back
    backward = bind(program, "loss_backward", tile.grid(*size.grid), (tile.group, 1), a["rendered"], photo, size.width,
                    size.height, pitch(size.width), a["partials"] if share > 0 else None, seen, float(l1_scale),
                    float(ssim_scale if view else 0.0), a["v_rendered"], _TO_LOSS * l1_scale / n,
                    loss_argument(level))
    return [*(ssim.launches(level, view, _TO_LOSS * ssim_scale / n) if share > 0 else []), backward]
