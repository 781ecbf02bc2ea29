"""Twin of splat/composite and splat/backward: Gaussians to an image, and the image's gradient back to depth.

Method section 4, both blends. All sums run over the list of pairs sorted by (pixel, z, Gaussian); pairs.py makes it.
"""

from dataclasses import dataclass

import numpy as np

from pagas_cl.config import Splatting
from twins.pairs import Pairs, candidates, rank, shares
from twins.project import Projected

ALPHA_MIN = 1 / 255  # with "alpha" and `normalize`: least coverage that C is divided by


@dataclass(frozen=True, eq=False)
class Rendered:
    """One context view, rendered from the target's Gaussians, with what the backward needs."""

    color: np.ndarray       # (H, W, channels): C as the losses see it, the photo's where nothing covers a pixel
    coverage: np.ndarray    # (H, W): A
    covered: np.ndarray     # (H, W) bool: where C comes from Gaussians, else neither C nor A has a gradient
    pairs: Pairs            # the participants only
    colors: np.ndarray      # (N, channels): of the Gaussians
    photo: np.ndarray       # (H * W, channels)
    total: np.ndarray       # (H * W,): S = sum of alpha (order-free), A (alpha blend)
    gaussians: int          # N
    splatting: Splatting


def composite(projected: Projected, colors: np.ndarray, photo: np.ndarray, splatting: Splatting,
              depth_threshold: float, z_first=None) -> Rendered:
    """Render the Gaussians, whose `colors` (N, channels) are 0 to 1, into a view (method section 4) of the size of its
    `photo` (H, W, channels), which stands where nothing covers a pixel; `depth_threshold` in units;
    `z_first` (H * W,) the first surfaces, where they are kept."""
    height, width, channels = photo.shape
    pairs = candidates(projected, width, height, splatting)
    pairs = pairs.shared(shares(pairs, width * height, splatting, depth_threshold, z_first))
    blend = _order_free if splatting.blend == "order_free" else _alpha_blend
    color, A, total, covered = blend(pairs, colors, photo.reshape(-1, channels), splatting.normalize)
    return Rendered(color.reshape(photo.shape), A.reshape(height, width), covered.reshape(height, width), pairs,
                    colors, photo.reshape(-1, channels), total, len(colors), splatting)


def composite_vjp(rendered: Rendered, v_color: np.ndarray, v_coverage: np.ndarray) -> np.ndarray:
    """dL/dd of shape (N,) from dL/dC (H, W, channels) and dL/dA (H, W); participation has no gradient."""
    channels = rendered.colors.shape[1]
    covered = rendered.covered.ravel()
    v_color = np.where(covered[:, None], v_color.reshape(-1, channels), 0.0)
    v_A = np.where(covered, v_coverage.ravel(), 0.0)
    back = _order_free_vjp if rendered.splatting.blend == "order_free" else _alpha_blend_vjp
    v_alpha = back(rendered, v_color, v_A)
    return np.bincount(rendered.pairs.gaussian, v_alpha * rendered.pairs.alpha_d, rendered.gaussians)


def _order_free(pairs: Pairs, colors, photo, normalize):
    """C = A (sum(alpha c) / S) + (1 - A) photo with A = min(1, S); covered iff S > 0.

    The average by weight of Zwicker et al. (2001) wherever the weights sum up to 1; below that the photo fills up, so
    that a pixel at an edge is compared by as much of it as is covered, and a Gaussian enters it smoothly.
    """
    S = np.bincount(pairs.pixel, pairs.alpha, len(photo))
    weighted = pairs.alpha[:, None] * colors[pairs.gaussian]
    mixed = np.stack([np.bincount(pairs.pixel, column, len(photo)) for column in weighted.T], axis=1)
    average = mixed / np.where(S > 0, S, 1.0)[:, None]
    return photo + filled(S)[:, None] * (average - photo), np.minimum(1.0, S), S, S > 0


def filled(S: np.ndarray) -> np.ndarray:
    """How much of a pixel its Gaussians fill: A = min(1, S). As participation it has no gradient: that would pull a
    surface away from its edges."""
    return np.minimum(1.0, S)


def _order_free_vjp(rendered: Rendered, v_color, v_A):
    """dC/dalpha_k = A (c_k - sum(alpha c) / S) / S with A held fixed; dA/dalpha_k = 1 where S < 1, for L1's weight."""
    pairs, S = rendered.pairs, np.where(rendered.total > 0, rendered.total, 1.0)
    A = np.minimum(1, S)[:, None]
    average = rendered.photo + (rendered.color.reshape(v_color.shape) - rendered.photo) / A
    v_average = A / S[:, None] * v_color
    v_alpha = (v_average[pairs.pixel] * (rendered.colors[pairs.gaussian] - average[pairs.pixel])).sum(axis=1)
    return v_alpha + np.where(S < 1, v_A, 0.0)[pairs.pixel]


def _table(pairs: Pairs, colors):
    """Front-to-back lists as arrays: alpha (M, K) and colour (M, K, channels) of M pixels, unused places with alpha
    0; the row and column of every pair; the M pixels."""
    pixels, row = np.unique(pairs.pixel, return_inverse=True)
    place = (row, rank(pairs.pixel))
    longest = int(place[1].max(initial=0)) + 1
    alpha, c = np.zeros((len(pixels), longest)), np.zeros((len(pixels), longest, colors.shape[1]))
    alpha[place], c[place] = pairs.alpha, colors[pairs.gaussian]
    through = np.cumprod(1 - alpha, axis=1)
    T = np.concatenate([np.ones((len(pixels), 1)), through[:, :-1]], axis=1)
    return alpha, c, T, through[:, -1], place, pixels


def _alpha_blend(pairs: Pairs, colors, photo, normalize):
    """C = sum(c alpha T), A = 1 - T_end, front to back (the paper's blend); with `normalize` C / A where A >= 1/255."""
    alpha, c, T, T_end, _, pixels = _table(pairs, colors)
    C, A = np.zeros_like(photo), np.zeros(len(photo))
    C[pixels], A[pixels] = ((alpha * T)[..., None] * c).sum(axis=1), 1 - T_end
    if not normalize:
        return C, A, A, np.ones(len(photo), bool)
    covered = A >= ALPHA_MIN
    return np.where(covered[:, None], C / np.where(covered, A, 1.0)[:, None], photo), A, A, covered


def _alpha_blend_vjp(rendered: Rendered, v_color, v_A):
    """dL/dalpha_k = T_k (g.(c_k - B_k) + v_A prod_{j>k}(1 - alpha_j)), back to front, without a division by 1 - alpha
    (method section 4): B_k is the colour composited behind k."""
    if rendered.splatting.normalize:  # C/A: the quotient rule first; `covered` has cut everything where A is small
        A = np.where(rendered.covered.ravel(), rendered.total, 1.0)
        v_A = v_A - (v_color * rendered.color.reshape(v_color.shape)).sum(axis=1) / A
        v_color = v_color / A[:, None]
    alpha, c, T, _, place, pixels = _table(rendered.pairs, rendered.colors)
    g, v_A = v_color[pixels], v_A[pixels]
    v_alpha = np.zeros_like(alpha)
    B, behind = np.zeros_like(g), np.ones(len(pixels))
    for k in reversed(range(alpha.shape[1])):
        v_alpha[:, k] = T[:, k] * ((g * (c[:, k] - B)).sum(axis=1) + v_A * behind)
        a = alpha[:, k, None]
        B = a * c[:, k] + (1 - a) * B
        behind = behind * (1 - alpha[:, k])
    return v_alpha[place]
