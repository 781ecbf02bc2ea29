"""Twin of surface/agree: which depths other views confirm, and which they should see (method section 7).

A depth d of view t is carried to view j: Q = d R rho + tau, seen there at m with depth z. View j confirms it when its
own depth at m differs from z by no more than a number of pixels of parallax, one pixel of parallax being the change of
d that moves m by one pixel (root mean square over the views that see the point). View j should see it when it has a
surface at m that does not hide it.
"""

import numpy as np

from pagas_cl.scene.camera import Camera

OCCLUDED = 0.05   # share of the depth: a surface nearer by more hides what is behind it
_FRONT = 1e-6     # share of the target's depth: nearer to a camera's plane than this is behind it
_ROWS = 1 << 19   # pixels worked on at a time, which bounds memory to some 100 MB


def count(target: Camera, depth: np.ndarray, cameras: list[Camera], depths: list[np.ndarray],
          pixels: float) -> tuple[np.ndarray, np.ndarray]:
    """How many other views confirm each depth, and how many should see it: two arrays of shape (H, W), uint16.

    `depth` (H, W) is the target's, 0 = no surface; `cameras` and `depths` are the other views'; `pixels` of parallax
    are the tolerance.
    """
    others = [(camera, other, *camera.relative_to(target)) for camera, other in zip(cameras, depths)]
    counts = np.zeros((2, depth.size), np.uint16)
    valid = np.flatnonzero(depth.reshape(-1) > 0)
    for start in range(0, len(valid), _ROWS):
        chunk = valid[start:start + _ROWS]
        counts[:, chunk] = _count(target, depth.reshape(-1)[chunk].astype(np.float64), chunk, others, pixels)
    return tuple(counts.reshape(2, *depth.shape))


def _count(target: Camera, d: np.ndarray, pixel: np.ndarray, others: list, pixels: float) -> np.ndarray:
    rows, columns = np.divmod(pixel, target.width)
    rho = np.stack([(columns + 0.5 - target.cx) / target.fx, (rows + 0.5 - target.cy) / target.fy, np.ones(len(d))])
    squared, views, expected = np.zeros(len(d)), np.zeros(len(d)), np.zeros(len(d))
    errors = np.full((len(others), len(d)), np.inf)
    for error, (camera, depth, rotation, tau) in zip(errors, others):
        q = rotation @ rho
        x, y, z = q * d + tau[:, None]
        front = z > _FRONT * d
        z = np.where(front, z, 1)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        moved = ((camera.fx * (q[0] * tau[2] - q[2] * tau[0]) / z**2) ** 2
                 + (camera.fy * (q[1] * tau[2] - q[2] * tau[1]) / z**2) ** 2)
        squared += np.where(inside, moved, 0)
        views += inside
        error[inside] = difference(depth, u[inside], v[inside], z[inside])
        found = depth[v[inside].astype(np.intp), u[inside].astype(np.intp)]
        expected[inside] += (found > 0) & (z[inside] < found * (1 + OCCLUDED))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_per_parallax = np.sqrt(views / squared)  # one pixel of parallax, in depth; inf or NaN where there is none
    depth_per_parallax = np.where(np.isfinite(depth_per_parallax), depth_per_parallax, 0)
    return np.stack([np.count_nonzero((errors <= pixels * depth_per_parallax) & (depth_per_parallax > 0), axis=0),
                     expected])


def difference(depth: np.ndarray, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> np.ndarray:
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
