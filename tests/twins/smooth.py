"""Twin of splat/smooth: what holds a depth map together where photos say little (method section 5, L_s), its weights
where a surface is specular, and normals to look at.

Each part of the loss returns the value and its gradient by depth, both WITHOUT the factor N of the step.
"""

import numpy as np

from pagas_cl.config import Smoothness
from twins.pairs import taper


def smoothness(depth, valid, settings: Smoothness, kappa, rays, texture):
    """L_s of the configured kind: value, and gradient of shape (H, W).

    Arrays are (H, W): `depth` in units, a surface where `valid`; `kappa` = d0^2 / u, pixels of parallax per change of
    inverse depth, 0 where the pixel is fixed ("planar"); `rays` (H, W, 3), rho of the target ("normal"); `texture`,
    w_grad of the target's photo.
    """
    if settings.kind == "none" or settings.weight == 0:
        return 0.0, np.zeros(depth.shape)
    if settings.kind == "planar":
        return planar(depth, valid, kappa, 1 - settings.texture * texture, settings.weight, settings.huber,
                      settings.discontinuity)
    return normal(depth, valid, rays, 1 - texture, settings.weight)


def penalty(e: np.ndarray, h: float, discontinuity: float = np.inf):
    """What a second difference e costs, and its derivative clip(e / h, -1, 1) taper(|e| / discontinuity): Huber's,
    up to |e| = discontinuity, beyond which the cost is constant: a discontinuity."""
    size = np.minimum(np.abs(e), discontinuity)
    inner = np.minimum(size, h)
    y = (inner / discontinuity) ** 8
    value = inner**2 / (2 * h) * (1 - 2 / 5 * y + y * y / 9)
    value = value + _taper_integral(size, discontinuity) - _taper_integral(inner, discontinuity)
    return value, np.clip(e / h, -1, 1) * taper(np.abs(e) / discontinuity)


def _taper_integral(e, discontinuity):
    """Integral of taper(t / discontinuity) from 0 to e."""
    y = (e / discontinuity) ** 8
    return e * (1 - 2 / 9 * y + y * y / 17)


def second_differences(depth, valid, kappa):
    """e = kappa (w_before + w_after - 2 w), w = 1/d, along rows and along columns: shape (2, H, W).

    0 where the pixel or one of both neighbours is not valid. Vanishes on every plane, since 1/d is linear there.
    """
    w = 1 / np.where(valid, depth, 1.0)
    e = np.zeros((2, *depth.shape))
    along_x = valid[:, :-2] & valid[:, 1:-1] & valid[:, 2:]
    along_y = valid[:-2] & valid[1:-1] & valid[2:]
    e[0, :, 1:-1] = along_x * (w[:, :-2] + w[:, 2:] - 2 * w[:, 1:-1])
    e[1, 1:-1] = along_y * (w[:-2] + w[2:] - 2 * w[1:-1])
    return e * kappa


def planar(depth, valid, kappa, pixel_weight, weight, h, discontinuity=np.inf):
    """weight / N sum_i pixel_weight_i (penalty(e_x) + penalty(e_y)), e of `second_differences`, pixels of parallax."""
    value, slope = penalty(second_differences(depth, valid, kappa), h, discontinuity)
    scale = weight / depth.size * pixel_weight
    v_e = scale * slope * kappa  # e is 0 where it is not defined, and so is the slope
    v_w = np.zeros(depth.shape)
    v_w[:, :-2] += v_e[0, :, 1:-1]
    v_w[:, 2:] += v_e[0, :, 1:-1]
    v_w[:-2] += v_e[1, 1:-1]
    v_w[2:] += v_e[1, 1:-1]
    v_w -= 2 * v_e.sum(axis=0)
    return float((scale * value).sum()), np.where(valid, -v_w / np.where(valid, depth, 1.0) ** 2, 0.0)


def _central_cross(depth, valid, rays):
    """Central differences of the points P = d rho, a along x and b along y, their cross product, its length, and
    where it is defined (pixel and all four neighbours valid); all of the interior, shape (H - 2, W - 2, ...)."""
    P = np.where(valid, depth, 0.0)[..., None] * rays
    a, b = P[1:-1, 2:] - P[1:-1, :-2], P[2:, 1:-1] - P[:-2, 1:-1]
    c = np.cross(a, b)
    length = np.linalg.norm(c, axis=-1)
    defined = valid[1:-1, 1:-1] & valid[1:-1, 2:] & valid[1:-1, :-2] & valid[2:, 1:-1] & valid[:-2, 1:-1]
    return a, b, c, length, defined & (length > 0)


def normal(depth, valid, rays, pixel_weight, weight):
    """weight / (2N) sum_i pixel_weight_i ((1 - n_i.n_right) + (1 - n_i.n_down)) where both normals are defined
    (the paper's L_s)."""
    if min(depth.shape) < 3:
        return 0.0, np.zeros(depth.shape)
    a, b, c, length, defined = _central_cross(depth, valid, rays)
    length = np.where(defined, length, 1.0)
    n = np.where(defined[..., None], c / length[..., None], 0.0)
    scale = weight / (2 * depth.size) * pixel_weight[1:-1, 1:-1]
    value, v_n = 0.0, np.zeros_like(n)
    for first, second in (((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
                          ((slice(None, -1),), (slice(1, None),))):
        w = scale[first] * defined[first] * defined[second]
        value += float((w * (1 - (n[first] * n[second]).sum(axis=-1))).sum())
        v_n[first] -= w[..., None] * n[second]
        v_n[second] -= w[..., None] * n[first]
    v_c = (v_n - n * (n * v_n).sum(axis=-1, keepdims=True)) / length[..., None]
    v_a, v_b = np.cross(b, v_c), np.cross(v_c, a)
    v_P = np.zeros(rays.shape)
    v_P[1:-1, 2:] += v_a
    v_P[1:-1, :-2] -= v_a
    v_P[2:, 1:-1] += v_b
    v_P[:-2, 1:-1] -= v_b
    return value, np.where(valid, (v_P * rays).sum(axis=-1), 0.0)


def normals(depth, valid, rays):
    """Unit normals (H, W, 3) from central differences of the depth map's points, 0 where not defined; they look
    along +z of the target (away from it), as (P_right - P_left) x (P_down - P_up) does."""
    n = np.zeros(rays.shape)
    if min(depth.shape) >= 3:
        _, _, c, length, defined = _central_cross(depth, valid, rays)
        n[1:-1, 1:-1] = np.where(defined[..., None], c / np.where(defined, length, 1.0)[..., None], 0.0)
    return n


def raised(weights, specularity, most: float):
    """Weights (H, W) raised where a surface is specular: by (largest residual within 3 samples / 0.007)^2, 1 to `most`.

    `specularity`: residuals on a grid over the image, NaN = unknown; the factors are interpolated between its samples.
    """
    around = 3
    padded = np.pad(np.nan_to_num(specularity), around)
    largest = np.lib.stride_tricks.sliding_window_view(padded, (2 * around + 1,) * 2).max(axis=(2, 3))
    factors = np.clip((largest / 0.007) ** 2, 1.0, most)
    for axis, (pixels, samples) in enumerate(zip(weights.shape, specularity.shape)):
        at = np.clip((np.arange(pixels) + 0.5) * samples / pixels - 0.5, 0, samples - 1)
        low = at.astype(int)
        share = (at - low)[:, None] if axis == 0 else at - low
        factors = (1 - share) * factors.take(low, axis) + share * factors.take(np.minimum(low + 1, samples - 1), axis)
    return weights * factors
