"""Twin of splat/smooth, without its loss, which ships: weights where a surface is specular, and normals to look at."""

import numpy as np

from pagas_cl.method.reference.smooth import _central_cross


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
