"""Launches of ssim.cl and loss.cl: a rendered view against its photo, and what each pixel passes back (method section 5)."""

from __future__ import annotations

from math import prod

from pagas_cl.runtime.program import bind, build
from pagas_cl.splat import ssim
from pagas_cl.splat.tile import pitch

ADD_GROUP = 64            # as in step.cl


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
    out = []
    if share > 0:
        forward = ssim.launches(level, view)
        out += forward + (_sum(level, level.ssim_tile.groups(*windows), ssim_scale / n) if forward else [])
    program = build(level.device, "loss.cl", (*level.defines, *tile.defines))
    out.append(bind(program, "loss_backward", tile.grid(*size.grid), (tile.group, 1), a["rendered"], photo, size.width,
                    size.height, pitch(size.width), a["partials"] if share > 0 else None, seen, float(l1_scale),
                    float(ssim_scale), a["upstream"], a["losses"] if "losses" in a else None))
    return out + _sum(level, tile.groups(*size.grid), l1_scale / n)


def _sum(level, groups: tuple[int, int], scale: float) -> list:
    """Add the tiles' losses to the schedule's, where it follows the loss."""
    a = level.arena
    if "losses" not in a:
        return []
    program = build(level.device, "step.cl", level.defines)
    return [bind(program, "add_loss", (ADD_GROUP,), (ADD_GROUP,), a["losses"], prod(groups), float(scale),
                 a["state"])]
