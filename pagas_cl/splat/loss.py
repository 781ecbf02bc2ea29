"""Launches of loss.cl: a rendered view against its photo, and what each pixel passes back (method section 5)."""

from __future__ import annotations

from pagas_cl.runtime.program import bind, build
from pagas_cl.splat.options import LOSS_GROUP

TILE_W, TILE_H, HALO = 32, 16, 5          # as in loss.cl


def launches(level, view: int) -> list:
    """From arena["rendered"] to arena["upstream"] for context view `view` (0: the target's own)."""
    program, a = build(level.device, "loss.cl", level.defines), level.arena
    size, photo = level.given.sizes[view], level.given.photos[view]
    grid = (-(-size.width // TILE_W) * LOSS_GROUP, -(-size.height // TILE_H))
    local = (LOSS_GROUP, 1)
    tiles = grid[0] // LOSS_GROUP * grid[1]
    share = level.config.loss.ssim
    windows = max(size.width - 2 * HALO, 0) * max(size.height - 2 * HALO, 0)
    channels = 1 if level.config.loss.grey else 3
    n, views = level.target.pixels, level.views_in_loss
    l1_scale = (1 - share) * n / size.pixels / views
    ssim_scale = share * n / (windows * channels) / views if windows else 0.0
    track = level.config.solver.patience > 0
    losses = a["losses"] if track else None
    seen = a[f"seen{view - 1}"] if level.config.loss.unseen_mask and view else None
    out = []
    if share > 0:
        out.append(bind(program, "ssim_forward", grid, local, a["rendered"], photo, size.width, size.height,
                        a["partials"], losses))
        out += _sum(level, tiles, ssim_scale / n) if track else []
    partials = a["partials"] if share > 0 else None
    out.append(bind(program, "loss_backward", grid, local, a["rendered"], photo, size.width, size.height, partials, seen,
                    float(l1_scale), float(ssim_scale), a["upstream"], losses))
    return out + (_sum(level, tiles, l1_scale / n) if track else [])


def _sum(level, tiles: int, scale: float) -> list:
    program, a = build(level.device, "step.cl", level.defines), level.arena
    return [bind(program, "add_loss", (LOSS_GROUP,), (LOSS_GROUP,), a["losses"], tiles, float(scale), a["state"])]
