"""Twin of splat/project: Gaussians with one degree of freedom, seen from a context view, with every derivative by d.

Method section 3, paper eq. 3 and 4.
"""

from dataclasses import dataclass

import numpy as np

from pagas_cl.scene.camera import Camera
from pagas_cl.scene.sampling import scene_scale_of

NEAR, FAR = 1e-3, 1e6  # depths of Gaussians that are drawn, in units


@dataclass(frozen=True, eq=False)
class Projected:
    """The target's N Gaussians in one context view; symmetric 2x2 matrices are stored as (xx, xy, yy).

    Where `valid` is false (no surface, or z <= near) the other fields hold finite numbers without meaning.
    """

    valid: np.ndarray       # (N,) bool
    z: np.ndarray           # (N,): depth in the context view, units
    z_d: np.ndarray
    m: np.ndarray           # (N, 2): projected mean, pixels (first pixel's centre at 0.5)
    m_d: np.ndarray
    Sigma: np.ndarray       # (N, 3): projected covariance without low-pass, px^2
    Sigma_d: np.ndarray
    K: np.ndarray           # (N, 3): conic (Sigma + eps I)^-1, px^-2
    o: np.ndarray           # (N,): compensation factor on opacity, 1 without low-pass
    log_o_d: np.ndarray     # (N,): derivative of its logarithm


def normalized_depth(depth: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Depth in units of its median, float32, 0 where there is none, and that median, the scene's scale.

    Depths outside NEAR to FAR units, masked out or not finite have no Gaussian.
    """
    depth = depth if depth.dtype in (np.float32, np.float64) else depth.astype(np.float32)
    scene_scale = scene_scale_of(depth, mask)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = (depth / np.asarray(scene_scale, depth.dtype)).astype(np.float32)
        valid = (depth > 0) & (depth < np.inf) & (scaled >= NEAR) & (scaled <= FAR)
    return np.where(valid if mask is None else valid & mask, scaled, np.float32(0)), scene_scale


def is_valid(depth: np.ndarray) -> np.ndarray:
    """Where a depth map has a surface: finite and above 0 (method section 1)."""
    return np.isfinite(depth) & (np.nan_to_num(depth, posinf=0.0) > 0)


def project(depth: np.ndarray, target: Camera, context: Camera, low_pass: float = 0.0,
            scene_scale: float = 1.0) -> Projected:
    """Project the Gaussians of `target` into `context` (method section 3).

    `depth` (height, width) is z-depth in units (scene units divided by `scene_scale`; the cameras are in scene units),
    0 = no surface; `low_pass` is eps, px^2, and 0 leaves low-pass and compensation out.
    """
    valid = is_valid(depth).ravel()
    d = np.where(valid, depth.ravel(), 1.0)
    R, tau = context.relative_to(target)
    tau = tau / scene_scale
    rays = target.rays().reshape(-1, 3)
    q = rays @ R.T
    sigma = 1 / (2 * np.sqrt(target.fx * target.fy) * np.linalg.norm(rays, axis=-1))    # of s_i = d_i sigma_i
    z = d * q[:, 2] + tau[2]
    valid = valid & (z > NEAR)
    z = np.where(valid, z, 1.0)
    XY = (d[:, None] * q[:, :2] + tau[:2]) / z[:, None]
    XY_d = (q[:, :2] * tau[2] - q[:, 2:] * tau[:2]) / z[:, None] ** 2
    focal = np.array([context.fx, context.fy])
    k, k_d = d * sigma / z, sigma * tau[2] / z**2
    Sigma, Sigma_d = _covariance(k, k_d, XY, XY_d, focal)
    K, o, log_o_d = _low_pass(Sigma, Sigma_d, k, k_d, XY, XY_d, focal, low_pass)
    return Projected(valid, z, q[:, 2], XY * focal + (context.cx, context.cy), XY_d * focal, Sigma, Sigma_d, K, o,
                     log_o_d)


def _covariance(k, k_d, XY, XY_d, focal):
    """Sigma = s^2 J J^T and dSigma/dd, with J the Jacobian of the projection (EWA; method section 3)."""
    (fx, fy), (X, Y), (X_d, Y_d) = focal, XY.T, XY_d.T
    shape = np.stack([fx**2 * (1 + X**2), fx * fy * X * Y, fy**2 * (1 + Y**2)], axis=1)
    shape_d = np.stack([2 * fx**2 * X * X_d, fx * fy * (X_d * Y + X * Y_d), 2 * fy**2 * Y * Y_d], axis=1)
    Sigma = (k**2)[:, None] * shape
    return Sigma, (2 * k * k_d)[:, None] * shape + (k**2)[:, None] * shape_d


def _low_pass(Sigma, Sigma_d, k, k_d, XY, XY_d, focal, eps):
    """Conic K = (Sigma + eps I)^-1, compensation o = sqrt(det Sigma / det(Sigma + eps I)) and d(log o)/dd."""
    norm2 = 1 + (XY**2).sum(axis=1)
    det_Sigma = k**4 * (focal[0] * focal[1]) ** 2 * norm2
    if eps == 0:  # the closed form of the determinant has no cancellation
        K = np.stack([Sigma[:, 2], -Sigma[:, 1], Sigma[:, 0]], axis=1) / det_Sigma[:, None]
        return K, np.ones_like(k), np.zeros_like(k)
    det = det_Sigma + eps * (Sigma[:, 0] + Sigma[:, 2]) + eps**2
    K = np.stack([Sigma[:, 2] + eps, -Sigma[:, 1], Sigma[:, 0] + eps], axis=1) / det[:, None]
    trace = K[:, 0] * Sigma_d[:, 0] + 2 * K[:, 1] * Sigma_d[:, 1] + K[:, 2] * Sigma_d[:, 2]
    log_o_d = 0.5 * (4 * k_d / k + 2 * (XY * XY_d).sum(axis=1) / norm2 - trace)
    return K, np.sqrt(det_Sigma / det), log_o_d
