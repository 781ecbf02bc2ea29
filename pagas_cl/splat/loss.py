"""Launches of ssim.cl and loss.cl: a rendered view against its photo, what its pixels pass back (method section 5)."""

from __future__ import annotations

from math import prod

from pagas_cl.runtime.program import bind, build
from pagas_cl.splat import ssim
from pagas_cl.splat.tile import pitch

ADD_GROUP = 256           # as in step.cl


def launches(level, view: int) -> list:
    """From arena["rendered"] to arena["upstream"] for context view `view` (0: the target's own)."""
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
                    float(ssim_scale if view else 0.0), a["upstream"], a["losses"] if "losses" in a else None)
    forward = ssim.launches(level, view) if share > 0 else []
    return [*forward, backward, *_sum(level, size, ssim_scale / n if forward else 0.0, l1_scale / n)]


def _sum(level, size, ssim_scale: float, l1_scale: float) -> list:
    """Add the tiles' losses to the schedule's, where it follows the loss."""
    a = level.arena
    if "losses" not in a:
        return []
    windows = prod(level.ssim_tile.groups(*ssim.windows(size))) if ssim_scale else 0
    program = build(level.device, "step.cl", level.defines)
    return [bind(program, "add_loss", (ADD_GROUP,), (ADD_GROUP,), a["ssim_losses"], windows, float(ssim_scale),
                 a["losses"], prod(level.loss_tile.groups(*size.grid)), float(l1_scale), a["state"])]
