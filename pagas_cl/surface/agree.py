"""Which depths other views confirm (method section 7), in NumPy.

A depth d of view t is carried to view j: Q = d R rho + tau, seen there at m with depth z. View j confirms it when its
own depth at m differs from z by no more than a number of pixels of parallax, one pixel of parallax being the change of
d that moves m by one pixel (root mean square over the views that see the point).
"""

from __future__ import annotations

import numpy as np

from pagas_cl.config import Fusion
from pagas_cl.errors import InputError
from pagas_cl.scene.camera import Camera

_ROWS = 1 << 19  # pixels worked on at a time, which bounds memory to some 100 MB


def confirmations(target: Camera, depth: np.ndarray, cameras: list[Camera], depths: list[np.ndarray | None],
                  pixels: float = 2.0) -> np.ndarray:
    """How many other views confirm each depth.

    Parameters
    ----------
    target : Camera
    depth : ndarray of shape (H, W)
        Its depth map, 0 = no surface.
    cameras, depths : lists of the same length
        The other views, without the target; None where a view has no depth map.
    pixels : float
        Tolerance, pixels of parallax.

    Returns
    -------
    ndarray of shape (H, W), uint16; 0 where there is no surface or no parallax
    """
    if len(cameras) != len(depths):
        raise InputError(f"there are {len(cameras)} cameras and {len(depths)} depth maps, expected one each")
    for camera, other in [(target, depth), *zip(cameras, depths)]:
        if other is not None and other.shape != (camera.height, camera.width):
            raise InputError(f"depth map of {camera.name!r} is {other.shape[1]} x {other.shape[0]}, its camera says "
                             f"{camera.width} x {camera.height}")
    others = [(camera, other, *camera.relative_to(target)) for camera, other in zip(cameras, depths)
              if other is not None]
    count = np.zeros(depth.size, np.uint16)
    valid = np.flatnonzero(depth.reshape(-1) > 0)
    for start in range(0, len(valid), _ROWS):
        chunk = valid[start:start + _ROWS]
        count[chunk] = _confirmed(target, depth.reshape(-1)[chunk].astype(np.float64), chunk, others, pixels)
    return count.reshape(depth.shape)


def confirmed(cameras: list[Camera], depths: list[np.ndarray | None], settings: Fusion,
              neighbours: list | None = None) -> list[np.ndarray | None]:
    """Copies of the depth maps without the depths that fewer than `settings.agree_views` others confirm.

    Parameters
    ----------
    neighbours : list of sequences of int, optional
        For each view the others to ask (its context views); all others where it is left out.
    """
    if settings.agree_views == 0:
        return list(depths)
    kept = []
    for i, (camera, depth) in enumerate(zip(cameras, depths)):
        asked = [j for j in (range(len(cameras)) if neighbours is None else neighbours[i]) if j != i]
        if depth is None:
            kept.append(None)
            continue
        count = confirmations(camera, depth, [cameras[j] for j in asked], [depths[j] for j in asked],
                              settings.agree_pixels)
        kept.append(np.where(count >= settings.agree_views, depth, np.float32(0)))
    return kept


def _confirmed(target: Camera, d: np.ndarray, pixel: np.ndarray, others: list, pixels: float) -> np.ndarray:
    rows, columns = np.divmod(pixel, target.width)
    rho = np.stack([(columns + 0.5 - target.cx) / target.fx, (rows + 0.5 - target.cy) / target.fy, np.ones(len(d))])
    squared, views = np.zeros(len(d)), np.zeros(len(d))
    errors = np.full((len(others), len(d)), np.inf)
    for error, (camera, depth, rotation, tau) in zip(errors, others):
        q = rotation @ rho
        x, y, z = q * d + tau[:, None]
        front = z > 1e-6 * d
        z = np.where(front, z, 1)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        moved = ((camera.fx * (q[0] * tau[2] - q[2] * tau[0]) / z**2) ** 2
                 + (camera.fy * (q[1] * tau[2] - q[2] * tau[1]) / z**2) ** 2)
        squared += np.where(inside, moved, 0)
        views += inside
        error[inside] = _difference(depth, u[inside], v[inside], z[inside])
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = np.sqrt(views / squared)  # one pixel of parallax, in depth; inf or NaN where there is none
    unit = np.where(np.isfinite(unit), unit, 0)
    return np.count_nonzero((errors <= pixels * unit) & (unit > 0), axis=0)


def _difference(depth: np.ndarray, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> np.ndarray:
    """|own depth - z|: the smaller of the pixel's own and, where all four neighbours are valid, their interpolation.

    Inverse depth is interpolated, since it is linear in the image on every plane. Infinite where there is no depth.
    """
    height, width = depth.shape
    near = depth[v.astype(np.intp), u.astype(np.intp)]
    best = np.where(near > 0, np.abs(near - z), np.inf)
    x, y = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(np.intp), max(width - 2, 0)), np.minimum(y.astype(np.intp), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = x - left, y - top
    inverse, valid = np.zeros(len(u)), np.ones(len(u), bool)
    for rows, columns, share in ((top, left, (1 - fy) * (1 - fx)), (top, right, (1 - fy) * fx),
                                 (bottom, left, fy * (1 - fx)), (bottom, right, fy * fx)):
        corner = depth[rows, columns].astype(np.float64)
        valid &= corner > 0
        inverse += share / np.where(corner > 0, corner, 1)
    return np.where(valid, np.minimum(best, np.abs(1 / np.where(valid, inverse, 1) - z)), best)
