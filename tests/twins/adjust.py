"""Twin of cameras/adjust: normal equations of cameras, one free depth a pixel eliminated (method section 9)."""

from __future__ import annotations

import numpy as np

from pagas_cl.method.cameras.adjust import BORDER, CUT, HUBER


def cubic(t):
    """Catmull and Rom's weights of four neighbours, and their derivatives: (4, ...)."""
    w = np.stack([t * (-0.5 + t * (1 - 0.5 * t)), 1 + t * t * (1.5 * t - 2.5), t * (0.5 + t * (2 - 1.5 * t)),
                  t * t * (0.5 * t - 0.5)])
    dw = np.stack([-0.5 + t * (2 - 1.5 * t), t * (4.5 * t - 5), 0.5 + t * (4 - 4.5 * t), t * (1.5 * t - 1)])
    return w, dw


def looked_up(image, x, y):
    """Value and gradient (by x, by y) at positions at least BORDER inside."""
    left, top = np.floor(x - 0.5).astype(int), np.floor(y - 0.5).astype(int)
    (wx, dx), (wy, dy) = cubic(x - 0.5 - left), cubic(y - 0.5 - top)
    corners = np.stack([[image[top - 1 + v, left - 1 + u] for u in range(4)] for v in range(4)])
    return (np.einsum("vn,un,vun->n", wy, wx, corners), np.einsum("vn,un,vun->n", wy, dx, corners),
            np.einsum("vn,un,vun->n", dy, wx, corners))


def residuals(target, other, depth, other_depth, normal, other_normal, tolerance):
    """Residual of each pixel (H W), NaN where the other view does not see it; gradient there (H W, 2), point in the
    other camera's frame (H W, 3)."""
    rotation, tau = other.relative_to(target)
    d, ray = depth.ravel(), target.rays().reshape(-1, 3)
    point = d[:, None] * (ray @ rotation.T) + tau
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = (f * point[:, k] / point[:, 2] + c for k, (f, c) in enumerate([(other.fx, other.cx),
                                                                              (other.fy, other.cy)]))
    v, u = np.divmod(np.arange(d.size), target.width)
    seen = (d > 0) & (point[:, 2] > 0)
    for camera, a, b in ((target, u + 0.5, v + 0.5), (other, x, y)):
        seen &= (a >= BORDER) & (b >= BORDER) & (a <= camera.width - BORDER) & (b <= camera.height - BORDER)
    at = np.flatnonzero(seen)
    own = other_depth[y[at].astype(int), x[at].astype(int)]
    at = at[(own > 0) & (np.abs(own - point[at, 2]) <= tolerance * point[at, 2])]
    value, *slope = looked_up(other_normal, x[at], y[at])
    residual, gradient = np.full(d.size, np.nan), np.zeros((d.size, 2))
    residual[at] = value - normal.ravel()[at]
    gradient[at] = np.where(np.isfinite(residual[at, None]), np.stack(slope, -1), 0)
    return residual, gradient, point


def weights(residual):
    """Huber's, and 0 beyond the cut and where nothing is seen."""
    size = np.abs(np.nan_to_num(residual, nan=np.inf))
    return np.where(size > CUT, 0.0, np.where(size > HUBER, HUBER / np.maximum(size, HUBER), 1.0))


def derivatives(target, other, depth, gradient, point):
    """Of the residual: by the other camera's twist (turning first), logarithm of its focal length and principal point,
    those of the target's, scale and shift of its depth map: (H W, 14); by the depth: (H W,)."""
    rotation, _ = other.relative_to(target)
    ray = target.rays().reshape(-1, 3)
    z = np.where(point[:, 2] > 0, point[:, 2], 1.0)
    gx, gy = gradient.T * [[other.fx], [other.fy]]
    x, y = point[:, 0] / z, point[:, 1] / z
    J = np.stack([gx, gy, -(gx * x + gy * y)], -1) / z[:, None]
    by_depth = (J * (ray @ rotation.T)).sum(-1)
    d = depth.reshape(-1, 1)
    own = d * (J @ rotation)
    intrinsics = [gx * x + gy * y, *gradient.T, -(own[:, :2] * ray[:, :2]).sum(-1), -own[:, 0] / target.fx,
                  -own[:, 1] / target.fy, d[:, 0] * by_depth, by_depth]
    return np.concatenate([np.cross(point, J), J, np.stack(intrinsics, -1)], -1), by_depth


def block(target, others, depth, other_depths, normal, other_normals, prior, tolerance, columns=6):
    """Matrix (K, C, K, C), right side (K, C), pixels used and sums of squares (K,), and the depths' own steps as
    numerator and denominator (H W, 2)."""
    rows = []
    for other, other_depth, other_normal in zip(others, other_depths, other_normals):
        residual, gradient, point = residuals(target, other, depth, other_depth, normal, other_normal, tolerance)
        by, by_depth = derivatives(target, other, depth, gradient, point)
        root = np.sqrt(weights(residual))
        rows.append((root[:, None] * by[:, :columns], root * np.nan_to_num(residual), root * by_depth))
    a, r, c = (np.stack(part) for part in zip(*rows))
    h = prior + (c**2).sum(0)
    g = a * c[..., None]
    matrix = -np.einsum("kpi,lpj,p->kilj", g, g, 1 / h)
    for k in range(len(others)):
        matrix[k, :, k] += a[k].T @ a[k]
    b = (c * r).sum(0)
    left = r - c * b / h
    steps = np.where(depth.reshape(-1, 1) > 0, np.stack([-b, h], -1), 0)
    return matrix, np.einsum("kpi,kp->ki", a, left), (a != 0).any(-1).sum(1), (left**2).sum(1), steps
