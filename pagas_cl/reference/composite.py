"""Twin of splat/composite and splat/backward: Gaussians to an image, and the image's gradient back to depth.

Method section 4, both blends. A *pair* is a Gaussian that may reach a pixel; all tests and sums run over the list of
pairs sorted by (pixel, z, Gaussian).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pagas_cl.config import Splatting
from pagas_cl.reference.project import Projected

ALPHA_MAX = 0.999  # clamp of a Gaussian's weight
ALPHA_MIN = 1 / 255  # least weight that says "there is a surface"
NEAREST = 128  # most participants of a pixel in the alpha blend


@dataclass(frozen=True, eq=False)
class Pairs:
    """P pairs of Gaussian and pixel, sorted by (pixel, z, Gaussian).

    Attributes
    ----------
    gaussian, pixel : ndarray of shape (P,), int64
        Index of the target pixel, and of the context pixel (row * width + column).
    Delta : ndarray of shape (P, 2)
        Pixel centre minus projected mean, pixels.
    z : ndarray of shape (P,)
    raw, alpha : ndarray of shape (P,)
        Weight before and after the clamp at 0.999.
    alpha_d : ndarray of shape (P,)
        d alpha / dd of the pair's own Gaussian; 0 where the clamp is active.
    """

    gaussian: np.ndarray
    pixel: np.ndarray
    Delta: np.ndarray
    z: np.ndarray
    raw: np.ndarray
    alpha: np.ndarray
    alpha_d: np.ndarray

    def where(self, keep: np.ndarray) -> Pairs:
        """The pairs where `keep` holds, order kept."""
        return Pairs(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class Rendered:
    """One context view, rendered from the target's Gaussians, with what the backward needs.

    Attributes
    ----------
    color : ndarray of shape (H, W, channels)
        C as the losses see it: the photo's colour where the blend says "not covered".
    coverage : ndarray of shape (H, W)
        A.
    covered : ndarray of shape (H, W), bool
        Where C comes from Gaussians; elsewhere neither C nor A has a gradient.
    pairs : Pairs
        The participants only.
    colors : ndarray of shape (N, channels)
        Colours of the Gaussians.
    total : ndarray of shape (H * W,)
        Order-free: S = sum of alpha. Alpha blend: A.
    gaussians : int
        N.
    splatting : Splatting
    """

    color: np.ndarray
    coverage: np.ndarray
    covered: np.ndarray
    pairs: Pairs
    colors: np.ndarray
    total: np.ndarray
    gaussians: int
    splatting: Splatting


def candidates(projected: Projected, width: int, height: int, radius: float) -> Pairs:
    """Pairs that pass the tests valid, z > near and |Delta| <= radius (method section 4), with their weights."""
    reach = int(np.floor(radius + 0.5))
    m = projected.m
    inside = projected.valid & (m > -reach - 1).all(axis=1) & (m < np.array([width, height]) + reach + 1).all(axis=1)
    g = np.flatnonzero(inside)
    corner = np.floor(m[g]).astype(np.int64)
    found = []
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            xy = corner + (dx, dy)
            Delta = xy + 0.5 - m[g]
            hit = ((xy >= 0) & (xy < (width, height))).all(axis=1) & (np.hypot(*Delta.T) <= radius)
            found.append((g[hit], xy[hit, 1] * width + xy[hit, 0], Delta[hit]))
    gaussian, pixel, Delta = (np.concatenate(part) for part in zip(*found))
    raw, alpha, alpha_d = _weight(projected, gaussian, Delta)
    pairs = Pairs(gaussian, pixel, Delta, projected.z[gaussian], raw, alpha, alpha_d)
    return pairs.where(np.lexsort((gaussian, pairs.z, pixel)))


def _weight(projected: Projected, g: np.ndarray, Delta: np.ndarray):
    """raw = o exp(-1/2 Delta^T K Delta), alpha = min(0.999, raw), d alpha/dd (method section 4)."""
    K, Sigma_d = projected.K[g], projected.Sigma_d[g]
    x, y = Delta.T
    u, v = K[:, 0] * x + K[:, 1] * y, K[:, 1] * x + K[:, 2] * y  # K Delta
    raw = projected.o[g] * np.exp(-0.5 * (u * x + v * y))
    alpha = np.minimum(ALPHA_MAX, raw)
    log_d = (u * projected.m_d[g, 0] + v * projected.m_d[g, 1] + projected.log_o_d[g]
             + 0.5 * (u * u * Sigma_d[:, 0] + 2 * u * v * Sigma_d[:, 1] + v * v * Sigma_d[:, 2]))
    return raw, alpha, np.where(raw < ALPHA_MAX, alpha * log_d, 0.0)


def nearest_surface(pairs: Pairs, pixels: int) -> np.ndarray:
    """z_first of every pixel: the least z among pairs with alpha > 1/255; inf where there is none."""
    z_first = np.full(pixels, np.inf)
    solid = pairs.alpha > ALPHA_MIN
    np.minimum.at(z_first, pairs.pixel[solid], pairs.z[solid])
    return z_first


def participants(pairs: Pairs, pixels: int, splatting: Splatting, delta: float) -> np.ndarray:
    """Which pairs take part, bool of shape (P,): the depth threshold, and in the alpha blend the 128 nearest."""
    keep = np.ones(len(pairs.z), bool)
    if splatting.occlusion:
        z_first = nearest_surface(pairs, pixels)
        limit = np.full(pixels, float(delta))
        if splatting.depth_relative > 0:
            limit = np.minimum(limit, splatting.depth_relative * z_first)
        keep = pairs.z <= (z_first + limit)[pairs.pixel]
    if splatting.blend == "alpha":  # z_first + limit only cuts a pixel's tail, so that the rank is the same after it
        keep &= _rank(pairs.pixel) < NEAREST
    return keep


def _rank(pixel: np.ndarray) -> np.ndarray:
    """Position of each pair in its pixel's list, given the sorted pixel indices."""
    return np.arange(len(pixel)) - np.searchsorted(pixel, pixel, side="left")


def composite(projected: Projected, colors: np.ndarray, photo: np.ndarray, splatting: Splatting,
              delta: float) -> Rendered:
    """Render the Gaussians into a view (method section 4).

    Parameters
    ----------
    colors : ndarray of shape (N, channels)
        Colours of the Gaussians, 0 to 1.
    photo : ndarray of shape (H, W, channels)
        The view's photo: its size is rendered, its colour stands where nothing covers a pixel.
    delta : float
        Depth threshold, units.
    """
    height, width, channels = photo.shape
    pairs = candidates(projected, width, height, splatting.radius)
    pairs = pairs.where(participants(pairs, width * height, splatting, delta))
    blend = _order_free if splatting.blend == "order_free" else _alpha_blend
    color, A, total, covered = blend(pairs, colors, photo.reshape(-1, channels), splatting.normalize)
    return Rendered(color.reshape(photo.shape), A.reshape(height, width), covered.reshape(height, width), pairs,
                    colors, total, len(colors), splatting)


def composite_vjp(rendered: Rendered, v_color: np.ndarray, v_coverage: np.ndarray) -> np.ndarray:
    """dL/dd of shape (N,) from dL/dC (H, W, channels) and dL/dA (H, W); participation has no gradient."""
    channels = rendered.colors.shape[1]
    covered = rendered.covered.ravel()
    v_color = np.where(covered[:, None], v_color.reshape(-1, channels), 0.0)
    v_A = np.where(covered, v_coverage.ravel(), 0.0)
    back = _order_free_vjp if rendered.splatting.blend == "order_free" else _alpha_blend_vjp
    v_alpha = back(rendered, v_color, v_A)
    return np.bincount(rendered.pairs.gaussian, v_alpha * rendered.pairs.alpha_d, rendered.gaussians)


def _sum_by(index: np.ndarray, values: np.ndarray, size: int) -> np.ndarray:
    """Sums of `values` of shape (P, channels) by `index`: shape (size, channels)."""
    return np.stack([np.bincount(index, column, size) for column in values.T], axis=1)


def _order_free(pairs: Pairs, colors, photo, normalize):
    """C = sum(alpha c) / S, A = min(1, S), covered iff S >= 1/255 (Zwicker et al. 2001)."""
    S = np.bincount(pairs.pixel, pairs.alpha, len(photo))
    covered = S >= ALPHA_MIN
    mixed = _sum_by(pairs.pixel, pairs.alpha[:, None] * colors[pairs.gaussian], len(photo))
    C = np.where(covered[:, None], mixed / np.where(covered, S, 1.0)[:, None], photo)
    return C, np.where(covered, np.minimum(1.0, S), 0.0), S, covered


def _order_free_vjp(rendered: Rendered, v_color, v_A):
    """dC/dalpha_k = (c_k - C) / S; dA/dalpha_k = 1 where S < 1."""
    pairs, S = rendered.pairs, rendered.total
    C = rendered.color.reshape(v_color.shape)
    v_alpha = (v_color[pairs.pixel] * (rendered.colors[pairs.gaussian] - C[pairs.pixel])).sum(axis=1)
    v_alpha /= np.where(S > 0, S, 1.0)[pairs.pixel]
    return v_alpha + np.where(S < 1, v_A, 0.0)[pairs.pixel]


def _table(pairs: Pairs, colors):
    """Front-to-back lists as arrays: alpha (M, K) and colour (M, K, channels) of M pixels, unused places with alpha
    0; the row and column of every pair; the M pixels."""
    pixels, row = np.unique(pairs.pixel, return_inverse=True)
    place = (row, _rank(pairs.pixel))
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
