"""Launches of ssim.cl: how alike a rendered view and its photo are, window by window (method section 5)."""

from __future__ import annotations

from pagas_cl.runtime.program import bind, build
from pagas_cl.splat.constants import HALO
from pagas_cl.splat.step import loss_argument
from pagas_cl.splat.tile import pitch


def windows(size) -> tuple[int, int]:
    """SSIM windows inside an image of `size`, across and down."""
    return max(size.width - HALO, 0), max(size.height - HALO, 0)


def launches(level, view: int, loss_scale: float) -> list:
    """Derivatives by the windows' means to arena["partials"] for context view `view` (0: the target's own).

    `loss_scale`: what its sum over the windows is multiplied by on its way to the loss.
    """
    size, photo, a, tile = level.given.sizes[view], level.given.photos[view], level.arena, level.ssim_tile
    if 0 in windows(size):
        return []
    program = build(level.device, "ssim.cl", (*level.defines, *tile.defines))
    return [bind(program, "ssim_forward", tile.grid(*windows(size)), (tile.group, 1), a["rendered"], photo, size.width,
                 size.height, pitch(size.width), a["partials"], loss_scale, loss_argument(level))]
